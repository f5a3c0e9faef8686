//! Launches `kernels/bounds.cu`: the bounds of all positions from the boxes of `deform`, and of each domain where the
//! scene keeps boxes.

use cudarc::driver::{CudaFunction, LaunchConfig};

use super::boxes::Boxes;
use super::chain;
use super::deform::config;
use super::device::Device;
use super::inputs::Values;
use super::layout::{BoundsArgs, Piece};
use super::plan::Kernel;
use crate::error::Result;

/// The kernel.
#[derive(Debug)]
pub(super) struct Bounds {
    pub(super) function: CudaFunction,
    config: LaunchConfig,
    /// Of a scene that keeps them.
    pub(super) boxes: Option<Boxes>,
}

impl Bounds {
    /// With `pieces`, a box of each domain is made too.
    pub(super) fn new(device: &Device, kernel: &Kernel, pieces: Option<&[Piece]>) -> Result<Self> {
        Ok(Self {
            function: device.function(kernel.name, kernel.source.0, &kernel.defines)?,
            config: config(kernel),
            boxes: pieces.map(|pieces| Boxes::new(device, pieces)).transpose()?,
        })
    }

    /// Starts the kernel on `count` boxes; the result goes into the header among the values.
    pub(super) fn launch(&self, device: &Device, values: Values, (boxes, count): (u64, u32)) -> Result<()> {
        let (pieces, piece_boxes, piece_count) = self.boxes.as_ref().map_or((0, 0, 0), |boxes| boxes.addresses(device));
        let Values { header, stamps, .. } = values;
        let args = BoundsArgs { header, boxes, pieces, stamps, piece_boxes, count, piece_count };
        // SAFETY: `BoundsArgs` is the kernel's only argument; `boxes` has six words for each of `count`, as `Deform`
        // allocated them, and `piece_boxes` for each piece. Pieces name boxes, vertices and domains of the same scene.
        // The kernel waits first.
        unsafe { chain::launch(device, &self.function, self.config, &args) }
    }
}

/// The bounds that the six keys stand for.
pub(super) fn bounds_of(keys: &[u32]) -> crate::scene::Bounds {
    let mut bounds = crate::scene::Bounds::EMPTY;
    for axis in 0..3 {
        bounds.min[axis] = -f64::from(number_of(keys[axis]));
        bounds.max[axis] = f64::from(number_of(keys[3 + axis]));
    }
    bounds
}

/// The inverse of `ordered` in `kernels/ordered.cuh`. Zero, which no number has, gives a NaN like the NaN's own key.
fn number_of(key: u32) -> f32 {
    f32::from_bits(if key >> 31 == 1 { key & 0x7fff_ffff } else { !key })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `ordered` of the kernel, word by word.
    fn ordered(x: f32) -> u32 {
        match x {
            x if x.is_nan() => u32::MAX,
            x if x.is_sign_negative() => !x.to_bits(),
            x => x.to_bits() | 0x8000_0000,
        }
    }

    #[test]
    fn keys_keep_the_order_of_numbers_and_a_nan_or_nothing_is_not_finite() {
        let rising = [f32::NEG_INFINITY, -1e30, -1.0, -1e-45, -0.0, 0.0, 1e-45, 2.5, f32::MAX, f32::INFINITY];
        for pair in rising.windows(2) {
            assert!(ordered(pair[0]) < ordered(pair[1]), "{pair:?}");
            assert!(ordered(pair[0]) > 0);
        }
        for number in rising {
            assert_eq!(number_of(ordered(number)).to_bits(), number.to_bits());
        }
        assert!(number_of(ordered(f32::NAN)).is_nan());
        assert!(number_of(0).is_nan());
        let good = [-1.0_f32, -2.0, -3.0, 4.0, 5.0, 6.0].map(ordered);
        assert_eq!(bounds_of(&good), crate::scene::Bounds { min: [1.0, 2.0, 3.0], max: [4.0, 5.0, 6.0] });
        for bad in [f32::NAN, f32::INFINITY] {
            let mut keys = good;
            keys[4] = ordered(bad);
            assert!(!bounds_of(&keys).is_finite());
        }
        assert!(!bounds_of(&[0; 6]).is_finite());
    }
}
