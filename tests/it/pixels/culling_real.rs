//! The almond tree has the same image with and without culling. Prints the times of its passes.

use std::path::PathBuf;
use std::sync::Arc;

use modalcast_compute::reference::ReferenceDeformer;
use modalcast_model::deform::Deformer as _;
use modalcast_model::scene::{
    Camera, Culling, RenderSettings, Scene, SceneParts, SceneState, ShadowSettings, Transparency,
};
use modalcast_render::{FrameCullStats, FrameParams, FrameTimes, Renderer};

use super::harness::open_renderer;

const SIZE: [u32; 2] = [1920, 1080];
const FRAMES: usize = 9;

/// The same scene with another look.
fn with_look(scene: &Scene, look: RenderSettings) -> Arc<Scene> {
    Scene::new(SceneParts { look, ..scene.parts() }).expect("expected a valid scene")
}

/// The image, the median times of some passes in milliseconds, and the culling statistics.
fn draw_frames(
    renderer: &mut Renderer,
    scene: &Arc<Scene>,
) -> (Vec<u8>, Vec<(&'static str, f64)>, Option<FrameCullStats>) {
    let mut deformer = ReferenceDeformer::new(scene);
    let bounds = deformer.deform(&SceneState::rest(scene)).expect("expected the step to succeed").bounds;
    let buffers = renderer.load(scene).expect("expected the scene to load");
    renderer.upload(&buffers, deformer.surface().expect("expected a surface")).expect("expected the upload to succeed");
    let camera = Camera::fit_to_scene(scene, SIZE[0], SIZE[1]);
    let params = FrameParams { camera, width: SIZE[0], height: SIZE[1], bounds, light: None };
    let images: Vec<_> = (0..FRAMES).map(|_| renderer.draw(&buffers, &params).expect("expected a frame")).collect();
    assert!(images.iter().all(|image| image.rgba == images[0].rgba), "expected identical frames");
    let median = |name: &'static str| {
        let pass_time = |times: &FrameTimes| times.iter().find(|(key, _)| key.name() == name).map_or(0.0, |(_, ms)| ms);
        let mut times: Vec<f64> = images[1..].iter().map(|image| pass_time(&image.times)).collect();
        times.sort_by(f64::total_cmp);
        (name, times[times.len() / 2])
    };
    let passes = ["shadow", "blur", "cull", "visibility", "blended", "draw"].map(median).to_vec();
    let culled = renderer.stats().culled;
    renderer.unload(buffers);
    (images[0].rgba.clone(), passes, culled)
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
fn real_almond_with_culling_is_the_same_picture() {
    let root = std::env::var_os("MODALCAST_DATA").map_or_else(|| PathBuf::from("../shared/data"), PathBuf::from);
    let scene = modalcast_model::load::open(&root.join("plants/almond").to_string_lossy()).expect("the almond").scene;
    let mut renderer = open_renderer();
    for transparency in [Transparency::OrderIndependent, Transparency::TwoPass] {
        let look = RenderSettings {
            transparency,
            shadow: Some(ShadowSettings { size: 2048, ..ShadowSettings::default() }),
            ..scene.look
        };
        let mut unculled_image = None;
        for culling in [Culling::None, Culling::Triangles, Culling::Occlusion] {
            let (rgba, passes, culled) =
                draw_frames(&mut renderer, &with_look(&scene, RenderSettings { culling, ..look }));
            println!("{transparency:?}, {culling:?}: {passes:.3?} {culled:?}");
            assert!(
                unculled_image.get_or_insert_with(|| rgba.clone()) == &rgba,
                "{culling:?}: expected the image without culling"
            );
            assert_eq!(culled.is_some_and(|culled| culled.camera.culled() > 0), culling != Culling::None);
        }
    }
}
