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
    AlphaMode, Corners, Domain, Material, Mesh, Metadata, Modes, Shape, Texture, Transform, smooth_normals,
};
use modalcast_model::error::Result;
use modalcast_model::scene::SceneParts;

/// Parameters of a conifer species.
#[derive(Debug, Clone, Copy)]
pub(super) struct ConiferParameters {
    pub(super) name: &'static str,
    pub(super) height: f64,
    /// Height below which no bough grows.
    pub(super) bare: f64,
    /// Length of the lowest boughs.
    pub(super) reach: f64,
    pub(super) whorls: usize,
    pub(super) boughs: usize,
    /// Rise of a bough at its base, and drop of its tip below that, as fractions of its length.
    pub(super) rise: f64,
    pub(super) hang: f64,
    /// sRGB, 0 to 255.
    pub(super) needles: [f32; 3],
    pub(super) seed: u64,
}

/// Stiff, with rising boughs.
pub(super) const FIR: ConiferParameters = ConiferParameters {
    name: "fir",
    height: 7.5,
    bare: 0.9,
    reach: 1.75,
    whorls: 26,
    boughs: 8,
    rise: 0.24,
    hang: 0.42,
    needles: [84.0, 126.0, 82.0],
    seed: 3,
};
/// Slender, with hanging boughs.
pub(super) const HEMLOCK: ConiferParameters = ConiferParameters {
    name: "hemlock",
    height: 8.5,
    bare: 1.6,
    reach: 2.1,
    whorls: 28,
    boughs: 7,
    rise: 0.30,
    hang: 0.62,
    needles: [108.0, 142.0, 70.0],
    seed: 11,
};
/// Dense and bluish, with the lower boughs cut off.
pub(super) const SPRUCE: ConiferParameters = ConiferParameters {
    name: "spruce",
    height: 6.5,
    bare: 2.6,
    reach: 1.9,
    whorls: 36,
    boughs: 10,
    rise: 0.10,
    hang: 0.30,
    needles: [112.0, 146.0, 146.0],
    seed: 5,
};

const TRUNK_RADIUS: f64 = 0.13;
const SIDES: usize = 20;
const RINGS: usize = 24;

/// Generates a conifer; `bark`: a color image and its normal map, both tiling.
///
/// # Errors
/// None in practice for the sizes in this module.
pub(super) fn grow(habit: &ConiferParameters, bark: [&Texture; 2]) -> Result<SceneParts> {
    let mut parts = SceneParts::named(habit.name);
    parts.textures = vec![bark[0].clone(), bark[1].clone(), needles::texture(habit.needles, habit.seed)?];
    let wood = Material {
        specular: [0.04; 3],
        shininess: 8.0,
        color_texture: Some(0),
        normal_texture: Some(1),
        ..Material::default()
    };
    add_rigid_domain(&mut parts, "trunk", trunk(habit)?, wood)?;
    parts.materials.push(Material {
        name: "needles".into(),
        specular: [0.05; 3],
        shininess: 16.0,
        color_texture: Some(2),
        alpha_mode: AlphaMode::Mask { cutoff: 0.35 },
        double_sided: true,
        ..Material::default()
    });
    parts.shapes.push(Shape::new(bough(habit)?, Modes::rigid())?);
    let mut rng = Rng::with_seed(habit.seed);
    for whorl in 0..habit.whorls {
        for bough in 0..habit.boughs {
            let name = format!("bough {}.{}", whorl + 1, bough + 1);
            parts.domains.push(rigid(name, place(habit, [whorl, bough], &mut rng)));
        }
    }
    // The leader: one bough that points up.
    let top = Translation3::new(0.0, habit.height - 0.42, 0.0).to_homogeneous();
    let upright = Rotation3::from_axis_angle(&Vector3::z_axis(), 0.25 * TAU).to_homogeneous();
    parts.domains.push(rigid("leader".into(), top * upright * Matrix4::new_scaling(0.45)));
    Ok(parts)
}

fn rigid(name: String, place: Matrix4<f64>) -> Domain {
    Domain {
        name,
        shape: 1,
        material: 1,
        material_ranges: Vec::new(),
        placement: Transform::from_matrix(&place),
        attachment: None,
        follows: None,
        rest_q: Vec::new(),
        shares_q_with: None,
        metadata: Metadata::default(),
    }
}

/// Placement of a bough. Towards the top whorls are denser and boughs shorter.
fn place(habit: &ConiferParameters, [whorl, bough]: [usize; 2], rng: &mut Rng) -> Matrix4<f64> {
    let mut any = |most: f64| most * (2.0 * rng.f64() - 1.0);
    let share = ((whorl as f64 + any(0.4)) / habit.whorls as f64).clamp(0.0, 1.0);
    let height = habit.bare + (habit.height - habit.bare - 0.25) * share;
    // Long at the foot, short at the top.
    let length = habit.reach * (1.0 - share).powf(0.8) * (1.0 + any(0.16)) + 0.2;
    let around = TAU * (bough as f64 + any(0.32)) / habit.boughs as f64 + 2.4 * whorl as f64;
    // Steeper towards the top.
    let steep = 0.55 * share * share + any(0.08);
    let turn = Rotation3::from_axis_angle(&Vector3::y_axis(), around)
        * Rotation3::from_axis_angle(&Vector3::z_axis(), steep)
        * Rotation3::from_axis_angle(&Vector3::x_axis(), any(0.25));
    Translation3::new(0.0, height, 0.0).to_homogeneous() * turn.to_homogeneous() * Matrix4::new_scaling(length)
}

/// A tapering tube. Its texture repeats twice around the trunk and keeps its proportions upwards.
fn trunk(habit: &ConiferParameters) -> Result<Mesh> {
    let ring = |at: usize| {
        let share = at as f64 / RINGS as f64;
        // The foot widens towards the roots.
        let flare = 1.0 + 0.5 * (-9.0 * share).exp();
        (share * habit.height, TRUNK_RADIUS * flare * (1.0 - 0.96 * share), share)
    };
    let point = |(at, side): (usize, usize)| {
        let (height, radius, _) = ring(at);
        let angle = TAU * side as f64 / SIDES as f64;
        [(radius * angle.cos()) as f32, height as f32, (radius * angle.sin()) as f32]
    };
    let all = || (0..=RINGS).flat_map(|at| (0..=SIDES).map(move |side| (at, side)));
    let rest: Vec<[f32; 3]> = all().map(point).collect();
    let uvs = all().map(|(at, side)| [2.0 * side as f32 / SIDES as f32, (2.2 * ring(at).0) as f32]).collect();
    let corner = |at: usize, side: usize| (at * (SIDES + 1) + side) as u32;
    let cell = |cell: usize| {
        let (at, side) = (cell / SIDES, cell % SIDES);
        let [a, b] = [corner(at, side), corner(at, side + 1)];
        let [c, d] = [corner(at + 1, side + 1), corner(at + 1, side)];
        [[a, c, b], [a, d, c]]
    };
    let triangles: Vec<[u32; 3]> = (0..RINGS * SIDES).flat_map(cell).collect();
    let normal = |(_, side): (usize, usize)| {
        let angle = TAU * side as f64 / SIDES as f64;
        [angle.cos() as f32, 0.0, angle.sin() as f32]
    };
    let corners = Corners { vertices: (0..rest.len() as u32).collect(), normals: all().map(normal).collect(), uvs };
    Mesh::new(rest, corners, triangles)
}

/// One textured quad of needles: base, direction, width direction, length and width.
struct Spray {
    base: Vector3<f64>,
    along: Vector3<f64>,
    across: Vector3<f64>,
    length: f64,
    width: f64,
}

/// Sprays on both sides of a stem along +X that rises and then hangs, and along the stem itself.
fn bough(habit: &ConiferParameters) -> Result<Mesh> {
    let mut rng = Rng::with_seed(habit.seed ^ 0xB0);
    let mut any = |most: f64| most * (2.0 * rng.f64() - 1.0);
    let stem = |t: f64| Vector3::new(t, habit.rise * t - habit.hang * t * t, 0.0);
    let mut sprays = Vec::new();
    const PAIRS: usize = 13;
    for pair in 0..2 * PAIRS {
        let t = 0.12 + 0.86 * (pair / 2) as f64 / PAIRS as f64;
        let side = if pair % 2 == 0 { 1.0 } else { -1.0 };
        let along = Vector3::new(0.62 + any(0.1), -0.10 - 0.4 * habit.hang * t + any(0.08), side).normalize();
        let across = along.cross(&(Vector3::y() + Vector3::new(any(0.3), 0.0, any(0.3)))).normalize();
        let length = (0.50 * (1.0 - t).powf(0.7) + 0.13) * (1.0 + any(0.12));
        sprays.push(Spray { base: stem(t), along, across, length, width: 0.17 });
    }
    const PIECES: usize = 4;
    for piece in 0..PIECES {
        let [a, b] = [piece, piece + 1].map(|at| stem(0.05 + 0.97 * at as f64 / PIECES as f64));
        let along = (b - a).normalize();
        for across in [Vector3::z(), along.cross(&Vector3::z())] {
            sprays.push(Spray { base: a, along, across, length: 1.12 * (b - a).norm(), width: 0.15 });
        }
    }
    mesh(&sprays)
}

fn mesh(sprays: &[Spray]) -> Result<Mesh> {
    let (mut rest, mut uvs, mut triangles) = (Vec::new(), Vec::new(), Vec::new());
    for spray in sprays {
        let first = rest.len() as u32;
        for (u, v) in [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)] {
            let point = spray.base + spray.along * (u * spray.length) + spray.across * ((v - 0.5) * spray.width);
            rest.push([point.x as f32, point.y as f32, point.z as f32]);
            uvs.push([u as f32, v as f32]);
        }
        triangles.extend([[first, first + 1, first + 2], [first, first + 2, first + 3]]);
    }
    let vertices: Vec<u32> = (0..rest.len() as u32).collect();
    // Normals follow the rounded shape of the whole bough, so that sprays are lit as one object; flat normals would
    // flicker.
    let flat = smooth_normals(&rest, &vertices, &triangles);
    let soft = |(point, own): (&[f32; 3], &[f32; 3])| {
        let own = Vector3::from(*own);
        let own = if own.y < 0.0 { -own } else { own };
        let out = Vector3::new(0.25 * point[0], 0.75, 0.9 * point[2]);
        <[f32; 3]>::from((out + 0.5 * own).normalize())
    };
    let normals = rest.iter().zip(&flat).map(soft).collect();
    Mesh::new(rest, Corners { vertices, normals, uvs }, triangles)
}

#[cfg(test)]
mod tests {
    use super::*;
    use modalcast_model::scene::Scene;

    #[test]
    fn conifers_have_the_stated_height_and_bare_foot() {
        let gray = Texture::new("grey", 1, 1, vec![128, 128, 255, 255]).expect("fits");
        for habit in [FIR, HEMLOCK, SPRUCE] {
            let parts = grow(&habit, [&gray, &gray]).expect("grown");
            assert_eq!(parts.domains.len(), 2 + habit.whorls * habit.boughs);
            // The trunk comes first.
            let lowest =
                parts.domains[1..].iter().map(|bough| bough.placement.translation().y).fold(f64::MAX, f64::min);
            assert!(lowest >= habit.bare - 1e-6, "{}: {lowest}", habit.name);
            let bounds = Scene::new(parts).expect("a good scene").rest_bounds;
            assert!(bounds.min[1].abs() < 1e-6 && (bounds.max[1] - habit.height).abs() < 0.3, "{bounds:?}");
        }
    }
}
