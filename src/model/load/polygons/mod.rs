//! Polygon meshes, as the loaders of OBJ, PLY, STL and NumPy archives read them, and their conversion to triangles.

mod build;
mod delaunay;
mod face_colors;
mod triangulate;
mod vertex_colors;

pub(super) use build::{build_all_faces, build_faces};
pub(super) use vertex_colors::{VertexColors, linear_from_srgb, paint, paint_over, patch_side};

use super::values::{CorrectedValue, Corrections};
use crate::error::{Result, invalid};
use crate::memory::TemporaryReservation;

/// The index of a missing texture coordinate or normal of a corner.
pub(super) const NO_INDEX: u32 = u32::MAX;

/// A coordinate in f64. A number beyond the range of f32 becomes infinite, because positions are stored as f32.
pub(super) const fn within_f32(number: f64) -> f64 {
    let rounded = number as f32;
    if rounded.is_finite() { number } else { rounded as f64 }
}

/// One corner of a polygon, as indices into the positions, texture coordinates and normals of the mesh.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct Corner {
    pub(super) vertex: u32,
    pub(super) uv: u32,
    pub(super) normal: u32,
}

impl Corner {
    /// A corner without texture coordinates and normal.
    pub(super) const fn of_vertex(vertex: u32) -> Self {
        Self { vertex, uv: NO_INDEX, normal: NO_INDEX }
    }
}

/// One polygon: its corners, its material and its place in the file.
#[derive(Debug, Clone, Copy)]
pub(super) struct Face {
    first_corner: usize,
    corner_count: usize,
    /// Index into [`PolygonMesh::materials`].
    pub(super) material: usize,
    /// Line of a text file, or index of the face, for errors.
    place: usize,
}

/// Polygons with shared vertices. The indices and numbers are validated by [`PolygonMesh::validate`].
#[derive(Debug, Default)]
pub(super) struct PolygonMesh {
    /// Rest positions, in the order of the file. In f64, because a model far from its origin is centered before its
    /// positions are rounded to f32.
    pub(super) positions: Vec<[f64; 3]>,
    /// Texture coordinates with (0, 0) at the top left.
    pub(super) uvs: Vec<[f32; 2]>,
    pub(super) normals: Vec<[f32; 3]>,
    /// One sRGB color per vertex, after the validation 0 to 1; empty if no vertex has a color.
    pub(super) colors: Vec<[f32; 3]>,
    pub(super) faces: Vec<Face>,
    /// The sRGB color of each face, if it has one; empty if no face has a color.
    pub(super) face_colors: Vec<Option<[u8; 3]>>,
    corners: Vec<Corner>,
    /// Number of faces with one or two corners: points and lines.
    small_face_count: usize,
    /// The values that were changed or ignored.
    pub(super) corrections: Corrections,
    /// Material names in order of first use.
    pub(super) materials: Vec<String>,
    /// The memory of the lists, which grows with them. `None`: unlimited.
    pub(super) memory: Option<TemporaryReservation>,
}

/// Largest memory in bytes while triangles are built, per corner of a polygon and per vertex: the map of the corners, the
/// triangles and their neighbors at creases, and the mesh itself. `tests/memory` measured, beyond the reserved lists, 33
/// bytes per corner for a smooth grid of 64,000 triangles, 44 with vertex colors, and 140 per corner for polygons of 256
/// corners without common vertices.
const BUILD_BYTES_PER_CORNER: u64 = 64;
const BUILD_BYTES_PER_VERTEX: u64 = 96;

/// Largest memory in bytes while one polygon is split into triangles, per corner of the polygon: `tests/memory` measured 700
/// for polygons of 5000 corners, of which every second one is reflex.
const TRIANGULATION_BYTES_PER_CORNER: u64 = 1024;

/// Largest memory in bytes that building a mesh takes, from the numbers of its vertices and corners of polygons.
pub(in crate::load) const fn build_bytes(vertices: usize, corners: usize) -> u64 {
    BUILD_BYTES_PER_CORNER * corners as u64 + BUILD_BYTES_PER_VERTEX * vertices as u64
}

/// Largest memory in bytes of the lists of a mesh, whose capacity is at most twice their length: numbers of positions
/// (f64), of normals and colors together (f32), of texture coordinates, of faces and of corners.
pub(in crate::load) const fn list_bytes(
    positions: usize,
    vectors: usize,
    uvs: usize,
    faces: usize,
    corners: usize,
) -> u64 {
    let vector_bytes = (24 * positions as u64).saturating_add(12 * vectors as u64).saturating_add(8 * uvs as u64);
    let face_bytes = (size_of::<Face>() * faces) as u64 + (size_of::<Corner>() * corners) as u64;
    vector_bytes.saturating_add(face_bytes).saturating_mul(2)
}

impl PolygonMesh {
    /// A mesh without faces, whose faces will have one material without a name.
    pub(super) fn with_one_material(positions: Vec<[f64; 3]>) -> Self {
        Self { positions, materials: vec![String::new()], ..Self::default() }
    }

    /// Largest memory in bytes that building the triangles takes, from the numbers of vertices and corners.
    pub(super) fn build_bytes(&self) -> u64 {
        let polygon_corners = self.faces.iter().map(|face| face.corner_count).max().unwrap_or(0);
        build_bytes(self.positions.len(), self.corners.len()) + TRIANGULATION_BYTES_PER_CORNER * polygon_corners as u64
    }

    /// Reserves the memory of the lists.
    fn reserve_lists(&mut self) -> Result<()> {
        let Some(memory) = &mut self.memory else { return Ok(()) };
        // A color of a face has 4 bytes, and its value in a PLY file 12.
        let vectors = self.normals.len() + self.colors.len() + 2 * self.face_colors.len();
        let bytes = list_bytes(self.positions.len(), vectors, self.uvs.len(), self.faces.len(), self.corners.len());
        // Half as much again, so that the reservation grows rarely.
        if bytes > memory.bytes() { memory.grow_to(bytes + bytes / 2) } else { Ok(()) }
    }

    /// Adds a polygon. Points and lines, with fewer than three corners, are only counted.
    ///
    /// # Errors
    /// `OutOfMemory`.
    pub(super) fn add_face(
        &mut self,
        corners: impl IntoIterator<Item = Corner>,
        material: usize,
        place: usize,
    ) -> Result<()> {
        let first_corner = self.corners.len();
        self.corners.extend(corners);
        let corner_count = self.corners.len() - first_corner;
        if corner_count < 3 {
            self.corners.truncate(first_corner);
            self.small_face_count += 1;
            return Ok(());
        }
        self.faces.push(Face { first_corner, corner_count, material, place });
        self.reserve_lists()
    }

    /// The corners of a polygon.
    pub(super) fn corners_of(&self, face: usize) -> &[Corner] {
        let face = &self.faces[face];
        &self.corners[face.first_corner..][..face.corner_count]
    }

    /// Whether any corner has texture coordinates.
    pub(super) fn has_uvs(&self) -> bool {
        self.corners.iter().any(|corner| corner.uv != NO_INDEX)
    }

    /// Checks that the mesh has a face, that all indices of vertices are in range and that the positions of these vertices
    /// are finite. Corrects all other values as the table of [`super::values`] states. `place` converts the line or index of
    /// a face to its location in an error. `first_index` is the index of the first vertex in the file format, 0 or 1.
    ///
    /// # Errors
    /// `Invalid` with the place of the face, and the range of valid indices or the position.
    pub(super) fn validate(&mut self, place: impl Fn(usize) -> String, first_index: u64) -> Result<()> {
        let small_faces = self.small_face_count;
        if self.faces.is_empty() {
            let given = if small_faces > 0 { format!("{small_faces} points and lines") } else { "0".into() };
            return Err(invalid("faces", "at least one face", given));
        }
        if small_faces > 0 {
            let given = || CorrectedValue::new("", "at least 3 corners", format!("{small_faces} points and lines"));
            self.corrections.add("faces", "they are not drawn", given);
        }
        for face in &self.faces {
            for corner in &mut self.corners[face.first_corner..][..face.corner_count] {
                let lists = [
                    ("v", &mut corner.vertex, self.positions.len()),
                    ("vt", &mut corner.uv, self.uvs.len()),
                    ("vn", &mut corner.normal, self.normals.len()),
                ];
                for (list, index, count) in lists {
                    if (*index as usize) < count || (*index == NO_INDEX && list != "v") {
                        continue;
                    }
                    let expected = match count as u64 {
                        0 => format!("no index in a file without {list}"),
                        count => format!("{first_index} to {}", count - 1 + first_index),
                    };
                    let (field, given) = (format!("index of {list}"), u64::from(*index) + first_index);
                    if list == "v" {
                        return Err(invalid(format!("{}: {field}", place(face.place)), expected, given));
                    }
                    let given = || CorrectedValue::new(place(face.place), expected, given);
                    self.corrections.add(&field, "the index is ignored", given);
                    *index = NO_INDEX;
                }
                let position = self.positions[corner.vertex as usize];
                if position.iter().any(|number| !number.is_finite()) {
                    let vertex = u64::from(corner.vertex) + first_index;
                    let field = format!("{}: position of vertex {vertex}", place(face.place));
                    return Err(invalid(field, "finite numbers", format!("{position:?}")));
                }
            }
        }
        self.correct_attributes(first_index);
        Ok(())
    }

    /// Corrects the numbers that no position of a face has.
    fn correct_attributes(&mut self, first_index: u64) {
        // An unused vertex at the place of a used one does not change the bounds of the mesh.
        let used_position = self.corners.first().map_or([0.0; 3], |corner| self.positions[corner.vertex as usize]);
        for (index, position) in self.positions.iter_mut().enumerate() {
            if position.iter().any(|number| !number.is_finite()) {
                let place = format!("vertex {}", index as u64 + first_index);
                let given = || CorrectedValue::new(place, "finite numbers", format!("{position:?}"));
                self.corrections.add("position", "no face uses the vertex", given);
                *position = used_position;
            }
        }
        let corrections = &mut self.corrections;
        corrections.zero_non_finite("normal", "the normal is computed", &mut self.normals, first_index);
        corrections.zero_non_finite("texture coordinates", "(0, 0) is used", &mut self.uvs, first_index);
        corrections.vertex_colors(&mut self.colors, first_index);
    }
}
