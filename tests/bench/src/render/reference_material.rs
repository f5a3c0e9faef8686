//! Materials of the ray-cast references, in f64 and with decoded textures.

use std::collections::BTreeMap;
use std::sync::Arc;

use nalgebra::Vector3;

use super::reference_texture::{ReferenceTexture, TextureRole};
use modalcast_model::domain::AlphaMode;
use modalcast_model::scene::Scene;

/// Alpha mode of a material, without the cutoff.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum AlphaKind {
    Opaque,
    Mask,
    Blend,
}

/// One material. Colors are linear.
#[derive(Debug, Clone)]
pub(super) struct ReferenceMaterial {
    pub(super) alpha_kind: AlphaKind,
    pub(super) double_sided: bool,
    pub(super) ambient: Vector3<f64>,
    pub(super) diffuse: Vector3<f64>,
    pub(super) specular: Vector3<f64>,
    /// Exponent of the specular highlight.
    pub(super) exponent: f64,
    pub(super) alpha: f64,
    /// Alpha from which a masked surface is visible.
    pub(super) alpha_cutoff: f64,
    /// Alpha from which a surface that is not opaque casts a shadow.
    pub(super) shadow_alpha_cutoff: f64,
    pub(super) color_texture: Option<Arc<ReferenceTexture>>,
    pub(super) normal_texture: Option<Arc<ReferenceTexture>>,
}

impl ReferenceMaterial {
    /// Converts the materials of a scene. Each texture is decoded once per role.
    pub(super) fn from_scene(scene: &Scene) -> Vec<Self> {
        // The key is the index of the texture, and whether it is a color texture.
        let mut textures: BTreeMap<(usize, bool), Arc<ReferenceTexture>> = BTreeMap::new();
        let mut decode_texture = |texture: Option<usize>, role: TextureRole| {
            texture.map(|index| {
                let entry = textures.entry((index, role == TextureRole::Color));
                Arc::clone(entry.or_insert_with(|| Arc::new(ReferenceTexture::new(&scene.textures[index], role))))
            })
        };
        let shadow_threshold = scene.look.shadow.unwrap_or_default().alpha_threshold;
        let to_f64 = |color: [f32; 3]| Vector3::from(color).cast::<f64>();
        let convert = |material: &modalcast_model::domain::Material| {
            let (alpha_kind, alpha_cutoff, shadow_alpha_cutoff) = match material.alpha_mode {
                AlphaMode::Opaque => (AlphaKind::Opaque, 0.0, 0.0),
                AlphaMode::Mask { cutoff } => (AlphaKind::Mask, cutoff, cutoff),
                AlphaMode::Blend => (AlphaKind::Blend, 0.0, shadow_threshold),
            };
            Self {
                alpha_kind,
                double_sided: material.double_sided,
                ambient: to_f64(material.ambient),
                diffuse: to_f64(material.diffuse),
                specular: to_f64(material.specular),
                exponent: f64::from(material.shininess),
                alpha: f64::from(material.alpha),
                alpha_cutoff: f64::from(alpha_cutoff),
                shadow_alpha_cutoff: f64::from(shadow_alpha_cutoff),
                color_texture: decode_texture(material.color_texture, TextureRole::Color),
                normal_texture: decode_texture(material.normal_texture, TextureRole::Normal),
            }
        };
        scene.materials.iter().map(convert).collect()
    }
}
