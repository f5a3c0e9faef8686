//! Time integrators and computed modes: error against step and time.
//!
//! - `oscillators`: linear modes from 1 mHz to 1 MHz against their closed form;
//! - `beam`: a cantilever beam against its modal series, with the error of the time integration apart from that of the
//!   modes that are left out;
//! - `cubic`: systems with cubic forces against a Runge-Kutta reference;
//! - `extremes`: extreme steps, eigenvalues and loads;
//! - `solid_modes`: frequencies by `modalcast model` against exact ones;
//! - `plants`: the time of a step of plants whose domains act on each other.
//!
//! Observed orders are compared with the theory, and a negative control must have a large error. `recommendation`
//! selects the fastest setting within each limit of the error.

mod beam;
mod cubic;
mod expectations;
mod extremes;
mod markdown;
mod method;
mod oscillators;
mod output;
mod plant_files;
mod plants;
mod plot;
mod recommendation;
mod reference;
mod row;
mod run;
mod solid_modes;
mod work;

use std::path::PathBuf;

use serde::Serialize;

use self::cubic::CubicResult;
pub use self::plants::PlantRow;
pub use self::recommendation::DynamicsRecommendation;
pub use self::reference::ReferenceSummary;
pub use self::row::{Expectation, IntegrationRow, MotionErrors};
pub use self::solid_modes::SolidRow;
pub use self::work::Work;
use crate::provenance::Provenance;
use crate::workloads::Size;
use modalcast_dynamics::Result as DynamicsResult;
use modalcast_model::error::Result;

/// Settings of a report.
#[derive(Debug, Clone)]
pub struct DynamicsReportOptions {
    /// Folder with `vega/simpleBridge` and `plants/almond`. Without it, only generated systems are measured.
    pub scenes: Option<PathBuf>,
    /// The names in [`CASES`] to measure. Empty for all.
    pub cases: Vec<String>,
    pub size: Size,
}

/// All results of one run.
#[derive(Debug, Clone, Serialize)]
pub struct DynamicsReport {
    #[serde(rename = "made")]
    pub provenance: Provenance,
    /// Cases that are skipped, each with the reason.
    pub remarks: Vec<String>,
    /// Names of the cases that are not measured yet. Empty when the report is complete.
    pub missing: Vec<&'static str>,
    pub rows: Vec<IntegrationRow>,
    pub references: Vec<ReferenceSummary>,
    pub solids: Vec<SolidRow>,
    pub plants: Vec<PlantRow>,
    pub recommendations: Vec<DynamicsRecommendation>,
    /// Expectations that are not met, each as `case: system: reason`.
    pub failed: Vec<String>,
}

/// Progress events of a running report.
#[derive(Debug)]
pub enum DynamicsProgress<'a> {
    /// Description of the measurement that starts now.
    Started(&'a str),
    /// All results so far, with one more case than in the previous event.
    Measured(&'a DynamicsReport),
}

/// The cases in the order of the report.
pub const CASES: [&str; 8] = [
    oscillators::SINGLE_MODES,
    oscillators::STIFF_SYSTEM,
    beam::CASE,
    cubic::CHAIN,
    cubic::BRIDGE,
    extremes::CASE,
    solid_modes::CASE,
    plants::CASE,
];

/// Measures all cases. `progress` is called before and after each case.
///
/// # Errors
/// Errors of `progress`. Failures of a case are recorded in the report instead.
pub fn measure(
    options: &DynamicsReportOptions,
    mut progress: impl FnMut(DynamicsProgress<'_>) -> Result<()>,
) -> Result<DynamicsReport> {
    let is_selected = |case: &&str| options.cases.is_empty() || options.cases.iter().any(|name| name == case);
    let selected: Vec<&str> = CASES.into_iter().filter(is_selected).collect();
    let (mut report, mut errors) = (DynamicsReport::new(&selected), Vec::new());
    for case in selected {
        progress(DynamicsProgress::Started(case))?;
        errors.extend(report.measure_case(case, options).err().map(|error| format!("{case}: {error}")));
        report.recommendations = recommendation::recommend(&report.rows, &report.solids);
        report.failed = expectations::failures(&report.rows, &report.references, &report.solids);
        report.failed.extend(errors.iter().cloned());
        progress(DynamicsProgress::Measured(&report))?;
    }
    Ok(report)
}

impl DynamicsReport {
    /// A report without results.
    fn new(cases: &[&'static str]) -> Self {
        Self {
            provenance: Provenance::collect(),
            remarks: Vec::new(),
            missing: cases.to_vec(),
            rows: Vec::new(),
            references: Vec::new(),
            solids: Vec::new(),
            plants: Vec::new(),
            recommendations: Vec::new(),
            failed: Vec::new(),
        }
    }

    /// Whether all expectations are met.
    pub fn passed(&self) -> bool {
        self.failed.is_empty()
    }

    fn measure_case(&mut self, case: &str, options: &DynamicsReportOptions) -> DynamicsResult<()> {
        self.missing.retain(|missing| *missing != case);
        let size = options.size;
        match case {
            oscillators::SINGLE_MODES => self.rows.extend(oscillators::measure_single_modes(size)?),
            oscillators::STIFF_SYSTEM => self.rows.extend(oscillators::measure_stiff_system(size)?),
            beam::CASE => self.rows.extend(beam::measure(size)?),
            cubic::CHAIN => self.add_cubic(cubic::measure_chain(size)?),
            cubic::BRIDGE => match &options.scenes {
                Some(scenes) => self.add_cubic(cubic::measure_bridge(scenes, size)?),
                None => {
                    let remark = "bridge: skipped, because --scenes names no folder with vega/simpleBridge; the chain has \
                                  cubic forces, too";
                    self.remarks.push(remark.into());
                }
            },
            extremes::CASE => {
                let (rows, references) = extremes::measure()?;
                self.rows.extend(rows);
                self.references.extend(references);
            }
            solid_modes::CASE => self.solids = solid_modes::measure(size),
            _ => self.plants = plants::measure(options.scenes.as_deref(), size)?,
        }
        Ok(())
    }

    fn add_cubic(&mut self, result: CubicResult) {
        self.rows.extend(result.rows);
        self.references.push(result.reference);
    }
}

#[cfg(test)]
mod tests;
