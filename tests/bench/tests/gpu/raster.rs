//! The CUDA rasterizer against its definition: bit-identical samples on every path.

use modalcast_bench::kernels::{Raster, RasterCounts, RasterMesh, Trial as _};
use modalcast_bench::render::loads::Kind;
use modalcast_bench::render::{Request, Size, rasters};
use modalcast_compute::gpu::{Device, RasterForm, Spread};
use modalcast_compute::reference::raster::{Dropped, outline};

use crate::soups::{Soup, soups};

fn launched(device: &Device, soup: &Soup, form: RasterForm) -> Raster {
    let mesh =
        RasterMesh { positions: &soup.positions, triangles: &soup.triangles, groups: &soup.groups, cut_outs: None };
    let raster = Raster::new(device, mesh, soup.window, form).expect("a raster");
    // Twice, to check that queues and samples of the first launch are cleared.
    (0..2).for_each(|_| raster.launch(device, 0).expect("launches"));
    raster
}

/// Triangles that the definition drops, by reason, and the number that it draws.
fn dropped(soup: &Soup) -> ([u32; 5], u32) {
    let (mut counts, mut drawn) = ([0; 5], 0);
    for group in &soup.groups {
        for triangle in &soup.triangles[group.first as usize..][..group.triangles as usize] {
            match outline(&soup.window, &soup.positions, *triangle, group.faces) {
                Ok(_) => drawn += 1,
                Err(Dropped::NotFinite) => counts[0] += 1,
                Err(Dropped::Outside) => counts[1] += 1,
                Err(Dropped::Flat) => counts[2] += 1,
                Err(Dropped::Back) => counts[3] += 1,
                Err(Dropped::Missed) => counts[4] += 1,
            }
        }
    }
    (counts, drawn)
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_samples_match_the_definition_bitwise_on_every_path() {
    let device = Device::open(0).expect("a CUDA device");
    for soup in soups() {
        let want = soup.drawn();
        for spread in [Spread::BySize, Spread::Warps, Spread::Tiles] {
            for counted in [false, true] {
                let form = RasterForm { spread, counted, ..RasterForm::default() };
                let keys = launched(&device, &soup, form).keys(&device).expect("keys");
                let wrong = keys.iter().zip(&want.keys).filter(|(got, want)| got != want).count();
                assert_eq!(wrong, 0, "{} by {form:?}: of {} samples", soup.name, keys.len());
            }
        }
        let form = RasterForm { depth_only: true, ..RasterForm::default() };
        let bits = |depths: Vec<f32>| depths.into_iter().map(f32::to_bits).collect::<Vec<_>>();
        let depths = launched(&device, &soup, form).depths(&device).expect("depths");
        assert!(bits(depths) == bits(want.depths()), "{}: depth alone", soup.name);
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_counts_every_triangle_once_and_takes_every_path() {
    let device = Device::open(0).expect("a CUDA device");
    let mut all = [0; 3];
    for soup in soups() {
        for spread in [Spread::BySize, Spread::Warps, Spread::Tiles] {
            let form = RasterForm { counted: true, spread, ..RasterForm::default() };
            let counts = launched(&device, &soup, form).counts(&device).expect("counts");
            let RasterCounts { small, medium, large, not_finite, outside, flat, back, missed } = counts;
            let (want, drawn) = dropped(&soup);
            assert_eq!([not_finite, outside, flat, back, missed], want, "{}", soup.name);
            assert_eq!(small + medium + large, drawn, "{}", soup.name);
            match spread {
                Spread::BySize => all = [all[0] + small, all[1] + medium, all[2] + large],
                Spread::Warps => assert_eq!(small, 0),
                Spread::Tiles => assert_eq!(small + medium, 0),
            }
        }
    }
    assert!(all.iter().all(|path| *path > 10), "{all:?}");
    let quiet = launched(&device, &soups()[1], RasterForm::default()).counts(&device).expect("counts");
    assert_eq!(quiet, RasterCounts::default(), "nothing is counted unasked");
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_ids_of_scenes_match_opengl_and_both_are_timed() {
    let request = Request {
        loads: vec![Kind::Square, Kind::Triangles(50_000)],
        plants: vec![],
        variants: vec![],
        size: Size { width: 640, height: 360 },
        quick: true,
        replays: 20,
    };
    let report = rasters(&request, |_| {}).expect("a report");
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
