//! Arrays that the demo's processes recorded, with one row per step.

use std::path::Path;

use modalcast_model::error::{Result, fault, invalid};
use modalcast_model::load::parse_numpy;

/// Rows of f32, one per step, in C order.
#[derive(Debug)]
pub(super) struct StepRecords {
    /// The number of steps, followed by the shape of the row of one step.
    shape: Vec<usize>,
    entries: Vec<f32>,
}

impl StepRecords {
    /// Reads a `.npy` file. The first axis counts the steps.
    ///
    /// # Errors
    /// `Fault` if the file cannot be read; `Invalid` if it does not contain an array in C order.
    pub(super) fn read(path: &Path) -> Result<Self> {
        let path_text = path.display().to_string();
        let bytes = std::fs::read(path).map_err(|error| fault("demo", format!("{path_text}: {error}")))?;
        let array = parse_numpy(&bytes).map_err(|error| error.prefix_field(&path_text))?;
        if array.fortran_order || array.shape.is_empty() {
            return Err(invalid(path_text, "an array of steps in C order", format!("the shape {:?}", array.shape)));
        }
        Ok(Self { shape: array.shape, entries: array.entries })
    }

    #[cfg(test)]
    pub(super) fn from_rows(row_shape: &[usize], rows: &[Vec<f32>]) -> Self {
        Self { shape: [&[rows.len()], row_shape].concat(), entries: rows.concat() }
    }

    /// The number of steps, followed by the shape of the row of one step.
    pub(super) fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// The entries of the row of a step.
    pub(super) fn row(&self, step: usize) -> &[f32] {
        let row_length = self.row_length();
        &self.entries[step * row_length..][..row_length]
    }

    #[cfg(test)]
    pub(super) fn row_mut(&mut self, step: usize) -> &mut [f32] {
        let row_length = self.row_length();
        &mut self.entries[step * row_length..][..row_length]
    }

    fn row_length(&self) -> usize {
        self.shape[1..].iter().product()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_rows_of_the_client_library_and_rejects_truncated_files() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let path = folder.path().join("rows.npy");
        let mut writer = modalcast_client::npy::Writer::create(&path, &[2, 2]).expect("expected a new file");
        for row in [[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0]] {
            writer.write_row(&row).expect("expected a written row");
        }
        writer.finish().expect("expected a complete file");
        let records = StepRecords::read(&path).expect("expected valid records");
        assert_eq!(records.shape(), [2, 2, 2]);
        assert_eq!(records.row(1), [5.0, 6.0, 7.0, 8.0]);
        assert!(StepRecords::read(&folder.path().join("missing.npy")).is_err());
        let bytes = std::fs::read(&path).expect("expected the file");
        std::fs::write(&path, &bytes[..bytes.len() - 4]).expect("expected a truncated file");
        let error = StepRecords::read(&path).expect_err("expected an error").to_string();
        assert!(error.contains("rows.npy") && error.contains("data: expected"), "{error}");
    }
}
