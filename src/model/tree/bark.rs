//! Procedural bark from a seed: a tiling sRGB color image and its tangent-space normal map (+Y up), 512 x 512 each.

use rayon::prelude::*;

use super::noise::{GradientNoise, lerp_color, smoothstep};
use super::random::SplitMix64;
use crate::domain::Texture;
use crate::error::Result;

/// Side of both images in pixels.
const SIDE: usize = 512;

/// Height of the ridges above the furrows, in tile widths.
const RELIEF: f32 = 0.020;

// sRGB colors, 0 to 255.
const FURROW: [f32; 3] = [70.0, 57.0, 47.0];
const RIDGE: [f32; 3] = [126.0, 109.0, 92.0];
const CREST: [f32; 3] = [166.0, 152.0, 135.0];
const LICHEN: [f32; 3] = [126.0, 126.0, 92.0];

/// The color image and the normal map.
///
/// # Errors
/// None in practice, because the sizes are constants.
pub(super) fn textures(random: &mut SplitMix64) -> Result<[Texture; 2]> {
    let layers = BarkLayers::new(random);
    let pixels_of_row = |row: usize| (0..SIDE).map(move |column| (column, row));
    let heights: Vec<f32> = (0..SIDE * SIDE)
        .into_par_iter()
        .with_min_len(SIDE)
        .map(|pixel| layers.height((pixel % SIDE) as f32 / SIDE as f32, (pixel / SIDE) as f32 / SIDE as f32))
        .collect();
    let mut colors = Vec::with_capacity(4 * SIDE * SIDE);
    let mut normals = Vec::with_capacity(4 * SIDE * SIDE);
    for (column, row) in (0..SIDE).flat_map(pixels_of_row) {
        let (u, v) = (column as f32 / SIDE as f32, row as f32 / SIDE as f32);
        let color = layers.color(u, v, heights[row * SIDE + column]);
        colors.extend(color.map(|channel| channel.clamp(0.0, 255.0) as u8));
        normals.extend(normal(&heights, column, row).map(|component| ((0.5 * component + 0.5) * 255.0).round() as u8));
        colors.push(255);
        normals.push(255);
    }
    let side = SIDE as u32;
    Ok([Texture::new("bark", side, side, colors)?, Texture::new("bark normals", side, side, normals)?])
}

/// The noise layers of the bark. The weights and thresholds in [`Self::height`] and [`Self::color`] are free choices of
/// the bark's look.
struct BarkLayers {
    /// Shift the other layers around the branch.
    warps: [GradientNoise; 2],
    /// Furrows along the branch: deep ones, then fine ones.
    furrows: [GradientNoise; 2],
    /// Cracks without a preferred direction.
    cracks: GradientNoise,
    /// Small variations of height and color.
    grain: [GradientNoise; 2],
    /// Large spots of color.
    tint: GradientNoise,
}

impl BarkLayers {
    fn new(random: &mut SplitMix64) -> Self {
        let mut noise = |across, along| GradientNoise { cells: [across, along], seed: random.next_bits() };
        Self {
            warps: [noise(4, 3), noise(9, 7)],
            furrows: [noise(15, 3), noise(27, 5)],
            cracks: noise(11, 15),
            grain: [noise(40, 18), noise(96, 60)],
            tint: noise(3, 2),
        }
    }

    /// The height at a position, from 0 in the furrows to about 1 on the crests.
    fn height(&self, u: f32, v: f32) -> f32 {
        let warped_u = u + 0.035 * self.warps[0].sample(u, v) + 0.012 * self.warps[1].sample(u, v);
        // The zero crossings of the noise form long, wavering furrows. Those of the finer noise are shallow.
        let deep_furrow = smoothstep(0.0, 0.34, self.furrows[0].sample(warped_u, v).abs());
        let fine_furrow = smoothstep(0.0, 0.36, self.furrows[1].sample(warped_u, v).abs());
        // Sampled at (v, u) instead of (u, v), so that v is not shifted in the same way as u.
        let crack = smoothstep(0.0, 0.16, self.cracks.sample(warped_u, v + 0.02 * self.warps[1].sample(v, u)).abs());
        let grain = 0.6 * self.grain[0].sample(warped_u, v) + 0.4 * self.grain[1].sample(u, v);
        let plate = deep_furrow.powf(0.7) * (0.58 + 0.42 * fine_furrow) * (0.80 + 0.20 * crack);
        plate * (0.93 + 0.07 * grain) + 0.045 * grain
    }

    /// sRGB color at a position of the given height.
    fn color(&self, u: f32, v: f32, height: f32) -> [f32; 3] {
        let grain = self.grain[0].sample(u, v);
        let tint = self.tint.sample(u, v);
        let base_color = lerp_color(FURROW, RIDGE, smoothstep(0.02, 0.6, height));
        let crest_color = lerp_color(base_color, CREST, 0.75 * smoothstep(0.55, 1.0, height + 0.12 * grain));
        let lichen_weight = 0.45 * smoothstep(0.05, 0.6, tint) * smoothstep(0.3, 0.9, height);
        let lichen_color = lerp_color(crest_color, LICHEN, lichen_weight);
        lichen_color.map(|channel| channel * (1.0 + 0.07 * grain + 0.05 * tint))
    }
}

/// The unit normal by central differences, periodic at the tile's edges; x points right and y up in the image.
fn normal(heights: &[f32], column: usize, row: usize) -> [f32; 3] {
    let height = |column: usize, row: usize| heights[row % SIDE * SIDE + column % SIDE];
    let height_step_right = height(column + 1, row) - height(column + SIDE - 1, row);
    let height_step_up = height(column, row + SIDE - 1) - height(column, row + 1);
    let slope_scale = 0.5 * SIDE as f32 * RELIEF;
    nalgebra::Vector3::new(-slope_scale * height_step_right, -slope_scale * height_step_up, 1.0).normalize().into()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mean(texture: &Texture) -> [f64; 3] {
        let count = texture.rgba().len() as f64 / 4.0;
        std::array::from_fn(|channel| {
            texture.rgba().chunks_exact(4).map(|pixel| f64::from(pixel[channel])).sum::<f64>() / count
        })
    }

    #[test]
    fn mean_normal_is_z_and_mean_color_is_brown() {
        let [color, normals] = textures(&mut SplitMix64::new(1)).expect("valid textures");
        let [x, y, z] = mean(&normals);
        assert!((x - 127.5).abs() < 2.0 && (y - 127.5).abs() < 2.0 && z > 215.0, "{x} {y} {z}");
        let [red, green, blue] = mean(&color);
        assert!(red > green && green > blue && (70.0..160.0).contains(&red), "{red} {green} {blue}");
        // The map is not flat.
        let tilted_count = normals.rgba().chunks_exact(4).filter(|pixel| pixel[2] < 240).count();
        assert!(tilted_count > SIDE * SIDE / 10, "{tilted_count} tilted pixels");
    }

    #[test]
    fn images_are_continuous_across_the_tile_edges() {
        let [color, _] = textures(&mut SplitMix64::new(2)).expect("valid textures");
        let red = |column: usize, row: usize| f64::from(color.rgba()[4 * (row * SIDE + column)]);
        let column_difference =
            |a: usize, b: usize| (0..SIDE).map(|row| (red(a, row) - red(b, row)).abs()).sum::<f64>();
        let row_difference =
            |a: usize, b: usize| (0..SIDE).map(|column| (red(column, a) - red(column, b)).abs()).sum::<f64>();
        assert!(column_difference(SIDE - 1, 0) < 3.0 * column_difference(100, 101) + 1.0);
        assert!(row_difference(SIDE - 1, 0) < 3.0 * row_difference(100, 101) + 1.0);
        // Control: distant columns differ more.
        assert!(column_difference(0, 101) > 3.0 * column_difference(100, 101));
    }

    #[test]
    fn normals_around_a_bump_point_away_from_it() {
        let mut heights = vec![0.0; SIDE * SIDE];
        heights[100 * SIDE + 100] = 0.2;
        assert!(normal(&heights, 101, 100)[0] > 0.1);
        assert!(normal(&heights, 99, 100)[0] < -0.1);
        // The normal of the pixel above the bump in the image points up.
        assert!(normal(&heights, 100, 99)[1] > 0.1);
    }
}
