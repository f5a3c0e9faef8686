//! Generates the texture of a spray of needles: a twig from left to right with needles on both sides.

use fastrand::Rng;
use rayon::prelude::*;

use modalcast_model::domain::Texture;
use modalcast_model::error::Result;

const WIDE: usize = 256;
const TALL: usize = 128;
/// Needles per side, and half their thickness in pixels.
const NEEDLES: usize = 46;
const THICK: f32 = 1.7;

/// A needle: its end points in pixels, and its brightness.
struct Needle {
    from: [f32; 2],
    to: [f32; 2],
    light: f32,
}

/// Draws the texture; `color`: sRGB, 0 to 255, of a needle of brightness 1.
///
/// # Errors
/// None in practice: its size is a constant.
pub(super) fn texture(color: [f32; 3], seed: u64) -> Result<Texture> {
    let needles = needles(&mut Rng::with_seed(seed));
    let pixel = |at: usize| {
        let place = [(at % WIDE) as f32 + 0.5, (at / WIDE) as f32 + 0.5];
        let mut best = (0.0_f32, 1.0_f32);
        for needle in &needles {
            // Edges are antialiased over one pixel.
            let cover = (THICK + 0.5 - distance(needle, place)).clamp(0.0, 1.0);
            if cover > best.0 {
                best = (cover, needle.light);
            }
        }
        let twig = (2.4 - (place[1] - 0.5 * TALL as f32).abs()).clamp(0.0, 1.0);
        let [r, g, b] = if twig > best.0 && place[0] < 0.92 * WIDE as f32 {
            [96.0, 78.0, 58.0]
        } else {
            color.map(|channel| channel * best.1)
        };
        let alpha = 255.0 * if place[0] < 0.92 * WIDE as f32 { best.0.max(twig) } else { best.0 };
        [r, g, b, alpha].map(|channel| channel.clamp(0.0, 255.0) as u8)
    };
    let rgba: Vec<u8> = (0..WIDE * TALL).into_par_iter().flat_map_iter(pixel).collect();
    Texture::new("needles", WIDE as u32, TALL as u32, rgba)
}

fn needles(rng: &mut Rng) -> Vec<Needle> {
    let (wide, middle) = (WIDE as f32, 0.5 * TALL as f32);
    let mut any = |most: f32| most * (2.0 * rng.f32() - 1.0);
    let mut all = Vec::new();
    for at in 0..2 * NEEDLES {
        let share = (at / 2) as f32 / NEEDLES as f32;
        let side = if at % 2 == 0 { 1.0 } else { -1.0 };
        let x = 4.0 + 0.88 * wide * share + any(2.0);
        // Shorter at the tip, so that a spray has a round end.
        let long = (0.88 * middle) * (1.0 - share.powi(3)).sqrt() * (1.0 + any(0.1)) + 5.0;
        let slope = 0.55 + any(0.12);
        let to = [(x + slope * long).min(wide - 3.0), middle + side * long.min(middle - 3.0)];
        // Young needles at the tip are brighter.
        all.push(Needle { from: [x, middle], to, light: 0.82 + 0.35 * share + any(0.18) });
    }
    all
}

/// Distance from a point to a needle's segment, pixels.
fn distance(needle: &Needle, [x, y]: [f32; 2]) -> f32 {
    let [ax, ay] = needle.from;
    let [dx, dy] = [needle.to[0] - ax, needle.to[1] - ay];
    let along = (((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy)).clamp(0.0, 1.0);
    (x - ax - along * dx).hypot(y - ay - along * dy)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spray_has_needles_and_holes_and_is_deterministic() {
        let image = texture([60.0, 100.0, 60.0], 3).expect("fits");
        let solid = image.rgba().chunks_exact(4).filter(|texel| texel[3] > 127).count() as f64;
        let share = solid / (WIDE * TALL) as f64;
        assert!((0.3..0.8).contains(&share), "{share}");
        assert_eq!(image, texture([60.0, 100.0, 60.0], 3).expect("fits"));
        assert_ne!(image, texture([60.0, 100.0, 60.0], 4).expect("fits"));
    }
}
