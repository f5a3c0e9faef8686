//! A domain: one deformable or rigid object of a scene, with its mesh, modes, materials and textures.
//!
//! The constructors of this module check lengths, indices and numbers. The constructed values are immutable, so that
//! other code does not check them again. Positions are in scene units.

mod composed_transform;
mod creases;
mod jpeg_memory;
mod material;
mod mesh;
mod modes;
mod smoothing_groups;
mod tangents;
mod texture;
mod transform;

pub use composed_transform::ComposedTransform;
pub use creases::{CreaseAngle, CreasedCorners, split_at_creases};
pub use material::{AlphaMode, Material};
pub use mesh::{Corners, Mesh, smooth_normals};
pub use modes::{MAX_RANK, Modes};
pub use smoothing_groups::{MAX_RING_TRIANGLES, RING_START, SmoothingGroups};
pub use texture::Texture;
pub use transform::Transform;

use std::collections::BTreeMap;

/// A mesh with its modes. Domains that are instances of one object share a shape.
#[derive(Debug, Clone)]
pub struct Shape {
    pub mesh: Mesh,
    pub modes: Modes,
    /// Per corner, the unit tangent and the sign of the bitangent. Empty unless a normal map needs them.
    pub(crate) tangents: Vec<[f32; 4]>,
    /// Present if normals are computed from the deformed triangles.
    smoothing: Option<SmoothingGroups>,
}

impl Shape {
    /// Combines a mesh and its modes.
    ///
    /// # Errors
    /// `Invalid` if the modes do not have three rows per vertex of the mesh.
    pub fn new(mesh: Mesh, modes: Modes) -> crate::error::Result<Self> {
        if modes.rank() > 0 && modes.vertices() != mesh.rest_positions().len() {
            return Err(crate::error::invalid(
                "modes.rows",
                format!("{} (3 x {} vertices)", 3 * mesh.rest_positions().len(), mesh.rest_positions().len()),
                3 * modes.vertices(),
            ));
        }
        Ok(Self { mesh, modes, tangents: Vec::new(), smoothing: None })
    }

    /// Per corner, the unit tangent (xyz) and the sign of the bitangent (w). Empty if no normal map needs them.
    pub fn tangents(&self) -> &[[f32; 4]] {
        &self.tangents
    }

    /// Computes the tangents (Lengyel's method) unless they already exist.
    pub(crate) fn add_tangents(&mut self) {
        if self.tangents.is_empty() {
            self.tangents = tangents::lengyel_tangents(&self.mesh);
        }
    }

    /// The smoothing groups of the mesh. `None` if the rest normals are transformed by T alone.
    pub const fn smoothing(&self) -> Option<&SmoothingGroups> {
        self.smoothing.as_ref()
    }

    /// Computes the smoothing groups unless they already exist.
    pub(crate) fn add_smoothing(&mut self) {
        self.smoothing.get_or_insert_with(|| SmoothingGroups::from_mesh(&self.mesh));
    }
}

/// Data that the server stores for clients and does not use.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Metadata {
    /// Eigenvalues of the modes, (rad/s)^2, in the order of the columns of U; empty if unknown.
    pub eigenvalues: Vec<f64>,
    /// Other values by name.
    pub notes: BTreeMap<String, String>,
}

/// The joint between a domain and its parent. Clients read it; the server does not move children with their parents.
#[derive(Debug, Clone, PartialEq)]
pub struct Attachment {
    /// Index of the parent domain.
    pub parent: usize,
    /// `parent_from_child` at rest.
    pub frame: Transform,
    /// Vertices of the parent near the joint. Clients fit the motion of the joint to the displacements of these
    /// vertices. Empty for a rigid parent.
    pub vertices: Vec<u32>,
}

/// Attaches a domain to another one by a constant transform: T = T_parent F. The modes of the parent do not affect T.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FollowConstraint {
    /// Index of the followed domain, smaller than the follower's index. The followed domain may be a follower itself.
    pub parent: usize,
    /// F, `parent_from_child`.
    pub frame: Transform,
}

/// Consecutive triangles of a domain that have one material. A range ends where the next range begins.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MaterialRange {
    pub first_triangle: usize,
    /// Index into the scene's materials.
    pub material: usize,
}

/// One deformable or, with rank 0, rigid object of a scene.
#[derive(Debug, Clone)]
pub struct Domain {
    pub name: String,
    /// Index into the scene's shapes.
    pub shape: usize,
    /// Index into the scene's materials.
    pub material: usize,
    /// Ranges of triangles with different materials, ascending. The first range begins at triangle 0. Empty if all
    /// triangles have `material`.
    pub material_ranges: Vec<MaterialRange>,
    /// `world_from_domain` at rest. [`crate::scene::Scene::new`] replaces the placement of a follower by the placement
    /// of its root (the last domain in the chain of followed domains) times the follower's frame relative to the root.
    pub placement: Transform,
    pub attachment: Option<Attachment>,
    /// Present if the domain moves with another one. Steps cannot set the transform of such a domain.
    pub follows: Option<FollowConstraint>,
    /// q at rest. The length is the rank. Empty if all coordinates are 0.
    pub rest_q: Vec<f32>,
    /// A domain with a smaller index and the same rank whose coordinates this domain shares (glTF node weights).
    pub shares_q_with: Option<usize>,
    pub metadata: Metadata,
}

impl Domain {
    /// An unattached domain with material 0 and the identity as placement.
    pub fn new(name: impl Into<String>, shape: usize) -> Self {
        Self {
            name: name.into(),
            shape,
            material: 0,
            material_ranges: vec![],
            placement: Transform::IDENTITY,
            attachment: None,
            follows: None,
            rest_q: vec![],
            shares_q_with: None,
            metadata: Metadata::default(),
        }
    }

    /// Indices of the materials of the domain's triangles: one per range, or `material` if there are no ranges.
    pub fn materials(&self) -> impl Iterator<Item = usize> + '_ {
        let single_material = self.material_ranges.is_empty().then_some(self.material);
        single_material.into_iter().chain(self.material_ranges.iter().map(|range| range.material))
    }
}
