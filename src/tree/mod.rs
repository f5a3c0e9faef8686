//! The built-in scene `tree`, made in code from a seed: beams to modes, modes to skin.
//!
//! A trunk of 7 m carries boughs, boughs carry twigs, all carry leaf clusters. Every wooden part is a clamped
//! Euler-Bernoulli beam along its centreline that carries the masses of its children where they hang; its modes are
//! lifted to the skin. Modes are mass-orthonormal in kg, so that modal forces are U^T f in newtons.
//!
//! The frame of a part: its origin is the centre of its base, +Y runs along its start, +Z looks up as far as that allows.

mod bark;
mod beam;
mod centreline;
mod cluster;
mod element;
mod leaf_image;
mod lift;
mod mold;
mod noise;
mod plan;
mod random;
mod sheet;

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use rayon::prelude::*;

use crate::domain::{AlphaMode, Attachment, Domain, Material, Metadata, Transform};
use crate::error::Result;
use crate::scene::{Look, Parts};
use mold::{Bud, Kind, Mold};
use random::Random;

/// What the tree is made from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Recipe {
    pub seed: u64,
}

impl Default for Recipe {
    fn default() -> Self {
        Self { seed: 7 }
    }
}

/// Index of the bark among the materials; the leaves follow.
const BARK: usize = 0;

/// Two kinds of leaves: those in the shade and those in the light.
const LEAVES: [(&str, leaf_image::Palette); 2] = [
    (
        "leaf",
        leaf_image::Palette {
            blade: [92.0, 133.0, 52.0],
            edge: [78.0, 118.0, 44.0],
            vein: [150.0, 176.0, 96.0],
            stem: [112.0, 112.0, 62.0],
        },
    ),
    (
        "light leaf",
        leaf_image::Palette {
            blade: [124.0, 156.0, 58.0],
            edge: [106.0, 142.0, 50.0],
            vein: [176.0, 194.0, 110.0],
            stem: [130.0, 122.0, 66.0],
        },
    ),
];

/// Grows the tree.
///
/// # Errors
/// `Fault` when the eigenproblem of a beam does not converge.
pub fn grow(recipe: &Recipe) -> Result<Parts> {
    let mut random = Random::new(recipe.seed);
    let mut parts = Parts::named("tree");
    parts.rigid_transforms = true;
    parts.look = Look { sun: [0.52, 0.74, 0.62], ..Look::default() };
    add_materials(&mut parts, &mut random.fork())?;
    let molds = plan::plan(&mut random.fork());
    let cast = molds.par_iter().map(Mold::cast).collect::<Result<Vec<_>>>()?;
    let (shapes, metadata): (Vec<_>, Vec<_>) = cast.into_iter().unzip();
    parts.shapes = shapes;
    let mut planter = Planter { molds: &molds, metadata: &metadata, domains: vec![], random: random.fork() };
    planter.plant();
    parts.domains = planter.domains;
    Ok(parts)
}

fn add_materials(parts: &mut Parts, random: &mut Random) -> Result<()> {
    parts.textures.extend(bark::textures(random)?);
    parts.materials.push(Material {
        name: "bark".into(),
        specular: [0.04; 3],
        shininess: 8.0,
        colour_texture: Some(0),
        normal_texture: Some(1),
        ..Material::default()
    });
    for (name, palette) in &LEAVES {
        parts.materials.push(Material {
            name: (*name).into(),
            specular: [0.10, 0.11, 0.08],
            shininess: 22.0,
            colour_texture: Some(parts.textures.len()),
            alpha_mode: AlphaMode::Mask { cutoff: 0.5 },
            double_sided: true,
            ..Material::default()
        });
        parts.textures.push(leaf_image::texture(name, palette, random)?);
    }
    Ok(())
}

/// Places molds, parents before children.
struct Planter<'a> {
    molds: &'a [Mold],
    metadata: &'a [Metadata],
    domains: Vec<Domain>,
    random: Random,
}

impl Planter<'_> {
    /// Places the trunk, which is the last mold, and all that hangs on it.
    fn plant(&mut self) {
        let trunk = self.molds.len() - 1;
        self.domains.push(self.domain("trunk".into(), trunk, BARK, Transform::IDENTITY));
        self.dress(0, trunk, &Isometry3::identity());
    }

    /// Places the children of a domain.
    fn dress(&mut self, parent: usize, mold: usize, world_from_parent: &Isometry3<f64>) {
        let molds = self.molds;
        for (number, bud) in molds[mold].buds.iter().enumerate() {
            let parent_from_child = joint(&molds[mold], bud, world_from_parent);
            let world_from_child = world_from_parent * parent_from_child;
            let child = &molds[bud.mold];
            let path = self.domains[parent].name.split_once(' ').map_or(String::new(), |(_, path)| format!("{path}."));
            let (kind, material) = match child.kind {
                Kind::Leaf => ("leaf", BARK + 1 + usize::from(self.random.unit() < 0.35)),
                Kind::Trunk | Kind::Branch => ("branch", BARK),
            };
            let placement = Transform::from_matrix(&world_from_child.to_homogeneous());
            let mut domain = self.domain(format!("{kind} {path}{}", number + 1), bud.mold, material, placement);
            domain.attachment = Some(Attachment {
                parent,
                frame: Transform::from_matrix(&parent_from_child.to_homogeneous()),
                rows: molds[mold].ring_rows(bud.ring),
            });
            self.domains.push(domain);
            self.dress(self.domains.len() - 1, bud.mold, &world_from_child);
        }
    }

    fn domain(&self, name: String, mold: usize, material: usize, placement: Transform) -> Domain {
        Domain {
            name,
            shape: mold,
            material,
            placement,
            attachment: None,
            runs: vec![],
            rest_q: vec![],
            shares_q_with: None,
            metadata: self.metadata[mold].clone(),
        }
    }
}

/// `parent_from_child`: at the ring's centre, along the bud, with +Z towards the sky.
fn joint(parent: &Mold, bud: &Bud, world_from_parent: &Isometry3<f64>) -> Isometry3<f64> {
    let turn = world_from_parent.rotation;
    let child = centreline::frame(&(turn * bud.direction), &Vector3::y());
    let rotation = turn.inverse() * UnitQuaternion::from_rotation_matrix(&child);
    Isometry3::from_parts(Translation3::from(parent.line.points[bud.ring]), rotation)
}
