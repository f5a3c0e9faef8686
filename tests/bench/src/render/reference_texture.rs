//! Samples textures for the references: bilinear, repeating, without mip levels. Decoded texels are f32.

use modalcast_model::domain::Texture;

/// Content of an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum TextureRole {
    /// sRGB colors; the color of fully transparent texels is ignored.
    Color,
    /// Tangent-space normals. The channels are decoded to byte / 255, from 0 to 1.
    Normal,
}

/// One decoded image, top row first; texture coordinate (0, 0) is its top left corner.
#[derive(Debug, Clone)]
pub(super) struct ReferenceTexture {
    width: usize,
    height: usize,
    role: TextureRole,
    rgba: Vec<[f32; 4]>,
}

impl ReferenceTexture {
    pub(super) fn new(texture: &Texture, role: TextureRole) -> Self {
        let decoded_levels: [f32; 256] = std::array::from_fn(|byte| match role {
            TextureRole::Color => linear_from_srgb(byte as f64 / 255.0) as f32,
            TextureRole::Normal => byte as f32 / 255.0,
        });
        let decode_texel = |bytes: &[u8]| {
            let [r, g, b] = [0, 1, 2].map(|channel| decoded_levels[usize::from(bytes[channel])]);
            [r, g, b, f32::from(bytes[3]) / 255.0]
        };
        let rgba = texture.rgba().chunks_exact(4).map(decode_texel).collect();
        Self { width: texture.width() as usize, height: texture.height() as usize, role, rgba }
    }

    /// The four texels around a point, with their bilinear weights.
    fn bilinear_footprint(&self, uv: [f64; 2]) -> [([f32; 4], f64); 4] {
        let neighbors = |coordinate: f64, count: usize| {
            // Wrap before scaling, so that large coordinates keep the precision of their fraction.
            let position = coordinate.rem_euclid(1.0) * count as f64 - 0.5;
            let lower_index = position.floor();
            let wrap_index = |index: f64| (index as i64).rem_euclid(count as i64) as usize;
            (wrap_index(lower_index), wrap_index(lower_index + 1.0), position - lower_index)
        };
        let ((left, right, u), (top, bottom, v)) = (neighbors(uv[0], self.width), neighbors(uv[1], self.height));
        let texel = |x: usize, y: usize| self.rgba[y * self.width + x];
        [
            (texel(left, top), (1.0 - u) * (1.0 - v)),
            (texel(right, top), u * (1.0 - v)),
            (texel(left, bottom), (1.0 - u) * v),
            (texel(right, bottom), u * v),
        ]
    }

    /// Samples alpha.
    pub(super) fn sample_alpha(&self, uv: [f64; 2]) -> f64 {
        self.bilinear_footprint(uv).iter().map(|(texel, weight)| f64::from(texel[3]) * weight).sum()
    }

    /// Samples all four channels. Fully transparent texels have no color, so the weights of the other texels' colors
    /// are normalized to the sum 1.
    pub(super) fn sample(&self, uv: [f64; 2]) -> [f64; 4] {
        let footprint = self.bilinear_footprint(uv);
        let has_color = |texel: &[f32; 4]| self.role == TextureRole::Normal || texel[3] > 0.0;
        let color_weight: f64 = footprint.iter().filter(|(texel, _)| has_color(texel)).map(|(_, weight)| weight).sum();
        let mut rgba = [0.0; 4];
        for (texel, weight) in &footprint {
            rgba[3] += f64::from(texel[3]) * weight;
            if has_color(texel) && color_weight > 0.0 {
                (0..3).for_each(|channel| rgba[channel] += f64::from(texel[channel]) * weight / color_weight);
            }
        }
        rgba
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

    /// An opaque red texel, and to its right a transparent green texel.
    fn texture_of_two_texels(role: TextureRole) -> ReferenceTexture {
        ReferenceTexture::new(&Texture::new("two", 2, 1, vec![255, 0, 0, 255, 0, 255, 0, 0]).expect("a texture"), role)
    }

    #[test]
    fn texel_centers_are_exact_and_images_repeat() {
        let texture = texture_of_two_texels(TextureRole::Normal);
        for offset in [-3.0, 0.0, 1e6] {
            assert_eq!(texture.sample([0.25 + offset, 0.5]), [1.0, 0.0, 0.0, 1.0]);
            assert_eq!(texture.sample([0.75 + offset, 7.5]), [0.0, 1.0, 0.0, 0.0]);
        }
        assert_eq!(texture.sample([0.5, 0.5]), [0.5, 0.5, 0.0, 0.5]);
        assert_eq!(texture.sample([0.0, 0.5]), [0.5, 0.5, 0.0, 0.5], "the edge is interpolated with the opposite edge");
    }

    #[test]
    fn transparent_texels_do_not_affect_color() {
        let texture = texture_of_two_texels(TextureRole::Color);
        assert_eq!(texture.sample([0.5, 0.5]), [1.0, 0.0, 0.0, 0.5]);
        assert_eq!(texture.sample_alpha([0.5, 0.5]), 0.5);
        assert_eq!(texture.sample([0.75, 0.5]), [0.0; 4]);
    }

    #[test]
    fn srgb_curves_are_inverse() {
        for value in [0.0, 0.001, 0.0031308, 0.2, 0.5, 1.0] {
            assert!((linear_from_srgb(srgb_from_linear(value)) - value).abs() < 1e-7, "{value}");
        }
        // 1.055 x 0.5^(1 / 2.4) - 0.055.
        assert!((srgb_from_linear(0.5) - 0.735_356_98).abs() < 1e-6);
    }
}
