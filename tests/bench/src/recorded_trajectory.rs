//! Recorded trajectories: modal coordinates over time, and optionally transforms.

use std::path::Path;

use super::exact_state::ExactState;
use modalcast_model::error::{Error, Result, invalid};
use modalcast_model::load::parse_numpy;
use modalcast_model::scene::Scene;

/// A recorded trajectory of one scene.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordedTrajectory {
    /// Packed coordinates of each step.
    q: Vec<Vec<f64>>,
    /// Per step: `world_from_domain` of each transform root, 12 numbers each. Empty if all domains stay at their
    /// placements.
    transforms: Vec<Vec<f64>>,
}

impl RecordedTrajectory {
    /// Reads a recording: a `.csv` file with a header and the columns time, q0, q1, ..., or a folder as `modalcast-sim`
    /// writes it. The folder holds `q.npy` (steps x coordinates) and, if the domains move, `transforms.npy` (steps x
    /// transform roots x 12).
    ///
    /// # Errors
    /// `NotFound` when a file is missing; `Invalid` when it cannot be parsed or does not match the scene.
    pub fn read(path: &Path, scene: &Scene) -> Result<Self> {
        let name = path.display().to_string();
        let transforms_path = path.join("transforms.npy");
        let trajectory = match path.is_dir() {
            true => Self {
                q: read_npy_rows(&path.join("q.npy"))?,
                transforms: if transforms_path.exists() { read_npy_rows(&transforms_path)? } else { Vec::new() },
            },
            false => Self { q: read_csv_rows(path)?, transforms: Vec::new() },
        };
        trajectory.validate(scene).map_err(|error| error.prefix_field(&name))
    }

    /// The recording next to a scene: the only file in its folder that ends in `.q.csv`. `None` when there is no such
    /// file or several.
    ///
    /// # Errors
    /// As [`Self::read`].
    pub fn find_next_to(source: &str, scene: &Scene) -> Result<Option<Self>> {
        let path = Path::new(source);
        let folder = if path.is_dir() { path } else { path.parent().unwrap_or(path) };
        let Ok(entries) = std::fs::read_dir(folder) else { return Ok(None) };
        let is_recording = |path: &std::path::PathBuf| path.to_string_lossy().ends_with(".q.csv");
        let mut paths: Vec<_> = entries.flatten().map(|entry| entry.path()).filter(is_recording).collect();
        let last_path = paths.pop();
        match (last_path, paths.is_empty()) {
            (Some(path), true) if path.exists() => Self::read(&path, scene).map(Some),
            _ => Ok(None),
        }
    }

    fn validate(self, scene: &Scene) -> Result<Self> {
        let check_lengths = |field: &str, rows: &[Vec<f64>], length: usize| {
            let mismatched = rows.iter().enumerate().find(|(_, row)| row.len() != length);
            mismatched.map_or(Ok(()), |(index, row)| {
                Err(invalid(format!("{field}[{index}]"), format!("{length} numbers"), row.len()))
            })
        };
        if self.q.is_empty() {
            return Err(invalid("steps", "at least one", 0));
        }
        check_lengths("q", &self.q, scene.layout.coordinates)?;
        check_lengths("transforms", &self.transforms, 12 * scene.transform_roots.count())?;
        if !self.transforms.is_empty() && self.transforms.len() != self.q.len() {
            return Err(invalid("transforms", format!("{} steps", self.q.len()), self.transforms.len()));
        }
        match self.q.iter().chain(&self.transforms).flatten().find(|number| !number.is_finite()) {
            Some(number) => Err(invalid("entries", "finite numbers", number)),
            None => Ok(self),
        }
    }

    pub(super) fn steps(&self) -> usize {
        self.q.len()
    }

    /// The exact state at a step. Without recorded transforms, the domains are at their placements.
    pub(super) fn step(&self, scene: &Scene, step: usize) -> ExactState {
        let placement = |domain: u32| scene.domains[domain as usize].placement.0.map(f64::from);
        let placements = || scene.transform_roots.domains().map(placement).collect();
        let recorded_transforms = |row: &Vec<f64>| row.as_chunks().0.to_vec();
        ExactState {
            q: self.q[step].clone(),
            transforms: self.transforms.get(step).map_or_else(placements, recorded_transforms),
        }
    }
}

/// The rows of a `.npy` array of at least two dimensions; all but the first dimension are flattened.
fn read_npy_rows(path: &Path) -> Result<Vec<Vec<f64>>> {
    let not_found =
        |error: std::io::Error| Error::NotFound { what: "recording", given: format!("{}: {error}", path.display()) };
    let array = parse_numpy(&std::fs::read(path).map_err(not_found)?)?;
    if array.shape.len() < 2 || array.fortran_order {
        let given = format!("{:?}, fortran {}", array.shape, array.fortran_order);
        return Err(invalid(path.display().to_string(), "steps x numbers in C order", given));
    }
    let width = array.shape[1..].iter().product::<usize>().max(1);
    let row = |row: &[f32]| row.iter().map(|number| f64::from(*number)).collect();
    Ok(array.entries.chunks_exact(width).map(row).collect())
}

/// All columns except the first of a CSV file with a header.
fn read_csv_rows(path: &Path) -> Result<Vec<Vec<f64>>> {
    let to_error = |error: csv::Error| match error.is_io_error() {
        true => Error::NotFound { what: "recording", given: format!("{}: {error}", path.display()) },
        false => invalid(path.display().to_string(), "rows of time,q0,q1,...", error),
    };
    let mut reader = csv::Reader::from_path(path).map_err(to_error)?;
    let without_time = |row: Result<Vec<f64>, csv::Error>| -> Result<Vec<f64>> {
        let row = row.map_err(to_error)?;
        Ok(row.into_iter().skip(1).collect())
    };
    reader.deserialize().map(without_time).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::workloads::{Size, WorkloadKind};

    /// A scene of one domain with two modes.
    fn scene() -> std::sync::Arc<Scene> {
        WorkloadKind::Single { power: 6, rank: 2 }.build(Size::Full).expect("built").scene
    }

    /// Reads a CSV file with this text by its path and by [`RecordedTrajectory::find_next_to`], which must agree.
    fn read(text: &str) -> Result<RecordedTrajectory> {
        let folder = tempfile::tempdir().expect("expected a folder");
        let path = folder.path().join("x.q.csv");
        std::fs::write(&path, text).expect("written");
        let found = RecordedTrajectory::find_next_to(folder.path().to_str().expect("UTF-8"), &scene());
        let read = RecordedTrajectory::read(&path, &scene());
        assert_eq!(found, read.clone().map(Some));
        read
    }

    #[test]
    fn columns_after_time_are_coordinates() {
        let trajectory = read("time,q0,q1\n0,1.5,-2\n1,3,4\n").expect("a valid recording");
        assert_eq!(trajectory.steps(), 2);
        assert_eq!(trajectory.step(&scene(), 1).q, [3.0, 4.0]);
        assert_eq!(trajectory.step(&scene(), 1).transforms[0][0], 1.0, "at its placement");
    }

    #[test]
    fn rejects_bad_recordings_with_the_reason() {
        for (text, reason) in [
            ("time,q0\n0,1\n", "q[0]: expected 2 numbers, got 1"),
            ("time,q0,q1\n", "steps: expected at least one"),
            ("time,q0,q1\n0,1,x\n", "expected rows of time,q0,q1"),
            ("time,q0,q1\n0,1,inf\n", "expected finite numbers"),
        ] {
            let error = read(text).expect_err(reason).to_string();
            assert!(error.contains(reason), "{error}");
        }
        assert!(matches!(RecordedTrajectory::read(Path::new("absent.csv"), &scene()), Err(Error::NotFound { .. })));
        assert_eq!(RecordedTrajectory::find_next_to("tree", &scene()), Ok(None));
    }

    #[test]
    fn reads_transforms_from_a_folder_of_arrays() {
        let folder = tempfile::tempdir().expect("expected a folder");
        let write = |name: &str, shape: &str, numbers: &[f32]| {
            let mut header = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}");
            // Magic, version and header length take 10 bytes. Spaces and a newline fill the header, so that the numbers
            // start at a multiple of 64 bytes.
            header.push_str(&" ".repeat(63 - (header.len() + 10) % 64));
            header.push('\n');
            let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
            bytes.extend((header.len() as u16).to_le_bytes());
            bytes.extend(header.as_bytes());
            bytes.extend(numbers.iter().flat_map(|number| number.to_le_bytes()));
            std::fs::write(folder.path().join(name), bytes).expect("written");
        };
        write("q.npy", "(2, 2)", &[1.0, 2.0, 3.0, 4.0]);
        // The numbers 0 to 23, so that the transform of the second step starts with 12.
        let numbers: Vec<f32> = (0..24).map(|number| number as f32).collect();
        write("transforms.npy", "(2, 1, 12)", &numbers);
        let trajectory = RecordedTrajectory::read(folder.path(), &scene()).expect("a valid recording");
        let step = trajectory.step(&scene(), 1);
        assert_eq!((step.q, step.transforms[0][0]), (vec![3.0, 4.0], 12.0));
    }
}
