//! AOV (arbitrary output variable) readback: numbers instead of colors for every pixel of a frame, namely depth,
//! domains, normals or a scalar per vertex. Programs are compiled and buffers allocated on the first readback; frames
//! before and after do not change.

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
use modalcast_model::error::{Result, fault_in};

/// Attribute to read back. Blended triangles are ignored; the surface behind them is read. Only depth includes the
/// ground: in the other fields, the ground hides nothing below it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Aov {
    /// f32: meters along the view axis, not along the ray; infinite where nothing is visible. Includes the ground.
    Depth,
    /// u32: index of the domain; `u32::MAX` where no triangle is visible.
    Domains,
    /// Three f32: unit normal on the visible side; zeros where no triangle is visible.
    Normals,
    /// One word per sample. Lower 16 bits: a scalar per vertex ([`crate::Renderer::upload_vertex_values`]) divided by `largest`,
    /// clamped to 0 to 1, as unorm. Upper 16 bits: the cosine between normal and eye, as unorm. 0 where no triangle is
    /// visible.
    Values { largest: f32 },
}

/// Result of a readback: 32-bit words, top row first.
#[derive(Debug, Clone, PartialEq)]
pub struct AovImage {
    pub width: u32,
    pub height: u32,
    /// Samples per pixel, stored next to each other; 1 for all fields but values.
    pub samples: u32,
    /// Little-endian on all supported machines.
    pub bytes: Vec<u8>,
    pub times: FrameTimes,
}

/// Reads AOV fields. Keeps the render target of the last readback.
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
    words: u64,
    ids: IdTarget,
    staging: Buffer,
}

impl Aov {
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

    /// Reads a field for the current content of the shared buffers; waits at most `limit`.
    ///
    /// # Errors
    /// `Invalid` for a camera whose matrices overflow; `Fault` when no values were uploaded, OpenGL reports an error or
    /// the device does not finish in time.
    pub(crate) fn render(
        &mut self,
        programs: &mut ProgramCache,
        buffers: &SceneBuffers,
        shot: &FrameParams,
        field: Aov,
        limit: Duration,
    ) -> Result<AovImage> {
        let samples = if matches!(field, Aov::Values { .. }) { buffers.scene.look.samples_per_pixel() } else { 1 };
        let desc = TargetDesc::plain(&self.gl, [shot.width, shot.height], samples);
        let words = if field == Aov::Normals { 3 } else { u64::from(desc.samples) };
        let uniforms = FrameUniforms::new(&buffers.scene, shot, buffers.origin)?;
        let mask = buffers.mask_program(desc.samples, &mut |source| programs.program(source))?;
        let program = match field {
            Aov::Domains => programs.program(shaders::readback::visibility_readback(desc.samples))?,
            _ => buffers.aov_program(field.define(), desc.samples, &mut |source| programs.program(source))?,
        };
        let gl = Rc::clone(&self.gl);
        let target = self.ensure_target(desc, words)?;
        let bytes = 4 * words * u64::from(desc.width) * u64::from(desc.height);
        upload_frame(buffers, &uniforms);
        if let Aov::Values { .. } = field {
            let values = buffers.values.as_ref().ok_or_else(|| fault_in("aov")("no values were uploaded"))?;
            values.view.bind(VALUE_UNIT);
        }
        let mut recorder = PassRecorder { gl: &gl, stats: &mut FrameStats::default() };
        let readback = Readback { field, mask: mask.as_deref(), program: &program, bytes };
        let drawn = gl.time_pass(Pass::Aov.name(), limit, || readback.record(&mut recorder, buffers, shot, target))?;
        gl.wait(Pass::Aov.name(), limit)?;
        let begin = Instant::now();
        let bytes = target.staging.read(bytes as usize)?;
        gl.check(Pass::Aov.name())?;
        let bytes = if field == Aov::Domains { domain_indices(buffers, bytes) } else { bytes };
        let read_ms = begin.elapsed().as_secs_f64() * 1e3;
        let times = FrameTimes::of_stages(&[(RenderStage::Draw, drawn.ms()), (RenderStage::Read, read_ms)]);
        Ok(AovImage { width: desc.width, height: desc.height, samples: desc.samples, bytes, times })
    }

    /// Keeps the last render target if its form and words per pixel match, else replaces it.
    fn ensure_target(&mut self, desc: TargetDesc, words: u64) -> Result<&AovTarget> {
        let last = self.target.take().filter(|last| (last.desc, last.words) == (desc, words));
        let target = match last {
            Some(last) => last,
            None => {
                let bytes = 4 * words * u64::from(desc.width) * u64::from(desc.height);
                let ids = IdTarget::new(&self.gl, desc, bytes)?;
                AovTarget { desc, words, ids, staging: self.gl.buffer(bytes, gl::STREAM_READ, None)? }
            }
        };
        Ok(self.target.insert(target))
    }
}

/// The commands of a readback.
#[derive(Debug)]
struct Readback<'a> {
    field: Aov,
    mask: Option<&'a Program>,
    program: &'a Program,
    bytes: u64,
}

impl Readback<'_> {
    fn record(
        &self,
        recorder: &mut PassRecorder<'_>,
        buffers: &SceneBuffers,
        shot: &FrameParams,
        target: &AovTarget,
    ) -> Result<()> {
        let size = [target.desc.width, target.desc.height];
        let ids = IdDraw {
            framebuffer: &target.ids.framebuffer,
            clear: ClearOp::DepthAndIds(None),
            region: Region::whole(size),
            set: TriangleSet::All,
            mask: self.mask,
            opaque_parts: None,
        };
        recorder.begin(Pass::Aov);
        draw_ids(recorder, buffers, &ids)?;
        if self.field == Aov::Depth {
            draw_ground(recorder, buffers, shot)?;
        }
        let scale = match self.field {
            Aov::Depth => Some(buffers.scene.unit as f32),
            Aov::Values { largest } => Some(largest.recip()),
            Aov::Domains | Aov::Normals => None,
        };
        let words = WordPass {
            pass: Pass::Aov,
            program: self.program,
            number: scale.map(f32::to_bits),
            size,
            staging: &target.staging,
            bytes: self.bytes,
        };
        target.ids.read(recorder, &words)
    }
}

/// Maps ids to the domains of their triangles.
fn domain_indices(buffers: &SceneBuffers, ids: Vec<u8>) -> Vec<u8> {
    let mut words: Vec<u32> = bytemuck::pod_collect_to_vec(&ids);
    let spans = &buffers.spans[..];
    let locate_triangle = |id: u32| match VisibilityId::from_id(id) {
        VisibilityId::Triangle(place) => {
            geometry::locate_triangle(spans, place).map_or(u32::MAX, |(domain, _)| domain as u32)
        }
        VisibilityId::Background | VisibilityId::Ground => u32::MAX,
    };
    words.par_chunks_mut(4096).for_each(|words| {
        // Neighboring pixels mostly see the same triangle.
        let mut last = (0, u32::MAX);
        for word in words {
            if *word != last.0 {
                last = (*word, locate_triangle(*word));
            }
            *word = last.1;
        }
    });
    bytemuck::cast_slice(&words).to_vec()
}
