//! `FrameService`: single frames with a deadline, frame streams and picks. Every frame names its step and is sent in
//! chunks.

use modalcast_proto::v1;
use tonic::{Request, Response, Status};

use super::convert::{
    describe_step_selector, parse_picture, parse_step_selector, parse_stream_delivery, wire_format,
    wire_raster_backend, wire_stages, wire_step_id,
};
use super::picks;
use super::status::to_status;
use super::stream::{Deadline, ReplySender, ReplyStream, chunks_with_head, respond};
use crate::engine::{EncodedOutput, EncodedSubscription, Engine, FrameFormat, OutputSpec};

/// Implementation of `FrameService`.
pub(super) struct FrameServiceImpl(pub(super) Engine);

#[tonic::async_trait]
impl v1::frame_service_server::FrameService for FrameServiceImpl {
    type RenderFrameStream = ReplyStream<v1::RenderFrameResponse>;

    async fn render_frame(
        &self,
        request: Request<v1::RenderFrameRequest>,
    ) -> Result<Response<Self::RenderFrameStream>, Status> {
        let config = self.0.config();
        let deadline = Deadline::of_request(request.metadata(), request.get_ref().deadline_ms, config);
        let request = request.into_inner();
        let scene_handle = self.0.find(&request.scene).map_err(to_status)?;
        let (output_spec, format) = parse_picture(&self.0, &scene_handle.scene, request.picture).map_err(to_status)?;
        let selector = parse_step_selector(request.step);
        let (max_chunk_bytes, encoder) = (config.chunk_bytes, self.0.encoder().clone());
        Ok(respond(move |reply_sender| async move {
            let work = async {
                let output = scene_handle.request_output(selector, output_spec).await.map_err(to_status)?;
                let frame = encoder.encode(output, format).await.map_err(to_status)?;
                for chunk in frame_chunks(&frame, output_spec, format, max_chunk_bytes) {
                    reply_sender.send(v1::RenderFrameResponse { chunk: Some(chunk) }).await?;
                }
                Ok(())
            };
            deadline.enforce(&describe_step_selector(selector, &scene_handle.name), work).await
        }))
    }

    type PickStream = ReplyStream<v1::PickResponse>;

    async fn pick(&self, request: Request<v1::PickRequest>) -> Result<Response<Self::PickStream>, Status> {
        let config = self.0.config();
        let deadline = Deadline::of_request(request.metadata(), request.get_ref().deadline_ms, config);
        picks::respond_to_pick(&self.0, deadline, request.into_inner())
    }

    type StreamFramesStream = ReplyStream<v1::StreamFramesResponse>;

    async fn stream_frames(
        &self,
        request: Request<v1::StreamFramesRequest>,
    ) -> Result<Response<Self::StreamFramesStream>, Status> {
        let deadline = Deadline::of_stream(request.metadata());
        let request = request.into_inner();
        let scene_handle = self.0.find(&request.scene).map_err(to_status)?;
        let (output_spec, format) = parse_picture(&self.0, &scene_handle.scene, request.picture).map_err(to_status)?;
        let delivery = parse_stream_delivery(request.delivery, request.max_hz).map_err(to_status)?;
        // Subscribe before the response headers are sent, so that a client can rely on receiving the next step.
        let subscription = scene_handle.subscribe(output_spec, delivery).await.map_err(to_status)?;
        let frames = EncodedSubscription::new(subscription, self.0.encoder().clone(), format, request.frames);
        let max_chunk_bytes = self.0.config().chunk_bytes;
        let split_frame = move |frame: &EncodedOutput| frame_chunks(frame, output_spec, format, max_chunk_bytes);
        Ok(respond(move |reply_sender| {
            deadline.enforce("the frame stream", send_frames(frames, split_frame, reply_sender))
        }))
    }
}

/// Sends frames in chunks until the subscription ends, the client disconnects, or the scene disconnects the subscriber.
async fn send_frames<C: Iterator<Item = v1::FrameChunk>>(
    mut frames: EncodedSubscription,
    split_frame: impl Fn(&EncodedOutput) -> C,
    reply_sender: ReplySender<v1::StreamFramesResponse>,
) -> Result<(), Status> {
    loop {
        let frame = tokio::select! {
            frame = frames.next() => frame.map_err(to_status)?,
            () = reply_sender.closed() => return Ok(()),
        };
        let Some(frame) = frame else { return Ok(()) };
        for chunk in split_frame(&frame) {
            tokio::select! {
                sent = reply_sender.send(v1::StreamFramesResponse { chunk: Some(chunk) }) => sent?,
                error = frames.disconnected() => return Err(to_status(error)),
            }
        }
    }
}

/// Splits a frame into chunks, of which the first has the head.
fn frame_chunks(
    frame: &EncodedOutput,
    output_spec: OutputSpec,
    format: FrameFormat,
    max_chunk_bytes: usize,
) -> impl Iterator<Item = v1::FrameChunk> + use<> {
    let (width, height) = match output_spec {
        OutputSpec::Frame { size, .. } => (size.width, size.height),
        // `parse_picture` returns frames only.
        OutputSpec::Vertices(_) | OutputSpec::Pick { .. } | OutputSpec::State => (0, 0),
    };
    let head = v1::FrameHead {
        step: Some(wire_step_id(frame.step)),
        width,
        height,
        format: wire_format(format).into(),
        total: frame.bytes.len() as u64,
        skipped: frame.skipped,
        stages: wire_stages(&frame.stages),
        shadow_drawn_by: wire_raster_backend(frame.raster_backends.shadow).into(),
        visibility_drawn_by: wire_raster_backend(frame.raster_backends.visibility).into(),
    };
    chunks_with_head(head, frame.bytes.clone(), max_chunk_bytes, |head, offset, data| v1::FrameChunk {
        head,
        offset,
        data,
    })
}
