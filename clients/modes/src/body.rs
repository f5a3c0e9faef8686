//! The body: its surface, materials and clamps, and its division into cells.

use std::collections::BTreeMap;

use modalcast_model::error::{Result, invalid};
use nalgebra::Vector3;

use crate::cell_moments::{GroupMoments, integrate};
use crate::cell_pieces::CellPieces;
use crate::constraints::{HeldPoint, points_on_groups, remove_regions};
use crate::grid::Grid;
use crate::inside_outside::InsideOutsideTest;
use crate::material_rays::{RaySegment, trace_rays};
use crate::materials::Material;
use crate::parameters::ModelingParameters;
use crate::region::{self, Region};
use crate::surface::Surface;
use crate::surface_file::SurfaceFile;
use crate::thickness::thicken;
use crate::winding_number::WindingNumber;

/// Parts with less than this share of the volume are removed.
const MIN_PART_FRACTION: f64 = 1e-3;
/// Pieces with less than this share of a cell are removed.
const MIN_PIECE_FRACTION: f64 = 1e-9;
/// Limit on the cells of a grid, with and without material.
const MAX_GRID_CELLS: f64 = 4e6;

/// The input of all grids.
#[derive(Debug)]
pub struct Body {
    pub surface: Surface,
    /// The material of each group.
    pub materials: Vec<Material>,
    /// Held regions.
    pub regions: Vec<Region>,
    /// Meters per unit of the file.
    pub unit: f64,
    /// For a surface with holes.
    winding: Option<WindingNumber>,
    /// For each axis, the coordinates of faces and clamps across it, meters.
    breaks: [Vec<f64>; 3],
    /// For each axis, the coordinates where a clamp can begin or end, meters.
    clamp_borders: [Vec<f64>; 3],
}

/// The cells of one grid.
#[derive(Debug)]
pub struct Layout {
    pub grid: Grid,
    pub pieces: CellPieces,
    /// The moments of each piece.
    pub moments: Vec<Vec<GroupMoments>>,
    /// Points on the border of removed regions and on held groups.
    pub held_points: Vec<HeldPoint>,
    /// Parts that were too small.
    pub removed_parts: usize,
}

impl Layout {
    /// The number of freedoms.
    pub const fn freedoms(&self) -> usize {
        3 * self.pieces.node_count
    }

    /// The share of its cell that each piece fills.
    pub fn volume_fractions(&self) -> Vec<f64> {
        volume_fractions(&self.moments)
    }
}

impl Body {
    /// Prepares the surface of a file.
    ///
    /// # Errors
    /// `Invalid` if the surface has no area or no volume, or a clamp or material is wrong.
    pub fn new(file: &SurfaceFile, parameters: &ModelingParameters) -> Result<Self> {
        let mesh = &file.mesh;
        let unit = parameters.unit.meters();
        let mut surface = Surface::new(&mesh.positions, &mesh.triangles, &mesh.triangle_groups);
        if surface.area() <= 0.0 {
            return Err(invalid("surface", "at least one triangle with an area", "none"));
        }
        if let Some(thickness) = parameters.thickness {
            surface = thicken(&surface, thickness * unit);
        }
        let winding = (!surface.is_closed).then(|| WindingNumber::new(&surface));
        let regions: Vec<Region> =
            parameters.clamps.iter().map(|text| Region::parse(text, &file.groups)).collect::<Result<_>>()?;
        let mut breaks = aligned_faces(&surface);
        let mut clamp_borders: [Vec<f64>; 3] = Default::default();
        for (axis, position) in parameters.clamps.iter().flat_map(|text| region::limits(text)) {
            breaks[axis].push(position * unit);
            clamp_borders[axis].push(position * unit);
        }
        for region in &regions {
            if let Region::Sphere { center, .. } = region {
                (0..3).for_each(|axis| clamp_borders[axis].push(center[axis] * unit));
            }
        }
        let materials = parameters.materials_of(&file.groups)?;
        let body = Self { materials, surface, regions, unit, winding, breaks, clamp_borders };
        body.check_volume()?;
        Ok(body)
    }

    /// The diagonal of the bounding box, meters.
    pub fn diagonal(&self) -> f64 {
        let (low, high) = self.surface.bounds();
        (high - low).norm()
    }

    /// The size of cells at which the search of a grid begins: eight cells along the longest side, and for a slender body
    /// four times the side of a square section, so that rays hit it.
    pub fn initial_cell_size(&self) -> f64 {
        let (low, high) = self.surface.bounds();
        let section_side = (self.surface.volume().abs() / self.diagonal()).sqrt();
        match self.surface.is_closed {
            true => ((high - low).max() / 8.0).min(4.0 * section_side),
            false => (high - low).max() / 8.0,
        }
    }

    /// A point in units of cells in the coordinates of the file.
    pub fn to_file(&self, grid: &Grid, point: Vector3<f64>) -> Vector3<f64> {
        (grid.origin + point * grid.cell_size) / self.unit
    }

    /// Fails unless the surface encloses a volume. An open surface such as a bowl has points with a winding number above
    /// 1/2 near it, but most of them have much less than 1.
    fn check_volume(&self) -> Result<()> {
        /// Cells along the longest side.
        const CELLS: f64 = 6.0;
        /// The smallest mean winding number inside of a body with holes.
        const MIN_WINDING: f64 = 0.8;
        let (low, high) = self.surface.bounds();
        let grid = Grid::covering(low, high, (high - low).max() / CELLS);
        let segments = self.trace(&grid);
        let ray_volume =
            |axis: usize, segment: &RaySegment| (segment.end - segment.start) * grid.ray_area(axis, segment.ray);
        let volume_of = |axis: usize| segments[axis].iter().map(|segment| ray_volume(axis, segment)).sum::<f64>();
        let volume = match self.surface.is_closed {
            true => self.surface.volume().abs(),
            false => [0, 1, 2].map(volume_of).into_iter().fold(0.0, f64::max) * grid.cell_size.powi(3),
        };
        let hint = "a surface that encloses a volume. For a sheet, give its --thickness";
        // Rounding of the positions gives a plane surface a volume of this size.
        if volume < 1e-9 * self.surface.area() * self.diagonal() {
            return Err(invalid("surface", hint, "none"));
        }
        let Some(winding) = &self.winding else { return Ok(()) };
        let mut sum = (0.0, 0.0);
        for (axis, segments) in segments.iter().enumerate() {
            for segment in segments {
                let middle = f64::midpoint(segment.start, segment.end);
                let point = grid.point_on_ray(axis, segment.ray, middle);
                let length = segment.end - segment.start;
                let value = winding.at(grid.origin + point * grid.cell_size).abs().min(1.0);
                sum = (sum.0 + length * value, sum.1 + length);
            }
        }
        match sum.0 >= MIN_WINDING * sum.1 {
            true => Ok(()),
            false => Err(invalid("surface", hint, "a surface with large openings")),
        }
    }

    /// The finest grid with at most `limit` freedoms. The search begins at the cell size `first`, in meters, and ends when
    /// the grid has at least the share `enough` of the freedoms.
    ///
    /// # Errors
    /// `Invalid` if the coarsest grid has more freedoms, or clamps hold nothing or everything.
    pub fn finest_layout(&self, limit: usize, first: f64, enough: f64) -> Result<Layout> {
        const MAX_TRIALS: usize = 12;
        let (low, high) = self.surface.bounds();
        let extent = high - low;
        let mut cell_size = first;
        // Cell sizes with too many freedoms, and with few enough.
        let (mut too_fine, mut coarse_enough): (f64, f64) = (0.0, f64::INFINITY);
        let mut best: Option<Layout> = None;
        for _ in 0..MAX_TRIALS {
            let cells: f64 = (0..3).map(|axis| (extent[axis] / cell_size).max(1.0)).product();
            if cells > MAX_GRID_CELLS {
                break;
            }
            let layout = self.layout(cell_size)?;
            let ratio = layout.freedoms() as f64 / limit as f64;
            if ratio <= 1.0 {
                coarse_enough = coarse_enough.min(cell_size);
                if best.as_ref().is_none_or(|best| layout.freedoms() > best.freedoms()) {
                    best = Some(layout);
                }
            } else {
                too_fine = too_fine.max(cell_size);
            }
            if (enough..=1.0).contains(&ratio) || (ratio <= 1.0 && coarse_enough < 1.005 * too_fine) {
                break;
            }
            // Freedoms grow with the power -2 (plates) to -3 (solids) of the cell size.
            let guess = cell_size * (ratio / 0.97).powf(0.4).clamp(0.25, 4.0);
            let is_bracketed = guess > too_fine && guess < coarse_enough;
            cell_size = if is_bracketed { guess } else { f64::midpoint(too_fine, coarse_enough.min(4.0 * too_fine)) };
        }
        best.ok_or_else(|| invalid("--freedoms", "more, because the coarsest grid of this surface has more", limit))
    }

    /// Divides the body into cells of the given size.
    ///
    /// # Errors
    /// `Invalid` if clamps hold nothing or everything.
    pub fn layout(&self, cell_size: f64) -> Result<Layout> {
        let (low, high) = self.surface.bounds();
        let grid = Grid::covering(low, high, cell_size).with_breaks(&self.breaks);
        let mut held_points = points_on_groups(&self.surface, &grid, &self.regions);
        let mut segments = self.trace(&grid);
        // The rays of a coarse grid can miss a slender body.
        let has_material = segments.iter().any(|segments| !segments.is_empty());
        for (axis, segments) in segments.iter_mut().enumerate() {
            let (remaining, held) =
                remove_regions(&grid, segments, axis, &self.regions, &self.borders(&grid, axis), |point| {
                    self.to_file(&grid, point)
                });
            *segments = remaining;
            held_points.extend(held);
        }
        if has_material && segments.iter().all(Vec::is_empty) {
            return Err(invalid("--clamp", "a region that leaves a part of the body free", "one with the whole body"));
        }
        let pieces = CellPieces::new(&grid, &self.surface, &segments);
        let moments = integrate(&grid, &pieces, &segments);
        Ok(remove_small_parts(Layout { grid, pieces, moments, held_points, removed_parts: 0 }))
    }

    /// Fails for a clamp that touches nothing.
    ///
    /// # Errors
    /// `Invalid` with the clamp, and the bounds of the surface in the units of the file.
    pub fn check_clamps(&self, grid: &Grid, clamps: &[String]) -> Result<()> {
        let segments = self.trace(grid);
        for (region, text) in self.regions.iter().zip(clamps) {
            let one_region = std::slice::from_ref(region);
            let is_group = !points_on_groups(&self.surface, grid, one_region).is_empty();
            let touches = |axis: usize| {
                let borders = self.borders(grid, axis);
                let (_, held) = remove_regions(grid, &segments[axis], axis, one_region, &borders, |point| {
                    self.to_file(grid, point)
                });
                !held.is_empty()
            };
            if !is_group && !(0..3).any(touches) {
                let (low, high) = self.surface.bounds();
                let range = |axis: usize| {
                    let [low, high] = [low[axis], high[axis]].map(|coordinate| coordinate / self.unit);
                    format!("{} from {low:.4} to {high:.4}", ["x", "y", "z"][axis])
                };
                let expected = format!("a region that touches the body: {}", [0, 1, 2].map(range).join(", "));
                return Err(invalid(format!("--clamp '{text}'"), expected, "one that does not"));
            }
        }
        Ok(())
    }

    /// The coordinates along an axis where a clamp can begin or end, in units of cells.
    fn borders(&self, grid: &Grid, axis: usize) -> Vec<f64> {
        self.clamp_borders[axis].iter().map(|position| (position - grid.origin[axis]) / grid.cell_size).collect()
    }

    /// The material along the rays of the three axes.
    fn trace(&self, grid: &Grid) -> [Vec<RaySegment>; 3] {
        let inside = self.winding.as_ref().map(|winding| InsideOutsideTest::new(grid, winding));
        [0, 1, 2].map(|axis| trace_rays(&self.surface, grid, axis, inside.as_ref()))
    }
}

/// For each axis, the coordinates of the largest faces across it.
fn aligned_faces(surface: &Surface) -> [Vec<f64>; 3] {
    /// Limit on the coordinates per axis.
    const MAX_FACES: usize = 64;
    /// Faces with a smaller share of the area are left out.
    const MIN_AREA: f64 = 1e-3;
    let (low, high) = surface.bounds();
    let total_area = surface.area();
    [0, 1, 2].map(|axis| {
        // Rounded coordinates, as coordinates of one face differ by rounding.
        let step = (high - low).norm() * 1e-7;
        let mut areas: BTreeMap<i64, f64> = BTreeMap::new();
        for triangle in 0..surface.triangles.len() {
            let corners = surface.corners(triangle).map(|corner| corner[axis]);
            if corners.iter().all(|corner| (corner - corners[0]).abs() < step) {
                let area = surface.area_vector(triangle).norm();
                *areas.entry(((corners[0] - low[axis]) / step).round() as i64).or_default() += area;
            }
        }
        let mut faces: Vec<(f64, i64)> = areas.into_iter().map(|(key, area)| (area, key)).collect();
        faces.retain(|(area, _)| *area > MIN_AREA * total_area);
        faces.sort_by(|(a, _), (b, _)| b.total_cmp(a));
        faces.truncate(MAX_FACES);
        faces.into_iter().map(|(_, key)| low[axis] + key as f64 * step).collect()
    })
}

/// The share of its cell that each piece fills.
fn volume_fractions(moments: &[Vec<GroupMoments>]) -> Vec<f64> {
    moments.iter().map(|groups| groups.iter().map(GroupMoments::volume_fraction).sum()).collect()
}

/// Removes parts with less than [`MIN_PART_FRACTION`] of the volume, and pieces without volume.
fn remove_small_parts(layout: Layout) -> Layout {
    let fractions = layout.volume_fractions();
    let layout =
        retain_pieces(layout, &fractions.iter().map(|fraction| *fraction > MIN_PIECE_FRACTION).collect::<Vec<_>>());
    let fractions = layout.volume_fractions();
    let mut part_volumes = vec![0.0; layout.pieces.part_count];
    for (part, fraction) in layout.pieces.parts.iter().zip(&fractions) {
        part_volumes[*part as usize] += fraction;
    }
    let limit = MIN_PART_FRACTION * part_volumes.iter().sum::<f64>();
    let removed_parts = part_volumes.iter().filter(|volume| **volume < limit).count();
    let keep: Vec<bool> = layout.pieces.parts.iter().map(|part| part_volumes[*part as usize] >= limit).collect();
    Layout { removed_parts, ..retain_pieces(layout, &keep) }
}

fn retain_pieces(layout: Layout, keep: &[bool]) -> Layout {
    if keep.iter().all(|keep| *keep) {
        return layout;
    }
    let pieces = layout.pieces.retain(keep);
    let moments = layout.moments.into_iter().zip(keep).filter(|(_, keep)| **keep).map(|(moments, _)| moments);
    Layout { pieces, moments: moments.collect(), ..layout }
}
