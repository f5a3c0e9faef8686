//! `modalcast report drift`: position errors over long runs.

use std::path::PathBuf;

use crate::drift::{self, DriftResult};
use modalcast::cli::options::with_spinner;
use modalcast::cli::{Completion, Outcome, print_line};

/// Position errors after 1, 10, ..., 1,000,000 steps against the exact motion: a chain of followers, domains that
/// travel far from the origin, and clients that accumulate T in f32 or f64.
///
/// Writes report.json and report.md. Exit code 1 when errors grow, when a step depends on earlier steps, or when the
/// errors of the negative controls f32-product and f32-orthonormal do not grow.
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    /// Output folder; files of an earlier report there are replaced.
    #[arg(long)]
    out: PathBuf,
    /// Steps of each case.
    #[arg(long, default_value_t = 1_000_000, value_parser = clap::value_parser!(u64).range(1_000..=1_000_000_000))]
    steps: u64,
}

/// Runs the report.
pub(super) fn run(args: &Args) -> Outcome {
    let report = with_spinner("measuring", || drift::measure(args.steps, |case| tracing::info!(case, "measuring")))?;
    report.write(&args.out)?;
    report.cases.iter().map(DriftResult::summary).for_each(print_line);
    report.failed.iter().for_each(|failure| print_line(format!("failed: {failure}")));
    print_line(format!("written to {}", args.out.display()));
    Ok(Completion::of_check(report.passed()))
}
