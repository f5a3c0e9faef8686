//! The variants of the rasterization kernels.

use modalcast_model::scene::Viewport;

pub(super) const SOURCE: &str = include_str!("../../../../../kernels/raster.cu");

/// The functions of the source with [`CUT_OUTS_DEFINE`]. `raster` draws the opaque triangles of a group,
/// `raster_cut_outs` draws its cut-outs, and
/// the others draw the medium and large triangles, which these two functions put into queues.
pub(super) const FUNCTIONS: [&str; 4] = ["raster", "raster_cut_outs", "raster_warps", "raster_tiles"];
/// The functions of the source without [`CUT_OUTS_DEFINE`].
pub(super) const OPAQUE_FUNCTIONS: [&str; 3] = [FUNCTIONS[0], FUNCTIONS[2], FUNCTIONS[3]];

/// The macro for meshes with cut-outs.
const CUT_OUTS_DEFINE: &str = "CUT_OUTS";

/// The kernels that draw small and medium triangles. Benchmarks compare them; the results are the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum RasterGranularity {
    /// A thread draws a small triangle, a warp a medium one, and several warps the tiles of a large one.
    #[default]
    BySize,
    /// As `BySize`, but warps also draw small triangles.
    Warps,
    /// All triangles are divided into tiles.
    Tiles,
}

/// A variant of the kernels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RasterVariant {
    /// Depth without ids, for shadow maps.
    pub depth_only: bool,
    /// Whether to count triangles by `TriangleBin` of the kernels.
    pub count_triangles: bool,
    /// Ignored with `depth_only`, which always uses [`RasterGranularity::BySize`].
    pub granularity: RasterGranularity,
}

impl RasterVariant {
    /// The macros of this variant, for meshes with or without cut-outs.
    pub(super) fn defines(self, has_cut_outs: bool) -> Vec<&'static str> {
        let optional_defines = [(has_cut_outs, CUT_OUTS_DEFINE), (self.count_triangles, "COUNT_TRIANGLES")]
            .into_iter()
            .filter_map(|(is_enabled, name)| is_enabled.then_some(name));
        if self.depth_only {
            return std::iter::once("DEPTH_ONLY").chain(optional_defines).collect();
        }
        let granularity: &[&str] = match self.granularity {
            RasterGranularity::BySize => &[],
            // 0 samples: no triangle is small. An extent of -1: no triangle is medium either.
            RasterGranularity::Warps => &["MAX_THREAD_SAMPLES=0"],
            RasterGranularity::Tiles => &["MAX_THREAD_SAMPLES=0", "MAX_WARP_EXTENT=-1"],
        };
        optional_defines.chain(granularity.iter().copied()).collect()
    }

    /// Bytes of all samples of a window.
    pub const fn bytes(self, window: &Viewport) -> u64 {
        let sample_bytes = if self.depth_only { size_of::<f32>() } else { size_of::<u64>() };
        sample_bytes as u64 * window.pixel_count() as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{CAPABILITIES, assert_compiles};

    /// Lists of macros that the server compiles.
    const SERVER_WITHOUT_CUT_OUTS: &[&[&str]] = &[&[], &["DEPTH_ONLY"]];
    const SERVER_WITH_CUT_OUTS: &[&[&str]] = &[&["CUT_OUTS"], &["DEPTH_ONLY", "CUT_OUTS"]];
    /// Lists of macros that only the benchmarks compile.
    const BENCHMARK_WITHOUT_CUT_OUTS: &[&[&str]] = &[
        &["COUNT_TRIANGLES"],
        &["DEPTH_ONLY", "COUNT_TRIANGLES"],
        &["MAX_THREAD_SAMPLES=0"],
        &["MAX_THREAD_SAMPLES=0", "MAX_WARP_EXTENT=-1"],
        &["COUNT_TRIANGLES", "MAX_THREAD_SAMPLES=0"],
        &["COUNT_TRIANGLES", "MAX_THREAD_SAMPLES=0", "MAX_WARP_EXTENT=-1"],
    ];
    const BENCHMARK_WITH_CUT_OUTS: &[&[&str]] = &[
        &["CUT_OUTS", "COUNT_TRIANGLES"],
        &["DEPTH_ONLY", "CUT_OUTS", "COUNT_TRIANGLES"],
        &["CUT_OUTS", "MAX_THREAD_SAMPLES=0"],
        &["CUT_OUTS", "MAX_THREAD_SAMPLES=0", "MAX_WARP_EXTENT=-1"],
        &["CUT_OUTS", "COUNT_TRIANGLES", "MAX_THREAD_SAMPLES=0"],
        &["CUT_OUTS", "COUNT_TRIANGLES", "MAX_THREAD_SAMPLES=0", "MAX_WARP_EXTENT=-1"],
    ];

    #[test]
    fn defines_of_every_variant_are_in_the_compiled_lists() {
        for depth_only in [false, true] {
            for count_triangles in [false, true] {
                for granularity in [RasterGranularity::BySize, RasterGranularity::Warps, RasterGranularity::Tiles] {
                    let variant = RasterVariant { depth_only, count_triangles, granularity };
                    // `depth_only` ignores the granularity.
                    let is_used_by_server =
                        !count_triangles && (depth_only || granularity == RasterGranularity::BySize);
                    for (has_cut_outs, server_variants, benchmark_variants) in [
                        (false, SERVER_WITHOUT_CUT_OUTS, BENCHMARK_WITHOUT_CUT_OUTS),
                        (true, SERVER_WITH_CUT_OUTS, BENCHMARK_WITH_CUT_OUTS),
                    ] {
                        let defines = variant.defines(has_cut_outs);
                        let variants = if is_used_by_server { server_variants } else { benchmark_variants };
                        assert!(variants.contains(&defines.as_slice()), "{variant:?}");
                    }
                }
            }
        }
    }

    #[test]
    #[ignore = "needs NVRTC: deploy/check installs it"]
    fn nvrtc_compiles_every_raster_variant() {
        assert_compiles(SOURCE, &OPAQUE_FUNCTIONS, SERVER_WITHOUT_CUT_OUTS, &CAPABILITIES);
        assert_compiles(SOURCE, &FUNCTIONS, SERVER_WITH_CUT_OUTS, &CAPABILITIES);
        // The benchmarks run on the H200.
        assert_compiles(SOURCE, &OPAQUE_FUNCTIONS, BENCHMARK_WITHOUT_CUT_OUTS, &[(9, 0)]);
        assert_compiles(SOURCE, &FUNCTIONS, BENCHMARK_WITH_CUT_OUTS, &[(9, 0)]);
    }
}
