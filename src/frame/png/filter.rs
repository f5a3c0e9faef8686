//! The filter of rows: Sub, the difference to the pixel on the left. In one pass it also drops alpha.

use crate::frame::rgb::block_colors;
#[cfg(target_arch = "x86_64")]
use crate::frame::rgb::shuffled_block_colors;

/// PNG's number of the filter Sub.
const SUB: u8 = 1;

/// The channels of a PNG.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Channels {
    Rgb,
    Rgba,
}

impl Channels {
    pub(super) const fn count(self) -> usize {
        match self {
            Self::Rgb => 3,
            Self::Rgba => 4,
        }
    }

    /// The color type in the header of the file.
    pub(super) const fn color_type(self) -> u8 {
        match self {
            Self::Rgb => 2,
            Self::Rgba => 6,
        }
    }
}

/// Filters rows of RGBA pixels into `target`, which has one byte and the channels of a row for each row. Returns
/// `false` as soon as a row has a pixel that is not opaque and `channels` is [`Channels::Rgb`].
pub(super) fn filter_rows(rgba: &[u8], width: usize, channels: Channels, target: &mut [u8]) -> bool {
    let mut rows = rgba.chunks_exact(4 * width).zip(target.chunks_exact_mut(1 + channels.count() * width));
    rows.all(|(row, target)| {
        let Some((filter, target)) = target.split_first_mut() else { return false };
        *filter = SUB;
        match channels {
            Channels::Rgb => sub_rgb(row, target),
            Channels::Rgba => {
                sub_rgba(row, target);
                true
            }
        }
    })
}

/// The differences of the colors; returns whether every pixel is opaque.
fn sub_rgb(rgba: &[u8], target: &mut [u8]) -> bool {
    #[cfg(target_arch = "x86_64")]
    if let Some(simd) = pulp::x86::V3::try_new() {
        return simd.vectorize(SubRgb { simd, rgba, target });
    }
    sub_rgb_blocks(rgba, target, |current, previous| block_colors(&sub(current, previous)))
}

/// [`sub_rgb`] with byte shuffles, which take a third of the time.
#[cfg(target_arch = "x86_64")]
struct SubRgb<'a> {
    simd: pulp::x86::V3,
    rgba: &'a [u8],
    target: &'a mut [u8],
}

#[cfg(target_arch = "x86_64")]
impl pulp::NullaryFnOnce for SubRgb<'_> {
    type Output = bool;

    #[inline(always)]
    fn call(self) -> bool {
        let Self { simd, rgba, target } = self;
        sub_rgb_blocks(rgba, target, |current, previous| {
            let difference = simd.sse2._mm_sub_epi8(pulp::cast(*current), pulp::cast(*previous));
            shuffled_block_colors(simd, pulp::cast(difference))
        })
    }
}

/// Passes blocks of four pixels, and the block that begins one pixel earlier, to `sub_block`, which returns the
/// differences of their colors.
#[inline(always)]
fn sub_rgb_blocks(rgba: &[u8], target: &mut [u8], sub_block: impl Fn(&[u8; 16], &[u8; 16]) -> [u8; 12]) -> bool {
    let (Some(first), Some((first_target, targets))) = (rgba.first_chunk::<4>(), target.split_first_chunk_mut::<3>())
    else {
        return true;
    };
    first_target.copy_from_slice(&first[..3]);
    let (blocks, rest) = rgba[4..].as_chunks::<16>();
    let previous_blocks = rgba.as_chunks::<16>().0;
    let (target_blocks, target_rest) = targets.as_chunks_mut::<12>();
    // The bitwise AND of all alphas is 255 only if every alpha is.
    let mut bits = [u8::MAX; 16];
    for ((block, previous), target) in blocks.iter().zip(previous_blocks).zip(target_blocks) {
        bits = std::array::from_fn(|index| bits[index] & block[index]);
        *target = sub_block(block, previous);
    }
    let mut alpha_bits = first[3] & bits[3] & bits[7] & bits[11] & bits[15];
    let rest_previous = &rgba[rgba.len() - rest.len() - 4..];
    let rest_pixels = rest.as_chunks::<4>().0.iter().zip(rest_previous.as_chunks::<4>().0);
    for ((pixel, previous), target) in rest_pixels.zip(target_rest.as_chunks_mut::<3>().0) {
        alpha_bits &= pixel[3];
        *target = std::array::from_fn(|channel| pixel[channel].wrapping_sub(previous[channel]));
    }
    alpha_bits == u8::MAX
}

#[inline(always)]
fn sub(current: &[u8; 16], previous: &[u8; 16]) -> [u8; 16] {
    std::array::from_fn(|index| current[index].wrapping_sub(previous[index]))
}

/// The differences of all channels.
fn sub_rgba(rgba: &[u8], target: &mut [u8]) {
    let (Some(first), Some((first_target, target))) = (rgba.first_chunk::<4>(), target.split_first_chunk_mut::<4>())
    else {
        return;
    };
    *first_target = *first;
    for ((target, byte), previous) in target.iter_mut().zip(&rgba[4..]).zip(rgba) {
        *target = byte.wrapping_sub(*previous);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn filtered_rows_are_differences_to_the_left() {
        let mut random = fastrand::Rng::with_seed(5);
        for (width, height) in [(1, 3), (2, 2), (4, 1), (5, 2), (6, 3), (17, 4), (64, 2)] {
            let mut rgba: Vec<u8> = (0..4 * width * height).map(|_| random.u8(..)).collect();
            let filter = |rgba: &[u8], channels: Channels| {
                let mut target = vec![7; height * (1 + channels.count() * width)];
                let is_complete = filter_rows(rgba, width, channels, &mut target);
                (is_complete, target)
            };
            let expected = |rgba: &[u8], count: usize| {
                let row = |row: &[u8]| -> Vec<u8> {
                    let left = |index: usize| if index < 4 { 0 } else { row[index - 4] };
                    let indices = (0..4 * width).filter(|index| index % 4 < count);
                    std::iter::once(SUB).chain(indices.map(|index| row[index].wrapping_sub(left(index)))).collect()
                };
                rgba.chunks_exact(4 * width).flat_map(row).collect::<Vec<u8>>()
            };
            rgba[4 * width * height - 1] = 254;
            assert_eq!(filter(&rgba, Channels::Rgba), (true, expected(&rgba, 4)));
            rgba.iter_mut().skip(3).step_by(4).for_each(|alpha| *alpha = 255);
            assert_eq!(filter(&rgba, Channels::Rgb), (true, expected(&rgba, 3)));
            for pixel in 0..width * height {
                rgba[4 * pixel + 3] = 254;
                assert!(!filter(&rgba, Channels::Rgb).0, "expected a translucent pixel {pixel} of {width} x {height}");
                rgba[4 * pixel + 3] = 255;
            }
        }
    }
}
