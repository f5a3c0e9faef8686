//! Limits the HTTP/2 frames of a connection that carry no request: PING, SETTINGS, PRIORITY, WINDOW_UPDATE and frames of
//! unknown types. Each costs a peer 9 to 17 bytes and the server some work, and h2 accepts any number of them.
//!
//! A connection has an allowance of [`BURST`] frames, which grows again with time and with the payload that is
//! transferred. A client that receives much therefore may send many window updates and measure the round-trip time
//! with many pings.

use std::time::Instant;

/// Frames that a connection may send at once.
const BURST: f64 = 10_000.0;

/// Frames per second by which the allowance grows.
const FRAMES_PER_SECOND: f64 = 100.0;

/// Bytes of payload, in either direction, by which the allowance grows by one frame.
const BYTES_PER_FRAME: f64 = 16.0;

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
    allowance: f64,
    last_growth: Instant,
}

impl ControlFrameLimit {
    pub(super) fn new() -> Self {
        let (header, header_bytes, missing_bytes) = ([0; HEADER_BYTES], 0, 0);
        Self { header, header_bytes, missing_bytes, allowance: BURST, last_growth: Instant::now() }
    }

    /// Counts received bytes. Returns false if the connection has sent too many control frames.
    pub(super) fn receive(&mut self, mut bytes: &[u8]) -> bool {
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
        self.allowance >= 0.0 || self.grow_with_time()
    }

    /// Counts bytes that the server has sent.
    pub(super) fn send(&mut self, bytes: usize) {
        self.grow(bytes as f64 / BYTES_PER_FRAME);
    }

    fn count(&mut self, kind: u8) {
        match kind {
            DATA | HEADERS | CONTINUATION => self.grow(self.missing_bytes as f64 / BYTES_PER_FRAME),
            // The server answers with as many bytes, by which the allowance must not grow.
            PING | SETTINGS => self.allowance -= 1.0 + (HEADER_BYTES + self.missing_bytes) as f64 / BYTES_PER_FRAME,
            _ => self.allowance -= 1.0,
        }
    }

    fn grow(&mut self, frames: f64) {
        self.allowance = BURST.min(self.allowance + frames);
    }

    fn grow_with_time(&mut self) -> bool {
        let seconds = self.last_growth.elapsed().as_secs_f64();
        self.last_growth = Instant::now();
        self.grow(FRAMES_PER_SECOND * seconds);
        self.allowance >= 0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WINDOW_UPDATE: u8 = 8;

    fn frame(kind: u8, payload: usize) -> Vec<u8> {
        let [_, a, b, c] = (payload as u32).to_be_bytes();
        [&[a, b, c, kind, 0, 0, 0, 0, 1][..], &vec![7; payload]].concat()
    }

    /// A limit whose allowance does not grow with time.
    fn limit() -> ControlFrameLimit {
        let future = Instant::now() + std::time::Duration::from_secs(1000);
        ControlFrameLimit { last_growth: future, ..ControlFrameLimit::new() }
    }

    fn accepted_frames(kind: u8, payload: usize, answer: usize) -> Option<usize> {
        let mut limit = limit();
        (0..100_000).find(|_| {
            let is_accepted = limit.receive(&frame(kind, payload));
            limit.send(answer);
            !is_accepted
        })
    }

    #[test]
    fn floods_of_all_kinds_end() {
        for (kind, payload, answer) in [(PING, 8, 17), (SETTINGS, 0, 9), (2, 5, 0), (WINDOW_UPDATE, 4, 0), (99, 3, 0)] {
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
            let mut limit = ControlFrameLimit { allowance: 100.0, ..limit() };
            assert!(bytes.chunks(part).all(|part| limit.receive(part)));
            let expected = 100.0 + 300.0 / 16.0 - 1.0 - 17.0 / 16.0 - 1.0;
            assert!((limit.allowance - expected).abs() < 1e-9, "{part}: {}", limit.allowance);
        }
    }
}
