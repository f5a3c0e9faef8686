//! A step stream: steps out, acknowledgements and refusals in, never more steps in flight than the window allows.
//!
//! A task of its own always reads the replies: a stalled reader of many small messages would lose its connection.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use modalcast_proto::v1;
use tokio::sync::{mpsc, watch};
use tokio_stream::wrappers::ReceiverStream;
use v1::drive_scene_request::Kind as Ask;
use v1::drive_scene_response::Kind as Answer;

use crate::client::Client;
use crate::error::{Error, Refusal, Result, malformed};
use crate::frames::{Stages, stages};
use crate::step::Step;

/// How many acknowledgements and refusals are kept until somebody takes them; older ones are dropped and counted.
const KEPT: usize = 1024;

/// What the server does with steps that come faster than it works.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Policy {
    /// Every step is deformed, in order, and rendered for each lossless subscriber.
    Lossless,
    /// The newest state wins; steps in between are merged and counted.
    Latest,
}

/// One acknowledgement: all steps up to this one are done or superseded.
#[derive(Debug, Clone, PartialEq)]
pub struct Ack {
    pub step: u64,
    /// Steps merged into a newer one since the stream began.
    pub skipped: u64,
    pub stages: Stages,
}

/// What a finished stream came to.
#[derive(Debug, Clone, PartialEq)]
pub struct Finished {
    /// The last step that was acknowledged.
    pub acknowledged: Option<u64>,
    /// Steps that were sent, and those of them that were refused.
    pub sent: u64,
    pub refused: u64,
    /// Steps merged into a newer one.
    pub skipped: u64,
}

/// What the reading task knows.
#[derive(Default)]
struct Progress {
    outstanding: VecDeque<u64>,
    acknowledged: Option<u64>,
    skipped: u64,
    refused: u64,
    acks: VecDeque<Ack>,
    refusals: VecDeque<Refusal>,
    ended: Option<Option<Error>>,
}

/// A step stream to one scene. Dropping it ends the stream and releases the scene.
pub struct Drive {
    /// Counts the writers that the scene has had.
    pub run: u64,
    /// How many steps may be without acknowledgement.
    pub window: usize,
    /// The scene as it was when the stream opened.
    pub scene: v1::SceneInfo,
    requests: Option<mpsc::Sender<v1::DriveSceneRequest>>,
    progress: Arc<Mutex<Progress>>,
    changed: watch::Receiver<()>,
    reader: tokio::task::JoinHandle<()>,
    sent: u64,
}

impl Client {
    /// Becomes the writer of a scene. A `window` of 0 leaves it to the server; [`Drive::window`] says what holds.
    ///
    /// # Errors
    /// `Rejected` or `Refused` when there is no such scene or another writer holds it.
    pub async fn drive(&self, scene: &str, policy: Policy, window: u32) -> Result<Drive> {
        let policy = match policy {
            Policy::Lossless => v1::Policy::Lossless,
            Policy::Latest => v1::Policy::Latest,
        };
        let (requests, queue) = mpsc::channel(64);
        let open = v1::OpenDrive { scene: scene.to_owned(), policy: policy.into(), window };
        let opening = v1::DriveSceneRequest { kind: Some(Ask::Open(open)) };
        requests.send(opening).await.map_err(|_| Error::Ended { what: "the stream opened" })?;
        let mut service = v1::step_service_client::StepServiceClient::new(self.channel.clone());
        let mut replies = service.drive_scene(ReceiverStream::new(queue)).await?.into_inner();
        let opened = match replies.message().await?.and_then(|reply| reply.kind) {
            Some(Answer::Opened(opened)) => opened,
            Some(Answer::Rejection(refusal)) => return Err(Error::Rejected(Box::new(refusal.into()))),
            Some(Answer::Ack(_)) => return Err(malformed("drive.opened", "`opened` first", "an acknowledgement")),
            None => return Err(Error::Ended { what: "the stream opened" }),
        };
        let progress = Arc::new(Mutex::new(Progress::default()));
        let (change, changed) = watch::channel(());
        let reader = tokio::spawn(read(replies, Arc::clone(&progress), change));
        Ok(Drive {
            run: opened.run,
            window: (opened.window as usize).max(1),
            scene: opened.scene.unwrap_or_default(),
            requests: Some(requests),
            progress,
            changed,
            reader,
            sent: 0,
        })
    }
}

impl Drive {
    /// Sends a step as soon as the window has room.
    ///
    /// # Errors
    /// `Rejected` reports the oldest refusal not reported yet. It names the step that was refused, usually an earlier
    /// one; the step at hand has been sent and the stream goes on. `Step` says that the step at hand was not sent, and
    /// the stream goes on, too. Every other error is the end of the stream.
    pub async fn step(&mut self, step: &Step) -> Result<()> {
        step.check()?;
        self.wait(|progress, window| progress.outstanding.len() < window).await?;
        lock(&self.progress).outstanding.push_back(step.number());
        let message = v1::DriveSceneRequest { kind: Some(Ask::Step(step.to_wire())) };
        let requests = self.requests.as_ref().ok_or(Error::Ended { what: "this step" })?;
        if requests.send(message).await.is_err() {
            // The stream is gone; the reader knows why in a moment.
            self.wait(|_, _| false).await?;
        }
        self.sent += 1;
        match lock(&self.progress).refusals.pop_front() {
            Some(refusal) => Err(Error::Rejected(Box::new(refusal))),
            None => Ok(()),
        }
    }

    /// Waits until every step sent so far is acknowledged or refused.
    ///
    /// # Errors
    /// `Rejected` with the oldest refusal not reported yet; every other error is the end of the stream.
    pub async fn settle(&mut self) -> Result<()> {
        self.wait(|progress, _| progress.outstanding.is_empty()).await?;
        match lock(&self.progress).refusals.pop_front() {
            Some(refusal) => Err(Error::Rejected(Box::new(refusal))),
            None => Ok(()),
        }
    }

    /// Takes the acknowledgements that came since the last call, oldest first; at most 1024 are kept.
    pub fn take_acks(&self) -> Vec<Ack> {
        lock(&self.progress).acks.drain(..).collect()
    }

    /// Takes the refusals that no call has reported yet, oldest first; at most 1024 are kept.
    pub fn take_refusals(&self) -> Vec<Refusal> {
        lock(&self.progress).refusals.drain(..).collect()
    }

    /// Steps without acknowledgement.
    pub fn outstanding(&self) -> usize {
        lock(&self.progress).outstanding.len()
    }

    /// What the stream came to up to now.
    pub fn so_far(&self) -> Finished {
        let progress = lock(&self.progress);
        Finished {
            acknowledged: progress.acknowledged,
            sent: self.sent,
            refused: progress.refused,
            skipped: progress.skipped,
        }
    }

    /// Waits for all acknowledgements, then ends the stream. Refusals are counted, not errors.
    ///
    /// # Errors
    /// Whatever ended the stream before all was acknowledged.
    pub async fn finish(mut self) -> Result<Finished> {
        self.wait(|progress, _| progress.outstanding.is_empty()).await?;
        self.requests = None;
        // The server ends its side when it has released the scene; one that forgets to is not waited for.
        let closing = async { while self.changed.changed().await.is_ok() {} };
        tokio::time::timeout(Duration::from_secs(5), closing).await.ok();
        Ok(self.so_far())
    }

    /// Waits until `enough` holds, or the stream has ended.
    async fn wait(&mut self, enough: impl Fn(&Progress, usize) -> bool) -> Result<()> {
        loop {
            // Marking as seen before looking: a change in between wakes the wait below at once.
            self.changed.borrow_and_update();
            {
                let progress = lock(&self.progress);
                if let Some(end) = &progress.ended {
                    return Err(end.clone().unwrap_or(Error::Ended { what: "the acknowledgement" }));
                }
                if enough(&progress, self.window) {
                    return Ok(());
                }
            }
            if self.changed.changed().await.is_err() && lock(&self.progress).ended.is_none() {
                return Err(Error::Ended { what: "the acknowledgement" });
            }
        }
    }
}

impl Drop for Drive {
    fn drop(&mut self) {
        self.reader.abort();
    }
}

/// Reads replies until the stream ends.
async fn read(
    mut replies: tonic::Streaming<v1::DriveSceneResponse>,
    progress: Arc<Mutex<Progress>>,
    change: watch::Sender<()>,
) {
    loop {
        let reply = replies.message().await;
        let mut progress = lock(&progress);
        match reply {
            Ok(Some(reply)) => match reply.kind {
                Some(Answer::Ack(ack)) => progress.acknowledge(ack),
                Some(Answer::Rejection(refusal)) => progress.refuse(refusal.into()),
                Some(Answer::Opened(_)) | None => {}
            },
            Ok(None) => progress.ended = Some(None),
            Err(status) => progress.ended = Some(Some(status.into())),
        }
        change.send_replace(());
        if progress.ended.is_some() {
            return;
        }
    }
}

impl Progress {
    fn acknowledge(&mut self, ack: v1::Acknowledgement) {
        self.outstanding.retain(|step| *step > ack.step);
        self.acknowledged = self.acknowledged.max(Some(ack.step));
        self.skipped = ack.skipped;
        keep(&mut self.acks, Ack { step: ack.step, skipped: ack.skipped, stages: stages(ack.stages) });
    }

    /// A refused step is answered. Several may bear its number: the oldest was meant.
    fn refuse(&mut self, refusal: Refusal) {
        if let Some(at) = self.outstanding.iter().position(|step| Some(*step) == refusal.step) {
            self.outstanding.remove(at);
        }
        self.refused += 1;
        keep(&mut self.refusals, refusal);
    }
}

/// Adds to a bounded list; the oldest makes room.
fn keep<T>(list: &mut VecDeque<T>, item: T) {
    if list.len() == KEPT {
        list.pop_front();
    }
    list.push_back(item);
}

/// The lock. Nobody panics while holding it, and a half-told story is still the best there is.
fn lock(progress: &Mutex<Progress>) -> MutexGuard<'_, Progress> {
    progress.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refusal(step: u64) -> Refusal {
        Refusal { step: Some(step), field: "q".into(), expected: "4 bytes".into(), given: "3 bytes".into() }
    }

    #[test]
    fn an_acknowledgement_covers_all_steps_before_it_and_a_refusal_one() {
        let mut progress = Progress { outstanding: (0..6).collect(), ..Progress::default() };
        progress.refuse(refusal(4));
        assert_eq!(progress.outstanding, [0, 1, 2, 3, 5]);
        progress.acknowledge(v1::Acknowledgement { step: 3, skipped: 2, stages: vec![] });
        assert_eq!((progress.outstanding.make_contiguous(), progress.skipped), (&mut [5][..], 2));
        progress.refuse(refusal(9));
        assert_eq!((progress.outstanding.len(), progress.refused), (1, 2));
    }

    #[test]
    fn what_nobody_takes_is_bounded() {
        let mut progress = Progress::default();
        for step in 0..2 * KEPT as u64 {
            progress.refuse(refusal(step));
        }
        assert_eq!((progress.refusals.len(), progress.refused), (KEPT, 2 * KEPT as u64));
        assert_eq!(progress.refusals[0].step, Some(KEPT as u64));
    }
}
