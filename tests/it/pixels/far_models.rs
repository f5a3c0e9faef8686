//! Models whose file has coordinates of a map look like the same models at the origin, and vertices that no face uses
//! change no picture. A camera that no client has set shows bodies that have all left the view of the rest state.

use std::sync::Arc;

use modalcast::config::{BackendChoice, Config};
use modalcast::engine::DeviceContext;
use modalcast_model::backend_settings::BackendSettings;
use modalcast_model::load;
use modalcast_model::scene::{Camera, CameraSource, FrameSize, Scene, SceneState};
use modalcast_render::FrameImage;

const SIZE: FrameSize = FrameSize::new(160, 120);

fn open_context() -> DeviceContext {
    DeviceContext::open(&Config { backend: BackendChoice::Cpu, ..Config::default() }).expect("expected a renderer")
}

/// A cube of `side` in the text of an OBJ file, with `first` lines before its vertices.
fn cube(center: [f64; 3], side: f64, first: &[&str]) -> String {
    let coordinate = |corner: usize, axis: usize| center[axis] + side * ((corner >> axis & 1) as f64 - 0.5);
    let vertex = |corner: usize| {
        format!("v {:?} {:?} {:?}\n", coordinate(corner, 0), coordinate(corner, 1), coordinate(corner, 2))
    };
    let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let face = |quad: [usize; 4]| {
        let [a, b, c, d] = quad.map(|corner| corner + first.len() + 1);
        format!("f {a} {b} {c} {d}\n")
    };
    let lines = first.iter().map(|line| format!("{line}\n")).chain((0..8).map(vertex)).chain(quads.map(face));
    lines.collect()
}

fn load_obj(text: &str) -> Arc<Scene> {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let path = folder.path().join("cube.obj");
    std::fs::write(&path, text).expect("expected a written file");
    load::open(&path.to_string_lossy()).expect("expected a valid file").scene
}

fn draw(context: &mut DeviceContext, scene: &Arc<Scene>, state: &SceneState, camera: &Camera) -> FrameImage {
    let mut loaded_scene = context.load_scene(scene, BackendSettings::default()).expect("expected the scene to load");
    loaded_scene.deform(state).expect("expected a valid state");
    let image = context.draw(&mut loaded_scene, camera, SIZE).expect("expected a frame");
    context.unload_scene(loaded_scene);
    image
}

/// The rest state in the default view.
fn draw_rest(context: &mut DeviceContext, scene: &Arc<Scene>) -> FrameImage {
    let camera = Camera::fit_to_scene(scene, SIZE.width, SIZE.height);
    draw(context, scene, &SceneState::rest(scene), &camera)
}

/// Number of pixels that differ by more than `levels` of 255.
fn different_pixels(left: &FrameImage, right: &FrameImage, levels: u8) -> usize {
    let pairs = left.rgba.chunks_exact(4).zip(right.rgba.chunks_exact(4));
    pairs.filter(|(a, b)| a.iter().zip(*b).any(|(a, b)| a.abs_diff(*b) > levels)).count()
}

#[test]
fn far_cube_looks_like_the_cube_at_the_origin() {
    let mut context = open_context();
    for side in [4.0, 0.4] {
        let origin_frame = draw_rest(&mut context, &load_obj(&cube([0.0; 3], side, &[])));
        for center in [
            [500_000.0, 4_649_776.0, 0.0],
            [500_000.3, 0.1, 4_649_776.2],
            [1e5, 0.0, 0.0],
            [0.0, 1e5, 0.0],
            [0.0, 0.0, -1e5],
            [1e3 + 0.7, -1e3, 1e3],
            [1e9, 0.0, 0.0],
        ] {
            let far_frame = draw_rest(&mut context, &load_obj(&cube(center, side, &[])));
            let count = different_pixels(&origin_frame, &far_frame, 8);
            // Samples at an edge, or at the edge of the shadow, whose texels are aligned to the world.
            assert!(count <= 120, "side {side}, center {center:?}: {count} pixels differ");
        }
        // Control: coordinates that f32 has rounded give another cube.
        let rounded = |coordinate: f64| f64::from(coordinate as f32);
        let text = cube([500_000.3, 4_649_776.2, 0.1], side, &[]);
        let lines = text.lines().map(|line| match line.strip_prefix("v ") {
            Some(numbers) => {
                let numbers = numbers.split(' ').map(|number| rounded(number.parse().expect("a number")).to_string());
                format!("v {}\n", numbers.collect::<Vec<_>>().join(" "))
            }
            None => format!("{line}\n"),
        });
        if side < 1.0 {
            let rounded_frame = draw_rest(&mut context, &load_obj(&lines.collect::<String>()));
            let count = different_pixels(&origin_frame, &rounded_frame, 8);
            assert!(count > 1000, "control: expected another picture, {count} pixels differ");
        }
    }
}

#[test]
fn unused_vertices_change_no_pixel() {
    let mut context = open_context();
    let expected = draw_rest(&mut context, &load_obj(&cube([0.0; 3], 1.0, &[])));
    let used = format!("{}f 1 2 3\n", cube([0.0; 3], 1.0, &["v 1000 0 0"]));
    let with_face = draw_rest(&mut context, &load_obj(&used));
    let count = different_pixels(&expected, &with_face, 8);
    assert!(count > 1000, "control: expected a face to change the picture, {count} pixels differ");
    for stray in ["v 1000 0 0", "v 0 -1000 0", "v 3 4 -1e6"] {
        let frame = draw_rest(&mut context, &load_obj(&cube([0.0; 3], 1.0, &[stray])));
        let count = different_pixels(&expected, &frame, 1);
        assert!(count <= 20, "{stray}: {count} pixels differ");
    }
}

#[test]
fn unset_camera_shows_bodies_that_have_left_its_view() {
    let mut context = open_context();
    let scene = load_obj(&cube([0.0; 3], 1.0, &[]));
    let source = CameraSource::framing(&scene, SIZE);
    let rest_frame = draw_rest(&mut context, &scene);
    for direction in [[1000.0, 0.0, 0.0], [0.0, 700.0, 0.0], [0.0, 0.0, -1000.0], [0.0, 0.0, 1000.0]] {
        let mut state = SceneState::rest(&scene);
        (0..3).for_each(|axis| state.transforms[0].0[4 * axis + 3] = direction[axis]);
        state.mark_all_dirty();
        let framing = source.resolve(&scene, &state, SIZE);
        assert!(framing.is_moved, "{direction:?}");
        let without_body = draw(&mut context, &scene, &state, source.at_rest());
        let with_body = draw(&mut context, &scene, &state, &framing.camera);
        let body_pixels = |frame: &FrameImage| {
            // The cube is brighter than the sky and the ground.
            let pixels = frame.rgba.chunks_exact(4).zip(without_body.rgba.chunks_exact(4));
            pixels.filter(|(a, b)| a.iter().zip(*b).any(|(a, b)| a.abs_diff(*b) > 30)).count()
        };
        assert!(body_pixels(&with_body) > body_pixels(&rest_frame) / 2, "{direction:?}: {}", body_pixels(&with_body));
    }
    let framing = source.resolve(&scene, &SceneState::rest(&scene), SIZE);
    assert!(!framing.is_moved && framing.camera == *source.at_rest());
}
