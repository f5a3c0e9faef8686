//! A step stream: sends steps, receives acknowledgments and rejections, and limits the steps in flight to the window.
//!
//! A separate task reads the replies all the time, because the server closes a connection on which many small messages
//! stay unread.

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
use crate::request::Delivery;
use crate::shared_memory::StepMemory;
use crate::stages::{self, StageTimes};
use crate::step::Step;

/// Maximum number of acknowledgments, and of rejections, that are stored until the caller takes them. Older ones are
/// dropped; [`StreamSummary::rejected`] counts all rejections.
const MAX_STORED: usize = 1024;

/// Maximum number of steps that wait inside this process for the connection.
const QUEUED_STEPS: usize = 8;

/// The largest stall budget of a writer: a day.
pub const MAX_STALL_BUDGET: Duration = Duration::from_secs(86_400);

/// Rounds up to whole milliseconds, because 0 means that no duration is set.
fn wire_milliseconds(duration: Duration) -> u32 {
    u32::try_from(duration.as_nanos().div_ceil(1_000_000)).unwrap_or(u32::MAX)
}

/// Describes a step stream before it is opened.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DriveRequest {
    scene: String,
    delivery: Delivery,
    window: Option<u32>,
    stall_budget: Duration,
    lease_token: Vec<u8>,
    takes_over: bool,
    initial_state: v1::InitialState,
}

impl DriveRequest {
    /// A writer of the scene. The first step of the writer starts from the rest state. With [`Delivery::Lossless`],
    /// sending waits while the server has no capacity.
    pub fn new(scene: &str, delivery: Delivery) -> Self {
        Self {
            scene: scene.to_owned(),
            delivery,
            window: None,
            stall_budget: Duration::ZERO,
            lease_token: Vec::new(),
            takes_over: false,
            initial_state: v1::InitialState::Unspecified,
        }
    }

    /// Limits the steps in flight (sent and not yet acknowledged): [`StepStream::step`] waits for acknowledgments.
    /// 0 selects the server's default. The server may grant fewer. Without this call there is no window, and the server
    /// slows this client down by flow control instead.
    #[must_use]
    pub fn window(mut self, steps: u32) -> Self {
        self.window = Some(steps);
        self
    }

    /// Sets how long lossless readers may make this writer wait, up to [`MAX_STALL_BUDGET`]: a budget that is refilled by
    /// a tenth of the elapsed time. The server disconnects readers that exceed it. Zero selects the server's default,
    /// which is 2 s. With [`MAX_STALL_BUDGET`], a slow reader slows this writer down instead of missing steps.
    #[must_use]
    pub const fn stall_budget(mut self, budget: Duration) -> Self {
        self.stall_budget = budget;
        self
    }

    /// Replaces the writer that has this token, which is [`StepStream::lease_token`] of an earlier stream. If no other
    /// writer has driven the scene since, the first step starts from the current state.
    #[must_use]
    pub fn lease_token(mut self, token: &[u8]) -> Self {
        self.lease_token = token.to_vec();
        self
    }

    /// Replaces any writer of the scene.
    #[must_use]
    pub fn take_over(mut self) -> Self {
        self.takes_over = true;
        self
    }

    /// Lets the first step start from the rest state, also with the token of the last writer.
    #[must_use]
    pub fn reset(mut self) -> Self {
        self.initial_state = v1::InitialState::Reset;
        self
    }

    /// Lets the first step start from the current state, which may be that of another writer.
    #[must_use]
    pub fn keep_state(mut self) -> Self {
        self.initial_state = v1::InitialState::Keep;
        self
    }

    fn to_wire(&self) -> v1::OpenDrive {
        let overflow = if self.window.is_some() { v1::Overflow::Reject } else { v1::Overflow::Block };
        v1::OpenDrive {
            scene: self.scene.clone(),
            delivery: v1::Delivery::from(self.delivery).into(),
            overflow: overflow.into(),
            window: self.window.unwrap_or_default(),
            stall_budget_ms: wire_milliseconds(self.stall_budget),
            lease_token: self.lease_token.clone().into(),
            take_over: self.takes_over,
            initial_state: self.initial_state.into(),
        }
    }
}

/// One acknowledgment: the server has processed all steps up to `step`, or merged them into a newer step.
#[derive(Debug, Clone, PartialEq)]
pub struct Ack {
    pub step: u64,
    /// Number of steps merged into a newer step since the stream began.
    pub skipped: u64,
    pub stages: StageTimes,
    /// The newest step of this run that survives a crash of the server and a power loss.
    pub durable_step: Option<u64>,
}

/// Totals of a stream.
#[derive(Debug, Clone, PartialEq)]
pub struct StreamSummary {
    /// The last acknowledged step.
    pub acknowledged: Option<u64>,
    /// Number of sent steps.
    pub sent: u64,
    /// Number of sent steps that the server rejected.
    pub rejected: u64,
    /// Number of steps merged into a newer step.
    pub skipped: u64,
}

/// State shared between the reading task and the [`StepStream`].
#[derive(Default)]
struct Progress {
    /// Numbers of the steps in flight, oldest first.
    in_flight: VecDeque<u64>,
    /// The last acknowledged step.
    acknowledged: Option<u64>,
    skipped: u64,
    rejected: u64,
    /// Acknowledgments that the caller has not taken.
    acks: VecDeque<Ack>,
    /// Rejections that have not been reported to the caller.
    rejections: VecDeque<Rejection>,
    /// `None` while the stream is open. `Some(None)` after the server has closed it; `Some(Some(error))` after it has
    /// failed.
    end: Option<Option<Error>>,
}

/// A step stream to one scene. Dropping it ends the stream and releases the scene.
pub struct StepStream {
    /// The run of this writer; later writers of the server have larger runs.
    pub run: u64,
    /// Maximum number of steps in flight: sent and not yet acknowledged. `None` if the server slows this client down by
    /// flow control instead.
    pub window: Option<usize>,
    /// Identifies this writer: a later stream with this token replaces it at once, for example after a lost connection.
    pub lease_token: Vec<u8>,
    /// Whether the first step starts from the rest state instead of the current one.
    pub starts_from_rest: bool,
    /// The scene at the time the stream opened.
    pub scene: v1::SceneInfo,
    requests: Option<mpsc::Sender<v1::DriveSceneRequest>>,
    progress: Arc<Mutex<Progress>>,
    /// Notifies of changes of `progress`; closed when the reading task ends.
    progress_changes: watch::Receiver<()>,
    reader: tokio::task::JoinHandle<()>,
    sent: u64,
    /// The memory for large values, if this client uses shared memory.
    memory: Option<StepMemory>,
}

impl Client {
    /// Opens a step stream and makes this client the writer of the scene.
    ///
    /// # Errors
    /// `Rejected` or `Status` if the scene does not exist or has another writer.
    pub async fn drive(&self, request: &DriveRequest) -> Result<StepStream> {
        // When the queue is full, sending a step waits.
        let (requests, queue) = mpsc::channel(QUEUED_STEPS);
        let open_request = v1::DriveSceneRequest { kind: Some(RequestKind::Open(request.to_wire())) };
        requests
            .send(open_request)
            .await
            .map_err(|_| Error::StreamEnded { awaited_reply: "the reply to the open request" })?;
        let mut service = v1::step_service_client::StepServiceClient::new(self.undecoded_channel());
        let memory = self.call_memory().await?;
        let mut replies = self.replies(service.drive_scene(memory.request(ReceiverStream::new(queue))).await)?;
        let opened = match replies.next().await?.and_then(|reply| reply.kind) {
            Some(ResponseKind::Opened(opened)) => opened,
            Some(ResponseKind::Rejection(rejection)) => return Err(Error::Rejected(Box::new(rejection.into()))),
            Some(ResponseKind::Ack(_)) => {
                return Err(malformed_reply("drive.opened", "`opened` first", "an acknowledgment"));
            }
            None => return Err(Error::StreamEnded { awaited_reply: "the reply to the open request" }),
        };
        let progress = Arc::new(Mutex::new(Progress::default()));
        let (change_sender, progress_changes) = watch::channel(());
        let reader = tokio::spawn(read_replies(replies, Arc::clone(&progress), change_sender));
        Ok(StepStream {
            run: opened.run,
            window: request.window.map(|_| (opened.window as usize).max(1)),
            starts_from_rest: opened.initial_state() == v1::InitialState::Reset,
            lease_token: opened.lease_token.to_vec(),
            scene: opened.scene.unwrap_or_default(),
            requests: Some(requests),
            progress,
            progress_changes,
            reader,
            sent: 0,
            memory: memory.into_step_memory(),
        })
    }
}

impl StepStream {
    /// Sends a step as soon as the server or the window has capacity.
    ///
    /// # Errors
    /// `Rejected` reports the oldest unreported rejection. It names the rejected step, usually an earlier one; the step
    /// passed to this call has been sent and the stream stays open. `Step` means that the step passed to this call was
    /// not sent because its transforms have several formats; the stream stays open. Every other error ends the stream.
    pub async fn step(&mut self, step: &Step) -> Result<()> {
        step.check_formats()?;
        self.wait_until(|progress, window| window.is_none_or(|window| progress.in_flight.len() < window)).await?;
        lock(&self.progress).in_flight.push_back(step.number());
        for mut part in step.to_wire_parts() {
            if let Some(memory) = &mut self.memory {
                let end = wait_until(&self.progress, &mut self.progress_changes, |_| false);
                tokio::select! {
                    () = memory.share(&mut part) => {}
                    end = end => end?,
                }
            }
            let message = v1::DriveSceneRequest { kind: Some(RequestKind::Step(part)) };
            let requests =
                self.requests.as_ref().ok_or(Error::StreamEnded { awaited_reply: "the reply to this step" })?;
            if requests.send(message).await.is_err() {
                // The stream has ended; the reading task receives the reason.
                self.wait_until(|_, _| false).await?;
            }
        }
        self.sent += 1;
        self.report_rejection()
    }

    /// Waits until every step sent so far is acknowledged or rejected. Each call reports at most one rejection.
    ///
    /// # Errors
    /// `Rejected` with the oldest unreported rejection; every other error ends the stream.
    pub async fn flush(&mut self) -> Result<()> {
        self.wait_until(|progress, _| progress.in_flight.is_empty()).await?;
        self.report_rejection()
    }

    /// Takes the oldest unreported rejection and returns it as an error.
    fn report_rejection(&self) -> Result<()> {
        match lock(&self.progress).rejections.pop_front() {
            Some(rejection) => Err(Error::Rejected(Box::new(rejection))),
            None => Ok(()),
        }
    }

    /// Takes the acknowledgments received since the last call, oldest first; at most 1024 are stored.
    pub fn take_acks(&self) -> Vec<Ack> {
        lock(&self.progress).acks.drain(..).collect()
    }

    /// Takes the unreported rejections, oldest first; at most 1024 are stored.
    pub fn take_rejections(&self) -> Vec<Rejection> {
        lock(&self.progress).rejections.drain(..).collect()
    }

    /// Number of steps in flight.
    pub fn in_flight_count(&self) -> usize {
        lock(&self.progress).in_flight.len()
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

    /// Waits for all acknowledgments, then ends the stream. Rejections are counted and are not errors.
    ///
    /// # Errors
    /// The error that ended the stream. A stream that has already ended is an error even if all steps are acknowledged.
    pub async fn finish(mut self) -> Result<StreamSummary> {
        self.wait_until(|progress, _| progress.in_flight.is_empty()).await?;
        self.requests = None;
        // The server closes its side after it has released the scene. The timeout ends the wait for a server that never
        // does.
        let reader_end = async { while self.progress_changes.changed().await.is_ok() {} };
        tokio::time::timeout(Duration::from_secs(5), reader_end).await.ok();
        Ok(self.summary())
    }

    /// Waits until `condition` holds for the progress and the window. Fails if the stream has ended.
    async fn wait_until(&mut self, condition: impl Fn(&Progress, Option<usize>) -> bool) -> Result<()> {
        let window = self.window;
        wait_until(&self.progress, &mut self.progress_changes, |progress| condition(progress, window)).await
    }
}

/// Waits until `condition` holds for the progress. Fails if the stream has ended.
async fn wait_until(
    progress: &Mutex<Progress>,
    changes: &mut watch::Receiver<()>,
    condition: impl Fn(&Progress) -> bool,
) -> Result<()> {
    loop {
        // Mark the last change as seen before `progress` is read, so that a later change ends the wait below.
        changes.borrow_and_update();
        {
            let progress = lock(progress);
            if let Some(end) = &progress.end {
                return Err(end
                    .clone()
                    .unwrap_or(Error::StreamEnded { awaited_reply: "the acknowledgment of a step" }));
            }
            if condition(&progress) {
                return Ok(());
            }
        }
        if changes.changed().await.is_err() && lock(progress).end.is_none() {
            return Err(Error::StreamEnded { awaited_reply: "the acknowledgment of a step" });
        }
    }
}

impl Drop for StepStream {
    fn drop(&mut self) {
        self.reader.abort();
    }
}

/// Reads replies until the stream ends.
async fn read_replies(
    mut replies: Replies<v1::DriveSceneResponse>,
    progress: Arc<Mutex<Progress>>,
    change_sender: watch::Sender<()>,
) {
    loop {
        let reply = replies.next().await;
        let mut progress = lock(&progress);
        match reply {
            Ok(Some(reply)) => match reply.kind {
                Some(ResponseKind::Ack(ack)) => progress.acknowledge(ack),
                Some(ResponseKind::Rejection(rejection)) => progress.reject(rejection.into()),
                Some(ResponseKind::Opened(_)) | None => {}
            },
            Ok(None) => progress.end = Some(None),
            Err(error) => progress.end = Some(Some(error)),
        }
        change_sender.send_replace(());
        if progress.end.is_some() {
            return;
        }
    }
}

impl Progress {
    fn acknowledge(&mut self, ack: v1::Acknowledgment) {
        self.in_flight.retain(|step| *step > ack.step);
        self.acknowledged = self.acknowledged.max(Some(ack.step));
        self.skipped = ack.skipped;
        push_bounded(
            &mut self.acks,
            Ack {
                step: ack.step,
                skipped: ack.skipped,
                stages: stages::from_wire(ack.stages),
                durable_step: ack.durable_step,
            },
        );
    }

    /// Removes the rejected step from the steps in flight. If several steps in flight have its number, removes the
    /// oldest of them.
    fn reject(&mut self, rejection: Rejection) {
        if let Some(index) = self.in_flight.iter().position(|step| Some(*step) == rejection.step) {
            self.in_flight.remove(index);
        }
        self.rejected += 1;
        push_bounded(&mut self.rejections, rejection);
    }
}

/// Appends to a bounded list and drops the oldest item of a full one.
fn push_bounded<T>(list: &mut VecDeque<T>, item: T) {
    if list.len() == MAX_STORED {
        list.pop_front();
    }
    list.push_back(item);
}

/// Locks the progress, also after a panic of another holder. Each field stays valid if a panic interrupts an update.
fn lock(progress: &Mutex<Progress>) -> MutexGuard<'_, Progress> {
    progress.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::Reason;

    fn rejection(step: u64) -> Rejection {
        Rejection {
            step: Some(step),
            reason: Reason::InvalidField,
            field: "q".into(),
            expected: "4 bytes".into(),
            given: "3 bytes".into(),
        }
    }

    #[test]
    fn stall_budget_is_sent_in_milliseconds_rounded_up() {
        let sent = |budget| DriveRequest::new("toy", Delivery::Lossless).stall_budget(budget).to_wire().stall_budget_ms;
        assert_eq!((sent(Duration::ZERO), sent(Duration::from_nanos(1))), (0, 1));
        assert_eq!((sent(MAX_STALL_BUDGET), sent(Duration::MAX)), (86_400_000, u32::MAX));
        assert_eq!(DriveRequest::new("toy", Delivery::Lossless).to_wire().stall_budget_ms, 0);
    }

    #[test]
    fn ack_removes_all_earlier_steps_and_rejection_removes_one() {
        let mut progress = Progress { in_flight: (0..6).collect(), ..Progress::default() };
        progress.reject(rejection(4));
        assert_eq!(progress.in_flight, [0, 1, 2, 3, 5]);
        progress.acknowledge(v1::Acknowledgment { step: 3, skipped: 2, ..Default::default() });
        assert_eq!((progress.in_flight.make_contiguous(), progress.skipped), (&mut [5][..], 2));
        progress.reject(rejection(9));
        assert_eq!((progress.in_flight.len(), progress.rejected), (1, 2));
    }

    #[test]
    fn number_of_stored_rejections_is_bounded() {
        let mut progress = Progress::default();
        for step in 0..2 * MAX_STORED as u64 {
            progress.reject(rejection(step));
        }
        assert_eq!((progress.rejections.len(), progress.rejected), (MAX_STORED, 2 * MAX_STORED as u64));
        assert_eq!(progress.rejections[0].step, Some(MAX_STORED as u64));
    }
}
