//! Rebuilds the index of a recording that was cut off.

use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use mcap::records::op;

use crate::error::{Error, Result};
use crate::format::{MAX_METADATA_BYTES, Topic, metadata};
use crate::mcap_records::{MetadataRecord, Record};
use crate::reader::{ChannelTable, RecordFile};
use crate::writer::{MetadataEntry, RecordingWriter};

/// The result of [`recover`].
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Recovered {
    /// Number of whole chunks.
    pub chunks: u64,
    /// Number of messages.
    pub messages: u64,
    /// Number of messages of the topic `states`.
    pub state_messages: u64,
    /// Size of the part of the file that was copied, in bytes.
    pub copied_bytes: u64,
    /// Size of the rest of the file, in bytes.
    pub lost_bytes: u64,
    /// Why the rest was not copied; `None` if the file is complete.
    pub reason: Option<String>,
}

/// Copies all whole chunks up to the end or the first damaged record of a recording into a new recording with an index.
/// One chunk is in memory at a time.
///
/// # Errors
/// `NotFound` if the file does not exist; `InvalidFile` if it is no recording, or was cut off before its first state;
/// `File` if it cannot be read or the new one cannot be written.
pub fn recover(path: &Path, out: &Path) -> Result<Recovered> {
    let source = RecordFile::open(path)?;
    if out.exists() && std::fs::canonicalize(out).ok() == std::fs::canonicalize(path).ok() {
        return Err(Error::invalid("--out", "another file than the recording", out.display()));
    }
    let mut copier = ChunkCopier { source, channels: ChannelTable::default(), recovered: Recovered::default() };
    let (metadata, first_chunk) = copier.read_metadata()?;
    let file = File::create(out).map_err(|error| Error::open(out, &error))?;
    let mut writer = RecordingWriter::new(BufWriter::new(file), &metadata).map_err(|error| error.at(out))?;
    copier.copy_chunks(first_chunk, &mut writer).map_err(|error| error.at(out))?;
    writer.finish().map_err(|error| error.at(out))?;
    match copier.recovered.state_messages {
        0 => {
            std::fs::remove_file(out).map_err(|error| Error::file(out, error))?;
            Err(copier.source.invalid("topic states", "a state before the cut", "none"))
        }
        _ => Ok(copier.recovered),
    }
}

/// Copies the chunks of a recording that is read from its beginning.
struct ChunkCopier {
    source: RecordFile,
    channels: ChannelTable,
    recovered: Recovered,
}

/// A record outside of chunks, and the offset after it.
enum Next {
    Record {
        opcode: u8,
        offset: u64,
        next: u64,
    },
    /// The rest of the file is not a whole record.
    Cut(Error),
}

impl ChunkCopier {
    fn next(&self, offset: u64) -> Next {
        match self.source.prefix(offset, self.source.length()) {
            Ok((prefix, next)) => Next::Record { opcode: prefix.opcode, offset, next },
            Err(error) => Next::Cut(error),
        }
    }

    /// Reads the metadata records, which precede the first chunk. Also returns the offset of the first chunk.
    fn read_metadata(&self) -> Result<(Vec<MetadataEntry>, u64)> {
        let mut entries = Vec::new();
        let mut position = mcap::MAGIC.len() as u64;
        loop {
            let (opcode, offset, next) = match self.next(position) {
                Next::Record { opcode, offset, next } => (opcode, offset, next),
                Next::Cut(error) => return Err(error),
            };
            match opcode {
                op::CHUNK | op::DATA_END => return Ok((entries, offset)),
                op::METADATA => {
                    let record = self.source.record(offset, next, MAX_METADATA_BYTES)?;
                    if let Record::Metadata(MetadataRecord { name, values }) = record
                        && let Some(name) = metadata::ALL.into_iter().find(|known| *known == name)
                    {
                        entries.push(MetadataEntry { name, values });
                    }
                }
                _ => {}
            }
            position = next;
        }
    }

    fn copy_chunks<W: std::io::Write>(&mut self, first_chunk: u64, writer: &mut RecordingWriter<W>) -> Result<()> {
        let mut position = first_chunk;
        let (end, reason) = loop {
            let (opcode, offset, next) = match self.next(position) {
                Next::Record { opcode, offset, next } => (opcode, offset, next),
                Next::Cut(error) => break (position, Some(error)),
            };
            if opcode == op::DATA_END {
                break (self.source.length(), None);
            }
            if opcode == op::CHUNK {
                let copied = match self.source.chunk(offset, next) {
                    Ok(records) => self.copy_chunk(offset, records, writer)?,
                    Err(error) => Err(error),
                };
                if let Err(error) = copied {
                    break (offset, Some(error));
                }
            }
            position = next;
        };
        self.recovered.copied_bytes = end;
        self.recovered.lost_bytes = self.source.length() - end;
        self.recovered.reason = reason.map(|error| error.to_string());
        Ok(())
    }

    /// Copies the messages of a chunk. The inner error concerns the chunk, and the outer one the new file. A chunk with
    /// an error is not copied.
    fn copy_chunk<W: std::io::Write>(
        &mut self,
        offset: u64,
        mut records: bytes::Bytes,
        writer: &mut RecordingWriter<W>,
    ) -> Result<Result<()>> {
        let mut messages = Vec::new();
        loop {
            match self.source.next_in_chunk(offset, &mut records) {
                Ok(None) => break,
                Ok(Some(Record::Message(message))) => messages.push(message),
                Ok(Some(record)) => {
                    if let Err(error) = self.channels.add(&record) {
                        return Ok(Err(self.source.malformed(offset, &error)));
                    }
                }
                Err(error) => return Ok(Err(error)),
            }
        }
        for message in messages {
            if let Some(topic) = self.channels.topic(message.channel) {
                writer.write_encoded(topic, message.log_time, &message.data)?;
                self.recovered.messages += 1;
                self.recovered.state_messages += u64::from(topic == Topic::States);
            }
        }
        self.recovered.chunks += 1;
        writer.flush().map(Ok)
    }
}
