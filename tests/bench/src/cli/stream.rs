//! `modalcast report stream`: rates, latencies and encodings at a client, with all programs as separate processes.

use std::path::PathBuf;

use crate::stream::peers::{self, PeerJob};
use crate::stream::{self, CASE_HELP, CaseReport, CaseResult, StreamProgress, StreamReport, StreamReportOptions};
use crate::workloads::Size;
use modalcast::cli::options::with_spinner;
use modalcast::cli::{Completion, Outcome, print_line};
use modalcast_model::error::invalid;

const EXAMPLES: &str = "Examples:
  modalcast report stream --out report
  modalcast report stream --out report --quick
  modalcast report stream --out report --scenes ../data
  modalcast report stream --out report --case tree-png-1080p --case 'tree-delay*' --repeat 5";

/// Rates and latencies at the client: rates beside the rate of the slowest stage, latency, a comparison with a plain
/// socket, rates over a long round trip, and encodings.
///
/// Starts the server, the physics process and each viewer as processes of this machine. Writes report.json, report.csv,
/// report.md, report.svg and report.png again after each case: an interrupted run keeps the finished cases and names
/// the missing ones. Exit code 1 when a case fails or an encoding exceeds its error bound.
#[derive(Debug, clap::Args)]
#[command(after_help = format!("{CASE_HELP}\n\n{EXAMPLES}"))]
pub(super) struct Args {
    /// Output folder; files of an earlier report there are replaced.
    #[arg(long)]
    out: PathBuf,
    /// Folder of scenes that contains plants/almond, plants/bean and vega/simpleBridge. Default: only generated scenes.
    #[arg(long, value_name = "DIR")]
    scenes: Option<PathBuf>,
    /// Measure only this case, or all cases with this prefix: "tree-delay*"; repeatable.
    #[arg(long = "case", value_name = "NAME")]
    cases: Vec<String>,
    /// Steps of each run [default: 300, 10 with --quick].
    #[arg(long, value_parser = clap::value_parser!(u64).range(2..=100_000))]
    steps: Option<u64>,
    /// Steps of the cases that measure latency [default: 10000 frames and 2000 acknowledgments, 200 with --quick].
    #[arg(long, value_parser = clap::value_parser!(u64).range(2..=100_000))]
    latency_steps: Option<u64>,
    /// Runs of each rate, of which the median is reported [default: 3, 1 with --quick].
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=1_000))]
    repeat: Option<u32>,
    /// For machines without a GPU: pictures of a quarter of the width and height, a smaller grid and fewer repetitions.
    #[arg(long)]
    quick: bool,
}

/// Runs the report.
pub(super) fn run(args: &Args) -> Outcome {
    let options = report_options(args);
    let on_progress = |progress: StreamProgress<'_>| match progress {
        StreamProgress::Started(case) => {
            tracing::info!(case, "measuring");
            Ok(())
        }
        StreamProgress::Measured(report) => report.write(&args.out),
    };
    let report = with_spinner("measuring", || stream::measure(&options, on_progress))?;
    report_lines(&report).into_iter().for_each(print_line);
    print_line(format!("written to {}", args.out.display()));
    Ok(Completion::of_check(report.passed()))
}

/// Runs as a child process of a report.
pub(super) fn run_peer(job: &str) -> Outcome {
    let job: PeerJob = serde_json::from_str(job).map_err(|error| invalid("job", "a job as JSON", error))?;
    peers::run(&job)?;
    Ok(Completion::Success)
}

fn report_options(args: &Args) -> StreamReportOptions {
    let (default_steps, default_repeat, size) = if args.quick { (10, 1, Size::Quick) } else { (300, 3, Size::Full) };
    StreamReportOptions {
        scenes: args.scenes.clone(),
        cases: args.cases.clone(),
        steps: args.steps.unwrap_or(default_steps),
        latency_steps: args.latency_steps,
        repeat: args.repeat.unwrap_or(default_repeat) as usize,
        size,
    }
}

/// The report as lines of text: one for each case, or for each encoding of a case, and the failures.
fn report_lines(report: &StreamReport) -> Vec<String> {
    let mut lines: Vec<String> = report.cases.iter().flat_map(case_lines).collect();
    lines.extend(report.failed.iter().map(|failed| format!("failed: {failed}")));
    lines
}

fn case_lines(case: &CaseReport) -> Vec<String> {
    let line = |text: String| format!("{:<34}{text}", case.name);
    match &case.result {
        CaseResult::Rate(result) => {
            let slowest = result.stage_rates.first().map(|rate| rate.line()).unwrap_or_default();
            let (per_second, fraction) = (result.per_second, result.of_slowest_stage);
            vec![line(format!("{per_second:>9.1} /s  {fraction:.2} of {slowest}"))]
        }
        CaseResult::Plant(plant) => {
            let (simulated, recorded, physics) =
                (plant.rate.per_second, plant.recorded_per_second, plant.physics_per_second);
            vec![line(format!(
                "{simulated:>9.1} /s  {recorded:.1} of recorded steps, {physics:.1} steps/s of the physics"
            ))]
        }
        CaseResult::Latency(result) => {
            let (p50, p90, p99, max) = (result.p50_ms, result.p90_ms, result.p99_ms, result.max_ms);
            vec![line(format!("p50 {p50:.2} ms, p90 {p90:.2} ms, p99 {p99:.2} ms, max {max:.2} ms"))]
        }
        CaseResult::Socket(result) => {
            let (stream, socket) = (result.stream_per_second, result.socket_per_second);
            let fraction = result.stream_of_socket;
            vec![line(format!("{stream:>9.1} /s  {fraction:.2} of a plain socket, {socket:.1} /s"))]
        }
        CaseResult::Contention(result) => {
            let (p99, max, idle) = (result.added_p99_ms, result.added_max_ms, result.idle.p50_ms);
            vec![line(format!("added p99 {p99:.2} ms, added max {max:.2} ms to a median of {idle:.2} ms"))]
        }
        CaseResult::Delay(result) => {
            let (delayed, undelayed) = (result.delayed_per_second, result.undelayed_per_second);
            vec![line(format!("{delayed:>9.1} /s with a round trip of 50 ms, {undelayed:.1} /s without"))]
        }
        CaseResult::VertexEncodings(rows) => rows
            .iter()
            .map(|row| {
                let name = format!("{} {}", row.attribute, row.encoding);
                let (bytes, fraction) = (row.bytes, row.errors.of_bound);
                line(format!("{name:<26}{bytes:>10} bytes, largest error / bound {fraction:.3}"))
            })
            .collect(),
        CaseResult::PictureEncodings(rows) => rows
            .iter()
            .map(|row| line(format!("{:<26}{:>10} bytes, {:.2} ms", row.encoder, row.bytes, row.ms)))
            .collect(),
        CaseResult::Afternoon(comparison) => comparison
            .variants
            .iter()
            .map(|variant| {
                let (name, fraction) = (&variant.name, variant.server_of_program);
                let (server, program) = (variant.server_per_second, variant.per_second);
                line(format!("{server:>9.1} /s  {fraction:.2} of {name} of the program, {program:.1} /s"))
            })
            .collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quick_reports_have_fewer_steps_and_runs() {
        let args = Args {
            out: "out".into(),
            scenes: None,
            cases: vec![],
            steps: None,
            latency_steps: None,
            repeat: None,
            quick: false,
        };
        let options = report_options(&args);
        assert_eq!((options.steps, options.repeat, options.size), (300, 3, Size::Full));
        let options = report_options(&Args { quick: true, repeat: Some(2), ..args });
        assert_eq!((options.steps, options.repeat, options.size), (10, 2, Size::Quick));
    }

    #[test]
    fn invalid_job_is_rejected() {
        let error = run_peer("{}").expect_err("expected an invalid job").to_string();
        assert!(error.starts_with("job: expected a job as JSON"), "{error}");
    }
}
