//! Recommends a method and a step for each kind of system and each limit of the error: the fastest one within the limit.

use serde::Serialize;

use super::oscillators::{PERIODS, SINGLE_MODES};
use super::row::{Expectation, IntegrationRow, larger};
use super::solid_modes::SolidRow;
use super::{beam, cubic};
use crate::recommendation::{LimitChoice, choose_by_limit};
use crate::table::TimeAndError;

/// Settings with larger relative errors are never recommended.
const MAX_ERROR: f64 = 0.1;

/// The recommended setting of one kind of system for errors of at most a limit.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DynamicsRecommendation {
    /// The kind of system.
    pub system: &'static str,
    /// A power of ten. The error is relative.
    pub limit: f64,
    /// Of the settings within the limit whose times differ from the shortest one only by noise, the one with the smallest
    /// error.
    pub setting: String,
    /// Time of [`Self::unit`].
    pub milliseconds: f64,
    /// What the time is for.
    pub unit: &'static str,
    pub error: f64,
    /// Further settings within the limit whose times differ from the shortest one only by noise.
    pub equally_fast: Vec<String>,
}

/// A setting with its time and error.
struct Candidate {
    setting: String,
    value: TimeAndError,
}

/// The recommendations by kind of system and ascending limit. Controls, extreme cases and failed rows are left out.
pub(super) fn recommend(rows: &[IntegrationRow], solids: &[SolidRow]) -> Vec<DynamicsRecommendation> {
    let of_case = |case| rows.iter().filter(move |row| row.case == case && row.expectation == Expectation::Candidate);
    let per_second = |case| of_case(case).filter_map(row_candidate).collect();
    let second = "second of motion";
    let kinds = [
        ("linear modes", "period", mode_candidates(of_case(SINGLE_MODES))),
        ("beam", second, per_second(beam::CASE)),
        ("chain with cubic forces", second, per_second(cubic::CHAIN)),
        ("bridge with cubic forces", second, per_second(cubic::BRIDGE)),
        ("modes of solids", "model", solid_candidates(solids)),
    ];
    kinds.into_iter().flat_map(|(system, unit, candidates)| recommend_kind(system, unit, candidates)).collect()
}

fn recommend_kind(system: &'static str, unit: &'static str, candidates: Vec<Candidate>) -> Vec<DynamicsRecommendation> {
    // A NaN is not within the limit.
    let candidates: Vec<Candidate> =
        candidates.into_iter().filter(|candidate| candidate.value.error <= MAX_ERROR).collect();
    let points: Vec<TimeAndError> = candidates.iter().map(|candidate| candidate.value).collect();
    let setting = |index: usize| candidates[index].setting.clone();
    let recommendation = |choice: LimitChoice| DynamicsRecommendation {
        system,
        limit: choice.limit,
        setting: setting(choice.best),
        milliseconds: points[choice.best].time_us / 1e3,
        unit,
        error: points[choice.best].error,
        equally_fast: choice.equally_fast.into_iter().map(setting).collect(),
    };
    choose_by_limit(&points).into_iter().map(recommendation).collect()
}

/// A setting of single modes is a method with a number of steps per period. It counts with its largest error and time of
/// all frequencies and damping ratios.
fn mode_candidates<'a>(rows: impl Iterator<Item = &'a IntegrationRow>) -> Vec<Candidate> {
    let candidates = rows.filter_map(|row| {
        let steps_per_period = row.steps / PERIODS;
        let setting = format!("{}, {steps_per_period} steps per period", row.method);
        Some(Candidate { setting, value: time_and_error(row, PERIODS as f64)? })
    });
    worst_of_each_setting(candidates)
}

/// A setting of a beam or of a system with cubic forces.
fn row_candidate(row: &IntegrationRow) -> Option<Candidate> {
    let modes = if row.case == beam::CASE { format!(", {}", row.system) } else { String::new() };
    let setting = format!("{}{modes}, steps of {}", row.method, format_step(row.dt_seconds));
    Some(Candidate { setting, value: time_and_error(row, row.duration())? })
}

/// A setting of solids is a limit on the freedoms.
fn solid_candidates(solids: &[SolidRow]) -> Vec<Candidate> {
    let candidates = solids.iter().filter_map(|row| {
        let time_us = 1e6 * row.seconds;
        let value = TimeAndError { time_us, quartiles_us: [time_us; 2], error: row.worst_error? };
        Some(Candidate { setting: format!("--freedoms {}", row.freedom_limit), value })
    });
    worst_of_each_setting(candidates)
}

/// Time of the run divided by `units`, and the error that a user sees.
fn time_and_error(row: &IntegrationRow, units: f64) -> Option<TimeAndError> {
    let (timing, errors) = row.timing.zip(row.errors)?;
    let [time_us, first, third] =
        [timing.median_us, timing.q1_us, timing.q3_us].map(|step_us| step_us * row.steps as f64 / units);
    Some(TimeAndError { time_us, quartiles_us: [first, third], error: errors.visible_error() })
}

/// One candidate per setting, with the largest time and the largest error.
fn worst_of_each_setting(candidates: impl Iterator<Item = Candidate>) -> Vec<Candidate> {
    let mut worst: Vec<Candidate> = Vec::new();
    for candidate in candidates {
        let Some(known) = worst.iter_mut().find(|known| known.setting == candidate.setting) else {
            worst.push(candidate);
            continue;
        };
        let error = larger(known.value.error, candidate.value.error);
        let slower = if candidate.value.time_us > known.value.time_us { candidate.value } else { known.value };
        known.value = TimeAndError { error, ..slower };
    }
    worst
}

/// A step as a fraction of a second where it is one.
pub(super) fn format_step(dt_seconds: f64) -> String {
    let per_second = dt_seconds.recip();
    let is_fraction =
        per_second > 1.5 && (per_second - per_second.round()).abs() < 1e-6 * per_second && per_second < 1e5;
    if is_fraction { format!("1/{per_second:.0} s") } else { format!("{dt_seconds:.1e} s") }
}

impl DynamicsRecommendation {
    /// The recommendation as a sentence.
    pub(crate) fn line(&self) -> String {
        let Self { system, limit, setting, milliseconds, unit, error, equally_fast } = self;
        let note = match equally_fast.len() {
            0 => String::new(),
            _ => format!(" (within noise: {})", equally_fast.join("; ")),
        };
        format!("{system}, error <= {limit:.0e}: {setting}: {milliseconds:.3} ms per {unit}, error {error:.1e}{note}")
    }
}
