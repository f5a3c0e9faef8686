//! Triangle soups (lists of triangles) with cut-outs: triangles whose samples are discarded where the alpha of an image
//! is below a cutoff. Also finds the samples where two texture filters may disagree.

use modalcast_compute::reference::raster::cut_out::{alpha, footprint};
use modalcast_compute::reference::raster::{VisibilityBuffer, clipped_polygon, corners, depth_at, fan_triangles};
use modalcast_model::raster::{AlphaImage, AlphaMaterial, CutOuts};
use modalcast_model::scene::{CullMode, DrawRange, Viewport};

use super::soups::{Soup, all_soups, clip_space_viewport, perspective_viewport};
use crate::scenes::Random;

/// A soup whose triangles from index `cut_outs.first` on are alpha-tested.
pub(crate) struct CutOutSoup {
    pub(crate) soup: Soup,
    pub(crate) cut_outs: CutOuts,
}

impl CutOutSoup {
    /// Draws the soup with the reference rasterizer.
    pub(crate) fn rasterize(&self) -> VisibilityBuffer {
        let Soup { viewport, positions, triangles, groups, .. } = &self.soup;
        let mut raster = VisibilityBuffer::new(*viewport);
        groups.iter().for_each(|group| raster.draw_cut_out(positions, triangles, *group, &self.cut_outs));
        raster
    }

    /// For each sample of the viewport, whether the alpha of any cut-out triangle at the sample is within `tolerance`
    /// of its cutoff.
    pub(crate) fn ambiguous_samples(&self, tolerance: f32) -> Vec<bool> {
        let (soup, cut_outs) = (&self.soup, &self.cut_outs);
        let mut is_ambiguous = vec![false; soup.viewport.pixel_count()];
        for (triangle, cull_mode) in soup.groups.iter().flat_map(|group| {
            (group.first_triangle..group.first_triangle + group.triangle_count)
                .map(move |triangle| (triangle, group.cull_mode))
        }) {
            let Some(cut_out_index) = triangle.checked_sub(cut_outs.first) else { continue };
            let vertices = soup.triangles[triangle as usize];
            let Ok(clipped_polygon) = clipped_polygon(&soup.viewport, &soup.positions, vertices, cull_mode) else {
                continue;
            };
            let (corners, uvs) =
                (corners(&soup.viewport, &soup.positions, vertices), &cut_outs.uvs[cut_out_index as usize]);
            let cutoff = cut_outs.materials[cut_outs.material_indices[cut_out_index as usize] as usize].cutoff;
            // The samples that the polygon may cover are in columns x0 to x1 and rows y0 to y1.
            let [x0, y0, x1, y1] = clipped_polygon.samples;
            for clipped_triangle in fan_triangles(&clipped_polygon) {
                for (row, column) in (y0..=y1).flat_map(|row| (x0..=x1).map(move |column| (row, column))) {
                    if depth_at(&clipped_triangle, column, row).is_some() {
                        // Texture coordinates of the sample and their derivatives, which the texture filter needs.
                        let footprint = footprint(&soup.viewport, &corners, uvs, [column, row]);
                        let is_near_cutoff = (alpha(cut_outs, triangle, &footprint) - cutoff).abs() <= tolerance;
                        is_ambiguous[row as usize * soup.viewport.size()[0] as usize + column as usize] |=
                            is_near_cutoff;
                    }
                }
            }
        }
        is_ambiguous
    }
}

/// An image with a full mip chain; `texel` returns the alpha of a level, column and row.
pub(crate) fn alpha_image(width: u32, height: u32, mut texel: impl FnMut(u32, u32, u32) -> u8) -> AlphaImage {
    let levels = (0..=width.max(height).ilog2()).map(|level| {
        let [width, height] = [width, height].map(|side| (side >> level).max(1));
        (0..width * height).map(|index| texel(level, index % width, index / width)).collect()
    });
    AlphaImage { width, height, levels: levels.collect() }
}

/// [`all_soups`] with cut-outs: the last two thirds of the triangles are alpha-tested. Each image has one alpha value,
/// so that the result does not depend on the texture filter.
pub(crate) fn constant_alpha_soups() -> Vec<CutOutSoup> {
    let mut random = Random(21);
    // Image 0 is transparent, image 1 is opaque. A cutoff of NaN discards every sample.
    let material = |alpha, cutoff, image| AlphaMaterial { alpha, cutoff, image };
    let materials = vec![
        material(1.0, 0.5, Some(0)),
        material(1.0, 0.5, Some(1)),
        material(0.25, 0.5, Some(1)),
        material(1.0, 0.0, Some(0)),
        material(0.75, 0.75, None),
        material(0.5, 0.75, None),
        material(1.0, f32::NAN, None),
    ];
    let images = vec![alpha_image(5, 3, |_, _, _| 0), alpha_image(8, 1, |_, _, _| 255)];
    let add_cut_outs = |soup: Soup| {
        let first = soup.triangles.len() as u32 / 3;
        let count = soup.triangles.len() - first as usize;
        // Texture coordinates in -3 to 3, so that the images repeat.
        let mut random_uv = || [random.next_number(), random.next_number()].map(|coordinate| 3.0 * coordinate);
        let uvs = (0..count).map(|_| [random_uv(), random_uv(), random_uv()]).collect();
        let material_indices = (0..count).map(|index| (index % materials.len()) as u32).collect();
        let (materials, images) = (materials.clone(), images.clone());
        CutOutSoup { soup, cut_outs: CutOuts { first, uvs, material_indices, materials, images, anisotropy: 8.0 } }
    };
    all_soups().into_iter().map(add_cut_outs).collect()
}

/// Two triangles that fill a viewport of `side` x `side` pixels with one image; u grows to the right, v downwards. If
/// the viewport has the size of the image, each sample is the center of a texel.
pub(crate) fn sheet_soup(side: u32, image: AlphaImage) -> CutOutSoup {
    let positions = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]].map(|[x, y]| [x, y, 0.0]).concat();
    let triangles = vec![[0, 1, 2], [0, 2, 3]];
    let uv_of_vertex = |vertex: u32| [[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]][vertex as usize];
    let cut_outs = CutOuts {
        first: 0,
        uvs: triangles.iter().map(|vertices: &[u32; 3]| vertices.map(uv_of_vertex)).collect(),
        material_indices: vec![0; 2],
        materials: vec![AlphaMaterial { alpha: 1.0, cutoff: 0.5, image: Some(0) }],
        images: vec![image],
        anisotropy: 1.0,
    };
    let groups = vec![DrawRange { first_triangle: 0, triangle_count: 2, cull_mode: CullMode::Back }];
    CutOutSoup {
        soup: Soup { name: "sheet", positions, triangles, groups, viewport: clip_space_viewport(side, side) },
        cut_outs,
    }
}

/// A floor one unit below the camera, split into `divisions` x `divisions` rectangles, and an opaque wall beyond its
/// far end. The camera is at the origin and looks along -z. The floor extends from z = 9, behind the camera, to
/// z = -20; the wall is at z = -20.5. The alpha image of the floor is smooth, so that filters of low precision differ
/// little.
pub(crate) fn floor_soup(divisions: u32) -> CutOutSoup {
    // Vertices 0 to 3 and triangles 0 and 1 are the wall.
    let mut positions = [[-20.0, -9.0, -20.5], [20.0, -9.0, -20.5], [20.0, 9.0, -20.5], [-20.0, 9.0, -20.5]].concat();
    let mut triangles = vec![[0, 1, 2], [0, 2, 3]];
    let fraction = |index: u32| index as f32 / divisions as f32;
    let grid = (0..=divisions).flat_map(|row| (0..=divisions).map(move |column| (column, row)));
    positions.extend(grid.flat_map(|(x, z)| [18.0 * fraction(x) - 9.0, -1.0, 9.0 - 29.0 * fraction(z)]));
    let mut uvs = Vec::new();
    for (column, row) in (0..divisions).flat_map(|row| (0..divisions).map(move |column| (column, row))) {
        let corners = [(0, 0), (1, 0), (1, 1), (0, 1)].map(|(right, down)| (column + right, row + down));
        for corner_indices in [[0, 1, 2], [0, 2, 3]] {
            let corners = corner_indices.map(|index: usize| corners[index]);
            triangles.push(corners.map(|(x, z)| 4 + z * (divisions + 1) + x));
            uvs.push(corners.map(|(x, z)| [3.0 * fraction(x), 5.0 * fraction(z)]));
        }
    }
    let cut_outs = CutOuts {
        first: 2,
        material_indices: vec![0; uvs.len()],
        uvs,
        materials: vec![AlphaMaterial { alpha: 1.0, cutoff: 0.4, image: Some(0) }],
        images: vec![wave_image()],
        anisotropy: 1.0,
    };
    let viewport: Viewport = perspective_viewport(192, 128, 0.1, 100.0);
    let groups = vec![
        DrawRange { first_triangle: 0, triangle_count: 2, cull_mode: CullMode::Back },
        DrawRange { first_triangle: 2, triangle_count: triangles.len() as u32 - 2, cull_mode: CullMode::None },
    ];
    CutOutSoup { soup: Soup { name: "floor", positions, triangles, groups, viewport }, cut_outs }
}

/// An alpha image: the sum of one sine wave per axis. The amplitude differs per mip level, so that tests detect a read
/// of a wrong level.
fn wave_image() -> AlphaImage {
    let sine = |texel: u32, side: u32| (std::f32::consts::TAU * (texel as f32 + 0.5) / side as f32).sin();
    alpha_image(64, 32, |level, column, row| {
        let sides = [64, 32].map(|side: u32| (side >> level).max(1));
        let amplitude = 60.0 - 4.0 * level as f32;
        (127.5 + amplitude * (sine(column, sides[0]) + sine(row, sides[1]))).round() as u8
    })
}
