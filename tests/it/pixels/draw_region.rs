//! A frame draws and clears only the region of the image that the bounds of its scene can cover. Pixels that earlier
//! frames drew outside this region never become visible.

use std::sync::Arc;

use modalcast_model::domain::{AlphaMode, Material};
use modalcast_model::scene::{BoundingBox, Camera, Culling, RenderSettings, Scene, Transparency};
use modalcast_render::{FrameParams, Renderer, SceneBuffers, VisibilityId};

use super::harness::{SceneBuilder, colored_material, facing_rectangle, front_camera, glass_material, open_renderer};

/// Side of a frame in pixels.
const SIZE: u32 = 96;

/// An opaque square, a cut-out leaf in front of it, and a glass pane in front of the leaf. `modify_look` changes the
/// render settings.
fn test_scene(modify_look: impl FnOnce(&mut RenderSettings)) -> Arc<Scene> {
    let mut builder = SceneBuilder::new();
    modify_look(&mut builder.parts.look);
    let leaf_material = builder.create_leaf_material();
    let builder = builder.add_domain(facing_rectangle(-1.0, -1.0, 0.3, 0.3, -0.5), colored_material([0.9, 0.2, 0.2]));
    builder
        .add_domain(facing_rectangle(-0.4, -0.6, 0.9, 0.7, 0.0), leaf_material)
        .add_domain(facing_rectangle(0.0, 0.0, 1.0, 1.0, 0.5), glass_material())
        .build()
}

/// Loads the scene and uploads its rest positions.
fn load_at_rest(renderer: &mut Renderer, scene: &Arc<Scene>) -> SceneBuffers {
    let buffers = renderer.load(scene).expect("expected the scene to load");
    let mut surface = modalcast_model::deform::DeformedSurface::default();
    for domain in &scene.domains {
        let mesh = &scene.shapes[domain.shape].mesh;
        surface.positions.extend(mesh.rest_positions().as_flattened());
        surface.normals.extend(mesh.corners().normals.as_flattened());
    }
    renderer.upload(&buffers, &surface).expect("expected the upload to succeed");
    buffers
}

/// [`front_camera`] with its principal point shifted by `[x, y]` pixels, which shifts the scene in the image.
fn shifted_camera([x, y]: [f64; 2]) -> Camera {
    let mut camera = front_camera(SIZE);
    if let modalcast_model::scene::Lens::Intrinsics { cx, cy, .. } = &mut camera.lens {
        (*cx, *cy) = (*cx + x, *cy + y);
    }
    camera
}

#[derive(PartialEq)]
struct Frame {
    rgba: Vec<u8>,
    /// Id of the first sample of each pixel.
    ids: Vec<VisibilityId>,
}

fn draw_frame(renderer: &mut Renderer, buffers: &SceneBuffers, camera: Camera, bounds: BoundingBox) -> Frame {
    let params =
        FrameParams { camera, width: SIZE, height: SIZE, bounds, light_bounds: None, edges: None, samples: None };
    let rgba = renderer.draw(buffers, &params).expect("expected a frame").rgba;
    Frame { rgba, ids: renderer.read_visibility().expect("expected visibility ids") }
}

#[test]
fn reused_targets_render_like_a_fresh_renderer() {
    let look_changes: [fn(&mut RenderSettings); 6] = [
        |look| look.samples = 1,
        |_| {},
        |look| look.transparency = Transparency::TwoPass,
        |look| look.transparency = Transparency::OrderIndependent,
        |look| look.culling = Culling::Occlusion,
        |look| (look.culling, look.samples) = (Culling::Occlusion, 1),
    ];
    // The shift by 500 pixels moves the scene out of the image.
    let shifts = [[0.0; 2], [30.0, 20.0], [-25.0, -30.0], [500.0, 0.0], [20.0, -20.0], [0.0; 2]];
    for (index, modify_look) in look_changes.into_iter().enumerate() {
        let scene = test_scene(modify_look);
        let (mut reused_renderer, mut previous_frame) = (open_renderer(), None::<Frame>);
        let buffers = load_at_rest(&mut reused_renderer, &scene);
        for shift in shifts {
            let (mut new_renderer, camera) = (open_renderer(), shifted_camera(shift));
            let new_buffers = load_at_rest(&mut new_renderer, &scene);
            let expected_frame = draw_frame(&mut new_renderer, &new_buffers, camera, scene.rest_bounds);
            let frame = draw_frame(&mut reused_renderer, &buffers, camera, scene.rest_bounds);
            assert!(frame == expected_frame, "look {index} at {shift:?}");
            let triangle_pixels = frame.ids.iter().filter(|id| matches!(id, VisibilityId::Triangle(_))).count();
            let is_in_image = shift[0] < 500.0;
            assert_eq!(triangle_pixels > 100, is_in_image, "look {index} at {shift:?}: {triangle_pixels} pixels");
            assert!(
                previous_frame.as_ref() != Some(&frame),
                "negative control: expected the shift to change the frame, look {index} at {shift:?}"
            );
            previous_frame = Some(frame);
        }
    }
}

#[test]
fn scenes_sharing_a_target_do_not_affect_each_other() {
    let mut builder = SceneBuilder::new();
    builder.parts.look.sunlight = [0.9, 0.3, 0.2];
    let glass = Material { alpha_mode: AlphaMode::Blend, alpha: 0.6, double_sided: true, ..Material::default() };
    let wall = Material { double_sided: true, ..Material::default() };
    // Five narrow vertical walls.
    let builder = (0..5).fold(builder, |builder, index| {
        builder.add_domain(
            facing_rectangle(0.2 * index as f32 - 0.7, -0.8, 0.2 * index as f32 - 0.6, 0.9, 0.1),
            wall.clone(),
        )
    });
    let other_scene = builder.add_domain(facing_rectangle(-0.8, 0.1, 0.8, 0.4, 0.6), glass).build();
    let scenes = [test_scene(|_| {}), other_scene];
    let mut shared_renderer = open_renderer();
    let buffers = [0, 1].map(|index| load_at_rest(&mut shared_renderer, &scenes[index]));
    for (frame_index, shift) in [[0.0; 2], [30.0, 20.0], [-25.0, -30.0], [12.0, 3.0]].into_iter().enumerate() {
        // The two scenes take turns.
        let (index, mut new_renderer) = (frame_index % 2, open_renderer());
        let new_buffers = load_at_rest(&mut new_renderer, &scenes[index]);
        let bounds = scenes[index].rest_bounds;
        let expected_frame = draw_frame(&mut new_renderer, &new_buffers, shifted_camera(shift), bounds);
        assert!(
            draw_frame(&mut shared_renderer, &buffers[index], shifted_camera(shift), bounds) == expected_frame,
            "frame {frame_index}"
        );
    }
}

#[test]
fn geometry_outside_the_bounds_leaves_no_stale_pixels() {
    for transparency in [Transparency::TwoPass, Transparency::OrderIndependent] {
        let scene = test_scene(|look| look.transparency = transparency);
        let mut renderer = open_renderer();
        let buffers = load_at_rest(&mut renderer, &scene);
        // These bounds are smaller than the scene on all sides. Rasterizers process blocks of 2 x 2 pixels and may draw
        // beyond the edges of the region. So the two shifts differ by one pixel: each edge lies inside a block with one
        // shift, and between two blocks with the other shift.
        let small_bounds = BoundingBox { min: [-0.3, -0.3, -0.5], max: [0.1, 0.2, -0.4] };
        let mut draw_shifted =
            |shift: [f64; 2]| draw_frame(&mut renderer, &buffers, shifted_camera(shift), small_bounds);
        for shift in [[0.0; 2], [1.0; 2]] {
            let first_frame = draw_shifted(shift);
            assert!(draw_shifted([30.0, 20.0]) != first_frame, "negative control: expected another frame");
            assert!(
                draw_shifted(shift) == first_frame && draw_shifted(shift) == first_frame,
                "expected the same frame again at {shift:?}"
            );
        }
    }
}

#[test]
fn bounds_limit_drawing_unless_they_are_nan() {
    let (scene, mut renderer) = (test_scene(|_| {}), open_renderer());
    let buffers = load_at_rest(&mut renderer, &scene);
    let mut count_triangle_pixels = |bounds: BoundingBox| {
        let frame = draw_frame(&mut renderer, &buffers, front_camera(SIZE), bounds);
        frame.ids.iter().filter(|id| matches!(id, VisibilityId::Triangle(_))).count()
    };
    let all_pixels = count_triangle_pixels(scene.rest_bounds);
    let half_bounds_pixels = count_triangle_pixels(BoundingBox { max: [0.0, 1.0, 0.5], ..scene.rest_bounds });
    let nan_bounds_pixels = count_triangle_pixels(BoundingBox { max: [f64::NAN; 3], ..scene.rest_bounds });
    assert!(
        half_bounds_pixels < all_pixels * 3 / 4 && all_pixels == nan_bounds_pixels,
        "{half_bounds_pixels} and {nan_bounds_pixels} of {all_pixels} pixels"
    );
}
