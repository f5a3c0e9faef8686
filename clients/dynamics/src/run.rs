//! Drives a scene with a scenario: sends changed values as a step stream, optionally in real time and with records, and
//! summarizes the run.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};
use modalcast_client::npy::Writer;
use modalcast_client::{Client, Error as ClientError, Policy, StageSamples, Step, StepStream};
use serde_json::{Value, json};
use tokio::sync::watch;

use crate::error::{Error, Result};
use crate::model::Model;

/// Named results of a scenario or a run.
pub type ScenarioReport = serde_json::Map<String, Value>;

/// The most refusals that are kept for the summary.
const MAX_REJECTIONS: usize = 16;

/// The state at one step: all coordinates, and `world_from_domain` of every part, row-major 3x4.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Motion {
    pub q: Vec<f32>,
    pub transforms: Vec<[f32; 12]>,
}

/// A source of motion for a scene. It counts the steps itself, so that they cannot be skipped or repeated.
pub trait Scenario {
    /// The model of the scene.
    fn model(&self) -> &Model;

    /// Computes the motion of the next step and overwrites `motion` with it. The first call computes step 0.
    ///
    /// # Errors
    /// If the motion cannot be continued.
    fn next_motion(&mut self, motion: &mut Motion) -> Result<()>;

    /// Load, peak displacements and joint gaps up to now.
    fn report(&self) -> ScenarioReport;
}

/// Settings of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// Number of steps; `None` runs until it is stopped.
    pub steps: Option<u64>,
    /// Seconds per step.
    pub dt: f64,
    pub policy: Policy,
    /// The most steps in flight; 0 selects the server's default.
    pub window: u32,
    /// Whether to run in real time.
    pub realtime: bool,
    /// Folder for q.npy (steps x coordinates) and transforms.npy (steps x domains x 12), f32.
    pub record: Option<PathBuf>,
}

/// Results of a run.
#[derive(Debug, Clone)]
pub struct Summary {
    pub sent: u64,
    pub rejected: u64,
    pub value: Value,
}

/// Statistics of a run: acknowledgements, refusals and sent bytes.
#[derive(Default)]
struct RunStats {
    stages: StageSamples,
    rejections: Vec<String>,
    acks: u64,
    bytes: u64,
}

/// Drives a scene until all steps are done or `stop` becomes true.
///
/// # Errors
/// `Client` if the scene has another writer, the stream ends, or a record cannot be written; errors of the scenario.
pub async fn run(
    client: &Client,
    scenario: &mut dyn Scenario,
    options: &Options,
    stop: &watch::Receiver<bool>,
) -> Result<Summary> {
    let scene = scenario.model().scene.clone();
    let mut drive = client.drive(&scene, options.policy, options.window).await?;
    let mut record = options.record.as_deref().map(|folder| Recorder::create(folder, scenario.model())).transpose()?;
    let (bar, start, mut tally) = (progress(options.steps), Instant::now(), RunStats::default());
    let mut last: Option<Motion> = None;
    let mut motion = Motion::default();
    let mut number = 0;
    while options.steps.is_none_or(|steps| number < steps) && !*stop.borrow() {
        scenario.next_motion(&mut motion)?;
        if options.realtime {
            let due = start + Duration::try_from_secs_f64(number as f64 * options.dt).unwrap_or(Duration::MAX / 4);
            tokio::time::sleep_until(due.into()).await;
        }
        let step = Step::new(number, number as f64 * options.dt);
        let step = encode_changes(scenario.model(), step, last.as_ref(), &motion);
        let rejected = tally.record_rejection(drive.step(&step).await)?;
        tally.add(&drive, step.payload_bytes());
        if let Some(record) = &mut record {
            record.add(&motion)?;
        }
        // After a refusal the server does not have the values of that step, so the next step sends everything.
        last = if rejected { None } else { Some(std::mem::take(&mut motion)) };
        number += 1;
        bar.inc(1);
    }
    while tally.record_rejection(drive.flush().await)? {}
    tally.add(&drive, 0);
    let run = drive.run;
    let window = drive.window;
    let end = drive.finish().await?;
    record.map(Recorder::finish).transpose()?;
    bar.finish_and_clear();
    let elapsed = start.elapsed().as_secs_f64();
    let mut value = scenario.report();
    value.extend(tally.report());
    value.extend(ScenarioReport::from_iter([
        ("scene".to_owned(), json!(scene)),
        ("run".to_owned(), json!(run)),
        ("window".to_owned(), json!(window)),
        ("dt_s".to_owned(), json!(options.dt)),
        ("steps_sent".to_owned(), json!(end.sent)),
        ("last_acknowledged".to_owned(), json!(end.acknowledged)),
        ("rejected".to_owned(), json!(end.rejected)),
        ("skipped".to_owned(), json!(end.skipped)),
        ("elapsed_s".to_owned(), json!(elapsed)),
        ("steps_per_second".to_owned(), json!(end.sent as f64 / elapsed.max(1e-9))),
    ]));
    Ok(Summary { sent: end.sent, rejected: end.rejected, value: Value::Object(value) })
}

/// Adds to a step the values whose bits differ from the last motion, or all values if there is none.
fn encode_changes(model: &Model, mut step: Step, last: Option<&Motion>, now: &Motion) -> Step {
    let same = |old: &[f32], new: &[f32]| old.iter().map(|x| x.to_bits()).eq(new.iter().map(|x| x.to_bits()));
    for (index, part) in model.parts.iter().enumerate() {
        let range = part.first..part.first + part.rank;
        let moved = last.is_none_or(|last| !same(&last.q[range.clone()], &now.q[range.clone()]));
        if part.owns_q && part.rank > 0 && moved {
            step.set_q(index as u32, &now.q[range]);
        }
        if last.is_none_or(|last| !same(&last.transforms[index], &now.transforms[index])) {
            step.set_transform(index as u32, &now.transforms[index]);
        }
    }
    step
}

impl RunStats {
    /// Records a refusal and returns whether there was one. Any other error is returned.
    fn record_rejection(&mut self, sent: modalcast_client::Result<()>) -> Result<bool> {
        match sent {
            Ok(()) => Ok(false),
            Err(ClientError::Rejected(refusal)) => {
                if self.rejections.len() < MAX_REJECTIONS {
                    self.rejections.push(refusal.to_string());
                }
                Ok(true)
            }
            Err(error) => Err(Error::Client(error)),
        }
    }

    fn add(&mut self, drive: &StepStream, bytes: usize) {
        self.bytes += bytes as u64;
        for ack in drive.take_acks() {
            self.acks += 1;
            self.stages.add(&ack.stages);
        }
    }

    fn report(self) -> ScenarioReport {
        ScenarioReport::from_iter([
            ("stages_ms".to_owned(), json!(self.stages.medians())),
            ("acknowledgements".to_owned(), json!(self.acks)),
            ("payload_bytes".to_owned(), json!(self.bytes)),
            ("rejections".to_owned(), json!(self.rejections)),
        ])
    }
}

/// A progress bar, or a counter for an unlimited run, on standard error; hidden unless standard error is a terminal.
fn progress(steps: Option<u64>) -> ProgressBar {
    let template = match steps {
        Some(_) => "steps [{bar:32}] {pos}/{len} {per_sec} eta {eta}",
        None => "{spinner} {pos} steps {per_sec}",
    };
    let bar = steps.map_or_else(ProgressBar::new_spinner, ProgressBar::new);
    bar.with_style(ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar()))
}

/// Records the coordinates and transforms of every step, so that results can be checked.
struct Recorder {
    q: Writer,
    transforms: Writer,
}

impl Recorder {
    fn create(folder: &Path, model: &Model) -> Result<Self> {
        std::fs::create_dir_all(folder).map_err(|fault| ClientError::file(folder, fault))?;
        let q = Writer::create(&folder.join("q.npy"), &[model.coordinates])?;
        let transforms = Writer::create(&folder.join("transforms.npy"), &[model.parts.len(), 12])?;
        Ok(Self { q, transforms })
    }

    fn add(&mut self, motion: &Motion) -> Result<()> {
        self.q.row(&motion.q)?;
        Ok(self.transforms.row(motion.transforms.as_flattened())?)
    }

    fn finish(self) -> Result<()> {
        self.q.finish()?;
        self.transforms.finish()?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hierarchy::tests::plant;

    #[test]
    fn first_step_sends_everything_and_later_ones_changes() {
        let model = plant();
        let still = Motion { q: vec![0.0; 6], transforms: vec![[0.0; 12]; 4] };
        let wire = |last, now| encode_changes(&model, Step::new(3, 0.5), last, now).to_wire();
        let first = wire(None, &still);
        assert_eq!((first.q_domains, first.transform_domains), (vec![0, 1, 2], vec![0, 1, 2, 3]));
        assert_eq!((first.q.len(), first.transforms.len()), (24, 192));
        let mut moved = still.clone();
        (moved.q[3], moved.transforms[3][7]) = (1.0, 2.0);
        let second = wire(Some(&still), &moved);
        assert_eq!((second.q_domains, second.transform_domains), (vec![1], vec![3]));
        let third = wire(Some(&moved), &moved);
        assert!(third.q.is_empty() && third.transforms.is_empty() && third.q_domains.is_empty());
    }
}
