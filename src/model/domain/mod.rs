//! A domain: one deformable or rigid object of a scene, with its mesh, modes, materials and textures.
//!
//! The constructors of this module check lengths, indices and numbers. The constructed values are immutable, so that
//! other code does not check them again. Positions are in scene units.

mod composed_transform;
mod creases;
mod inertia;
mod jpeg_memory;
mod material;
mod mesh;
mod modes;
mod rest_origin;
mod smoothing_groups;
mod tangents;
mod texture;
mod transform;

pub use composed_transform::ComposedTransform;
pub use creases::{CreaseAngle, CreasedCorners, split_at_creases};
pub use inertia::Inertia;
pub use material::{AlphaMode, Material};
pub use mesh::{Corners, Mesh, smooth_normals};
pub use modes::{MAX_RANK, Modes};
pub use rest_origin::{MAX_DIAGONALS, RestOrigin};
pub(crate) use rest_origin::{origin_of_bounds, origin_of_positions, power_of_two_at_most, snap_to_grid};
pub use smoothing_groups::{MAX_RING_TRIANGLES, RING_START, SmoothingGroups};
pub use texture::Texture;
pub use transform::Transform;

use std::collections::BTreeMap;

use nalgebra::Matrix4;

/// A mesh with its modes. Domains that are instances of one object share a shape.
#[derive(Debug, Clone)]
pub struct Shape {
    /// Its rest positions are relative to [`Self::origin`].
    pub mesh: Mesh,
    pub modes: Modes,
    /// c, the point that the rest positions of `mesh` are relative to, in scene units and in the frame of the domain:
    /// x0 = c + v for a rest position v of the mesh. Zero unless f32 would round x0 too coarsely.
    origin: [f64; 3],
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
        Ok(Self { mesh, modes, origin: [0.0; 3], tangents: Vec::new(), smoothing: None })
    }

    /// The shape with rest positions relative to `origin`, in scene units.
    #[must_use]
    pub fn with_origin(self, origin: [f64; 3]) -> Self {
        Self { origin, ..self }
    }

    /// c, the point that the rest positions of the mesh are relative to: x0 = c + v. Zero for most shapes.
    pub const fn origin(&self) -> [f64; 3] {
        self.origin
    }

    /// Whether the rest positions are relative to a point other than the origin of the domain's frame.
    pub fn is_centered(&self) -> bool {
        self.origin != [0.0; 3]
    }

    /// x0 of all vertices in f64.
    pub fn exact_positions(&self) -> impl Iterator<Item = [f64; 3]> + '_ {
        let exact = |v: &[f32; 3]| std::array::from_fn(|axis| f64::from(v[axis]) + self.origin[axis]);
        self.mesh.rest_positions().iter().map(exact)
    }

    /// Changes the origin of the rest positions. The vertices stay where they are, up to rounding to f32.
    pub(crate) fn set_origin(&mut self, origin: [f64; 3]) -> crate::error::Result<()> {
        let relative = |x0: [f64; 3]| std::array::from_fn(|axis| (x0[axis] - origin[axis]) as f32);
        let rest_positions = self.exact_positions().map(relative).collect();
        self.mesh = self.mesh.clone().with_rest_positions(rest_positions)?;
        self.origin = origin;
        Ok(())
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
    /// Mass properties of the domain's own material, without the domains that are attached to it; `None` if unknown.
    pub inertia: Option<Inertia>,
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
    /// The parts of the entries of `placement` that rounding to f32 has removed. [`crate::scene::Scene::new`] sets them
    /// to zero if they do not matter, that is, unless the domain is far from the scene's origin.
    pub placement_remainder: [f64; 12],
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
            placement_remainder: [0.0; 12],
            attachment: None,
            follows: None,
            rest_q: vec![],
            shares_q_with: None,
            metadata: Metadata::default(),
        }
    }

    /// `world_from_domain` at rest in f64.
    pub fn placement_matrix(&self) -> Matrix4<f64> {
        let mut matrix = self.placement.to_matrix();
        for (entry, remainder) in self.placement_remainder.iter().enumerate() {
            matrix[(entry / 4, entry % 4)] += remainder;
        }
        matrix
    }

    /// Sets `world_from_domain` at rest in f64.
    pub fn set_placement(&mut self, world_from_domain: &Matrix4<f64>) {
        self.set_rounded_placement(Transform::from_matrix(world_from_domain), world_from_domain);
    }

    /// Sets `world_from_domain` at rest in f32, and in f64 for domains that are far from the scene's origin.
    pub(crate) fn set_rounded_placement(&mut self, rounded: Transform, world_from_domain: &Matrix4<f64>) {
        self.placement = rounded;
        let matrix = rounded.to_matrix();
        let remainder = |entry: usize| {
            let index = (entry / 4, entry % 4);
            world_from_domain[index] - matrix[index]
        };
        self.placement_remainder = std::array::from_fn(remainder);
    }

    /// Indices of the materials of the domain's triangles: one per range, or `material` if there are no ranges.
    pub fn materials(&self) -> impl Iterator<Item = usize> + '_ {
        let single_material = self.material_ranges.is_empty().then_some(self.material);
        single_material.into_iter().chain(self.material_ranges.iter().map(|range| range.material))
    }
}
