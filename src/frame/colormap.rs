//! Color mapping: viridis, and the conversion of an AOV of values to RGBA8 sRGB.

/// The viridis color map: maps 0 to 1 to encoded sRGB, 0 to 1 per channel; values outside are clamped. It is
/// perceptually uniform and suitable for color-blind readers.
///
/// The map is by Smith and van der Walt (matplotlib, 2015). The polynomial of degree six is Matt Zucker's fit
/// (shadertoy.com/view/WlfXRN, CC0). Its colors differ from the table by at most 0.02 per channel.
pub fn viridis(share: f32) -> [f32; 3] {
    const TERMS: [[f32; 3]; 7] = [
        [0.277_727_33, 0.005_407_344_5, 0.334_099_8],
        [0.105_093_04, 1.404_613_5, 1.384_590_2],
        [-0.330_861_83, 0.214_847_56, 0.095_095_16],
        [-4.634_230_5, -5.799_101, -19.332_441],
        [6.228_27, 14.179_933, 56.690_55],
        [4.776_385, -13.745_145, -65.353_03],
        [-5.435_456, 4.645_852_6, 26.312_435],
    ];
    let share = share.clamp(0.0, 1.0);
    [0, 1, 2].map(|channel| {
        let sum = TERMS.iter().rev().fold(0.0, |sum, term| sum * share + term[channel]);
        sum.clamp(0.0, 1.0)
    })
}

/// Gray level of the background, linear.
const BACKGROUND: f32 = 0.87;
/// The fraction of the light that does not depend on the orientation of the surface.
const AMBIENT_SHARE: f32 = 0.62;

/// Converts samples of values from the renderer to RGBA8 sRGB. Each sample is a word with the fraction of the scale
/// (lower 16 bits) and the cosine of the angle between normal and view direction (upper 16 bits); 0 means background. A
/// surface that faces the camera has exactly the viridis color. A surface that turns away has up to 38 % less light, so
/// that the shape is visible. A pixel is the mean of its samples in linear light.
pub fn apply_colormap(words: &[u32], samples: usize) -> Vec<u8> {
    let light = |word: u32| match word {
        0 => [BACKGROUND; 3],
        word => {
            let shade = AMBIENT_SHARE + (1.0 - AMBIENT_SHARE) * (word >> 16) as f32 / 65535.0;
            viridis((word & 0xFFFF) as f32 / 65535.0).map(|channel| shade * linear(channel))
        }
    };
    let pixel = |words: &[u32]| {
        let mut sum = [0.0; 3];
        for word in words {
            let light = light(*word);
            (0..3).for_each(|channel| sum[channel] += light[channel] / words.len() as f32);
        }
        let [r, g, b] = sum.map(|channel| (255.0 * encoded(channel)).round() as u8);
        [r, g, b, 255]
    };
    // Cache the last pixel, because neighboring pixels mostly show the same background.
    let mut last = (Vec::new(), [0; 4]);
    let mut rgba = Vec::with_capacity(4 * words.len() / samples.max(1));
    for words in words.chunks_exact(samples.max(1)) {
        if last.0 != words {
            last = (words.to_vec(), pixel(words));
        }
        rgba.extend(last.1);
    }
    rgba
}

fn linear(encoded: f32) -> f32 {
    if encoded <= 0.040_45 { encoded / 12.92 } else { ((encoded + 0.055) / 1.055).powf(2.4) }
}

fn encoded(linear: f32) -> f32 {
    if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn viridis_has_the_colours_of_its_table_and_grows_lighter_all_along() {
        // matplotlib's table at 0, 1/4, 1/2, 3/4 and 1.
        let table = [
            [0.267_004, 0.004_874, 0.329_415],
            [0.229_739, 0.322_361, 0.545_706],
            [0.127_568, 0.566_949, 0.550_556],
            [0.369_214, 0.788_888, 0.382_914],
            [0.993_248, 0.906_157, 0.143_936],
        ];
        for (at, want) in table.iter().enumerate() {
            let got = viridis(at as f32 / 4.0);
            assert!(got.iter().zip(want).all(|(got, want): (&f32, &f32)| (got - want).abs() < 0.02), "{at}: {got:?}");
        }
        let luminance = |share: f32| {
            let [r, g, b] = viridis(share).map(linear);
            0.2126 * r + 0.7152 * g + 0.0722 * b
        };
        assert!((0..100).all(|at| luminance((at + 1) as f32 / 100.0) > luminance(at as f32 / 100.0)));
        assert_eq!((viridis(-1.0), viridis(f32::INFINITY)), (viridis(0.0), viridis(1.0)));
    }

    #[test]
    fn a_surface_that_faces_the_eye_has_the_maps_colour_and_samples_are_mixed_as_light() {
        let faces = |share: u32| 0xFFFF_0000 | share;
        let rgba = apply_colormap(&[faces(0), faces(65535), 0, 0x0001_0000], 1);
        let want = |share: f32| viridis(share).map(|channel| (255.0 * channel).round() as u8);
        assert_eq!((&rgba[..3], &rgba[4..7]), (&want(0.0)[..], &want(1.0)[..]));
        assert_eq!(rgba[8], rgba[9], "grey behind");
        assert!(rgba[14] < rgba[2] && rgba[14] > rgba[2] / 2, "darker, not black");
        let mixed = apply_colormap(&[0, faces(0)], 2);
        assert!(mixed[0] < rgba[8] && mixed[0] > rgba[0]);
    }
}
