//! Scene to what a step costs on the device: kernels with their defines, buffers in bytes, launches and copies. Pure.

use serde::Serialize;

use super::layout::{BLOCK, CornerSlot, VertexSlot};
use super::pack;
use crate::scene::Scene;

/// A kernel file and the macros that switch parts of it on.
#[derive(Debug)]
pub(super) struct KernelSource {
    pub name: &'static str,
    pub source: &'static str,
    pub features: &'static [&'static str],
}

/// All kernels there are.
pub(super) const KERNELS: [KernelSource; 2] = [
    KernelSource { name: "deform", source: include_str!("../../kernels/deform.cu"), features: &["MODES"] },
    KernelSource {
        name: "orient",
        source: include_str!("../../kernels/orient.cu"),
        features: &["NORMAL_MAPS", "SHEAR"],
    },
];

/// A kernel as one scene compiles it; launched once a step.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Kernel {
    pub name: &'static str,
    /// Macros that switch parts of it on.
    pub defines: Vec<&'static str>,
    pub blocks: u32,
    pub threads: u32,
    #[serde(skip)]
    pub(super) source: &'static str,
}

/// What a device buffer holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// x0 and the columns of U of every shape.
    Columns,
    /// Where each domain's vertices lie.
    VertexSlots,
    /// The first domain of each block of vertices.
    VertexBlocks,
    RestNormals,
    RestTangents,
    /// Where each domain's corners lie.
    CornerSlots,
    /// The first domain of each block of corners.
    CornerBlocks,
    /// Transforms and q of a step.
    Inputs,
    Bounds,
    Positions,
    Normals,
    Tangents,
}

/// One device buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Buffer {
    pub role: Role,
    pub bytes: u64,
}

/// A part that the scene does without.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct LeftOut {
    /// The flag of [`crate::scene::Needs`] that is off.
    pub feature: &'static str,
    /// What is not compiled, computed or stored.
    pub what: &'static str,
    /// Device bytes that are not allocated.
    pub bytes: u64,
}

/// What the CUDA deformer compiles, allocates and launches for a scene.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Plan {
    /// Launched in this order, each once a step.
    pub kernels: Vec<Kernel>,
    pub buffers: Vec<Buffer>,
    /// Bytes to the device and from it in each step, besides the vertices themselves.
    pub bytes_in: u64,
    pub bytes_out: u64,
    pub left_out: Vec<LeftOut>,
}

/// What a scene costs.
pub fn plan(scene: &Scene) -> Plan {
    let needs = scene.needs;
    let layout = &scene.layout;
    let rest_corners = pack::rest_corners(scene) as u64;
    let (vertices, corners) = (layout.vertices as u64, layout.corners as u64);
    let domains = scene.domains.len() as u64;
    let inputs = 48 * domains + 4 * layout.coordinates as u64;
    let mut buffers = vec![
        (Role::Columns, 4 * pack::placements(scene).1),
        (Role::VertexSlots, domains * size_of::<VertexSlot>() as u64),
        (Role::VertexBlocks, 4 * (u64::from(blocks(layout.vertices)) + 1)),
        (Role::RestNormals, 12 * rest_corners),
        (Role::CornerSlots, domains * size_of::<CornerSlot>() as u64),
        (Role::CornerBlocks, 4 * (u64::from(blocks(layout.corners)) + 1)),
        (Role::Inputs, inputs),
        (Role::Bounds, 24),
        (Role::Positions, 12 * vertices),
        (Role::Normals, 12 * corners),
    ];
    if needs.normal_maps {
        buffers.push((Role::RestTangents, 16 * pack::tangent_count(scene) as u64));
        buffers.push((Role::Tangents, 16 * corners));
    }
    Plan {
        kernels: kernels(scene),
        buffers: buffers.into_iter().map(|(role, bytes)| Buffer { role, bytes }).collect(),
        bytes_in: inputs,
        bytes_out: 24,
        left_out: left_out(scene, 16 * (rest_corners + corners)),
    }
}

fn kernels(scene: &Scene) -> Vec<Kernel> {
    let needs = scene.needs;
    let flags = [("MODES", needs.modes), ("NORMAL_MAPS", needs.normal_maps), ("SHEAR", needs.shear)];
    let compiled = |kernel: KernelSource, items: usize| Kernel {
        name: kernel.name,
        defines: flags
            .iter()
            .filter(|(name, on)| *on && kernel.features.contains(name))
            .map(|(name, _)| *name)
            .collect(),
        blocks: blocks(items),
        threads: BLOCK,
        source: kernel.source,
    };
    let [deform, orient] = KERNELS;
    vec![compiled(deform, scene.layout.vertices), compiled(orient, scene.layout.corners)]
}

fn left_out(scene: &Scene, tangent_bytes: u64) -> Vec<LeftOut> {
    let needs = scene.needs;
    let all = [
        (needs.modes, LeftOut { feature: "modes", what: "the sum U q in `deform`", bytes: 0 }),
        (
            needs.normal_maps,
            LeftOut {
                feature: "normal_maps",
                what: "tangents in `orient` and their two buffers",
                bytes: tangent_bytes,
            },
        ),
        (needs.shear, LeftOut { feature: "shear", what: "the inverse transpose in `orient`", bytes: 0 }),
    ];
    all.into_iter().filter(|(needed, _)| !needed).map(|(_, part)| part).collect()
}

/// Blocks that cover so many vertices or corners.
fn blocks(items: usize) -> u32 {
    items.div_ceil(BLOCK as usize) as u32
}

impl Plan {
    /// Bytes of a buffer; 0 when the scene does not have it.
    pub fn bytes(&self, role: Role) -> u64 {
        self.buffers.iter().filter(|buffer| buffer.role == role).map(|buffer| buffer.bytes).sum()
    }

    /// Bytes of all buffers, outputs included.
    pub fn total_bytes(&self) -> u64 {
        self.buffers.iter().map(|buffer| buffer.bytes).sum()
    }

    /// Kernel launches of one step, whatever the number of domains.
    pub const fn launches(&self) -> usize {
        self.kernels.len()
    }
}

#[cfg(test)]
mod tests {
    use super::super::pack::tests::scene;
    use super::*;

    fn defines(plan: &Plan) -> Vec<(&str, Vec<&str>)> {
        plan.kernels.iter().map(|kernel| (kernel.name, kernel.defines.clone())).collect()
    }

    #[test]
    fn a_scene_without_modes_normal_maps_and_shear_compiles_none_of_their_branches() {
        let bare = plan(&scene(&[(7, 0), (300, 0)], false, true));
        assert_eq!(defines(&bare), [("deform", vec![]), ("orient", vec![])]);
        assert_eq!(bare.bytes(Role::Tangents) + bare.bytes(Role::RestTangents), 0);
        assert_eq!(bare.bytes_in, 48 * 4, "four transforms, no q");
        let left_out: Vec<_> = bare.left_out.iter().map(|part| part.feature).collect();
        assert_eq!(left_out, ["modes", "normal_maps", "shear"]);
        assert_eq!(bare.left_out[1].bytes, 16 * (311 + 622), "rest and world tangents of every corner");
    }

    #[test]
    fn a_scene_that_needs_everything_leaves_nothing_out() {
        let full = plan(&scene(&[(7, 2), (300, 0)], true, false));
        assert_eq!(defines(&full), [("deform", vec!["MODES"]), ("orient", vec!["NORMAL_MAPS", "SHEAR"])]);
        assert_eq!(full.bytes(Role::Tangents), 16 * 2 * (9 + 302));
        assert_eq!(full.bytes(Role::RestTangents), 16 * 302, "only the shape with a normal map");
        assert_eq!(full.bytes_in, 48 * 4 + 4 * 4);
        assert!(full.left_out.is_empty());
    }

    #[test]
    fn launches_do_not_grow_with_the_number_of_domains() {
        let (few, many) = (scene(&[(7, 1)], false, false), scene(&[(7, 1); 3000], false, false));
        assert_eq!((plan(&few).launches(), plan(&many).launches()), (2, 2));
        assert_eq!(plan(&many).kernels[0].blocks, (2 * 3000 * 7_u32).div_ceil(BLOCK));
    }

    #[test]
    fn planned_bytes_are_those_of_the_tables() {
        let scene = scene(&[(7, 2), (300, 0), (513, 4)], true, false);
        let plan = plan(&scene);
        let slots = pack::vertex_slots(&scene);
        let blocks = pack::first_domains(slots.iter().map(|slot| slot.first), scene.layout.vertices);
        let corner_slots = pack::corner_slots(&scene);
        let corner_blocks = pack::first_domains(corner_slots.iter().map(|slot| slot.first), scene.layout.corners);
        for (role, bytes) in [
            (Role::VertexSlots, size_of_val(slots.as_slice())),
            (Role::VertexBlocks, size_of_val(blocks.as_slice())),
            (Role::CornerSlots, size_of_val(corner_slots.as_slice())),
            (Role::CornerBlocks, size_of_val(corner_blocks.as_slice())),
            (Role::RestNormals, size_of_val(pack::rest_normals(&scene).as_slice())),
            (Role::RestTangents, size_of_val(pack::rest_tangents(&scene).as_slice())),
        ] {
            assert_eq!(plan.bytes(role), bytes as u64, "{role:?}");
        }
        assert_eq!(plan.total_bytes(), plan.buffers.iter().map(|buffer| buffer.bytes).sum::<u64>());
    }
}
