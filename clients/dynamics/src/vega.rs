//! Settings from `.config` files of the FEM library Vega. A setting is a line `*name`, followed by a line with its
//! value.

use std::path::Path;

use modalcast_client::Error as ClientError;

use crate::error::{Result, invalid_input};

/// Frequency scale and Rayleigh damping of a reduced system.
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

#[cfg(test)]
mod tests {
    use super::*;

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
