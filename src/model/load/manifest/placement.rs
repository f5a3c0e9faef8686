//! Placements in `scene.toml`: translation, rotation and scale, or a matrix.

use nalgebra::{Matrix3, Matrix3x4, Matrix4, Quaternion, Rotation3, Unit, UnitQuaternion, Vector3};

use crate::domain::Transform;
use crate::error::{Result, invalid};

/// Scale, then rotation, then translation; or the twelve entries of a row-major 3x4 matrix.
#[derive(Debug, Clone, Default, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Placement {
    translation: Option<[f64; 3]>,
    /// Rotation axis through the origin; requires `degrees`.
    axis: Option<[f64; 3]>,
    degrees: Option<f64>,
    /// Rotation as x, y, z, w (glTF's order).
    quaternion: Option<[f64; 4]>,
    scale: Option<Scale>,
    matrix: Option<[f64; 12]>,
}

#[derive(Debug, Clone, Copy, serde::Deserialize)]
#[serde(untagged, expecting = "a number or an array of three numbers")]
enum Scale {
    Uniform(f64),
    PerAxis([f64; 3]),
}

impl Placement {
    /// The transform that the keys describe.
    ///
    /// # Errors
    /// `Invalid` with the keys if they conflict or one is missing, and with the entry of the matrix if a number is not
    /// finite.
    pub(super) fn to_matrix(&self) -> Result<Matrix4<f64>> {
        let components =
            [self.translation.is_some(), self.axis.is_some(), self.quaternion.is_some(), self.scale.is_some()];
        let matrix = match self.matrix {
            Some(_) if components.contains(&true) || self.degrees.is_some() => {
                return Err(invalid("matrix", "either a matrix or translation, rotation and scale", "both"));
            }
            Some(entries) => {
                let mut matrix = Matrix4::identity();
                matrix.fixed_view_mut::<3, 4>(0, 0).copy_from(&Matrix3x4::from_row_slice(&entries));
                matrix
            }
            None => {
                let scale = match self.scale {
                    None => [1.0; 3],
                    Some(Scale::Uniform(factor)) => [factor; 3],
                    Some(Scale::PerAxis(factors)) => factors,
                };
                let linear = self.rotation()?.into_inner() * Matrix3::from_diagonal(&scale.into());
                let mut matrix = linear.to_homogeneous();
                matrix.fixed_view_mut::<3, 1>(0, 3).copy_from_slice(&self.translation.unwrap_or_default());
                matrix
            }
        };
        Transform::new(Transform::from_matrix(&matrix).0).map(|_| matrix)
    }

    fn rotation(&self) -> Result<Rotation3<f64>> {
        // A length below 1e-12 counts as zero.
        let check_length = |field: &str, squared_length: f64| match squared_length.is_finite() && squared_length > 1e-24
        {
            true => Ok(()),
            false => {
                let given = format!("length {}", squared_length.sqrt());
                Err(invalid(field, "finite numbers that are not all zero", given))
            }
        };
        match (self.axis, self.degrees, self.quaternion) {
            (None, None, None) => Ok(Rotation3::identity()),
            (Some(axis), Some(degrees), None) => {
                let axis = Vector3::from(axis);
                check_length("axis", axis.norm_squared())?;
                Ok(Rotation3::from_axis_angle(&Unit::new_normalize(axis), degrees.to_radians()))
            }
            (None, None, Some([x, y, z, w])) => {
                let quaternion = Quaternion::new(w, x, y, z);
                check_length("quaternion", quaternion.norm_squared())?;
                Ok(UnitQuaternion::from_quaternion(quaternion).to_rotation_matrix())
            }
            _ => Err(invalid(
                "axis, degrees, quaternion",
                "axis and degrees, or only quaternion",
                "another combination of these keys",
            )),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Transform> {
        let placement: Placement = toml::from_str(text).map_err(|error| invalid("toml", "TOML", error.message()))?;
        placement.to_matrix().map(|matrix| Transform::from_matrix(&matrix))
    }

    fn is_close(a: Transform, b: [f32; 12]) -> bool {
        a.0.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-6)
    }

    #[test]
    fn equivalent_keys_give_equal_transforms() {
        // A scale of 2, a rotation of 90 degrees about z, and a translation by (1, 2, 3). The axis and the quaternion
        // need not have length 1.
        let expected = [0.0, -2.0, 0.0, 1.0, 2.0, 0.0, 0.0, 2.0, 0.0, 0.0, 2.0, 3.0];
        for text in [
            "translation = [1, 2, 3]\naxis = [0, 0, 5]\ndegrees = 90\nscale = 2",
            "translation = [1.0, 2.0, 3.0]\nquaternion = [0.0, 0.0, 1.0, 1.0]\nscale = [2.0, 2.0, 2.0]",
            "matrix = [0, -2, 0, 1, 2, 0, 0, 2, 0, 0, 2, 3]",
        ] {
            assert!(is_close(parse(text).expect(text), expected), "{text}");
        }
        assert!(is_close(parse("").expect("the identity"), Transform::IDENTITY.0));
    }

    #[test]
    fn conflicting_keys_and_invalid_numbers_are_rejected() {
        for (text, start) in [
            ("matrix = [1,0,0,0, 0,1,0,0, 0,0,1,0]\nscale = 1", "matrix: expected either"),
            ("axis = [0,0,1]", "axis, degrees, quaternion: expected axis and degrees"),
            ("axis = [0,0,0]\ndegrees = 1", "axis: expected finite numbers that are not all zero"),
            ("quaternion = [0,0,0,nan]", "quaternion: expected"),
            ("translation = [inf,0,0]", "transform[3]: expected a finite number"),
            ("scale = 1e300", "transform[0]: expected a finite number"),
            ("scale = 'big'", "toml: expected TOML, got a number or an array of three numbers"),
            ("matrix = [1]", "toml:"),
            ("rotation = 1", "toml:"),
        ] {
            let message = parse(text).expect_err(text).to_string();
            assert!(message.starts_with(start), "{message}");
        }
    }
}
