//! Compares views of the CUDA view renderer with those of the reference.

use modalcast_compute::gpu::launch::DeviceBuffer;
use modalcast_compute::gpu::{CudaViewRenderer, Device, DeviceVertices};
use modalcast_compute::reference::views::ReferenceViewRenderer;
use modalcast_compute::testing::TestRng;
use modalcast_compute::testing::views::ViewFixture;
use modalcast_model::views::{View, ViewBatch, ViewFormat, ViewOutputs, ViewPictures};

const ALL_OUTPUTS: ViewOutputs = ViewOutputs { color: true, depth: true, domains: true, normals: true };

fn format(width: u32, height: u32) -> ViewFormat {
    ViewFormat { width, height, outputs: ALL_OUTPUTS, depth_scale: 0.5, depth_includes_ground: true }
}

/// Fractions of pixels that differ: domain; depth by more than 1e-4 of itself; color by more than `max_levels`; normal
/// by more than 1e-3.
fn differences(got: &ViewPictures, expected: &ViewPictures, max_levels: u8) -> [f64; 4] {
    let pixels = expected.domains.len();
    assert_eq!((got.domains.len(), got.depth.len()), (pixels, pixels));
    assert_eq!((got.color.len(), got.normals.len()), (3 * pixels, 3 * pixels));
    let fraction =
        |differs: &dyn Fn(usize) -> bool| (0..pixels).filter(|pixel| differs(*pixel)).count() as f64 / pixels as f64;
    let has_other_depth = |a: f32, b: f32| a.is_finite() != b.is_finite() || (a - b).abs() > 1e-4 * b.abs();
    [
        fraction(&|pixel| got.domains[pixel] != expected.domains[pixel]),
        fraction(&|pixel| has_other_depth(got.depth[pixel], expected.depth[pixel])),
        fraction(&|pixel| {
            (0..3).any(|channel| {
                got.color[3 * pixel + channel].abs_diff(expected.color[3 * pixel + channel]) > max_levels
            })
        }),
        fraction(&|pixel| {
            (0..3).any(|axis| (got.normals[3 * pixel + axis] - expected.normals[3 * pixel + axis]).abs() > 1e-3)
        }),
    ]
}

/// Views by a camera between the triangles, which clips some of them, and by cameras outside. All sizes have tiles of
/// one strip and of several strips, and widths that are no multiples of four.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_views_equal_the_reference() {
    let device = Device::open(0).expect("a CUDA device");
    let mut rng = TestRng(11);
    // The hardware filters images with weights of 8 bits. So samples at the edges of holes may differ, and highlights
    // on normal maps differ by some levels.
    for (has_images, limit, max_levels) in [(false, 0.0, 1), (true, 0.01, 8)] {
        let fixture = ViewFixture::new(5, has_images, &mut rng);
        let reference = ReferenceViewRenderer::new(fixture.scene.clone()).expect("a valid scene");
        let renderer = CudaViewRenderer::new(&device, &fixture.scene).expect("a renderer");
        let [positions, normals, tangents] = [&fixture.positions, &fixture.normals, &fixture.tangents]
            .map(|list| DeviceBuffer::upload(&device, list).expect("device memory"));
        let vertices = DeviceVertices::new(&positions, &normals, Some(&tangents)).expect("vertices");
        for (width, height) in [(64, 64), (37, 21), (128, 96)] {
            let views = fixture.views(&mut rng);
            let batch = ViewBatch { cameras: &fixture.cameras, views: &views, format: format(width, height) };
            let mut device_views = renderer.prepare(&batch).expect("a batch");
            renderer.draw(&vertices, &mut device_views).expect("a draw");
            let pictures = device_views.read(&device).expect("pictures");
            let expected = reference.draw(&fixture.vertices(), &batch).expect("pictures");
            let [domains, depth, color, normals] = differences(&pictures, &expected, max_levels);
            println!("{width} x {height}, images {has_images}: {domains:.5} {depth:.5} {color:.5} {normals:.5}");
            assert!(domains <= limit && depth <= limit + 1e-4 && color <= limit + 1e-4 && normals <= limit + 1e-4);
            let other_views: Vec<View> =
                views.iter().map(|view| View { world: (view.world + 1) % 5, ..*view }).collect();
            let other = reference.draw(&fixture.vertices(), &ViewBatch { views: &other_views, ..batch });
            let differences_of_worlds = differences(&pictures, &other.expect("pictures"), max_levels);
            assert!(differences_of_worlds.iter().all(|fraction| *fraction > 0.05), "{differences_of_worlds:?}");
        }
    }
}
