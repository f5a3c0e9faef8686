//! Frames in flight, and their mapped pixels.

use std::cell::Cell;
use std::rc::Rc;
use std::time::{Duration, Instant};

use rayon::prelude::*;

use super::frame_readback::FrameReadback;
use crate::device::gl::{Fence, PassTimer, ReadbackView, SpanTimer};
use crate::pass::{FrameTimes, Pass, RenderStage};
use crate::pieces::{OutputClass, OutputCosts};
use crate::resources::target_desc::TargetDesc;
use crate::types::{FrameImage, FrameInfo, FrameStats};
use modalcast_model::error::{Error, Result};
use modalcast_model::shared_memory::{CopiedPng, PngRequest};

/// Bytes that one parallel task copies: enough to hide the cost of starting the task.
const COPY_CHUNK_BYTES: usize = 1 << 20;

/// A frame in flight. Dropping it abandons the frame.
#[derive(Debug)]
pub struct PendingFrame {
    pub(super) desc: TargetDesc,
    /// None for a frame whose pixels are not read back.
    pub(super) readback: Option<FrameReadback>,
    pub(super) fence: Fence,
    /// Passes in execution order, each with its timer.
    pub(super) passes: Vec<(Pass, PassTimer)>,
    /// Milliseconds of the upload of vertices before the frame; `None` if none were uploaded.
    pub(super) upload_ms: Option<f64>,
    /// Milliseconds that the host waited for the compute rasterizer beside its device time.
    pub(super) raster_switch_ms: f64,
    /// When the device draws the frame; `None` for a software rasterizer.
    pub(super) span: Option<SpanTimer>,
    pub(super) stats: FrameStats,
    /// Without the rasterizers, which `stats` contains.
    pub(super) info: FrameInfo,
    pub(super) class: OutputClass,
    /// Receives the time of the frame.
    pub(super) costs: Rc<OutputCosts>,
    /// Maximum time from `first_wait` until the frame is finished.
    pub(super) timeout: Duration,
    /// When the host first polled or waited for the frame.
    pub(super) first_wait: Cell<Option<Instant>>,
}

/// Pixels of a finished frame in host-readable memory. Any thread may read them. No other frame can use the memory
/// while this value exists, so copy the pixels soon, or let [`MappedPixels::into_shared_image`] decide.
#[derive(Debug)]
pub struct MappedPixels {
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) view: Option<ReadbackView>,
    /// The PNG file, if [`PendingFrame::request_png`] has requested it and the device has encoded it.
    pub(super) png: Option<CopiedPng>,
    pub(super) times: FrameTimes,
    pub(super) info: FrameInfo,
}

/// The RGBA8 pixels of a frame, in memory of their own or in that of the readback.
#[derive(Debug)]
pub enum FramePixels {
    Copied(Vec<u8>),
    Held(HeldPixels),
    /// The PNG file, which the device has encoded.
    Encoded(EncodedPng),
}

/// The PNG file of a frame.
#[derive(Debug)]
pub struct EncodedPng {
    /// A copy, so that the device's memory for files is free for the next frames.
    pub png: Vec<u8>,
    /// Milliseconds that the device encoded.
    pub ms: f64,
    /// The pixels, if they were requested, too.
    pub rgba: Option<Box<FramePixels>>,
}

/// Pixels in the memory of a readback. No other frame can use the memory while this value exists.
#[derive(Debug)]
pub struct HeldPixels(ReadbackView);

impl AsRef<[u8]> for HeldPixels {
    fn as_ref(&self) -> &[u8] {
        self.0.bytes()
    }
}

impl AsRef<[u8]> for FramePixels {
    fn as_ref(&self) -> &[u8] {
        match self {
            Self::Copied(bytes) => bytes,
            Self::Held(pixels) => pixels.as_ref(),
            Self::Encoded(encoded) => encoded.rgba.as_deref().map_or(&[], Self::as_ref),
        }
    }
}

impl From<Vec<u8>> for FramePixels {
    fn from(bytes: Vec<u8>) -> Self {
        Self::Copied(bytes)
    }
}

impl PartialEq for FramePixels {
    fn eq(&self, other: &Self) -> bool {
        self.as_ref() == other.as_ref()
    }
}

impl PendingFrame {
    /// Requests that the device encodes the frame as PNG. The pixels are copied, too, if `copies_pixels`, or if the
    /// device cannot encode the frame ([`crate::PixelReadback`]).
    pub fn request_png(&self, copies_pixels: bool) {
        if let Some(FrameReadback::Whole(slot)) = &self.readback {
            slot.request_png(PngRequest { size: [self.desc.width, self.desc.height], copies_pixels });
        }
    }

    /// Whether OpenGL has drawn the frame. It may still have to be copied or encoded.
    pub fn is_drawn(&self) -> bool {
        self.fence.is_done_within(Duration::ZERO)
    }

    /// Whether [`super::Renderer::map_pixels`] would return without waiting.
    pub fn is_ready(&self) -> bool {
        self.is_ready_within(Duration::ZERO)
    }

    /// Waits at most `timeout` for the frame and returns whether it is ready. A frame that exceeds its own time limit
    /// counts as ready: retrieving it reports the timeout.
    pub fn is_ready_within(&self, timeout: Duration) -> bool {
        self.time_left().is_zero()
            || match &self.readback {
                Some(readback) => readback.is_ready_within(&self.fence, timeout),
                None => self.fence.is_done_within(timeout),
            }
    }

    /// Remaining time until the frame's time limit. The clock starts at the first poll or wait.
    pub(super) fn time_left(&self) -> Duration {
        let begin = self.first_wait.get().unwrap_or_else(Instant::now);
        self.first_wait.set(Some(begin));
        self.timeout.saturating_sub(begin.elapsed())
    }

    pub(super) fn wait(&self) -> Result<()> {
        self.fence.wait(Pass::Read.name(), self.time_left()).map_err(|error| self.name_failed_pass(error))
    }

    /// Replaces the stage of a fault by the first pass that the device did not finish.
    fn name_failed_pass(&self, error: Error) -> Error {
        let Error::Fault { stage, reason } = error else { return error };
        let finished_count = self.passes.iter().take_while(|(_, timer)| timer.is_done()).count();
        let stage = self.passes.get(finished_count).map_or(stage, |(pass, _)| pass.name());
        let last_pass =
            finished_count.checked_sub(1).map_or("none".into(), |index| format!("'{}'", self.passes[index].0));
        Error::Fault {
            stage,
            reason: format!("{reason} (time limit {:?}); last finished pass: {last_pass}", self.timeout),
        }
    }
}

impl MappedPixels {
    /// Times of the passes, without the copy of the pixels.
    pub const fn times(&self) -> &FrameTimes {
        &self.times
    }

    /// The pixels, held in the memory of the readback if enough of it is left for the next frames, else copied. With
    /// the PNG file, if it was requested and the device has encoded it.
    pub fn into_shared_image(mut self) -> FrameImage<FramePixels> {
        let Some(CopiedPng { file, has_pixels, ms }) = self.png.take() else { return self.into_shared_pixels() };
        let (width, height, info) = (self.width, self.height, self.info);
        let png = file.bytes().to_vec();
        drop(file);
        let (times, rgba) = if has_pixels {
            let image = self.into_shared_pixels();
            (image.times, Some(Box::new(image.rgba)))
        } else {
            (self.times, None)
        };
        FrameImage { width, height, rgba: FramePixels::Encoded(EncodedPng { png, ms, rgba }), times, info }
    }

    fn into_shared_pixels(self) -> FrameImage<FramePixels> {
        let Self { width, height, view, png, times, info } = self;
        match view {
            Some(view) if view.can_be_held() => {
                FrameImage { width, height, rgba: FramePixels::Held(HeldPixels(view)), times, info }
            }
            view => {
                let FrameImage { rgba, times, .. } = Self { width, height, view, png, times, info }.into_image();
                FrameImage { width, height, rgba: FramePixels::Copied(rgba), times, info }
            }
        }
    }

    /// Copies the pixels, with several threads if there are many, unless they were copied band by band.
    pub fn into_image(self) -> FrameImage {
        let begin = Instant::now();
        let Self { width, height, view, mut times, info, .. } = self;
        let rgba = match view {
            Some(ReadbackView::Copied(bytes)) => bytes,
            view => {
                let bytes = view.as_ref().map_or(&[][..], ReadbackView::bytes);
                let mut rgba = vec![0; bytes.len()];
                let chunks = rgba.par_chunks_mut(COPY_CHUNK_BYTES).zip(bytes.par_chunks(COPY_CHUNK_BYTES));
                chunks.for_each(|(destination, source)| destination.copy_from_slice(source));
                rgba
            }
        };
        times.add(RenderStage::Read, begin.elapsed().as_secs_f64() * 1e3);
        FrameImage { width, height, rgba, times, info }
    }
}
