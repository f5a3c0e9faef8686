//! Converts ids to 32-bit words and reads the words back: the common part of visibility readback, picking and AOVs.
//! Also copies the pixels of a frame to a staging buffer.

use std::rc::Rc;

use super::draw::bind_visibility;
use super::recorder::{FrameContext, PassRecorder};
use crate::device::gl::{self, Buffer, BufferCopy, Framebuffer, Gl, Program, Texture};
use crate::layout::{ID_UNIT, WORDS_BINDING, WORKGROUP_SIZE};
use crate::pass::Pass;
use crate::region::Band;
use crate::resources::target::RenderTarget;
use crate::resources::target_desc::{TargetDesc, create_image};
use modalcast_model::error::Result;

/// Render target with ids and depth only, and the buffer of the words to read back.
#[derive(Debug)]
pub(super) struct IdTarget {
    pub(super) ids: Texture,
    pub(super) framebuffer: Framebuffer,
    pub(super) readback_source: Buffer,
}

/// Parameters of a compute pass that converts ids to 32-bit words, and of the copy of the words.
#[derive(Debug, Clone, Copy)]
pub(super) struct WordPass<'a> {
    pub(super) pass: Pass,
    pub(super) program: &'a Program,
    /// Uniform at location 0 of programs that have one.
    pub(super) uniform: Option<u32>,
    /// Width and height of the id image in pixels; the program runs once per pixel.
    pub(super) size: [u32; 2],
    /// The rows to convert; none for a program that converts all rows.
    pub(super) band: Option<Band>,
    pub(super) staging: &'a Buffer,
    /// Bytes to copy to the staging buffer.
    pub(super) bytes: u64,
}

impl IdTarget {
    pub(super) fn new(gl: &Rc<Gl>, desc: TargetDesc, readback_bytes: u64) -> Result<Self> {
        let (ids, depth) = (create_image(gl, desc, gl::R32UI)?, create_image(gl, desc, gl::DEPTH_COMPONENT32F)?);
        Ok(Self {
            framebuffer: gl.framebuffer(Some(&ids), &depth)?,
            ids,
            readback_source: gl.buffer(readback_bytes, gl::STREAM_COPY, None)?,
        })
    }

    /// Converts the ids of this target, and copies the words to the staging buffer.
    pub(super) fn read(&self, recorder: &PassRecorder<'_>, word_pass: &WordPass<'_>) -> Result<()> {
        self.convert(recorder, word_pass);
        self.copy(recorder, word_pass)
    }

    /// Converts the ids of this target to words.
    pub(super) fn convert(&self, recorder: &PassRecorder<'_>, word_pass: &WordPass<'_>) {
        self.ids.bind(ID_UNIT);
        convert_ids(recorder, &self.readback_source, word_pass);
    }

    /// Copies the words to the staging buffer.
    pub(super) fn copy(&self, recorder: &PassRecorder<'_>, word_pass: &WordPass<'_>) -> Result<()> {
        copy_words(recorder, &self.readback_source, word_pass)
    }
}

/// Copies the id of the first sample of each pixel to a staging buffer of `desc.frame_bytes()` bytes, top row first.
pub(crate) fn read_visibility(
    recorder: &PassRecorder<'_>,
    target: &RenderTarget,
    program: &Program,
    staging: &Buffer,
) -> Result<()> {
    recorder.begin(Pass::VisibilityReadback);
    bind_visibility(target);
    let size = [target.desc.width, target.desc.height];
    let bytes = target.desc.frame_bytes();
    let band = Some(Band::whole(target.desc.height));
    let word_pass = WordPass { pass: Pass::VisibilityReadback, program, uniform: None, size, band, staging, bytes };
    convert_ids(recorder, &target.readback_source, &word_pass);
    copy_words(recorder, &target.readback_source, &word_pass)
}

/// A buffer that receives a part of a frame and of the counters that follow it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ReadbackBuffer<'a> {
    pub(crate) buffer: &'a Buffer,
    /// The byte of the frame that the first byte of the buffer receives.
    pub(crate) first_byte: u64,
}

/// Copies as many rows of a frame as a band has to a staging buffer, unless the frame has a shared picture. With the
/// last band, also copies the fragment and culling counters behind the pixels.
pub(crate) fn copy_frame(
    recorder: &PassRecorder<'_>,
    frame: &FrameContext<'_>,
    staging: Option<ReadbackBuffer<'_>>,
    band: Band,
) -> Result<()> {
    let FrameContext { buffers, target, .. } = *frame;
    recorder.begin(Pass::Read);
    if let Some(ReadbackBuffer { buffer, first_byte }) = staging {
        let [source_offset, bytes] =
            [band.first_row, band.rows].map(|rows| 4 * u64::from(target.desc.width) * u64::from(rows));
        let (source, target_offset) = (&target.readback_source, source_offset - first_byte);
        recorder.gl.copy(BufferCopy { source, source_offset, target: buffer, target_offset, bytes });
    }
    let picture = frame.picture.map(|buffer| ReadbackBuffer { buffer, first_byte: 0 });
    let Some(ReadbackBuffer { buffer, first_byte }) = staging.or(picture).filter(|_| band.is_last()) else {
        return recorder.check(Pass::Read);
    };
    let counters = [
        target.oit.as_ref().map(|oit| &oit.counters),
        buffers.cull_resources.as_ref().map(|cull_resources| &cull_resources.buffers.counters),
    ];
    for (source, range) in counters.into_iter().zip(target.desc.readback_ranges()) {
        if let Some(source) = source.filter(|_| !range.is_empty()) {
            let copy = BufferCopy::first(range.end - range.start, source, buffer);
            recorder.gl.copy(BufferCopy { target_offset: range.start - first_byte, ..copy });
        }
    }
    recorder.check(Pass::Read)
}

/// Converts the bound ids to words.
fn convert_ids(recorder: &PassRecorder<'_>, readback_source: &Buffer, word_pass: &WordPass<'_>) {
    word_pass.program.bind(word_pass.uniform);
    if let Some(band) = word_pass.band {
        word_pass.program.set_first_row(band.first_row);
    }
    readback_source.bind_storage(WORDS_BINDING);
    let rows = word_pass.band.map_or(word_pass.size[1], |band| band.rows);
    recorder.gl.dispatch(word_pass.size[0].div_ceil(WORKGROUP_SIZE), rows);
}

/// Copies the words to the staging buffer.
fn copy_words(recorder: &PassRecorder<'_>, readback_source: &Buffer, word_pass: &WordPass<'_>) -> Result<()> {
    recorder.barrier_within_pass(word_pass.pass);
    recorder.gl.copy(BufferCopy::first(word_pass.bytes, readback_source, word_pass.staging));
    recorder.check(word_pass.pass)
}
