//! The modal matrix U of one shape: 3n x r, column-major f32, so that each mode is contiguous.

use std::sync::Arc;

use crate::error::{Result, invalid};

/// The largest number of modes of a domain.
pub const MAX_RANK: usize = 512;

/// U with 3n rows and r columns. Row 3i + c is component c of vertex i; every entry is finite. Clones share the
/// entries.
#[derive(Debug, Clone, PartialEq)]
pub struct Modes {
    vertices: usize,
    rank: usize,
    columns: Arc<Vec<f32>>,
}

impl Modes {
    /// No modes, for a rigid domain.
    pub fn rigid() -> Self {
        Self { vertices: 0, rank: 0, columns: Arc::default() }
    }

    /// U from its entries in column-major order (Vega's order).
    ///
    /// # Errors
    /// `Invalid` if the number of rows is not a positive multiple of three, there are more than 512 columns, the number
    /// of entries differs from rows x columns, or an entry is not finite.
    pub fn from_columns(rows: usize, rank: usize, columns: Vec<f32>) -> Result<Self> {
        check_sizes(rows, rank, columns.len())?;
        if let Some(index) = columns.iter().position(|entry| !entry.is_finite()) {
            let field = format!("modes[{}, {}]", index % rows, index / rows);
            return Err(invalid(field, "a finite number", columns[index]));
        }
        if rank == 0 {
            return Ok(Self::rigid());
        }
        Ok(Self { vertices: rows / 3, rank, columns: Arc::new(columns) })
    }

    /// U from its entries in row-major order (NumPy's default order).
    ///
    /// # Errors
    /// As for [`Self::from_columns`].
    pub fn from_rows(rows: usize, rank: usize, entries: &[f32]) -> Result<Self> {
        check_sizes(rows, rank, entries.len())?;
        let columns = (0..rank).flat_map(|mode| (0..rows).map(move |row| entries[row * rank + mode])).collect();
        Self::from_columns(rows, rank, columns)
    }

    /// The number r of modes.
    pub const fn rank(&self) -> usize {
        self.rank
    }

    /// The number n of vertices, or 0 if there are no modes.
    pub const fn vertices(&self) -> usize {
        self.vertices
    }

    /// All entries, column-major.
    pub fn columns(&self) -> &[f32] {
        &self.columns
    }

    /// The 3n entries of one mode.
    pub fn column(&self, mode: usize) -> &[f32] {
        &self.columns[3 * self.vertices * mode..][..3 * self.vertices]
    }

    /// The entry of vertex `vertex`, component `component`, mode `mode`.
    pub fn entry(&self, vertex: usize, component: usize, mode: usize) -> f32 {
        self.columns[3 * self.vertices * mode + 3 * vertex + component]
    }

    /// The 3 x r block of U at a point of a triangle, row-major: the rows of the three vertices, weighted by the
    /// barycentric coordinates `weights` in f64 and rounded once.
    pub fn block_at_point(&self, vertices: [u32; 3], weights: [f64; 3]) -> Vec<f32> {
        let entry = |component: usize, mode: usize| {
            let weighted_entry =
                |(vertex, weight): (&u32, f64)| weight * f64::from(self.entry(*vertex as usize, component, mode));
            vertices.iter().zip(weights).map(weighted_entry).sum::<f64>() as f32
        };
        (0..3)
            .flat_map(|component| (0..self.rank).map(move |mode| (component, mode)))
            .map(|(component, mode)| entry(component, mode))
            .collect()
    }

    /// Replaces U by [`Self::rigid`] if all entries are zero.
    pub fn without_zero_matrix(self) -> Self {
        if self.columns.iter().all(|entry| *entry == 0.0) { Self::rigid() } else { self }
    }
}

fn check_sizes(rows: usize, rank: usize, entries: usize) -> Result<()> {
    if !rows.is_multiple_of(3) || rows == 0 {
        return Err(invalid("modes.rows", "a positive multiple of 3", rows));
    }
    if rank > MAX_RANK {
        return Err(invalid("modes.columns", format!("0 to {MAX_RANK}"), rank));
    }
    match rows.checked_mul(rank) {
        Some(expected) if expected == entries => Ok(()),
        _ => Err(invalid("modes.entries", format!("{rows} x {rank}"), entries)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn row_major_and_column_major_give_the_same_matrix() {
        let modes_from_rows = Modes::from_rows(3, 2, &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]).expect("valid modes");
        let modes_from_columns = Modes::from_columns(3, 2, vec![1.0, 3.0, 5.0, 2.0, 4.0, 6.0]).expect("valid modes");
        assert_eq!(modes_from_rows, modes_from_columns);
        assert_eq!(modes_from_rows.entry(0, 2, 1), 6.0);
        assert_eq!(modes_from_rows.column(1), [2.0, 4.0, 6.0]);
    }

    #[test]
    fn block_at_point_interpolates_the_rows_of_the_vertices() {
        // Three vertices and two modes: the entry of component c of vertex v is 3 v + c in mode 0 and 9 + 3 v + c in
        // mode 1.
        let modes = Modes::from_columns(9, 2, (0..18).map(|entry| entry as f32).collect()).expect("valid modes");
        // All weight is on vertex 0.
        assert_eq!(modes.block_at_point([2, 0, 1], [0.0, 1.0, 0.0]), [0.0, 9.0, 1.0, 10.0, 2.0, 11.0]);
        // The mean of the three vertices equals vertex 1.
        let center = [1.0 / 3.0; 3];
        assert_eq!(modes.block_at_point([0, 1, 2], center), [3.0, 12.0, 4.0, 13.0, 5.0, 14.0]);
        assert!(Modes::rigid().block_at_point([0, 1, 2], center).is_empty());
    }

    #[test]
    fn invalid_modes_are_rejected_with_their_field() {
        for (rows, rank, entries, field) in [
            (4, 1, vec![0.0; 4], "modes.rows"),
            (0, 0, vec![], "modes.rows"),
            (3, 513, vec![0.0; 3 * 513], "modes.columns"),
            (3, 2, vec![0.0; 5], "modes.entries"),
            (3, 1, vec![0.0, f32::NAN, 0.0], "modes[1, 0]"),
        ] {
            let message = Modes::from_columns(rows, rank, entries).expect_err(field).to_string();
            assert!(message.starts_with(field), "expected an error about {field}, got {message}");
        }
    }
}
