//! The colors of RGBA pixels without alpha.

use rayon::prelude::*;

/// Number of pixels that a thread converts at a time.
const PIECE_PIXELS: usize = 64 << 10;

/// RGB8 of RGBA8 pixels, in the same order. All threads of the current pool take part.
pub fn drop_alpha(rgba: &[u8]) -> Vec<u8> {
    let mut rgb = vec![0; rgba.len() / 4 * 3];
    let pieces = rgba.par_chunks(4 * PIECE_PIXELS).zip(rgb.par_chunks_mut(3 * PIECE_PIXELS));
    pieces.for_each(|(rgba, rgb)| copy_colors(rgba, rgb));
    rgb
}

/// Copies the colors of pixels to `rgb`, which has room for them.
fn copy_colors(rgba: &[u8], rgb: &mut [u8]) {
    #[cfg(target_arch = "x86_64")]
    if let Some(simd) = pulp::x86::V3::try_new() {
        return simd.vectorize(CopyColors { simd, rgba, rgb });
    }
    copy_blocks(rgba, rgb, block_colors);
}

/// The colors of four pixels.
#[inline(always)]
pub(super) fn block_colors(block: &[u8; 16]) -> [u8; 12] {
    std::array::from_fn(|index| block[index / 3 * 4 + index % 3])
}

/// [`block_colors`] with a byte shuffle.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
pub(super) fn shuffled_block_colors(simd: pulp::x86::V3, block: [u8; 16]) -> [u8; 12] {
    // 0x80 selects no byte.
    const COLORS: [u8; 16] = [0, 1, 2, 4, 5, 6, 8, 9, 10, 12, 13, 14, 0x80, 0x80, 0x80, 0x80];
    let colors: [u8; 16] = pulp::cast(simd.ssse3._mm_shuffle_epi8(pulp::cast(block), pulp::cast(COLORS)));
    let mut target = [0; 12];
    target.copy_from_slice(&colors[..12]);
    target
}

/// [`copy_colors`] with byte shuffles.
#[cfg(target_arch = "x86_64")]
struct CopyColors<'a> {
    simd: pulp::x86::V3,
    rgba: &'a [u8],
    rgb: &'a mut [u8],
}

#[cfg(target_arch = "x86_64")]
impl pulp::NullaryFnOnce for CopyColors<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let Self { simd, rgba, rgb } = self;
        copy_blocks(rgba, rgb, |block| shuffled_block_colors(simd, *block));
    }
}

/// Passes blocks of four pixels to `copy_block`, which returns their colors.
#[inline(always)]
fn copy_blocks(rgba: &[u8], rgb: &mut [u8], copy_block: impl Fn(&[u8; 16]) -> [u8; 12]) {
    let (blocks, rest) = rgba.as_chunks::<16>();
    let (target_blocks, target_rest) = rgb.as_chunks_mut::<12>();
    for (block, target) in blocks.iter().zip(target_blocks) {
        *target = copy_block(block);
    }
    for (pixel, target) in rest.as_chunks::<4>().0.iter().zip(target_rest.as_chunks_mut::<3>().0) {
        target.copy_from_slice(&pixel[..3]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colors_keep_their_order_and_alpha_is_dropped() {
        let mut random = fastrand::Rng::with_seed(3);
        for pixels in [0, 1, 3, 4, 5, 4097, 2 * PIECE_PIXELS + 7] {
            let rgba: Vec<u8> = (0..4 * pixels).map(|_| random.u8(..)).collect();
            let expected: Vec<u8> = rgba.as_chunks::<4>().0.iter().flat_map(|pixel| pixel[..3].to_vec()).collect();
            assert!(drop_alpha(&rgba) == expected, "{pixels} pixels");
            let mut rgb = vec![0; 3 * pixels];
            copy_blocks(&rgba, &mut rgb, block_colors);
            assert!(rgb == expected, "{pixels} pixels without byte shuffles");
        }
    }
}
