//! Colors of vertices, drawn through an image: the renderer has no colors per vertex. Each triangle has its own patch
//! of 2 x 2 texels. The corners of the triangle are the centers of three texels, and the fourth texel is chosen so that
//! the bilinear lookup is the linear interpolation of the three colors. Coarser levels of the image mix patches of
//! triangles that are close in the file; they are used where a triangle is smaller than a pixel.

use crate::domain::{Corners, Mesh, Texture};
use crate::error::{Result, invalid};

/// The largest number of patches in one row and in one column of an image of 8192 x 8192 texels.
const MAX_PATCHES_PER_SIDE: usize = 4096;

/// How the vertices of a mesh are colored.
#[derive(Debug)]
pub(in crate::load) enum VertexColors {
    /// All vertices have this linear color, with alpha.
    Uniform([f32; 4]),
    /// A mesh with separate corners for each triangle, and the image with the patches of all triangles.
    Image(Box<(Mesh, Texture)>),
}

/// Colors a mesh. `linear_colors` has one linear color with alpha, 0 to 1, per vertex.
///
/// # Errors
/// `Invalid` if the mesh has more than 16,777,216 triangles.
pub(in crate::load) fn paint(mesh: &Mesh, linear_colors: &[[f32; 4]]) -> Result<VertexColors> {
    if let [first, others @ ..] = linear_colors
        && others.iter().all(|color| color == first)
    {
        return Ok(VertexColors::Uniform(*first));
    }
    let triangle_count = mesh.triangles().len();
    let columns = patch_columns(triangle_count)?;
    let (width, height) = (2 * columns, 2 * triangle_count.div_ceil(columns));
    let mut rgba = vec![u8::MAX; 4 * width * height];
    let mut corners = Corners::default();
    for (index, triangle) in mesh.triangles().iter().enumerate() {
        let (x, y) = (2 * (index % columns), 2 * (index / columns));
        let vertices = triangle.map(|corner| mesh.corners().vertices[corner as usize]);
        let patch = Patch::new(vertices.map(|vertex| linear_colors[vertex as usize]));
        for (texel, color) in patch.texels.iter().enumerate() {
            let first_byte = 4 * ((y + texel / 2) * width + x + texel % 2);
            rgba[first_byte..first_byte + 4].copy_from_slice(&encode(*color));
        }
        for (corner, texel) in triangle.iter().zip(patch.texel_of_corner) {
            let center = [(x + texel % 2) as f32 + 0.5, (y + texel / 2) as f32 + 0.5];
            corners.vertices.push(mesh.corners().vertices[*corner as usize]);
            corners.normals.push(mesh.corners().normals[*corner as usize]);
            corners.uvs.push([center[0] / width as f32, center[1] / height as f32]);
        }
    }
    let texture = Texture::new("vertex colors", width as u32, height as u32, rgba)?;
    Ok(VertexColors::Image(Box::new((with_separate_corners(mesh, corners)?, texture))))
}

/// The number of columns of patches in an image.
fn patch_columns(triangle_count: usize) -> Result<usize> {
    let columns = (triangle_count as f64).sqrt().ceil() as usize;
    if columns > MAX_PATCHES_PER_SIDE {
        let limit = MAX_PATCHES_PER_SIDE * MAX_PATCHES_PER_SIDE;
        return Err(invalid("vertex colors", format!("at most {limit} triangles"), triangle_count));
    }
    Ok(columns)
}

/// The mesh with three corners of their own for each triangle.
fn with_separate_corners(mesh: &Mesh, corners: Corners) -> Result<Mesh> {
    let triangle_count = mesh.triangles().len() as u32;
    let triangles = (0..triangle_count).map(|index| [3 * index, 3 * index + 1, 3 * index + 2]).collect();
    let separate = Mesh::new(mesh.rest_positions().to_vec(), corners, triangles)?;
    match mesh.inner_edges() {
        [] => Ok(separate),
        inner_edges => separate.with_inner_edges(inner_edges.to_vec()),
    }
}

/// Texels per side of the patches that [`paint_over`] needs: as many as the longest edge of a triangle has in the image, as
/// far as an image of 8192 x 8192 texels has room for all triangles.
pub(in crate::load) fn patch_side(mesh: &Mesh, image: &Texture) -> Result<usize> {
    let uv = |corner: u32| mesh.corners().uvs[corner as usize];
    let size = [image.width() as f32, image.height() as f32];
    let length = |a: [f32; 2], b: [f32; 2]| ((a[0] - b[0]) * size[0]).abs().max(((a[1] - b[1]) * size[1]).abs());
    let longest_edge = |triangle: &[u32; 3]| {
        let [a, b, c] = triangle.map(uv);
        length(a, b).max(length(b, c)).max(length(c, a))
    };
    let longest = mesh.triangles().iter().map(longest_edge).fold(0.0, f32::max);
    let limit = 2 * MAX_PATCHES_PER_SIDE / patch_columns(mesh.triangles().len())?;
    Ok((longest.ceil() as usize + 1).clamp(2, limit))
}

/// Colors a mesh with an image whose colors are multiplied by those of the vertices. The texture coordinates of the returned
/// mesh refer to the returned texture, in which each triangle has a patch of [`patch_side`] texels per side.
///
/// # Errors
/// As for [`paint`].
pub(in crate::load) fn paint_over(
    mesh: &Mesh,
    linear_colors: &[[f32; 4]],
    image: &Texture,
    side: usize,
) -> Result<(Mesh, Texture)> {
    let triangle_count = mesh.triangles().len();
    let columns = patch_columns(triangle_count)?;
    let (width, height) = (side * columns, side * triangle_count.div_ceil(columns));
    let mut rgba = vec![0; 4 * width * height];
    let mut corners = Corners::default();
    for (index, triangle) in mesh.triangles().iter().enumerate() {
        let (x, y) = (side * (index % columns), side * (index / columns));
        let uvs = triangle.map(|corner| mesh.corners().uvs[corner as usize]);
        let colors = triangle.map(|corner| linear_colors[mesh.corners().vertices[corner as usize] as usize]);
        for texel in 0..side * side {
            let [second, third] = [texel % side, texel / side].map(|step| step as f32 / (side - 1) as f32);
            let weights = [1.0 - second - third, second, third];
            let uv = [0, 1].map(|axis| (0..3).map(|corner| weights[corner] * uvs[corner][axis]).sum());
            let color = [0, 1, 2, 3].map(|channel| {
                (0..3).map(|corner| weights[corner] * colors[corner][channel]).sum::<f32>().clamp(0.0, 1.0)
            });
            let texel_color = sample(image, uv);
            let product = [0, 1, 2, 3].map(|channel| color[channel] * texel_color[channel]);
            let first_byte = 4 * ((y + texel / side) * width + x + texel % side);
            rgba[first_byte..first_byte + 4].copy_from_slice(&encode(product));
        }
        for (corner, [step_x, step_y]) in triangle.iter().zip([[0, 0], [side - 1, 0], [0, side - 1]]) {
            corners.vertices.push(mesh.corners().vertices[*corner as usize]);
            corners.normals.push(mesh.corners().normals[*corner as usize]);
            let center = [(x + step_x) as f32 + 0.5, (y + step_y) as f32 + 0.5];
            corners.uvs.push([center[0] / width as f32, center[1] / height as f32]);
        }
    }
    let texture = Texture::new(format!("{} with vertex colors", image.name), width as u32, height as u32, rgba)?;
    Ok((with_separate_corners(mesh, corners)?, texture))
}

/// The linear color of a repeated texture, interpolated between the four nearest texels.
fn sample(image: &Texture, [u, v]: [f32; 2]) -> [f32; 4] {
    let [width, height] = [image.width() as usize, image.height() as usize];
    let [x, y] = [u.rem_euclid(1.0) * width as f32 - 0.5, v.rem_euclid(1.0) * height as f32 - 0.5];
    let [weight_x, weight_y] = [x - x.floor(), y - y.floor()];
    let texel = |step_x: usize, step_y: usize| {
        // The sum is positive, because x and y are at least -0.5.
        let column = ((x.floor() + width as f32) as usize + step_x) % width;
        let row = ((y.floor() + height as f32) as usize + step_y) % height;
        let texel = &image.rgba()[4 * (row * width + column)..];
        let channel = |channel: usize| f32::from(texel[channel]) / 255.0;
        [linear_from_srgb(channel(0)), linear_from_srgb(channel(1)), linear_from_srgb(channel(2)), channel(3)]
    };
    let mut color = [0.0; 4];
    for (step, weight) in [
        ([0, 0], (1.0 - weight_x) * (1.0 - weight_y)),
        ([1, 0], weight_x * (1.0 - weight_y)),
        ([0, 1], (1.0 - weight_x) * weight_y),
        ([1, 1], weight_x * weight_y),
    ] {
        let texel = texel(step[0], step[1]);
        color.iter_mut().zip(texel).for_each(|(sum, channel)| *sum += weight * channel);
    }
    color
}

/// The four texels of a triangle, row by row, in linear color.
struct Patch {
    texels: [[f32; 4]; 4],
    /// The texel of each corner of the triangle.
    texel_of_corner: [usize; 3],
}

impl Patch {
    /// The fourth texel has the color p + q - o, where o is the color of the corner at the first texel, and p and q are
    /// the other two. That corner is chosen so that p + q - o is as little as possible outside of 0 to 1. For gray
    /// colors, the corner with the middle value keeps p + q - o in this range.
    fn new(colors: [[f32; 4]; 3]) -> Self {
        let fourth_of = |origin: usize| {
            let [p, q, o] = [colors[(origin + 1) % 3], colors[(origin + 2) % 3], colors[origin]];
            [0, 1, 2, 3].map(|channel| p[channel] + q[channel] - o[channel])
        };
        let excess = |color: [f32; 4]| color.iter().map(|value| (value - value.clamp(0.0, 1.0)).abs()).sum::<f32>();
        let origin = [0, 1, 2].into_iter().min_by(|a, b| excess(fourth_of(*a)).total_cmp(&excess(fourth_of(*b))));
        let origin = origin.unwrap_or(0);
        let mut texel_of_corner = [0; 3];
        (texel_of_corner[(origin + 1) % 3], texel_of_corner[(origin + 2) % 3]) = (1, 2);
        let fourth = fourth_of(origin).map(|value| value.clamp(0.0, 1.0));
        let texels = [colors[origin], colors[(origin + 1) % 3], colors[(origin + 2) % 3], fourth];
        Self { texels, texel_of_corner }
    }
}

/// Converts a channel of a color from sRGB: the inverse of the transfer function of IEC 61966-2-1.
pub(in crate::load) fn linear_from_srgb(encoded: f32) -> f32 {
    if encoded <= 0.040_45 { encoded / 12.92 } else { ((encoded + 0.055) / 1.055).powf(2.4) }
}

/// A linear color with alpha as four bytes of an image.
fn encode([red, green, blue, alpha]: [f32; 4]) -> [u8; 4] {
    [srgb_byte(red), srgb_byte(green), srgb_byte(blue), (alpha * 255.0).round() as u8]
}

fn srgb_byte(linear: f32) -> u8 {
    let encoded = if linear <= 0.003_130_8 { linear * 12.92 } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 };
    (encoded * 255.0).round() as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square() -> Mesh {
        let positions = vec![[0.0; 3], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]];
        Mesh::from_indexed(positions, vec![[0.0, 0.0, 1.0]; 4], vec![], vec![[0, 1, 2], [0, 2, 3]]).expect("a mesh")
    }

    const fn opaque([red, green, blue]: [f32; 3]) -> [f32; 4] {
        [red, green, blue, 1.0]
    }

    /// An image and colors of vertices multiply each other at every point of the surface.
    #[test]
    fn image_is_multiplied_by_the_colors_of_the_vertices() {
        let uvs = vec![[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
        let mesh = Mesh::from_indexed(
            square().rest_positions().to_vec(),
            vec![[0.0, 0.0, 1.0]; 4],
            uvs,
            square().triangles().to_vec(),
        );
        let mesh = mesh.expect("a mesh");
        // Each column of the image has one gray.
        let gray = |column: u32| (40 * column) as u8;
        let texels = (0..16_u32).flat_map(|texel| [gray(texel % 4), gray(texel % 4), gray(texel % 4), 255]).collect();
        let image = Texture::new("columns", 4, 4, texels).expect("an image");
        let colors = [[1.0, 0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 1.0], [0.0, 1.0, 0.0, 1.0], [0.0, 1.0, 0.0, 0.0]];
        let side = patch_side(&mesh, &image).expect("a side").max(33);
        let (painted, texture) = paint_over(&mesh, &colors, &image, side).expect("a painted mesh");
        for (triangle, source) in painted.triangles().iter().zip(mesh.triangles()) {
            for weights in [[1.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.2, 0.3, 0.5], [0.0, 0.25, 0.75]] {
                let mixed = |values: [[f32; 2]; 3]| {
                    [0, 1].map(|axis| (0..3).map(|corner| weights[corner] * values[corner][axis]).sum::<f32>())
                };
                let color =
                    super::sample(&texture, mixed(triangle.map(|corner| painted.corners().uvs[corner as usize])));
                let texel = super::sample(&image, mixed(source.map(|corner| mesh.corners().uvs[corner as usize])));
                let expected = [0, 1, 2, 3].map(|channel| {
                    let vertex = source.map(|corner| colors[corner as usize][channel]);
                    texel[channel] * (0..3).map(|corner| weights[corner] * vertex[corner]).sum::<f32>()
                });
                for channel in 0..4 {
                    let error = (color[channel] - expected[channel]).abs();
                    assert!(error < 0.01, "{weights:?}: expected {expected:?}, got {color:?}");
                }
            }
        }
    }

    /// The linear color of a texture at `uv`, interpolated as the sampler does.
    fn sample(texture: &Texture, uv: [f32; 2]) -> [f32; 3] {
        let [x, y] = [uv[0] * texture.width() as f32 - 0.5, uv[1] * texture.height() as f32 - 0.5];
        let texel = |x: usize, y: usize| {
            let first_byte = 4 * (y * texture.width() as usize + x);
            [0, 1, 2].map(|channel| linear_from_srgb(f32::from(texture.rgba()[first_byte + channel]) / 255.0))
        };
        let (left, top) = (x.floor() as usize, y.floor() as usize);
        let (u, v) = (x - x.floor(), y - y.floor());
        let weighted = [
            (texel(left, top), (1.0 - u) * (1.0 - v)),
            (texel((left + 1).min(texture.width() as usize - 1), top), u * (1.0 - v)),
            (texel(left, (top + 1).min(texture.height() as usize - 1)), (1.0 - u) * v),
        ];
        let last = texel((left + 1).min(texture.width() as usize - 1), (top + 1).min(texture.height() as usize - 1));
        [0, 1, 2].map(|channel| {
            weighted.iter().map(|(texel, weight)| texel[channel] * weight).sum::<f32>() + last[channel] * u * v
        })
    }

    #[test]
    fn image_interpolates_the_colors_of_the_corners_linearly() {
        // Black, white and two grays: 0.5 and 0.735 encode the linear values 0.214 and 0.5.
        let colors = [[0.0; 3], [1.0; 3], [0.5; 3], [0.735; 3]];
        let VertexColors::Image(painted) =
            paint(&square(), &colors.map(|color| opaque(color.map(linear_from_srgb)))).expect("a painted mesh")
        else {
            panic!("expected an image")
        };
        let (mesh, texture) = *painted;
        assert_eq!(mesh.rest_positions(), square().rest_positions());
        assert_eq!((mesh.corners().vertices.len(), mesh.corners().vertices[4]), (6, 2));
        for triangle in mesh.triangles() {
            for weights in [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.5, 0.5, 0.0], [0.2, 0.3, 0.5], [1.0 / 3.0; 3]] {
                let mut uv = [0.0_f32; 2];
                let mut expected = 0.0;
                for (corner, weight) in triangle.iter().zip(weights) {
                    let corner = *corner as usize;
                    let corner_uv = mesh.corners().uvs[corner];
                    uv = [uv[0] + weight * corner_uv[0], uv[1] + weight * corner_uv[1]];
                    expected += weight * linear_from_srgb(colors[mesh.corners().vertices[corner] as usize][0]);
                }
                let color = sample(&texture, uv);
                assert!((color[0] - expected).abs() < 0.005, "{weights:?}: expected {expected}, got {color:?}");
            }
        }
    }

    #[test]
    fn equal_colors_need_no_image() {
        let VertexColors::Uniform(color) = paint(&square(), &[[0.25, 0.0, 1.0, 0.5]; 4]).expect("colors") else {
            panic!("expected one color")
        };
        assert_eq!(color, [0.25, 0.0, 1.0, 0.5]);
    }

    #[test]
    fn saturated_colors_stay_in_range() {
        // Red, green and blue: every choice of the fourth texel leaves the range.
        let patch = Patch::new([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(opaque));
        assert!(patch.texels.iter().flatten().all(|value| (0.0..=1.0).contains(value)));
        let mut corners = patch.texel_of_corner;
        corners.sort_unstable();
        assert_eq!(corners, [0, 1, 2]);
    }
}
