//! Files of the FEM library Vega: settings from `.config` files, and modes from `.URendering.float` files.

use std::path::Path;

use modalcast_client::{ContentHash, Error as ClientError};
use sha2::{Digest as _, Sha256};

use crate::error::{Result, invalid_input};

/// Frequency scale and Rayleigh damping of a reduced system. In a file, a setting is a line `*name`, followed by a line
/// with its value.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VegaSettings {
    /// Factor of all frequencies. The internal force is scaled by its square.
    pub base_frequency: f64,
    /// Mass coefficient of Rayleigh damping, 1/s.
    pub damping_mass: f64,
    /// Stiffness coefficient of Rayleigh damping, seconds.
    pub damping_stiffness: f64,
}

impl Default for VegaSettings {
    fn default() -> Self {
        Self { base_frequency: 1.0, damping_mass: 0.0, damping_stiffness: 0.0 }
    }
}

impl VegaSettings {
    /// Reads a file.
    ///
    /// # Errors
    /// `Client` if the file cannot be read; `Invalid` as for [`Self::parse`].
    pub fn read(path: &Path) -> Result<Self> {
        Self::parse(&std::fs::read_to_string(path).map_err(|error| ClientError::file(path, error))?)
    }

    /// Parses the text. Missing settings keep their defaults; unknown settings are ignored.
    ///
    /// # Errors
    /// `Invalid` if a value is not a finite number >= 0, or the base frequency is zero.
    pub fn parse(text: &str) -> Result<Self> {
        let mut settings = Self::default();
        let mut lines = text.lines().map(str::trim).filter(|line| !line.is_empty());
        while let Some(line) = lines.next() {
            let setting = match line.strip_prefix('*') {
                Some("baseFrequency") => &mut settings.base_frequency,
                Some("dampingMassCoef") => &mut settings.damping_mass,
                Some("dampingStiffnessCoef") => &mut settings.damping_stiffness,
                _ => continue,
            };
            let value_text = lines.next().unwrap_or("nothing");
            let value = value_text.parse().ok().filter(|value: &f64| value.is_finite() && *value >= 0.0);
            *setting = value.ok_or_else(|| invalid_input(&line[1..], "a finite number >= 0", value_text))?;
        }
        if settings.base_frequency == 0.0 {
            return Err(invalid_input("baseFrequency", "a positive number", 0));
        }
        Ok(settings)
    }
}

/// The SHA-256 of the modes U in a matrix file, as descriptions of scenes have it: that of the f32 entries in row-major
/// order. The file has two little-endian i32 (rows and columns), and then f32 or f64 entries in column-major order.
///
/// # Errors
/// `Client` if the file cannot be read; `Invalid` if its size does not match its rows and columns.
pub fn read_modes_hash(path: &Path) -> Result<ContentHash> {
    let bytes = std::fs::read(path).map_err(|error| ClientError::file(path, error))?;
    hash_modes(&bytes).ok_or_else(|| {
        let expected = "rows and columns as i32, and one f32 or f64 per entry";
        invalid_input(format!("modes in {}", path.display()), expected, format!("{} bytes", bytes.len()))
    })
}

/// `None` if the size does not match the rows and columns.
fn hash_modes(bytes: &[u8]) -> Option<ContentHash> {
    let (header, body) = bytes.split_first_chunk::<8>()?;
    let dimension = |start: usize| {
        let word = header[start..].first_chunk().copied()?;
        usize::try_from(i32::from_le_bytes(word)).ok()
    };
    let (rows, columns) = (dimension(0)?, dimension(4)?);
    let count = rows.checked_mul(columns)?;
    let entries: Vec<f32> = match body.len() {
        size if Some(size) == count.checked_mul(4) => {
            body.as_chunks().0.iter().map(|entry| f32::from_le_bytes(*entry)).collect()
        }
        size if Some(size) == count.checked_mul(8) => {
            body.as_chunks().0.iter().map(|entry| f64::from_le_bytes(*entry) as f32).collect()
        }
        _ => return None,
    };
    let mut hasher = Sha256::new();
    for row in 0..rows {
        let row_bytes: Vec<u8> = (0..columns).flat_map(|column| entries[column * rows + row].to_le_bytes()).collect();
        hasher.update(&row_bytes);
    }
    Some(hasher.finalize().into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hash_of_modes_is_that_of_row_major_f32() {
        let header = [2_i32.to_le_bytes(), 3_i32.to_le_bytes()].concat();
        // Column-major: the rows are (0, 2, 4) and (1, 3, 5).
        let f32s: Vec<u8> = (0..6_u8).flat_map(|entry| f32::from(entry).to_le_bytes()).collect();
        let f64s: Vec<u8> = (0..6_u8).flat_map(|entry| f64::from(entry).to_le_bytes()).collect();
        let row_major: Vec<u8> =
            [0_u8, 2, 4, 1, 3, 5].into_iter().flat_map(|entry| f32::from(entry).to_le_bytes()).collect();
        let expected: ContentHash = Sha256::digest(&row_major).into();
        for body in [&f32s, &f64s] {
            assert_eq!(hash_modes(&[&header[..], body].concat()), Some(expected));
        }
        let negative = [(-2_i32).to_le_bytes(), (-3_i32).to_le_bytes()].concat();
        let truncated = [&header[..], &f32s[1..]].concat();
        for bytes in [&header[..], &truncated, &[&negative[..], &f32s].concat(), &f32s[..5]] {
            assert_eq!(hash_modes(bytes), None);
        }
    }

    #[test]
    fn missing_settings_keep_their_defaults() {
        let text = "*modesFilename\nx.URendering.float\n\n*baseFrequency\n0.25\n\n*dampingStiffnessCoef\n0.003\n";
        let settings = VegaSettings { base_frequency: 0.25, damping_mass: 0.0, damping_stiffness: 0.003 };
        assert_eq!(VegaSettings::parse(text).expect("valid settings"), settings);
        assert_eq!(VegaSettings::parse("").expect("valid settings"), VegaSettings::default());
    }

    #[test]
    fn invalid_values_are_rejected_with_their_name() {
        for value in ["x", "nan", "-1", "inf", ""] {
            let error = VegaSettings::parse(&format!("*dampingMassCoef\n{value}")).expect_err("an invalid value");
            assert!(error.to_string().starts_with("dampingMassCoef"), "{error}");
        }
        assert!(VegaSettings::parse("*baseFrequency\n0").is_err());
    }
}
