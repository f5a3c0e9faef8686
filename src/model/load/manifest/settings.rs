//! The tables `look` and `deform` of `scene.toml`. They contain settings of the scene and of the backends.

use std::fmt;

use serde::Deserialize as _;
use serde::de::value::{MapAccessDeserializer, StrDeserializer};
use serde::de::{Deserializer, Error, MapAccess, Visitor};

use crate::backend_settings::{BatchPolicy, RasterPolicy};
use crate::scene::{
    AmbientOcclusion, Antialiasing, Bloom, Culling, DeformationSettings, Ground, Lighting, LookOverrides, LookPreset,
    MeshEdges, MomentFormat, NormalMethod, PresetRequest, RenderSettings, ShadowFit, ShadowMethod, ShadowSettings,
    StorageType, ToneMapping, Transparency,
};

/// The value of the key `look`: a table, or the name of a preset instead of a table with the key `preset` only.
///
/// # Errors
/// Those of the table, or an unknown name.
pub(super) fn deserialize_look<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<LookKeys>, D::Error> {
    deserializer.deserialize_any(LookVisitor).map(Some)
}

struct LookVisitor;

impl<'de> Visitor<'de> for LookVisitor {
    type Value = LookKeys;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("the name of a preset, or a table")
    }

    fn visit_str<E: Error>(self, name: &str) -> Result<LookKeys, E> {
        let preset = LookPreset::deserialize(StrDeserializer::new(name))?;
        Ok(LookKeys { preset: Some(preset), ..LookKeys::default() })
    }

    fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<LookKeys, A::Error> {
        LookKeys::deserialize(MapAccessDeserializer::new(map))
    }
}

/// The table `look.shadow`. A missing key has the value of a preset or the default of [`ShadowSettings`].
#[derive(Debug, Clone, Copy, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct ShadowKeys {
    method: Option<ShadowMethod>,
    size: Option<u32>,
    blur: Option<f32>,
    least_variance: Option<f32>,
    bleeding: Option<f32>,
    alpha_threshold: Option<f32>,
    moments: Option<MomentFormat>,
    #[serde(rename = "splits")]
    cascades: Option<u32>,
    fit: Option<ShadowFit>,
}

impl ShadowKeys {
    fn settings(&self) -> ShadowSettings {
        let default = ShadowSettings::default();
        ShadowSettings {
            method: self.method.unwrap_or(default.method),
            size: self.size.unwrap_or(default.size),
            blur: self.blur.unwrap_or(default.blur),
            least_variance: self.least_variance.unwrap_or(default.least_variance),
            bleeding: self.bleeding.unwrap_or(default.bleeding),
            alpha_threshold: self.alpha_threshold.unwrap_or(default.alpha_threshold),
            moments: self.moments.unwrap_or(default.moments),
            cascades: self.cascades.unwrap_or(default.cascades),
            fit: self.fit.unwrap_or(default.fit),
            pcf_fallback: default.pcf_fallback,
        }
    }
}

/// The table `look.ground`.
#[derive(Debug, Clone, Copy, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct GroundKeys {
    color: Option<[f32; 3]>,
}

/// The table `look`. A missing key has the value of a preset, or of the lighting ([`Lighting::settings`]).
#[derive(Debug, Default, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct LookKeys {
    preset: Option<LookPreset>,
    pub(super) lighting: Option<Lighting>,
    sun: Option<[f32; 3]>,
    sunlight: Option<[f32; 3]>,
    skylight: Option<[f32; 3]>,
    zenith: Option<[f32; 3]>,
    horizon: Option<[f32; 3]>,
    shadow: Option<ShadowKeys>,
    ground: Option<GroundKeys>,
    ambient_occlusion: Option<AmbientOcclusion>,
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
    /// The settings of the scene. `models`: those of its models, which determine the lighting if no key does.
    pub(super) fn render_settings(&self, models: &RenderSettings) -> RenderSettings {
        let default = self.lighting.unwrap_or(models.lighting).settings();
        let ground =
            self.ground.map(|keys| Ground { color: keys.color.or(default.ground.and_then(|ground| ground.color)) });
        let settings = RenderSettings {
            preset: None,
            lighting: default.lighting,
            sun: self.sun.unwrap_or(default.sun),
            sunlight: self.sunlight.unwrap_or(default.sunlight),
            skylight: self.skylight.unwrap_or(default.skylight),
            zenith: self.zenith.unwrap_or(default.zenith),
            horizon: self.horizon.unwrap_or(default.horizon),
            shadow: self.shadow.map_or(default.shadow, |keys| Some(keys.settings())),
            ground: ground.or(default.ground),
            ambient_occlusion: self.ambient_occlusion.or(default.ambient_occlusion),
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
        };
        settings.with_preset(PresetRequest { preset: self.preset, overrides: self.overrides() })
    }

    /// The keys that no preset changes.
    fn overrides(&self) -> LookOverrides {
        let method = self.shadow.and_then(|keys| keys.method);
        let requires_cuda = matches!(self.raster, RasterPolicy::Cuda | RasterPolicy::Fastest);
        LookOverrides {
            antialias: self.antialias,
            samples: self.samples,
            // The compute rasterizer draws the depth of variance maps only, so it implies the method.
            shadow_method: method.or(requires_cuda.then_some(ShadowMethod::Variance)),
            shadow_size: self.shadow.and_then(|keys| keys.size),
            shadow_blur: self.shadow.and_then(|keys| keys.blur),
        }
    }
}

/// The table `deform`. A missing key has the default of [`DeformationSettings`].
#[derive(Debug, Default, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(super) struct DeformKeys {
    storage: StorageType,
    normals: Option<NormalMethod>,
    compensated: bool,
    displacements: bool,
    boxes: bool,
    /// A setting of the backends.
    pub(super) batches: BatchPolicy,
}

impl DeformKeys {
    /// The settings of the scene. `normals` is the method that the models choose.
    pub(super) fn deformation_settings(&self, normals: NormalMethod) -> DeformationSettings {
        DeformationSettings {
            storage: self.storage,
            normals: self.normals.unwrap_or(normals),
            compensated: self.compensated,
            displacements: self.displacements,
            boxes: self.boxes,
        }
    }
}
