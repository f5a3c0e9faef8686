//! The alpha test of cut-outs for one sample. It defines the result of `kernels/cut_out.cuh`.
//!
//! The texture coordinates of a sample are a weighted sum of the texture coordinates of the corners. The weights are
//! the edge functions of the corners in homogeneous coordinates (Olano and Greer, "Triangle scan conversion using 2D
//! homogeneous coordinates", 1997). They are perspective-correct without clipping, also for corners behind the eye.
//! First, the position of the sample is subtracted from the corners, which avoids cancellation for small triangles far
//! from the center of the window. All numbers are f32; each sum and product is rounded separately, in the order of the
//! kernel. The image is then filtered trilinearly. The hardware filters with lower precision, and anisotropically if
//! requested.

use modalcast_model::raster::{AlphaImage, CutOuts};
use modalcast_model::scene::Viewport;

/// A texture footprint: texture coordinates of a sample, and their derivatives with respect to x and y in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Footprint {
    pub uv: [f32; 2],
    pub duv_dx: [f32; 2],
    pub duv_dy: [f32; 2],
}

/// The footprint of a pixel's sample on a triangle with these corners in clip space. Zeros if it is not finite, which
/// may occur where w is outside 2^-50 to 2^50.
pub fn footprint(
    window: &Viewport,
    corners: &[[f32; 4]; 3],
    uvs: &[[f32; 2]; 3],
    [column, row]: [i32; 2],
) -> Footprint {
    let pixel_step = window.half_size().map(|half| 1.0 / half);
    let sample = [(column as f32 + 0.5) * pixel_step[0] - 1.0, 1.0 - (row as f32 + 0.5) * pixel_step[1]];
    let x = corners.map(|[x, _, _, w]| x - sample[0] * w);
    let y = corners.map(|[_, y, _, w]| y - sample[1] * w);
    let w = corners.map(|[.., w]| w);
    // The cross product of two vectors that have one component per corner.
    let cross = |a: &[f32; 3], b: &[f32; 3]| {
        [0, 1, 2].map(|index| {
            let (j, k) = ((index + 1) % 3, (index + 2) % 3);
            a[j] * b[k] - b[j] * a[k]
        })
    };
    let edges = cross(&x, &y);
    let inverse_sum = 1.0 / (edges[0] + edges[1] + edges[2]);
    // Snapping may put a sample outside the unsnapped corners, so clamp the weights to zero.
    let weights = edges.map(|edge| (edge * inverse_sum).max(0.0));
    let weight_scale = 1.0 / (weights[0] + weights[1] + weights[2]);
    let sum = |terms: [f32; 3]| terms[0] + terms[1] + terms[2];
    let uv = [0, 1].map(|axis| sum([0, 1, 2].map(|index| weights[index] * uvs[index][axis])) * weight_scale);
    // Sums the derivative of each corner's weight, times the difference between the texture coordinates of the corner
    // and of the sample. The y of the sample decreases as its row increases, which cancels the minus sign of the
    // derivatives by y.
    let uv_derivative = |weight_derivatives: [f32; 3], pixel_step: f32| {
        [0, 1].map(|axis| {
            let terms = [0, 1, 2].map(|index| weight_derivatives[index] * (uvs[index][axis] - uv[axis]));
            sum(terms) * (pixel_step * inverse_sum)
        })
    };
    let (duv_dx, duv_dy) = (uv_derivative(cross(&y, &w), pixel_step[0]), uv_derivative(cross(&x, &w), pixel_step[1]));
    let is_finite = [uv, duv_dx, duv_dy].as_flattened().iter().all(|number| number.is_finite());
    if is_finite { Footprint { uv, duv_dx, duv_dy } } else { Footprint::default() }
}

/// Alpha of a cut-out triangle at a footprint.
pub fn alpha(cut_outs: &CutOuts, triangle: u32, footprint: &Footprint) -> f32 {
    let material = &cut_outs.materials[cut_outs.material_indices[(triangle - cut_outs.first) as usize] as usize];
    let texture_alpha =
        material.image.map_or(1.0, |image| sample_trilinear(&cut_outs.images[image as usize], footprint));
    material.alpha * texture_alpha
}

/// Whether a triangle with these corners in clip space passes the alpha test at a pixel's sample. Always true for
/// triangles before the first cut-out, which are opaque.
pub(super) fn passes_alpha_test(
    cut_outs: &CutOuts,
    window: &Viewport,
    triangle: u32,
    corners: &[[f32; 4]; 3],
    pixel: [i32; 2],
) -> bool {
    let Some(cut_out) = triangle.checked_sub(cut_outs.first) else { return true };
    let footprint = footprint(window, corners, &cut_outs.uvs[cut_out as usize], pixel);
    let material = &cut_outs.materials[cut_outs.material_indices[cut_out as usize] as usize];
    alpha(cut_outs, triangle, &footprint) >= material.cutoff
}

/// Trilinear filtering between the two mip levels whose texels are about as long as the footprint's longer side.
fn sample_trilinear(image: &AlphaImage, footprint: &Footprint) -> f32 {
    let size = [image.width as f32, image.height as f32];
    let length = |derivative: [f32; 2]| (derivative[0] * size[0]).hypot(derivative[1] * size[1]);
    let last_level = (image.levels.len() - 1) as f32;
    let level = length(footprint.duv_dx).max(length(footprint.duv_dy)).log2().clamp(0.0, last_level);
    let [lower_alpha, upper_alpha] =
        [level.floor(), level.ceil()].map(|level| bilinear(image, level as u32, footprint.uv));
    lower_alpha + level.fract() * (upper_alpha - lower_alpha)
}

/// Bilinear filtering of one mip level, which repeats in both directions.
fn bilinear(image: &AlphaImage, level: u32, uv: [f32; 2]) -> f32 {
    let texels = &image.levels[level as usize];
    let size = [image.width, image.height].map(|side| (side >> level).max(1));
    let texel_position = [0, 1].map(|axis| (uv[axis] - uv[axis].floor()) * size[axis] as f32 - 0.5);
    let texel = |x: f32, y: f32| {
        let [column, row] =
            [(x, size[0]), (y, size[1])].map(|(coordinate, side)| (coordinate as i64).rem_euclid(i64::from(side)));
        f32::from(texels[row as usize * size[0] as usize + column as usize]) / 255.0
    };
    let [x, y] = texel_position.map(f32::floor);
    let mix = |a: f32, b: f32, t: f32| a + t * (b - a);
    let row = |y: f32| mix(texel(x, y), texel(x + 1.0, y), texel_position[0] - x);
    mix(row(y), row(y + 1.0), texel_position[1] - y)
}
