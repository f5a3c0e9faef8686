//! Adds rigid domains to the scenes that are drawn.

use modalcast_model::domain::{Domain, Material, Mesh, Metadata, Modes, Shape, Transform};
use modalcast_model::error::Result;
use modalcast_model::scene::SceneParts;

/// Adds a rigid domain with a shape and a material of its own.
pub(super) fn add_rigid_domain(parts: &mut SceneParts, name: &str, mesh: Mesh, material: Material) -> Result<()> {
    parts.shapes.push(Shape::new(mesh, Modes::rigid())?);
    parts.materials.push(Material { name: name.into(), ..material });
    parts.domains.push(Domain {
        name: name.into(),
        shape: parts.shapes.len() - 1,
        material: parts.materials.len() - 1,
        material_ranges: Vec::new(),
        placement: Transform::IDENTITY,
        attachment: None,
        follows: None,
        rest_q: Vec::new(),
        shares_q_with: None,
        metadata: Metadata::default(),
    });
    Ok(())
}
