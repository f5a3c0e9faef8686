//! Frames draw and clear only the region that their scene can cover. Remains of earlier frames outside of it never
//! become visible.

use std::sync::Arc;

use modalcast_model::domain::{AlphaMode, Material};
use modalcast_model::scene::{Bounds, Camera, Culling, RenderSettings, Scene, Transparency};
use modalcast_render::{FrameParams, Renderer, SceneBuffers, VisibilityId};

use super::harness::{SceneBuilder, facing_rectangle, front_camera, open_renderer};

const SIZE: u32 = 96;

/// An opaque square, a leaf with holes in front of it, and a pane in front of the leaf.
fn test_scene(look: impl FnOnce(&mut RenderSettings)) -> Arc<Scene> {
    let mut builder = SceneBuilder::new();
    look(&mut builder.parts.look);
    let holes = builder.add_texture(8, 8, |x, y| [200, 220, 90, if (x + y) % 2 == 0 { 255 } else { 0 }]);
    let painted = |diffuse: [f32; 3]| Material { diffuse, double_sided: true, ..Material::default() };
    let glass = Material { alpha_mode: AlphaMode::Blend, alpha: 0.4, ..painted([0.2, 0.9, 0.3]) };
    let leaf =
        Material { alpha_mode: AlphaMode::Mask { cutoff: 0.5 }, color_texture: Some(holes), ..painted([1.0; 3]) };
    let builder = builder.add_domain(facing_rectangle(-1.0, -1.0, 0.3, 0.3, -0.5), painted([0.9, 0.2, 0.2]));
    builder
        .add_domain(facing_rectangle(-0.4, -0.6, 0.9, 0.7, 0.0), leaf)
        .add_domain(facing_rectangle(0.0, 0.0, 1.0, 1.0, 0.5), glass)
        .build()
}

/// Loads the scene with every vertex at its rest position.
fn loaded(renderer: &mut Renderer, scene: &Arc<Scene>) -> SceneBuffers {
    let buffers = renderer.load(scene).expect("expected the scene to load");
    let mut surface = modalcast_model::deform::DeformedSurface::default();
    for domain in &scene.domains {
        let mesh = &scene.shapes[domain.shape].mesh;
        surface.positions.extend(mesh.rest().as_flattened());
        surface.normals.extend(mesh.corners().normals.as_flattened());
    }
    renderer.upload(&buffers, &surface).expect("expected the upload to succeed");
    buffers
}

/// The camera with its principal point shifted by this many pixels.
fn aside([x, y]: [f64; 2]) -> Camera {
    let mut moved = front_camera(SIZE);
    if let modalcast_model::scene::Lens::Intrinsics { cx, cy, .. } = &mut moved.lens {
        (*cx, *cy) = (*cx + x, *cy + y);
    }
    moved
}

type Frame = (Vec<u8>, Vec<VisibilityId>);

fn frame(renderer: &mut Renderer, buffers: &SceneBuffers, camera: Camera, bounds: Bounds) -> Frame {
    let shot = FrameParams { camera, width: SIZE, height: SIZE, bounds, light: None };
    let rgba = renderer.draw(buffers, &shot).expect("expected a frame").rgba;
    (rgba, renderer.read_visibility().expect("reads"))
}

#[test]
fn reused_targets_render_like_a_fresh_renderer() {
    let looks: [fn(&mut RenderSettings); 6] = [
        |look| look.samples = 1,
        |_| {},
        |look| look.transparency = Transparency::TwoPass,
        |look| look.transparency = Transparency::OrderIndependent,
        |look| look.culling = Culling::Occlusion,
        |look| (look.culling, look.samples) = (Culling::Occlusion, 1),
    ];
    let places = [[0.0; 2], [30.0, 20.0], [-25.0, -30.0], [500.0, 0.0], [20.0, -20.0], [0.0; 2]];
    for (index, look) in looks.into_iter().enumerate() {
        let scene = test_scene(look);
        let (mut used, mut last) = (open_renderer(), None::<Frame>);
        let buffers = loaded(&mut used, &scene);
        for place in places {
            let (mut fresh, camera) = (open_renderer(), aside(place));
            let alone = loaded(&mut fresh, &scene);
            let want = frame(&mut fresh, &alone, camera, scene.rest_bounds);
            let got = frame(&mut used, &buffers, camera, scene.rest_bounds);
            assert!(got == want, "look {index} at {place:?}");
            let triangles = got.1.iter().filter(|seen| matches!(seen, VisibilityId::Triangle(_))).count();
            assert_eq!(triangles > 100, place[0] < 100.0, "look {index} at {place:?}: {triangles} pixels");
            assert!(last.as_ref() != Some(&got), "control: look {index} at {place:?} is another picture");
            last = Some(got);
        }
    }
}

#[test]
fn scenes_sharing_a_target_do_not_affect_each_other() {
    let mut other = SceneBuilder::new();
    other.parts.look.sunlight = [0.9, 0.3, 0.2];
    let glass = Material { alpha_mode: AlphaMode::Blend, alpha: 0.6, double_sided: true, ..Material::default() };
    let wall = Material { double_sided: true, ..Material::default() };
    let other = (0..5).fold(other, |builder, at| {
        builder.add_domain(facing_rectangle(0.2 * at as f32 - 0.7, -0.8, 0.2 * at as f32 - 0.6, 0.9, 0.1), wall.clone())
    });
    let (both, mut shared) = (
        [test_scene(|_| {}), other.add_domain(facing_rectangle(-0.8, 0.1, 0.8, 0.4, 0.6), glass).build()],
        open_renderer(),
    );
    let buffers = [0, 1].map(|index| loaded(&mut shared, &both[index]));
    for (turn, place) in [[0.0; 2], [30.0, 20.0], [-25.0, -30.0], [12.0, 3.0]].into_iter().enumerate() {
        let (at, mut fresh) = (turn % 2, open_renderer());
        let alone = loaded(&mut fresh, &both[at]);
        let bounds = both[at].rest_bounds;
        let want = frame(&mut fresh, &alone, aside(place), bounds);
        assert!(frame(&mut shared, &buffers[at], aside(place), bounds) == want, "turn {turn}");
    }
}

#[test]
fn geometry_outside_the_bounds_leaves_no_remains() {
    for transparency in [Transparency::TwoPass, Transparency::OrderIndependent] {
        let scene = test_scene(|look| look.transparency = transparency);
        let mut renderer = open_renderer();
        let buffers = loaded(&mut renderer, &scene);
        // Bounds smaller than the scene: they cut it on all sides, between two pixels of one quad or next to a quad.
        let told = Bounds { min: [-0.3, -0.3, -0.5], max: [0.1, 0.2, -0.4] };
        let mut draw = |place: [f64; 2]| frame(&mut renderer, &buffers, aside(place), told);
        for place in [[0.0; 2], [1.0; 2]] {
            let first = draw(place);
            assert!(draw([30.0, 20.0]) != first, "control");
            assert!(draw(place) == first && draw(place) == first, "the same again at {place:?}");
        }
    }
}

#[test]
fn nothing_is_drawn_outside_the_given_bounds() {
    let (scene, mut renderer) = (test_scene(|_| {}), open_renderer());
    let buffers = loaded(&mut renderer, &scene);
    let mut ids = |bounds: Bounds| {
        let (_, seen) = frame(&mut renderer, &buffers, front_camera(SIZE), bounds);
        seen.iter().filter(|seen| matches!(seen, VisibilityId::Triangle(_))).count()
    };
    let whole = ids(scene.rest_bounds);
    let half = ids(Bounds { max: [0.0, 1.0, 0.5], ..scene.rest_bounds });
    let unknown = ids(Bounds { max: [f64::NAN; 3], ..scene.rest_bounds });
    assert!(half < whole * 3 / 4 && whole == unknown, "{half} and {unknown} of {whole} pixels");
}
