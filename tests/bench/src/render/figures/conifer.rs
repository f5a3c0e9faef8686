//! Generates conifers: a trunk of rings, and whorls of boughs whose sprays are textured quads.
//!
//! One bough is modeled, one meter long; all others are rotated and scaled instances of it. Y is up, lengths are
//! meters.

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
    /// Quadratic drop of a bough: at its tip, a bough of length 1 is at height `rise` - `hang`.
    pub(super) hang: f64,
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
    hang: 0.42,
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
    hang: 0.62,
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
    hang: 0.30,
    needle_color: [112.0, 146.0, 146.0],
    seed: 5,
};

const TRUNK_RADIUS: f64 = 0.13;
const SIDES: usize = 20;
const RINGS: usize = 24;

/// Generates a conifer; `bark`: a color image and its normal map, both tiling.
///
/// # Errors
/// None in practice for the sizes in this module.
pub(super) fn build(parameters: &ConiferParameters, bark: [&Texture; 2]) -> Result<SceneParts> {
    let mut parts = SceneParts::named(parameters.name);
    parts.textures =
        vec![bark[0].clone(), bark[1].clone(), needles::draw_texture(parameters.needle_color, parameters.seed)?];
    let wood = Material {
        specular: [0.04; 3],
        shininess: 8.0,
        color_texture: Some(0),
        normal_texture: Some(1),
        ..Material::default()
    };
    add_rigid_domain(&mut parts, "trunk", trunk_mesh(parameters)?, wood)?;
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
    // The leader: one bough that points up.
    let top = Translation3::new(0.0, parameters.height - 0.42, 0.0).to_homogeneous();
    let upright = Rotation3::from_axis_angle(&Vector3::z_axis(), 0.25 * TAU).to_homogeneous();
    parts.domains.push(bough_domain("leader".into(), top * upright * Matrix4::new_scaling(0.45)));
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
    let azimuth = TAU * (bough as f64 + random_offset(0.32)) / parameters.boughs as f64 + 2.4 * whorl as f64;
    let elevation = 0.55 * height_fraction * height_fraction + random_offset(0.08);
    let rotation = Rotation3::from_axis_angle(&Vector3::y_axis(), azimuth)
        * Rotation3::from_axis_angle(&Vector3::z_axis(), elevation)
        * Rotation3::from_axis_angle(&Vector3::x_axis(), random_offset(0.25));
    Translation3::new(0.0, height, 0.0).to_homogeneous() * rotation.to_homogeneous() * Matrix4::new_scaling(length)
}

/// A tapering tube. Its texture repeats twice around the trunk, and upwards without distortion.
fn trunk_mesh(parameters: &ConiferParameters) -> Result<Mesh> {
    // Height and radius of a ring.
    let ring_size = |ring: usize| {
        let height_fraction = ring as f64 / RINGS as f64;
        // The trunk widens towards the roots.
        let flare = 1.0 + 0.5 * (-9.0 * height_fraction).exp();
        (height_fraction * parameters.height, TRUNK_RADIUS * flare * (1.0 - 0.96 * height_fraction))
    };
    let point = |(ring, side): (usize, usize)| {
        let (height, radius) = ring_size(ring);
        let angle = TAU * side as f64 / SIDES as f64;
        [(radius * angle.cos()) as f32, height as f32, (radius * angle.sin()) as f32]
    };
    let grid = || (0..=RINGS).flat_map(|ring| (0..=SIDES).map(move |side| (ring, side)));
    let rest: Vec<[f32; 3]> = grid().map(point).collect();
    let uvs = grid().map(|(ring, side)| [2.0 * side as f32 / SIDES as f32, (2.2 * ring_size(ring).0) as f32]).collect();
    let corner = |ring: usize, side: usize| (ring * (SIDES + 1) + side) as u32;
    let cell_triangles = |cell: usize| {
        let (ring, side) = (cell / SIDES, cell % SIDES);
        let [a, b] = [corner(ring, side), corner(ring, side + 1)];
        let [c, d] = [corner(ring + 1, side + 1), corner(ring + 1, side)];
        [[a, c, b], [a, d, c]]
    };
    let triangles: Vec<[u32; 3]> = (0..RINGS * SIDES).flat_map(cell_triangles).collect();
    let normal = |(_, side): (usize, usize)| {
        let angle = TAU * side as f64 / SIDES as f64;
        [angle.cos() as f32, 0.0, angle.sin() as f32]
    };
    let corners = Corners { vertices: (0..rest.len() as u32).collect(), normals: grid().map(normal).collect(), uvs };
    Mesh::new(rest, corners, triangles)
}

/// One textured quad of needles.
struct Spray {
    base: Vector3<f64>,
    direction: Vector3<f64>,
    width_direction: Vector3<f64>,
    length: f64,
    width: f64,
}

/// Sprays on both sides of a stem along +X that rises and then hangs, and along the stem.
fn bough_mesh(parameters: &ConiferParameters) -> Result<Mesh> {
    let mut rng = Rng::with_seed(parameters.seed ^ 0xB0);
    let mut random_offset = |max: f64| max * (2.0 * rng.f64() - 1.0);
    let stem = |t: f64| Vector3::new(t, parameters.rise * t - parameters.hang * t * t, 0.0);
    let mut sprays = Vec::new();
    const PAIRS: usize = 13;
    for pair in 0..2 * PAIRS {
        let t = 0.12 + 0.86 * (pair / 2) as f64 / PAIRS as f64;
        let side = if pair % 2 == 0 { 1.0 } else { -1.0 };
        let direction =
            Vector3::new(0.62 + random_offset(0.1), -0.10 - 0.4 * parameters.hang * t + random_offset(0.08), side)
                .normalize();
        let width_direction =
            direction.cross(&(Vector3::y() + Vector3::new(random_offset(0.3), 0.0, random_offset(0.3)))).normalize();
        let length = (0.50 * (1.0 - t).powf(0.7) + 0.13) * (1.0 + random_offset(0.12));
        sprays.push(Spray { base: stem(t), direction, width_direction, length, width: 0.17 });
    }
    const STEM_SEGMENTS: usize = 4;
    for segment in 0..STEM_SEGMENTS {
        let [a, b] = [segment, segment + 1].map(|end| stem(0.05 + 0.97 * end as f64 / STEM_SEGMENTS as f64));
        let direction = (b - a).normalize();
        for width_direction in [Vector3::z(), direction.cross(&Vector3::z())] {
            sprays.push(Spray { base: a, direction, width_direction, length: 1.12 * (b - a).norm(), width: 0.15 });
        }
    }
    spray_mesh(&sprays)
}

fn spray_mesh(sprays: &[Spray]) -> Result<Mesh> {
    let (mut rest, mut uvs, mut triangles) = (Vec::new(), Vec::new(), Vec::new());
    for spray in sprays {
        let first = rest.len() as u32;
        for (u, v) in [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)] {
            let point =
                spray.base + spray.direction * (u * spray.length) + spray.width_direction * ((v - 0.5) * spray.width);
            rest.push([point.x as f32, point.y as f32, point.z as f32]);
            uvs.push([u as f32, v as f32]);
        }
        triangles.extend([[first, first + 1, first + 2], [first, first + 2, first + 3]]);
    }
    let vertices: Vec<u32> = (0..rest.len() as u32).collect();
    // Normals follow the rounded shape of the bough, because flat normals of the sprays would flicker.
    let spray_normals = smooth_normals(&rest, &vertices, &triangles);
    let bough_normal = |(point, spray_normal): (&[f32; 3], &[f32; 3])| {
        let spray_normal = Vector3::from(*spray_normal);
        let upward = if spray_normal.y < 0.0 { -spray_normal } else { spray_normal };
        let outward = Vector3::new(0.25 * point[0], 0.75, 0.9 * point[2]);
        <[f32; 3]>::from((outward + 0.5 * upward).normalize())
    };
    let normals = rest.iter().zip(&spray_normals).map(bough_normal).collect();
    Mesh::new(rest, Corners { vertices, normals, uvs }, triangles)
}

#[cfg(test)]
mod tests {
    use super::*;
    use modalcast_model::scene::Scene;

    #[test]
    fn conifers_have_the_stated_height_and_bare_trunk() {
        let gray = Texture::new("grey", 1, 1, vec![128, 128, 255, 255]).expect("a texture");
        for parameters in [FIR, HEMLOCK, SPRUCE] {
            let parts = build(&parameters, [&gray, &gray]).expect("a conifer");
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
