//! Lighting of a scene: a named set of lights and background that determines the defaults of `look`.

use std::str::FromStr;

use nalgebra::Vector3;

use super::{AmbientOcclusion, Ground, RenderSettings, ShadowSettings, UpAxis};
use crate::error::{Error, Result, invalid};

/// A named set of lights and background.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Lighting {
    /// Sun, sky and a colored ground: for plants and landscapes.
    #[default]
    Outdoor,
    /// A key light with shadows, a fill light at the camera, ambient light that depends on the normal, ambient
    /// occlusion, and a neutral background: for machine parts and scans. The ground shows only shadows and ambient
    /// occlusion.
    Studio,
}

/// Ambient light and fill light of a studio. Both are proportional to [`RenderSettings::skylight`].
///
/// The ambient light of a surface with the unit normal n is the sum over the axes of `n_i^2 c_i`, where `c_i` is the
/// color of the side to which `n_i` points (the ambient cube of McTaggart, "Half-Life 2 / Valve Source Shading", Game
/// Developers Conference 2004). The weights sum to 1 and change smoothly with n.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StudioLight {
    /// Linear colors of the sides +x, -x, +y, -y, +z and -z.
    pub ambient_cube: [[f32; 3]; 6],
    /// Linear color of the fill light at the camera. It is diffuse and casts no shadow.
    pub fill: [f32; 3],
}

/// The sides of [`StudioLight::ambient_cube`] in Y-up coordinates, in multiples of [`RenderSettings::skylight`]. All
/// sides differ, so that the visible faces of a box differ from every viewpoint.
const STUDIO_CUBE: [[f32; 3]; 6] = [
    [0.69, 0.72, 0.77],
    [0.62, 0.63, 0.65],
    [1.20, 1.20, 1.20],
    [0.42, 0.41, 0.40],
    [0.82, 0.80, 0.77],
    [0.55, 0.56, 0.58],
];

/// The fill light, in multiples of [`RenderSettings::skylight`].
const STUDIO_FILL: [f32; 3] = [0.42; 3];

impl Lighting {
    /// All lightings.
    pub const ALL: [Self; 2] = [Self::Outdoor, Self::Studio];

    /// Name in scene files and on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Outdoor => "outdoor",
            Self::Studio => "studio",
        }
    }

    /// The default settings with this lighting.
    pub fn settings(self) -> RenderSettings {
        match self {
            Self::Outdoor => RenderSettings::default(),
            Self::Studio => RenderSettings {
                lighting: Self::Studio,
                sun: [-0.30, 0.85, 0.34],
                sunlight: [0.64, 0.62, 0.59],
                skylight: [0.36, 0.36, 0.36],
                zenith: [0.58, 0.61, 0.65],
                horizon: [0.70, 0.72, 0.75],
                ground: Some(Ground { color: None }),
                ambient_occlusion: Some(AmbientOcclusion::default()),
                shadow: Some(ShadowSettings::default()),
                ..RenderSettings::default()
            },
        }
    }

    /// Direction from the scene to the default camera in Y-up coordinates, not normalized. The camera is in front of
    /// the scene, above it and to its side.
    pub(super) const fn to_camera(self) -> [f64; 3] {
        match self {
            Self::Outdoor => [0.42, 0.14, 0.90],
            Self::Studio => [0.58, 0.46, 0.82],
        }
    }
}

impl FromStr for Lighting {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        let lighting = Self::ALL.into_iter().find(|lighting| lighting.name() == name);
        lighting.ok_or_else(|| invalid("lighting", "outdoor or studio", name))
    }
}

impl RenderSettings {
    /// The studio's ambient light and fill light for this up axis; `None` outdoors, where the ambient light is
    /// [`Self::skylight`] on every side.
    pub fn studio_light(&self, up: UpAxis) -> Option<StudioLight> {
        let scaled =
            |color: [f32; 3]| std::array::from_fn(|channel| (color[channel] * self.skylight[channel]).min(f32::MAX));
        (self.lighting == Lighting::Studio)
            .then(|| StudioLight { ambient_cube: cube_for_axis(up).map(scaled), fill: scaled(STUDIO_FILL) })
    }

    /// Color of the ground. If the settings have none, it is the color that looks like the horizon in full sun, so that
    /// the ground shows only shadows and ambient occlusion.
    pub fn ground_color(&self, up: UpAxis) -> Option<[f32; 3]> {
        let ground = self.ground?;
        Some(ground.color.unwrap_or_else(|| {
            let cosine = up.vector().dot(&self.to_sun(up)).max(0.0) as f32;
            let ambient = self.studio_light(up).map_or(self.skylight, |light| light.ambient_cube[2 * up.index()]);
            std::array::from_fn(|channel| {
                let light = ambient[channel] + cosine * self.sunlight[channel];
                let color = self.horizon[channel] / light;
                if color.is_finite() { color } else { 0.0 }
            })
        }))
    }
}

/// [`STUDIO_CUBE`], rotated from Y-up coordinates to an up axis.
fn cube_for_axis(up: UpAxis) -> [[f32; 3]; 6] {
    let rotation = up.rotation_from_y_up().inverse();
    std::array::from_fn(|side| {
        let sign = if side % 2 == 0 { 1.0 } else { -1.0 };
        let direction: Vector3<f64> = rotation * (sign * Vector3::ith(side / 2, 1.0));
        let axis = direction.iamax();
        STUDIO_CUBE[2 * axis + usize::from(direction[axis] < 0.0)]
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_parsed_and_unknown_names_are_rejected() {
        for lighting in Lighting::ALL {
            assert_eq!(lighting.name().parse::<Lighting>().expect("a name"), lighting);
            assert_eq!(lighting.settings().lighting, lighting);
        }
        let message = "garage".parse::<Lighting>().expect_err("an unknown name").to_string();
        assert_eq!(message, "lighting: expected outdoor or studio, got garage");
    }

    #[test]
    fn ambient_cube_has_its_brightest_side_up_for_each_axis() {
        let look = Lighting::Studio.settings();
        for up in [UpAxis::X, UpAxis::Y, UpAxis::Z] {
            let cube = look.studio_light(up).expect("a studio").ambient_cube;
            let brightness = |side: usize| cube[side].iter().sum::<f32>();
            let brightest = (0..6).max_by(|a, b| brightness(*a).total_cmp(&brightness(*b)));
            let darkest = (0..6).min_by(|a, b| brightness(*a).total_cmp(&brightness(*b)));
            assert_eq!((brightest, darkest), (Some(2 * up.index()), Some(2 * up.index() + 1)), "{up:?}");
        }
        assert_eq!(RenderSettings::default().studio_light(UpAxis::Y), None);
    }

    #[test]
    fn ground_without_color_has_the_light_of_the_horizon() {
        let look = Lighting::Studio.settings();
        for up in [UpAxis::X, UpAxis::Y, UpAxis::Z] {
            let color = look.ground_color(up).expect("a ground");
            let cosine = up.vector().dot(&look.to_sun(up)) as f32;
            let light = look.studio_light(up).expect("a studio").ambient_cube[2 * up.index()];
            for channel in 0..3 {
                let lit = color[channel] * (light[channel] + cosine * look.sunlight[channel]);
                assert!((lit - look.horizon[channel]).abs() < 1e-6, "{up:?}: {lit}");
            }
        }
        let dark = RenderSettings { sunlight: [0.0; 3], skylight: [0.0; 3], ..look };
        assert_eq!(dark.ground_color(UpAxis::Y), Some([0.0; 3]));
    }
}
