//! Parsers of received transforms: affine matrices, or a quaternion and a translation in f32 or f64.

use nalgebra::{Matrix3, Vector3};

use crate::domain::Transform;
use crate::error::{Result, invalid};

/// The largest accepted deviation of a quaternion's norm from 1. Rounding to f32 causes deviations of about 1e-7, so
/// that a larger deviation is an error of the sender.
const NORM_TOLERANCE: f64 = 1e-3;

/// The largest f64 translation per axis, in scene units. Below this limit, neighboring f64 numbers differ by at most
/// 2^-13 units, which is about 0.1 mm in a scene of meters.
pub(super) const MAX_TRANSLATION: f64 = (1_u64 << 40) as f64;

/// The encoding of the transforms of a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum TransformFormat {
    /// A 3x4 matrix relative to the scene's origin: 12 f32, row-major.
    #[default]
    Affine,
    /// A quaternion x, y, z, w and a translation relative to the scene's origin: 7 f32.
    QuaternionXyzwF32,
    /// A quaternion x, y, z, w (4 f32) and a translation from the world's origin in scene units (3 f64).
    QuaternionXyzwF64,
}

impl TransformFormat {
    /// Size of one transform in bytes.
    pub const fn bytes(self) -> usize {
        match self {
            Self::Affine => 48,
            Self::QuaternionXyzwF32 => 28,
            Self::QuaternionXyzwF64 => 40,
        }
    }
}

/// A parsed transform relative to the scene's origin and, if its translation was given in f64 or the domain has a
/// pivot, the unrounded translation.
pub(super) type ParsedTransform = (Transform, Option<[f64; 3]>);

/// Parses [`TransformFormat::Affine`]. `pivot` is p in [`move_to_pivot`].
pub(super) fn parse_affine(bytes: &[u8], pivot: Option<[f64; 3]>) -> Result<ParsedTransform> {
    let transform = Transform::new(decode_f32_array(bytes))?;
    Ok(match pivot {
        None => (transform, None),
        Some(pivot) => move_to_pivot(&transform.linear(), transform.translation(), pivot),
    })
}

/// T = (A, t) as a transform of positions relative to the pivot p: (A, A p + t), with the translation in f64.
fn move_to_pivot(linear: &Matrix3<f64>, translation: Vector3<f64>, pivot: [f64; 3]) -> ParsedTransform {
    let moved = linear * Vector3::from(pivot) + translation;
    (Transform::from_parts(linear, &moved), Some(moved.into()))
}

/// Parses [`TransformFormat::QuaternionXyzwF32`].
pub(super) fn parse_quaternion_f32(bytes: &[u8], pivot: Option<[f64; 3]>) -> Result<ParsedTransform> {
    let (rotation, translation) = bytes.split_at(16);
    let translation: [f32; 3] = decode_f32_array(translation);
    check_finite("translation", &translation.map(f64::from))?;
    let linear = rotation_matrix(decode_f32_array(rotation))?;
    let translation = Vector3::from(translation).cast();
    Ok(match pivot {
        None => (Transform::from_parts(&linear, &translation), None),
        Some(pivot) => move_to_pivot(&linear, translation, pivot),
    })
}

/// Parses [`TransformFormat::QuaternionXyzwF64`]. `origin` is the scene's origin in scene units.
pub(super) fn parse_quaternion_f64(bytes: &[u8], origin: [f64; 3], pivot: Option<[f64; 3]>) -> Result<ParsedTransform> {
    let (rotation, translation) = bytes.split_at(16);
    let absolute: [f64; 3] = decode_array(translation, f64::from_le_bytes);
    check_finite("translation", &absolute)?;
    let relative: [f64; 3] = std::array::from_fn(|axis| absolute[axis] - origin[axis]);
    for (suffix, translation) in [("", absolute), (" relative to the scene's origin", relative)] {
        if let Some(axis) = translation.iter().position(|coordinate| coordinate.abs() > MAX_TRANSLATION) {
            let expected = format!("at most {MAX_TRANSLATION:e} scene units{suffix}");
            return Err(invalid(format!("translation[{axis}]"), expected, translation[axis]));
        }
    }
    let linear = rotation_matrix(decode_f32_array(rotation))?;
    Ok(match pivot {
        None => (Transform::from_parts(&linear, &Vector3::from(relative)), Some(relative)),
        Some(pivot) => move_to_pivot(&linear, relative.into(), pivot),
    })
}

/// The matrix of a quaternion that is normalized in f64.
fn rotation_matrix(quaternion: [f32; 4]) -> Result<Matrix3<f64>> {
    let [x, y, z, w] = quaternion.map(f64::from);
    let squared_norm = x * x + y * y + z * z + w * w;
    let norm = squared_norm.sqrt();
    if (norm - 1.0).abs() <= NORM_TOLERANCE {
        // Equal to normalizing the quaternion first, without the square root and four divisions.
        let scale = 2.0 / squared_norm;
        let (sx, sy, sz) = (scale * x, scale * y, scale * z);
        let (xx, xy, xz, wx) = (sx * x, sx * y, sx * z, sx * w);
        let (yy, yz, wy) = (sy * y, sy * z, sy * w);
        let (zz, wz) = (sz * z, sz * w);
        return Ok(Matrix3::new(
            1.0 - (yy + zz),
            xy - wz,
            xz + wy,
            xy + wz,
            1.0 - (xx + zz),
            yz - wx,
            xz - wy,
            yz + wx,
            1.0 - (xx + yy),
        ));
    }
    check_finite("rotation", &[x, y, z, w])?;
    let expected = format!("a quaternion x y z w of norm 1 within {NORM_TOLERANCE}");
    Err(invalid("rotation", expected, format!("norm {norm}")))
}

fn check_finite(field: &str, list: &[f64]) -> Result<()> {
    match list.iter().position(|number| !number.is_finite()) {
        None => Ok(()),
        Some(index) => Err(invalid(format!("{field}[{index}]"), "a finite number", list[index])),
    }
}

fn decode_f32_array<const N: usize>(bytes: &[u8]) -> [f32; N] {
    decode_array(bytes, f32::from_le_bytes)
}

/// Decodes N little-endian numbers of S bytes each, at any alignment. `bytes` has at least N * S bytes.
fn decode_array<T, const N: usize, const S: usize>(bytes: &[u8], read: impl Fn([u8; S]) -> T) -> [T; N] {
    let words = &bytes.as_chunks::<S>().0[..N];
    std::array::from_fn(|index| read(words[index]))
}

#[cfg(test)]
mod tests {
    use nalgebra::UnitQuaternion;

    use super::*;

    /// Encodes a transform with an offset of one byte, so that no number is aligned.
    fn pack(rotation: [f32; 4], translation: impl IntoIterator<Item = Vec<u8>>) -> Vec<u8> {
        let mut bytes = vec![0xff];
        bytes.extend(rotation.into_iter().flat_map(f32::to_le_bytes));
        bytes.extend(translation.into_iter().flatten());
        bytes
    }

    #[test]
    fn f32_and_f64_formats_give_the_same_transform() {
        let expected_rotation = UnitQuaternion::from_euler_angles(0.4, -1.3, 2.2);
        let rotation = [expected_rotation.i, expected_rotation.j, expected_rotation.k, expected_rotation.w]
            .map(|number| number as f32);
        let f32_bytes = pack(rotation, [1.5_f32, -2.0, 0.25].map(|number| number.to_le_bytes().to_vec()));
        let f64_bytes = pack(rotation, [1.5_f64, -2.0, 0.25].map(|number| number.to_le_bytes().to_vec()));
        let (f32_transform, no_translation) = parse_quaternion_f32(&f32_bytes[1..], None).expect("a valid transform");
        let (f64_transform, f64_translation) =
            parse_quaternion_f64(&f64_bytes[1..], [0.0; 3], None).expect("a valid transform");
        assert_eq!((f32_transform, no_translation, f64_translation), (f64_transform, None, Some([1.5, -2.0, 0.25])));
        let error = (f32_transform.linear() - expected_rotation.to_rotation_matrix().into_inner()).abs().max();
        assert!(error <= 2e-7, "{error}");
        assert!(f32_transform.is_similarity());
        let inverse_error =
            (f32_transform.linear() - expected_rotation.inverse().to_rotation_matrix().into_inner()).abs().max();
        assert!(inverse_error > 0.1, "expected the inverse rotation to differ");
    }

    #[test]
    fn quaternion_is_normalized_within_the_tolerance() {
        let parse_with_w = |w: f32| parse_quaternion_f32(&pack([0.0, 0.0, 0.0, w], [vec![0; 12]])[1..], None);
        assert_eq!(parse_with_w(1.0009).expect("a norm within the tolerance").0, Transform::IDENTITY);
        // A quaternion and its negative are the same rotation.
        assert_eq!(parse_with_w(-0.9991).expect("a norm within the tolerance").0, Transform::IDENTITY);
        for (w, norm_text) in [(1.002, "norm 1.00199"), (0.998, "norm 0.99800"), (0.0, "norm 0"), (3e38, "norm 300000")]
        {
            let message = parse_with_w(w).expect_err(norm_text).to_string();
            assert!(message.starts_with("rotation: expected a quaternion x y z w of norm 1 within 0.001"), "{message}");
            assert!(message.contains(norm_text), "{message}");
        }
        let message = parse_with_w(f32::NAN).expect_err("NaN").to_string();
        assert!(message.starts_with("rotation[3]: expected a finite number"), "{message}");
    }

    #[test]
    fn scene_origin_is_subtracted_before_rounding() {
        let position = [1e7 + 0.001, -1e7, 12.5];
        let bytes = pack([0.0, 0.0, 0.0, 1.0], position.map(|number: f64| number.to_le_bytes().to_vec()));
        let (transform, f64_translation) =
            parse_quaternion_f64(&bytes[1..], [1e7, -1e7, 0.0], None).expect("a valid transform");
        assert!((transform.0[3] - 0.001).abs() < 2e-9, "{}", transform.0[3]);
        assert_eq!(
            (transform.0[7], transform.0[11], f64_translation.map(|translation| translation[2])),
            (0.0, 12.5, Some(12.5))
        );
        // Counterexample: rounding before the subtraction loses the millimeter.
        assert_eq!(position[0] as f32 - 1e7_f32, 0.0);
    }

    #[test]
    fn distant_and_non_finite_translations_are_rejected() {
        let parse_at = |x: f64, origin: f64| {
            let translation = [x, 0.0, 0.0].map(|number| number.to_le_bytes().to_vec());
            parse_quaternion_f64(&pack([0.0, 0.0, 0.0, 1.0], translation)[1..], [origin, 0.0, 0.0], None).map(drop)
        };
        // MAX_TRANSLATION is about 1.1e12. It also limits the difference from the scene's origin.
        assert_eq!(parse_at(MAX_TRANSLATION, 0.0), Ok(()));
        for (x, origin) in [(2e12, 0.0), (2e12, 2e12), (1e12, -1e12), (f64::INFINITY, 0.0), (f64::NAN, 0.0)] {
            let message = parse_at(x, origin).expect_err("an invalid translation").to_string();
            assert!(message.starts_with("translation[0]"), "{message}");
        }
    }
}
