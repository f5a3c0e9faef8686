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
    /// Ambient color, array of the normal map.
    ambient_array: [f32; 4],
    /// Diffuse color, layer of the normal map.
    diffuse_layer: [f32; 4],
    /// Specular color, exponent.
    specular_exponent: [f32; 4],
    /// Array and layer of the color texture, alpha, cutoff.
    cut: [f32; 4],
}

pub(crate) const MATERIAL_BYTES: usize = size_of::<PackedMaterial>();
const _: () = assert!(MATERIAL_BYTES == 64, "PackedMaterial differs from shaders/shared/material.glsl");

/// Packs the materials that triangles use; `images` are the color and the normal arrays.
pub(crate) fn pack_materials(scene: &Scene, images: &[Vec<TextureArray>; 2]) -> Vec<PackedMaterial> {
    let wide = |[r, g, b]: [f32; 3], fourth: f32| [r, g, b, fourth];
    let at = |arrays: &[TextureArray], texture: Option<usize>| {
        let place = texture.and_then(|texture| find_layer(arrays, texture));
        place.map_or([-1.0; 2], |(array, layer)| [array as f32, layer as f32])
    };
    let one = |material: &modalcast_model::domain::Material| {
        let cutoff = match material.alpha_mode {
            AlphaMode::Mask { cutoff } => cutoff,
            AlphaMode::Blend => scene.look.opaque_alpha,
            AlphaMode::Opaque => 0.0,
        };
        let [color_array, color_layer] = at(&images[0], material.color_texture);
        let [normal_array, normal_layer] = at(&images[1], material.normal_texture);
        PackedMaterial {
            ambient_array: wide(material.ambient, normal_array),
            diffuse_layer: wide(material.diffuse, normal_layer),
            specular_exponent: wide(material.specular, material.shininess),
            cut: [color_array, color_layer, material.alpha, cutoff],
        }
    };
    used_materials(scene).into_iter().map(|material| one(&scene.materials[material])).collect()
}
