//! Input of the compute rasterizer: triangles of the draw groups and alpha data of cut-outs.

use crate::scene_data::geometry::{BlendMode, Geometry, blend_mode, used_materials};
use crate::scene_data::textures::{TextureArray, TextureRole, arrays, cutoff, find_layer, mip_levels};
use modalcast_model::domain::{AlphaMode, Material};
use modalcast_model::raster::{AlphaImage, AlphaMaterial, CutOuts, GlBuffer, RasterGeometry};
use modalcast_model::scene::{CullMode, DrawRange, Scene};

/// The mesh of a scene. `positions`: the buffer of the deformed positions.
pub(super) fn raster_geometry(scene: &Scene, positions: GlBuffer, anisotropy: f32) -> RasterGeometry {
    let geometry = Geometry::new(scene);
    let groups = geometry.groups.iter().map(|group| DrawRange {
        first_triangle: group.first_triangle as u32,
        triangle_count: group.triangle_count as u32,
        cull_mode: if group.double_sided { CullMode::None } else { CullMode::Back },
    });
    RasterGeometry {
        positions,
        groups: groups.collect(),
        cut_outs: cut_outs(scene, &geometry, anisotropy),
        triangles: geometry.triangle_vertices,
    }
}

/// Alpha data of cut-out triangles and of the blended triangles, which follow in the draw order. Blended triangles cast
/// shadows where their alpha reaches a threshold.
pub(crate) fn cut_outs(scene: &Scene, geometry: &Geometry, anisotropy: f32) -> Option<CutOuts> {
    let first_triangle = geometry.groups.iter().find(|group| group.blend_mode != BlendMode::Opaque)?.first_triangle;
    let uv_of = |corner: u32| geometry.uvs.get(corner as usize).copied().unwrap_or_default();
    let arrays = arrays(scene, TextureRole::Color);
    let mut image_textures: Vec<usize> = Vec::new();
    let materials = used_materials(scene)
        .into_iter()
        .map(|index| alpha_material(scene, &scene.materials[index], &mut image_textures));
    Some(CutOuts {
        first: first_triangle as u32,
        uvs: geometry.triangle_corners[first_triangle..].iter().map(|corners| corners.map(uv_of)).collect(),
        material_indices: match geometry.triangle_materials.get(first_triangle..) {
            Some(materials) => materials.to_vec(),
            None => vec![0; geometry.triangle_corners.len() - first_triangle],
        },
        materials: materials.collect(),
        images: image_textures.iter().map(|texture| alpha_image(scene, &arrays, *texture)).collect(),
        anisotropy,
    })
}

/// Alpha properties of a material. Appends its color texture to `image_textures` if it is not in the list.
fn alpha_material(scene: &Scene, material: &Material, image_textures: &mut Vec<usize>) -> AlphaMaterial {
    let cutoff = match material.alpha_mode {
        AlphaMode::Opaque => 0.0,
        AlphaMode::Mask { cutoff } => cutoff,
        AlphaMode::Blend => scene.look.shadow.unwrap_or_default().alpha_threshold,
    };
    let image_texture = material.color_texture.filter(|_| blend_mode(material) != BlendMode::Opaque);
    let image = image_texture.map(|texture| {
        let position = image_textures.iter().position(|image| *image == texture);
        position.unwrap_or_else(|| {
            image_textures.push(texture);
            image_textures.len() - 1
        })
    });
    AlphaMaterial { alpha: material.alpha, cutoff, image: image.map(|image| image as u32) }
}

/// Alpha of all mipmap levels of an image, the same as in OpenGL; one opaque texel if the image has no texture array.
fn alpha_image(scene: &Scene, arrays: &[TextureArray], texture: usize) -> AlphaImage {
    if find_layer(arrays, texture).is_none() {
        return AlphaImage { width: 1, height: 1, levels: vec![vec![u8::MAX]] };
    }
    let image = &scene.textures[texture];
    let levels = mip_levels(image, TextureRole::Color, cutoff(scene, texture));
    let alpha_channel = |rgba: &Vec<u8>| rgba.iter().skip(3).step_by(4).copied().collect();
    AlphaImage { width: image.width(), height: image.height(), levels: levels.iter().map(alpha_channel).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene_data::geometry::tests::squares;
    use modalcast_model::domain::Texture;

    #[test]
    fn cut_outs_contain_alpha_of_masked_and_blended_triangles() {
        let material = |alpha_mode, color_texture| Material { alpha_mode, color_texture, ..Material::default() };
        let mut parts = squares(vec![
            material(AlphaMode::Blend, Some(1)),
            material(AlphaMode::Opaque, Some(0)),
            material(AlphaMode::Mask { cutoff: 0.25 }, Some(1)),
        ]);
        let texture = |alpha| Texture::new("one", 2, 1, vec![9, 9, 9, alpha, 9, 9, 9, 255]).expect("a valid texture");
        parts.textures = vec![texture(7), texture(100)];
        let scene = Scene::new(parts).expect("a valid scene");
        let geometry = Geometry::new(&scene);
        let cut_out_data = cut_outs(&scene, &geometry, 8.0).expect("cut-outs");
        assert_eq!(
            (cut_out_data.first, cut_out_data.uvs.len()),
            (2, 4),
            "expected four triangles after the two of the opaque square"
        );
        assert_eq!(cut_out_data.uvs[0], [[0.0, 1.0], [1.0, 1.0], [1.0, 0.0]]);
        let material_of = |triangle: usize| cut_out_data.materials[cut_out_data.material_indices[triangle] as usize];
        assert_eq!(
            (material_of(0).cutoff, material_of(2).cutoff),
            (0.25, scene.look.shadow.expect("a shadow").alpha_threshold)
        );
        assert_eq!(
            (material_of(0).image, material_of(2).image, cut_out_data.images.len()),
            (Some(0), Some(0), 1),
            "expected one shared image, and none of the opaque material"
        );
        // Texture 1 has two texels, so it has two mipmap levels.
        assert_eq!((cut_out_data.images[0].levels.len(), &cut_out_data.images[0].levels[0]), (2, &vec![100, 255]));
        let opaque = Scene::new(squares(vec![Material::default()])).expect("a valid scene");
        assert_eq!(cut_outs(&opaque, &Geometry::new(&opaque), 8.0), None);
    }
}
