//! The CUDA rasterizer against its definition: bit-identical samples on every path.

use modalcast_bench::kernels::{KernelBenchmark as _, RasterBenchmark, RasterCounts, RasterMesh};
use modalcast_bench::render::workloads::RenderWorkload;
use modalcast_bench::render::{RenderReportOptions, Size, rasters};
use modalcast_compute::gpu::{Device, RasterGranularity, RasterVariant};
use modalcast_compute::reference::raster::{CullReason, clipped_polygon};

use crate::soups::{Soup, all_soups};

fn launched(device: &Device, soup: &Soup, form: RasterVariant) -> RasterBenchmark {
    let mesh =
        RasterMesh { positions: &soup.positions, triangles: &soup.triangles, groups: &soup.groups, cut_outs: None };
    let raster = RasterBenchmark::new(device, mesh, soup.viewport, form).expect("expected a rasterizer");
    // Twice, to check that queues and samples of the first launch are cleared.
    (0..2).for_each(|_| raster.launch(device, 0).expect("launches"));
    raster
}

/// Triangles that the definition drops, by reason, and the number that it draws.
fn dropped(soup: &Soup) -> ([u32; 5], u32) {
    let (mut counts, mut drawn) = ([0; 5], 0);
    for group in &soup.groups {
        for triangle in &soup.triangles[group.first as usize..][..group.triangles as usize] {
            match clipped_polygon(&soup.viewport, &soup.positions, *triangle, group.cull_mode) {
                Ok(_) => drawn += 1,
                Err(CullReason::NotFinite) => counts[0] += 1,
                Err(CullReason::OutsideFrustum) => counts[1] += 1,
                Err(CullReason::Degenerate) => counts[2] += 1,
                Err(CullReason::BackFacing) => counts[3] += 1,
                Err(CullReason::NoSample) => counts[4] += 1,
            }
        }
    }
    (counts, drawn)
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_samples_match_the_definition_bitwise_on_every_path() {
    let device = Device::open(0).expect("expected a CUDA device");
    for soup in all_soups() {
        let want = soup.rasterize();
        for granularity in [RasterGranularity::BySize, RasterGranularity::Warps, RasterGranularity::Tiles] {
            for count_triangles in [false, true] {
                let form = RasterVariant { granularity, count_triangles, ..RasterVariant::default() };
                let keys = launched(&device, &soup, form).keys(&device).expect("expected the id keys");
                let wrong = keys.iter().zip(&want.keys).filter(|(got, want)| got != want).count();
                assert_eq!(wrong, 0, "{} by {form:?}: of {} samples", soup.name, keys.len());
            }
        }
        let form = RasterVariant { depth_only: true, ..RasterVariant::default() };
        let bits = |depths: Vec<f32>| depths.into_iter().map(f32::to_bits).collect::<Vec<_>>();
        let depths = launched(&device, &soup, form).depths(&device).expect("depths");
        assert!(bits(depths) == bits(want.depths()), "{}: depth alone", soup.name);
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_counts_every_triangle_once_and_takes_every_path() {
    let device = Device::open(0).expect("expected a CUDA device");
    let mut all = [0; 3];
    for soup in all_soups() {
        for granularity in [RasterGranularity::BySize, RasterGranularity::Warps, RasterGranularity::Tiles] {
            let form = RasterVariant { count_triangles: true, granularity, ..RasterVariant::default() };
            let counts = launched(&device, &soup, form).counts(&device).expect("counts");
            let RasterCounts { small, medium, large, not_finite, outside, flat, back, missed } = counts;
            let (want, drawn) = dropped(&soup);
            assert_eq!([not_finite, outside, flat, back, missed], want, "{}", soup.name);
            assert_eq!(small + medium + large, drawn, "{}", soup.name);
            match granularity {
                RasterGranularity::BySize => all = [all[0] + small, all[1] + medium, all[2] + large],
                RasterGranularity::Warps => assert_eq!(small, 0),
                RasterGranularity::Tiles => assert_eq!(small + medium, 0),
            }
        }
    }
    assert!(all.iter().all(|path| *path > 10), "{all:?}");
    let quiet = launched(&device, &all_soups()[1], RasterVariant::default()).counts(&device).expect("counts");
    assert_eq!(quiet, RasterCounts::default(), "nothing is counted unasked");
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_ids_of_scenes_match_opengl_and_both_are_timed() {
    let request = RenderReportOptions {
        loads: vec![RenderWorkload::Square, RenderWorkload::Triangles(50_000)],
        plants: vec![],
        variants: vec![],
        size: Size { width: 640, height: 360 },
        quick: true,
        replays: 20,
    };
    let report = rasters(&request, |_| {}).expect("expected a report");
    report.rows.iter().for_each(|row| eprintln!("{}", row.line()));
    assert_eq!(report.rows.len(), 4);
    for row in &report.rows {
        let passes = row.passes.unwrap_or_else(|| panic!("not timed: {row:?}"));
        assert!(passes.depth.ratio() > 0.0 && passes.visibility.ratio() > 0.0);
        assert!(row.in_frame.small + row.in_frame.medium + row.in_frame.large > 0, "{row:?}");
    }
    let named = |name: &str| report.rows.iter().find(|row| row.load == name).expect("there").in_frame;
    assert!(named("room").dropped > 1000, "much of the room lies behind the eye: {:?}", named("room"));
    assert_eq!(named("screen").large, 2);
}
