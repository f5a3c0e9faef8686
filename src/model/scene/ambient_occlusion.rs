//! Ambient occlusion: nearby surfaces block ambient light.

use crate::error::{Result, invalid};

/// Settings of the ambient occlusion, which multiplies the ambient light by the visibility of a point.
///
/// The visibility of a point with the unit normal n is the cosine-weighted fraction of the hemisphere around n from
/// which light arrives. An occluder at the distance d blocks 1 - (d / R)^2 of the light from its direction, and nothing
/// beyond the radius R.
///
/// The renderer computes the visibility from the depth of the visible surfaces by horizon angles (Jimenez et al.,
/// "Practical Real-Time Strategies for Accurate Indirect Occlusion", SIGGRAPH 2016 courses), so hidden surfaces occlude
/// nothing. The occlusion by the ground is computed from its plane, without horizon angles.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AmbientOcclusion {
    /// Radius R as a fraction of the diagonal of the scene at rest, above 0 and at most 1.
    pub radius: f32,
}

impl Default for AmbientOcclusion {
    fn default() -> Self {
        Self { radius: 0.15 }
    }
}

impl AmbientOcclusion {
    pub(super) fn check(self) -> Result<()> {
        match self.radius > 0.0 && self.radius <= 1.0 {
            true => Ok(()),
            false => {
                Err(invalid("look.ambient_occlusion.radius", "above 0, up to 1 diagonal of the scene", self.radius))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn radius_out_of_range_is_rejected() {
        for radius in [1e-6, 0.5, 1.0] {
            AmbientOcclusion { radius }.check().expect("a valid radius");
        }
        for radius in [0.0, -1.0, 1.5, f32::NAN, f32::INFINITY] {
            let message = AmbientOcclusion { radius }.check().expect_err("an invalid radius").to_string();
            let expected =
                format!("look.ambient_occlusion.radius: expected above 0, up to 1 diagonal of the scene, got {radius}");
            assert_eq!(message, expected);
        }
    }
}
