//! Latency with one step in flight. The sender and the viewer are two connections of this process, so that one clock
//! measures both ends. All tasks of this process run on one thread, so that no time includes a switch between threads
//! of the client. The server is another process.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use modalcast_client::{Client, Frame, FrameStream, FrameStreamRequest, StageTimes};
use serde::Serialize;

use super::SCENE;
use super::motion::{self, Motion};
use super::peers::viewer::{self, Content};
use super::session::Session;
use crate::timing::quantile;
use modalcast_model::error::{Result, fault, fault_in};

/// Time between two steps: 60 steps per second.
const PERIOD: Duration = Duration::from_micros(16_667);

/// Steps before the first timed one.
const WARM_UP_STEPS: u64 = 5;

/// Lateness from which a step counts as delayed. Timers of the runtime have a resolution of 1 ms.
const MAX_TIMER_ERROR: Duration = Duration::from_millis(2);

/// Quantiles of times.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LatencyResult {
    /// The events at the start and at the end of the measured time.
    pub from: &'static str,
    pub to: &'static str,
    /// Number of steps.
    pub steps: usize,
    pub p50_ms: f64,
    pub p90_ms: f64,
    pub p99_ms: f64,
    pub max_ms: f64,
    /// Time between two steps in milliseconds; `None` if the next step is sent as soon as the previous one has arrived.
    pub period_ms: Option<f64>,
    /// Steps that were sent more than 2 ms too late, because the previous step had not arrived.
    pub delayed_steps: usize,
    /// Steps per second if steps are sent from memory without waiting for acknowledgments; `None` for frames.
    pub steps_per_second: Option<f64>,
    /// The stages of the server, and everything between them. The largest p50 is first.
    pub stages: Vec<StageLatency>,
}

/// Quantiles of the time of one stage.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StageLatency {
    pub stage: String,
    pub p50_ms: f64,
    pub p99_ms: f64,
}

/// The name of the time that is not in a stage of the server.
const OTHER_STAGE: &str = "send, transfer and waits";

impl LatencyResult {
    /// The stage with the largest p50, in words.
    pub fn bottleneck(&self) -> Option<String> {
        let StageLatency { stage, p50_ms, p99_ms } = self.stages.first()?;
        let (total, tail) = (self.p50_ms, self.p99_ms);
        Some(format!("{stage}: {p50_ms:.3} of {total:.3} ms at p50, p99 {p99_ms:.3} of {tail:.3} ms"))
    }

    /// The quantiles of times in milliseconds.
    fn new([from, to]: [&'static str; 2], mut times_ms: Vec<f64>) -> Result<Self> {
        let mut at = |fraction: f64| quantile(&mut times_ms, fraction);
        let quantiles = [0.5, 0.9, 0.99, 1.0].map(&mut at);
        let [Some(p50_ms), Some(p90_ms), Some(p99_ms), Some(max_ms)] = quantiles else {
            return Err(fault("report", "expected times of at least one step"));
        };
        let steps = times_ms.len();
        let (period_ms, delayed_steps, steps_per_second) = (None, 0, None);
        let stages = Vec::new();
        Ok(Self { from, to, steps, p50_ms, p90_ms, p99_ms, max_ms, period_ms, delayed_steps, steps_per_second, stages })
    }
}

/// The times of the stages of frames or steps.
#[derive(Debug, Default)]
struct StageSamples(BTreeMap<String, Vec<f64>>);

impl StageSamples {
    /// Adds the stages of a frame or a step that took `total_ms`.
    fn add(&mut self, stages: &StageTimes, total_ms: f64) {
        let stages_ms: f64 = stages.iter().map(|(_, ms)| f64::from(*ms)).sum();
        let other = (OTHER_STAGE, (total_ms - stages_ms).max(0.0));
        for (stage, ms) in stages.iter().map(|(stage, ms)| (stage.as_str(), f64::from(*ms))).chain([other]) {
            self.0.entry(stage.to_owned()).or_default().push(ms);
        }
    }

    fn latencies(self) -> Vec<StageLatency> {
        let quantiles = |(stage, mut times_ms): (String, Vec<f64>)| {
            let p50_ms = quantile(&mut times_ms, 0.5)?;
            Some(StageLatency { stage, p50_ms, p99_ms: quantile(&mut times_ms, 0.99)? })
        };
        let mut stages: Vec<StageLatency> = self.0.into_iter().filter_map(quantiles).collect();
        stages.sort_by(|a, b| b.p50_ms.total_cmp(&a.p50_ms));
        stages
    }
}

/// Measures the time from sending a step until its PNG is received, with a step every 16.7 ms.
///
/// # Errors
/// `Fault` when the server rejects a request or a frame shows another step.
pub(super) fn measure_frames(session: &Session, content: Content, steps: u64) -> Result<LatencyResult> {
    let motion = session.motion(steps.min(super::RECORDED_STEPS))?;
    runtime()?.block_on(time_frames(&session.url(), motion, content, steps))
}

/// Median times of the stages of pictures in milliseconds, for each view. A step is sent after the frames of the previous
/// one have been received. A stage of overlapping steps would also include waits for the other steps.
///
/// # Errors
/// `Fault` when the server rejects a request or a frame shows another step.
pub(super) fn measure_stages(
    session: &Session,
    motion: &Motion,
    content: Content,
    views: usize,
    steps: u64,
) -> Result<Vec<BTreeMap<String, f32>>> {
    runtime()?.block_on(time_stages(&session.url(), motion, content, views, steps))
}

async fn time_stages(
    url: &str,
    motion: &Motion,
    content: Content,
    views: usize,
    steps: u64,
) -> Result<Vec<BTreeMap<String, f32>>> {
    let (sender, viewer) = (connect(url).await?, connect(url).await?);
    let mut streams = Vec::new();
    for view in 0..views {
        let picture = viewer::picture(&viewer, SCENE, content, view as u32).await?;
        let picture = picture.ok_or_else(|| fault("report", "expected a picture"))?;
        let request = FrameStreamRequest::new(SCENE, picture).max_steps(WARM_UP_STEPS + steps);
        let frames = viewer.stream_frames(&request).await.map_err(fault_in("report"))?;
        streams.push((frames, modalcast_client::StageSamples::default()));
    }
    let mut writer = motion::open_writer(&sender, None).await?;
    for number in 0..WARM_UP_STEPS + steps {
        writer.step(&motion.step(number)).await.map_err(fault_in("report"))?;
        for (frames, samples) in &mut streams {
            let frame = next_frame(frames, number).await?;
            if number >= WARM_UP_STEPS {
                samples.add(&frame.stages);
            }
        }
        writer.take_acks();
    }
    writer.finish().await.map_err(fault_in("report"))?;
    Ok(streams.into_iter().map(|(_, samples)| samples.medians()).collect())
}

/// The next frame of a stream, which must show this step.
async fn next_frame(frames: &mut FrameStream, number: u64) -> Result<Frame> {
    let frame = frames.next().await.ok_or_else(|| fault("report", "expected another frame"))?;
    let frame = frame.map_err(fault_in("report"))?;
    match frame.step.number == number {
        true => Ok(frame),
        false => Err(fault("report", format!("expected a frame of step {number}, got {}", frame.step.number))),
    }
}

/// A runtime with one thread.
pub(super) fn runtime() -> Result<tokio::runtime::Runtime> {
    tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(fault_in("report"))
}

async fn time_frames(url: &str, motion: &Motion, content: Content, steps: u64) -> Result<LatencyResult> {
    let (sender, viewer) = (connect(url).await?, connect(url).await?);
    let picture = viewer::picture(&viewer, SCENE, content, 0).await?;
    let picture = picture.ok_or_else(|| fault("report", "expected a picture"))?;
    let request = FrameStreamRequest::new(SCENE, picture).max_steps(WARM_UP_STEPS + steps);
    let mut frames = viewer.stream_frames(&request).await.map_err(fault_in("report"))?;
    let mut writer = motion::open_writer(&sender, None).await?;
    let (mut times_ms, mut delayed_steps, mut start) = (Vec::new(), 0, Instant::now());
    let mut stages = StageSamples::default();
    for number in 0..WARM_UP_STEPS + steps {
        if number == WARM_UP_STEPS {
            start = Instant::now();
        }
        let step = motion.step(number);
        let timed_number = number.checked_sub(WARM_UP_STEPS);
        if let Some(timed_number) = timed_number {
            let due_time = start + PERIOD * timed_number as u32;
            tokio::time::sleep_until(due_time.into()).await;
            delayed_steps += usize::from(due_time.elapsed() > MAX_TIMER_ERROR);
        }
        let sent = Instant::now();
        writer.step(&step).await.map_err(fault_in("report"))?;
        let frame = next_frame(&mut frames, number).await?;
        if timed_number.is_some() {
            let total_ms = sent.elapsed().as_secs_f64() * 1e3;
            times_ms.push(total_ms);
            stages.add(&frame.stages, total_ms);
        }
        writer.take_acks();
    }
    writer.finish().await.map_err(fault_in("report"))?;
    let period_ms = Some(PERIOD.as_secs_f64() * 1e3);
    let latency = LatencyResult::new(["step sent", "PNG received"], times_ms)?;
    Ok(LatencyResult { period_ms, delayed_steps, stages: stages.latencies(), ..latency })
}

/// Measures the time from sending a step until its acknowledgment, with one step in flight, and the rate of steps that
/// do not wait for acknowledgments.
///
/// # Errors
/// `Fault` when the server rejects a step.
pub(super) fn measure_acknowledgments(session: &Session, steps: u64) -> Result<LatencyResult> {
    let motion = session.motion(steps.min(super::RECORDED_STEPS))?;
    let latency = runtime()?.block_on(async {
        let client = connect(&session.url()).await?;
        time_acknowledgments(&client, motion, steps).await
    })?;
    let steps_per_second = session.runtime.block_on(motion::measure_rate(&session.client, motion, steps))?;
    Ok(LatencyResult { steps_per_second: Some(steps_per_second), ..latency })
}

async fn time_acknowledgments(client: &Client, motion: &Motion, steps: u64) -> Result<LatencyResult> {
    let mut writer = motion::open_writer(client, Some(1)).await?;
    let (mut times_ms, mut stages) = (Vec::new(), StageSamples::default());
    for number in 0..WARM_UP_STEPS + steps {
        let step = motion.step(number);
        let sent = Instant::now();
        writer.step(&step).await.map_err(fault_in("report"))?;
        writer.flush().await.map_err(fault_in("report"))?;
        let total_ms = sent.elapsed().as_secs_f64() * 1e3;
        let acks = writer.take_acks();
        if number >= WARM_UP_STEPS {
            times_ms.push(total_ms);
            acks.iter().for_each(|ack| stages.add(&ack.stages, total_ms));
        }
    }
    writer.finish().await.map_err(fault_in("report"))?;
    let latency = LatencyResult::new(["step sent", "acknowledgment received"], times_ms)?;
    Ok(LatencyResult { stages: stages.latencies(), ..latency })
}

pub(super) async fn connect(url: &str) -> Result<Client> {
    Client::connect(url).await.map_err(fault_in("report"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_of_times_in_any_order() {
        let times_ms: Vec<f64> = (0..=100).rev().map(f64::from).collect();
        let latency = LatencyResult::new(["a", "b"], times_ms).expect("expected quantiles");
        assert_eq!((latency.p50_ms, latency.p90_ms, latency.p99_ms, latency.max_ms), (50.0, 90.0, 99.0, 100.0));
        assert_eq!(latency.steps, 101);
        assert!(LatencyResult::new(["a", "b"], vec![]).is_err());
    }

    #[test]
    fn stages_and_the_rest_add_up_and_the_largest_is_named() {
        let mut samples = StageSamples::default();
        for number in 0..=100_u8 {
            let stages = vec![("draw".to_owned(), 3.0), ("encode".to_owned(), f32::from(number))];
            samples.add(&stages, 10.0 + f64::from(number));
        }
        let stages = samples.latencies();
        let of = |index: usize| (stages[index].stage.as_str(), stages[index].p50_ms, stages[index].p99_ms);
        assert_eq!([of(0), of(1), of(2)], [("encode", 50.0, 99.0), (OTHER_STAGE, 7.0, 7.0), ("draw", 3.0, 3.0)]);
        let times_ms = (10..=110).map(f64::from).collect();
        let latency = LatencyResult::new(["a", "b"], times_ms).expect("expected quantiles");
        assert_eq!(latency.bottleneck(), None);
        let bottleneck = LatencyResult { stages, ..latency }.bottleneck();
        assert_eq!(bottleneck.as_deref(), Some("encode: 50.000 of 60.000 ms at p50, p99 99.000 of 109.000 ms"));
    }
}
