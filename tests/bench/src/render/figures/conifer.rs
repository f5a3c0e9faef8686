//! Generates conifers. The trunk is a tube of rings. A whorl is a set of boughs around the trunk at about one height. A
//! bough consists of sprays: twigs with needles, drawn as textured rectangles.
//!
//! One bough of one meter is modeled. All boughs are rotated and scaled instances of this mesh. Y is up, lengths are
//! meters. Numbers without a comment are chosen by eye.

use std::f64::consts::TAU;

use fastrand::Rng;
use nalgebra::{Matrix4, Rotation3, Translation3, Vector3};

use super::needles;
use crate::render::rigid_domain::add_rigid_domain;
use modalcast_model::domain::{
    AlphaMode, Corners, Domain, Material, Mesh, Modes, Shape, Texture, Transform, smooth_normals,
};
use modalcast_model::error::Result;
use modalcast_model::scene::SceneParts;

/// Parameters of a conifer species.
#[derive(Debug, Clone, Copy)]
pub(super) struct ConiferParameters {
    pub(super) name: &'static str,
    pub(super) height: f64,
    /// Height below which no bough grows.
    pub(super) bare_height: f64,
    /// Length of the lowest boughs.
    pub(super) bough_length: f64,
    pub(super) whorls: usize,
    /// Boughs per whorl.
    pub(super) boughs: usize,
    /// Slope of a bough at its base.
    pub(super) rise: f64,
    /// Quadratic drop of a bough: the tip of a bough of length 1 is at height `rise - sag` relative to its base.
    pub(super) sag: f64,
    /// sRGB, 0 to 255.
    pub(super) needle_color: [f32; 3],
    pub(super) seed: u64,
}

/// Stiff, with rising boughs.
pub(super) const FIR: ConiferParameters = ConiferParameters {
    name: "fir",
    height: 7.5,
    bare_height: 0.9,
    bough_length: 1.75,
    whorls: 26,
    boughs: 8,
    rise: 0.24,
    sag: 0.42,
    needle_color: [84.0, 126.0, 82.0],
    seed: 3,
};
/// Slender, with hanging boughs.
pub(super) const HEMLOCK: ConiferParameters = ConiferParameters {
    name: "hemlock",
    height: 8.5,
    bare_height: 1.6,
    bough_length: 2.1,
    whorls: 28,
    boughs: 7,
    rise: 0.30,
    sag: 0.62,
    needle_color: [108.0, 142.0, 70.0],
    seed: 11,
};
/// Dense and bluish, with the lower boughs cut off.
pub(super) const SPRUCE: ConiferParameters = ConiferParameters {
    name: "spruce",
    height: 6.5,
    bare_height: 2.6,
    bough_length: 1.9,
    whorls: 36,
    boughs: 10,
    rise: 0.10,
    sag: 0.30,
    needle_color: [112.0, 146.0, 146.0],
    seed: 5,
};

/// Radius in meters without the flare at the roots.
const TRUNK_RADIUS: f64 = 0.13;
const TRUNK_SIDES: usize = 20;
const TRUNK_RINGS: usize = 24;

/// Generates a conifer. `bark` is a color image and its normal map; both are seamless.
///
/// # Errors
/// None for the species in this module.
pub(super) fn build(parameters: &ConiferParameters, bark: [&Texture; 2]) -> Result<SceneParts> {
    let mut parts = SceneParts::named(parameters.name);
    parts.textures =
        vec![bark[0].clone(), bark[1].clone(), needles::draw_texture(parameters.needle_color, parameters.seed)?];
    let bark_material = Material {
        specular: [0.04; 3],
        shininess: 8.0,
        color_texture: Some(0),
        normal_texture: Some(1),
        ..Material::default()
    };
    add_rigid_domain(&mut parts, "trunk", trunk_mesh(parameters)?, bark_material)?;
    parts.materials.push(Material {
        name: "needles".into(),
        specular: [0.05; 3],
        shininess: 16.0,
        color_texture: Some(2),
        alpha_mode: AlphaMode::Mask { cutoff: 0.35 },
        double_sided: true,
        ..Material::default()
    });
    parts.shapes.push(Shape::new(bough_mesh(parameters)?, Modes::rigid())?);
    let mut rng = Rng::with_seed(parameters.seed);
    for whorl in 0..parameters.whorls {
        for bough in 0..parameters.boughs {
            let name = format!("bough {}.{}", whorl + 1, bough + 1);
            parts.domains.push(bough_domain(name, bough_placement(parameters, [whorl, bough], &mut rng)));
        }
    }
    // The leader: one bough of length 0.45 that points up and ends near the stated height.
    let top_translation = Translation3::new(0.0, parameters.height - 0.42, 0.0).to_homogeneous();
    let upright_rotation = Rotation3::from_axis_angle(&Vector3::z_axis(), 0.25 * TAU).to_homogeneous();
    parts.domains.push(bough_domain("leader".into(), top_translation * upright_rotation * Matrix4::new_scaling(0.45)));
    Ok(parts)
}

fn bough_domain(name: String, placement: Matrix4<f64>) -> Domain {
    Domain { material: 1, placement: Transform::from_matrix(&placement), ..Domain::new(name, 1) }
}

/// Placement of a bough. Boughs become shorter and steeper towards the top.
fn bough_placement(parameters: &ConiferParameters, [whorl, bough]: [usize; 2], rng: &mut Rng) -> Matrix4<f64> {
    let mut random_offset = |max: f64| max * (2.0 * rng.f64() - 1.0);
    let height_fraction = ((whorl as f64 + random_offset(0.4)) / parameters.whorls as f64).clamp(0.0, 1.0);
    let height = parameters.bare_height + (parameters.height - parameters.bare_height - 0.25) * height_fraction;
    let length = parameters.bough_length * (1.0 - height_fraction).powf(0.8) * (1.0 + random_offset(0.16)) + 0.2;
    // Successive whorls are rotated by about the golden angle, 2.4 radians.
    let azimuth = TAU * (bough as f64 + random_offset(0.32)) / parameters.boughs as f64 + 2.4 * whorl as f64;
    let elevation = 0.55 * height_fraction * height_fraction + random_offset(0.08);
    let rotation = Rotation3::from_axis_angle(&Vector3::y_axis(), azimuth)
        * Rotation3::from_axis_angle(&Vector3::z_axis(), elevation)
        * Rotation3::from_axis_angle(&Vector3::x_axis(), random_offset(0.25));
    Translation3::new(0.0, height, 0.0).to_homogeneous() * rotation.to_homogeneous() * Matrix4::new_scaling(length)
}

/// A tapering tube. Its texture repeats twice around the trunk, and along the trunk without distortion.
fn trunk_mesh(parameters: &ConiferParameters) -> Result<Mesh> {
    // Height and radius of a ring.
    let ring_size = |ring: usize| {
        let height_fraction = ring as f64 / TRUNK_RINGS as f64;
        // The trunk widens towards the roots.
        let flare = 1.0 + 0.5 * (-9.0 * height_fraction).exp();
        (height_fraction * parameters.height, TRUNK_RADIUS * flare * (1.0 - 0.96 * height_fraction))
    };
    let ring_point = |(ring, side): (usize, usize)| {
        let (height, radius) = ring_size(ring);
        let angle = TAU * side as f64 / TRUNK_SIDES as f64;
        [(radius * angle.cos()) as f32, height as f32, (radius * angle.sin()) as f32]
    };
    let grid_points = || (0..=TRUNK_RINGS).flat_map(|ring| (0..=TRUNK_SIDES).map(move |side| (ring, side)));
    let positions: Vec<[f32; 3]> = grid_points().map(ring_point).collect();
    let uvs = grid_points()
        .map(|(ring, side)| [2.0 * side as f32 / TRUNK_SIDES as f32, (2.2 * ring_size(ring).0) as f32])
        .collect();
    let corner_index = |ring: usize, side: usize| (ring * (TRUNK_SIDES + 1) + side) as u32;
    let cell_triangles = |cell: usize| {
        let (ring, side) = (cell / TRUNK_SIDES, cell % TRUNK_SIDES);
        let [a, b] = [corner_index(ring, side), corner_index(ring, side + 1)];
        let [c, d] = [corner_index(ring + 1, side + 1), corner_index(ring + 1, side)];
        [[a, c, b], [a, d, c]]
    };
    let triangles: Vec<[u32; 3]> = (0..TRUNK_RINGS * TRUNK_SIDES).flat_map(cell_triangles).collect();
    let ring_normal = |(_, side): (usize, usize)| {
        let angle = TAU * side as f64 / TRUNK_SIDES as f64;
        [angle.cos() as f32, 0.0, angle.sin() as f32]
    };
    let corners = Corners {
        vertices: (0..positions.len() as u32).collect(),
        normals: grid_points().map(ring_normal).collect(),
        uvs,
    };
    Mesh::new(positions, corners, triangles)
}

/// One textured rectangle of needles.
struct Spray {
    base: Vector3<f64>,
    direction: Vector3<f64>,
    width_direction: Vector3<f64>,
    length: f64,
    width: f64,
}

/// A bough: sprays on both sides of its stem and along the stem. The stem extends along +X, rises, and then sags.
fn bough_mesh(parameters: &ConiferParameters) -> Result<Mesh> {
    // A random sequence other than that of the placements in `build`.
    let mut rng = Rng::with_seed(parameters.seed ^ 0xB0);
    let mut random_offset = |max: f64| max * (2.0 * rng.f64() - 1.0);
    let stem_point = |t: f64| Vector3::new(t, parameters.rise * t - parameters.sag * t * t, 0.0);
    let mut sprays = Vec::new();
    const PAIRS: usize = 13;
    // Sprays of a pair are on opposite sides of the stem.
    for index in 0..2 * PAIRS {
        let t = 0.12 + 0.86 * (index / 2) as f64 / PAIRS as f64;
        let side = if index % 2 == 0 { 1.0 } else { -1.0 };
        let direction =
            Vector3::new(0.62 + random_offset(0.1), -0.10 - 0.4 * parameters.sag * t + random_offset(0.08), side)
                .normalize();
        let width_direction =
            direction.cross(&(Vector3::y() + Vector3::new(random_offset(0.3), 0.0, random_offset(0.3)))).normalize();
        let length = (0.50 * (1.0 - t).powf(0.7) + 0.13) * (1.0 + random_offset(0.12));
        sprays.push(Spray { base: stem_point(t), direction, width_direction, length, width: 0.17 });
    }
    const STEM_SEGMENTS: usize = 4;
    for segment in 0..STEM_SEGMENTS {
        let [a, b] = [segment, segment + 1].map(|end| stem_point(0.05 + 0.97 * end as f64 / STEM_SEGMENTS as f64));
        let direction = (b - a).normalize();
        for width_direction in [Vector3::z(), direction.cross(&Vector3::z())] {
            sprays.push(Spray { base: a, direction, width_direction, length: 1.12 * (b - a).norm(), width: 0.15 });
        }
    }
    spray_mesh(&sprays)
}

fn spray_mesh(sprays: &[Spray]) -> Result<Mesh> {
    let (mut positions, mut uvs, mut triangles) = (Vec::new(), Vec::new(), Vec::new());
    for spray in sprays {
        let first_corner = positions.len() as u32;
        for (u, v) in [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)] {
            let point =
                spray.base + spray.direction * (u * spray.length) + spray.width_direction * ((v - 0.5) * spray.width);
            positions.push([point.x as f32, point.y as f32, point.z as f32]);
            uvs.push([u as f32, v as f32]);
        }
        triangles.extend([
            [first_corner, first_corner + 1, first_corner + 2],
            [first_corner, first_corner + 2, first_corner + 3],
        ]);
    }
    let vertices: Vec<u32> = (0..positions.len() as u32).collect();
    // Normals follow the rounded shape of the bough, because flat normals of the sprays would flicker.
    let spray_normals = smooth_normals(&positions, &vertices, &triangles);
    let bough_normal = |(point, spray_normal): (&[f32; 3], &[f32; 3])| {
        let spray_normal = Vector3::from(*spray_normal);
        let upward_normal = if spray_normal.y < 0.0 { -spray_normal } else { spray_normal };
        let outward_direction = Vector3::new(0.25 * point[0], 0.75, 0.9 * point[2]);
        <[f32; 3]>::from((outward_direction + 0.5 * upward_normal).normalize())
    };
    let normals = positions.iter().zip(&spray_normals).map(bough_normal).collect();
    Mesh::new(positions, Corners { vertices, normals, uvs }, triangles)
}

#[cfg(test)]
mod tests {
    use super::*;
    use modalcast_model::scene::Scene;

    #[test]
    fn conifers_have_the_stated_height_and_bare_trunk() {
        let gray = Texture::new("gray", 1, 1, vec![128, 128, 255, 255]).expect("a texture");
        for parameters in [FIR, HEMLOCK, SPRUCE] {
            let parts = build(&parameters, [&gray, &gray]).expect("a conifer");
            // The trunk, the leader and the boughs.
            assert_eq!(parts.domains.len(), 2 + parameters.whorls * parameters.boughs);
            // Domain 0 is the trunk.
            let lowest_bough =
                parts.domains[1..].iter().map(|bough| bough.placement.translation().y).fold(f64::MAX, f64::min);
            assert!(lowest_bough >= parameters.bare_height - 1e-6, "{}: {lowest_bough}", parameters.name);
            let bounds = Scene::new(parts).expect("a valid scene").rest_bounds;
            assert!(bounds.min[1].abs() < 1e-6 && (bounds.max[1] - parameters.height).abs() < 0.3, "{bounds:?}");
        }
    }
}
