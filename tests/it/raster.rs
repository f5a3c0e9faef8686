//! The definition of the compute rasterizer is compared with geometry, and a CPU twin of the kernels' traversal with
//! the definition.

use modalcast_compute::reference::raster::{
    ClippedPolygon, CullReason, EMPTY_KEY, SnappedVertex, VisibilityBuffer, clipped_polygon, depth_at, edge,
    fan_triangles,
};
use modalcast_model::scene::{CullMode, DrawRange, Viewport};

use crate::common::soups::{Soup, all_soups, clip_space_viewport, fan_soup, perspective_viewport};

/// Constants of `kernels/raster.cu`; a test compares them with its text.
const MAX_THREAD_SAMPLES: i32 = 32;
const MAX_WARP_EXTENT: i32 = 16384;
const TILE_SIZE: i32 = 64;
const MAX_STRIP_SPLITS: u32 = 3;
const BITS: u32 = 40;

/// CPU twin of the raster kernels for one window. Queues may have any order, and the per-thread and per-warp paths use
/// 32-bit edge functions.
struct Walk<'a> {
    soup: &'a Soup,
    keys: Vec<u64>,
    medium: Vec<u32>,
    /// First tile, triangle, packed box.
    large: Vec<(u64, u32, u32)>,
    tally: u64,
    paths: [usize; 3],
}

impl Walk<'_> {
    fn put(&mut self, column: i32, row: i32, depth: f32, triangle: u32) {
        let at = row as usize * self.soup.viewport.size()[0] as usize + column as usize;
        self.keys[at] = self.keys[at].min(u64::from(depth.to_bits()) << 32 | u64::from(triangle));
    }

    fn clipped_polygon(&self, triangle: u32, cull_mode: CullMode) -> Result<ClippedPolygon, CullReason> {
        clipped_polygon(&self.soup.viewport, &self.soup.positions, self.soup.triangles[triangle as usize], cull_mode)
    }

    /// `raster`: the narrow tests of `setup_unclipped`, and the entries that each path pushes.
    fn aim(&mut self, triangle: u32, cull_mode: CullMode) {
        let Ok(clipped_polygon) = self.clipped_polygon(triangle, cull_mode) else { return };
        let extent = |of: fn(&SnappedVertex) -> i32| {
            let all = || clipped_polygon.corners.iter().map(of);
            all().max().expect("corners") - all().min().expect("corners")
        };
        let [x0, y0, x1, y1] = clipped_polygon.samples;
        let narrow = !clipped_polygon.is_clipped
            && extent(|corner| corner.x) <= MAX_WARP_EXTENT
            && extent(|corner| corner.y) <= MAX_WARP_EXTENT;
        if narrow && (x1 - x0 + 1) * (y1 - y0 + 1) <= MAX_THREAD_SAMPLES {
            self.paths[0] += 1;
            self.draw_narrow(&clipped_polygon, triangle);
        } else if narrow {
            self.paths[1] += 1;
            self.medium.push(triangle);
        } else {
            self.paths[2] += 1;
            let (x, y) = (x0 / TILE_SIZE, y0 / TILE_SIZE);
            let (across, down) = (x1 / TILE_SIZE - x + 1, y1 / TILE_SIZE - y + 1);
            assert!(x < 256 && y < 256 && across <= 256, "boxes are three bytes");
            let before = self.tally;
            self.tally += 1 << BITS | (across * down) as u64;
            let box_of = (x | y << 8 | (across - 1) << 16) as u32;
            assert_eq!((before >> BITS) as usize, self.large.len());
            self.large.push((before & ((1 << BITS) - 1), triangle, box_of));
        }
    }

    /// Checked arithmetic panics when an edge function overflows 32 bits.
    fn draw_narrow(&mut self, clipped_polygon: &ClippedPolygon, triangle: u32) {
        let edge = |from: &SnappedVertex, to: &SnappedVertex, x: i32, y: i32| -> i32 {
            let [one, other] = [(to.x - from.x, y - from.y), (to.y - from.y, x - from.x)];
            let product = |(a, b): (i32, i32)| a.checked_mul(b).expect("32 bits hold it");
            product(one).checked_sub(product(other)).expect("32 bits hold it")
        };
        let [a, b, c] = fan_triangles(clipped_polygon)[0];
        let area = edge(&a, &b, c.x, c.y);
        let [x0, y0, x1, y1] = clipped_polygon.samples;
        for (row, column) in (y0..=y1).flat_map(|row| (x0..=x1).map(move |column| (row, column))) {
            let (x, y) = (256 * column + 128, 256 * row + 128);
            let inside = [(&b, &c), (&c, &a), (&a, &b)].iter().all(|(from, to)| {
                let takes = to.y < from.y || (to.y == from.y && to.x > from.x);
                edge(from, to, x, y) >= i32::from(!takes)
            });
            let [share_b, share_c] = [edge(&c, &a, x, y), edge(&a, &b, x, y)].map(|at| at as f32 * (1.0 / area as f32));
            let z = a.z + (share_b * (b.z - a.z) + share_c * (c.z - a.z));
            if inside && z <= 1.0 {
                self.put(column, row, if z > 0.0 { z } else { 0.0 }, triangle);
            }
        }
    }

    /// Index of the list entry that contains a tile, found by the 32-way search of a warp.
    fn find(&self, tile: u64) -> usize {
        let (mut low, mut high) = (0, self.large.len());
        while high - low > 1 {
            let step = (high - low).div_ceil(32);
            let is_before = |own: &usize| *own < high && self.large[*own].0 <= tile;
            low += step * ((0..32).map(|lane| low + step * lane).filter(is_before).count() - 1);
            high = high.min(low + step);
        }
        low
    }

    /// `raster_tiles`: one strip of a listed tile, clipped to the triangle's samples. A strip that lies entirely beyond
    /// an edge is rejected.
    fn strip(&mut self, at: u64, strip_splits: u32) {
        let tile = at >> strip_splits;
        let (first, triangle, box_of) = self.large[self.find(tile)];
        let (own, across) = ((tile - first) as u32, (box_of >> 16 & 255) + 1);
        let tall = TILE_SIZE >> strip_splits;
        let x = TILE_SIZE * ((box_of & 255) + own % across) as i32;
        let y =
            TILE_SIZE * ((box_of >> 8 & 255) + own / across) as i32 + tall * (at as i32 & ((1 << strip_splits) - 1));
        let clipped_polygon = self.clipped_polygon(triangle, CullMode::None).expect("queued");
        let [x0, y0, x1, y1] = clipped_polygon.samples;
        let (x, right, y, bottom) = (x.max(x0), (x + TILE_SIZE - 1).min(x1), y.max(y0), (y + tall - 1).min(y1));
        for piece in fan_triangles(&clipped_polygon) {
            let beyond = |from: &SnappedVertex, to: &SnappedVertex| {
                let column = if to.y > from.y { x } else { right };
                let row = if to.x > from.x { bottom } else { y };
                let takes = to.y < from.y || (to.y == from.y && to.x > from.x);
                edge(from, to, 256 * column + 128, 256 * row + 128) < i64::from(!takes)
            };
            let [a, b, c] = &piece;
            if beyond(b, c) || beyond(c, a) || beyond(a, b) {
                continue;
            }
            for (row, column) in (y..=bottom).flat_map(|row| (x..=right).map(move |column| (row, column))) {
                if let Some(depth) = depth_at(&piece, column, row) {
                    self.put(column, row, depth, triangle);
                }
            }
        }
    }
}

/// Runs `raster`, `raster_warps` and `raster_tiles` in sequence, with reversed queues and tiles halved `strip_splits`
/// times.
fn twin_of_raster(soup: &Soup, strip_splits: u32) -> (Vec<u64>, [usize; 3]) {
    let keys = vec![EMPTY_KEY; soup.viewport.pixel_count()];
    let mut walk = Walk { soup, keys, medium: vec![], large: vec![], tally: 0, paths: [0; 3] };
    for group in &soup.groups {
        (group.first..group.first + group.triangles).rev().for_each(|triangle| walk.aim(triangle, group.cull_mode));
    }
    for triangle in std::mem::take(&mut walk.medium) {
        let clipped_polygon = walk.clipped_polygon(triangle, CullMode::None).expect("queued");
        walk.draw_narrow(&clipped_polygon, triangle);
    }
    (0..(walk.tally & ((1 << BITS) - 1)) << strip_splits).rev().for_each(|at| walk.strip(at, strip_splits));
    (walk.keys, walk.paths)
}

/// The per-thread, per-warp and per-tile paths equal the definition, and the 32-bit edge functions of the first two do
/// not overflow.
#[test]
fn all_raster_paths_equal_the_definition() {
    let text = include_str!("../../kernels/raster.cu");
    for line in [
        format!("#define MAX_THREAD_SAMPLES {MAX_THREAD_SAMPLES}"),
        format!("#define MAX_WARP_EXTENT {MAX_WARP_EXTENT}"),
        format!("constexpr int TILE_SIZE = {TILE_SIZE};"),
        format!("constexpr unsigned MAX_STRIP_SPLITS = {MAX_STRIP_SPLITS};"),
        format!("constexpr unsigned TILE_COUNT_BITS = {BITS};"),
    ] {
        assert!(text.contains(&line), "the kernel has another {line}");
    }
    let mut all = [0; 3];
    for soup in all_soups() {
        let want = soup.rasterize().keys;
        for strip_splits in 0..=MAX_STRIP_SPLITS {
            let (keys, paths) = twin_of_raster(&soup, strip_splits);
            assert!(keys == want, "{}, {strip_splits} halvings", soup.name);
            (0..3).for_each(|path| all[path] += paths[path]);
        }
    }
    assert!(all.iter().all(|path| *path > 10), "every path is taken: {all:?}");
}

/// Number of pieces that cover each sample, with the top-left rule or with all edges closed.
fn takers(soup: &Soup, closed: bool) -> Vec<usize> {
    let [width, height] = soup.viewport.size().map(|side| side as i32);
    let all: Vec<[SnappedVertex; 3]> = (soup.triangles.iter())
        .filter_map(|triangle| clipped_polygon(&soup.viewport, &soup.positions, *triangle, CullMode::None).ok())
        .flat_map(|clipped_polygon| fan_triangles(&clipped_polygon))
        .collect();
    let takes = |piece: &[SnappedVertex; 3], column: i32, row: i32| {
        let [a, b, c] = piece;
        let inside = |from, to| edge(from, to, 256 * column + 128, 256 * row + 128) >= 0;
        if closed { inside(a, b) && inside(b, c) && inside(c, a) } else { depth_at(piece, column, row).is_some() }
    };
    let count = |column, row| all.iter().filter(|piece| takes(piece, column, row)).count();
    (0..height).flat_map(|row| (0..width).map(move |column| (column, row))).map(|(x, y)| count(x, y)).collect()
}

#[test]
fn fan_covers_every_sample_once() {
    let mut soup = fan_soup(clip_space_viewport(128, 128));
    // The center is on a sample and some spokes run along rows and columns, so many samples lie on edges.
    soup.positions[..2].copy_from_slice(&[1.0 / 128.0, 1.0 / 128.0]);
    for spoke in [0, 10, 20, 30] {
        let own = &mut soup.positions[3 * (1 + spoke)..][..2];
        let axis = usize::from(spoke % 20 == 0);
        own[axis] = 1.0 / 128.0;
    }
    soup.positions.chunks_exact_mut(3).for_each(|position| position[2] = 0.0);
    assert!(takers(&soup, false).iter().all(|count| *count == 1));
    let twice = takers(&soup, true).iter().filter(|count| **count > 1).count();
    assert!(twice > 100, "negative control: without the rule {twice} samples are taken twice or more");
}

#[test]
fn fan_clipped_by_near_plane_covers_every_sample_once() {
    let mut soup = fan_soup(perspective_viewport(96, 64, 0.5, 100.0));
    // A floor one unit below the eye that continues behind it.
    for position in soup.positions.chunks_exact_mut(3) {
        let [x, y] = [position[0], position[1]];
        position.copy_from_slice(&[30.0 * x, -1.0, 30.0 * y]);
    }
    let counts = takers(&soup, false);
    assert!(counts.iter().all(|count| *count <= 1));
    // The floor ends at a distance of 57: 1 / 57 below the horizon, half a row. The near plane is at 0.5, so all rows
    // below are floor.
    let rows = counts.chunks_exact(96).map(|row| row.iter().sum::<usize>()).collect::<Vec<_>>();
    assert!(rows[..32].iter().all(|count| *count == 0) && rows[34..].iter().all(|count| *count == 96), "{rows:?}");
}

/// A nearer triangle wins whatever its id.
#[test]
fn depth_ties_go_to_the_lower_id() {
    let square = |z: f32| [[-1.0, -1.0, z], [3.0, -1.0, z], [-1.0, 3.0, z]].concat();
    let positions = [square(0.5), square(0.5), square(0.25), square(0.25)].concat();
    let drawn = |triangles: &[[u32; 3]]| {
        let mut raster = VisibilityBuffer::new(clip_space_viewport(4, 4));
        let group = DrawRange { first: 0, triangles: triangles.len() as u32, cull_mode: CullMode::None };
        raster.draw(&positions, triangles, group);
        (raster.ids(), raster.depths())
    };
    let [a, b, c, d] = [[0, 1, 2], [3, 4, 5], [6, 7, 8], [9, 10, 11]];
    assert_eq!(drawn(&[a, b]), (vec![Some(0); 16], vec![0.75; 16]));
    assert_eq!(drawn(&[a, c, b, d]), (vec![Some(1); 16], vec![0.625; 16]));
    assert_eq!(drawn(&[]), (vec![None; 16], vec![1.0; 16]));
}

#[test]
fn dropped_triangles_report_the_reason() {
    let viewport = clip_space_viewport(10, 10);
    let why = |corners: [[f32; 3]; 3], cull_mode: CullMode| {
        clipped_polygon(&viewport, &corners.concat(), [0, 1, 2], cull_mode).err()
    };
    let front = [[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.0, 0.5, 0.0]];
    let back = [front[1], front[0], front[2]];
    assert_eq!(why(front, CullMode::Back), None);
    assert_eq!(why(back, CullMode::None), None);
    assert_eq!(why(back, CullMode::Back), Some(CullReason::BackFacing));
    assert_eq!(why([[f32::NAN, 0.0, 0.0], front[1], front[2]], CullMode::None), Some(CullReason::NotFinite));
    assert_eq!(why(front.map(|[x, y, z]| [x + 2.0, y, z]), CullMode::None), Some(CullReason::OutsideFrustum));
    assert_eq!(why(front.map(|[x, y, z]| [x, y, z + 1.5]), CullMode::None), Some(CullReason::OutsideFrustum));
    assert_eq!(why([front[0], front[0], front[1]], CullMode::None), Some(CullReason::Degenerate));
    assert_eq!(why(front.map(|[x, y, z]| [0.05 * x, 0.05 * y, z]), CullMode::None), Some(CullReason::NoSample));
}

#[test]
fn plane_depth_and_rectangle_coverage_are_exact() {
    let (near, far) = (0.5, 50.0);
    let viewport: Viewport = perspective_viewport(200, 200, near, far);
    let corners = [[-2.0, -2.0, -4.0], [2.0, -2.0, -9.0], [-1.0, 3.0, -20.0]];
    let mut raster = VisibilityBuffer::new(viewport);
    let positions = corners.map(|corner| corner.map(|number: f64| number as f32)).concat();
    raster.draw(&positions, &[[0, 1, 2]], DrawRange { first: 0, triangles: 1, cull_mode: CullMode::None });
    let [a, b, c] = corners.map(nalgebra::Vector3::from);
    let normal = (b - a).cross(&(c - a));
    let focal = 1.0 / 30.0_f64.to_radians().tan();
    let (mut seen, mut worst) = (0, 0.0_f64);
    for (at, depth) in raster.depths().into_iter().enumerate().filter(|(at, _)| raster.ids()[*at].is_some()) {
        let pixel = |place: usize| (place as f64 + 0.5) / 100.0 - 1.0;
        let ray = nalgebra::Vector3::new(pixel(at % 200) / focal, -pixel(at / 200) / focal, -1.0);
        let distance = normal.dot(&a) / normal.dot(&ray);
        let z = (far + near) / (far - near) - 2.0 * far * near / ((far - near) * distance);
        worst = worst.max((f64::from(depth) - (0.5 * z + 0.5)).abs());
        seen += 1;
    }
    // Corners move by up to 1/512 pixel when they are snapped, and the depth of this plane changes by less than 1e-3
    // per pixel.
    assert!(seen > 1000 && worst < 4e-6, "{seen} samples, off by up to {worst:e}");

    let mut raster = VisibilityBuffer::new(clip_space_viewport(100, 100));
    let square = [[-0.6, -0.4, 0.0], [0.2, -0.4, 0.0], [0.2, 0.8, 0.0], [-0.6, 0.8, 0.0]].concat();
    raster.draw(&square, &[[0, 1, 2], [0, 2, 3]], DrawRange { first: 0, triangles: 2, cull_mode: CullMode::Back });
    assert_eq!(raster.ids().iter().flatten().count(), 40 * 60);
}
