//! A triangle mesh on two levels: vertices, each with three rows of U, and corners, one per rendered combination of
//! OBJ's v, vt and vn.

use crate::error::{Result, invalid};

/// The rendered corners as arrays of equal length.
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
    rest: Vec<[f32; 3]>,
    corners: Corners,
    triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// A mesh whose triangles index `corners` and whose corners index `rest`. Normals are normalized.
    ///
    /// Unreferenced vertices are kept, because the rows of U include them.
    ///
    /// # Errors
    /// `Invalid` if a list is empty, an index is out of range, lengths differ or a number is not finite.
    pub fn new(rest: Vec<[f32; 3]>, mut corners: Corners, triangles: Vec<[u32; 3]>) -> Result<Self> {
        let count = corners.vertices.len();
        if rest.is_empty() || triangles.is_empty() {
            return Err(invalid(
                "mesh",
                "at least one vertex and one triangle",
                format!("{} vertices, {} triangles", rest.len(), triangles.len()),
            ));
        }
        if corners.normals.len() != count {
            return Err(invalid("mesh.normals", format!("{count}, one per corner"), corners.normals.len()));
        }
        if !corners.uvs.is_empty() && corners.uvs.len() != count {
            return Err(invalid("mesh.uvs", format!("none or {count}, one per corner"), corners.uvs.len()));
        }
        finite("mesh.positions", &rest)?;
        finite("mesh.normals", &corners.normals)?;
        finite("mesh.uvs", &corners.uvs)?;
        in_range("mesh.corners", &corners.vertices, rest.len())?;
        in_range("mesh.indices", triangles.as_flattened(), count)?;
        for normal in &mut corners.normals {
            *normal = unit(*normal);
        }
        Ok(Self { rest, corners, triangles })
    }

    /// A mesh with one corner per vertex.
    ///
    /// # Errors
    /// As for [`Self::new`].
    pub fn from_indexed(
        rest: Vec<[f32; 3]>,
        normals: Vec<[f32; 3]>,
        uvs: Vec<[f32; 2]>,
        triangles: Vec<[u32; 3]>,
    ) -> Result<Self> {
        let vertices = (0..rest.len() as u32).collect();
        Self::new(rest, Corners { vertices, normals, uvs }, triangles)
    }

    /// Rest positions, one per vertex.
    pub fn rest_positions(&self) -> &[[f32; 3]] {
        &self.rest
    }

    /// The corners.
    pub const fn corners(&self) -> &Corners {
        &self.corners
    }

    /// Triangles as corner indices.
    pub fn triangles(&self) -> &[[u32; 3]] {
        &self.triangles
    }
}

/// Area-weighted vertex normals, one per corner, for corners without normals. Triangles index corners, and all corners
/// of a vertex share its normal. A vertex without adjacent area gets +Z.
pub fn smooth_normals(rest: &[[f32; 3]], corner_vertices: &[u32], triangles: &[[u32; 3]]) -> Vec<[f32; 3]> {
    let mut sums = vec![nalgebra::Vector3::<f64>::zeros(); rest.len()];
    let position = |vertex: u32| nalgebra::Vector3::from(rest[vertex as usize]).cast::<f64>();
    for triangle in triangles {
        let [a, b, c] = triangle.map(|corner| corner_vertices[corner as usize]);
        let area = (position(b) - position(a)).cross(&(position(c) - position(a)));
        for vertex in [a, b, c] {
            sums[vertex as usize] += area;
        }
    }
    let normal = |vertex: &u32| {
        let sum = sums[*vertex as usize].try_normalize(f64::MIN_POSITIVE);
        sum.map_or([0.0, 0.0, 1.0], |sum| sum.cast::<f32>().into())
    };
    corner_vertices.iter().map(normal).collect()
}

fn unit(normal: [f32; 3]) -> [f32; 3] {
    let long = nalgebra::Vector3::from(normal).cast::<f64>();
    long.try_normalize(1e-30).map_or([0.0, 0.0, 1.0], |unit| unit.cast::<f32>().into())
}

fn finite<const N: usize>(field: &str, list: &[[f32; N]]) -> Result<()> {
    match list.as_flattened().iter().position(|number| !number.is_finite()) {
        None => Ok(()),
        Some(at) => Err(invalid(format!("{field}[{}]", at / N), "finite numbers", format!("{:?}", list[at / N]))),
    }
}

fn in_range(field: &str, indices: &[u32], limit: usize) -> Result<()> {
    match indices.iter().position(|index| *index as usize >= limit) {
        None => Ok(()),
        Some(at) => Err(invalid(format!("{field}[{at}]"), format!("an index below {limit}"), indices[at])),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SQUARE: [[f32; 3]; 4] = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]];

    #[test]
    fn smooth_normals_of_a_flat_square_point_up_and_a_collapsed_vertex_stays_finite() {
        let normals = smooth_normals(&SQUARE, &[0, 1, 2, 3], &[[0, 1, 2], [0, 2, 3]]);
        assert_eq!(normals, [[0.0, 0.0, 1.0]; 4]);
        let collapsed = smooth_normals(&SQUARE, &[0, 0, 0], &[[0, 1, 2]]);
        assert_eq!(collapsed, [[0.0, 0.0, 1.0]; 3]);
    }

    #[test]
    fn bad_meshes_are_refused_by_name() {
        let corners = || Corners { vertices: vec![0, 1, 2], normals: vec![[0.0, 0.0, 2.0]; 3], uvs: vec![] };
        let good = Mesh::new(SQUARE.to_vec(), corners(), vec![[0, 1, 2]]).expect("good");
        assert_eq!(good.corners().normals[0], [0.0, 0.0, 1.0]);
        let refusals = [
            (Mesh::new(vec![], corners(), vec![[0, 1, 2]]), "mesh:"),
            (Mesh::new(SQUARE.to_vec(), corners(), vec![[0, 1, 3]]), "mesh.indices[2]"),
            (Mesh::new(SQUARE[..2].to_vec(), corners(), vec![[0, 1, 2]]), "mesh.corners[2]"),
            (Mesh::new(vec![[f32::NAN; 3]; 3], corners(), vec![[0, 1, 2]]), "mesh.positions[0]"),
            (Mesh::new(SQUARE.to_vec(), Corners { uvs: vec![[0.0; 2]], ..corners() }, vec![[0, 1, 2]]), "mesh.uvs"),
        ];
        for (refusal, field) in refusals {
            let text = refusal.expect_err(field).to_string();
            assert!(text.starts_with(field), "{text}");
        }
    }
}
