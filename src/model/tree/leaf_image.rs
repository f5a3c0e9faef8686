//! Procedural leaf texture from a seed: a 256 x 256 sRGB image with alpha. It shows one leaf with its tip at the top,
//! and an opaque strip at the right edge, which is the texture of stems. Numbers without a comment are free choices of
//! the leaf's look.

use super::noise::{GradientNoise, lerp_color, smoothstep};
use super::random::SplitMix64;
use crate::domain::Texture;
use crate::error::Result;

/// Side of the image in pixels.
const SIDE: usize = 256;

/// The range of u that the leaf covers. It has a margin on the left, because filtering with wrap mode "repeat" blends
/// the strip at the right edge into the left edge.
pub(crate) const LEAF_SPAN: [f32; 2] = [0.03, 0.90];

/// The texture coordinate u at the center of the strip for stems.
pub(crate) const STEM_U: f32 = 0.965;

/// The texture coordinate u at the left edge of the strip for stems.
const STRIP_LEFT: f32 = 0.93;

/// Length of the petiole at the bottom of the image, as a fraction of the height.
const PETIOLE_LENGTH: f32 = 0.13;

/// The texture coordinate v where the petiole ends and the blade begins. The tip of the blade is near 0.
pub(crate) const LEAF_BLADE_START: f32 = 1.0 - PETIOLE_LENGTH;

/// Height of the tip of the blade, as a fraction of the height of the image.
const TIP_HEIGHT: f32 = 0.985;

/// Largest half-width of the blade, as a fraction of the width of [`LEAF_SPAN`].
const MAX_HALF_WIDTH: f32 = 0.46;

/// Number of teeth per side of the outline.
const TOOTH_COUNT: f32 = 19.0;

/// sRGB colors, 0 to 255.
#[derive(Debug, Clone, Copy)]
pub(super) struct LeafColors {
    pub(super) blade: [f32; 3],
    pub(super) edge: [f32; 3],
    pub(super) vein: [f32; 3],
    pub(super) stem: [f32; 3],
}

/// The texture of a leaf.
///
/// # Errors
/// None in practice, because the sizes are constants.
pub(super) fn texture(name: &str, colors: &LeafColors, random: &mut SplitMix64) -> Result<Texture> {
    let mottle_noise = [
        GradientNoise { cells: [7, 9], seed: random.next_bits() },
        GradientNoise { cells: [31, 37], seed: random.next_bits() },
    ];
    let mut rgba = Vec::with_capacity(4 * SIDE * SIDE);
    for pixel in 0..SIDE * SIDE {
        let u = ((pixel % SIDE) as f32 + 0.5) / SIDE as f32;
        let v = ((pixel / SIDE) as f32 + 0.5) / SIDE as f32;
        let brightness = 1.0 + 0.08 * mottle_noise[0].sample(u, v) + 0.05 * mottle_noise[1].sample(u, v);
        let x = (u - LEAF_SPAN[0]) / (LEAF_SPAN[1] - LEAF_SPAN[0]) - 0.5;
        let (color, coverage) = if u >= STRIP_LEFT { (colors.stem, 1.0) } else { shade_leaf(colors, x, 1.0 - v) };
        rgba.extend(color.map(|channel| (brightness * channel).clamp(0.0, 255.0) as u8));
        rgba.push((255.0 * coverage).round() as u8);
    }
    Texture::new(name, SIDE as u32, SIDE as u32, rgba)
}

/// Color and coverage at the signed distance `x` from the midrib, as a fraction of the width of [`LEAF_SPAN`], and the
/// height `y` above the base of the petiole, as a fraction of the height of the image.
fn shade_leaf(colors: &LeafColors, x: f32, y: f32) -> ([f32; 3], f32) {
    let blade_fraction = (y - PETIOLE_LENGTH) / (TIP_HEIGHT - PETIOLE_LENGTH);
    let distance = x.abs();
    let pixel_width = 1.2 / SIDE as f32;
    // The petiole continues as the midrib of the blade.
    let midrib_half_width = 0.016 * (1.0 - 0.85 * blade_fraction.max(0.0));
    let midrib_coverage =
        if blade_fraction < 0.9 { ((midrib_half_width - distance) / pixel_width + 0.5).clamp(0.0, 1.0) } else { 0.0 };
    if blade_fraction <= 0.0 {
        return (colors.stem, midrib_coverage);
    }
    let blade_half_width = half_width(blade_fraction);
    let coverage = ((blade_half_width - distance) / (1.6 * pixel_width) + 0.5).clamp(0.0, 1.0).max(midrib_coverage);
    let relative_distance = (distance / blade_half_width.max(1e-3)).min(1.2);
    let base_color = lerp_color(colors.blade, colors.edge, smoothstep(0.35, 1.1, relative_distance));
    // Between two side veins the blade bulges and appears lighter.
    let (vein_intensity, bulge) = side_vein(blade_fraction, distance, relative_distance);
    let bulged_color = base_color.map(|channel| channel * (0.93 + 0.14 * bulge));
    let veined_color = lerp_color(bulged_color, colors.vein, 0.75 * vein_intensity);
    (
        lerp_color(veined_color, colors.vein, smoothstep(1.9 * midrib_half_width, 0.6 * midrib_half_width, distance)),
        coverage,
    )
}

/// Half-width of the blade at a fraction of its height: egg-shaped with an elongated tip and forward-pointing teeth.
fn half_width(blade_fraction: f32) -> f32 {
    let blade_fraction = blade_fraction.clamp(0.0, 1.0);
    let egg_profile = (std::f32::consts::PI * blade_fraction.powf(0.74)).sin().max(0.0).powf(0.72);
    let tip_factor = 1.0 - 0.42 * smoothstep(0.70, 0.96, blade_fraction);
    let tooth_fraction = (blade_fraction * TOOTH_COUNT).fract();
    MAX_HALF_WIDTH * egg_profile * tip_factor * (0.93 + 0.07 * tooth_fraction * tooth_fraction.sqrt())
}

/// Intensity of the side veins, and smoothed distance from the nearest one: 0 on the vein, 1 halfway between two.
fn side_vein(blade_fraction: f32, distance: f32, relative_distance: f32) -> (f32, f32) {
    // Veins leave the midrib at equal intervals and bend towards the tip.
    let phase = (blade_fraction - 0.62 * distance - 0.35 * distance * distance) * 8.5;
    let vein_distance = (phase - phase.round()).abs();
    let width = 0.10 * (1.0 - 0.75 * relative_distance.min(1.0));
    let intensity = smoothstep(width, 0.35 * width, vein_distance) * smoothstep(1.05, 0.75, relative_distance);
    (intensity, smoothstep(0.0, 0.5, vein_distance))
}

#[cfg(test)]
mod tests {
    use super::*;

    const PALETTE: LeafColors = LeafColors {
        blade: [90.0, 130.0, 50.0],
        edge: [80.0, 120.0, 45.0],
        vein: [150.0, 170.0, 90.0],
        stem: [120.0, 110.0, 60.0],
    };

    #[test]
    fn leaf_covers_part_of_the_image_and_the_strip_is_opaque() {
        let image = texture("leaf", &PALETTE, &mut SplitMix64::new(1)).expect("a valid texture");
        let is_opaque = |pixel: usize| image.rgba()[4 * pixel + 3] >= 128;
        let opaque_fraction = (0..SIDE * SIDE).filter(|pixel| is_opaque(*pixel)).count() as f64 / (SIDE * SIDE) as f64;
        assert!((0.2..0.8).contains(&opaque_fraction), "{opaque_fraction} of the image is opaque");
        let strip_column = (STEM_U * SIDE as f32) as usize;
        assert!((0..SIDE).all(|row| is_opaque(row * SIDE + strip_column)));
        // The top left pixel is outside the leaf. The pixel at half the height and u = 0.45 is near the midrib.
        assert!(!is_opaque(0) && is_opaque(SIDE / 2 * SIDE + (0.45 * SIDE as f32) as usize));
    }

    #[test]
    fn outline_is_serrated_and_petiole_reaches_the_bottom() {
        let widths: Vec<f32> = (20..80).map(|step| half_width(step as f32 / 100.0)).collect();
        let turning_points =
            widths.windows(3).filter(|widths| (widths[1] - widths[0]) * (widths[2] - widths[1]) < 0.0).count();
        assert!(turning_points >= 12, "expected at least 12 turning points, got {turning_points}");
        assert_eq!(shade_leaf(&PALETTE, 0.0, 0.01).1, 1.0);
        assert_eq!(shade_leaf(&PALETTE, 0.1, 0.01).1, 0.0);
    }

    /// Dark transparent pixels would darken the outline in smaller mip levels.
    #[test]
    fn transparent_pixels_are_green() {
        let image = texture("leaf", &PALETTE, &mut SplitMix64::new(1)).expect("a valid texture");
        let transparent_pixels = image.rgba().chunks_exact(4).filter(|pixel| pixel[3] == 0);
        assert!(transparent_pixels.clone().count() > 1000);
        assert!(transparent_pixels.into_iter().all(|pixel| pixel[1] > 70));
    }
}
