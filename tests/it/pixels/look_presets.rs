//! A look may leave antialiasing and shadow map to a preset, or to the rule that chooses a preset by renderer and frame
//! size. Its frame equals the frame of a look with the chosen settings.

use std::sync::Arc;

use modalcast_model::scene::{
    Antialiasing, Camera, Lens, LookOverrides, LookPreset, PresetRequest, RenderSettings, Scene, ShadowMethod,
    ShadowSettings, View,
};
use modalcast_render::{FrameLook, Renderer};

use super::harness::{
    RenderedFrame, SceneBuilder, colored_material, facing_rectangle, floor_mesh, open_renderer, render_sized,
};

/// Sizes of frames. If the renderer is a software renderer, the rule draws large frames with one sample per pixel and
/// small ones with four.
const LARGE: [u32; 2] = [400, 240];
const SMALL: [u32; 2] = [96, 64];

/// A narrow wall that casts a shadow on a floor.
fn scene(look: impl FnOnce(RenderSettings) -> RenderSettings) -> Arc<Scene> {
    let mut builder = SceneBuilder::new();
    let settings = RenderSettings { sun: [2.0, 3.0, 1.0], ..builder.parts.look };
    builder.parts.look = look(RenderSettings { shadow: Some(ShadowSettings::default()), ..settings });
    builder
        .add_domain(floor_mesh(3.0, 0.0), colored_material([0.8; 3]))
        .add_domain(facing_rectangle(-0.43, 0.31, 0.27, 2.2, 0.1), colored_material([0.9, 0.5, 0.2]))
        .build()
}

fn draw(renderer: &mut Renderer, scene: &Arc<Scene>, size: [u32; 2]) -> (RenderedFrame, FrameLook) {
    let view = View::LookAt { eye: [1.0, 3.0, 6.0], target: [0.0, 0.8, 0.0], up: [0.1, 1.0, 0.0] };
    let camera = Camera { view, lens: Lens::FieldOfView(45.0), near: 0.0, far: 0.0 };
    let frame = render_sized(renderer, scene, camera, size);
    let look = frame.image.info.look.expect("expected the look of a color frame");
    assert_eq!(look.samples, frame.stats.samples);
    (frame, look)
}

/// Draws the scene with the settings that a frame names, and without a preset.
fn draw_with(renderer: &mut Renderer, look: FrameLook, size: [u32; 2]) -> RenderedFrame {
    let FrameLook { antialias, samples, shadow, .. } = look;
    draw(renderer, &scene(|settings| RenderSettings { antialias, samples, shadow, ..settings }), size).0
}

#[test]
fn rule_draws_the_settings_that_the_frame_names() {
    let mut renderer = open_renderer();
    let is_software = renderer.info().software;
    let automatic = scene(|settings| settings.with_preset(PresetRequest::default()));
    for (size, is_small) in [(LARGE, false), (SMALL, true), (LARGE, false)] {
        let (frame, look) = draw(&mut renderer, &automatic, size);
        let expected = draw_with(&mut renderer, look, size);
        assert!(frame.image.rgba == expected.image.rgba, "{size:?}: expected the image with {look}");
        let multisampled = !is_software || is_small;
        assert_eq!((look.preset, look.samples), (None, if multisampled { 4 } else { 1 }), "{size:?}");
        assert_eq!(look.shadow.expect("a shadow").size, if is_software { 512 } else { 1024 });
        let other = FrameLook { samples: if multisampled { 1 } else { 4 }, antialias: Antialiasing::Msaa, ..look };
        let other = draw_with(&mut renderer, other, size);
        assert!(frame.image.rgba != other.image.rgba, "control: expected another image with other samples");
    }
}

/// A preset gives the same settings on every renderer, and overrides replace single settings of it.
#[test]
fn preset_and_overrides_decide_on_every_renderer() {
    let mut renderer = open_renderer();
    for (preset, samples, method, size) in [
        (LookPreset::Preview, 1, ShadowMethod::Variance, 512),
        (LookPreset::Standard, 4, ShadowMethod::PercentageCloser, 1024),
        (LookPreset::Best, 4, ShadowMethod::PercentageCloser, 2048),
    ] {
        let request = PresetRequest { preset: Some(preset), ..PresetRequest::default() };
        let with_preset = scene(|settings| settings.with_preset(request));
        let (frame, look) = draw(&mut renderer, &with_preset, LARGE);
        let shadow = look.shadow.expect("a shadow");
        assert_eq!((look.preset, look.samples, shadow.method, shadow.size), (Some(preset), samples, method, size));
        assert!(frame.image.rgba == draw_with(&mut renderer, look, LARGE).image.rgba, "{look}");
        let overrides =
            LookOverrides { antialias: Some(Antialiasing::Fxaa), shadow_size: Some(64), ..LookOverrides::default() };
        let overridden = scene(|settings| settings.with_preset(PresetRequest { overrides, ..request }));
        let (frame, look) = draw(&mut renderer, &overridden, LARGE);
        let shadow = look.shadow.expect("a shadow");
        assert_eq!((look.antialias, look.samples, shadow.method, shadow.size), (Antialiasing::Fxaa, 1, method, 64));
        assert!(frame.image.rgba == draw_with(&mut renderer, look, LARGE).image.rgba, "{look}");
    }
}
