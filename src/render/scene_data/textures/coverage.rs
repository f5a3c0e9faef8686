//! Coverage-preserving mipmap levels of cut-outs (after Castano, "Computing alpha mipmaps", 2010).
//!
//! The coverage of an image is the fraction with an alpha at or above the cutoff, sampled bilinearly as in the shaders.
//! With plain averages, an image of which more than half is covered becomes covered completely in coarse levels: leaves
//! grow into the polygons that carry them. If less than half is covered, leaves vanish. Therefore the alpha of each
//! level is scaled until its coverage equals that of level 0. Alpha is clamped to 1, so the result is not exact if
//! alpha is raised.

use super::LinearImage;

/// Minimum number of samples of alpha along each side of a level.
const MIN_SAMPLES_PER_SIDE: u32 = 256;

/// Scales the alpha of all levels except level 0, so that they have the coverage of level 0.
pub(crate) fn preserve_coverage(chain: &mut [LinearImage], cutoff: f32) {
    let Some((finest, coarser_levels)) = chain.split_first_mut() else { return };
    let target_coverage = coverage(finest, cutoff);
    for level in coarser_levels {
        let level_threshold = find_threshold(level, target_coverage);
        if level_threshold > 0.0 {
            let scale = cutoff / level_threshold;
            level.texels.iter_mut().for_each(|texel| texel[3] = (scale * texel[3]).min(1.0));
        }
    }
}

/// Fraction of an image whose alpha is at or above the cutoff.
pub(crate) fn coverage(image: &LinearImage, cutoff: f32) -> f32 {
    let alphas = sample_alpha(image);
    alphas.iter().filter(|alpha| **alpha >= cutoff).count() as f32 / alphas.len() as f32
}

/// Finds the cutoff for which the image has the given coverage. It is the mean of the lowest covered and the highest
/// uncovered alpha, so that no sample is close to it.
fn find_threshold(image: &LinearImage, coverage: f32) -> f32 {
    let mut alphas = sample_alpha(image);
    let covered_count = (coverage * alphas.len() as f32).round() as usize;
    let Some(last_covered) = covered_count.checked_sub(1) else {
        // Nothing is covered at level 0, so nothing may be covered here.
        return f32::INFINITY;
    };
    let (_, lowest_covered, uncovered) = alphas.select_nth_unstable_by(last_covered, |a, b| b.total_cmp(a));
    0.5 * (*lowest_covered + uncovered.iter().copied().fold(0.0, f32::max))
}

/// Alpha interpolated on a regular grid with at least one sample per texel.
fn sample_alpha(image: &LinearImage) -> Vec<f32> {
    let (width, height) = (image.width, image.height);
    let samples_per_texel = MIN_SAMPLES_PER_SIDE.div_ceil(width.min(height)).max(1);
    let mut alphas = Vec::with_capacity((width * samples_per_texel) as usize * (height * samples_per_texel) as usize);
    let interpolate = |sample: u32, count: u32| {
        let position = (sample as f32 + 0.5) / samples_per_texel as f32 - 0.5;
        let low = position.floor();
        let wrap = |index: i64| index.rem_euclid(i64::from(count)) as u32;
        (wrap(low as i64), wrap(low as i64 + 1), position - low)
    };
    for y in 0..height * samples_per_texel {
        let (top, bottom, v) = interpolate(y, height);
        for x in 0..width * samples_per_texel {
            let (left, right, u) = interpolate(x, width);
            let row_alpha = |y: u32| image.texel_at(left, y)[3] * (1.0 - u) + image.texel_at(right, y)[3] * u;
            alphas.push(row_alpha(top) * (1.0 - v) + row_alpha(bottom) * v);
        }
    }
    alphas
}

#[cfg(test)]
mod tests {
    use super::super::{TextureRole, mip_levels};
    use super::*;
    use modalcast_model::domain::Texture;
    use modalcast_model::scene::SceneParts;

    /// Coverage of each mipmap level, computed from its bytes. `is_preserved`: whether the levels are scaled.
    fn level_coverages(texture: &Texture, cutoff: f32, is_preserved: bool) -> Vec<f32> {
        let chain = mip_levels(texture, TextureRole::Color, is_preserved.then_some(cutoff));
        let coverage_of = |(level, rgba): (usize, &Vec<u8>)| {
            let level_side = |side: u32| (side >> level).max(1);
            let level_texture =
                Texture::new("level", level_side(texture.width()), level_side(texture.height()), rgba.clone())
                    .expect("a valid texture");
            coverage(&LinearImage::new(&level_texture, TextureRole::Color), cutoff)
        };
        chain.iter().enumerate().map(coverage_of).collect()
    }

    /// An opaque disc in 64 x 64 transparent texels. `radius` is in halves of the side.
    fn disc(radius: f32) -> Texture {
        let offset = |index: u32| (index as f32 + 0.5) / 32.0 - 1.0;
        let alpha = |index: u32| 255 * u8::from(offset(index % 64).hypot(offset(index / 64)) < radius);
        let rgba = (0..64 * 64).flat_map(|index| [0, 99, 0, alpha(index)]).collect();
        Texture::new("disc", 64, 64, rgba).expect("a valid texture")
    }

    #[test]
    fn levels_down_to_four_by_four_texels_preserve_coverage() {
        for (radius, cutoff) in [(0.4, 0.5), (0.9, 0.5), (0.7, 0.2)] {
            let texture = disc(radius);
            let max_error = |is_preserved: bool| {
                let coverages = level_coverages(&texture, cutoff, is_preserved);
                // Sides of 64, 32, 16, 8 and 4 texels.
                coverages[..5].iter().map(|coverage| (coverage - coverages[0]).abs()).fold(0.0, f32::max)
            };
            assert!(max_error(true) < 0.02, "{radius} {cutoff}: expected an error below 0.02, got {}", max_error(true));
            assert!(
                max_error(false) > 0.06,
                "{radius} {cutoff}: expected a larger error without preservation, got {}",
                max_error(false)
            );
        }
    }

    #[test]
    fn empty_and_full_coverage_do_not_change() {
        for (radius, expected) in [(0.0, 0.0), (2.0, 1.0)] {
            assert!(level_coverages(&disc(radius), 0.5, true).iter().all(|coverage| *coverage == expected), "{radius}");
        }
    }

    #[test]
    fn cutoff_exists_only_if_all_materials_agree() {
        use crate::scene_data::geometry::tests::squares;
        use modalcast_model::domain::{AlphaMode, Material};
        // One material per alpha mode and alpha.
        let cutoff_of = |modes: &[(AlphaMode, f32)]| {
            let material = |(alpha_mode, alpha): &(AlphaMode, f32)| Material {
                alpha_mode: *alpha_mode,
                alpha: *alpha,
                color_texture: Some(0),
                ..Material::default()
            };
            let mut parts: SceneParts = squares(modes.iter().map(material).collect());
            parts.textures.push(disc(0.5));
            super::super::cutoff(&modalcast_model::scene::Scene::new(parts).expect("a valid scene"), 0)
        };
        let mask = |cutoff: f32| AlphaMode::Mask { cutoff };
        assert_eq!(cutoff_of(&[(mask(0.5), 1.0), (mask(0.4), 0.8)]), Some(0.5), "expected cutoff / alpha");
        for modes in [[mask(0.5), AlphaMode::Opaque], [mask(0.5), mask(0.6)], [AlphaMode::Blend, AlphaMode::Blend]] {
            assert_eq!(cutoff_of(&modes.map(|mode| (mode, 1.0))), None, "{modes:?}");
        }
        assert_eq!(cutoff_of(&[(mask(0.5), 0.3)]), None, "expected none, because a cutoff above 1 covers nothing");
    }
}
