//! The plan of a scene on the device: kernels with their macros, buffers in bytes, launches and copies. The
//! module `work` describes tiles, quads and batches.

use serde::Serialize;

use super::box_segments::box_bytes;
use super::change_list::{ChangeListLayout, max_change_entries};
use super::device_tables::{CudaDeformerOptions, DeviceTables, NormalTables};
use super::kernels::plan_kernels;
use super::layout::NormalSlot;
use super::normal_tables;
use super::rings::possible_corner_group_bytes;
use super::work::batches::BatchTables;
use crate::gpu::launch::{KernelDescriptor, KernelKind};
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::Scene;

/// Content of a device buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum BufferRole {
    /// U of every shape, in packed words of 16 bytes.
    ModeWords,
    /// x0 of every shape.
    RestPositions,
    /// Scales of U; only with `Int8`.
    Scales,
    /// The work of each warp, and the tile list of partial steps if the scene can have them.
    WarpTiles,
    /// The quads of tiles that several domains share; with `Int8` also the index of each quad's first scale.
    MixedQuads,
    /// Per domain, offset from its first vertex to its first corner; only if an offset differs from zero.
    CornerOffsets,
    /// Groups of domains that share U, and the work of each block of `batch`.
    Batches,
    /// Four bounding boxes per tile.
    WarpBoxes,
    /// The step that last changed each domain.
    ChangeSteps,
    /// Transform root of each domain, and the frames of followers.
    FollowerFrames,
    RestNormals,
    RestTangents,
    /// The smoothing group of each corner; only if normals follow the surface.
    CornerGroups,
    /// The ring of vertices around each smoothing group, and the offset of each ring.
    RingTables,
    /// The geometric normal of each smoothing group at rest.
    GroupNormals,
    /// Offsets of each domain in the tables of `normals`.
    CornerSlots,
    /// Per block of `normals`, the domain of its first corner.
    CornerBlocks,
    /// Header, transforms and q of a step.
    Inputs,
    Positions,
    Normals,
    Tangents,
    /// u; only in scenes with the feature `displacements`.
    Displacements,
    /// The segments of domains that `bounds` reduces to boxes; only in scenes with the feature `boxes`.
    BoxSegments,
    /// The boxes of these segments.
    DomainBoxes,
}

/// One device buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct BufferDescriptor {
    pub role: BufferRole,
    pub bytes: u64,
}

/// An optional feature that the scene does not use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct OmittedFeature {
    /// The flag of [`modalcast_model::scene::SceneFeatures`] that is off, or "batches" or "shadows".
    pub feature: &'static str,
    /// Code and data that are not compiled, computed or stored.
    pub what: &'static str,
    /// Device bytes saved. They do not include the rings of the kernel `normals` (the vertices around each vertex),
    /// whose length is unknown until they are built.
    pub bytes: u64,
}

/// The kernels, buffers and copies of the CUDA deformer for a scene.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct DeformPlan {
    /// The kernels of the scene in launch order, except `apply`, which is last here and first in a partial step.
    pub kernels: Vec<KernelDescriptor>,
    pub buffers: Vec<BufferDescriptor>,
    /// Bytes that a full step copies to the device.
    pub bytes_in: u64,
    /// Bytes that each step copies back, without the vertices: the box of the scene, and with bounding axes a second
    /// box along them. A box has six keys of four bytes.
    pub bytes_out: u64,
    /// Bytes of pinned host memory for the lists of a partial step; 0 for a scene whose steps are always full.
    pub change_list_bytes: u64,
    pub omitted: Vec<OmittedFeature>,
}

/// The plan of a scene, for a deformer with these options.
pub fn plan(scene: &Scene, options: CudaDeformerOptions) -> DeformPlan {
    plan_from_tables(scene, &DeviceTables::new(scene, options))
}

/// The plan of a scene from existing tables.
pub fn plan_from_tables(scene: &Scene, tables: &DeviceTables) -> DeformPlan {
    let change_list_bytes = match max_change_entries(scene) {
        0 => 0,
        max_changes => ChangeListLayout::new(max_changes, tables.coordinates.total, tables.work.tiles.len()).bytes(),
    };
    DeformPlan {
        kernels: plan_kernels(scene, tables),
        buffers: plan_buffers(scene, tables),
        bytes_in: tables.inputs.total(),
        bytes_out: if tables.bounding_axes.is_some() { 48 } else { 24 },
        change_list_bytes,
        omitted: list_omitted_features(scene, tables),
    }
}

fn bytes_of<T>(table: &[T]) -> u64 {
    size_of_val(table) as u64
}

/// The buffers of a scene with the bytes of their tables.
fn plan_buffers(scene: &Scene, tables: &DeviceTables) -> Vec<BufferDescriptor> {
    let (features, layout, work) = (scene.features, &scene.layout, &tables.work);
    let normals = tables.normals.as_ref();
    let (vertices, corners) = (layout.vertices as u64, layout.corners as u64);
    let mut buffers = vec![
        (BufferRole::ModeWords, 16 * work.word_count),
        (BufferRole::RestPositions, bytes_of(&tables.rest_positions)),
        (BufferRole::Scales, 4 * work.scale_count),
        (BufferRole::WarpTiles, bytes_of(&work.tiles) + 4 * tables.tile_list_capacity as u64),
        (BufferRole::MixedQuads, bytes_of(&work.mixed_quads) + bytes_of(&work.mixed_quad_scales)),
        (BufferRole::CornerOffsets, bytes_of(&work.corner_offsets)),
        (BufferRole::WarpBoxes, work.box_bytes()),
        (BufferRole::ChangeSteps, 4 * scene.domains.len() as u64),
        (
            BufferRole::RestNormals,
            normals.map_or(bytes_of(&tables.rest_normals), |normals| bytes_of(&normals.rest_normals)),
        ),
        (BufferRole::Inputs, tables.inputs.total()),
        (BufferRole::Positions, 12 * vertices),
        (BufferRole::Normals, 12 * corners),
    ];
    if features.normal_maps {
        let bytes = normals.map_or(bytes_of(&tables.rest_tangents), |normals| bytes_of(&normals.rest_tangents));
        buffers.push((BufferRole::RestTangents, bytes));
        buffers.push((BufferRole::Tangents, 16 * corners));
    }
    if features.displacements {
        buffers.push((BufferRole::Displacements, 12 * vertices));
    }
    if !work.batched.blocks.is_empty() {
        let BatchTables { groups, members, blocks, .. } = &work.batched;
        buffers.push((BufferRole::Batches, bytes_of(groups) + bytes_of(members) + bytes_of(blocks)));
    }
    if features.boxes {
        let boxes = (BufferRole::DomainBoxes, box_bytes(tables.segments.len()));
        buffers.extend([(BufferRole::BoxSegments, bytes_of(&tables.segments)), boxes]);
    }
    if let Some(NormalTables { slots, first_domains, rings, .. }) = normals {
        buffers.push((BufferRole::CornerSlots, bytes_of(slots)));
        buffers.push((BufferRole::CornerBlocks, bytes_of(first_domains)));
        buffers.push((BufferRole::CornerGroups, bytes_of(&rings.corner_groups)));
        buffers.push((BufferRole::RingTables, bytes_of(&rings.ring_offsets) + bytes_of(&rings.rings)));
        buffers.push((BufferRole::GroupNormals, bytes_of(&rings.group_normals)));
    }
    if features.followers {
        let frames = bytes_of(scene.transform_roots.follower_frames()) + bytes_of(&tables.transform_links);
        buffers.push((BufferRole::FollowerFrames, frames));
    }
    buffers.into_iter().map(|(role, bytes)| BufferDescriptor { role, bytes }).collect()
}

/// The optional features that the scene does not use.
fn list_omitted_features(scene: &Scene, tables: &DeviceTables) -> Vec<OmittedFeature> {
    let (features, layout) = (scene.features, &scene.layout);
    let is_batched = !tables.work.batched.blocks.is_empty();
    let slot_bytes = (size_of::<NormalSlot>() * scene.domains.len()) as u64;
    let tangent_bytes = 16 * (normal_tables::rest_corner_count(scene) + layout.corners) as u64;
    let segment_bytes = bytes_of(&tables.segments) + box_bytes(tables.segments.len());
    let feature = |feature, what, bytes| OmittedFeature { feature, what, bytes };
    let features = [
        (features.modes, feature("modes", "the sum U q in `deform`", 0)),
        (features.normal_maps, feature("normal_maps", "tangents and their two buffers", tangent_bytes)),
        (features.shear, feature("shear", "the inverse transpose", 0)),
        (
            features.exact_normals,
            feature(
                "exact_normals",
                "`normals` after `deform`, and its rings",
                possible_corner_group_bytes(scene) + slot_bytes,
            ),
        ),
        (features.compensated, feature("compensated", "the compensation in `deform`", 0)),
        (features.followers, feature("followers", "frames, and products of transforms", 0)),
        (features.displacements, feature("displacements", "u as an output of `deform`", 12 * layout.vertices as u64)),
        (tables.bounding_axes.is_some(), feature("shadows", "bounds in light space", 0)),
        (features.boxes, feature("boxes", "a box of each domain in `bounds`", segment_bytes)),
        (is_batched, feature("batches", "`batch`, and groups of domains", 0)),
    ];
    features.into_iter().filter(|(is_used, _)| !is_used).map(|(_, feature)| feature).collect()
}

impl DeformPlan {
    /// Bytes of a buffer; 0 when the scene does not have it.
    pub fn bytes(&self, role: BufferRole) -> u64 {
        self.buffers.iter().filter(|buffer| buffer.role == role).map(|buffer| buffer.bytes).sum()
    }

    /// Bytes of all buffers, outputs included.
    pub fn total_bytes(&self) -> u64 {
        self.buffers.iter().map(|buffer| buffer.bytes).sum()
    }

    /// The kernel of this kind, if the scene has it.
    pub fn kernel(&self, kind: KernelKind) -> Option<&KernelDescriptor> {
        self.kernels.iter().find(|kernel| kernel.kind == kind)
    }

    /// The kernel of a kind that every scene has; `Fault` if it is missing.
    pub fn require_kernel(&self, kind: KernelKind) -> Result<&KernelDescriptor> {
        let missing = || Error::Fault { stage: "plan", reason: format!("no kernel for {kind:?}") };
        self.kernel(kind).ok_or_else(missing)
    }

    /// Maximum number of kernel launches of one step, for any number of domains.
    pub fn launches(&self) -> usize {
        // A full step may launch `batch` but not `apply`; a partial step may launch `apply` but not `batch`.
        let count_except = |omitted: KernelKind| self.kernels.iter().filter(|kernel| kernel.kind != omitted).count();
        let (full_step, partial_step) = (count_except(KernelKind::Apply), count_except(KernelKind::Batch));
        if self.kernel(KernelKind::Apply).is_some() { full_step.max(partial_step) } else { full_step }
    }
}

#[cfg(test)]
mod tests;
