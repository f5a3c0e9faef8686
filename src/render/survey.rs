//! Numbers in place of colours: depth, domains, normals, or a number per vertex, for every pixel of a frame. Made only when
//! somebody asks: the programs are compiled and the buffers allocated then, and the frames before and after do not change.

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

/// What is read off a frame. Blended triangles are not there: what stands behind them is. Only depth knows the ground:
/// elsewhere it hides nothing that hangs below it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Field {
    /// f32, metres along the view axis, not along the ray; infinite where nothing is. The ground counts.
    Depth,
    /// u32, the domain's index; `u32::MAX` where no triangle is.
    Domains,
    /// Three f32: the unit normal, on the side that is seen; zeros where no triangle is.
    Normals,
    /// A word per sample: a number of every vertex ([`Renderer::upload_values`]) over `largest`, clamped to 0 to 1, in the
    /// lower 16 bits; and in the upper ones the cosine between normal and eye. 0 where no triangle is.
    Values { largest: f32 },
}

/// Words of 32 bits, top row first.
#[derive(Debug, Clone, PartialEq)]
pub struct Survey {
    pub width: u32,
    pub height: u32,
    /// Samples a pixel, which follow each other: 1 unless it is values.
    pub samples: u32,
    /// Little-endian on every machine that this runs on.
    pub bytes: Vec<u8>,
    /// Milliseconds per pass, by the name of the stage.
    pub passes: Vec<(&'static str, f64)>,
}

/// Ids and depth of a survey, and the words read off them.
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
    /// Takes a number per vertex, packed as the scene's layout says, for surveys of [`Field::Values`].
    ///
    /// # Errors
    /// `Fault` when the count is not the scene's, or OpenGL reports an error.
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

    /// Reads a field off what the shared buffers hold. Depth, domains and normals are those of the middle of each pixel.
    ///
    /// # Errors
    /// `Invalid` for a size above the limit or a camera that overflows; `Fault` when no values were uploaded, OpenGL
    /// reports an error or the device does not finish.
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

    /// Keeps one surveyor: the last one, when it fits.
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

/// Ids to the domains of their triangles.
fn domains(buffers: &SceneBuffers, ids: Vec<u8>) -> Vec<u8> {
    let mut words: Vec<u32> = bytemuck::pod_collect_to_vec(&ids);
    let stretches = &buffers.stretches[..];
    let whose = |id: u32| match Seen::from_id(id) {
        Seen::Triangle(place) => super::geometry::whose(stretches, place).map_or(u32::MAX, |(domain, _)| domain as u32),
        Seen::Nothing | Seen::Ground => u32::MAX,
    };
    words.par_chunks_mut(4096).for_each(|words| {
        // Neighbours mostly see the same triangle.
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
