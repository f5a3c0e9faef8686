//! Writes the coordinates and transforms of every step to NumPy files.

use std::path::Path;

use modalcast_client::Error as ClientError;
use modalcast_client::npy::Writer as NpyWriter;

use crate::error::{Result, invalid_input};
use crate::model::Model;
use crate::step_values::StepValues;

/// The record of a run: q.npy (steps x coordinates) and transforms.npy (steps x domains x 12), f32.
pub(crate) struct Recorder {
    q: NpyWriter,
    transforms: NpyWriter,
}

impl Recorder {
    /// Creates a record in `folder`, and the folder. Replaces an existing record.
    ///
    /// # Errors
    /// `Client` if a file cannot be written.
    pub(crate) fn create(folder: &Path, model: &Model) -> Result<Self> {
        std::fs::create_dir_all(folder).map_err(|error| ClientError::file(folder, error))?;
        let q = NpyWriter::create(&folder.join("q.npy"), &[model.coordinate_count])?;
        let transforms = NpyWriter::create(&folder.join("transforms.npy"), &[model.domains.len(), 12])?;
        Ok(Self { q, transforms })
    }

    /// Opens the record of a run that continues from a checkpoint. A record in `folder` continues after the
    /// `recorded_rows` that it had at the checkpoint; later rows are removed. Without a record in `folder`, a new one
    /// begins with the next step.
    ///
    /// # Errors
    /// `Client` if a file cannot be written or has fewer rows; `Invalid` if the run before the checkpoint has not
    /// written the record in `folder`.
    pub(crate) fn resume(folder: &Path, model: &Model, recorded_rows: Option<u64>) -> Result<Self> {
        let q_path = folder.join("q.npy");
        if !q_path.exists() {
            return Self::create(folder, model);
        }
        let Some(rows) = recorded_rows else {
            let expected = format!(
                "a folder without {}, because the checkpoint is that of a run without --record",
                q_path.display()
            );
            return Err(invalid_input("--record", expected, "a record of another run"));
        };
        let q = NpyWriter::resume(&q_path, &[model.coordinate_count], rows)?;
        let transforms = NpyWriter::resume(&folder.join("transforms.npy"), &[model.domains.len(), 12], rows)?;
        Ok(Self { q, transforms })
    }

    /// Writes the values of a step.
    ///
    /// # Errors
    /// `Client` if a file cannot be written.
    pub(crate) fn write_row(&mut self, values: &StepValues) -> Result<()> {
        self.q.write_row(&values.q)?;
        Ok(self.transforms.write_row(values.transforms.as_flattened())?)
    }

    /// Makes all rows so far durable, and returns their number.
    ///
    /// # Errors
    /// `Client` if a file cannot be written.
    pub(crate) fn sync(&mut self) -> Result<u64> {
        self.q.sync()?;
        self.transforms.sync()?;
        Ok(self.q.row_count())
    }

    /// Closes the files.
    ///
    /// # Errors
    /// `Client` if a file cannot be written.
    pub(crate) fn finish(self) -> Result<()> {
        self.q.finish()?;
        self.transforms.finish()?;
        Ok(())
    }
}
