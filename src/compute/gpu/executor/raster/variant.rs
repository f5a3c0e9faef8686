//! The variants of the rasterization kernels.

use modalcast_model::scene::Viewport;

pub(super) const SOURCE: &str = include_str!("../../../../../kernels/raster.cu");

/// The functions of the source: two launched per group, for its opaque triangles and for its cut-outs, and two that
/// process the queues. Without [`CUT_OUTS_DEFINE`] the source has no `raster_cut_outs`.
pub(super) const FUNCTIONS: [&str; 4] = ["raster", "raster_cut_outs", "raster_warps", "raster_tiles"];
pub(super) const OPAQUE_FUNCTIONS: [&str; 3] = [FUNCTIONS[0], FUNCTIONS[2], FUNCTIONS[3]];

/// The macro for meshes with cut-outs.
const CUT_OUTS_DEFINE: &str = "CUT_OUTS";

/// Which path draws the triangles that are small enough for a thread; for benchmarks, the result is the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum RasterGranularity {
    /// Threads and warps by triangle size.
    #[default]
    BySize,
    /// No threads: warps, and tiles for large triangles.
    Warps,
    /// Only tiles.
    Tiles,
}

/// A variant of the kernels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RasterVariant {
    /// Depth without ids, for shadow maps.
    pub depth_only: bool,
    /// Whether to count triangles by path.
    pub count_triangles: bool,
    /// Ignored with `depth_only`, which always uses [`RasterGranularity::BySize`].
    pub granularity: RasterGranularity,
}

impl RasterVariant {
    /// The macros of this form, for meshes with or without cut-outs.
    pub(super) fn defines(self, cut: bool) -> Vec<&'static str> {
        let more = [(cut, CUT_OUTS_DEFINE), (self.count_triangles, "COUNT_TRIANGLES")]
            .into_iter()
            .filter_map(|(wanted, name)| wanted.then_some(name));
        if self.depth_only {
            return std::iter::once("DEPTH_ONLY").chain(more).collect();
        }
        let granularity: &[&str] = match self.granularity {
            RasterGranularity::BySize => &[],
            RasterGranularity::Warps => &["MAX_THREAD_SAMPLES=0"],
            RasterGranularity::Tiles => &["MAX_THREAD_SAMPLES=0", "MAX_WARP_EXTENT=-1"],
        };
        more.chain(granularity.iter().copied()).collect()
    }

    /// Bytes of all samples of a window.
    pub const fn bytes(self, window: &Viewport) -> u64 {
        let sample = if self.depth_only { size_of::<f32>() } else { size_of::<u64>() };
        sample as u64 * window.pixel_count() as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::assert_compiles;

    /// What a server or a trial ever compiles.
    const WITHOUT_CUT_OUTS: &[&[&str]] = &[
        &[],
        &["DEPTH_ONLY"],
        &["COUNT_TRIANGLES"],
        &["DEPTH_ONLY", "COUNT_TRIANGLES"],
        &["MAX_THREAD_SAMPLES=0"],
        &["MAX_THREAD_SAMPLES=0", "MAX_WARP_EXTENT=-1"],
        &["COUNT_TRIANGLES", "MAX_THREAD_SAMPLES=0"],
        &["COUNT_TRIANGLES", "MAX_THREAD_SAMPLES=0", "MAX_WARP_EXTENT=-1"],
    ];

    const WITH_CUT_OUTS: &[&[&str]] = &[
        &["CUT_OUTS"],
        &["DEPTH_ONLY", "CUT_OUTS"],
        &["CUT_OUTS", "COUNT_TRIANGLES"],
        &["DEPTH_ONLY", "CUT_OUTS", "COUNT_TRIANGLES"],
        &["CUT_OUTS", "MAX_THREAD_SAMPLES=0"],
        &["CUT_OUTS", "MAX_THREAD_SAMPLES=0", "MAX_WARP_EXTENT=-1"],
        &["CUT_OUTS", "COUNT_TRIANGLES", "MAX_THREAD_SAMPLES=0"],
        &["CUT_OUTS", "COUNT_TRIANGLES", "MAX_THREAD_SAMPLES=0", "MAX_WARP_EXTENT=-1"],
    ];

    #[test]
    fn every_form_is_a_variant_that_is_compiled_in_the_check() {
        for depth_only in [false, true] {
            for count_triangles in [false, true] {
                for granularity in [RasterGranularity::BySize, RasterGranularity::Warps, RasterGranularity::Tiles] {
                    let variant = RasterVariant { depth_only, count_triangles, granularity };
                    for (cut, variants) in [(false, WITHOUT_CUT_OUTS), (true, WITH_CUT_OUTS)] {
                        assert!(variants.contains(&variant.defines(cut).as_slice()), "{variant:?}");
                    }
                }
            }
        }
    }

    #[test]
    #[ignore = "needs NVRTC: deploy/check installs it"]
    fn nvrtc_compiles_every_raster() {
        assert_compiles(SOURCE, &OPAQUE_FUNCTIONS, WITHOUT_CUT_OUTS);
        assert_compiles(SOURCE, &FUNCTIONS, WITH_CUT_OUTS);
    }
}
