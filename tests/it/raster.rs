//! Tests of the reference rasterizer, and of a CPU twin of the kernels in `kernels/raster.cu`, which must give the same
//! result as the reference rasterizer. A soup is a list of triangles with a viewport. A viewport has one sample per
//! pixel, at the center.

use modalcast_compute::reference::raster::{
    ClippedPolygon, CullReason, EMPTY_KEY, SnappedVertex, VisibilityBuffer, clipped_polygon, depth_at, edge,
    fan_triangles, sample_key, with_farthest_first,
};
use modalcast_model::scene::{CullMode, DrawRange, Viewport};

use crate::common::soups::{Soup, all_soups, clip_space_viewport, fan_soup, perspective_viewport};

// Constants of `kernels/raster.cu`. A test compares them with the text of the kernel.

/// Maximum number of samples in the bounding rectangle of a triangle that one thread draws. One warp, or one
/// warp per tile, draws a triangle with a larger rectangle.
const MAX_THREAD_SAMPLES: i32 = 32;
/// Maximum width and maximum height of a triangle that one warp draws, in 1/256 pixel: 64 pixels.
const MAX_WARP_EXTENT: i32 = 16384;
/// Side of a tile in pixels.
const TILE_SIZE: i32 = 64;
/// Maximum number of times that a tile is halved into strips.
const MAX_STRIP_SPLITS: u32 = 3;
/// Bits of the tile count in [`RasterTraversal::packed_counts`].
const TILE_COUNT_BITS: u32 = 40;

/// Coordinate of the center of a pixel column or row, in 1/256 pixel.
fn sample_coordinate(index: i32) -> i32 {
    256 * index + 128
}

/// The top-left rule: whether a triangle covers samples that are exactly on its edge. Corners are clockwise and y
/// points down, so a left edge goes up and a top edge goes right.
fn owns_edge(from: &SnappedVertex, to: &SnappedVertex) -> bool {
    to.y < from.y || (to.y == from.y && to.x > from.x)
}

/// CPU twin of the raster kernels for one viewport. A triangle takes one of three paths: one thread draws it, one warp
/// draws it, or one warp per tile draws it. The first two paths use 32-bit edge functions, the third 64-bit ones. A
/// tile is a square of [`TILE_SIZE`] pixels. It may be divided into strips of rows.
struct RasterTraversal<'a> {
    soup: &'a Soup,
    /// Per sample, as in [`VisibilityBuffer::keys`]: the inverted bits of the depth above the triangle index.
    keys: Vec<u64>,
    /// Triangles of the per-warp path, in any order.
    warp_queue: Vec<u32>,
    /// Triangles of the per-tile path, in any order.
    tile_queue: Vec<TileEntry>,
    /// Length of `tile_queue` in the high bits, and total number of its tiles in the low [`TILE_COUNT_BITS`] bits. The
    /// kernel updates both with one atomic addition.
    packed_counts: u64,
    /// Number of triangles on the per-thread, per-warp and per-tile path.
    triangle_counts: [usize; 3],
}

/// A triangle of the per-tile path.
struct TileEntry {
    /// Number of tiles of all earlier entries.
    first_tile: u64,
    triangle: u32,
    /// Column and row of the first tile, and number of tile columns minus 1; one byte each, from the lowest byte.
    packed_box: u32,
}

impl RasterTraversal<'_> {
    /// Keeps the key of the nearer sample, and for equal depths the key with the lower triangle.
    fn write_sample(&mut self, column: i32, row: i32, depth: f32, triangle: u32) {
        let index = row as usize * self.soup.viewport.size()[0] as usize + column as usize;
        self.keys[index] = self.keys[index].min(sample_key(depth, triangle));
    }

    fn clipped_polygon(&self, triangle: u32, cull_mode: CullMode) -> Result<ClippedPolygon, CullReason> {
        clipped_polygon(&self.soup.viewport, &self.soup.positions, self.soup.triangles[triangle as usize], cull_mode)
    }

    /// Twin of kernel `raster`: draws a small triangle, and queues a larger one.
    fn draw_or_queue(&mut self, triangle: u32, cull_mode: CullMode) {
        let Ok(clipped_polygon) = self.clipped_polygon(triangle, cull_mode) else { return };
        let extent = |coordinate: fn(&SnappedVertex) -> i32| {
            let coordinates = || clipped_polygon.corners.iter().map(coordinate);
            coordinates().max().expect("expected corners") - coordinates().min().expect("expected corners")
        };
        // The first and the last column and row of samples in the bounding box.
        let [x0, y0, x1, y1] = clipped_polygon.samples;
        let fits_32_bits = !clipped_polygon.is_clipped
            && extent(|corner| corner.x) <= MAX_WARP_EXTENT
            && extent(|corner| corner.y) <= MAX_WARP_EXTENT;
        if fits_32_bits && (x1 - x0 + 1) * (y1 - y0 + 1) <= MAX_THREAD_SAMPLES {
            self.triangle_counts[0] += 1;
            self.draw_32_bits(&clipped_polygon, triangle);
        } else if fits_32_bits {
            self.triangle_counts[1] += 1;
            self.warp_queue.push(triangle);
        } else {
            self.triangle_counts[2] += 1;
            // The box of the triangle in tiles.
            let (first_column, first_row) = (x0 / TILE_SIZE, y0 / TILE_SIZE);
            let (columns, rows) = (x1 / TILE_SIZE - first_column + 1, y1 / TILE_SIZE - first_row + 1);
            assert!(
                first_column < 256 && first_row < 256 && columns <= 256,
                "expected a box that fits into three bytes"
            );
            let counts_before = self.packed_counts;
            self.packed_counts += 1 << TILE_COUNT_BITS | (columns * rows) as u64;
            let packed_box = (first_column | first_row << 8 | (columns - 1) << 16) as u32;
            assert_eq!((counts_before >> TILE_COUNT_BITS) as usize, self.tile_queue.len());
            let first_tile = counts_before & ((1 << TILE_COUNT_BITS) - 1);
            self.tile_queue.push(TileEntry { first_tile, triangle, packed_box });
        }
    }

    /// Draws a triangle with 32-bit edge functions. Panics if an edge function overflows.
    fn draw_32_bits(&mut self, clipped_polygon: &ClippedPolygon, triangle: u32) {
        let edge = |from: &SnappedVertex, to: &SnappedVertex, x: i32, y: i32| -> i32 {
            let product = |a: i32, b: i32| a.checked_mul(b).expect("expected a value within 32 bits");
            product(to.x - from.x, y - from.y)
                .checked_sub(product(to.y - from.y, x - from.x))
                .expect("expected a value within 32 bits")
        };
        // A fan divides a polygon into triangles that share its first corner. The polygon is not clipped, so its fan
        // is one triangle.
        let [a, b, c] = with_farthest_first(&fan_triangles(clipped_polygon)[0]);
        let area = edge(&a, &b, c.x, c.y);
        let [x0, y0, x1, y1] = clipped_polygon.samples;
        for (row, column) in (y0..=y1).flat_map(|row| (x0..=x1).map(move |column| (row, column))) {
            let (x, y) = (sample_coordinate(column), sample_coordinate(row));
            // The edge function is positive inside of the edge and zero on it.
            let edges = [(&b, &c), (&c, &a), (&a, &b)];
            let is_inside = edges.iter().all(|(from, to)| edge(from, to, x, y) >= i32::from(!owns_edge(from, to)));
            let [slope_b, slope_c] = [b, c].map(|corner| (corner.z - a.z) * (1.0 / area as f32));
            let z = a.z + (edge(&c, &a, x, y) as f32 * slope_b + edge(&a, &b, x, y) as f32 * slope_c);
            if is_inside && z >= 0.0 {
                self.write_sample(column, row, if z < 1.0 { z } else { 1.0 }, triangle);
            }
        }
    }

    /// Index of the entry of `tile_queue` that contains a tile. Each round of the loop is a 32-way search by a warp:
    /// the 32 lanes look at evenly spaced entries, and the last of these that begins at or before the tile is the new
    /// lower end.
    fn find_entry(&self, tile: u64) -> usize {
        let (mut low, mut high) = (0, self.tile_queue.len());
        while high - low > 1 {
            let step = (high - low).div_ceil(32);
            let is_before = |entry: &usize| *entry < high && self.tile_queue[*entry].first_tile <= tile;
            low += step * ((0..32).map(|lane| low + step * lane).filter(is_before).count() - 1);
            high = high.min(low + step);
        }
        low
    }

    /// Twin of kernel `raster_tiles`: draws the part of a triangle in one strip of a queued tile. Skips a strip that
    /// lies entirely outside of an edge. Strips are numbered across all queued tiles; a tile has 2^`strip_splits`
    /// strips.
    fn draw_strip(&mut self, strip: u64, strip_splits: u32) {
        let tile = strip >> strip_splits;
        let TileEntry { first_tile, triangle, packed_box } = self.tile_queue[self.find_entry(tile)];
        // Index of the tile within the box of the triangle, row by row, and number of tile columns of the box.
        let (tile_of_entry, columns) = ((tile - first_tile) as u32, (packed_box >> 16 & 255) + 1);
        let strip_height = TILE_SIZE >> strip_splits;
        let first_column = TILE_SIZE * ((packed_box & 255) + tile_of_entry % columns) as i32;
        let first_row = TILE_SIZE * ((packed_box >> 8 & 255) + tile_of_entry / columns) as i32
            + strip_height * (strip as i32 & ((1 << strip_splits) - 1));
        let clipped_polygon =
            self.clipped_polygon(triangle, CullMode::None).expect("expected a triangle that is not culled");
        let [x0, y0, x1, y1] = clipped_polygon.samples;
        let (first_column, last_column, first_row, last_row) = (
            first_column.max(x0),
            (first_column + TILE_SIZE - 1).min(x1),
            first_row.max(y0),
            (first_row + strip_height - 1).min(y1),
        );
        for triangle_piece in fan_triangles(&clipped_polygon) {
            // Whether the whole strip is outside of the edge: the corner sample with the largest edge function is
            // outside.
            let is_beyond = |from: &SnappedVertex, to: &SnappedVertex| {
                let column = if to.y > from.y { first_column } else { last_column };
                let row = if to.x > from.x { last_row } else { first_row };
                edge(from, to, sample_coordinate(column), sample_coordinate(row)) < i64::from(!owns_edge(from, to))
            };
            let [a, b, c] = &triangle_piece;
            if is_beyond(b, c) || is_beyond(c, a) || is_beyond(a, b) {
                continue;
            }
            for (row, column) in
                (first_row..=last_row).flat_map(|row| (first_column..=last_column).map(move |column| (row, column)))
            {
                if let Some(depth) = depth_at(&triangle_piece, column, row) {
                    self.write_sample(column, row, depth, triangle);
                }
            }
        }
    }
}

/// Runs the twins of `raster`, `raster_warps` and `raster_tiles` with tiles that are halved `strip_splits` times.
/// Triangles and strips are processed in reverse order, because the result must not depend on the order. Returns the
/// keys of the samples and the number of triangles on each path.
fn rasterize_like_kernels(soup: &Soup, strip_splits: u32) -> (Vec<u64>, [usize; 3]) {
    let keys = vec![EMPTY_KEY; soup.viewport.pixel_count()];
    let mut traversal = RasterTraversal {
        soup,
        keys,
        warp_queue: vec![],
        tile_queue: vec![],
        packed_counts: 0,
        triangle_counts: [0; 3],
    };
    for group in &soup.groups {
        (group.first_triangle..group.first_triangle + group.triangle_count)
            .rev()
            .for_each(|triangle| traversal.draw_or_queue(triangle, group.cull_mode));
    }
    // Twin of kernel `raster_warps`. Queued triangles have passed back-face culling.
    for triangle in std::mem::take(&mut traversal.warp_queue) {
        let clipped_polygon =
            traversal.clipped_polygon(triangle, CullMode::None).expect("expected a triangle that is not culled");
        traversal.draw_32_bits(&clipped_polygon, triangle);
    }
    (0..(traversal.packed_counts & ((1 << TILE_COUNT_BITS) - 1)) << strip_splits)
        .rev()
        .for_each(|strip| traversal.draw_strip(strip, strip_splits));
    (traversal.keys, traversal.triangle_counts)
}

/// The twin panics if a 32-bit edge function overflows.
#[test]
fn all_raster_paths_equal_the_reference() {
    let text = concat!(include_str!("../../kernels/raster.cu"), include_str!("../../kernels/raster_setup.cuh"));
    for line in [
        format!("#define MAX_THREAD_SAMPLES {MAX_THREAD_SAMPLES}"),
        format!("#define MAX_WARP_EXTENT {MAX_WARP_EXTENT}"),
        format!("constexpr int TILE_SIZE = {TILE_SIZE};"),
        format!("constexpr unsigned MAX_STRIP_SPLITS = {MAX_STRIP_SPLITS};"),
        format!("constexpr unsigned TILE_COUNT_BITS = {TILE_COUNT_BITS};"),
    ] {
        assert!(text.contains(&line), "expected the kernel to contain '{line}'");
    }
    let mut path_counts = [0; 3];
    for soup in all_soups() {
        let reference_keys = soup.rasterize().keys;
        for strip_splits in 0..=MAX_STRIP_SPLITS {
            let (keys, triangle_counts) = rasterize_like_kernels(&soup, strip_splits);
            assert!(keys == reference_keys, "{}, strip_splits = {strip_splits}", soup.name);
            (0..3).for_each(|path| path_counts[path] += triangle_counts[path]);
        }
    }
    assert!(path_counts.iter().all(|path| *path > 10), "expected triangles on every path, got {path_counts:?}");
}

/// Which triangle covers a sample on an edge that two triangles share.
#[derive(Clone, Copy, PartialEq)]
enum EdgeRule {
    /// One of the two triangles, by the top-left rule.
    TopLeft,
    /// Both triangles.
    Both,
}

/// Number of triangle pieces that cover each sample. Clipping divides a triangle into pieces.
fn count_covering_pieces(soup: &Soup, edge_rule: EdgeRule) -> Vec<usize> {
    let [width, height] = soup.viewport.size().map(|side| side as i32);
    let pieces: Vec<[SnappedVertex; 3]> = (soup.triangles.iter())
        .filter_map(|triangle| clipped_polygon(&soup.viewport, &soup.positions, *triangle, CullMode::None).ok())
        .flat_map(|clipped_polygon| fan_triangles(&clipped_polygon))
        .collect();
    let covers = |piece: &[SnappedVertex; 3], column: i32, row: i32| {
        let [a, b, c] = piece;
        let is_inside = |from, to| edge(from, to, sample_coordinate(column), sample_coordinate(row)) >= 0;
        match edge_rule {
            EdgeRule::TopLeft => depth_at(piece, column, row).is_some(),
            EdgeRule::Both => is_inside(a, b) && is_inside(b, c) && is_inside(c, a),
        }
    };
    let count = |column, row| pieces.iter().filter(|piece| covers(piece, column, row)).count();
    let samples = (0..height).flat_map(|row| (0..width).map(move |column| (column, row)));
    samples.map(|(column, row)| count(column, row)).collect()
}

#[test]
fn fan_covers_every_sample_once() {
    let mut soup = fan_soup(clip_space_viewport(128, 128));
    // The center of the fan is on a sample, and four of the 40 spokes run along a row or a column of samples, so many
    // samples lie on edges.
    soup.positions[..2].copy_from_slice(&[1.0 / 128.0, 1.0 / 128.0]);
    for spoke in [0, 10, 20, 30] {
        let position = &mut soup.positions[3 * (1 + spoke)..][..2];
        // Spokes 0 and 20 are horizontal, so their y is set. Spokes 10 and 30 are vertical, so their x is set.
        let axis = usize::from(spoke % 20 == 0);
        position[axis] = 1.0 / 128.0;
    }
    soup.positions.chunks_exact_mut(3).for_each(|position| position[2] = 0.0);
    assert!(count_covering_pieces(&soup, EdgeRule::TopLeft).iter().all(|count| *count == 1));
    let shared_samples = count_covering_pieces(&soup, EdgeRule::Both).iter().filter(|count| **count > 1).count();
    assert!(shared_samples > 100, "negative control: expected many samples on shared edges, got {shared_samples}");
}

#[test]
fn fan_clipped_by_near_plane_covers_every_sample_once() {
    let mut soup = fan_soup(perspective_viewport(96, 64, 0.5, 100.0));
    // The fan becomes a floor one unit below the eye, which continues behind the eye.
    for position in soup.positions.chunks_exact_mut(3) {
        let [x, y] = [position[0], position[1]];
        position.copy_from_slice(&[30.0 * x, -1.0, 30.0 * y]);
    }
    let counts = count_covering_pieces(&soup, EdgeRule::TopLeft);
    assert!(counts.iter().all(|count| *count <= 1));
    // The image is 96 samples wide and 64 high. The horizon is between rows 31 and 32. The floor ends at a distance of
    // 57 (30 times the fan's radius of 1.9), one row below the horizon. The near plane clips only the part of the floor
    // below the image. So the floor covers all samples from row 34 on.
    let rows = counts.chunks_exact(96).map(|row| row.iter().sum::<usize>()).collect::<Vec<_>>();
    assert!(rows[..32].iter().all(|count| *count == 0) && rows[34..].iter().all(|count| *count == 96), "{rows:?}");
}

/// The id of a triangle is its index in the list that is drawn. A nearer triangle is visible regardless of its id. The
/// depth of a position is 0.5 - 0.5 z.
#[test]
fn depth_ties_go_to_the_lower_id() {
    // Triangles a to d fill the viewport. a and b are at z = 0.5, c and d at z = 0.25.
    let triangle_at = |z: f32| [[-1.0, -1.0, z], [3.0, -1.0, z], [-1.0, 3.0, z]].concat();
    let positions = [triangle_at(0.5), triangle_at(0.5), triangle_at(0.25), triangle_at(0.25)].concat();
    let draw_ids_and_depths = |triangles: &[[u32; 3]]| {
        let mut raster = VisibilityBuffer::new(clip_space_viewport(4, 4));
        let group = DrawRange { first_triangle: 0, triangle_count: triangles.len() as u32, cull_mode: CullMode::None };
        raster.draw(&positions, triangles, group);
        (raster.ids(), raster.depths())
    };
    let [a, b, c, d] = [[0, 1, 2], [3, 4, 5], [6, 7, 8], [9, 10, 11]];
    assert_eq!(draw_ids_and_depths(&[a, b]), (vec![Some(0); 16], vec![0.25; 16]));
    // c has the id 1 and d has the id 3.
    assert_eq!(draw_ids_and_depths(&[a, c, b, d]), (vec![Some(1); 16], vec![0.375; 16]));
    assert_eq!(draw_ids_and_depths(&[]), (vec![None; 16], vec![0.0; 16]));
}

#[test]
fn culled_triangles_report_the_reason() {
    let viewport = clip_space_viewport(10, 10);
    let cull_reason = |corners: [[f32; 3]; 3], cull_mode: CullMode| {
        clipped_polygon(&viewport, &corners.concat(), [0, 1, 2], cull_mode).err()
    };
    let front = [[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.0, 0.5, 0.0]];
    let back = [front[1], front[0], front[2]];
    assert_eq!(cull_reason(front, CullMode::Back), None);
    assert_eq!(cull_reason(back, CullMode::None), None);
    assert_eq!(cull_reason(back, CullMode::Back), Some(CullReason::BackFacing));
    assert_eq!(cull_reason([[f32::NAN, 0.0, 0.0], front[1], front[2]], CullMode::None), Some(CullReason::NotFinite));
    assert_eq!(cull_reason(front.map(|[x, y, z]| [x + 2.0, y, z]), CullMode::None), Some(CullReason::OutsideFrustum));
    assert_eq!(cull_reason(front.map(|[x, y, z]| [x, y, z + 1.5]), CullMode::None), Some(CullReason::OutsideFrustum));
    assert_eq!(cull_reason([front[0], front[0], front[1]], CullMode::None), Some(CullReason::Degenerate));
    // This triangle of 1/4 pixel is at the center of the viewport, between four samples.
    assert_eq!(cull_reason(front.map(|[x, y, z]| [0.05 * x, 0.05 * y, z]), CullMode::None), Some(CullReason::NoSample));
}

#[test]
fn plane_depth_and_rectangle_coverage_are_exact() {
    let (near, far) = (0.5, 50.0);
    let viewport: Viewport = perspective_viewport(200, 200, near, far);
    let corners = [[-2.0, -2.0, -4.0], [2.0, -2.0, -9.0], [-1.0, 3.0, -20.0]];
    let mut raster = VisibilityBuffer::new(viewport);
    let positions = corners.map(|corner| corner.map(|number: f64| number as f32)).concat();
    raster.draw(
        &positions,
        &[[0, 1, 2]],
        DrawRange { first_triangle: 0, triangle_count: 1, cull_mode: CullMode::None },
    );
    let [a, b, c] = corners.map(nalgebra::Vector3::from);
    let normal = (b - a).cross(&(c - a));
    // Half of the vertical field of view is 30 degrees.
    let focal = 1.0 / 30.0_f64.to_radians().tan();
    // Number of samples that the triangle covers, and largest error of their depth.
    let (mut samples, mut max_error) = (0, 0.0_f64);
    for (index, depth) in raster.depths().into_iter().enumerate().filter(|(index, _)| raster.ids()[*index].is_some()) {
        // The depth where the ray through the sample meets the plane of the triangle.
        let to_ndc = |pixel: usize| (pixel as f64 + 0.5) / 100.0 - 1.0;
        let ray = nalgebra::Vector3::new(to_ndc(index % 200) / focal, -to_ndc(index / 200) / focal, -1.0);
        let distance = normal.dot(&a) / normal.dot(&ray);
        let expected_depth = near * (far - distance) / ((far - near) * distance);
        max_error = max_error.max((f64::from(depth) - expected_depth).abs());
        samples += 1;
    }
    // Corners move by up to 1/512 pixel per axis when they are snapped. The depth of this plane changes by less than
    // 1e-3 per pixel and axis, so the error is below 2 * 1e-3 / 512 = 4e-6.
    assert!(samples > 1000 && max_error < 4e-6, "{samples} samples, maximum error {max_error:e}");

    let mut raster = VisibilityBuffer::new(clip_space_viewport(100, 100));
    // The rectangle is 0.8 x 1.2 in a viewport of 2 x 2, which has 100 x 100 samples.
    let rectangle = [[-0.6, -0.4, 0.0], [0.2, -0.4, 0.0], [0.2, 0.8, 0.0], [-0.6, 0.8, 0.0]].concat();
    raster.draw(
        &rectangle,
        &[[0, 1, 2], [0, 2, 3]],
        DrawRange { first_triangle: 0, triangle_count: 2, cull_mode: CullMode::Back },
    );
    assert_eq!(raster.ids().iter().flatten().count(), 40 * 60);
}
