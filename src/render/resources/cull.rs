//! Device resources of triangle culling.

use std::rc::Rc;

use crate::device::gl::{self, Buffer, Gl, Texture, VertexArray};
use crate::layout::CULL_BLOCK;
use crate::layout::cull::{
    CULL_COUNTERS_BINDING, CullUniforms, DRAWS_BINDING, INDICES_BINDING, MAX_GROUPS, PREVIOUSLY_VISIBLE_BINDING,
    TRIANGLE_IDS_BINDING, VISIBLE_BITS_BINDING,
};
use crate::plan::buffers::CullBuffers;
use crate::scene_data::geometry::{BlendMode, DrawGroup};
use modalcast_model::error::Result;

/// Buffers that the culling programs read and write, among them one list of visible triangles per draw group, and the
/// vertex arrays that draw the lists.
#[derive(Debug)]
pub(crate) struct CullResources {
    pub(crate) buffers: CullBuffers<Buffer>,
    pub(crate) uniforms: CullUniforms,
    /// Buffer texture over the ids of the visible triangles.
    pub(crate) triangle_ids: Texture,
    vertex_arrays: CullVertexArrays,
}

/// Vertex arrays whose index buffer contains the lists of visible triangles.
#[derive(Debug)]
pub(crate) struct CullVertexArrays {
    /// Attributes: positions only. Draws opaque triangles.
    pub(crate) position_array: VertexArray,
    /// Attributes: all attributes of a corner. Draws cut-out and blended triangles; none without such triangles.
    pub(crate) corner_array: Option<VertexArray>,
}

impl CullResources {
    /// Writes the uniforms, and marks all triangles as not visible in the previous frame.
    pub(crate) fn new(
        gl: &Rc<Gl>,
        buffers: CullBuffers<Buffer>,
        groups: &[DrawGroup],
        vertex_arrays: CullVertexArrays,
    ) -> Result<Self> {
        debug_assert!(groups.len() <= MAX_GROUPS);
        let uniforms = CullUniforms::new(groups, gl.limits.subpixel_step());
        buffers.uniforms.write(bytemuck::bytes_of(&uniforms));
        if let Some(bitmap) = &buffers.previously_visible {
            bitmap.write(&vec![0; uniforms.bitmap_bytes()]);
        }
        Ok(Self {
            triangle_ids: gl.buffer_texture(&buffers.triangle_ids, gl::R32UI)?,
            buffers,
            uniforms,
            vertex_arrays,
        })
    }

    /// Vertex array of the visible triangles with this blend mode.
    pub(crate) const fn vertex_array(&self, blend_mode: BlendMode) -> Option<&VertexArray> {
        match blend_mode {
            BlendMode::Opaque => Some(&self.vertex_arrays.position_array),
            BlendMode::Mask | BlendMode::Blend => self.vertex_arrays.corner_array.as_ref(),
        }
    }

    /// Binds the buffers for the culling programs.
    pub(crate) fn bind(&self) {
        let CullBuffers { uniforms, draws, counters, visible_bits, triangle_ids, indices, previously_visible } =
            &self.buffers;
        draws.bind_storage(DRAWS_BINDING);
        visible_bits.bind_storage(VISIBLE_BITS_BINDING);
        counters.bind_storage(CULL_COUNTERS_BINDING);
        if let Some(bitmap) = previously_visible {
            bitmap.bind_storage(PREVIOUSLY_VISIBLE_BINDING);
        }
        triangle_ids.bind_storage(TRIANGLE_IDS_BINDING);
        indices.bind_storage(INDICES_BINDING);
        uniforms.bind_uniform(CULL_BLOCK, size_of::<CullUniforms>());
    }
}
