//! `FrameService`: single frames with a deadline, frame streams with movable cameras, and picks. Every frame names its
//! step and is sent in chunks.

use std::sync::Arc;

use bytes::Bytes;
use modalcast_proto::v1;
use tokio::sync::OwnedSemaphorePermit;
use tonic::{Request, Response, Status};
use v1::render_frame_response::Part as SinglePart;
use v1::stream_frames_response::Part as StreamPart;

use super::caller::Caller;
use super::connection::ConnectionInfo;
use super::convert::{
    FrameUse, RequestedPicture, count_pixels, describe_step_selector, parse_moved_cameras, parse_pictures,
    parse_step_selector, parse_stream_delivery, right_to_receive, wire_delivery, wire_format, wire_frame_info,
    wire_picture, wire_stages, wire_step_id,
};
use super::picks;
use super::sent_steps::SentSteps;
use super::shared_memory::{CallMemory, SharedMemory};
use super::status::to_status;
use super::stream::{Deadline, ReplySender, ReplyStream, chunks_with_head, respond, run_while_permitted};
use crate::engine::{
    EncodedFrame, EncodedSubscription, Engine, FrameFormat, FrameQueue, FrameStreamEntry, FrameStreamRegistration,
    OutputSpec, SceneRight, StreamDelivery, StreamId,
};
use modalcast_model::error::fault;

/// Implementation of `FrameService`.
pub(super) struct FrameServiceImpl {
    pub(super) engine: Engine,
    pub(super) shared_memory: SharedMemory,
}

#[tonic::async_trait]
impl v1::frame_service_server::FrameService for FrameServiceImpl {
    type RenderFrameStream = ReplyStream<v1::RenderFrameResponse>;

    async fn render_frame(
        &self,
        request: Request<v1::RenderFrameRequest>,
    ) -> Result<Response<Self::RenderFrameStream>, Status> {
        let config = self.engine.config();
        let deadline = Deadline::of_request(request.metadata(), request.get_ref().deadline_ms, config);
        let Caller { principal, account, replies, .. } = Caller::of(&request)?;
        let memory = self.shared_memory.find(request.metadata(), &principal).map_err(to_status)?;
        let connection = ConnectionInfo::of(&request).map_err(to_status)?;
        let request = request.into_inner();
        let scene_handle =
            self.engine.find_opened(&request.scene, &principal, SceneRight::Use).await.map_err(to_status)?;
        let pictures =
            parse_pictures(&self.engine, &scene_handle.scene, request.pictures, FrameUse::Still).map_err(to_status)?;
        let selector = parse_step_selector(request.step);
        let (max_chunk_bytes, encoder) = (config.chunk_bytes, self.engine.encoder().clone());
        Ok(respond(replies, move |reply_sender| async move {
            let work = async {
                let _pixels = connection.acquire_frame_pixels(count_pixels(&pictures)).await.map_err(to_status)?;
                let output =
                    scene_handle.request_output(&account, selector, output_spec(&pictures)).await.map_err(to_status)?;
                let mut frames = FrameQueue::new(encoder, formats(&pictures));
                frames.push(output).map_err(to_status)?;
                for picture in &pictures {
                    let Some(frame) = frames.next().await else { break };
                    for mut chunk in frame_chunks(&frame.map_err(to_status)?, picture, max_chunk_bytes) {
                        chunk.shared = memory.share(&mut chunk.data).await;
                        reply_sender.send(v1::RenderFrameResponse { part: Some(SinglePart::Chunk(chunk)) }).await?;
                    }
                }
                Ok(())
            };
            deadline.enforce(&describe_step_selector(selector, &scene_handle.name), work).await
        }))
    }

    type PickStream = ReplyStream<v1::PickResponse>;

    async fn pick(&self, request: Request<v1::PickRequest>) -> Result<Response<Self::PickStream>, Status> {
        let config = self.engine.config();
        let deadline = Deadline::of_request(request.metadata(), request.get_ref().deadline_ms, config);
        let caller = Caller::of(&request)?;
        picks::respond_to_pick(&self.engine, caller, deadline, request.into_inner()).await
    }

    async fn update_frame_stream(
        &self,
        request: Request<v1::UpdateFrameStreamRequest>,
    ) -> Result<Response<v1::UpdateFrameStreamResponse>, Status> {
        let v1::UpdateFrameStreamRequest { stream, cameras } = request.into_inner();
        let id = StreamId::parse("stream", &stream).map_err(to_status)?;
        let FrameStreamEntry { scene, cameras: camera_control } =
            &*self.engine.find_frame_stream(id).map_err(to_status)?;
        let moved_cameras = parse_moved_cameras(scene, &camera_control.pictures(), cameras).map_err(to_status)?;
        let camera_version = camera_control.move_cameras(&moved_cameras);
        Ok(Response::new(v1::UpdateFrameStreamResponse { camera_version }))
    }

    type StreamFramesStream = ReplyStream<v1::StreamFramesResponse>;

    async fn stream_frames(
        &self,
        request: Request<v1::StreamFramesRequest>,
    ) -> Result<Response<Self::StreamFramesStream>, Status> {
        let deadline = Deadline::of_stream(request.metadata());
        let Caller { principal, account, replies, .. } = Caller::of(&request)?;
        let memory = self.shared_memory.find(request.metadata(), &principal).map_err(to_status)?;
        let connection = ConnectionInfo::of(&request).map_err(to_status)?;
        let request = request.into_inner();
        let delivery = parse_stream_delivery(request.delivery, request.max_hz).map_err(to_status)?;
        let right = right_to_receive(delivery);
        let scene_handle = self.engine.find_opened(&request.scene, &principal, right).await.map_err(to_status)?;
        let pictures =
            parse_pictures(&self.engine, &scene_handle.scene, request.pictures, FrameUse::Stream).map_err(to_status)?;
        let pixels = connection.acquire_stream_pixels(count_pixels(&pictures)).map_err(to_status)?;
        // Subscribe before the response headers are sent, so that a client can rely on receiving the next step.
        let subscription =
            scene_handle.subscribe(&account, output_spec(&pictures), delivery).await.map_err(to_status)?;
        let cameras = subscription.cameras().cloned().ok_or_else(|| to_status(fault("frames", "expected cameras")))?;
        let entry = FrameStreamEntry { scene: Arc::clone(&scene_handle.scene), cameras };
        let registration = self.engine.register_frame_stream(entry).map_err(to_status)?;
        let encoder = self.engine.encoder().clone();
        let frames = EncodedSubscription::new(subscription, encoder, formats(&pictures), request.steps);
        let frame_stream = FrameStream {
            registration,
            pictures,
            delivery,
            max_steps: request.steps,
            memory,
            max_chunk_bytes: self.engine.config().chunk_bytes,
            _pixels: pixels,
        };
        let right_ended = scene_handle.right_ended(&principal, right);
        Ok(respond(replies, move |reply_sender| {
            let work = run_while_permitted(right_ended, frame_stream.run(frames, reply_sender));
            deadline.enforce("the frame stream", work)
        }))
    }
}

/// Parameters of a frame stream.
struct FrameStream {
    /// Ends with this stream.
    registration: FrameStreamRegistration,
    pictures: Vec<RequestedPicture>,
    delivery: StreamDelivery,
    /// Number of steps to send. 0 means no limit.
    max_steps: u64,
    memory: CallMemory,
    max_chunk_bytes: usize,
    _pixels: OwnedSemaphorePermit,
}

impl FrameStream {
    /// Sends the settings, then frames in chunks until the subscription ends, the client disconnects, or the scene
    /// disconnects the subscriber.
    async fn run(
        self,
        mut frames: EncodedSubscription,
        reply_sender: ReplySender<v1::StreamFramesResponse>,
    ) -> Result<(), Status> {
        let to_response = |part| v1::StreamFramesResponse { part: Some(part) };
        reply_sender.send(to_response(StreamPart::Settings(self.settings()))).await?;
        let mut sent_steps = SentSteps::default();
        loop {
            let frame = tokio::select! {
                frame = frames.next() => frame.map_err(|error| sent_steps.end(error, None))?,
                () = reply_sender.closed() => return Ok(()),
            };
            let Some(frame) = frame else { return Ok(()) };
            // The encoder numbers the frames by the same list of pictures.
            let Some(picture) = self.pictures.get(frame.picture as usize) else { continue };
            for mut chunk in frame_chunks(&frame, picture, self.max_chunk_bytes) {
                let send = async {
                    chunk.shared = self.memory.share(&mut chunk.data).await;
                    reply_sender.send(to_response(StreamPart::Chunk(chunk))).await
                };
                tokio::select! {
                    sent = send => sent?,
                    error = frames.encode_until_disconnected() => return Err(sent_steps.end(error, Some(frame.step))),
                }
            }
            if frame.picture as usize + 1 == self.pictures.len() {
                sent_steps.complete(frame.step);
            }
        }
    }

    fn settings(&self) -> v1::FrameStreamSettings {
        v1::FrameStreamSettings {
            delivery: wire_delivery(self.delivery.delivery()).into(),
            max_hz: self.delivery.max_hz(),
            steps: self.max_steps,
            pictures: self.pictures.iter().map(wire_picture).collect(),
            stream: Bytes::copy_from_slice(self.registration.id.as_bytes()),
        }
    }
}

fn output_spec(pictures: &[RequestedPicture]) -> OutputSpec {
    OutputSpec::Frames(pictures.iter().map(|picture| picture.spec).collect())
}

fn formats(pictures: &[RequestedPicture]) -> Vec<FrameFormat> {
    pictures.iter().map(|picture| picture.format).collect()
}

/// Splits a frame into chunks, of which the first has the head.
fn frame_chunks(
    frame: &EncodedFrame,
    picture: &RequestedPicture,
    max_chunk_bytes: usize,
) -> impl Iterator<Item = v1::FrameChunk> + use<> {
    let head = v1::FrameHead {
        step: Some(wire_step_id(frame.step)),
        width: picture.spec.size.width,
        height: picture.spec.size.height,
        format: wire_format(picture.format).into(),
        total: frame.bytes.len() as u64,
        skipped: frame.skipped,
        stages: wire_stages(&frame.stages),
        picture: frame.picture,
        camera_version: frame.camera_version,
        ..wire_frame_info(&frame.info)
    };
    chunks_with_head(head, frame.bytes.clone(), max_chunk_bytes, |head, offset, data| v1::FrameChunk {
        head,
        offset,
        data,
        shared: None,
    })
}
