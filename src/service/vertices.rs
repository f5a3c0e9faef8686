//! `VertexService`: deformed vertices of one step with a deadline, or of every step. A reply contains positions in row
//! order of U, normals, displacements and boxes, as far as they are requested.

use std::sync::Arc;

use modalcast_proto::v1;
use tonic::{Request, Response, Status};

use super::convert::{describe_step_selector, parse_delivery, parse_step_selector, wire_stages, wire_step_id};
use super::status::to_status;
use super::stream::{Deadline, ReplySender, ReplyStream, chunks_with_head, respond};
use crate::engine::{Engine, OutputSpec, PackedVertices, SceneHandle, Subscription, VertexSelection, pack_vertices};
use modalcast_model::deform::VertexAttributes;

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
        let selection = parse_selection(&scene_handle, request.selection)?;
        let selector = parse_step_selector(request.step);
        let max_chunk_bytes = config.chunk_bytes;
        Ok(respond(move |reply_sender| async move {
            let work = async {
                let output = scene_handle
                    .request_output(selector, OutputSpec::Vertices(selection.attributes))
                    .await
                    .map_err(to_status)?;
                let vertices = pack_vertices(output, &selection).await.map_err(to_status)?;
                for chunk in vertex_chunks(&vertices, &selection, max_chunk_bytes) {
                    reply_sender.send(v1::GetVerticesResponse { chunk: Some(chunk) }).await?;
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
        let selection = parse_selection(&scene_handle, request.selection)?;
        let delivery = parse_delivery("delivery", request.delivery).map_err(to_status)?;
        // Subscribe before the response headers are sent, so that a client can rely on receiving the next step.
        let subscription =
            scene_handle.subscribe(OutputSpec::Vertices(selection.attributes), delivery).await.map_err(to_status)?;
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
        let mut sent_steps = 0;
        while self.max_steps == 0 || sent_steps < self.max_steps {
            let output = tokio::select! {
                output = subscription.next() => output.map_err(to_status)?,
                () = reply_sender.closed() => return Ok(()),
            };
            let vertices = pack_vertices(output, &self.selection).await.map_err(to_status)?;
            for chunk in vertex_chunks(&vertices, &self.selection, self.max_chunk_bytes) {
                tokio::select! {
                    sent = reply_sender.send(v1::StreamVerticesResponse { chunk: Some(chunk) }) => sent?,
                    error = subscription.disconnected() => return Err(to_status(error)),
                }
            }
            sent_steps += 1;
        }
        Ok(())
    }
}

/// Validates the selection of a request.
fn parse_selection(
    scene_handle: &SceneHandle,
    selection: Option<v1::VertexSelection>,
) -> Result<Arc<VertexSelection>, Status> {
    let v1::VertexSelection { domains, positions_only, displacements, boxes, without_vertices } =
        selection.unwrap_or_default();
    let positions = !without_vertices;
    let attributes = VertexAttributes { positions, normals: positions && !positions_only, displacements, boxes };
    VertexSelection::new(&scene_handle.scene, domains, attributes).map(Arc::new).map_err(to_status)
}

/// Splits vertices into chunks, of which the first has the head.
fn vertex_chunks(
    packed: &PackedVertices,
    selection: &VertexSelection,
    max_chunk_bytes: usize,
) -> impl Iterator<Item = v1::VertexChunk> + use<> {
    let encoded = &packed.encoded;
    let head = v1::VertexHead {
        step: Some(wire_step_id(encoded.step)),
        origin: packed.origin.to_vec(),
        domains: selection.domains.clone(),
        vertices: selection.vertex_counts().collect(),
        corners: selection.corner_counts().collect(),
        position_bytes: selection.position_bytes(),
        total: encoded.bytes.len() as u64,
        skipped: encoded.skipped,
        stages: wire_stages(&encoded.stages),
        origin_bytes: packed.origin_bytes,
        displacement_bytes: selection.displacement_bytes(),
        box_bytes: selection.box_bytes(),
    };
    chunks_with_head(head, encoded.bytes.clone(), max_chunk_bytes, |head, offset, data| v1::VertexChunk {
        head,
        offset,
        data,
    })
}
