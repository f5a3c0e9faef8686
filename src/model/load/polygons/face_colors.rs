//! Colors of faces: the renderer has none, so each color becomes a material.

use std::collections::{HashMap, HashSet};

use super::{PolygonMesh, linear_from_srgb};
use crate::domain::Material;

/// The largest number of materials. More colors are rounded to [`ROUNDED_BITS`] bits per channel.
const MAX_COLORS: usize = 4096;
/// 12 bits per color are [`MAX_COLORS`] colors.
const ROUNDED_BITS: u32 = 4;

impl PolygonMesh {
    /// Replaces the materials of the faces by one per color of [`PolygonMesh::face_colors`]. Returns the materials in the
    /// order of [`PolygonMesh::materials`].
    pub(in crate::load) fn color_faces(&mut self, remarks: &mut Vec<String>) -> Vec<Material> {
        let colors = std::mem::take(&mut self.face_colors);
        let color_count = colors.iter().collect::<HashSet<_>>().len();
        let is_rounded = color_count > MAX_COLORS;
        if is_rounded {
            remarks.push(format!("{color_count} colors of faces are rounded to at most {MAX_COLORS} colors"));
        }
        let (mut materials, mut index_of) = (Vec::new(), HashMap::new());
        for (face, color) in self.faces.iter_mut().zip(colors) {
            let color = if is_rounded { color.map(|color| color.map(round_channel)) } else { color };
            face.material = *index_of.entry(color).or_insert_with(|| {
                materials.push(color.map_or_else(|| Material::unspecified(""), material_of));
                materials.len() - 1
            });
        }
        self.materials = materials.iter().map(|material| material.name.clone()).collect();
        materials
    }
}

/// The material of an sRGB color.
fn material_of(color: [u8; 3]) -> Material {
    let [red, green, blue] = color;
    let linear = color.map(|channel| linear_from_srgb(f32::from(channel) / 255.0));
    let name = format!("color #{red:02x}{green:02x}{blue:02x}");
    Material { ambient: linear, diffuse: linear, ..Material::unspecified(&name) }
}

/// Rounds a channel to [`ROUNDED_BITS`] bits in the range 0 to 255.
const fn round_channel(channel: u8) -> u8 {
    (channel >> (8 - ROUNDED_BITS)) * 17
}

#[cfg(test)]
mod tests {
    use super::super::Corner;
    use super::*;

    fn mesh_with(colors: Vec<Option<[u8; 3]>>) -> PolygonMesh {
        let mut polygons = PolygonMesh::with_one_material(vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]);
        for place in 0..colors.len() {
            polygons.add_face([0, 1, 2].map(Corner::of_vertex), 0, place).expect("unlimited memory");
        }
        polygons.face_colors = colors;
        polygons
    }

    #[test]
    fn faces_of_one_color_share_a_material() {
        let mut polygons = mesh_with(vec![Some([255, 0, 0]), None, Some([255, 0, 0]), Some([0, 188, 255])]);
        let mut remarks = Vec::new();
        let materials = polygons.color_faces(&mut remarks);
        let faces: Vec<usize> = polygons.faces.iter().map(|face| face.material).collect();
        assert_eq!((faces, remarks.len()), (vec![0, 1, 0, 2], 0));
        assert_eq!(polygons.materials, ["color #ff0000", "default", "color #00bcff"]);
        assert_eq!(materials[1], Material::unspecified(""));
        let [red, green, blue] = materials[2].diffuse;
        assert!(red == 0.0 && (green - 0.5).abs() < 0.01 && blue == 1.0, "{:?}", materials[2].diffuse);
    }

    #[test]
    fn many_colors_are_rounded() {
        let colors = (0..=4096_u16).map(|index| Some([(index / 256) as u8, (index % 256) as u8, 255])).collect();
        let (mut polygons, mut remarks) = (mesh_with(colors), Vec::new());
        let materials = polygons.color_faces(&mut remarks);
        assert_eq!(remarks, ["4097 colors of faces are rounded to at most 4096 colors"]);
        // Red is 0 to 16, which has two rounded values; green has 16.
        assert_eq!(materials.len(), 17);
        assert_eq!(polygons.materials[0], "color #0000ff");
    }
}
