//! AOV (arbitrary output variable) readback: numbers instead of colors for every pixel of a frame, namely depth,
//! domains, normals or a scalar per vertex. Programs are compiled and buffers allocated on the first readback; frames
//! before and after do not change.

use std::time::Instant;

use rayon::prelude::*;

use super::gl::{self, Buffer, Framebuffer, Texture};
use super::region::Region;
use super::scene_buffers::{SceneBuffers, Values};
use super::seen::Seen;
use super::shaders::{self, VALUE_UNIT};
use super::target::{Form, image};
use super::{Ran, Renderer, Shot, frame, passes};
use modalcast_model::error::{Result, during};

/// Attribute to read back. Blended triangles are ignored; the surface behind them is read. Only depth includes the
/// ground: in the other fields, the ground hides nothing below it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Field {
    /// f32: meters along the view axis, not along the ray; infinite where nothing is visible. Includes the ground.
    Depth,
    /// u32: index of the domain; `u32::MAX` where no triangle is visible.
    Domains,
    /// Three f32: unit normal on the visible side; zeros where no triangle is visible.
    Normals,
    /// One word per sample. Lower 16 bits: a scalar per vertex ([`Renderer::upload_values`]) divided by `largest`,
    /// clamped to 0 to 1, as unorm. Upper 16 bits: the cosine between normal and eye, as unorm. 0 where no triangle is
    /// visible.
    Values { largest: f32 },
}

/// Result of a readback: 32-bit words, top row first.
#[derive(Debug, Clone, PartialEq)]
pub struct Survey {
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
pub(super) struct Surveyor {
    form: Form,
    words: u64,
    ids: Texture,
    visible: Framebuffer,
    packed: Buffer,
    staging: Buffer,
    // Attached to the framebuffer, which must not outlive it.
    _depth: Texture,
}

impl Field {
    const fn name(self) -> &'static str {
        match self {
            Self::Depth => "DEPTH",
            Self::Domains => "",
            Self::Normals => "NORMALS",
            Self::Values { .. } => "VALUES",
        }
    }
}

impl Renderer {
    /// Uploads a scalar per vertex, in the vertex order of the scene's layout, for readbacks of [`Field::Values`].
    ///
    /// # Errors
    /// `Fault` when the count differs from the scene's number of vertices, or OpenGL reports an error.
    pub fn upload_values(&mut self, buffers: &mut SceneBuffers, values: &[f32]) -> Result<()> {
        let count = buffers.scene.layout.vertices;
        if values.len() != count {
            return Err(during("upload")(format!("{} numbers of values, {count} expected", values.len())));
        }
        let held = match buffers.values.take() {
            Some(held) => held,
            None => {
                let buffer = self.gl.buffer(4 * count as u64, gl::DYNAMIC_DRAW, None)?;
                Values { view: self.gl.view(&buffer, gl::R32F)?, buffer }
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
    pub fn survey(&mut self, buffers: &SceneBuffers, shot: &Shot, field: Field) -> Result<Survey> {
        self.check_size(shot)?;
        let samples = if matches!(field, Field::Values { .. }) { buffers.scene.look.samples_a_pixel() } else { 1 };
        let form = Form::plain(&self.gl, [shot.width, shot.height], samples);
        let words = if field == Field::Normals { 3 } else { u64::from(form.samples) };
        let numbers = frame::Frame::new(&buffers.scene, shot, buffers.origin)?;
        let cut_out = buffers.cut_out(form.samples, &mut |source| self.program(source))?;
        let program = match field {
            Field::Domains => self.program(shaders::seen(form.samples))?,
            _ => buffers.survey(field.name(), form.samples, &mut |source| self.program(source))?,
        };
        self.make_surveyor(form, words)?;
        let Some(surveyor) = &self.surveyor else { return Err(during("survey")("nothing to draw into")) };
        let gl = &self.gl;
        buffers.buffer("frame")?.write(bytemuck::bytes_of(&numbers));
        passes::bind(buffers)?;
        if let Field::Values { .. } = field {
            let values = buffers.values.as_ref().ok_or_else(|| during("survey")("no values were uploaded"))?;
            values.view.bind(VALUE_UNIT);
        }
        let scale = match field {
            Field::Depth => Some(buffers.scene.unit as f32),
            Field::Values { largest } => Some(largest.recip()),
            Field::Domains | Field::Normals => None,
        };
        let drawn = gl.timed(("survey", self.watchdog), || {
            let ran = &mut Ran::default();
            passes::identify(
                gl,
                buffers,
                (
                    &surveyor.visible,
                    gl::Clear::DepthAndIds(None),
                    Region::whole([form.width, form.height]),
                    passes::Drawn::All,
                ),
                (cut_out.as_deref(), None),
                ran,
            )?;
            if field == Field::Depth {
                passes::ground(gl, buffers, shot, ran)?;
            }
            passes::words(
                gl,
                (&surveyor.ids, &surveyor.packed),
                (&program, scale.map(f32::to_bits)),
                [form.width, form.height],
            )
        })?;
        let bytes = (4 * words) as usize * form.width as usize * form.height as usize;
        gl.copy(&surveyor.packed, &surveyor.staging, bytes as u64);
        gl.wait("survey", self.watchdog)?;
        let begin = Instant::now();
        let bytes = surveyor.staging.read(bytes)?;
        gl.check("survey")?;
        let bytes = if field == Field::Domains { domains(buffers, bytes) } else { bytes };
        let passes = vec![("draw", drawn.ms()), ("read", begin.elapsed().as_secs_f64() * 1e3)];
        Ok(Survey { width: form.width, height: form.height, samples: form.samples, bytes, passes })
    }

    /// Keeps the last render target if its form and words per pixel match, else replaces it.
    fn make_surveyor(&mut self, form: Form, words: u64) -> Result<()> {
        if self.surveyor.as_ref().is_some_and(|last| (last.form, last.words) == (form, words)) {
            return Ok(());
        }
        self.surveyor = None;
        let gl = &self.gl;
        let (ids, depth) = (image(gl, form, gl::R32UI)?, image(gl, form, gl::DEPTH_COMPONENT32F)?);
        let bytes = 4 * words * u64::from(form.width) * u64::from(form.height);
        self.surveyor = Some(Surveyor {
            form,
            words,
            visible: gl.framebuffer(Some(&ids), &depth)?,
            ids,
            packed: gl.buffer(bytes, gl::STREAM_COPY, None)?,
            staging: gl.buffer(bytes, gl::STREAM_READ, None)?,
            _depth: depth,
        });
        Ok(())
    }
}

/// Maps ids to the domains of their triangles.
fn domains(buffers: &SceneBuffers, ids: Vec<u8>) -> Vec<u8> {
    let mut words: Vec<u32> = bytemuck::pod_collect_to_vec(&ids);
    let stretches = &buffers.stretches[..];
    let whose = |id: u32| match Seen::from_id(id) {
        Seen::Triangle(place) => super::geometry::whose(stretches, place).map_or(u32::MAX, |(domain, _)| domain as u32),
        Seen::Nothing | Seen::Ground => u32::MAX,
    };
    words.par_chunks_mut(4096).for_each(|words| {
        // Neighboring pixels mostly see the same triangle.
        let mut last = (0, u32::MAX);
        for word in words {
            if *word != last.0 {
                last = (*word, whose(*word));
            }
            *word = last.1;
        }
    });
    bytemuck::cast_slice(&words).to_vec()
}
