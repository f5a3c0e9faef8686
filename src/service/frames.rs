//! `FrameService`: single frames with a deadline, frame streams and picks. Every frame names its step and is sent in
//! chunks.

use bytes::Bytes;
use modalcast_proto::v1;
use tonic::{Request, Response, Status};

use super::convert::{delivery, drawn_by, picture, said, stages, step_id, which_of_frame, wire_format};
use super::picks;
use super::status::status;
use super::stream::{Deadline, Outlet, Replies, pieces, respond};
use crate::engine::{Encoded, EncodedFeed, Engine, Format, View};

/// Implementation of `FrameService`.
pub(super) struct Frames(pub(super) Engine);

#[tonic::async_trait]
impl v1::frame_service_server::FrameService for Frames {
    type RenderFrameStream = Replies<v1::RenderFrameResponse>;

    async fn render_frame(
        &self,
        request: Request<v1::RenderFrameRequest>,
    ) -> Result<Response<Self::RenderFrameStream>, Status> {
        let config = self.0.config();
        let deadline = Deadline::of_request(request.metadata(), request.get_ref().deadline_ms, config);
        let request = request.into_inner();
        let host = self.0.find(&request.scene).map_err(status)?;
        let (view, format) = picture(&self.0, &host.scene, request.picture).map_err(status)?;
        let which = which_of_frame(request.step.as_ref());
        let (most, encoder) = (config.chunk_bytes, self.0.encoder().clone());
        Ok(respond(move |outlet| async move {
            let work = async {
                let shown = host.show(which, view).await.map_err(status)?;
                let frame = encoder.encode(shown, format).await.map_err(status)?;
                for chunk in chunks(&frame, view, format, most) {
                    outlet.send(v1::RenderFrameResponse { chunk: Some(chunk) }).await?;
                }
                Ok(())
            };
            deadline.hold(&said(which, &host.name), work).await
        }))
    }

    type PickStream = Replies<v1::PickResponse>;

    async fn pick(&self, request: Request<v1::PickRequest>) -> Result<Response<Self::PickStream>, Status> {
        let config = self.0.config();
        let deadline = Deadline::of_request(request.metadata(), request.get_ref().deadline_ms, config);
        picks::answer(&self.0, deadline, request.into_inner())
    }

    type StreamFramesStream = Replies<v1::StreamFramesResponse>;

    async fn stream_frames(
        &self,
        request: Request<v1::StreamFramesRequest>,
    ) -> Result<Response<Self::StreamFramesStream>, Status> {
        let deadline = Deadline::of_stream(request.metadata());
        let request = request.into_inner();
        let host = self.0.find(&request.scene).map_err(status)?;
        let (view, format) = picture(&self.0, &host.scene, request.picture).map_err(status)?;
        let delivery = delivery(request.delivery).map_err(status)?;
        // Subscribe before the response headers are sent, so that a client can rely on receiving the next step.
        let feed = host.watch(view, delivery).await.map_err(status)?;
        let frames = EncodedFeed::new(feed, self.0.encoder().clone(), format, request.frames);
        let most = self.0.config().chunk_bytes;
        let cut = move |frame: &Encoded| chunks(frame, view, format, most);
        Ok(respond(move |outlet| deadline.hold("the end of the frame stream", send_frames(frames, cut, outlet))))
    }
}

/// Sends frames in chunks until the stream ends, the client disconnects or the feed is cut off.
async fn send_frames<C: Iterator<Item = v1::FrameChunk>>(
    mut frames: EncodedFeed,
    cut: impl Fn(&Encoded) -> C,
    outlet: Outlet<v1::StreamFramesResponse>,
) -> Result<(), Status> {
    loop {
        let frame = tokio::select! {
            frame = frames.next() => frame.map_err(status)?,
            () = outlet.closed() => return Ok(()),
        };
        let Some(frame) = frame else { return Ok(()) };
        for chunk in cut(&frame) {
            tokio::select! {
                sent = outlet.send(v1::StreamFramesResponse { chunk: Some(chunk) }) => sent?,
                error = frames.cut_off() => return Err(status(error)),
            }
        }
    }
}

fn chunks(frame: &Encoded, view: View, format: Format, most: usize) -> impl Iterator<Item = v1::FrameChunk> + use<> {
    let (width, height) = match view {
        View::Frame { width, height, .. } => (width, height),
        View::Vertices(_) | View::Pick { .. } => (0, 0),
    };
    let head = v1::FrameHead {
        step: Some(step_id(frame.step)),
        width,
        height,
        format: wire_format(format).into(),
        total: frame.bytes.len() as u64,
        skipped: frame.skipped,
        stages: stages(&frame.stages),
        shadow_drawn_by: drawn_by(frame.paths.shadow).into(),
        visibility_drawn_by: drawn_by(frame.paths.visibility).into(),
    };
    let mut head = Some(head);
    let cut = move |(offset, data): (u64, Bytes)| v1::FrameChunk { head: head.take(), offset, data };
    pieces(frame.bytes.clone(), most).map(cut)
}
