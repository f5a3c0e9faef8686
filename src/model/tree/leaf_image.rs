//! Procedural leaf texture from a seed: a 256 x 256 sRGB image. Alpha is the outline of the leaf with its tip at the
//! top; at the right edge is an opaque strip for stems.

use super::noise::{GradientNoise, lerp_color, smoothstep};
use super::random::SplitMix64;
use crate::domain::Texture;
use crate::error::Result;

const SIDE: usize = 256;

/// The horizontal range of the leaf. It keeps a margin on the left, where filtering with wrap mode "repeat" would blend
/// in the strip at the right edge.
pub(super) const LEAF_SPAN: [f32; 2] = [0.03, 0.90];

/// The center of the strip for stems.
pub(super) const STEM_U: f32 = 0.965;

/// Left edge of the strip.
const STRIP: f32 = 0.93;

/// The fraction of the height that the petiole takes, at the bottom.
const PETIOLE: f32 = 0.13;

/// Largest half-width of the blade, as a fraction of the leaf's range.
const HALF_WIDTH: f32 = 0.46;

const TEETH: f32 = 19.0;

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
pub(super) fn texture(name: &str, palette: &LeafColors, random: &mut SplitMix64) -> Result<Texture> {
    let mottle =
        [GradientNoise { cells: [7, 9], seed: random.bits() }, GradientNoise { cells: [31, 37], seed: random.bits() }];
    let mut rgba = Vec::with_capacity(4 * SIDE * SIDE);
    for pixel in 0..SIDE * SIDE {
        let u = ((pixel % SIDE) as f32 + 0.5) / SIDE as f32;
        let v = ((pixel / SIDE) as f32 + 0.5) / SIDE as f32;
        let shade = 1.0 + 0.08 * mottle[0].at(u, v) + 0.05 * mottle[1].at(u, v);
        let across = (u - LEAF_SPAN[0]) / (LEAF_SPAN[1] - LEAF_SPAN[0]) - 0.5;
        let (color, cover) = if u >= STRIP { (palette.stem, 1.0) } else { leaf(palette, across, 1.0 - v) };
        rgba.extend(color.map(|channel| (shade * channel).clamp(0.0, 255.0) as u8));
        rgba.push((255.0 * cover).round() as u8);
    }
    Texture::new(name, SIDE as u32, SIDE as u32, rgba)
}

/// Color and coverage at distance `x` from the midrib and `y` above the base of the petiole.
fn leaf(palette: &LeafColors, x: f32, y: f32) -> ([f32; 3], f32) {
    let along = (y - PETIOLE) / (0.985 - PETIOLE);
    let off = x.abs();
    let pixel = 1.2 / SIDE as f32;
    let stalk = 0.016 * (1.0 - 0.85 * along.max(0.0));
    let on_stalk = if along < 0.9 { ((stalk - off) / pixel + 0.5).clamp(0.0, 1.0) } else { 0.0 };
    if along <= 0.0 {
        return (palette.stem, on_stalk);
    }
    let half = half_width(along);
    let cover = ((half - off) / (1.6 * pixel) + 0.5).clamp(0.0, 1.0).max(on_stalk);
    let across = (off / half.max(1e-3)).min(1.2);
    let body = lerp_color(palette.blade, palette.edge, smoothstep(0.35, 1.1, across));
    // Between two side veins the blade bulges and appears lighter.
    let (vein, bulge) = side_vein(along, off, across);
    let bulged = body.map(|channel| channel * (0.93 + 0.14 * bulge));
    let veined = lerp_color(bulged, palette.vein, 0.75 * vein);
    (lerp_color(veined, palette.vein, smoothstep(1.9 * stalk, 0.6 * stalk, off)), cover)
}

/// Half-width of the blade: egg-shaped with an elongated tip and forward-pointing teeth.
fn half_width(along: f32) -> f32 {
    let t = along.clamp(0.0, 1.0);
    let egg = (std::f32::consts::PI * t.powf(0.74)).sin().max(0.0).powf(0.72);
    let tip = 1.0 - 0.42 * smoothstep(0.70, 0.96, t);
    let tooth = (t * TEETH).fract();
    HALF_WIDTH * egg * tip * (0.93 + 0.07 * tooth * tooth.sqrt())
}

/// Intensity of the side veins, and relative distance from the nearest one (1 halfway between two).
fn side_vein(along: f32, off: f32, across: f32) -> (f32, f32) {
    // Veins leave the midrib at equal intervals and bend towards the tip.
    let phase = (along - 0.62 * off - 0.35 * off * off) * 8.5;
    let from_vein = (phase - phase.round()).abs();
    let width = 0.10 * (1.0 - 0.75 * across.min(1.0));
    let vein = smoothstep(width, 0.35 * width, from_vein) * smoothstep(1.05, 0.75, across);
    (vein, smoothstep(0.0, 0.5, from_vein))
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
    fn the_outline_covers_a_part_of_the_image_and_the_stem_strip_all_of_its_own() {
        let image = texture("leaf", &PALETTE, &mut SplitMix64::new(1)).expect("made");
        let opaque = |pixel: usize| image.rgba()[4 * pixel + 3] >= 128;
        let share = (0..SIDE * SIDE).filter(|pixel| opaque(*pixel)).count() as f64 / (SIDE * SIDE) as f64;
        assert!((0.2..0.8).contains(&share), "{share} of the image is leaf");
        let strip = (STEM_U * SIDE as f32) as usize;
        assert!((0..SIDE).all(|row| opaque(row * SIDE + strip)));
        assert!(!opaque(0) && opaque(SIDE / 2 * SIDE + (0.45 * SIDE as f32) as usize));
    }

    #[test]
    fn the_outline_is_serrated_and_the_petiole_reaches_the_foot() {
        let widths: Vec<f32> = (20..80).map(|step| half_width(step as f32 / 100.0)).collect();
        let turns = widths.windows(3).filter(|w| (w[1] - w[0]) * (w[2] - w[1]) < 0.0).count();
        assert!(turns >= 12, "{turns} turns of the outline");
        assert_eq!(leaf(&PALETTE, 0.0, 0.01).1, 1.0);
        assert_eq!(leaf(&PALETTE, 0.1, 0.01).1, 0.0);
    }

    #[test]
    fn transparent_pixels_are_green_too_so_that_smaller_copies_get_no_dark_rim() {
        let image = texture("leaf", &PALETTE, &mut SplitMix64::new(1)).expect("made");
        let hidden = image.rgba().chunks_exact(4).filter(|pixel| pixel[3] == 0);
        assert!(hidden.clone().count() > 1000);
        assert!(hidden.into_iter().all(|pixel| pixel[1] > 70));
    }
}
