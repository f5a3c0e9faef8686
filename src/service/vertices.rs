//! `VertexService`: deformed vertices of one step with a deadline, or of every step. A reply contains positions in row
//! order of U, then normals, and the displacements and boxes if they are requested and the scene keeps them.

use std::sync::Arc;

use bytes::Bytes;
use modalcast_proto::v1;
use tonic::{Request, Response, Status};

use super::convert::{delivery, said, stages, step_id, which_of_vertices};
use super::status::status;
use super::stream::{Deadline, Outlet, Replies, pieces, respond};
use crate::engine::{Engine, Feed, Host, Packed, Selection, View, pack_vertices};
use modalcast_model::deform::Wanted;

/// Implementation of `VertexService`.
pub(super) struct Vertices(pub(super) Engine);

#[tonic::async_trait]
impl v1::vertex_service_server::VertexService for Vertices {
    type GetVerticesStream = Replies<v1::GetVerticesResponse>;

    async fn get_vertices(
        &self,
        request: Request<v1::GetVerticesRequest>,
    ) -> Result<Response<Self::GetVerticesStream>, Status> {
        let config = self.0.config();
        let deadline = Deadline::of_request(request.metadata(), request.get_ref().deadline_ms, config);
        let request = request.into_inner();
        let host = self.0.find(&request.scene).map_err(status)?;
        let selection = select(&host, request.selection)?;
        let which = which_of_vertices(request.step.as_ref());
        let most = config.chunk_bytes;
        Ok(respond(move |outlet| async move {
            let work = async {
                let shown = host.show(which, View::Vertices(selection.wanted)).await.map_err(status)?;
                let vertices = pack_vertices(shown, &selection).await.map_err(status)?;
                for chunk in chunks(&vertices, &selection, most) {
                    outlet.send(v1::GetVerticesResponse { chunk: Some(chunk) }).await?;
                }
                Ok(())
            };
            deadline.hold(&said(which, &host.name), work).await
        }))
    }

    type StreamVerticesStream = Replies<v1::StreamVerticesResponse>;

    async fn stream_vertices(
        &self,
        request: Request<v1::StreamVerticesRequest>,
    ) -> Result<Response<Self::StreamVerticesStream>, Status> {
        let deadline = Deadline::of_stream(request.metadata());
        let request = request.into_inner();
        let host = self.0.find(&request.scene).map_err(status)?;
        let selection = select(&host, request.selection)?;
        let delivery = delivery(request.delivery).map_err(status)?;
        // Subscribe before the response headers are sent, so that a client can rely on receiving the next step.
        let feed = host.watch(View::Vertices(selection.wanted), delivery).await.map_err(status)?;
        let show = Show { selection, most: self.0.config().chunk_bytes, steps: request.steps };
        Ok(respond(move |outlet| deadline.hold("the end of the vertex stream", show.run(feed, outlet))))
    }
}

/// Parameters of a vertex stream.
struct Show {
    selection: Arc<Selection>,
    most: usize,
    /// Number of steps to send; 0 means no limit.
    steps: u64,
}

impl Show {
    async fn run(self, mut feed: Feed, outlet: Outlet<v1::StreamVerticesResponse>) -> Result<(), Status> {
        let mut sent = 0;
        while self.steps == 0 || sent < self.steps {
            let shown = tokio::select! {
                shown = feed.next() => shown.map_err(status)?,
                () = outlet.closed() => return Ok(()),
            };
            let vertices = pack_vertices(shown, &self.selection).await.map_err(status)?;
            for chunk in chunks(&vertices, &self.selection, self.most) {
                tokio::select! {
                    sent = outlet.send(v1::StreamVerticesResponse { chunk: Some(chunk) }) => sent?,
                    error = feed.cut_off() => return Err(status(error)),
                }
            }
            sent += 1;
        }
        Ok(())
    }
}

fn select(host: &Host, selection: Option<v1::VertexSelection>) -> Result<Arc<Selection>, Status> {
    let v1::VertexSelection { domains, positions_only, displacements, boxes, without_vertices } =
        selection.unwrap_or_default();
    let positions = !without_vertices;
    let wanted = Wanted { positions, normals: positions && !positions_only, displacements, boxes };
    Selection::new(&host.scene, domains, wanted).map(Arc::new).map_err(status)
}

fn chunks(packed: &Packed, selection: &Selection, most: usize) -> impl Iterator<Item = v1::VertexChunk> + use<> {
    let vertices = &packed.encoded;
    let head = v1::VertexHead {
        step: Some(step_id(vertices.step)),
        origin: packed.origin.to_vec(),
        domains: selection.domains.clone(),
        vertices: selection.vertices().collect(),
        corners: selection.corners().collect(),
        position_bytes: selection.position_bytes(),
        total: vertices.bytes.len() as u64,
        skipped: vertices.skipped,
        stages: stages(&vertices.stages),
        origin_bytes: packed.origin_bytes,
        displacement_bytes: selection.displacement_bytes(),
        box_bytes: selection.box_bytes(),
    };
    let mut head = Some(head);
    let cut = move |(offset, data): (u64, Bytes)| v1::VertexChunk { head: head.take(), offset, data };
    pieces(vertices.bytes.clone(), most).map(cut)
}
