//! Command line of `modalcast-report`, the program that `modalcast report` starts.

mod drift;
mod dynamics;
mod render;
mod stream;

use std::path::PathBuf;

use clap::{CommandFactory as _, Parser, Subcommand};

use crate::bench::LocalMachine;
use crate::recommendation::Recommendation;
use crate::validate::ValidationLimits;
use crate::workloads::{Size, WorkloadKind};
use crate::{DeformReport, DeformReportOptions, Progress, WorkloadSource, deform};
use modalcast::cli::options::with_spinner;
use modalcast::cli::{Completion, EXIT_CODES, Outcome, finish, print_line};
use modalcast_model::error::Result;

/// Measures error against run time, rates and latencies at the client, errors over long runs, and time integrators, on
/// this machine. Writes tables and plots.
#[derive(Debug, Parser)]
#[command(name = "modalcast report", version, after_help = format!("{EXAMPLES}\n\n{EXIT_CODES}"))]
struct Cli {
    /// Print the hash of the sources that this program was built from, then exit.
    #[arg(long)]
    build: bool,
    #[command(subcommand)]
    report: Option<ReportCommand>,
}

#[derive(Debug, Subcommand)]
enum ReportCommand {
    Deform(DeformArgs),
    Render(render::Args),
    Stream(stream::Args),
    Drift(drift::Args),
    Dynamics(dynamics::Args),
    /// Runs as a child process of a report. The job is JSON.
    #[command(hide = true)]
    Peer {
        job: String,
    },
}

const EXAMPLES: &str = "Examples:
  modalcast report deform --out report
  modalcast report deform --out report --quick
  modalcast report deform --out report --load single-22-30 --load plants
  modalcast report deform --out report --load c --variant 'cuda*' --variant 'cpu f32'
  modalcast report deform --out report --load c --load plants --variant 'cuda overlap'
  modalcast report deform --out report --scene path/to/finger
  modalcast report deform --out report --scene tree --trajectory path/to/record
  modalcast report render --out report --quick
  modalcast report stream --out report --quick
  modalcast report drift --out report
  modalcast report dynamics --out report --quick";

const LOADS: &str = "Loads:
  single-P-R          one domain of 2^P vertices and R modes (table 4.4 of the thesis: P is 14 to 22, R is 10 to 30)
  a, a-positions      one domain of 1.5 M vertices and 32 modes, with normals and tangents, or without
  b                   1,000 domains of 1,500 vertices and 0 to 64 modes
  c                   200,000 domains of 7 vertices, 95 % of them rigid
  cancel              one domain at the origin whose modes nearly cancel in pairs
  batch               16 instances of one domain of 2^18 vertices and 32 modes
  plant-1 .. plant-12 the plants of table 4.5 of the thesis
  plant-N-follows     the same plant with leaves that follow branches, so that only branches have a T
  single              all loads single-P-R of table 4.4
  plants              all loads plant-N
  follows             all loads plant-N-follows
  all                 every load, but of plant-N-follows only the plant with the most domains";

/// Error against run time of the deformation: validates every variant, then times it.
///
/// Writes report.json, report.csv, report.md, report.svg and report.png again after each load: an interrupted run keeps
/// the finished loads and names the missing ones. Exit code 1 when a variant exceeds its a-priori error bound.
#[derive(Debug, clap::Args)]
#[command(after_help = format!("{LOADS}\n\n{EXAMPLES}"))]
struct DeformArgs {
    /// Output folder; files of an earlier report there are replaced.
    #[arg(long)]
    out: PathBuf,
    /// A scene of your own: a built-in name, or a path to a model or a scene folder.
    #[arg(long)]
    scene: Option<String>,
    /// Trajectory of the scene: a .csv of time,q0,q1,..., or a folder with q.npy as modalcast-sim --record writes it.
    /// Default: the only .q.csv next to the scene.
    #[arg(long, requires = "scene")]
    trajectory: Option<PathBuf>,
    /// A synthetic scene; repeatable. Default: all, unless --scene is given.
    #[arg(long = "load", value_name = "NAME")]
    loads: Vec<String>,
    /// Random states per load [default: 100, 10 with --quick].
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    seeds: Option<u32>,
    /// Repetitions per median [default: 100, 20 with --quick]. Wall-clock times take at least 20.
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    replays: Option<u32>,
    /// Validate at most this number of trajectory steps [default: all].
    #[arg(long)]
    steps: Option<usize>,
    /// Seconds per load after which no further states are validated. At least 10 random states and 2 steps are.
    #[arg(long, value_name = "SECONDS", default_value_t = 8.0, value_parser = parse_seconds)]
    validation_seconds: f64,
    /// Measure only this variant, or all variants with this prefix: "cuda*"; repeatable.
    #[arg(long = "variant", value_name = "NAME")]
    variants: Vec<String>,
    /// Build each load that would take more than seconds at a fraction of its size, for machines without a GPU; the
    /// report marks these loads.
    #[arg(long)]
    quick: bool,
}

/// Runs the command line and returns the process's exit code.
pub fn run() -> u8 {
    let cli = Cli::parse();
    if cli.build {
        print_line(modalcast::BUILD);
        return 0;
    }
    modalcast::telemetry::init_logging();
    finish(match &cli.report {
        Some(ReportCommand::Deform(args)) => run_deform(args),
        Some(ReportCommand::Render(args)) => render::run(args),
        Some(ReportCommand::Stream(args)) => stream::run(args),
        Some(ReportCommand::Drift(args)) => drift::run(args),
        Some(ReportCommand::Dynamics(args)) => dynamics::run(args),
        Some(ReportCommand::Peer { job }) => stream::run_peer(job),
        None => {
            Cli::command().print_help().ok(); // A closed stdout is no error.
            return 2; // The exit code of clap for invalid arguments.
        }
    })
}

fn run_deform(args: &DeformArgs) -> Outcome {
    let options = report_options(args)?;
    let on_progress = |progress: Progress<'_>| match progress {
        Progress::Started(workload) => {
            tracing::info!(load = workload, "measuring");
            Ok(())
        }
        Progress::Measured(report) => report.write(&args.out),
    };
    let report = with_spinner("measuring", || deform(&options, &LocalMachine::open(), on_progress))?;
    format_lines(&report).into_iter().for_each(print_line);
    print_line(format!("written to {}", args.out.display()));
    Ok(Completion::of_check(report.passed()))
}

/// Parses a number of seconds that is not negative.
fn parse_seconds(text: &str) -> Result<f64, String> {
    let seconds = text.parse::<f64>().ok().filter(|seconds| *seconds >= 0.0);
    seconds.ok_or_else(|| format!("expected a number of seconds of at least 0, got {text}"))
}

fn report_options(args: &DeformArgs) -> Result<DeformReportOptions> {
    let mut sources = Vec::new();
    if let Some(source) = &args.scene {
        sources.push(WorkloadSource::Scene { source: source.clone(), recording: args.trajectory.clone() });
    }
    for name in &args.loads {
        sources.extend(WorkloadKind::parse(name)?.into_iter().map(WorkloadSource::Synthetic));
    }
    if sources.is_empty() {
        sources.extend(WorkloadKind::all().into_iter().map(WorkloadSource::Synthetic));
    }
    let (default_seeds, default_replays, size) =
        if args.quick { (10, 20, Size::Quick) } else { (100, 100, Size::Full) };
    let count_or = |argument: Option<u32>, default: usize| argument.map_or(default, |count| count as usize);
    Ok(DeformReportOptions {
        sources,
        validation: ValidationLimits {
            seeds: count_or(args.seeds, default_seeds),
            steps: args.steps.unwrap_or(usize::MAX),
            seconds: args.validation_seconds,
        },
        replays: count_or(args.replays, default_replays),
        variants: args.variants.clone(),
        size,
    })
}

/// The report as lines of text: remarks, a table of all rows, and failures.
fn format_lines(report: &DeformReport) -> Vec<String> {
    let mut lines = report.remarks.clone();
    lines.push(format!(
        "{:<16}{:<24}{:<6}{:>14}{:>10}{:>16}{:>12}{:>10}",
        "load", "variant", "cache", "median us", "GB/s", "max error m", "of bound", "passed"
    ));
    for row in &report.rows {
        let format_number =
            |number: Option<f64>, digits: usize| number.map_or("-".into(), |number| format!("{number:.digits$}"));
        let errors = row.validation.as_ref().map(|validation| validation.errors);
        lines.push(format!(
            "{:<16}{:<24}{:<6}{:>14}{:>10}{:>16}{:>12}{:>10}",
            row.load,
            row.name,
            row.cache.name(),
            format_number(row.timing.map(|timing| timing.median_us), 2),
            format_number(row.gbs, 2),
            errors.map_or("-".into(), |errors| format!("{:.3e}", errors.meters.largest)),
            format_number(errors.map(|errors| errors.of_bound), 4),
            match (row.passed, row.is_skipped) {
                (true, _) => "yes",
                (false, true) => "skipped",
                (false, false) => "NO",
            }
        ));
    }
    for workload in &report.loads {
        lines.extend(workload.recommendations.iter().map(|recommendation| {
            let Recommendation { limit_meters, variant, median_us, equally_fast, .. } = recommendation;
            let note = if equally_fast.is_empty() {
                String::new()
            } else {
                format!(" (within noise: {})", equally_fast.join(", "))
            };
            format!("{}: for an error <= {limit_meters:.0e} m: {variant}, {median_us:.1} us{note}", workload.name)
        }));
    }
    lines.extend(report.failed.iter().map(|failed| format!("failed: {failed}")));
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    fn args() -> DeformArgs {
        let out = PathBuf::from("out");
        DeformArgs {
            out,
            scene: None,
            trajectory: None,
            loads: vec![],
            seeds: None,
            replays: None,
            steps: None,
            validation_seconds: 8.0,
            variants: vec![],
            quick: false,
        }
    }

    #[test]
    fn measures_all_loads_by_default_and_fewer_states_if_quick() {
        let all = report_options(&args()).expect("valid arguments");
        assert_eq!(
            (all.sources.len(), all.validation.seeds, all.replays, all.size),
            (WorkloadKind::all().len(), 100, 100, Size::Full)
        );
        let quick = report_options(&DeformArgs { quick: true, seeds: Some(3), ..args() }).expect("valid arguments");
        assert_eq!((quick.validation.seeds, quick.replays, quick.size), (3, 20, Size::Quick));
    }

    #[test]
    fn combines_scene_and_loads_and_rejects_unknown_load() {
        let both = DeformArgs { scene: Some("tree".into()), loads: vec!["plants".into(), "c".into()], ..args() };
        // The tree, the twelve plants, and c.
        assert_eq!(report_options(&both).expect("valid arguments").sources.len(), 14);
        let wrong = report_options(&DeformArgs { loads: vec!["d".into()], ..args() }).expect_err("no such load");
        assert!(wrong.to_string().starts_with("load: expected single-P-R"), "{wrong}");
    }
}
