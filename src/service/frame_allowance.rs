//! The number of frames without payload that a connection may send.
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

/// Counts frames without payload.
#[derive(Debug)]
pub(super) struct FrameAllowance {
    frames: f64,
    last_growth: Instant,
}

impl FrameAllowance {
    pub(super) fn new() -> Self {
        Self { frames: BURST, last_growth: Instant::now() }
    }

    /// Counts a frame.
    pub(super) fn take_frame(&mut self) {
        self.frames -= 1.0;
    }

    /// Counts a frame that the server answers with `bytes` bytes. The allowance must not grow by this answer.
    pub(super) fn take_answered_frame(&mut self, bytes: usize) {
        self.frames -= 1.0 + bytes as f64 / BYTES_PER_FRAME;
    }

    /// Counts transferred payload.
    pub(super) fn add_payload(&mut self, bytes: usize) {
        self.grow(bytes as f64 / BYTES_PER_FRAME);
    }

    /// False if the connection has sent too many frames without payload.
    pub(super) fn is_left(&mut self) -> bool {
        self.frames >= 0.0 || self.grow_with_time()
    }

    fn grow(&mut self, frames: f64) {
        self.frames = BURST.min(self.frames + frames);
    }

    fn grow_with_time(&mut self) -> bool {
        let seconds = self.last_growth.elapsed().as_secs_f64();
        self.last_growth = Instant::now();
        self.grow(FRAMES_PER_SECOND * seconds);
        self.frames >= 0.0
    }
}

#[cfg(test)]
impl FrameAllowance {
    /// An allowance that does not grow with time.
    pub(super) fn without_growth(frames: f64) -> Self {
        Self { frames, last_growth: Instant::now() + std::time::Duration::from_secs(1000) }
    }

    /// The default allowance, without growth.
    pub(super) fn burst() -> Self {
        Self::without_growth(BURST)
    }

    pub(super) const fn frames(&self) -> f64 {
        self.frames
    }
}
