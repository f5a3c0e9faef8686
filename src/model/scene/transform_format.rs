//! Parsers of received transforms: affine matrices, or a quaternion and a translation in f32 or f64.

use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};

use crate::domain::Transform;
use crate::error::{Result, invalid};

/// The largest accepted deviation of a quaternion's norm from 1. Rounding to f32 causes a ten-thousandth of it; a
/// larger deviation is an error of the sender.
const NORM_TOLERANCE: f64 = 1e-3;

/// The largest f64 translation per axis, in scene units. At this distance, f64 rounds by up to 1.2e-4 units.
pub(super) const MAX_TRANSLATION: f64 = (1_u64 << 40) as f64;

/// The encoding of the transforms of a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum TransformFormat {
    /// A 3x4 matrix relative to the scene's origin: 12 f32, row-major.
    #[default]
    Affine,
    /// A quaternion x, y, z, w and a translation relative to the scene's origin: 7 f32.
    RigidF32,
    /// A quaternion x, y, z, w (4 f32) and a translation from the world's origin in scene units (3 f64).
    RigidF64,
}

impl TransformFormat {
    /// Size of one transform in bytes.
    pub const fn bytes(self) -> usize {
        match self {
            Self::Affine => 48,
            Self::RigidF32 => 28,
            Self::RigidF64 => 40,
        }
    }
}

/// A parsed transform relative to the scene's origin and, if it was given in f64, the unrounded translation.
pub(super) type ParsedTransform = (Transform, Option<[f64; 3]>);

/// Parses [`TransformFormat::Affine`].
pub(super) fn parse_affine(bytes: &[u8]) -> Result<ParsedTransform> {
    Ok((Transform::new(floats(bytes))?, None))
}

/// Parses [`TransformFormat::RigidF32`].
pub(super) fn parse_rigid_f32(bytes: &[u8]) -> Result<ParsedTransform> {
    let (rotation, translation) = bytes.split_at(16);
    let translation: [f32; 3] = floats(translation);
    finite("translation", &translation.map(f64::from))?;
    let linear = rotation_matrix(floats(rotation))?;
    Ok((Transform::from_parts(&linear, &Vector3::from(translation).cast()), None))
}

/// Parses [`TransformFormat::RigidF64`]. `origin` is the scene's origin in scene units.
pub(super) fn parse_rigid_f64(bytes: &[u8], origin: [f64; 3]) -> Result<ParsedTransform> {
    let (rotation, translation) = bytes.split_at(16);
    let given: [f64; 3] = numbers(translation, f64::from_le_bytes);
    finite("translation", &given)?;
    let relative: [f64; 3] = std::array::from_fn(|axis| given[axis] - origin[axis]);
    for (what, list) in [("", given), (" relative to the scene's origin", relative)] {
        if let Some(axis) = list.iter().position(|along| along.abs() > MAX_TRANSLATION) {
            let expected = format!("at most {MAX_TRANSLATION:e} scene units{what}");
            return Err(invalid(format!("translation[{axis}]"), expected, list[axis]));
        }
    }
    let linear = rotation_matrix(floats(rotation))?;
    Ok((Transform::from_parts(&linear, &Vector3::from(relative)), Some(relative)))
}

fn rotation_matrix([x, y, z, w]: [f32; 4]) -> Result<Matrix3<f64>> {
    finite("rotation", &[x, y, z, w].map(f64::from))?;
    let quaternion = Quaternion::new(w, x, y, z).cast::<f64>();
    let norm = quaternion.norm();
    if (norm - 1.0).abs() > NORM_TOLERANCE {
        let expected = format!("a quaternion x y z w of norm 1 within {NORM_TOLERANCE}");
        return Err(invalid("rotation", expected, format!("norm {norm}")));
    }
    Ok(UnitQuaternion::from_quaternion(quaternion).to_rotation_matrix().into_inner())
}

fn finite(field: &str, list: &[f64]) -> Result<()> {
    match list.iter().position(|number| !number.is_finite()) {
        None => Ok(()),
        Some(at) => Err(invalid(format!("{field}[{at}]"), "a finite number", list[at])),
    }
}

fn floats<const N: usize>(bytes: &[u8]) -> [f32; N] {
    numbers(bytes, f32::from_le_bytes)
}

/// Decodes N little-endian numbers of S bytes each, at any alignment. `bytes` has at least N * S bytes.
fn numbers<T, const N: usize, const S: usize>(bytes: &[u8], read: fn([u8; S]) -> T) -> [T; N] {
    std::array::from_fn(|at| {
        let mut word = [0; S];
        word.copy_from_slice(&bytes[S * at..][..S]);
        read(word)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Encodes a transform with an offset of one byte, so that no number is aligned.
    fn pack(rotation: [f32; 4], translation: impl IntoIterator<Item = Vec<u8>>) -> Vec<u8> {
        let mut bytes = vec![0xff];
        bytes.extend(rotation.into_iter().flat_map(f32::to_le_bytes));
        bytes.extend(translation.into_iter().flatten());
        bytes
    }

    #[test]
    fn a_quaternion_turns_as_its_axis_and_angle_say_and_both_precisions_agree() {
        let turn = UnitQuaternion::from_euler_angles(0.4, -1.3, 2.2);
        let rotation = [turn.i, turn.j, turn.k, turn.w].map(|number| number as f32);
        let narrow = pack(rotation, [1.5_f32, -2.0, 0.25].map(|number| number.to_le_bytes().to_vec()));
        let wide = pack(rotation, [1.5_f64, -2.0, 0.25].map(|number| number.to_le_bytes().to_vec()));
        let (narrow, none) = parse_rigid_f32(&narrow[1..]).expect("good");
        let (wide, kept) = parse_rigid_f64(&wide[1..], [0.0; 3]).expect("good");
        assert_eq!((narrow, none, kept), (wide, None, Some([1.5, -2.0, 0.25])));
        let error = (narrow.linear() - turn.to_rotation_matrix().into_inner()).abs().max();
        assert!(error <= 2e-7, "{error}");
        assert!(narrow.is_similarity());
        let control = (narrow.linear() - turn.inverse().to_rotation_matrix().into_inner()).abs().max();
        assert!(control > 0.1, "the inverse is another rotation");
    }

    #[test]
    fn a_norm_is_put_right_within_the_slack_and_refused_with_its_value_beyond() {
        let with = |w: f32| parse_rigid_f32(&pack([0.0, 0.0, 0.0, w], [vec![0; 12]])[1..]);
        assert_eq!(with(1.0009).expect("near enough").0, Transform::IDENTITY);
        assert_eq!(with(-0.9991).expect("near enough").0, Transform::IDENTITY);
        for (w, given) in [(1.002, "norm 1.00199"), (0.998, "norm 0.99800"), (0.0, "norm 0"), (3e38, "norm 300000")] {
            let refusal = with(w).expect_err(given).to_string();
            assert!(refusal.starts_with("rotation: expected a quaternion x y z w of norm 1 within 0.001"), "{refusal}");
            assert!(refusal.contains(given), "{refusal}");
        }
        let refusal = with(f32::NAN).expect_err("NaN").to_string();
        assert!(refusal.starts_with("rotation[3]: expected a finite number"), "{refusal}");
    }

    #[test]
    fn an_f64_translation_loses_the_scenes_origin_before_it_is_rounded() {
        let at = [1e7 + 0.001, -1e7, 12.5];
        let bytes = pack([0.0, 0.0, 0.0, 1.0], at.map(|number: f64| number.to_le_bytes().to_vec()));
        let (transform, kept) = parse_rigid_f64(&bytes[1..], [1e7, -1e7, 0.0]).expect("good");
        assert!((transform.0[3] - 0.001).abs() < 2e-9, "{}", transform.0[3]);
        assert_eq!((transform.0[7], transform.0[11], kept.map(|kept| kept[2])), (0.0, 12.5, Some(12.5)));
        // Counterexample: rounding before the subtraction loses the millimeter.
        assert_eq!(at[0] as f32 - 1e7_f32, 0.0);
    }

    #[test]
    fn translations_that_f64_cannot_keep_to_the_millimetre_are_refused() {
        let with = |x: f64, origin: f64| {
            let translation = [x, 0.0, 0.0].map(|number| number.to_le_bytes().to_vec());
            parse_rigid_f64(&pack([0.0, 0.0, 0.0, 1.0], translation)[1..], [origin, 0.0, 0.0]).map(drop)
        };
        assert_eq!(with(MAX_TRANSLATION, 0.0), Ok(()));
        for (x, origin) in [(2e12, 0.0), (2e12, 2e12), (1e12, -1e12), (f64::INFINITY, 0.0), (f64::NAN, 0.0)] {
            let refusal = with(x, origin).expect_err("too far").to_string();
            assert!(refusal.starts_with("translation[0]"), "{refusal}");
        }
    }
}
