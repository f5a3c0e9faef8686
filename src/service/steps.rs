//! `StepService`: one bidirectional stream per physics process. The stream's task always reads, so that a slow scene
//! never blocks the connection. A step that cannot be accepted is answered with a rejection; the stream stays open.

use std::collections::VecDeque;

use modalcast_proto::v1;
use modalcast_proto::v1::drive_scene_request::Kind as RequestKind;
use modalcast_proto::v1::drive_scene_response::Kind as ResponseKind;
use tonic::{Request, Response, Status, Streaming};

use super::convert::{policy, raw_update, scene_info, stages, wire_policy};
use super::status::{rejection, status, transport_status};
use super::stream::{Deadline, ReplySender, ReplyStream, respond};
use crate::engine::{Engine, StepReport, WriterSession};
use modalcast_model::error::{Error, Result, invalid};

/// Replies that are buffered for a client that does not read. The stream ends with an error beyond this limit.
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
            drive: None,
            replies: VecDeque::new(),
        };
        Ok(respond(move |reply_sender| deadline.enforce("the end of the step stream", session.run(reply_sender))))
    }
}

/// The state of one step stream.
struct DriveSession {
    engine: Engine,
    peer: String,
    inbound: Streaming<v1::DriveSceneRequest>,
    /// The writer lease, once it is acquired.
    drive: Option<WriterSession>,
    replies: VecDeque<v1::DriveSceneResponse>,
}

impl DriveSession {
    /// Reads requests and sends replies until the client has closed its side and all replies are sent.
    async fn run(mut self, reply_sender: ReplySender<v1::DriveSceneResponse>) -> Result<(), Status> {
        let mut listens = true;
        loop {
            let is_drained = self.drive.as_ref().is_none_or(WriterSession::is_drained);
            if !listens && is_drained && self.replies.is_empty() {
                return Ok(());
            }
            let has_room = self.replies.len() < MAX_PENDING_REPLIES;
            tokio::select! {
                message = self.inbound.message(), if listens => match message {
                    Ok(Some(message)) => self.receive(message).await?,
                    Ok(None) => listens = false,
                    Err(fault) => return Err(transport_status(fault, self.engine.config().message_bytes)),
                },
                report = next_report(self.drive.as_ref()), if has_room => match report {
                    Ok(report) => self.replies.push_back(response_of(report)),
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

    /// Handles one message. Invalid input is answered with a rejection; only an overflow of the reply queue is an
    /// error.
    async fn receive(&mut self, message: v1::DriveSceneRequest) -> Result<(), Status> {
        let refused = match message.kind {
            Some(RequestKind::Open(open)) => self.open(open).await.err().map(|error| (None, error)),
            Some(RequestKind::Step(step)) => {
                let number = step.number;
                self.step(step).err().map(|error| (Some(number), error))
            }
            None => Some((None, invalid("kind", "open or step", "neither"))),
        };
        if let Some((step, error)) = refused {
            self.push(ResponseKind::Rejection(rejection(step, &error)))?;
        }
        Ok(())
    }

    async fn open(&mut self, open: v1::OpenDrive) -> Result<()> {
        if self.drive.is_some() {
            return Err(invalid("open", "one open per stream", format!("a second, of '{}'", open.scene)));
        }
        let policy = policy(open.policy)?;
        let scene_handle = self.engine.find(&open.scene)?;
        let window = if open.window == 0 { self.engine.config().window } else { open.window };
        let drive = scene_handle.drive(self.peer.clone(), policy, window).await?;
        let opened = v1::Opened {
            run: drive.run,
            policy: wire_policy(drive.policy).into(),
            window: drive.window,
            scene: Some(scene_info(&scene_handle, true)),
        };
        self.drive = Some(drive);
        self.replies.push_back(v1::DriveSceneResponse { kind: Some(ResponseKind::Opened(opened)) });
        Ok(())
    }

    fn step(&mut self, step: v1::Step) -> Result<()> {
        match &mut self.drive {
            Some(drive) => drive.step(&raw_update(step)?),
            None => Err(invalid("kind", "open, before any step", "a step")),
        }
    }

    fn push(&mut self, kind: ResponseKind) -> Result<(), Status> {
        if self.replies.len() >= MAX_PENDING_REPLIES {
            return Err(status(Error::Busy { queue: "replies not read by the client", limit: MAX_PENDING_REPLIES }));
        }
        self.replies.push_back(v1::DriveSceneResponse { kind: Some(kind) });
        Ok(())
    }

    /// Ends the stream with a server-side error. First sends the buffered replies, for at most half the drain time.
    async fn close_with_error(
        mut self,
        reply_sender: &ReplySender<v1::DriveSceneResponse>,
        error: Error,
    ) -> Result<(), Status> {
        let timeout = self.engine.config().drain_timeout / 2;
        let tell = async {
            while let Some(reply) = self.replies.pop_front() {
                reply_sender.send(reply).await?;
            }
            Ok::<(), Status>(())
        };
        // The error comes last, whether or not the client has read the replies.
        tokio::time::timeout(timeout, tell).await.ok();
        Err(status(error))
    }
}

/// Waits for the next report; pends forever without a writer lease.
async fn next_report(drive: Option<&WriterSession>) -> Result<StepReport> {
    match drive {
        Some(drive) => drive.next_report().await,
        None => std::future::pending().await,
    }
}

fn response_of(report: StepReport) -> v1::DriveSceneResponse {
    let kind = match report {
        StepReport::Done { step, skipped, stages: times } => {
            ResponseKind::Ack(v1::Acknowledgement { step, skipped, stages: stages(&times) })
        }
        StepReport::Rejected { step, error } => ResponseKind::Rejection(rejection(Some(step), &error)),
    };
    v1::DriveSceneResponse { kind: Some(kind) }
}
