//! A rendered frame equals the recorded image `tests/snapshots/tree.png` up to a tolerance. A person has checked the
//! image. The command that rendered it, on llvmpipe, is
//! `modalcast render tree --size 104x78 --eye 1.5,1.9,2.5 --target 0,1.8,0 --field-of-view 45`.

use modalcast_model::load;
use modalcast_model::scene::{Antialiasing, Camera, Lens, RenderSettings, Scene, SceneParts, ShadowSettings, View};
use modalcast_render::FrameImage;

use super::harness::{open_renderer, render_sized};

/// Tolerance of the mean difference, in levels of 255. Drivers differ at edges, and most pixels of the leaves in this
/// small image lie on edges. Measured: an NVIDIA H200 (driver 580.159.04) differs from llvmpipe by 5.6 levels on
/// average, and by 97 levels at the 99th percentile.
const MAX_MEAN: f64 = 7.0;
/// Tolerance of the 99th percentile of the difference, in levels of 255.
const MAX_PERCENTILE_99: u8 = 128;

/// Statistics of the per-pixel difference of two images, in levels of 255. The difference of a pixel is the largest
/// difference of its channels.
struct DifferenceStats {
    mean: f64,
    percentile_99: u8,
    max: u8,
}

fn compare_images(image: &[u8], snapshot: &[u8]) -> DifferenceStats {
    assert_eq!(image.len(), snapshot.len(), "expected images of equal size");
    let max_difference = |(a, b): (&[u8], &[u8])| a.iter().zip(b).map(|(a, b)| a.abs_diff(*b)).max().unwrap_or(0);
    let mut levels: Vec<u8> = image.chunks_exact(4).zip(snapshot.chunks_exact(4)).map(max_difference).collect();
    levels.sort_unstable();
    let mean = levels.iter().copied().map(f64::from).sum::<f64>() / levels.len() as f64;
    DifferenceStats { mean, percentile_99: levels[levels.len() * 99 / 100], max: levels[levels.len() - 1] }
}

/// Renders the tree close to its trunk: normal map of the bark, cut-out leaves, variance shadow map, four samples per
/// pixel, ground and sky. The clip planes are fitted to the scene.
fn render_tree(eye: [f64; 3]) -> FrameImage {
    let tree = load::open("tree").expect("expected the built-in scene").scene;
    let shadow = Some(ShadowSettings::default());
    let look = RenderSettings { preset: None, antialias: Antialiasing::Msaa, samples: 4, shadow, ..tree.look };
    let scene = Scene::new(SceneParts { look, ..tree.parts() }).expect("expected a valid scene");
    let view = View::LookAt { eye, target: [0.0, 1.8, 0.0], up: [0.0, 1.0, 0.0] };
    let camera = Camera { view, lens: Lens::FieldOfView(45.0), near: 0.0, far: 0.0 };
    render_sized(&mut open_renderer(), &scene, camera, [104, 78]).image
}

#[test]
fn tree_matches_its_snapshot() {
    let snapshot =
        image::load_from_memory(include_bytes!("../../snapshots/tree.png")).expect("expected a PNG file").into_rgba8();
    let DifferenceStats { mean, percentile_99, max } = compare_images(&render_tree([1.5, 1.9, 2.5]).rgba, &snapshot);
    assert!(
        mean < MAX_MEAN && percentile_99 < MAX_PERCENTILE_99,
        "mean {mean}, 99th percentile {percentile_99}, maximum {max} levels"
    );
    let DifferenceStats { mean, percentile_99, .. } = compare_images(&render_tree([1.5, 2.1, 2.5]).rgba, &snapshot);
    assert!(
        mean > 2.0 * MAX_MEAN && percentile_99 > MAX_PERCENTILE_99,
        "negative control: eye moved by 0.2 m, mean {mean}, 99th percentile {percentile_99}"
    );
}
