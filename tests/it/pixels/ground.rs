//! The ground is rasterized by a pass of its own only if geometry may be below it. Otherwise the shading intersects
//! view rays with the ground plane, in samples without a triangle. Both ways give the same image.

use std::sync::Arc;

use modalcast_model::deform::DeformedSurface;
use modalcast_model::scene::{
    Bloom, Camera, Culling, Ground, Lens, RenderSettings, Scene, ShadowSettings, Transparency, View,
};
use modalcast_render::{FrameParams, Pass, Renderer, VisibilityId};

use super::harness::{SceneBuilder, colored_material, facing_rectangle, floor_mesh, glass_material, open_renderer};

/// Side of a frame in pixels.
const SIZE: u32 = 96;

/// A wall and a glass pane that stand on the ground, a red square that lies on it, and a cut-out leaf above it.
/// `modify_look` changes the render settings.
fn test_scene(modify_look: impl FnOnce(&mut RenderSettings)) -> Arc<Scene> {
    let mut builder = SceneBuilder::new();
    let look = &mut builder.parts.look;
    (look.zenith, look.horizon) = ([0.1, 0.3, 0.8], [0.7, 0.8, 0.9]);
    look.sun = [2.0, 3.0, 1.0];
    look.ground = Some(Ground { color: [0.5, 0.4, 0.3] });
    modify_look(look);
    let leaf_material = builder.create_leaf_material();
    let builder = builder
        .add_domain(floor_mesh(1.5, 0.0), colored_material([0.9, 0.2, 0.2]))
        .add_domain(facing_rectangle(-2.0, 0.0, -0.5, 1.5, -0.3), colored_material([0.4; 3]));
    builder
        .add_domain(facing_rectangle(-1.0, 0.0, 2.5, 1.0, 0.8), glass_material())
        .add_domain(facing_rectangle(0.5, 1.1, 1.5, 2.1, 0.0), leaf_material)
        .build()
}

/// A camera at `eye` that looks at the objects. Clip planes of 0 are fitted to the bounds.
fn camera_at(eye: [f64; 3]) -> Camera {
    let view = View::LookAt { eye, target: [0.0, 0.8, 0.0], up: [0.0, 1.0, 0.0] };
    Camera { view, lens: Lens::FieldOfView(50.0), near: 0.0, far: 0.0 }
}

struct Frame {
    rgba: Vec<u8>,
    /// Id of the first sample of each pixel.
    ids: Vec<VisibilityId>,
    passes: Vec<Pass>,
}

impl Frame {
    /// Renders the scene at rest, lowered by `lowering`. `min_y` is the lower bound of y that the
    /// renderer receives.
    fn new(renderer: &mut Renderer, scene: &Arc<Scene>, camera: Camera, lowering: f32, min_y: f64) -> Self {
        let buffers = renderer.load(scene).expect("expected the scene to load");
        let collect_from_meshes = |attribute: fn(&modalcast_model::domain::Mesh) -> &[[f32; 3]]| -> Vec<f32> {
            scene
                .domains
                .iter()
                .flat_map(|domain| attribute(&scene.shapes[domain.shape].mesh).as_flattened())
                .copied()
                .collect()
        };
        let (mut positions, normals) =
            (collect_from_meshes(|mesh| mesh.rest_positions()), collect_from_meshes(|mesh| &mesh.corners().normals));
        positions.chunks_exact_mut(3).for_each(|vertex| vertex[1] -= lowering);
        renderer
            .upload(&buffers, &DeformedSurface { positions, normals, ..DeformedSurface::default() })
            .expect("expected the upload to succeed");
        let mut bounds = scene.rest_bounds;
        bounds.min[1] = min_y;
        let params = FrameParams { camera, width: SIZE, height: SIZE, bounds, light_bounds: None };
        let rgba = renderer.draw(&buffers, &params).expect("expected a frame").rgba;
        let passes = renderer.stats().passes.clone();
        let ids = renderer.read_visibility().expect("expected visibility ids");
        renderer.unload(buffers);
        Self { rgba, ids, passes }
    }

    fn draws_ground(&self) -> bool {
        self.passes.contains(&Pass::Ground)
    }

    /// Number of pixels whose colors differ by more than two levels, and number of pixels whose ids differ.
    fn count_differences(&self, other: &Self) -> [usize; 2] {
        let pixels = self.rgba.chunks_exact(4).zip(other.rgba.chunks_exact(4));
        let is_different = |(left, right): &(&[u8], &[u8])| left.iter().zip(*right).any(|(a, b)| a.abs_diff(*b) > 2);
        [
            pixels.filter(is_different).count(),
            self.ids.iter().zip(&other.ids).filter(|(left, right)| left != right).count(),
        ]
    }
}

/// Lower bound in y that requires the ground pass. It is farther below the ground than the renderer's tolerance for
/// rounding, about 1e-6 for these scenes, and too close to the ground to affect the shadow map or the depth range.
const BELOW_GROUND: f64 = -1e-5;

#[test]
fn analytic_ground_equals_drawn_ground() {
    let look_changes: [fn(&mut RenderSettings); 6] = [
        |_| {},
        |look| look.samples = 1,
        |look| look.shadow = Some(ShadowSettings { size: 256, ..ShadowSettings::default() }),
        |look| look.transparency = Transparency::TwoPass,
        |look| look.culling = Culling::Occlusion,
        |look| look.bloom = Some(Bloom::default()),
    ];
    let mut renderer = open_renderer();
    for (index, modify_look) in look_changes.into_iter().enumerate() {
        let scene = test_scene(modify_look);
        for eye in [[0.5, 1.0, 7.0], [3.0, 4.0, 5.0], [-4.0, 0.05, 1.0], [0.0, 0.8, 60.0]] {
            let mut draw_frame = |min_y: f64| Frame::new(&mut renderer, &scene, camera_at(eye), 0.0, min_y);
            let (analytic_frame, drawn_frame) = (draw_frame(0.0), draw_frame(BELOW_GROUND));
            assert_eq!([analytic_frame.draws_ground(), drawn_frame.draws_ground()], [false, true]);
            // Rounding may assign a sample at the horizon to the ground or to the sky, which have the same color there.
            let [colors, ids] = analytic_frame.count_differences(&drawn_frame);
            assert!(
                colors == 0 && ids <= 2,
                "look {index} from {eye:?}: {colors} colors and {ids} ids of {} pixels differ",
                SIZE * SIZE
            );
            let ground_pixels = analytic_frame.ids.iter().filter(|id| **id == VisibilityId::Ground).count();
            assert!(ground_pixels > 500, "look {index} from {eye:?}: {ground_pixels} pixels of ground");
        }
    }
}

/// Bounds that overflowed to NaN also require the ground pass.
#[test]
fn ground_hides_geometry_below_and_is_one_sided() {
    let (scene, mut renderer) = (test_scene(|_| {}), open_renderer());
    let camera = camera_at([0.5, 1.0, 7.0]);
    let mut draw_frame =
        |camera: Camera, lowering: f32, min_y: f64| Frame::new(&mut renderer, &scene, camera, lowering, min_y);
    // Both frames lower the scene by 0.7. Only the bounds of the first frame extend below the ground.
    let (frame_with_pass, frame_without_pass) = (draw_frame(camera, 0.7, -0.7), draw_frame(camera, 0.7, 0.0));
    assert_eq!([frame_with_pass.draws_ground(), frame_without_pass.draws_ground()], [true, false]);
    let [colors, ids] = frame_without_pass.count_differences(&frame_with_pass);
    assert!(colors > 200 && ids > 100, "negative control: {colors} colors and {ids} ids differ");
    // From below, the ground is not visible.
    let frame_from_below = draw_frame(camera_at([0.5, -1.0, 7.0]), 0.0, 0.0);
    assert!(!frame_from_below.draws_ground() && frame_from_below.ids.iter().all(|id| *id != VisibilityId::Ground));
    let nan_bounds_frame = draw_frame(camera, 0.0, f64::NAN);
    assert!(nan_bounds_frame.draws_ground(), "expected the ground pass for bounds that overflowed");
}

#[test]
fn geometry_on_the_ground_is_visible_despite_rounding() {
    let (scene, mut renderer) = (test_scene(|_| {}), open_renderer());
    let camera = camera_at([1.0, 5.0, 4.0]);
    // The scene and its bounds are lowered by 4e-7, an error that rounding can cause.
    let frame = Frame::new(&mut renderer, &scene, camera, 4e-7, -4e-7);
    assert!(!frame.draws_ground());
    let frame_with_pass = Frame::new(&mut renderer, &scene, camera, 4e-7, BELOW_GROUND);
    let [colors, ids] = frame.count_differences(&frame_with_pass);
    assert!(frame_with_pass.draws_ground() && colors == 0 && ids <= 2, "{colors} colors and {ids} ids differ");
    let red_pixels = frame.rgba.chunks_exact(4).filter(|pixel| pixel[0] > pixel[1].saturating_add(30)).count();
    assert!(red_pixels > 300, "{red_pixels} pixels of the red square");
}
