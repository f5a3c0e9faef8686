//! The buffers of a scene by purpose. The type parameter `T` is a size in bytes in a plan, and a buffer in a loaded
//! scene.
//!
//! A corner is a vertex with one normal and one pair of texture coordinates. Several corners can share a vertex.

use std::fmt;

use modalcast_model::error::Result;

/// A buffer of a scene. Plans list the buffers in the order of the variants.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum BufferName {
    Positions,
    Normals,
    Triangles,
    TriangleVertices,
    Materials,
    FrameUniforms,
    CornerVertices,
    Tangents,
    Uvs,
    TriangleMaterials,
    ShadowCascades,
    CullUniforms,
    CullDraws,
    CullCounters,
    CullVisibleBits,
    VisibleTriangleIds,
    VisibleIndices,
    PreviouslyVisible,
}

/// Buffers of vertices, corners and triangles.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct GeometryBuffers<T> {
    /// 3 f32 per vertex, deformed.
    pub(crate) positions: T,
    /// 3 f32 per corner, deformed.
    pub(crate) normals: T,
    /// 4 f32 per corner (tangent and sign of the bitangent), deformed; only with normal maps.
    pub(crate) tangents: Option<T>,
    /// 2 f32 per corner; only with textures or normal maps.
    pub(crate) uvs: Option<T>,
    /// Three corner indices per triangle; they select normals, tangents and texture coordinates.
    pub(crate) triangles: T,
    /// Three vertex indices per triangle; they select positions.
    pub(crate) triangle_vertices: T,
    /// Vertex index of each corner; only with cut-out or blended triangles.
    pub(crate) corner_vertices: Option<T>,
}

/// Buffers of materials.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct MaterialBuffers<T> {
    /// The materials that triangles use, one record each.
    pub(crate) materials: T,
    /// Index of the material of each triangle; only with several materials.
    pub(crate) triangle_materials: Option<T>,
}

/// Uniform blocks that change with every frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct UniformBuffers<T> {
    pub(crate) frame: T,
    /// Only when the shadow map is split.
    pub(crate) cascades: Option<T>,
}

/// Input and output of triangle culling. `crate::layout::cull` defines groups and superblocks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct CullBuffers<T> {
    pub(crate) uniforms: T,
    /// Indirect draws of the groups, then the number of visible triangles per superblock.
    pub(crate) draws: T,
    /// Results of the culling tests, for statistics.
    pub(crate) counters: T,
    /// One bit per triangle: whether it passed the culling tests.
    pub(crate) visible_bits: T,
    /// Ids of the visible triangles.
    pub(crate) triangle_ids: T,
    /// Three indices per visible triangle.
    pub(crate) indices: T,
    /// One bit per triangle that was visible in the last frame; only with occlusion culling.
    pub(crate) previously_visible: Option<T>,
}

/// All buffers of a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct SceneBufferSet<T> {
    pub(crate) geometry: GeometryBuffers<T>,
    pub(crate) materials: MaterialBuffers<T>,
    pub(crate) uniforms: UniformBuffers<T>,
    /// Only when triangles are culled.
    pub(crate) culling: Option<CullBuffers<T>>,
}

impl BufferName {
    /// Name in plans.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Positions => "positions",
            Self::Normals => "normals",
            Self::Triangles => "triangles",
            Self::TriangleVertices => "triangle vertices",
            Self::Materials => "materials",
            Self::FrameUniforms => "frame uniforms",
            Self::CornerVertices => "corner vertices",
            Self::Tangents => "tangents",
            Self::Uvs => "uvs",
            Self::TriangleMaterials => "triangle materials",
            Self::ShadowCascades => "shadow cascades",
            Self::CullUniforms => "cull uniforms",
            Self::CullDraws => "cull draws",
            Self::CullCounters => "cull counters",
            Self::CullVisibleBits => "cull visible bits",
            Self::VisibleTriangleIds => "visible triangle ids",
            Self::VisibleIndices => "visible indices",
            Self::PreviouslyVisible => "cull previously visible",
        }
    }
}

impl fmt::Display for BufferName {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(self.name())
    }
}

impl<T> CullBuffers<T> {
    /// The buffers with their names, in the order of plans.
    pub(crate) fn named(&self) -> impl Iterator<Item = (BufferName, &T)> {
        let required_buffers = [
            (BufferName::CullUniforms, &self.uniforms),
            (BufferName::CullDraws, &self.draws),
            (BufferName::CullCounters, &self.counters),
            (BufferName::CullVisibleBits, &self.visible_bits),
            (BufferName::VisibleTriangleIds, &self.triangle_ids),
            (BufferName::VisibleIndices, &self.indices),
        ];
        let optional_buffer = self.previously_visible.as_ref().map(|buffer| (BufferName::PreviouslyVisible, buffer));
        required_buffers.into_iter().chain(optional_buffer)
    }
}

impl<T> SceneBufferSet<T> {
    /// The buffers with their names, in the order of plans.
    pub(crate) fn named(&self) -> impl Iterator<Item = (BufferName, &T)> {
        let Self { geometry, materials, uniforms, culling } = self;
        let buffers = [
            (BufferName::Positions, Some(&geometry.positions)),
            (BufferName::Normals, Some(&geometry.normals)),
            (BufferName::Triangles, Some(&geometry.triangles)),
            (BufferName::TriangleVertices, Some(&geometry.triangle_vertices)),
            (BufferName::Materials, Some(&materials.materials)),
            (BufferName::FrameUniforms, Some(&uniforms.frame)),
            (BufferName::CornerVertices, geometry.corner_vertices.as_ref()),
            (BufferName::Tangents, geometry.tangents.as_ref()),
            (BufferName::Uvs, geometry.uvs.as_ref()),
            (BufferName::TriangleMaterials, materials.triangle_materials.as_ref()),
            (BufferName::ShadowCascades, uniforms.cascades.as_ref()),
        ];
        let buffers = buffers.into_iter().filter_map(|(name, buffer)| Some((name, buffer?)));
        buffers.chain(culling.iter().flat_map(CullBuffers::named))
    }

    /// Converts each buffer, for example its size to an allocated buffer.
    ///
    /// # Errors
    /// The first error of `convert`.
    pub(crate) fn try_map<U>(&self, mut convert: impl FnMut(BufferName, &T) -> Result<U>) -> Result<SceneBufferSet<U>> {
        let mut convert_buffer = |name, buffer: &T| convert(name, buffer);
        let Self { geometry, materials, uniforms, culling } = self;
        let geometry = GeometryBuffers {
            positions: convert_buffer(BufferName::Positions, &geometry.positions)?,
            normals: convert_buffer(BufferName::Normals, &geometry.normals)?,
            tangents: geometry
                .tangents
                .as_ref()
                .map(|buffer| convert_buffer(BufferName::Tangents, buffer))
                .transpose()?,
            uvs: geometry.uvs.as_ref().map(|buffer| convert_buffer(BufferName::Uvs, buffer)).transpose()?,
            triangles: convert_buffer(BufferName::Triangles, &geometry.triangles)?,
            triangle_vertices: convert_buffer(BufferName::TriangleVertices, &geometry.triangle_vertices)?,
            corner_vertices: geometry
                .corner_vertices
                .as_ref()
                .map(|buffer| convert_buffer(BufferName::CornerVertices, buffer))
                .transpose()?,
        };
        let materials = MaterialBuffers {
            materials: convert_buffer(BufferName::Materials, &materials.materials)?,
            triangle_materials: materials
                .triangle_materials
                .as_ref()
                .map(|buffer| convert_buffer(BufferName::TriangleMaterials, buffer))
                .transpose()?,
        };
        let uniforms = UniformBuffers {
            frame: convert_buffer(BufferName::FrameUniforms, &uniforms.frame)?,
            cascades: uniforms
                .cascades
                .as_ref()
                .map(|buffer| convert_buffer(BufferName::ShadowCascades, buffer))
                .transpose()?,
        };
        let culling = match culling {
            Some(culling) => Some(CullBuffers {
                uniforms: convert_buffer(BufferName::CullUniforms, &culling.uniforms)?,
                draws: convert_buffer(BufferName::CullDraws, &culling.draws)?,
                counters: convert_buffer(BufferName::CullCounters, &culling.counters)?,
                visible_bits: convert_buffer(BufferName::CullVisibleBits, &culling.visible_bits)?,
                triangle_ids: convert_buffer(BufferName::VisibleTriangleIds, &culling.triangle_ids)?,
                indices: convert_buffer(BufferName::VisibleIndices, &culling.indices)?,
                previously_visible: culling
                    .previously_visible
                    .as_ref()
                    .map(|buffer| convert_buffer(BufferName::PreviouslyVisible, buffer))
                    .transpose()?,
            }),
            None => None,
        };
        Ok(SceneBufferSet { geometry, materials, uniforms, culling })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn try_map_keeps_each_buffer_in_its_field() {
        // Each number is the position of the buffer's name in `BufferName`.
        let sizes = SceneBufferSet {
            geometry: GeometryBuffers {
                positions: 0,
                normals: 1,
                tangents: Some(7),
                uvs: Some(8),
                triangles: 2,
                triangle_vertices: 3,
                corner_vertices: Some(6),
            },
            materials: MaterialBuffers { materials: 4, triangle_materials: Some(9) },
            uniforms: UniformBuffers { frame: 5, cascades: Some(10) },
            culling: Some(CullBuffers {
                uniforms: 11,
                draws: 12,
                counters: 13,
                visible_bits: 14,
                triangle_ids: 15,
                indices: 16,
                previously_visible: Some(17),
            }),
        };
        let numbers = sizes.try_map(|name, number| {
            assert_eq!(name as usize, *number, "{name}");
            Ok(*number)
        });
        assert_eq!(numbers.expect("no errors"), sizes);
        assert!(sizes.named().zip(0..).all(|((name, number), index)| name as usize == index && *number == index));
        assert_eq!(sizes.named().count(), 18);
    }
}
