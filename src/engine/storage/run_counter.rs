//! Persistent counter of runs. A run is the sequence of steps from one writer; its number is `StepId.run`. Each new
//! writer gets the next number, which is on disk before it is returned, so that no number is used twice, even after a
//! crash.

use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use super::file_system::{FileSystem, write_atomic};
use crate::engine::lock::lock;
use modalcast_model::error::{Error, Result, fault_in};

/// Name of the file in the state folder. It contains the number of the last run as decimal digits.
const FILE_NAME: &str = "last_run";

/// The number of the server's last run, in memory and on disk.
#[derive(Debug)]
pub(in crate::engine) struct RunCounter {
    file_system: Arc<dyn FileSystem>,
    path: PathBuf,
    last_run: Mutex<u64>,
}

impl RunCounter {
    /// Reads the counter in a state folder. Without a counter file, it starts at 0.
    ///
    /// # Errors
    /// `Unavailable` when the file cannot be read or is damaged.
    pub(in crate::engine) fn open(state_folder: &Path, file_system: &Arc<dyn FileSystem>) -> Result<Self> {
        let path = state_folder.join(FILE_NAME);
        let unavailable = |reason: String| Error::Unavailable {
            what: "counter of runs",
            reason: format!("{}: {reason}", path.display()),
            remedy: "Write into the file a number larger than every run that clients have seen".into(),
        };
        let last_run = match fs::read_to_string(&path) {
            Ok(text) => text.trim().parse().map_err(|_| unavailable(format!("expected a number, got {text:?}")))?,
            Err(error) if error.kind() == ErrorKind::NotFound => 0,
            Err(error) => return Err(unavailable(error.to_string())),
        };
        Ok(Self { file_system: Arc::clone(file_system), path, last_run: Mutex::new(last_run) })
    }

    /// Returns the number of a new run, which is larger than all earlier numbers. Waits until it is on disk.
    ///
    /// # Errors
    /// `Fault` when the number cannot be written. Later calls return larger numbers.
    pub(in crate::engine) fn next(&self) -> Result<u64> {
        let mut last_run = lock(&self.last_run);
        *last_run += 1;
        let digits = last_run.to_string();
        write_atomic(&*self.file_system, &self.path, digits.as_bytes()).map_err(fault_in("counter of runs"))?;
        Ok(*last_run)
    }

    /// Raises the counter to `run`, which was read from a checkpoint, if the counter is lower.
    pub(in crate::engine) fn continue_after(&self, run: u64) {
        let mut last_run = lock(&self.last_run);
        *last_run = run.max(*last_run);
    }
}

#[cfg(test)]
mod tests {
    use super::super::file_system::DiskFileSystem;
    use super::*;

    fn disk() -> Arc<dyn FileSystem> {
        Arc::new(DiskFileSystem)
    }

    fn open(folder: &Path) -> RunCounter {
        RunCounter::open(folder, &disk()).expect("expected a counter")
    }

    #[test]
    fn runs_increase_also_after_the_counter_is_opened_again() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let counter = open(folder.path());
        assert_eq!([counter.next(), counter.next()], [Ok(1), Ok(2)]);
        // A crash: the counter is not closed.
        let counter = open(folder.path());
        assert_eq!(counter.next(), Ok(3));
        counter.continue_after(2);
        assert_eq!(counter.next(), Ok(4));
        counter.continue_after(10);
        assert_eq!(counter.next(), Ok(11));
    }

    #[test]
    fn damaged_counter_is_not_replaced_by_zero() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        fs::write(folder.path().join(FILE_NAME), "12x").expect("expected a written file");
        assert!(matches!(RunCounter::open(folder.path(), &disk()), Err(Error::Unavailable { .. })));
    }

    #[test]
    fn run_that_cannot_be_written_is_not_returned() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let counter = open(&folder.path().join("missing"));
        assert!(matches!(counter.next(), Err(Error::Fault { .. })));
    }
}
