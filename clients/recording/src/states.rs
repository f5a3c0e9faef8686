//! Reads the states of a recording, from any time on.

use std::sync::Arc;

use modalcast_client::{SceneState, SentValues, StateDecoder, v1};
use v1::stream_states_response::Part;

use crate::error::Result;
use crate::format::{Topic, max_state_bytes};
use crate::reader::{Messages, RecordedMessage, Recording};

/// A state of a recording.
#[derive(Debug, Clone)]
pub struct RecordedState {
    /// Nanoseconds since the first state.
    pub time: u64,
    pub state: Arc<SceneState>,
    /// The values that differ from the state before; all values in the first state of a reader.
    pub sent_values: SentValues,
}

/// States in the order of the file.
pub struct RecordedStates {
    recording: Recording,
    messages: Messages,
    decoder: StateDecoder,
    /// Whether changes before the first complete state are skipped.
    is_skipping: bool,
    /// Start time: the last state at or before it is returned first. `None` if no state has to be found: the start time
    /// is 0, or the state was found.
    from: Option<u64>,
    to: u64,
    /// The state after the first one, which was read to find the first one.
    pending: Option<RecordedState>,
    has_ended: bool,
}

impl Recording {
    /// The states from `from` to `to` in nanoseconds since the first state. The first one is the last state at or
    /// before `from`, or the first of the recording if `from` is 0.
    ///
    /// # Errors
    /// `InvalidFile` if a chunk is damaged; `File` if it cannot be read.
    pub fn states(&self, from: u64, to: u64) -> Result<RecordedStates> {
        let chunk = if from == 0 { 0 } else { self.find_complete_state(from)? };
        Ok(RecordedStates {
            recording: self.clone(),
            messages: self.messages_of_chunks(&[Topic::States], chunk..usize::MAX),
            decoder: StateDecoder::new(self.layout(), max_state_bytes(self.description())),
            is_skipping: chunk > 0,
            from: Some(from).filter(|from| *from > 0),
            to,
            pending: None,
            has_ended: false,
        })
    }

    /// The last chunk in which a complete state at or before `time` begins; 0 if there is none.
    fn find_complete_state(&self, time: u64) -> Result<usize> {
        for chunk in (1..=self.chunk_at(time)).rev() {
            let mut messages = self.messages_of_chunks(&[Topic::States], chunk..chunk + 1);
            while let Some(message) = messages.next()? {
                if message.time <= time && self.decode_chunk(message)?.head.is_some_and(|head| head.complete) {
                    return Ok(chunk);
                }
            }
        }
        Ok(0)
    }

    fn decode_chunk(&self, message: RecordedMessage) -> Result<v1::StateChunk> {
        match self.decode::<v1::StreamStatesResponse>(Topic::States, message.data)?.part {
            Some(Part::Chunk(chunk)) => Ok(chunk),
            _ => Err(self.invalid("topic states", "the part `chunk`", "another part")),
        }
    }
}

impl RecordedStates {
    /// The next state; `None` at the end. An incomplete state at the end of the file is left out.
    ///
    /// # Errors
    /// `InvalidFile` if a chunk is damaged; `Client` if a state contradicts the scene or the states before it.
    #[allow(clippy::should_implement_trait, reason = "an iterator would return errors inside of its items")]
    pub fn next(&mut self) -> Result<Option<RecordedState>> {
        if let Some(state) = self.pending.take() {
            return Ok(Some(state));
        }
        let Some(from) = self.from.take() else { return self.read() };
        let mut first: Option<RecordedState> = None;
        loop {
            let next = self.read()?;
            match next {
                Some(state) if state.time <= from => first = Some(state),
                next => {
                    let Some(mut first) = first else { return Ok(next) };
                    self.pending = next;
                    first.sent_values = SentValues { is_complete: true, origins: true, ..SentValues::default() };
                    return Ok(Some(first));
                }
            }
        }
    }

    fn read(&mut self) -> Result<Option<RecordedState>> {
        while !self.has_ended {
            let Some(message) = self.messages.next()? else { break };
            let time = message.time;
            let chunk = self.recording.decode_chunk(message)?;
            self.is_skipping &= !chunk.head.as_ref().is_some_and(|head| head.complete);
            if self.is_skipping {
                continue;
            }
            if let Some(state) = self.decoder.add_chunk(chunk)? {
                self.has_ended = time > self.to;
                let sent_values = self.decoder.sent_values().clone();
                return Ok(Some(RecordedState { time, state, sent_values }).filter(|_| !self.has_ended));
            }
        }
        Ok(None)
    }
}
