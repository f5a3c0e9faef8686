//! Input of the compute rasterizer: the triangles of the draw groups and the alpha data of cut-outs.

use crate::scene_data::geometry::{BlendMode, Geometry, blend_mode, used_materials};
use crate::scene_data::textures::{TextureArray, TextureRole, arrays, cutoff, find_layer, mip_levels};
use modalcast_model::domain::{AlphaMode, Material};
use modalcast_model::raster::{AlphaImage, AlphaMaterial, CutOuts, GlBuffer, RasterGeometry};
use modalcast_model::scene::{CullMode, DrawRange, Scene};

/// The mesh of a scene, over the shared position buffer.
pub(super) fn raster_geometry(scene: &Scene, positions: GlBuffer, anisotropy: f32) -> RasterGeometry {
    let geometry = Geometry::new(scene);
    let groups = geometry.groups.iter().map(|group| DrawRange {
        first: group.first_triangle as u32,
        triangles: group.triangles as u32,
        cull_mode: if group.double_sided { CullMode::None } else { CullMode::Back },
    });
    RasterGeometry {
        positions,
        groups: groups.collect(),
        cut_outs: cut_outs(scene, &geometry, anisotropy),
        triangles: geometry.triangle_vertices,
    }
}

/// Alpha data of cut-out triangles and of the blended triangles after them, which cast shadows above a threshold of
/// alpha.
fn cut_outs(scene: &Scene, geometry: &Geometry, anisotropy: f32) -> Option<CutOuts> {
    let first = geometry.groups.iter().find(|group| group.blend_mode != BlendMode::Opaque)?.first_triangle;
    let uv = |corner: u32| geometry.uvs.get(corner as usize).copied().unwrap_or_default();
    let arrays = arrays(scene, TextureRole::Color);
    let mut images: Vec<usize> = Vec::new();
    let materials = used_materials(scene).into_iter().map(|index| surface(scene, &scene.materials[index], &mut images));
    Some(CutOuts {
        first: first as u32,
        uvs: geometry.triangles[first..].iter().map(|corners| corners.map(uv)).collect(),
        material_indices: match geometry.materials.get(first..) {
            Some(materials) => materials.to_vec(),
            None => vec![0; geometry.triangles.len() - first],
        },
        materials: materials.collect(),
        images: images.iter().map(|texture| alpha(scene, &arrays, *texture)).collect(),
        anisotropy,
    })
}

/// The alpha properties of a material. Appends its image to `images` if it is not in the list.
fn surface(scene: &Scene, material: &Material, images: &mut Vec<usize>) -> AlphaMaterial {
    let cutoff = match material.alpha_mode {
        AlphaMode::Opaque => 0.0,
        AlphaMode::Mask { cutoff } => cutoff,
        AlphaMode::Blend => scene.look.shadow.unwrap_or_default().alpha_threshold,
    };
    let wanted = material.color_texture.filter(|_| blend_mode(material) != BlendMode::Opaque);
    let image = wanted.map(|texture| {
        let there = images.iter().position(|image| *image == texture);
        there.unwrap_or_else(|| {
            images.push(texture);
            images.len() - 1
        })
    });
    AlphaMaterial { alpha: material.alpha, cutoff, image: image.map(|image| image as u32) }
}

/// Alpha of all mipmap levels of an image, the same as in OpenGL; one opaque texel if the image has no texture array.
fn alpha(scene: &Scene, arrays: &[TextureArray], texture: usize) -> AlphaImage {
    let Some((array, _)) = find_layer(arrays, texture) else {
        return AlphaImage { width: 1, height: 1, levels: vec![vec![u8::MAX]] };
    };
    let array = &arrays[array];
    let levels = mip_levels(&scene.textures[texture], array, TextureRole::Color, cutoff(scene, texture));
    let of = |rgba: &Vec<u8>| rgba.iter().skip(3).step_by(4).copied().collect();
    AlphaImage { width: array.width, height: array.height, levels: levels.iter().map(of).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene_data::geometry::tests::squares;
    use modalcast_model::domain::Texture;

    #[test]
    fn cut_outs_are_what_is_not_opaque_with_the_alpha_of_their_own_images() {
        let with = |alpha_mode, color_texture| Material { alpha_mode, color_texture, ..Material::default() };
        let mut parts = squares(vec![
            with(AlphaMode::Blend, Some(1)),
            with(AlphaMode::Opaque, Some(0)),
            with(AlphaMode::Mask { cutoff: 0.25 }, Some(1)),
        ]);
        let texture = |alpha| Texture::new("one", 2, 1, vec![9, 9, 9, alpha, 9, 9, 9, 255]).expect("fits");
        parts.textures = vec![texture(7), texture(100)];
        let scene = Scene::new(parts).expect("good");
        let geometry = Geometry::new(&scene);
        let cut = cut_outs(&scene, &geometry, 8.0).expect("there are some");
        assert_eq!((cut.first, cut.uvs.len()), (2, 4), "the opaque square comes first");
        assert_eq!(cut.uvs[0], [[0.0, 1.0], [1.0, 1.0], [1.0, 0.0]]);
        let of = |triangle: usize| cut.materials[cut.material_indices[triangle] as usize];
        assert_eq!((of(0).cutoff, of(2).cutoff), (0.25, scene.look.shadow.expect("has one").alpha_threshold));
        assert_eq!((of(0).image, of(2).image, cut.images.len()), (Some(0), Some(0), 1), "the opaque one's is not read");
        assert_eq!((cut.images[0].levels.len(), &cut.images[0].levels[0]), (2, &vec![100, 255]));
        let opaque = Scene::new(squares(vec![Material::default()])).expect("good");
        assert_eq!(cut_outs(&opaque, &Geometry::new(&opaque), 8.0), None);
    }
}
