//! Material table of the shaders.

use bytemuck::{Pod, Zeroable};

use crate::scene_data::geometry::used_materials;
use crate::scene_data::textures::{TextureArray, find_layer};
use modalcast_model::domain::AlphaMode;
use modalcast_model::scene::Scene;

/// GPU layout of a material. Twin of `material_of` in `shaders/shared/material.glsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub(crate) struct PackedMaterial {
    /// xyz: ambient color. w: texture array of the normal map, -1 without a normal map ([`pack_location`]).
    ambient_array: [f32; 4],
    /// xyz: diffuse color. w: layer of the normal map ([`pack_location`]).
    diffuse_layer: [f32; 4],
    /// xyz: specular color. w: specular exponent.
    specular_exponent: [f32; 4],
    /// Texture array and layer of the color texture ([`pack_location`]), each -1 without one; alpha; cutoff. The cutoff
    /// is the alpha from which a cut-out is kept, or from which a blended triangle is drawn as opaque.
    color_texture_alpha: [f32; 4],
}

pub(crate) const MATERIAL_BYTES: usize = size_of::<PackedMaterial>();
const _: () = assert!(MATERIAL_BYTES == 64, "PackedMaterial differs from shaders/shared/material.glsl");

/// Packs texture array and layer of an image and, in a mixed array (with images of several sizes), the size of the
/// image: array + 8 (width - 1) and layer + 2048 (height - 1). f32 is exact, because both numbers are below 2^24: sides
/// are at most 8192, and a scene has at most 512 images.
fn pack_location(array: usize, layer: usize, size: Option<[u32; 2]>) -> [f32; 2] {
    let [width, height] = size.unwrap_or([1, 1]);
    [(array as u32 + 8 * (width - 1)) as f32, (layer as u32 + 2048 * (height - 1)) as f32]
}

/// Packs the materials that triangles use. `texture_arrays`: arrays of color textures, then those of normal maps.
pub(crate) fn pack_materials(scene: &Scene, texture_arrays: &[Vec<TextureArray>; 2]) -> Vec<PackedMaterial> {
    let pack_vec4 = |[r, g, b]: [f32; 3], w: f32| [r, g, b, w];
    let find_texture = |arrays: &[TextureArray], texture: Option<usize>| {
        let location = texture.and_then(|texture| Some((texture, find_layer(arrays, texture)?)));
        location.map_or([-1.0; 2], |(texture, (array, layer))| {
            let image = &scene.textures[texture];
            let size = arrays[array].is_mixed.then_some([image.width(), image.height()]);
            pack_location(array, layer, size)
        })
    };
    let pack_material = |material: &modalcast_model::domain::Material| {
        let cutoff = match material.alpha_mode {
            AlphaMode::Mask { cutoff } => cutoff,
            AlphaMode::Blend => scene.look.opaque_alpha,
            AlphaMode::Opaque => 0.0,
        };
        let [color_array, color_layer] = find_texture(&texture_arrays[0], material.color_texture);
        let [normal_array, normal_layer] = find_texture(&texture_arrays[1], material.normal_texture);
        PackedMaterial {
            ambient_array: pack_vec4(material.ambient, normal_array),
            diffuse_layer: pack_vec4(material.diffuse, normal_layer),
            specular_exponent: pack_vec4(material.specular, material.shininess),
            color_texture_alpha: [color_array, color_layer, material.alpha, cutoff],
        }
    };
    used_materials(scene).into_iter().map(|material| pack_material(&scene.materials[material])).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packed_locations_are_exact_up_to_the_largest_image() {
        assert_eq!(pack_location(5, 511, None), [5.0, 511.0]);
        for (array, layer, width, height) in [(0, 0, 1, 1), (5, 511, 8192, 8192), (6, 2047, 8192, 8191)] {
            let [x, y] = pack_location(array, layer, Some([width, height])).map(|number| number as u32);
            // As `mixed_image_texel` and the selection of the array in GLSL unpack them.
            assert_eq!((x & 7, y & 2047), (array as u32, layer as u32));
            assert_eq!(((x >> 3) + 1, (y >> 11) + 1), (width, height));
        }
    }
}
