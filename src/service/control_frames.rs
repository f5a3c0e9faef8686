//! Limits the HTTP/2 frames of a connection that carry no request: PING, SETTINGS, PRIORITY, WINDOW_UPDATE and frames
//! of unknown types. Each costs a peer 9 to 17 bytes and the server some work, and h2 accepts any number of them.

use std::io;

use super::frame_allowance::FrameAllowance;
use super::metered_socket::Meter;

/// Size of a frame's header in bytes: 3 bytes of length, the type, the flags and the stream.
const HEADER_BYTES: usize = 9;

// Frame types (RFC 9113, 6).
const DATA: u8 = 0;
const HEADERS: u8 = 1;
const SETTINGS: u8 = 4;
const PING: u8 = 6;
const CONTINUATION: u8 = 9;

/// Counts the frames that a connection receives.
#[derive(Debug)]
pub(super) struct ControlFrameLimit {
    header: [u8; HEADER_BYTES],
    /// Number of received bytes of the next header.
    header_bytes: usize,
    /// Number of missing bytes of the frame's payload.
    missing_bytes: usize,
    allowance: FrameAllowance,
}

impl ControlFrameLimit {
    pub(super) fn new() -> Self {
        let (header, header_bytes, missing_bytes) = ([0; HEADER_BYTES], 0, 0);
        Self { header, header_bytes, missing_bytes, allowance: FrameAllowance::new() }
    }

    /// Counts received bytes. Returns false if the connection has sent too many control frames.
    fn receive_frames(&mut self, mut bytes: &[u8]) -> bool {
        while !bytes.is_empty() {
            if self.missing_bytes > 0 {
                let payload = self.missing_bytes.min(bytes.len());
                bytes = &bytes[payload..];
                self.missing_bytes -= payload;
                continue;
            }
            let part = (HEADER_BYTES - self.header_bytes).min(bytes.len());
            self.header[self.header_bytes..][..part].copy_from_slice(&bytes[..part]);
            bytes = &bytes[part..];
            self.header_bytes += part;
            if self.header_bytes == HEADER_BYTES {
                self.header_bytes = 0;
                let [a, b, c, kind, ..] = self.header;
                self.missing_bytes = u32::from_be_bytes([0, a, b, c]) as usize;
                self.count(kind);
            }
        }
        self.allowance.is_left()
    }

    fn count(&mut self, kind: u8) {
        match kind {
            DATA | HEADERS | CONTINUATION => self.allowance.add_payload(self.missing_bytes),
            PING | SETTINGS => self.allowance.take_answered_frame(HEADER_BYTES + self.missing_bytes),
            _ => self.allowance.take_frame(),
        }
    }
}

impl Meter for ControlFrameLimit {
    fn receive(&mut self, bytes: &[u8]) -> io::Result<()> {
        match self.receive_frames(bytes) {
            true => Ok(()),
            false => Err(io::Error::other("the client has sent too many control frames")),
        }
    }

    fn send(&mut self, bytes: usize) {
        self.allowance.add_payload(bytes);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PRIORITY: u8 = 2;
    const WINDOW_UPDATE: u8 = 8;
    const UNKNOWN: u8 = 99;

    fn frame(kind: u8, payload: usize) -> Vec<u8> {
        let [_, a, b, c] = (payload as u32).to_be_bytes();
        [&[a, b, c, kind, 0, 0, 0, 0, 1][..], &vec![7; payload]].concat()
    }

    /// A limit whose allowance does not grow with time.
    fn limit() -> ControlFrameLimit {
        ControlFrameLimit { allowance: FrameAllowance::burst(), ..ControlFrameLimit::new() }
    }

    /// Number of equal frames that are accepted, if the server sends `answer` bytes after each. `None`: all of 100,000.
    fn accepted_frames(kind: u8, payload: usize, answer: usize) -> Option<usize> {
        let mut limit = limit();
        (0..100_000).find(|_| {
            let is_accepted = limit.receive_frames(&frame(kind, payload));
            limit.send(answer);
            !is_accepted
        })
    }

    #[test]
    fn floods_of_all_kinds_end() {
        for (kind, payload, answer) in
            [(PING, 8, 17), (SETTINGS, 0, 9), (PRIORITY, 5, 0), (WINDOW_UPDATE, 4, 0), (UNKNOWN, 3, 0)]
        {
            let accepted = accepted_frames(kind, payload, answer).expect("expected an end");
            assert!((5000..=10_000).contains(&accepted), "{kind}: {accepted}");
        }
    }

    #[test]
    fn transferred_payload_permits_control_frames() {
        assert_eq!(accepted_frames(DATA, 20, 0), None);
        assert_eq!(accepted_frames(WINDOW_UPDATE, 4, 29), None);
        assert_eq!(accepted_frames(PING, 8, 17 + 100), None);
    }

    #[test]
    fn frames_are_found_in_any_split() {
        let bytes = [frame(DATA, 300), frame(PING, 8), frame(DATA, 0), frame(WINDOW_UPDATE, 4)].concat();
        for part in [1, 2, 8, 9, 10, 100, bytes.len()] {
            let mut limit = ControlFrameLimit { allowance: FrameAllowance::without_growth(100.0), ..limit() };
            assert!(bytes.chunks(part).all(|part| limit.receive_frames(part)));
            // 300 bytes of payload, a PING with an answer of 17 bytes, and a WINDOW_UPDATE. 16 bytes permit a frame.
            let expected = 100.0 + 300.0 / 16.0 - (1.0 + 17.0 / 16.0) - 1.0;
            let frames = limit.allowance.frames();
            assert!((frames - expected).abs() < 1e-9, "{part}: {frames}");
        }
    }
}
