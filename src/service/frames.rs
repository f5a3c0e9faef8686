//! Pictures: one with a deadline, or a stream of them. Every frame names the step it shows and travels in chunks.

use bytes::Bytes;
use modalcast_proto::v1;
use tonic::{Request, Response, Status};

use super::convert::{delivery, drawn_by, picture, said, stages, step_id, which_of_frame, wire_format};
use super::picks;
use super::status::status;
use super::stream::{Deadline, Outlet, Replies, pieces, respond};
use crate::engine::{Encoded, Engine, Feed, Format, View, encode_frame};

/// `FrameService`.
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
        let most = config.chunk_bytes;
        Ok(respond(move |outlet| async move {
            let work = async {
                let shown = host.show(which, view).await.map_err(status)?;
                let frame = encode_frame(shown, format).await.map_err(status)?;
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
        // The subscription holds before the reply's head is sent, so that a client may count on the next step.
        let feed = host.watch(view, delivery).await.map_err(status)?;
        let show = Show { view, format, most: self.0.config().chunk_bytes, frames: request.frames };
        Ok(respond(move |outlet| deadline.hold("the end of the frame stream", show.run(feed, outlet))))
    }
}

/// How a stream of frames is sent.
struct Show {
    view: View,
    format: Format,
    most: usize,
    /// 0: without end.
    frames: u64,
}

impl Show {
    async fn run(self, mut feed: Feed, outlet: Outlet<v1::StreamFramesResponse>) -> Result<(), Status> {
        let mut sent = 0;
        while self.frames == 0 || sent < self.frames {
            let shown = tokio::select! {
                shown = feed.next() => shown.map_err(status)?,
                () = outlet.closed() => return Ok(()),
            };
            let frame = encode_frame(shown, self.format).await.map_err(status)?;
            for chunk in chunks(&frame, self.view, self.format, self.most) {
                tokio::select! {
                    sent = outlet.send(v1::StreamFramesResponse { chunk: Some(chunk) }) => sent?,
                    error = feed.cut_off() => return Err(status(error)),
                }
            }
            sent += 1;
        }
        Ok(())
    }
}

fn chunks(frame: &Encoded, view: View, format: Format, most: usize) -> impl Iterator<Item = v1::FrameChunk> {
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
