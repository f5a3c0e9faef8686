//! The reference rasterizer draws the triangle ids that OpenGL draws. Ids may differ only where two triangles have
//! equal depth, and where a sample lies on an edge.

use std::sync::Arc;

use modalcast_compute::reference::ReferenceDeformer;
use modalcast_compute::reference::raster::VisibilityBuffer;
use modalcast_model::deform::Deformer as _;
use modalcast_model::domain::{Material, Mesh};
use modalcast_model::scene::{Camera, CullMode, Culling, DrawRange, Lens, Scene, SceneState, View, Viewport};
use modalcast_render::{FrameParams, VisibilityId};
use nalgebra::Matrix4;

use super::harness::{SceneBuilder, open_renderer};
use crate::common::exact_triangle::{ExactTriangle, compare_ids};
use crate::scenes::Random;

/// Width and height of a frame in pixels.
const SIZE: [u32; 2] = [320, 240];
/// Depths with at most this difference count as equal: one rounding step of 2^-24 for each of the two rasterizers.
const DEPTH_TOLERANCE: f64 = 2.0 / (1 << 24) as f64;

/// A scene of one domain with triangles of many sizes, some of them behind the eye. Also returns the vertex indices of
/// the triangles.
fn random_scene(seed: u64) -> (Arc<Scene>, Vec<[u32; 3]>) {
    let mut random = Random(seed);
    let mut positions = Vec::new();
    for index in 0..1500 {
        let size = match index % 4 {
            0 => 0.02,
            1 => 0.1,
            2 => 0.5,
            // One triangle in 60.
            _ if index % 60 == 3 => 3.0,
            // The triangle has no area.
            _ => 0.0,
        };
        // `next_triple` gives three numbers from -1 to 1.
        let center = random.next_triple().map(|number| 3.0 * number);
        for _ in 0..3 {
            let offset = random.next_triple();
            positions.push(std::array::from_fn(|axis| center[axis] + size * offset[axis]));
        }
    }
    let triangles: Vec<[u32; 3]> =
        (0..positions.len() as u32 / 3).map(|index| [3 * index, 3 * index + 1, 3 * index + 2]).collect();
    let vertex_count = positions.len();
    let normals = vec![[0.0, 0.0, 1.0]; vertex_count];
    let mesh = Mesh::from_indexed(positions, normals, vec![[0.0; 2]; vertex_count], triangles.clone())
        .expect("expected a valid mesh");
    let mut builder = SceneBuilder::new();
    (builder.parts.look.samples, builder.parts.look.culling) = (1, Culling::None);
    (builder.add_domain(mesh, Material { double_sided: true, ..Material::default() }).build(), triangles)
}

#[test]
fn ids_equal_opengl_except_on_edges_and_depth_ties() {
    let mut renderer = open_renderer();
    for (seed, eye) in [(1, [0.0, 0.5, 9.0]), (2, [0.3, 0.2, 0.5]), (3, [-6.0, 4.0, 2.0])] {
        let (scene, triangles) = random_scene(seed);
        let view = View::LookAt { eye, target: [0.0; 3], up: [0.0, 1.0, 0.0] };
        let camera = Camera { view, lens: Lens::FieldOfView(50.0), near: 0.1, far: 40.0 };
        let mut deformer = ReferenceDeformer::new(&scene);
        let bounds = deformer.deform(&SceneState::rest(&scene)).expect("expected the step to succeed").bounds;
        let surface = deformer.surface().expect("expected a surface").clone();
        let buffers = renderer.load(&scene).expect("expected the scene to load");
        renderer.upload(&buffers, &surface).expect("expected the upload to succeed");
        let [width, height] = SIZE;
        renderer
            .draw(
                &buffers,
                &FrameParams { camera, width, height, bounds, light_bounds: None, edges: None, samples: None },
            )
            .expect("expected a frame");
        assert_eq!(renderer.stats().samples, 1);
        // The index that a visible triangle has in the mesh.
        let triangle_index = |id: &VisibilityId| match id {
            VisibilityId::Triangle(index) => buffers.source_triangle(*index).map(|(_, triangle)| triangle as u32),
            _ => None,
        };
        let opengl_ids: Vec<Option<u32>> =
            renderer.read_visibility().expect("expected visibility ids").iter().map(triangle_index).collect();
        renderer.unload(buffers);

        let clip = camera.clip_from_camera(width, height, &bounds) * camera.camera_from_world();
        let corner = |vertex: u32| std::array::from_fn(|axis| surface.positions[3 * vertex as usize + axis]);
        let exact_triangles: Vec<ExactTriangle> =
            triangles.iter().map(|triangle| ExactTriangle::new(&clip, SIZE, triangle.map(corner))).collect();
        let rasterize_ids = |clip: &Matrix4<f64>| {
            let mut raster =
                VisibilityBuffer::new(Viewport::new(clip, width, height).expect("expected a valid viewport"));
            let all_triangles =
                DrawRange { first_triangle: 0, triangle_count: triangles.len() as u32, cull_mode: CullMode::None };
            raster.draw(&surface.positions, &triangles, all_triangles);
            raster.ids()
        };
        let differences = compare_ids(&rasterize_ids(&clip), &opengl_ids, &exact_triangles, SIZE[0], DEPTH_TOLERANCE);
        let covered_samples = opengl_ids.iter().flatten().count();
        eprintln!("eye {eye:?}: {covered_samples} covered samples, {differences:?}");
        // `wrong` counts different ids that neither an edge nor a depth tie explains.
        assert!(covered_samples > 5000 && differences.wrong == 0, "{covered_samples} covered samples, {differences:?}");
        assert!(differences.edges + differences.ties < covered_samples / 100, "{differences:?}");

        // The image is 2 wide in normalized device coordinates, so a pixel is 2 / width, and this shift 1/20 pixel.
        let mut shift = Matrix4::identity();
        shift[(0, 3)] = 0.1 / f64::from(width);
        let shifted_differences =
            compare_ids(&rasterize_ids(&(shift * clip)), &opengl_ids, &exact_triangles, SIZE[0], DEPTH_TOLERANCE);
        assert!(shifted_differences.wrong > 5, "negative control, shifted by 1/20 pixel: {shifted_differences:?}");
    }
}
