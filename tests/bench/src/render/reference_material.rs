//! Materials of the ray-cast references in f64, with decoded images.

use std::collections::BTreeMap;
use std::sync::Arc;

use nalgebra::Vector3;

use super::reference_texture::{ReferenceTexture, TextureRole};
use modalcast_model::domain::AlphaMode;
use modalcast_model::scene::Scene;

/// Alpha mode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum AlphaKind {
    Opaque,
    Mask,
    Blend,
}

/// One material. Colors are linear.
#[derive(Debug, Clone)]
pub(super) struct ReferenceMaterial {
    pub(super) kind: AlphaKind,
    pub(super) double_sided: bool,
    pub(super) ambient: Vector3<f64>,
    pub(super) diffuse: Vector3<f64>,
    pub(super) specular: Vector3<f64>,
    pub(super) exponent: f64,
    pub(super) alpha: f64,
    /// A masked surface is visible where alpha is at least this.
    pub(super) cutoff: f64,
    /// A surface that is not opaque casts a shadow where alpha is at least this.
    pub(super) caster: f64,
    pub(super) color: Option<Arc<ReferenceTexture>>,
    pub(super) normal: Option<Arc<ReferenceTexture>>,
}

impl ReferenceMaterial {
    /// The materials of a scene, in order. Each image is decoded once per use.
    pub(super) fn all(scene: &Scene) -> Vec<Self> {
        let mut decoded: BTreeMap<(usize, bool), Arc<ReferenceTexture>> = BTreeMap::new();
        let mut image = |texture: Option<usize>, purpose: TextureRole| {
            texture.map(|index| {
                let slot = decoded.entry((index, purpose == TextureRole::Color));
                Arc::clone(slot.or_insert_with(|| Arc::new(ReferenceTexture::new(&scene.textures[index], purpose))))
            })
        };
        let threshold = scene.look.shadow.unwrap_or_default().alpha_threshold;
        let wide = |color: [f32; 3]| Vector3::from(color).cast::<f64>();
        let paint = |material: &modalcast_model::domain::Material| {
            let (kind, cutoff, caster) = match material.alpha_mode {
                AlphaMode::Opaque => (AlphaKind::Opaque, 0.0, 0.0),
                AlphaMode::Mask { cutoff } => (AlphaKind::Mask, cutoff, cutoff),
                AlphaMode::Blend => (AlphaKind::Blend, 0.0, threshold),
            };
            Self {
                kind,
                double_sided: material.double_sided,
                ambient: wide(material.ambient),
                diffuse: wide(material.diffuse),
                specular: wide(material.specular),
                exponent: f64::from(material.shininess),
                alpha: f64::from(material.alpha),
                cutoff: f64::from(cutoff),
                caster: f64::from(caster),
                color: image(material.color_texture, TextureRole::Color),
                normal: image(material.normal_texture, TextureRole::Normal),
            }
        };
        scene.materials.iter().map(paint).collect()
    }
}
