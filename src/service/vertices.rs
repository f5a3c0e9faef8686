//! `VertexService`: deformed vertices of one step with a deadline, or of the steps of a stream. A reply begins with the
//! layout. Each step has a head with its sections, and is sent in chunks.

use std::sync::Arc;

use bytes::Bytes;
use modalcast_proto::v1;
use tonic::{Request, Response, Status};
use v1::get_vertices_response::Part as SinglePart;
use v1::stream_vertices_response::Part as StreamPart;

use super::caller::Caller;
use super::convert::{
    describe_step_selector, parse_step_selector, parse_stream_delivery, parse_vertex_selection, right_to_receive,
    wire_delivery, wire_sections, wire_stages, wire_step_id,
};
use super::sent_steps::SentSteps;
use super::shared_memory::{CallMemory, SharedMemory};
use super::status::to_status;
use super::stream::{Deadline, ReplySender, ReplyStream, respond, run_while_permitted, split_into_chunks};
use crate::engine::{Engine, OutputSpec, PackedVertices, SceneRight, Subscription, VertexPacker, VertexSelection};

/// Number of domains in one part of a layout. A part then has at most 0.8 MiB.
const LAYOUT_PART_DOMAINS: usize = 65_536;

/// Implementation of `VertexService`.
pub(super) struct VertexServiceImpl {
    pub(super) engine: Engine,
    pub(super) shared_memory: SharedMemory,
}

#[tonic::async_trait]
impl v1::vertex_service_server::VertexService for VertexServiceImpl {
    type GetVerticesStream = ReplyStream<v1::GetVerticesResponse>;

    async fn get_vertices(
        &self,
        request: Request<v1::GetVerticesRequest>,
    ) -> Result<Response<Self::GetVerticesStream>, Status> {
        let config = self.engine.config();
        let deadline = Deadline::of_request(request.metadata(), request.get_ref().deadline_ms, config);
        let Caller { principal, account, replies, .. } = Caller::of(&request)?;
        let memory = self.shared_memory.find(request.metadata(), &principal).map_err(to_status)?;
        let request = request.into_inner();
        let scene_handle =
            self.engine.find_opened(&request.scene, &principal, SceneRight::Use).await.map_err(to_status)?;
        let selection = parse_vertex_selection(&scene_handle.scene, request.selection).map_err(to_status)?;
        let selector = parse_step_selector(request.step);
        let (packer, max_chunk_bytes) = (self.engine.vertex_packer().clone(), config.chunk_bytes);
        let to_response = |part| v1::GetVerticesResponse { part: Some(part) };
        Ok(respond(replies, move |reply_sender| async move {
            let work = async {
                let spec = OutputSpec::Vertices(selection.vertex_attributes());
                let output = scene_handle.request_output(&account, selector, spec).await.map_err(to_status)?;
                let vertices = packer.pack(output, &selection, None).await.map_err(to_status)?;
                for layout in layout_parts(&selection) {
                    reply_sender.send(to_response(SinglePart::Layout(layout))).await?;
                }
                for mut chunk in vertex_chunks(&vertices, max_chunk_bytes) {
                    chunk.shared = memory.share(&mut chunk.data).await;
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
        let Caller { principal, account, replies, .. } = Caller::of(&request)?;
        let memory = self.shared_memory.find(request.metadata(), &principal).map_err(to_status)?;
        let request = request.into_inner();
        let delivery = parse_stream_delivery(request.delivery, request.max_hz).map_err(to_status)?;
        let right = right_to_receive(delivery);
        let scene_handle = self.engine.find_opened(&request.scene, &principal, right).await.map_err(to_status)?;
        let selection = parse_vertex_selection(&scene_handle.scene, request.selection).map_err(to_status)?;
        let spec = OutputSpec::Vertices(selection.vertex_attributes());
        // Subscribe before the response headers are sent, so that a client can rely on receiving the next step.
        let subscription = scene_handle.subscribe(&account, spec, delivery).await.map_err(to_status)?;
        let right_ended = scene_handle.right_ended(&principal, right);
        let vertex_stream = VertexStream {
            selection,
            packer: self.engine.vertex_packer().clone(),
            memory,
            max_chunk_bytes: self.engine.config().chunk_bytes,
            max_steps: request.steps,
        };
        Ok(respond(replies, move |reply_sender| {
            let work = run_while_permitted(right_ended, vertex_stream.run(subscription, reply_sender));
            deadline.enforce("the vertex stream", work)
        }))
    }
}

/// Parameters of a vertex stream.
struct VertexStream {
    selection: Arc<VertexSelection>,
    packer: VertexPacker,
    memory: CallMemory,
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
        let work_timer = Arc::clone(subscription.work_timer());
        let (mut sent_steps, mut sent_count, mut known_origins) = (SentSteps::default(), 0, None);
        while self.max_steps == 0 || sent_count < self.max_steps {
            let output = tokio::select! {
                output = work_timer.measure(subscription.next()) => output.map_err(|error| sent_steps.end(error, None))?,
                () = reply_sender.closed() => return Ok(()),
            };
            let pack = self.packer.pack(output, &self.selection, known_origins);
            let vertices = work_timer.measure(pack).await.map_err(to_status)?;
            for mut chunk in vertex_chunks(&vertices, self.max_chunk_bytes) {
                let send = async {
                    chunk.shared = self.memory.share(&mut chunk.data).await;
                    reply_sender.send(to_response(StreamPart::Chunk(chunk))).await
                };
                tokio::select! {
                    sent = send => sent?,
                    error = subscription.disconnected() => return Err(sent_steps.end(error, Some(vertices.step))),
                }
            }
            known_origins = Some(vertices.origins);
            sent_steps.complete(vertices.step);
            sent_count += 1;
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

/// Splits the vertices of a step into chunks, of which the first has the head. A chunk belongs to one part. Vertices
/// without bytes are one empty chunk.
fn vertex_chunks(packed: &PackedVertices, max_chunk_bytes: usize) -> impl Iterator<Item = v1::VertexChunk> + use<> {
    let head = v1::VertexHead {
        step: Some(wire_step_id(packed.step)),
        sections: wire_sections(&packed.sections),
        total: packed.total_bytes(),
        skipped: packed.skipped,
        stages: wire_stages(&packed.stages),
    };
    let parts = if packed.parts.is_empty() { vec![Bytes::new()] } else { packed.parts.clone() };
    let (mut head, mut part_offset) = (Some(head), 0);
    parts.into_iter().flat_map(move |part| {
        let part_bytes = part.len() as u64;
        let chunks: Vec<v1::VertexChunk> = split_into_chunks(part, max_chunk_bytes)
            .map(|(offset, data)| v1::VertexChunk {
                head: head.take(),
                offset: part_offset + offset,
                data,
                shared: None,
            })
            .collect();
        part_offset += part_bytes;
        chunks
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::{Attribute, Encoding, Section, StepId};

    fn packed(parts: Vec<Bytes>) -> PackedVertices {
        let bytes = parts.iter().map(|part| part.len() as u64).sum();
        let sections = vec![Section { attribute: Attribute::Positions, encoding: Encoding::F32, offset: 0, bytes }];
        let step = StepId { run: 1, number: 2, time: 0.0 };
        PackedVertices { step, skipped: 0, stages: vec![], sections, parts, origins: Arc::new([]) }
    }

    #[test]
    fn chunks_refer_to_the_parts_and_only_the_first_has_a_head() {
        let parts: Vec<Bytes> = [250, 100, 1].map(|length| Bytes::from(vec![length; length.into()])).to_vec();
        let chunks: Vec<_> = vertex_chunks(&packed(parts.clone()), 100).collect();
        let offsets_and_sizes: Vec<_> = chunks.iter().map(|chunk| (chunk.offset, chunk.data.len())).collect();
        assert_eq!(offsets_and_sizes, [(0, 100), (100, 100), (200, 50), (250, 100), (350, 1)]);
        assert_eq!(chunks[1].data.as_ptr(), parts[0][100..].as_ptr());
        assert_eq!(chunks[0].head.as_ref().map(|head| head.total), Some(351));
        assert!(chunks[1..].iter().all(|chunk| chunk.head.is_none()));
    }

    #[test]
    fn vertices_without_bytes_are_one_chunk() {
        let chunks: Vec<_> = vertex_chunks(&packed(vec![]), 100).collect();
        assert_eq!(chunks.len(), 1);
        assert!(chunks[0].head.is_some() && chunks[0].data.is_empty());
    }
}
