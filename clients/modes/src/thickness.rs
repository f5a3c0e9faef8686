//! Sheets: a closed surface around a surface without volume.

use nalgebra::{Matrix3, Vector3};

use crate::surface::{Surface, directed_edges};

/// Limit on the movement of a vertex at a fold, as a multiple of half the thickness.
const MAX_MITER: f64 = 4.0;

/// Moves every vertex in both directions, so that all of its triangles move by half the thickness along their normals, and
/// closes the borders of the sheet.
pub fn thicken(surface: &Surface, thickness: f64) -> Surface {
    let count = surface.positions.len();
    // Least squares for each vertex: the sums of a n n^T and a n over its triangles with area a and normal n.
    let mut matrices = vec![Matrix3::zeros(); count];
    let mut normals = vec![Vector3::zeros(); count];
    for (index, triangle) in surface.triangles.iter().enumerate() {
        let area_vector = surface.area_vector(index);
        let Some(normal) = area_vector.try_normalize(0.0) else { continue };
        for vertex in triangle {
            matrices[*vertex as usize] += area_vector * normal.transpose();
            normals[*vertex as usize] += area_vector;
        }
    }
    let movements: Vec<Vector3<f64>> =
        matrices.iter().zip(&normals).map(|(matrix, normal)| miter(matrix, normal)).collect();
    let offset = |sign: f64| {
        let moved = surface.positions.iter().zip(&movements);
        moved.map(move |(position, movement): (&Vector3<f64>, &Vector3<f64>)| {
            position + movement * (sign * thickness / 2.0)
        })
    };
    let positions: Vec<Vector3<f64>> = offset(1.0).chain(offset(-1.0)).collect();
    let lower = count as u32;
    let mut triangles = surface.triangles.clone();
    let mut groups = surface.triangle_groups.clone();
    triangles.extend(surface.triangles.iter().map(|[a, b, c]| [a + lower, c + lower, b + lower]));
    groups.extend(&surface.triangle_groups);
    let edges: std::collections::HashSet<[u32; 2]> = surface.triangles.iter().flat_map(directed_edges).collect();
    for (triangle, group) in surface.triangles.iter().zip(&surface.triangle_groups) {
        for [start, end] in directed_edges(triangle) {
            if !edges.contains(&[end, start]) {
                triangles.extend([[end, start, start + lower], [end, start + lower, end + lower]]);
                groups.extend([*group; 2]);
            }
        }
    }
    Surface::new(&positions, &triangles, &groups)
}

/// The movement of a vertex whose triangles move by 1: the smallest least-squares solution. Directions in which its
/// normals hardly differ are left out.
fn miter(matrix: &Matrix3<f64>, normal: &Vector3<f64>) -> Vector3<f64> {
    /// Singular values below this share of the largest one are left out.
    const TOLERANCE: f64 = 0.02;
    let svd = matrix.svd(true, true);
    let movement = svd.solve(normal, TOLERANCE * svd.singular_values.max()).unwrap_or_default();
    let length = movement.norm();
    if length > MAX_MITER { movement * (MAX_MITER / length) } else { movement }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A cube of twelve triangles becomes a wall of the same thickness everywhere.
    #[test]
    fn folds_keep_the_thickness() {
        let (positions, triangles) = crate::surface::tests::box_surface([0.0; 3], [1.0; 3]);
        let wall = thicken(&Surface::new(&positions, &triangles, &[0; 12]), 0.01);
        let expected = 1.01_f64.powi(3) - 0.99_f64.powi(3);
        assert!((wall.volume() / expected - 1.0).abs() < 1e-9, "{} instead of {expected}", wall.volume());
    }

    #[test]
    fn square_becomes_a_closed_plate() {
        let positions = [[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0]].map(|[x, y]| Vector3::new(x, y, 3.0));
        let surface = Surface::new(&positions, &[[0, 1, 2], [0, 2, 3]], &[5, 5]);
        assert!(!surface.is_closed);
        let plate = thicken(&surface, 0.1);
        assert!(plate.is_closed);
        let volume = |index: usize| plate.area_vector(index).dot(&plate.corners(index)[0]) / 3.0;
        let total: f64 = (0..plate.triangles.len()).map(volume).sum();
        assert!((total - 0.2).abs() < 1e-12, "{total}");
        assert_eq!(plate.triangles.len(), 12);
        assert!(plate.triangle_groups.iter().all(|group| *group == 5));
    }
}
