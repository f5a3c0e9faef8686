//! The built-in scene `tree`, generated from a seed.
//!
//! A trunk of 6.8 m carries boughs and twigs, boughs carry twigs, and boughs and twigs carry leaf clusters. Every part is
//! a clamped beam along its centerline ([`modalcast_beam`]). The modes of the beam are lifted to the part's skin, its
//! surface mesh. The skin consists of rings: each ring is the circle of vertices around one point of the centerline.
//!
//! The modes are loaded-interface modes: at each joint, the beam carries the rigid inertia D_c of everything beyond it.
//! They are normalized to U^T (M + sum P_c^T D_c P_c) U = I with the own mass M in kg and the motions P_c of the joints. U
//! is in 1/sqrt(kg) and q in m sqrt(kg), so that the modal forces are U^T f with f in newtons. Instances of a template
//! carry the same parts, and share their modes. Only the roll of a part about its own axis differs between instances of
//! its parent, because parts turn towards the light. D_c has the roll of the template's up direction.
//!
//! The coordinate frame of a part has its origin at the center of the part's base, +Y along the start of the
//! centerline, and +Z as close to the world's up direction as possible.

mod bark;
mod centerline;
mod cluster;
mod leaf_image;
mod noise;
mod random;
mod skin;
mod species;
mod template;

pub(crate) use leaf_image::{LEAF_BLADE_START, LEAF_SPAN, STEM_U};
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

/// The names of the materials that [`add_materials`] adds.
pub(crate) const TREE_MATERIALS: [&str; 3] = ["bark", LEAF_MATERIALS[0].0, LEAF_MATERIALS[1].0];

/// Index of the bark material. The leaf materials follow it.
const BARK_MATERIAL: usize = 0;

/// The two leaf materials: shaded and sunlit leaves.
const LEAF_MATERIALS: [(&str, leaf_image::LeafColors); 2] = [
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
pub fn generate(parameters: &TreeParameters) -> Result<SceneParts> {
    let mut random = SplitMix64::new(parameters.seed);
    let mut parts = SceneParts::named("tree");
    (parts.unit, parts.rigid_transforms) = (Some(1.0), true);
    // Leaves and bark are dark, so strong sunlight does not overexpose them.
    parts.look = RenderSettings {
        sun: [0.52, 0.74, 0.62],
        sunlight: [1.15, 1.06, 0.92],
        skylight: [0.30, 0.34, 0.39],
        ..RenderSettings::default()
    };
    add_seeded_materials(&mut parts, &mut random.fork())?;
    let templates = species::grow_templates(&mut random.fork())?;
    let shapes_and_metadata = templates.par_iter().map(PartTemplate::build_shape).collect::<Result<Vec<_>>>()?;
    let (shapes, metadata): (Vec<_>, Vec<_>) = shapes_and_metadata.into_iter().unzip();
    parts.shapes = shapes;
    let mut placer = PartPlacer { templates: &templates, metadata: &metadata, domains: vec![], random: random.fork() };
    placer.place_trunk();
    parts.domains = placer.domains;
    Ok(parts)
}

/// Adds bark, leaves and sunlit leaves with their images to a scene without materials.
///
/// # Errors
/// None in practice, because the sizes of the images are constants.
pub(crate) fn add_materials(parts: &mut SceneParts) -> Result<()> {
    add_seeded_materials(parts, &mut SplitMix64::new(TreeParameters::default().seed).fork())
}

fn add_seeded_materials(parts: &mut SceneParts, random: &mut SplitMix64) -> Result<()> {
    parts.textures.extend(bark::textures(random)?);
    parts.materials.push(Material {
        name: "bark".into(),
        specular: [0.04; 3],
        shininess: 8.0,
        color_texture: Some(0),
        normal_texture: Some(1),
        ..Material::default()
    });
    for (name, colors) in &LEAF_MATERIALS {
        parts.materials.push(Material {
            name: (*name).into(),
            specular: [0.10, 0.11, 0.08],
            shininess: 22.0,
            color_texture: Some(parts.textures.len()),
            alpha_mode: AlphaMode::Mask { cutoff: 0.5 },
            double_sided: true,
            ..Material::default()
        });
        parts.textures.push(leaf_image::texture(name, colors, random)?);
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
    /// Places the trunk, which is the last template, and all parts that it carries.
    fn place_trunk(&mut self) {
        let trunk = self.templates.len() - 1;
        self.domains.push(self.create_domain("trunk".into(), trunk, BARK_MATERIAL, Transform::IDENTITY));
        self.place_children(0, trunk, &Isometry3::identity());
    }

    /// Places the children of a domain, and recursively their children.
    fn place_children(&mut self, parent: usize, template_index: usize, world_from_parent: &Isometry3<f64>) {
        let templates = self.templates;
        for (index, child_joint) in templates[template_index].children.iter().enumerate() {
            let parent_from_child = joint_transform(&templates[template_index], child_joint, world_from_parent);
            let world_from_child = world_from_parent * parent_from_child;
            let child = &templates[child_joint.template_index];
            // A name is a kind and the numbers of the joints from the trunk to the part, such as `leaf 3.2`.
            let parent_path = self.domains[parent]
                .name
                .split_once(' ')
                .map_or(String::new(), |(_, parent_path)| format!("{parent_path}."));
            // 35 % of the leaf clusters have the second leaf material, the one for sunlit leaves.
            let (kind, material) = match child.kind {
                PartKind::Leaf => ("leaf", BARK_MATERIAL + 1 + usize::from(self.random.next_unit() < 0.35)),
                PartKind::Trunk | PartKind::Branch => ("branch", BARK_MATERIAL),
            };
            let placement = Transform::from_matrix(&world_from_child.to_homogeneous());
            let mut domain = self.create_domain(
                format!("{kind} {parent_path}{}", index + 1),
                child_joint.template_index,
                material,
                placement,
            );
            domain.attachment = Some(Attachment {
                parent,
                frame: Transform::from_matrix(&parent_from_child.to_homogeneous()),
                vertices: templates[template_index].ring_vertices(child_joint.ring),
            });
            self.domains.push(domain);
            self.place_children(self.domains.len() - 1, child_joint.template_index, &world_from_child);
        }
    }

    fn create_domain(&self, name: String, template_index: usize, material: usize, placement: Transform) -> Domain {
        let metadata = self.metadata[template_index].clone();
        Domain { material, placement, metadata, ..Domain::new(name, template_index) }
    }
}

/// `parent_from_child`. The child's origin is the ring's center, +Y the direction of the joint, and +Z is as close to
/// the world's up direction as possible.
fn joint_transform(
    parent: &PartTemplate,
    child_joint: &ChildJoint,
    world_from_parent: &Isometry3<f64>,
) -> Isometry3<f64> {
    let world_from_parent_rotation = world_from_parent.rotation;
    let world_from_child_rotation =
        centerline::part_orientation(&(world_from_parent_rotation * child_joint.direction), &Vector3::y());
    let rotation =
        world_from_parent_rotation.inverse() * UnitQuaternion::from_rotation_matrix(&world_from_child_rotation);
    Isometry3::from_parts(Translation3::from(parent.centerline.points[child_joint.ring]), rotation)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Scene;

    fn generate_tree(seed: u64) -> SceneParts {
        generate(&TreeParameters { seed }).expect("a valid tree")
    }

    fn note<'a>(domain: &'a Domain, name: &str) -> &'a str {
        domain.metadata.notes.get(name).map_or("", String::as_str)
    }

    #[test]
    fn equal_seeds_give_equal_trees() {
        let (tree, same_tree, other_tree) = (generate_tree(7), generate_tree(7), generate_tree(8));
        let rest_positions = |parts: &SceneParts| {
            parts.shapes.iter().flat_map(|shape| shape.mesh.rest_positions().to_vec()).collect::<Vec<_>>()
        };
        let modes = |parts: &SceneParts| {
            parts.shapes.iter().flat_map(|shape| shape.modes.columns().to_vec()).collect::<Vec<_>>()
        };
        let placements = |parts: &SceneParts| parts.domains.iter().map(|domain| domain.placement).collect::<Vec<_>>();
        assert_eq!(rest_positions(&tree), rest_positions(&same_tree));
        assert_eq!(modes(&tree), modes(&same_tree));
        assert_eq!(placements(&tree), placements(&same_tree));
        assert_eq!(tree.textures, same_tree.textures);
        assert!(
            rest_positions(&tree) != rest_positions(&other_tree)
                && modes(&tree) != modes(&other_tree)
                && placements(&tree) != placements(&other_tree)
        );
        assert_ne!(tree.textures, other_tree.textures);
    }

    #[test]
    fn every_seed_gives_a_valid_scene_of_similar_size() {
        for seed in [0, 7, u64::MAX] {
            let scene = Scene::new(generate_tree(seed)).expect("a valid scene");
            let count = |kind: &str| scene.domains.iter().filter(|domain| note(domain, "kind") == kind).count();
            let triangle_count = |domain: &Domain| scene.shapes[domain.shape].mesh.triangles().len();
            let triangles: usize = scene.domains.iter().map(triangle_count).sum();
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
            assert!(scene.rest_bounds.min[1].abs() < 1e-6, "expected the base at 0, got {}", scene.rest_bounds.min[1]);
        }
    }

    #[test]
    fn leaf_clusters_have_zero_or_two_modes() {
        let parts = generate_tree(7);
        let rank = |domain: &Domain| parts.shapes[domain.shape].modes.rank();
        let leaves = parts.domains.iter().filter(|domain| note(domain, "kind") == "leaf");
        let ranks: std::collections::BTreeSet<usize> = leaves.map(rank).collect();
        assert_eq!(ranks.into_iter().collect::<Vec<_>>(), [0, 2]);
        for domain in &parts.domains {
            assert_eq!(domain.metadata.eigenvalues.len(), rank(domain));
            assert_eq!(note(domain, "mass_normalized") == "true", rank(domain) > 0);
        }
    }

    #[test]
    fn every_joint_is_at_the_center_of_its_ring() {
        let parts = generate_tree(7);
        for domain in &parts.domains[1..] {
            let attachment = domain.attachment.as_ref().expect("a parent for every part but the trunk");
            let parent = &parts.domains[attachment.parent];
            let rest_positions = parts.shapes[parent.shape].mesh.rest_positions();
            let joint_gap = |vertices: &[u32]| {
                let sum: Vector3<f64> =
                    vertices.iter().map(|vertex| Vector3::from(rest_positions[*vertex as usize]).cast::<f64>()).sum();
                let center = parent.placement.to_matrix().transform_point(&(sum / vertices.len() as f64).into());
                (center.coords - domain.placement.translation()).norm()
            };
            assert!(
                joint_gap(&attachment.vertices) <= 1e-5,
                "{}: a gap of {}",
                domain.name,
                joint_gap(&attachment.vertices)
            );
            // Counterexample: the center of the ring below is elsewhere. Rings are consecutive in the vertices of a
            // part.
            let vertex_count = attachment.vertices.len() as u32;
            let lower_ring: Vec<u32> =
                attachment.vertices.iter().map(|vertex| vertex.saturating_sub(vertex_count)).collect();
            assert!(joint_gap(&lower_ring) > 1e-3, "{}", domain.name);
        }
        assert!(parts.domains[0].attachment.is_none());
    }

    #[test]
    fn attachment_frames_compose_to_placements() {
        let parts = generate_tree(7);
        for domain in &parts.domains {
            let linear = domain.placement.linear();
            assert!((linear.transpose() * linear - nalgebra::Matrix3::identity()).abs().max() < 1e-5);
            assert!((linear.determinant() - 1.0).abs() < 1e-5);
            let Some(attachment) = &domain.attachment else { continue };
            let composed = parts.domains[attachment.parent].placement.compose(attachment.frame);
            for (actual, expected) in composed.0.iter().zip(domain.placement.0) {
                assert!((actual - expected).abs() <= 1e-5, "{}: expected {expected}, got {actual}", domain.name);
            }
        }
    }

    #[test]
    fn lowest_frequencies_are_in_the_range_of_real_trees() {
        for domain in &generate_tree(7).domains {
            let hertz: Vec<f64> = domain
                .metadata
                .eigenvalues
                .iter()
                .map(|eigenvalue| eigenvalue.sqrt() / std::f64::consts::TAU)
                .collect();
            assert!(hertz.windows(2).all(|pair| pair[0] <= pair[1]));
            let Some(lowest) = hertz.first() else { continue };
            let level = domain.metadata.notes.get("level").map(String::as_str);
            assert_eq!(level.is_none(), note(domain, "kind") == "leaf", "expected a level unless the part is a leaf");
            // Hertz: the trunk, boughs, then twigs and leaf clusters.
            let range = match level {
                Some("0") => 0.4..1.5,
                Some("1") => 0.6..6.0,
                _ => 1.5..15.0,
            };
            assert!(range.contains(lowest), "{}: {lowest} Hz", domain.name);
        }
    }

    #[test]
    fn first_mode_of_the_trunk_is_largest_at_the_top() {
        let parts = generate_tree(7);
        let shape = &parts.shapes[parts.domains[0].shape];
        let amplitude = |vertex: usize| Vector3::from_fn(|axis, _| shape.modes.entry(vertex, axis, 0)).norm();
        let vertex_count = shape.mesh.rest_positions().len();
        let largest = (0..vertex_count).map(amplitude).fold(0.0, f32::max);
        // Vertices are ordered from the base to the tip.
        assert!(amplitude(vertex_count - 1) > 0.95 * largest);
        assert!(amplitude(vertex_count / 4) < 0.3 * largest);
    }
}
