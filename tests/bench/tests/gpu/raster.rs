//! Compares the CUDA rasterizer with its CPU definition on triangle soups (lists of triangles). Samples are
//! bit-identical with every granularity: threads draw small triangles and warps draw medium ones (`BySize`), warps draw
//! both (`Warps`), or all triangles are divided into tiles (`Tiles`).

use modalcast_bench::kernels::{KernelBenchmark as _, RasterBenchmark, RasterCounts, RasterMesh};
use modalcast_bench::render::workloads::RenderWorkload;
use modalcast_bench::render::{RenderReportOptions, Size, compare_rasterizers};
use modalcast_compute::gpu::{Device, RasterGranularity, RasterVariant};
use modalcast_compute::reference::raster::{CullReason, clipped_polygon};

use crate::soups::{Soup, all_soups};

fn launch_raster(device: &Device, soup: &Soup, variant: RasterVariant) -> RasterBenchmark {
    let mesh =
        RasterMesh { positions: &soup.positions, triangles: &soup.triangles, groups: &soup.groups, cut_outs: None };
    let raster = RasterBenchmark::new(device, mesh, soup.viewport, variant).expect("expected a rasterizer");
    // Launch twice, to check that queues and samples of the first launch are cleared.
    (0..2).for_each(|_| raster.launch(device, 0).expect("a launch"));
    raster
}

/// Number of triangles that the CPU definition drops, by reason in the order of [`RasterCounts`], and number of
/// triangles that it draws.
fn count_expected_triangles(soup: &Soup) -> ([u32; 5], u32) {
    let (mut counts_by_reason, mut drawn) = ([0; 5], 0);
    // A group is a range of triangles with one cull mode.
    for group in &soup.groups {
        for triangle in &soup.triangles[group.first_triangle as usize..][..group.triangle_count as usize] {
            match clipped_polygon(&soup.viewport, &soup.positions, *triangle, group.cull_mode) {
                Ok(_) => drawn += 1,
                Err(CullReason::NotFinite) => counts_by_reason[0] += 1,
                Err(CullReason::OutsideFrustum) => counts_by_reason[1] += 1,
                Err(CullReason::Degenerate) => counts_by_reason[2] += 1,
                Err(CullReason::BackFacing) => counts_by_reason[3] += 1,
                Err(CullReason::NoSample) => counts_by_reason[4] += 1,
            }
        }
    }
    (counts_by_reason, drawn)
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_samples_match_definition_at_every_granularity() {
    let device = Device::open(0).expect("expected a CUDA device");
    for soup in all_soups() {
        let definition = soup.rasterize();
        for granularity in [RasterGranularity::BySize, RasterGranularity::Warps, RasterGranularity::Tiles] {
            for count_triangles in [false, true] {
                let variant = RasterVariant { granularity, count_triangles, ..RasterVariant::default() };
                // The key of a sample holds its depth (upper 32 bits) and its triangle (lower 32 bits).
                let keys = launch_raster(&device, &soup, variant).keys(&device).expect("expected the id keys");
                let differing = keys.iter().zip(&definition.keys).filter(|(key, expected)| key != expected).count();
                assert_eq!(differing, 0, "{} with {variant:?}: expected {} equal samples", soup.name, keys.len());
            }
        }
        let variant = RasterVariant { depth_only: true, ..RasterVariant::default() };
        let to_bits = |depths: Vec<f32>| depths.into_iter().map(f32::to_bits).collect::<Vec<_>>();
        let depths = launch_raster(&device, &soup, variant).depths(&device).expect("depths");
        assert!(
            to_bits(depths) == to_bits(definition.depths()),
            "{}: expected equal depths if only depth is drawn",
            soup.name
        );
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_counts_every_triangle_once_at_every_granularity() {
    let device = Device::open(0).expect("expected a CUDA device");
    let mut totals_by_size = [0; 3];
    for soup in all_soups() {
        for granularity in [RasterGranularity::BySize, RasterGranularity::Warps, RasterGranularity::Tiles] {
            let variant = RasterVariant { count_triangles: true, granularity, ..RasterVariant::default() };
            let counts = launch_raster(&device, &soup, variant).counts(&device).expect("counts");
            let RasterCounts { small, medium, large, not_finite, outside, flat, back, missed } = counts;
            let (expected_dropped, expected_drawn) = count_expected_triangles(&soup);
            assert_eq!([not_finite, outside, flat, back, missed], expected_dropped, "{}", soup.name);
            assert_eq!(small + medium + large, expected_drawn, "{}", soup.name);
            match granularity {
                RasterGranularity::BySize => {
                    totals_by_size = [totals_by_size[0] + small, totals_by_size[1] + medium, totals_by_size[2] + large]
                }
                RasterGranularity::Warps => assert_eq!(small, 0),
                RasterGranularity::Tiles => assert_eq!(small + medium, 0),
            }
        }
    }
    assert!(
        totals_by_size.iter().all(|triangles| *triangles > 10),
        "expected more than 10 triangles of every size class, got {totals_by_size:?}"
    );
    // Any soup with drawn triangles.
    let counts = launch_raster(&device, &all_soups()[1], RasterVariant::default()).counts(&device).expect("counts");
    assert_eq!(counts, RasterCounts::default(), "expected zeros without `count_triangles`");
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_ids_of_scenes_match_opengl_and_both_are_timed() {
    let options = RenderReportOptions {
        loads: vec![RenderWorkload::Square, RenderWorkload::Triangles(50_000)],
        plants: vec![],
        variants: vec![],
        size: Size { width: 640, height: 360 },
        quick: true,
        replays: 20,
    };
    let report = compare_rasterizers(&options, |_| {}).expect("expected a report");
    report.rows.iter().for_each(|row| eprintln!("{}", row.line()));
    // The two workloads, and the two that every report has: a room, and a screen of two triangles that fill the frame.
    assert_eq!(report.rows.len(), 4);
    for row in &report.rows {
        let passes = row.passes.unwrap_or_else(|| panic!("expected a timed row, got {row:?}"));
        assert!(passes.depth.ratio() > 0.0 && passes.visibility.ratio() > 0.0);
        assert!(row.in_frame.small + row.in_frame.medium + row.in_frame.large > 0, "{row:?}");
    }
    let triangle_counts = |name: &str| report.rows.iter().find(|row| row.load == name).expect("a row").in_frame;
    assert!(
        triangle_counts("room").dropped > 1000,
        "room: expected many dropped triangles behind the eye, got {:?}",
        triangle_counts("room")
    );
    assert_eq!(triangle_counts("screen").large, 2);
}
