//! The `images` scene: upright panels with images of different sizes, and a floor. Each surface repeats its image.

use std::f32::consts::TAU;

use super::rigid_domain::add_rigid_domain;
use modalcast_model::domain::{Material, Mesh, Texture};
use modalcast_model::error::Result;
use modalcast_model::scene::{RenderSettings, SceneParts};

/// Image sizes of the upright panels, from left to right, lower row first. In a frame of 640 x 360 pixels, a texel of
/// the smallest image is four pixels wide and a texel of the largest half a pixel.
const SIZES: [[u32; 2]; 6] = [[16, 16], [25, 15], [32, 32], [64, 64], [75, 50], [128, 128]];
/// Repetitions of the image along each side of an upright panel.
const PANEL_REPETITIONS: usize = 2;
/// Repetitions of the image along each side of the floor.
const FLOOR_REPETITIONS: usize = 24;
/// Size of the floor's image.
const FLOOR_IMAGE_SIZE: [u32; 2] = [24, 24];

/// Builds the scene.
///
/// # Errors
/// None in practice: its sizes are constants.
pub(super) fn build_panels() -> Result<SceneParts> {
    let mut parts = SceneParts::named("images");
    for (index, size) in SIZES.iter().enumerate() {
        let (column, row) = (index % 3, index / 3);
        // Panels of side 1 with gaps of 0.1.
        let corner = [1.1 * column as f32 - 1.6, 0.1 + 1.1 * row as f32, 0.0];
        let mesh = repeated_quads(corner, [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], PANEL_REPETITIONS)?;
        add_panel(&mut parts, &format!("panel {} x {}", size[0], size[1]), mesh, *size)?;
    }
    let floor = repeated_quads([-4.0, 0.0, 5.0], [[8.0, 0.0, 0.0], [0.0, 0.0, -8.0]], FLOOR_REPETITIONS)?;
    add_panel(&mut parts, "floor", floor, FLOOR_IMAGE_SIZE)?;
    parts.look = RenderSettings { sun: [0.35, 0.6, 0.7], shadow: None, ground: None, ..RenderSettings::default() };
    Ok(parts)
}

/// Adds a panel with a new image of this size.
fn add_panel(parts: &mut SceneParts, name: &str, mesh: Mesh, [width, height]: [u32; 2]) -> Result<()> {
    parts.textures.push(test_image(name, width, height)?);
    let color_texture = Some(parts.textures.len() - 1);
    add_rigid_domain(parts, name, mesh, Material { color_texture, double_sided: true, ..Material::default() })
}

/// A parallelogram of `repetitions` x `repetitions` cells. Each cell shows the image once and has its own corners.
fn repeated_quads(corner: [f32; 3], sides: [[f32; 3]; 2], repetitions: usize) -> Result<Mesh> {
    let point = |u: usize, v: usize| {
        let [u, v] = [u, v].map(|index| index as f32 / repetitions as f32);
        std::array::from_fn(|axis| corner[axis] + u * sides[0][axis] + v * sides[1][axis])
    };
    let mut positions: Vec<[f32; 3]> = Vec::new();
    let mut triangles: Vec<[u32; 3]> = Vec::new();
    let mut uvs = Vec::new();
    for (column, row) in (0..repetitions * repetitions).map(|cell| (cell % repetitions, cell / repetitions)) {
        let first_corner = positions.len() as u32;
        for (u, v) in [(0, 0), (1, 0), (1, 1), (0, 1)] {
            positions.push(point(column + u, row + v));
            uvs.push([(column + u) as f32, (row + v) as f32]);
        }
        triangles.extend([
            [first_corner, first_corner + 1, first_corner + 2],
            [first_corner, first_corner + 2, first_corner + 3],
        ]);
    }
    // The second side of an upright panel points up; the second side of the floor is horizontal.
    let normal = if sides[1][1] > 0.0 { [0.0, 0.0, 1.0] } else { [0.0, 1.0, 0.0] };
    let normals = vec![normal; positions.len()];
    Mesh::from_indexed(positions, normals, uvs, triangles)
}

/// A seamless image: waves of whole periods in three colors, with a thin dark border that marks its edges.
fn test_image(name: &str, width: u32, height: u32) -> Result<Texture> {
    let wave = |phase: f32| 0.5 + 0.5 * (TAU * phase).sin();
    let texel = |index: u32| {
        let (x, y) = (index % width, index / width);
        let (u, v) = ((x as f32 + 0.5) / width as f32, (y as f32 + 0.5) / height as f32);
        let is_border = x < width.div_ceil(32) || y < height.div_ceil(32);
        let brightness = if is_border { 0.15 } else { 0.35 + 0.65 * wave(3.0 * u + 2.0 * wave(v)) };
        let color = [0.9 - 0.4 * wave(v), 0.45 + 0.4 * wave(u + v), 0.35 + 0.5 * wave(2.0 * v - u)];
        let [r, g, b] = color.map(|channel| (255.0 * channel * brightness) as u8);
        [r, g, b, 255]
    };
    Texture::new(name, width, height, (0..width * height).flat_map(texel).collect())
}
