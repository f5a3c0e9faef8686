//! Exact order-independent transparency: a list of all blended fragments of each pixel, in bounded memory.
//!
//! One pass counts the fragments, a prefix sum allocates a list for each pixel, and another pass fills the lists in any
//! order. The lists are sorted by depth and id before they are blended, so the picture does not depend on the order of
//! the fragments. The memory budget is a number of fragments. When a frame has more, every pixel keeps at most the same
//! number of its nearest fragments: the largest number for which all lists fit, up to 256. Dropped fragments are
//! counted.

use std::rc::Rc;

use bytemuck::{Pod, Zeroable};

use super::cull::command_offset;
use super::geometry::BlendMode;
use super::passes::{EMPTY_TILE_LIST, TILES, bind_shadow, draw_group, first_triangle_of, triangle_set};
use super::region::{DirtyRegion, Region};
use super::scene_buffers::SceneBuffers;
use super::shaders::oit::{BINS, HISTOGRAM_TILE};
use super::shaders::{self, ShaderOptions, TILE};
use super::target::{BlendStorage, TargetDesc};
use crate::device::gl::{
    self, Buffer, BufferCopy, ClearOp, Framebuffer, Gl, Limits, PipelineState, Program, Texture, TextureDesc,
};
use crate::types::{FrameStats, OitStats};
use modalcast_model::error::Result;
use modalcast_model::scene::{MAX_FRAGMENTS, RenderSettings};

const RECORDS_BINDING: u32 = 2;
const COUNTERS_BINDING: u32 = 3;
const COUNTS_UNIT: u32 = 1;
const CURSORS_UNIT: u32 = 2;
const LAYERS_UNIT: u32 = 3;
/// Bytes of a fragment: depth, then id and coverage.
const RECORD_BYTES: u64 = 8;
/// Default budget in fragments per pixel, and its minimum per frame.
const DEFAULT_FRAGMENTS_PER_PIXEL: u64 = 8;
const MIN_FRAGMENTS: u64 = 1 << 20;
/// Phases of the gather program: count, fill, and add ids to the kept depths.
const PHASE_COUNT: i32 = 0;
const PHASE_FILL: i32 = 1;
const PHASE_JOIN_IDS: i32 = 2;

/// Counters and indirect draws of a frame. Twin of `OitCounters` in `shaders/shared/oit_lists.glsl`, up to its bins.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct OitCounters {
    total: [u32; 2],
    max_per_pixel: u32,
    per_pixel_limit: u32,
    used: u32,
    budget: u32,
    /// Indirect draws: index count, instances, first index, base vertex, base instance.
    commands: [[u32; 5]; 2],
}

pub(crate) const COUNTERS_HEADER_BYTES: usize = size_of::<OitCounters>();
const COMMANDS_OFFSET: usize = 24;
const COUNTERS_BYTES: usize = COUNTERS_HEADER_BYTES + 4 * BINS;
const _: () = assert!(COUNTERS_HEADER_BYTES == 64, "OitCounters differs from shaders/shared/oit_lists.glsl");

/// Programs of exact transparency.
#[derive(Debug, Clone)]
pub(crate) struct OitPrograms {
    gather: Rc<Program>,
    histogram: Rc<Program>,
    allocate: Rc<Program>,
    resolve: Rc<Program>,
}

/// Images and buffers of exact transparency for frames of one form.
#[derive(Debug)]
pub(crate) struct OitTarget {
    /// Blended fragments of each pixel.
    pub(crate) counts: Texture,
    cursors: Texture,
    /// One array layer per sample.
    pub(crate) layers: Texture,
    /// Framebuffer that clears the counts.
    clear_framebuffer: Framebuffer,
    dirty: DirtyRegion,
    /// Framebuffer with depth only, for the depth test.
    depth_only: Framebuffer,
    records: Buffer,
    pub(crate) counters: Buffer,
    tiles: Buffer,
}

/// Number of fragment records that a frame may use.
///
/// # Errors
/// `Invalid` when the look asks for more records than fit into one buffer of the device.
pub(crate) fn budget(limits: &Limits, look: &RenderSettings, [width, height]: [u32; 2]) -> Result<u32> {
    let most = u64::from(MAX_FRAGMENTS).min(limits.max_storage_bytes / RECORD_BYTES);
    if let Some(fragments) = look.fragments {
        let fits = u64::from(fragments) <= most;
        return if fits { Ok(fragments) } else { Err(gl::too_large("look.fragments", most, fragments.into())) };
    }
    Ok((DEFAULT_FRAGMENTS_PER_PIXEL * u64::from(width) * u64::from(height)).max(MIN_FRAGMENTS).min(most) as u32)
}

impl OitPrograms {
    pub(crate) fn compile(
        options: &ShaderOptions,
        samples: u32,
        compile: &mut super::programs::ProgramCompiler<'_>,
    ) -> Result<Self> {
        Ok(Self {
            gather: compile(options.oit_gather(samples))?,
            histogram: compile(shaders::oit::histogram())?,
            allocate: compile(shaders::oit::oit_allocate())?,
            resolve: compile(options.oit_resolve(samples))?,
        })
    }
}

impl OitTarget {
    pub(crate) fn new(gl: &Rc<Gl>, desc: TargetDesc, budget: u32, depth: &Texture) -> Result<Self> {
        let TargetDesc { width, height, samples, .. } = desc;
        let image = |target: u32, format: u32, depth: u32| {
            let texture = gl.texture(TextureDesc { target, format, width, height, depth, levels: 1 })?;
            texture.set_sampling(&[(gl::TEXTURE_MIN_FILTER, gl::NEAREST), (gl::TEXTURE_MAG_FILTER, gl::NEAREST)], 1.0);
            Ok(texture)
        };
        let counts = image(gl::TEXTURE_2D, gl::R32UI, 1)?;
        let tiles = u64::from(width.div_ceil(TILE)) * u64::from(height.div_ceil(TILE));
        Ok(Self {
            clear_framebuffer: gl.color_framebuffer(&counts)?,
            dirty: DirtyRegion::default(),
            depth_only: gl.framebuffer(None, depth)?,
            counts,
            cursors: image(gl::TEXTURE_2D, gl::R32UI, 1)?,
            layers: image(gl::TEXTURE_2D_ARRAY, gl::RGBA16F, samples)?,
            records: gl.buffer(RECORD_BYTES * u64::from(budget), gl::STREAM_COPY, None)?,
            counters: gl.buffer(COUNTERS_BYTES as u64, gl::STREAM_COPY, None)?,
            tiles: gl.buffer(16 + 4 * tiles, gl::STREAM_COPY, None)?,
        })
    }

    fn bind(&self) {
        self.counts.bind_image_read_write(COUNTS_UNIT);
        self.cursors.bind_image_read_write(CURSORS_UNIT);
        self.records.bind_storage(RECORDS_BINDING);
        self.counters.bind_storage(COUNTERS_BINDING);
        self.tiles.bind_storage(TILES);
    }

    /// Resets the ledger: nothing is counted, and the number of records per pixel is unlimited.
    fn reset(&self, gl: &Gl, buffers: &SceneBuffers) {
        let mut commands = [[0; 5]; 2];
        let blended = buffers.groups.iter().filter(|group| group.blend_mode == BlendMode::Blend);
        for (command_offset, group) in commands.iter_mut().zip(blended) {
            *command_offset = [3 * group.triangles as u32, 0, 3 * group.first_triangle as u32, 0, 0];
        }
        let budget = (self.records.bytes / RECORD_BYTES) as u32;
        let head =
            OitCounters { total: [0; 2], max_per_pixel: 0, per_pixel_limit: u32::MAX, used: 0, budget, commands };
        let mut bytes = vec![0; COUNTERS_BYTES];
        bytes[..COUNTERS_HEADER_BYTES].copy_from_slice(bytemuck::bytes_of(&head));
        self.counters.write(&bytes);
        let blended = buffers.groups.iter().enumerate().filter(|(_, group)| group.blend_mode == BlendMode::Blend);
        for (index, (place, _)) in blended.enumerate() {
            // A culled scene draws only as many indices as are listed.
            if let Some((_, listed)) = buffers.visible_draws(BlendMode::Blend) {
                let to = COMMANDS_OFFSET + size_of::<[u32; 5]>() * index;
                gl.copy(BufferCopy {
                    from: listed,
                    from_offset: command_offset(place) as u64,
                    to: &self.counters,
                    to_offset: to as u64,
                    bytes: size_of::<u32>() as u64,
                });
            }
        }
        self.tiles.write(bytemuck::cast_slice(&EMPTY_TILE_LIST));
    }
}

/// Fragment statistics of a frame, from the head of its ledger.
pub(crate) fn parse_stats(head: &[u8]) -> OitStats {
    let mut counters = OitCounters::zeroed();
    // A byte copy, because `head` may be unaligned; it has the length of the ledger.
    bytemuck::bytes_of_mut(&mut counters).iter_mut().zip(head).for_each(|(to, from)| *to = *from);
    let [low, high] = counters.total.map(u64::from);
    let per_pixel_limit = (counters.per_pixel_limit != u32::MAX).then_some(counters.per_pixel_limit);
    OitStats {
        fragments: high << 32 | low,
        stored: counters.used.into(),
        max_per_pixel: counters.max_per_pixel,
        per_pixel_limit,
    }
}

/// Draws the layers of the blended triangles in front of the opaque ones, against whose depth they are tested.
pub(crate) fn draw(
    gl: &Gl,
    buffers: &SceneBuffers,
    (target, part): (&OitTarget, Region),
    programs: &OitPrograms,
    stats: &mut FrameStats,
) -> Result<()> {
    target.reset(gl, buffers);
    let [width, height] = part.frame();
    gl.begin_pass(&target.clear_framebuffer, part, ClearOp::Uint(&target.dirty));
    target.bind();
    gather(gl, buffers, (target, part), (programs, PHASE_COUNT), stats);
    gl.check("oit count")?;
    programs.histogram.bind(None);
    gl.dispatch(width.div_ceil(HISTOGRAM_TILE), height.div_ceil(HISTOGRAM_TILE));
    programs.allocate.bind(None);
    gl.dispatch(width.div_ceil(TILE), height.div_ceil(TILE));
    gl.check("oit allocate")?;
    gather(gl, buffers, (target, part), (programs, PHASE_FILL), stats);
    gather(gl, buffers, (target, part), (programs, PHASE_JOIN_IDS), stats);
    gl.check("oit fill")?;
    bind_shadow(buffers);
    target.layers.bind_image(LAYERS_UNIT);
    programs.resolve.bind(None);
    gl.dispatch_indirect(&target.tiles);
    stats.passes.extend(PASSES);
    gl.check("oit resolve")
}

/// The passes of exact transparency.
pub(crate) const PASSES: [&str; 4] = ["oit count", "oit allocate", "oit fill", "oit resolve"];

/// Draws all blended triangles for one phase. In the last phase the ledger gives the number of instances: none when all
/// fragments fit.
fn gather(
    gl: &Gl,
    buffers: &SceneBuffers,
    (target, part): (&OitTarget, Region),
    (programs, phase): (&OitPrograms, i32),
    stats: &mut FrameStats,
) {
    let (all, drawn) = (buffers.vertex_array(BlendMode::Blend), triangle_set(buffers));
    let array = buffers.visible_draws(BlendMode::Blend).map(|(array, _)| array).or(all);
    let Some(array) = array else { return };
    gl.begin_pass(&target.depth_only, part, ClearOp::Load);
    let groups = buffers.groups.iter().enumerate().filter(|(_, group)| group.blend_mode == BlendMode::Blend);
    for (index, (place, group)) in groups.enumerate() {
        gl.set_pipeline_state(PipelineState { cull: !group.double_sided, ..PipelineState::default() });
        programs.gather.bind(Some(first_triangle_of(group, drawn)));
        programs.gather.set_phase(phase);
        if phase == PHASE_JOIN_IDS {
            gl.draw_indexed_indirect(array, &target.counters, COMMANDS_OFFSET + size_of::<[u32; 5]>() * index);
        } else {
            draw_group(gl, buffers, place, drawn);
        }
        stats.draw_calls += 1;
    }
    gl.barrier();
}

/// How a frame of this look draws blended triangles.
pub(crate) fn blend_storage(gl: &Gl, scene: &modalcast_model::scene::Scene, size: [u32; 2]) -> Result<BlendStorage> {
    match scene.look.transparency {
        _ if !scene.needs.blend => Ok(BlendStorage::None),
        modalcast_model::scene::Transparency::TwoPass => Ok(BlendStorage::SingleLayer),
        modalcast_model::scene::Transparency::OrderIndependent => {
            budget(&gl.limits, &scene.look, size).map(BlendStorage::FragmentLists)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::geometry::tests::squares;
    use super::super::{DevicePreference, FrameParams, Renderer};
    use super::*;
    use modalcast_model::deform::DeformedSurface;
    use modalcast_model::domain::{AlphaMode, Material};
    use modalcast_model::scene::{Bounds, Camera, Scene, Transparency};

    #[test]
    fn the_budget_is_eight_a_pixel_or_what_the_look_says_as_far_as_one_buffer_reaches() {
        let limits = |max_storage_bytes: u64| Limits { max_storage_bytes, ..Limits::default() };
        let of = |fragments: Option<u32>, max_storage_bytes: u64, size: [u32; 2]| {
            budget(&limits(max_storage_bytes), &RenderSettings { fragments, ..RenderSettings::default() }, size)
        };
        assert_eq!(of(None, 1 << 31, [640, 480]).expect("fits"), 8 * 640 * 480);
        assert_eq!(of(None, 1 << 31, [1, 1]).expect("fits"), 1 << 20);
        assert_eq!(of(None, 1 << 27, [8192, 8192]).expect("less"), 1 << 24, "as many as fit");
        assert_eq!(of(Some(100), 1 << 27, [8192, 8192]).expect("fits"), 100);
        let refusal = of(Some(1 << 25), 1 << 27, [64, 64]).expect_err("refused").to_string();
        assert_eq!(refusal, "look.fragments: expected at most 16777216 on this device, got 33554432");
    }

    /// Draws a glass square in front of an opaque square and another behind it, 64 pixels wide; returns the pixels and
    /// the renderer.
    fn drawn(transparency: Transparency, alpha_mode: AlphaMode, post_depth_coverage: bool) -> (Vec<u8>, Renderer) {
        let glass = Material { alpha: 0.5, alpha_mode, double_sided: true, ..Material::default() };
        let mut parts =
            squares(vec![Material { diffuse: [0.9, 0.2, 0.1], ..Material::default() }, glass.clone(), glass]);
        // No shadow: light that varies within a pixel would reveal where in the pixel a fragment is shaded.
        (parts.look.transparency, parts.look.shadow) = (transparency, None);
        // Slightly rotated, so that edges cross pixels.
        let corner = |z: f32, angle: f32, [x, y]: [f32; 2]| {
            let (sine, cosine) = angle.sin_cos();
            [cosine * x - sine * y, sine * x + cosine * y, z]
        };
        let square = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
        let positions: Vec<[f32; 3]> = [(0.0, 0.3), (0.3, 0.5), (-0.3, 0.7)]
            .into_iter()
            .flat_map(|(z, angle)| square.map(|at| corner(z, angle, at)))
            .collect();
        let mut bounds = Bounds::EMPTY;
        positions.iter().for_each(|position| bounds.include(position.map(f64::from)));
        let surface = DeformedSurface {
            positions: positions.as_flattened().to_vec(),
            normals: [0.0, 0.0, 1.0].repeat(positions.len()),
            ..DeformedSurface::default()
        };
        let scene = Scene::new(parts).expect("good");
        let mut renderer = Renderer::open(DevicePreference::Any).expect("EGL");
        let gl = Rc::get_mut(&mut renderer.gl).expect("not shared yet");
        gl.limits.post_depth_coverage &= post_depth_coverage;
        let buffers = renderer.load(&scene).expect("loads");
        renderer.upload(&buffers, &surface).expect("uploads");
        let camera = Camera::fit_to_scene(&scene, 64, 64);
        let image = renderer
            .draw(&buffers, &FrameParams { camera, width: 64, height: 64, bounds, light: None })
            .expect("draws");
        (image.rgba, renderer)
    }

    #[test]
    fn a_fragment_a_pixel_with_its_samples_and_a_fragment_a_sample_give_the_same_picture() {
        let (known, renderer) = drawn(Transparency::OrderIndependent, AlphaMode::Blend, true);
        let (apart, other) = drawn(Transparency::OrderIndependent, AlphaMode::Blend, false);
        let worst = known.iter().zip(&apart).map(|(a, b)| a.abs_diff(*b)).max();
        assert!(worst <= Some(2), "{worst:?} levels");
        let [few, many] = [&renderer, &other].map(|renderer| renderer.stats().oit.expect("exact").fragments);
        assert!(!renderer.gl.limits.post_depth_coverage || many > 3 * few, "control: {few} and {many} fragments");
    }

    #[test]
    fn only_the_method_that_the_look_names_is_compiled_and_neither_without_blended_triangles() {
        let compiled = |transparency, alpha_mode| {
            let (_, renderer) = drawn(transparency, alpha_mode, true);
            let any = |name: &str| renderer.programs.keys().any(|source| source.label.starts_with(name));
            (["oit gather", "oit histogram", "oit allocate", "oit resolve"].map(any), any("blended"))
        };
        assert_eq!(compiled(Transparency::OrderIndependent, AlphaMode::Opaque), ([false; 4], false));
        assert_eq!(compiled(Transparency::TwoPass, AlphaMode::Opaque), ([false; 4], false));
        assert_eq!(compiled(Transparency::OrderIndependent, AlphaMode::Blend), ([true; 4], false));
        assert_eq!(compiled(Transparency::TwoPass, AlphaMode::Blend), ([false; 4], true));
    }
}
