//! A triangle mesh. A vertex is a deformed point with three rows of U. A corner is a vertex with a normal and texture
//! coordinates, as the renderer draws it: several corners can share one vertex. Triangles index corners.

use crate::error::{Result, invalid};

/// The attributes of all corners, one array per attribute. The arrays have equal lengths, but `uvs` may be empty.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Corners {
    /// The vertex of each corner.
    pub vertices: Vec<u32>,
    /// Unit normals at rest.
    pub normals: Vec<[f32; 3]>,
    /// Texture coordinates with (0, 0) at the top left of the image; empty if the mesh has none.
    pub uvs: Vec<[f32; 2]>,
}

/// Vertices, corners and triangles of a shape at rest.
#[derive(Debug, Clone, PartialEq)]
pub struct Mesh {
    rest_positions: Vec<[f32; 3]>,
    corners: Corners,
    triangles: Vec<[u32; 3]>,
    inner_edges: Vec<u8>,
}

impl Mesh {
    /// A mesh whose triangles index `corners` and whose corners index `rest_positions`. Normals are normalized.
    ///
    /// Unreferenced vertices are kept, because the rows of U include them.
    ///
    /// # Errors
    /// `Invalid` if there is no vertex or no triangle, an index is out of range, the number of normals or texture
    /// coordinates is wrong, or a number is not finite.
    pub fn new(rest_positions: Vec<[f32; 3]>, mut corners: Corners, triangles: Vec<[u32; 3]>) -> Result<Self> {
        let corner_count = corners.vertices.len();
        if rest_positions.is_empty() || triangles.is_empty() {
            return Err(invalid(
                "mesh",
                "at least one vertex and one triangle",
                format!("{} vertices, {} triangles", rest_positions.len(), triangles.len()),
            ));
        }
        if corners.normals.len() != corner_count {
            let expected = format!("one normal per corner ({corner_count})");
            return Err(invalid("mesh.normals", expected, corners.normals.len()));
        }
        if !corners.uvs.is_empty() && corners.uvs.len() != corner_count {
            let expected = format!("none or one per corner ({corner_count})");
            return Err(invalid("mesh.uvs", expected, corners.uvs.len()));
        }
        check_finite("mesh.positions", &rest_positions)?;
        check_finite("mesh.normals", &corners.normals)?;
        check_finite("mesh.uvs", &corners.uvs)?;
        check_indices("mesh.corners", &corners.vertices, rest_positions.len())?;
        check_indices("mesh.indices", triangles.as_flattened(), corner_count)?;
        for normal in &mut corners.normals {
            *normal = normalize_or_z(*normal);
        }
        Ok(Self { rest_positions, corners, triangles, inner_edges: Vec::new() })
    }

    /// Marks the triangle edges that lie inside a polygon, in the format of [`Self::inner_edges`]. A list without marks
    /// is stored as an empty one.
    ///
    /// # Errors
    /// `Invalid` unless there is one entry per triangle.
    pub fn with_inner_edges(self, inner_edges: Vec<u8>) -> Result<Self> {
        if inner_edges.len() != self.triangles.len() {
            let expected = format!("one entry per triangle ({})", self.triangles.len());
            return Err(invalid("mesh.inner_edges", expected, inner_edges.len()));
        }
        let has_marks = inner_edges.iter().any(|edges| *edges != 0);
        Ok(Self { inner_edges: if has_marks { inner_edges } else { Vec::new() }, ..self })
    }

    /// A mesh with one corner per vertex.
    ///
    /// # Errors
    /// As for [`Self::new`].
    pub fn from_indexed(
        rest_positions: Vec<[f32; 3]>,
        normals: Vec<[f32; 3]>,
        uvs: Vec<[f32; 2]>,
        triangles: Vec<[u32; 3]>,
    ) -> Result<Self> {
        let vertices = (0..rest_positions.len() as u32).collect();
        Self::new(rest_positions, Corners { vertices, normals, uvs }, triangles)
    }

    /// Rest positions, one per vertex.
    pub fn rest_positions(&self) -> &[[f32; 3]] {
        &self.rest_positions
    }

    /// The attributes of all corners.
    pub const fn corners(&self) -> &Corners {
        &self.corners
    }

    /// Triangles as corner indices.
    pub fn triangles(&self) -> &[[u32; 3]] {
        &self.triangles
    }

    /// The rest positions of the vertices that triangles use, one per use. Only these vertices are drawn: bounds,
    /// ground and cameras ignore the others.
    pub fn drawn_positions(&self) -> impl Iterator<Item = [f32; 3]> + '_ {
        self.used_vertices().map(|vertex| self.rest_positions[vertex])
    }

    /// The vertices of the triangles, with repetitions.
    fn used_vertices(&self) -> impl Iterator<Item = usize> + '_ {
        self.triangles.as_flattened().iter().map(|corner| self.corners.vertices[*corner as usize] as usize)
    }

    /// The vertices that triangles use, ascending and without repetitions.
    pub(crate) fn drawn_vertices(&self) -> Vec<u32> {
        let mut is_drawn = vec![false; self.rest_positions.len()];
        self.used_vertices().for_each(|vertex| is_drawn[vertex] = true);
        (0..).zip(is_drawn).filter_map(|(vertex, is_drawn)| is_drawn.then_some(vertex)).collect()
    }

    /// The same mesh with other rest positions, one per vertex.
    pub(crate) fn with_rest_positions(self, rest_positions: Vec<[f32; 3]>) -> Result<Self> {
        check_finite("mesh.positions", &rest_positions)?;
        Ok(Self { rest_positions, ..self })
    }

    /// For each triangle, bit i is 1 if the edge opposite to its corner i is inside of a polygon, such as the diagonal
    /// of a quadrilateral. Empty if there is no such edge.
    pub fn inner_edges(&self) -> &[u8] {
        &self.inner_edges
    }
}

/// Area-weighted vertex normals, one per corner, for meshes without normals. Triangles index corners. All corners of a
/// vertex have the same normal. The normal is +Z if all triangles at the vertex are degenerate.
pub fn smooth_normals(rest_positions: &[[f32; 3]], corner_vertices: &[u32], triangles: &[[u32; 3]]) -> Vec<[f32; 3]> {
    let mut normal_sums = vec![nalgebra::Vector3::<f64>::zeros(); rest_positions.len()];
    let position = |vertex: u32| nalgebra::Vector3::from(rest_positions[vertex as usize]).cast::<f64>();
    for triangle in triangles {
        let [a, b, c] = triangle.map(|corner| corner_vertices[corner as usize]);
        let area_vector = (position(b) - position(a)).cross(&(position(c) - position(a)));
        for vertex in [a, b, c] {
            normal_sums[vertex as usize] += area_vector;
        }
    }
    let normal = |vertex: &u32| {
        let unit_normal = normal_sums[*vertex as usize].try_normalize(f64::MIN_POSITIVE);
        unit_normal.map_or([0.0, 0.0, 1.0], |normal| normal.cast::<f32>().into())
    };
    corner_vertices.iter().map(normal).collect()
}

/// Normalizes in f64. A vector of length 0, or below 1e-30, becomes +Z.
fn normalize_or_z(normal: [f32; 3]) -> [f32; 3] {
    let normal_f64 = nalgebra::Vector3::from(normal).cast::<f64>();
    normal_f64.try_normalize(1e-30).map_or([0.0, 0.0, 1.0], |unit| unit.cast::<f32>().into())
}

fn check_finite<const N: usize>(field: &str, list: &[[f32; N]]) -> Result<()> {
    match list.as_flattened().iter().position(|number| !number.is_finite()) {
        None => Ok(()),
        Some(index) => {
            Err(invalid(format!("{field}[{}]", index / N), "finite numbers", format!("{:?}", list[index / N])))
        }
    }
}

fn check_indices(field: &str, indices: &[u32], limit: usize) -> Result<()> {
    match indices.iter().position(|index| *index as usize >= limit) {
        None => Ok(()),
        Some(position) => {
            Err(invalid(format!("{field}[{position}]"), format!("an index below {limit}"), indices[position]))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SQUARE: [[f32; 3]; 4] = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]];

    #[test]
    fn smooth_normals_of_a_square_in_the_xy_plane_are_z() {
        let normals = smooth_normals(&SQUARE, &[0, 1, 2, 3], &[[0, 1, 2], [0, 2, 3]]);
        assert_eq!(normals, [[0.0, 0.0, 1.0]; 4]);
    }

    #[test]
    fn smooth_normal_of_a_degenerate_triangle_is_z() {
        let normals = smooth_normals(&SQUARE, &[0, 0, 0], &[[0, 1, 2]]);
        assert_eq!(normals, [[0.0, 0.0, 1.0]; 3]);
    }

    #[test]
    fn invalid_mesh_is_rejected_with_its_field() {
        let corners = || Corners { vertices: vec![0, 1, 2], normals: vec![[0.0, 0.0, 2.0]; 3], uvs: vec![] };
        let valid_mesh = Mesh::new(SQUARE.to_vec(), corners(), vec![[0, 1, 2]]).expect("a valid mesh");
        assert_eq!(valid_mesh.corners().normals[0], [0.0, 0.0, 1.0]);
        let rejections = [
            (Mesh::new(vec![], corners(), vec![[0, 1, 2]]), "mesh:"),
            (Mesh::new(SQUARE.to_vec(), corners(), vec![[0, 1, 3]]), "mesh.indices[2]"),
            (Mesh::new(SQUARE[..2].to_vec(), corners(), vec![[0, 1, 2]]), "mesh.corners[2]"),
            (Mesh::new(vec![[f32::NAN; 3]; 3], corners(), vec![[0, 1, 2]]), "mesh.positions[0]"),
            (Mesh::new(SQUARE.to_vec(), Corners { uvs: vec![[0.0; 2]], ..corners() }, vec![[0, 1, 2]]), "mesh.uvs"),
        ];
        for (result, field) in rejections {
            let message = result.expect_err(field).to_string();
            assert!(message.starts_with(field), "expected an error about {field}, got {message}");
        }
    }
}
