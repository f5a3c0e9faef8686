//! `StepService`: one bidirectional stream per physics process. A stream with the overflow `Block` is not read while
//! its window is full, so that the flow control of HTTP/2 slows the client down. Every other stream is always read, and
//! a step that cannot be accepted is answered with a rejection. The stream remains open, but not without a writer lease.

use std::collections::VecDeque;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use modalcast_proto::v1;
use modalcast_proto::v1::drive_scene_request::Kind as RequestKind;
use modalcast_proto::v1::drive_scene_response::Kind as ResponseKind;
use tokio::sync::OwnedSemaphorePermit;
use tokio::time::Instant;
use tonic::{Request, Response, Status, Streaming};

use super::caller::Caller;
use super::connection::ConnectionInfo;
use super::convert::{parse_lease_request, parse_step, wire_opened, wire_stages, wire_step_id};
use super::shared_memory::SharedMemory;
use super::status::{to_rejection, to_status, transport_status};
use super::step_parts::StepAssembler;
use super::stream::{Deadline, ReplySender, ReplyStream, respond};
use crate::admission::PermitHandle;
use crate::config::Config;
use crate::engine::{Engine, SceneRight, StepReport, WriterSession};
use modalcast_model::error::{Error, Result};

/// Maximum number of replies that are buffered for a client that does not read. A further reply ends the stream with an
/// error.
const MAX_PENDING_REPLIES: usize = 256;

/// Number of buffered replies above which acknowledgments are merged.
const MAX_PENDING_ACKS: usize = 64;

/// Implementation of `StepService`.
pub(super) struct StepServiceImpl {
    pub(super) engine: Engine,
    pub(super) shared_memory: SharedMemory,
}

#[tonic::async_trait]
impl v1::step_service_server::StepService for StepServiceImpl {
    type DriveSceneStream = ReplyStream<v1::DriveSceneResponse>;

    async fn drive_scene(
        &self,
        request: Request<Streaming<v1::DriveSceneRequest>>,
    ) -> Result<Response<Self::DriveSceneStream>, Status> {
        let caller = Caller::of(&request)?;
        let connection = ConnectionInfo::of(&request).map_err(to_status)?;
        let drive_permit = connection.acquire_drive().map_err(to_status)?;
        let deadline = Deadline::of_stream(request.metadata());
        let memory = self.shared_memory.find(request.metadata(), &caller.principal).map_err(to_status)?;
        let replies = Arc::clone(&caller.replies);
        let session = DriveSession {
            engine: self.engine.clone(),
            caller,
            parts: StepAssembler::new(connection.receive.new_memory(), connection.receive.limits(), memory),
            _drive_permit: drive_permit,
            open_deadline: OpenDeadline::new(self.engine.config()),
            connection: connection.permit.clone(),
            inbound: request.into_inner(),
            right_ended: Box::pin(std::future::pending()),
            writer: None,
            replies: VecDeque::new(),
        };
        Ok(respond(replies, move |reply_sender| deadline.enforce("the step stream", session.run(reply_sender))))
    }

    async fn reset_scene(
        &self,
        request: Request<v1::ResetSceneRequest>,
    ) -> Result<Response<v1::ResetSceneResponse>, Status> {
        let caller = Caller::of(&request)?;
        let v1::ResetSceneRequest { scene, take_over } = request.into_inner();
        let reset = async {
            let scene_handle = self.engine.find_opened(&scene, &caller.principal, SceneRight::Control).await?;
            scene_handle.reset(&caller.peer, &caller.account, take_over).await
        };
        let step = caller.log_change("ResetScene", &scene, reset.await.map_err(to_status))?;
        Ok(Response::new(v1::ResetSceneResponse { step: Some(wire_step_id(step)) }))
    }
}

type BoxFuture<T> = Pin<Box<dyn Future<Output = T> + Send>>;

/// The state of one step stream.
struct DriveSession {
    engine: Engine,
    caller: Caller,
    /// Counts this stream among those of its connection.
    _drive_permit: OwnedSemaphorePermit,
    /// The time by which the writer lease must be acquired.
    open_deadline: OpenDeadline,
    /// The permit of the connection.
    connection: PermitHandle,
    inbound: Streaming<v1::DriveSceneRequest>,
    /// The step that is being received, if it has several parts.
    parts: StepAssembler,
    /// Completes when the caller loses the right to the scene. Pending until the writer lease is acquired.
    right_ended: BoxFuture<Error>,
    /// The writer lease, once it is acquired.
    writer: Option<WriterSession>,
    /// Replies that are not sent yet, oldest first.
    replies: VecDeque<v1::DriveSceneResponse>,
}

impl DriveSession {
    /// Reads requests and sends replies until the client has closed its side and all replies are sent.
    async fn run(mut self, reply_sender: ReplySender<v1::DriveSceneResponse>) -> Result<(), Status> {
        let mut is_receiving = true;
        loop {
            let is_drained = self.writer.as_ref().is_none_or(WriterSession::is_drained);
            if !is_receiving && is_drained && self.replies.is_empty() {
                return Ok(());
            }
            // Without capacity, reports wait in the step queue.
            let may_read = self.writer.as_ref().is_none_or(WriterSession::may_read_step);
            let next_reply_bytes = self.replies.front().map_or(0, prost::Message::encoded_len);
            let has_reply_capacity = self.replies.len() < MAX_PENDING_REPLIES;
            tokio::select! {
                message = self.inbound.message(), if is_receiving && may_read => match message {
                    Ok(Some(message)) => self.receive(message).await?,
                    Ok(None) => is_receiving = false,
                    Err(status) => return Err(transport_status(status, self.engine.config().message_bytes)),
                },
                error = self.parts.stalled(), if is_receiving && may_read => return Err(to_status(error)),
                report = next_report(self.writer.as_ref()), if has_reply_capacity => match report {
                    Ok(report) => self.push_report(report),
                    Err(error) => return self.close_with_error(&reply_sender, error).await,
                },
                permit = reply_sender.reserve(next_reply_bytes), if !self.replies.is_empty() => {
                    let permit = permit?;
                    if let Some(reply) = self.replies.pop_front() {
                        permit.send(reply)?;
                    }
                }
                error = self.open_deadline.passed(), if self.writer.is_none() => return Err(to_status(error)),
                error = &mut self.right_ended => return self.close_with_error(&reply_sender, error).await,
                () = reply_sender.closed() => return Ok(()),
            }
        }
    }

    /// Handles one message. Invalid input is answered with a rejection.
    ///
    /// # Errors
    /// `RESOURCE_EXHAUSTED` when the reply queue is full.
    async fn receive(&mut self, message: v1::DriveSceneRequest) -> Result<(), Status> {
        let rejected = match message.kind {
            Some(RequestKind::Open(open)) => {
                let rejected = self.open(open).await.err().map(|error| (None, error));
                self.open_deadline = OpenDeadline::new(self.engine.config());
                rejected
            }
            Some(RequestKind::Step(step)) => {
                let number = step.number;
                self.push_step(step).await.err().map(|error| (Some(number), error))
            }
            None => Some((None, Error::UnexpectedMessage { expected: "open or step", given: "an empty message" })),
        };
        if let Some((step, error)) = rejected {
            self.push_reply(ResponseKind::Rejection(to_rejection(step, &error)))?;
        }
        Ok(())
    }

    async fn open(&mut self, open: v1::OpenDrive) -> Result<()> {
        if self.writer.is_some() {
            return Err(Error::UnexpectedMessage { expected: "one open per stream", given: "a second open" });
        }
        let principal = &self.caller.principal;
        let right = if open.take_over { SceneRight::Control } else { SceneRight::Use };
        let scene_handle = self.engine.find_opened(&open.scene, principal, right).await?;
        let request = parse_lease_request(&open, &self.caller.account, self.engine.config())?;
        let writer = scene_handle.drive(&self.caller.peer, request.clone()).await?;
        let opened = wire_opened(&writer, &request, &scene_handle);
        self.right_ended = Box::pin(scene_handle.right_ended(principal, right));
        self.writer = Some(writer);
        self.connection.mark_progress();
        self.replies.push_back(v1::DriveSceneResponse { kind: Some(ResponseKind::Opened(opened)) });
        Ok(())
    }

    async fn push_step(&mut self, step: v1::Step) -> Result<()> {
        let Some(step) = self.parts.push(step)? else { return Ok(()) };
        match &mut self.writer {
            Some(writer) => writer.push_step(parse_step(step)?).await,
            None => Err(Error::UnexpectedMessage { expected: "open before the first step", given: "a step" }),
        }
    }

    /// Appends a report. An acknowledgment also covers all earlier steps. If many replies wait, the acknowledgment
    /// replaces one that is not sent yet. A client that reads nothing can therefore continue to send steps.
    fn push_report(&mut self, report: StepReport) {
        if matches!(report, StepReport::Done { .. }) {
            self.connection.mark_progress();
        }
        let durable_step = self.writer.as_ref().and_then(WriterSession::durable_step);
        let response = to_response(report, durable_step);
        let is_ack = |response: &v1::DriveSceneResponse| matches!(response.kind, Some(ResponseKind::Ack(_)));
        if self.replies.len() >= MAX_PENDING_ACKS && is_ack(&response) && self.replies.back().is_some_and(is_ack) {
            self.replies.pop_back();
        }
        self.replies.push_back(response);
    }

    fn push_reply(&mut self, kind: ResponseKind) -> Result<(), Status> {
        if self.replies.len() >= MAX_PENDING_REPLIES {
            return Err(to_status(Error::SlowReader { queue: "queue of replies", limit: MAX_PENDING_REPLIES }));
        }
        self.replies.push_back(v1::DriveSceneResponse { kind: Some(kind) });
        Ok(())
    }

    /// Ends the stream with an error. First sends the buffered replies, for at most half the drain time.
    async fn close_with_error(
        mut self,
        reply_sender: &ReplySender<v1::DriveSceneResponse>,
        error: Error,
    ) -> Result<(), Status> {
        let timeout = self.engine.config().drain_timeout / 2;
        let send_replies = async {
            while let Some(reply) = self.replies.pop_front() {
                reply_sender.send(reply).await?;
            }
            Ok::<(), Status>(())
        };
        // Send the error even if the client has not read all replies.
        tokio::time::timeout(timeout, send_replies).await.ok();
        Err(to_status(error))
    }
}

/// The time within which a stream must acquire the writer lease, from its begin or its last `open` on. Without it, streams
/// whose `open` is rejected would stay open.
#[derive(Debug, Clone, Copy)]
struct OpenDeadline {
    deadline: Instant,
    timeout: Duration,
}

impl OpenDeadline {
    fn new(config: &Config) -> Self {
        let timeout = config.first_request_timeout;
        Self { deadline: Instant::now() + timeout, timeout }
    }

    async fn passed(self) -> Error {
        tokio::time::sleep_until(self.deadline).await;
        Error::Deadline { what: "an open that is accepted".into(), ms: self.timeout.as_millis() as u64 }
    }
}

/// Waits for the next report. Pends forever without a writer.
async fn next_report(writer: Option<&WriterSession>) -> Result<StepReport> {
    match writer {
        Some(writer) => writer.next_report().await,
        None => std::future::pending().await,
    }
}

fn to_response(report: StepReport, durable_step: Option<u64>) -> v1::DriveSceneResponse {
    let kind = match report {
        StepReport::Done { step, skipped, stages: times } => {
            ResponseKind::Ack(v1::Acknowledgment { step, skipped, stages: wire_stages(&times), durable_step })
        }
        StepReport::Rejected { step, error } => ResponseKind::Rejection(to_rejection(Some(step), &error)),
    };
    v1::DriveSceneResponse { kind: Some(kind) }
}
