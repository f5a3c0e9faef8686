//! Sun directions, cameras and scenes at their limits with every kind of shadow map, and temporal stability of shadows.

use modalcast_compute::reference::ReferenceDeformer;
use modalcast_model::deform::Deformer as _;
use modalcast_model::domain::{Material, Mesh};
use modalcast_model::scene::{
    BoundingBox, Camera, Lens, OrientedBounds, RenderSettings, Scene, SceneState, ShadowMethod, ShadowSettings, View,
};
use modalcast_render::{FrameImage, FrameParams};

use super::harness::{SceneBuilder, floor_mesh, open_renderer};

/// Every kind of shadow map. The last map is smaller than its blur kernel.
fn shadow_settings() -> [ShadowSettings; 5] {
    let base = ShadowSettings { size: 128, ..ShadowSettings::default() };
    [
        base,
        ShadowSettings { method: ShadowMethod::Standard, ..base },
        ShadowSettings { method: ShadowMethod::PercentageCloser, ..base },
        ShadowSettings { cascades: 4, ..base },
        ShadowSettings { size: 16, blur: 16.0, cascades: 2, method: ShadowMethod::PercentageCloser, ..base },
    ]
}

fn triangle(corners: [[f32; 3]; 3]) -> Mesh {
    Mesh::from_indexed(corners.to_vec(), vec![[0.0, 1.0, 0.0]; 3], vec![], vec![[0, 1, 2]])
        .expect("expected a valid mesh")
}

/// Renders meshes with the given sun and shadow map. The default sky is bright and lights all surfaces, so that only
/// NaN gives black pixels. `clip_planes` are the near and far distances; without them, both are fitted to the bounds.
fn render_scene(meshes: &[Mesh], sun: [f32; 3], shadow: ShadowSettings, clip_planes: Option<(f64, f64)>) -> FrameImage {
    let mut builder = SceneBuilder::new();
    builder.parts.look = RenderSettings { sun, shadow: Some(shadow), ..RenderSettings::default() };
    for mesh in meshes {
        builder = builder.add_domain(mesh.clone(), Material { double_sided: true, ..Material::default() });
    }
    let scene = builder.build();
    let mut camera = Camera::fit_to_scene(&scene, 32, 32);
    if let Some((near, far)) = clip_planes {
        (camera.near, camera.far) = (near, far);
    }
    let mut deformer = ReferenceDeformer::new(&scene);
    let bounds = deformer.deform(&SceneState::rest(&scene)).expect("expected the step to succeed").bounds;
    let mut renderer = open_renderer();
    let buffers = renderer.load(&scene).expect("expected the scene to load");
    renderer.upload(&buffers, deformer.surface().expect("expected a surface")).expect("expected the upload to succeed");
    renderer
        .draw(
            &buffers,
            &FrameParams { camera, width: 32, height: 32, bounds, light_bounds: None, edges: None, samples: None },
        )
        .expect("expected a frame")
}

fn count_black(image: &FrameImage) -> usize {
    image.rgba.chunks_exact(4).filter(|pixel| pixel[..3] == [0; 3]).count()
}

#[test]
fn extreme_suns_cameras_and_scenes_have_no_nan_pixel() {
    let triangle_mesh = [triangle([[0.0, 0.5, 0.0], [1.0, 0.5, 0.0], [0.0, 1.0, 1.0]])];
    let point_mesh = [triangle([[5.0, 2.0, 5.0]; 3])];
    let upright_mesh = [triangle([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])];
    let far_mesh = [triangle([[1e7, 0.5, 0.0], [1e7 + 2.0, 0.5, 0.0], [1e7, 1.0, 2.0]])];
    let square_meshes = Vec::from([floor_mesh(2.0, 0.0), floor_mesh(1.0, 1.0)]);
    let scenes: [(&[Mesh], &str); 5] = [
        (&triangle_mesh, "one triangle"),
        (&point_mesh, "one point"),
        (&upright_mesh, "triangle in the plane x = 0"),
        (&far_mesh, "far from the origin"),
        (&square_meshes, "two squares"),
    ];
    let usual_sun = [0.4, 0.8, 0.5];
    // Straight above, at the horizon, slightly above the horizon, below the horizon, and a usual direction.
    let suns = [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1e-4, 0.2], [0.3, -1.0, 0.2], usual_sun];
    for shadow in shadow_settings() {
        for (meshes, name) in scenes {
            for sun in suns {
                let image = render_scene(meshes, sun, shadow, None);
                assert_eq!(count_black(&image), 0, "{name}, sun {sun:?}, {shadow:?}");
            }
        }
        assert_eq!(
            count_black(&render_scene(&square_meshes, usual_sun, shadow, Some((1e-6, 1e9)))),
            0,
            "extreme clip planes, {shadow:?}"
        );
    }
    let mut modified_image = render_scene(&square_meshes, usual_sun, shadow_settings()[0], None);
    modified_image.rgba[..3].fill(0);
    assert_eq!(count_black(&modified_image), 1, "negative control: expected one black pixel");
}

#[test]
fn static_shadow_does_not_flicker_while_bounds_grow() {
    let table_scene = |shadow: ShadowSettings| {
        let mut builder = SceneBuilder::new();
        builder.parts.look = RenderSettings { shadow: Some(shadow), ..RenderSettings::default() };
        builder
            .add_domain(floor_mesh(1.0, 0.7), Material::default())
            .add_domain(floor_mesh(0.1, 0.0), Material::default())
            .build()
    };
    let base = ShadowSettings { size: 100, ..ShadowSettings::default() };
    for method in [ShadowMethod::Variance, ShadowMethod::Standard, ShadowMethod::PercentageCloser] {
        let scene = table_scene(ShadowSettings { method, ..base });
        for has_light_bounds in [false, true] {
            let frames = render_growing_bounds(&scene, has_light_bounds);
            let changes: Vec<usize> =
                frames.windows(2).map(|pair| count_different_pixels(&pair[0], &pair[1])).collect();
            let changed_frames = changes.iter().filter(|change| **change > 0).count();
            // Over 60 frames the bounds grow by 0.25 scene units along x and by 0.125 along z. The extent of the map is
            // quantized: its width, its height and its depth range grow in about two steps each, and each step changes
            // one frame. A map that is not quantized would change all 59 later frames.
            assert!(
                changed_frames <= 10,
                "{method:?}: expected at most 10 changed frames, got {changed_frames}: {changes:?}"
            );
            assert!(
                count_different_pixels(&frames[0], &frames[59]) > 0,
                "negative control: expected a different image with the largest bounds"
            );
        }
    }
}

/// Renders 60 frames of a scene at rest. The bounds grow from frame to frame. With `has_light_bounds`, the frames also
/// have light-space bounds.
fn render_growing_bounds(scene: &std::sync::Arc<Scene>, has_light_bounds: bool) -> Vec<FrameImage> {
    let mut deformer = ReferenceDeformer::new(scene);
    let rest_bounds = deformer.deform(&SceneState::rest(scene)).expect("expected the step to succeed").bounds;
    let mut renderer = open_renderer();
    let buffers = renderer.load(scene).expect("expected the scene to load");
    renderer.upload(&buffers, deformer.surface().expect("expected a surface")).expect("expected the upload to succeed");
    let view = View::LookAt { eye: [3.0, 4.0, 5.0], target: [-0.3, 0.0, -0.3], up: [0.0, 1.0, 0.0] };
    let camera = Camera { view, lens: Lens::FieldOfView(30.0), near: 1.0, far: 30.0 };
    // The growth is 0 in frame 0 and 0.125 in the last frame, frame 59.
    let bounds_of_frame = |frame: u32| {
        let growth = 0.125 * f64::from(frame) / 59.0;
        BoundingBox {
            min: rest_bounds.min,
            max: [rest_bounds.max[0] * (1.0 + 2.0 * growth), rest_bounds.max[1], rest_bounds.max[2] * (1.0 + growth)],
        }
    };
    let axes = scene.light_axes().expect("expected a scene with a shadow");
    let mut draw_frame = |frame: u32| {
        let bounds = bounds_of_frame(frame);
        // Light bounds slightly larger than the light-space box of the scene bounds.
        let light_bounds = OrientedBounds::enclosing(&axes, &bounds).expanded_by(0.02 * bounds.diagonal());
        let params = FrameParams {
            camera,
            width: 96,
            height: 96,
            bounds,
            light_bounds: has_light_bounds.then_some(light_bounds),
            edges: None,
            samples: None,
        };
        renderer.draw(&buffers, &params).expect("expected a frame")
    };
    (0..60).map(&mut draw_frame).collect()
}

/// Number of pixels that differ by more than one level.
fn count_different_pixels(left: &FrameImage, right: &FrameImage) -> usize {
    let pairs = left.rgba.chunks_exact(4).zip(right.rgba.chunks_exact(4));
    pairs.filter(|(a, b)| a.iter().zip(*b).any(|(a, b)| a.abs_diff(*b) > 1)).count()
}
