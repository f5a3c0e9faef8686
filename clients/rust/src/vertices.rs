//! Deformed vertices of a step: positions per vertex, relative to [`VertexSet::domain_origin`], and normals per corner,
//! both in world axes. Displacements and bounding boxes are optional.

use std::ops::Range;
use std::pin::Pin;
use std::task::{Context, Poll};

use bytes::Bytes;
use modalcast_proto::v1;
use v1::vertex_service_client::VertexServiceClient;

use crate::assemble::{Chunk, ChunkedReplies, WireChunk, decode};
use crate::client::Client;
use crate::error::{Error, Result, malformed_reply};
use crate::request::{StepRequest, Subscription};
use crate::stages::{self, StageTimes};

/// The domains and attributes to return. The default is positions and normals of all domains. The server rejects
/// attributes that `deform` in scene.toml does not enable.
pub use modalcast_proto::v1::VertexSelection;

/// A request for the vertices of one step.
pub type VertexRequest = StepRequest<VertexSelection>;

/// A subscription to the vertices of every step.
pub type VertexStreamRequest = Subscription<VertexSelection>;

/// A selected domain of a [`VertexSet`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct VertexSetDomain {
    pub index: u32,
    pub vertex_count: u32,
    pub corner_count: u32,
}

/// The vertices of one step.
#[derive(Debug, Clone, PartialEq)]
pub struct VertexSet {
    pub step: v1::StepId,
    /// World position of the common origin of all positions, in meters; meaningless if `domain_origins` is not empty.
    /// The common origin equals the scene's origin until f64 translations move domains far away. Then it follows the
    /// domains and may change from step to step.
    pub origin: Vec<f64>,
    /// The origin of each selected domain in meters, if the origins differ; otherwise empty.
    pub domain_origins: Vec<[f64; 3]>,
    /// The selected domains, in the order of all arrays.
    pub domains: Vec<VertexSetDomain>,
    /// Three numbers per vertex in scene units, selected domains concatenated; empty if omitted.
    pub positions: Vec<f32>,
    /// Three numbers per corner; empty if omitted.
    pub normals: Vec<f32>,
    /// u = U q, three numbers per vertex in the frame of its domain; empty unless requested.
    pub displacements: Vec<f32>,
    /// Per selected domain the minimum and the maximum x, y, z of its positions; empty unless requested.
    pub boxes: Vec<[[f32; 3]; 2]>,
    /// Number of steps skipped since the previous set of the stream.
    pub skipped: u64,
    pub stages: StageTimes,
}

impl VertexSet {
    /// The range of a selected domain in `positions` and in `displacements`. `ordinal` is its index in `domains`;
    /// `None` if it is out of range.
    pub fn float_range(&self, ordinal: usize) -> Option<Range<usize>> {
        let float_count = |domain: &VertexSetDomain| 3 * domain.vertex_count as usize;
        let domain = self.domains.get(ordinal)?;
        let start: usize = self.domains.iter().take(ordinal).map(float_count).sum();
        Some(start..start + float_count(domain))
    }

    /// World position of the origin of a selected domain, in meters. `ordinal` is its index in `domains`. A vertex is
    /// at `domain_origin(ordinal) + unit * position`, where `unit` is [`v1::SceneInfo::unit`].
    pub fn domain_origin(&self, ordinal: usize) -> [f64; 3] {
        let common_origin = || std::array::from_fn(|axis| self.origin.get(axis).copied().unwrap_or(0.0));
        self.domain_origins.get(ordinal).copied().unwrap_or_else(common_origin)
    }
}

impl Client {
    /// Gets the vertices of one step.
    ///
    /// # Errors
    /// `Status` if the scene, a domain or the step does not exist, the scene does not enable a requested attribute, or
    /// the deadline passed; `Malformed` if the reply contradicts itself; `Connect` if the connection is lost.
    pub async fn get_vertices(&self, request: &VertexRequest) -> Result<VertexSet> {
        let wire = v1::GetVerticesRequest {
            scene: request.scene.clone(),
            selection: Some(request.query.clone()),
            step: request.step.to_wire(),
            deadline_ms: request.deadline_ms,
        };
        let messages = self.replies(VertexServiceClient::new(self.channel.clone()).get_vertices(wire).await)?;
        let set = ChunkedReplies::new(messages, |message| message.chunk, self.max_reply_bytes).next().await;
        set.unwrap_or(Err(Error::StreamEnded { awaited_reply: "the vertices of the step" }))
    }

    /// Subscribes to vertices. When this returns, the server has accepted the subscription.
    ///
    /// # Errors
    /// `Status` if the scene or a domain does not exist, or the scene does not enable a requested attribute; `Connect`
    /// if the connection is lost.
    pub async fn stream_vertices(&self, request: &VertexStreamRequest) -> Result<VertexStream> {
        let wire = v1::StreamVerticesRequest {
            scene: request.scene.clone(),
            selection: Some(request.query.clone()),
            delivery: v1::Delivery::from(request.delivery).into(),
            steps: request.max_replies,
        };
        let messages = self.replies(VertexServiceClient::new(self.channel.clone()).stream_vertices(wire).await)?;
        Ok(VertexStream(ChunkedReplies::new(messages, |message| message.chunk, self.max_reply_bytes)))
    }
}

/// A stream of vertex sets; dropping it unsubscribes.
pub struct VertexStream(ChunkedReplies<v1::StreamVerticesResponse, v1::VertexChunk>);

impl VertexStream {
    /// The vertices of the next step, or `None` after the requested number of steps.
    pub async fn next(&mut self) -> Option<Result<VertexSet>> {
        self.0.next().await
    }
}

impl tokio_stream::Stream for VertexStream {
    type Item = Result<VertexSet>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.0.poll(context)
    }
}

impl WireChunk for v1::VertexChunk {
    type Head = v1::VertexHead;
    type Reply = VertexSet;
    const NAME: &'static str = "vertices";

    fn into_chunk(self) -> Chunk<Self::Head> {
        let head = self.head.map(|head| {
            let total = head.total;
            (head, total)
        });
        Chunk { head, offset: self.offset, data: self.data }
    }

    fn decode_reply(head: Self::Head, bytes: Bytes) -> Result<VertexSet> {
        decode_vertex_set(head, &bytes)
    }
}

fn decode_vertex_set(head: v1::VertexHead, bytes: &[u8]) -> Result<VertexSet> {
    let domain_count = head.domains.len();
    if head.vertices.len() != domain_count || head.corners.len() != domain_count {
        return Err(malformed_reply(
            "vertices.domains",
            format!("{domain_count} vertex counts and {domain_count} corner counts"),
            format!("{} and {}", head.vertices.len(), head.corners.len()),
        ));
    }
    let sections = split_reply(&head, bytes)?;
    let counts = head.vertices.iter().zip(&head.corners);
    let domains = head.domains.iter().zip(counts);
    let domain = |(index, (vertex_count, corner_count)): (&u32, (&u32, &u32))| VertexSetDomain {
        index: *index,
        vertex_count: *vertex_count,
        corner_count: *corner_count,
    };
    Ok(VertexSet {
        step: head.step.ok_or_else(|| malformed_reply("vertices.step", "a step", "none"))?,
        origin: head.origin,
        domain_origins: decode("vertices.origins", sections.origins)?,
        domains: domains.map(domain).collect(),
        positions: decode("vertices.positions", sections.positions)?,
        normals: decode("vertices.normals", sections.normals)?,
        displacements: decode("vertices.displacements", sections.displacements)?,
        boxes: decode("vertices.boxes", sections.boxes)?,
        skipped: head.skipped,
        stages: stages::from_wire(head.stages),
    })
}

/// The bytes of a reply, in the order of the fields. The head has the sizes of all sections but `normals`. The normals
/// are the remaining bytes.
struct ReplySections<'a> {
    positions: &'a [u8],
    normals: &'a [u8],
    displacements: &'a [u8],
    boxes: &'a [u8],
    origins: &'a [u8],
}

fn split_reply<'a>(head: &v1::VertexHead, bytes: &'a [u8]) -> Result<ReplySections<'a>> {
    // Size of three f32 per item.
    let float3_bytes = |counts: &[u32]| 12 * counts.iter().map(|count| u64::from(*count)).sum::<u64>();
    let vertex_bytes = float3_bytes(&head.vertices);
    let normal_bytes = float3_bytes(&head.corners);
    // A box has six f32 and an origin three f64: 24 bytes each.
    let domain_bytes = 24 * head.domains.len() as u64;
    for (field, section_bytes, complete_bytes) in [
        ("vertices.position_bytes", head.position_bytes, vertex_bytes),
        ("vertices.displacement_bytes", head.displacement_bytes, vertex_bytes),
        ("vertices.box_bytes", head.box_bytes, domain_bytes),
        ("vertices.origin_bytes", head.origin_bytes, domain_bytes),
    ] {
        if section_bytes != 0 && section_bytes != complete_bytes {
            return Err(malformed_reply(field, format!("0 or {complete_bytes}"), section_bytes));
        }
    }
    let total = bytes.len() as u64;
    let bytes_without_normals = head.position_bytes + head.displacement_bytes + head.box_bytes + head.origin_bytes;
    let bytes_with_normals = bytes_without_normals + normal_bytes;
    if total != bytes_without_normals && total != bytes_with_normals {
        let expected = format!("{bytes_without_normals} or {bytes_with_normals}");
        return Err(malformed_reply("vertices.total", expected, total));
    }
    let (positions, rest) = bytes.split_at(head.position_bytes as usize);
    let (normals, rest) = rest.split_at((total - bytes_without_normals) as usize);
    let (displacements, rest) = rest.split_at(head.displacement_bytes as usize);
    let (boxes, origins) = rest.split_at(head.box_bytes as usize);
    Ok(ReplySections { positions, normals, displacements, boxes, origins })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The head of a reply with two domains. The first has one vertex and no corner. The second has no vertex and one
    /// corner.
    fn two_domain_head(origin_bytes: u64) -> v1::VertexHead {
        v1::VertexHead {
            step: Some(v1::StepId::default()),
            origin: vec![1.0, 2.0, 3.0],
            domains: vec![4, 7],
            vertices: vec![1, 0],
            corners: vec![0, 1],
            position_bytes: 12,
            origin_bytes,
            ..Default::default()
        }
    }

    #[test]
    fn vertex_set_reports_the_origin_of_each_domain() {
        let vertex_and_normal = [1.5_f32, 2.5, 3.5, 0.0, 0.0, 1.0].into_iter().flat_map(f32::to_le_bytes);
        let origins = [1e7_f64, 0.0, -1.0, 8.0, 9.0, 1e300].into_iter().flat_map(f64::to_le_bytes);
        let reply: Vec<u8> = vertex_and_normal.clone().chain(origins).collect();
        let set = decode_vertex_set(two_domain_head(48), &reply).expect("a valid reply");
        assert_eq!((set.positions.as_slice(), set.normals.len()), ([1.5, 2.5, 3.5].as_slice(), 3));
        assert_eq!([set.domain_origin(0), set.domain_origin(1)], [[1e7, 0.0, -1.0], [8.0, 9.0, 1e300]]);
        assert_eq!([set.float_range(0), set.float_range(1), set.float_range(2)], [Some(0..3), Some(3..3), None]);
        let reply_without_normals = [&reply[..12], &reply[24..]].concat();
        let set = decode_vertex_set(two_domain_head(48), &reply_without_normals).expect("a valid reply");
        assert_eq!((set.normals.len(), set.domain_origin(1)), (0, [8.0, 9.0, 1e300]));
        let reply_without_origins: Vec<u8> = vertex_and_normal.collect();
        let set = decode_vertex_set(two_domain_head(0), &reply_without_origins).expect("a valid reply");
        assert_eq!((set.domain_origins.len(), set.domain_origin(1)), (0, [1.0, 2.0, 3.0]));
    }

    /// A valid reply has 12 bytes of positions, optionally 12 bytes of normals, and 0 or 48 bytes of origins.
    #[test]
    fn malformed_origins_report_their_field() {
        for (origin_bytes, length, field) in
            [(24, 48, "origin_bytes"), (u64::MAX, 72, "origin_bytes"), (48, 24, "total"), (0, 72, "total")]
        {
            let error =
                decode_vertex_set(two_domain_head(origin_bytes), &vec![0; length]).expect_err(field).to_string();
            assert!(error.contains(field), "{error}");
        }
    }

    #[test]
    fn decodes_displacements_and_boxes_with_and_without_positions() {
        let float_bytes = |first: u16, count: u16| (first..first + count).flat_map(|x| f32::from(x).to_le_bytes());
        let head = |position_bytes| v1::VertexHead {
            position_bytes,
            displacement_bytes: 12,
            box_bytes: 48,
            ..two_domain_head(0)
        };
        let positions_and_normals = float_bytes(0, 3).chain(float_bytes(10, 3));
        let reply: Vec<u8> = positions_and_normals.chain(float_bytes(20, 3)).chain(float_bytes(30, 12)).collect();
        let set = decode_vertex_set(head(12), &reply).expect("a valid reply");
        assert_eq!((set.positions.as_slice(), set.normals.as_slice()), (&[0.0, 1.0, 2.0][..], &[10.0, 11.0, 12.0][..]));
        assert_eq!(set.displacements, [20.0, 21.0, 22.0]);
        let boxes = [[[30.0, 31.0, 32.0], [33.0, 34.0, 35.0]], [[36.0, 37.0, 38.0], [39.0, 40.0, 41.0]]];
        assert_eq!(set.boxes, boxes);
        let set_without_positions = decode_vertex_set(head(0), &reply[24..]).expect("a valid reply");
        assert_eq!((set_without_positions.displacements, set_without_positions.boxes), (set.displacements, set.boxes));
        assert!(set_without_positions.positions.is_empty() && set_without_positions.normals.is_empty());
    }

    #[test]
    fn malformed_sizes_report_their_field() {
        // With positions, normals, displacements and boxes, a valid reply has 12 + 12 + 12 + 48 = 84 bytes.
        for (position_bytes, displacement_bytes, box_bytes, field) in [
            (0, 12, 24, "box_bytes"),
            (0, 24, 48, "displacement_bytes"),
            (24, 12, 48, "position_bytes"),
            (12, 0, 0, "total"),
        ] {
            let head = v1::VertexHead { position_bytes, displacement_bytes, box_bytes, ..two_domain_head(0) };
            let error = decode_vertex_set(head, &[0; 84]).expect_err(field).to_string();
            assert!(error.contains(field), "{error}");
        }
    }
}
