//! How a scene is lit: one directional light (the sun), its shadow, the ground and the sky.

use nalgebra::Vector3;

use super::shadow::Shadow;
use super::{Antialias, Bloom, Tone};
use crate::error::{Result, invalid};

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
    /// Index of the axis.
    pub const fn index(self) -> usize {
        self as usize
    }

    /// The unit vector up.
    pub fn vector(self) -> Vector3<f64> {
        Vector3::ith(self.index(), 1.0)
    }

    /// A rotation that takes Y-up coordinates to this axis up.
    pub fn from_y_up(self) -> nalgebra::Rotation3<f64> {
        let identity = nalgebra::Rotation3::identity();
        nalgebra::Rotation3::rotation_between(&Vector3::y(), &self.vector()).unwrap_or(identity)
    }
}

/// A plane at the lowest rest position along up; it receives the shadow and casts none.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Ground {
    pub colour: [f32; 3],
}

impl Default for Ground {
    fn default() -> Self {
        Self { colour: [0.40, 0.41, 0.36] }
    }
}

/// Blended fragments that one frame may keep: they lie in one buffer, 8 bytes each, and one buffer has less than 2 GiB.
pub const MAX_FRAGMENTS: u32 = (1 << 28) - 1;

/// How blended triangles are drawn over what is opaque, and over each other.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Transparency {
    /// The thesis's two passes (chapter 3.3): what reaches [`Look::opaque_alpha`] first, with depth; then the rest, blended
    /// over that without writing depth. Blended triangles lie over each other in the order of the index buffer: those with
    /// one side before those with two, then by domain, then by triangle.
    TwoPass,
    /// A list of all blended fragments in each pixel, sorted by depth: order does not matter. Depths are compared in the
    /// middle of the pixel; of equal ones the later triangle of the index buffer lies in front.
    #[default]
    Exact,
}

/// Which triangles are left out before the rasteriser sees them. The picture is the same to the bit, whichever it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Culling {
    /// Chosen by the number of triangles and by the device.
    #[default]
    Fitting,
    /// None: nothing is compiled, allocated or run for it.
    None,
    /// Those outside the view, back faces of what has one side, and those in which no sample lies; for shadow maps too.
    Triangles,
    /// Those, and what is hidden behind the triangles that the last frame saw. A rasteriser in software leaves hidden
    /// triangles in where cut-outs have images and several samples a pixel: there they change where images are read.
    Depth,
}

/// What turns triangles into samples, pass by pass: the depth of the shadow map, and what the camera sees.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Rastering {
    /// OpenGL's rasteriser: the reference.
    #[default]
    OpenGl,
    /// A rasteriser in CUDA, where it can: on the CUDA device that also draws, for variance maps that are not split, and for
    /// frames with one sample a pixel in which nothing is blended. Elsewhere OpenGL draws; a frame says who drew it. Samples
    /// may see another triangle only where depths tie, within 1/256 pixel of an edge, and at the rim of what an image cuts
    /// out.
    Cuda,
    /// For each pass the faster of both, measured when the scene is loaded.
    Fastest,
}

/// Light, shadow, ground and sky. Colours are linear.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Look {
    /// Direction towards the sun for a scene with Y up; other up axes turn it along.
    pub sun: [f32; 3],
    /// Colour times intensity of the sun.
    pub sunlight: [f32; 3],
    /// Colour times intensity of the ambient light.
    pub skylight: [f32; 3],
    /// Sky at the zenith and at the horizon.
    pub zenith: [f32; 3],
    pub horizon: [f32; 3],
    pub shadow: Option<Shadow>,
    pub ground: Option<Ground>,
    /// Samples a pixel, 1 or 4: how smooth the edges of triangles and cut-outs are.
    pub samples: u32,
    /// What smooths edges: these samples, or something that needs but one.
    pub antialias: Antialias,
    pub bloom: Option<Bloom>,
    pub tone: Tone,
    /// All light is multiplied by this before glow and tone curve, above 0.
    pub exposure: f32,
    /// Whether levels of 8 bits are mixed in a fixed pattern of 8 x 8 pixels, so that slow gradients show no bands. A pixel
    /// changes by one level at most, and one that lies on a level stays.
    pub dither: bool,
    /// How blended triangles are drawn.
    pub transparency: Transparency,
    /// Two passes only: alpha from which a blended triangle counts as opaque, above 0; above 1 none does.
    pub opaque_alpha: f32,
    /// Exact only: blended fragments of a frame that are kept, 1 to 2^28 - 1; by default eight a pixel (2^20 at
    /// least), as far as the device has buffers so large. Where a frame has more, every pixel keeps as many of its
    /// nearest as all pixels can.
    pub fragments: Option<u32>,
    /// What is left out before it is drawn.
    pub culling: Culling,
    /// What draws.
    pub raster: Rastering,
}

impl Default for Look {
    fn default() -> Self {
        Self {
            sun: [0.45, 0.80, 0.55],
            // Ambient and sun together stay about at 1, so that white surfaces keep some shape.
            sunlight: [0.82, 0.77, 0.69],
            skylight: [0.25, 0.28, 0.33],
            zenith: [0.16, 0.36, 0.72],
            horizon: [0.72, 0.82, 0.90],
            shadow: Some(Shadow::default()),
            ground: Some(Ground::default()),
            samples: 4,
            antialias: Antialias::Samples,
            bloom: None,
            tone: Tone::None,
            exposure: 1.0,
            dither: false,
            transparency: Transparency::default(),
            opaque_alpha: 0.95,
            fragments: None,
            culling: Culling::default(),
            raster: Rastering::default(),
        }
    }
}

impl Look {
    /// Unit vector from the scene towards the sun (v_l of the thesis).
    pub fn to_sun(&self, up: UpAxis) -> Vector3<f64> {
        let sun = Vector3::from(self.sun).cast::<f64>();
        up.from_y_up() * sun.try_normalize(1e-12).unwrap_or_else(Vector3::y)
    }

    pub(super) fn check(&self) -> Result<()> {
        let colours = [self.sun, self.sunlight, self.skylight, self.zenith, self.horizon];
        if !colours.as_flattened().iter().all(|number| number.is_finite()) {
            return Err(invalid("look", "finite numbers", format!("{self:?}")));
        }
        if ![1, 4].contains(&self.samples) {
            return Err(invalid("look.samples", "1 or 4 a pixel", self.samples));
        }
        if !(self.opaque_alpha > 0.0 && self.opaque_alpha.is_finite()) {
            return Err(invalid("look.opaque_alpha", "a number above 0", self.opaque_alpha));
        }
        if self.fragments.is_some_and(|fragments| !(1..=MAX_FRAGMENTS).contains(&fragments)) {
            return Err(invalid("look.fragments", format!("1 to {MAX_FRAGMENTS}"), format!("{:?}", self.fragments)));
        }
        self.check_post()?;
        self.shadow.map_or(Ok(()), |shadow| shadow.check())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_that_are_neither_one_nor_four_are_refused() {
        for samples in [1, 4] {
            Look { samples, ..Look::default() }.check().expect("good");
        }
        for samples in [0, 2, 8, u32::MAX] {
            let refusal = Look { samples, ..Look::default() }.check().expect_err("refused").to_string();
            assert_eq!(refusal, format!("look.samples: expected 1 or 4 a pixel, given {samples}"));
        }
    }

    #[test]
    fn a_threshold_of_nothing_and_a_budget_of_nothing_or_beyond_a_buffer_are_refused() {
        for opaque_alpha in [0.0, -1.0, f32::NAN, f32::INFINITY] {
            let refusal = Look { opaque_alpha, ..Look::default() }.check().expect_err("refused").to_string();
            assert_eq!(refusal, format!("look.opaque_alpha: expected a number above 0, given {opaque_alpha}"));
        }
        for fragments in [0, MAX_FRAGMENTS + 1, u32::MAX] {
            Look { fragments: Some(fragments), ..Look::default() }.check().expect_err("refused");
        }
        for fragments in [None, Some(1), Some(MAX_FRAGMENTS)] {
            Look { fragments, opaque_alpha: 2.0, ..Look::default() }.check().expect("good");
        }
    }
}
