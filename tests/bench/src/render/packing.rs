//! Packs images into arrays as in the thesis (equation 3.13, figure 3.12): all images are in one array of the largest
//! width and height. Smaller images are repeated until they fill their layer, and texture coordinates are wrapped and
//! scaled:
//!
//!   uv' = (uv - floor uv) s,  s = ((w - 1) / (w_t - 1), (h - 1) / (h_t - 1))
//!
//! w x h is the size of an image, w_t x h_t the size of the array.
//!
//! The renderer uses an array per size. If there are more sizes than arrays, images of several sizes share an array,
//! and the shader wraps and filters within each image, so that no image is scaled. For the comparison, a scene is
//! rebuilt so that the renderer reproduces the thesis's method: images are repeated to the size of the array, and the
//! corners of every triangle have the coordinates of the equation. The equation wraps the coordinates of each fragment.
//! Wrapping the coordinates of each triangle is equivalent if no triangle crosses the edge of its image.
//!
//! The scale of the equation does not reach the last column and row of an image. [`Packing::CorrectedRepetition`] uses
//! s = (w / w_t, h / h_t) instead. The `images` workload has seven image sizes and the renderer has six arrays, so two
//! images, 16 x 16 and 25 x 15, share an array. The test `images_in_a_mixed_array_look_as_they_do_alone` compares both
//! methods with the images alone.

use std::sync::Arc;

use serde::Serialize;

use modalcast_model::domain::{Corners, Mesh, Modes, Shape, Texture};
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::{Scene, SceneParts};

/// Packing of images in arrays.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub enum Packing {
    /// An array per size, or a shared one, as in the renderer.
    #[serde(rename = "classes")]
    SizeClasses,
    /// Equation 3.13 as printed: it does not reach the last column and row of an image.
    #[serde(rename = "repeated")]
    PrintedRepetition,
    /// Equation 3.13 with s = (w / w_t, h / h_t), which covers the whole image.
    #[serde(rename = "repeated-whole")]
    CorrectedRepetition,
}

/// Packs the images of a scene by this method. The scene must be rigid, and its images must be color images.
///
/// # Errors
/// `Invalid` when a triangle crosses the edge of its image.
pub(super) fn pack_images(scene: &Scene, packing: Packing) -> Result<Arc<Scene>> {
    let mut parts = scene.parts();
    if packing != Packing::SizeClasses {
        repeat_images(&mut parts, packing)?;
    }
    Scene::new(parts)
}

fn repeat_images(parts: &mut SceneParts, packing: Packing) -> Result<()> {
    let max_side = |side: fn(&Texture) -> u32| parts.textures.iter().map(side).max().unwrap_or(1);
    let layer_size = [max_side(Texture::width), max_side(Texture::height)];
    let mut shapes = Vec::new();
    for domain in &mut parts.domains {
        let texture = parts.materials[domain.material].color_texture.map(|texture| &parts.textures[texture]);
        let scale = texture.map_or([1.0; 2], |texture| uv_scale(texture, layer_size, packing));
        shapes.push(Shape::new(wrap_uvs(&parts.shapes[domain.shape].mesh, scale)?, Modes::rigid())?);
        domain.shape = shapes.len() - 1;
    }
    parts.shapes = shapes;
    parts.textures =
        parts.textures.iter().map(|texture| fill_by_repetition(texture, layer_size)).collect::<Result<_>>()?;
    Ok(())
}

/// s of equation 3.13 per axis.
fn uv_scale(texture: &Texture, layer_size: [u32; 2], packing: Packing) -> [f32; 2] {
    let image_size = [texture.width(), texture.height()];
    std::array::from_fn(|axis| match packing {
        Packing::PrintedRepetition => f64::from(image_size[axis] - 1) / f64::from((layer_size[axis] - 1).max(1)),
        Packing::SizeClasses | Packing::CorrectedRepetition => {
            f64::from(image_size[axis]) / f64::from(layer_size[axis])
        }
    } as f32)
}

/// The image, repeated until it fills `width` x `height` texels.
fn fill_by_repetition(texture: &Texture, [width, height]: [u32; 2]) -> Result<Texture> {
    let (columns, rows) = (texture.width() as usize, texture.height() as usize);
    let texel_bytes = |index: usize| {
        let (layer_x, layer_y) = (index % width as usize, index / width as usize);
        let (x, y) = (layer_x % columns, layer_y % rows);
        let first_byte = 4 * (y * columns + x);
        texture.rgba()[first_byte..first_byte + 4].iter().copied()
    };
    let rgba = (0..width as usize * height as usize).flat_map(texel_bytes).collect();
    Texture::new(texture.name.clone(), width, height, rgba)
}

/// A mesh with separate corners per triangle and wrapped, scaled texture coordinates.
fn wrap_uvs(mesh: &Mesh, scale: [f32; 2]) -> Result<Mesh> {
    let mesh_corners = mesh.corners();
    let mut corners = Corners { vertices: Vec::new(), normals: Vec::new(), uvs: Vec::new() };
    for triangle in mesh.triangles() {
        let uvs = triangle.map(|corner| mesh_corners.uvs[corner as usize]);
        let min_uv = [0, 1].map(|axis| uvs.iter().map(|uv| uv[axis]).fold(f32::MAX, f32::min).floor());
        for (corner, uv) in triangle.iter().zip(uvs) {
            let wrapped_uv = [0, 1].map(|axis| uv[axis] - min_uv[axis]);
            if wrapped_uv.iter().any(|coordinate| *coordinate > 1.0) {
                return Err(invalid(
                    "packing",
                    "triangles that stay within one repetition of their image",
                    format!("{uv:?}"),
                ));
            }
            corners.vertices.push(mesh_corners.vertices[*corner as usize]);
            corners.normals.push(mesh_corners.normals[*corner as usize]);
            corners.uvs.push([0, 1].map(|axis| wrapped_uv[axis] * scale[axis]));
        }
    }
    let triangle_count = corners.vertices.len() as u32 / 3;
    Mesh::new(
        mesh.rest_positions().to_vec(),
        corners,
        (0..triangle_count).map(|triangle| [3 * triangle, 3 * triangle + 1, 3 * triangle + 2]).collect(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::workloads::RenderWorkload;

    #[test]
    fn repeats_small_images_and_scales_uvs_by_equation_3_13() {
        let scene = RenderWorkload::Images.build().expect("a workload").scene;
        // The largest image has 128 x 128 texels, so this is the size of the array.
        let [printed_scene, corrected_scene] = [Packing::PrintedRepetition, Packing::CorrectedRepetition]
            .map(|packing| pack_images(&scene, packing).expect("a packed scene"));
        let small_index = scene
            .textures
            .iter()
            .position(|image| (image.width(), image.height()) == (25, 15))
            .expect("an image of 25 x 15");
        let (image, filled_image) = (&scene.textures[small_index], &printed_scene.textures[small_index]);
        assert_eq!((filled_image.width(), filled_image.height()), (128, 128));
        let red = |image: &Texture, x: u32, y: u32| image.rgba()[4 * (y * image.width() + x) as usize];
        for (x, y) in [(0, 0), (24, 14), (25, 15), (127, 127), (63, 40)] {
            assert_eq!(red(filled_image, x, y), red(image, x % 25, y % 15), "({x}, {y})");
        }
        let max_uv = |scene: &Scene| {
            let domain =
                scene.domains.iter().find(|domain| scene.materials[domain.material].color_texture == Some(small_index));
            let uvs = &scene.shapes[domain.expect("a domain with the image").shape].mesh.corners().uvs;
            uvs.iter().fold([0.0_f32; 2], |max, uv| [max[0].max(uv[0]), max[1].max(uv[1])])
        };
        let is_close = |uv: [f32; 2], expected: [f32; 2]| {
            uv.iter().zip(expected).all(|(uv, expected)| (uv - expected).abs() < 1e-6)
        };
        assert!(is_close(max_uv(&printed_scene), [24.0 / 127.0, 14.0 / 127.0]), "{:?}", max_uv(&printed_scene));
        assert!(is_close(max_uv(&corrected_scene), [25.0 / 128.0, 15.0 / 128.0]), "{:?}", max_uv(&corrected_scene));
        assert!(max_uv(&scene)[0] > 1.5, "control: the panel repeats its image");
    }

    #[test]
    fn rejects_triangle_that_crosses_its_image_edge() {
        let mesh = |max_u: f32| {
            let positions = vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
            let uvs = vec![[1.0, 0.0], [max_u, 0.0], [1.0, 1.0]];
            Mesh::from_indexed(positions, vec![[0.0, 0.0, 1.0]; 3], uvs, vec![[0, 1, 2]]).expect("a mesh")
        };
        assert_eq!(
            wrap_uvs(&mesh(2.0), [0.5; 2]).expect("a triangle inside of its image").corners().uvs[1],
            [0.5, 0.0]
        );
        assert!(wrap_uvs(&mesh(2.25), [0.5; 2]).is_err());
    }
}
