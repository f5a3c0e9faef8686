//! Uploads texture arrays with their mipmap levels.

use std::rc::Rc;

use rayon::prelude::*;

use crate::device::gl::{self, Gl, Texture, TextureDesc};
use crate::scene_data::textures::{TextureArray, TextureRole, cutoff, mip_levels};
use modalcast_model::error::Result;
use modalcast_model::scene::Scene;

/// Creates and fills the texture arrays of one role.
pub(crate) fn upload_arrays(
    gl: &Rc<Gl>,
    scene: &Scene,
    arrays: &[TextureArray],
    purpose: TextureRole,
) -> Result<Vec<Texture>> {
    arrays.iter().map(|array| upload_array(gl, scene, array, purpose)).collect()
}

fn upload_array(gl: &Rc<Gl>, scene: &Scene, array: &TextureArray, purpose: TextureRole) -> Result<Texture> {
    let layers = array.layers.len() as u32;
    if layers > gl.limits.max_layers {
        let field = format!("textures of {} x {}", array.width, array.height);
        return Err(gl::too_large(&field, u64::from(gl.limits.max_layers), u64::from(layers)));
    }
    let texture = gl.texture(TextureDesc {
        target: gl::TEXTURE_2D_ARRAY,
        format: if purpose == TextureRole::Color { gl::SRGB8_ALPHA8 } else { gl::RGBA8 },
        width: array.width,
        height: array.height,
        depth: layers,
        levels: array.levels(),
    })?;
    // Few layers at a time: the mipmap chains of all layers of a large scene would take many times the memory of its
    // textures.
    for (chunk, part) in array.layers.chunks(8).enumerate() {
        let chain = |layer: &usize| {
            let cutoff = if purpose == TextureRole::Color { cutoff(scene, *layer) } else { None };
            mip_levels(&scene.textures[*layer], array, purpose, cutoff)
        };
        let chains: Vec<Vec<Vec<u8>>> = part.par_iter().map(chain).collect();
        for (offset, chain) in chains.iter().enumerate() {
            for (level, rgba) in chain.iter().enumerate() {
                let size = [(array.width >> level).max(1), (array.height >> level).max(1)];
                texture.upload_pixels(level as u32, (8 * chunk + offset) as u32, size, rgba)?;
            }
        }
    }
    // On a CPU, blending two mipmap levels costs a sixth of the frame time and is hardly visible.
    let between = if gl.limits.software { gl::LINEAR_MIPMAP_NEAREST } else { gl::LINEAR_MIPMAP_LINEAR };
    let sampling = [
        (gl::TEXTURE_MIN_FILTER, between),
        (gl::TEXTURE_MAG_FILTER, gl::LINEAR),
        (gl::TEXTURE_WRAP_S, gl::REPEAT),
        (gl::TEXTURE_WRAP_T, gl::REPEAT),
    ];
    texture.set_sampling(&sampling, gl.limits.anisotropy);
    Ok(texture)
}
