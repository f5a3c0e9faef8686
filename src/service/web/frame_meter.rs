//! Limits on the WebSocket frames of a connection that the library does not have. Incomplete messages have a deadline,
//! and count against the receive budgets from their first header on. Frames without payload are counted.
//!
//! The library keeps the memory of its largest frame. Its reader is therefore replaced after a message with a large
//! frame, and no byte after this message is read before the replacement ([`FrameMeter::take_boundary`]).

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::task::{Context, Poll};

use super::super::frame_allowance::FrameAllowance;
use super::super::metered_socket::Meter;
use super::super::progress_timer::ProgressTimer;
use super::super::receive_budget::{ConnectionReceiveBudget, MessageLimits, ReceivedMemory};
use super::close_reason::CloseReason;
use super::envelope::ENVELOPE_BYTES;

/// The largest header: two bytes, a length of eight bytes, and a mask of four bytes (RFC 6455, 5.2).
const MAX_HEADER_BYTES: usize = 14;

/// Opcodes from here on are control frames.
const FIRST_CONTROL_OPCODE: u8 = 8;

/// A frame with at least this many bytes of payload is large: it is larger than the library's read buffer.
const MIN_LARGE_FRAME: usize = 64 << 10;

/// Bytes of a connection.
#[derive(Debug, Default)]
pub(super) struct Traffic {
    /// All received bytes.
    pub(super) received: AtomicU64,
    /// Bytes of messages that were sent since the meter has last counted them.
    pub(super) sent: AtomicUsize,
}

/// Reads the headers of received frames.
pub(super) struct FrameMeter {
    header: [u8; MAX_HEADER_BYTES],
    /// Number of received bytes of the next header.
    header_bytes: usize,
    /// Missing bytes of the frame's payload.
    missing_bytes: u64,
    /// Whether a message has begun whose last frame is not complete.
    is_in_message: bool,
    /// Whether the current frame is the last one of its message.
    is_last_frame: bool,
    /// Bytes of the frames of the incomplete message.
    message_bytes: usize,
    memory: ReceivedMemory,
    limits: MessageLimits,
    timer: ProgressTimer,
    allowance: FrameAllowance,
    traffic: Arc<Traffic>,
    /// Whether the incomplete message has a large frame.
    is_large: bool,
    /// Whether the last received byte is the end of a message with a large frame.
    is_at_boundary: bool,
}

impl FrameMeter {
    pub(super) fn new(budget: &Arc<ConnectionReceiveBudget>, traffic: Arc<Traffic>) -> Self {
        let limits = budget.limits();
        Self {
            header: [0; MAX_HEADER_BYTES],
            header_bytes: 0,
            missing_bytes: 0,
            is_in_message: false,
            is_last_frame: false,
            message_bytes: 0,
            memory: budget.new_memory(),
            limits: MessageLimits { max_bytes: limits.max_bytes + ENVELOPE_BYTES, ..limits },
            timer: ProgressTimer::new(limits.timeout),
            allowance: FrameAllowance::new(),
            traffic,
            is_large: false,
            is_at_boundary: false,
        }
    }

    /// Whether all received bytes belong to complete messages, the last of which has a large frame. The answer is true
    /// once per message.
    pub(super) fn take_boundary(&mut self) -> bool {
        std::mem::take(&mut self.is_at_boundary)
    }

    const fn is_incomplete(&self) -> bool {
        self.header_bytes > 0 || self.missing_bytes > 0 || self.is_in_message
    }

    /// Length of the header that has begun.
    const fn expected_header_bytes(&self) -> usize {
        if self.header_bytes < 2 {
            return 2;
        }
        let length_bytes = match self.header[1] & 0x7f {
            126 => 2,
            127 => 8,
            _ => 0,
        };
        let mask_bytes = if self.header[1] & 0x80 == 0 { 0 } else { 4 };
        2 + length_bytes + mask_bytes
    }

    /// Handles a complete header.
    fn begin_frame(&mut self) -> Result<(), CloseReason> {
        let [first, second, a, b, c, d, e, f, g, h, ..] = self.header;
        let length = match second & 0x7f {
            126 => u64::from(u16::from_be_bytes([a, b])),
            127 => u64::from_be_bytes([a, b, c, d, e, f, g, h]),
            short => short.into(),
        };
        self.header_bytes = 0;
        self.missing_bytes = length;
        let payload_bytes = usize::try_from(length).unwrap_or(usize::MAX);
        if first & 0x0f >= FIRST_CONTROL_OPCODE {
            self.allowance.take_answered_frame(payload_bytes.min(MAX_HEADER_BYTES));
        } else {
            // The library rejects a message above the limit.
            self.message_bytes = self.message_bytes.saturating_add(payload_bytes).min(self.limits.max_bytes);
            self.memory.resize(self.message_bytes).map_err(|error| CloseReason::receive_budget(&error))?;
            self.allowance.take_frame();
            self.allowance.add_payload(payload_bytes.min(self.limits.max_bytes));
            (self.is_in_message, self.is_last_frame) = (true, first & 0x80 != 0);
            self.is_large |= payload_bytes >= MIN_LARGE_FRAME;
        }
        if self.missing_bytes == 0 {
            self.end_frame(first & 0x0f >= FIRST_CONTROL_OPCODE);
        }
        match self.allowance.is_left() {
            true => Ok(()),
            false => Err(CloseReason::policy("too many control frames or tiny messages")),
        }
    }

    /// Handles the end of a frame's payload.
    fn end_frame(&mut self, is_control: bool) {
        if is_control || !self.is_last_frame {
            return;
        }
        // From here on, the queue of the call counts the message.
        (self.is_in_message, self.is_last_frame, self.message_bytes) = (false, false, 0);
        self.is_at_boundary = std::mem::take(&mut self.is_large);
        self.memory.resize(0).ok();
        self.timer.reset();
    }

    fn receive_frames(&mut self, mut bytes: &[u8]) -> Result<(), CloseReason> {
        while !bytes.is_empty() {
            if self.missing_bytes > 0 {
                let payload = usize::try_from(self.missing_bytes).unwrap_or(usize::MAX).min(bytes.len());
                bytes = &bytes[payload..];
                self.missing_bytes -= payload as u64;
                if self.missing_bytes == 0 {
                    let opcode = self.header[0] & 0x0f;
                    self.end_frame(opcode >= FIRST_CONTROL_OPCODE);
                }
                continue;
            }
            let part = (self.expected_header_bytes() - self.header_bytes).min(bytes.len());
            self.header[self.header_bytes..][..part].copy_from_slice(&bytes[..part]);
            bytes = &bytes[part..];
            self.header_bytes += part;
            if self.header_bytes >= 2 && self.header_bytes == self.expected_header_bytes() {
                self.begin_frame()?;
            }
        }
        Ok(())
    }
}

impl Meter for FrameMeter {
    fn receive(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.traffic.received.fetch_add(bytes.len() as u64, Ordering::Relaxed);
        self.allowance.add_payload(self.traffic.sent.swap(0, Ordering::Relaxed));
        self.timer.stop(bytes.len());
        self.is_at_boundary &= bytes.is_empty();
        Ok(self.receive_frames(bytes)?)
    }

    /// Bytes after a message with a large frame are not read together with it.
    fn max_read_bytes(&self) -> usize {
        match self.missing_bytes {
            _ if !self.is_large => usize::MAX,
            0 => self.expected_header_bytes() - self.header_bytes,
            missing => usize::try_from(missing).unwrap_or(usize::MAX),
        }
    }

    fn poll_overdue(&mut self, cx: &mut Context<'_>) -> Poll<io::Error> {
        if !self.is_incomplete() {
            self.timer.reset();
            return Poll::Pending;
        }
        self.timer.poll_overdue(cx).map(|error| CloseReason::policy(error.to_string()).into())
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::super::super::receive_budget::ReceiveBudget;
    use super::*;
    use crate::admission::{Account, Admission};
    use crate::config::Config;

    const BINARY: u8 = 2;
    const CONTINUATION: u8 = 0;
    const PING: u8 = 9;

    /// A masked frame.
    fn frame(opcode: u8, is_last: bool, payload: usize) -> Vec<u8> {
        let first = opcode | u8::from(is_last) << 7;
        let mut bytes = match payload {
            0..126 => vec![first, 0x80 | payload as u8],
            126..65536 => [&[first, 0xfe], &(payload as u16).to_be_bytes()[..]].concat(),
            _ => [&[first, 0xff], &(payload as u64).to_be_bytes()[..]].concat(),
        };
        bytes.extend([9; 4]);
        bytes.extend(vec![5; payload]);
        bytes
    }

    fn connection_of(config: &Config) -> Arc<ConnectionReceiveBudget> {
        ReceiveBudget::new(config, &Admission::default()).new_connection(&Account::server())
    }

    fn budget() -> Arc<ConnectionReceiveBudget> {
        let config = Config { receive_bytes: 200_000, message_bytes: 100_000, ..Config::default() };
        connection_of(&config)
    }

    fn meter_within(budget: &Arc<ConnectionReceiveBudget>) -> FrameMeter {
        FrameMeter { allowance: FrameAllowance::burst(), ..FrameMeter::new(budget, Arc::default()) }
    }

    fn meter() -> FrameMeter {
        meter_within(&budget())
    }

    #[test]
    fn frames_are_found_in_any_split() {
        let parts = [
            frame(BINARY, false, 300),
            frame(PING, true, 4),
            frame(CONTINUATION, false, 0),
            frame(CONTINUATION, true, 70_000),
            frame(BINARY, true, 0),
            frame(BINARY, true, 9),
        ];
        let bytes = parts.concat();
        for part in [1, 2, 3, 7, 100, bytes.len()] {
            let mut meter = FrameMeter { allowance: FrameAllowance::without_growth(20.0), ..meter() };
            for part in bytes.chunks(part) {
                meter.receive_frames(part).expect("expected frames within the limits");
            }
            assert!(!meter.is_incomplete() && !meter.memory.is_in_use(), "{part}");
            assert_eq!(meter.header_bytes, 0);
        }
    }

    #[test]
    fn incomplete_message_counts_with_all_of_its_frames() {
        let budget = budget();
        let mut meter = meter_within(&budget);
        meter.receive_frames(&frame(BINARY, false, 60_000)).expect("expected capacity");
        assert!(meter.is_incomplete() && meter.memory.is_in_use());
        // Another message of the connection, in the queue of a call.
        let mut queued = budget.new_memory();
        queued.resize(80_000).expect("expected capacity");
        let header = &frame(CONTINUATION, true, 30_000)[..8];
        let reason = meter.receive_frames(header).expect_err("expected a full budget");
        assert_eq!(reason.code(), 1008);
    }

    /// The reads end with the message, whatever follows its large frame.
    #[test]
    fn message_with_a_large_frame_ends_a_read() {
        let mut meter = meter();
        let message = [
            frame(BINARY, false, 3),
            frame(CONTINUATION, false, MIN_LARGE_FRAME),
            frame(PING, true, 3),
            frame(CONTINUATION, false, 300),
            frame(CONTINUATION, true, 5),
        ];
        let small = frame(BINARY, true, 9);
        let bytes = [&small, &message.concat(), &small[..]].concat();
        let (mut position, mut boundaries) = (0, Vec::new());
        while position < bytes.len() {
            let length = meter.max_read_bytes().min(1000).min(bytes.len() - position);
            meter.receive(&bytes[position..][..length]).expect("expected frames within the limits");
            position += length;
            if meter.take_boundary() {
                boundaries.push(position);
            }
        }
        assert_eq!(boundaries, [bytes.len() - small.len()]);
    }

    #[test]
    fn length_above_the_limit_is_left_to_the_library() {
        let mut meter = meter();
        let header = [&[0x80 | BINARY, 0xff][..], &u64::MAX.to_be_bytes(), &[0; 4]].concat();
        meter.receive_frames(&header).expect("expected the budget to hold");
        meter.receive_frames(&[0; 1000]).expect("expected the budget to hold");
    }

    #[test]
    fn floods_of_tiny_frames_end() {
        for (opcode, is_last, payload) in
            [(PING, true, 0), (PING, true, 125), (10, true, 4), (BINARY, true, 0), (CONTINUATION, false, 1)]
        {
            let mut meter = meter();
            let flood = frame(opcode, is_last, payload);
            let accepted = (0..100_000).position(|_| meter.receive_frames(&flood).is_err());
            let accepted = accepted.expect("expected an end of the flood");
            assert!((4000..20_000).contains(&accepted), "{opcode}: {accepted}");
        }
        let mut meter = meter();
        assert!((0..100_000).all(|_| meter.receive_frames(&frame(BINARY, true, 40)).is_ok()));
    }

    #[tokio::test]
    async fn only_an_incomplete_message_has_a_deadline() {
        let config = Config { message_timeout: Duration::from_millis(20), ..Config::default() };
        let budget = connection_of(&config);
        let mut meter = FrameMeter::new(&budget, Arc::default());
        let overdue = async |meter: &mut FrameMeter, limit| {
            tokio::time::timeout(limit, std::future::poll_fn(|cx| meter.poll_overdue(cx))).await
        };
        assert!(overdue(&mut meter, Duration::from_millis(200)).await.is_err(), "expected no deadline");
        meter.receive(&frame(BINARY, false, 3)).expect("expected a frame within the limits");
        let error = overdue(&mut meter, crate::hang_guard::HANG_GUARD).await.expect("expected a deadline");
        assert_eq!(error.downcast::<CloseReason>().expect("expected a reason").code(), 1008);
    }
}
