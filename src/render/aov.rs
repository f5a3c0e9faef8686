//! AOV (arbitrary output variable) readback: numbers instead of colors for every pixel of a frame, namely depth,
//! domains, normals or a scalar per vertex. Programs are compiled and buffers allocated on the first readback; frames
//! before and after do not change.

use std::time::Instant;

use rayon::prelude::*;

use super::region::Region;
use super::scene_buffers::{SceneBuffers, VertexValues};
use super::shaders::{self, VALUE_UNIT};
use super::target::{TargetDesc, create_image};
use super::{FrameParams, FrameStats, Renderer, frame_uniforms, passes};
use crate::device::gl::{self, Buffer, BufferCopy, Framebuffer, Texture};
use crate::types::VisibilityId;
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
    /// One word per sample. Lower 16 bits: a scalar per vertex ([`Renderer::upload_vertex_values`]) divided by `largest`,
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
    /// Milliseconds by stage.
    pub passes: Vec<(&'static str, f64)>,
}

/// Render target of a readback, and the buffers of its words.
#[derive(Debug)]
pub(crate) struct AovTarget {
    desc: TargetDesc,
    words: u64,
    ids: Texture,
    visibility_fbo: Framebuffer,
    readback_source: Buffer,
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

impl Renderer {
    /// Uploads a scalar per vertex, in the vertex order of the scene's layout, for readbacks of [`Aov::Values`].
    ///
    /// # Errors
    /// `Fault` when the count differs from the scene's number of vertices, or OpenGL reports an error.
    pub fn upload_vertex_values(&mut self, buffers: &mut SceneBuffers, values: &[f32]) -> Result<()> {
        let _current = self.gl.make_current()?;
        let count = buffers.scene.layout.vertices;
        if values.len() != count {
            return Err(fault_in("upload")(format!("{} numbers of values, {count} expected", values.len())));
        }
        let held = match buffers.values.take() {
            Some(held) => held,
            None => {
                let buffer = self.gl.buffer(4 * count as u64, gl::DYNAMIC_DRAW, None)?;
                VertexValues { view: self.gl.buffer_texture(&buffer, gl::R32F)?, buffer }
            }
        };
        held.buffer.write(bytemuck::cast_slice(values));
        buffers.values = Some(held);
        self.gl.check("upload")
    }

    /// Reads a field for the current content of the shared buffers. Depth, domains and normals are sampled at pixel
    /// centers.
    ///
    /// # Errors
    /// `Invalid` for a size above the limit or a camera whose matrices overflow; `Fault` when no values were uploaded,
    /// OpenGL reports an error or the device does not finish in time.
    pub fn render_aov(&mut self, buffers: &SceneBuffers, shot: &FrameParams, field: Aov) -> Result<AovImage> {
        let _current = self.gl.make_current()?;
        self.check_size(shot)?;
        let samples = if matches!(field, Aov::Values { .. }) { buffers.scene.look.samples_per_pixel() } else { 1 };
        let desc = TargetDesc::plain(&self.gl, [shot.width, shot.height], samples);
        let words = if field == Aov::Normals { 3 } else { u64::from(desc.samples) };
        let numbers = frame_uniforms::FrameUniforms::new(&buffers.scene, shot, buffers.origin)?;
        let cut_out = buffers.mask_program(desc.samples, &mut |source| self.program(source))?;
        let program = match field {
            Aov::Domains => self.program(shaders::visibility_readback(desc.samples))?,
            _ => buffers.aov_program(field.define(), desc.samples, &mut |source| self.program(source))?,
        };
        self.ensure_aov_target(desc, words)?;
        let Some(aov_target) = &self.aov_target else { return Err(fault_in("aov")("nothing to draw into")) };
        let gl = &self.gl;
        buffers.buffer("frame uniforms")?.write(bytemuck::bytes_of(&numbers));
        passes::bind(buffers)?;
        if let Aov::Values { .. } = field {
            let values = buffers.values.as_ref().ok_or_else(|| fault_in("aov")("no values were uploaded"))?;
            values.view.bind(VALUE_UNIT);
        }
        let scale = match field {
            Aov::Depth => Some(buffers.scene.unit as f32),
            Aov::Values { largest } => Some(largest.recip()),
            Aov::Domains | Aov::Normals => None,
        };
        let drawn = gl.time_pass(("aov", self.frame_timeout), || {
            let stats = &mut FrameStats::default();
            passes::draw_ids(
                gl,
                buffers,
                (
                    &aov_target.visibility_fbo,
                    gl::ClearOp::DepthAndIds(None),
                    Region::whole([desc.width, desc.height]),
                    passes::TriangleSet::All,
                ),
                (cut_out.as_deref(), None),
                stats,
            )?;
            if field == Aov::Depth {
                passes::ground(gl, buffers, shot, stats)?;
            }
            passes::run_readback(
                gl,
                (&aov_target.ids, &aov_target.readback_source),
                (&program, scale.map(f32::to_bits)),
                [desc.width, desc.height],
            )
        })?;
        let bytes = (4 * words) as usize * desc.width as usize * desc.height as usize;
        gl.copy(BufferCopy::first(bytes as u64, &aov_target.readback_source, &aov_target.staging));
        gl.wait("aov", self.frame_timeout)?;
        let begin = Instant::now();
        let bytes = aov_target.staging.read(bytes)?;
        gl.check("aov")?;
        let bytes = if field == Aov::Domains { domain_indices(buffers, bytes) } else { bytes };
        let passes = vec![("draw", drawn.ms()), ("read", begin.elapsed().as_secs_f64() * 1e3)];
        Ok(AovImage { width: desc.width, height: desc.height, samples: desc.samples, bytes, passes })
    }

    /// Keeps the last render target if its form and words per pixel match, else replaces it.
    fn ensure_aov_target(&mut self, desc: TargetDesc, words: u64) -> Result<()> {
        if self.aov_target.as_ref().is_some_and(|last| (last.desc, last.words) == (desc, words)) {
            return Ok(());
        }
        self.aov_target = None;
        let gl = &self.gl;
        let (ids, depth) = (create_image(gl, desc, gl::R32UI)?, create_image(gl, desc, gl::DEPTH_COMPONENT32F)?);
        let bytes = 4 * words * u64::from(desc.width) * u64::from(desc.height);
        self.aov_target = Some(AovTarget {
            desc,
            words,
            visibility_fbo: gl.framebuffer(Some(&ids), &depth)?,
            ids,
            readback_source: gl.buffer(bytes, gl::STREAM_COPY, None)?,
            staging: gl.buffer(bytes, gl::STREAM_READ, None)?,
        });
        Ok(())
    }
}

/// Maps ids to the domains of their triangles.
fn domain_indices(buffers: &SceneBuffers, ids: Vec<u8>) -> Vec<u8> {
    let mut words: Vec<u32> = bytemuck::pod_collect_to_vec(&ids);
    let spans = &buffers.spans[..];
    let locate_triangle = |id: u32| match VisibilityId::from_id(id) {
        VisibilityId::Triangle(place) => {
            super::geometry::locate_triangle(spans, place).map_or(u32::MAX, |(domain, _)| domain as u32)
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
