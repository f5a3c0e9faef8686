//! Opens recordings and reads their messages. A file is read chunk by chunk, so memory does not depend on its length.

use std::collections::BTreeMap;
use std::fs::File;
use std::ops::Range;
use std::os::unix::fs::FileExt as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use bytes::Bytes;
use mcap::records::op;
use modalcast_client::{ContentHash, SceneDescription, ShapeArray, StateLayout, v1};
use sha2::{Digest as _, Sha256};

use crate::error::{Error, Result};
use crate::format::{
    ENCODING, MAX_CHUNK_BYTES, MAX_CONTENT_BYTES, MAX_METADATA_BYTES, MAX_SCENE_BYTES, PROFILE, Topic, VERSION,
    metadata,
};
use crate::mcap_records::{
    ChunkIndex, FILE_END_BYTES, Malformed, MetadataIndex, MetadataRecord, PREFIX_BYTES, Parsed, Prefix, Record, Schema,
    malformed, parse_record, take_record,
};

/// Size limit of a chunk record: its records and its header.
const MAX_CHUNK_RECORD_BYTES: u64 = MAX_CHUNK_BYTES + (64 << 10);

/// The arrays of a shape that deform its surface, in both forms of its rest positions.
pub(crate) const SURFACE_ARRAYS: [ShapeArray; 5] = [
    ShapeArray::Indices,
    ShapeArray::CornerVertices,
    ShapeArray::RestPositions,
    ShapeArray::CenteredPositions,
    ShapeArray::Modes,
];

/// A file whose records are read by their offsets.
pub(crate) struct RecordFile {
    path: PathBuf,
    file: File,
    length: u64,
}

impl RecordFile {
    pub(crate) fn open(path: &Path) -> Result<Self> {
        let file = File::open(path).map_err(|error| Error::open(path, &error))?;
        let length = file.metadata().map_err(|error| Error::file(path, error))?.len();
        let records = Self { path: path.to_owned(), file, length };
        let magic = records.read(0, (mcap::MAGIC.len() as u64).min(length))?;
        match magic[..] == *mcap::MAGIC {
            true => Ok(records),
            false => Err(records.invalid("the first 8 bytes", "those of an MCAP file", "others")),
        }
    }

    pub(crate) const fn length(&self) -> u64 {
        self.length
    }

    /// Reads bytes that the caller has checked to be inside the file.
    fn read(&self, offset: u64, length: u64) -> Result<Bytes> {
        let mut bytes = vec![0; length as usize];
        self.file.read_exact_at(&mut bytes, offset).map_err(|error| Error::file(&self.path, error))?;
        Ok(bytes.into())
    }

    /// The prefix of the record at an offset, and the offset after the record. The record lies before `end`.
    pub(crate) fn prefix(&self, offset: u64, end: u64) -> Result<(Prefix, u64)> {
        let end = end.min(self.length);
        let body = offset.checked_add(PREFIX_BYTES).filter(|body| *body <= end);
        let Some(body) = body else {
            return Err(self.invalid(format!("offset {offset}"), "a record", "the end of the file"));
        };
        let bytes = self.read(offset, PREFIX_BYTES)?;
        let prefix = Prefix::parse(bytes[..].try_into().unwrap_or_default());
        match body.checked_add(prefix.length).filter(|next| *next <= end) {
            Some(next) => Ok((prefix, next)),
            None => {
                let expected = format!("a record of at most {} bytes", end - body);
                Err(self.invalid(format!("offset {offset}"), expected, format!("{} bytes", prefix.length)))
            }
        }
    }

    /// Reads a record that lies before `end` and has at most `limit` bytes.
    pub(crate) fn record(&self, offset: u64, end: u64, limit: u64) -> Result<Record> {
        let (prefix, _) = self.prefix(offset, end)?;
        if prefix.length > limit {
            let expected = format!("a record of at most {limit} bytes");
            return Err(self.invalid(format!("offset {offset}"), expected, format!("{} bytes", prefix.length)));
        }
        let body = self.read(offset + PREFIX_BYTES, prefix.length)?;
        parse_record(prefix.opcode, body).map_err(|error| self.malformed(offset, &error))
    }

    pub(crate) fn invalid(&self, location: impl Into<String>, expected: impl ToString, given: impl ToString) -> Error {
        Error::InvalidFile {
            path: self.path.display().to_string(),
            location: location.into(),
            expected: expected.to_string(),
            given: given.to_string(),
        }
    }

    pub(crate) fn malformed(&self, offset: u64, error: &Malformed) -> Error {
        self.invalid(format!("record at {offset}: {}", error.field), &error.expected, &error.given)
    }

    /// Reads the records of a chunk that lies before `end`.
    pub(crate) fn chunk(&self, offset: u64, end: u64) -> Result<Bytes> {
        match self.record(offset, end, MAX_CHUNK_RECORD_BYTES)? {
            Record::Chunk(records) => Ok(records),
            _ => Err(self.invalid(format!("offset {offset}"), "a chunk", "another record")),
        }
    }

    /// Takes the next record off the records of the chunk at `offset`.
    pub(crate) fn next_in_chunk(&self, offset: u64, records: &mut Bytes) -> Result<Option<Record>> {
        take_record(records).map_err(|error| self.malformed(offset, &error))
    }
}

/// Maps channels to topics.
#[derive(Debug, Default)]
pub(crate) struct ChannelTable {
    schemas: BTreeMap<u16, Schema>,
    topics: BTreeMap<u16, Topic>,
}

impl ChannelTable {
    /// Adds a schema or a channel. Channels with other topics are ignored.
    pub(crate) fn add(&mut self, record: &Record) -> Parsed<()> {
        match record {
            Record::Schema(schema) => {
                self.schemas.insert(schema.id, schema.clone());
            }
            Record::Channel(channel) => {
                let Some(topic) = Topic::ALL.into_iter().find(|topic| topic.name() == channel.topic) else {
                    return Ok(());
                };
                let schema = self.schemas.get(&channel.schema);
                let given = schema.map_or_else(String::new, |schema| format!("{} {}", schema.encoding, schema.name));
                let expected = format!("{ENCODING} {}", topic.schema_name());
                if given != expected || channel.encoding != ENCODING {
                    return malformed("channel.schema", expected, format!("'{given}'"));
                }
                self.topics.insert(channel.id, topic);
            }
            _ => {}
        }
        Ok(())
    }

    pub(crate) fn topic(&self, channel: u16) -> Option<Topic> {
        self.topics.get(&channel).copied()
    }
}

/// An array or the pixels of a texture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ContentItem {
    pub hash: ContentHash,
    /// Size in bytes.
    pub bytes: u64,
}

/// A message of a recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RecordedMessage {
    pub topic: Topic,
    /// Nanoseconds since the first state.
    pub time: u64,
    /// The encoded message.
    pub data: Bytes,
}

/// An open recording. Clones share the file.
#[derive(Clone)]
pub struct Recording {
    file: Arc<RecordingFile>,
    scene: Arc<RecordedScene>,
}

/// A file and its index.
struct RecordingFile {
    records: RecordFile,
    channels: ChannelTable,
    /// In the order of the file.
    chunks: Vec<ChunkIndex>,
    metadata: BTreeMap<String, BTreeMap<String, String>>,
}

/// The scene of a recording, without arrays.
struct RecordedScene {
    messages: Vec<v1::DescribeSceneResponse>,
    description: SceneDescription,
    layout: Arc<StateLayout>,
    contents: Vec<ContentItem>,
}

/// The index at the end of a file.
#[derive(Default)]
struct Index {
    channels: ChannelTable,
    chunks: Vec<ChunkIndex>,
    metadata: Vec<MetadataIndex>,
}

impl Recording {
    /// Opens a recording: reads its index, its metadata and the description of its scene.
    ///
    /// # Errors
    /// `NotFound` if the file does not exist; `InvalidFile` with the offset of the record if it is no recording or was
    /// cut off.
    pub fn open(path: impl AsRef<Path>) -> Result<Self> {
        let file = Arc::new(RecordingFile::open(path.as_ref())?);
        let messages = file.read_scene()?;
        let invalid_scene = |error| file.records.invalid("topic scene", "the description of a scene", error);
        let description = SceneDescription::from_messages(messages.clone(), MAX_SCENE_BYTES).map_err(invalid_scene)?;
        let layout = StateLayout::new(&description).map_err(invalid_scene)?;
        let contents = file.read_content_items()?;
        Ok(Self { file, scene: Arc::new(RecordedScene { messages, description, layout, contents }) })
    }

    /// The path of the file.
    pub fn path(&self) -> &Path {
        &self.file.records.path
    }

    /// Size of the file in bytes.
    pub fn file_bytes(&self) -> u64 {
        self.file.records.length
    }

    /// A value of a metadata record.
    pub fn metadata(&self, record: &str, key: &str) -> Option<&str> {
        self.file.metadata.get(record)?.get(key).map(String::as_str)
    }

    /// The messages of the description of the scene, with hashes.
    pub fn scene_messages(&self) -> &[v1::DescribeSceneResponse] {
        &self.scene.messages
    }

    /// The scene: domains, shapes, materials and textures with hashes, without arrays.
    pub fn description(&self) -> &SceneDescription {
        &self.scene.description
    }

    /// The layout of the states.
    pub fn layout(&self) -> &Arc<StateLayout> {
        &self.scene.layout
    }

    /// All contents of the scene, in the order of `ReadContentResponse.item`.
    pub fn contents(&self) -> &[ContentItem] {
        &self.scene.contents
    }

    /// Whether the file has the contents, and not only their hashes.
    pub fn has_contents(&self) -> bool {
        self.metadata(metadata::RECORDING, "contents") == Some("embedded")
    }

    /// The time of the last message in nanoseconds.
    pub fn end_time(&self) -> u64 {
        self.file.chunks.iter().map(|chunk| chunk.end_time).max().unwrap_or(0)
    }

    /// All messages of these topics, in the order of the file.
    pub fn messages(&self, topics: &[Topic]) -> Messages {
        Messages::new(&self.file, topics, 0..usize::MAX)
    }

    /// As [`Self::messages`], of a range of chunks.
    pub(crate) fn messages_of_chunks(&self, topics: &[Topic], chunks: Range<usize>) -> Messages {
        Messages::new(&self.file, topics, chunks)
    }

    /// The index of the last chunk that begins at or before `time`; 0 if there is none.
    pub(crate) fn chunk_at(&self, time: u64) -> usize {
        self.file.chunks.partition_point(|chunk| chunk.start_time <= time).saturating_sub(1)
    }

    /// Decodes a message of a topic.
    pub(crate) fn decode<M: prost::Message + Default>(&self, topic: Topic, data: Bytes) -> Result<M> {
        self.file.decode(topic, data)
    }

    /// An error of this file.
    pub(crate) fn invalid(&self, location: impl Into<String>, expected: impl ToString, given: impl ToString) -> Error {
        self.file.records.invalid(location, expected, given)
    }

    /// Fails if the file has only the hashes of the contents, or the contents are too large.
    pub(crate) fn require_contents(&self) -> Result<()> {
        if self.has_contents() {
            let total = self.contents().iter().fold(0, |total: u64, item| total.saturating_add(item.bytes));
            return match total > MAX_CONTENT_BYTES {
                true => Err(self.invalid("metadata content.bytes", format!("at most {MAX_CONTENT_BYTES}"), total)),
                false => Ok(()),
            };
        }
        Err(Error::Unavailable {
            what: "contents of the scene".to_owned(),
            reason: format!("{} has only their hashes", self.path().display()),
            remedy: "Record without --by-hash".to_owned(),
        })
    }

    /// Reads every content and calls `process` with its index and bytes. One content is in memory at a time.
    ///
    /// # Errors
    /// `Unavailable` if the recording has only hashes; `InvalidFile` if a content is missing or does not have its hash;
    /// errors of `process`.
    pub fn read_contents(&self, mut process: impl FnMut(usize, Bytes) -> Result<()>) -> Result<()> {
        self.require_contents()?;
        let mut messages = self.messages(&[Topic::Content]);
        for (index, item) in self.contents().iter().enumerate() {
            let bytes = self.read_content(&mut messages, index, item)?;
            process(index, bytes)?;
        }
        Ok(())
    }

    fn read_content(&self, messages: &mut Messages, index: usize, item: &ContentItem) -> Result<Bytes> {
        let location = || format!("content {index}");
        let mut bytes = Vec::new();
        let mut has_chunk = false;
        while (bytes.len() as u64) < item.bytes || !has_chunk {
            let Some(message) = messages.next()? else {
                return Err(self.invalid(location(), format!("{} bytes", item.bytes), bytes.len()));
            };
            let chunk: v1::ReadContentResponse = self.decode(Topic::Content, message.data)?;
            let is_next = chunk.item as usize == index
                && (chunk.offset, chunk.total) == (bytes.len() as u64, item.bytes)
                && chunk.data.len() as u64 <= item.bytes - bytes.len() as u64
                && (!chunk.data.is_empty() || item.bytes == 0);
            if !is_next {
                let expected = format!("bytes {} to {}", bytes.len(), item.bytes);
                let given = format!("{} bytes at {} of item {}", chunk.data.len(), chunk.offset, chunk.item);
                return Err(self.invalid(location(), expected, given));
            }
            bytes.extend_from_slice(&chunk.data);
            has_chunk = true;
        }
        match ContentHash::from(Sha256::digest(&bytes)) == item.hash {
            true => Ok(bytes.into()),
            false => Err(self.invalid(location(), "bytes with the recorded SHA-256", "others")),
        }
    }

    /// The description with these arrays, and with the pixels of textures on request.
    ///
    /// # Errors
    /// As [`Self::read_contents`]; `Client` if an array contradicts the description.
    pub fn read_description(&self, arrays: &[ShapeArray], with_textures: bool) -> Result<SceneDescription> {
        let mut description = self.description().clone();
        self.read_contents(|index, bytes| {
            let hash = self.contents()[index].hash;
            for shape in &mut description.shapes {
                for array in arrays.iter().filter(|array| shape.hash_of(**array) == Some(hash)).collect::<Vec<_>>() {
                    shape.set_array(*array, &bytes)?;
                }
            }
            for texture in description.textures.iter_mut().filter(|texture| with_textures && texture.hash == Some(hash))
            {
                texture.pixels = bytes.clone();
            }
            Ok(())
        })?;
        description.check_arrays(arrays)?;
        Ok(description)
    }
}

impl RecordingFile {
    fn open(path: &Path) -> Result<Self> {
        let records = RecordFile::open(path)?;
        let Index { channels, mut chunks, metadata } = read_index(&records)?;
        chunks.sort_by_key(|chunk| chunk.offset);
        check_disjoint(&records, &chunks)?;
        let metadata = read_metadata(&records, &metadata)?;
        let file = Self { records, channels, chunks, metadata };
        file.check_version()?;
        Ok(file)
    }

    fn read_scene(self: &Arc<Self>) -> Result<Vec<v1::DescribeSceneResponse>> {
        let (mut scene_messages, mut total) = (Vec::new(), 0);
        let mut messages = Messages::new(self, &Topic::ALL, 0..usize::MAX);
        while let Some(message) = messages.next()?.filter(|message| message.topic == Topic::Scene) {
            total += message.data.len() as u64;
            if total > MAX_SCENE_BYTES {
                return Err(self.records.invalid("topic scene", format!("at most {MAX_SCENE_BYTES} bytes"), total));
            }
            scene_messages.push(self.decode(Topic::Scene, message.data)?);
        }
        Ok(scene_messages)
    }

    fn decode<M: prost::Message + Default>(&self, topic: Topic, data: Bytes) -> Result<M> {
        let location = || format!("topic {}", topic.name());
        M::decode(data).map_err(|error| self.records.invalid(location(), topic.schema_name(), error))
    }

    fn check_version(&self) -> Result<()> {
        let value = |key| self.metadata.get(metadata::RECORDING).and_then(|values| values.get(key));
        match value("version").map(String::as_str) {
            Some(VERSION) => Ok(()),
            Some(version) => Err(self.records.invalid("metadata recording.version", VERSION, version)),
            None => {
                let expected = format!("metadata of a recording with the profile '{PROFILE}'");
                Err(self.records.invalid("metadata", expected, "none"))
            }
        }
    }

    fn read_content_items(&self) -> Result<Vec<ContentItem>> {
        let Some(values) = self.metadata.get(metadata::CONTENT) else { return Ok(Vec::new()) };
        let list = |key| values.get(key).map_or("", String::as_str).split_ascii_whitespace();
        let (hashes, sizes) = (list("sha256").count(), list("bytes").count());
        if hashes != sizes {
            return Err(self.records.invalid("metadata content.bytes", format!("{hashes} sizes"), sizes));
        }
        let items = list("sha256").zip(list("bytes"));
        let item =
            |(hash, bytes): (&str, &str)| Some(ContentItem { hash: parse_hash(hash)?, bytes: bytes.parse().ok()? });
        let items: Option<Vec<_>> = items.map(item).collect();
        items.ok_or_else(|| self.records.invalid("metadata content", "hashes of 64 digits and sizes", "other texts"))
    }
}

fn parse_hash(text: &str) -> Option<ContentHash> {
    let mut hash = ContentHash::default();
    if text.len() != 2 * hash.len() || !text.is_ascii() {
        return None;
    }
    for (byte, index) in hash.iter_mut().zip((0..).step_by(2)) {
        *byte = u8::from_str_radix(text.get(index..index + 2)?, 16).ok()?;
    }
    Some(hash)
}

/// Reads the summary section.
fn read_index(records: &RecordFile) -> Result<Index> {
    let cut_off = |given: &str| {
        let expected = "an index (a file that was cut off can be repaired with `modalcast recover`)";
        records.invalid("end of the file", expected, given)
    };
    let end = records.length.checked_sub(FILE_END_BYTES).ok_or_else(|| cut_off("none"))?;
    let file_end = records.read(end, FILE_END_BYTES)?;
    let has_footer =
        file_end[0] == op::FOOTER && file_end[FILE_END_BYTES as usize - mcap::MAGIC.len()..] == *mcap::MAGIC;
    let summary_start: [u8; 8] = file_end[PREFIX_BYTES as usize..][..8].try_into().unwrap_or_default();
    let mut offset = u64::from_le_bytes(summary_start);
    if !has_footer || offset == 0 {
        return Err(cut_off("none"));
    }
    let mut index = Index::default();
    while offset < end {
        let (_, next) = records.prefix(offset, end)?;
        match records.record(offset, end, MAX_METADATA_BYTES)? {
            Record::ChunkIndex(chunk) => index.chunks.push(chunk),
            Record::MetadataIndex(metadata) => index.metadata.push(metadata),
            record => index.channels.add(&record).map_err(|error| records.malformed(offset, &error))?,
        }
        offset = next;
    }
    Ok(index)
}

/// Checks that the chunks lie inside the file, and that no byte belongs to two chunks. Otherwise a small file could
/// contain any number of messages.
fn check_disjoint(records: &RecordFile, chunks: &[ChunkIndex]) -> Result<()> {
    let next_offsets = chunks.iter().skip(1).map(|chunk| chunk.offset).chain([records.length]);
    for (chunk, next_offset) in chunks.iter().zip(next_offsets) {
        if chunk.end() > next_offset {
            let location = format!("index of the chunk at {}", chunk.offset);
            let expected = format!("an end before {next_offset}, where the next chunk or the end of the file is");
            return Err(records.invalid(location, expected, chunk.end()));
        }
    }
    Ok(())
}

fn read_metadata(records: &RecordFile, index: &[MetadataIndex]) -> Result<BTreeMap<String, BTreeMap<String, String>>> {
    let mut metadata = BTreeMap::new();
    for entry in index.iter().filter(|entry| metadata::ALL.contains(&entry.name.as_str())) {
        if metadata.contains_key(&entry.name) {
            return Err(records.invalid("index of the metadata", format!("'{}' once", entry.name), "it again"));
        }
        let end = entry.offset.saturating_add(entry.length);
        match records.record(entry.offset, end, MAX_METADATA_BYTES)? {
            Record::Metadata(MetadataRecord { name, values }) if name == entry.name => metadata.insert(name, values),
            _ => {
                let expected = format!("metadata with the name '{}'", entry.name);
                return Err(records.invalid(format!("offset {}", entry.offset), expected, "another record"));
            }
        };
    }
    Ok(metadata)
}

/// Messages in the order of the file.
pub struct Messages {
    file: Arc<RecordingFile>,
    topics: Vec<Topic>,
    /// Indices of the chunks that were not read yet.
    chunks: Range<usize>,
    /// Offset of the chunk that `records` belongs to.
    chunk_offset: u64,
    /// The rest of the records of the chunk.
    records: Bytes,
}

impl Messages {
    fn new(file: &Arc<RecordingFile>, topics: &[Topic], chunks: Range<usize>) -> Self {
        let chunks = chunks.start..chunks.end.min(file.chunks.len());
        let (file, topics) = (Arc::clone(file), topics.to_vec());
        Self { file, topics, chunks, chunk_offset: 0, records: Bytes::new() }
    }

    /// The next message; `None` at the end.
    ///
    /// # Errors
    /// `InvalidFile` if a chunk is damaged; `File` if it cannot be read.
    #[allow(clippy::should_implement_trait, reason = "an iterator would return errors inside of its items")]
    pub fn next(&mut self) -> Result<Option<RecordedMessage>> {
        loop {
            while let Some(record) = self.file.records.next_in_chunk(self.chunk_offset, &mut self.records)? {
                let Record::Message(message) = record else { continue };
                if let Some(topic) = self.wanted_topic(message.channel) {
                    return Ok(Some(RecordedMessage { topic, time: message.log_time, data: message.data }));
                }
            }
            let Some(chunk) = self.chunks.next().and_then(|chunk| self.file.chunks.get(chunk)) else { return Ok(None) };
            let is_wanted = |channel: &u16| self.wanted_topic(*channel).is_some();
            if chunk.channels.is_empty() || chunk.channels.iter().any(is_wanted) {
                let records = self.file.records.chunk(chunk.offset, chunk.end())?;
                (self.chunk_offset, self.records) = (chunk.offset, records);
            }
        }
    }

    fn wanted_topic(&self, channel: u16) -> Option<Topic> {
        self.file.channels.topic(channel).filter(|topic| self.topics.contains(topic))
    }
}
