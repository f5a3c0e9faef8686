//! States of a scene: the coordinates q and the transforms T of its domains at a step. From them a client computes the
//! vertices x = T (x0 + U q) by itself. A stream sends only what changes; the client applies it and returns complete
//! states.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use bytes::Bytes;
use modalcast_proto::v1;
use v1::StateContent;
use v1::state_service_client::StateServiceClient;

use crate::assemble::{Assembler, Chunk, DecodedReplies, ReplyDecoder, decode};
use crate::client::Client;
use crate::error::{Error, Result, malformed_reply};
use crate::request::{StepRequest, Subscription};
use crate::scene::SceneDescription;
use crate::stages::{self, StageTimes};

/// A row-major 3x4 matrix.
type Matrix3x4 = [f32; 12];

/// Where the values of each domain are stored in the states of a scene. Built once from the description of the scene.
#[derive(Debug, Clone, PartialEq)]
pub struct StateLayout {
    domains: Vec<DomainSlot>,
    coordinate_count: usize,
    /// The domains with a transform of their own, in order.
    pub(crate) roots: Vec<u32>,
    /// `root_from_domain` of the domains that follow another one.
    follow_frames: Vec<Matrix3x4>,
}

/// The values of one domain.
#[derive(Debug, Clone, Copy, PartialEq)]
struct DomainSlot {
    first_coordinate: usize,
    rank: usize,
    owns_q: bool,
    /// Index of the transform of the domain, or of the domain that it follows.
    root: usize,
    /// Index in `StateLayout::follow_frames`; `None` for a domain that follows no other.
    follow_frame: Option<usize>,
}

impl StateLayout {
    /// The layout of a scene whose domains are all described; arrays are not needed.
    ///
    /// # Errors
    /// `Malformed` if domains are missing, or one refers to a domain that does not precede it.
    pub fn new(description: &SceneDescription) -> Result<Arc<Self>> {
        let mut layout = Self { domains: vec![], coordinate_count: 0, roots: vec![], follow_frames: vec![] };
        let domain_count = description.info.domains as usize;
        if description.domains.len() != domain_count {
            return Err(malformed_reply("describe.domains", domain_count, description.domains.len()));
        }
        // In f64, so that a chain of followers is rounded only once.
        let mut unrounded_frames: Vec<[f64; 12]> = Vec::new();
        for (index, domain) in description.domains.iter().enumerate() {
            let earlier_domain = |other: usize| {
                let expected = format!("a domain before domain {index}");
                layout.domains.get(other).copied().ok_or_else(|| malformed_reply("describe.domains", expected, other))
            };
            let first_coordinate = match domain.shares_q_with {
                Some(owner) => earlier_domain(owner)?.first_coordinate,
                None => layout.coordinate_count,
            };
            let (root, follow_frame) = match &domain.follow {
                None => (layout.roots.len(), None),
                Some(follow) => {
                    let leader = earlier_domain(follow.leader)?;
                    let frame = follow.leader_from_follower.map(f64::from);
                    let leader_frame = leader.follow_frame.map(|frame| unrounded_frames[frame]);
                    unrounded_frames.push(leader_frame.map_or(frame, |leader_frame| product(&leader_frame, &frame)));
                    (leader.root, Some(unrounded_frames.len() - 1))
                }
            };
            let owns_q = domain.shares_q_with.is_none();
            layout.domains.push(DomainSlot { first_coordinate, rank: domain.rank, owns_q, root, follow_frame });
            layout.coordinate_count += if owns_q { domain.rank } else { 0 };
            if follow_frame.is_none() {
                layout.roots.push(index as u32);
            }
        }
        layout.follow_frames = unrounded_frames.into_iter().map(|frame| frame.map(|entry| entry as f32)).collect();
        Ok(Arc::new(layout))
    }

    /// The number of domains.
    pub const fn domain_count(&self) -> usize {
        self.domains.len()
    }

    /// Whether the domain has coordinates that it shares with no domain before it.
    pub(crate) fn owns_coordinates(&self, domain: u32) -> bool {
        self.domains.get(domain as usize).is_some_and(|slot| slot.owns_q && slot.rank > 0)
    }

    fn owns_transform(&self, domain: u32) -> bool {
        self.domains.get(domain as usize).is_some_and(|slot| slot.follow_frame.is_none())
    }
}

/// The product of two affine transforms, row-major 3x4.
fn product(a: &[f64; 12], b: &[f64; 12]) -> [f64; 12] {
    std::array::from_fn(|index| {
        let (row, column) = (index / 4, index % 4);
        let sum: f64 = (0..3).map(|k| a[4 * row + k] * b[4 * k + column]).sum();
        sum + if column == 3 { a[4 * row + 3] } else { 0.0 }
    })
}

/// The complete state of a scene at a step.
#[derive(Debug, Clone, PartialEq)]
pub struct SceneState {
    pub step: v1::StepId,
    /// Number of steps skipped since the previous state of the stream.
    pub skipped: u64,
    /// Size of the sent values in bytes, without the heads and the encoding of messages.
    pub encoded_bytes: u64,
    /// In a stream, only as [`StateStreamOptions::stages_every`] demands.
    pub stages: StageTimes,
    pub(crate) layout: Arc<StateLayout>,
    /// Of the domains that own their coordinates, in order.
    pub(crate) q: Vec<f32>,
    /// One per domain that follows no other.
    pub(crate) transforms: Vec<Matrix3x4>,
    /// World positions in meters of the origins of the transforms: one origin for all, or one per transform if they
    /// differ.
    pub(crate) origins: Vec<[f64; 3]>,
}

impl SceneState {
    /// The coordinates of a domain: r numbers. `None` if the scene has no such domain.
    pub fn q(&self, domain: usize) -> Option<&[f32]> {
        let slot = self.layout.domains.get(domain)?;
        self.q.get(slot.first_coordinate..)?.get(..slot.rank)
    }

    /// `world_from_domain` of a domain, row-major 3x4, in scene units relative to [`Self::origin`]. The transform of a
    /// domain that follows another one is a product, rounded to f32. `None` if the scene has no such domain.
    pub fn transform(&self, domain: usize) -> Option<[f32; 12]> {
        let slot = self.layout.domains.get(domain)?;
        let root = self.transforms.get(slot.root)?;
        let Some(frame) = slot.follow_frame else { return Some(*root) };
        let frame = self.layout.follow_frames.get(frame)?;
        Some(product(&root.map(f64::from), &frame.map(f64::from)).map(|entry| entry as f32))
    }

    /// World position in meters of the origin of a domain's transform. A vertex is at `origin + unit * T (x0 + U q)`,
    /// where `unit` is [`v1::SceneInfo::unit`]. `None` if the scene has no such domain.
    pub fn origin(&self, domain: usize) -> Option<[f64; 3]> {
        let slot = self.layout.domains.get(domain)?;
        match self.origins.as_slice() {
            [origin] => Some(*origin),
            origins => origins.get(slot.root).copied(),
        }
    }
}

/// A request for the state of one step.
pub type StateRequest = StepRequest<()>;

/// A subscription to the states of every step.
pub type StateStreamRequest = Subscription<StateStreamOptions>;

/// The contents of the states of a stream.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct StateStreamOptions {
    /// The first state and every n-th one after it has stage times; 0: no state.
    pub stages_every: u32,
}

impl From<()> for StateStreamOptions {
    fn from((): ()) -> Self {
        Self::default()
    }
}

impl Client {
    /// Gets the state of one step.
    ///
    /// # Errors
    /// `Status` if the scene or the step does not exist or the deadline passed; `Malformed` if the reply contradicts
    /// itself or the layout; `Connect` if the connection is lost.
    pub async fn get_state(&self, request: &StateRequest, layout: &Arc<StateLayout>) -> Result<Arc<SceneState>> {
        let wire = v1::GetStateRequest {
            scene: request.scene.clone(),
            step: request.step.to_wire(),
            deadline_ms: request.deadline_ms,
        };
        let messages = self.replies(StateServiceClient::new(self.undecoded_channel()).get_state(wire).await)?;
        let chunk_of = |message: v1::GetStateResponse| message.chunk;
        let decoder = StateMessageDecoder::new(chunk_of, layout, self.max_reply_bytes);
        let state = DecodedReplies::new(messages, decoder).next().await;
        state.unwrap_or(Err(Error::StreamEnded { awaited_reply: "the state of the step" }))
    }

    /// Subscribes to states. When this returns, the server has accepted the subscription.
    ///
    /// # Errors
    /// `Status` if the scene does not exist or `max_hz` is invalid; `Malformed` if the first message has no settings;
    /// `Connect` if the connection is lost.
    pub async fn stream_states(&self, request: &StateStreamRequest, layout: &Arc<StateLayout>) -> Result<StateStream> {
        use v1::stream_states_response::Part;
        let wire = v1::StreamStatesRequest {
            scene: request.scene.clone(),
            delivery: v1::Delivery::from(request.delivery).into(),
            max_hz: request.max_hz,
            steps: request.max_steps,
            stages_every: request.query.stages_every,
        };
        let channel = self.channel_for(request.delivery);
        let mut messages = self.replies(StateServiceClient::new(channel).stream_states(wire).await)?;
        let first_message = messages.next().await?.and_then(|message| message.part);
        let Some(Part::Settings(settings)) = first_message else {
            return Err(malformed_reply("states.settings", "settings as the first message", "another message"));
        };
        let chunk_of = |message: v1::StreamStatesResponse| match message.part {
            Some(Part::Chunk(chunk)) => Some(chunk),
            _ => None,
        };
        let replies = DecodedReplies::new(messages, StateMessageDecoder::new(chunk_of, layout, self.max_reply_bytes));
        Ok(StateStream { settings, replies })
    }
}

/// A stream of complete states; dropping it unsubscribes. When changes arrive, the stream copies the previous state
/// only if the caller still holds it.
pub struct StateStream {
    /// The settings in effect.
    pub settings: v1::StateStreamSettings,
    replies: DecodedReplies<v1::StreamStatesResponse, StateMessageDecoder<v1::StreamStatesResponse>>,
}

impl StateStream {
    /// The state of the next step, or `None` after the requested number of states.
    pub async fn next(&mut self) -> Option<Result<Arc<SceneState>>> {
        self.replies.next().await
    }
}

impl tokio_stream::Stream for StateStream {
    type Item = Result<Arc<SceneState>>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.replies.poll(context)
    }
}

/// Decodes the chunks of consecutive states, of which the first is complete. Keeps the last state, to which changes are
/// applied.
pub struct StateDecoder {
    layout: Arc<StateLayout>,
    assembler: Assembler<v1::StateHead>,
    last_state: Option<Arc<SceneState>>,
    sent_values: SentValues,
}

/// The values that a state has on the wire. All other values are equal to those of the previous state.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SentValues {
    /// Whether the state has all values.
    pub is_complete: bool,
    /// Domains with coordinates, ascending.
    pub q_domains: Vec<u32>,
    /// Domains with transforms, ascending.
    pub transform_domains: Vec<u32>,
    /// Whether the state has the origins of the transforms.
    pub origins: bool,
}

impl StateDecoder {
    /// A decoder for states of at most `max_bytes` bytes.
    pub fn new(layout: &Arc<StateLayout>, max_bytes: u64) -> Self {
        let assembler = Assembler::new("states", max_bytes);
        Self { layout: Arc::clone(layout), assembler, last_state: None, sent_values: SentValues::default() }
    }

    /// The values that the last state had on the wire.
    pub const fn sent_values(&self) -> &SentValues {
        &self.sent_values
    }

    /// Adds the next chunk. Returns the state that it completes.
    ///
    /// # Errors
    /// `Malformed` if the chunk contradicts the previous ones or the layout, or the first state is not complete.
    pub fn add_chunk(&mut self, chunk: v1::StateChunk) -> Result<Option<Arc<SceneState>>> {
        match self.assembler.push(Chunk::new(chunk.head, |head| head.total, chunk.offset, chunk.data))? {
            Some((head, bytes)) => self.decode_state(head, &bytes).map(Some),
            None => Ok(None),
        }
    }

    fn decode_state(&mut self, head: v1::StateHead, bytes: &Bytes) -> Result<Arc<SceneState>> {
        let changes = StateChanges::decode(&head, bytes, &self.layout)?;
        let mut state = match self.last_state.take() {
            Some(last_state) if !head.complete => last_state,
            None if !head.complete => {
                return Err(malformed_reply("states.complete", "a complete first state", "changes"));
            }
            _ => Arc::new(changes.complete_state(&self.layout)?),
        };
        let changed_state = Arc::make_mut(&mut state);
        self.sent_values = SentValues { is_complete: head.complete, ..changes.apply(changed_state) };
        changed_state.step = head.step.ok_or_else(|| malformed_reply("states.step", "a step", "none"))?;
        changed_state.skipped = head.skipped;
        changed_state.encoded_bytes = bytes.len() as u64;
        changed_state.stages = stages::from_wire(head.stages);
        self.last_state = Some(Arc::clone(&state));
        Ok(state)
    }
}

/// Decodes messages `M` to states.
struct StateMessageDecoder<M> {
    chunk_of: fn(M) -> Option<v1::StateChunk>,
    states: StateDecoder,
}

impl<M> StateMessageDecoder<M> {
    fn new(chunk_of: fn(M) -> Option<v1::StateChunk>, layout: &Arc<StateLayout>, max_reply_bytes: u64) -> Self {
        Self { chunk_of, states: StateDecoder::new(layout, max_reply_bytes) }
    }
}

impl<M> ReplyDecoder<M> for StateMessageDecoder<M> {
    type Reply = Arc<SceneState>;

    fn add_message(&mut self, message: M) -> Result<Option<Arc<SceneState>>> {
        let chunk = (self.chunk_of)(message).ok_or_else(|| malformed_reply("states.part", "a chunk", "none"))?;
        self.states.add_chunk(chunk)
    }

    fn is_open(&self) -> bool {
        self.states.assembler.is_open()
    }
}

/// The sections of a state. Indices are in range and every list has the length that the layout demands.
#[derive(Debug, Default)]
struct StateChanges {
    q_domains: Vec<u32>,
    q: Vec<f32>,
    transform_domains: Vec<u32>,
    transforms: Vec<Matrix3x4>,
    /// Empty if the origins have not changed.
    origins: Vec<[f64; 3]>,
}

impl StateChanges {
    fn decode(head: &v1::StateHead, bytes: &[u8], layout: &StateLayout) -> Result<Self> {
        let mut changes = Self::default();
        let mut offset = 0;
        for (index, section) in head.sections.iter().enumerate() {
            let field = format!("states.sections[{index}]");
            let end = section.offset.checked_add(section.bytes).filter(|end| *end <= bytes.len() as u64);
            let Some(end) = end.filter(|_| section.offset == offset) else {
                let expected = format!("a section at {offset} within {} bytes", bytes.len());
                return Err(malformed_reply(field, expected, format!("{} bytes at {}", section.bytes, section.offset)));
            };
            let section_bytes = &bytes[offset as usize..end as usize];
            offset = end;
            match section.content() {
                StateContent::QDomains => changes.q_domains = decode(&field, section_bytes)?,
                StateContent::Q => changes.q = decode(&field, section_bytes)?,
                StateContent::TransformDomains => changes.transform_domains = decode(&field, section_bytes)?,
                StateContent::Transforms => changes.transforms = decode(&field, section_bytes)?,
                StateContent::Origins => changes.origins = decode(&field, section_bytes)?,
                // A content of a newer server.
                StateContent::Unspecified => {}
            }
        }
        if offset != bytes.len() as u64 {
            return Err(malformed_reply("states.total", offset, bytes.len()));
        }
        // A list that is left out has all domains.
        if changes.q_domains.is_empty() && !changes.q.is_empty() {
            changes.q_domains =
                (0..layout.domain_count() as u32).filter(|domain| layout.owns_coordinates(*domain)).collect();
        }
        if changes.transform_domains.is_empty() && !changes.transforms.is_empty() {
            changes.transform_domains.clone_from(&layout.roots);
        }
        changes.check(layout)?;
        Ok(changes)
    }

    fn check(&self, layout: &StateLayout) -> Result<()> {
        check_domains("states.q_domains", &self.q_domains, |domain| layout.owns_coordinates(domain))?;
        check_domains("states.transform_domains", &self.transform_domains, |domain| layout.owns_transform(domain))?;
        let coordinate_count: usize = self.q_domains.iter().map(|domain| layout.domains[*domain as usize].rank).sum();
        if self.q.len() != coordinate_count {
            return Err(malformed_reply("states.q", format!("{coordinate_count} numbers"), self.q.len()));
        }
        if self.transforms.len() != self.transform_domains.len() {
            let expected = format!("{} transforms", self.transform_domains.len());
            return Err(malformed_reply("states.transforms", expected, self.transforms.len()));
        }
        if self.origins.len() > 1 && self.origins.len() != layout.roots.len() {
            let expected = format!("1 or {} origins", layout.roots.len());
            return Err(malformed_reply("states.origins", expected, self.origins.len()));
        }
        Ok(())
    }

    /// A new state, if the changes have all values. The values of the state are zeros until [`Self::apply`] sets them.
    fn complete_state(&self, layout: &Arc<StateLayout>) -> Result<SceneState> {
        let is_complete = self.q.len() == layout.coordinate_count
            && self.transforms.len() == layout.roots.len()
            && !self.origins.is_empty();
        if !is_complete {
            let expected = format!("{} coordinates and {} transforms", layout.coordinate_count, layout.roots.len());
            let given = format!("{} and {}", self.q.len(), self.transforms.len());
            return Err(malformed_reply("states.complete", expected, given));
        }
        Ok(SceneState {
            step: v1::StepId::default(),
            skipped: 0,
            encoded_bytes: 0,
            stages: StageTimes::new(),
            layout: Arc::clone(layout),
            q: vec![0.0; layout.coordinate_count],
            transforms: vec![[0.0; 12]; layout.roots.len()],
            origins: Vec::new(),
        })
    }

    /// Applies the changes. Returns what has changed.
    fn apply(self, state: &mut SceneState) -> SentValues {
        let layout = Arc::clone(&state.layout);
        let mut values = self.q.as_slice();
        for domain in &self.q_domains {
            let slot = layout.domains[*domain as usize];
            let (domain_q, remaining_values) = values.split_at(slot.rank);
            state.q[slot.first_coordinate..][..slot.rank].copy_from_slice(domain_q);
            values = remaining_values;
        }
        for (domain, transform) in self.transform_domains.iter().zip(self.transforms) {
            state.transforms[layout.domains[*domain as usize].root] = transform;
        }
        let Self { q_domains, transform_domains, origins, .. } = self;
        let has_origins = !origins.is_empty();
        if has_origins {
            state.origins = origins;
        }
        SentValues { is_complete: false, q_domains, transform_domains, origins: has_origins }
    }
}

/// Checks that the indices ascend and satisfy a condition.
fn check_domains(field: &str, domains: &[u32], is_valid: impl Fn(u32) -> bool) -> Result<()> {
    let is_ascending = domains.is_sorted_by(|a, b| a < b);
    match domains.iter().find(|domain| !is_valid(**domain)) {
        None if is_ascending => Ok(()),
        None => Err(malformed_reply(field, "ascending indices", "another order")),
        Some(domain) => Err(malformed_reply(field, "domains with values of their own", domain)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Domain, Follow};

    const IDENTITY: Matrix3x4 = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];

    /// Domain 0 has two modes; domain 1 has one mode and follows domain 0; domain 2 follows domain 1 and shares the
    /// coordinates of domain 0. Each follower is one unit further along x.
    fn layout() -> Arc<StateLayout> {
        let domain = |index, rank| Domain { index, rank, ..Domain::default() };
        let mut leader_from_follower = IDENTITY;
        leader_from_follower[3] = 1.0;
        let follow = |leader| Some(Follow { leader, leader_from_follower });
        let domains = vec![
            domain(0, 2),
            Domain { follow: follow(0), ..domain(1, 1) },
            Domain { follow: follow(1), shares_q_with: Some(0), ..domain(2, 2) },
        ];
        let info = v1::SceneInfo { domains: 3, ..Default::default() };
        StateLayout::new(&SceneDescription { info, domains, ..SceneDescription::default() })
            .expect("a valid description")
    }

    fn decoder() -> StateMessageDecoder<v1::GetStateResponse> {
        StateMessageDecoder::new(|message| message.chunk, &layout(), 1 << 20)
    }

    /// A state in one message, whose sections follow each other.
    fn message(complete: bool, sections: &[(StateContent, Vec<u8>)]) -> v1::GetStateResponse {
        let mut head = v1::StateHead { step: Some(v1::StepId::default()), complete, ..Default::default() };
        let mut data = Vec::new();
        for (content, bytes) in sections {
            let (content, offset) = ((*content).into(), data.len() as u64);
            head.sections.push(v1::StateSection { content, offset, bytes: bytes.len() as u64 });
            data.extend_from_slice(bytes);
        }
        head.total = data.len() as u64;
        v1::GetStateResponse { chunk: Some(v1::StateChunk { head: Some(head), offset: 0, data: data.into() }) }
    }

    fn bytes_of<T: bytemuck::NoUninit>(numbers: &[T]) -> Vec<u8> {
        bytemuck::cast_slice(numbers).to_vec()
    }

    fn complete_sections() -> Vec<(StateContent, Vec<u8>)> {
        vec![
            (StateContent::QDomains, bytes_of(&[0_u32, 1])),
            (StateContent::Q, bytes_of(&[1.0_f32, 2.0, 3.0])),
            (StateContent::TransformDomains, bytes_of(&[0_u32])),
            (StateContent::Transforms, bytes_of(&IDENTITY)),
            (StateContent::Origins, bytes_of(&[1e7_f64, 0.0, -1.0])),
        ]
    }

    #[test]
    fn changes_are_applied_to_a_copy_if_the_state_is_still_held() {
        let mut decoder = decoder();
        let mut add = |message| decoder.add_message(message).expect("a valid message").expect("a complete state");
        let first = add(message(true, &complete_sections()));
        assert_eq!([first.q(0), first.q(1), first.q(2)], [Some(&[1.0, 2.0][..]), Some(&[3.0]), Some(&[1.0, 2.0])]);
        assert_eq!(first.q(3), None);
        assert_eq!([0, 1, 2].map(|domain| first.transform(domain).map(|matrix| matrix[3])), [0.0, 1.0, 2.0].map(Some));
        let changes = [
            (StateContent::QDomains, bytes_of(&[1_u32])),
            (StateContent::Q, bytes_of(&[7.0_f32])),
            // A content that this client does not know.
            (StateContent::Unspecified, vec![9; 5]),
        ];
        let second = add(message(false, &changes));
        assert_eq!((second.q(1), second.q(2), second.encoded_bytes), (Some(&[7.0][..]), Some(&[1.0, 2.0][..]), 13));
        assert_eq!(second.origin(2), Some([1e7, 0.0, -1.0]));
        assert_eq!(first.q(1), Some(&[3.0][..]), "control: the held state is unchanged");
    }

    #[test]
    fn lists_that_are_left_out_have_all_domains() {
        let [_, q, _, transforms, origins] = complete_sections().try_into().expect("five sections");
        let mut decoder = decoder();
        let state = decoder.add_message(message(true, &[q, transforms, origins])).expect("a valid message");
        let state = state.expect("a complete state");
        assert_eq!([state.q(0), state.q(1), state.q(2)], [Some(&[1.0, 2.0][..]), Some(&[3.0]), Some(&[1.0, 2.0])]);
        assert_eq!(state.transform(0), Some(IDENTITY));
        let expected =
            SentValues { is_complete: true, q_domains: vec![0, 1], transform_domains: vec![0], origins: true };
        assert_eq!(decoder.states.sent_values(), &expected);
    }

    #[test]
    fn malformed_states_report_their_field() {
        let with_section = |index: usize, bytes: Vec<u8>| {
            let mut sections = complete_sections();
            sections[index].1 = bytes;
            message(true, &sections)
        };
        for (message, field) in [
            (message(false, &complete_sections()), "states.complete"),
            (message(true, &complete_sections()[..4]), "states.complete"),
            (message(true, &complete_sections()[2..]), "states.complete"),
            (with_section(0, bytes_of(&[0_u32, 2])), "states.q_domains"),
            (with_section(0, bytes_of(&[1_u32, 0])), "states.q_domains"),
            (with_section(0, bytes_of(&[0_u32, 9])), "states.q_domains"),
            (with_section(1, bytes_of(&[1.0_f32])), "states.q"),
            (with_section(2, bytes_of(&[1_u32])), "states.transform_domains"),
            (with_section(3, vec![0; 47]), "states.sections[3]"),
            (with_section(4, vec![0; 48]), "states.origins"),
            (v1::GetStateResponse { chunk: None }, "states.part"),
        ] {
            let error = decoder().add_message(message).expect_err(field).to_string();
            assert!(error.contains(field), "expected {field}, got {error}");
        }
    }

    #[test]
    fn layout_needs_all_domains_and_earlier_leaders() {
        let description = |domains: Vec<Domain>| {
            let info = v1::SceneInfo { domains: 1, ..Default::default() };
            StateLayout::new(&SceneDescription { info, domains, ..SceneDescription::default() })
        };
        assert!(description(vec![Domain::default()]).is_ok());
        assert!(description(vec![]).is_err());
        let follow = Some(Follow { leader: 0, leader_from_follower: IDENTITY });
        assert!(description(vec![Domain { follow, ..Domain::default() }]).is_err());
        assert!(description(vec![Domain { shares_q_with: Some(0), ..Domain::default() }]).is_err());
    }
}
