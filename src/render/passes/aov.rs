//! AOV (arbitrary output variable) readback: depth, domains, normals or vertex values for every pixel of a frame.
//! The first readback compiles programs and allocates buffers. Readbacks do not change later frames.

use std::rc::Rc;
use std::time::{Duration, Instant};

use rayon::prelude::*;

use super::draw::TriangleSet;
use super::readback::{IdTarget, WordPass};
use super::recorder::PassRecorder;
use super::uniforms::upload_frame;
use super::visibility::{IdDraw, draw_ground, draw_ids};
use crate::device::gl::{self, Buffer, ClearOp, Gl, Program};
use crate::layout::VALUE_UNIT;
use crate::pass::{FrameTimes, Pass, RenderStage};
use crate::region::Region;
use crate::resources::programs::ProgramCache;
use crate::resources::scene_buffers::SceneBuffers;
use crate::resources::target_desc::TargetDesc;
use crate::scene_data::geometry;
use crate::shaders;
use crate::types::{FrameParams, FrameStats, VisibilityId};
use crate::uniforms::frame::FrameUniforms;
use modalcast_model::error::{Result, fault};

/// Words that one parallel task converts: enough to hide the cost of starting the task.
const WORDS_PER_TASK: usize = 4096;

/// Field to read back. All fields ignore blended triangles. Only the depth contains the ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Aov {
    /// f32: meters along the view axis, not along the ray; infinite where neither a triangle nor the ground is visible.
    Depth,
    /// u32: index of the domain; `u32::MAX` where no triangle is visible.
    Domains,
    /// Three f32: unit normal that points to the visible side; zeros where no triangle is visible.
    Normals,
    /// One word per sample, of two 16-bit unorms; 0 where no triangle is visible. Lower half: the interpolated vertex
    /// value ([`crate::Renderer::upload_vertex_values`]) divided by `scale_max`, clamped to 0 to 1. Upper half: the
    /// cosine between the normal and the direction to the eye.
    Values { scale_max: f32 },
}

/// Result of a readback: 32-bit words, top row first.
#[derive(Debug, Clone, PartialEq)]
pub struct AovImage {
    pub width: u32,
    pub height: u32,
    /// Samples per pixel, stored next to each other; always 1 except for [`Aov::Values`].
    pub samples: u32,
    /// The words in native byte order, which is little-endian on all supported machines.
    pub bytes: Vec<u8>,
    pub times: FrameTimes,
}

/// Reads AOV fields. Caches the render target of the last readback.
#[derive(Debug)]
pub(crate) struct AovReader {
    gl: Rc<Gl>,
    target: Option<AovTarget>,
}

/// Render target of a readback, and its staging buffer.
#[derive(Debug)]
struct AovTarget {
    desc: TargetDesc,
    /// 32-bit words per pixel.
    words_per_pixel: u64,
    ids: IdTarget,
    staging: Buffer,
}

impl Aov {
    /// Macro that selects the field in `shaders/aov.comp`; empty for domains, which `shaders/visibility_readback.comp`
    /// reads.
    const fn define(self) -> &'static str {
        match self {
            Self::Depth => "DEPTH",
            Self::Domains => "",
            Self::Normals => "NORMALS",
            Self::Values { .. } => "VALUES",
        }
    }
}

impl AovReader {
    pub(crate) fn new(gl: &Rc<Gl>) -> Self {
        Self { gl: Rc::clone(gl), target: None }
    }

    /// Reads a field for the current content of the scene's buffers; waits at most `timeout`.
    ///
    /// # Errors
    /// `Invalid` for a camera whose matrices overflow; `Fault` if no values were uploaded, OpenGL reports an error or
    /// the device does not finish in time.
    pub(crate) fn render(
        &mut self,
        programs: &mut ProgramCache,
        buffers: &SceneBuffers,
        params: &FrameParams,
        field: Aov,
        timeout: Duration,
    ) -> Result<AovImage> {
        let samples = if matches!(field, Aov::Values { .. }) { buffers.scene.look.samples_per_pixel() } else { 1 };
        let desc = TargetDesc::ids_and_depth(&self.gl, [params.width, params.height], samples);
        let words_per_pixel = if field == Aov::Normals { 3 } else { u64::from(desc.samples) };
        let uniforms = FrameUniforms::new(&buffers.scene, params, buffers.origin)?;
        let mask = buffers.mask_program(desc.samples, &mut |source| programs.program(source))?;
        let program = match field {
            Aov::Domains => programs.program(shaders::readback::visibility_readback(desc.samples))?,
            _ => buffers.aov_program(field.define(), desc.samples, &mut |source| programs.program(source))?,
        };
        let gl = Rc::clone(&self.gl);
        let target = self.ensure_target(desc, words_per_pixel)?;
        let byte_count = 4 * words_per_pixel * u64::from(desc.width) * u64::from(desc.height);
        upload_frame(buffers, &uniforms);
        if let Aov::Values { .. } = field {
            let values = buffers.values.as_ref().ok_or_else(|| fault("aov", "no values were uploaded"))?;
            values.view.bind(VALUE_UNIT);
        }
        let mut recorder = PassRecorder { gl: &gl, stats: &mut FrameStats::default() };
        let readback = Readback { field, mask: mask.as_deref(), program: &program, bytes: byte_count };
        let timer =
            gl.time_pass(Pass::Aov.name(), timeout, || readback.record(&mut recorder, buffers, params, target))?;
        gl.wait(Pass::Aov.name(), timeout)?;
        let start = Instant::now();
        let words = target.staging.read(byte_count as usize)?;
        gl.check(Pass::Aov.name())?;
        let bytes = if field == Aov::Domains { domain_indices(buffers, words) } else { words };
        let read_ms = start.elapsed().as_secs_f64() * 1e3;
        let times = FrameTimes::of_stages(&[(RenderStage::Draw, timer.ms()), (RenderStage::Read, read_ms)]);
        Ok(AovImage { width: desc.width, height: desc.height, samples: desc.samples, bytes, times })
    }

    /// Returns the cached render target if it fits, else replaces it.
    fn ensure_target(&mut self, desc: TargetDesc, words_per_pixel: u64) -> Result<&AovTarget> {
        let cached_target = self
            .target
            .take()
            .filter(|cached_target| (cached_target.desc, cached_target.words_per_pixel) == (desc, words_per_pixel));
        let target = match cached_target {
            Some(cached_target) => cached_target,
            None => {
                let bytes = 4 * words_per_pixel * u64::from(desc.width) * u64::from(desc.height);
                let ids = IdTarget::new(&self.gl, desc, bytes)?;
                AovTarget { desc, words_per_pixel, ids, staging: self.gl.buffer(bytes, gl::STREAM_READ, None)? }
            }
        };
        Ok(self.target.insert(target))
    }
}

/// Programs and parameters of a readback.
#[derive(Debug)]
struct Readback<'a> {
    field: Aov,
    /// Draws the ids of cut-outs; none without such triangles.
    mask: Option<&'a Program>,
    /// Converts ids to the field.
    program: &'a Program,
    /// Bytes to copy to the staging buffer.
    bytes: u64,
}

impl Readback<'_> {
    /// Draws the ids, converts them to the field, and copies it to the staging buffer.
    fn record(
        &self,
        recorder: &mut PassRecorder<'_>,
        buffers: &SceneBuffers,
        params: &FrameParams,
        target: &AovTarget,
    ) -> Result<()> {
        let size = [target.desc.width, target.desc.height];
        let ids = IdDraw {
            framebuffer: &target.ids.framebuffer,
            clear: ClearOp::DepthAndIds(None),
            region: Region::whole(size),
            triangles: TriangleSet::All,
            mask: self.mask,
            opaque_parts: None,
        };
        recorder.begin(Pass::Aov);
        draw_ids(recorder, buffers, &ids)?;
        if self.field == Aov::Depth {
            draw_ground(recorder, buffers, params)?;
        }
        let scale = match self.field {
            // Meters per scene unit.
            Aov::Depth => Some(buffers.scene.unit as f32),
            Aov::Values { scale_max } => Some(scale_max.recip()),
            Aov::Domains | Aov::Normals => None,
        };
        let word_pass = WordPass {
            pass: Pass::Aov,
            program: self.program,
            uniform: scale.map(f32::to_bits),
            size,
            staging: &target.staging,
            bytes: self.bytes,
        };
        target.ids.read(recorder, &word_pass)
    }
}

/// Replaces each id by the domain of its triangle; `u32::MAX` without a triangle.
fn domain_indices(buffers: &SceneBuffers, ids: Vec<u8>) -> Vec<u8> {
    let mut words: Vec<u32> = bytemuck::pod_collect_to_vec(&ids);
    let spans = &buffers.spans[..];
    let domain_of = |id: u32| match VisibilityId::from_id(id) {
        VisibilityId::Triangle(triangle) => {
            geometry::locate_triangle(spans, triangle).map_or(u32::MAX, |(domain, _)| domain as u32)
        }
        VisibilityId::Background | VisibilityId::Ground => u32::MAX,
    };
    words.par_chunks_mut(WORDS_PER_TASK).for_each(|task_words| {
        // Neighboring pixels usually have the same id. Id 0 is the background.
        let (mut previous_id, mut previous_domain) = (0, u32::MAX);
        for word in task_words {
            if *word != previous_id {
                (previous_id, previous_domain) = (*word, domain_of(*word));
            }
            *word = previous_domain;
        }
    });
    bytemuck::cast_slice(&words).to_vec()
}
