//! Pictures in device memory that OpenGL and CUDA share, and their readback by CUDA's copy engine.
//!
//! OpenGL draws into the memory. The host waits for OpenGL's fence, then a copy on a stream of its own moves the pixels
//! to pinned memory. Copies run concurrently with the next frame: they do not make the GPU change between the contexts of
//! OpenGL and CUDA, as kernels do. On request, kernels on another stream encode the picture as PNG ([`super::picture_encoder`]).

use std::ops::Range;
use std::rc::Rc;
use std::sync::Arc;

use cudarc::driver::{CudaEvent, CudaStream, sys};

use super::picture_encoder::{Encoding, PictureEncoder};
use super::pinned_pixels::PinnedPixels;
use super::png::DevicePicture;
use crate::gpu::launch::cleanup::WaitForStream;
use crate::gpu::launch::error::cuda_error;
use crate::gpu::launch::{Device, ExportedMemory};
use modalcast_model::error::{Result, fault};
use modalcast_model::shared_memory::{
    CopiedPixels, CopiedPng, CopyRequest, HostPixels, NewPicture, PictureMemory, PngRequest, SharedPicture,
};

const STAGE: &str = "read";

/// Allocates pictures on a CUDA device.
#[derive(Debug)]
pub struct CudaPictureMemory {
    device: Arc<Device>,
    copy_stream: Arc<CudaStream>,
    encoder: Rc<PictureEncoder>,
}

/// A picture in device memory, and the pinned memory of its copy.
#[derive(Debug)]
struct CudaPicture {
    memory: ExportedMemory,
    /// Bytes of the picture; `memory` may be larger.
    bytes: usize,
    pixels: Arc<PinnedPixels>,
    /// End of the last copy.
    copied: CudaEvent,
    is_copying: bool,
    /// The encoding of the last copy.
    encoding: Option<RequestedPng>,
    /// Bytes of the copy in flight.
    copied_bytes: usize,
    encoder: Rc<PictureEncoder>,
    copy_stream: Arc<CudaStream>,
    device: Arc<Device>,
}

/// A requested PNG file, and whether the pixels are copied, too.
#[derive(Debug)]
struct RequestedPng {
    encoding: Rc<Encoding>,
    copies_pixels: bool,
}

impl CudaPictureMemory {
    /// Creates the streams of the copies and of the encodings.
    ///
    /// # Errors
    /// `Fault` when the driver refuses a stream.
    pub fn new(device: &Arc<Device>) -> Result<Self> {
        let copy_stream = device.context().new_stream().map_err(cuda_error(STAGE))?;
        let encoder = Rc::new(PictureEncoder::new(Arc::new(device.with_own_stream()?)));
        Ok(Self { device: Arc::clone(device), copy_stream, encoder })
    }

    /// Compiles the kernels of the PNG encoder, so that the first picture does not wait for them.
    ///
    /// # Errors
    /// `Unavailable` when NVRTC is missing; `Fault` when compiling fails.
    pub fn prepare_encoder(&self) -> Result<()> {
        self.encoder.prepare()
    }

    /// Starts to encode all pictures whose copies were started with a request for a PNG file, without waiting. The owner
    /// calls this before a step of a deformer, and when OpenGL has nothing to draw, because the kernels make the GPU change
    /// between the contexts of OpenGL and CUDA.
    pub fn start_encodings(&self) {
        self.encoder.start_requested();
    }
}

impl PictureMemory for CudaPictureMemory {
    fn create_picture(&self, bytes: usize) -> Result<NewPicture> {
        let device = &self.device;
        let _current = device.enter()?;
        let memory = ExportedMemory::new(device, bytes)?;
        let (descriptor, allocated_bytes) = (memory.export()?, memory.bytes() as u64);
        let picture = Box::new(CudaPicture {
            memory,
            bytes,
            pixels: Arc::new(PinnedPixels::new(device, bytes)?),
            copied: device.context().new_event(None).map_err(cuda_error(STAGE))?,
            is_copying: false,
            encoding: None,
            copied_bytes: 0,
            encoder: Rc::clone(&self.encoder),
            copy_stream: Arc::clone(&self.copy_stream),
            device: Arc::clone(device),
        });
        Ok(NewPicture { descriptor, allocated_bytes, picture })
    }
}

impl CudaPicture {
    /// Requests the file of the picture. `None` if no picture can be encoded.
    ///
    /// # Errors
    /// `Fault` if the picture is larger than the memory.
    fn request_png(
        &self,
        PngRequest { size: [width, height], copies_pixels }: PngRequest,
    ) -> Result<Option<RequestedPng>> {
        if 4 * u64::from(width) * u64::from(height) > self.bytes as u64 {
            return Err(fault(STAGE, format!("expected a picture of at most {} bytes", self.bytes)));
        }
        let picture = DevicePicture { address: self.memory.address(), pitch: 4 * i64::from(width), width, height };
        // SAFETY: the memory has these pixels. OpenGL writes it again only after `is_copied` or `finish_copy`, and this
        // value cancels the encoding before it is dropped.
        let encoding = unsafe { self.encoder.request(picture) };
        Ok(encoding.map(|encoding| RequestedPng { encoding, copies_pixels }))
    }

    /// Starts to copy a range of bytes.
    fn copy(&self, range: Range<usize>) -> Result<()> {
        let guard = WaitForStream::new(&self.copy_stream);
        if !range.is_empty() {
            let target = self.pixels.address.wrapping_add(range.start).cast();
            let source = self.memory.address() + range.start as u64;
            // SAFETY: both memories have the range and belong to this value, which waits for the copy before it is dropped.
            // No reader has a reference to the pixels, and gets one only after the copy. If this fails before the event is
            // recorded, the guard waits for the copy.
            unsafe { sys::cuMemcpyDtoHAsync_v2(target, source, range.len(), self.copy_stream.cu_stream()) }
                .result()
                .map_err(cuda_error(STAGE))?;
        }
        self.copied.record(&self.copy_stream).map_err(cuda_error(STAGE))?;
        guard.disarm();
        Ok(())
    }

    /// Waits for the file. If the picture has no file, copies the pixels that were left out.
    fn finish_encoding(&mut self) -> Result<Option<CopiedPng>> {
        let Some(RequestedPng { encoding, copies_pixels }) = self.encoding.take() else { return Ok(None) };
        if let Some(file) = self.encoder.finish(&encoding)? {
            let ms = file.ms();
            return Ok(Some(CopiedPng { file: Arc::new(file), has_pixels: copies_pixels, ms }));
        }
        if !copies_pixels {
            let _current = self.device.enter()?;
            self.copy(0..self.copied_bytes)?;
            self.copied.synchronize().map_err(cuda_error(STAGE))?;
        }
        Ok(None)
    }
}

impl HostPixels for PinnedPixels {
    fn bytes(&self) -> &[u8] {
        self.as_slice()
    }
}

impl SharedPicture for CudaPicture {
    fn start_copy(&mut self, CopyRequest { bytes, png }: CopyRequest) -> Result<()> {
        if bytes > self.bytes {
            return Err(fault(STAGE, format!("expected at most {} bytes of a picture, got {bytes}", self.bytes)));
        }
        if self.is_copying || Arc::strong_count(&self.pixels) > 1 {
            return Err(fault(STAGE, "expected a picture without a copy in flight and without a reader"));
        }
        let _current = self.device.enter()?;
        self.encoding = png.map_or(Ok(None), |request| self.request_png(request))?;
        let is_png_only = self.encoding.as_ref().is_some_and(|png| !png.copies_pixels);
        let pixel_bytes =
            png.map_or(0, |PngRequest { size: [width, height], .. }| 4 * width as usize * height as usize);
        self.copy(if is_png_only { pixel_bytes..bytes.max(pixel_bytes) } else { 0..bytes })?;
        self.copied_bytes = bytes;
        self.is_copying = true;
        Ok(())
    }

    fn is_copied(&self) -> bool {
        let is_encoded = self.encoding.as_ref().is_none_or(|png| self.encoder.is_finished(&png.encoding));
        !self.is_copying || (is_encoded && self.copied.try_is_complete() != Ok(false))
    }

    fn finish_copy(&mut self) -> Result<CopiedPixels> {
        if !self.is_copying {
            return Err(fault(STAGE, "expected a copy in flight, got none"));
        }
        self.copied.synchronize().map_err(cuda_error(STAGE))?;
        let png = self.finish_encoding()?;
        self.is_copying = false;
        Ok(CopiedPixels { pixels: Arc::clone(&self.pixels) as Arc<dyn HostPixels>, png })
    }

    fn fill(&mut self, word: u32) -> Result<()> {
        let _current = self.device.enter()?;
        let stream = &self.copy_stream;
        // SAFETY: the memory has at least these words, and the stream is synchronized before this returns.
        let fill_result =
            unsafe { sys::cuMemsetD32Async(self.memory.address(), word, self.bytes / 4, stream.cu_stream()) };
        let wait_result = stream.synchronize();
        fill_result.result().and(wait_result).map_err(cuda_error(STAGE))
    }
}

impl Drop for CudaPicture {
    fn drop(&mut self) {
        if let Some(png) = self.encoding.take() {
            self.encoder.cancel(&png.encoding);
        }
        if self.is_copying {
            // Ignore a fault: the next call to the device reports it.
            self.copied.synchronize().ok();
        }
    }
}
