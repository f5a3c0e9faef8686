//! Combines several plants into one scene. The shapes, materials and images of each species are stored once.

use nalgebra::{Matrix4, Rotation3, Vector3};

use modalcast_model::domain::{Texture, Transform};
use modalcast_model::error::Result;
use modalcast_model::scene::{RenderSettings, SceneParts};

/// Placement of one plant on the ground plane.
#[derive(Debug, Clone, Copy)]
pub(super) struct PlantInstance {
    /// Index of the species.
    pub(super) species: usize,
    /// Position to the right.
    pub(super) x: f64,
    /// Position towards the camera.
    pub(super) z: f64,
    /// Rotation about the trunk, radians.
    pub(super) rotation: f64,
    pub(super) scale: f64,
}

/// Combines instances of Y-up species into one scene with these render settings.
pub(super) fn combine_plants(
    name: &str,
    species: &[&SceneParts],
    instances: &[PlantInstance],
    look: RenderSettings,
) -> SceneParts {
    let mut forest = SceneParts { look, ..SceneParts::named(name) };
    let first_indices: Vec<[usize; 2]> = species.iter().map(|species| add_shared_data(&mut forest, species)).collect();
    for (plant_number, instance) in instances.iter().enumerate() {
        let [first_shape, first_material] = first_indices[instance.species];
        let placement = Matrix4::new_translation(&Vector3::new(instance.x, 0.0, instance.z))
            * Rotation3::new(Vector3::y() * instance.rotation).to_homogeneous()
            * Matrix4::new_scaling(instance.scale);
        let first_domain = forest.domains.len();
        for domain in &species[instance.species].domains {
            let mut copy = domain.clone();
            copy.name = format!("{} of plant {plant_number}", domain.name);
            copy.shape += first_shape;
            copy.material += first_material;
            copy.material_ranges.iter_mut().for_each(|range| range.material += first_material);
            copy.placement = Transform::from_matrix(&(placement * domain.placement.to_matrix()));
            if let Some(attachment) = &mut copy.attachment {
                attachment.parent += first_domain;
            }
            copy.shares_q_with = copy.shares_q_with.map(|source| source + first_domain);
            forest.domains.push(copy);
        }
    }
    forest
}

/// Adds the shared data of a species and returns the indices of its first shape and material.
fn add_shared_data(forest: &mut SceneParts, species: &SceneParts) -> [usize; 2] {
    let [first_shape, first_material, first_texture] =
        [forest.shapes.len(), forest.materials.len(), forest.textures.len()];
    forest.shapes.extend_from_slice(&species.shapes);
    forest.textures.extend_from_slice(&species.textures);
    for material in &species.materials {
        let mut copy = material.clone();
        copy.color_texture = copy.color_texture.map(|index| index + first_texture);
        copy.normal_texture = copy.normal_texture.map(|index| index + first_texture);
        forest.materials.push(copy);
    }
    [first_shape, first_material]
}

/// The tree in blossom: leaves of the material `light leaf` become petals, leaves of the material `leaf` become light
/// green.
///
/// # Errors
/// Those of `Texture::new`. They do not occur, because each texture keeps its size.
pub(super) fn build_blossoming_tree(tree: &SceneParts) -> Result<SceneParts> {
    let mut parts = SceneParts::named("peach tree");
    add_shared_data(&mut parts, tree);
    parts.domains.clone_from(&tree.domains);
    for (name, tint) in [("leaf", [1.25, 1.12, 0.75]), ("light leaf", [1.85, 1.02, 2.9])] {
        let leaf = parts.materials.iter().find(|material| material.name == name);
        let Some(index) = leaf.and_then(|leaf| leaf.color_texture) else { continue };
        parts.textures[index] = tint_texture(&parts.textures[index], tint)?;
    }
    Ok(parts)
}

/// An image with its colors multiplied by a tint and clamped to 255; alpha is unchanged.
fn tint_texture(image: &Texture, tint: [f32; 3]) -> Result<Texture> {
    let tint_texel = |texel: &[u8]| {
        let tint_channel = |channel: usize| (f32::from(texel[channel]) * tint[channel]).round().min(255.0) as u8;
        [tint_channel(0), tint_channel(1), tint_channel(2), texel[3]]
    };
    let rgba = image.rgba().chunks_exact(4).flat_map(tint_texel).collect();
    Texture::new(image.name.clone(), image.width(), image.height(), rgba)
}

#[cfg(test)]
mod tests {
    use super::*;
    use modalcast_model::load;
    use modalcast_model::scene::Scene;

    #[test]
    fn plants_share_species_data_and_have_separate_parents() {
        let tree = load::open("tree").expect("a tree").scene.parts();
        let blossom = build_blossoming_tree(&tree).expect("a blossoming tree");
        assert_ne!(blossom.textures, tree.textures);
        let instance = |species: usize, x: f64| PlantInstance { species, x, z: 0.0, rotation: 1.0, scale: 0.5 };
        let instances = [instance(0, -5.0), instance(1, 0.0), instance(1, 5.0)];
        let forest = combine_plants("three", &[&tree, &blossom], &instances, tree.look);
        let domain_count = tree.domains.len();
        assert_eq!((forest.shapes.len(), forest.domains.len()), (2 * tree.shapes.len(), 3 * domain_count));
        // Plant 0 is of species 0, plants 1 and 2 are of species 1.
        for (index, domain) in forest.domains.iter().enumerate() {
            let has_own_parent = domain
                .attachment
                .as_ref()
                .is_none_or(|attachment| attachment.parent / domain_count == index / domain_count);
            assert!(
                has_own_parent && domain.shape / tree.shapes.len() == usize::from(index >= domain_count),
                "{}",
                domain.name
            );
        }
        let scene = Scene::new(forest).expect("a valid scene");
        assert!(scene.rest_bounds.max[0] - scene.rest_bounds.min[0] > 10.0);
    }
}
