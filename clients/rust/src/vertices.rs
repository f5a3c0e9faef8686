//! Deformed vertices of a step: positions per vertex and normals per corner in world axes, relative to an origin that
//! the set states. On request also displacements and bounding boxes.

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

/// The domains and attributes to return. The default is positions and normals of all domains. The server refuses
/// attributes that the scene does not keep.
pub use modalcast_proto::v1::VertexSelection;

/// A request for the vertices of one step.
pub type VertexRequest = StepRequest<VertexSelection>;

/// A subscription to the vertices of every step.
pub type VertexStreamRequest = Subscription<VertexSelection>;

/// A selected domain of a [`VertexSet`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct VertexSetDomain {
    pub index: u32,
    pub vertices: u32,
    pub corners: u32,
}

/// The vertices of one step.
#[derive(Debug, Clone, PartialEq)]
pub struct VertexSet {
    pub step: v1::StepId,
    /// World position of the origin of all positions, in meters. This is the scene's origin unless steps with f64
    /// translations move domains far from it; it may change from step to step.
    pub origin: Vec<f64>,
    /// The origin of each selected domain if the origins differ; otherwise empty.
    pub origins: Vec<[f64; 3]>,
    /// The selected domains, in the order of all arrays.
    pub domains: Vec<VertexSetDomain>,
    /// Three per vertex, selected domains concatenated; empty if omitted.
    pub positions: Vec<f32>,
    /// Three per corner; empty if omitted.
    pub normals: Vec<f32>,
    /// u = U q, three per vertex in the frame of its domain; empty unless requested.
    pub displacements: Vec<f32>,
    /// Per selected domain the minimum and the maximum x, y, z of its positions; empty unless requested.
    pub boxes: Vec<[[f32; 3]; 2]>,
    pub skipped: u64,
    pub stages: StageTimes,
}

impl VertexSet {
    /// The range of the `place`-th selected domain in `positions` and in `displacements`.
    pub fn range(&self, place: usize) -> Range<usize> {
        let before: usize = self.domains[..place].iter().map(|domain| 3 * domain.vertices as usize).sum();
        before..before + 3 * self.domains[place].vertices as usize
    }

    /// World position of the origin of the `place`-th selected domain, in meters. A vertex is at
    /// `origin_of(place) + unit * position`, with the unit of the scene's info.
    pub fn origin_of(&self, place: usize) -> [f64; 3] {
        let all = || std::array::from_fn(|axis| self.origin.get(axis).copied().unwrap_or(0.0));
        self.origins.get(place).copied().unwrap_or_else(all)
    }
}

impl Client {
    /// The vertices of one step.
    ///
    /// # Errors
    /// `Status` if the scene, a domain or the step does not exist, the scene does not keep a requested attribute, or
    /// the deadline passed; `Malformed`; `Connect`.
    pub async fn vertices(&self, request: &VertexRequest) -> Result<VertexSet> {
        use v1::get_vertices_request::Step;
        let wire = v1::GetVerticesRequest {
            scene: request.scene.clone(),
            selection: Some(request.query.clone()),
            step: request.step.to_wire(Step::ExactStep, Step::MinimumStep),
            deadline_ms: request.deadline_ms,
        };
        let messages = self.replies(VertexServiceClient::new(self.channel.clone()).get_vertices(wire).await)?;
        let set = ChunkedReplies::new(messages, |message| message.chunk, self.reply_limit).next().await;
        set.unwrap_or(Err(Error::StreamEnded { what: "the vertices" }))
    }

    /// Subscribes to vertices. When this returns, the server has accepted the subscription.
    ///
    /// # Errors
    /// `Status` if the scene or a domain does not exist, or the scene does not keep a requested attribute; `Connect`.
    pub async fn stream_vertices(&self, request: &VertexStreamRequest) -> Result<VertexStream> {
        let wire = v1::StreamVerticesRequest {
            scene: request.scene.clone(),
            selection: Some(request.query.clone()),
            delivery: v1::Delivery::from(request.delivery).into(),
            steps: request.replies,
        };
        let messages = self.replies(VertexServiceClient::new(self.channel.clone()).stream_vertices(wire).await)?;
        Ok(VertexStream(ChunkedReplies::new(messages, |message| message.chunk, self.reply_limit)))
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
        set(head, &bytes)
    }
}

fn set(head: v1::VertexHead, bytes: &[u8]) -> Result<VertexSet> {
    let counts = (head.domains.len(), head.vertices.len(), head.corners.len());
    if counts.0 != counts.1 || counts.0 != counts.2 {
        return Err(malformed_reply(
            "vertices.domains",
            "one count of vertices and corners each",
            format!("{counts:?}"),
        ));
    }
    let parts = parts(&head, bytes)?;
    let counts = head.vertices.iter().zip(&head.corners);
    let domains = head.domains.iter().zip(counts);
    let domain = |(index, (vertices, corners)): (&u32, (&u32, &u32))| VertexSetDomain {
        index: *index,
        vertices: *vertices,
        corners: *corners,
    };
    Ok(VertexSet {
        step: head.step.ok_or_else(|| malformed_reply("vertices.step", "a step", "none"))?,
        origin: head.origin,
        origins: decode("vertices.origins", parts.origins)?,
        domains: domains.map(domain).collect(),
        positions: decode("vertices.positions", parts.positions)?,
        normals: decode("vertices.normals", parts.normals)?,
        displacements: decode("vertices.displacements", parts.displacements)?,
        boxes: decode("vertices.boxes", parts.boxes)?,
        skipped: head.skipped,
        stages: stages::from_wire(head.stages),
    })
}

/// The bytes of a reply, split by the sizes in its head.
struct Parts<'a> {
    positions: &'a [u8],
    normals: &'a [u8],
    displacements: &'a [u8],
    boxes: &'a [u8],
    origins: &'a [u8],
}

fn parts<'a>(head: &v1::VertexHead, bytes: &'a [u8]) -> Result<Parts<'a>> {
    let sum = |list: &[u32]| 12 * list.iter().map(|count| u64::from(*count)).sum::<u64>();
    let (vertices, domains) = (sum(&head.vertices), 24 * head.domains.len() as u64);
    for (field, given, whole) in [
        ("vertices.position_bytes", head.position_bytes, vertices),
        ("vertices.displacement_bytes", head.displacement_bytes, vertices),
        ("vertices.box_bytes", head.box_bytes, domains),
        ("vertices.origin_bytes", head.origin_bytes, domains),
    ] {
        if given != 0 && given != whole {
            return Err(malformed_reply(field, format!("0 or {whole}"), given));
        }
    }
    let total = bytes.len() as u64;
    let bare = head.position_bytes + head.displacement_bytes + head.box_bytes + head.origin_bytes;
    if total != bare && total != bare + sum(&head.corners) {
        let expected = format!("{bare} or {}", bare + sum(&head.corners));
        return Err(malformed_reply("vertices.total", expected, total));
    }
    let (positions, rest) = bytes.split_at(head.position_bytes as usize);
    let (normals, rest) = rest.split_at((total - bare) as usize);
    let (displacements, rest) = rest.split_at(head.displacement_bytes as usize);
    let (boxes, origins) = rest.split_at(head.box_bytes as usize);
    Ok(Parts { positions, normals, displacements, boxes, origins })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn head(origin_bytes: u64) -> v1::VertexHead {
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
    fn a_set_reports_the_origin_of_each_domain() {
        let floats = [1.5_f32, 2.5, 3.5, 0.0, 0.0, 1.0].into_iter().flat_map(f32::to_le_bytes);
        let origins = [1e7_f64, 0.0, -1.0, 8.0, 9.0, 1e300].into_iter().flat_map(f64::to_le_bytes);
        let whole: Vec<u8> = floats.clone().chain(origins).collect();
        let with_own = set(head(48), &whole).expect("fits");
        assert_eq!((with_own.positions.as_slice(), with_own.normals.len()), ([1.5, 2.5, 3.5].as_slice(), 3));
        assert_eq!([with_own.origin_of(0), with_own.origin_of(1)], [[1e7, 0.0, -1.0], [8.0, 9.0, 1e300]]);
        let bare = set(head(48), &[&whole[..12], &whole[24..]].concat()).expect("without normals");
        assert_eq!((bare.normals.len(), bare.origin_of(1)), (0, [8.0, 9.0, 1e300]));
        let plain = set(head(0), &floats.collect::<Vec<u8>>()).expect("fits");
        assert_eq!((plain.origins.len(), plain.origin_of(1)), (0, [1.0, 2.0, 3.0]));
    }

    #[test]
    fn malformed_origins_are_refused_by_field() {
        for (origin_bytes, length, field) in
            [(24, 48, "origin_bytes"), (u64::MAX, 72, "origin_bytes"), (48, 24, "total"), (0, 72, "total")]
        {
            let refusal = set(head(origin_bytes), &vec![0; length]).expect_err(field).to_string();
            assert!(refusal.contains(field), "{refusal}");
        }
    }

    #[test]
    fn displacements_and_boxes_follow_optional_vertices() {
        let bytes = |from: u16, count: u16| (from..from + count).flat_map(|at| f32::from(at).to_le_bytes());
        let readback = |positions: bool| v1::VertexHead {
            position_bytes: if positions { 12 } else { 0 },
            displacement_bytes: 12,
            box_bytes: 48,
            ..head(0)
        };
        let with_all: Vec<u8> = bytes(0, 3).chain(bytes(10, 3)).chain(bytes(20, 3)).chain(bytes(30, 12)).collect();
        let all = set(readback(true), &with_all).expect("fits");
        assert_eq!((all.positions.as_slice(), all.normals.as_slice()), (&[0.0, 1.0, 2.0][..], &[10.0, 11.0, 12.0][..]));
        assert_eq!(all.displacements, [20.0, 21.0, 22.0]);
        let want = [[[30.0, 31.0, 32.0], [33.0, 34.0, 35.0]], [[36.0, 37.0, 38.0], [39.0, 40.0, 41.0]]];
        assert_eq!(all.boxes, want);
        let alone = set(readback(false), &with_all[24..]).expect("fits");
        assert_eq!((alone.displacements, alone.boxes), (all.displacements, all.boxes));
        assert!(alone.positions.is_empty() && alone.normals.is_empty());
        for (spoil, field) in [
            ((0, 12, 24), "box_bytes"),
            ((0, 24, 48), "displacement_bytes"),
            ((24, 12, 48), "position_bytes"),
            ((12, 0, 0), "total"),
        ] {
            let (position_bytes, displacement_bytes, box_bytes) = spoil;
            let head = v1::VertexHead { position_bytes, displacement_bytes, box_bytes, ..head(0) };
            let refusal = set(head, &with_all).expect_err(field).to_string();
            assert!(refusal.contains(field), "{refusal}");
        }
    }
}
