//! Sheets: a closed surface around a surface without volume.

use nalgebra::Vector3;

use crate::surface::{Surface, directed_edges};

/// Moves every vertex by half the thickness along its normal in both directions, and closes the borders of the sheet.
pub fn thicken(surface: &Surface, thickness: f64) -> Surface {
    let count = surface.positions.len();
    let mut normals = vec![Vector3::zeros(); count];
    for (index, triangle) in surface.triangles.iter().enumerate() {
        for vertex in triangle {
            normals[*vertex as usize] += surface.area_vector(index);
        }
    }
    let offset = |sign: f64| {
        let moved = surface.positions.iter().zip(&normals);
        moved.map(move |(position, normal): (&Vector3<f64>, &Vector3<f64>)| {
            position + normal.try_normalize(0.0).unwrap_or_default() * (sign * thickness / 2.0)
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

#[cfg(test)]
mod tests {
    use super::*;

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
