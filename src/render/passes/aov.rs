//! AOV (arbitrary output variable) readback: depth, domains, normals or vertex values for every pixel of a frame.
//! The first readback compiles programs and allocates buffers. Readbacks do not change later frames.

use std::collections::VecDeque;
use std::rc::Rc;
use std::sync::Arc;
use std::time::{Duration, Instant};

use rayon::prelude::*;

use super::draw::TriangleSet;
use super::readback::{IdTarget, WordPass};
use super::recorder::PassRecorder;
use super::uniforms::upload_frame;
use super::visibility::{IdDraw, draw_ids};
use crate::device::gl::{self, Buffer, ClearOp, Fence, Gl, PassTimer, Program};
use crate::layout::VALUE_UNIT;
use crate::pass::{FrameTimes, Pass, RenderStage};
use crate::pieces::{OutputClass, OutputKind, PieceCursor, PieceLimits, PieceLoad, PieceRange};
use crate::region::{Band, BandLimit, Region};
use crate::resources::programs::ProgramCache;
use crate::resources::scene_buffers::SceneBuffers;
use crate::resources::target_desc::TargetDesc;
use crate::scene_data::geometry;
use crate::shaders;
use crate::types::{FrameParams, FrameStats, VisibilityId};
use crate::uniforms::frame::FrameUniforms;
use modalcast_model::error::{Result, fault};
use modalcast_model::memory::MemoryReservation;

/// Words that one parallel task converts: enough to hide the cost of starting the task.
const WORDS_PER_TASK: usize = 4096;

/// Field to read back. All fields ignore blended triangles. Only `DepthWithGround` contains the ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Aov {
    /// f32: meters along the view axis, not along the ray; infinite where no triangle is visible.
    Depth,
    /// As `Depth`, with the depth of the ground where the ground is visible and no triangle is.
    DepthWithGround,
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

/// Reads AOV fields. Caches the render target of the last finished readback.
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
    last_use: Instant,
    _memory: Arc<MemoryReservation>,
}

impl Aov {
    /// Macro that selects the field in `shaders/aov.comp`; empty for domains, which `shaders/visibility_readback.comp`
    /// reads.
    const fn define(self) -> &'static str {
        match self {
            Self::Depth => "DEPTH",
            Self::DepthWithGround => "DEPTH_WITH_GROUND",
            Self::Domains => "",
            Self::Normals => "NORMALS",
            Self::Values { .. } => "VALUES",
        }
    }
}

/// The most that is drawn without a break.
#[derive(Debug, Clone, Copy)]
pub(crate) struct OutputLimits {
    pub(crate) bands: BandLimit,
    pub(crate) pieces: PieceLimits,
}

/// A readback of which some bands are not submitted yet. Owns its render target.
#[derive(Debug)]
pub struct PartialAov {
    field: Aov,
    uniforms: FrameUniforms,
    /// Draws the ids of cut-outs; none without such triangles.
    mask: Option<Rc<Program>>,
    /// Converts ids to the field.
    program: Rc<Program>,
    target: AovTarget,
    /// Bands that are not submitted yet.
    bands: VecDeque<Band>,
    /// Triangles of the first of `bands` that are not submitted yet; none before its first piece.
    cursor: Option<PieceCursor>,
    class: OutputClass,
    is_divided: bool,
    /// Whether the readback is drawn in pieces.
    has_pieces: bool,
    timers: Vec<PassTimer>,
    /// Fence after the last piece.
    fence: Option<Fence>,
}

impl PartialAov {
    /// Whether all bands are submitted, so that the words can be read.
    pub fn is_submitted(&self) -> bool {
        self.bands.is_empty()
    }

    /// Whether the readback is large and therefore divided into bands.
    pub const fn is_divided(&self) -> bool {
        self.is_divided
    }

    /// Whether commands of other scenes should be executed between the pieces, because the readback may take long.
    pub const fn has_breaks(&self) -> bool {
        self.has_pieces
    }

    /// Milliseconds that the device took for the last submitted piece. Waits for the piece.
    pub fn last_step_ms(&self) -> f64 {
        self.timers.last().map_or(0.0, PassTimer::ms)
    }

    /// Waits at most `limit` for the last submitted piece. Returns whether it is complete. Submitting the next piece only
    /// then keeps the queue of the device short.
    pub fn is_ready_within(&self, limit: Duration) -> bool {
        self.fence.as_ref().is_none_or(|fence| fence.is_done_within(limit))
    }

    /// Bytes of the words.
    const fn byte_count(&self) -> u64 {
        4 * self.target.words_per_pixel * self.target.desc.width as u64 * self.target.desc.height as u64
    }

    /// Draws the ids of the triangles of a range in a band. After the last range, converts the ids to the field.
    fn record(
        &self,
        recorder: &mut PassRecorder<'_>,
        buffers: &SceneBuffers,
        band: Band,
        range: PieceRange,
    ) -> Result<()> {
        let AovTarget { desc, ids: id_target, .. } = &self.target;
        let ids = IdDraw {
            framebuffer: &id_target.framebuffer,
            clear: ClearOp::DepthAndIds(None),
            region: Region::whole([desc.width, desc.height]),
            band,
            triangles: TriangleSet::All,
            range,
            mask: self.mask.as_deref(),
            opaque_parts: None,
        };
        recorder.begin(Pass::Aov);
        draw_ids(recorder, buffers, &ids)?;
        if self.cursor.as_ref().is_some_and(|cursor| !cursor.is_finished()) {
            return Ok(());
        }
        let word_pass = self.word_pass(buffers, band);
        id_target.convert(recorder, &word_pass);
        if band.is_last() { id_target.copy(recorder, &word_pass) } else { recorder.check(Pass::Aov) }
    }

    /// The triangles of the next piece of a band.
    fn next_piece(&mut self, buffers: &SceneBuffers, band: Band, limits: PieceLimits) -> PieceRange {
        let last_ms = self.last_step_ms();
        match &mut self.cursor {
            Some(cursor) => {
                // The device has finished the previous piece, so the time above did not wait.
                cursor.record_ms(last_ms);
                cursor.next_piece()
            }
            cursor => {
                let TargetDesc { width, samples, .. } = self.target.desc;
                let samples = u64::from(width) * u64::from(band.rows) * u64::from(samples);
                let load = PieceLoad { items: buffers.all_triangles(), samples, sample_cost: 1 };
                cursor.insert(PieceCursor::new(limits, load)).next_piece()
            }
        }
    }

    fn word_pass(&self, buffers: &SceneBuffers, band: Band) -> WordPass<'_> {
        let scale = match self.field {
            // Meters per scene unit.
            Aov::Depth | Aov::DepthWithGround => Some(buffers.scene.unit as f32),
            Aov::Values { scale_max } => Some(scale_max.recip()),
            Aov::Domains | Aov::Normals => None,
        };
        WordPass {
            pass: Pass::Aov,
            program: &self.program,
            uniform: scale.map(f32::to_bits),
            size: [self.target.desc.width, self.target.desc.height],
            band: Some(band),
            staging: &self.target.staging,
            bytes: self.byte_count(),
        }
    }
}

impl AovReader {
    pub(crate) fn new(gl: &Rc<Gl>) -> Self {
        Self { gl: Rc::clone(gl), target: None }
    }

    /// Whether a render target is cached.
    pub(crate) const fn has_target(&self) -> bool {
        self.target.is_some()
    }

    /// Frees the cached render target.
    pub(crate) fn free_target(&mut self) {
        self.target = None;
    }

    /// Frees the cached render target if no readback has used it for this time.
    pub(crate) fn free_unused_target(&mut self, unused: Duration) {
        self.target.take_if(|target| target.last_use.elapsed() >= unused);
    }

    /// Begins to read a field for the current content of the scene's buffers, in bands within `band_limit`. `reserve`
    /// reserves the memory of a new target.
    ///
    /// # Errors
    /// `Invalid` for a camera whose matrices overflow; the errors of `reserve`; `Fault` if no values were uploaded or
    /// OpenGL reports an error.
    pub(crate) fn begin(
        &mut self,
        programs: &mut ProgramCache,
        buffers: &SceneBuffers,
        params: &FrameParams,
        field: Aov,
        limits: OutputLimits,
        reserve: impl FnOnce(TargetDesc, u64) -> Result<Arc<MemoryReservation>>,
    ) -> Result<PartialAov> {
        let size = [params.width, params.height];
        let samples = if matches!(field, Aov::Values { .. }) { buffers.antialiasing(size, None).samples } else { 1 };
        let desc = TargetDesc::ids_and_depth(&self.gl, size, samples);
        let words_per_pixel = if field == Aov::Normals { 3 } else { u64::from(desc.samples) };
        let uniforms = FrameUniforms::new(&buffers.scene, &buffers.look, params, buffers.origin)?;
        let mask = buffers.mask_program(desc.samples, &mut |source| programs.program(source))?;
        let program = match field {
            Aov::Domains => programs.program(shaders::readback::visibility_readback(desc.samples))?,
            _ => buffers.aov_program(field.define(), desc.samples, &mut |source| programs.program(source))?,
        };
        if matches!(field, Aov::Values { .. }) && buffers.values.is_none() {
            return Err(fault("aov", "expected uploaded vertex values, got none"));
        }
        let target = self.take_target(desc, words_per_pixel, reserve)?;
        let bands = VecDeque::from(Band::divide(size, limits.bands.max_pixels(desc.samples)));
        let is_divided = bands.len() > 1;
        let class = OutputClass::new(OutputKind::Aov, size, desc.samples);
        let has_pieces = is_divided || buffers.costs.has_pieces(class, limits.pieces);
        Ok(PartialAov {
            field,
            uniforms,
            mask,
            program,
            target,
            bands,
            cursor: None,
            class,
            is_divided,
            has_pieces,
            timers: Vec::new(),
            fence: None,
        })
    }

    /// Submits the next piece. The scene's buffers must not change until all pieces are submitted.
    ///
    /// # Errors
    /// `Fault` if OpenGL reports an error or a software renderer does not finish in time.
    pub(crate) fn submit_piece(
        &self,
        aov: &mut PartialAov,
        buffers: &SceneBuffers,
        limits: OutputLimits,
        timeout: Duration,
    ) -> Result<()> {
        let Some(band) = aov.bands.front().copied() else { return Ok(()) };
        let range = if aov.has_pieces { aov.next_piece(buffers, band, limits.pieces) } else { PieceRange::ALL };
        upload_frame(buffers, &aov.uniforms);
        if let (Aov::Values { .. }, Some(values)) = (aov.field, &buffers.values) {
            values.view.bind(VALUE_UNIT);
        }
        let mut recorder = PassRecorder { gl: &self.gl, stats: &mut FrameStats::default() };
        let timer = self.gl.time_pass(Pass::Aov.name(), timeout, || aov.record(&mut recorder, buffers, band, range))?;
        aov.timers.push(timer);
        if aov.cursor.as_ref().is_none_or(PieceCursor::is_finished) {
            aov.cursor = None;
            aov.bands.pop_front();
        }
        if aov.has_pieces {
            aov.fence = Some(self.gl.fence(Pass::Aov.name())?);
        }
        Ok(())
    }

    /// Waits at most `timeout` for the words of a readback whose bands are all submitted, and returns them.
    ///
    /// # Errors
    /// `Fault` if OpenGL reports an error or the device does not finish in time.
    pub(crate) fn finish(&mut self, aov: PartialAov, buffers: &SceneBuffers, timeout: Duration) -> Result<AovImage> {
        let byte_count = aov.byte_count();
        let PartialAov { field, target, timers, class, .. } = aov;
        self.gl.wait(Pass::Aov.name(), timeout)?;
        let start = Instant::now();
        let words = target.staging.read(byte_count as usize)?;
        self.gl.check(Pass::Aov.name())?;
        let bytes = if field == Aov::Domains { domain_indices(buffers, words) } else { words };
        let read_ms = start.elapsed().as_secs_f64() * 1e3;
        let draw_ms = timers.iter().map(PassTimer::ms).sum();
        buffers.costs.record(class, draw_ms);
        let times = FrameTimes::of_stages(&[(RenderStage::Draw, draw_ms), (RenderStage::Read, read_ms)]);
        let TargetDesc { width, height, samples, .. } = target.desc;
        self.target = Some(AovTarget { last_use: Instant::now(), ..target });
        Ok(AovImage { width, height, samples, bytes, times })
    }

    /// Takes the cached render target if it fits, else creates one.
    fn take_target(
        &mut self,
        desc: TargetDesc,
        words_per_pixel: u64,
        reserve: impl FnOnce(TargetDesc, u64) -> Result<Arc<MemoryReservation>>,
    ) -> Result<AovTarget> {
        let cached_target = self
            .target
            .take()
            .filter(|cached_target| (cached_target.desc, cached_target.words_per_pixel) == (desc, words_per_pixel));
        if let Some(cached_target) = cached_target {
            return Ok(cached_target);
        }
        let pixels = u64::from(desc.width) * u64::from(desc.height);
        let bytes = 4 * words_per_pixel * pixels;
        // Ids and depth per sample, the words, and their staging buffer.
        let memory = reserve(desc, 8 * u64::from(desc.samples) * pixels + 2 * bytes)?;
        let ids = IdTarget::new(&self.gl, desc, bytes)?;
        let staging = self.gl.buffer(bytes, gl::STREAM_READ, None)?;
        Ok(AovTarget { desc, words_per_pixel, ids, staging, last_use: Instant::now(), _memory: memory })
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
