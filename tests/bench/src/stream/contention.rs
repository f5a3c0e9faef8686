//! The waits of one client while the server works for another one: it loads scenes, or draws large frames.
//!
//! The first client drives the scene of the session: it sends a step each period and receives a small frame of it. Each
//! wait counts from the time at which the step was due, so a stall of the server also counts for the steps that were
//! due during it. After a stall the client continues with the step that is due then, as a client that follows real
//! time. The second client runs on a thread of its own.

use std::sync::Arc;
use std::time::{Duration, Instant};

use modalcast_client::{
    Client, FrameFormat, FrameRequest, FrameStream, FrameStreamRequest, Picture, StageTimes, StepStream,
};
use serde::Serialize;
use tokio::sync::oneshot::{self, error::TryRecvError};

use super::latency::{connect, runtime};
use super::motion::{self, Motion};
use super::session::{SceneSource, Session};
use super::{QUICK_DIVISOR, SCENE, StreamReportOptions};
use crate::timing::quantile;
use crate::workloads::Size;
use modalcast_model::error::{Result, fault, fault_in};

/// Shortest time between two steps.
const MIN_PERIOD: Duration = Duration::from_millis(5);

/// Steps before the first timed one.
const WARM_UP_STEPS: usize = 5;
/// Steps that determine the period.
const PERIOD_STEPS: usize = 20;
/// Timed steps before the second client starts.
const IDLE_STEPS: usize = 200;

/// Width and height of the frames of the first client.
const FRAME_SIZE: [u32; 2] = [320, 180];

/// Width and height of a large frame.
const LARGE_SIDE: u32 = 8192;

/// The name of the second client's scene on the server.
const OTHER_SCENE: &str = "other";

/// What the server does for the second client.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum OtherWork {
    /// Opens scenes and draws the first frame of each.
    Loads,
    /// Draws large frames of another scene.
    LargeFrames,
}

/// Waits of the first client, without and with work for the second one.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ContentionResult {
    /// Time between two steps in milliseconds.
    pub period_ms: f64,
    pub idle: Waits,
    /// The waits during all jobs.
    pub busy: Waits,
    /// Quantile 0.99 of the waits during all jobs, minus the median without jobs.
    pub added_p99_ms: f64,
    /// The longest wait during all jobs, minus the median without jobs.
    pub added_max_ms: f64,
    pub jobs: Vec<JobWaits>,
}

/// The waits during one job of the second client.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct JobWaits {
    pub job: String,
    /// Time until the second client has its result.
    pub job_ms: f64,
    pub waits: Waits,
}

/// Quantiles of the times from the due time of a step to the arrival of its frame.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Waits {
    pub steps: usize,
    pub p50_ms: f64,
    pub p99_ms: f64,
    pub max_ms: f64,
    /// The stages of the server for the step with the longest wait, longest first.
    pub longest_stages: StageTimes,
}

/// A job of the second client.
#[derive(Debug, Clone, PartialEq)]
struct Job {
    name: String,
    begin: Instant,
    end: Instant,
}

/// The time from the due time of a step to the arrival of its frame.
#[derive(Debug, Clone, PartialEq)]
struct Wait {
    due: Instant,
    received: Instant,
    stages: Arc<StageTimes>,
}

impl Wait {
    fn ms(&self) -> f64 {
        (self.received - self.due).as_secs_f64() * 1e3
    }

    fn overlaps(&self, job: &Job) -> bool {
        self.due <= job.end && self.received >= job.begin
    }
}

impl Waits {
    fn new<'a>(waits: impl Iterator<Item = &'a Wait> + Clone) -> Result<Self> {
        let longest = waits.clone().max_by(|a, b| a.ms().total_cmp(&b.ms()));
        let mut longest_stages = longest.map(|wait| wait.stages.to_vec()).unwrap_or_default();
        longest_stages.sort_by(|a, b| b.1.total_cmp(&a.1));
        let mut times_ms: Vec<f64> = waits.map(Wait::ms).collect();
        match [0.5, 0.99, 1.0].map(|fraction| quantile(&mut times_ms, fraction)) {
            [Some(p50_ms), Some(p99_ms), Some(max_ms)] => {
                Ok(Self { steps: times_ms.len(), p50_ms, p99_ms, max_ms, longest_stages })
            }
            _ => Err(fault("report", "expected at least one step")),
        }
    }
}

impl ContentionResult {
    fn new(period: Duration, idle_steps: &[Wait], busy_steps: &[Wait], jobs: &[Job]) -> Result<Self> {
        let idle = Waits::new(idle_steps.iter())?;
        let busy = Waits::new(busy_steps.iter().filter(|wait| jobs.iter().any(|job| wait.overlaps(job))))?;
        let waits_of = |job: &Job| {
            let waits = Waits::new(busy_steps.iter().filter(|wait| wait.overlaps(job)))?;
            Ok(JobWaits { job: job.name.clone(), job_ms: (job.end - job.begin).as_secs_f64() * 1e3, waits })
        };
        Ok(Self {
            period_ms: period.as_secs_f64() * 1e3,
            added_p99_ms: busy.p99_ms - idle.p50_ms,
            added_max_ms: busy.max_ms - idle.p50_ms,
            jobs: jobs.iter().map(waits_of).collect::<Result<_>>()?,
            idle,
            busy,
        })
    }
}

/// Measures the waits of the session's scene without and with work for a second client.
///
/// # Errors
/// `Fault` when the server rejects a request.
pub(super) fn measure(session: &Session, work: OtherWork, options: &StreamReportOptions) -> Result<ContentionResult> {
    let motion = session.motion(options.steps.min(super::RECORDED_STEPS))?;
    let (url, options) = (session.url(), options.clone());
    runtime()?.block_on(async {
        let mut probe = Probe::start(&session.url(), motion).await?;
        for _ in 0..WARM_UP_STEPS {
            probe.step(Instant::now()).await?;
        }
        probe.choose_period().await?;
        let mut idle = Vec::new();
        for _ in 0..IDLE_STEPS {
            probe.next(&mut idle).await?;
        }
        let (sender, mut finished) = oneshot::channel();
        std::thread::spawn(move || {
            sender.send(runtime().and_then(|runtime| runtime.block_on(run_jobs(&url, work, &options))))
        });
        let mut busy = Vec::new();
        let jobs = loop {
            match finished.try_recv() {
                Ok(jobs) => break jobs?,
                Err(TryRecvError::Empty) => probe.next(&mut busy).await?,
                Err(error) => return Err(fault_in("report")(error)),
            }
        };
        ContentionResult::new(probe.period, &idle, &busy, &jobs)
    })
}

/// The first client: one step in flight, with a small frame of each.
struct Probe<'a> {
    motion: &'a Motion,
    steps: StepStream,
    frames: FrameStream,
    number: u64,
    period: Duration,
    due: Instant,
}

impl<'a> Probe<'a> {
    async fn start(url: &str, motion: &'a Motion) -> Result<Self> {
        let (sender, viewer) = (connect(url).await?, connect(url).await?);
        let picture = Picture::default().size(FRAME_SIZE[0], FRAME_SIZE[1]).format(FrameFormat::Rgba);
        let frames =
            viewer.stream_frames(&FrameStreamRequest::new(SCENE, picture)).await.map_err(fault_in("report"))?;
        let steps = motion::open_writer(&sender, None).await?;
        Ok(Self { motion, steps, frames, number: 0, period: MIN_PERIOD, due: Instant::now() })
    }

    /// Chooses a period in which the server can finish a step although its time varies.
    async fn choose_period(&mut self) -> Result<()> {
        let mut waits = Vec::new();
        for _ in 0..PERIOD_STEPS {
            waits.push(self.step(Instant::now()).await?);
        }
        let median_ms = Waits::new(waits.iter())?.p50_ms;
        self.period = MIN_PERIOD.max(Duration::from_secs_f64(2e-3 * median_ms));
        self.due = Instant::now();
        Ok(())
    }

    /// Sends the next step when it is due, and adds its wait. Steps that become due before its frame arrives are not
    /// sent; their waits are added too.
    async fn next(&mut self, waits: &mut Vec<Wait>) -> Result<()> {
        self.due += self.period;
        tokio::time::sleep_until(self.due.into()).await;
        let wait = self.step(self.due).await?;
        waits.push(wait.clone());
        while self.due + self.period <= wait.received {
            self.due += self.period;
            waits.push(Wait { due: self.due, ..wait.clone() });
        }
        Ok(())
    }

    async fn step(&mut self, due: Instant) -> Result<Wait> {
        self.steps.step(&self.motion.step(self.number)).await.map_err(fault_in("report"))?;
        let frame = self.frames.next().await.ok_or_else(|| fault("report", "expected another frame"))?;
        let frame = frame.map_err(fault_in("report"))?;
        let received = Instant::now();
        if frame.step.number != self.number {
            return Err(fault(
                "report",
                format!("expected a frame of step {}, got {}", self.number, frame.step.number),
            ));
        }
        self.number += 1;
        self.steps.take_acks();
        Ok(Wait { due, received, stages: Arc::new(frame.stages) })
    }
}

/// The jobs of the second client.
async fn run_jobs(url: &str, work: OtherWork, options: &StreamReportOptions) -> Result<Vec<Job>> {
    let client = connect(url).await?;
    let mut jobs = Vec::new();
    if work == OtherWork::LargeFrames {
        open_other(&client, SceneSource::Tree).await?;
    }
    for round in 1..=options.repeat {
        match work {
            OtherWork::Loads => {
                for source in loaded_scenes(options) {
                    jobs.push(load_scene(&client, source, round).await?);
                }
            }
            OtherWork::LargeFrames => jobs.push(draw_large_frame(&client, options.size, round).await?),
        }
    }
    if work == OtherWork::LargeFrames {
        client.delete_scene(OTHER_SCENE).await.map_err(fault_in("report"))?;
    }
    Ok(jobs)
}

/// The scenes that are loaded. The first round also compiles their programs.
fn loaded_scenes(options: &StreamReportOptions) -> Vec<SceneSource> {
    let repository = options.scenes.is_some().then_some([SceneSource::BRIDGE, SceneSource::ALMOND]);
    std::iter::once(SceneSource::Tree).chain(repository.into_iter().flatten()).collect()
}

async fn open_other(client: &Client, source: SceneSource) -> Result<()> {
    client.open_scene(source.name(), OTHER_SCENE).await.map_err(fault_in("report")).map(drop)
}

async fn load_scene(client: &Client, source: SceneSource, round: usize) -> Result<Job> {
    let begin = Instant::now();
    open_other(client, source).await?;
    draw_other(client, FRAME_SIZE).await?;
    let job = Job { name: format!("load {}, round {round}", source.name()), begin, end: Instant::now() };
    client.delete_scene(OTHER_SCENE).await.map_err(fault_in("report"))?;
    Ok(job)
}

async fn draw_large_frame(client: &Client, size: Size, round: usize) -> Result<Job> {
    let side = match size {
        Size::Full => LARGE_SIDE,
        Size::Quick => LARGE_SIDE / QUICK_DIVISOR,
    };
    let begin = Instant::now();
    draw_other(client, [side; 2]).await?;
    Ok(Job { name: format!("draw {side}x{side}, round {round}"), begin, end: Instant::now() })
}

async fn draw_other(client: &Client, [width, height]: [u32; 2]) -> Result<()> {
    let picture = Picture::default().size(width, height);
    client.render_frame(&FrameRequest::new(OTHER_SCENE, picture)).await.map_err(fault_in("report")).map(drop)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stall_counts_for_all_steps_that_were_due_in_it() {
        let start = Instant::now();
        let at = |ms: u64| start + Duration::from_millis(ms);
        let wait = |due, received| Wait {
            due: at(due),
            received: at(received),
            stages: Arc::new(vec![("draw".into(), 1.0), ("queue".into(), (received - due) as f32)]),
        };
        let idle = [wait(0, 2), wait(10, 12), wait(20, 22)];
        // The server stalls from 35 ms to 60 ms.
        let busy = [wait(30, 32), wait(40, 61), wait(50, 63), wait(60, 65), wait(70, 72), wait(80, 82)];
        let job = |name: &str, begin, end| Job { name: name.into(), begin: at(begin), end: at(end) };
        let jobs = [job("first", 35, 60), job("second", 81, 82)];
        let result = ContentionResult::new(Duration::from_millis(10), &idle, &busy, &jobs).expect("expected a result");
        assert_eq!((result.idle.steps, result.idle.max_ms, result.busy.steps), (3, 2.0, 4));
        assert_eq!((result.busy.max_ms, result.added_max_ms), (21.0, 19.0));
        assert_eq!(result.busy.longest_stages, [("queue".into(), 21.0), ("draw".into(), 1.0)]);
        let jobs: Vec<(usize, f64)> = result.jobs.iter().map(|job| (job.waits.steps, job.waits.max_ms)).collect();
        assert_eq!(jobs, [(3, 21.0), (1, 2.0)]);
        assert!(
            ContentionResult::new(Duration::ZERO, &idle, &[], &[]).is_err(),
            "expected an error without waits during jobs"
        );
    }
}
