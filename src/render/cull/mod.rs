//! Culling on the GPU: before the rasteriser sees a group of triangles, a compute pass looks at each of them and lists
//! those that it may make something of; one indirect call a group draws the list. The rasteriser is scarce (about
//! 0.4 G triangles/s on a data-centre GPU), compute is not.
//!
//! # What is left out
//! Triangles outside one plane of the view volume; back faces of what has one side; triangles so small that no sample lies
//! in their bounding box; and, where the look says so, triangles behind what is nearer. Each bound is widened by all that
//! rounding may do, on the host's side of the rasteriser and on its own, so that no bit of the picture changes. The counts
//! come back with the pixels.
//!
//! # Hidden triangles
//! What the last frame saw is drawn first, depth alone, where it is now. A pyramid of the farthest depth of ever larger
//! squares is made of that, all triangles are tested against it, and the survivors are drawn into a cleared image in their
//! own order. The picture depends on no history: whatever was remembered, it was drawn from this frame's positions, so a
//! triangle that is strictly behind its depth at every sample is behind the picture's too, and what is dropped never
//! would have been seen. Which triangles are hidden does depend on it, and so does their count: a first frame hides none.
//!
//! Drawing the remembered ones once, with ids, and only the rest after them would spare their second turn. It is not
//! exact: of equal depths the later triangle is seen, and the rest may be both equal and earlier. Fragments cannot ask what
//! is there, and comparing depths in the shader would run it once a sample. So they are drawn twice, the first time without
//! ids. Depth is cleared in between because depths of the two turns would have to agree to the bit otherwise; now they
//! only need to agree within the margin.
//!
//! # Lists
//! A list keeps its triangles' order, by a scan of counted bits and not by atomics, and begins where its group does. It
//! holds indices rather than triangles alone, so that vertices are still shared between triangles: without an index buffer
//! each would be transformed three times. Its fragments find their triangle's name by one fetch, the same for all
//! fragments of a triangle.

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
/// The pass of the sun's lists.
pub(super) const SHADOW_CULL: &str = "shadow cull";
/// Words of the counts: five verdicts of the camera, five of the sun.
const COUNTS: usize = 10;
pub(super) const COUNT_BYTES: usize = 4 * COUNTS;
/// The buffer of the counts.
pub(super) const COUNTED: &str = "cull counts";
/// Triangles from which a scene is culled on hardware, where its look does not say: between those measured, see `chosen`.
const MANY: usize = 1 << 20;

/// What became of the triangles of one pass. Of a shadow with several maps, those of all maps; of one that frames share,
/// nothing but in the frame that drew it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct Sifted {
    /// Left to the rasteriser.
    pub listed: u32,
    /// Outside the view volume, or the box of the shadow map.
    pub outside: u32,
    /// Back faces of what has one side.
    pub facing: u32,
    /// In no sample of a pixel, or without area.
    pub no_sample: u32,
    /// Behind what the last frame saw.
    pub hidden: u32,
}

/// What became of a frame's triangles before they were drawn.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct Culled {
    pub camera: Sifted,
    /// Of the shadow map.
    pub sun: Sifted,
}

impl Sifted {
    /// Triangles that the rasteriser does not see.
    pub const fn left_out(&self) -> u32 {
        self.outside + self.facing + self.no_sample + self.hidden
    }
}

/// How a scene is culled on a device: what its look says, or what suits both. Not at all where the device has no buffers
/// so large as the lists.
///
/// On hardware (H200, 1080p) a field of 3 M triangles takes 6.32 ms a frame without culling, 5.78 with what no sample hits
/// left out, and more by depth. One of 262,144 takes 2.04 ms without, 2.08 and 2.76 with; the almond tree (37,560 triangles,
/// leaves with two sides, four samples) 1.57 without, 1.59 and 2.09 with: there it does not pay.
///
/// Software gains too little: on two cores the visibility pass of the almond tree (37,560 triangles, 1080p, four samples)
/// takes 83 ms in place of 80 where what no sample hits is left out (3 % of it), and by depth four times as long.
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

/// Whether cut-outs read an image at the centroid of the samples that they cover. Mesa's rasteriser takes the centroid of
/// those that also pass the depth test, so that what is hidden later moves it, and a pixel in a million differs without
/// what is hidden.
fn centroids(scene: &Scene) -> bool {
    scene.look.samples_a_pixel() > 1 && scene.needs.mask && scene.needs.textures
}

/// How a plan culls.
pub(super) fn of(plan: &Plan) -> Culling {
    match (plan.defines("CULLED"), plan.defines("REMEMBERS")) {
        (_, true) => Culling::Depth,
        (true, false) => Culling::Triangles,
        (false, false) => Culling::None,
    }
}

/// The passes of the camera's lists, in order.
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

/// Programs of the camera's lists, for one number of samples a pixel.
#[derive(Debug, Clone)]
pub(super) struct CullPrograms {
    sift: Rc<Program>,
    list: Rc<Program>,
    /// Of culling by depth.
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

/// Programs of the sun's lists.
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

/// The lists of a culled scene, one for each group, and what is drawn from them.
#[derive(Debug)]
pub(super) struct Culler {
    numbers: Groups,
    names: Texture,
    solids: VertexArray,
    corners: Option<VertexArray>,
}

impl Culler {
    /// Of a scene whose plan has the buffers; none otherwise. The vertex arrays are those of lists.
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

    /// What listed triangles of a kind are made from.
    pub(super) const fn array(&self, kind: Kind) -> Option<&VertexArray> {
        match kind {
            Kind::Opaque => Some(&self.solids),
            Kind::Mask | Kind::Blend => self.corners.as_ref(),
        }
    }
}

/// What became of a frame's triangles, from its counts.
pub(super) fn told(counts: &[u8]) -> Culled {
    let words: Vec<u32> = bytemuck::pod_collect_to_vec(counts);
    let sifted = |first: usize| {
        let at = |index: usize| words.get(first + index).copied().unwrap_or_default();
        Sifted { listed: at(0), outside: at(1), facing: at(2), no_sample: at(3), hidden: at(4) }
    };
    Culled { camera: sifted(sources::CAMERA_COUNTS), sun: sifted(sources::SUN_COUNTS) }
}
