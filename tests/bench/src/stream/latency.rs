//! Latency with one step in flight. The sender and the viewer are two connections of this process, so that one clock
//! measures both ends. The server is another process.

use std::time::{Duration, Instant};

use modalcast_client::FrameStreamRequest;
use serde::Serialize;

use super::SCENE;
use super::motion::{self, Motion};
use super::peers::viewer::{self, Content};
use super::session::Session;
use crate::timing::quantile;
use modalcast_client::Client;
use modalcast_model::error::{Result, fault, fault_in};

/// Time between two steps: 60 steps per second.
const PERIOD: Duration = Duration::from_micros(16_667);

/// Steps before the first timed one.
const WARM_UP_STEPS: u64 = 5;

/// Lateness from which a step counts as delayed. Timers of the runtime have a resolution of 1 ms.
const MAX_TIMER_ERROR: Duration = Duration::from_millis(2);

/// Quantiles of times.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct LatencyResult {
    /// The two ends of the time.
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
    /// Steps per second if steps are sent from memory without a wait for acknowledgements. Only for acknowledgements.
    pub steps_per_second: Option<f64>,
}

impl LatencyResult {
    /// The quantiles of times in milliseconds.
    fn new([from, to]: [&'static str; 2], mut times_ms: Vec<f64>) -> Result<Self> {
        let mut at = |fraction: f64| quantile(&mut times_ms, fraction);
        let quantiles = [0.5, 0.9, 0.99, 1.0].map(&mut at);
        let [Some(p50_ms), Some(p90_ms), Some(p99_ms), Some(max_ms)] = quantiles else {
            return Err(fault("report", "expected times of at least one step"));
        };
        let steps = times_ms.len();
        let (period_ms, delayed_steps, steps_per_second) = (None, 0, None);
        Ok(Self { from, to, steps, p50_ms, p90_ms, p99_ms, max_ms, period_ms, delayed_steps, steps_per_second })
    }
}

/// Measures the time from sending a step until its PNG is received, with a step every 16.7 ms.
///
/// # Errors
/// `Fault` when the server rejects a request or a frame shows another step.
pub(super) fn measure_frames(session: &Session, content: Content, steps: u64) -> Result<LatencyResult> {
    let motion = session.motion(steps.min(super::RECORDED_STEPS))?;
    session.runtime.block_on(time_frames(&session.url(), motion, content, steps))
}

async fn time_frames(url: &str, motion: &Motion, content: Content, steps: u64) -> Result<LatencyResult> {
    let (sender, viewer) = (connect(url).await?, connect(url).await?);
    let picture = viewer::picture(&viewer, SCENE, content, 0).await?;
    let picture = picture.ok_or_else(|| fault("report", "expected a picture"))?;
    let request = FrameStreamRequest::new(SCENE, picture).max_steps(WARM_UP_STEPS + steps);
    let mut frames = viewer.stream_frames(&request).await.map_err(fault_in("report"))?;
    let mut writer = motion::open_writer(&sender, None).await?;
    let (mut times_ms, mut delayed_steps, mut start) = (Vec::new(), 0, Instant::now());
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
        let frame = frames.next().await.ok_or_else(|| fault("report", "expected another frame"))?;
        let frame = frame.map_err(fault_in("report"))?;
        if frame.step.number != number {
            return Err(fault("report", format!("expected a frame of step {number}, got {}", frame.step.number)));
        }
        times_ms.extend(timed_number.map(|_| sent.elapsed().as_secs_f64() * 1e3));
        writer.take_acks();
    }
    writer.finish().await.map_err(fault_in("report"))?;
    let period_ms = Some(PERIOD.as_secs_f64() * 1e3);
    Ok(LatencyResult { period_ms, delayed_steps, ..LatencyResult::new(["step sent", "PNG received"], times_ms)? })
}

/// Measures the time from sending a step until its acknowledgement, with one step in flight, and the rate of steps that
/// do not wait for acknowledgements.
///
/// # Errors
/// `Fault` when the server rejects a step.
pub(super) fn measure_acknowledgements(session: &Session, steps: u64) -> Result<LatencyResult> {
    let motion = session.motion(steps.min(super::RECORDED_STEPS))?;
    session.runtime.block_on(async {
        let times_ms = time_acknowledgements(&session.client, motion, steps).await?;
        let steps_per_second = Some(motion::measure_rate(&session.client, motion, steps).await?);
        let latency = LatencyResult::new(["step sent", "acknowledgement received"], times_ms)?;
        Ok(LatencyResult { steps_per_second, ..latency })
    })
}

async fn time_acknowledgements(client: &Client, motion: &Motion, steps: u64) -> Result<Vec<f64>> {
    let mut writer = motion::open_writer(client, Some(1)).await?;
    let mut times_ms = Vec::new();
    for number in 0..WARM_UP_STEPS + steps {
        let step = motion.step(number);
        let sent = Instant::now();
        writer.step(&step).await.map_err(fault_in("report"))?;
        writer.flush().await.map_err(fault_in("report"))?;
        if number >= WARM_UP_STEPS {
            times_ms.push(sent.elapsed().as_secs_f64() * 1e3);
        }
    }
    writer.finish().await.map_err(fault_in("report"))?;
    Ok(times_ms)
}

async fn connect(url: &str) -> Result<Client> {
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
}
