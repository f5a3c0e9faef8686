//! The optional features that a scene uses, computed once at load time. These flags alone select kernels, shaders,
//! passes and buffers.

use super::{NormalMethod, SceneParts};
use crate::domain::Domain;

/// Feature flags of a scene. A feature is compiled, allocated and run only if its flag is set.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
pub struct SceneFeatures {
    /// Some domain has modes; requires u = U q.
    pub modes: bool,
    /// Some material has a color texture.
    pub textures: bool,
    /// Some material has a normal map on a shape with texture coordinates; requires tangents.
    pub normal_maps: bool,
    /// Some material is alpha-tested (cut-outs).
    pub mask: bool,
    /// Some material is blended; requires the blended pass.
    pub blend: bool,
    /// The look has shadows; requires the shadow map and, for variance maps, moments and blur.
    pub shadows: bool,
    /// Steps may shear or scale non-uniformly; normals require the inverse transpose.
    pub shear: bool,
    /// Normals are computed from the deformed triangles; requires the triangles around each vertex.
    pub exact_normals: bool,
    /// Sums over modes are compensated: their rounding errors are accumulated and added.
    pub compensated: bool,
    /// Some domain follows another one by a constant frame; requires products of transforms.
    pub followers: bool,
    /// Displacements of all vertices are stored. Those of domains without modes are 0.
    pub displacements: bool,
    /// A bounding box of each domain is stored.
    pub boxes: bool,
}

impl SceneFeatures {
    pub(super) fn from_parts(parts: &SceneParts) -> Self {
        // Without modes, exact normals and compensated sums have no effect, so they are off.
        let modes = parts.domains.iter().any(|domain| parts.shapes[domain.shape].modes.rank() > 0);
        Self {
            modes,
            textures: parts.has_used_material(|material| material.color_texture.is_some()),
            normal_maps: parts.domains.iter().any(|domain| {
                domain.materials().any(|material| parts.materials[material].normal_texture.is_some())
                    && !parts.shapes[domain.shape].tangents().is_empty()
            }),
            mask: parts.has_masked_material(),
            blend: parts.has_used_material(|material| material.alpha_mode == crate::domain::AlphaMode::Blend),
            shadows: parts.look.shadow.is_some(),
            shear: !parts.rigid_transforms || !parts.domains.iter().all(has_similarity_transforms),
            exact_normals: modes && parts.deformation.normals == NormalMethod::Exact,
            compensated: modes && parts.deformation.compensated,
            followers: parts.domains.iter().any(|domain| domain.follows.is_some()),
            displacements: parts.deformation.displacements,
            boxes: parts.deformation.boxes,
        }
    }

    /// Each flag with its name, in a fixed order.
    pub fn flags(&self) -> [(&'static str, bool); 12] {
        [
            ("modes", self.modes),
            ("textures", self.textures),
            ("normal_maps", self.normal_maps),
            ("mask", self.mask),
            ("blend", self.blend),
            ("shadows", self.shadows),
            ("shear", self.shear),
            ("exact_normals", self.exact_normals),
            ("compensated", self.compensated),
            ("followers", self.followers),
            ("displacements", self.displacements),
            ("boxes", self.boxes),
        ]
    }
}

/// Whether the placement of a domain and, for a follower, its frame have a uniform scale and no shear.
fn has_similarity_transforms(domain: &Domain) -> bool {
    domain.placement.is_similarity() && domain.follows.is_none_or(|follow| follow.frame.is_similarity())
}
