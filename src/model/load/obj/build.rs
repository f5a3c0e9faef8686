//! Builds a triangle mesh, grouped into runs of one material, from the polygons of an OBJ file.

use std::collections::HashMap;

use super::parse::{Corner, NO_INDEX, ObjFile};
use super::triangulate::triangulate;
use crate::domain::{Corners, MaterialRange, Mesh, smooth_normals};
use crate::error::Result;

/// A mesh and its runs of materials (indices into [`ObjFile::materials`]).
#[derive(Debug)]
pub(in crate::load) struct ObjMesh {
    pub(in crate::load) mesh: Mesh,
    pub(in crate::load) material: usize,
    /// Empty if there is only one material.
    pub(in crate::load) material_ranges: Vec<MaterialRange>,
}

/// Builds a mesh from all faces. Its vertices are all `v` lines in file order, whether referenced or not.
///
/// # Errors
/// `Invalid` as for [`Mesh::new`].
pub(in crate::load) fn build_all_faces(obj: &ObjFile) -> Result<ObjMesh> {
    let faces: Vec<usize> = (0..obj.faces.len()).collect();
    let mut builder = ObjMeshBuilder { rest: obj.positions.clone(), ..ObjMeshBuilder::new(obj) };
    builder.add(&faces);
    builder.finish()
}

/// Builds a mesh from some faces and only the vertices that they use, with positions relative to `base`.
///
/// # Errors
/// `Invalid` as for [`Mesh::new`].
pub(in crate::load) fn build_faces(obj: &ObjFile, faces: &[usize], base: [f64; 3]) -> Result<ObjMesh> {
    let mut builder = ObjMeshBuilder { local: Some((HashMap::new(), base)), ..ObjMeshBuilder::new(obj) };
    builder.add(faces);
    builder.finish()
}

struct ObjMeshBuilder<'a> {
    obj: &'a ObjFile,
    /// For [`build_faces`]: the new index of each used vertex, by its index in the file, and the base.
    local: Option<(HashMap<u32, u32>, [f64; 3])>,
    rest: Vec<[f32; 3]>,
    corner_of: HashMap<Corner, u32>,
    corners: Vec<Corner>,
    vertices: Vec<u32>,
    triangles: Vec<[u32; 3]>,
    material_ranges: Vec<MaterialRange>,
}

impl<'a> ObjMeshBuilder<'a> {
    fn new(obj: &'a ObjFile) -> Self {
        Self {
            obj,
            local: None,
            rest: Vec::new(),
            corner_of: HashMap::new(),
            corners: Vec::new(),
            vertices: Vec::new(),
            triangles: Vec::new(),
            material_ranges: Vec::new(),
        }
    }

    fn add(&mut self, faces: &[usize]) {
        // Sort by material, so that there are no more runs than materials. The sort is stable: file order within a run.
        let mut faces = faces.to_vec();
        faces.sort_by_key(|face| self.obj.faces[*face].material);
        for face in faces {
            let material = self.obj.faces[face].material;
            if self.material_ranges.last().is_none_or(|run| run.material != material) {
                self.material_ranges.push(MaterialRange { first_triangle: self.triangles.len(), material });
            }
            self.face(face);
        }
    }

    fn face(&mut self, face: usize) {
        let corners = self.obj.corners_of(face);
        let points: Vec<_> = corners.iter().map(|corner| self.obj.positions[corner.v as usize]).collect();
        let numbers: Vec<u32> = corners.iter().map(|corner| self.corner(*corner)).collect();
        self.triangles.extend(triangulate(&points).into_iter().map(|triangle| triangle.map(|index| numbers[index])));
    }

    /// The index of the rendered corner of a (v, vt, vn), which is created on first use.
    fn corner(&mut self, corner: Corner) -> u32 {
        if let Some(known) = self.corner_of.get(&corner) {
            return *known;
        }
        let number = self.corners.len() as u32;
        let vertex = self.vertex(corner.v);
        self.vertices.push(vertex);
        self.corners.push(corner);
        self.corner_of.insert(corner, number);
        number
    }

    fn vertex(&mut self, v: u32) -> u32 {
        let Some((numbers, base)) = &mut self.local else { return v };
        *numbers.entry(v).or_insert_with(|| {
            let position = self.obj.positions[v as usize];
            self.rest.push([0, 1, 2].map(|axis| (f64::from(position[axis]) - base[axis]) as f32));
            self.rest.len() as u32 - 1
        })
    }

    fn finish(self) -> Result<ObjMesh> {
        let normals = self.normals();
        let uvs = if self.corners.iter().all(|corner| corner.vt == NO_INDEX) { Vec::new() } else { self.uvs() };
        let material = self.material_ranges.first().map_or(0, |run| run.material);
        let material_ranges = if self.material_ranges.len() > 1 { self.material_ranges } else { Vec::new() };
        let mesh = Mesh::new(self.rest, Corners { vertices: self.vertices, normals, uvs }, self.triangles)?;
        Ok(ObjMesh { mesh, material, material_ranges })
    }

    /// The file's normals. Corners with none or a zero normal get the smooth normal of their vertex.
    fn normals(&self) -> Vec<[f32; 3]> {
        let given = |corner: &Corner| self.obj.normals.get(corner.vn as usize).filter(|normal| **normal != [0.0; 3]);
        if let Some(all) = self.corners.iter().map(|corner| given(corner).copied()).collect() {
            return all;
        }
        let smooth = smooth_normals(&self.rest, &self.vertices, &self.triangles);
        self.corners.iter().zip(smooth).map(|(corner, smooth)| given(corner).copied().unwrap_or(smooth)).collect()
    }

    fn uvs(&self) -> Vec<[f32; 2]> {
        let uv = |corner: &Corner| self.obj.uvs.get(corner.vt as usize).copied().unwrap_or_default();
        self.corners.iter().map(uv).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two squares in one plane. The middle edge is duplicated, one vertex is unused, and materials alternate.
    const SQUARES: &str = "v 9 9 9\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 1 0 0\nv 2 0 0\nv 2 1 0\nv 1 1 0\n\
        vt 0 0\nvt 1 1\nusemtl b\nf 2/1 3/1 4/1 5/1\nusemtl a\nf 6 7 8 9\nusemtl b\nf 2/2 3/2 4/2\n";

    fn parsed() -> ObjFile {
        ObjFile::parse(SQUARES.as_bytes()).expect("good")
    }

    #[test]
    fn rows_follow_the_v_lines_with_unreferenced_and_coincident_vertices_kept() {
        let obj = parsed();
        let mesh = build_all_faces(&obj).expect("good").mesh;
        assert_eq!(mesh.rest_positions(), obj.positions);
        assert_eq!(mesh.corners().vertices, [1, 2, 3, 4, 1, 2, 3, 5, 6, 7, 8], "v/1 and v/2 are corners of one vertex");
        assert_eq!(mesh.corners().uvs[4], [1.0, 0.0]);
        assert_eq!(mesh.corners().uvs[7], [0.0, 0.0], "a corner without vt among others with");
        assert_eq!(mesh.corners().normals, [[0.0, 0.0, 1.0]; 11]);
    }

    #[test]
    fn faces_of_one_material_make_one_run_and_one_material_makes_none() {
        let obj = parsed();
        let piece = build_all_faces(&obj).expect("good");
        assert_eq!(obj.materials, ["b", "a"]);
        assert_eq!(
            piece.material_ranges,
            [MaterialRange { first_triangle: 0, material: 0 }, MaterialRange { first_triangle: 3, material: 1 }]
        );
        assert_eq!(piece.mesh.triangles().len(), 5);
        let only = build_faces(&obj, &[1], [0.0; 3]).expect("good");
        assert_eq!((only.material, only.material_ranges.len()), (1, 0));
    }

    #[test]
    fn a_part_has_its_own_vertices_relative_to_its_base() {
        let piece = build_faces(&parsed(), &[1], [1.0, 0.0, 0.5]).expect("good");
        let rest = [[0.0, 0.0, -0.5], [1.0, 0.0, -0.5], [1.0, 1.0, -0.5], [0.0, 1.0, -0.5]];
        assert_eq!(piece.mesh.rest_positions(), rest);
        assert!(piece.mesh.corners().uvs.is_empty());
    }

    #[test]
    fn missing_and_zero_normals_are_computed_and_given_ones_kept() {
        let text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 1 0 0\nvn 0 0 0\nf 1//1 2//2 3\n";
        let mesh = build_all_faces(&ObjFile::parse(text.as_bytes()).expect("good")).expect("good").mesh;
        assert_eq!(mesh.corners().normals, [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]]);
    }
}
