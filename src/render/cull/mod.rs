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

mod layout;
mod pyramid;
mod run;
mod sources;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::rc::Rc;

pub(super) use self::layout::command;
use self::layout::{GROUPS, Groups};
pub(super) use self::pyramid::Pyramid;
pub(super) use self::run::{begin, camera, remember, sun};
use super::geometry::{Group, Kind, groups};
use super::gl::{self, Buffer, Gl, Limits, Program, Texture, VertexArray};
use super::plan::{Allocation, Plan};
use super::programs::Compile;
use super::shaders::Options;
use modalcast_model::error::Result;
use modalcast_model::scene::{Culling, Scene};

/// The buffer of listed triangles, three indices each.
pub(super) const LISTED: &str = "listed triangles";
/// The pass that builds the lists of shadow casters.
pub(super) const SHADOW_CULL: &str = "shadow cull";
/// Words of the counts: five verdicts for the camera, five for the sun.
const COUNTS: usize = 10;
pub(super) const COUNT_BYTES: usize = 4 * COUNTS;
/// The buffer of the counts.
pub(super) const COUNTED: &str = "cull counts";
/// Number of triangles from which a scene is culled on hardware by default; lies between the measurements given at
/// `chosen`.
const MANY: usize = 1 << 20;

/// Culling result of one view. For the sun, the counts add up over all cascades; they are zero in frames that reuse a
/// shadow map.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct Sifted {
    /// Passed on to the rasterizer.
    pub listed: u32,
    /// Outside the view volume, or outside the box of the shadow map.
    pub outside: u32,
    /// Back faces of single-sided materials.
    pub facing: u32,
    /// Triangles that cover no sample or have no area.
    pub no_sample: u32,
    /// Behind the depth of the triangles that the last frame saw.
    pub hidden: u32,
}

/// Culling results of a frame.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct Culled {
    pub camera: Sifted,
    /// Casters of the shadow map.
    pub sun: Sifted,
}

impl Sifted {
    /// Triangles that the rasterizer does not process.
    pub const fn left_out(&self) -> u32 {
        self.outside + self.facing + self.no_sample + self.hidden
    }
}

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
pub(super) fn chosen(scene: &Scene, limits: &Limits) -> Culling {
    let software = limits.software;
    let wanted = match scene.look.culling {
        Culling::Fitting if software || scene.layout.triangles < MANY => Culling::None,
        Culling::Fitting => Culling::Triangles,
        Culling::Depth if software && centroids(scene) => Culling::Triangles,
        named => named,
    };
    let fits = allocations(scene, wanted).iter().all(|part| part.bytes <= limits.max_storage);
    if fits { wanted } else { Culling::None }
}

/// Whether cut-outs sample a texture at the centroid of their covered samples. Mesa's rasterizer takes the centroid of
/// the samples that also pass the depth test. Hidden triangles drawn earlier thus move the centroid, and about one
/// pixel in a million differs when they are culled.
fn centroids(scene: &Scene) -> bool {
    scene.look.samples_a_pixel() > 1 && scene.needs.mask && scene.needs.textures
}

/// Culling method of a plan.
pub(super) fn of(plan: &Plan) -> Culling {
    match (plan.defines("CULLED"), plan.defines("REMEMBERS")) {
        (_, true) => Culling::Depth,
        (true, false) => Culling::Triangles,
        (false, false) => Culling::None,
    }
}

/// The passes of the camera's lists, in execution order.
pub(super) fn passes(culling: Culling) -> Vec<&'static str> {
    match culling {
        Culling::Depth => vec!["occluders", "cull"],
        Culling::Triangles => vec!["cull"],
        Culling::None | Culling::Fitting => vec![],
    }
}

/// The buffers of a culled scene.
pub(super) fn allocations(scene: &Scene, culling: Culling) -> Vec<Allocation> {
    if culling == Culling::None {
        return Vec::new();
    }
    let (numbers, triangles) = (Groups::new(&groups(scene).0, 0.0), scene.layout.triangles);
    let bits = numbers.bit_bytes();
    let seen = (culling == Culling::Depth).then_some(("cull seen", bits));
    let all = [
        ("cull groups", size_of::<Groups>()),
        ("cull ledger", numbers.ledger_bytes()),
        (COUNTED, COUNT_BYTES),
        ("cull bits", bits),
        ("listed names", 4 * triangles),
        (LISTED, 12 * triangles),
    ];
    let named = |(name, bytes): (&str, usize)| Allocation { name: name.into(), bytes: bytes as u64 };
    all.into_iter().chain(seen).map(named).collect()
}

/// Programs of the camera's lists, for one number of samples per pixel.
#[derive(Debug, Clone)]
pub(super) struct CullPrograms {
    sift: Rc<Program>,
    list: Rc<Program>,
    /// Programs of occlusion culling.
    remembered: Option<Rc<Program>>,
    remember: Option<Rc<Program>>,
    pyramid: Option<[Rc<Program>; 2]>,
}

impl CullPrograms {
    pub(super) fn compile(options: &Options, samples: u32, compile: &mut Compile<'_>) -> Result<Option<Self>> {
        if !options.culls() {
            return Ok(None);
        }
        let mut own = Self {
            sift: compile(options.sift(samples))?,
            list: compile(options.list())?,
            remembered: None,
            remember: None,
            pyramid: None,
        };
        if options.hides() {
            own.remembered = Some(compile(options.sift_remembered())?);
            own.remember = Some(compile(options.remember(samples))?);
            own.pyramid = Some([compile(options.pyramid(samples, true))?, compile(options.pyramid(samples, false))?]);
        }
        Ok(Some(own))
    }
}

/// Programs of the shadow casters' lists.
#[derive(Debug)]
pub(super) struct SunPrograms {
    sift: Rc<Program>,
    list: Rc<Program>,
}

impl SunPrograms {
    pub(super) fn compile(options: &Options, compile: &mut Compile<'_>) -> Result<Self> {
        Ok(Self { sift: compile(options.sift_sun())?, list: compile(options.list())? })
    }
}

/// The lists of a culled scene, one per group, and the vertex arrays that draw them.
#[derive(Debug)]
pub(super) struct Culler {
    numbers: Groups,
    names: Texture,
    solids: VertexArray,
    corners: Option<VertexArray>,
}

impl Culler {
    /// Creates the lists of a scene whose plan has buffers for them; none otherwise. The vertex arrays index the lists.
    pub(super) fn new(
        gl: &Rc<Gl>,
        buffers: &BTreeMap<String, Buffer>,
        groups: &[Group],
        (solids, corners): (VertexArray, Option<VertexArray>),
    ) -> Result<Option<Self>> {
        let (Some(own), Some(names)) = (buffers.get("cull groups"), buffers.get("listed names")) else {
            return Ok(None);
        };
        debug_assert!(groups.len() <= GROUPS);
        let numbers = Groups::new(groups, gl.grid());
        own.write(bytemuck::bytes_of(&numbers));
        if let Some(seen) = buffers.get("cull seen") {
            seen.write(&vec![0; numbers.bit_bytes()]);
        }
        Ok(Some(Self { numbers, names: gl.view(names, gl::R32UI)?, solids, corners }))
    }

    /// Vertex array of one kind of listed triangle.
    pub(super) const fn array(&self, kind: Kind) -> Option<&VertexArray> {
        match kind {
            Kind::Opaque => Some(&self.solids),
            Kind::Mask | Kind::Blend => self.corners.as_ref(),
        }
    }
}

/// Culling results of a frame, from its counts.
pub(super) fn told(counts: &[u8]) -> Culled {
    let words: Vec<u32> = bytemuck::pod_collect_to_vec(counts);
    let sifted = |first: usize| {
        let at = |index: usize| words.get(first + index).copied().unwrap_or_default();
        Sifted { listed: at(0), outside: at(1), facing: at(2), no_sample: at(3), hidden: at(4) }
    };
    Culled { camera: sifted(sources::CAMERA_COUNTS), sun: sifted(sources::SUN_COUNTS) }
}
