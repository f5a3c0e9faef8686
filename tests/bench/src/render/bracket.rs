//! The `bracket` scene: a machine part with recesses and flat faces. Lengths are in meters.

use std::f32::consts::TAU;

use nalgebra::Vector3;

use super::rigid_domain::add_rigid_domain;
use modalcast_model::domain::{Material, Mesh};
use modalcast_model::error::Result;
use modalcast_model::scene::{Lighting, SceneParts};

/// Half the width along x.
const HALF_WIDTH: f32 = 0.05;
/// Thickness of the plates.
const PLATE: f32 = 0.008;
/// Height of the upright plate.
const HEIGHT: f32 = 0.062;
/// Thickness of the ribs.
const RIB: f32 = 0.007;
/// Sides of the boss.
const BOSS_SIDES: usize = 24;

/// Faces that share no vertices, so that each has its own normal.
#[derive(Default)]
struct FlatFaces {
    positions: Vec<[f32; 3]>,
    normals: Vec<[f32; 3]>,
    triangles: Vec<[u32; 3]>,
}

/// Builds two perpendicular plates with two triangular ribs between them, and a boss between the ribs. The pieces
/// touch.
///
/// # Errors
/// None in practice: its sizes are constants.
pub(super) fn build_bracket() -> Result<SceneParts> {
    let mut parts = SceneParts::named("bracket");
    let FlatFaces { positions, normals, triangles } = bracket_faces();
    let mesh = Mesh::from_indexed(positions, normals, Vec::new(), triangles)?;
    add_rigid_domain(&mut parts, "bracket", mesh, Material::unspecified(""))?;
    parts.look = Lighting::Studio.settings();
    Ok(parts)
}

fn bracket_faces() -> FlatFaces {
    let mut faces = FlatFaces::default();
    // The base lies on the ground, and the upright plate stands on its rear edge.
    faces.add_box([-HALF_WIDTH, 0.0, 0.0], [HALF_WIDTH, PLATE, 0.07]);
    faces.add_box([-HALF_WIDTH, PLATE, 0.0], [HALF_WIDTH, HEIGHT, PLATE]);
    for left in [-0.024 - RIB, 0.024] {
        let rib = [[PLATE, PLATE], [HEIGHT - 0.01, PLATE], [PLATE, 0.062]].map(|[y, z]| Vector3::new(left, y, z));
        faces.add_prism(&rib, Vector3::new(RIB, 0.0, 0.0));
    }
    let boss: Vec<Vector3<f32>> = (0..BOSS_SIDES)
        .map(|side| TAU * side as f32 / BOSS_SIDES as f32)
        .map(|angle| Vector3::new(0.013 * angle.sin(), PLATE, 0.036 + 0.013 * angle.cos()))
        .collect();
    faces.add_prism(&boss, Vector3::new(0.0, 0.016, 0.0));
    faces
}

impl FlatFaces {
    /// Adds a convex face. Its corners are counter-clockwise seen from outside.
    fn add_face(&mut self, corners: &[Vector3<f32>]) {
        let normal = (corners[1] - corners[0]).cross(&(corners[2] - corners[0])).normalize();
        let first = self.positions.len() as u32;
        self.positions.extend(corners.iter().map(|corner| <[f32; 3]>::from(*corner)));
        self.normals.extend(corners.iter().map(|_| <[f32; 3]>::from(normal)));
        self.triangles.extend((2..corners.len() as u32).map(|corner| [first, first + corner - 1, first + corner]));
    }

    /// Adds a prism. The corners of its base are counter-clockwise seen from its top.
    fn add_prism(&mut self, base: &[Vector3<f32>], height: Vector3<f32>) {
        let top: Vec<Vector3<f32>> = base.iter().map(|corner| corner + height).collect();
        let bottom: Vec<Vector3<f32>> = base.iter().rev().copied().collect();
        self.add_face(&bottom);
        self.add_face(&top);
        for corner in 0..base.len() {
            let next = (corner + 1) % base.len();
            self.add_face(&[base[corner], base[next], top[next], top[corner]]);
        }
    }

    /// Adds a box between two opposite corners.
    fn add_box(&mut self, min: [f32; 3], max: [f32; 3]) {
        let corner = |x: f32, z: f32| Vector3::new(x, min[1], z);
        let base = [corner(min[0], max[2]), corner(max[0], max[2]), corner(max[0], min[2]), corner(min[0], min[2])];
        self.add_prism(&base, Vector3::new(0.0, max[1] - min[1], 0.0));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The volume of a closed surface whose faces point outwards, by the divergence theorem.
    fn volume(faces: &FlatFaces) -> f64 {
        let corner = |index: u32| Vector3::from(faces.positions[index as usize]).cast::<f64>();
        let sixfold: f64 = faces.triangles.iter().map(|[a, b, c]| corner(*a).dot(&corner(*b).cross(&corner(*c)))).sum();
        sixfold / 6.0
    }

    #[test]
    fn bracket_is_closed_and_its_faces_point_outwards() {
        let faces = bracket_faces();
        let [width, plate, height, rib] = [2.0 * HALF_WIDTH, PLATE, HEIGHT, RIB].map(f64::from);
        let plates = width * plate * (0.07 + height - plate);
        let ribs = 2.0 * rib * 0.5 * (0.062 - plate) * (height - 0.01 - plate);
        // Area of a regular polygon with n sides and the circumradius r: n r^2 sin(2 pi / n) / 2.
        let sides = BOSS_SIDES as f64;
        let boss = 0.5 * sides * 0.013 * 0.013 * (std::f64::consts::TAU / sides).sin() * 0.016;
        let expected = plates + ribs + boss;
        let actual = volume(&faces);
        assert!((actual - expected).abs() < 1e-5 * expected, "expected {expected}, got {actual}");
        for [a, b, c] in &faces.triangles {
            let [a, b, c] = [a, b, c].map(|index| *index as usize);
            let point = |index: usize| Vector3::from(faces.positions[index]);
            let normal = (point(b) - point(a)).cross(&(point(c) - point(a))).normalize();
            assert!((normal - Vector3::from(faces.normals[a])).norm() < 1e-4 && faces.normals[a] == faces.normals[c]);
        }
        let lowest = faces.positions.iter().map(|position| position[1]).fold(f32::INFINITY, f32::min);
        assert_eq!(lowest, 0.0, "the base lies on the ground");
    }
}
