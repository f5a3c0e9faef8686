//! A deformable object as uploaded: mesh, modes, material and textures, checked once and immutable afterwards.
//!
//! Positions are metres times the scene's unit. Behind the constructors of this module no length, index or float is
//! checked again.

mod composed;
mod material;
mod mesh;
mod modes;
mod smoothing;
mod tangents;
mod texture;
mod transform;

pub use composed::Composed;
pub use material::{AlphaMode, Material};
pub use mesh::{Corners, Mesh, smooth_normals};
pub use modes::{MAX_RANK, Modes};
pub use smoothing::{MAX_RING_TRIANGLES, RING_START, Smoothing};
pub use texture::Texture;
pub use transform::Transform;

use std::collections::BTreeMap;

/// A mesh with its modes. Domains that are instances of each other share one shape.
#[derive(Debug, Clone)]
pub struct Shape {
    pub mesh: Mesh,
    pub modes: Modes,
    /// Per corner: unit tangent and the sign of the bitangent. Empty unless a normal map needs it.
    pub(crate) tangents: Vec<[f32; 4]>,
    /// None unless normals follow its deformed triangles.
    smoothing: Option<Smoothing>,
}

impl Shape {
    /// A shape whose modes have three rows per vertex of the mesh.
    ///
    /// # Errors
    /// `Invalid` when the rows of the modes are not three times the vertices of the mesh.
    pub fn new(mesh: Mesh, modes: Modes) -> crate::error::Result<Self> {
        if modes.rank() > 0 && modes.vertices() != mesh.rest().len() {
            return Err(crate::error::invalid(
                "modes.rows",
                format!("{} (3 x {} vertices)", 3 * mesh.rest().len(), mesh.rest().len()),
                3 * modes.vertices(),
            ));
        }
        Ok(Self { mesh, modes, tangents: Vec::new(), smoothing: None })
    }

    /// Per corner: unit tangent (xyz) and sign of the bitangent (w); empty when no normal map needs them.
    pub fn tangents(&self) -> &[[f32; 4]] {
        &self.tangents
    }

    /// Makes the tangents (Lengyel's method) if they are not there yet.
    pub(crate) fn add_tangents(&mut self) {
        if self.tangents.is_empty() {
            self.tangents = tangents::lengyel(&self.mesh);
        }
    }

    /// Smoothing groups and the triangles around them; none when normals turn with the domain alone.
    pub const fn smoothing(&self) -> Option<&Smoothing> {
        self.smoothing.as_ref()
    }

    /// Makes the smoothing groups if they are not there yet.
    pub(crate) fn add_smoothing(&mut self) {
        self.smoothing.get_or_insert_with(|| Smoothing::of(&self.mesh));
    }
}

/// What the server keeps for a client and hands on, but never uses.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Metadata {
    /// Eigenvalues of the modes, (rad/s)^2, in the order of the columns of U; empty when unknown.
    pub eigenvalues: Vec<f64>,
    /// Anything else, by name.
    pub notes: BTreeMap<String, String>,
}

/// How a domain hangs on its parent.
#[derive(Debug, Clone, PartialEq)]
pub struct Attachment {
    /// Index of the parent domain.
    pub parent: usize,
    /// Rest pose of the child's frame in the parent's frame: `parent_from_child`.
    pub frame: Transform,
    /// Vertices of the parent (rows of its U divided by three) that carry the frame: their displaced positions tell
    /// how the frame moves. Empty on a rigid parent.
    pub rows: Vec<u32>,
}

/// A constant place on another domain: T = T_parent F. The parent's modes do not move it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Follow {
    /// Index of the domain that is followed: smaller than that of the follower. It may follow another one itself.
    pub parent: usize,
    /// F, `parent_from_child`.
    pub frame: Transform,
}

/// Where a material begins in a domain's triangles; it holds until the next run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Run {
    pub first_triangle: usize,
    /// Index into the scene's materials.
    pub material: usize,
}

/// One deformable (or, with rank 0, rigid) object of a scene.
#[derive(Debug, Clone)]
pub struct Domain {
    pub name: String,
    /// Index into the scene's shapes.
    pub shape: usize,
    /// Index into the scene's materials.
    pub material: usize,
    /// Several materials by runs of triangles, the first at triangle 0, ascending; empty when all triangles have
    /// `material`.
    pub runs: Vec<Run>,
    /// `world_from_domain` until a step says otherwise. That of a follower is computed, whatever was given.
    pub placement: Transform,
    pub attachment: Option<Attachment>,
    /// Steps name no transform of a domain that follows another one.
    pub follows: Option<Follow>,
    /// The coordinates until a step says otherwise; its length is the rank, or 0 for all zeros.
    pub rest_q: Vec<f32>,
    /// A domain with a smaller index and the same rank whose coordinates this one shares (glTF node weights).
    pub shares_q_with: Option<usize>,
    pub metadata: Metadata,
}

impl Domain {
    /// Indices of the materials that its triangles have, one per run.
    pub fn materials(&self) -> impl Iterator<Item = usize> + '_ {
        let only = self.runs.is_empty().then_some(self.material);
        only.into_iter().chain(self.runs.iter().map(|run| run.material))
    }
}
