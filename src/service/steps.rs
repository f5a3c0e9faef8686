//! `StepService`: one bidirectional stream per physics process. The task of the stream always reads, so that a slow
//! scene never blocks the connection. A step that cannot be accepted is answered with a rejection, and the stream
//! remains open.

use std::collections::VecDeque;

use modalcast_proto::v1;
use modalcast_proto::v1::drive_scene_request::Kind as RequestKind;
use modalcast_proto::v1::drive_scene_response::Kind as ResponseKind;
use tonic::{Request, Response, Status, Streaming};

use super::convert::{parse_policy, parse_step, wire_policy, wire_scene_info, wire_stages};
use super::status::{to_rejection, to_status, transport_status};
use super::stream::{Deadline, ReplySender, ReplyStream, respond};
use crate::engine::{Engine, StepReport, WriterSession};
use modalcast_model::error::{Error, Result, invalid};

/// Maximum number of replies that are buffered for a client that does not read. A further reply ends the stream with an
/// error.
const MAX_PENDING_REPLIES: usize = 256;

/// Implementation of `StepService`.
pub(super) struct StepServiceImpl(pub(super) Engine);

#[tonic::async_trait]
impl v1::step_service_server::StepService for StepServiceImpl {
    type DriveSceneStream = ReplyStream<v1::DriveSceneResponse>;

    async fn drive_scene(
        &self,
        request: Request<Streaming<v1::DriveSceneRequest>>,
    ) -> Result<Response<Self::DriveSceneStream>, Status> {
        let peer = request.remote_addr().map_or_else(|| "a local client".into(), |address| address.to_string());
        let deadline = Deadline::of_stream(request.metadata());
        let session = DriveSession {
            engine: self.0.clone(),
            peer,
            inbound: request.into_inner(),
            writer: None,
            replies: VecDeque::new(),
        };
        Ok(respond(move |reply_sender| deadline.enforce("the step stream", session.run(reply_sender))))
    }
}

/// The state of one step stream.
struct DriveSession {
    engine: Engine,
    /// Address of the client, for errors.
    peer: String,
    inbound: Streaming<v1::DriveSceneRequest>,
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
            let has_reply_capacity = self.replies.len() < MAX_PENDING_REPLIES;
            tokio::select! {
                message = self.inbound.message(), if is_receiving => match message {
                    Ok(Some(message)) => self.receive(message).await?,
                    Ok(None) => is_receiving = false,
                    Err(status) => return Err(transport_status(status, self.engine.config().message_bytes)),
                },
                report = next_report(self.writer.as_ref()), if has_reply_capacity => match report {
                    Ok(report) => self.replies.push_back(to_response(report)),
                    Err(error) => return self.close_with_error(&reply_sender, error).await,
                },
                permit = reply_sender.reserve(), if !self.replies.is_empty() => {
                    let permit = permit?;
                    if let Some(reply) = self.replies.pop_front() {
                        permit.send(Ok(reply));
                    }
                }
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
            Some(RequestKind::Open(open)) => self.open(open).await.err().map(|error| (None, error)),
            Some(RequestKind::Step(step)) => {
                let number = step.number;
                self.push_step(step).err().map(|error| (Some(number), error))
            }
            None => Some((None, invalid("kind", "open or step", "neither"))),
        };
        if let Some((step, error)) = rejected {
            self.push_reply(ResponseKind::Rejection(to_rejection(step, &error)))?;
        }
        Ok(())
    }

    async fn open(&mut self, open: v1::OpenDrive) -> Result<()> {
        if self.writer.is_some() {
            return Err(invalid("open", "one open per stream", format!("a second open, of '{}'", open.scene)));
        }
        let policy = parse_policy(open.policy)?;
        let scene_handle = self.engine.find(&open.scene)?;
        let window = if open.window == 0 { self.engine.config().window } else { open.window };
        let writer = scene_handle.drive(self.peer.clone(), policy, window).await?;
        let opened = v1::Opened {
            run: writer.run,
            policy: wire_policy(writer.policy).into(),
            window: writer.window,
            scene: Some(wire_scene_info(&scene_handle)),
        };
        self.writer = Some(writer);
        self.replies.push_back(v1::DriveSceneResponse { kind: Some(ResponseKind::Opened(opened)) });
        Ok(())
    }

    fn push_step(&mut self, step: v1::Step) -> Result<()> {
        match &mut self.writer {
            Some(writer) => writer.push_step(&parse_step(step)?),
            None => Err(invalid("kind", "open before the first step", "a step")),
        }
    }

    fn push_reply(&mut self, kind: ResponseKind) -> Result<(), Status> {
        if self.replies.len() >= MAX_PENDING_REPLIES {
            return Err(to_status(Error::Busy { queue: "replies not read by the client", limit: MAX_PENDING_REPLIES }));
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

/// Waits for the next report. Pends forever without a writer.
async fn next_report(writer: Option<&WriterSession>) -> Result<StepReport> {
    match writer {
        Some(writer) => writer.next_report().await,
        None => std::future::pending().await,
    }
}

fn to_response(report: StepReport) -> v1::DriveSceneResponse {
    let kind = match report {
        StepReport::Done { step, skipped, stages: times } => {
            ResponseKind::Ack(v1::Acknowledgement { step, skipped, stages: wire_stages(&times) })
        }
        StepReport::Rejected { step, error } => ResponseKind::Rejection(to_rejection(Some(step), &error)),
    };
    v1::DriveSceneResponse { kind: Some(kind) }
}
