//! The ground that is found analytically in samples without a triangle, compared with the ground drawn by its pass.

use std::sync::Arc;

use modalcast_model::deform::DeformedSurface;
use modalcast_model::domain::{AlphaMode, Material};
use modalcast_model::scene::{
    Bloom, Bounds, Camera, Culling, Ground, Lens, RenderSettings, Scene, ShadowSettings, Transparency, View,
};
use modalcast_render::{FrameParams, Pass, Renderer, VisibilityId};

use super::harness::{SceneBuilder, facing_rectangle, floor_mesh, open_renderer};

const SIZE: u32 = 96;

/// A wall and a pane that stand on the ground, a mat that lies on it, and a leaf with holes above.
fn test_scene(look: impl FnOnce(&mut RenderSettings)) -> Arc<Scene> {
    let mut builder = SceneBuilder::new();
    let base = &mut builder.parts.look;
    (base.zenith, base.horizon) = ([0.1, 0.3, 0.8], [0.7, 0.8, 0.9]);
    base.sun = [2.0, 3.0, 1.0];
    base.ground = Some(Ground { color: [0.5, 0.4, 0.3] });
    look(base);
    let holes = builder.add_texture(8, 8, |x, y| [200, 220, 90, if (x + y) % 2 == 0 { 255 } else { 0 }]);
    let painted = |diffuse: [f32; 3]| Material { diffuse, double_sided: true, ..Material::default() };
    let glass = Material { alpha_mode: AlphaMode::Blend, alpha: 0.4, ..painted([0.2, 0.9, 0.3]) };
    let leaf =
        Material { alpha_mode: AlphaMode::Mask { cutoff: 0.5 }, color_texture: Some(holes), ..painted([1.0; 3]) };
    let builder = builder
        .add_domain(floor_mesh(1.5, 0.0), painted([0.9, 0.2, 0.2]))
        .add_domain(facing_rectangle(-2.0, 0.0, -0.5, 1.5, -0.3), painted([0.4; 3]));
    builder
        .add_domain(facing_rectangle(-1.0, 0.0, 2.5, 1.0, 0.8), glass)
        .add_domain(facing_rectangle(0.5, 1.1, 1.5, 2.1, 0.0), leaf)
        .build()
}

fn from(eye: [f64; 3]) -> Camera {
    let view = View::LookAt { eye, target: [0.0, 0.8, 0.0], up: [0.0, 1.0, 0.0] };
    Camera { view, lens: Lens::FieldOfView(50.0), near: 0.0, far: 0.0 }
}

struct Frame {
    rgba: Vec<u8>,
    seen: Vec<VisibilityId>,
    passes: Vec<Pass>,
}

impl Frame {
    /// Renders the scene at rest, lowered by `sunk`, with bounds whose lowest point is at `lowest`.
    fn new(renderer: &mut Renderer, scene: &Arc<Scene>, camera: Camera, (sunk, lowest): (f32, f64)) -> Self {
        let buffers = renderer.load(scene).expect("expected the scene to load");
        let of_all = |part: fn(&modalcast_model::domain::Mesh) -> &[[f32; 3]]| -> Vec<f32> {
            scene
                .domains
                .iter()
                .flat_map(|domain| part(&scene.shapes[domain.shape].mesh).as_flattened())
                .copied()
                .collect()
        };
        let (mut positions, normals) = (of_all(|mesh| mesh.rest()), of_all(|mesh| &mesh.corners().normals));
        positions.chunks_exact_mut(3).for_each(|vertex| vertex[1] -= sunk);
        renderer
            .upload(&buffers, &DeformedSurface { positions, normals, ..DeformedSurface::default() })
            .expect("expected the upload to succeed");
        let mut bounds = scene.rest_bounds;
        bounds.min[1] = lowest;
        let shot = FrameParams { camera, width: SIZE, height: SIZE, bounds, light: None };
        let rgba = renderer.draw(&buffers, &shot).expect("expected a frame").rgba;
        let passes = renderer.stats().passes.clone();
        let seen = renderer.read_visibility().expect("reads");
        renderer.unload(buffers);
        Self { rgba, seen, passes }
    }

    fn draws_ground(&self) -> bool {
        self.passes.contains(&Pass::Ground)
    }

    /// Number of pixels whose colors differ by more than two levels, and number of samples that see something else.
    fn against(&self, other: &Self) -> [usize; 2] {
        let pixels = self.rgba.chunks_exact(4).zip(other.rgba.chunks_exact(4));
        let far = |(own, other): &(&[u8], &[u8])| own.iter().zip(*other).any(|(a, b)| a.abs_diff(*b) > 2);
        [pixels.filter(far).count(), self.seen.iter().zip(&other.seen).filter(|(own, other)| own != other).count()]
    }
}

/// Far enough below the ground to exceed rounding, but too little to affect the shadow map or the depth range.
const BELOW: f64 = -1e-5;

#[test]
fn analytic_ground_equals_drawn_ground() {
    let looks: [fn(&mut RenderSettings); 6] = [
        |_| {},
        |look| look.samples = 1,
        |look| look.shadow = Some(ShadowSettings { size: 256, ..ShadowSettings::default() }),
        |look| look.transparency = Transparency::TwoPass,
        |look| look.culling = Culling::Occlusion,
        |look| look.bloom = Some(Bloom::default()),
    ];
    let mut renderer = open_renderer();
    for (index, look) in looks.into_iter().enumerate() {
        let scene = test_scene(look);
        for eye in [[0.5, 1.0, 7.0], [3.0, 4.0, 5.0], [-4.0, 0.05, 1.0], [0.0, 0.8, 60.0]] {
            let mut frame = |lowest: f64| Frame::new(&mut renderer, &scene, from(eye), (0.0, lowest));
            let (found, drawn) = (frame(0.0), frame(BELOW));
            assert_eq!([found.draws_ground(), drawn.draws_ground()], [false, true]);
            // The far edge of the ground has exactly the color of the sky at the horizon. Samples there may round
            // differently.
            let [colors, ids] = found.against(&drawn);
            assert!(
                colors == 0 && ids <= 2,
                "look {index} from {eye:?}: {colors} colours and {ids} ids of {}",
                SIZE * SIZE
            );
            let ground = found.seen.iter().filter(|seen| **seen == VisibilityId::Ground).count();
            assert!(ground > 500, "look {index} from {eye:?}: {ground} pixels of ground");
        }
    }
}

/// Bounds that overflowed need the ground pass, because they say nothing about geometry below the ground.
#[test]
fn ground_hides_geometry_below_and_is_one_sided() {
    let (scene, mut renderer) = (test_scene(|_| {}), open_renderer());
    let camera = from([0.5, 1.0, 7.0]);
    let mut frame = |eye: Camera, sunk: f32, lowest: f64| Frame::new(&mut renderer, &scene, eye, (sunk, lowest));
    let (right, wrong) = (frame(camera, 0.7, -0.7), frame(camera, 0.7, 0.0));
    assert_eq!([right.draws_ground(), wrong.draws_ground()], [true, false]);
    let [colors, ids] = wrong.against(&right);
    assert!(colors > 200 && ids > 100, "control: {colors} colours and {ids} ids tell who lies below");
    let from_below = frame(from([0.5, -1.0, 7.0]), 0.0, 0.0);
    assert!(!from_below.draws_ground() && from_below.seen.iter().all(|seen| *seen != VisibilityId::Ground));
    let nowhere = frame(camera, 0.0, f64::NAN);
    assert!(nowhere.draws_ground(), "bounds that overflowed tell nothing");
}

#[test]
fn geometry_on_the_ground_is_visible_despite_rounding() {
    let (scene, mut renderer) = (test_scene(|_| {}), open_renderer());
    let camera = from([1.0, 5.0, 4.0]);
    let rounded = Bounds { min: [0.0, -4e-7, 0.0], ..scene.rest_bounds }.min[1];
    let frame = Frame::new(&mut renderer, &scene, camera, (4e-7, rounded));
    assert!(!frame.draws_ground());
    let drawn = Frame::new(&mut renderer, &scene, camera, (4e-7, BELOW));
    let [colors, ids] = frame.against(&drawn);
    assert!(drawn.draws_ground() && colors == 0 && ids <= 2, "{colors} colours and {ids} ids");
    let red = frame.rgba.chunks_exact(4).filter(|pixel| pixel[0] > pixel[1].saturating_add(30)).count();
    assert!(red > 300, "{red} pixels of the mat");
}
