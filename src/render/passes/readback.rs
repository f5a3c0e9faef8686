//! Readback of ids as words in a buffer: the common part of visibility readback, picking and AOV readback.

use std::rc::Rc;

use super::draw::bind_visibility;
use super::recorder::{FrameContext, PassRecorder};
use crate::device::gl::{self, Buffer, BufferCopy, Framebuffer, Gl, Program, Texture};
use crate::layout::{ID_UNIT, WORDS_BINDING, WORKGROUP_SIZE};
use crate::pass::Pass;
use crate::resources::target::RenderTarget;
use crate::resources::target_desc::{TargetDesc, create_image};
use modalcast_model::error::Result;

/// Ids and depth without the other images of a frame, and the buffer of the words that are read back.
#[derive(Debug)]
pub(super) struct IdTarget {
    pub(super) ids: Texture,
    pub(super) framebuffer: Framebuffer,
    pub(super) readback_source: Buffer,
}

/// A conversion of ids to words.
#[derive(Debug)]
pub(super) struct WordPass<'a> {
    pub(super) pass: Pass,
    pub(super) program: &'a Program,
    /// Uniform at location 0 of programs that have one.
    pub(super) number: Option<u32>,
    pub(super) size: [u32; 2],
    pub(super) staging: &'a Buffer,
    /// Bytes that are copied to the staging buffer.
    pub(super) bytes: u64,
}

impl IdTarget {
    pub(super) fn new(gl: &Rc<Gl>, desc: TargetDesc, bytes: u64) -> Result<Self> {
        let (ids, depth) = (create_image(gl, desc, gl::R32UI)?, create_image(gl, desc, gl::DEPTH_COMPONENT32F)?);
        Ok(Self {
            framebuffer: gl.framebuffer(Some(&ids), &depth)?,
            ids,
            readback_source: gl.buffer(bytes, gl::STREAM_COPY, None)?,
        })
    }

    /// Converts the ids that the pass has drawn, and copies the words to the staging buffer.
    pub(super) fn read(&self, recorder: &PassRecorder<'_>, words: &WordPass<'_>) -> Result<()> {
        self.ids.bind(ID_UNIT);
        convert(recorder, &self.readback_source, words)
    }
}

/// Copies the id that each pixel's first sample sees to a staging buffer of `desc.bytes()` bytes, top row first.
pub(crate) fn read_visibility(
    recorder: &PassRecorder<'_>,
    target: &RenderTarget,
    program: &Program,
    staging: &Buffer,
) -> Result<()> {
    recorder.begin(Pass::VisibilityReadback);
    bind_visibility(target);
    let size = [target.desc.width, target.desc.height];
    let bytes = target.desc.bytes();
    let words = WordPass { pass: Pass::VisibilityReadback, program, number: None, size, staging, bytes };
    convert(recorder, &target.readback_source, &words)
}

/// Copies the pixels of a frame, then its list and culling statistics, to a staging buffer.
pub(crate) fn copy_frame(recorder: &PassRecorder<'_>, frame: &FrameContext<'_>, staging: &Buffer) -> Result<()> {
    let FrameContext { buffers, target, .. } = *frame;
    recorder.begin(Pass::Read);
    recorder.gl.copy(BufferCopy::first(target.desc.bytes(), &target.readback_source, staging));
    let counters =
        [target.oit.as_ref().map(|oit| &oit.counters), buffers.culler.as_ref().map(|culler| &culler.buffers.counters)];
    for (from, to) in counters.into_iter().zip(target.desc.readback_ranges()) {
        if let Some(from) = from.filter(|_| !to.is_empty()) {
            let copy = BufferCopy::first(to.end - to.start, from, staging);
            recorder.gl.copy(BufferCopy { target_offset: to.start, ..copy });
        }
    }
    recorder.check(Pass::Read)
}

/// Runs the conversion of the bound ids.
fn convert(recorder: &PassRecorder<'_>, readback_source: &Buffer, words: &WordPass<'_>) -> Result<()> {
    words.program.bind(words.number);
    readback_source.bind_storage(WORDS_BINDING);
    recorder.gl.dispatch(words.size[0].div_ceil(WORKGROUP_SIZE), words.size[1]);
    recorder.continue_pass(words.pass);
    recorder.gl.copy(BufferCopy::first(words.bytes, readback_source, words.staging));
    recorder.check(words.pass)
}
