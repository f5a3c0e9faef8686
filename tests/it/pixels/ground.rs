//! The ground is behind all triangles, also those below it, and only visible from above.

use std::sync::Arc;

use modalcast_model::deform::DeformedSurface;
use modalcast_model::scene::{
    Bloom, Camera, Culling, Ground, Lens, RenderSettings, Scene, ShadowSettings, Transparency, View,
};
use modalcast_render::{FrameParams, Renderer, VisibilityId};

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
    look.ground = Some(Ground { color: Some([0.5, 0.4, 0.3]) });
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
}

impl Frame {
    /// Renders the scene at rest, lowered by `lowering`.
    fn new(renderer: &mut Renderer, scene: &Arc<Scene>, camera: Camera, lowering: f32) -> Self {
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
        bounds.min[1] -= f64::from(lowering);
        let params =
            FrameParams { camera, width: SIZE, height: SIZE, bounds, light_bounds: None, edges: None, samples: None };
        let rgba = renderer.draw(&buffers, &params).expect("expected a frame").rgba;
        let ids = renderer.read_visibility().expect("expected visibility ids");
        renderer.unload(buffers);
        Self { rgba, ids }
    }

    fn count_ids(&self, predicate: impl Fn(VisibilityId) -> bool) -> usize {
        self.ids.iter().filter(|id| predicate(**id)).count()
    }
}

/// Lowers the scene until half of it is below the ground.
#[test]
fn ground_never_hides_triangles() {
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
        let [scene, scene_without_ground] = [true, false].map(|has_ground| {
            test_scene(|look| {
                modify_look(look);
                look.ground = look.ground.filter(|_| has_ground);
            })
        });
        for eye in [[3.0, 4.0, 5.0], [-4.0, 0.05, 1.0]] {
            let mut draw_frame =
                |scene: &Arc<Scene>, lowering: f32| Frame::new(&mut renderer, scene, camera_at(eye), lowering);
            let (frame, frame_without_ground) = (draw_frame(&scene, 0.7), draw_frame(&scene_without_ground, 0.7));
            let triangle_or_background = |id: &VisibilityId| match *id {
                VisibilityId::Ground => VisibilityId::Background,
                id => id,
            };
            let ids: Vec<_> = frame.ids.iter().map(triangle_or_background).collect();
            assert_eq!(ids, frame_without_ground.ids, "look {index} from {eye:?}");
            let ground_pixels = frame.count_ids(|id| id == VisibilityId::Ground);
            assert!(ground_pixels > 500, "look {index} from {eye:?}: {ground_pixels} pixels of ground");
            // The ground does not move: a pixel without a triangle in both frames has the same id.
            let frame_at_rest = draw_frame(&scene, 0.0);
            let has_moved = |(at_rest, lowered): (&VisibilityId, &VisibilityId)| {
                !matches!(at_rest, VisibilityId::Triangle(_))
                    && !matches!(lowered, VisibilityId::Triangle(_))
                    && at_rest != lowered
            };
            let moved_pixels = frame_at_rest.ids.iter().zip(&frame.ids).filter(|pair| has_moved(*pair)).count();
            assert_eq!(moved_pixels, 0, "look {index} from {eye:?}");
            assert_ne!(frame_at_rest.ids, frame.ids, "control: expected the triangles to move");
        }
    }
}

#[test]
fn ground_is_one_sided() {
    let (scene, mut renderer) = (test_scene(|_| {}), open_renderer());
    let mut draw_frame = |eye: [f64; 3]| Frame::new(&mut renderer, &scene, camera_at(eye), 0.0);
    let [from_above, from_below] = [draw_frame([0.5, 1.0, 7.0]), draw_frame([0.5, -1.0, 7.0])]
        .map(|frame| frame.count_ids(|id| id == VisibilityId::Ground));
    assert!(from_above > 500 && from_below == 0, "{from_above} pixels from above, {from_below} from below");
}

#[test]
fn geometry_on_the_ground_is_visible_despite_rounding() {
    let (scene, mut renderer) = (test_scene(|_| {}), open_renderer());
    // Rounding can lower the scene by 4e-7.
    let frame = Frame::new(&mut renderer, &scene, camera_at([1.0, 5.0, 4.0]), 4e-7);
    let red_pixels = frame.rgba.chunks_exact(4).filter(|pixel| pixel[0] > pixel[1].saturating_add(30)).count();
    assert!(red_pixels > 300, "{red_pixels} pixels of the red square");
}
