//! The reference rasterizer, sample by sample: defines the result of `kernels/raster.cu`, in plain loops.
//!
//! Corners are transformed to clip space in f32, with each sum and product rounded separately, clipped by the near
//! plane and a guard band around the window (Sutherland and Hodgman, "Reentrant polygon clipping", 1974), and snapped
//! to 1/256 pixel. From there on coverage is exact, in integers: a triangle covers the samples on the inner side of all
//! its edges. A sample on an edge belongs to the triangle for which it is a top or left edge, so triangles that share
//! an edge cover each sample exactly once. Depth is z/w, linear in the window, in f32 from the exact edge values.
//! Cut-outs keep the samples whose alpha is large enough ([`cut_out`]).

pub mod cut_out;

use modalcast_model::raster::CutOuts;
use modalcast_model::scene::{CullMode, DrawRange, Viewport};

/// Subpixel steps per pixel, and the smallest w of a divisor.
const SUBPIXEL_STEPS: i32 = 256;
const MIN_W: f32 = f32::from_bits((127 - 100) << 23);

/// Clear value of a sample.
pub const EMPTY_KEY: u64 = u64::MAX;

/// A corner in the window: 1/256 pixel with y down, and depth.
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
    /// Outside one plane of the view frustum, or nothing remains after clipping.
    OutsideFrustum,
    /// No area after snapping.
    Degenerate,
    BackFacing,
    /// The box of its corners contains no sample.
    NoSample,
}

/// The samples of a box, both ends included: least x and y, largest x and y.
pub type PixelRect = [i32; 4];

/// A triangle after clipping.
#[derive(Debug, Clone, PartialEq)]
pub struct ClippedPolygon {
    /// 3 to 8 corners of a convex polygon, in the triangle's own orientation.
    pub corners: Vec<SnappedVertex>,
    /// Twice its area in (1/256 pixel)^2, positive where the corners are clockwise on the screen.
    pub area: i64,
    pub samples: PixelRect,
    /// Whether a plane clipped it.
    pub clipped: bool,
}

/// Samples of a window: the least depth of each and its triangle.
#[derive(Debug, Clone, PartialEq)]
pub struct VisibilityBuffer {
    window: Viewport,
    /// Row by row from the top: the bits of depth, then the triangle; [`EMPTY_KEY`] where there is none.
    pub keys: Vec<u64>,
}

impl VisibilityBuffer {
    /// An empty window.
    pub fn new(window: Viewport) -> Self {
        Self { window, keys: vec![EMPTY_KEY; window.pixel_count()] }
    }

    /// Draws the triangles of a group; positions are three numbers per vertex.
    pub fn draw(&mut self, positions: &[f32], triangles: &[[u32; 3]], group: DrawRange) {
        self.draw_filtered(positions, triangles, group, |_, _| true);
    }

    /// Draws the triangles of a group of a mesh with cut-outs.
    pub fn draw_cut_out(&mut self, positions: &[f32], triangles: &[[u32; 3]], group: DrawRange, cut_outs: &CutOuts) {
        let window = self.window;
        self.draw_filtered(positions, triangles, group, |triangle, pixel| {
            let corners = corners(&window, positions, triangles[triangle as usize]);
            cut_out::passes_alpha_test(cut_outs, &window, (triangle, &corners), pixel)
        });
    }

    fn draw_filtered(
        &mut self,
        positions: &[f32],
        triangles: &[[u32; 3]],
        group: DrawRange,
        passes_alpha_test: impl Fn(u32, [i32; 2]) -> bool,
    ) {
        for triangle in group.first..group.first + group.triangles {
            if let Ok(clipped_polygon) =
                clipped_polygon(&self.window, positions, triangles[triangle as usize], group.cull_mode)
            {
                self.fill(&clipped_polygon, triangle, |pixel| passes_alpha_test(triangle, pixel));
            }
        }
    }

    /// Depths; 1 where nothing was drawn.
    pub fn depths(&self) -> Vec<f32> {
        let depth = |key: &u64| if *key == EMPTY_KEY { 1.0 } else { f32::from_bits((key >> 32) as u32) };
        self.keys.iter().map(depth).collect()
    }

    /// The triangle of each sample.
    pub fn ids(&self) -> Vec<Option<u32>> {
        self.keys.iter().map(|key| (*key != EMPTY_KEY).then_some(*key as u32)).collect()
    }

    fn fill(&mut self, clipped_polygon: &ClippedPolygon, triangle: u32, passes_alpha_test: impl Fn([i32; 2]) -> bool) {
        let [x0, y0, x1, y1] = clipped_polygon.samples;
        let width = self.window.size()[0] as usize;
        for piece in fan_triangles(clipped_polygon) {
            for (row, column) in (y0..=y1).flat_map(|row| (x0..=x1).map(move |column| (row, column))) {
                if let Some(depth) = depth_at(&piece, column, row).filter(|_| passes_alpha_test([column, row])) {
                    let key = &mut self.keys[row as usize * width + column as usize];
                    *key = (*key).min(u64::from(depth.to_bits()) << 32 | u64::from(triangle));
                }
            }
        }
    }
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
    let whole =
        |corner: &[f32; 4]| (0..5).all(|plane| plane_distance(window, corner, plane) >= 0.0) && corner[3] >= MIN_W;
    let clipped = !corners.iter().all(whole);
    let kept = if clipped { clip(window, &corners) } else { corners.to_vec() };
    if kept.len() < 3 || !kept.iter().all(|corner| corner[3] >= MIN_W) {
        return Err(CullReason::OutsideFrustum);
    }
    let corners: Vec<SnappedVertex> = kept.iter().map(|corner| snap(window, corner)).collect();
    let area = (1..corners.len() - 1).map(|at| area(&[corners[0], corners[at], corners[at + 1]])).sum();
    let samples = samples(window, &corners);
    if area == 0 {
        return Err(CullReason::Degenerate);
    }
    if cull_mode == CullMode::Back && area > 0 {
        return Err(CullReason::BackFacing);
    }
    if samples[0] > samples[2] || samples[1] > samples[3] {
        return Err(CullReason::NoSample);
    }
    Ok(ClippedPolygon { corners, area, samples, clipped })
}

/// A triangle's corners in clip space.
pub fn corners(window: &Viewport, positions: &[f32], triangle: [u32; 3]) -> [[f32; 4]; 3] {
    triangle.map(|vertex| to_clip(window, &positions[3 * vertex as usize..][..3]))
}

/// A triangle fan over the outline, each triangle oriented so that its corners are clockwise on the screen.
pub fn fan_triangles(clipped_polygon: &ClippedPolygon) -> Vec<[SnappedVertex; 3]> {
    let corners = &clipped_polygon.corners;
    let turned = |at: usize| {
        let (b, c) = if clipped_polygon.area < 0 { (at + 1, at) } else { (at, at + 1) };
        [corners[0], corners[b], corners[c]]
    };
    (1..corners.len() - 1).map(turned).filter(|piece| area(piece) > 0).collect()
}

/// Depth of a piece at a pixel's sample, if the sample lies inside and not behind the far plane.
pub fn depth_at(piece: &[SnappedVertex; 3], column: i32, row: i32) -> Option<f32> {
    let (x, y) = (SUBPIXEL_STEPS * column + SUBPIXEL_STEPS / 2, SUBPIXEL_STEPS * row + SUBPIXEL_STEPS / 2);
    let [a, b, c] = piece;
    let edges = [(b, c), (c, a), (a, b)].map(|(from, to)| (edge(from, to, x, y), top_left_bias(from, to)));
    if edges.iter().any(|(value, top_left_bias)| value < top_left_bias) {
        return None;
    }
    let inverse = 1.0 / area(piece) as f32;
    let [share_b, share_c] = [1, 2].map(|at| edges[at].0 as f32 * inverse);
    let z = a.z + (share_b * (b.z - a.z) + share_c * (c.z - a.z));
    (z <= 1.0).then_some(if z > 0.0 { z } else { 0.0 })
}

/// The edge function at a point: positive on the right of the edge, with y down.
pub fn edge(from: &SnappedVertex, to: &SnappedVertex, x: i32, y: i32) -> i64 {
    let [across, down] = [to.x - from.x, to.y - from.y].map(i64::from);
    across * i64::from(y - from.y) - down * i64::from(x - from.x)
}

/// Least covered value of an edge function: samples on top and left edges are covered.
fn top_left_bias(from: &SnappedVertex, to: &SnappedVertex) -> i64 {
    i64::from(!(to.y < from.y || (to.y == from.y && to.x > from.x)))
}

fn area(piece: &[SnappedVertex; 3]) -> i64 {
    edge(&piece[0], &piece[1], piece[2].x, piece[2].y)
}

fn to_clip(window: &Viewport, position: &[f32]) -> [f32; 4] {
    let m = window.clip_from_positions();
    std::array::from_fn(|row| {
        let row = &m[4 * row..][..4];
        row[0] * position[0] + row[1] * position[1] + row[2] * position[2] + row[3]
    })
}

fn is_outside(corners: &[[f32; 4]; 3]) -> bool {
    let beyond = |axis: usize, side: f32| corners.iter().all(|corner| side * corner[axis] > corner[3]);
    (0..3).any(|axis| beyond(axis, 1.0) || beyond(axis, -1.0))
}

/// Signed distance to a plane, not negative on the inner side: the near plane, then the sides of the guard band.
fn plane_distance(window: &Viewport, [x, y, z, w]: &[f32; 4], plane: usize) -> f32 {
    let [guard_x, guard_y] = window.guard_band().map(|guard| guard * w);
    [z + w, guard_x - x, guard_x + x, guard_y - y, guard_y + y][plane]
}

fn clip(window: &Viewport, corners: &[[f32; 4]; 3]) -> Vec<[f32; 4]> {
    let mut list = corners.to_vec();
    for plane in 0..5 {
        let mut kept = Vec::with_capacity(8);
        for (at, a) in list.iter().enumerate() {
            let b = &list[(at + 1) % list.len()];
            let [of_a, of_b] = [a, b].map(|corner| plane_distance(window, corner, plane));
            if of_a >= 0.0 {
                kept.push(*a);
            }
            if (of_a >= 0.0) != (of_b >= 0.0) {
                kept.push(if of_a >= 0.0 { clip_edge(a, b, of_a, of_b) } else { clip_edge(b, a, of_b, of_a) });
            }
        }
        // Rounding may make a polygon slightly concave; a plane adds at most one corner to a convex polygon.
        kept.truncate(8);
        list = kept;
    }
    list
}

/// Intersection of an edge with a plane, always computed from the inner end, so that both triangles of an edge get the
/// same result.
fn clip_edge(inner: &[f32; 4], outer: &[f32; 4], of_inner: f32, of_outer: f32) -> [f32; 4] {
    let t = of_inner / (of_inner - of_outer);
    std::array::from_fn(|axis| inner[axis] + t * (outer[axis] - inner[axis]))
}

fn snap(window: &Viewport, [x, y, z, w]: &[f32; 4]) -> SnappedVertex {
    let [half_width, half_height] = window.half_size();
    let inverse = 1.0 / w;
    let across = x * inverse * half_width + half_width;
    let down = -(y * inverse) * half_height + half_height;
    let snapped = |pixel_count: f32| (pixel_count * SUBPIXEL_STEPS as f32).round_ties_even() as i32;
    SnappedVertex { x: snapped(across), y: snapped(down), z: z * inverse * 0.5 + 0.5 }
}

/// The samples in the box of the corners, clipped to the window.
fn samples(window: &Viewport, corners: &[SnappedVertex]) -> PixelRect {
    let ends = |of: fn(&SnappedVertex) -> i32, side: u32| {
        let all = || corners.iter().map(of);
        let (low, high) = (all().min().unwrap_or(0), all().max().unwrap_or(0));
        (((low + SUBPIXEL_STEPS / 2 - 1) >> 8).max(0), ((high - SUBPIXEL_STEPS / 2) >> 8).min(side as i32 - 1))
    };
    let [width, height] = window.size();
    let ((x0, x1), (y0, y1)) = (ends(|corner| corner.x, width), ends(|corner| corner.y, height));
    [x0, y0, x1, y1]
}
