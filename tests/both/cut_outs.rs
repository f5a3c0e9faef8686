//! Triangle soups with cut-outs, and the samples where two filters may disagree.

use modalcast_compute::reference::raster::cut_out::{alpha, footprint};
use modalcast_compute::reference::raster::{VisibilityBuffer, clipped_polygon, corners, depth_at, fan_triangles};
use modalcast_model::raster::{AlphaImage, AlphaMaterial, CutOuts};
use modalcast_model::scene::{CullMode, DrawRange, Viewport};

use super::soups::{Soup, flat, perspective, soups};
use crate::scenes::Random;

/// A soup whose triangles from `first` on are cut out.
pub(crate) struct Holes {
    pub(crate) soup: Soup,
    pub(crate) cut_outs: CutOuts,
}

impl Holes {
    /// The result of the definition.
    pub(crate) fn drawn(&self) -> VisibilityBuffer {
        let Soup { window, positions, triangles, groups, .. } = &self.soup;
        let mut raster = VisibilityBuffer::new(*window);
        groups.iter().for_each(|group| raster.draw_cut_out(positions, triangles, *group, &self.cut_outs));
        raster
    }

    /// Samples at which an alpha value is within `tolerance` of its threshold.
    pub(crate) fn doubtful(&self, tolerance: f32) -> Vec<bool> {
        let (soup, cut_outs) = (&self.soup, &self.cut_outs);
        let mut list = vec![false; soup.window.pixel_count()];
        for (triangle, faces) in soup
            .groups
            .iter()
            .flat_map(|group| (group.first..group.first + group.triangles).map(move |triangle| (triangle, group.faces)))
        {
            let Some(own) = triangle.checked_sub(cut_outs.first) else { continue };
            let vertices = soup.triangles[triangle as usize];
            let Ok(clipped_polygon) = clipped_polygon(&soup.window, &soup.positions, vertices, faces) else { continue };
            let (corners, uvs) = (corners(&soup.window, &soup.positions, vertices), &cut_outs.uvs[own as usize]);
            let cutoff = cut_outs.materials[cut_outs.material_indices[own as usize] as usize].cutoff;
            let [x0, y0, x1, y1] = clipped_polygon.samples;
            for piece in fan_triangles(&clipped_polygon) {
                for (row, column) in (y0..=y1).flat_map(|row| (x0..=x1).map(move |column| (row, column))) {
                    if depth_at(&piece, column, row).is_some() {
                        let at = footprint(&soup.window, &corners, uvs, [column, row]);
                        let near = (alpha(cut_outs, triangle, &at) - cutoff).abs() <= tolerance;
                        list[row as usize * soup.window.size()[0] as usize + column as usize] |= near;
                    }
                }
            }
        }
        list
    }
}

/// An image whose level `l` has the texels `of(l, column, row)`.
pub(crate) fn image(width: u32, height: u32, mut of: impl FnMut(u32, u32, u32) -> u8) -> AlphaImage {
    let levels = (0..=width.max(height).ilog2()).map(|level| {
        let [width, height] = [width, height].map(|side| (side >> level).max(1));
        (0..width * height).map(|at| of(level, at % width, at / width)).collect()
    });
    AlphaImage { width, height, levels: levels.collect() }
}

/// Soups whose images are uniform, and surfaces without an image, so that the result does not depend on the filter. All
/// but the first third of the triangles are cut out.
pub(crate) fn plain_holes() -> Vec<Holes> {
    let mut random = Random(21);
    let surface = |alpha, cutoff, image| AlphaMaterial { alpha, cutoff, image };
    let materials = vec![
        surface(1.0, 0.5, Some(0)),
        surface(1.0, 0.5, Some(1)),
        surface(0.25, 0.5, Some(1)),
        surface(1.0, 0.0, Some(0)),
        surface(0.75, 0.75, None),
        surface(0.5, 0.75, None),
        surface(1.0, f32::NAN, None),
    ];
    let images = vec![image(5, 3, |_, _, _| 0), image(8, 1, |_, _, _| 255)];
    let holes = |soup: Soup| {
        let first = soup.triangles.len() as u32 / 3;
        let count = soup.triangles.len() - first as usize;
        let mut uv = || [random.number(), random.number()].map(|number| 3.0 * number);
        let uvs = (0..count).map(|_| [uv(), uv(), uv()]).collect();
        let material_indices = (0..count).map(|at| (at % materials.len()) as u32).collect();
        let (materials, images) = (materials.clone(), images.clone());
        Holes { soup, cut_outs: CutOuts { first, uvs, material_indices, materials, images, anisotropy: 8.0 } }
    };
    soups().into_iter().map(holes).collect()
}

/// Two triangles that fill a window of `side` x `side` pixels, with an image from corner to corner: u grows to the
/// right, v downwards. In a window of the size of the image, each sample is the center of a texel.
pub(crate) fn sheet(side: u32, image: AlphaImage) -> Holes {
    let positions = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]].map(|[x, y]| [x, y, 0.0]).concat();
    let triangles = vec![[0, 1, 2], [0, 2, 3]];
    let uv = |corner: u32| [[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]][corner as usize];
    let cut_outs = CutOuts {
        first: 0,
        uvs: triangles.iter().map(|corners: &[u32; 3]| corners.map(uv)).collect(),
        material_indices: vec![0; 2],
        materials: vec![AlphaMaterial { alpha: 1.0, cutoff: 0.5, image: Some(0) }],
        images: vec![image],
        anisotropy: 1.0,
    };
    let groups = vec![DrawRange { first: 0, triangles: 2, faces: CullMode::Back }];
    Holes { soup: Soup { name: "a sheet", positions, triangles, groups, window: flat(side, side) }, cut_outs }
}

/// A floor one unit below the eye that continues behind it, split into `cuts` x `cuts` rectangles, and a wall without
/// holes at its end. The floor's image is smooth, so that filters of low precision differ little.
pub(crate) fn floor(cuts: u32) -> Holes {
    let mut positions = [[-20.0, -9.0, -20.5], [20.0, -9.0, -20.5], [20.0, 9.0, -20.5], [-20.0, 9.0, -20.5]].concat();
    let mut triangles = vec![[0, 1, 2], [0, 2, 3]];
    let part = |at: u32| at as f32 / cuts as f32;
    let places = (0..=cuts).flat_map(|row| (0..=cuts).map(move |column| (column, row)));
    positions.extend(places.flat_map(|(x, z)| [18.0 * part(x) - 9.0, -1.0, 9.0 - 29.0 * part(z)]));
    let mut uvs = Vec::new();
    for (column, row) in (0..cuts).flat_map(|row| (0..cuts).map(move |column| (column, row))) {
        let corners = [(0, 0), (1, 0), (1, 1), (0, 1)].map(|(right, far)| (column + right, row + far));
        for list in [[0, 1, 2], [0, 2, 3]] {
            let corners = list.map(|corner: usize| corners[corner]);
            triangles.push(corners.map(|(x, z)| 4 + z * (cuts + 1) + x));
            uvs.push(corners.map(|(x, z)| [3.0 * part(x), 5.0 * part(z)]));
        }
    }
    let cut_outs = CutOuts {
        first: 2,
        material_indices: vec![0; uvs.len()],
        uvs,
        materials: vec![AlphaMaterial { alpha: 1.0, cutoff: 0.4, image: Some(0) }],
        images: vec![waves()],
        anisotropy: 1.0,
    };
    let window: Viewport = perspective(192, 128, 0.1, 100.0);
    let groups = vec![
        DrawRange { first: 0, triangles: 2, faces: CullMode::Back },
        DrawRange { first: 2, triangles: triangles.len() as u32 - 2, faces: CullMode::None },
    ];
    Holes { soup: Soup { name: "a floor", positions, triangles, groups, window }, cut_outs }
}

/// One wave across and one down. The levels differ, so that reading a wrong level is detected.
fn waves() -> AlphaImage {
    let wave = |at: u32, of: u32| (std::f32::consts::TAU * (at as f32 + 0.5) / of as f32).sin();
    image(64, 32, |level, column, row| {
        let sides = [64, 32].map(|side: u32| (side >> level).max(1));
        let height = 60.0 - 4.0 * level as f32;
        (127.5 + height * (wave(column, sides[0]) + wave(row, sides[1]))).round() as u8
    })
}
