//! The cells of VTK's unstructured grids, for both of its file formats. Cell types: VTK's header `vtkCellType.h`.

use modalcast_model::error::{Result, invalid};
use nalgebra::Vector3;

use crate::cell_collector::{CellCollector, CellKind};

/// Groups of an array with more values are no regions.
const MAX_GROUPS: usize = 64;

/// Parts of the names of arrays with regions. Without such an array, the first one with integers has the regions.
const REGION_ARRAYS: [&str; 4] = ["physical", "material", "region", "medit:ref"];

/// An unstructured grid, or one of its pieces.
#[derive(Debug, Default)]
pub struct VtkCells {
    /// Three coordinates per point.
    pub points: Vec<f64>,
    /// The points of all cells.
    pub connectivity: Vec<i64>,
    /// The end of each cell in the connectivity.
    pub ends: Vec<i64>,
    /// The type of each cell.
    pub types: Vec<i64>,
    /// Names and values of arrays with one integer per cell.
    pub cell_data: Vec<(String, Vec<i64>)>,
}

impl VtkCells {
    /// Adds the points and cells to those of other pieces.
    ///
    /// # Errors
    /// `Invalid` for indices out of range, and arrays of different lengths.
    pub fn add_to(self, cells: &mut CellCollector) -> Result<()> {
        let first = cells.positions().len();
        let count = self.points.len() / 3;
        cells.positions().extend(self.points.chunks_exact(3).map(Vector3::from_column_slice));
        if self.ends.len() != self.types.len() {
            return Err(invalid("cells", format!("{} types", self.ends.len()), self.types.len()));
        }
        let regions = self.regions();
        let mut start = 0;
        for (index, (end, cell_type)) in self.ends.iter().zip(&self.types).enumerate() {
            let range = usize::try_from(*end)
                .ok()
                .and_then(|end| self.connectivity.get(start..end).map(|points| (end, points)));
            let Some((end, points)) = range else {
                let expected = format!("an ascending end up to {}", self.connectivity.len());
                return Err(invalid(format!("cell {index}"), expected, end));
            };
            start = end;
            let node = |point: &i64| match usize::try_from(*point) {
                Ok(point) if point < count => Ok((first + point) as u32),
                _ => Err(invalid(format!("cell {index}"), format!("one of {count} points"), point)),
            };
            let nodes: Vec<u32> = points.iter().map(node).collect::<Result<_>>()?;
            let kind = kind_of(*cell_type, nodes.len())?;
            let group = regions.and_then(|(name, values)| Some(format!("{name} {}", values.get(index)?)));
            cells.add(kind, &nodes, &group.as_deref().into_iter().collect::<Vec<_>>())?;
        }
        Ok(())
    }

    /// The array that divides the cells into regions.
    fn regions(&self) -> Option<&(String, Vec<i64>)> {
        let has_few_values = |(_, values): &&(String, Vec<i64>)| {
            let different: std::collections::BTreeSet<i64> = values.iter().copied().take(1 << 24).collect();
            different.len() <= MAX_GROUPS
        };
        let mut arrays = self.cell_data.iter().filter(has_few_values).peekable();
        let first = arrays.peek().copied();
        let is_region = |name: &str| REGION_ARRAYS.iter().any(|part| name.to_lowercase().contains(part));
        arrays.find(|(name, _)| is_region(name)).or(first)
    }
}

/// The kind of a cell type. Lagrange tetrahedra of second order have the nodes of quadratic ones.
fn kind_of(cell_type: i64, nodes: usize) -> Result<CellKind> {
    let flat = |name, dimension| CellKind::Flat { name, dimension };
    let solid = |name| CellKind::Other { name };
    Ok(match (cell_type, nodes) {
        (0..=2, _) => flat("points", 0),
        (3 | 4 | 21 | 35 | 68 | 75, _) => flat("lines", 1),
        (5 | 6 | 22 | 34 | 69 | 76, _) => flat("triangles", 2),
        (7..=9 | 23 | 28 | 30 | 36 | 70 | 77, _) => flat("polygons", 2),
        (10, _) | (71 | 78, 4) => CellKind::Tet4,
        (24, _) | (71 | 78, 10) => CellKind::Tet10([0, 1, 2, 3, 4, 5, 6, 7, 8, 9]),
        (71 | 78, _) => solid("tetrahedra of higher order"),
        (11 | 12 | 25 | 29 | 33 | 72 | 79, _) => solid("hexahedra"),
        (13 | 26 | 31 | 32 | 73 | 80, _) => solid("prisms"),
        (14 | 27 | 37 | 74 | 81, _) => solid("pyramids"),
        (15 | 16 | 41 | 42, _) => solid("polyhedra"),
        _ => return Err(invalid("cell type", "a type of VTK's linear or quadratic cells", cell_type)),
    })
}
