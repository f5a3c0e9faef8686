//! Images of more sizes than there are texture arrays: images that share an array with larger ones look as they do
//! alone.

use modalcast_model::domain::{Corners, Material, Mesh, Texture};
use modalcast_render::Renderer;

use super::harness::{SceneBuilder, facing_rectangle, front_camera, open_renderer, render_square};

/// Seven sizes. The renderer has six arrays per role, so the two smallest images share an array of 25 x 16 texels.
const SIZES: [[u32; 2]; 7] = [[16, 16], [25, 15], [24, 24], [32, 32], [75, 50], [64, 64], [128, 128]];
const FRAME_SIDE: u32 = 128;

/// Texels with a different color at each edge, so that a lookup across a wrong edge is visible.
fn texel(size: [u32; 2], x: u32, y: u32) -> [u8; 4] {
    let [width, height] = size;
    let noise = (37 * x + 101 * y + 13 * x * y) % 97;
    [(255 * x / width) as u8, (255 * (y + 1) / height) as u8, 2 * noise as u8, 255]
}

fn texture(size: [u32; 2], texel: impl Fn(u32, u32) -> [u8; 4]) -> Texture {
    let [width, height] = size;
    let rgba = (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).flat_map(|(x, y)| texel(x, y)).collect();
    Texture::new("test", width, height, rgba).expect("expected a valid texture")
}

/// A square of 10 x 10 units in the plane z = 0, 100 x 100 pixels large, with `repeats` images along each side. Each
/// image has its own triangles, with texture coordinates of 0 to `scale`.
fn tiles(repeats: u32, scale: [f32; 2]) -> Mesh {
    let (mut positions, mut corners, mut triangles) = (Vec::new(), Corners::default(), Vec::new());
    let side = 10.0 / repeats as f32;
    for tile in 0..repeats * repeats {
        let (left, bottom) = ((tile % repeats) as f32 * side - 5.0, (tile / repeats) as f32 * side - 5.0);
        let first = positions.len() as u32;
        for [u, v] in [[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]] {
            positions.push([left + side * u, bottom + side * (1.0 - v), 0.0]);
            corners.uvs.push([u * scale[0], v * scale[1]]);
        }
        triangles.extend([[first, first + 1, first + 2], [first, first + 2, first + 3]]);
    }
    corners.vertices = (0..positions.len() as u32).collect();
    corners.normals = vec![[0.0, 0.0, 1.0]; positions.len()];
    Mesh::new(positions, corners, triangles).expect("expected a valid mesh")
}

/// Draws the tiles with an image, in a scene that also has images of `other_sizes` behind the camera.
fn draw(renderer: &mut Renderer, mesh: Mesh, image: Texture, other_sizes: &[[u32; 2]]) -> Vec<u8> {
    let mut builder = SceneBuilder::new();
    builder.parts.look.samples = 1;
    builder.parts.textures.push(image);
    builder = builder.add_domain(mesh, Material { color_texture: Some(0), ..Material::default() });
    for (index, size) in other_sizes.iter().enumerate() {
        builder.parts.textures.push(texture(*size, |_, _| [255, 0, 255, 255]));
        let material = Material { color_texture: Some(index + 1), ..Material::default() };
        builder = builder.add_domain(facing_rectangle(0.0, 0.0, 1.0, 1.0, 20.0), material);
    }
    let scene = builder.build();
    render_square(renderer, &scene, front_camera(FRAME_SIDE), FRAME_SIDE).image.rgba
}

/// The mean difference of two frames in levels of 255, over all channels of the pixels inside of the square.
fn mean_difference(a: &[u8], b: &[u8]) -> f64 {
    let is_inside = |index: &usize| {
        let pixel = (index / 4) as u32;
        [pixel % FRAME_SIDE, pixel / FRAME_SIDE].iter().all(|coordinate| (16..FRAME_SIDE - 16).contains(coordinate))
    };
    let differences: Vec<f64> =
        (0..a.len()).filter(is_inside).map(|index| f64::from(a[index].abs_diff(b[index]))).collect();
    differences.iter().sum::<f64>() / differences.len() as f64
}

/// The reference is the image alone, in its own array and with the filter of OpenGL. The thesis (B. Wang, "CUDA
/// Deformers for Model Reduction", equation 3.13) repeats an image until it fills a layer of the largest size; its
/// scale is corrected so that it covers the whole image. The control stretches the image to the layer of its array.
#[test]
fn images_in_a_mixed_array_look_as_they_do_alone() {
    let mut renderer = open_renderer();
    for size in [[16, 16], [25, 15]] {
        let [width, height] = size;
        let others: Vec<[u32; 2]> = SIZES.into_iter().filter(|other| *other != size).collect();
        let image = || texture(size, |x, y| texel(size, x, y));
        // From magnified images (6 pixels per texel) to minified ones (3 or 5 texels per pixel).
        for repeats in [1, 4, 8, 20] {
            let alone = draw(&mut renderer, tiles(repeats, [1.0; 2]), image(), &[]);
            let mixed = draw(&mut renderer, tiles(repeats, [1.0; 2]), image(), &others);
            let repeated = texture([128, 128], |x, y| texel(size, x % width, y % height));
            let scale = [width as f32 / 128.0, height as f32 / 128.0];
            let thesis = draw(&mut renderer, tiles(repeats, scale), repeated, &[]);
            let (error, thesis_error) = (mean_difference(&mixed, &alone), mean_difference(&thesis, &alone));
            println!("{size:?}, {repeats} repeats: mixed array {error:.3}, thesis {thesis_error:.3} of 255");
            assert!(error <= 0.05, "{size:?}, {repeats}: expected at most 0.05 of 255, got {error}");
            // The tolerance is for the rounding of filter weights: the thesis's method is exact where the layer is a
            // multiple of the image.
            let limit = thesis_error + 0.01;
            assert!(error <= limit, "{size:?}, {repeats}: expected at most {limit} of 255, got {error}");
        }
        let stretched = image::RgbaImage::from_raw(width, height, image().rgba().to_vec()).expect("expected an image");
        let stretched = image::imageops::resize(&stretched, 25, 16, image::imageops::FilterType::Triangle);
        let stretched = Texture::new("stretched", 25, 16, stretched.into_raw()).expect("expected a valid texture");
        let alone = draw(&mut renderer, tiles(1, [1.0; 2]), image(), &[]);
        let control = mean_difference(&draw(&mut renderer, tiles(1, [1.0; 2]), stretched, &[]), &alone);
        assert!(control > 1.0, "{size:?}: expected the stretched image to differ by more than 1 of 255, got {control}");
    }
}
