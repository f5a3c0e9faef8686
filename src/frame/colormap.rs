//! Color mapping: viridis, and the conversion of an AOV of values to RGBA8 sRGB.

/// The viridis color map. Maps a fraction of the axis (the range of values from 0 to `Legend::scale_max`) to encoded
/// sRGB with channels from 0 to 1. A fraction outside of 0 to 1 is clamped. The map is perceptually uniform and
/// suitable for color-blind readers.
///
/// The map is by Smith and van der Walt (matplotlib, 2015). The polynomial of degree six is Matt Zucker's fit
/// (shadertoy.com/view/WlfXRN, CC0). Its colors differ from matplotlib's table by at most 0.02 per channel.
pub fn viridis(fraction: f32) -> [f32; 3] {
    const COEFFICIENTS: [[f32; 3]; 7] = [
        [0.277_727_33, 0.005_407_344_5, 0.334_099_8],
        [0.105_093_04, 1.404_613_5, 1.384_590_2],
        [-0.330_861_83, 0.214_847_56, 0.095_095_16],
        [-4.634_230_5, -5.799_101, -19.332_441],
        [6.228_27, 14.179_933, 56.690_55],
        [4.776_385, -13.745_145, -65.353_03],
        [-5.435_456, 4.645_852_6, 26.312_435],
    ];
    let fraction = fraction.clamp(0.0, 1.0);
    // Horner's method per channel.
    [0, 1, 2].map(|channel| {
        let value = COEFFICIENTS.iter().rev().fold(0.0, |value, coefficients| value * fraction + coefficients[channel]);
        value.clamp(0.0, 1.0)
    })
}

/// Linear gray of the background.
const BACKGROUND: f32 = 0.87;
/// The fraction of the light that does not depend on the orientation of the surface.
const AMBIENT_FRACTION: f32 = 0.62;

/// Converts the samples of an AOV (arbitrary output variable) of values to RGBA8 sRGB. A sample is one word, 0 for the
/// background. Otherwise its lower 16 bits are the value as a fraction of the axis, and its upper 16 bits are the
/// cosine of the angle between the normal and the direction to the camera. Both are scaled by 65535.
///
/// A surface that faces the camera has exactly the viridis color. An inclined surface has up to 38 % less light
/// (1 - `AMBIENT_FRACTION`), so that the shape is visible. A pixel is the mean of its samples in linear light.
pub fn apply_colormap(words: &[u32], samples: usize) -> Vec<u8> {
    let linear_color = |word: u32| match word {
        0 => [BACKGROUND; 3],
        word => {
            let shade = AMBIENT_FRACTION + (1.0 - AMBIENT_FRACTION) * (word >> 16) as f32 / 65535.0;
            viridis((word & 0xFFFF) as f32 / 65535.0).map(|channel| shade * srgb_to_linear(channel))
        }
    };
    let mean_color = |words: &[u32]| {
        let mut sum = [0.0; 3];
        for word in words {
            let color = linear_color(*word);
            (0..3).for_each(|channel| sum[channel] += color[channel] / words.len() as f32);
        }
        let [r, g, b] = sum.map(|channel| (255.0 * linear_to_srgb(channel)).round() as u8);
        [r, g, b, 255]
    };
    // Cache the color of the last pixel, because most neighboring pixels show the background.
    let (mut cached_words, mut cached_color) = (Vec::new(), [0; 4]);
    let mut rgba = Vec::with_capacity(4 * words.len() / samples.max(1));
    for pixel_words in words.chunks_exact(samples.max(1)) {
        if cached_words != pixel_words {
            (cached_words, cached_color) = (pixel_words.to_vec(), mean_color(pixel_words));
        }
        rgba.extend(cached_color);
    }
    rgba
}

fn srgb_to_linear(encoded: f32) -> f32 {
    if encoded <= 0.040_45 { encoded / 12.92 } else { ((encoded + 0.055) / 1.055).powf(2.4) }
}

fn linear_to_srgb(linear: f32) -> f32 {
    if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn viridis_matches_matplotlib_with_increasing_luminance() {
        // matplotlib's table at 0, 1/4, 1/2, 3/4 and 1.
        let table = [
            [0.267_004, 0.004_874, 0.329_415],
            [0.229_739, 0.322_361, 0.545_706],
            [0.127_568, 0.566_949, 0.550_556],
            [0.369_214, 0.788_888, 0.382_914],
            [0.993_248, 0.906_157, 0.143_936],
        ];
        for (quarter, expected) in table.iter().enumerate() {
            let actual = viridis(quarter as f32 / 4.0);
            let is_close = actual.iter().zip(expected).all(|(a, b)| (a - b).abs() < 0.02);
            assert!(is_close, "{quarter}/4: expected {expected:?}, got {actual:?}");
        }
        let luminance = |fraction: f32| {
            let [r, g, b] = viridis(fraction).map(srgb_to_linear);
            0.2126 * r + 0.7152 * g + 0.0722 * b
        };
        assert!((0..100).all(|percent| luminance((percent + 1) as f32 / 100.0) > luminance(percent as f32 / 100.0)));
        assert_eq!((viridis(-1.0), viridis(f32::INFINITY)), (viridis(0.0), viridis(1.0)));
    }

    #[test]
    fn apply_colormap_shades_surfaces_and_averages_samples() {
        let facing_word = |value: u32| 0xFFFF_0000 | value;
        // The value is 0, as in the first pixel, and the cosine is 1 / 65535.
        let edge_on_word = 0x0001_0000;
        let rgba = apply_colormap(&[facing_word(0), facing_word(65535), 0, edge_on_word], 1);
        let expected = |fraction: f32| viridis(fraction).map(|channel| (255.0 * channel).round() as u8);
        assert_eq!((&rgba[..3], &rgba[4..7]), (&expected(0.0)[..], &expected(1.0)[..]));
        assert_eq!(rgba[8], rgba[9], "expected a gray background");
        let (facing_blue, edge_on_blue) = (rgba[2], rgba[4 * 3 + 2]);
        assert!(edge_on_blue < facing_blue && edge_on_blue > facing_blue / 2, "expected a darker color, but not black");
        let mean = apply_colormap(&[0, facing_word(0)], 2);
        assert!(mean[0] < rgba[8] && mean[0] > rgba[0], "expected a color between background and surface");
    }
}
