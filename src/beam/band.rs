//! Symmetric band matrices: stiffness and mass of a chain of beam elements. Two nodes of an element have twelve degrees
//! of freedom, so an entry is at most eleven columns from the diagonal.

use nalgebra::DMatrix;

/// Number of entries of a row of the lower triangle.
const WIDTH: usize = 12;

/// A symmetric band matrix, or a lower triangular factor of one.
#[derive(Debug, Clone)]
pub(crate) struct BandMatrix {
    /// Per row: the entries up to the diagonal, which is the last one. Entries left of the first column are not used.
    rows: Vec<[f64; WIDTH]>,
}

impl BandMatrix {
    /// A matrix of zeros.
    pub(crate) fn zeros(size: usize) -> Self {
        Self { rows: vec![[0.0; WIDTH]; size] }
    }

    /// The number of rows.
    pub(crate) const fn size(&self) -> usize {
        self.rows.len()
    }

    /// Adds to an entry of the lower triangle. `column` is at most `row` and at least `row - 11`.
    pub(crate) fn add(&mut self, row: usize, column: usize, value: f64) {
        self.rows[row][WIDTH - 1 + column - row] += value;
    }

    /// The columns of the nonzero entries of a row of the lower triangle, without the diagonal.
    const fn columns(row: usize) -> std::ops::Range<usize> {
        row.saturating_sub(WIDTH - 1)..row
    }

    fn entry(&self, row: usize, column: usize) -> f64 {
        self.rows[row][WIDTH - 1 + column - row]
    }

    /// The matrix without its first `count` rows and columns.
    pub(crate) fn without_first(&self, count: usize) -> Self {
        Self { rows: self.rows[count.min(self.size())..].to_vec() }
    }

    /// The product with the columns of `vectors`.
    pub(crate) fn multiply(&self, vectors: &DMatrix<f64>) -> DMatrix<f64> {
        let mut product = DMatrix::zeros(vectors.nrows(), vectors.ncols());
        for (x, mut y) in vectors.column_iter().zip(product.column_iter_mut()) {
            for row in 0..self.size() {
                let mut sum = self.entry(row, row) * x[row];
                for column in Self::columns(row) {
                    let entry = self.entry(row, column);
                    sum += entry * x[column];
                    y[column] += entry * x[row];
                }
                y[row] += sum;
            }
        }
        product
    }

    /// The lower triangular L with L L^T equal to this matrix; `None` unless the matrix is positive definite.
    pub(crate) fn factor(&self) -> Option<Self> {
        let mut factor = self.clone();
        for row in 0..self.size() {
            for column in Self::columns(row).chain([row]) {
                let products =
                    (Self::columns(row).start..column).map(|k| factor.entry(row, k) * factor.entry(column, k));
                let rest = self.entry(row, column) - products.sum::<f64>();
                let entry = if column == row { rest.sqrt() } else { rest / factor.entry(column, column) };
                let is_valid = entry.is_finite() && (column < row || rest > 0.0);
                if !is_valid {
                    return None;
                }
                factor.rows[row][WIDTH - 1 + column - row] = entry;
            }
        }
        Some(factor)
    }

    /// Solves L X = `vectors` for a factor L.
    pub(crate) fn solve_lower(&self, mut vectors: DMatrix<f64>) -> DMatrix<f64> {
        for mut x in vectors.column_iter_mut() {
            for row in 0..self.size() {
                let products = Self::columns(row).map(|column| self.entry(row, column) * x[column]);
                x[row] = (x[row] - products.sum::<f64>()) / self.entry(row, row);
            }
        }
        vectors
    }

    /// Solves L^T X = `vectors` for a factor L.
    pub(crate) fn solve_upper(&self, mut vectors: DMatrix<f64>) -> DMatrix<f64> {
        for mut x in vectors.column_iter_mut() {
            for row in (0..self.size()).rev() {
                x[row] /= self.entry(row, row);
                for column in Self::columns(row) {
                    x[column] -= self.entry(row, column) * x[row];
                }
            }
        }
        vectors
    }

    /// All entries.
    #[cfg(test)]
    pub(crate) fn to_dense(&self) -> DMatrix<f64> {
        self.multiply(&DMatrix::identity(self.size(), self.size()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Random;

    #[test]
    fn operations_agree_with_dense_ones() {
        let mut random = Random::new(3);
        let mut matrix = BandMatrix::zeros(31);
        for row in 0..31 {
            for column in BandMatrix::columns(row) {
                matrix.add(row, column, random.uniform_symmetric(1.0));
            }
            matrix.add(row, row, 15.0);
        }
        let dense = matrix.to_dense();
        assert_eq!(dense, dense.transpose());
        assert!(dense[(20, 8)] == 0.0 && dense[(20, 9)] != 0.0, "expected 11 entries left of the diagonal");
        let vectors = DMatrix::from_fn(31, 3, |_, _| random.uniform_symmetric(1.0));
        assert!((matrix.multiply(&vectors) - &dense * &vectors).norm() <= 1e-12);
        let factor = matrix.factor().expect("a positive definite matrix");
        let solution = factor.solve_upper(factor.solve_lower(vectors.clone()));
        assert!((dense * solution - vectors).norm() <= 1e-12);
    }

    #[test]
    fn first_rows_and_columns_can_be_removed() {
        let mut matrix = BandMatrix::zeros(20);
        for row in 0..20 {
            BandMatrix::columns(row)
                .chain([row])
                .for_each(|column| matrix.add(row, column, (20 * row + column) as f64));
        }
        let expected = matrix.to_dense().view((6, 6), (14, 14)).into_owned();
        assert_eq!(matrix.without_first(6).to_dense(), expected);
        assert_eq!(matrix.without_first(30).size(), 0);
    }

    #[test]
    fn indefinite_matrix_has_no_factor() {
        for diagonal in [0.0, -1.0, f64::NAN] {
            let mut matrix = BandMatrix::zeros(3);
            (0..3).for_each(|row| matrix.add(row, row, if row == 2 { diagonal } else { 1.0 }));
            assert!(matrix.factor().is_none(), "{diagonal}");
        }
    }
}
