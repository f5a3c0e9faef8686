//! Tests of the references against analytic results, and of the renderer against the references.

use std::sync::Arc;

use nalgebra::Vector3;

use super::harness::{RenderHarness, Size};
use super::light_meter;
use super::metrics;
use super::ray_scene::{Ray, RayScene};
use super::reference_image::{ReferenceImage, SampleCounts, SunTerm, trace};
use super::reference_texture::linear_from_srgb;
use super::reference_view::View;
use super::rigid_domain::add_rigid_domain;
use super::variants;
use super::workloads::{RenderWorkload, lying, quad};
use super::{RenderReportOptions, render};
use modalcast_compute::reference::ReferenceDeformer;
use modalcast_model::deform::{DeformedSurface, Deformer as _};
use modalcast_model::domain::{AlphaMode, Material, Mesh, Texture};
use modalcast_model::scene::{BoundingBox, Camera, Ground, Lens, Scene, SceneParts, SceneState, View as Eye};
use modalcast_render::FrameParams;

/// An empty scene without sky and ground, with the sun behind the camera.
fn bare() -> SceneParts {
    let mut parts = SceneParts::named("test");
    (parts.look.shadow, parts.look.ground) = (None, None);
    (parts.look.zenith, parts.look.horizon) = ([0.0; 3], [0.0; 3]);
    (parts.look.sun, parts.look.sunlight, parts.look.skylight) = ([0.0, 0.0, 1.0], [0.5; 3], [0.25; 3]);
    parts
}

fn facing([left, bottom, right, top]: [f32; 4], z: f32) -> Mesh {
    quad([[left, bottom, z], [right, bottom, z], [right, top, z], [left, top, z]], [0.0, 0.0, 1.0]).expect("a square")
}

fn surface(scene: &Arc<Scene>) -> (DeformedSurface, BoundingBox) {
    let mut deformer = ReferenceDeformer::new(scene);
    let bounds = deformer.deform(&SceneState::rest(scene)).expect("deforms").bounds;
    (deformer.surface().expect("there").clone(), bounds)
}

/// A shot with ten pixels per unit in the plane z = 0, or y = 0 when seen from above; the origin is in the center of
/// `side` pixels.
fn shot(bounds: BoundingBox, side: u32, above: bool) -> FrameParams {
    let middle = f64::from(side) / 2.0;
    let (eye, up) = if above { ([0.0, 10.0, 0.0], [0.0, 0.0, -1.0]) } else { ([0.0, 0.0, 10.0], [0.0, 1.0, 0.0]) };
    let camera = Camera {
        view: Eye::LookAt { eye, target: [0.0; 3], up },
        lens: Lens::Intrinsics { fx: 100.0, fy: 100.0, cx: middle, cy: middle },
        near: 0.0,
        far: 0.0,
    };
    FrameParams { camera, width: side, height: side, bounds, light: None }
}

fn pictures(parts: SceneParts, above: bool, terms: &[SunTerm], side: u32) -> Vec<ReferenceImage> {
    let scene = Scene::new(parts).expect("a good scene");
    let (surface, bounds) = surface(&scene);
    let view = View::new(&scene, &shot(bounds, side, above));
    trace(&RayScene::new(&scene, &surface), &view, terms, SampleCounts::FULL)
}

fn linear(picture: &ReferenceImage, at: usize) -> Vector3<f64> {
    Vector3::from(picture.colors[at]).map(|level| linear_from_srgb(f64::from(level) / 255.0))
}

#[test]
fn pixels_are_as_bright_as_their_covered_area() {
    let mut parts = bare();
    let white = Material { ambient: [1.0; 3], diffuse: [0.0; 3], ..Material::default() };
    // 10.35 by 7.8 pixels; the left edge bisects a column of pixels.
    add_rigid_domain(&mut parts, "square", facing([-0.55, -0.38, 0.485, 0.4], 0.0), white).expect("added");
    parts.look.skylight = [1.0; 3];
    let picture = pictures(parts, false, &[SunTerm::Unshadowed], 32).remove(0);
    let area: f64 = (0..32 * 32).map(|at| linear(&picture, at).x).sum();
    assert!((area - 10.35 * 7.8).abs() < 0.25, "{area}");
    let half = linear(&picture, 16 * 32 + 10).x;
    assert!((half - 0.5).abs() < 1e-6, "{half}");
    assert_eq!((linear(&picture, 16 * 32 + 9).x, linear(&picture, 16 * 32 + 12).x.round()), (0.0, 1.0));
}

#[test]
fn shades_one_pixel_by_equation_3_12() {
    let mut parts = bare();
    let material = Material {
        ambient: [0.2, 0.4, 0.6],
        diffuse: [0.5, 0.25, 0.1],
        specular: [0.3, 0.2, 0.1],
        shininess: 3.0,
        ..Material::default()
    };
    add_rigid_domain(&mut parts, "square", facing([-3.0, -3.0, 3.0, 3.0], 0.0), material).expect("added");
    parts.look.sun = [3.0, 0.0, 4.0];
    let picture = pictures(parts, false, &[SunTerm::Unshadowed], 41).remove(0);
    // The center of the middle pixel is the origin, so the eye is straight ahead and v_e' is n.
    let cosine: f64 = 0.8;
    let wanted = [(0.2, 0.5, 0.3), (0.4, 0.25, 0.2), (0.6, 0.1, 0.1)]
        .map(|(ambient, diffuse, gleam)| 0.25 * ambient + 0.5 * (cosine * diffuse + cosine.powi(3) * gleam));
    let found = linear(&picture, 20 * 41 + 20);
    for (found, wanted) in found.iter().zip(wanted) {
        assert!((found - wanted).abs() < 2e-4, "{found} is not {wanted}");
    }
}

#[test]
fn back_face_is_visible_only_if_double_sided() {
    let shown = |double_sided: bool| {
        let mut parts = bare();
        let turned = quad([[1.0, -1.0, 0.0], [-1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [1.0, 1.0, 0.0]], [0.0, 0.0, -1.0]);
        let material = Material { double_sided, ..Material::default() };
        add_rigid_domain(&mut parts, "square", turned.expect("a square"), material).expect("added");
        linear(&pictures(parts, false, &[SunTerm::Unshadowed], 9).remove(0), 40).x
    };
    assert!((shown(true) - 0.75).abs() < 1e-6 && shown(false) == 0.0);
}

#[test]
fn sorts_transparent_layers_in_any_order() {
    let shown = |depths: [f32; 2]| {
        let mut parts = bare();
        parts.look.skylight = [1.0; 3];
        for (ambient, z) in [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]].into_iter().zip(depths) {
            let (diffuse, alpha_mode) = ([0.0; 3], AlphaMode::Blend);
            let glass = Material { ambient, diffuse, alpha: 0.5, alpha_mode, ..Material::default() };
            add_rigid_domain(&mut parts, "pane", facing([-1.0, -1.0, 1.0, 1.0], z), glass).expect("added");
        }
        let behind = Material { ambient: [0.0, 0.0, 1.0], diffuse: [0.0; 3], ..Material::default() };
        add_rigid_domain(&mut parts, "behind", facing([-2.0, -2.0, 2.0, 2.0], -0.5), behind).expect("added");
        linear(&pictures(parts, false, &[SunTerm::Unshadowed], 9).remove(0), 40)
    };
    let red_first = shown([0.5, 0.0]);
    assert!((red_first - Vector3::new(0.5, 0.25, 0.25)).norm() < 1e-6, "{red_first}");
    let green_first = shown([0.0, 0.5]);
    assert!((green_first - Vector3::new(0.25, 0.5, 0.25)).norm() < 1e-6, "{green_first}");
}

/// A ground seen from above with the edge of a shadow at `x = 0.3`. The caster is outside of the image; a peg keeps the
/// ground at height 0.
fn edge(caster: Material) -> SceneParts {
    let mut parts = bare();
    parts.look.ground = Some(Ground { color: [1.0; 3] });
    parts.look.sun = [3.0, 4.0, 0.0];
    // The sun comes from +x: a point at height 4 casts its shadow 3 units to the left.
    let rest = [[3.3, 4.0, 9.0], [9.0, 4.0, 9.0], [9.0, 4.0, -9.0], [3.3, 4.0, -9.0]];
    let uvs = vec![[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]];
    let mesh = Mesh::from_indexed(rest.to_vec(), vec![[0.0, 1.0, 0.0]; 4], uvs, vec![[0, 1, 2], [0, 2, 3]]);
    add_rigid_domain(&mut parts, "caster", mesh.expect("a square"), caster).expect("added");
    add_rigid_domain(&mut parts, "peg", lying(0.01, 0.0).expect("a square"), Material::default()).expect("added");
    parts
}

#[test]
fn hard_and_gaussian_shadow_edges_match_the_analytic_ones() {
    // Deviations of 0.4 in the plane perpendicular to the light: 0.4 / 0.8 on the ground along x.
    let across = [Vector3::new(4.0, -3.0, 0.0) / 5.0 * 0.4, Vector3::z() * 0.4];
    let terms = [SunTerm::Hard, SunTerm::Filtered(across), SunTerm::Unshadowed];
    let [hard, soft, all]: [ReferenceImage; 3] =
        pictures(edge(Material::default()), true, &terms, 40).try_into().expect("three");
    let light = |picture: &ReferenceImage, column: usize| f64::from(picture.light[20 * 40 + column].expect("lit"));
    assert!((0..40).all(|column| light(&all, column) == 1.0));
    // The edge is at 20 + 10 x 0.3 = 23 pixels from the left.
    assert_eq!((light(&hard, 22), light(&hard, 23)), (1.0, 0.0));
    let deviation = 10.0 * 0.4 / 0.8;
    for column in 4..40 {
        let away = (column as f64 + 0.5 - 23.0) / deviation;
        let wanted = 0.5 * (1.0 - erf(away / 2f64.sqrt()));
        let found: f64 = (12..28).map(|row| f64::from(soft.light[row * 40 + column].expect("lit"))).sum::<f64>() / 16.0;
        assert!((found - wanted).abs() < 0.015, "column {column}: {found} is not {wanted}");
        let one = light(&soft, column);
        assert!((one - wanted).abs() < 0.08, "one pixel, column {column}: {one} is not {wanted}");
    }
}

/// Abramowitz and Stegun 7.1.26, to 1.5e-7.
fn erf(x: f64) -> f64 {
    let t = 1.0 / (1.0 + 0.327_591_1 * x.abs());
    let sum =
        t * (0.254_829_592 + t * (-0.284_496_736 + t * (1.421_413_741 + t * (-1.453_152_027 + t * 1.061_405_429))));
    (1.0 - sum * (-x * x).exp()).copysign(x)
}

#[test]
fn cut_outs_and_glass_cast_from_their_alpha_threshold_on() {
    let dark = |alpha_mode: AlphaMode, alpha: f32, texel: u8| {
        let mut parts = edge(Material { alpha_mode, alpha, color_texture: Some(0), ..Material::default() });
        parts.textures.push(Texture::new("leaf", 1, 1, vec![255, 255, 255, texel]).expect("fits"));
        let picture = pictures(parts, true, &[SunTerm::Hard], 40).remove(0);
        picture.light[20 * 40 + 38].expect("enough light falls there") == 0.0
    };
    let mask = AlphaMode::Mask { cutoff: 0.5 };
    assert!(dark(mask, 1.0, 255) && !dark(mask, 1.0, 100) && dark(AlphaMode::Opaque, 0.0, 0));
    assert!(dark(AlphaMode::Blend, 0.6, 255) && !dark(AlphaMode::Blend, 0.4, 255));
}

#[test]
fn ray_queries_match_a_linear_search_at_any_position() {
    let stage = RenderWorkload::Triangles(800).stage().expect("built");
    let (mut surface, _) = surface(&stage.scene);
    for shift in [0.0_f32, 2048.0] {
        surface.positions.iter_mut().for_each(|number| *number += shift);
        let ray_scene = RayScene::new(&stage.scene, &surface);
        for seed in 0..400_u64 {
            let mut rng = fastrand::Rng::with_seed(seed);
            let mut any = || Vector3::from_fn(|_, _| 2.0 * rng.f64() - 1.0);
            let (from, to) = (ray_scene.center + 40.0 * any(), ray_scene.center + ray_scene.radius * any());
            let ray = Ray { from, along: to - from };
            let all = ray_scene.every(&ray, (0.0, f64::INFINITY), |_| true);
            let nearest = ray_scene.nearest(&ray, (0.0, f64::INFINITY), |_| true);
            let searched = (0..ray_scene.triangles.len())
                .filter_map(|at| ray_scene.meet(at, &ray))
                .min_by(|a, b| a.t.total_cmp(&b.t));
            assert_eq!(nearest.map(|hit| hit.t), searched.map(|hit| hit.t), "{seed}");
            assert_eq!(nearest.map(|hit| hit.t), all.last().map(|hit| hit.t), "{seed}");
            assert_eq!(ray_scene.is_dark(&ray, 0.0, None), searched.is_some(), "{seed}");
        }
    }
}

#[test]
fn drawn_scene_matches_reference_unless_sun_moves() {
    let stage = RenderWorkload::Square.stage().expect("built");
    let size = Size { width: 160, height: 90 };
    let variant = variants::all(true).remove(1);
    let mut studio = RenderHarness::open().expect("EGL and OpenGL 4.3 (libegl1, libegl-mesa0, libgl1-mesa-dri)");
    let mut errors = |sun: [f32; 3]| {
        let look = modalcast_model::scene::RenderSettings { sun, ..variant.look(stage.scene.look) };
        let drawn = light_meter::relit(&stage.scene, look).expect("fits");
        let mut set = studio.set(&drawn).expect("loads");
        studio.pose(&mut set, &SceneState::rest(&drawn)).expect("deforms");
        let camera = Camera::fit_to_scene(&drawn, size.width, size.height);
        let image = studio.draw(&set, camera, size).expect("draws");
        let view = View::new(&stage.scene, &set.shot(camera, size));
        let ray_scene = RayScene::new(&stage.scene, set.surface().expect("there"));
        let reference = trace(&ray_scene, &view, &[SunTerm::Hard], SampleCounts::QUICK).remove(0);
        studio.unload(set);
        metrics::colors(&image.rgba, &reference.colors)
    };
    let [x, y, z] = stage.scene.look.sun;
    let right = errors([x, y, z]);
    assert!(right.mean < 1.0 && right.p99 < 20.0, "{right:?}");
    let wrong = errors([x + 0.3, y, z]);
    assert!(wrong.mean > 1.5 * right.mean && wrong.p99 > 40.0, "control: {wrong:?} beside {right:?}");
}

#[test]
fn report_measures_wanted_variants_and_files_read_back() {
    let request = RenderReportOptions {
        plants: vec![],
        loads: vec![RenderWorkload::Square],
        variants: vec!["none".into(), "variance 512, blur 4".into()],
        size: Size { width: 96, height: 54 },
        quick: true,
        replays: 20,
    };
    let report = render(&request, |_| {}).expect("a report");
    assert!(report.passed(), "{:?}", report.failed);
    let [none, soft] = &report.rows[..] else { panic!("two rows: {:?}", report.rows) };
    assert!(none.color.mean > 2.0 * soft.color.mean, "a picture without shadows is far from one with them");
    assert!(
        none.color_of_reference.mean < 1.5 && none.light_of_aim.all.largest == 0.0,
        "but near to what it means to show"
    );
    assert!(soft.shadow_bytes == 20 * 512 * 512 && soft.bytes > none.bytes && none.shadow_bytes == 0);
    for row in &report.rows {
        assert!(row.median_us().expect("timed") > 0.0 && row.flicker.expect("looked at").count == 59 * 24 * 13);
    }
    let folder = tempfile::tempdir().expect("a folder");
    report.write(folder.path()).expect("written");
    let read = |name: &str| std::fs::read(folder.path().join(name)).expect(name);
    let json: serde_json::Value = serde_json::from_slice(&read("report.json")).expect("JSON");
    assert_eq!(json["rows"][1]["shadow"]["size"], 512);
    assert_eq!(json["rows"][1]["passes"][0]["name"], "frame");
    let mut table = csv::Reader::from_reader(std::io::Cursor::new(read("report.csv")));
    let frames = table.headers().expect("a header").iter().position(|name| name == "frame_us").expect("a column");
    assert!(table.records().all(|row| row.expect("a record")[frames].parse::<f64>().is_ok()));
    assert!(String::from_utf8(read("report.md")).expect("UTF-8").contains("variance 512, blur 4"));
    assert!(read("report.svg").starts_with(b"<svg") && image::load_from_memory(&read("report.png")).is_ok());
    for name in ["square-hard.png", "square-hard-light.png", "square-none.png", "square-variance-512-blur-4.png"] {
        let picture = image::load_from_memory(&read(&format!("pictures/{name}"))).expect("a PNG");
        assert_eq!(picture.height(), 54, "{name}");
    }
}

#[test]
fn bare_passes_are_compared_with_a_frame_without_culling() {
    let request = RenderReportOptions {
        plants: vec![],
        loads: vec![RenderWorkload::Triangles(800)],
        variants: vec!["culling triangles".into()],
        size: Size { width: 48, height: 27 },
        quick: true,
        replays: 20,
    };
    let report = render(&request, |_| {}).expect("a report");
    let ([row], [bare]) = (&report.rows[..], &report.bare[..]) else { panic!("one each: {report:?}") };
    assert!(row.culled.is_some() && bare.map == 2048, "control: the row culls");
    assert_eq!(bare.unculled.name, "variance 2048, blur 1.5: without culling");
    assert_eq!(bare.usual.name, "variance 2048, blur 1.5: as the load culls");
    let both = bare.depth.median_us + bare.visibility.median_us;
    for frame in [&bare.unculled, &bare.usual] {
        assert!((frame.frame_us - both - frame.beyond_us).abs() < 1e-6 && Some(frame.frame_us) != row.median_us());
    }
    let request = RenderReportOptions { variants: vec!["culling none".into(), "culling triangles".into()], ..request };
    let report = render(&request, |_| {}).expect("a report");
    assert_eq!(report.bare[0].unculled.name, "culling none: without culling", "its own row is taken");
    assert_eq!(Some(report.bare[0].unculled.frame_us), report.rows[0].median_us());
}

#[test]
fn exact_transparency_is_closer_to_reference_than_two_pass() {
    let request = RenderReportOptions {
        plants: vec![],
        loads: vec![RenderWorkload::Panes, RenderWorkload::Square],
        variants: vec!["exact transparency".into(), "two-pass transparency".into()],
        size: Size { width: 96, height: 54 },
        quick: true,
        replays: 20,
    };
    let report = render(&request, |_| {}).expect("a report");
    let [exact, passes] = &report.rows[..] else { panic!("two rows, of the panes: {:?}", report.rows) };
    let [near, far] = [exact, passes].map(|row| row.color_of_reference.mean);
    assert!(near < 1.0 && far > 3.0 * near, "{near} and {far} levels");
    assert!(report.passed(), "{:?}", report.failed);
}

#[test]
fn refitted_bvh_gives_the_same_pictures_as_a_rebuilt_one() {
    let stage = RenderWorkload::Triangles(2_000).stage().expect("built");
    let at = |step: usize| {
        let mut deformer = ReferenceDeformer::new(&stage.scene);
        let bounds = deformer.deform(&stage.state(step)).expect("deforms").bounds;
        (deformer.surface().expect("there").clone(), bounds)
    };
    let ((first, _), (later, bounds)) = (at(0), at(30));
    let size = Size { width: 48, height: 32 };
    let view = View::new(
        &stage.scene,
        &FrameParams { camera: stage.camera(size), width: 48, height: 32, bounds, light: None },
    );
    let traced = |ray_scene: &RayScene| trace(ray_scene, &view, &[SunTerm::Hard], SampleCounts::QUICK);
    let anew = traced(&RayScene::new(&stage.scene, &later));
    assert_eq!(traced(&RayScene::new(&stage.scene, &first).moved(&stage.scene, &later)), anew);
    assert_ne!(traced(&RayScene::new(&stage.scene, &first)), anew, "control: the step before");
}
