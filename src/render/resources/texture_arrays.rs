//! Uploads texture arrays with their mipmap levels.

use std::rc::Rc;

use rayon::prelude::*;

use crate::device::gl::{self, Gl, Texture, TextureDesc};
use crate::scene_data::textures::{TextureArray, TextureRole, cutoff, mip_levels};
use modalcast_model::error::Result;
use modalcast_model::scene::Scene;

/// Layers whose mipmap levels are computed at once. Few, because mipmap chains take much host memory.
const LAYERS_PER_CHUNK: usize = 8;

/// Creates and fills the texture arrays of one role.
pub(crate) fn upload_arrays(
    gl: &Rc<Gl>,
    scene: &Scene,
    arrays: &[TextureArray],
    role: TextureRole,
) -> Result<Vec<Texture>> {
    arrays.iter().map(|array| upload_array(gl, scene, array, role)).collect()
}

/// Creates a texture array and fills all mipmap levels of its layers.
fn upload_array(gl: &Rc<Gl>, scene: &Scene, array: &TextureArray, role: TextureRole) -> Result<Texture> {
    let layer_count = array.layers.len() as u32;
    if layer_count > gl.limits.max_layers {
        let field = format!("textures of {} x {}", array.width, array.height);
        return Err(gl::too_large(&field, u64::from(gl.limits.max_layers), u64::from(layer_count)));
    }
    let texture = gl.texture(TextureDesc {
        target: gl::TEXTURE_2D_ARRAY,
        format: if role == TextureRole::Color { gl::SRGB8_ALPHA8 } else { gl::RGBA8 },
        width: array.width,
        height: array.height,
        depth: layer_count,
        levels: array.levels(),
    })?;
    for (chunk_index, texture_indices) in array.layers.chunks(LAYERS_PER_CHUNK).enumerate() {
        let build_chain = |index: &usize| {
            let cutoff = if role == TextureRole::Color { cutoff(scene, *index) } else { None };
            mip_levels(&scene.textures[*index], array, role, cutoff)
        };
        // RGBA8 pixels of each layer and level.
        let chains: Vec<Vec<Vec<u8>>> = texture_indices.par_iter().map(build_chain).collect();
        for (index_in_chunk, chain) in chains.iter().enumerate() {
            let layer = (LAYERS_PER_CHUNK * chunk_index + index_in_chunk) as u32;
            for (level, rgba) in chain.iter().enumerate() {
                let size = [(array.width >> level).max(1), (array.height >> level).max(1)];
                texture.upload_pixels(level as u32, layer, size, rgba)?;
            }
        }
    }
    // With a software rasterizer, blending two mipmap levels takes a sixth of the frame time and is hardly visible.
    let min_filter = if gl.limits.software { gl::LINEAR_MIPMAP_NEAREST } else { gl::LINEAR_MIPMAP_LINEAR };
    let sampling = [
        (gl::TEXTURE_MIN_FILTER, min_filter),
        (gl::TEXTURE_MAG_FILTER, gl::LINEAR),
        (gl::TEXTURE_WRAP_S, gl::REPEAT),
        (gl::TEXTURE_WRAP_T, gl::REPEAT),
    ];
    texture.set_sampling(&sampling, gl.limits.anisotropy);
    Ok(texture)
}
