//! Units of length, and their text format.

use std::fmt;
use std::ops::RangeInclusive;
use std::str::FromStr;

use serde::de::{Deserialize, Deserializer, Visitor};

use crate::error::{Error, Result, invalid};

/// Units with a name, in meters.
const NAMED_UNITS: [(&str, f64); 6] =
    [("m", 1.0), ("mm", 1e-3), ("cm", 1e-2), ("um", 1e-6), ("in", 0.0254), ("ft", 0.3048)];

/// The units that are accepted, in meters.
const UNIT_RANGE: RangeInclusive<f64> = 1e-12..=1e12;

/// A unit of length: a number of meters from 1e-12 to 1e12. Its text, also in `scene.toml`, is `m`, `mm`, `cm`, `um`, `in`,
/// `ft`, or the number of meters.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LengthUnit {
    meters: f64,
}

impl LengthUnit {
    pub const METER: Self = Self { meters: 1.0 };

    /// A unit of this many meters.
    ///
    /// # Errors
    /// `Invalid` for a number outside of 1e-12 to 1e12.
    pub fn from_meters(meters: f64) -> Result<Self> {
        match UNIT_RANGE.contains(&meters) {
            true => Ok(Self { meters }),
            false => Err(not_a_unit(meters)),
        }
    }

    /// The length of the unit in meters.
    pub const fn meters(self) -> f64 {
        self.meters
    }
}

fn not_a_unit(given: impl fmt::Display) -> Error {
    let names = NAMED_UNITS.map(|(name, _)| name).join(", ");
    invalid("unit", format!("{names}, or a number of meters from 1e-12 to 1e12"), given)
}

/// Parses the name of a unit, or a number of meters.
impl FromStr for LengthUnit {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let named = NAMED_UNITS.into_iter().find(|(name, _)| name.eq_ignore_ascii_case(text)).map(|(_, meters)| meters);
        match named.or_else(|| text.parse().ok()) {
            Some(meters) => Self::from_meters(meters),
            None => Err(not_a_unit(text)),
        }
    }
}

/// Writes the name of the unit, or its number of meters, as [`LengthUnit::from_str`] reads it.
impl fmt::Display for LengthUnit {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match NAMED_UNITS.into_iter().find(|(_, meters)| *meters == self.meters) {
            Some((name, _)) => out.write_str(name),
            None => write!(out, "{}", self.meters),
        }
    }
}

impl<'de> Deserialize<'de> for LengthUnit {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(LengthUnitVisitor)
    }
}

struct LengthUnitVisitor;

impl Visitor<'_> for LengthUnitVisitor {
    type Value = LengthUnit;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("a number of meters, or the name of a unit")
    }

    fn visit_str<E: serde::de::Error>(self, text: &str) -> Result<LengthUnit, E> {
        text.parse().map_err(E::custom)
    }

    fn visit_f64<E: serde::de::Error>(self, meters: f64) -> Result<LengthUnit, E> {
        LengthUnit::from_meters(meters).map_err(E::custom)
    }

    fn visit_i64<E: serde::de::Error>(self, meters: i64) -> Result<LengthUnit, E> {
        self.visit_f64(meters as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_of_a_unit_is_read_as_the_same_unit() {
        for (text, meters, canonical) in [
            ("m", 1.0, "m"),
            ("mm", 0.001, "mm"),
            ("1e-3", 0.001, "mm"),
            ("ft", 0.3048, "ft"),
            ("MM", 0.001, "mm"),
            ("0.25", 0.25, "0.25"),
            ("1000", 1000.0, "1000"),
        ] {
            let unit: LengthUnit = text.parse().expect(text);
            assert_eq!((unit.meters(), unit.to_string().as_str()), (meters, canonical), "{text}");
            assert_eq!(canonical.parse(), Ok(unit));
        }
    }

    #[test]
    fn other_texts_are_rejected_with_the_known_names() {
        for text in ["", "yard", "0", "-1", "nan", "inf", "1e300", "1 mm"] {
            let message = text.parse::<LengthUnit>().expect_err(text).to_string();
            assert!(
                message
                    .starts_with("unit: expected m, mm, cm, um, in, ft, or a number of meters from 1e-12 to 1e12, got"),
                "{message}"
            );
        }
    }
}
