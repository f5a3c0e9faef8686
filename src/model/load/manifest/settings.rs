//! The tables `look` and `deform` of `scene.toml`. They contain settings of the scene and of the backends.

use crate::backend_settings::{BatchPolicy, RasterPolicy};
use crate::scene::{
    Antialiasing, Bloom, Culling, DeformationSettings, Ground, MeshEdges, NormalMethod, RenderSettings, ShadowSettings,
    StorageType, ToneMapping, Transparency,
};

/// The table `look`. Missing keys have the default of [`RenderSettings`].
#[derive(Debug, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct LookKeys {
    sun: Option<[f32; 3]>,
    sunlight: Option<[f32; 3]>,
    skylight: Option<[f32; 3]>,
    zenith: Option<[f32; 3]>,
    horizon: Option<[f32; 3]>,
    shadow: Option<ShadowSettings>,
    ground: Option<Ground>,
    edges: Option<MeshEdges>,
    samples: Option<u32>,
    antialias: Option<Antialiasing>,
    bloom: Option<Bloom>,
    tone: Option<ToneMapping>,
    exposure: Option<f32>,
    dither: Option<bool>,
    transparency: Option<Transparency>,
    opaque_alpha: Option<f32>,
    fragments: Option<u32>,
    culling: Option<Culling>,
    /// A setting of the backends.
    #[serde(default)]
    pub(super) raster: RasterPolicy,
}

impl LookKeys {
    /// The settings of the scene.
    pub(super) fn render_settings(&self) -> RenderSettings {
        let default = RenderSettings::default();
        RenderSettings {
            sun: self.sun.unwrap_or(default.sun),
            sunlight: self.sunlight.unwrap_or(default.sunlight),
            skylight: self.skylight.unwrap_or(default.skylight),
            zenith: self.zenith.unwrap_or(default.zenith),
            horizon: self.horizon.unwrap_or(default.horizon),
            shadow: self.shadow.or(default.shadow),
            ground: self.ground.or(default.ground),
            edges: self.edges.or(default.edges),
            samples: self.samples.unwrap_or(default.samples),
            antialias: self.antialias.unwrap_or(default.antialias),
            bloom: self.bloom.or(default.bloom),
            tone: self.tone.unwrap_or(default.tone),
            exposure: self.exposure.unwrap_or(default.exposure),
            dither: self.dither.unwrap_or(default.dither),
            transparency: self.transparency.unwrap_or(default.transparency),
            opaque_alpha: self.opaque_alpha.unwrap_or(default.opaque_alpha),
            fragments: self.fragments.or(default.fragments),
            culling: self.culling.unwrap_or(default.culling),
        }
    }
}

/// The table `deform`. Missing keys have the default of [`DeformationSettings`].
#[derive(Debug, Default, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(super) struct DeformKeys {
    storage: StorageType,
    normals: NormalMethod,
    truncation: Option<f64>,
    compensated: bool,
    displacements: bool,
    boxes: bool,
    /// A setting of the backends.
    pub(super) batches: BatchPolicy,
}

impl DeformKeys {
    /// The settings of the scene.
    pub(super) fn deformation_settings(&self) -> DeformationSettings {
        DeformationSettings {
            storage: self.storage,
            normals: self.normals,
            truncation: self.truncation,
            compensated: self.compensated,
            displacements: self.displacements,
            boxes: self.boxes,
        }
    }
}
