//! A scanned almond tree has the same image with and without culling. The test prints the times of the passes.

use std::path::PathBuf;
use std::sync::Arc;

use modalcast_compute::reference::ReferenceDeformer;
use modalcast_model::deform::Deformer as _;
use modalcast_model::scene::{
    Camera, Culling, RenderSettings, Scene, SceneParts, SceneState, ShadowSettings, Transparency,
};
use modalcast_render::{FrameCullStats, FrameParams, FrameTimes, Renderer};

use super::harness::open_renderer;

/// Width and height of a frame in pixels.
const SIZE: [u32; 2] = [1920, 1080];
const FRAME_COUNT: usize = 9;

/// A copy of the scene with other render settings, of which none is left to a preset.
fn replace_look(scene: &Scene, look: RenderSettings) -> Arc<Scene> {
    let look = RenderSettings { preset: None, ..look };
    Scene::new(SceneParts { look, ..scene.parts() }).expect("expected a valid scene")
}

/// The image that [`FRAME_COUNT`] frames share, and their statistics.
struct DrawnFrames {
    rgba: Vec<u8>,
    /// Names of the passes that culling affects, and their median times in milliseconds.
    pass_times: Vec<(&'static str, f64)>,
    cull_stats: Option<FrameCullStats>,
}

/// Draws [`FRAME_COUNT`] frames of the scene at rest and asserts that they are identical.
fn draw_frames(renderer: &mut Renderer, scene: &Arc<Scene>) -> DrawnFrames {
    let mut deformer = ReferenceDeformer::new(scene);
    let bounds = deformer.deform(&SceneState::rest(scene)).expect("expected the step to succeed").bounds;
    let buffers = renderer.load(scene).expect("expected the scene to load");
    renderer.upload(&buffers, deformer.surface().expect("expected a surface")).expect("expected the upload to succeed");
    let camera = Camera::fit_to_scene(scene, SIZE[0], SIZE[1]);
    let params =
        FrameParams { camera, width: SIZE[0], height: SIZE[1], bounds, light_bounds: None, edges: None, samples: None };
    let images: Vec<_> =
        (0..FRAME_COUNT).map(|_| renderer.draw(&buffers, &params).expect("expected a frame")).collect();
    assert!(images.iter().all(|image| image.rgba == images[0].rgba), "expected identical frames");
    let median_time = |name: &'static str| {
        let pass_time =
            |times: &FrameTimes| times.iter().find(|(stage, _)| stage.name() == name).map_or(0.0, |(_, ms)| ms);
        // The first frame is excluded, because occlusion culling needs a previous frame.
        let mut times: Vec<f64> = images[1..].iter().map(|image| pass_time(&image.times)).collect();
        times.sort_by(f64::total_cmp);
        (name, times[times.len() / 2])
    };
    let pass_times = ["shadow", "blur", "cull", "visibility", "blended", "draw"].map(median_time).to_vec();
    let cull_stats = renderer.stats().culled;
    renderer.unload(buffers);
    DrawnFrames { rgba: images[0].rgba.clone(), pass_times, cull_stats }
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
fn real_almond_has_the_same_image_with_culling() {
    let data_folder = std::env::var_os("MODALCAST_DATA").map_or_else(|| PathBuf::from("../shared/data"), PathBuf::from);
    let scene = modalcast_model::load::open(&data_folder.join("plants/almond").to_string_lossy())
        .expect("expected the almond tree")
        .scene;
    let mut renderer = open_renderer();
    for transparency in [Transparency::OrderIndependent, Transparency::TwoPass] {
        let look = RenderSettings {
            transparency,
            shadow: Some(ShadowSettings { size: 2048, ..ShadowSettings::default() }),
            ..scene.look
        };
        // The image of the first culling mode, `Culling::None`.
        let mut unculled_image = None;
        for culling in [Culling::None, Culling::Triangles, Culling::Occlusion] {
            let DrawnFrames { rgba, pass_times, cull_stats } =
                draw_frames(&mut renderer, &replace_look(&scene, RenderSettings { culling, ..look }));
            println!("{transparency:?}, {culling:?}: {pass_times:.3?} {cull_stats:?}");
            assert!(
                unculled_image.get_or_insert_with(|| rgba.clone()) == &rgba,
                "{culling:?}: expected the image without culling"
            );
            assert_eq!(cull_stats.is_some_and(|cull_stats| cull_stats.camera.culled() > 0), culling != Culling::None);
        }
    }
}
