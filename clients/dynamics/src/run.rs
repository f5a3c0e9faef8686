//! A scenario to a step stream: only what changed is sent; records, pace and a summary.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};
use modalcast_client::npy::Writer;
use modalcast_client::{Ack, Client, Drive, Error as ClientError, Policy, Step};
use serde_json::{Value, json};
use tokio::sync::watch;

use crate::error::{Error, Result};
use crate::model::Model;

/// What a scenario says of itself at the end, by name.
pub type Report = serde_json::Map<String, Value>;

/// How many times per stage, and refusals, are kept for the summary.
const KEPT: usize = 1 << 16;
const REFUSALS: usize = 16;

/// All coordinates, and `world_from_domain` of every part, row-major 3x4.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Motion {
    pub q: Vec<f32>,
    pub transforms: Vec<[f32; 12]>,
}

/// Something that moves.
pub trait Scenario {
    /// What is moved.
    fn model(&self) -> &Model;

    /// The motion at a step; called with 0, 1, 2 and so on.
    ///
    /// # Errors
    /// When the motion cannot go on.
    fn at(&mut self, number: u64, motion: &mut Motion) -> Result<()>;

    /// Load, peaks and gaps up to now.
    fn report(&self) -> Report;
}

/// How to run.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// None runs until it is stopped.
    pub steps: Option<u64>,
    /// Seconds per step.
    pub dt: f64,
    pub policy: Policy,
    /// Steps without acknowledgement; 0 leaves it to the server.
    pub window: u32,
    /// Keep pace with the clock.
    pub realtime: bool,
    /// A folder for q.npy (steps x coordinates) and transforms.npy (steps x domains x 12).
    pub record: Option<PathBuf>,
}

/// What a run came to.
#[derive(Debug, Clone)]
pub struct Summary {
    pub sent: u64,
    pub refused: u64,
    pub value: Value,
}

/// What the acknowledgements said.
#[derive(Default)]
struct Tally {
    stages: BTreeMap<String, Vec<f32>>,
    refusals: Vec<String>,
    acks: u64,
    bytes: u64,
}

/// Drives a scene until the steps are done or `stop` turns true.
///
/// # Errors
/// `Client` when the scene is taken, the stream ends or a record cannot be written.
pub async fn run(
    client: &Client,
    scenario: &mut dyn Scenario,
    options: &Options,
    stop: &watch::Receiver<bool>,
) -> Result<Summary> {
    let scene = scenario.model().scene.clone();
    let mut drive = client.drive(&scene, options.policy, options.window).await?;
    let mut record = options.record.as_deref().map(|folder| Record::create(folder, scenario.model())).transpose()?;
    let (bar, start, mut tally) = (progress(options.steps), Instant::now(), Tally::default());
    let mut last: Option<Motion> = None;
    let mut motion = Motion::default();
    let mut number = 0;
    while options.steps.is_none_or(|steps| number < steps) && !*stop.borrow() {
        scenario.at(number, &mut motion)?;
        if options.realtime {
            let due = start + Duration::try_from_secs_f64(number as f64 * options.dt).unwrap_or(Duration::MAX / 4);
            tokio::time::sleep_until(due.into()).await;
        }
        let step = changed(scenario.model(), number, number as f64 * options.dt, (last.as_ref(), &motion));
        let refused = tally.note(drive.step(&step).await)?;
        tally.add(&drive, step.payload());
        if let Some(record) = &mut record {
            record.add(&motion)?;
        }
        // After a refusal the server lacks what that step carried: everything is sent again.
        last = if refused { None } else { Some(std::mem::take(&mut motion)) };
        number += 1;
        bar.inc(1);
    }
    while tally.note(drive.settle().await)? {}
    tally.add(&drive, 0);
    let run = drive.run;
    let window = drive.window;
    let end = drive.finish().await?;
    record.map(Record::finish).transpose()?;
    bar.finish_and_clear();
    let elapsed = start.elapsed().as_secs_f64();
    let mut value = scenario.report();
    value.extend(tally.report());
    value.extend(Report::from_iter([
        ("scene".to_owned(), json!(scene)),
        ("run".to_owned(), json!(run)),
        ("window".to_owned(), json!(window)),
        ("dt_s".to_owned(), json!(options.dt)),
        ("steps_sent".to_owned(), json!(end.sent)),
        ("last_acknowledged".to_owned(), json!(end.acknowledged)),
        ("rejected".to_owned(), json!(end.refused)),
        ("skipped".to_owned(), json!(end.skipped)),
        ("elapsed_s".to_owned(), json!(elapsed)),
        ("steps_per_second".to_owned(), json!(end.sent as f64 / elapsed.max(1e-9))),
    ]));
    Ok(Summary { sent: end.sent, refused: end.refused, value: Value::Object(value) })
}

/// The step with what differs from the last one, bit by bit; all of it the first time.
fn changed(model: &Model, number: u64, time: f64, (last, now): (Option<&Motion>, &Motion)) -> Step {
    let mut step = Step::new(number, time);
    let same = |old: &[f32], new: &[f32]| old.iter().map(|x| x.to_bits()).eq(new.iter().map(|x| x.to_bits()));
    for (index, part) in model.parts.iter().enumerate() {
        let range = part.first..part.first + part.rank;
        let moved = last.is_none_or(|last| !same(&last.q[range.clone()], &now.q[range.clone()]));
        if part.owner && part.rank > 0 && moved {
            step.set_q(index as u32, &now.q[range]);
        }
        if last.is_none_or(|last| !same(&last.transforms[index], &now.transforms[index])) {
            step.set_transform(index as u32, &now.transforms[index]);
        }
    }
    step
}

impl Tally {
    /// Notes a refusal and goes on; whether there was one. Any other error is the end.
    fn note(&mut self, sent: modalcast_client::Result<()>) -> Result<bool> {
        match sent {
            Ok(()) => Ok(false),
            Err(ClientError::Rejected(refusal)) => {
                if self.refusals.len() < REFUSALS {
                    self.refusals.push(refusal.to_string());
                }
                Ok(true)
            }
            Err(error) => Err(Error::Client(error)),
        }
    }

    fn add(&mut self, drive: &Drive, bytes: usize) {
        self.bytes += bytes as u64;
        for Ack { stages, .. } in drive.take_acks() {
            self.acks += 1;
            for (stage, milliseconds) in stages {
                let times = self.stages.entry(stage).or_default();
                if times.len() < KEPT {
                    times.push(milliseconds);
                }
            }
        }
    }

    fn report(mut self) -> Report {
        let medians: BTreeMap<_, _> = self.stages.iter_mut().map(|(stage, times)| (stage, median(times))).collect();
        Report::from_iter([
            ("stages_ms".to_owned(), json!(medians)),
            ("acknowledgements".to_owned(), json!(self.acks)),
            ("payload_bytes".to_owned(), json!(self.bytes)),
            ("rejections".to_owned(), json!(self.refusals)),
        ])
    }
}

/// The middle of some times; 0 of none.
fn median(times: &mut [f32]) -> f32 {
    times.sort_by(f32::total_cmp);
    times.get(times.len() / 2).copied().unwrap_or(0.0)
}

/// A bar (or, without end, a counter) on standard error; hidden when that is no terminal.
fn progress(steps: Option<u64>) -> ProgressBar {
    let template = match steps {
        Some(_) => "steps [{bar:32}] {pos}/{len} {per_sec} eta {eta}",
        None => "{spinner} {pos} steps {per_sec}",
    };
    let bar = steps.map_or_else(ProgressBar::new_spinner, ProgressBar::new);
    bar.with_style(ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar()))
}

/// Every step's coordinates and transforms, for whoever checks what came of them.
struct Record {
    q: Writer,
    transforms: Writer,
}

impl Record {
    fn create(folder: &Path, model: &Model) -> Result<Self> {
        std::fs::create_dir_all(folder).map_err(|fault| ClientError::file(folder, fault))?;
        let q = Writer::create(&folder.join("q.npy"), &[model.coordinates])?;
        let transforms = Writer::create(&folder.join("transforms.npy"), &[model.parts.len(), 12])?;
        Ok(Self { q, transforms })
    }

    fn add(&mut self, motion: &Motion) -> Result<()> {
        self.q.row(&motion.q)?;
        Ok(self.transforms.row(&motion.transforms.concat())?)
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
    fn only_what_changed_is_sent_and_everything_the_first_time() {
        let model = plant();
        let still = Motion { q: vec![0.0; 6], transforms: vec![[0.0; 12]; 4] };
        let wire = |last, now| changed(&model, 3, 0.5, (last, now)).to_wire();
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
