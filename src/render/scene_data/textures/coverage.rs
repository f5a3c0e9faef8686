//! Coverage-preserving mipmap levels of cut-outs (after Castano, "Computing alpha mipmaps", 2010).
//!
//! Averaging alpha destroys shapes. If more than half of an image is covered, the coarse levels are covered completely,
//! and small leaves grow into the polygons that carry them; if less than half is covered, they vanish. The alpha of
//! each level is therefore scaled until the share at or above the cutoff, sampled bilinearly as in the shaders, equals
//! that of level 0. Alpha is clamped to 1, so a level with raised alpha falls short by what the clamp removes, and a
//! level of one texel cannot keep a shape.

use super::LinearImage;

/// Minimum number of samples along each side of a level.
const MIN_SAMPLES_PER_SIDE: u32 = 256;

/// Scales the alpha of all levels but the first.
pub(crate) fn preserve_coverage(chain: &mut [LinearImage], cutoff: f32) {
    let Some((first, rest)) = chain.split_first_mut() else { return };
    let share = coverage(first, cutoff);
    for level in rest {
        let threshold = threshold(level, share);
        if threshold > 0.0 {
            let scale = cutoff / threshold;
            level.texels.iter_mut().for_each(|texel| texel[3] = (scale * texel[3]).min(1.0));
        }
    }
}

/// Share of an image whose alpha is at or above the cutoff.
pub(crate) fn coverage(image: &LinearImage, cutoff: f32) -> f32 {
    let samples = samples(image);
    samples.iter().filter(|alpha| **alpha >= cutoff).count() as f32 / samples.len() as f32
}

/// The alpha that exactly this share of an image reaches: the middle between the lowest alpha that counts and the
/// highest that does not, so that plateaus stay clear of the cutoff.
fn threshold(image: &LinearImage, share: f32) -> f32 {
    let mut samples = samples(image);
    let rank = (share * samples.len() as f32).round() as usize;
    let Some(last) = rank.checked_sub(1) else {
        // Nothing is covered at level 0, so nothing may be covered here.
        return f32::INFINITY;
    };
    let (_, reached, rest) = samples.select_nth_unstable_by(last, |a, b| b.total_cmp(a));
    0.5 * (*reached + rest.iter().copied().fold(0.0, f32::max))
}

/// Alpha interpolated on an even grid with at least one sample per texel.
fn samples(image: &LinearImage) -> Vec<f32> {
    let (width, height) = (image.width, image.height);
    let fine = MIN_SAMPLES_PER_SIDE.div_ceil(width.min(height)).max(1);
    let mut samples = Vec::with_capacity((width * fine) as usize * (height * fine) as usize);
    let along = |step: u32, count: u32| {
        let place = (step as f32 + 0.5) / fine as f32 - 0.5;
        let low = place.floor();
        let wrap = |at: i64| at.rem_euclid(i64::from(count)) as u32;
        (wrap(low as i64), wrap(low as i64 + 1), place - low)
    };
    for y in 0..height * fine {
        let (top, bottom, v) = along(y, height);
        for x in 0..width * fine {
            let (left, right, u) = along(x, width);
            let row = |y: u32| image.at(left, y)[3] * (1.0 - u) + image.at(right, y)[3] * u;
            samples.push(row(top) * (1.0 - v) + row(bottom) * v);
        }
    }
    samples
}

#[cfg(test)]
mod tests {
    use super::super::{TextureArray, TextureRole, mip_levels};
    use super::*;
    use modalcast_model::domain::Texture;
    use modalcast_model::scene::SceneParts;

    /// Covered share of each level, computed from its bytes.
    fn shares(texture: &Texture, cutoff: f32, kept: bool) -> Vec<f32> {
        let array = TextureArray { width: texture.width(), height: texture.height(), layers: vec![0] };
        let chain = mip_levels(texture, &array, TextureRole::Color, kept.then_some(cutoff));
        let share = |(level, rgba): (usize, &Vec<u8>)| {
            let side = |side: u32| (side >> level).max(1);
            let rgba = Texture::new("level", side(array.width), side(array.height), rgba.clone()).expect("fits");
            coverage(&LinearImage::new(&rgba, TextureRole::Color), cutoff)
        };
        chain.iter().enumerate().map(share).collect()
    }

    fn disc(radius: f32) -> Texture {
        let inside = |at: u32| (at as f32 + 0.5) / 32.0 - 1.0;
        let alpha = |at: u32| 255 * u8::from(inside(at % 64).hypot(inside(at / 64)) < radius);
        let rgba = (0..64 * 64).flat_map(|at| [0, 99, 0, alpha(at)]).collect();
        Texture::new("disc", 64, 64, rgba).expect("fits")
    }

    #[test]
    fn every_level_down_to_four_texels_leaves_as_much_as_the_first_and_averages_do_not() {
        for (radius, cutoff) in [(0.4, 0.5), (0.9, 0.5), (0.7, 0.2)] {
            let texture = disc(radius);
            let off = |kept: bool| {
                let shares = shares(&texture, cutoff, kept);
                shares[..5].iter().map(|share| (share - shares[0]).abs()).fold(0.0, f32::max)
            };
            assert!(off(true) < 0.02, "{radius} {cutoff}: off by {}", off(true));
            assert!(off(false) > 0.06, "control, {radius} {cutoff}: averages are off by {}", off(false));
        }
    }

    #[test]
    fn what_is_wholly_there_or_wholly_cut_away_stays_so() {
        for (radius, share) in [(0.0, 0.0), (2.0, 1.0)] {
            assert!(shares(&disc(radius), 0.5, true).iter().all(|own| *own == share), "{radius}");
        }
    }

    #[test]
    fn only_images_that_nothing_but_cut_outs_reads_have_a_cutoff() {
        use crate::scene_data::geometry::tests::squares;
        use modalcast_model::domain::{AlphaMode, Material};
        let cutoff_of = |modes: &[(AlphaMode, f32)]| {
            let material = |(alpha_mode, alpha): &(AlphaMode, f32)| Material {
                alpha_mode: *alpha_mode,
                alpha: *alpha,
                color_texture: Some(0),
                ..Material::default()
            };
            let mut parts: SceneParts = squares(modes.iter().map(material).collect());
            parts.textures.push(disc(0.5));
            super::super::cutoff(&modalcast_model::scene::Scene::new(parts).expect("good"), 0)
        };
        let mask = |cutoff: f32| AlphaMode::Mask { cutoff };
        assert_eq!(cutoff_of(&[(mask(0.5), 1.0), (mask(0.4), 0.8)]), Some(0.5));
        for wrong in [[mask(0.5), AlphaMode::Opaque], [mask(0.5), mask(0.6)], [AlphaMode::Blend, AlphaMode::Blend]] {
            assert_eq!(cutoff_of(&wrong.map(|mode| (mode, 1.0))), None, "{wrong:?}");
        }
        assert_eq!(cutoff_of(&[(mask(0.5), 0.3)]), None, "all is cut away");
    }
}
