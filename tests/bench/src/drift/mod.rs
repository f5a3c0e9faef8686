//! Drift over long runs: position errors after 1, 10, ..., 1,000,000 steps against the exact motion in f64.
//!
//! Every step passes through the code of the server: [`StepUpdate::parse`](modalcast_model::scene::StepUpdate::parse),
//! [`SceneState::apply`](modalcast_model::scene::SceneState::apply) and the CPU deformer. The server carries no error
//! from step to step: each step is compared with a new deformer that receives only the state of this step. Clients that
//! accumulate T in f32 are the negative control.

mod case;
mod markdown;
mod measurement;
mod sent_transform;

use std::path::Path;

use serde::Serialize;

pub use self::measurement::{DriftErrors, DriftResult, DriftWindow};
use crate::output_files::write_files;
use crate::provenance::Provenance;
use modalcast_model::error::{Result, fault_in};

/// Results of all cases, with everything that another run needs to repeat them.
#[derive(Debug, Clone, Serialize)]
pub struct DriftReport {
    #[serde(rename = "made")]
    pub provenance: Provenance,
    /// Steps of each case.
    pub steps: u64,
    pub cases: Vec<DriftResult>,
    /// Expectations that are not met, each as `case: reason`.
    pub failed: Vec<String>,
}

/// Measures all cases over `steps` steps. `on_start` receives the name of each case.
///
/// # Errors
/// Errors of the scenes and of the deformer. Expectations that are not met are recorded in the report instead.
pub fn measure(steps: u64, mut on_start: impl FnMut(&str)) -> Result<DriftReport> {
    let mut cases = Vec::new();
    for case in case::all() {
        on_start(case.name);
        cases.push(measurement::measure(case, steps)?);
    }
    let failed = cases.iter().flat_map(DriftResult::failures).collect();
    Ok(DriftReport { provenance: Provenance::collect(), steps, cases, failed })
}

impl DriftReport {
    /// Whether all expectations are met.
    pub fn passed(&self) -> bool {
        self.failed.is_empty()
    }

    /// Writes `report.json` and `report.md` into a folder, which is created.
    ///
    /// # Errors
    /// `Fault` when a file cannot be written.
    pub fn write(&self, folder: &Path) -> Result<()> {
        let json = serde_json::to_vec_pretty(self).map_err(fault_in("report"))?;
        write_files(folder, [("report.json", json), ("report.md", markdown::markdown(self).into_bytes())])
    }
}

#[cfg(test)]
mod tests;
