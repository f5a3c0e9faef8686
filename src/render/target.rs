//! Where a frame is drawn: multisampled colour and depth, and the buffers through which its pixels come back.

use std::rc::Rc;

use super::gl::{self, Buffer, Framebuffer, Gl, Program, Texture, TextureKind};
use crate::error::Result;

/// Device memory that a multisampled frame may take; a larger one is drawn with one sample a pixel.
const MULTISAMPLED_BYTES: u64 = 512 << 20;
/// Colour (RGBA16F) and depth (32 bit).
const SAMPLE_BYTES: u64 = 12;

/// The images and buffers of frames of one size.
#[derive(Debug)]
pub(super) struct Target {
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) samples: u32,
    pub(super) colour: Texture,
    pub(super) framebuffer: Framebuffer,
    /// RGBA8, top row first, as the encoder writes it.
    pub(super) packed: Buffer,
    /// The same where the host can read it.
    pub(super) staging: Buffer,
    pub(super) encode: Rc<Program>,
    // Attached to the framebuffer, which must not outlive it.
    _depth: Texture,
}

/// Samples a pixel that a frame of this size is drawn with.
pub(super) fn samples(gl: &Gl, width: u32, height: u32) -> u32 {
    let wanted = most_samples(gl);
    let bytes = u64::from(width) * u64::from(height) * u64::from(wanted) * SAMPLE_BYTES;
    if bytes <= MULTISAMPLED_BYTES { wanted } else { 1 }
}

/// The most that any frame is drawn with: four, or one where the device has no four.
pub(super) fn most_samples(gl: &Gl) -> u32 {
    if gl.limits.max_samples >= 4 { 4 } else { 1 }
}

impl Target {
    pub(super) fn new(gl: &Rc<Gl>, width: u32, height: u32, encode: Rc<Program>) -> Result<Self> {
        let samples = samples(gl, width, height);
        let target = if samples > 1 { gl::TEXTURE_2D_MULTISAMPLE } else { gl::TEXTURE_2D };
        let image = |format: u32| gl.texture(TextureKind { target, format, width, height, depth: samples, levels: 1 });
        let (colour, depth) = (image(gl::RGBA16F)?, image(gl::DEPTH_COMPONENT32F)?);
        if samples == 1 {
            colour.sampling(&[(gl::TEXTURE_MIN_FILTER, gl::NEAREST), (gl::TEXTURE_MAG_FILTER, gl::NEAREST)], 1.0);
        }
        let bytes = 4 * u64::from(width) * u64::from(height);
        Ok(Self {
            width,
            height,
            samples,
            framebuffer: gl.framebuffer(Some(&colour), &depth)?,
            packed: gl.buffer(bytes, gl::STREAM_COPY, None)?,
            staging: gl.buffer(bytes, gl::STREAM_READ, None)?,
            colour,
            encode,
            _depth: depth,
        })
    }
}
