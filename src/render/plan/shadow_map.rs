//! Textures of the shadow map.

use crate::types::BlurMethod;
use modalcast_model::scene::{MomentFormat, ShadowSettings};

/// A texture of a shadow map.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ShadowTexture {
    pub(crate) name: &'static str,
    pub(crate) texel_bytes: u32,
    /// Number of array layers: one per cascade, or one that all cascades share.
    pub(crate) layers: u32,
}

/// The textures of a shadow map.
pub(crate) fn shadow_textures(shadow: &ShadowSettings, blur_method: BlurMethod) -> Vec<ShadowTexture> {
    let texture = |name, texel_bytes, layers| ShadowTexture { name, texel_bytes, layers };
    // Two moments per texel.
    let moment_bytes = if shadow.moments == MomentFormat::F16 { 4 } else { 8 };
    let mut textures = vec![texture("shadow depth", 4, shadow.cascades)];
    if shadow.has_moments() {
        textures.push(texture("shadow moments", moment_bytes, shadow.cascades));
        if matches!(blur_method, BlurMethod::Rows | BlurMethod::Fragments) {
            textures.push(texture("shadow moments, blurred in x", moment_bytes, 1));
        }
    }
    textures
}
