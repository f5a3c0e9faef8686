//! Combines several plants into one scene: the shapes, materials and images of each species are stored once.

use nalgebra::{Matrix4, Rotation3, Vector3};

use modalcast_model::domain::{Texture, Transform};
use modalcast_model::error::Result;
use modalcast_model::scene::{RenderSettings, SceneParts};

/// Placement of one plant: to the right, towards the viewer, rotation about its trunk in radians, and scale.
#[derive(Debug, Clone, Copy)]
pub(super) struct PlantInstance {
    /// Index of the species.
    pub(super) species: usize,
    pub(super) right: f64,
    pub(super) near: f64,
    pub(super) turn: f64,
    pub(super) scale: f64,
}

/// Combines plants of Y-up species into one scene with this look.
pub(super) fn plant(name: &str, species: &[&SceneParts], stands: &[PlantInstance], look: RenderSettings) -> SceneParts {
    let mut forest = SceneParts { look, ..SceneParts::named(name) };
    let firsts: Vec<[usize; 2]> = species.iter().map(|species| bring(&mut forest, species)).collect();
    for (number, stand) in stands.iter().enumerate() {
        let [shape, material] = firsts[stand.species];
        let place = Matrix4::new_translation(&Vector3::new(stand.right, 0.0, stand.near))
            * Rotation3::new(Vector3::y() * stand.turn).to_homogeneous()
            * Matrix4::new_scaling(stand.scale);
        let first = forest.domains.len();
        for domain in &species[stand.species].domains {
            let mut own = domain.clone();
            own.name = format!("{} of plant {number}", domain.name);
            own.shape += shape;
            own.material += material;
            own.material_ranges.iter_mut().for_each(|run| run.material += material);
            own.placement = Transform::from_matrix(&(place * domain.placement.to_matrix()));
            if let Some(attachment) = &mut own.attachment {
                attachment.parent += first;
            }
            own.shares_q_with = own.shares_q_with.map(|twin| twin + first);
            forest.domains.push(own);
        }
    }
    forest
}

/// Adds the shared data of a species and returns the indices of its first shape and material.
fn bring(forest: &mut SceneParts, species: &SceneParts) -> [usize; 2] {
    let [shape, material, texture] = [forest.shapes.len(), forest.materials.len(), forest.textures.len()];
    forest.shapes.extend_from_slice(&species.shapes);
    forest.textures.extend_from_slice(&species.textures);
    for own in &species.materials {
        let mut own = own.clone();
        own.color_texture = own.color_texture.map(|index| index + texture);
        own.normal_texture = own.normal_texture.map(|index| index + texture);
        forest.materials.push(own);
    }
    [shape, material]
}

/// The tree in blossom: leaves of the second kind become petals, and those of the first kind a young green.
///
/// # Errors
/// Only those that the tree's own images would cause.
pub(super) fn in_blossom(tree: &SceneParts) -> Result<SceneParts> {
    let mut parts = SceneParts { name: "peach tree".into(), ..SceneParts::named("peach tree") };
    bring(&mut parts, tree);
    parts.domains.clone_from(&tree.domains);
    for (name, tint) in [("leaf", [1.25, 1.12, 0.75]), ("light leaf", [1.85, 1.02, 2.9])] {
        let leaf = parts.materials.iter().find(|material| material.name == name);
        let Some(index) = leaf.and_then(|leaf| leaf.color_texture) else { continue };
        parts.textures[index] = tinted(&parts.textures[index], tint)?;
    }
    Ok(parts)
}

/// An image with its colors multiplied by a tint and clamped to 255; alpha is unchanged.
fn tinted(image: &Texture, tint: [f32; 3]) -> Result<Texture> {
    let texel = |texel: &[u8]| {
        let own = |channel: usize| (f32::from(texel[channel]) * tint[channel]).round().min(255.0) as u8;
        [own(0), own(1), own(2), texel[3]]
    };
    let rgba = image.rgba().chunks_exact(4).flat_map(texel).collect();
    Texture::new(image.name.clone(), image.width(), image.height(), rgba)
}

#[cfg(test)]
mod tests {
    use super::*;
    use modalcast_model::load;
    use modalcast_model::scene::Scene;

    #[test]
    fn plants_share_species_data_and_keep_parents_of_their_own() {
        let tree = load::open("tree").expect("built").scene.parts();
        let blossom = in_blossom(&tree).expect("tinted");
        assert_ne!(blossom.textures, tree.textures);
        let stand = |species: usize, right: f64| PlantInstance { species, right, near: 0.0, turn: 1.0, scale: 0.5 };
        let stands = [stand(0, -5.0), stand(1, 0.0), stand(1, 5.0)];
        let forest = plant("three", &[&tree, &blossom], &stands, tree.look);
        let count = tree.domains.len();
        assert_eq!((forest.shapes.len(), forest.domains.len()), (2 * tree.shapes.len(), 3 * count));
        for (at, domain) in forest.domains.iter().enumerate() {
            let own = domain.attachment.as_ref().is_none_or(|attachment| attachment.parent / count == at / count);
            assert!(own && domain.shape / tree.shapes.len() == usize::from(at >= count), "{}", domain.name);
        }
        let scene = Scene::new(forest).expect("a good scene");
        assert!(scene.rest_bounds.max[0] - scene.rest_bounds.min[0] > 10.0);
    }
}
