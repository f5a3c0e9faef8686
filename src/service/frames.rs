//! `FrameService`: single frames with a deadline, frame streams and picks. Every frame names its step and is sent in
//! chunks.

use modalcast_proto::v1;
use tonic::{Request, Response, Status};

use super::convert::{delivery, describe_step_selector, drawn_by, picture, stages, step_id, wire_format};
use super::picks;
use super::status::status;
use super::stream::{Deadline, ReplySender, ReplyStream, chunks_with_head, respond};
use crate::engine::{EncodedOutput, EncodedSubscription, Engine, FrameFormat, OutputSpec, StepSelector};

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
        let scene_handle = self.0.find(&request.scene).map_err(status)?;
        let (view, format) = picture(&self.0, &scene_handle.scene, request.picture).map_err(status)?;
        let selector = StepSelector::from(request.step);
        let (most, encoder) = (config.chunk_bytes, self.0.encoder().clone());
        Ok(respond(move |reply_sender| async move {
            let work = async {
                let output = scene_handle.request_output(selector, view).await.map_err(status)?;
                let frame = encoder.encode(output, format).await.map_err(status)?;
                for chunk in chunks(&frame, view, format, most) {
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
        picks::answer(&self.0, deadline, request.into_inner())
    }

    type StreamFramesStream = ReplyStream<v1::StreamFramesResponse>;

    async fn stream_frames(
        &self,
        request: Request<v1::StreamFramesRequest>,
    ) -> Result<Response<Self::StreamFramesStream>, Status> {
        let deadline = Deadline::of_stream(request.metadata());
        let request = request.into_inner();
        let scene_handle = self.0.find(&request.scene).map_err(status)?;
        let (view, format) = picture(&self.0, &scene_handle.scene, request.picture).map_err(status)?;
        let delivery = delivery(request.delivery).map_err(status)?;
        // Subscribe before the response headers are sent, so that a client can rely on receiving the next step.
        let subscription = scene_handle.subscribe(view, delivery).await.map_err(status)?;
        let frames = EncodedSubscription::new(subscription, self.0.encoder().clone(), format, request.frames);
        let most = self.0.config().chunk_bytes;
        let cut = move |frame: &EncodedOutput| chunks(frame, view, format, most);
        Ok(respond(move |reply_sender| {
            deadline.enforce("the end of the frame stream", send_frames(frames, cut, reply_sender))
        }))
    }
}

/// Sends frames in chunks until the stream ends, the client disconnects or the feed is cut off.
async fn send_frames<C: Iterator<Item = v1::FrameChunk>>(
    mut frames: EncodedSubscription,
    cut: impl Fn(&EncodedOutput) -> C,
    reply_sender: ReplySender<v1::StreamFramesResponse>,
) -> Result<(), Status> {
    loop {
        let frame = tokio::select! {
            frame = frames.next() => frame.map_err(status)?,
            () = reply_sender.closed() => return Ok(()),
        };
        let Some(frame) = frame else { return Ok(()) };
        for chunk in cut(&frame) {
            tokio::select! {
                sent = reply_sender.send(v1::StreamFramesResponse { chunk: Some(chunk) }) => sent?,
                error = frames.disconnected() => return Err(status(error)),
            }
        }
    }
}

fn chunks(
    frame: &EncodedOutput,
    view: OutputSpec,
    format: FrameFormat,
    most: usize,
) -> impl Iterator<Item = v1::FrameChunk> + use<> {
    let (width, height) = match view {
        OutputSpec::Frame { size, .. } => (size.width, size.height),
        OutputSpec::Vertices(_) | OutputSpec::Pick { .. } => (0, 0),
    };
    let head = v1::FrameHead {
        step: Some(step_id(frame.step)),
        width,
        height,
        format: wire_format(format).into(),
        total: frame.bytes.len() as u64,
        skipped: frame.skipped,
        stages: stages(&frame.stages),
        shadow_drawn_by: drawn_by(frame.raster_backends.shadow).into(),
        visibility_drawn_by: drawn_by(frame.raster_backends.visibility).into(),
    };
    chunks_with_head(head, frame.bytes.clone(), most, |head, offset, data| v1::FrameChunk { head, offset, data })
}
