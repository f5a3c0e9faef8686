//! Recommends a deformation for each limit of the error: the fastest complete step whose largest error is within it.

use serde::Serialize;

use super::cuda_variants::is_complete_step;
use super::markdown_table::table;
use super::table::{DeformRow, TimeAndError};
use super::timing::CacheState;

/// The recommended variant of one load for errors of at most a limit.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Recommendation {
    /// A power of ten.
    pub limit_meters: f64,
    /// Of the variants within the limit whose times differ from the shortest one only by noise, the one with the smallest
    /// error.
    pub variant: String,
    pub median_us: f64,
    pub largest_error_meters: f64,
    /// Further variants within the limit whose times differ from the shortest one only by noise.
    pub equally_fast: Vec<String>,
}

/// The recommendations for the rows of one load, by ascending limit. Only complete steps with warm caches are compared.
pub fn recommend<'a>(rows: impl Iterator<Item = &'a DeformRow>) -> Vec<Recommendation> {
    let is_comparable = |row: &&DeformRow| row.cache == CacheState::Warm && is_complete_step(row.backend, &row.name);
    let (mut names, mut points) = (Vec::new(), Vec::new());
    for row in rows.filter(is_comparable) {
        let (Some(validation), Some(value)) = (&row.validation, row.time_and_error()) else { continue };
        names.push(&row.name);
        points.push(TimeAndError { error: validation.errors.meters.largest, ..value });
    }
    let recommendation = |choice: LimitChoice| Recommendation {
        limit_meters: choice.limit,
        variant: names[choice.best].clone(),
        median_us: points[choice.best].time_us,
        largest_error_meters: points[choice.best].error,
        equally_fast: choice.equally_fast.iter().map(|index| names[*index].clone()).collect(),
    };
    choose_by_limit(&points).into_iter().map(recommendation).collect()
}

/// The point that is recommended for one limit of the error.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct LimitChoice {
    /// A power of ten.
    pub(crate) limit: f64,
    /// Of the points within the limit whose times differ from the shortest one only by noise, the one with the smallest
    /// error.
    pub(crate) best: usize,
    /// Further points within the limit whose times differ from the shortest one only by noise.
    pub(crate) equally_fast: Vec<usize>,
}

/// Smallest limit, meters or relative. An error below it is of no interest.
const MIN_LIMIT: f64 = 1e-9;

/// Chooses points by ascending limit: one for the smallest power of ten that some point keeps, and one for each larger
/// power that allows another point.
pub(crate) fn choose_by_limit(points: &[TimeAndError]) -> Vec<LimitChoice> {
    // An error of 0, as of a rigid scene with exact transforms, is within every limit.
    let decades = || points.iter().map(|point| point.error.max(MIN_LIMIT).log10().ceil() as i32);
    let (Some(first), Some(last)) = (decades().min(), decades().max()) else { return Vec::new() };
    let mut choices: Vec<LimitChoice> = Vec::new();
    for limit in (first..=last).map(|exponent| 10_f64.powi(exponent)) {
        let choice = choose_within(points, limit);
        let is_new = |new: &LimitChoice| choices.last().is_none_or(|last| last.best != new.best);
        choices.extend(choice.filter(is_new));
    }
    choices
}

fn choose_within(points: &[TimeAndError], limit: f64) -> Option<LimitChoice> {
    // The tolerance covers the rounding of powers of ten.
    let within = || (0..points.len()).filter(|index| points[*index].error <= limit * (1.0 + 1e-12));
    let fastest = within().min_by(|a, b| points[*a].time_us.total_cmp(&points[*b].time_us))?;
    let mut group: Vec<usize> = within().filter(|index| points[*index].has_time_of(&points[fastest])).collect();
    group.sort_by(|a, b| {
        let (a, b) = (&points[*a], &points[*b]);
        a.error.total_cmp(&b.error).then(a.time_us.total_cmp(&b.time_us))
    });
    let (best, others) = group.split_first()?;
    Some(LimitChoice { limit, best: *best, equally_fast: others.to_vec() })
}

/// The recommendations of all loads as a Markdown section; empty without recommendations. Each item is the name of a
/// load and its recommendations.
pub(super) fn markdown<'a>(loads: impl Iterator<Item = (&'a str, &'a [Recommendation])>) -> String {
    let mut rows = Vec::new();
    for (load, recommendations) in loads {
        rows.extend(recommendations.iter().map(|recommendation| {
            let Recommendation { limit_meters, variant, median_us, largest_error_meters, equally_fast } =
                recommendation;
            [
                load.to_owned(),
                format!("{limit_meters:.0e}"),
                variant.clone(),
                format!("{median_us:.1}"),
                format!("{largest_error_meters:.2e}"),
                equally_fast.join(", "),
            ]
        }));
    }
    if rows.is_empty() {
        return String::new();
    }
    let head = ["load", "error at most, m", "setting", "median us", "largest error m", "equally fast within noise"];
    format!(
        "\n## Recommendation\n\nFor each limit of the error, the fastest complete step with warm caches. A limit that is \
         not listed has the setting of the next smaller one. Times whose quartiles overlap differ within noise.\n\n{}",
        table(&head, rows)
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::table::tests::row;

    fn cpu(name: &str, time_us: f64, error: f64) -> DeformRow {
        row("a", name, CacheState::Warm, (time_us, error))
    }

    #[test]
    fn recommends_the_fastest_complete_step_within_each_limit() {
        let mut failed = cpu("cpu broken", 0.1, 1e-9);
        failed.passed = false;
        let rows = [
            cpu("cpu f32", 100.0, 2e-7),
            cpu("cpu f16", 50.0, 4e-5),
            cpu("cpu int8", 60.0, 8e-4),
            cpu("cpu tiny", 20.0, 5e-3),
            row("a", "cpu cold", CacheState::Cold, (1.0, 1e-9)),
            failed,
        ];
        let recommendations = recommend(rows.iter());
        let summary: Vec<(f64, &str)> =
            recommendations.iter().map(|item| (item.limit_meters, item.variant.as_str())).collect();
        assert_eq!(summary, [(1e-6, "cpu f32"), (1e-4, "cpu f16"), (1e-2, "cpu tiny")], "int8 is slower than f16");
        let text = markdown([("a", recommendations.as_slice())].into_iter());
        assert!(text.contains("| a | 1e-4 | cpu f16 | 50.0 | 4.00e-5 |  |"), "{text}");
        assert!(recommend([].into_iter()).is_empty() && markdown([].into_iter()).is_empty());
    }

    #[test]
    fn prefers_the_smaller_error_of_times_within_noise() {
        let mut noisy = cpu("cpu f32", 100.0, 2e-7);
        if let Some(timing) = &mut noisy.timing {
            (timing.q1_us, timing.q3_us) = (95.0, 105.0);
        }
        let rows = [cpu("cpu f32 compensated", 99.0, 9e-7), noisy];
        let recommendations = recommend(rows.iter());
        assert_eq!(recommendations.len(), 1);
        assert_eq!(recommendations[0].variant, "cpu f32");
        assert_eq!(recommendations[0].equally_fast, ["cpu f32 compensated"]);
        // The control: without noise, the faster variant is recommended.
        let exact = [cpu("cpu f32 compensated", 99.0, 9e-7), cpu("cpu f32", 100.0, 2e-7)];
        assert_eq!(recommend(exact.iter())[0].variant, "cpu f32 compensated");
    }

    #[test]
    fn kernels_without_transfers_are_no_complete_steps() {
        let mut rows =
            [cpu("cuda f32 positions", 1.0, 1e-7), cpu("cuda f32 step", 5.0, 1e-7), cpu("reference f64", 9.0, 1e-9)];
        for row in &mut rows[..2] {
            row.backend = modalcast_model::deform::Backend::Cuda;
        }
        rows[2].backend = modalcast_model::deform::Backend::Reference;
        assert_eq!(recommend(rows.iter())[0].variant, "cuda f32 step");
    }
}
