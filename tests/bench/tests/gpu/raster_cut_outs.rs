//! Compares cut-outs (alpha-tested triangles) of the CUDA rasterizer with their CPU definition, with every granularity.
//! Results are bit-identical where texture filtering has no effect. With filtering, samples near the alpha threshold
//! may differ.

use modalcast_bench::kernels::{KernelBenchmark as _, RasterBenchmark, RasterMesh};
use modalcast_compute::gpu::{Device, RasterGranularity, RasterVariant};

use crate::cut_outs::{CutOutSoup, alpha_image, constant_alpha_soups, floor_soup, sheet_soup};
use crate::scenes::Random;

/// Samples may differ if their alpha is closer to the threshold than this tolerance. It exceeds the sum of two errors,
/// 3/256 + 8/256:
/// * The hardware interpolates texels and levels with 8-bit weights (CUDA C++ programming guide, "Texture fetching").
///   Three interpolations have an error of up to 3/256.
/// * The hardware's mip level is assumed to be accurate to 1/16. Alpha of the floor's image differs by at most 1/2
///   between levels, so the error is at most 1/32 = 8/256.
const TOLERANCE: f32 = 1.0 / 16.0;

const GRANULARITIES: [RasterGranularity; 3] =
    [RasterGranularity::BySize, RasterGranularity::Warps, RasterGranularity::Tiles];

fn launch_raster(device: &Device, cut_out_soup: &CutOutSoup, variant: RasterVariant) -> RasterBenchmark {
    let soup = &cut_out_soup.soup;
    let (positions, triangles, groups) = (&soup.positions, &soup.triangles, &soup.groups);
    let mesh = RasterMesh { positions, triangles, groups, cut_outs: Some(&cut_out_soup.cut_outs) };
    let raster = RasterBenchmark::new(device, mesh, soup.viewport, variant).expect("expected a rasterizer");
    // Launch twice, to check that queues and samples of the first launch are cleared.
    (0..2).for_each(|_| raster.launch(device, 0).expect("a launch"));
    raster
}

/// The key of each sample: depth in the upper and triangle in the lower 32 bits, or `u64::MAX` without a triangle.
fn read_keys(device: &Device, cut_out_soup: &CutOutSoup, granularity: RasterGranularity) -> Vec<u64> {
    let variant = RasterVariant { granularity, ..RasterVariant::default() };
    launch_raster(device, cut_out_soup, variant).keys(device).expect("expected the id keys")
}

fn read_depth_bits(device: &Device, cut_out_soup: &CutOutSoup) -> Vec<u32> {
    let variant = RasterVariant { depth_only: true, ..RasterVariant::default() };
    launch_raster(device, cut_out_soup, variant).depths(device).expect("depths").into_iter().map(f32::to_bits).collect()
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_uniform_images_match_the_definition_bitwise() {
    let device = Device::open(0).expect("expected a CUDA device");
    // Each image has one alpha value, so texture filtering has no effect.
    for cut_out_soup in constant_alpha_soups() {
        let definition = cut_out_soup.rasterize();
        for granularity in GRANULARITIES {
            let keys = read_keys(&device, &cut_out_soup, granularity);
            let differing = keys.iter().zip(&definition.keys).filter(|(key, expected)| key != expected).count();
            assert_eq!(
                differing,
                0,
                "{} with {granularity:?}: expected {} equal samples",
                cut_out_soup.soup.name,
                keys.len()
            );
        }
        let expected_bits: Vec<u32> = definition.depths().into_iter().map(f32::to_bits).collect();
        assert!(
            read_depth_bits(&device, &cut_out_soup) == expected_bits,
            "{}: expected bit-identical depths of the depth-only variant",
            cut_out_soup.soup.name
        );
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_sheet_covers_opaque_texels_of_its_mip_level() {
    let device = Device::open(0).expect("expected a CUDA device");
    let mut random = Random(3);
    // Texels of all levels are independent. About half are transparent, because numbers are uniform in -1 to 1.
    let image = alpha_image(64, 64, |_, _, _| if random.next_number() < 0.0 { 0 } else { 255 });
    for level in [0, 1] {
        for granularity in GRANULARITIES {
            // The sheet fills a viewport of the size of the level, so each sample is the center of a texel.
            let cut_out_soup = sheet_soup(64 >> level, image.clone());
            let coverage: Vec<bool> =
                read_keys(&device, &cut_out_soup, granularity).iter().map(|key| *key != u64::MAX).collect();
            let expected_coverage: Vec<bool> = image.levels[level].iter().map(|texel| *texel == 255).collect();
            assert!(
                coverage == expected_coverage,
                "level {level} with {granularity:?}: expected the opaque texels to be covered"
            );
            assert!(coverage.iter().rev().ne(&expected_coverage), "control: expected reversed samples to differ");
        }
    }
}

/// Number of samples that differ although their alpha is outside of the tolerance of the threshold, and number of
/// samples whose alpha is within the tolerance (ambiguous samples).
fn count_differing_samples(cut_out_soup: &CutOutSoup, keys: &[u64]) -> (usize, usize) {
    let (expected_keys, is_ambiguous) = (cut_out_soup.rasterize().keys, cut_out_soup.ambiguous_samples(TOLERANCE));
    let differing =
        (0..keys.len()).filter(|sample| keys[*sample] != expected_keys[*sample] && !is_ambiguous[*sample]).count();
    (differing, is_ambiguous.iter().filter(|flag| **flag).count())
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_perspective_floor_matches_the_definition() {
    let device = Device::open(0).expect("expected a CUDA device");
    let mut cut_out_soup = floor_soup(1);
    let keys = read_keys(&device, &cut_out_soup, RasterGranularity::BySize);
    let (differing, ambiguous) = count_differing_samples(&cut_out_soup, &keys);
    eprintln!("floor: {differing} of {} samples differ, {ambiguous} are ambiguous", keys.len());
    assert_eq!(differing, 0, "{ambiguous} of {} samples are ambiguous", keys.len());
    assert!(ambiguous < keys.len() / 8, "expected few ambiguous samples, got {ambiguous} of {}", keys.len());
    // Controls: another threshold, and a u coordinate that is off by 0.1.
    cut_out_soup.cut_outs.materials[0].cutoff += 4.0 * TOLERANCE;
    assert!(count_differing_samples(&cut_out_soup, &keys).0 > 100);
    cut_out_soup.cut_outs.materials[0].cutoff -= 4.0 * TOLERANCE;
    cut_out_soup.cut_outs.uvs.as_flattened_mut().iter_mut().for_each(|uv| uv[0] += 0.1);
    assert!(count_differing_samples(&cut_out_soup, &keys).0 > 100);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_split_floor_matches_the_definition_at_every_granularity() {
    let device = Device::open(0).expect("expected a CUDA device");
    // More divisions of the floor's sides give smaller triangles.
    for (divisions, granularity) in [
        (60_u32, RasterGranularity::BySize),
        (12, RasterGranularity::BySize),
        (12, RasterGranularity::Warps),
        (12, RasterGranularity::Tiles),
    ] {
        let cut_out_soup = floor_soup(divisions);
        let keys = read_keys(&device, &cut_out_soup, granularity);
        let (differing, ambiguous) = count_differing_samples(&cut_out_soup, &keys);
        assert_eq!(
            differing,
            0,
            "{divisions} divisions, {granularity:?}: {ambiguous} of {} samples are ambiguous",
            keys.len()
        );
        assert!(ambiguous < keys.len() / 8, "expected few ambiguous samples, got {ambiguous} of {}", keys.len());
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_anisotropic_filtering_keeps_more_of_far_stripes() {
    let device = Device::open(0).expect("expected a CUDA device");
    let mut cut_out_soup = floor_soup(1);
    // Stripes along the view: their coarser levels are gray, which is below the threshold.
    cut_out_soup.cut_outs.images[0] = alpha_image(64, 32, |level, column, _| match (level, column / 8 % 2) {
        (0, 0) => 255,
        (0, _) => 0,
        _ => 90,
    });
    let count_floor_samples = |cut_out_soup: &CutOutSoup| {
        let keys = read_keys(&device, cut_out_soup, RasterGranularity::BySize);
        // The floor follows the two triangles of the wall.
        keys.iter().filter(|key| **key != u64::MAX && **key as u32 >= 2).count()
    };
    let isotropic_samples = count_floor_samples(&cut_out_soup);
    cut_out_soup.cut_outs.anisotropy = 16.0;
    let anisotropic_samples = count_floor_samples(&cut_out_soup);
    assert!(
        anisotropic_samples > isotropic_samples + isotropic_samples / 20,
        "expected 5 % more samples than the {isotropic_samples} of isotropic filtering, got {anisotropic_samples}"
    );
}
