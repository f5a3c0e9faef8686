//! Triangle culling on the GPU. Before the rasterizer processes a group of triangles, a compute pass tests each
//! triangle and lists those that may be visible; one indirect draw per group draws the list. Rasterizer throughput is
//! scarce (about 0.4 G triangles/s on a data-center GPU), compute throughput is not.
//!
//! # Tests
//! Culling removes triangles outside one plane of the view volume, back faces of single-sided materials, triangles so
//! small that no sample lies in their bounding box and, if the look asks for it, triangles behind nearer ones. Each
//! bound is widened by the rounding errors of the shaders and of the rasterizer, so that culling changes no bit of the
//! picture. The counts are read back with the pixels.
//!
//! # Occlusion culling
//! The pass first draws the depth of the triangles that the last frame saw, at their current positions. A hierarchical
//! depth pyramid holds the farthest depth of ever larger squares. All triangles are tested against the pyramid, and the
//! survivors are drawn into a cleared image in their original order. The picture does not depend on the history. The
//! occluders have this frame's positions, so a triangle strictly behind their depth at every sample is also behind the
//! picture's depth and would not be visible. The set of hidden triangles, and so their count, does depend on the
//! history: the first frame hides none.
//!
//! Drawing the remembered triangles once, with ids, and then only the rest would avoid drawing them twice, but it is
//! not exact: at equal depths the later triangle must win, and one of the rest may have equal depth and an earlier
//! position. Fragment shaders cannot read the current id, and a depth comparison in the shader would force per-sample
//! shading. The occluders are therefore drawn twice, the first time without ids. The depth is cleared in between
//! because the depths of both draws would otherwise have to match to the bit; with the clear they only need to match
//! within the margin.
//!
//! # Lists
//! A list keeps the order of its triangles, because it is compacted with a prefix sum over bits instead of atomics, and
//! begins at the offset of its group. It holds indices and not only triangles, so that triangles still share
//! transformed vertices: without an index buffer, each vertex would be transformed three times. Fragments find the id
//! of their triangle with one texel fetch, which is uniform over a triangle.

mod blocks;
mod pyramid;
mod run;
mod sources;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::rc::Rc;

pub(crate) use self::blocks::command_offset;
use self::blocks::{CullUniforms, MAX_GROUPS};
pub(crate) use self::pyramid::DepthPyramid;
pub(crate) use self::run::{clear_counters, cull_for_camera, cull_shadow_casters, record_visible};
use super::geometry::{BlendMode, DrawGroup, groups};
use super::plan::{Allocation, RenderPlan};
use super::programs::ProgramCompiler;
use super::shaders::ShaderOptions;
use crate::device::gl::{self, Buffer, Gl, Limits, Program, Texture, VertexArray};
use crate::types::{CullStats, FrameCullStats};
use modalcast_model::error::Result;
use modalcast_model::scene::{Culling, Scene};

/// The buffer of listed triangles, three indices each.
pub(crate) const VISIBLE_INDICES: &str = "visible indices";
/// The pass that builds the lists of shadow casters.
pub(crate) const SHADOW_CULL: &str = "shadow cull";
/// Words of the counts: five verdicts for the camera, five for the sun.
const COUNTER_WORDS: usize = 10;
pub(crate) const COUNTER_BYTES: usize = 4 * COUNTER_WORDS;
/// The buffer of the counts.
pub(crate) const COUNTERS: &str = "cull counters";
/// Number of triangles from which a scene is culled on hardware by default; lies between the measurements given at
/// `select_culling`.
const MIN_TRIANGLES: usize = 1 << 20;

/// Culling method of a scene on a device: the look's choice, or the one that suits both. None if the lists exceed the
/// largest buffer of the device.
///
/// On hardware (H200, 1080p), a field of 3 M triangles takes 6.32 ms per frame without culling, 5.78 ms with the test
/// for samples, and more with occlusion culling. A field of 262,144 triangles takes 2.04 ms without culling, 2.08 ms
/// and 2.76 ms with the two methods; the almond tree (37,560 triangles, double-sided leaves, four samples) takes 1.57
/// ms without, 1.59 ms and 2.09 ms with them. Culling does not pay for the two smaller scenes.
///
/// In software it does not pay either: on two cores, the visibility pass of the almond tree (37,560 triangles, 1080p,
/// four samples) takes 83 ms instead of 80 ms when the 3 % of triangles without a sample are culled, and four times as
/// long with occlusion culling.
pub(crate) fn select_culling(scene: &Scene, limits: &Limits) -> Culling {
    let software = limits.software;
    let wanted = match scene.look.culling {
        Culling::Auto if software || scene.layout.triangles < MIN_TRIANGLES => Culling::None,
        Culling::Auto => Culling::Triangles,
        Culling::Occlusion if software && interpolates_at_centroid(scene) => Culling::Triangles,
        named => named,
    };
    let fits = allocations(scene, wanted).iter().all(|part| part.bytes <= limits.max_storage_bytes);
    if fits { wanted } else { Culling::None }
}

/// Whether cut-outs sample a texture at the centroid of their covered samples. Mesa's rasterizer takes the centroid of
/// the samples that also pass the depth test. Hidden triangles drawn earlier thus move the centroid, and about one
/// pixel in a million differs when they are culled.
fn interpolates_at_centroid(scene: &Scene) -> bool {
    scene.look.samples_per_pixel() > 1 && scene.needs.mask && scene.needs.textures
}

/// Culling method of a plan.
pub(crate) fn culling_of(plan: &RenderPlan) -> Culling {
    match (plan.defines("CULLED"), plan.defines("OCCLUSION_CULLING")) {
        (_, true) => Culling::Occlusion,
        (true, false) => Culling::Triangles,
        (false, false) => Culling::None,
    }
}

/// The passes of the camera's lists, in execution order.
pub(crate) fn passes(culling: Culling) -> Vec<&'static str> {
    match culling {
        Culling::Occlusion => vec!["occluders", "cull"],
        Culling::Triangles => vec!["cull"],
        Culling::None | Culling::Auto => vec![],
    }
}

/// The buffers of a culled scene.
pub(crate) fn allocations(scene: &Scene, culling: Culling) -> Vec<Allocation> {
    if culling == Culling::None {
        return Vec::new();
    }
    let (uniforms, triangles) = (CullUniforms::new(&groups(scene).0, 0.0), scene.layout.triangles);
    let bits = uniforms.mask_bytes();
    let seen = (culling == Culling::Occlusion).then_some(("cull previously visible", bits));
    let all = [
        ("cull uniforms", size_of::<CullUniforms>()),
        ("cull draws", uniforms.draws_bytes()),
        (COUNTERS, COUNTER_BYTES),
        ("cull visible bits", bits),
        ("visible triangle ids", 4 * triangles),
        (VISIBLE_INDICES, 12 * triangles),
    ];
    let named = |(name, bytes): (&str, usize)| Allocation { name: name.into(), bytes: bytes as u64 };
    all.into_iter().chain(seen).map(named).collect()
}

/// Programs of the camera's lists, for one number of samples per pixel.
#[derive(Debug, Clone)]
pub(crate) struct CullPrograms {
    cull_triangles: Rc<Program>,
    compact: Rc<Program>,
    /// Programs of occlusion culling.
    cull_previous: Option<Rc<Program>>,
    record_visible: Option<Rc<Program>>,
    pyramid: Option<[Rc<Program>; 2]>,
}

impl CullPrograms {
    pub(crate) fn compile(
        options: &ShaderOptions,
        samples: u32,
        compile: &mut ProgramCompiler<'_>,
    ) -> Result<Option<Self>> {
        if !options.has_culling() {
            return Ok(None);
        }
        let mut own = Self {
            cull_triangles: compile(options.cull_triangles(samples))?,
            compact: compile(options.compact())?,
            cull_previous: None,
            record_visible: None,
            pyramid: None,
        };
        if options.has_occlusion_culling() {
            own.cull_previous = Some(compile(options.cull_previously_visible())?);
            own.record_visible = Some(compile(options.record_visible(samples))?);
            own.pyramid = Some([compile(options.pyramid(samples, true))?, compile(options.pyramid(samples, false))?]);
        }
        Ok(Some(own))
    }
}

/// Programs of the shadow casters' lists.
#[derive(Debug)]
pub(crate) struct ShadowCullPrograms {
    cull_triangles: Rc<Program>,
    compact: Rc<Program>,
}

impl ShadowCullPrograms {
    pub(crate) fn compile(options: &ShaderOptions, compile: &mut ProgramCompiler<'_>) -> Result<Self> {
        Ok(Self { cull_triangles: compile(options.cull_casters())?, compact: compile(options.compact())? })
    }
}

/// The lists of a culled scene, one per group, and the vertex arrays that draw them.
#[derive(Debug)]
pub(crate) struct TriangleCuller {
    uniforms: CullUniforms,
    triangle_ids: Texture,
    position_array: VertexArray,
    corners: Option<VertexArray>,
}

impl TriangleCuller {
    /// Creates the lists of a scene whose plan has buffers for them; none otherwise. The vertex arrays index the lists.
    pub(crate) fn new(
        gl: &Rc<Gl>,
        buffers: &BTreeMap<String, Buffer>,
        groups: &[DrawGroup],
        (position_array, corners): (VertexArray, Option<VertexArray>),
    ) -> Result<Option<Self>> {
        let (Some(own), Some(triangle_ids)) = (buffers.get("cull uniforms"), buffers.get("visible triangle ids"))
        else {
            return Ok(None);
        };
        debug_assert!(groups.len() <= MAX_GROUPS);
        let uniforms = CullUniforms::new(groups, gl.limits.subpixel_step());
        own.write(bytemuck::bytes_of(&uniforms));
        if let Some(seen) = buffers.get("cull previously visible") {
            seen.write(&vec![0; uniforms.mask_bytes()]);
        }
        Ok(Some(Self { uniforms, triangle_ids: gl.buffer_texture(triangle_ids, gl::R32UI)?, position_array, corners }))
    }

    /// Vertex array of one kind of listed triangle.
    pub(crate) const fn vertex_array(&self, blend_mode: BlendMode) -> Option<&VertexArray> {
        match blend_mode {
            BlendMode::Opaque => Some(&self.position_array),
            BlendMode::Mask | BlendMode::Blend => self.corners.as_ref(),
        }
    }
}

/// Culling results of a frame, from its counts.
pub(crate) fn parse_stats(counts: &[u8]) -> FrameCullStats {
    let words: Vec<u32> = bytemuck::pod_collect_to_vec(counts);
    let sifted = |first: usize| {
        let at = |index: usize| words.get(first + index).copied().unwrap_or_default();
        CullStats { visible: at(0), outside_view: at(1), back_facing: at(2), no_sample: at(3), occluded: at(4) }
    };
    FrameCullStats { camera: sifted(sources::CAMERA_COUNTERS), shadow: sifted(sources::SHADOW_COUNTERS) }
}
