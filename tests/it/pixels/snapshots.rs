//! Frames of every part of the look equal recorded images, which llvmpipe rendered and a person has checked. The test
//! writes a missing image and fails. Other renderers may differ at edges, where a sample falls on either side.

use std::path::Path;
use std::sync::Arc;

use modalcast_model::domain::Material;
use modalcast_model::load;
use modalcast_model::scene::{
    Antialiasing, Bloom, Camera, Lens, RenderSettings, Scene, SceneParts, ShadowMethod, ShadowSettings, ToneMapping,
    Transparency, View,
};

use super::harness::{RenderedFrame, render_sized};
use super::harness::{SceneBuilder, colored_material, facing_rectangle, floor_mesh, glass_material, open_renderer};

/// Width and height of the images in pixels.
const SIZE: [u32; 2] = [104, 78];

/// A pixel is wrong if a channel is further than this, in levels of 255, outside of the range of the recorded image
/// within one pixel. Edges move by less than a pixel between renderers.
const TOLERANCE: u8 = 8;

/// A frame to compare. Measured: an NVIDIA H100 (driver 580.159.04) differs from llvmpipe by at most 5.8 levels and 76
/// of 8112 pixels in frames of the tree, whose leaves are hardly larger than a pixel, and by at most 0.08 levels and no
/// pixel in the others.
struct Snapshot {
    name: &'static str,
    scene: Arc<Scene>,
    /// The negative control: the scene without the feature.
    control: Arc<Scene>,
    /// As `control`, for renderers with the limits of this snapshot. Differs more than another renderer.
    coarse_control: Arc<Scene>,
    camera: Camera,
    /// Limit on the mean difference in levels of 255. With llvmpipe, [`LLVMPIPE_LIMITS`] replaces these limits.
    max_mean: f64,
    /// Limit on the number of wrong pixels.
    max_wrong: usize,
}

/// Limits on the mean and the number of wrong pixels for llvmpipe, whose versions differ by rounding.
const LLVMPIPE_LIMITS: (f64, usize) = (0.02, 2);

#[derive(Debug)]
struct Difference {
    /// Mean over the pixels of the largest difference of a channel, in levels of 255.
    mean: f64,
    wrong: usize,
}

impl Difference {
    fn between(image: &[u8], recorded: &[u8]) -> Self {
        assert_eq!(image.len(), recorded.len(), "expected images of equal size");
        let [width, height] = SIZE.map(|side| side as usize);
        let pixel = |rgba: &[u8], x: usize, y: usize| -> [u8; 3] {
            std::array::from_fn(|channel| rgba[4 * (y * width + x) + channel])
        };
        let (mut sum, mut wrong) = (0.0, 0);
        for (y, x) in (0..height).flat_map(|y| (0..width).map(move |x| (y, x))) {
            let (got, want) = (pixel(image, x, y), pixel(recorded, x, y));
            sum += got.iter().zip(want).map(|(got, want)| f64::from(got.abs_diff(want))).fold(0.0, f64::max);
            let rows = y.saturating_sub(1)..height.min(y + 2);
            let columns = x.saturating_sub(1)..width.min(x + 2);
            let near: Vec<_> = rows.flat_map(|y| columns.clone().map(move |x| (x, y))).collect();
            wrong += usize::from((0..3).any(|channel| {
                let levels = near.iter().map(|(x, y)| pixel(recorded, *x, *y)[channel]);
                let (min, max) = levels.fold((u8::MAX, 0), |(min, max), level| (min.min(level), max.max(level)));
                !(min.saturating_sub(TOLERANCE)..=max.saturating_add(TOLERANCE)).contains(&got[channel])
            }));
        }
        Self { mean: sum / (width * height) as f64, wrong }
    }
}

fn with_look(scene: &Scene, change: impl FnOnce(&mut RenderSettings)) -> Arc<Scene> {
    let mut look = RenderSettings { preset: None, ..scene.look };
    change(&mut look);
    Scene::new(SceneParts { look, ..scene.parts() }).expect("expected a valid scene")
}

/// The tree close to its trunk, with the clip planes fitted to the scene.
fn trunk_camera(eye_height: f64) -> Camera {
    let view = View::LookAt { eye: [1.5, eye_height, 2.5], target: [0.0, 1.8, 0.0], up: [0.0, 1.0, 0.0] };
    Camera { view, lens: Lens::FieldOfView(45.0), near: 0.0, far: 0.0 }
}

/// Two panes before a wall, above a floor.
fn panes(material: &Material) -> Arc<Scene> {
    let mut builder = SceneBuilder::new();
    let defaults = RenderSettings::default();
    (builder.parts.look.ground, builder.parts.look.horizon) = (defaults.ground, defaults.horizon);
    builder.parts.look.sun = [1.0, 3.0, 2.0];
    builder
        .add_domain(facing_rectangle(-0.8, 0.0, 0.4, 1.1, -0.4), colored_material([0.8, 0.3, 0.2]))
        .add_domain(floor_mesh(0.45, 0.7), colored_material([0.9, 0.8, 0.3]))
        .add_domain(facing_rectangle(-0.5, 0.1, 0.6, 0.9, 0.3), material.clone())
        .add_domain(facing_rectangle(-0.2, 0.3, 0.9, 1.2, 0.5), material.clone())
        .build()
}

fn panes_camera() -> Camera {
    let view = View::LookAt { eye: [1.4, 1.9, 4.0], target: [0.0, 0.4, 0.0], up: [0.0, 1.0, 0.0] };
    Camera { view, lens: Lens::FieldOfView(28.0), near: 0.0, far: 0.0 }
}

/// Each part of the look.
fn snapshots() -> Vec<Snapshot> {
    let tree = load::open("tree").expect("expected the built-in scene").scene;
    let with_shadow = |shadow: Option<ShadowSettings>| {
        move |look: &mut RenderSettings| {
            (look.antialias, look.samples, look.shadow) = (Antialiasing::Msaa, 4, shadow);
        }
    };
    let map = ShadowSettings::default();
    let base = with_look(&tree, with_shadow(Some(map)));
    let unshadowed = with_look(&tree, with_shadow(None));
    let shadowed = |shadow| with_look(&base, with_shadow(Some(shadow)));
    let of_tree = |name, scene: Arc<Scene>, control: &Arc<Scene>, max_mean, max_wrong| Snapshot {
        name,
        scene,
        control: Arc::clone(control),
        coarse_control: Arc::clone(&unshadowed),
        camera: trunk_camera(1.9),
        max_mean,
        max_wrong,
    };
    let panes_of =
        |material: &Material| with_look(&panes(material), with_shadow(Some(ShadowSettings { size: 512, ..map })));
    let (panes, opaque_panes) = (panes_of(&glass_material()), panes_of(&colored_material([0.2, 0.9, 0.3])));
    let of_panes = |name: &'static str, scene: Arc<Scene>, control: Arc<Scene>, max_mean, max_wrong| Snapshot {
        name,
        scene,
        coarse_control: Arc::clone(if name == "two-pass transparency" { &opaque_panes } else { &control }),
        control,
        camera: panes_camera(),
        max_mean,
        max_wrong,
    };
    let lit = |bloom, tone| with_look(&panes, |look| (look.bloom, look.tone, look.exposure) = (bloom, tone, 2.0));
    vec![
        of_tree("tree", Arc::clone(&base), &unshadowed, 6.5, 100),
        of_tree("fxaa", with_look(&base, |look| look.antialias = Antialiasing::Fxaa), &base, 6.5, 100),
        of_tree("cascades", shadowed(ShadowSettings { cascades: 3, ..map }), &base, 6.5, 100),
        of_tree(
            "filtered shadow",
            shadowed(ShadowSettings { method: ShadowMethod::PercentageCloser, ..map }),
            &base,
            6.5,
            100,
        ),
        of_tree("standard shadow", shadowed(ShadowSettings { method: ShadowMethod::Standard, ..map }), &base, 6.5, 100),
        of_panes("panes", Arc::clone(&panes), Arc::clone(&opaque_panes), 0.2, 0),
        of_panes(
            "two-pass transparency",
            with_look(&panes, |look| look.transparency = Transparency::TwoPass),
            Arc::clone(&panes),
            0.2,
            0,
        ),
        of_panes(
            "bloom",
            lit(Some(Bloom { threshold: 0.5, ..Bloom::default() }), ToneMapping::default()),
            lit(None, ToneMapping::default()),
            0.2,
            0,
        ),
        of_panes("tone", lit(None, ToneMapping::Aces), lit(None, ToneMapping::default()), 0.2, 0),
    ]
}

#[test]
fn every_part_of_the_look_matches_its_snapshot() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/snapshots");
    let mut renderer = open_renderer();
    let mut missing = Vec::new();
    for Snapshot { name, scene, control, coarse_control, camera, max_mean, max_wrong } in snapshots() {
        let (control, (max_mean, max_wrong)) = match renderer.info().software {
            true => (control, LLVMPIPE_LIMITS),
            false => (coarse_control, (max_mean, max_wrong)),
        };
        let path = folder.join(name.replace(' ', "_")).with_extension("png");
        let RenderedFrame { image, .. } = render_sized(&mut renderer, &scene, camera, SIZE);
        if !path.exists() {
            image::save_buffer(&path, &image.rgba, SIZE[0], SIZE[1], image::ExtendedColorType::Rgba8)
                .expect("expected a written image");
            missing.push(name);
            continue;
        }
        let recorded = image::open(&path).expect("expected a PNG file").into_rgba8();
        let difference = Difference::between(&image.rgba, &recorded);
        let control_image = render_sized(&mut renderer, &control, camera, SIZE).image;
        let of_control = Difference::between(&control_image.rgba, &recorded);
        eprintln!("{name}: {difference:?}; control: {of_control:?}");
        assert!(difference.mean <= max_mean && difference.wrong <= max_wrong, "{name}: {difference:?}");
        assert!(
            of_control.mean > max_mean || of_control.wrong > max_wrong,
            "{name}: negative control without the feature: {of_control:?}"
        );
    }
    assert!(missing.is_empty(), "missing images, now written: {missing:?}. Look at them");
}

/// Negative control for the geometry: the eye is 0.2 m higher.
#[test]
fn frame_of_another_camera_differs_from_its_snapshot() {
    let Snapshot { scene, max_mean, max_wrong, .. } = snapshots().swap_remove(0);
    let mut renderer = open_renderer();
    let [frame, moved] = [1.9, 2.1].map(|height| render_sized(&mut renderer, &scene, trunk_camera(height), SIZE).image);
    let difference = Difference::between(&moved.rgba, &frame.rgba);
    assert!(difference.mean > 2.0 * max_mean && difference.wrong > 2 * max_wrong, "{difference:?}");
}
