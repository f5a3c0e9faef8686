//! `modalcast report dynamics`: time integrators and computed modes.

use std::path::PathBuf;

use crate::dynamics::{self, DynamicsProgress, DynamicsRecommendation, DynamicsReportOptions};
use crate::workloads::Size;
use modalcast::cli::options::with_spinner;
use modalcast::cli::{Completion, Outcome, print_line};

const EXAMPLES: &str = "Examples:
  modalcast report dynamics --out report
  modalcast report dynamics --out report --quick
  modalcast report dynamics --out report --scenes ../data
  modalcast report dynamics --out report --case plants";

/// Error against step and time of the time integrators, and of the modes that modalcast model computes: oscillators in
/// closed form, a beam, cubic forces, extreme cases, and solids with known frequencies. Then the time of a step of plants
/// of 100 to 10,000 domains.
///
/// Ends with the fastest setting for each limit of the error. Writes report.json, report.csv, solids.csv, plants.csv,
/// report.md, report.svg and report.png again after each case: an interrupted run keeps the finished cases and names the missing
/// ones. Exit code 1 when an order differs from the theory, when an energy is not conserved, when a frequency is wrong,
/// or when a negative control has a small error.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Args {
    /// Output folder; files of an earlier report there are replaced.
    #[arg(long)]
    out: PathBuf,
    /// Folder of scenes that contains vega/simpleBridge and plants/almond. Default: only generated systems.
    #[arg(long, value_name = "DIR")]
    scenes: Option<PathBuf>,
    /// Measure only this case; repeatable.
    #[arg(long = "case", value_name = "NAME", value_parser = clap::builder::PossibleValuesParser::new(dynamics::CASES))]
    cases: Vec<String>,
    /// Fewer steps, modes and freedoms.
    #[arg(long)]
    quick: bool,
}

/// Runs the report.
pub(super) fn run(args: &Args) -> Outcome {
    let size = if args.quick { Size::Quick } else { Size::Full };
    let options = DynamicsReportOptions { scenes: args.scenes.clone(), cases: args.cases.clone(), size };
    let on_progress = |progress: DynamicsProgress<'_>| match progress {
        DynamicsProgress::Started(case) => {
            tracing::info!(case, "measuring");
            Ok(())
        }
        DynamicsProgress::Measured(report) => report.write(&args.out),
    };
    let report = with_spinner("measuring", || dynamics::measure(&options, on_progress))?;
    report.remarks.iter().for_each(print_line);
    report.recommendations.iter().map(DynamicsRecommendation::line).for_each(print_line);
    report.failed.iter().for_each(|failure| print_line(format!("failed: {failure}")));
    print_line(format!("written to {}", args.out.display()));
    Ok(Completion::of_check(report.passed()))
}
