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
    /// xyz: ambient color. w: texture array of the normal map, -1 without a normal map.
    ambient_array: [f32; 4],
    /// xyz: diffuse color. w: layer of the normal map.
    diffuse_layer: [f32; 4],
    /// xyz: specular color. w: specular exponent.
    specular_exponent: [f32; 4],
    /// Texture array and layer of the color texture, each -1 without a color texture; alpha; cutoff. The cutoff is the
    /// alpha from which a cut-out is kept, or from which a blended triangle is drawn as opaque.
    color_texture_alpha: [f32; 4],
}

pub(crate) const MATERIAL_BYTES: usize = size_of::<PackedMaterial>();
const _: () = assert!(MATERIAL_BYTES == 64, "PackedMaterial differs from shaders/shared/material.glsl");

/// Packs the materials that triangles use. `texture_arrays`: arrays of color textures, then those of normal maps.
pub(crate) fn pack_materials(scene: &Scene, texture_arrays: &[Vec<TextureArray>; 2]) -> Vec<PackedMaterial> {
    let pack_vec4 = |[r, g, b]: [f32; 3], w: f32| [r, g, b, w];
    let find_texture = |arrays: &[TextureArray], texture: Option<usize>| {
        let layer = texture.and_then(|texture| find_layer(arrays, texture));
        layer.map_or([-1.0; 2], |(array, layer)| [array as f32, layer as f32])
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
