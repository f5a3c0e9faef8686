//! Studio lighting: contrast of faces and background, ambient occlusion, and a ground that shows only shadows.

use std::sync::Arc;

use modalcast_model::domain::{Material, Mesh};
use modalcast_model::scene::{
    AmbientOcclusion, Camera, Lens, Lighting, RenderSettings, Scene, SceneParts, UpAxis, View,
};
use modalcast_render::Pass;
use nalgebra::{Point3, Vector3};

use super::contrast::lab;
use super::harness::{
    RenderedFrame, SceneBuilder, colored_material, decode_srgb, facing_rectangle, open_renderer, render_sized,
    render_with_normals,
};

const SIZE: [u32; 2] = [160, 120];

/// A box with a normal per face.
fn box_mesh(min: [f32; 3], max: [f32; 3]) -> Mesh {
    let (mut positions, mut normals, mut triangles) = (Vec::new(), Vec::new(), Vec::new());
    for (axis, is_max) in (0..3).flat_map(|axis| [(axis, false), (axis, true)]) {
        let first = positions.len() as u32;
        for (u, v) in [(false, false), (true, false), (true, true), (false, true)] {
            let mut corner = [0.0; 3];
            for (component, is_far) in [(axis, is_max), ((axis + 1) % 3, u), ((axis + 2) % 3, v)] {
                corner[component] = if is_far { max[component] } else { min[component] };
            }
            positions.push(corner);
            let side = if is_max { 1.0 } else { -1.0 };
            normals.push(std::array::from_fn(|component| if component == axis { side } else { 0.0 }));
        }
        let [a, b, c, d] = [0, 1, 2, 3].map(|corner| first + corner);
        triangles.extend(if is_max { [[a, b, c], [a, c, d]] } else { [[a, c, b], [a, d, c]] });
    }
    Mesh::from_indexed(positions, normals, Vec::new(), triangles).expect("expected a valid mesh")
}

/// A cube of the default material with this up axis.
fn cube(up: UpAxis, look: RenderSettings) -> Arc<Scene> {
    let mut builder = SceneBuilder::new().add_domain(box_mesh([-1.0; 3], [1.0; 3]), Material::unspecified(""));
    builder.parts = SceneParts { up, look, ..builder.parts };
    builder.build()
}

/// The pixel that shows a point.
fn pixel_of(camera: &Camera, scene: &Scene, point: [f64; 3]) -> [u32; 2] {
    let [width, height] = SIZE;
    let clip = camera.clip_from_camera(width, height, &scene.rest_bounds) * camera.camera_from_world();
    let ndc = clip.transform_point(&Point3::from(point));
    [0.5 * (ndc.x + 1.0) * f64::from(width), 0.5 * (1.0 - ndc.y) * f64::from(height)].map(|pixel| pixel as u32)
}

/// Mean CIELAB color of 5 x 5 pixels around a pixel.
fn lab_at(frame: &RenderedFrame, [x, y]: [u32; 2]) -> [f64; 3] {
    let mut sum = [0.0; 3];
    for (dx, dy) in (0..5).flat_map(|dy| (0..5).map(move |dx| (dx, dy))) {
        for (sum, component) in sum.iter_mut().zip(lab(frame.pixel(x + dx - 2, y + dy - 2))) {
            *sum += component / 25.0;
        }
    }
    sum
}

fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    (Vector3::from(a) - Vector3::from(b)).norm()
}

/// The smallest color difference (CIE 1976) between two visible faces of the cube, and between a face and the
/// background.
fn contrasts(up: UpAxis, look: RenderSettings) -> [f64; 2] {
    let scene = cube(up, look);
    let camera = Camera::fit_to_scene(&scene, SIZE[0], SIZE[1]);
    let frame = render_sized(&mut open_renderer(), &scene, camera, SIZE);
    let from_y_up = up.rotation_from_y_up();
    let faces = [Vector3::x(), Vector3::y(), Vector3::z()]
        .map(|normal| lab_at(&frame, pixel_of(&camera, &scene, (from_y_up * normal).into())));
    let background = lab_at(&frame, [4, 4]);
    let between_faces =
        [(0, 1), (1, 2), (2, 0)].map(|(a, b)| distance(faces[a], faces[b])).into_iter().fold(f64::MAX, f64::min);
    let to_background = faces.map(|face| distance(face, background)).into_iter().fold(f64::MAX, f64::min);
    eprintln!("{up:?}: {between_faces:.1} between faces, {to_background:.1} to the background");
    [between_faces, to_background]
}

/// Negative control: with uniform ambient light only, two faces of the cube have almost the same color.
#[test]
fn faces_of_a_part_and_the_background_differ() {
    for up in [UpAxis::X, UpAxis::Y, UpAxis::Z] {
        let [between_faces, to_background] = contrasts(up, Lighting::Studio.settings());
        assert!(between_faces >= 12.0, "{up:?}: {between_faces} between faces");
        assert!(to_background >= 25.0, "{up:?}: {to_background} to the background");
    }
    let flat = RenderSettings { sunlight: [0.0; 3], ..RenderSettings::default() };
    let [between_faces, _] = contrasts(UpAxis::Y, flat);
    assert!(between_faces < 2.0, "control: {between_faces}");
}

/// A wall in the plane z = 0, and a plate in the plane x = 0 in front of it. There is only ambient light, so the linear
/// color of a white point is 0.5 times its visibility.
fn wall_and_plate(ambient_occlusion: Option<AmbientOcclusion>) -> Arc<Scene> {
    let white = || Material { ambient: [1.0; 3], ..colored_material([1.0; 3]) };
    let mut builder = SceneBuilder::new()
        .add_domain(facing_rectangle(-2.0, -2.0, 0.0, 2.0, 0.0), white())
        .add_domain(box_mesh([0.0, -2.0, 0.0], [0.01, 2.0, 2.0]), white());
    let look = builder.parts.look;
    builder.parts.look =
        RenderSettings { ambient_occlusion, sunlight: [0.0; 3], skylight: [0.5; 3], samples: 1, ..look };
    builder.build()
}

/// The visibility beside an upright plate that is higher than the radius is 1 - f(k) at the distance of k radii, with
/// f(k) = ((1 + 2 k^2) arccos k - 3 k sqrt(1 - k^2)) / pi: the integral of the definition over half of the directions.
/// The few points of a horizon miss up to two fifths of f.
#[test]
fn ambient_occlusion_beside_a_plate_is_that_of_the_definition() {
    let view = View::LookAt { eye: [-3.0, 0.5, 9.0], target: [-0.6, 0.0, 0.0], up: [0.0, 1.0, 0.0] };
    let camera = Camera { view, lens: Lens::FieldOfView(16.0), near: 0.0, far: 0.0 };
    let occlusion = AmbientOcclusion { radius: 0.15 };
    let scene = wall_and_plate(Some(occlusion));
    let radius = f64::from(occlusion.radius) * scene.rest_bounds.diagonal();
    let renderer = &mut open_renderer();
    let frame = render_sized(renderer, &scene, camera, SIZE);
    let control = render_sized(renderer, &wall_and_plate(None), camera, SIZE);
    assert!(frame.stats.passes.contains(&Pass::AmbientOcclusion), "{:?}", frame.stats.passes);
    assert!(!control.stats.passes.contains(&Pass::AmbientOcclusion), "control: {:?}", control.stats.passes);
    let mut nearer = 0.0;
    for k in [0.1, 0.25, 0.5, 0.75, 1.5] {
        let [x, y] = pixel_of(&camera, &scene, [-k * radius, 0.0, 0.0]);
        let visibility = |frame: &RenderedFrame| decode_srgb(frame.pixel(x, y)[1]) / 0.5;
        let near = f64::min(k, 1.0);
        let occluded =
            ((1.0 + 2.0 * near * near) * near.acos() - 3.0 * near * (1.0 - near * near).sqrt()) / std::f64::consts::PI;
        let (rendered, expected) = (visibility(&frame), 1.0 - occluded);
        eprintln!("k = {k}: {rendered:.3}, expected {expected:.3}");
        let tolerance = 0.03 + 0.4 * occluded;
        assert!((rendered - expected).abs() < tolerance, "k = {k}: expected {expected}, got {rendered}");
        assert!(rendered >= nearer, "k = {k}: expected at least {nearer}, got {rendered}");
        nearer = rendered;
        assert!((visibility(&control) - 1.0).abs() < 0.01, "control at k = {k}: {}", visibility(&control));
    }
}

/// Negative control: a ground with a color of its own is visible.
#[test]
fn ground_shows_only_shadows() {
    let differing_pixels = |look: RenderSettings| {
        let without_ground = RenderSettings { ground: None, ..look };
        let [frame, empty] = [look, without_ground].map(|look| {
            let scene = cube(UpAxis::Y, look);
            let camera = Camera::fit_to_scene(&scene, SIZE[0], SIZE[1]);
            render_sized(&mut open_renderer(), &scene, camera, SIZE)
        });
        let differs = |(x, y): &(u32, u32)| {
            (0..3).any(|channel| frame.pixel(*x, *y)[channel].abs_diff(empty.pixel(*x, *y)[channel]) > 1)
        };
        (0..SIZE[1]).flat_map(|y| (0..SIZE[0]).map(move |x| (x, y))).filter(differs).count()
    };
    let look = Lighting::Studio.settings();
    let (shown, pixels) = (differing_pixels(look), (SIZE[0] * SIZE[1]) as usize);
    assert!(shown > pixels / 100 && shown < pixels / 4, "{shown} of {pixels}");
    let unlit = differing_pixels(RenderSettings { shadow: None, ambient_occlusion: None, ..look });
    assert_eq!(unlit, 0, "expected no trace of the ground without shadow and occlusion");
    let colored = differing_pixels(RenderSettings { ground: RenderSettings::default().ground, ..look });
    assert!(colored > pixels / 4, "control: {colored} of {pixels}");
}

/// Small frames, a tiny radius and the largest one, and cameras inside of the part and far from it: a
/// frame has at most the mean brightness of the frame without ambient occlusion, and at least 0.6 times this
/// brightness.
#[test]
fn extreme_frames_have_ambient_occlusion() {
    let renderer = &mut open_renderer();
    let studio = Lighting::Studio.settings();
    for (radius, distance, size) in [
        (1e-6, 6.0, [64, 48]),
        (1.0, 6.0, [64, 48]),
        (0.15, 6.0, [1, 1]),
        (0.15, 6.0, [3, 5]),
        (0.15, 0.1, [33, 17]),
        (0.15, 1e6, [64, 48]),
        (0.15, 1e12, [64, 48]),
        (0.15, 6.0, [61, 230]),
    ] {
        let [frame, control] = [Some(AmbientOcclusion { radius }), None].map(|ambient_occlusion| {
            let scene = cube(UpAxis::Y, RenderSettings { ambient_occlusion, ..studio });
            let eye = [0.3 * distance, 0.2 * distance, distance];
            let view = View::LookAt { eye, target: [0.0; 3], up: [0.0, 1.0, 0.0] };
            let camera = Camera { view, lens: Lens::FieldOfView(40.0), near: 0.0, far: 0.0 };
            render_sized(renderer, &scene, camera, size)
        });
        let brightness = |frame: &RenderedFrame| {
            let pixels = frame.image.rgba.chunks_exact(4);
            pixels.map(|pixel| u64::from(pixel[1])).sum::<u64>() as f64 / f64::from(size[0] * size[1])
        };
        let [with, without] = [brightness(&frame), brightness(&control)];
        let case = format!("radius {radius}, distance {distance}, {size:?}");
        assert!(with <= without + 0.5 && with >= 0.6 * without, "{case}: {with} with, {without} without");
        let darkest = frame.image.rgba.chunks_exact(4).map(|pixel| pixel[1]).min();
        assert!(darkest > Some(20), "{case}: expected no black pixel, got {darkest:?}");
    }
}

/// A normal that is 0 or not finite gives neither a black pixel nor a white one.
#[test]
fn surfaces_without_normals_are_lit() {
    for normal in [[0.0; 3], [f32::NAN; 3], [f32::INFINITY, 0.0, 0.0]] {
        let scene = cube(UpAxis::Y, Lighting::Studio.settings());
        let camera = Camera::fit_to_scene(&scene, SIZE[0], SIZE[1]);
        let frame = render_with_normals(&mut open_renderer(), &scene, camera, SIZE, normal);
        let [x, y] = pixel_of(&camera, &scene, [0.0, 0.0, 1.0]);
        let pixel = frame.pixel(x, y);
        assert!(pixel.iter().all(|channel| (20..=250).contains(channel)), "{normal:?}: {pixel:?}");
    }
}
