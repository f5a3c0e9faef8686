//! The reference rasterizer: plain loops over samples that define the result of `kernels/raster.cu`.
//!
//! Corners are transformed to clip space in f32; each sum and product is rounded separately. Triangles are clipped by
//! the near plane and a guard band, a rectangle around the window that keeps coordinates in range (Sutherland and
//! Hodgman, "Reentrant polygon clipping", 1974). Their corners are snapped to 1/256 pixel.
//!
//! Coverage is then computed exactly, in integers: a triangle covers the samples on the inner side of all its edges. A
//! sample on an edge belongs to the triangle for which it is a top or left edge, so triangles that share an edge cover
//! each sample exactly once. Depth is z/w, linear in the window, in f32 from the exact edge values. It is reversed: 1
//! at the near plane and 0 at the far plane, so the largest depth of a sample is visible. Cut-outs cover only samples
//! whose alpha is large enough ([`cut_out`]).

pub mod cut_out;

use modalcast_model::raster::CutOuts;
use modalcast_model::scene::{CullMode, DrawRange, Viewport};

/// Subpixel steps per pixel.
const SUBPIXEL_STEPS: i32 = 256;
/// 2^-100: the smallest w by which clip coordinates are divided. 1 / w overflows below about 2^-128.
const MIN_W: f32 = f32::from_bits((127 - 100) << 23);

/// Key of a sample that no triangle covers.
pub const EMPTY_KEY: u64 = u64::MAX;

/// A corner in the window: x and y in 1/256 pixel with y down, z is the depth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SnappedVertex {
    pub x: i32,
    pub y: i32,
    pub z: f32,
}

/// Reason why a triangle is culled.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CullReason {
    /// A corner is not finite in clip space.
    NotFinite,
    /// All corners are outside of one plane of the view frustum, or nothing remains after clipping.
    OutsideFrustum,
    /// No area after snapping.
    Degenerate,
    BackFacing,
    /// The bounding box of its corners contains no sample.
    NoSample,
}

/// A range of samples with both ends included: minimum x and y, maximum x and y.
pub type PixelRect = [i32; 4];

/// A triangle after clipping.
#[derive(Debug, Clone, PartialEq)]
pub struct ClippedPolygon {
    /// 3 to 8 corners of a convex polygon, in the orientation of the triangle.
    pub corners: Vec<SnappedVertex>,
    /// Twice the signed area in (1/256 pixel)^2, positive if the corners are clockwise on the screen.
    pub doubled_area: i64,
    /// The samples in the bounding box of the corners, inside of the window.
    pub samples: PixelRect,
    /// Whether the near plane or the guard band clipped the triangle.
    pub is_clipped: bool,
}

/// Samples of a window: the nearest depth of each sample, and its triangle.
#[derive(Debug, Clone, PartialEq)]
pub struct VisibilityBuffer {
    window: Viewport,
    /// Row by row from the top, each from [`sample_key`]. [`EMPTY_KEY`] where no triangle covers the sample.
    pub keys: Vec<u64>,
}

impl VisibilityBuffer {
    /// Creates an empty buffer for a window.
    pub fn new(window: Viewport) -> Self {
        Self { window, keys: vec![EMPTY_KEY; window.pixel_count()] }
    }

    /// Draws a range of triangles. Positions are three numbers per vertex.
    pub fn draw(&mut self, positions: &[f32], triangles: &[[u32; 3]], range: DrawRange) {
        self.draw_filtered(positions, triangles, range, |_, _| true);
    }

    /// Draws a range of triangles of a mesh with cut-outs.
    pub fn draw_cut_out(&mut self, positions: &[f32], triangles: &[[u32; 3]], range: DrawRange, cut_outs: &CutOuts) {
        let window = self.window;
        self.draw_filtered(positions, triangles, range, |triangle, pixel| {
            let corners = corners(&window, positions, triangles[triangle as usize]);
            cut_out::passes_alpha_test(cut_outs, &window, triangle, &corners, pixel)
        });
    }

    /// Draws the samples for which `passes_alpha_test(triangle, [column, row])` is true.
    fn draw_filtered(
        &mut self,
        positions: &[f32],
        triangles: &[[u32; 3]],
        range: DrawRange,
        passes_alpha_test: impl Fn(u32, [i32; 2]) -> bool,
    ) {
        for triangle in range.first_triangle..range.first_triangle + range.triangle_count {
            if let Ok(clipped_polygon) =
                clipped_polygon(&self.window, positions, triangles[triangle as usize], range.cull_mode)
            {
                self.fill(&clipped_polygon, triangle, |pixel| passes_alpha_test(triangle, pixel));
            }
        }
    }

    /// Depths; 0 where nothing was drawn.
    pub fn depths(&self) -> Vec<f32> {
        // The inverted bits of an empty key are those of 0.
        self.keys.iter().map(|key| f32::from_bits(!((key >> 32) as u32))).collect()
    }

    /// The triangle of each sample; `None` where nothing was drawn.
    pub fn ids(&self) -> Vec<Option<u32>> {
        self.keys.iter().map(|key| (*key != EMPTY_KEY).then_some(*key as u32)).collect()
    }

    /// Draws the samples of a clipped triangle.
    fn fill(&mut self, clipped_polygon: &ClippedPolygon, triangle: u32, passes_alpha_test: impl Fn([i32; 2]) -> bool) {
        let [x0, y0, x1, y1] = clipped_polygon.samples;
        let width = self.window.size()[0] as usize;
        for triangle_corners in fan_triangles(clipped_polygon) {
            for (row, column) in (y0..=y1).flat_map(|row| (x0..=x1).map(move |column| (row, column))) {
                if let Some(depth) =
                    depth_at(&triangle_corners, column, row).filter(|_| passes_alpha_test([column, row]))
                {
                    let key = &mut self.keys[row as usize * width + column as usize];
                    *key = (*key).min(sample_key(depth, triangle));
                }
            }
        }
    }
}

/// Key of a sample: the inverted bits of its depth in the upper 32 bits, the triangle in the lower 32 bits. The bits of
/// non-negative floats compare as the floats do, so the smallest key has the largest depth, which is the nearest. At
/// equal depths, the smallest key has the smallest triangle index.
pub const fn sample_key(depth: f32, triangle: u32) -> u64 {
    (!depth.to_bits() as u64) << 32 | triangle as u64
}

/// Clips and snaps a triangle.
///
/// # Errors
/// The reason why the triangle is culled.
pub fn clipped_polygon(
    window: &Viewport,
    positions: &[f32],
    triangle: [u32; 3],
    cull_mode: CullMode,
) -> Result<ClippedPolygon, CullReason> {
    let corners = corners(window, positions, triangle);
    if !corners.as_flattened().iter().all(|number| number.is_finite()) {
        return Err(CullReason::NotFinite);
    }
    if is_outside(&corners) {
        return Err(CullReason::OutsideFrustum);
    }
    let is_unclipped =
        |corner: &[f32; 4]| (0..5).all(|plane| plane_distance(window, corner, plane) >= 0.0) && corner[3] >= MIN_W;
    let is_clipped = !corners.iter().all(is_unclipped);
    let clipped_corners = if is_clipped { clip(window, &corners) } else { corners.to_vec() };
    if clipped_corners.len() < 3 || !clipped_corners.iter().all(|corner| corner[3] >= MIN_W) {
        return Err(CullReason::OutsideFrustum);
    }
    let corners: Vec<SnappedVertex> = clipped_corners.iter().map(|corner| snap(window, corner)).collect();
    let doubled_area =
        (1..corners.len() - 1).map(|index| doubled_area(&[corners[0], corners[index], corners[index + 1]])).sum();
    let samples = samples(window, &corners);
    if doubled_area == 0 {
        return Err(CullReason::Degenerate);
    }
    // The corners of a front face are counterclockwise.
    if cull_mode == CullMode::Back && doubled_area > 0 {
        return Err(CullReason::BackFacing);
    }
    if samples[0] > samples[2] || samples[1] > samples[3] {
        return Err(CullReason::NoSample);
    }
    Ok(ClippedPolygon { corners, doubled_area, samples, is_clipped })
}

/// A triangle's corners in clip space.
pub fn corners(window: &Viewport, positions: &[f32], triangle: [u32; 3]) -> [[f32; 4]; 3] {
    triangle.map(|vertex| transform_to_clip(window, &positions[3 * vertex as usize..][..3]))
}

/// Divides the polygon into a triangle fan. The corners of each triangle are clockwise on the screen.
pub fn fan_triangles(clipped_polygon: &ClippedPolygon) -> Vec<[SnappedVertex; 3]> {
    let corners = &clipped_polygon.corners;
    let oriented_triangle = |index: usize| {
        let (second, third) = if clipped_polygon.doubled_area < 0 { (index + 1, index) } else { (index, index + 1) };
        [corners[0], corners[second], corners[third]]
    };
    (1..corners.len() - 1).map(oriented_triangle).filter(|triangle| doubled_area(triangle) > 0).collect()
}

/// Depth of a triangle at a pixel's sample, if the sample lies inside and not behind the far plane.
pub fn depth_at(triangle: &[SnappedVertex; 3], column: i32, row: i32) -> Option<f32> {
    let (x, y) = (SUBPIXEL_STEPS * column + SUBPIXEL_STEPS / 2, SUBPIXEL_STEPS * row + SUBPIXEL_STEPS / 2);
    let [a, b, c] = &with_farthest_first(triangle);
    let edge_values =
        [(b, c), (c, a), (a, b)].map(|(start, end)| (edge(start, end, x, y), min_covered_edge(start, end)));
    if edge_values.iter().any(|(value, min_covered_edge)| value < min_covered_edge) {
        return None;
    }
    let inverse_area = 1.0 / doubled_area(triangle) as f32;
    // No term of the sum is negative, so its relative error is a few roundings, also where depth is small.
    let [slope_b, slope_c] = [b, c].map(|corner| (corner.z - a.z) * inverse_area);
    let z = a.z + (edge_values[1].0 as f32 * slope_b + edge_values[2].0 as f32 * slope_c);
    (z >= 0.0).then_some(if z < 1.0 { z } else { 1.0 })
}

/// The corners in the same cyclic order, beginning with the farthest one. Of equally far corners, the first one begins.
pub fn with_farthest_first(triangle: &[SnappedVertex; 3]) -> [SnappedVertex; 3] {
    let [a, b, c] = *triangle;
    if b.z < a.z && b.z <= c.z {
        [b, c, a]
    } else if c.z < a.z {
        [c, a, b]
    } else {
        [a, b, c]
    }
}

/// The edge function at a point: positive on the right of the edge, with y down.
pub fn edge(start: &SnappedVertex, end: &SnappedVertex, x: i32, y: i32) -> i64 {
    let [dx, dy] = [end.x - start.x, end.y - start.y].map(i64::from);
    dx * i64::from(y - start.y) - dy * i64::from(x - start.x)
}

/// Smallest value of an edge function at covered samples: 0 for top and left edges, 1 for other edges.
fn min_covered_edge(start: &SnappedVertex, end: &SnappedVertex) -> i64 {
    i64::from(!(end.y < start.y || (end.y == start.y && end.x > start.x)))
}

/// Twice the signed area of a triangle in (1/256 pixel)^2, positive if the corners are clockwise on the screen.
fn doubled_area(triangle: &[SnappedVertex; 3]) -> i64 {
    edge(&triangle[0], &triangle[1], triangle[2].x, triangle[2].y)
}

fn transform_to_clip(window: &Viewport, position: &[f32]) -> [f32; 4] {
    let m = window.clip_from_positions();
    std::array::from_fn(|row| {
        let row = &m[4 * row..][..4];
        row[0] * position[0] + row[1] * position[1] + row[2] * position[2] + row[3]
    })
}

/// Whether all corners are outside of the same plane of the view frustum.
fn is_outside(corners: &[[f32; 4]; 3]) -> bool {
    let is_beyond = |axis: usize, sign: f32| corners.iter().all(|corner| sign * corner[axis] > corner[3]);
    (0..3).any(|axis| is_beyond(axis, 1.0))
        || (0..2).any(|axis| is_beyond(axis, -1.0))
        || corners.iter().all(|corner| corner[2] < 0.0)
}

/// Signed distance to a plane, not negative on the inner side. Plane 0 is the near plane; planes 1 to 4 are the sides
/// of the guard band.
fn plane_distance(window: &Viewport, [x, y, z, w]: &[f32; 4], plane: usize) -> f32 {
    let [guard_x, guard_y] = window.guard_band().map(|guard| guard * w);
    [w - z, guard_x - x, guard_x + x, guard_y - y, guard_y + y][plane]
}

/// Clips a triangle to a convex polygon by the near plane and the guard band.
fn clip(window: &Viewport, corners: &[[f32; 4]; 3]) -> Vec<[f32; 4]> {
    let mut polygon = corners.to_vec();
    for plane in 0..5 {
        let mut clipped_polygon = Vec::with_capacity(8);
        for (index, start) in polygon.iter().enumerate() {
            let end = &polygon[(index + 1) % polygon.len()];
            let [start_distance, end_distance] = [start, end].map(|corner| plane_distance(window, corner, plane));
            if start_distance >= 0.0 {
                clipped_polygon.push(*start);
            }
            if (start_distance >= 0.0) != (end_distance >= 0.0) {
                clipped_polygon.push(if start_distance >= 0.0 {
                    clip_edge(start, end, start_distance, end_distance)
                } else {
                    clip_edge(end, start, end_distance, start_distance)
                });
            }
        }
        // A plane adds at most one corner to a convex polygon: 3 + 5 corners. Rounding may make a polygon slightly
        // concave, and a plane may then add more corners.
        clipped_polygon.truncate(8);
        polygon = clipped_polygon;
    }
    polygon
}

/// Intersection of an edge with a plane. Both triangles of an edge get the same result, because it is always computed
/// from the inner end.
fn clip_edge(inner: &[f32; 4], outer: &[f32; 4], inner_distance: f32, outer_distance: f32) -> [f32; 4] {
    let t = inner_distance / (inner_distance - outer_distance);
    std::array::from_fn(|axis| inner[axis] + t * (outer[axis] - inner[axis]))
}

/// Divides a corner by w and rounds it to 1/256 pixel of the window.
fn snap(window: &Viewport, [x, y, z, w]: &[f32; 4]) -> SnappedVertex {
    let [half_width, half_height] = window.half_size();
    let inverse_w = 1.0 / w;
    let window_x = x * inverse_w * half_width + half_width;
    let window_y = -(y * inverse_w) * half_height + half_height;
    let to_subpixels = |pixels: f32| (pixels * SUBPIXEL_STEPS as f32).round_ties_even() as i32;
    SnappedVertex { x: to_subpixels(window_x), y: to_subpixels(window_y), z: z * inverse_w }
}

/// The samples in the bounding box of the corners, clipped to the window. In units of 1/256 pixel, the sample of column
/// c is at x = 256 c + 128. The first column at or after x0 is therefore ceil((x0 - 128) / 256) = floor((x0 + 127) /
/// 256), and the last column at or before x1 is floor((x1 - 128) / 256). A shift by 8 divides by 256 and rounds down.
fn samples(window: &Viewport, corners: &[SnappedVertex]) -> PixelRect {
    let sample_range = |coordinate_of: fn(&SnappedVertex) -> i32, window_side: u32| {
        let coordinates = || corners.iter().map(coordinate_of);
        let (min, max) = (coordinates().min().unwrap_or(0), coordinates().max().unwrap_or(0));
        (((min + SUBPIXEL_STEPS / 2 - 1) >> 8).max(0), ((max - SUBPIXEL_STEPS / 2) >> 8).min(window_side as i32 - 1))
    };
    let [width, height] = window.size();
    let ((x0, x1), (y0, y1)) = (sample_range(|corner| corner.x, width), sample_range(|corner| corner.y, height));
    [x0, y0, x1, y1]
}
