//! What a scene needs, computed once at load; kernels, shaders, passes and buffers follow it and nothing else.

use super::{Normals, Parts};
use crate::domain::Domain;

/// A feature is compiled, allocated and run only when its flag is set.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
pub struct Needs {
    /// Some domain has modes: u = U q is computed at all.
    pub modes: bool,
    /// Some material has a colour texture.
    pub textures: bool,
    /// Some material has a normal map on a shape with uvs: tangents exist.
    pub normal_maps: bool,
    /// Some material discards by cutoff.
    pub mask: bool,
    /// Some material blends: the blended pass exists.
    pub blend: bool,
    /// The look asks for shadows: map, moments and blur exist.
    pub shadows: bool,
    /// Steps may shear or scale unevenly: normals need the inverse transpose.
    pub shear: bool,
    /// Normals follow the deformed triangles: their adjacency exists.
    pub exact_normals: bool,
    /// Modes that cannot matter at a step's q are left out: lists of modes exist.
    pub truncation: bool,
    /// Sums carry their rounding errors along.
    pub compensated: bool,
    /// Some domain follows another one by a constant frame: products of transforms exist.
    pub followers: bool,
    /// Displacements are kept, those of domains without modes too: they are 0.
    pub displacements: bool,
    /// A box of each domain is kept.
    pub boxes: bool,
}

impl Needs {
    pub(super) fn of(parts: &Parts) -> Self {
        // What is done about modes costs nothing where there are none.
        let modes = parts.domains.iter().any(|domain| parts.shapes[domain.shape].modes.rank() > 0);
        Self {
            modes,
            textures: parts.any_material(|material| material.colour_texture.is_some()),
            normal_maps: parts.domains.iter().any(|domain| {
                domain.materials().any(|material| parts.materials[material].normal_texture.is_some())
                    && !parts.shapes[domain.shape].tangents().is_empty()
            }),
            mask: parts.any_mask(),
            blend: parts.any_material(|material| material.alpha_mode == crate::domain::AlphaMode::Blend),
            shadows: parts.look.shadow.is_some(),
            shear: !parts.rigid_transforms || !parts.domains.iter().all(is_similar),
            exact_normals: modes && parts.deformation.normals == Normals::Exact,
            truncation: modes && parts.deformation.truncation.is_some(),
            compensated: modes && parts.deformation.compensated,
            followers: parts.domains.iter().any(|domain| domain.follows.is_some()),
            displacements: parts.deformation.displacements,
            boxes: parts.deformation.boxes,
        }
    }

    /// Each flag with its name, in a fixed order.
    pub fn flags(&self) -> [(&'static str, bool); 13] {
        [
            ("modes", self.modes),
            ("textures", self.textures),
            ("normal_maps", self.normal_maps),
            ("mask", self.mask),
            ("blend", self.blend),
            ("shadows", self.shadows),
            ("shear", self.shear),
            ("exact_normals", self.exact_normals),
            ("truncation", self.truncation),
            ("compensated", self.compensated),
            ("followers", self.followers),
            ("displacements", self.displacements),
            ("boxes", self.boxes),
        ]
    }
}

/// Whether neither the placement of a domain nor the frame that it has in another one shears.
fn is_similar(domain: &Domain) -> bool {
    domain.placement.is_similarity() && domain.follows.is_none_or(|follow| follow.frame.is_similarity())
}
