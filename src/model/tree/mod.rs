//! The built-in scene `tree`, generated from a seed: beams, their modes, and the modes of the skin.
//!
//! A trunk of 6.8 m carries boughs and twigs, boughs carry twigs, and boughs and twigs carry leaf clusters. Every
//! wooden part is a clamped Euler-Bernoulli beam along its centerline, loaded with the masses of its children at their
//! joints; its modes are lifted to the skin. Modes are mass-orthonormal in kg, so that modal forces are U^T f with f in
//! newtons.
//!
//! The frame of a part has its origin at the center of the base, +Y along the start of the centerline, and +Z as close
//! to up as possible.

mod bark;
mod beam;
mod centerline;
mod cluster;
mod element;
mod leaf_image;
mod noise;
mod random;
mod skin;
mod skin_modes;
mod species;
mod template;

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use rayon::prelude::*;

use crate::domain::{AlphaMode, Attachment, Domain, Material, Metadata, Transform};
use crate::error::Result;
use crate::scene::{RenderSettings, SceneParts};
use random::SplitMix64;
use template::{ChildJoint, PartKind, PartTemplate};

/// Parameters of the tree.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TreeParameters {
    pub seed: u64,
}

impl Default for TreeParameters {
    fn default() -> Self {
        Self { seed: 7 }
    }
}

/// Index of the bark material; the leaf materials follow.
const BARK: usize = 0;

/// The two leaf materials: shaded and sunlit leaves.
const LEAVES: [(&str, leaf_image::LeafColors); 2] = [
    (
        "leaf",
        leaf_image::LeafColors {
            blade: [92.0, 133.0, 52.0],
            edge: [78.0, 118.0, 44.0],
            vein: [150.0, 176.0, 96.0],
            stem: [112.0, 112.0, 62.0],
        },
    ),
    (
        "light leaf",
        leaf_image::LeafColors {
            blade: [124.0, 156.0, 58.0],
            edge: [106.0, 142.0, 50.0],
            vein: [176.0, 194.0, 110.0],
            stem: [130.0, 122.0, 66.0],
        },
    ),
];

/// Generates the tree.
///
/// # Errors
/// `Fault` if the eigenproblem of a beam does not converge.
pub fn generate(recipe: &TreeParameters) -> Result<SceneParts> {
    let mut random = SplitMix64::new(recipe.seed);
    let mut parts = SceneParts::named("tree");
    parts.rigid_transforms = true;
    // Leaves and bark are dark, so strong sunlight does not overexpose them.
    parts.look = RenderSettings {
        sun: [0.52, 0.74, 0.62],
        sunlight: [1.15, 1.06, 0.92],
        skylight: [0.30, 0.34, 0.39],
        ..RenderSettings::default()
    };
    add_materials(&mut parts, &mut random.fork())?;
    let templates = species::plan(&mut random.fork());
    let cast = templates.par_iter().map(PartTemplate::cast).collect::<Result<Vec<_>>>()?;
    let (shapes, metadata): (Vec<_>, Vec<_>) = cast.into_iter().unzip();
    parts.shapes = shapes;
    let mut planter = PartPlacer { templates: &templates, metadata: &metadata, domains: vec![], random: random.fork() };
    planter.place_trunk();
    parts.domains = planter.domains;
    Ok(parts)
}

fn add_materials(parts: &mut SceneParts, random: &mut SplitMix64) -> Result<()> {
    parts.textures.extend(bark::textures(random)?);
    parts.materials.push(Material {
        name: "bark".into(),
        specular: [0.04; 3],
        shininess: 8.0,
        color_texture: Some(0),
        normal_texture: Some(1),
        ..Material::default()
    });
    for (name, palette) in &LEAVES {
        parts.materials.push(Material {
            name: (*name).into(),
            specular: [0.10, 0.11, 0.08],
            shininess: 22.0,
            color_texture: Some(parts.textures.len()),
            alpha_mode: AlphaMode::Mask { cutoff: 0.5 },
            double_sided: true,
            ..Material::default()
        });
        parts.textures.push(leaf_image::texture(name, palette, random)?);
    }
    Ok(())
}

/// Places instances of the templates ([`PartTemplate`]), parents before children.
struct PartPlacer<'a> {
    templates: &'a [PartTemplate],
    metadata: &'a [Metadata],
    domains: Vec<Domain>,
    random: SplitMix64,
}

impl PartPlacer<'_> {
    /// Places the trunk, which is the last template, and everything attached to it.
    fn place_trunk(&mut self) {
        let trunk = self.templates.len() - 1;
        self.domains.push(self.domain("trunk".into(), trunk, BARK, Transform::IDENTITY));
        self.place_children(0, trunk, &Isometry3::identity());
    }

    /// Places the children of a domain, recursively.
    fn place_children(&mut self, parent: usize, mold: usize, world_from_parent: &Isometry3<f64>) {
        let templates = self.templates;
        for (number, bud) in templates[mold].children.iter().enumerate() {
            let parent_from_child = joint(&templates[mold], bud, world_from_parent);
            let world_from_child = world_from_parent * parent_from_child;
            let child = &templates[bud.mold];
            let path = self.domains[parent].name.split_once(' ').map_or(String::new(), |(_, path)| format!("{path}."));
            let (kind, material) = match child.kind {
                PartKind::Leaf => ("leaf", BARK + 1 + usize::from(self.random.next_unit() < 0.35)),
                PartKind::Trunk | PartKind::Branch => ("branch", BARK),
            };
            let placement = Transform::from_matrix(&world_from_child.to_homogeneous());
            let mut domain = self.domain(format!("{kind} {path}{}", number + 1), bud.mold, material, placement);
            domain.attachment = Some(Attachment {
                parent,
                frame: Transform::from_matrix(&parent_from_child.to_homogeneous()),
                rows: templates[mold].ring_rows(bud.ring),
            });
            self.domains.push(domain);
            self.place_children(self.domains.len() - 1, bud.mold, &world_from_child);
        }
    }

    fn domain(&self, name: String, mold: usize, material: usize, placement: Transform) -> Domain {
        Domain {
            name,
            shape: mold,
            material,
            placement,
            attachment: None,
            follows: None,
            material_ranges: vec![],
            rest_q: vec![],
            shares_q_with: None,
            metadata: self.metadata[mold].clone(),
        }
    }
}

/// `parent_from_child`: the origin is the ring's center, +Y the bud's direction, and +Z points towards the sky.
fn joint(parent: &PartTemplate, bud: &ChildJoint, world_from_parent: &Isometry3<f64>) -> Isometry3<f64> {
    let turn = world_from_parent.rotation;
    let child = centerline::frame(&(turn * bud.direction), &Vector3::y());
    let rotation = turn.inverse() * UnitQuaternion::from_rotation_matrix(&child);
    Isometry3::from_parts(Translation3::from(parent.centerline.points[bud.ring]), rotation)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Scene;

    fn grown(seed: u64) -> SceneParts {
        generate(&TreeParameters { seed }).expect("every beam is solved")
    }

    fn note<'a>(domain: &'a Domain, name: &str) -> &'a str {
        domain.metadata.notes.get(name).map_or("", String::as_str)
    }

    #[test]
    fn a_seed_grows_the_same_tree_twice_and_another_seed_another_tree() {
        let (one, two, other) = (grown(7), grown(7), grown(8));
        let rest = |parts: &SceneParts| {
            parts.shapes.iter().flat_map(|shape| shape.mesh.rest_positions().to_vec()).collect::<Vec<_>>()
        };
        let modes = |parts: &SceneParts| {
            parts.shapes.iter().flat_map(|shape| shape.modes.columns().to_vec()).collect::<Vec<_>>()
        };
        let frames = |parts: &SceneParts| parts.domains.iter().map(|domain| domain.placement).collect::<Vec<_>>();
        assert_eq!(rest(&one), rest(&two));
        assert_eq!(modes(&one), modes(&two));
        assert_eq!(frames(&one), frames(&two));
        assert_eq!(one.textures, two.textures);
        assert!(rest(&one) != rest(&other) && modes(&one) != modes(&other) && frames(&one) != frames(&other));
        assert_ne!(one.textures, other.textures);
    }

    #[test]
    fn every_seed_gives_a_scene_of_the_promised_size_that_needs_what_it_should() {
        for seed in [0, 7, u64::MAX] {
            let scene = Scene::new(grown(seed)).expect("a valid scene");
            let count = |kind: &str| scene.domains.iter().filter(|domain| note(domain, "kind") == kind).count();
            let corners = |domain: &Domain| scene.shapes[domain.shape].mesh.triangles().len();
            let triangles: usize = scene.domains.iter().map(corners).sum();
            assert!(scene.domains.len() >= 300, "{} domains", scene.domains.len());
            assert!((50_000..=130_000).contains(&triangles), "{triangles} triangles");
            assert_eq!(count("trunk"), 1);
            assert!(count("branch") >= 60 && count("leaf") >= 200);
            assert_eq!(count("trunk") + count("branch") + count("leaf"), scene.domains.len());
            let features = scene.features;
            assert!(features.modes && features.textures && features.normal_maps && features.mask && features.shadows);
            assert!(!features.blend && !features.shear);
            let height = scene.rest_bounds.max[1];
            assert!((7.0..9.5).contains(&height), "{height} m high");
            assert!(scene.rest_bounds.min[1].abs() < 1e-6, "the tree stands on {}", scene.rest_bounds.min[1]);
        }
    }

    #[test]
    fn some_leaves_are_rigid_and_some_bend_with_two_modes() {
        let parts = grown(7);
        let rank = |domain: &Domain| parts.shapes[domain.shape].modes.rank();
        let leaves = parts.domains.iter().filter(|domain| note(domain, "kind") == "leaf");
        let ranks: std::collections::BTreeSet<usize> = leaves.map(rank).collect();
        assert_eq!(ranks.into_iter().collect::<Vec<_>>(), [0, 2]);
        for domain in &parts.domains {
            assert_eq!(domain.metadata.eigenvalues.len(), rank(domain));
            assert_eq!(note(domain, "mass_normalised") == "true", rank(domain) > 0);
        }
    }

    #[test]
    fn every_joint_is_the_centre_of_the_ring_that_carries_it() {
        let parts = grown(7);
        for domain in &parts.domains[1..] {
            let attachment = domain.attachment.as_ref().expect("all but the trunk hang on something");
            let parent = &parts.domains[attachment.parent];
            let rest = parts.shapes[parent.shape].mesh.rest_positions();
            let mean = |rows: &[u32]| {
                let sum: Vector3<f64> = rows.iter().map(|row| Vector3::from(rest[*row as usize]).cast::<f64>()).sum();
                let center = parent.placement.to_matrix().transform_point(&(sum / rows.len() as f64).into());
                (center.coords - domain.placement.translation()).norm()
            };
            assert!(mean(&attachment.rows) <= 1e-5, "{}: a gap of {}", domain.name, mean(&attachment.rows));
            // Counterexample: the center of the ring below differs.
            let count = attachment.rows.len() as u32;
            let below: Vec<u32> = attachment.rows.iter().map(|row| row.saturating_sub(count)).collect();
            assert!(mean(&below) > 1e-3, "{}", domain.name);
        }
        assert!(parts.domains[0].attachment.is_none());
    }

    #[test]
    fn frames_compose_to_placements_and_are_rotations() {
        let parts = grown(7);
        for domain in &parts.domains {
            let linear = domain.placement.linear();
            assert!((linear.transpose() * linear - nalgebra::Matrix3::identity()).abs().max() < 1e-5);
            assert!((linear.determinant() - 1.0).abs() < 1e-5);
            let Some(attachment) = &domain.attachment else { continue };
            let composed = parts.domains[attachment.parent].placement.compose(attachment.frame);
            for (got, want) in composed.0.iter().zip(domain.placement.0) {
                assert!((got - want).abs() <= 1e-5, "{}: {got} is not {want}", domain.name);
            }
        }
    }

    #[test]
    fn frequencies_are_those_of_a_living_tree() {
        for domain in &grown(7).domains {
            let hertz: Vec<f64> =
                domain.metadata.eigenvalues.iter().map(|value| value.sqrt() / std::f64::consts::TAU).collect();
            assert!(hertz.windows(2).all(|pair| pair[0] <= pair[1]));
            let Some(lowest) = hertz.first() else { continue };
            let level = domain.metadata.notes.get("level").map(String::as_str);
            assert_eq!(level.is_none(), note(domain, "kind") == "leaf", "only leaves have no level");
            let range = match level {
                Some("0") => 0.4..1.5,
                Some("1") => 0.6..6.0,
                _ => 1.5..15.0,
            };
            assert!(range.contains(lowest), "{}: {lowest} Hz", domain.name);
        }
    }

    #[test]
    fn the_first_mode_sways_the_top_more_than_the_stem_below_it() {
        let parts = grown(7);
        let shape = &parts.shapes[parts.domains[0].shape];
        let sway = |vertex: usize| Vector3::from_fn(|axis, _| shape.modes.entry(vertex, axis, 0)).norm();
        let count = shape.mesh.rest_positions().len();
        let largest = (0..count).map(sway).fold(0.0, f32::max);
        assert!(sway(count - 1) > 0.95 * largest);
        assert!(sway(count / 4) < 0.3 * largest);
    }
}
