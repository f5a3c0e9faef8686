//! Rates, latencies and encodings at the client, with the server, the physics process and each viewer in its
//! own process of this machine.
//!
//! - `processes` starts and ends child processes. The benchmark also starts its own program as a child, which then has
//!   one of the roles in `peers`: `viewer`, `socket` (a plain TCP connection) and `proxy` (a delaying connection).
//! - `session` is a server with one scene. `motion` records steps, so that they can be sent from memory. `grid` is a
//!   scene of many vertices, and `skeletons` are plants with the counts of the thesis.
//! - `cases` lists the cases. Each case makes one measurement: `rates` with `stages`, `latency`, `socket`,
//!   `contention`, `delay`, `vertex_encodings`, `picture_encodings`, `afternoon` or `plants` (tables 4.5 to 4.7 of the
//!   thesis).
//! - `afternoon` compares the server with a Python program that a user could write in an afternoon
//!   (`tests/bench/peers/afternoon.py`). `afternoon_scene` writes a scene for this program.
//! - `output`, `markdown` and `plot` write the report.

pub mod afternoon;
mod afternoon_scene;
mod cases;
pub mod contention;
pub mod delay;
mod grid;
pub mod latency;
mod markdown;
mod motion;
mod output;
pub(crate) mod peers;
pub mod picture_encodings;
pub mod plants;
mod plot;
mod processes;
pub mod rates;
mod session;
mod skeletons;
pub mod stages;
pub mod vertex_encodings;

use std::path::PathBuf;

use serde::Serialize;

use crate::is_selected;
use crate::provenance::{Provenance, utc_date};
use crate::workloads::Size;
use afternoon::AfternoonComparison;
pub(crate) use cases::CASE_HELP;
use cases::{Case, Measurement};
use contention::ContentionResult;
use delay::DelayResult;
use latency::LatencyResult;
use modalcast_model::error::{Result, invalid};
use peers::socket::{SocketComparison, SocketJob, VertexViewers};
use picture_encodings::PictureEncodingRow;
use plants::PlantRates;
use rates::RateResult;
pub use session::SceneLook;
use session::Session;
use vertex_encodings::VertexEncodingRow;

/// The name of every scene on its server.
const SCENE: &str = "scene";

/// Maximum number of steps that are recorded to be sent from memory. Longer measurements repeat them.
const RECORDED_STEPS: u64 = 120;

/// The width and the height of the pictures of a quick report are divided by this number.
const QUICK_DIVISOR: u32 = 4;

/// Settings of a report.
#[derive(Debug, Clone)]
pub struct StreamReportOptions {
    /// Folder of scenes with `plants/almond`, `plants/bean` and `vega/simpleBridge`. Without it, only generated scenes
    /// are measured.
    pub scenes: Option<PathBuf>,
    /// Cases to measure: full names, or prefixes that end in `*`. An empty list selects all.
    pub cases: Vec<String>,
    /// Steps of each run.
    pub steps: u64,
    /// Number of steps of each latency measurement. `None` selects the default of a full or quick report (`size`).
    pub latency_steps: Option<u64>,
    /// Runs of each rate, of which the median is reported.
    pub repeat: usize,
    /// A quick report has pictures of a quarter of the width and height, a smaller grid and fewer repetitions.
    pub size: Size,
}

/// All results of one run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StreamReport {
    #[serde(rename = "made")]
    pub provenance: Provenance,
    /// Hash of the sources of the programs.
    pub build: &'static str,
    /// Whether the sizes are those that the names of the cases state.
    #[serde(rename = "full")]
    pub is_full_size: bool,
    pub cases: Vec<CaseReport>,
    /// Names of the selected cases that are not measured yet. Empty when the report is complete.
    pub missing: Vec<&'static str>,
    /// Failed cases, each as `case: reason`.
    pub failed: Vec<String>,
}

/// Result of one case, with everything that another run needs to repeat it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CaseReport {
    pub name: &'static str,
    pub scene: &'static str,
    /// `None` for a scene that is not drawn.
    pub look: Option<SceneLook>,
    /// Backend, device and renderer of the server.
    pub server: String,
    pub machine: String,
    /// UTC date and time at which the case ended.
    pub date: String,
    pub build: &'static str,
    pub command: String,
    pub result: CaseResult,
}

/// The measurement of a case.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum CaseResult {
    Rate(RateResult),
    Latency(LatencyResult),
    Socket(SocketComparison),
    Contention(ContentionResult),
    Delay(DelayResult),
    VertexEncodings(Vec<VertexEncodingRow>),
    PictureEncodings(Vec<PictureEncodingRow>),
    Afternoon(AfternoonComparison),
    Plant(Box<PlantRates>),
}

/// Progress events of a running report.
#[derive(Debug)]
pub enum StreamProgress<'a> {
    /// Name of the case that starts now.
    Started(&'a str),
    /// All results so far.
    Measured(&'a StreamReport),
}

/// Measures all selected cases. `progress` is called before and after each case. Must be called on the main thread,
/// because the child processes end with the thread that starts them.
///
/// # Errors
/// `Invalid` when no case is selected; errors of `progress`. Failures of a case are recorded in the report instead.
pub fn measure(
    options: &StreamReportOptions,
    mut progress: impl FnMut(StreamProgress<'_>) -> Result<()>,
) -> Result<StreamReport> {
    let all_cases = cases::all(options);
    let selected: Vec<&Case> = all_cases.iter().filter(|case| is_selected(&options.cases, case.name)).collect();
    if selected.is_empty() {
        let names: Vec<&str> = all_cases.iter().map(|case| case.name).collect();
        return Err(invalid("case", format!("one or more of: {}", names.join(", ")), options.cases.join(", ")));
    }
    let mut report = StreamReport {
        provenance: Provenance::collect(),
        build: modalcast::BUILD,
        is_full_size: options.size == Size::Full,
        cases: Vec::new(),
        missing: selected.iter().map(|case| case.name).collect(),
        failed: Vec::new(),
    };
    // The session of the previous case. At most one server runs at a time.
    let mut session: Option<Session> = None;
    for case in selected {
        progress(StreamProgress::Started(case.name))?;
        report.missing.remove(0);
        match measure_case(case, &mut session, options, &report) {
            Ok(case_report) => {
                report.failed.extend(case_report.failures());
                report.cases.push(case_report);
            }
            Err(error) => {
                // The server may have failed, so the next case starts a new one.
                let error = match session.take() {
                    Some(session) => session.explain(error),
                    None => error,
                };
                report.failed.push(format!("{}: {error}", case.name));
            }
        }
        progress(StreamProgress::Measured(&report))?;
    }
    Ok(report)
}

fn measure_case(
    case: &Case,
    session: &mut Option<Session>,
    options: &StreamReportOptions,
    report: &StreamReport,
) -> Result<CaseReport> {
    let reusable = session.take().filter(|session| session.source == case.scene && session.backend == case.backend);
    // The previous server has ended here, unless its scene is the same.
    let session = session.insert(reusable.map_or_else(|| Session::open(case.scene, case.backend, options), Ok)?);
    let result = match case.measurement {
        Measurement::Rate(viewers) => rates::measure(session, viewers, options).map(CaseResult::Rate),
        Measurement::FrameLatency(content, steps) => {
            latency::measure_frames(session, content, steps).map(CaseResult::Latency)
        }
        Measurement::AcknowledgmentLatency(steps) => {
            latency::measure_acknowledgments(session, steps).map(CaseResult::Latency)
        }
        Measurement::Socket => compare_with_socket(session, options).map(CaseResult::Socket),
        Measurement::Contention(work) => contention::measure(session, work, options).map(CaseResult::Contention),
        Measurement::Delay(stream) => delay::measure(session, stream, options).map(CaseResult::Delay),
        Measurement::VertexEncodings => vertex_encodings::measure(session, options).map(CaseResult::VertexEncodings),
        Measurement::PictureEncodings(content) => {
            picture_encodings::measure(session, content, options).map(CaseResult::PictureEncodings)
        }
        Measurement::Afternoon(size) => afternoon::measure(session, size, options).map(CaseResult::Afternoon),
        Measurement::Plant(content) => {
            plants::measure(session, content, options).map(|plant| CaseResult::Plant(Box::new(plant)))
        }
    }?;
    let server = &session.server_info;
    Ok(CaseReport {
        name: case.name,
        scene: case.scene.name(),
        look: session.look.clone(),
        server: format!("deforms on {} ({}), draws on {}", server.backend, server.device, server.renderer),
        machine: report.provenance.line(),
        date: utc_date(),
        build: report.build,
        command: report.provenance.command.join(" "),
        result,
    })
}

/// Compares vertex streams with a plain TCP connection.
fn compare_with_socket(session: &Session, options: &StreamReportOptions) -> Result<SocketComparison> {
    let motion = session.motion(options.steps.min(RECORDED_STEPS))?;
    let receive = |server: String, shared_memory, content, writes: bool| {
        let job = peers::viewer::ViewerJob {
            server,
            shared_memory,
            scene: SCENE.into(),
            replies: options.steps,
            content,
            view: 0,
        };
        let mut process = peers::PeerJob::Viewer(job).start()?;
        process.wait_for("ready")?;
        if writes {
            session.runtime.block_on(motion::measure_rate(&session.client, motion, options.steps))?;
        }
        process.finish::<peers::viewer::ViewerSummary>()
    };
    let (streamed, requested) = (peers::viewer::Content::Positions, peers::viewer::Content::RequestedPositions);
    let shared_memory = Some(session.shared_memory());
    let viewers = VertexViewers {
        stream: receive(session.url(), None, streamed, true)?,
        requests: receive(session.url(), None, requested, false)?,
        unix_stream: receive(session.unix_url(), None, streamed, true)?,
        unix_requests: receive(session.unix_url(), None, requested, false)?,
        shared_stream: receive(session.url(), shared_memory.clone(), streamed, true)?,
        shared_requests: receive(session.url(), shared_memory, requested, false)?,
    };
    let reply_bytes = 12 * session.scene_info.vertices as usize;
    let socket = peers::socket::measure(SocketJob::new(reply_bytes, options.steps))?;
    SocketComparison::new(&viewers, &socket)
}

impl StreamReport {
    /// Whether all cases were measured and no encoding exceeds its bound.
    pub fn passed(&self) -> bool {
        self.failed.is_empty()
    }
}

impl CaseResult {
    /// The rate of a case that has one.
    fn rate(&self) -> Option<&RateResult> {
        match self {
            Self::Rate(rate) => Some(rate),
            Self::Plant(plant) => Some(&plant.rate),
            _ => None,
        }
    }
}

impl CaseReport {
    /// Encodings whose error exceeds the stated bound.
    fn failures(&self) -> Vec<String> {
        let CaseResult::VertexEncodings(rows) = &self.result else { return Vec::new() };
        let failed = rows.iter().filter(|row| row.errors.of_bound.is_nan() || row.errors.of_bound > 1.0);
        failed
            .map(|row| {
                let expected = format!("expected an error of at most {:e}", row.errors.bound);
                format!("{}: {} {}: {expected}, got {:e}", self.name, row.attribute, row.encoding, row.errors.largest)
            })
            .collect()
    }
}

#[cfg(test)]
mod tests;
