//! Rates that reach viewers, with the server, the physics process and each viewer in its own process.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::StreamReportOptions;
use super::latency;
use super::peers::PeerJob;
use super::peers::socket::{self, SocketJob};
use super::peers::viewer::{Content, ViewerJob, ViewerSummary};
use super::processes::{Process, arguments};
use super::session::Session;
use super::stages::{StageInputs, StageRate};
use super::{RECORDED_STEPS, SCENE};
use crate::timing::quantile;
use crate::workloads::Size;
use modalcast_model::error::{Result, fault};

/// Steps of the untimed first run, which compiles kernels and shaders and fills the caches.
const WARM_UP_STEPS: u64 = 3;

/// Minimum number of steps from which the rate of the physics process alone is measured, because its first step sends
/// all values.
const MIN_PHYSICS_STEPS: u64 = 60;

/// Maximum number of steps from which the times of the stages of pictures alone are measured.
const MAX_STAGE_STEPS: u64 = 60;

/// The viewers of a case.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Viewers {
    pub(super) content: Content,
    pub(super) count: usize,
    /// Number of distinct views; viewer i has view i modulo this number.
    pub(super) views: usize,
}

impl Viewers {
    pub(super) const fn one(content: Content) -> Self {
        Self { content, count: 1, views: 1 }
    }

    fn view_of(&self, viewer: usize) -> usize {
        viewer % self.views
    }
}

/// Rates of a case.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RateResult {
    /// Content of a reply; `None` for steps without viewers.
    pub content: Option<String>,
    pub viewers: usize,
    pub views: usize,
    /// Steps of each run, all of them lossless.
    pub steps: u64,
    /// Rate of each run.
    pub runs: Vec<f64>,
    /// The median of `runs`. A client that receives n replies in a time t, counted from the first to the last reply,
    /// has the rate (n - 1) / t. The rate of a run is that of its slowest client, or that of the physics process if
    /// there are no clients.
    pub per_second: f64,
    /// Steps per second of the physics process, from its first step to its last acknowledgment. This result and those up
    /// to `stages_ms` are of the run with the median rate.
    pub steps_per_second: f64,
    /// Bytes of a reply on average; `None` without viewers.
    pub reply_bytes: Option<f64>,
    pub skipped: u64,
    /// Median of each stage in milliseconds, for each distinct view. A stage of overlapping steps includes waits for
    /// the other steps.
    pub stages_ms: Vec<BTreeMap<String, f32>>,
    /// The medians from which `stage_rates` are computed: those of a further run with one step in flight for pictures,
    /// otherwise `stages_ms`.
    pub alone_ms: Vec<BTreeMap<String, f32>>,
    /// The rates of the stages alone, the slowest first.
    pub stage_rates: Vec<StageRate>,
    /// `per_second` divided by the rate of the slowest stage.
    pub of_slowest_stage: f64,
}

/// The parts of the report of `modalcast-sim` that are used here.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub(super) struct PhysicsReport {
    pub(super) steps_per_second: f64,
    pub(super) stages_ms: BTreeMap<String, f32>,
    pub(super) rejected: u64,
}

/// One run.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Run {
    pub(super) physics: PhysicsReport,
    pub(super) viewers: Vec<ViewerSummary>,
}

impl Run {
    /// The rate of the slowest viewer, or of the physics process if there are no viewers.
    pub(super) fn per_second(&self) -> f64 {
        let slowest_viewer = self.viewers.iter().map(|viewer| viewer.per_second).reduce(f64::min);
        slowest_viewer.unwrap_or(self.physics.steps_per_second)
    }
}

/// Measures the rate of a case.
///
/// # Errors
/// `Fault` when a process fails.
pub(super) fn measure(
    session: &Session,
    viewers: Option<Viewers>,
    options: &StreamReportOptions,
) -> Result<RateResult> {
    let (url, steps) = (session.url(), steps_of_run(viewers.map(|viewers| viewers.content), options));
    run(session, viewers, WARM_UP_STEPS, &url)?;
    let runs = (0..options.repeat).map(|_| run(session, viewers, steps, &url));
    let mut runs: Vec<Run> = runs.collect::<Result<_>>()?;
    let rates: Vec<f64> = runs.iter().map(Run::per_second).collect();
    runs.sort_by(|a, b| a.per_second().total_cmp(&b.per_second()));
    let median_run = runs.swap_remove(runs.len() / 2);
    let per_second = quantile(&mut rates.clone(), 0.5).unwrap_or(0.0);
    let views = match viewers {
        None => vec![median_run.physics.stages_ms.clone()],
        Some(viewers) => median_run.viewers.iter().take(viewers.views).map(|viewer| viewer.stages_ms.clone()).collect(),
    };
    let sum = |count: fn(&ViewerSummary) -> u64| median_run.viewers.iter().map(count).sum::<u64>();
    let alone_ms = match viewers {
        Some(Viewers { content, views, .. }) if content.is_picture() => {
            let motion = session.motion(options.steps.min(RECORDED_STEPS))?;
            latency::measure_stages(session, motion, content, views, steps.min(MAX_STAGE_STEPS))?
        }
        _ => views.clone(),
    };
    let reply_bytes = viewers.map(|_| sum(|viewer| viewer.bytes) as f64 / sum(|viewer| viewer.replies).max(1) as f64);
    let stage_rates = StageInputs {
        server: &session.server_info,
        threads: std::thread::available_parallelism().map_or(1, std::num::NonZero::get),
        viewers: viewers.map(|viewers| (viewers.content, viewers.count)),
        views: &alone_ms,
        physics_per_second: measure_physics(session, steps)?,
        socket_per_second: reply_bytes.map(|bytes| measure_socket(bytes, options.size)).transpose()?,
    }
    .rates();
    let slowest_rate = stage_rates.first().map_or(f64::INFINITY, |rate| rate.per_second);
    Ok(RateResult {
        content: viewers.map(|viewers| viewers.content.name()),
        viewers: viewers.map_or(0, |viewers| viewers.count),
        views: viewers.map_or(0, |viewers| viewers.views),
        steps,
        runs: rates,
        per_second,
        steps_per_second: median_run.physics.steps_per_second,
        reply_bytes,
        skipped: sum(|viewer| viewer.skipped),
        stages_ms: views,
        alone_ms,
        stage_rates,
        of_slowest_stage: per_second / slowest_rate,
    })
}

/// Steps of a run. Steps without pictures are fast, so a run without pictures has more steps. Otherwise its start and
/// its end would be a large part of its time.
pub(super) fn steps_of_run(content: Option<Content>, options: &StreamReportOptions) -> u64 {
    if content.is_some_and(Content::is_picture) { options.steps } else { 4 * options.steps }
}

/// Starts the viewers, runs the physics process, and collects the results. The viewers connect to `viewer_url`.
///
/// # Errors
/// `Fault` when a process fails, or a viewer does not receive every step.
pub(super) fn run(session: &Session, viewers: Option<Viewers>, steps: u64, viewer_url: &str) -> Result<Run> {
    let job = |viewers: &Viewers, viewer| ViewerJob {
        server: viewer_url.to_owned(),
        shared_memory: None,
        scene: SCENE.into(),
        replies: steps,
        content: viewers.content,
        view: viewers.view_of(viewer) as u32,
    };
    let start = |viewers: Viewers| (0..viewers.count).map(move |viewer| PeerJob::Viewer(job(&viewers, viewer)).start());
    let mut processes: Vec<Process> = viewers.into_iter().flat_map(start).collect::<Result<_>>()?;
    for process in &mut processes {
        process.wait_for("ready")?;
    }
    let physics: PhysicsReport = session.start_physics(steps, &[])?.finish()?;
    let viewers: Vec<ViewerSummary> = processes.into_iter().map(Process::finish).collect::<Result<_>>()?;
    let received: Vec<u64> = viewers.iter().map(|viewer| viewer.replies).collect();
    if physics.rejected > 0 || received.iter().any(|replies| *replies != steps) {
        let expected = format!("expected {steps} accepted steps and as many replies of each viewer");
        return Err(fault("report", format!("{expected}, got {} rejected steps and {received:?}", physics.rejected)));
    }
    Ok(Run { physics, viewers })
}

/// Replies per second over a plain TCP connection.
fn measure_socket(reply_bytes: f64, size: Size) -> Result<f64> {
    let total_bytes = match size {
        Size::Full => 512e6,
        Size::Quick => 32e6,
    };
    let replies = (total_bytes / reply_bytes).clamp(10.0, 10_000.0) as u64;
    Ok(socket::measure(SocketJob::new(reply_bytes.round() as usize, replies))?.per_second)
}

/// The rate of the physics process alone: the server merges the steps that it has no time for, so that it does not slow
/// the process down.
fn measure_physics(session: &Session, steps: u64) -> Result<f64> {
    if let Some(rate) = session.physics_per_second.get() {
        return Ok(*rate);
    }
    let steps = steps.max(MIN_PHYSICS_STEPS);
    let report: PhysicsReport = session.start_physics(steps, &arguments([&"--delivery", &"latest"]))?.finish()?;
    Ok(*session.physics_per_second.get_or_init(|| report.steps_per_second))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rate_of_a_run_is_that_of_its_slowest_viewer() {
        let viewer =
            |per_second| ViewerSummary { replies: 3, per_second, bytes: 30, skipped: 0, stages_ms: BTreeMap::new() };
        let physics = PhysicsReport { steps_per_second: 70.0, stages_ms: BTreeMap::new(), rejected: 0 };
        let run = Run { physics: physics.clone(), viewers: vec![viewer(60.0), viewer(50.0), viewer(55.0)] };
        assert_eq!((run.per_second(), Run { physics, viewers: vec![] }.per_second()), (50.0, 70.0));
    }

    #[test]
    fn viewers_are_assigned_to_the_views_in_turn() {
        let viewers = Viewers { content: Content::Positions, count: 8, views: 4 };
        assert_eq!((0..8).map(|viewer| viewers.view_of(viewer)).collect::<Vec<_>>(), [0, 1, 2, 3, 0, 1, 2, 3]);
    }
}
