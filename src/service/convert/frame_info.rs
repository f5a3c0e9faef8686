//! Converts the description of how a frame was drawn.

use modalcast_proto::v1;

use crate::engine::{FrameInfo, FrameLook, RasterBackend};
use modalcast_model::scene::{Antialiasing, LookPreset, ShadowMethod};

/// A frame head with only the fields that describe how the frame was drawn.
pub(crate) fn wire_frame_info(info: &FrameInfo) -> v1::FrameHead {
    v1::FrameHead {
        shadow_drawn_by: wire_raster_backend(info.raster_backends.shadow).into(),
        visibility_drawn_by: wire_raster_backend(info.raster_backends.visibility).into(),
        look: info.look.as_ref().map(wire_look),
        below_ground: info.below_ground,
        reframed: info.is_reframed,
        ..v1::FrameHead::default()
    }
}

const fn wire_raster_backend(backend: Option<RasterBackend>) -> v1::DrawnBy {
    match backend {
        None => v1::DrawnBy::Unspecified,
        Some(RasterBackend::OpenGl) => v1::DrawnBy::Opengl,
        Some(RasterBackend::Cuda) => v1::DrawnBy::Cuda,
    }
}

fn wire_look(look: &FrameLook) -> v1::FrameLook {
    let preset = match look.preset {
        None => v1::LookPreset::Unspecified,
        Some(LookPreset::Preview) => v1::LookPreset::Preview,
        Some(LookPreset::Standard) => v1::LookPreset::Standard,
        Some(LookPreset::Best) => v1::LookPreset::Best,
    };
    let antialiasing = match look.antialias {
        Antialiasing::None => v1::Antialiasing::None,
        Antialiasing::Fxaa => v1::Antialiasing::Fxaa,
        Antialiasing::Msaa => v1::Antialiasing::Samples,
    };
    let shadow_method = match look.shadow.map(|shadow| shadow.method) {
        None => v1::ShadowMethod::Unspecified,
        Some(ShadowMethod::Variance) => v1::ShadowMethod::Variance,
        Some(ShadowMethod::Standard) => v1::ShadowMethod::Standard,
        Some(ShadowMethod::PercentageCloser) => v1::ShadowMethod::Filtered,
    };
    v1::FrameLook {
        preset: preset.into(),
        antialiasing: antialiasing.into(),
        samples: look.samples,
        shadow_method: shadow_method.into(),
        shadow_size: look.shadow.map_or(0, |shadow| shadow.size),
    }
}
