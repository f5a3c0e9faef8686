//! The variants of the rasterization kernels.

use modalcast_model::scene::Window;

pub(in super::super) const SOURCE: &str = include_str!("../../../../kernels/raster.cu");

/// The functions of the source: two launched per group, for its opaque triangles and for its cut-outs, and two that
/// process the queues. Without [`CUT`] the source has no `raster_cut`.
pub(in super::super) const FUNCTIONS: [&str; 4] = ["raster", "raster_cut", "raster_warps", "raster_tiles"];
pub(in super::super) const WHOLE: [&str; 3] = [FUNCTIONS[0], FUNCTIONS[2], FUNCTIONS[3]];

/// The macro for meshes with cut-outs.
const CUT: &str = "CUT";

/// Which path draws the triangles that are small enough for a thread; for benchmarks, the result is the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Spread {
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
pub struct RasterForm {
    /// Depth without ids, for shadow maps.
    pub depth_only: bool,
    /// Whether to count triangles by path.
    pub counted: bool,
    /// Ignored with `depth_only`, which always uses [`Spread::BySize`].
    pub spread: Spread,
}

impl RasterForm {
    /// The macros of this form, for meshes with or without cut-outs.
    pub(in super::super) fn defines(self, cut: bool) -> Vec<&'static str> {
        let more =
            [(cut, CUT), (self.counted, "COUNT")].into_iter().filter_map(|(wanted, name)| wanted.then_some(name));
        if self.depth_only {
            return std::iter::once("DEPTH").chain(more).collect();
        }
        let spread: &[&str] = match self.spread {
            Spread::BySize => &[],
            Spread::Warps => &["FEW=0"],
            Spread::Tiles => &["FEW=0", "NARROW=-1"],
        };
        more.chain(spread.iter().copied()).collect()
    }

    /// Bytes of all samples of a window.
    pub const fn bytes(self, window: &Window) -> u64 {
        let sample = if self.depth_only { size_of::<f32>() } else { size_of::<u64>() };
        sample as u64 * window.pixels() as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::assert_compiles;

    /// What a server or a trial ever compiles.
    const WITHOUT_CUT_OUTS: &[&[&str]] = &[
        &[],
        &["DEPTH"],
        &["COUNT"],
        &["DEPTH", "COUNT"],
        &["FEW=0"],
        &["FEW=0", "NARROW=-1"],
        &["COUNT", "FEW=0"],
        &["COUNT", "FEW=0", "NARROW=-1"],
    ];

    const WITH_CUT_OUTS: &[&[&str]] = &[
        &["CUT"],
        &["DEPTH", "CUT"],
        &["CUT", "COUNT"],
        &["DEPTH", "CUT", "COUNT"],
        &["CUT", "FEW=0"],
        &["CUT", "FEW=0", "NARROW=-1"],
        &["CUT", "COUNT", "FEW=0"],
        &["CUT", "COUNT", "FEW=0", "NARROW=-1"],
    ];

    #[test]
    fn every_form_is_a_variant_that_is_compiled_in_the_check() {
        for depth_only in [false, true] {
            for counted in [false, true] {
                for spread in [Spread::BySize, Spread::Warps, Spread::Tiles] {
                    let form = RasterForm { depth_only, counted, spread };
                    for (cut, variants) in [(false, WITHOUT_CUT_OUTS), (true, WITH_CUT_OUTS)] {
                        assert!(variants.contains(&form.defines(cut).as_slice()), "{form:?}");
                    }
                }
            }
        }
    }

    #[test]
    #[ignore = "needs NVRTC: deploy/check installs it"]
    fn nvrtc_compiles_every_raster() {
        assert_compiles(SOURCE, &WHOLE, WITHOUT_CUT_OUTS);
        assert_compiles(SOURCE, &FUNCTIONS, WITH_CUT_OUTS);
    }
}
