//! Deformed vertices of a step: positions per vertex, relative to [`VertexSet::domain_origin`], and normals per corner,
//! both in world axes. Displacements and bounding boxes are optional.

use std::ops::Range;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

pub use modalcast_proto::v1::{Attribute, Encoding};

use modalcast_proto::v1;
use v1::vertex_service_client::VertexServiceClient;

use crate::assemble::{Chunk, ChunkSequence, DecodedReplies, ReplyDecoder};
use crate::client::Client;
use crate::error::{Result, malformed_reply};
use crate::request::{StepRequest, Subscription};
use crate::shared_memory::CallMemory;
use crate::stages::{self, StageTimes};
use crate::vertex_sections::{SectionWriter, VertexArrays, VertexSetDomain};

/// The domains and attributes to return. The default is positions and normals of all domains, as f32. The server
/// rejects attributes that `deform` in scene.toml does not enable.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct VertexSelection {
    /// Domain indices in the order of the reply; empty for all domains.
    pub domains: Vec<u32>,
    /// Each attribute once, with its encoding; empty for positions and normals as f32.
    pub attributes: Vec<(Attribute, Encoding)>,
}

impl VertexSelection {
    /// Selects domains by index.
    #[must_use]
    pub fn domains(mut self, domains: &[u32]) -> Self {
        self.domains = domains.to_vec();
        self
    }

    /// Adds an attribute as f32.
    #[must_use]
    pub fn attribute(self, attribute: Attribute) -> Self {
        self.encoded_attribute(attribute, Encoding::F32)
    }

    /// Adds an attribute with an encoding that may take fewer bytes. [`Encoding`] states the error of each encoding.
    #[must_use]
    pub fn encoded_attribute(mut self, attribute: Attribute, encoding: Encoding) -> Self {
        self.attributes.push((attribute, encoding));
        self
    }

    fn to_wire(&self) -> v1::VertexSelection {
        let to_wire = |(attribute, encoding): &(Attribute, Encoding)| v1::SelectedAttribute {
            attribute: (*attribute).into(),
            encoding: (*encoding).into(),
        };
        v1::VertexSelection { domains: self.domains.clone(), attributes: self.attributes.iter().map(to_wire).collect() }
    }
}

/// A request for the vertices of one step.
pub type VertexRequest = StepRequest<VertexSelection>;

/// A subscription to the vertices of every step.
pub type VertexStreamRequest = Subscription<VertexSelection>;

/// The vertices of one step.
#[derive(Debug, Clone, PartialEq)]
pub struct VertexSet {
    pub step: v1::StepId,
    /// World position in meters of the common origin of all positions, or of the origin of each selected domain if the
    /// origins differ. The common origin equals that of the scene until f64 translations move domains far from there.
    /// Then it follows the domains and may differ per step.
    pub origins: Arc<[[f64; 3]]>,
    /// The selected domains, in the order of all arrays. All sets of a stream share them.
    pub domains: Arc<[VertexSetDomain]>,
    /// Three numbers per vertex in scene units, selected domains concatenated; empty unless selected.
    pub positions: Vec<f32>,
    /// Three numbers per corner; empty unless selected.
    pub normals: Vec<f32>,
    /// u = U q, three numbers per vertex in the frame of its domain; empty unless selected.
    pub displacements: Vec<f32>,
    /// Per selected domain the minimum and the maximum x, y, z of its positions; empty unless selected.
    pub boxes: Vec<[[f32; 3]; 2]>,
    /// Number of steps skipped since the previous set of the stream.
    pub skipped: u64,
    /// Size of the sent values in bytes, without the heads and the encoding of messages.
    pub encoded_bytes: u64,
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

    /// World position of the origin of all positions, in meters. `None` if the origins of the domains differ.
    pub fn common_origin(&self) -> Option<[f64; 3]> {
        match &*self.origins {
            [origin] => Some(*origin),
            _ => None,
        }
    }

    /// World position of the origin of a selected domain, in meters. `ordinal` is its index in `domains`. A vertex is
    /// at `domain_origin(ordinal) + unit * position`, where `unit` is [`v1::SceneInfo::unit`].
    pub fn domain_origin(&self, ordinal: usize) -> [f64; 3] {
        self.common_origin().or_else(|| self.origins.get(ordinal).copied()).unwrap_or_default()
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
            selection: Some(request.query.to_wire()),
            step: request.step.to_wire(),
            deadline_ms: request.deadline_ms,
        };
        let memory = self.call_memory().await?;
        let reply = VertexServiceClient::new(self.undecoded_channel()).get_vertices(memory.request(wire)).await;
        let decoder = VertexDecoder::new(single_part, self.max_reply_bytes, memory);
        DecodedReplies::new(self.replies(reply)?, decoder).single("the vertices of the step").await
    }

    /// Subscribes to vertices. When this returns, the server has accepted the subscription.
    ///
    /// # Errors
    /// `Status` if the scene or a domain does not exist, or the scene does not enable a requested attribute; `Connect`
    /// if the connection is lost.
    pub async fn stream_vertices(&self, request: &VertexStreamRequest) -> Result<VertexStream> {
        let wire = v1::StreamVerticesRequest {
            scene: request.scene.clone(),
            selection: Some(request.query.to_wire()),
            delivery: v1::Delivery::from(request.delivery).into(),
            steps: request.max_steps,
            max_hz: request.max_hz,
        };
        let channel = self.channel_for(request.delivery);
        let memory = self.call_memory().await?;
        let reply = VertexServiceClient::new(channel).stream_vertices(memory.request(wire)).await;
        let mut messages = self.replies(reply)?;
        let settings = match messages.next().await?.and_then(|message| message.part) {
            Some(v1::stream_vertices_response::Part::Settings(settings)) => settings,
            part => return Err(malformed_reply("vertices.part", "the settings of the stream", format!("{part:?}"))),
        };
        let sets = DecodedReplies::new(messages, VertexDecoder::new(stream_part, self.max_reply_bytes, memory));
        Ok(VertexStream { settings, sets })
    }
}

/// A stream of vertex sets; dropping it unsubscribes.
pub struct VertexStream {
    settings: v1::VertexStreamSettings,
    sets: DecodedReplies<v1::StreamVerticesResponse, VertexDecoder<v1::StreamVerticesResponse>>,
}

impl VertexStream {
    /// The settings in effect.
    pub const fn settings(&self) -> &v1::VertexStreamSettings {
        &self.settings
    }

    /// The vertices of the next step, or `None` after the requested number of steps.
    pub async fn next(&mut self) -> Option<Result<VertexSet>> {
        self.sets.next().await
    }
}

impl tokio_stream::Stream for VertexStream {
    type Item = Result<VertexSet>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.sets.poll(context)
    }
}

/// A message of a reply to `get_vertices` or `stream_vertices`.
enum Part {
    Layout(v1::VertexLayout),
    Chunk(v1::VertexChunk),
}

fn single_part(message: v1::GetVerticesResponse) -> Option<Part> {
    use v1::get_vertices_response::Part as Wire;
    message.part.map(|part| match part {
        Wire::Layout(layout) => Part::Layout(layout),
        Wire::Chunk(chunk) => Part::Chunk(chunk),
    })
}

fn stream_part(message: v1::StreamVerticesResponse) -> Option<Part> {
    use v1::stream_vertices_response::Part as Wire;
    match message.part? {
        Wire::Layout(layout) => Some(Part::Layout(layout)),
        Wire::Chunk(chunk) => Some(Part::Chunk(chunk)),
        Wire::Settings(_) => None,
    }
}

/// Decodes messages `M` to vertex sets. Keeps the layout and the last origins, which hold for the following sets.
struct VertexDecoder<M> {
    part_of: fn(M) -> Option<Part>,
    layout: Layout,
    /// Limit on the domains of the layout, so that its size in memory is at most that of a reply.
    max_domains: u64,
    origins: Option<Arc<[[f64; 3]]>>,
    chunks: ChunkSequence<v1::VertexHead>,
    /// The sections of the open set.
    sections: Option<SectionWriter>,
    memory: CallMemory,
}

impl<M> VertexDecoder<M> {
    fn new(part_of: fn(M) -> Option<Part>, max_reply_bytes: u64, memory: CallMemory) -> Self {
        Self {
            part_of,
            layout: Layout::Incomplete(Vec::new()),
            max_domains: max_reply_bytes / size_of::<VertexSetDomain>() as u64,
            origins: None,
            chunks: ChunkSequence::new("vertices", max_reply_bytes),
            sections: None,
            memory,
        }
    }

    /// Adds a chunk. Returns the set that it completes.
    fn add_chunk(&mut self, chunk: v1::VertexChunk) -> Result<Option<VertexSet>> {
        let Layout::Complete(domains) = &self.layout else {
            return Err(malformed_reply("vertices.layout", "a complete layout before the first step", "none"));
        };
        let data = self.memory.data(chunk.data, chunk.shared)?;
        let chunk = Chunk::new(chunk.head, |head| head.total, chunk.offset, data);
        let sections = &mut self.sections;
        let data = self.chunks.add(chunk, |reply| {
            *sections = Some(SectionWriter::new(&reply.head, domains)?);
            Ok(())
        })?;
        if let Some(sections) = &mut self.sections {
            sections.write(&data);
        }
        match (self.chunks.end_reply(), self.sections.take_if(|_| !self.chunks.is_open())) {
            (Some(head), Some(sections)) => {
                let set = vertex_set(head, sections.finish()?, Arc::clone(domains), self.origins.take())?;
                self.origins = Some(Arc::clone(&set.origins));
                Ok(Some(set))
            }
            _ => Ok(None),
        }
    }
}

impl<M> ReplyDecoder<M> for VertexDecoder<M> {
    type Reply = VertexSet;

    fn add_message(&mut self, message: M) -> Result<Option<VertexSet>> {
        match (self.part_of)(message) {
            None => Err(malformed_reply("vertices.part", "a layout or a chunk", "none")),
            Some(Part::Layout(layout)) => self.layout.add(&layout, self.max_domains).map(|()| None),
            Some(Part::Chunk(chunk)) => self.add_chunk(chunk),
        }
    }

    fn is_open(&self) -> bool {
        self.chunks.is_open()
    }

    fn end(&mut self) {
        self.memory.release();
    }
}

/// A set of decoded arrays. `last_origins` are those of the previous step.
fn vertex_set(
    head: v1::VertexHead,
    arrays: VertexArrays,
    domains: Arc<[VertexSetDomain]>,
    last_origins: Option<Arc<[[f64; 3]]>>,
) -> Result<VertexSet> {
    let VertexArrays { positions, normals, displacements, boxes, origins } = arrays;
    let missing_origins = || malformed_reply("vertices.origins", "origins in the first step", "none");
    Ok(VertexSet {
        step: head.step.ok_or_else(|| malformed_reply("vertices.step", "a step", "none"))?,
        origins: origins.or(last_origins).ok_or_else(missing_origins)?,
        domains,
        positions,
        normals,
        displacements,
        boxes,
        skipped: head.skipped,
        encoded_bytes: head.total,
        stages: stages::from_wire(head.stages),
    })
}

/// The selected domains of a reply.
enum Layout {
    /// The parts received so far.
    Incomplete(Vec<VertexSetDomain>),
    Complete(Arc<[VertexSetDomain]>),
}

impl Layout {
    fn add(&mut self, part: &v1::VertexLayout, max_domains: u64) -> Result<()> {
        let Self::Incomplete(domains) = self else {
            return Err(malformed_reply("vertices.layout", "one complete layout", "a further part"));
        };
        let count = part.domains.len();
        if (domains.len() + count) as u64 > max_domains {
            let expected = format!("at most {max_domains} domains");
            return Err(malformed_reply("vertices.layout", expected, domains.len() + count));
        }
        if part.vertices.len() != count || part.corners.len() != count {
            return Err(malformed_reply(
                "vertices.layout",
                format!("{count} vertex counts and {count} corner counts"),
                format!("{} and {}", part.vertices.len(), part.corners.len()),
            ));
        }
        let counts = part.vertices.iter().zip(&part.corners);
        domains.extend(part.domains.iter().zip(counts).map(|(index, (vertex_count, corner_count))| VertexSetDomain {
            index: *index,
            vertex_count: *vertex_count,
            corner_count: *corner_count,
        }));
        if !part.has_more {
            *self = Self::Complete(std::mem::take(domains).into());
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;

    use super::*;
    use crate::vertex_sections::tests::{NORMALS, ORIGIN, POSITIONS, float_bytes, head, two_domains};

    /// Decodes sections that arrive in one chunk.
    fn decode_vertex_set(
        head: v1::VertexHead,
        bytes: &[u8],
        domains: &Arc<[VertexSetDomain]>,
        last_origins: Option<Arc<[[f64; 3]]>>,
    ) -> Result<VertexSet> {
        let mut decoder = VertexDecoder::new(|chunk| Some(Part::Chunk(chunk)), 1 << 20, CallMemory::default());
        (decoder.layout, decoder.origins) = (Layout::Complete(Arc::clone(domains)), last_origins);
        let chunk = v1::VertexChunk { head: Some(head), offset: 0, data: Bytes::copy_from_slice(bytes), shared: None };
        decoder.add_message(chunk).map(|set| set.expect("expected a complete set"))
    }

    #[test]
    fn origins_are_kept_until_they_are_sent_again() {
        let origins = |numbers: &[f64]| numbers.iter().flat_map(|number| number.to_le_bytes()).collect::<Vec<u8>>();
        let per_domain = origins(&[1e7, 0.0, -1.0, 8.0, 9.0, 1e300]);
        let sections = [POSITIONS, NORMALS, (Attribute::Origins, Encoding::F64, 48)];
        let bytes = [float_bytes(1, 3), float_bytes(5, 3), per_domain].concat();
        let set = decode_vertex_set(head(&sections), &bytes, &two_domains(), None).expect("a valid reply");
        assert_eq!((set.positions.as_slice(), set.normals.as_slice()), (&[1.0, 2.0, 3.0][..], &[5.0, 6.0, 7.0][..]));
        assert_eq!([set.domain_origin(0), set.domain_origin(1)], [[1e7, 0.0, -1.0], [8.0, 9.0, 1e300]]);
        assert_eq!(set.common_origin(), None);
        assert_eq!([set.float_range(0), set.float_range(1), set.float_range(2)], [Some(0..3), Some(3..3), None]);
        let positions_only = decode_vertex_set(head(&[POSITIONS]), &bytes[..12], &two_domains(), Some(set.origins));
        assert_eq!(positions_only.expect("a valid reply").domain_origin(1), [8.0, 9.0, 1e300]);
        let common = [(Attribute::Origins, Encoding::F64, 24)];
        let set = decode_vertex_set(head(&common), &origins(&[1.0, 2.0, 3.0]), &two_domains(), None);
        let set = set.expect("a valid reply");
        assert_eq!((set.common_origin(), set.domain_origin(1)), (Some([1.0, 2.0, 3.0]), [1.0, 2.0, 3.0]));
        assert!(set.positions.is_empty() && set.boxes.is_empty());
    }

    #[test]
    fn decodes_boxes_and_encoded_attributes() {
        let sections = [
            (Attribute::Displacements, Encoding::F16, 6),
            (Attribute::Boxes, Encoding::F32, 48),
            (Attribute::Origins, Encoding::F64, 24),
        ];
        let bytes = [vec![0, 0x3c, 0, 0xc0, 0, 0], float_bytes(30, 12), vec![0; 24]].concat();
        let set = decode_vertex_set(head(&sections), &bytes, &two_domains(), None).expect("a valid reply");
        assert_eq!(set.displacements, [1.0, -2.0, 0.0]);
        let boxes = [[[30.0, 31.0, 32.0], [33.0, 34.0, 35.0]], [[36.0, 37.0, 38.0], [39.0, 40.0, 41.0]]];
        assert_eq!((set.boxes.as_slice(), set.encoded_bytes), (&boxes[..], 78));
    }

    #[test]
    fn chunks_of_a_set_arrive_one_after_the_other() {
        let mut decoder = VertexDecoder::new(|chunk| Some(Part::Chunk(chunk)), 1 << 20, CallMemory::default());
        let bytes = [float_bytes(1, 3), vec![0; 24]].concat();
        let chunk = |head, range: std::ops::Range<usize>| v1::VertexChunk {
            head,
            offset: range.start as u64,
            data: Bytes::copy_from_slice(&bytes[range]),
            shared: None,
        };
        let (head, empty_head) = (head(&[POSITIONS, ORIGIN]), head(&[]));
        let error = decoder.add_message(chunk(Some(head.clone()), 0..5)).expect_err("a chunk without a layout");
        assert!(error.to_string().contains("vertices.layout"), "{error}");
        decoder.layout = Layout::Complete(two_domains());
        for _ in 0..2 {
            assert_eq!(decoder.add_message(chunk(Some(head.clone()), 0..5)).expect("a valid chunk"), None);
            assert!(decoder.is_open());
            let set = decoder.add_message(chunk(None, 5..36)).expect("a valid chunk").expect("a complete set");
            assert_eq!((set.positions, set.encoded_bytes), (vec![1.0, 2.0, 3.0], 36));
            assert!(!decoder.is_open());
        }
        let set = decoder.add_message(chunk(Some(empty_head), 0..0)).expect("a valid chunk").expect("a complete set");
        assert!(set.positions.is_empty());
    }

    #[test]
    fn missing_origins_and_steps_are_malformed() {
        let error = |head| decode_vertex_set(head, &[0; 12], &two_domains(), None).expect_err("an error").to_string();
        assert!(error(head(&[POSITIONS])).contains("vertices.origins"));
        assert!(error(v1::VertexHead { step: None, ..head(&[POSITIONS]) }).contains("vertices.step"));
    }

    #[test]
    fn layout_arrives_in_parts_and_once() {
        let part = |first: u32, has_more| v1::VertexLayout {
            domains: vec![first, first + 1],
            vertices: vec![3, 4],
            corners: vec![5, 6],
            has_more,
        };
        let mut layout = Layout::Incomplete(Vec::new());
        layout.add(&part(0, true), 4).expect("a valid part");
        layout.add(&part(2, false), 4).expect("a valid part");
        let Layout::Complete(domains) = &layout else { panic!("expected a complete layout") };
        assert_eq!((domains.len(), domains[3]), (4, VertexSetDomain { index: 3, vertex_count: 4, corner_count: 6 }));
        assert!(layout.add(&part(4, false), 10).is_err(), "expected one layout");
        let wrong_counts = v1::VertexLayout { vertices: vec![1], ..part(0, false) };
        assert!(Layout::Incomplete(Vec::new()).add(&wrong_counts, 10).is_err());
        assert!(Layout::Incomplete(Vec::new()).add(&part(0, true), 1).is_err(), "expected a limit on the domains");
    }
}
