//! Picks compared with arithmetic: triangle, barycentric coordinates, position, and pixels without a hit.

use std::sync::Arc;

use modalcast_compute::reference::ReferenceDeformer;
use modalcast_model::deform::{DeformedSurface, Deformer as _};
use modalcast_model::domain::{AlphaMode, Domain, Material, Mesh, Modes, Shape, Transform};
use modalcast_model::scene::{Bounds, Camera, Ground, Lens, PixelRect, Scene, SceneState, View};
use modalcast_render::{FrameParams, PickHit, Renderer, SceneBuffers, VisibilityId};
use nalgebra::Vector3;

use super::harness::{SceneBuilder, facing_rectangle, floor_mesh, front_camera, open_renderer};

/// Ids are those of the frame unless an edge passes a sample by less than the rasterizer's 1/256 pixel. The hit
/// position is computed in f64 on the f32 triangle, so in these scenes it is correct to a millionth of a unit.
const NEAR: f64 = 1e-6;

struct PickHarness {
    renderer: Renderer,
    buffers: SceneBuffers,
    bounds: Bounds,
}

impl PickHarness {
    fn of(scene: &Arc<Scene>, state: &SceneState) -> Self {
        let mut renderer = open_renderer();
        let mut deformer = ReferenceDeformer::new(scene);
        let bounds = deformer.deform(state).expect("expected the step to succeed").bounds;
        let buffers = renderer.load(scene).expect("expected the scene to load");
        renderer.upload(&buffers, deformer.surface().expect("there")).expect("expected the upload to succeed");
        Self { renderer, buffers, bounds }
    }

    fn rest(scene: &Arc<Scene>) -> Self {
        Self::of(scene, &SceneState::rest(scene))
    }

    fn shot(&self, camera: Camera, size: u32) -> FrameParams {
        FrameParams { camera, width: size, height: size, bounds: self.bounds, light: None }
    }

    /// Hits of a rectangle of a square picture, given by its corner and size.
    fn pick(&mut self, camera: Camera, picture: u32, corner: [u32; 2], size: [u32; 2]) -> Vec<PickHit> {
        let rectangle = PixelRect::within([picture; 2], corner, size).expect("inside");
        let shot = self.shot(camera, picture);
        let pick = self.renderer.begin_pick(&self.buffers, &shot, rectangle).expect("expected a readback to start");
        self.renderer.finish_pick(pick).expect("ends")
    }
}

fn off(got: [f64; 3], want: [f64; 3]) -> f64 {
    (Vector3::from(got) - Vector3::from(want)).abs().max()
}

/// Intersection of the ray through the center of a pixel of [`front_camera`]`(64)` with the plane z = 0.
fn at(x: u32, y: u32) -> [f64; 3] {
    [(f64::from(x) + 0.5 - 32.0) / 10.0, (32.0 - f64::from(y) - 0.5) / 10.0, 0.0]
}

#[test]
fn pick_has_domain_triangle_position_normal_and_depth() {
    let builder = SceneBuilder::new().add_domain(facing_rectangle(-3.0, -3.0, -2.5, -2.5, 0.0), Material::default());
    let scene = builder.add_domain(facing_rectangle(-2.0, -1.0, 2.0, 1.0, 0.0), Material::default()).build();
    let hits = PickHarness::rest(&scene).pick(front_camera(64), 64, [40, 30], [1, 1]);
    let [hit] = &hits[..] else { panic!("{hits:?}") };
    let [x, y, _] = at(40, 30);
    assert_eq!((hit.pixel, hit.domain, hit.triangle, hit.vertices), ([40, 30], 1, 0, [0, 1, 2]));
    assert!(off(hit.position, [x, y, 0.0]) < NEAR && off(hit.normal, [0.0, 0.0, 1.0]) < NEAR, "{hit:?}");
    assert!((hit.depth - 10.0).abs() < NEAR);
    // Corners (-2, -1), (2, -1), (2, 1); the second barycentric coordinate is the remainder.
    let [first, third] = [(2.0 - x) / 4.0, (y + 1.0) / 2.0];
    assert!(off(hit.barycentrics, [first, 1.0 - first - third, third]) < NEAR, "{hit:?}");
}

/// A hit on the back side has a flipped normal.
#[test]
fn mirrored_domains_keep_vertex_order_in_picks() {
    let double_sided = Material { double_sided: true, ..Material::default() };
    let mut builder = SceneBuilder::new().add_domain(facing_rectangle(-2.0, -1.0, 2.0, 1.0, 0.0), double_sided);
    builder.parts.domains[0].placement.0[0] = -1.0;
    let scene = builder.build();
    let mut board = PickHarness::rest(&scene);
    let hit = board.pick(front_camera(64), 64, [24, 34], [1, 1]).remove(0);
    // The point on the mesh is mirrored in x.
    let [x, y, _] = at(24, 34);
    assert_eq!(hit.vertices, [0, 1, 2]);
    assert!(off(hit.barycentrics, [(2.0 + x) / 4.0, 1.0 - (2.0 + x) / 4.0 - (y + 1.0) / 2.0, (y + 1.0) / 2.0]) < NEAR);
    let behind = View::LookAt { eye: [0.0, 0.0, -10.0], target: [0.0; 3], up: [0.0, 1.0, 0.0] };
    for (view, z) in [(front_camera(64).view, 1.0), (behind, -1.0)] {
        let hit = board.pick(Camera { view, ..front_camera(64) }, 64, [30, 30], [1, 1]).remove(0);
        assert!(off(hit.normal, [0.0, 0.0, z]) < NEAR, "{hit:?}");
    }
}

#[test]
fn pick_follows_the_deformed_surface() {
    let mesh = facing_rectangle(-1.0, -1.0, 1.0, 1.0, 0.0);
    let columns = (0..12).map(|row| if row % 3 == 2 { 1.0 } else { 0.0 }).collect();
    let mut builder = SceneBuilder::new().add_domain(mesh.clone(), Material::default());
    builder.parts.shapes[0] = Shape::new(mesh, Modes::from_columns(12, 1, columns).expect("12 x 1")).expect("fits");
    let scene = builder.build();
    let mut state = SceneState::rest(&scene);
    for q in [0.0, 2.0, -3.0_f32] {
        state.q[0] = q;
        let hit = PickHarness::of(&scene, &state).pick(front_camera(64), 64, [36, 27], [1, 1]).remove(0);
        let (z, [x, y, _]) = (f64::from(q), at(36, 27));
        // The ray from (0, 0, 10) meets the plane at this z instead of the plane z = 0.
        let want = [x * (10.0 - z) / 10.0, y * (10.0 - z) / 10.0, z];
        assert!(off(hit.position, want) < NEAR && (hit.depth - 10.0 + z).abs() < NEAR, "{q}: {hit:?}");
    }
}

/// For rectangles of the largest size and at the border of the picture.
#[test]
fn picks_agree_with_the_visibility_of_the_frame() {
    let mut builder = SceneBuilder::new();
    builder.parts.look.samples = 1;
    builder.parts.look.ground = Some(Ground::default());
    let image = builder.add_texture(8, 8, |x, y| [200, 200, 200, if (x + y) % 2 == 0 { 255 } else { 0 }]);
    let leaf =
        Material { alpha_mode: AlphaMode::Mask { cutoff: 0.5 }, color_texture: Some(image), ..Material::default() };
    let scene = builder
        .add_domain(floor_mesh(3.0, 0.0), Material::default())
        .add_domain(facing_rectangle(-1.5, 0.3, 1.5, 2.5, 0.4), leaf)
        .add_domain(facing_rectangle(-0.9, 0.2, 2.0, 1.1, -0.7), Material::default())
        .build();
    let mut board = PickHarness::rest(&scene);
    let view = View::LookAt { eye: [3.0, 4.0, 9.0], target: [0.2, 0.5, 0.0], up: [0.0, 1.0, 0.0] };
    for lens in [Lens::FieldOfView(40.0), Lens::Intrinsics { fx: 120.0, fy: 130.0, cx: 50.0, cy: 44.0 }] {
        let camera = Camera { view, lens, near: 0.0, far: 0.0 };
        let shot = board.shot(camera, 100);
        board.renderer.draw(&board.buffers, &shot).expect("expected a frame");
        let frame = board.renderer.read_visibility().expect("reads");
        let (mut differ, mut holes, mut seen) = (0, 0, [0; 3]);
        for (corner, size) in [([0, 0], [64, 64]), ([64, 0], [36, 64]), ([0, 64], [64, 36]), ([64, 64], [36, 36])] {
            let hits = board.pick(camera, 100, corner, size);
            for y in corner[1]..corner[1] + size[1] {
                for x in corner[0]..corner[0] + size[0] {
                    let want = match frame[(100 * y + x) as usize] {
                        VisibilityId::Triangle(place) => board.buffers.source_triangle(place),
                        _ => None,
                    };
                    let got = hits.iter().find(|hit| hit.pixel == [x, y]);
                    differ += usize::from(got.map(|hit| (hit.domain, hit.triangle)) != want);
                    holes += usize::from(got.is_none());
                    got.into_iter().for_each(|hit| seen[hit.domain] += 1);
                }
            }
        }
        // An edge may pass a sample by less than the rasterizer's precision.
        assert!(differ <= 5, "{differ} of 10000 pixels");
        assert!(holes > 500 && seen.iter().all(|count| *count > 100), "control: {holes} {seen:?}");
    }
}

/// A surface behind a hole is hit.
#[test]
fn holes_glass_sky_and_ground_are_not_hit() {
    let mut builder = SceneBuilder::new();
    let image = builder.add_texture(2, 1, |x, _| [200, 200, 200, if x == 0 { 255 } else { 0 }]);
    let leaf =
        Material { alpha_mode: AlphaMode::Mask { cutoff: 0.5 }, color_texture: Some(image), ..Material::default() };
    let glass = Material { alpha_mode: AlphaMode::Blend, alpha: 0.9, ..Material::default() };
    // The leaf is solid on its left half and open on its right half. The glass covers the upper half, in front of it.
    let scene = builder
        .add_domain(facing_rectangle(-2.0, -2.0, 2.0, 2.0, 0.0), leaf)
        .add_domain(facing_rectangle(-2.0, -2.0, 2.0, 0.0, -1.0), Material::default())
        .add_domain(facing_rectangle(-2.0, 0.0, 2.0, 2.0, 1.0), glass)
        .build();
    let mut board = PickHarness::rest(&scene);
    let mut at = |x: u32, y: u32| board.pick(front_camera(64), 64, [x, y], [1, 1]).first().map(|hit| hit.domain);
    assert_eq!([at(22, 22), at(42, 22), at(42, 42), at(2, 2)], [Some(0), None, Some(1), None]);
    let floor = Camera {
        view: View::LookAt { eye: [0.0, 2.0, 10.0], target: [0.0, -3.0, 0.0], up: [0.0, 1.0, 0.0] },
        ..front_camera(64)
    };
    let mut builder = SceneBuilder::new();
    builder.parts.look.ground = Some(Ground::default());
    let scene = builder.add_domain(facing_rectangle(-1.0, 0.0, 1.0, 1.0, 0.0), Material::default()).build();
    assert!(PickHarness::rest(&scene).pick(floor, 64, [32, 60], [1, 1]).is_empty(), "the ground");
}

#[test]
fn concurrent_picks_finish_in_any_order() {
    let scene =
        SceneBuilder::new().add_domain(facing_rectangle(-3.0, -3.0, 3.0, 3.0, 0.0), Material::default()).build();
    let mut board = PickHarness::rest(&scene);
    let shot = board.shot(front_camera(64), 64);
    let picks: Vec<_> = (10..50)
        .map(|x| {
            let rectangle = PixelRect::within([64; 2], [x, 20], [1, 1]).expect("inside");
            (x, board.renderer.begin_pick(&board.buffers, &shot, rectangle).expect("expected a readback to start"))
        })
        .collect();
    board.renderer.draw(&board.buffers, &shot).expect("expected a frame");
    for (x, pick) in picks.into_iter().rev() {
        let hits = board.renderer.finish_pick(pick).expect("ends");
        assert!(off(hits[0].position, at(x, 20)) < NEAR, "{x}: {hits:?}");
    }
}

/// Normals that are zero or NaN give a zero normal.
#[test]
fn picks_of_rebased_scenes_and_bad_normals_are_finite() {
    let scene =
        SceneBuilder::new().add_domain(facing_rectangle(-1.0, -1.0, 1.0, 1.0, 0.0), Material::default()).build();
    let mut board = PickHarness::rest(&scene);
    let away = [1e7, 0.0, -1e7];
    board.buffers.set_origin(away);
    let view = View::LookAt { eye: [1e7, 0.0, 10.0 - 1e7], target: away, up: [0.0, 1.0, 0.0] };
    let hit = board.pick(Camera { view, ..front_camera(64) }, 64, [36, 30], [1, 1]).remove(0);
    let [x, y, _] = at(36, 30);
    assert!(off(hit.position, [1e7 + x, y, -1e7]) < 2e-6, "{hit:?}");
    board.buffers.set_origin([0.0; 3]);
    for normals in [[0.0_f32; 3], [f32::NAN; 3]] {
        let positions = scene.shapes[0].mesh.rest().as_flattened().to_vec();
        let surface =
            DeformedSurface { positions, normals: normals.repeat(4), tangents: vec![], ..DeformedSurface::default() };
        board.renderer.upload(&board.buffers, &surface).expect("expected the upload to succeed");
        let hit = board.pick(front_camera(64), 64, [30, 30], [1, 1]).remove(0);
        assert_eq!(hit.normal.map(f64::abs), [0.0; 3]);
    }
}

#[test]
fn tiny_triangle_near_the_camera_is_picked() {
    let mesh = Mesh::from_indexed(
        vec![[0.0, 0.0, 0.0], [1e-6, 0.0, 0.0], [0.0, 1e-6, 0.0]],
        vec![[0.0, 0.0, 1.0]; 3],
        vec![],
        vec![[0, 1, 2]],
    );
    let mut builder = SceneBuilder::new().add_domain(mesh.expect("expected a valid mesh"), Material::default());
    builder.parts.domains[0] = Domain { placement: Transform::IDENTITY, ..builder.parts.domains[0].clone() };
    let view = View::LookAt { eye: [2e-7, 2e-7, 2e-6], target: [2e-7, 2e-7, 0.0], up: [0.0, 1.0, 0.0] };
    let near = Camera { view, near: 1e-6, far: 1e9, ..front_camera(64) };
    let hit = PickHarness::rest(&builder.build()).pick(near, 64, [31, 31], [1, 1]).remove(0);
    assert!((hit.depth - 2e-6).abs() < 1e-12 && (hit.barycentrics.iter().sum::<f64>() - 1.0).abs() < 1e-12, "{hit:?}");
}
