//! `ViewService`: draws batches of small views of worlds that belong to the call. Views are drawn in pieces, and sent in
//! chunks. While a piece is sent, the next one is drawn and one waits.

use std::sync::Arc;

use modalcast_proto::v1;
use modalcast_proto::v1::draw_views_request::Kind as RequestKind;
use modalcast_proto::v1::draw_views_response::Part;
use tokio::sync::{OwnedSemaphorePermit, mpsc};
use tonic::{Request, Response, Status, Streaming};

use super::caller::Caller;
use super::connection::ConnectionInfo;
use super::convert::{
    parse_view_settings, parse_view_update, wire_device_slots, wire_frame_output, wire_stages, wire_views_opened,
};
use super::shared_memory::{CallMemory, DeviceMemory, SharedMemory};
use super::status::{to_rejection, to_status, transport_status};
use super::step_parts::StepAssembler;
use super::stream::{Deadline, ReplySender, ReplyStream, respond, run_while_permitted, split_into_chunks};
use crate::admission::PermitHandle;
use crate::engine::{DrawnViews, Engine, PendingViews, SceneRight, ViewSession, ViewStep};
use crate::telemetry::StageTimes;
use modalcast_model::error::{Error, Result, fault, invalid};

/// Implementation of `ViewService`.
pub(super) struct ViewServiceImpl {
    pub(super) engine: Engine,
    pub(super) shared_memory: SharedMemory,
}

#[tonic::async_trait]
impl v1::view_service_server::ViewService for ViewServiceImpl {
    type DrawViewsStream = ReplyStream<v1::DrawViewsResponse>;

    async fn draw_views(
        &self,
        request: Request<Streaming<v1::DrawViewsRequest>>,
    ) -> Result<Response<Self::DrawViewsStream>, Status> {
        let deadline = Deadline::of_stream(request.metadata());
        let caller = Caller::of(&request)?;
        let connection = ConnectionInfo::of(&request).map_err(to_status)?;
        // Views count as step streams, because HTTP/2 buffers their small steps in the same way.
        let drive_permit = connection.acquire_drive().map_err(to_status)?;
        let memory = self.shared_memory.find(request.metadata(), &caller.principal).map_err(to_status)?;
        let replies = Arc::clone(&caller.replies);
        let call = ViewCall {
            parts: StepAssembler::new(connection.receive.new_memory(), connection.receive.limits(), memory.clone()),
            engine: self.engine.clone(),
            connection: connection.permit.clone(),
            caller,
            inbound: request.into_inner(),
            memory,
            _drive_permit: drive_permit,
        };
        Ok(respond(replies, move |reply_sender| deadline.enforce("the views", call.run(reply_sender))))
    }
}

/// A call that has not opened its worlds yet.
struct ViewCall {
    engine: Engine,
    caller: Caller,
    inbound: Streaming<v1::DrawViewsRequest>,
    /// The step that is being received, if it has several parts.
    parts: StepAssembler,
    memory: CallMemory,
    /// The permit of the connection.
    connection: PermitHandle,
    _drive_permit: OwnedSemaphorePermit,
}

impl ViewCall {
    async fn run(mut self, reply_sender: ReplySender<v1::DrawViewsResponse>) -> Result<(), Status> {
        let max_message_bytes = self.engine.config().message_bytes;
        let timeout = self.engine.config().first_request_timeout;
        let first = tokio::time::timeout(timeout, self.inbound.message()).await.map_err(|_| {
            to_status(Error::Deadline { what: "the first message".into(), ms: timeout.as_millis() as u64 })
        })?;
        let Some(message) = first.map_err(|status| transport_status(status, max_message_bytes))? else {
            return Ok(());
        };
        let Some(RequestKind::Open(open)) = message.kind else {
            return Err(to_status(Error::UnexpectedMessage { expected: "open", given: "another message" }));
        };
        let principal = &self.caller.principal;
        let scene_handle = self.engine.find_opened(&open.scene, principal, SceneRight::Use).await.map_err(to_status)?;
        let slot_count = open.device_slots as usize;
        if slot_count > 0 && !self.memory.is_available() {
            let error = invalid("device_slots", "a call with shared memory", "a call without it");
            return Err(to_status(error));
        }
        let settings = parse_view_settings(&scene_handle.scene, open).map_err(to_status)?;
        let session = self.engine.open_views(&scene_handle, &self.caller.account, settings).await.map_err(to_status)?;
        let (right_ended, closed) = (scene_handle.right_ended(principal, SceneRight::Use), scene_handle.closed());
        drop(scene_handle);
        let scene_ended = async {
            tokio::select! {
                error = right_ended => error,
                error = closed => error,
            }
        };
        let mut opened = wire_views_opened(&session);
        let mut device = None;
        if slot_count > 0 {
            let exported = session.export(slot_count).await.map_err(to_status)?;
            device = Some(self.memory.send_device_memory(&exported).map_err(to_status)?);
            opened.device_slots = Some(wire_device_slots(&exported));
        }
        reply_sender.send(to_response(Part::Opened(opened))).await?;
        let stream = ViewStream { session, device, inbound: self.inbound, parts: self.parts, max_message_bytes };
        let (replies, receiver) = mpsc::channel(1);
        let max_chunk_bytes = self.engine.config().chunk_bytes;
        let work = async {
            let send = send_replies(receiver, self.memory, max_chunk_bytes, &self.connection, &reply_sender);
            tokio::try_join!(stream.run(replies), send).map(|((), ())| ())
        };
        run_while_permitted(scene_ended, work).await
    }
}

/// A call with open worlds.
struct ViewStream {
    session: ViewSession,
    /// The slots in which the pictures stay on the device. `None`: the pictures are sent.
    device: Option<DeviceMemory>,
    inbound: Streaming<v1::DrawViewsRequest>,
    parts: StepAssembler,
    max_message_bytes: usize,
}

/// What a client receives.
enum Reply {
    /// Views of a step from `first` on.
    Views { step: u64, first: usize, count: usize, drawn: Arc<DrawnViews> },
    /// All views of a step, in device memory.
    Device(v1::DeviceViews),
    /// A step that was not applied.
    Rejection(v1::Rejection),
}

impl ViewStream {
    /// Draws the views of each step, until the client has closed its side.
    async fn run(mut self, replies: mpsc::Sender<Reply>) -> Result<(), Status> {
        while let Some(message) = next_message(&mut self.inbound, &self.parts, self.max_message_bytes).await? {
            let number = message.step.as_ref().map_or(0, |step| step.number);
            let drawn = match self.prepare(message).await {
                Ok(None) => continue,
                Ok(Some(step)) => self.draw(number, step, &replies).await,
                Err(error) => Err(error),
            };
            match drawn {
                Ok(()) => {}
                Err(error @ (Error::Invalid { .. } | Error::LimitReached { .. } | Error::Preempted { .. })) => {
                    replies.send(Reply::Rejection(to_rejection(Some(number), &error))).await.ok();
                }
                Err(error) => return Err(to_status(error)),
            }
        }
        Ok(())
    }

    /// The next step, once all of its parts have arrived.
    async fn prepare(&mut self, message: v1::ViewStep) -> Result<Option<ViewStep>> {
        let v1::ViewStep { step, cameras, drawn_worlds } = message;
        let Some(step) = self.parts.push(step.unwrap_or_default())? else { return Ok(None) };
        let update = parse_view_update(&self.session, step, cameras, drawn_worlds)?;
        self.session.prepare(update).await.map(Some)
    }

    /// Draws the views of a step piece by piece. The first piece shows whether the device accepts the step.
    async fn draw(&mut self, number: u64, mut step: ViewStep, replies: &mpsc::Sender<Reply>) -> Result<()> {
        let Self { session, device, .. } = self;
        let slot = match device {
            Some(device) => Some(device.take().await.ok_or_else(memory_ended)?),
            None => None,
        };
        if let Some(slot) = &slot {
            step.draw_into(slot.number() as usize);
        }
        let mut stages = StageTimes::new();
        while let Some(pending) = session.draw_next(&mut step) {
            let PendingViews { first, count, .. } = pending;
            let drawn = pending.wait().await?;
            session.record_piece(count, &drawn);
            if first == 0 {
                session.accept(&step);
            }
            // Sending fails only if an earlier reply could not be sent, which ends the call.
            match slot {
                Some(_) => add_times(&mut stages, &drawn.stages),
                None => drop(replies.send(Reply::Views { step: number, first, count, drawn }).await),
            }
        }
        if let Some(slot) = slot {
            let views = v1::DeviceViews { step: number, slot: slot.lend(), stages: wire_stages(&stages) };
            replies.send(Reply::Device(views)).await.ok();
        }
        Ok(())
    }
}

fn memory_ended() -> Error {
    fault("device memory", "the client has closed the connection of its shared memory")
}

/// Adds the times of a piece to those of its step.
fn add_times(sum: &mut StageTimes, times: &StageTimes) {
    for (stage, ms) in times {
        match sum.iter_mut().find(|(summed_stage, _)| summed_stage == stage) {
            Some((_, sum)) => *sum += ms,
            None => sum.push((*stage, *ms)),
        }
    }
}

/// Sends the replies until `replies` is closed.
async fn send_replies(
    mut replies: mpsc::Receiver<Reply>,
    memory: CallMemory,
    max_chunk_bytes: usize,
    connection: &PermitHandle,
    reply_sender: &ReplySender<v1::DrawViewsResponse>,
) -> Result<(), Status> {
    while let Some(reply) = replies.recv().await {
        match reply {
            Reply::Rejection(rejection) => {
                reply_sender.send(to_response(Part::Rejection(rejection))).await?;
                continue;
            }
            Reply::Device(views) => reply_sender.send(to_response(Part::Device(views))).await?,
            Reply::Views { step, first, count, drawn } => {
                for mut chunk in view_chunks(step, first, count, &drawn, max_chunk_bytes) {
                    chunk.shared = memory.share(&mut chunk.data).await;
                    reply_sender.send(to_response(Part::Chunk(chunk))).await?;
                }
            }
        }
        connection.mark_progress();
    }
    Ok(())
}

/// Splits a piece into chunks, of which the first has the times.
fn view_chunks(
    step: u64,
    first: usize,
    count: usize,
    drawn: &DrawnViews,
    max_chunk_bytes: usize,
) -> impl Iterator<Item = v1::ViewChunk> {
    let mut stages = wire_stages(&drawn.stages);
    let parts = drawn.arrays.iter().flat_map(move |(output, array)| {
        let begin = (array.len() / count * first) as u64;
        let output = wire_frame_output(*output).into();
        split_into_chunks(array.clone(), max_chunk_bytes).map(move |(offset, data)| (output, begin + offset, data))
    });
    parts.map(move |(output, offset, data)| v1::ViewChunk {
        step,
        output,
        offset,
        stages: std::mem::take(&mut stages),
        data,
        shared: None,
    })
}

/// The next step, or a part of one. `None` when the client has closed its side.
async fn next_message(
    inbound: &mut Streaming<v1::DrawViewsRequest>,
    parts: &StepAssembler,
    max_message_bytes: usize,
) -> Result<Option<v1::ViewStep>, Status> {
    let message = tokio::select! {
        message = inbound.message() => message.map_err(|status| transport_status(status, max_message_bytes))?,
        error = parts.stalled() => return Err(to_status(error)),
    };
    match message.map(|message| message.kind) {
        None => Ok(None),
        Some(Some(RequestKind::Step(step))) => Ok(Some(step)),
        Some(_) => Err(to_status(Error::UnexpectedMessage { expected: "a step", given: "another message" })),
    }
}

fn to_response(part: Part) -> v1::DrawViewsResponse {
    v1::DrawViewsResponse { part: Some(part) }
}
