//! Builds a triangle mesh from polygons, with one range of triangles per material.

use std::collections::HashMap;

use super::triangulate::{Triangulation, triangulate};
use super::{Corner, NO_INDEX, PolygonMesh};
use crate::domain::{Corners, CreaseAngle, MaterialRange, Mesh, RestOrigin, split_at_creases};
use crate::error::Result;

/// A triangle mesh and its materials, as indices into [`PolygonMesh::materials`].
#[derive(Debug)]
pub(in crate::load) struct TriangleMesh {
    pub(in crate::load) mesh: Mesh,
    /// The point that the positions of the mesh are relative to.
    pub(in crate::load) origin: [f64; 3],
    /// The material of the first triangle.
    pub(in crate::load) material: usize,
    /// The ranges of all materials; empty if there is only one material.
    pub(in crate::load) material_ranges: Vec<MaterialRange>,
    /// The vertex of the file for each vertex of the mesh. Empty if the mesh has all vertices of the file.
    pub(in crate::load) file_vertices: Vec<u32>,
    /// Number of polygons that are drawn as a fan, because they intersect themselves too often.
    inexact_polygons: usize,
}

/// Builds a mesh from all faces. Its vertices are all `v` lines in file order, whether referenced or not. They are
/// relative to an origin of their own if f32 would round them too coarsely ([`RestOrigin`]).
///
/// # Errors
/// `Invalid` as for [`Mesh::new`].
pub(in crate::load) fn build_all_faces(polygons: &PolygonMesh, crease_angle: CreaseAngle) -> Result<TriangleMesh> {
    let faces: Vec<usize> = (0..polygons.faces.len()).collect();
    let drawn = polygons.corners.iter().map(|corner| corner.vertex as usize);
    let RestOrigin { origin, positions } = RestOrigin::choose(&polygons.positions, drawn);
    let mut builder = MeshBuilder { rest_positions: positions, origin, ..MeshBuilder::new(polygons) };
    builder.add_faces(&faces);
    builder.finish(crease_angle)
}

/// Builds a mesh from some faces and only the vertices that they use, with positions relative to `origin`.
///
/// # Errors
/// `Invalid` as for [`Mesh::new`].
pub(in crate::load) fn build_faces(
    polygons: &PolygonMesh,
    faces: &[usize],
    origin: [f64; 3],
    crease_angle: CreaseAngle,
) -> Result<TriangleMesh> {
    let mut builder = MeshBuilder { new_indices: Some(HashMap::new()), origin, ..MeshBuilder::new(polygons) };
    builder.add_faces(faces);
    builder.finish(crease_angle)
}

/// Collects the corners and triangles of the faces of one mesh.
struct MeshBuilder<'a> {
    polygons: &'a PolygonMesh,
    /// Index in the triangle mesh by index in the polygon mesh, for the vertices so far. `None` if the mesh has all
    /// vertices of the file.
    new_indices: Option<HashMap<u32, u32>>,
    /// The point that `rest_positions` are relative to.
    origin: [f64; 3],
    rest_positions: Vec<[f32; 3]>,
    /// Index of each corner in `corners`.
    corner_indices: HashMap<Corner, u32>,
    corners: Vec<Corner>,
    /// The vertex of each corner in the mesh.
    corner_vertices: Vec<u32>,
    triangles: Vec<[u32; 3]>,
    /// As [`Mesh::inner_edges`].
    inner_edges: Vec<u8>,
    material_ranges: Vec<MaterialRange>,
    /// As [`TriangleMesh::inexact_polygons`].
    inexact_polygons: usize,
}

impl TriangleMesh {
    /// A remark on the polygons that are not drawn as the file describes them.
    pub(in crate::load) fn remark(&self) -> Option<String> {
        let count = self.inexact_polygons;
        let text = || format!("{count} polygons intersect themselves too often: they are drawn as fans of triangles");
        (count > 0).then(text)
    }
}

impl<'a> MeshBuilder<'a> {
    fn new(polygons: &'a PolygonMesh) -> Self {
        Self {
            polygons,
            new_indices: None,
            origin: [0.0; 3],
            rest_positions: Vec::new(),
            corner_indices: HashMap::new(),
            corners: Vec::new(),
            corner_vertices: Vec::new(),
            triangles: Vec::new(),
            inner_edges: Vec::new(),
            material_ranges: Vec::new(),
            inexact_polygons: 0,
        }
    }

    fn add_faces(&mut self, faces: &[usize]) {
        // Sort by material, so that each material has one range. The sort is stable, so a range is in file order.
        let mut faces = faces.to_vec();
        faces.sort_by_key(|face| self.polygons.faces[*face].material);
        for face in faces {
            let material = self.polygons.faces[face].material;
            if self.material_ranges.last().is_none_or(|range| range.material != material) {
                self.material_ranges.push(MaterialRange { first_triangle: self.triangles.len(), material });
            }
            self.add_face(face);
        }
    }

    fn add_face(&mut self, face: usize) {
        let corners = self.polygons.corners_of(face);
        let corner_indices: Vec<u32> = corners.iter().map(|corner| self.corner_index(*corner)).collect();
        let position = |corner: &u32| self.rest_positions[self.corner_vertices[*corner as usize] as usize];
        let positions: Vec<_> = corner_indices.iter().map(position).collect();
        let Triangulation { triangles, is_inexact } = triangulate(&positions);
        self.inexact_polygons += usize::from(is_inexact);
        for triangle in triangles {
            self.triangles.push(triangle.map(|index| corner_indices[index]));
            self.inner_edges.push(inner_edges(triangle, corners.len()));
        }
    }

    /// Returns the index of a corner in the mesh. The first call for a corner adds it to the mesh.
    fn corner_index(&mut self, corner: Corner) -> u32 {
        if let Some(index) = self.corner_indices.get(&corner) {
            return *index;
        }
        let index = self.corners.len() as u32;
        let vertex = self.vertex_index(corner.vertex);
        self.corner_vertices.push(vertex);
        self.corners.push(corner);
        self.corner_indices.insert(corner, index);
        index
    }

    /// Returns the index in the mesh of a vertex of the file. [`build_faces`] adds a vertex on the first call for it.
    fn vertex_index(&mut self, file_vertex: u32) -> u32 {
        let Some(new_indices) = &mut self.new_indices else { return file_vertex };
        *new_indices.entry(file_vertex).or_insert_with(|| {
            let position = self.polygons.positions[file_vertex as usize];
            self.rest_positions.push([0, 1, 2].map(|axis| (position[axis] - self.origin[axis]) as f32));
            self.rest_positions.len() as u32 - 1
        })
    }

    fn finish(mut self, crease_angle: CreaseAngle) -> Result<TriangleMesh> {
        let normals = self.add_normals(crease_angle);
        let uvs = if self.corners.iter().all(|corner| corner.uv == NO_INDEX) { Vec::new() } else { self.uvs() };
        let material = self.material_ranges.first().map_or(0, |range| range.material);
        let material_ranges = if self.material_ranges.len() > 1 { self.material_ranges } else { Vec::new() };
        let mesh =
            Mesh::new(self.rest_positions, Corners { vertices: self.corner_vertices, normals, uvs }, self.triangles)?
                .with_inner_edges(self.inner_edges)?;
        let new_indices = self.new_indices.unwrap_or_default();
        let mut file_vertices = vec![0; new_indices.len()];
        new_indices.into_iter().for_each(|(file_vertex, vertex)| file_vertices[vertex as usize] = file_vertex);
        let (origin, inexact_polygons) = (self.origin, self.inexact_polygons);
        Ok(TriangleMesh { mesh, origin, material, material_ranges, file_vertices, inexact_polygons })
    }

    /// The normals of the corners. Corners whose normal is missing or zero in the file are split at creases.
    fn add_normals(&mut self, crease_angle: CreaseAngle) -> Vec<[f32; 3]> {
        let file_normal =
            |corner: &Corner| self.polygons.normals.get(corner.normal as usize).filter(|normal| **normal != [0.0; 3]);
        let file_normals: Vec<Option<[f32; 3]>> =
            self.corners.iter().map(|corner| file_normal(corner).copied()).collect();
        if let Some(normals) = file_normals.iter().copied().collect() {
            return normals;
        }
        let creased =
            split_at_creases(&self.rest_positions, &self.corner_vertices, &self.triangles, &file_normals, crease_angle);
        let sources = || creased.source_corners.iter().map(|corner| *corner as usize);
        self.corners = sources().map(|corner| self.corners[corner]).collect();
        self.corner_vertices = sources().map(|corner| self.corner_vertices[corner]).collect();
        self.triangles = creased.triangles;
        creased.normals
    }

    fn uvs(&self) -> Vec<[f32; 2]> {
        let uv = |corner: &Corner| self.polygons.uvs.get(corner.uv as usize).copied().unwrap_or_default();
        self.corners.iter().map(uv).collect()
    }
}

/// The edges of a triangle of a polygon with `count` corners that are not edges of the polygon: bit i is 1 for the edge
/// opposite to corner i.
fn inner_edges(triangle: [usize; 3], count: usize) -> u8 {
    let is_polygon_edge = |a: usize, b: usize| (a + 1) % count == b || (b + 1) % count == a;
    let is_inner = |corner: usize| !is_polygon_edge(triangle[(corner + 1) % 3], triangle[(corner + 2) % 3]);
    (0..3).map(|corner| u8::from(is_inner(corner)) << corner).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::load::obj::parse_obj;

    /// Two squares in one plane, and a triangle on the first square. The squares have their own vertices on their
    /// common edge, vertex 0 is unused, and materials alternate.
    const SQUARES: &str = "v 9 9 9\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 1 0 0\nv 2 0 0\nv 2 1 0\nv 1 1 0\n\
        vt 0 0\nvt 1 1\nusemtl b\nf 2/1 3/1 4/1 5/1\nusemtl a\nf 6 7 8 9\nusemtl b\nf 2/2 3/2 4/2\n";

    fn parse_squares() -> PolygonMesh {
        parse_obj(SQUARES)
    }

    #[test]
    fn build_all_faces_keeps_all_v_lines_in_file_order() {
        let obj = parse_squares();
        let mesh = build_all_faces(&obj, CreaseAngle::default()).expect("a valid OBJ file").mesh;
        let positions: Vec<[f64; 3]> = mesh.rest_positions().iter().map(|position| position.map(f64::from)).collect();
        assert_eq!(positions, obj.positions);
        // First both faces of material b, then the face of material a.
        assert_eq!(
            mesh.corners().vertices,
            [1, 2, 3, 4, 1, 2, 3, 5, 6, 7, 8],
            "expected v/1 and v/2 to be corners of one vertex"
        );
        assert_eq!(mesh.corners().uvs[4], [1.0, 0.0]);
        assert_eq!(mesh.corners().uvs[7], [0.0, 0.0], "expected (0, 0) for a corner without vt");
        assert_eq!(mesh.corners().normals, [[0.0, 0.0, 1.0]; 11]);
    }

    /// The faces of a quadrilateral, a pentagon and two triangles, one of them sharing an edge with the other.
    #[test]
    fn edges_inside_of_polygons_are_marked() {
        let vertices = "v 0 0 0\nv 1 0 0\nv 2 1 0\nv 1 2 0\nv 0 1 0\n";
        let inner_edges = |faces: &str| {
            let obj = parse_obj(&format!("{vertices}{faces}"));
            let mesh = build_all_faces(&obj, CreaseAngle::default()).expect("a valid OBJ file").mesh;
            let vertex = |corner: u32| mesh.corners().vertices[corner as usize];
            let mut edges = Vec::new();
            for (triangle, marks) in mesh.triangles().iter().zip(mesh.inner_edges()) {
                for corner in (0..3).filter(|corner| marks >> corner & 1 == 1) {
                    let ends = [1, 2].map(|offset| vertex(triangle[(corner + offset) % 3]));
                    edges.push([ends[0].min(ends[1]), ends[0].max(ends[1])]);
                }
            }
            edges.sort_unstable();
            edges
        };
        assert_eq!(inner_edges("f 1 2 4 5\n"), [[0, 3], [0, 3]], "expected the diagonal, from both sides");
        assert_eq!(inner_edges("f 1 2 3 4 5\n"), [[0, 2], [0, 2], [0, 3], [0, 3]]);
        assert_eq!(inner_edges("f 1 2 3\nf 1 3 4\n"), <[[u32; 2]; 0]>::default());
    }

    #[test]
    fn faces_are_merged_into_one_range_per_material() {
        let obj = parse_squares();
        let obj_mesh = build_all_faces(&obj, CreaseAngle::default()).expect("a valid OBJ file");
        assert_eq!(obj.materials, ["b", "a"]);
        assert_eq!(
            obj_mesh.material_ranges,
            [MaterialRange { first_triangle: 0, material: 0 }, MaterialRange { first_triangle: 3, material: 1 }]
        );
        assert_eq!(obj_mesh.mesh.triangles().len(), 5);
        let single_face_mesh = build_faces(&obj, &[1], [0.0; 3], CreaseAngle::default()).expect("a valid OBJ file");
        assert_eq!((single_face_mesh.material, single_face_mesh.material_ranges.len()), (1, 0));
    }

    #[test]
    fn build_faces_keeps_used_vertices_relative_to_origin() {
        let obj_mesh =
            build_faces(&parse_squares(), &[1], [1.0, 0.0, 0.5], CreaseAngle::default()).expect("a valid OBJ file");
        let rest_positions = [[0.0, 0.0, -0.5], [1.0, 0.0, -0.5], [1.0, 1.0, -0.5], [0.0, 1.0, -0.5]];
        assert_eq!(obj_mesh.mesh.rest_positions(), rest_positions);
        assert_eq!(obj_mesh.file_vertices, [5, 6, 7, 8]);
        assert!(obj_mesh.mesh.corners().uvs.is_empty());
    }

    #[test]
    fn missing_and_zero_normals_become_smooth_normals() {
        let text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 1 0 0\nvn 0 0 0\nf 1//1 2//2 3\n";
        let mesh = build_all_faces(&parse_obj(text), CreaseAngle::default()).expect("a valid OBJ file").mesh;
        assert_eq!(mesh.corners().normals, [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]]);
    }
}
