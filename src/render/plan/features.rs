//! Features of a scene's shaders. The defines of the sources are derived from them.

use crate::layout::ambient::AmbientSampling;
use crate::types::BlurMethod;
use modalcast_model::scene::{Culling, ShadowMethod, ShadowSettings};

/// Features that the shaders of a scene need. Code of other features is not compiled.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ShaderFeatures {
    /// Some triangle has a color texture.
    pub(crate) textures: bool,
    pub(crate) normal_maps: bool,
    /// Triangles have several materials.
    pub(crate) material_table: bool,
    pub(crate) ground: bool,
    /// Some triangle is blended.
    pub(crate) blend_layers: bool,
    /// Blended triangles are sorted per pixel; implies `blend_layers`.
    pub(crate) oit: bool,
    /// Two-pass transparency may draw parts of blended triangles as opaque: those of high alpha.
    pub(crate) opaque_parts: bool,
    pub(crate) shadow: Option<ShadowSettings>,
    /// The sampling of the ambient occlusion for the device; none without it.
    pub(crate) ambient_occlusion: Option<AmbientSampling>,
    /// The method for the device; never `Auto`.
    pub(crate) blur_method: BlurMethod,
    /// The method for the device; never `Auto`.
    pub(crate) culling: Culling,
}

impl ShaderFeatures {
    /// No feature.
    #[cfg(test)]
    pub(crate) const NONE: Self = Self {
        textures: false,
        normal_maps: false,
        material_table: false,
        ground: false,
        blend_layers: false,
        oit: false,
        opaque_parts: false,
        shadow: None,
        ambient_occlusion: None,
        blur_method: BlurMethod::Tiles,
        culling: Culling::None,
    };

    /// The defines of the shader sources.
    pub(crate) fn defines(&self) -> Vec<&'static str> {
        let feature_defines = [
            ("TEXTURES", self.textures),
            ("NORMAL_MAPS", self.normal_maps),
            ("UVS", self.textures || self.normal_maps),
            ("MATERIAL_TABLE", self.material_table),
            ("HAS_GROUND", self.ground),
            ("BLEND_LAYERS", self.blend_layers),
            ("OIT", self.oit),
            ("OPAQUE_PARTS", self.opaque_parts),
        ];
        let feature_defines = feature_defines.into_iter().filter_map(|(name, is_enabled)| is_enabled.then_some(name));
        let shadow = self.shadow.iter().flat_map(shadow_defines);
        let culling = self.has_culling().then_some("CULLED");
        feature_defines.chain(shadow).chain(culling).collect()
    }

    /// Shadow settings, if the shadow map is a variance shadow map.
    pub(crate) fn variance_shadow(&self) -> Option<&ShadowSettings> {
        self.shadow.as_ref().filter(|shadow| shadow.method == ShadowMethod::Variance)
    }

    /// Define of the number of cascades, if the shadow map has several.
    pub(crate) fn cascade_define(&self) -> Option<&'static str> {
        self.shadow.as_ref().and_then(cascade_define)
    }

    /// Whether triangles are culled.
    pub(crate) fn has_culling(&self) -> bool {
        self.culling != Culling::None
    }

    /// Whether occluded triangles are culled.
    pub(crate) fn has_occlusion_culling(&self) -> bool {
        self.culling == Culling::Occlusion
    }
}

/// Defines of a shadow method.
pub(crate) fn shadow_defines(shadow: &ShadowSettings) -> impl Iterator<Item = &'static str> {
    let method = match shadow.method {
        ShadowMethod::Variance => "SHADOW_VARIANCE",
        ShadowMethod::Standard => "SHADOW_STANDARD",
        ShadowMethod::PercentageCloser => "SHADOW_FILTERED",
    };
    let fallback = shadow.filters_undecided_points().then_some("PCF_FALLBACK");
    ["SHADOWS", method].into_iter().chain(fallback).chain(cascade_define(shadow))
}

/// Define of the number of cascades; none for a map with one cascade.
fn cascade_define(shadow: &ShadowSettings) -> Option<&'static str> {
    match shadow.cascades {
        2 => Some("CASCADES 2"),
        3 => Some("CASCADES 3"),
        4 => Some("CASCADES 4"),
        _ => None,
    }
}
