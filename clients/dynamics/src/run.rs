//! Drives a scene with a scenario: sends the changed values of each step, and reports the results. Optionally paces the
//! steps in real time, records q and the transforms, and writes checkpoints or continues from one.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};
use modalcast_client::{
    Client, Delivery, DriveRequest, Error as ClientError, StageSamples, Step, StepStream, StreamSummary,
};
use serde_json::{Value, json};
use tokio::sync::watch;

use crate::checkpoint::{Checkpoint, CheckpointOptions, RunIdentity};
use crate::divergence::DivergenceCheck;
use crate::error::{Error, Result, invalid_input};
use crate::loads::DomainLoads;
use crate::model::Model;
use crate::recorder::Recorder;
use crate::step_values::{StepValues, add_changes};
use crate::viewer_forces::ViewerForces;

/// Named results of a scenario or a run.
pub type Report = serde_json::Map<String, Value>;

/// Maximum number of rejections in the report.
const MAX_REJECTIONS: usize = 16;

/// Computes the values of all steps of a scene, one step after another.
pub trait Scenario {
    /// The model of the scene.
    fn model(&self) -> &Model;

    /// Overwrites `values` with the values of the next step. The first call computes step 0.
    ///
    /// The values may be out of range: [`DivergenceCheck`] checks them before they are sent.
    ///
    /// # Errors
    /// Those of the scenario.
    fn compute_next_step(&mut self, values: &mut StepValues) -> Result<()>;

    /// What the motion follows from, in addition to the scene, the time of a step and the forces of viewers. A
    /// checkpoint continues only a run with the same inputs.
    fn identity(&self) -> RunIdentity;

    /// The state before the next step, for a checkpoint: bit by bit.
    ///
    /// # Errors
    /// `Invalid` if JSON cannot hold the state.
    fn save(&self) -> Result<Value>;

    /// Continues with step `next_step` from a state of [`Self::save`].
    ///
    /// # Errors
    /// `Invalid` if the state is not that of this scenario.
    fn restore(&mut self, next_step: u64, state: Value) -> Result<()>;

    /// Sets the forces of viewers, which act in all later steps in addition to the load of the scenario.
    ///
    /// # Errors
    /// `Invalid` if the motion of the scenario does not follow from forces.
    fn set_viewer_forces(&mut self, _loads: &DomainLoads) -> Result<()> {
        Err(invalid_input("--forces", "a motion that follows from forces", "a sweep"))
    }

    /// Sentences about parts of the input that the motion does not show, such as modes that are held still. They hold
    /// for the whole run.
    fn remarks(&self) -> Vec<String> {
        vec![]
    }

    /// The last [`Self::remarks`]: those about the motion and the forces of viewers, which are not known before the
    /// first step.
    fn late_remarks(&self) -> &[String] {
        &[]
    }

    /// Results so far. The keys depend on the scenario; each scenario has the key `load`, which
    /// names the motion or the force.
    fn report(&self) -> Report;
}

/// A remark if steps of `dt` seconds do not resolve a periodic motion: with two steps per period or fewer, all steps
/// may be equal. `subject` names the motion.
pub fn aliasing_remark(subject: &str, period: f64, dt: f64) -> Option<String> {
    (period <= 2.0 * dt).then(|| {
        format!(
            "{subject} has a period of {period} s, which steps of {dt} s do not resolve: choose steps below {} s",
            0.5 * period
        )
    })
}

/// Settings of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct RunOptions {
    /// Number of steps, with those before the checkpoint that the run continues. `None` runs until the caller stops the
    /// run.
    pub steps: Option<u64>,
    /// Simulated seconds per step.
    pub dt: f64,
    /// Real seconds per simulated second, for `realtime`.
    pub slow: f64,
    pub delivery: Delivery,
    /// Maximum number of steps in flight. `None` and 0 select the server's default.
    pub window: Option<u32>,
    /// How long lossless readers may make the run wait. `None` selects the server's default.
    pub stall_budget: Option<Duration>,
    /// Whether to run in real time, or `slow` times slower.
    pub realtime: bool,
    /// Whether the forces of viewers act on the scene.
    pub applies_viewer_forces: bool,
    /// Folder for q.npy (steps x coordinates) and transforms.npy (steps x domains x 12), f32.
    pub record_folder: Option<PathBuf>,
    /// `None` writes no checkpoints.
    pub checkpoint: Option<CheckpointOptions>,
    /// The checkpoint that the run continues.
    pub resume_path: Option<PathBuf>,
}

/// Results of a run.
#[derive(Debug, Clone)]
pub struct RunSummary {
    /// Number of sent steps.
    pub sent_steps: u64,
    /// Number of rejected steps.
    pub rejected_steps: u64,
    pub report: Report,
}

/// Statistics of a run: acknowledgments, rejections and sent bytes.
#[derive(Default)]
struct RunStats {
    /// Times of the server's processing stages, from the acknowledgments.
    stage_samples: StageSamples,
    /// Texts of the first `MAX_REJECTIONS` rejections.
    rejections: Vec<String>,
    acknowledgment_count: u64,
    /// Bytes of coordinates and transforms in all sent steps.
    payload_bytes: u64,
}

/// Drives a scene until all steps are done or `stop_receiver` receives true.
///
/// # Errors
/// `Client` if the scene has another writer, the stream ends, or a record or a checkpoint cannot be read or written.
/// `Invalid` if the checkpoint to continue is invalid or belongs to another run. `Diverged` before a step that is not
/// finite or far out of range would be sent. Errors of the scenario are returned unchanged. After an error of the
/// scenario, the stream and the record end with the step before it.
pub async fn drive_scene(
    client: &Client,
    scenario: &mut dyn Scenario,
    options: &RunOptions,
    stop_receiver: &watch::Receiver<bool>,
) -> Result<RunSummary> {
    let identity = identity(scenario, options);
    let start = match &options.resume_path {
        Some(path) => resume(scenario, &identity, path, options.steps)?,
        None => RunStart { step: 0, recorded_rows: None },
    };
    let mut driver = Driver::start(client, scenario, options, identity, &start).await?;
    let outcome = driver.send_steps(options, stop_receiver).await;
    if let Err(error @ Error::Client(_)) = outcome {
        return Err(error);
    }
    let report = driver.finish().await;
    outcome?;
    let (stream_summary, mut report) = report?;
    report.extend(scenario.report());
    report.extend(Report::from_iter([
        ("scene".to_owned(), json!(scenario.model().scene)),
        ("first_step".to_owned(), json!(start.step)),
        ("dt_s".to_owned(), json!(options.dt)),
        ("slow".to_owned(), json!(options.slow)),
        ("remarks".to_owned(), json!(scenario.remarks())),
    ]));
    Ok(RunSummary { sent_steps: stream_summary.sent, rejected_steps: stream_summary.rejected, report })
}

/// Where a run begins.
struct RunStart {
    step: u64,
    /// Number of steps in the record before; `None` without a record.
    recorded_rows: Option<u64>,
}

/// What the motion of a run follows from.
fn identity(scenario: &dyn Scenario, options: &RunOptions) -> RunIdentity {
    let identity = scenario.identity().with_scene(scenario.model()).with("--forces", options.applies_viewer_forces);
    identity.with_number("seconds per step (--dt / --slow)", options.dt)
}

/// Restores a scenario from the checkpoint at `path`, for a run that ends before step `steps`.
fn resume(scenario: &mut dyn Scenario, identity: &RunIdentity, path: &Path, steps: Option<u64>) -> Result<RunStart> {
    let Checkpoint { identity: saved_identity, next_step, recorded_rows, state } =
        Checkpoint::read(path, scenario.model())?;
    saved_identity.check(identity, path)?;
    scenario.restore(next_step, state)?;
    if let Some(steps) = steps.filter(|steps| next_step >= *steps) {
        eprintln!(
            "modalcast-sim: {}: the checkpoint has all {steps} steps of the run (--seconds and --steps count from step 0)",
            scenario.model().scene
        );
    }
    Ok(RunStart { step: next_step, recorded_rows })
}

/// A run in progress.
struct Driver<'a> {
    scenario: &'a mut dyn Scenario,
    identity: RunIdentity,
    check: DivergenceCheck,
    viewer_forces: Option<ViewerForces>,
    step_stream: StepStream,
    recorder: Option<Recorder>,
    progress_bar: ProgressBar,
    start: Instant,
    /// The first step of this process.
    first_step: u64,
    next_step: u64,
    /// The next step in the newest checkpoint that this process has written.
    saved_step: Option<u64>,
    /// The values of the last step sent. `None` before the first step and after a reported rejection.
    last_sent_values: Option<StepValues>,
    current_values: StepValues,
    printed_remarks: usize,
    stats: RunStats,
}

impl<'a> Driver<'a> {
    async fn start(
        client: &Client,
        scenario: &'a mut dyn Scenario,
        options: &RunOptions,
        identity: RunIdentity,
        start: &RunStart,
    ) -> Result<Self> {
        let scene = &scenario.model().scene;
        let viewer_forces = match options.applies_viewer_forces {
            true => Some(ViewerForces::subscribe(client, scene).await?),
            false => None,
        };
        let request = DriveRequest::new(scene, options.delivery);
        let request = options.window.into_iter().fold(request, DriveRequest::window);
        let request = options.stall_budget.into_iter().fold(request, DriveRequest::stall_budget);
        let step_stream = client.drive(&request).await?;
        let open_recorder = |folder: &PathBuf| match options.resume_path {
            Some(_) => Recorder::resume(folder, scenario.model(), start.recorded_rows),
            None => Recorder::create(folder, scenario.model()),
        };
        Ok(Self {
            check: DivergenceCheck::new(scenario.model()),
            identity,
            viewer_forces,
            step_stream,
            recorder: options.record_folder.as_ref().map(open_recorder).transpose()?,
            progress_bar: create_progress_bar(options.steps).with_position(start.step),
            start: Instant::now(),
            first_step: start.step,
            next_step: start.step,
            saved_step: None,
            last_sent_values: None,
            current_values: StepValues::default(),
            printed_remarks: 0,
            stats: RunStats::default(),
            scenario,
        })
    }

    async fn send_steps(&mut self, options: &RunOptions, stop_receiver: &watch::Receiver<bool>) -> Result<()> {
        while options.steps.is_none_or(|steps| self.next_step < steps) && !*stop_receiver.borrow() {
            self.send_next_step(options).await?;
            if let Some(checkpoint) = &options.checkpoint
                && self.next_step.is_multiple_of(checkpoint.interval)
            {
                self.write_checkpoint(checkpoint)?;
            }
        }
        match &options.checkpoint {
            Some(checkpoint) if self.saved_step != Some(self.next_step) => self.write_checkpoint(checkpoint),
            _ => Ok(()),
        }
    }

    async fn send_next_step(&mut self, options: &RunOptions) -> Result<()> {
        let time = self.next_step as f64 * options.dt;
        if options.realtime {
            let elapsed_time = (self.next_step - self.first_step) as f64 * options.dt * options.slow;
            // Adding `Duration::MAX` itself would overflow.
            let due_time = self.start + Duration::try_from_secs_f64(elapsed_time).unwrap_or(Duration::MAX / 4);
            tokio::time::sleep_until(due_time.into()).await;
        }
        // After the pause, so that a force that arrives during the pause acts in this step.
        if let Some(viewer_forces) = &mut self.viewer_forces
            && let Some(loads) = viewer_forces.take_changed(self.scenario.model()).await?
        {
            self.scenario.set_viewer_forces(&loads)?;
        }
        self.scenario.compute_next_step(&mut self.current_values)?;
        let late_remarks = self.scenario.late_remarks();
        for remark in &late_remarks[self.printed_remarks..] {
            self.progress_bar.suspend(|| eprintln!("modalcast-sim: {}: {remark}", self.scenario.model().scene));
        }
        self.printed_remarks = late_remarks.len();
        let model = self.scenario.model();
        self.check.check(model, self.next_step, time, &self.current_values)?;
        let step = Step::new(self.next_step, time);
        let step = add_changes(model, step, self.last_sent_values.as_ref(), &self.current_values);
        // A rejection arrives late: it may concern this step or an earlier one.
        let is_rejected = self.stats.record_rejection(self.step_stream.step(&step).await)?;
        self.stats.payload_bytes += step.payload_bytes() as u64;
        self.stats.record_acknowledgments(&self.step_stream);
        if let Some(recorder) = &mut self.recorder {
            recorder.write_row(&self.current_values)?;
        }
        // After a rejection the server lacks the values of some step, so the next step sends all values.
        self.last_sent_values = (!is_rejected).then(|| std::mem::take(&mut self.current_values));
        self.next_step += 1;
        self.progress_bar.inc(1);
        Ok(())
    }

    /// Writes the state before the next step. The record is durable before, so that it has all steps of the checkpoint.
    fn write_checkpoint(&mut self, options: &CheckpointOptions) -> Result<()> {
        let checkpoint = Checkpoint {
            identity: self.identity.clone(),
            next_step: self.next_step,
            recorded_rows: self.recorder.as_mut().map(Recorder::sync).transpose()?,
            state: self.scenario.save()?,
        };
        self.saved_step = Some(self.next_step);
        checkpoint.write(&options.path)
    }

    /// Waits for the acknowledgments of all steps and closes the stream and the record.
    async fn finish(mut self) -> Result<(StreamSummary, Report)> {
        // Each flush reports at most one rejection. Repeat until no rejection is left.
        while self.stats.record_rejection(self.step_stream.flush().await)? {}
        self.stats.record_acknowledgments(&self.step_stream);
        // The number that the server has given to this writer.
        let (run_number, window) = (self.step_stream.run, self.step_stream.window);
        let stream_summary = self.step_stream.finish().await?;
        self.recorder.map(Recorder::finish).transpose()?;
        self.progress_bar.finish_and_clear();
        let elapsed = self.start.elapsed().as_secs_f64();
        let mut report = self.stats.report();
        report.extend(Report::from_iter([
            ("run".to_owned(), json!(run_number)),
            ("window".to_owned(), json!(window)),
            ("steps_sent".to_owned(), json!(stream_summary.sent)),
            ("last_acknowledged".to_owned(), json!(stream_summary.acknowledged)),
            ("rejected".to_owned(), json!(stream_summary.rejected)),
            ("skipped".to_owned(), json!(stream_summary.skipped)),
            ("elapsed_s".to_owned(), json!(elapsed)),
            ("steps_per_second".to_owned(), json!(stream_summary.sent as f64 / elapsed.max(1e-9))),
        ]));
        Ok((stream_summary, report))
    }
}

impl RunStats {
    /// Records a rejection and returns whether there was one.
    ///
    /// # Errors
    /// `Client` for any other error of `result`.
    fn record_rejection(&mut self, result: modalcast_client::Result<()>) -> Result<bool> {
        match result {
            Ok(()) => Ok(false),
            Err(ClientError::Rejected(rejection)) => {
                if self.rejections.len() < MAX_REJECTIONS {
                    self.rejections.push(rejection.to_string());
                }
                Ok(true)
            }
            Err(error) => Err(Error::Client(error)),
        }
    }

    /// Records the acknowledgments that have arrived since the last call.
    fn record_acknowledgments(&mut self, step_stream: &StepStream) {
        for acknowledgment in step_stream.take_acks() {
            self.acknowledgment_count += 1;
            self.stage_samples.add(&acknowledgment.stages);
        }
    }

    fn report(self) -> Report {
        Report::from_iter([
            ("stages_ms".to_owned(), json!(self.stage_samples.medians())),
            ("acknowledgments".to_owned(), json!(self.acknowledgment_count)),
            ("payload_bytes".to_owned(), json!(self.payload_bytes)),
            ("rejections".to_owned(), json!(self.rejections)),
        ])
    }
}

/// A progress bar on standard error, or a counter for an unlimited run. It is hidden unless standard error is a
/// terminal.
fn create_progress_bar(steps: Option<u64>) -> ProgressBar {
    let template = match steps {
        Some(_) => "steps [{bar:32}] {pos}/{len} {per_sec} eta {eta}",
        None => "{spinner} {pos} steps {per_sec}",
    };
    let bar = steps.map_or_else(ProgressBar::new_spinner, ProgressBar::new);
    bar.with_style(ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar()))
}
