//! A pick returns the surface points in a rectangle of pixels. Triangles, barycentric coordinates and positions of hits
//! equal values that the tests compute.

use std::sync::Arc;

use modalcast_compute::reference::ReferenceDeformer;
use modalcast_model::deform::{DeformedSurface, Deformer as _};
use modalcast_model::domain::{AlphaMode, Material, Mesh, Modes, Shape};
use modalcast_model::scene::{BoundingBox, Camera, Ground, Lens, PixelRect, Scene, SceneState, View};
use modalcast_render::{FrameParams, PickHit, Renderer, SceneBuffers, VisibilityId};
use nalgebra::Vector3;

use super::harness::{SceneBuilder, facing_rectangle, floor_mesh, front_camera, open_renderer};

/// Tolerance of hit positions in scene units. Hits are computed in f64, and only the vertices are rounded to f32.
const TOLERANCE: f64 = 1e-6;

struct PickHarness {
    renderer: Renderer,
    buffers: SceneBuffers,
    bounds: BoundingBox,
}

impl PickHarness {
    fn with_state(scene: &Arc<Scene>, state: &SceneState) -> Self {
        let mut renderer = open_renderer();
        let mut deformer = ReferenceDeformer::new(scene);
        let bounds = deformer.deform(state).expect("expected the step to succeed").bounds;
        let buffers = renderer.load(scene).expect("expected the scene to load");
        renderer
            .upload(&buffers, deformer.surface().expect("expected a surface"))
            .expect("expected the upload to succeed");
        Self { renderer, buffers, bounds }
    }

    fn at_rest(scene: &Arc<Scene>) -> Self {
        Self::with_state(scene, &SceneState::rest(scene))
    }

    fn frame_params(&self, camera: Camera, size: u32) -> FrameParams {
        FrameParams {
            camera,
            width: size,
            height: size,
            bounds: self.bounds,
            light_bounds: None,
            edges: None,
            samples: None,
        }
    }

    /// Hits in a rectangle of `size` pixels, with `corner` as its top left pixel, of a square image with side
    /// `image_size`.
    fn pick(&mut self, camera: Camera, image_size: u32, corner: [u32; 2], size: [u32; 2]) -> Vec<PickHit> {
        let rectangle = PixelRect::within([image_size; 2], corner, size).expect("expected a valid rectangle");
        let frame_params = self.frame_params(camera, image_size);
        let pick = self.renderer.begin_pick(&self.buffers, &frame_params, rectangle).expect("expected a pick to start");
        self.renderer.finish_pick(pick).expect("expected hits")
    }
}

/// Largest difference of two vectors in any component.
fn max_difference(left: [f64; 3], right: [f64; 3]) -> f64 {
    (Vector3::from(left) - Vector3::from(right)).abs().max()
}

/// Intersection of the plane z = 0 with the ray through the center of a pixel of [`front_camera`]`(64)`, which has ten
/// pixels per unit there.
fn plane_point(x: u32, y: u32) -> [f64; 3] {
    [(f64::from(x) + 0.5 - 32.0) / 10.0, (32.0 - f64::from(y) - 0.5) / 10.0, 0.0]
}

#[test]
fn pick_has_domain_triangle_position_normal_and_depth() {
    let builder = SceneBuilder::new().add_domain(facing_rectangle(-3.0, -3.0, -2.5, -2.5, 0.0), Material::default());
    let scene = builder.add_domain(facing_rectangle(-2.0, -1.0, 2.0, 1.0, 0.0), Material::default()).build();
    // The pixel shows domain 1.
    let hits = PickHarness::at_rest(&scene).pick(front_camera(64), 64, [40, 30], [1, 1]);
    let [hit] = &hits[..] else { panic!("expected one hit, got {hits:?}") };
    let [x, y, _] = plane_point(40, 30);
    assert_eq!((hit.pixel, hit.domain, hit.triangle, hit.vertices), ([40, 30], 1, 0, [0, 1, 2]));
    assert!(
        max_difference(hit.position, [x, y, 0.0]) < TOLERANCE
            && max_difference(hit.normal, [0.0, 0.0, 1.0]) < TOLERANCE,
        "{hit:?}"
    );
    assert!((hit.depth - 10.0).abs() < TOLERANCE);
    // The triangle has the corners (-2, -1), (2, -1) and (2, 1). The barycentric coordinates sum to 1.
    let [first_weight, third_weight] = [(2.0 - x) / 4.0, (y + 1.0) / 2.0];
    assert!(
        max_difference(hit.barycentrics, [first_weight, 1.0 - first_weight - third_weight, third_weight]) < TOLERANCE,
        "{hit:?}"
    );
}

/// A hit on the back side has a flipped normal.
#[test]
fn mirrored_domains_keep_vertex_order_in_picks() {
    let double_sided = Material { double_sided: true, ..Material::default() };
    let mut builder = SceneBuilder::new().add_domain(facing_rectangle(-2.0, -1.0, 2.0, 1.0, 0.0), double_sided);
    builder.parts.domains[0].placement.0[0] = -1.0; // mirrors x
    let scene = builder.build();
    let mut harness = PickHarness::at_rest(&scene);
    let hit = harness.pick(front_camera(64), 64, [24, 34], [1, 1]).remove(0);
    // The barycentric coordinates are those of `pick_has_domain_triangle_position_normal_and_depth`, with -x for x.
    let [x, y, _] = plane_point(24, 34);
    assert_eq!(hit.vertices, [0, 1, 2]);
    assert!(
        max_difference(hit.barycentrics, [(2.0 + x) / 4.0, 1.0 - (2.0 + x) / 4.0 - (y + 1.0) / 2.0, (y + 1.0) / 2.0])
            < TOLERANCE
    );
    let view_from_behind = View::LookAt { eye: [0.0, 0.0, -10.0], target: [0.0; 3], up: [0.0, 1.0, 0.0] };
    for (view, z) in [(front_camera(64).view, 1.0), (view_from_behind, -1.0)] {
        let hit = harness.pick(Camera { view, ..front_camera(64) }, 64, [30, 30], [1, 1]).remove(0);
        assert!(max_difference(hit.normal, [0.0, 0.0, z]) < TOLERANCE, "{hit:?}");
    }
}

#[test]
fn pick_follows_the_deformed_surface() {
    let mesh = facing_rectangle(-1.0, -1.0, 1.0, 1.0, 0.0);
    // One mode, which moves the four vertices along z. Its column has the rows x, y and z of each vertex.
    let column = (0..12).map(|row| if row % 3 == 2 { 1.0 } else { 0.0 }).collect();
    let mut builder = SceneBuilder::new().add_domain(mesh.clone(), Material::default());
    builder.parts.shapes[0] = Shape::new(mesh, Modes::from_columns(12, 1, column).expect("expected valid modes"))
        .expect("expected a valid shape");
    let scene = builder.build();
    let mut state = SceneState::rest(&scene);
    for q in [0.0, 2.0, -3.0_f32] {
        state.q[0] = q;
        let hit = PickHarness::with_state(&scene, &state).pick(front_camera(64), 64, [36, 27], [1, 1]).remove(0);
        let (z, [x, y, _]) = (f64::from(q), plane_point(36, 27));
        // The ray from the eye at (0, 0, 10) through (x, y, 0) intersects the mesh, which is now in the plane of this
        // z.
        let expected = [x * (10.0 - z) / 10.0, y * (10.0 - z) / 10.0, z];
        assert!(
            max_difference(hit.position, expected) < TOLERANCE && (hit.depth - 10.0 + z).abs() < TOLERANCE,
            "{q}: {hit:?}"
        );
    }
}

/// Four pick rectangles cover the image. The first one has the maximum side of a pick, 64 pixels.
#[test]
fn picks_agree_with_the_visibility_of_the_frame() {
    let mut builder = SceneBuilder::new();
    builder.parts.look.samples = 1;
    builder.parts.look.ground = Some(Ground::default());
    let image = builder.add_texture(8, 8, |x, y| [200, 200, 200, if (x + y) % 2 == 0 { 255 } else { 0 }]);
    let cut_out_material =
        Material { alpha_mode: AlphaMode::Mask { cutoff: 0.5 }, color_texture: Some(image), ..Material::default() };
    let scene = builder
        .add_domain(floor_mesh(3.0, 0.0), Material::default())
        .add_domain(facing_rectangle(-1.5, 0.3, 1.5, 2.5, 0.4), cut_out_material)
        .add_domain(facing_rectangle(-0.9, 0.2, 2.0, 1.1, -0.7), Material::default())
        .build();
    let mut harness = PickHarness::at_rest(&scene);
    let view = View::LookAt { eye: [3.0, 4.0, 9.0], target: [0.2, 0.5, 0.0], up: [0.0, 1.0, 0.0] };
    for lens in [Lens::FieldOfView(40.0), Lens::Intrinsics { fx: 120.0, fy: 130.0, cx: 50.0, cy: 44.0 }] {
        // Clip planes of 0 are fitted to the bounds.
        let camera = Camera { view, lens, near: 0.0, far: 0.0 };
        let frame_params = harness.frame_params(camera, 100);
        harness.renderer.draw(&harness.buffers, &frame_params).expect("expected a frame");
        let frame_ids = harness.renderer.read_visibility().expect("expected visibility ids");
        let (mut mismatches, mut misses, mut hits_per_domain) = (0, 0, [0; 3]);
        for (corner, size) in [([0, 0], [64, 64]), ([64, 0], [36, 64]), ([0, 64], [64, 36]), ([64, 64], [36, 36])] {
            let hits = harness.pick(camera, 100, corner, size);
            for y in corner[1]..corner[1] + size[1] {
                for x in corner[0]..corner[0] + size[0] {
                    // As (domain, triangle of the domain).
                    let visible_triangle = match frame_ids[(100 * y + x) as usize] {
                        VisibilityId::Triangle(index) => harness.buffers.source_triangle(index),
                        _ => None,
                    };
                    let hit = hits.iter().find(|hit| hit.pixel == [x, y]);
                    mismatches += usize::from(hit.map(|hit| (hit.domain, hit.triangle)) != visible_triangle);
                    misses += usize::from(hit.is_none());
                    hit.into_iter().for_each(|hit| hits_per_domain[hit.domain] += 1);
                }
            }
        }
        // Ids may differ where an edge passes a sample within the rasterizer's precision of 1/256 pixel.
        assert!(mismatches <= 5, "expected at most 5 different pixels of 10000, got {mismatches}");
        assert!(
            misses > 500 && hits_per_domain.iter().all(|count| *count > 100),
            "negative control: expected misses and hits of all domains, got {misses} misses, hits {hits_per_domain:?}"
        );
    }
}

/// A pick through a hole hits the surface behind it.
#[test]
fn holes_glass_sky_and_ground_are_not_hit() {
    let mut builder = SceneBuilder::new();
    let image = builder.add_texture(2, 1, |x, _| [200, 200, 200, if x == 0 { 255 } else { 0 }]);
    let cut_out_material =
        Material { alpha_mode: AlphaMode::Mask { cutoff: 0.5 }, color_texture: Some(image), ..Material::default() };
    let glass_material = Material { alpha_mode: AlphaMode::Blend, alpha: 0.9, ..Material::default() };
    // Domain 0 is a cut-out whose left half is solid and whose right half is a hole. Domain 1 is opaque and lies behind
    // the lower half of the cut-out. Domain 2 is glass and lies in front of the upper half.
    let scene = builder
        .add_domain(facing_rectangle(-2.0, -2.0, 2.0, 2.0, 0.0), cut_out_material)
        .add_domain(facing_rectangle(-2.0, -2.0, 2.0, 0.0, -1.0), Material::default())
        .add_domain(facing_rectangle(-2.0, 0.0, 2.0, 2.0, 1.0), glass_material)
        .build();
    let mut harness = PickHarness::at_rest(&scene);
    let mut picked_domain =
        |x: u32, y: u32| harness.pick(front_camera(64), 64, [x, y], [1, 1]).first().map(|hit| hit.domain);
    // Solid half behind glass, hole behind glass, hole in front of domain 1, sky.
    assert_eq!(
        [picked_domain(22, 22), picked_domain(42, 22), picked_domain(42, 42), picked_domain(2, 2)],
        [Some(0), None, Some(1), None]
    );
    let camera = Camera {
        view: View::LookAt { eye: [0.0, 2.0, 10.0], target: [0.0, -3.0, 0.0], up: [0.0, 1.0, 0.0] },
        ..front_camera(64)
    };
    let mut builder = SceneBuilder::new();
    builder.parts.look.ground = Some(Ground::default());
    let scene = builder.add_domain(facing_rectangle(-1.0, 0.0, 1.0, 1.0, 0.0), Material::default()).build();
    assert!(
        PickHarness::at_rest(&scene).pick(camera, 64, [32, 60], [1, 1]).is_empty(),
        "expected no hit on the ground"
    );
}

#[test]
fn concurrent_picks_finish_in_any_order() {
    let scene =
        SceneBuilder::new().add_domain(facing_rectangle(-3.0, -3.0, 3.0, 3.0, 0.0), Material::default()).build();
    let mut harness = PickHarness::at_rest(&scene);
    let frame_params = harness.frame_params(front_camera(64), 64);
    let pending_picks: Vec<_> = (10..50)
        .map(|x| {
            let rectangle = PixelRect::within([64; 2], [x, 20], [1, 1]).expect("expected a valid rectangle");
            (
                x,
                harness
                    .renderer
                    .begin_pick(&harness.buffers, &frame_params, rectangle)
                    .expect("expected a pick to start"),
            )
        })
        .collect();
    harness.renderer.draw(&harness.buffers, &frame_params).expect("expected a frame");
    for (x, pick) in pending_picks.into_iter().rev() {
        let hits = harness.renderer.finish_pick(pick).expect("expected hits");
        assert!(max_difference(hits[0].position, plane_point(x, 20)) < TOLERANCE, "{x}: {hits:?}");
    }
}

/// The shared origin is the point that uploaded positions are relative to. Hits are in world coordinates. Vertex
/// normals of zero or NaN give hits with a zero normal.
#[test]
fn picks_with_a_distant_origin_or_bad_normals_are_finite() {
    let scene =
        SceneBuilder::new().add_domain(facing_rectangle(-1.0, -1.0, 1.0, 1.0, 0.0), Material::default()).build();
    let mut harness = PickHarness::at_rest(&scene);
    let origin = [1e7, 0.0, -1e7];
    harness.buffers.set_shared_origin(origin);
    let view = View::LookAt { eye: [1e7, 0.0, 10.0 - 1e7], target: origin, up: [0.0, 1.0, 0.0] };
    let hit = harness.pick(Camera { view, ..front_camera(64) }, 64, [36, 30], [1, 1]).remove(0);
    let [x, y, _] = plane_point(36, 30);
    // Twice the tolerance, because rays at coordinates of 1e7 also have rounding errors in f64.
    assert!(max_difference(hit.position, [1e7 + x, y, -1e7]) < 2.0 * TOLERANCE, "{hit:?}");
    harness.buffers.set_shared_origin([0.0; 3]);
    for vertex_normal in [[0.0_f32; 3], [f32::NAN; 3]] {
        let positions = scene.shapes[0].mesh.rest_positions().as_flattened().to_vec();
        let surface = DeformedSurface {
            positions,
            normals: vertex_normal.repeat(4),
            tangents: vec![],
            ..DeformedSurface::default()
        };
        harness.renderer.upload(&harness.buffers, &surface).expect("expected the upload to succeed");
        let hit = harness.pick(front_camera(64), 64, [30, 30], [1, 1]).remove(0);
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
    let builder = SceneBuilder::new().add_domain(mesh.expect("expected a valid mesh"), Material::default());
    let view = View::LookAt { eye: [2e-7, 2e-7, 2e-6], target: [2e-7, 2e-7, 0.0], up: [0.0, 1.0, 0.0] };
    let camera = Camera { view, near: 1e-6, far: 1e9, ..front_camera(64) };
    let hit = PickHarness::at_rest(&builder.build()).pick(camera, 64, [31, 31], [1, 1]).remove(0);
    assert!((hit.depth - 2e-6).abs() < 1e-12 && (hit.barycentrics.iter().sum::<f64>() - 1.0).abs() < 1e-12, "{hit:?}");
}
