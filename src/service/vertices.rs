//! `VertexService`: deformed vertices of one step with a deadline, or of the steps of a stream. A reply begins with the
//! layout. Each step has a head with its sections, and is sent in chunks.

use std::sync::Arc;

use modalcast_proto::v1;
use tonic::{Request, Response, Status};
use v1::get_vertices_response::Part as SinglePart;
use v1::stream_vertices_response::Part as StreamPart;

use super::convert::{
    describe_step_selector, parse_step_selector, parse_stream_delivery, parse_vertex_selection, wire_delivery,
    wire_sections, wire_stages, wire_step_id,
};
use super::status::to_status;
use super::stream::{Deadline, ReplySender, ReplyStream, chunks_with_head, respond};
use crate::engine::{Engine, OutputSpec, PackedVertices, Subscription, VertexSelection, pack_vertices};

/// Number of domains in one part of a layout. A part then has at most 0.8 MiB.
const LAYOUT_PART_DOMAINS: usize = 65_536;

/// Implementation of `VertexService`.
pub(super) struct VertexServiceImpl(pub(super) Engine);

#[tonic::async_trait]
impl v1::vertex_service_server::VertexService for VertexServiceImpl {
    type GetVerticesStream = ReplyStream<v1::GetVerticesResponse>;

    async fn get_vertices(
        &self,
        request: Request<v1::GetVerticesRequest>,
    ) -> Result<Response<Self::GetVerticesStream>, Status> {
        let config = self.0.config();
        let deadline = Deadline::of_request(request.metadata(), request.get_ref().deadline_ms, config);
        let request = request.into_inner();
        let scene_handle = self.0.find(&request.scene).map_err(to_status)?;
        let selection = parse_vertex_selection(&scene_handle.scene, request.selection).map_err(to_status)?;
        let selector = parse_step_selector(request.step);
        let max_chunk_bytes = config.chunk_bytes;
        let to_response = |part| v1::GetVerticesResponse { part: Some(part) };
        Ok(respond(move |reply_sender| async move {
            let work = async {
                let spec = OutputSpec::Vertices(selection.vertex_attributes());
                let output = scene_handle.request_output(selector, spec).await.map_err(to_status)?;
                let vertices = pack_vertices(output, &selection, None).await.map_err(to_status)?;
                for layout in layout_parts(&selection) {
                    reply_sender.send(to_response(SinglePart::Layout(layout))).await?;
                }
                for chunk in vertex_chunks(&vertices, max_chunk_bytes) {
                    reply_sender.send(to_response(SinglePart::Chunk(chunk))).await?;
                }
                Ok(())
            };
            deadline.enforce(&describe_step_selector(selector, &scene_handle.name), work).await
        }))
    }

    type StreamVerticesStream = ReplyStream<v1::StreamVerticesResponse>;

    async fn stream_vertices(
        &self,
        request: Request<v1::StreamVerticesRequest>,
    ) -> Result<Response<Self::StreamVerticesStream>, Status> {
        let deadline = Deadline::of_stream(request.metadata());
        let request = request.into_inner();
        let scene_handle = self.0.find(&request.scene).map_err(to_status)?;
        let selection = parse_vertex_selection(&scene_handle.scene, request.selection).map_err(to_status)?;
        let delivery = parse_stream_delivery(request.delivery, request.max_hz).map_err(to_status)?;
        let spec = OutputSpec::Vertices(selection.vertex_attributes());
        // Subscribe before the response headers are sent, so that a client can rely on receiving the next step.
        let subscription = scene_handle.subscribe(spec, delivery).await.map_err(to_status)?;
        let vertex_stream =
            VertexStream { selection, max_chunk_bytes: self.0.config().chunk_bytes, max_steps: request.steps };
        Ok(respond(move |reply_sender| {
            deadline.enforce("the vertex stream", vertex_stream.run(subscription, reply_sender))
        }))
    }
}

/// Parameters of a vertex stream.
struct VertexStream {
    selection: Arc<VertexSelection>,
    max_chunk_bytes: usize,
    /// Number of steps to send. 0 means no limit.
    max_steps: u64,
}

impl VertexStream {
    async fn run(
        self,
        mut subscription: Subscription,
        reply_sender: ReplySender<v1::StreamVerticesResponse>,
    ) -> Result<(), Status> {
        let to_response = |part| v1::StreamVerticesResponse { part: Some(part) };
        let delivery = subscription.delivery();
        let settings = v1::VertexStreamSettings {
            delivery: wire_delivery(delivery.delivery()).into(),
            max_hz: delivery.max_hz(),
            steps: self.max_steps,
        };
        reply_sender.send(to_response(StreamPart::Settings(settings))).await?;
        for layout in layout_parts(&self.selection) {
            reply_sender.send(to_response(StreamPart::Layout(layout))).await?;
        }
        let (mut sent_steps, mut known_origins) = (0, None);
        while self.max_steps == 0 || sent_steps < self.max_steps {
            let output = tokio::select! {
                output = subscription.next() => output.map_err(to_status)?,
                () = reply_sender.closed() => return Ok(()),
            };
            let vertices = pack_vertices(output, &self.selection, known_origins).await.map_err(to_status)?;
            for chunk in vertex_chunks(&vertices, self.max_chunk_bytes) {
                tokio::select! {
                    sent = reply_sender.send(to_response(StreamPart::Chunk(chunk))) => sent?,
                    error = subscription.disconnected() => return Err(to_status(error)),
                }
            }
            known_origins = Some(vertices.origins);
            sent_steps += 1;
        }
        Ok(())
    }
}

/// The layout of a reply in parts; at least one.
fn layout_parts(selection: &VertexSelection) -> Vec<v1::VertexLayout> {
    let mut counts = selection.counts();
    let parts = selection.domains.chunks(LAYOUT_PART_DOMAINS).map(|domains| {
        let (vertices, corners) = counts.by_ref().take(domains.len()).unzip();
        v1::VertexLayout { domains: domains.to_vec(), vertices, corners, has_more: true }
    });
    let mut parts: Vec<_> = parts.collect();
    if let Some(last_part) = parts.last_mut() {
        last_part.has_more = false;
    }
    parts
}

/// Splits the vertices of a step into chunks, of which the first has the head.
fn vertex_chunks(packed: &PackedVertices, max_chunk_bytes: usize) -> impl Iterator<Item = v1::VertexChunk> + use<> {
    let encoded = &packed.encoded;
    let head = v1::VertexHead {
        step: Some(wire_step_id(encoded.step)),
        sections: wire_sections(&packed.sections),
        total: encoded.bytes.len() as u64,
        skipped: encoded.skipped,
        stages: wire_stages(&encoded.stages),
    };
    chunks_with_head(head, encoded.bytes.clone(), max_chunk_bytes, |head, offset, data| v1::VertexChunk {
        head,
        offset,
        data,
    })
}
