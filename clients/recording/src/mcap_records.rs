//! Parses records of MCAP files (<https://mcap.dev/spec>). The crate `mcap` has readers too, but this one checks every
//! length against the bytes that are present and against a limit before it allocates memory.

use std::collections::BTreeMap;

use bytes::{Buf as _, Bytes};
use mcap::records::op;

use crate::format::MAX_CHUNK_BYTES;

/// Size of the opcode and of the length of a record in bytes.
pub(crate) const PREFIX_BYTES: u64 = 9;

/// Size of the footer and of the magic bytes after it, at the end of the file.
pub(crate) const FILE_END_BYTES: u64 = PREFIX_BYTES + 20 + mcap::MAGIC.len() as u64;

/// Why a record is invalid.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Malformed {
    pub(crate) field: &'static str,
    pub(crate) expected: String,
    pub(crate) given: String,
}

pub(crate) type Parsed<T> = std::result::Result<T, Malformed>;

pub(crate) fn malformed<T>(field: &'static str, expected: impl ToString, given: impl ToString) -> Parsed<T> {
    Err(Malformed { field, expected: expected.to_string(), given: given.to_string() })
}

/// Reads the fields of a record in order. A field beyond the end is an error.
struct Fields(Bytes);

impl Fields {
    fn bytes(&mut self, field: &'static str, length: u64) -> Parsed<Bytes> {
        let available = self.0.len();
        match usize::try_from(length) {
            Ok(length) if length <= available => Ok(self.0.split_to(length)),
            _ => malformed(field, format!("at most {available} bytes"), length),
        }
    }

    fn u16(&mut self, field: &'static str) -> Parsed<u16> {
        Ok(self.bytes(field, 2)?.get_u16_le())
    }

    fn u32(&mut self, field: &'static str) -> Parsed<u32> {
        Ok(self.bytes(field, 4)?.get_u32_le())
    }

    fn u64(&mut self, field: &'static str) -> Parsed<u64> {
        Ok(self.bytes(field, 8)?.get_u64_le())
    }

    fn text(&mut self, field: &'static str) -> Parsed<String> {
        let bytes = self.prefixed(field)?;
        match std::str::from_utf8(&bytes) {
            Ok(text) => Ok(text.to_owned()),
            Err(_) => malformed(field, "UTF-8", "other bytes"),
        }
    }

    /// Bytes after their length as u32.
    fn prefixed(&mut self, field: &'static str) -> Parsed<Bytes> {
        let length = self.u32(field)?;
        self.bytes(field, length.into())
    }

    const fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
}

/// A schema, without its data.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Schema {
    pub(crate) id: u16,
    pub(crate) name: String,
    pub(crate) encoding: String,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Channel {
    pub(crate) id: u16,
    pub(crate) schema: u16,
    pub(crate) topic: String,
    pub(crate) encoding: String,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Message {
    pub(crate) channel: u16,
    pub(crate) log_time: u64,
    pub(crate) data: Bytes,
}

/// Named texts.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct MetadataRecord {
    pub(crate) name: String,
    pub(crate) values: BTreeMap<String, String>,
}

/// Where a metadata record is in the file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct MetadataIndex {
    pub(crate) offset: u64,
    pub(crate) length: u64,
    pub(crate) name: String,
}

/// Where a chunk is in the file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ChunkIndex {
    pub(crate) start_time: u64,
    pub(crate) end_time: u64,
    pub(crate) offset: u64,
    pub(crate) length: u64,
    /// Channels with messages in the chunk; empty if they are unknown.
    pub(crate) channels: Vec<u16>,
}

impl ChunkIndex {
    /// The offset after the chunk.
    pub(crate) const fn end(&self) -> u64 {
        self.offset.saturating_add(self.length)
    }
}

/// A record that recordings contain. Others are skipped.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Record {
    Schema(Schema),
    Channel(Channel),
    Message(Message),
    Metadata(MetadataRecord),
    MetadataIndex(MetadataIndex),
    ChunkIndex(ChunkIndex),
    /// The records of a chunk.
    Chunk(Bytes),
    DataEnd,
    Other,
}

/// Opcode and length of a record.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Prefix {
    pub(crate) opcode: u8,
    /// Size of the record without its prefix in bytes.
    pub(crate) length: u64,
}

impl Prefix {
    pub(crate) const fn parse(bytes: [u8; PREFIX_BYTES as usize]) -> Self {
        let [opcode, length @ ..] = bytes;
        Self { opcode, length: u64::from_le_bytes(length) }
    }
}

/// Parses a record without its prefix.
pub(crate) fn parse_record(opcode: u8, body: Bytes) -> Parsed<Record> {
    let mut fields = Fields(body);
    Ok(match opcode {
        op::SCHEMA => Record::Schema(Schema {
            id: fields.u16("schema.id")?,
            name: fields.text("schema.name")?,
            encoding: fields.text("schema.encoding")?,
        }),
        op::CHANNEL => Record::Channel(Channel {
            id: fields.u16("channel.id")?,
            schema: fields.u16("channel.schema_id")?,
            topic: fields.text("channel.topic")?,
            encoding: fields.text("channel.message_encoding")?,
        }),
        op::MESSAGE => {
            let channel = fields.u16("message.channel_id")?;
            fields.u32("message.sequence")?;
            let log_time = fields.u64("message.log_time")?;
            fields.u64("message.publish_time")?;
            Record::Message(Message { channel, log_time, data: fields.0 })
        }
        op::METADATA => Record::Metadata(parse_metadata(&mut fields)?),
        op::METADATA_INDEX => Record::MetadataIndex(MetadataIndex {
            offset: fields.u64("metadata_index.offset")?,
            length: fields.u64("metadata_index.length")?,
            name: fields.text("metadata_index.name")?,
        }),
        op::CHUNK_INDEX => Record::ChunkIndex(parse_chunk_index(&mut fields)?),
        op::CHUNK => Record::Chunk(parse_chunk(&mut fields)?),
        op::DATA_END => Record::DataEnd,
        _ => Record::Other,
    })
}

fn parse_metadata(fields: &mut Fields) -> Parsed<MetadataRecord> {
    let name = fields.text("metadata.name")?;
    let mut entries = Fields(fields.prefixed("metadata.metadata")?);
    let mut values = BTreeMap::new();
    while !entries.is_empty() {
        values.insert(entries.text("metadata.key")?, entries.text("metadata.value")?);
    }
    Ok(MetadataRecord { name, values })
}

fn parse_chunk_index(fields: &mut Fields) -> Parsed<ChunkIndex> {
    let (start_time, end_time) = (fields.u64("chunk_index.start_time")?, fields.u64("chunk_index.end_time")?);
    let (offset, length) = (fields.u64("chunk_index.offset")?, fields.u64("chunk_index.length")?);
    let mut entries = Fields(fields.prefixed("chunk_index.message_index_offsets")?);
    let mut channels = Vec::new();
    while !entries.is_empty() {
        channels.push(entries.u16("chunk_index.channel_id")?);
        entries.u64("chunk_index.message_index_offset")?;
    }
    Ok(ChunkIndex { start_time, end_time, offset, length, channels })
}

/// Decompresses the records of a chunk, and compares them with their checksum.
fn parse_chunk(fields: &mut Fields) -> Parsed<Bytes> {
    fields.u64("chunk.start_time")?;
    fields.u64("chunk.end_time")?;
    let size = fields.u64("chunk.uncompressed_size")?;
    let checksum = fields.u32("chunk.uncompressed_crc")?;
    let compression = fields.text("chunk.compression")?;
    let compressed_size = fields.u64("chunk.records")?;
    let records = fields.bytes("chunk.records", compressed_size)?;
    if size > MAX_CHUNK_BYTES {
        return malformed("chunk.uncompressed_size", format!("at most {MAX_CHUNK_BYTES} bytes"), size);
    }
    let records = match compression.as_str() {
        "" => records,
        // The buffer never grows beyond the stated size.
        "zstd" => match zstd::bulk::decompress(&records, size as usize) {
            Ok(records) => records.into(),
            Err(error) => return malformed("chunk.records", format!("{size} bytes in zstd frames"), error),
        },
        _ => return malformed("chunk.compression", "zstd or none", format!("'{compression}'")),
    };
    if records.len() as u64 != size {
        return malformed("chunk.uncompressed_size", records.len(), size);
    }
    // A checksum of 0 means that there is none.
    let actual_checksum = crc32fast::hash(&records);
    if checksum != 0 && checksum != actual_checksum {
        return malformed("chunk.uncompressed_crc", format!("{actual_checksum:08x}"), format!("{checksum:08x}"));
    }
    Ok(records)
}

/// Takes the next record off the records of a chunk; `None` at the end.
pub(crate) fn take_record(records: &mut Bytes) -> Parsed<Option<Record>> {
    if records.is_empty() {
        return Ok(None);
    }
    let Some(prefix) = records.first_chunk().copied() else {
        return malformed("chunk.records", "a whole record", format!("{} bytes", records.len()));
    };
    let prefix = Prefix::parse(prefix);
    let mut fields = Fields(records.clone());
    fields.bytes("record", PREFIX_BYTES)?;
    let body = fields.bytes("record.length", prefix.length)?;
    *records = fields.0;
    match prefix.opcode {
        op::SCHEMA | op::CHANNEL | op::MESSAGE => parse_record(prefix.opcode, body).map(Some),
        opcode => malformed("chunk.records", "schemas, channels and messages", format!("opcode {opcode}")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lengths_beyond_the_record_are_errors() {
        let body = |bytes: &[u8]| Bytes::copy_from_slice(bytes);
        // A channel whose topic claims 4 GiB, a chunk whose records claim 2^64 - 1 bytes, and empty records.
        let channel = [&[1, 0, 1, 0][..], &[0xff; 4]].concat();
        let chunk = [&[0; 16][..], &[1, 0, 0, 0, 0, 0, 0, 0], &[0; 4], &[0; 4], &[0xff; 8]].concat();
        for (opcode, bytes, field) in [
            (op::CHANNEL, channel, "channel.topic"),
            (op::CHUNK, chunk, "chunk.records"),
            (op::MESSAGE, vec![], "message.channel_id"),
            (op::METADATA, vec![0; 4], "metadata.metadata"),
        ] {
            assert_eq!(parse_record(opcode, body(&bytes)).expect_err(field).field, field);
        }
        let records = [&[op::MESSAGE][..], &[0xff; 8]].concat();
        assert_eq!(take_record(&mut body(&records)).expect_err("a long record").field, "record.length");
    }

    /// A chunk that states the size and has zstd frames of `records`.
    fn chunk(records: &[u8], size: u64, checksum: u32) -> Bytes {
        let compressed = zstd::bulk::compress(records, 1).expect("compressed bytes");
        let mut body = vec![0; 16];
        body.extend(size.to_le_bytes());
        body.extend(checksum.to_le_bytes());
        body.extend(4_u32.to_le_bytes());
        body.extend(b"zstd");
        body.extend((compressed.len() as u64).to_le_bytes());
        body.extend(compressed);
        body.into()
    }

    #[test]
    fn chunk_has_its_stated_size_and_checksum() {
        let records = vec![7; 1 << 20];
        let checksum = crc32fast::hash(&records);
        let parsed = parse_record(op::CHUNK, chunk(&records, 1 << 20, checksum));
        assert_eq!(parsed, Ok(Record::Chunk(records.clone().into())));
        assert!(parse_record(op::CHUNK, chunk(&records, 1 << 20, 0)).is_ok(), "expected 0 to mean no checksum");
        for (size, checksum, field) in [
            (1 << 20, checksum ^ 1, "chunk.uncompressed_crc"),
            ((1 << 20) - 1, checksum, "chunk.records"),
            ((1 << 20) + 1, checksum, "chunk.uncompressed_size"),
            (MAX_CHUNK_BYTES + 1, checksum, "chunk.uncompressed_size"),
            (u64::MAX, checksum, "chunk.uncompressed_size"),
        ] {
            assert_eq!(parse_record(op::CHUNK, chunk(&records, size, checksum)).expect_err(field).field, field);
        }
    }
}
