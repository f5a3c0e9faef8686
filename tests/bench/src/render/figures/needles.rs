//! Draws the texture of a spray: a twig from left to right with needles on both sides. Numbers without a comment are
//! chosen by eye.

use fastrand::Rng;
use rayon::prelude::*;

use modalcast_model::domain::Texture;
use modalcast_model::error::Result;

/// Size of the texture, pixels.
const WIDTH: usize = 256;
const HEIGHT: usize = 128;
/// Needles on each side of the twig.
const NEEDLES: usize = 46;
/// Length of the twig, pixels.
const TWIG_LENGTH: f32 = 0.92 * WIDTH as f32;
/// Half the thickness of a needle, pixels.
const HALF_THICKNESS: f32 = 1.7;

/// A needle: its end points in pixels, and its brightness.
struct Needle {
    base: [f32; 2],
    tip: [f32; 2],
    brightness: f32,
}

/// Draws the texture. `color` is the sRGB color, 0 to 255, of a needle of brightness 1.
///
/// # Errors
/// None in practice: its size is a constant.
pub(super) fn draw_texture(color: [f32; 3], seed: u64) -> Result<Texture> {
    let needles = generate_needles(&mut Rng::with_seed(seed));
    let texel = |index: usize| {
        let position = [(index % WIDTH) as f32 + 0.5, (index / WIDTH) as f32 + 0.5];
        let (mut coverage, mut brightness) = (0.0_f32, 1.0_f32);
        for needle in &needles {
            // Edges are antialiased over one pixel.
            let needle_coverage = (HALF_THICKNESS + 0.5 - distance_to_needle(needle, position)).clamp(0.0, 1.0);
            if needle_coverage > coverage {
                (coverage, brightness) = (needle_coverage, needle.brightness);
            }
        }
        // Half of the twig's thickness is 1.9 pixels, plus half a pixel of antialiasing.
        let twig_coverage = (2.4 - (position[1] - 0.5 * HEIGHT as f32).abs()).clamp(0.0, 1.0);
        let is_within_twig_length = position[0] < TWIG_LENGTH;
        // The twig is brown.
        let [r, g, b] = if twig_coverage > coverage && is_within_twig_length {
            [96.0, 78.0, 58.0]
        } else {
            color.map(|channel| channel * brightness)
        };
        let alpha = 255.0 * if is_within_twig_length { coverage.max(twig_coverage) } else { coverage };
        [r, g, b, alpha].map(|channel| channel.clamp(0.0, 255.0) as u8)
    };
    let rgba: Vec<u8> = (0..WIDTH * HEIGHT).into_par_iter().flat_map_iter(texel).collect();
    Texture::new("needles", WIDTH as u32, HEIGHT as u32, rgba)
}

fn generate_needles(rng: &mut Rng) -> Vec<Needle> {
    let (width, center_y) = (WIDTH as f32, 0.5 * HEIGHT as f32);
    let mut random_offset = |max: f32| max * (2.0 * rng.f32() - 1.0);
    let mut needles = Vec::new();
    for index in 0..2 * NEEDLES {
        let twig_fraction = (index / 2) as f32 / NEEDLES as f32;
        let side = if index % 2 == 0 { 1.0 } else { -1.0 };
        let x = 4.0 + 0.88 * width * twig_fraction + random_offset(2.0);
        // Needles are shorter at the end of the twig, so that the spray has a round end.
        let length = (0.88 * center_y) * (1.0 - twig_fraction.powi(3)).sqrt() * (1.0 + random_offset(0.1)) + 5.0;
        let slope = 0.55 + random_offset(0.12);
        let tip = [(x + slope * length).min(width - 3.0), center_y + side * length.min(center_y - 3.0)];
        // Young needles at the end of the twig are brighter.
        needles.push(Needle {
            base: [x, center_y],
            tip,
            brightness: 0.82 + 0.35 * twig_fraction + random_offset(0.18),
        });
    }
    needles
}

/// Distance from a point to the line segment of a needle, pixels.
fn distance_to_needle(needle: &Needle, [x, y]: [f32; 2]) -> f32 {
    let [ax, ay] = needle.base;
    let [dx, dy] = [needle.tip[0] - ax, needle.tip[1] - ay];
    let t = (((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy)).clamp(0.0, 1.0);
    (x - ax - t * dx).hypot(y - ay - t * dy)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texture_is_partly_opaque_and_depends_on_the_seed_only() {
        let image = draw_texture([60.0, 100.0, 60.0], 3).expect("a texture");
        let opaque_texels = image.rgba().chunks_exact(4).filter(|texel| texel[3] > 127).count() as f64;
        let opaque_fraction = opaque_texels / (WIDTH * HEIGHT) as f64;
        assert!((0.3..0.8).contains(&opaque_fraction), "{opaque_fraction}");
        assert_eq!(image, draw_texture([60.0, 100.0, 60.0], 3).expect("a texture"));
        assert_ne!(image, draw_texture([60.0, 100.0, 60.0], 4).expect("a texture"));
    }
}
