//! PNG files of shared pictures: one encoder for each size of pictures, and the pictures that are not encoded yet.
//!
//! Kernels between two OpenGL commands make the GPU change to the context of CUDA and back, which takes 0.3 ms. A picture
//! therefore waits until the owner starts all encodings: together with the next step of a deformer, so that both share one
//! change, or when OpenGL has nothing to draw.

use std::cell::{Cell, RefCell};
use std::num::NonZero;
use std::rc::Rc;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::png::{DevicePicture, EncodedPng, PendingPng, PngEncoder};
use crate::gpu::launch::Device;
use crate::gpu::tables::png_plan::PngChannels;
use modalcast_model::error::{Error, Result};

/// Maximum number of encoders, each for a size of pictures. A further one replaces the least recently used one.
const MAX_ENCODERS: usize = 4;

/// Files of one size that are in flight or being copied by readers. Further pictures have no file.
const FILES_PER_ENCODER: NonZero<usize> = NonZero::new(8).expect("8 is not zero");

/// Time after which an encoding is started although OpenGL draws and no deformer computes a step.
const MAX_DELAY: Duration = Duration::from_millis(5);

/// The PNG encoders of all pictures of a device. They share a stream.
#[derive(Debug)]
pub(super) struct PictureEncoder {
    /// The device with the stream of the encoders.
    device: Arc<Device>,
    /// The least recently used one first.
    encoders: RefCell<Vec<PngEncoder>>,
    /// Requested encodings that are not started; at most one for each picture.
    waiting: RefCell<Vec<Rc<Encoding>>>,
    /// Whether an encoding could not be started. Then no further one is.
    has_failed: Cell<bool>,
}

/// The encoding of one picture. Its owner calls [`PictureEncoder::finish`] or [`PictureEncoder::cancel`] before the picture
/// is written or freed.
#[derive(Debug)]
pub(super) struct Encoding {
    picture: DevicePicture,
    requested: Instant,
    state: RefCell<EncodingState>,
}

#[derive(Debug)]
enum EncodingState {
    Waiting,
    /// `None`: the picture has no file.
    Started(Result<Option<PendingPng>>),
}

impl PictureEncoder {
    /// `device` has the stream of the encoders.
    pub(super) fn new(device: Arc<Device>) -> Self {
        Self { device, encoders: RefCell::default(), waiting: RefCell::default(), has_failed: Cell::default() }
    }

    /// Compiles the kernels.
    ///
    /// # Errors
    /// `Unavailable` when NVRTC is missing; `Fault` when compiling fails.
    pub(super) fn prepare(&self) -> Result<()> {
        PngEncoder::new(&self.device, [1, 1], PngChannels::Rgb, NonZero::<usize>::MIN).map(drop)
    }

    /// Requests the file of a picture. `None` if no picture can be encoded.
    ///
    /// # Safety
    /// The picture is readable device memory. It is not written or freed before [`Self::finish`] or [`Self::cancel`].
    pub(super) unsafe fn request(&self, picture: DevicePicture) -> Option<Rc<Encoding>> {
        if self.has_failed.get() {
            return None;
        }
        let state = RefCell::new(EncodingState::Waiting);
        let encoding = Rc::new(Encoding { picture, requested: Instant::now(), state });
        self.waiting.borrow_mut().push(Rc::clone(&encoding));
        Some(encoding)
    }

    /// Starts all requested encodings, without waiting.
    pub(super) fn start_requested(&self) {
        for encoding in self.waiting.take() {
            let started = match self.start(&encoding.picture) {
                Err(error) if !matches!(error, Error::DeviceLost { .. }) => {
                    tracing::warn!(%error, "the CPU encodes PNG files: CUDA cannot");
                    self.has_failed.set(true);
                    Ok(None)
                }
                started => started,
            };
            encoding.state.replace(EncodingState::Started(started));
        }
    }

    fn start(&self, picture: &DevicePicture) -> Result<Option<PendingPng>> {
        if self.has_failed.get() {
            return Ok(None);
        }
        let mut encoders = self.encoders.borrow_mut();
        let size = [picture.width, picture.height];
        let encoder = match encoders.iter().position(|encoder| encoder.size() == size) {
            Some(index) => encoders.remove(index),
            None => {
                if encoders.len() >= MAX_ENCODERS {
                    encoders.remove(0);
                }
                // A frame without alpha is usual. The others have no file.
                PngEncoder::new(&self.device, size, PngChannels::Rgb, FILES_PER_ENCODER)?
            }
        };
        encoders.push(encoder);
        let Some(encoder) = encoders.last_mut() else { return Ok(None) };
        // SAFETY: the picture is readable and not written, as `request` requires.
        unsafe { encoder.encode(picture) }
    }

    /// Whether [`Self::finish`] returns without waiting. Starts all encodings if this one has waited for too long.
    pub(super) fn is_finished(&self, encoding: &Encoding) -> bool {
        if encoding.requested.elapsed() > MAX_DELAY {
            self.start_requested();
        }
        match &*encoding.state.borrow() {
            EncodingState::Waiting => false,
            EncodingState::Started(Ok(Some(png))) => png.is_complete(),
            EncodingState::Started(_) => true,
        }
    }

    /// Waits for the file. `None` if the picture has no file: it is not opaque, or too many files are in use.
    ///
    /// # Errors
    /// `DeviceLost` or `Fault` when the device fails.
    pub(super) fn finish(&self, encoding: &Encoding) -> Result<Option<EncodedPng>> {
        if matches!(*encoding.state.borrow(), EncodingState::Waiting) {
            self.start_requested();
        }
        match encoding.state.replace(EncodingState::Started(Ok(None))) {
            EncodingState::Started(started) => started?.map_or(Ok(None), PendingPng::wait),
            EncodingState::Waiting => Ok(None),
        }
    }

    /// Forgets an encoding that is not started, or waits for it.
    pub(super) fn cancel(&self, encoding: &Rc<Encoding>) {
        self.waiting.borrow_mut().retain(|waiting| !Rc::ptr_eq(waiting, encoding));
        if let EncodingState::Started(Ok(Some(png))) = encoding.state.replace(EncodingState::Started(Ok(None))) {
            // Ignore a fault: the next call to the device reports it.
            png.wait().ok();
        }
    }
}
