//! A step stream: sends steps, receives acknowledgements and refusals, and limits the steps in flight to the window.
//!
//! A separate task always reads the replies, because a stalled reader of many small messages would lose its connection.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use modalcast_proto::v1;
use tokio::sync::{mpsc, watch};
use tokio_stream::wrappers::ReceiverStream;
use v1::drive_scene_request::Kind as RequestKind;
use v1::drive_scene_response::Kind as ResponseKind;

use crate::assemble::Replies;
use crate::client::Client;
use crate::error::{Error, Rejection, Result, malformed_reply};
use crate::stages::{self, StageTimes};
use crate::step::Step;

/// The most acknowledgements, and the most refusals, that are kept until the caller takes them. Older ones are dropped;
/// [`StreamSummary::rejected`] counts all refusals.
const MAX_RETAINED: usize = 1024;

/// How the server handles steps that arrive faster than it processes them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Policy {
    /// Every step is deformed, in order, and rendered for each lossless subscriber.
    Lossless,
    /// Only the newest state is processed; steps in between are merged into it and counted.
    Latest,
}

/// One acknowledgement: all steps up to this one are done or merged into a newer one.
#[derive(Debug, Clone, PartialEq)]
pub struct Ack {
    pub step: u64,
    /// Number of steps merged into a newer one since the stream began.
    pub skipped: u64,
    pub stages: StageTimes,
}

/// Totals of a stream.
#[derive(Debug, Clone, PartialEq)]
pub struct StreamSummary {
    /// The last acknowledged step.
    pub acknowledged: Option<u64>,
    /// Number of steps sent, and how many of them the server refused.
    pub sent: u64,
    pub rejected: u64,
    /// Number of steps merged into a newer one.
    pub skipped: u64,
}

/// State shared between the reading task and the [`StepStream`].
#[derive(Default)]
struct Progress {
    outstanding: VecDeque<u64>,
    acknowledged: Option<u64>,
    skipped: u64,
    rejected: u64,
    acks: VecDeque<Ack>,
    rejections: VecDeque<Rejection>,
    ended: Option<Option<Error>>,
}

/// A step stream to one scene. Dropping it ends the stream and releases the scene.
pub struct StepStream {
    /// The number of this run; every new writer of the scene increments it.
    pub run: u64,
    /// The most steps in flight: sent and not yet acknowledged.
    pub window: usize,
    /// The scene at the time the stream opened.
    pub scene: v1::SceneInfo,
    requests: Option<mpsc::Sender<v1::DriveSceneRequest>>,
    progress: Arc<Mutex<Progress>>,
    changed: watch::Receiver<()>,
    reader: tokio::task::JoinHandle<()>,
    sent: u64,
}

impl Client {
    /// Becomes the writer of a scene. A `window` of 0 selects the server's default; [`StepStream::window`] is the granted
    /// window.
    ///
    /// # Errors
    /// `Rejected` or `Status` if the scene does not exist or has another writer.
    pub async fn drive(&self, scene: &str, policy: Policy, window: u32) -> Result<StepStream> {
        let policy = match policy {
            Policy::Lossless => v1::Policy::Lossless,
            Policy::Latest => v1::Policy::Latest,
        };
        let (requests, queue) = mpsc::channel(64);
        let open = v1::OpenDrive { scene: scene.to_owned(), policy: policy.into(), window };
        let opening = v1::DriveSceneRequest { kind: Some(RequestKind::Open(open)) };
        requests.send(opening).await.map_err(|_| Error::StreamEnded { what: "the stream opened" })?;
        let mut service = v1::step_service_client::StepServiceClient::new(self.channel.clone());
        let mut replies = self.replies(service.drive_scene(ReceiverStream::new(queue)).await)?;
        let opened = match replies.next().await?.and_then(|reply| reply.kind) {
            Some(ResponseKind::Opened(opened)) => opened,
            Some(ResponseKind::Rejection(rejection)) => return Err(Error::Rejected(Box::new(rejection.into()))),
            Some(ResponseKind::Ack(_)) => {
                return Err(malformed_reply("drive.opened", "`opened` first", "an acknowledgement"));
            }
            None => return Err(Error::StreamEnded { what: "the stream opened" }),
        };
        let progress = Arc::new(Mutex::new(Progress::default()));
        let (change, changed) = watch::channel(());
        let reader = tokio::spawn(read(replies, Arc::clone(&progress), change));
        Ok(StepStream {
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

impl StepStream {
    /// Sends a step as soon as the window has capacity.
    ///
    /// # Errors
    /// `Rejected` reports the oldest unreported refusal. It names the refused step, usually an earlier one; the step
    /// passed to this call has been sent and the stream stays open. `Step` means that the step passed to this call was
    /// not sent; the stream stays open. Every other error ends the stream.
    pub async fn step(&mut self, step: &Step) -> Result<()> {
        step.check()?;
        self.wait(|progress, window| progress.outstanding.len() < window).await?;
        lock(&self.progress).outstanding.push_back(step.number());
        let message = v1::DriveSceneRequest { kind: Some(RequestKind::Step(step.to_wire())) };
        let requests = self.requests.as_ref().ok_or(Error::StreamEnded { what: "this step" })?;
        if requests.send(message).await.is_err() {
            // The stream has ended; the reading task receives the reason.
            self.wait(|_, _| false).await?;
        }
        self.sent += 1;
        match lock(&self.progress).rejections.pop_front() {
            Some(rejection) => Err(Error::Rejected(Box::new(rejection))),
            None => Ok(()),
        }
    }

    /// Waits until every step sent so far is acknowledged or refused.
    ///
    /// # Errors
    /// `Rejected` with the oldest unreported refusal; every other error ends the stream.
    pub async fn flush(&mut self) -> Result<()> {
        self.wait(|progress, _| progress.outstanding.is_empty()).await?;
        match lock(&self.progress).rejections.pop_front() {
            Some(rejection) => Err(Error::Rejected(Box::new(rejection))),
            None => Ok(()),
        }
    }

    /// Takes the acknowledgements received since the last call, oldest first; at most 1024 are kept.
    pub fn take_acks(&self) -> Vec<Ack> {
        lock(&self.progress).acks.drain(..).collect()
    }

    /// Takes the unreported refusals, oldest first; at most 1024 are kept.
    pub fn take_rejections(&self) -> Vec<Rejection> {
        lock(&self.progress).rejections.drain(..).collect()
    }

    /// Number of steps in flight.
    pub fn outstanding(&self) -> usize {
        lock(&self.progress).outstanding.len()
    }

    /// Totals of the stream up to now.
    pub fn summary(&self) -> StreamSummary {
        let progress = lock(&self.progress);
        StreamSummary {
            acknowledged: progress.acknowledged,
            sent: self.sent,
            rejected: progress.rejected,
            skipped: progress.skipped,
        }
    }

    /// Waits for all acknowledgements, then ends the stream. Refusals are counted and are not errors.
    ///
    /// # Errors
    /// The error that ended the stream before all steps were acknowledged.
    pub async fn finish(mut self) -> Result<StreamSummary> {
        self.wait(|progress, _| progress.outstanding.is_empty()).await?;
        self.requests = None;
        // The server closes its side after it has released the scene. The timeout covers a server that does not.
        let closing = async { while self.changed.changed().await.is_ok() {} };
        tokio::time::timeout(Duration::from_secs(5), closing).await.ok();
        Ok(self.summary())
    }

    /// Waits until `enough` holds, or the stream has ended.
    async fn wait(&mut self, enough: impl Fn(&Progress, usize) -> bool) -> Result<()> {
        loop {
            // Mark the value as seen before reading it, so that a change in between wakes the wait below.
            self.changed.borrow_and_update();
            {
                let progress = lock(&self.progress);
                if let Some(end) = &progress.ended {
                    return Err(end.clone().unwrap_or(Error::StreamEnded { what: "the acknowledgement" }));
                }
                if enough(&progress, self.window) {
                    return Ok(());
                }
            }
            if self.changed.changed().await.is_err() && lock(&self.progress).ended.is_none() {
                return Err(Error::StreamEnded { what: "the acknowledgement" });
            }
        }
    }
}

impl Drop for StepStream {
    fn drop(&mut self) {
        self.reader.abort();
    }
}

/// Reads replies until the stream ends.
async fn read(mut replies: Replies<v1::DriveSceneResponse>, progress: Arc<Mutex<Progress>>, change: watch::Sender<()>) {
    loop {
        let reply = replies.next().await;
        let mut progress = lock(&progress);
        match reply {
            Ok(Some(reply)) => match reply.kind {
                Some(ResponseKind::Ack(ack)) => progress.acknowledge(ack),
                Some(ResponseKind::Rejection(rejection)) => progress.refuse(rejection.into()),
                Some(ResponseKind::Opened(_)) | None => {}
            },
            Ok(None) => progress.ended = Some(None),
            Err(error) => progress.ended = Some(Some(error)),
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
        push_bounded(
            &mut self.acks,
            Ack { step: ack.step, skipped: ack.skipped, stages: stages::from_wire(ack.stages) },
        );
    }

    /// Removes the refused step from the steps in flight. If several have its number, the oldest one is meant.
    fn refuse(&mut self, rejection: Rejection) {
        if let Some(at) = self.outstanding.iter().position(|step| Some(*step) == rejection.step) {
            self.outstanding.remove(at);
        }
        self.rejected += 1;
        push_bounded(&mut self.rejections, rejection);
    }
}

/// Appends to a bounded list and drops the oldest item of a full one.
fn push_bounded<T>(list: &mut VecDeque<T>, item: T) {
    if list.len() == MAX_RETAINED {
        list.pop_front();
    }
    list.push_back(item);
}

/// Locks the progress. No holder panics; if one did, the last written state would still be usable.
fn lock(progress: &Mutex<Progress>) -> MutexGuard<'_, Progress> {
    progress.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rejection(step: u64) -> Rejection {
        Rejection { step: Some(step), field: "q".into(), expected: "4 bytes".into(), given: "3 bytes".into() }
    }

    #[test]
    fn an_ack_covers_all_earlier_steps_and_a_refusal_covers_one() {
        let mut progress = Progress { outstanding: (0..6).collect(), ..Progress::default() };
        progress.refuse(rejection(4));
        assert_eq!(progress.outstanding, [0, 1, 2, 3, 5]);
        progress.acknowledge(v1::Acknowledgement { step: 3, skipped: 2, stages: vec![] });
        assert_eq!((progress.outstanding.make_contiguous(), progress.skipped), (&mut [5][..], 2));
        progress.refuse(rejection(9));
        assert_eq!((progress.outstanding.len(), progress.rejected), (1, 2));
    }

    #[test]
    fn untaken_refusals_are_bounded() {
        let mut progress = Progress::default();
        for step in 0..2 * MAX_RETAINED as u64 {
            progress.refuse(rejection(step));
        }
        assert_eq!((progress.rejections.len(), progress.rejected), (MAX_RETAINED, 2 * MAX_RETAINED as u64));
        assert_eq!(progress.rejections[0].step, Some(MAX_RETAINED as u64));
    }
}
