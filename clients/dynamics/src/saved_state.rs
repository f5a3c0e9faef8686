//! Conversion of the state of a scenario to and from JSON, for checkpoints. Floats are stored as the integers of their
//! bits: exact for all values, with the sign of zero and with infinities, which JSON does not have.

use nalgebra::DVector;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::Value;

use crate::error::{Result, invalid_input};

/// Converts a state to JSON.
///
/// # Errors
/// `Invalid` if the state has a type that JSON lacks.
pub(crate) fn to_json(state: &impl Serialize) -> Result<Value> {
    serde_json::to_value(state).map_err(|error| invalid_input("state", "a state that JSON can hold", error))
}

/// Converts a state from JSON.
///
/// # Errors
/// `Invalid` if a field is missing or has another type.
pub(crate) fn from_json<T: DeserializeOwned>(state: Value) -> Result<T> {
    T::deserialize(state).map_err(|error| invalid_input("state", "the fields of this motion", error))
}

/// Checks a vector that was read.
///
/// # Errors
/// `Invalid` unless it has `count` finite numbers.
pub(crate) fn check_vector(field: &str, vector: &DVector<f64>, count: usize) -> Result<()> {
    if vector.len() != count {
        return Err(invalid_input(format!("state.{field}"), format!("{count} numbers"), vector.len()));
    }
    match vector.iter().position(|number| !number.is_finite()) {
        None => Ok(()),
        Some(index) => Err(invalid_input(format!("state.{field}[{index}]"), "a finite number", vector[index])),
    }
}

/// A vector of f64 as the bits of its numbers.
pub(crate) mod vector_bits {
    use super::*;

    pub(crate) fn serialize<S: Serializer>(vector: &DVector<f64>, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_seq(vector.iter().map(|number| number.to_bits()))
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<DVector<f64>, D::Error> {
        let bits = Vec::<u64>::deserialize(deserializer)?;
        Ok(DVector::from_vec(bits.into_iter().map(f64::from_bits).collect()))
    }
}

/// One f64 as its bits.
pub(crate) mod number_bits {
    use super::*;

    pub(crate) fn serialize<S: Serializer>(number: &f64, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_u64(number.to_bits())
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
        u64::deserialize(deserializer).map(f64::from_bits)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Serialize, Deserialize)]
    struct Numbers {
        #[serde(with = "vector_bits")]
        vector: DVector<f64>,
        #[serde(with = "number_bits")]
        number: f64,
    }

    #[test]
    fn floats_keep_all_bits() {
        let random = (0..100_000_u64).map(|seed| f64::from_bits(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15)));
        let special =
            [0.0, -0.0, f64::INFINITY, f64::NEG_INFINITY, f64::MIN_POSITIVE, 5e-324, f64::MAX, 0.1, 1.0 / 3.0];
        let vector = DVector::from_vec(special.into_iter().chain(random).collect());
        let text = to_json(&Numbers { vector: vector.clone(), number: -0.0 }).expect("a state").to_string();
        let read: Numbers = from_json(serde_json::from_str(&text).expect("JSON")).expect("a state");
        assert!(read.vector.iter().zip(&vector).all(|(a, b)| a.to_bits() == b.to_bits()));
        assert_eq!((read.vector.len(), read.number.to_bits()), (vector.len(), (-0.0_f64).to_bits()));
    }

    #[test]
    fn states_with_other_fields_lengths_or_numbers_are_rejected() {
        for text in
            ["null", "[]", r#"{"vector":[0]}"#, r#"{"vector":[-1],"number":0}"#, r#"{"vector":[0.5],"number":0}"#]
        {
            let error = from_json::<Numbers>(serde_json::from_str(text).expect("JSON")).err().expect(text).to_string();
            assert!(error.starts_with("state: expected the fields"), "{error}");
        }
        for (vector, expected) in
            [(vec![1.0], "state.q: expected 2"), (vec![1.0, f64::NAN], "state.q[1]: expected a finite")]
        {
            let error = check_vector("q", &DVector::from_vec(vector), 2).expect_err("an invalid vector").to_string();
            assert!(error.starts_with(expected), "{error}");
        }
        check_vector("q", &DVector::from_vec(vec![1.0, -0.0]), 2).expect("a valid vector");
    }
}
