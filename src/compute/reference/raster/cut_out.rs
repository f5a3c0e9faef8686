//! The alpha test of cut-outs, sample by sample: defines the result of `kernels/cut_out.cuh`.
//!
//! The texture coordinates of a sample are weighted sums of those of the corners. The weights are the edge functions of
//! the corners in homogeneous coordinates (Olano and Greer, "Triangle scan conversion using 2D homogeneous
//! coordinates", 1997): perspective-correct without clipping, also for corners behind the eye. The corners are first
//! taken relative to the sample, so that a small triangle far from the center keeps its precision. All is f32, with
//! each sum and product rounded separately, in the kernel's order. The image is then filtered; the hardware filters
//! with lower precision, and anisotropically if requested.

use modalcast_model::raster::{AlphaImage, CutOuts};
use modalcast_model::scene::Viewport;

/// A texture footprint: texture coordinates of a sample, and their derivatives by the pixel in x and y.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Footprint {
    pub uv: [f32; 2],
    pub across: [f32; 2],
    pub down: [f32; 2],
}

/// The footprint of a pixel's sample on a triangle with these corners in clip space. Zeros where it is not finite, as
/// where w is outside 2^-50 to 2^50.
pub fn footprint(
    window: &Viewport,
    corners: &[[f32; 4]; 3],
    uvs: &[[f32; 2]; 3],
    [column, row]: [i32; 2],
) -> Footprint {
    let step = window.half_size().map(|half| 1.0 / half);
    let sample = [(column as f32 + 0.5) * step[0] - 1.0, 1.0 - (row as f32 + 0.5) * step[1]];
    let x = corners.map(|[x, _, _, w]| x - sample[0] * w);
    let y = corners.map(|[_, y, _, w]| y - sample[1] * w);
    let w = corners.map(|[.., w]| w);
    let cross = |a: &[f32; 3], b: &[f32; 3]| {
        [0, 1, 2].map(|at| {
            let (j, k) = ((at + 1) % 3, (at + 2) % 3);
            a[j] * b[k] - b[j] * a[k]
        })
    };
    let edges = cross(&x, &y);
    let inverse = 1.0 / (edges[0] + edges[1] + edges[2]);
    // Snapping may put a sample outside the unsnapped corners, so clamp the weights to zero.
    let shares = edges.map(|edge| (edge * inverse).max(0.0));
    let whole = 1.0 / (shares[0] + shares[1] + shares[2]);
    let sum = |of: [f32; 3]| of[0] + of[1] + of[2];
    let uv = [0, 1].map(|axis| sum([0, 1, 2].map(|at| shares[at] * uvs[at][axis])) * whole);
    // Derivatives of the weights by the pixel in x and y, times the differences of the corners' texture coordinates
    // from this sample's.
    let change = |rates: [f32; 3], step: f32| {
        [0, 1].map(|axis| sum([0, 1, 2].map(|at| rates[at] * (uvs[at][axis] - uv[axis]))) * (step * inverse))
    };
    let (across, down) = (change(cross(&y, &w), step[0]), change(cross(&x, &w), step[1]));
    let is_finite = [uv, across, down].as_flattened().iter().all(|number| number.is_finite());
    if is_finite { Footprint { uv, across, down } } else { Footprint::default() }
}

/// Alpha of a cut-out triangle at a footprint.
pub fn alpha(cut_outs: &CutOuts, triangle: u32, footprint: &Footprint) -> f32 {
    let surface = &cut_outs.materials[cut_outs.material_indices[(triangle - cut_outs.first) as usize] as usize];
    let image = surface.image.map_or(1.0, |image| sample_trilinear(&cut_outs.images[image as usize], footprint));
    surface.alpha * image
}

/// Whether a triangle keeps a pixel's sample; always true for triangles before the first cut-out.
pub(super) fn passes_alpha_test(
    cut_outs: &CutOuts,
    window: &Viewport,
    (triangle, corners): (u32, &[[f32; 4]; 3]),
    pixel: [i32; 2],
) -> bool {
    let Some(own) = triangle.checked_sub(cut_outs.first) else { return true };
    let footprint = footprint(window, corners, &cut_outs.uvs[own as usize], pixel);
    let surface = &cut_outs.materials[cut_outs.material_indices[own as usize] as usize];
    alpha(cut_outs, triangle, &footprint) >= surface.cutoff
}

/// Trilinear filtering: the two mip levels are those whose texels are about as long as the footprint's longer side.
fn sample_trilinear(image: &AlphaImage, footprint: &Footprint) -> f32 {
    let size = [image.width as f32, image.height as f32];
    let length = |side: [f32; 2]| (side[0] * size[0]).hypot(side[1] * size[1]);
    let last = (image.levels.len() - 1) as f32;
    let level = length(footprint.across).max(length(footprint.down)).log2().clamp(0.0, last);
    let [low, high] = [level.floor(), level.ceil()].map(|level| bilinear(image, level as u32, footprint.uv));
    low + level.fract() * (high - low)
}

fn bilinear(image: &AlphaImage, level: u32, uv: [f32; 2]) -> f32 {
    let texels = &image.levels[level as usize];
    let size = [image.width, image.height].map(|side| (side >> level).max(1));
    let at = [0, 1].map(|axis| (uv[axis] - uv[axis].floor()) * size[axis] as f32 - 0.5);
    let texel = |x: f32, y: f32| {
        let [column, row] = [(x, size[0]), (y, size[1])].map(|(at, side)| (at as i64).rem_euclid(i64::from(side)));
        f32::from(texels[row as usize * size[0] as usize + column as usize]) / 255.0
    };
    let [x, y] = at.map(f32::floor);
    let mix = |a: f32, b: f32, t: f32| a + t * (b - a);
    let row = |y: f32| mix(texel(x, y), texel(x + 1.0, y), at[0] - x);
    mix(row(y), row(y + 1.0), at[1] - y)
}
