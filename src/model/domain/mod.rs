//! A domain: one deformable or rigid object of a scene, with its mesh, modes, materials and textures. Objects are
//! validated once and are immutable afterwards.
//!
//! Positions are in scene units. The constructors of this module check lengths, indices and numbers; code that uses the
//! constructed values does not check them again.

mod composed_transform;
mod material;
mod mesh;
mod modes;
mod smoothing_groups;
mod tangents;
mod texture;
mod transform;

pub use composed_transform::ComposedTransform;
pub use material::{AlphaMode, Material};
pub use mesh::{Corners, Mesh, smooth_normals};
pub use modes::{MAX_RANK, Modes};
pub use smoothing_groups::{MAX_RING_TRIANGLES, RING_START, SmoothingGroups};
pub use texture::Texture;
pub use transform::Transform;

use std::collections::BTreeMap;

/// A mesh with its modes. Instances of an object share one shape.
#[derive(Debug, Clone)]
pub struct Shape {
    pub mesh: Mesh,
    pub modes: Modes,
    /// Per corner, the unit tangent and the sign of the bitangent. Empty unless a normal map needs them.
    pub(crate) tangents: Vec<[f32; 4]>,
    /// `None` unless normals are computed from the deformed triangles.
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

    /// Smoothing groups and the triangles around them; `None` if normals only rotate with the domain.
    pub const fn smoothing(&self) -> Option<&SmoothingGroups> {
        self.smoothing.as_ref()
    }

    /// Computes the smoothing groups unless they already exist.
    pub(crate) fn add_smoothing(&mut self) {
        self.smoothing.get_or_insert_with(|| SmoothingGroups::of(&self.mesh));
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
    /// Rest pose of the child's frame in the parent's frame, `parent_from_child`.
    pub frame: Transform,
    /// Vertices of the parent (rows of its U divided by three) from whose displaced positions the motion of the frame
    /// can be determined. Empty for a rigid parent.
    pub rows: Vec<u32>,
}

/// A constant frame on another domain, T = T_parent F. The modes of the parent do not affect it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FollowConstraint {
    /// Index of the followed domain, smaller than that of the follower. The followed domain may be a follower itself.
    pub parent: usize,
    /// F, `parent_from_child`.
    pub frame: Transform,
}

/// The first triangle of a material within a domain. The run ends at the next one.
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
    /// Runs of triangles with different materials, ascending, the first at triangle 0. Empty if all triangles have
    /// `material`.
    pub material_ranges: Vec<MaterialRange>,
    /// `world_from_domain` at rest. For a follower it is computed from the frame, and the given value is ignored.
    pub placement: Transform,
    pub attachment: Option<Attachment>,
    /// For a domain that moves with another one; steps cannot set the transform of such a domain.
    pub follows: Option<FollowConstraint>,
    /// The coordinates at rest. The length is the rank, or 0 for all zeros.
    pub rest_q: Vec<f32>,
    /// A domain with a smaller index and the same rank whose coordinates this domain shares (glTF node weights).
    pub shares_q_with: Option<usize>,
    pub metadata: Metadata,
}

impl Domain {
    /// Indices of the materials of its triangles, one per run.
    pub fn materials(&self) -> impl Iterator<Item = usize> + '_ {
        let only = self.material_ranges.is_empty().then_some(self.material);
        only.into_iter().chain(self.material_ranges.iter().map(|run| run.material))
    }
}
