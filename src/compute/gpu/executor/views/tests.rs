use super::{
    CHUNK_TRIANGLES, CudaViewRenderer, DeviceVertices, FUNCTIONS, MAX_TILE_PIXELS, SOURCE, tile_layout, triangle_chunks,
};
use crate::gpu::launch::{CAPABILITIES, CompiledVariant, Device, DeviceBuffer};
use crate::testing::TestRng;
use crate::testing::views::ViewFixture;
use modalcast_model::scene::CullMode;
use modalcast_model::views::{View, ViewBatch, ViewFormat, ViewOutputs};

const ALL_OUTPUTS: ViewOutputs = ViewOutputs { color: true, depth: true, domains: true, normals: true };

fn format(width: u32, height: u32) -> ViewFormat {
    ViewFormat { width, height, outputs: ALL_OUTPUTS, depth_scale: 0.5, depth_includes_ground: true }
}

#[test]
fn strips_fit_shared_memory_and_cover_a_view_once() {
    for (width, height) in
        [(1, 1), (64, 64), (64, 65), (84, 84), (128, 128), (900, 9), (1024, 1024), (1024, 1), (1, 1024)]
    {
        let [tile_height, tiles] = tile_layout(&format(width, height));
        assert!(width * tile_height <= MAX_TILE_PIXELS, "{width} x {height}");
        assert!(tiles * tile_height >= height && (tiles - 1) * tile_height < height, "{width} x {height}");
    }
    assert_eq!(tile_layout(&format(64, 64)), [64, 1]);
    assert_eq!(tile_layout(&format(128, 128)), [32, 4]);
}

#[test]
fn chunks_cover_each_triangle_once_with_its_cull_mode() {
    let mut scene = ViewFixture::new(1, true, &mut TestRng(1)).scene;
    // The first cut-out is inside of a group.
    scene.cut_outs.as_mut().expect("cut-outs").first = 95;
    let chunks = triangle_chunks(&scene);
    let mut next = 0;
    for chunk in &chunks {
        assert_eq!(chunk.first_triangle, next);
        assert!((1..=CHUNK_TRIANGLES).contains(&chunk.triangle_count), "{chunk:?}");
        let triangles = next..next + chunk.triangle_count;
        assert!(!(triangles.start < 95 && triangles.end > 95), "expected no chunk with some cut-outs, got {chunk:?}");
        for triangle in triangles {
            assert_eq!(chunk.culls_back_faces == 1, scene.cull_mode(triangle) == CullMode::Back);
        }
        next += chunk.triangle_count;
    }
    assert_eq!(next as usize, scene.triangle_vertices.len());
}

/// The kernel may spill registers: on an H200, four resident blocks with spills draw 1.5 times as many views as two
/// blocks without.
#[test]
#[ignore = "needs NVRTC: deploy/check installs it"]
fn nvrtc_compiles_every_view_variant() {
    let variants: [&[&str]; 6] = [
        &[],
        &["CUT_OUTS"],
        &["TEXTURES"],
        &["TEXTURES", "NORMAL_MAPS"],
        &["CUT_OUTS", "TEXTURES"],
        &["CUT_OUTS", "TEXTURES", "NORMAL_MAPS"],
    ];
    let largest_variant = variants[variants.len() - 1];
    let jobs = variants.map(|defines| (defines, (9, 0))).into_iter();
    for (defines, capability) in jobs.chain(CAPABILITIES.map(|capability| (largest_variant, capability))) {
        let compiled = CompiledVariant::new(FUNCTIONS[0], SOURCE, defines, capability);
        for function in FUNCTIONS {
            assert!(compiled.log.contains(&format!("'{function}'")), "expected {function} in: {}", compiled.log);
        }
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_culling_changes_no_pixel() {
    let device = Device::open(0).expect("a CUDA device");
    let mut rng = TestRng(13);
    let fixture = ViewFixture::new(3, true, &mut rng);
    let renderer = CudaViewRenderer::new(&device, &fixture.scene).expect("a renderer");
    let [positions, normals, tangents] = [&fixture.positions, &fixture.normals, &fixture.tangents]
        .map(|list| DeviceBuffer::upload(&device, list).expect("device memory"));
    let vertices = DeviceVertices::new(&positions, &normals, Some(&tangents)).expect("vertices");
    let views = fixture.views(&mut rng);
    let batch = ViewBatch { cameras: &fixture.cameras, views: &views, format: format(128, 96) };
    let mut device_views = renderer.prepare(&batch).expect("a batch");
    let mut draw = |boxes: Option<DeviceBuffer>| {
        device_views.boxes = boxes;
        renderer.draw(&vertices, &mut device_views).expect("a draw");
        device_views.read(&device).expect("pictures")
    };
    let pictures = draw(None);
    let box_bytes = 24 * 3 * renderer.tables.chunk_count as u64;
    let boxes = DeviceBuffer::zeroed(&device, box_bytes).expect("device memory");
    assert!(draw(Some(boxes)) == pictures, "expected equal pictures");
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_views_of_missing_worlds_are_rejected() {
    let device = Device::open(0).expect("a CUDA device");
    let fixture = ViewFixture::new(2, false, &mut TestRng(5));
    let renderer = CudaViewRenderer::new(&device, &fixture.scene).expect("a renderer");
    let [positions, normals] =
        [&fixture.positions, &fixture.normals].map(|list| DeviceBuffer::upload(&device, list).expect("device memory"));
    let vertices = DeviceVertices::new(&positions, &normals, None).expect("vertices");
    let draw = |world| {
        let views = [View { camera: 0, world }];
        let batch = ViewBatch { cameras: &fixture.cameras, views: &views, format: format(8, 8) };
        renderer.draw(&vertices, &mut renderer.prepare(&batch).expect("a batch"))
    };
    assert_eq!(draw(1), Ok(()));
    assert!(draw(2).is_err_and(|error| error.to_string().starts_with("views.positions: ")));
}
