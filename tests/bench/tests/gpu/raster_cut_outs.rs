//! Cut-outs on the device against the definition, on every path: bit-identical where filtering has no effect, and
//! identical away from the alpha threshold where it has.

use modalcast_bench::kernels::{KernelBenchmark as _, RasterBenchmark, RasterMesh};
use modalcast_compute::gpu::{Device, RasterGranularity, RasterVariant};

use crate::cut_outs::{CutOutSoup, alpha_image, floor_soup, sheet_soup, uniform_cut_out_soups};
use crate::scenes::Random;

/// Tolerance of the alpha threshold. Hardware interpolates texels and levels with weights of 8 bits (CUDA C++
/// programming guide, "Texture fetching"): three interpolations give 3/256. It computes the level by its own logarithm,
/// assumed here to be accurate to a sixteenth of a level, where levels differ by at most one half.
const TOLERANCE: f32 = 1.0 / 16.0;

const SPREADS: [RasterGranularity; 3] = [RasterGranularity::BySize, RasterGranularity::Warps, RasterGranularity::Tiles];

fn launched(device: &Device, holes: &CutOutSoup, form: RasterVariant) -> RasterBenchmark {
    let soup = &holes.soup;
    let (positions, triangles, groups) = (&soup.positions, &soup.triangles, &soup.groups);
    let mesh = RasterMesh { positions, triangles, groups, cut_outs: Some(&holes.cut_outs) };
    let raster = RasterBenchmark::new(device, mesh, soup.viewport, form).expect("expected a rasterizer");
    (0..2).for_each(|_| raster.launch(device, 0).expect("launches"));
    raster
}

fn keys(device: &Device, holes: &CutOutSoup, granularity: RasterGranularity) -> Vec<u64> {
    let form = RasterVariant { granularity, ..RasterVariant::default() };
    launched(device, holes, form).keys(device).expect("expected the id keys")
}

fn depths(device: &Device, holes: &CutOutSoup) -> Vec<u32> {
    let form = RasterVariant { depth_only: true, ..RasterVariant::default() };
    launched(device, holes, form).depths(device).expect("depths").into_iter().map(f32::to_bits).collect()
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_uniform_images_match_the_definition_bitwise() {
    let device = Device::open(0).expect("expected a CUDA device");
    for holes in uniform_cut_out_soups() {
        let want = holes.rasterize();
        for granularity in SPREADS {
            let got = keys(&device, &holes, granularity);
            let wrong = got.iter().zip(&want.keys).filter(|(got, want)| got != want).count();
            assert_eq!(wrong, 0, "{} by {granularity:?}: of {} samples", holes.soup.name, got.len());
        }
        let bits: Vec<u32> = want.depths().into_iter().map(f32::to_bits).collect();
        assert!(depths(&device, &holes) == bits, "{}: depth alone", holes.soup.name);
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_sheet_samples_its_image_and_mip_level_exactly() {
    let device = Device::open(0).expect("expected a CUDA device");
    let mut random = Random(3);
    let own = alpha_image(64, 64, |_, _, _| if random.next_number() < 0.0 { 0 } else { 255 });
    for level in [0, 1] {
        for granularity in SPREADS {
            let holes = sheet_soup(64 >> level, own.clone());
            let got: Vec<bool> = keys(&device, &holes, granularity).iter().map(|key| *key != u64::MAX).collect();
            let want: Vec<bool> = own.levels[level].iter().map(|texel| *texel == 255).collect();
            assert!(got == want, "level {level} by {granularity:?}");
            assert!(got.iter().rev().ne(&want), "expected the reversed samples to differ");
        }
    }
}

/// Number of samples that differ outside of the tolerance, and number of samples within the tolerance.
fn beyond_doubt(holes: &CutOutSoup, got: &[u64]) -> (usize, usize) {
    let (want, doubtful) = (holes.rasterize().keys, holes.ambiguous_samples(TOLERANCE));
    let wrong = (0..got.len()).filter(|at| got[*at] != want[*at] && !doubtful[*at]).count();
    (wrong, doubtful.iter().filter(|doubt| **doubt).count())
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_perspective_floor_matches_the_definition() {
    let device = Device::open(0).expect("expected a CUDA device");
    let mut holes = floor_soup(1);
    let got = keys(&device, &holes, RasterGranularity::BySize);
    let (wrong, doubtful) = beyond_doubt(&holes, &got);
    eprintln!("a floor: {wrong} of {} samples differ, {doubtful} are in doubt", got.len());
    assert_eq!(wrong, 0, "{doubtful} of {} in doubt", got.len());
    assert!(doubtful < got.len() / 8, "{doubtful} of {} in doubt", got.len());
    // Controls: another threshold, and texture coordinates that are off by a tenth.
    holes.cut_outs.materials[0].cutoff += 4.0 * TOLERANCE;
    assert!(beyond_doubt(&holes, &got).0 > 100);
    holes.cut_outs.materials[0].cutoff -= 4.0 * TOLERANCE;
    holes.cut_outs.uvs.as_flattened_mut().iter_mut().for_each(|uv| uv[0] += 0.1);
    assert!(beyond_doubt(&holes, &got).0 > 100);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_split_floor_matches_the_definition_on_every_path() {
    let device = Device::open(0).expect("expected a CUDA device");
    for (cuts, granularity) in [
        (60_u32, RasterGranularity::BySize),
        (12, RasterGranularity::BySize),
        (12, RasterGranularity::Warps),
        (12, RasterGranularity::Tiles),
    ] {
        let holes = floor_soup(cuts);
        let got = keys(&device, &holes, granularity);
        let (wrong, doubtful) = beyond_doubt(&holes, &got);
        assert_eq!(wrong, 0, "{cuts} by {granularity:?}, {doubtful} of {} in doubt", got.len());
        assert!(doubtful < got.len() / 8, "{doubtful} of {} in doubt", got.len());
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_anisotropic_filtering_keeps_more_of_far_stripes() {
    let device = Device::open(0).expect("expected a CUDA device");
    let mut holes = floor_soup(1);
    // Stripes along the view: their coarser levels are gray, which is below the threshold.
    holes.cut_outs.images[0] = alpha_image(64, 32, |level, column, _| match (level, column / 8 % 2) {
        (0, 0) => 255,
        (0, _) => 0,
        _ => 90,
    });
    let floor_samples = |holes: &CutOutSoup| {
        let got = keys(&device, holes, RasterGranularity::BySize);
        got.iter().filter(|key| **key != u64::MAX && **key as u32 >= 2).count()
    };
    let alike = floor_samples(&holes);
    holes.cut_outs.anisotropy = 16.0;
    let along = floor_samples(&holes);
    assert!(along > alike + alike / 20, "{along} samples along the footprint, {alike} alike in all directions");
}
