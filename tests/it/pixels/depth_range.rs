//! Objects of every size and at every distance are drawn, picked and measured, and nearer surfaces hide farther ones.
//! The cameras have no clip planes of their own.

use std::sync::Arc;

use modalcast_compute::reference::ReferenceDeformer;
use modalcast_model::deform::Deformer as _;
use modalcast_model::domain::{Material, Mesh};
use modalcast_model::scene::{Camera, Lens, PixelRect, RenderSettings, Scene, SceneState, ShadowSettings, View};
use modalcast_render::{Aov, FrameParams, PickHit, Renderer, VisibilityId};

use super::harness::{SceneBuilder, colored_material, facing_rectangle, floor_mesh, open_renderer, render_square};

/// Side of the images in pixels.
const SIZE: u32 = 64;
/// Focal length of the cameras in pixels: a square of side s at the distance d is 100 s / d pixels wide.
const FOCAL_LENGTH: f64 = 100.0;

/// A camera at `eye` that looks along -z.
fn camera_at(eye: [f64; 3]) -> Camera {
    // Only the direction of the target matters. It is so far away that `eye - target` does not round to 0.
    let target = [eye[0], eye[1], eye[2] - eye[2].abs().max(1.0)];
    let center = f64::from(SIZE) / 2.0;
    Camera {
        view: View::LookAt { eye, target, up: [0.0, 1.0, 0.0] },
        lens: Lens::Intrinsics { fx: FOCAL_LENGTH, fy: FOCAL_LENGTH, cx: center, cy: center },
        near: 0.0,
        far: 0.0,
    }
}

/// A square with side 2 `half_side` that faces the camera. `center` is its center.
fn square(center: [f32; 3], half_side: f32) -> Mesh {
    let [x, y, z] = center;
    facing_rectangle(x - half_side, y - half_side, x + half_side, y + half_side, z)
}

/// What a camera sees of a scene.
struct Observation {
    /// The domain that each pixel shows, row by row from the top.
    domains: Vec<Option<usize>>,
    /// Depth of each pixel in scene units; infinite without a surface.
    depths: Vec<f32>,
    /// The hit at the center of the image.
    hit: Option<PickHit>,
}

impl Observation {
    fn count(&self, domain: usize) -> usize {
        self.domains.iter().filter(|shown| **shown == Some(domain)).count()
    }
}

fn observe(renderer: &mut Renderer, scene: &Arc<Scene>, state: &SceneState, camera: Camera) -> Observation {
    let mut deformer = ReferenceDeformer::new(scene);
    let bounds = deformer.deform(state).expect("expected the step to succeed").bounds;
    let buffers = renderer.load(scene).expect("expected the scene to load");
    renderer.upload(&buffers, deformer.surface().expect("expected a surface")).expect("expected the upload to succeed");
    let params =
        FrameParams { camera, width: SIZE, height: SIZE, bounds, light_bounds: None, edges: None, samples: None };
    renderer.draw(&buffers, &params).expect("expected a frame");
    let samples = renderer.stats().samples as usize;
    let domain_of = |id: &VisibilityId| match id {
        VisibilityId::Triangle(triangle) => buffers.source_triangle(*triangle).map(|(domain, _)| domain),
        _ => None,
    };
    let ids = renderer.read_visibility().expect("expected visibility ids");
    let domains = ids.iter().step_by(ids.len() / (SIZE * SIZE) as usize).map(domain_of).collect();
    assert!(samples > 1, "expected several visibility ids per pixel, got {samples}");
    let depth_image = renderer.render_aov(&buffers, &params, Aov::Depth).expect("expected depths");
    let rectangle = PixelRect::within([SIZE; 2], [SIZE / 2; 2], [1, 1]).expect("expected a valid rectangle");
    let pick = renderer.begin_pick(&buffers, &params, rectangle).expect("expected a pick to start");
    let hit = renderer.finish_pick(pick).expect("expected a pick").pop();
    renderer.unload(buffers);
    Observation { domains, depths: bytemuck::pod_collect_to_vec(&depth_image.bytes), hit }
}

/// A square in front of a larger one: its distance is five times its side, so that it is 20 pixels wide. The depth of a
/// pixel and of a pick is off by the rounding of the matrix to f32: less than 2^-20 of the distance.
#[test]
fn models_of_all_sizes_are_drawn_picked_and_measured() {
    let mut renderer = open_renderer();
    for exponent in [-11, -8, -4, 0, 4, 7, 9] {
        let size = 10.0_f32.powi(exponent);
        let back_square = square([0.0, 0.0, -10.0 * size], 4.0 * size);
        let scene = SceneBuilder::new()
            .add_domain(square([0.0; 3], size), colored_material([1.0, 0.1, 0.1]))
            .add_domain(back_square, Material::default())
            .build();
        let distance = 10.0 * f64::from(size);
        let eye = [0.0, 0.0, distance];
        let view = View::LookAt { eye, target: [0.0; 3], up: [0.0, 1.0, 0.0] };
        let observation = observe(&mut renderer, &scene, &SceneState::rest(&scene), Camera { view, ..camera_at(eye) });
        // The back square is 100 * 8 / 20 = 40 pixels wide.
        assert_eq!((observation.count(0), observation.count(1)), (20 * 20, 40 * 40 - 20 * 20), "size {size:e}");
        let hit = observation.hit.unwrap_or_else(|| panic!("size {size:e}: expected a hit"));
        let center = (SIZE / 2 * SIZE + SIZE / 2) as usize;
        for depth in [f64::from(observation.depths[center]), hit.depth] {
            let error = (depth / distance - 1.0).abs();
            assert!(hit.domain == 0 && error < 1e-6, "size {size:e}: {error:e} in {hit:?}");
        }
    }
}

/// A table over the ground with shadows, scaled by powers of two: all f32 operations are then exact multiples of each
/// other, so every scale gives the same picture.
#[test]
fn picture_does_not_depend_on_the_scale_of_the_scene() {
    let mut renderer = open_renderer();
    for cascades in [1, 3] {
        let mut render_at = |scale: f64| {
            let mut builder = SceneBuilder::new();
            let shadow = Some(ShadowSettings { cascades, ..ShadowSettings::default() });
            builder.parts.look = RenderSettings { shadow, ..RenderSettings::default() };
            let scaled_floor = |half_side: f32, y: f32| {
                let parts = [half_side, y].map(|length| length * scale as f32);
                floor_mesh(parts[0], parts[1])
            };
            let meshes = [scaled_floor(0.8, 0.5), scaled_floor(0.4, 0.0)];
            let builder =
                meshes.into_iter().fold(builder, |builder, mesh| builder.add_domain(mesh, Material::default()));
            let eye = [1.7, 2.1, 3.3].map(|coordinate: f64| scale * coordinate);
            let target = [0.0, 0.2 * scale, 0.0];
            let view = View::LookAt { eye, target, up: [0.0, 1.0, 0.0] };
            let camera = Camera { view, lens: Lens::FieldOfView(40.0), near: 0.0, far: 0.0 };
            render_square(&mut renderer, &builder.build(), camera, 96).image.rgba
        };
        let expected = render_at(1.0);
        for exponent in [-36, -20, -3, 7, 30] {
            let got = render_at(2.0_f64.powi(exponent));
            let different = got.iter().zip(&expected).filter(|(got, expected)| got.abs_diff(**expected) > 1).count();
            assert_eq!(different, 0, "different channels at the scale 2^{exponent}, {cascades} cascades");
        }
        let pixels: std::collections::HashSet<&[u8]> = expected.chunks_exact(4).collect();
        assert!(pixels.len() > 100, "control: expected a picture with shadows, got {} colors", pixels.len());
    }
}

/// One scene has pairs of squares at distances from a millimeter to ten thousand kilometers. The second square of a
/// pair is behind the first one by 2^-18 of the distance. It must be hidden, whichever is drawn last.
#[test]
fn depth_orders_surfaces_at_all_distances_of_one_scene() {
    let mut renderer = open_renderer();
    let distances: [f32; 6] = [1e-3, 1e-1, 1e1, 1e3, 1e5, 1e7];
    for hidden_is_last in [false, true] {
        let mut builder = SceneBuilder::new();
        for (index, distance) in distances.into_iter().enumerate() {
            // Three columns and two rows, 20 pixels apart; a square is 16 pixels wide.
            let [column, row] = [index % 3, index / 3].map(|number| number as f32);
            let center = |distance: f32| [0.2 * (column - 1.0) * distance, 0.2 * (row - 0.5) * distance, -distance];
            let visible = square(center(distance), 0.08 * distance);
            let hidden = square(center(distance * (1.0 + 0.5_f32.powi(18))), 0.07 * distance);
            let meshes = if hidden_is_last { [visible, hidden] } else { [hidden, visible] };
            for mesh in meshes {
                builder = builder.add_domain(mesh, colored_material([0.8; 3]));
            }
        }
        let scene = builder.build();
        let observation = observe(&mut renderer, &scene, &SceneState::rest(&scene), camera_at([0.0; 3]));
        for (index, distance) in distances.into_iter().enumerate() {
            let (visible, hidden) = (2 * index + usize::from(!hidden_is_last), 2 * index + usize::from(hidden_is_last));
            let counts = [visible, hidden].map(|domain| observation.count(domain));
            assert_eq!(counts, [16 * 16, 0], "distance {distance:e}, hidden square last: {hidden_is_last}");
        }
    }
}

/// T moves an object of half a meter by 4 km or more, and the camera is one meter away from the moved object. The rest
/// bounds and the deformed bounds are then far apart.
#[test]
fn object_beside_the_camera_is_drawn_after_a_long_move() {
    let mut renderer = open_renderer();
    let scene = SceneBuilder::new().add_domain(square([0.0; 3], 0.25), colored_material([0.8; 3])).build();
    // f32 resolves 2^-12 m there, 1/40 of a pixel.
    for translation in [[4000.0, 0.0, 0.0], [0.0, 0.0, -4000.0], [-3000.0, 2000.0, 4000.0_f32]] {
        let mut state = SceneState::rest(&scene);
        (0..3).for_each(|axis| state.transforms[0].0[4 * axis + 3] = translation[axis]);
        let [x, y, z] = translation.map(f64::from);
        let observation = observe(&mut renderer, &scene, &state, camera_at([x, y, z + 1.0]));
        assert_eq!(observation.count(0), 50 * 50, "translation {translation:?}");
        let hit = observation.hit.expect("expected a hit");
        assert!((hit.depth - 1.0).abs() < 1e-3, "{hit:?}");
    }
}

/// Two objects are 5 km apart. A camera beside the first one sees it at its full size, and the second one behind it.
#[test]
fn objects_5_km_apart_are_drawn_together() {
    let mut renderer = open_renderer();
    let scene = SceneBuilder::new()
        .add_domain(square([0.0; 3], 0.1), colored_material([0.8; 3]))
        .add_domain(square([0.0, 0.0, -5000.0], 1000.0), colored_material([0.2, 0.8, 0.2]))
        .build();
    let state = SceneState::rest(&scene);
    // The second square is 100 * 2000 / 5000 = 40 pixels wide.
    for distance in [1.0, 0.5, 1e-3] {
        let observation = observe(&mut renderer, &scene, &state, camera_at([0.0, 0.0, distance]));
        let width = ((FOCAL_LENGTH * 0.2 / distance).min(f64::from(SIZE))) as usize;
        let visible_back = if width < 40 { 40 * 40 - width * width } else { 0 };
        assert_eq!((observation.count(0), observation.count(1)), (width * width, visible_back), "{distance} m");
        let hit = observation.hit.expect("expected a hit");
        assert!(hit.domain == 0 && (hit.depth / distance - 1.0).abs() < 1e-6, "{hit:?}");
    }
    let behind = observe(&mut renderer, &scene, &state, camera_at([0.0, 0.0, -1.0]));
    assert_eq!((behind.count(0), behind.count(1)), (0, 40 * 40), "expected no surface behind the camera");
}
