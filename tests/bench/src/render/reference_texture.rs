//! Image sampling of the references: mip level 0, bilinear, repeating, in f32 after decoding.

use modalcast_model::domain::Texture;

/// Content of an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum TextureRole {
    /// sRGB colors; the color of fully transparent texels is ignored.
    Color,
    /// Tangent-space normals, bytes divided by 255.
    Normal,
}

/// One decoded image, top row first; texture coordinate (0, 0) is its top left corner.
#[derive(Debug, Clone)]
pub(super) struct ReferenceTexture {
    width: usize,
    height: usize,
    purpose: TextureRole,
    rgba: Vec<[f32; 4]>,
}

impl ReferenceTexture {
    pub(super) fn new(texture: &Texture, purpose: TextureRole) -> Self {
        let decode: [f32; 256] = std::array::from_fn(|byte| match purpose {
            TextureRole::Color => linear_from_srgb(byte as f64 / 255.0) as f32,
            TextureRole::Normal => byte as f32 / 255.0,
        });
        let texel = |four: &[u8]| {
            let [r, g, b] = [0, 1, 2].map(|channel| decode[usize::from(four[channel])]);
            [r, g, b, f32::from(four[3]) / 255.0]
        };
        let rgba = texture.rgba().chunks_exact(4).map(texel).collect();
        Self { width: texture.width() as usize, height: texture.height() as usize, purpose, rgba }
    }

    /// The four texels around a point and their weights.
    fn around(&self, uv: [f64; 2]) -> [([f32; 4], f64); 4] {
        let along = |coordinate: f64, count: usize| {
            // Wrap first, so that large coordinates keep their fraction.
            let place = coordinate.rem_euclid(1.0) * count as f64 - 0.5;
            let low = place.floor();
            let wrap = |index: f64| (index as i64).rem_euclid(count as i64) as usize;
            (wrap(low), wrap(low + 1.0), place - low)
        };
        let ((left, right, u), (top, bottom, v)) = (along(uv[0], self.width), along(uv[1], self.height));
        let at = |x: usize, y: usize| self.rgba[y * self.width + x];
        [
            (at(left, top), (1.0 - u) * (1.0 - v)),
            (at(right, top), u * (1.0 - v)),
            (at(left, bottom), (1.0 - u) * v),
            (at(right, bottom), u * v),
        ]
    }

    /// Alpha alone.
    pub(super) fn alpha(&self, uv: [f64; 2]) -> f64 {
        self.around(uv).iter().map(|(texel, weight)| f64::from(texel[3]) * weight).sum()
    }

    /// All four channels. Fully transparent texels have no color, so the color weights of the others are renormalized.
    pub(super) fn at(&self, uv: [f64; 2]) -> [f64; 4] {
        let four = self.around(uv);
        let counts = |texel: &[f32; 4]| self.purpose == TextureRole::Normal || texel[3] > 0.0;
        let whole: f64 = four.iter().filter(|(texel, _)| counts(texel)).map(|(_, weight)| weight).sum();
        let mut sum = [0.0; 4];
        for (texel, weight) in &four {
            sum[3] += f64::from(texel[3]) * weight;
            if counts(texel) && whole > 0.0 {
                (0..3).for_each(|channel| sum[channel] += f64::from(texel[channel]) * weight / whole);
            }
        }
        sum
    }
}

/// sRGB decoding by IEC 61966-2-1, 0 to 1.
pub(super) fn linear_from_srgb(encoded: f64) -> f64 {
    if encoded <= 0.040_45 { encoded / 12.92 } else { ((encoded + 0.055) / 1.055).powf(2.4) }
}

/// sRGB encoding, the inverse of [`linear_from_srgb`].
pub(super) fn srgb_from_linear(linear: f64) -> f64 {
    if linear <= 0.003_130_8 { linear * 12.92 } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pair(purpose: TextureRole) -> ReferenceTexture {
        ReferenceTexture::new(&Texture::new("two", 2, 1, vec![255, 0, 0, 255, 0, 255, 0, 0]).expect("fits"), purpose)
    }

    #[test]
    fn texel_centers_are_exact_and_images_repeat() {
        let texels = pair(TextureRole::Normal);
        for turn in [-3.0, 0.0, 1e6] {
            assert_eq!(texels.at([0.25 + turn, 0.5]), [1.0, 0.0, 0.0, 1.0]);
            assert_eq!(texels.at([0.75 + turn, 7.5]), [0.0, 1.0, 0.0, 0.0]);
        }
        assert_eq!(texels.at([0.5, 0.5]), [0.5, 0.5, 0.0, 0.5]);
        assert_eq!(texels.at([0.0, 0.5]), [0.5, 0.5, 0.0, 0.5], "the rim blends with the other side");
    }

    #[test]
    fn transparent_texels_do_not_affect_color() {
        let texels = pair(TextureRole::Color);
        assert_eq!(texels.at([0.5, 0.5]), [1.0, 0.0, 0.0, 0.5]);
        assert_eq!(texels.alpha([0.5, 0.5]), 0.5);
        assert_eq!(texels.at([0.75, 0.5]), [0.0; 4]);
    }

    #[test]
    fn srgb_curves_are_inverse() {
        for value in [0.0, 0.001, 0.0031308, 0.2, 0.5, 1.0] {
            assert!((linear_from_srgb(srgb_from_linear(value)) - value).abs() < 1e-7, "{value}");
        }
        assert!((srgb_from_linear(0.5) - 0.735_356_98).abs() < 1e-6);
    }
}
