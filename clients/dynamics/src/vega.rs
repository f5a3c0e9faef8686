//! Settings from Vega's `.config` text: a line `*name`, then a line with its value.

use std::path::Path;

use modalcast_client::Error as ClientError;

use crate::error::{Result, invalid};

/// Frequencies and Rayleigh damping of a reduced model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VegaSettings {
    /// Factor of all frequencies: the internal force is scaled by its square.
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
    /// `Client` if it cannot be read; `Invalid` as for [`Self::parse`].
    pub fn read(path: &Path) -> Result<Self> {
        Self::parse(&std::fs::read_to_string(path).map_err(|fault| ClientError::file(path, fault))?)
    }

    /// Parses the text. Missing settings keep their defaults; unknown settings are ignored.
    ///
    /// # Errors
    /// `Invalid` if a value is not a finite number >= 0, or the base frequency is zero.
    pub fn parse(text: &str) -> Result<Self> {
        let mut settings = Self::default();
        let mut lines = text.lines().map(str::trim).filter(|line| !line.is_empty());
        while let Some(line) = lines.next() {
            let place = match line.strip_prefix('*') {
                Some("baseFrequency") => &mut settings.base_frequency,
                Some("dampingMassCoef") => &mut settings.damping_mass,
                Some("dampingStiffnessCoef") => &mut settings.damping_stiffness,
                _ => continue,
            };
            let given = lines.next().unwrap_or("nothing");
            let number = given.parse().ok().filter(|number: &f64| number.is_finite() && *number >= 0.0);
            *place = number.ok_or_else(|| invalid(&line[1..], "a finite number >= 0", given))?;
        }
        if settings.base_frequency == 0.0 {
            return Err(invalid("baseFrequency", "a positive number", 0));
        }
        Ok(settings)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_settings_are_read_and_the_rest_keep_defaults() {
        let text = "*modesFilename\nx.URendering.float\n\n*baseFrequency\n0.25\n\n*dampingStiffnessCoef\n0.003\n";
        let settings = VegaSettings { base_frequency: 0.25, damping_mass: 0.0, damping_stiffness: 0.003 };
        assert_eq!(VegaSettings::parse(text).expect("parses"), settings);
        assert_eq!(VegaSettings::parse("").expect("parses"), VegaSettings::default());
    }

    #[test]
    fn invalid_values_are_refused_by_name() {
        for value in ["x", "nan", "-1", "inf", ""] {
            let refusal = VegaSettings::parse(&format!("*dampingMassCoef\n{value}")).expect_err("refused").to_string();
            assert!(refusal.starts_with("dampingMassCoef"), "{refusal}");
        }
        assert!(VegaSettings::parse("*baseFrequency\n0").is_err());
    }
}
