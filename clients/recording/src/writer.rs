//! Writes recordings.

use std::collections::BTreeMap;
use std::io::Write;
use std::sync::Arc;

use bytes::Bytes;
use mcap::records::MessageHeader;
use mcap::write::{Metadata, NoSeek};
use modalcast_client::{SceneDescription, SceneState, StateDecoder, StateLayout, v1};

use crate::error::{Error, Result};
use crate::format::{
    CHUNK_BYTES, COMPLETE_INTERVAL, COMPLETE_STATES, ENCODING, MAX_SCENE_BYTES, PROFILE, Topic, max_state_bytes,
};
use crate::timeline::Timeline;

/// A metadata record: texts by their keys.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MetadataEntry {
    pub name: &'static str,
    pub values: BTreeMap<String, String>,
}

/// Writes a recording: first the messages of the scene, then contents, then states and forces in any order.
///
/// Every chunk is written as a whole when it is closed, so a process that is killed loses at most the open chunk.
pub struct RecordingWriter<W: Write> {
    mcap: mcap::Writer<NoSeek<W>>,
    /// The channel of each topic, in the order of [`Topic::ALL`].
    channels: [u16; 4],
    /// Number of messages of each topic.
    sequences: [u32; 4],
    scene_messages: Vec<v1::DescribeSceneResponse>,
    states: Option<StateWriter>,
    summary: WriteSummary,
}

/// Totals of a recording.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct WriteSummary {
    pub states: u64,
    /// Number of states that have all domains.
    pub complete_states: u64,
    /// Steps that the server skipped between the states.
    pub skipped: u64,
    /// Size of the sections of all states in bytes, without heads.
    pub state_bytes: u64,
    pub force_messages: u64,
    /// `log_time` of the last state in nanoseconds.
    pub last_time: u64,
}

/// Decides which states are written as complete states, for which it keeps the current state.
struct StateWriter {
    decoder: StateDecoder,
    timeline: Timeline,
    last_complete_time: u64,
    states_since_complete: u64,
    /// Whether the state whose chunks arrive is replaced by a complete one.
    replaces: bool,
}

impl<W: Write> RecordingWriter<W> {
    /// Begins a recording with these metadata records. The caller buffers the writer.
    ///
    /// # Errors
    /// `File` if it cannot be written.
    pub fn new(writer: W, metadata: &[MetadataEntry]) -> Result<Self> {
        let options = mcap::WriteOptions::new()
            .profile(PROFILE)
            .library(concat!("modalcast-record ", env!("CARGO_PKG_VERSION")))
            .chunk_size(Some(CHUNK_BYTES))
            // A chunk is written when it is complete, instead of a placeholder that is overwritten later.
            .disable_seeking(true)
            .compression_threads(0);
        let mut mcap = options.create(NoSeek::new(writer)).map_err(write_error)?;
        for MetadataEntry { name, values } in metadata {
            let record = Metadata { name: (*name).to_owned(), metadata: values.clone() };
            mcap.write_metadata(&record).map_err(write_error)?;
        }
        let mut channels = [0; 4];
        for (topic, channel) in Topic::ALL.into_iter().zip(&mut channels) {
            let schema = topic.schema().map_err(write_error)?;
            let schema = mcap.add_schema(topic.schema_name(), ENCODING, &schema).map_err(write_error)?;
            *channel = mcap.add_channel(schema, topic.name(), ENCODING, &BTreeMap::new()).map_err(write_error)?;
        }
        let (sequences, scene_messages, summary) = ([0; 4], Vec::new(), WriteSummary::default());
        Ok(Self { mcap, channels, sequences, scene_messages, states: None, summary })
    }

    /// Adds a message of the description of the scene, with hashes and without arrays.
    ///
    /// # Errors
    /// `File` if it cannot be written.
    pub fn scene_message(&mut self, message: v1::DescribeSceneResponse) -> Result<()> {
        self.write(Topic::Scene, 0, &message)?;
        self.scene_messages.push(message);
        Ok(())
    }

    /// Adds a chunk of a content. `item` is the index of its hash in the metadata record `content`.
    ///
    /// # Errors
    /// `File` if it cannot be written.
    pub fn content_message(&mut self, message: &v1::ReadContentResponse) -> Result<()> {
        self.write(Topic::Content, 0, message)
    }

    /// Adds a chunk of a state.
    ///
    /// # Errors
    /// `Client` if the chunk contradicts the previous ones or the scene; `File` if it cannot be written.
    pub fn state_chunk(&mut self, mut chunk: v1::StateChunk) -> Result<()> {
        let states = match &mut self.states {
            Some(states) => states,
            states => states.insert(StateWriter::new(std::mem::take(&mut self.scene_messages))?),
        };
        if let Some(head) = &mut chunk.head {
            head.stages.clear();
            states.begin(head);
        }
        let (time, replaces) = (states.timeline.last(), states.replaces);
        let state = states.decoder.add_chunk(chunk.clone())?;
        let is_complete = states.states_since_complete == 0;
        if !replaces {
            self.write_state_chunk(time, chunk)?;
        }
        let Some(state) = state else { return Ok(()) };
        if replaces {
            state.to_chunks().into_iter().try_for_each(|chunk| self.write_state_chunk(time, chunk))?;
        }
        self.count_state(&state, is_complete, time);
        Ok(())
    }

    fn count_state(&mut self, state: &Arc<SceneState>, is_complete: bool, time: u64) {
        self.summary.states += 1;
        self.summary.complete_states += u64::from(is_complete);
        self.summary.skipped += state.skipped;
        self.summary.last_time = time;
    }

    fn write_state_chunk(&mut self, time: u64, chunk: v1::StateChunk) -> Result<()> {
        self.summary.state_bytes += chunk.data.len() as u64;
        let part = Some(v1::stream_states_response::Part::Chunk(chunk));
        self.write(Topic::States, time, &v1::StreamStatesResponse { part })
    }

    /// Adds all forces after a change.
    ///
    /// # Errors
    /// `File` if it cannot be written.
    pub fn forces(&mut self, message: &v1::StreamForcesResponse) -> Result<()> {
        self.summary.force_messages += 1;
        let time = self.states.as_ref().map_or(0, |states| states.timeline.last());
        self.write(Topic::Forces, time, message)
    }

    /// Closes the open chunk and writes it.
    ///
    /// # Errors
    /// `File` if it cannot be written.
    pub fn flush(&mut self) -> Result<()> {
        self.mcap.flush().map_err(write_error)
    }

    /// Totals up to now.
    pub const fn summary(&self) -> WriteSummary {
        self.summary
    }

    /// Writes the open chunk, the index and the end of the file. Returns the writer.
    ///
    /// # Errors
    /// `File` if it cannot be written.
    pub fn finish(mut self) -> Result<W> {
        self.mcap.finish().map_err(write_error)?;
        let mut writer = self.mcap.into_inner().into_inner();
        writer.flush().map_err(write_error)?;
        Ok(writer)
    }

    fn write(&mut self, topic: Topic, time: u64, message: &impl prost::Message) -> Result<()> {
        self.write_encoded(topic, time, &message.encode_to_vec().into())
    }

    /// Adds an encoded message, in the order of the recording.
    pub(crate) fn write_encoded(&mut self, topic: Topic, time: u64, data: &Bytes) -> Result<()> {
        let index = topic as usize;
        let sequence = self.sequences[index];
        self.sequences[index] = sequence.wrapping_add(1);
        let channel_id = self.channels[index];
        let header = MessageHeader { channel_id, sequence, log_time: time, publish_time: time };
        self.mcap.write_to_known_channel(&header, data).map_err(write_error)
    }
}

impl StateWriter {
    fn new(scene_messages: Vec<v1::DescribeSceneResponse>) -> Result<Self> {
        let description = SceneDescription::from_messages(scene_messages, MAX_SCENE_BYTES)?;
        let layout = StateLayout::new(&description)?;
        Ok(Self {
            decoder: StateDecoder::new(&layout, max_state_bytes(&description)),
            timeline: Timeline::default(),
            last_complete_time: 0,
            states_since_complete: 0,
            replaces: false,
        })
    }

    /// Begins a state.
    fn begin(&mut self, head: &v1::StateHead) {
        let time = self.timeline.time_of(&head.step.unwrap_or_default());
        self.states_since_complete += 1;
        let is_due = time.saturating_sub(self.last_complete_time) >= COMPLETE_INTERVAL
            || self.states_since_complete >= COMPLETE_STATES;
        self.replaces = is_due && !head.complete;
        if is_due || head.complete {
            (self.last_complete_time, self.states_since_complete) = (time, 0);
        }
    }
}

/// The path is unknown here; the caller of the writer knows it.
fn write_error(error: impl std::fmt::Display) -> Error {
    Error::File { path: "recording".to_owned(), reason: error.to_string() }
}
