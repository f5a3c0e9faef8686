//! Render settings of a scene: one directional light (the sun) and its shadow, the ground, the sky, and how triangles
//! are rasterized and blended.

use std::str::FromStr;

use nalgebra::Vector3;

use super::shadow::ShadowSettings;
use super::{AmbientOcclusion, Antialiasing, Bloom, Lighting, MeshEdges, PresetRequest, ToneMapping};
use crate::error::{Error, Result, invalid};

/// The axis that points up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum UpAxis {
    X,
    #[default]
    Y,
    Z,
}

impl UpAxis {
    /// Index of the axis: 0 to 2.
    pub const fn index(self) -> usize {
        self as usize
    }

    /// The name in `scene.toml`.
    pub const fn name(self) -> &'static str {
        ["x", "y", "z"][self.index()]
    }

    /// The up direction as a unit vector.
    pub fn vector(self) -> Vector3<f64> {
        Vector3::ith(self.index(), 1.0)
    }

    /// The rotation from Y-up coordinates to this up axis.
    pub fn rotation_from_y_up(self) -> nalgebra::Rotation3<f64> {
        let identity = nalgebra::Rotation3::identity();
        nalgebra::Rotation3::rotation_between(&Vector3::y(), &self.vector()).unwrap_or(identity)
    }
}

/// Parses `x`, `y` or `z`, in either letter case.
impl FromStr for UpAxis {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        let axis = [Self::X, Self::Y, Self::Z].into_iter().find(|axis| axis.name().eq_ignore_ascii_case(name));
        axis.ok_or_else(|| invalid("up", "x, y or z", name))
    }
}

/// A plane at the lowest rest position along the up axis. It receives shadows and casts none.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Ground {
    /// Linear color. Without one, the ground shows only the shadows on it ([`RenderSettings::ground_color`]).
    pub color: Option<[f32; 3]>,
}

impl Default for Ground {
    fn default() -> Self {
        Self { color: Some([0.40, 0.41, 0.36]) }
    }
}

/// The largest number of blended fragments per frame. They share one buffer with 8 bytes per fragment, which must be
/// smaller than 2 GiB.
pub const MAX_FRAGMENTS: u32 = (1 << 28) - 1;

/// How blended triangles are composited over opaque ones and over each other.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Transparency {
    /// The two-pass method of B. Wang's thesis, "CUDA Deformers for Model Reduction" (chapter 3.3). The first pass
    /// draws fragments whose alpha is at least [`RenderSettings::opaque_alpha`], with depth writes. The second pass
    /// blends the others over them without depth writes. Blended triangles are drawn in index-buffer order: one-sided
    /// before double-sided, then by domain, then by triangle.
    TwoPass,
    /// Order-independent transparency: per pixel, a list of all blended fragments, sorted by depth. Depths are compared
    /// at the pixel center. At equal depths, the later triangle in the index buffer is in front.
    #[default]
    #[serde(rename = "exact")]
    OrderIndependent,
}

/// Which triangles are culled before rasterization. The image is bit-identical in all modes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Culling {
    /// Selected by the number of triangles and by the device.
    #[default]
    #[serde(rename = "fitting")]
    Auto,
    /// No culling: no culling pass is compiled, allocated or run.
    None,
    /// Triangles outside the view, back faces of one-sided materials, and triangles that cover no sample. Applies to
    /// shadow maps too.
    Triangles,
    /// As `Triangles`, plus triangles that are occluded by the triangles visible in the last frame. Exception: on
    /// software OpenGL implementations, occluded triangles are not culled in multisampled frames with textured
    /// cut-outs, because culling them would change where textures are sampled.
    #[serde(rename = "depth")]
    Occlusion,
}

/// Light, shadow, ground, sky and rasterization settings. Colors are linear.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct RenderSettings {
    /// If set, the renderer chooses `antialias`, `samples`, and the method, size and blur of `shadow`. If `None`, the
    /// values in these fields are used. Set by [`Self::with_preset`]; scene files always set it.
    pub preset: Option<PresetRequest>,
    /// The choice that has determined the other fields. It also selects the ambient light
    /// ([`RenderSettings::studio_light`]) and the direction of the default camera.
    pub lighting: Lighting,
    /// Direction towards the sun in Y-up coordinates; rotated to the scene's up axis.
    pub sun: [f32; 3],
    /// Color times intensity of the sun.
    pub sunlight: [f32; 3],
    /// Color times intensity of the ambient light.
    pub skylight: [f32; 3],
    /// Sky colors at the zenith and at the horizon.
    pub zenith: [f32; 3],
    pub horizon: [f32; 3],
    pub shadow: Option<ShadowSettings>,
    pub ground: Option<Ground>,
    pub ambient_occlusion: Option<AmbientOcclusion>,
    /// Lines along the edges of the faces. A frame request can override them.
    pub edges: Option<MeshEdges>,
    /// Samples per pixel for multisampling, 1 or 4.
    pub samples: u32,
    /// The antialiasing method: multisampling with `samples`, or a method with one sample per pixel.
    pub antialias: Antialiasing,
    pub bloom: Option<Bloom>,
    pub tone: ToneMapping,
    /// Multiplier of all light before bloom and tone mapping, above 0.
    pub exposure: f32,
    /// Whether 8-bit output is dithered with a fixed pattern of 8 x 8 pixels against banding. A pixel changes by at
    /// most one level, and a value exactly on a level does not change.
    pub dither: bool,
    /// How blended triangles are composited.
    pub transparency: Transparency,
    /// [`Transparency::TwoPass`] only: the smallest alpha of a fragment that is drawn as opaque, above 0. If it exceeds
    /// 1, all fragments are blended.
    pub opaque_alpha: f32,
    /// [`Transparency::OrderIndependent`] only: capacity of the fragment buffer, 1 to 2^28 - 1. The default is eight
    /// fragments per pixel and at least 2^20, limited by the largest buffer of the device. If a frame has more
    /// fragments, every pixel keeps only its n nearest ones, with the largest n that fits into the buffer.
    pub fragments: Option<u32>,
    /// Which triangles are culled.
    pub culling: Culling,
}

impl Default for RenderSettings {
    fn default() -> Self {
        Self {
            preset: None,
            lighting: Lighting::Outdoor,
            sun: [0.45, 0.80, 0.55],
            // Sunlight and skylight add up to about 1 per channel, so that white surfaces are not clipped to uniform
            // white.
            sunlight: [0.82, 0.77, 0.69],
            skylight: [0.25, 0.28, 0.33],
            zenith: [0.10, 0.27, 0.58],
            // Between the lit and the shaded side of white surfaces in luminance, and saturated enough to differ from
            // both.
            horizon: [0.34, 0.54, 0.79],
            shadow: Some(ShadowSettings::default()),
            ground: Some(Ground::default()),
            ambient_occlusion: None,
            edges: None,
            samples: 4,
            antialias: Antialiasing::Msaa,
            bloom: None,
            tone: ToneMapping::None,
            exposure: 1.0,
            dither: false,
            transparency: Transparency::default(),
            opaque_alpha: 0.95,
            fragments: None,
            culling: Culling::default(),
        }
    }
}

impl RenderSettings {
    /// Unit vector from the scene towards the sun (v_l of the thesis).
    pub fn to_sun(&self, up: UpAxis) -> Vector3<f64> {
        let sun = Vector3::from(self.sun).cast::<f64>();
        up.rotation_from_y_up() * sun.try_normalize(1e-12).unwrap_or_else(Vector3::y)
    }

    pub(super) fn check(&self) -> Result<()> {
        let vectors = [self.sun, self.sunlight, self.skylight, self.zenith, self.horizon];
        if !vectors.as_flattened().iter().all(|number| number.is_finite()) {
            return Err(invalid("look", "finite numbers", format!("{self:?}")));
        }
        if ![1, 4].contains(&self.samples) {
            return Err(invalid("look.samples", "1 or 4 per pixel", self.samples));
        }
        if !(self.opaque_alpha > 0.0 && self.opaque_alpha.is_finite()) {
            return Err(invalid("look.opaque_alpha", "a number above 0", self.opaque_alpha));
        }
        if self.fragments.is_some_and(|fragments| !(1..=MAX_FRAGMENTS).contains(&fragments)) {
            return Err(invalid("look.fragments", format!("1 to {MAX_FRAGMENTS}"), format!("{:?}", self.fragments)));
        }
        self.check_post()?;
        self.ambient_occlusion.map_or(Ok(()), AmbientOcclusion::check)?;
        self.edges.map_or(Ok(()), |edges| edges.check("look.edges"))?;
        self.shadow.map_or(Ok(()), |shadow| shadow.check())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_other_than_one_and_four_are_rejected() {
        for samples in [1, 4] {
            RenderSettings { samples, ..RenderSettings::default() }.check().expect("valid settings");
        }
        for samples in [0, 2, 8, u32::MAX] {
            let message = RenderSettings { samples, ..RenderSettings::default() }
                .check()
                .expect_err("invalid settings")
                .to_string();
            assert_eq!(message, format!("look.samples: expected 1 or 4 per pixel, got {samples}"));
        }
    }

    #[test]
    fn invalid_opaque_alpha_and_fragments_are_rejected() {
        for opaque_alpha in [0.0, -1.0, f32::NAN, f32::INFINITY] {
            let message = RenderSettings { opaque_alpha, ..RenderSettings::default() }
                .check()
                .expect_err("invalid settings")
                .to_string();
            assert_eq!(message, format!("look.opaque_alpha: expected a number above 0, got {opaque_alpha}"));
        }
        for fragments in [0, MAX_FRAGMENTS + 1, u32::MAX] {
            RenderSettings { fragments: Some(fragments), ..RenderSettings::default() }
                .check()
                .expect_err("invalid settings");
        }
        for fragments in [None, Some(1), Some(MAX_FRAGMENTS)] {
            RenderSettings { fragments, opaque_alpha: 2.0, ..RenderSettings::default() }
                .check()
                .expect("valid settings");
        }
    }
}
