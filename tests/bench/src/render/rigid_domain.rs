//! Adds rigid domains to the scenes that are drawn.

use modalcast_model::domain::{Domain, Material, Mesh, Modes, Shape};
use modalcast_model::error::Result;
use modalcast_model::scene::SceneParts;

/// Adds a rigid domain with a shape and a material of its own.
pub(super) fn add_rigid_domain(parts: &mut SceneParts, name: &str, mesh: Mesh, material: Material) -> Result<()> {
    parts.shapes.push(Shape::new(mesh, Modes::rigid())?);
    parts.materials.push(Material { name: name.into(), ..material });
    parts.domains.push(Domain { material: parts.materials.len() - 1, ..Domain::new(name, parts.shapes.len() - 1) });
    Ok(())
}
