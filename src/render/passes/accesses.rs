//! Resources that each pass reads and writes, and the memory barriers that follow from them.
//!
//! OpenGL orders all accesses, except shader writes to images and storage buffers. Each pass issues a barrier before
//! its first command ([`barrier_before`]), and a barrier between two of its commands if the second uses outputs of the
//! first ([`barrier_within`]).

use std::sync::LazyLock;

use crate::device::gl::MemoryBarriers;
use crate::pass::Pass;

/// A buffer or an image of a scene or of a render target. Consecutive frames share them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Resource {
    ShadowDepth,
    /// Shadow depth in a buffer, from the compute rasterizer.
    RasterShadowDepth,
    /// Copy of `RasterShadowDepth` in an image.
    ShadowDepthCopy,
    /// Moments of the shadow depth, blurred in x only.
    HorizontalMoments,
    ShadowMoments,
    /// Indirect draw commands of the lists of visible triangles.
    CullDraws,
    /// Bitmap of the triangles that passed the culling tests.
    CullVisibleBits,
    CullCounters,
    /// Bitmap of the triangles that were visible in the last frame.
    PreviouslyVisible,
    VisibleTriangleIds,
    VisibleIndices,
    DepthPyramid,
    /// Triangle and depth of each pixel, from the compute rasterizer.
    RasterKeys,
    /// Id of each sample.
    Ids,
    /// Depth of each sample.
    Depth,
    /// Depth and normal of each texel of the ambient occlusion.
    AmbientSurface,
    /// Ambient visibility of each texel, before the noise is removed.
    NoisyVisibility,
    AmbientVisibility,
    /// Blended light of two-pass transparency.
    BlendLayer,
    /// Number of blended fragments of each pixel.
    OitCounts,
    /// Index of the next fragment record of each pixel.
    OitCursors,
    /// Fragments of all lists, one record each.
    OitRecords,
    OitCounters,
    /// Tiles with blended fragments.
    OitTileList,
    /// Blended light of exact transparency.
    OitLayers,
    /// Tiles with visible triangles.
    ShadeTileList,
    SceneColor,
    BloomMips,
    /// Data to copy to the staging buffer: pixels, ids or AOV fields.
    ReadbackSource,
}

/// How a pass uses a resource.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Access {
    /// Texture lookup, also of buffer textures.
    Sampled,
    ImageRead,
    /// Image stores or atomics, and possibly loads.
    ImageWrite,
    StorageRead,
    /// Stores or atomics to a storage buffer, and possibly loads.
    StorageWrite,
    /// Arguments of an indirect draw or dispatch.
    Indirect,
    /// Index buffer of a draw.
    Index,
    /// Draws, depth tests and clears of a framebuffer.
    Attachment,
    /// Writes and copies by API calls.
    Transfer,
    /// Accesses of the compute rasterizer, ordered by the CUDA interoperability calls.
    External,
}

impl Access {
    /// Whether the access is a shader write, which OpenGL orders only at barriers.
    const fn is_shader_write(self) -> bool {
        matches!(self, Self::ImageWrite | Self::StorageWrite)
    }

    /// Barrier that makes earlier shader writes visible to this access.
    const fn barrier(self) -> MemoryBarriers {
        match self {
            Self::Sampled => MemoryBarriers::TEXTURE_FETCH,
            Self::ImageRead | Self::ImageWrite => MemoryBarriers::SHADER_IMAGE,
            Self::StorageRead | Self::StorageWrite => MemoryBarriers::SHADER_STORAGE,
            Self::Indirect => MemoryBarriers::COMMAND,
            Self::Index => MemoryBarriers::ELEMENT_ARRAY,
            Self::Attachment => MemoryBarriers::FRAMEBUFFER,
            Self::Transfer => MemoryBarriers::BUFFER_UPDATE,
            Self::External => MemoryBarriers::NONE,
        }
    }
}

type Accesses = &'static [(Resource, Access)];

/// Draws from the lists of visible triangles.
const VISIBLE_LISTS: Accesses = &[
    (Resource::CullDraws, Access::Indirect),
    (Resource::VisibleIndices, Access::Index),
    (Resource::VisibleTriangleIds, Access::Sampled),
];

/// Reset of the lists of visible triangles, culling tests and compaction of the lists.
const LIST_TRIANGLES: Accesses = &[
    (Resource::CullDraws, Access::Transfer),
    (Resource::CullDraws, Access::StorageWrite),
    (Resource::CullVisibleBits, Access::StorageWrite),
    (Resource::CullCounters, Access::StorageWrite),
    (Resource::VisibleTriangleIds, Access::StorageWrite),
    (Resource::VisibleIndices, Access::StorageWrite),
];

/// Lookups of the shadow map.
const SHADOW_LOOKUP: Accesses = &[
    (Resource::ShadowDepth, Access::Sampled),
    (Resource::ShadowDepthCopy, Access::Sampled),
    (Resource::ShadowMoments, Access::Sampled),
];

/// Inputs of the shading, and its outputs.
const SHADING: Accesses = &[
    (Resource::Ids, Access::Sampled),
    (Resource::Depth, Access::Sampled),
    (Resource::AmbientVisibility, Access::Sampled),
    (Resource::BlendLayer, Access::Sampled),
    (Resource::OitLayers, Access::Sampled),
    (Resource::OitCounts, Access::Sampled),
    (Resource::SceneColor, Access::ImageWrite),
    (Resource::BloomMips, Access::ImageWrite),
];

/// Ids and depth that a pass draws.
const DRAW_IDS: Accesses = &[(Resource::Ids, Access::Attachment), (Resource::Depth, Access::Attachment)];

/// Conversion of ids to words, and copy of the words to a staging buffer.
const READ_IDS: Accesses = &[
    (Resource::Ids, Access::Sampled),
    (Resource::Depth, Access::Sampled),
    (Resource::ReadbackSource, Access::StorageWrite),
    (Resource::ReadbackSource, Access::Transfer),
];

/// Accesses of each pass, in the order of [`Pass::ALL`]. Resources that no shader ever writes need no entry.
const PASS_ACCESSES: [(Pass, &[Accesses]); Pass::ALL.len()] = [
    (Pass::UniformUpload, &[&[(Resource::CullCounters, Access::Transfer)]]),
    (
        // This pass also draws the visibility if the compute rasterizer draws both.
        Pass::RasterShadow,
        &[&[(Resource::RasterShadowDepth, Access::External), (Resource::RasterKeys, Access::External)]],
    ),
    (Pass::RasterVisibility, &[&[(Resource::RasterKeys, Access::External)]]),
    (Pass::ShadowCull, &[LIST_TRIANGLES]),
    (Pass::Shadow, &[VISIBLE_LISTS, &[(Resource::ShadowDepth, Access::Attachment)]]),
    (
        Pass::Blur,
        &[&[
            (Resource::ShadowDepth, Access::Sampled),
            (Resource::RasterShadowDepth, Access::StorageRead),
            (Resource::ShadowDepthCopy, Access::ImageWrite),
            (Resource::HorizontalMoments, Access::ImageWrite),
            (Resource::HorizontalMoments, Access::Sampled),
            (Resource::HorizontalMoments, Access::Attachment),
            (Resource::ShadowMoments, Access::ImageWrite),
            (Resource::ShadowMoments, Access::Attachment),
        ]],
    ),
    (
        Pass::Occluders,
        &[
            LIST_TRIANGLES,
            VISIBLE_LISTS,
            &[
                (Resource::PreviouslyVisible, Access::StorageWrite),
                (Resource::Depth, Access::Attachment),
                (Resource::Depth, Access::Sampled),
                (Resource::DepthPyramid, Access::StorageWrite),
            ],
        ],
    ),
    (
        Pass::Cull,
        &[
            LIST_TRIANGLES,
            &[(Resource::PreviouslyVisible, Access::StorageWrite), (Resource::DepthPyramid, Access::StorageRead)],
        ],
    ),
    (Pass::Visibility, &[VISIBLE_LISTS, DRAW_IDS]),
    (
        Pass::RecordVisible,
        &[&[
            (Resource::Ids, Access::Sampled),
            (Resource::Depth, Access::Sampled),
            (Resource::PreviouslyVisible, Access::StorageWrite),
        ]],
    ),
    (Pass::Unpack, &[&[(Resource::RasterKeys, Access::StorageRead), (Resource::Ids, Access::ImageWrite)]]),
    (
        Pass::AmbientOcclusion,
        &[&[
            (Resource::Ids, Access::Sampled),
            (Resource::Depth, Access::Sampled),
            (Resource::AmbientSurface, Access::ImageWrite),
            (Resource::AmbientSurface, Access::Sampled),
            (Resource::NoisyVisibility, Access::ImageWrite),
            (Resource::NoisyVisibility, Access::Sampled),
            (Resource::AmbientVisibility, Access::ImageWrite),
        ]],
    ),
    (
        Pass::Blended,
        &[
            VISIBLE_LISTS,
            SHADOW_LOOKUP,
            &[(Resource::Depth, Access::Attachment), (Resource::BlendLayer, Access::Attachment)],
        ],
    ),
    (
        Pass::OitCount,
        &[
            VISIBLE_LISTS,
            &[
                (Resource::CullDraws, Access::Transfer),
                (Resource::OitCounters, Access::Transfer),
                (Resource::OitCounts, Access::Attachment),
                (Resource::Depth, Access::Attachment),
                (Resource::OitCounts, Access::ImageWrite),
            ],
        ],
    ),
    (
        Pass::OitAllocate,
        &[&[
            (Resource::OitCounts, Access::ImageRead),
            (Resource::OitCounters, Access::StorageWrite),
            (Resource::OitRecords, Access::StorageWrite),
            (Resource::OitCursors, Access::ImageWrite),
            (Resource::OitTileList, Access::Transfer),
            (Resource::OitTileList, Access::StorageWrite),
        ]],
    ),
    (
        Pass::OitFill,
        &[
            VISIBLE_LISTS,
            &[
                (Resource::Depth, Access::Attachment),
                (Resource::OitCounts, Access::ImageRead),
                (Resource::OitCounters, Access::StorageRead),
                // A part of a group sets the range of its indirect draw.
                (Resource::OitCounters, Access::Transfer),
                (Resource::OitCounters, Access::Indirect),
                (Resource::OitRecords, Access::StorageWrite),
                (Resource::OitCursors, Access::ImageWrite),
            ],
        ],
    ),
    (
        Pass::OitResolve,
        &[
            SHADOW_LOOKUP,
            &[
                (Resource::OitTileList, Access::Indirect),
                (Resource::OitTileList, Access::StorageRead),
                (Resource::OitCounts, Access::ImageRead),
                (Resource::OitCursors, Access::ImageRead),
                (Resource::OitCounters, Access::StorageRead),
                (Resource::OitRecords, Access::StorageWrite),
                (Resource::OitLayers, Access::ImageWrite),
            ],
        ],
    ),
    (
        Pass::Background,
        &[
            SHADOW_LOOKUP,
            SHADING,
            &[(Resource::ShadeTileList, Access::Transfer), (Resource::ShadeTileList, Access::StorageWrite)],
        ],
    ),
    (
        Pass::Shade,
        &[
            SHADOW_LOOKUP,
            SHADING,
            &[(Resource::ShadeTileList, Access::Indirect), (Resource::ShadeTileList, Access::StorageRead)],
        ],
    ),
    (
        Pass::Bloom,
        &[&[
            (Resource::BloomMips, Access::Sampled),
            (Resource::BloomMips, Access::ImageWrite),
            (Resource::SceneColor, Access::ImageWrite),
        ]],
    ),
    (Pass::Encode, &[&[(Resource::SceneColor, Access::Sampled), (Resource::ReadbackSource, Access::StorageWrite)]]),
    (
        Pass::Read,
        &[&[
            (Resource::ReadbackSource, Access::Transfer),
            (Resource::OitCounters, Access::Transfer),
            (Resource::CullCounters, Access::Transfer),
        ]],
    ),
    (Pass::VisibilityReadback, &[READ_IDS]),
    (Pass::Pick, &[DRAW_IDS, READ_IDS]),
    (Pass::Aov, &[DRAW_IDS, READ_IDS]),
];

fn accesses_of(pass: Pass) -> impl Iterator<Item = (Resource, Access)> {
    PASS_ACCESSES[pass as usize].1.iter().flat_map(|group| group.iter().copied())
}

fn is_written_by_shaders(pass: Pass, resource: Resource) -> bool {
    accesses_of(pass).any(|(accessed, access)| accessed == resource && access.is_shader_write())
}

/// Barrier for these accesses.
fn barrier_of(accesses: impl Iterator<Item = Access>) -> MemoryBarriers {
    accesses.fold(MemoryBarriers::NONE, |kinds, access| kinds | access.barrier())
}

fn compute_barrier_before(pass: Pass) -> MemoryBarriers {
    let is_written = |resource| Pass::ALL.into_iter().any(|pass| is_written_by_shaders(pass, resource));
    barrier_of(accesses_of(pass).filter(|(resource, _)| is_written(*resource)).map(|(_, access)| access))
}

fn compute_barrier_within(pass: Pass) -> MemoryBarriers {
    let accesses = accesses_of(pass).filter(|(resource, _)| is_written_by_shaders(pass, *resource));
    barrier_of(accesses.map(|(_, access)| access))
}

/// Barrier before the first command of a pass. It covers all resources that shaders write in any pass, including the
/// same pass of an earlier frame.
pub(super) fn barrier_before(pass: Pass) -> MemoryBarriers {
    static BARRIERS: LazyLock<[MemoryBarriers; Pass::ALL.len()]> =
        LazyLock::new(|| Pass::ALL.map(compute_barrier_before));
    BARRIERS[pass as usize]
}

/// Barrier between commands of a pass. It covers the resources that shaders of this pass write.
pub(super) fn barrier_within(pass: Pass) -> MemoryBarriers {
    static BARRIERS: LazyLock<[MemoryBarriers; Pass::ALL.len()]> =
        LazyLock::new(|| Pass::ALL.map(compute_barrier_within));
    BARRIERS[pass as usize]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn accesses_are_in_the_order_of_the_passes() {
        assert_eq!(PASS_ACCESSES.map(|(pass, _)| pass), Pass::ALL);
    }

    #[test]
    fn barriers_cover_all_readers_of_shader_writes() {
        let covers = |barriers: MemoryBarriers, barrier: MemoryBarriers| barriers | barrier == barriers;
        let mut pairs = 0;
        for writer in Pass::ALL {
            for reader in Pass::ALL {
                for (resource, access) in accesses_of(reader) {
                    if is_written_by_shaders(writer, resource) {
                        pairs += 1;
                        assert!(covers(barrier_before(reader), access.barrier()), "{writer} to {reader}: {resource:?}");
                    }
                }
            }
        }
        // The loops above must not be empty.
        assert!(pairs > 100, "expected more than 100 pairs of a writer and a reader, got {pairs}");
    }

    #[test]
    fn shader_writes_wait_for_earlier_accesses() {
        // A store waits for earlier accesses only after a barrier of its own kind.
        for pass in Pass::ALL {
            for (resource, access) in accesses_of(pass).filter(|(_, access)| access.is_shader_write()) {
                assert_eq!(barrier_before(pass) | access.barrier(), barrier_before(pass), "{pass}: {resource:?}");
            }
        }
    }

    #[test]
    fn barriers_contain_only_kinds_that_the_pass_uses() {
        use MemoryBarriers as Kinds;
        assert_eq!(barrier_before(Pass::UniformUpload), Kinds::BUFFER_UPDATE);
        assert_eq!(barrier_before(Pass::RasterShadow), Kinds::NONE);
        let lists = Kinds::COMMAND | Kinds::ELEMENT_ARRAY | Kinds::TEXTURE_FETCH;
        assert_eq!(barrier_before(Pass::Shadow), lists);
        assert_eq!(barrier_before(Pass::Visibility), lists | Kinds::FRAMEBUFFER);
        assert_eq!(barrier_before(Pass::Encode), Kinds::TEXTURE_FETCH | Kinds::SHADER_STORAGE);
        assert_eq!(barrier_before(Pass::Read), Kinds::BUFFER_UPDATE);
        assert_eq!(barrier_within(Pass::Visibility), Kinds::NONE);
        let allocation = Kinds::SHADER_STORAGE | Kinds::SHADER_IMAGE | Kinds::BUFFER_UPDATE;
        assert_eq!(barrier_within(Pass::OitAllocate), allocation);
        assert_eq!(barrier_within(Pass::Bloom), Kinds::TEXTURE_FETCH | Kinds::SHADER_IMAGE);
        assert_eq!(barrier_within(Pass::Pick), Kinds::SHADER_STORAGE | Kinds::BUFFER_UPDATE);
    }
}
