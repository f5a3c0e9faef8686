//! Materials: elastic constants, density and damping.

use modalcast_model::error::{Result, invalid};

/// A homogeneous isotropic linear elastic material.
#[derive(Debug, Clone, PartialEq)]
pub struct Material {
    /// The name in the table, or `custom`.
    pub name: String,
    /// Young's modulus, pascals.
    pub youngs_modulus: f64,
    /// Poisson's ratio, above -1 and below 0.5.
    pub poissons_ratio: f64,
    /// Kilograms per cubic meter.
    pub density: f64,
    /// Damping ratio of all modes: the fraction of critical damping.
    pub damping_ratio: f64,
}

/// The damping ratio of materials that are given by numbers.
const DEFAULT_DAMPING_RATIO: f64 = 0.005;

/// Names, Young's modulus (Pa), Poisson's ratio, density (kg/m3) and damping ratio. `README.md` lists the sources.
const TABLE: [(&str, f64, f64, f64, f64); 16] = [
    ("steel", 200e9, 0.29, 7850.0, 0.001),
    ("stainless-steel", 193e9, 0.29, 8000.0, 0.001),
    ("cast-iron", 110e9, 0.26, 7200.0, 0.003),
    ("aluminum", 69e9, 0.33, 2700.0, 0.0005),
    ("titanium", 114e9, 0.34, 4430.0, 0.001),
    ("brass", 100e9, 0.34, 8500.0, 0.001),
    ("copper", 117e9, 0.34, 8960.0, 0.001),
    ("glass", 70e9, 0.22, 2500.0, 0.001),
    ("concrete", 30e9, 0.2, 2400.0, 0.01),
    ("wood", 11e9, 0.35, 600.0, 0.01),
    ("abs", 2.2e9, 0.37, 1050.0, 0.015),
    ("pla", 3.5e9, 0.36, 1240.0, 0.015),
    ("nylon", 2.7e9, 0.39, 1140.0, 0.02),
    ("polycarbonate", 2.3e9, 0.37, 1200.0, 0.01),
    ("rubber", 5e6, 0.48, 1100.0, 0.05),
    ("gel", 1e5, 0.48, 1050.0, 0.05),
];

impl Material {
    /// A material from its constants: Young's modulus (Pa), Poisson's ratio and density (kg/m3).
    ///
    /// # Errors
    /// `Invalid` if a constant is not finite or out of range. At a ratio of 1/2 the material is incompressible and its
    /// stiffness infinite.
    pub fn new(youngs_modulus: f64, poissons_ratio: f64, density: f64) -> Result<Self> {
        let is_positive = |value: f64| value > 0.0 && value.is_finite();
        if !is_positive(youngs_modulus) {
            return Err(invalid("material: E", "a Young's modulus above 0 Pa", youngs_modulus));
        }
        if !(poissons_ratio > -1.0 && poissons_ratio < 0.5) {
            return Err(invalid("material: nu", "a Poisson's ratio above -1 and below 0.5", poissons_ratio));
        }
        if !is_positive(density) {
            return Err(invalid("material: rho", "a density above 0 kg/m3", density));
        }
        let damping_ratio = DEFAULT_DAMPING_RATIO;
        Ok(Self { name: "custom".into(), youngs_modulus, poissons_ratio, density, damping_ratio })
    }

    /// Reads a name of the table, or constants: `E=2e9,nu=0.3,rho=1200`. Upper and lower case and the characters `-`,
    /// `_` and space do not matter in names.
    ///
    /// # Errors
    /// `Invalid` if there is no such material, a constant is missing or wrong.
    pub fn parse(text: &str) -> Result<Self> {
        if text.contains('=') {
            return Self::parse_constants(text);
        }
        let normalize = |name: &str| name.to_lowercase().replace(['-', '_', ' '], "").replace("aluminium", "aluminum");
        let entry = TABLE.iter().find(|(name, ..)| normalize(name) == normalize(text));
        let Some((name, youngs_modulus, poissons_ratio, density, damping_ratio)) = entry else {
            let expected = format!("one of {}, or E=...,nu=...,rho=...", Self::names().join(", "));
            return Err(invalid("--material", expected, format!("'{text}'")));
        };
        let material = Self::new(*youngs_modulus, *poissons_ratio, *density)?;
        Ok(Self { name: (*name).into(), damping_ratio: *damping_ratio, ..material })
    }

    /// The names in the table.
    pub fn names() -> Vec<&'static str> {
        TABLE.iter().map(|(name, ..)| *name).collect()
    }

    fn parse_constants(text: &str) -> Result<Self> {
        let mut constants = [None; 3];
        for assignment in text.split(',') {
            let (name, value) = assignment.split_once('=').unwrap_or((assignment, ""));
            let index = ["e", "nu", "rho"].iter().position(|known| name.trim().eq_ignore_ascii_case(known));
            match (index, value.trim().parse::<f64>()) {
                (Some(index), Ok(value)) => constants[index] = Some(value),
                _ => return Err(invalid("--material", "E=PASCALS,nu=RATIO,rho=KG_PER_M3", format!("'{text}'"))),
            }
        }
        let [Some(youngs_modulus), Some(poissons_ratio), Some(density)] = constants else {
            return Err(invalid("--material", "all of E, nu and rho", format!("'{text}'")));
        };
        Self::new(youngs_modulus, poissons_ratio, density)
    }

    /// Lamé's parameters lambda and mu, pascals.
    pub fn lame_parameters(&self) -> (f64, f64) {
        let mu = self.youngs_modulus / (2.0 * (1.0 + self.poissons_ratio));
        (2.0 * mu * self.poissons_ratio / (1.0 - 2.0 * self.poissons_ratio), mu)
    }

    /// The speed of longitudinal waves in a bar, meters per second.
    pub fn bar_wave_speed(&self) -> f64 {
        (self.youngs_modulus / self.density).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_and_constants_are_read() {
        let steel = Material::parse("Stainless Steel").expect("a material");
        assert_eq!((steel.name.as_str(), steel.density), ("stainless-steel", 8000.0));
        assert_eq!(Material::parse("aluminium").expect("a material").name, "aluminum");
        let custom = Material::parse("rho=1200, E=2e9,nu=0.3").expect("a material");
        assert_eq!((custom.youngs_modulus, custom.poissons_ratio, custom.density), (2e9, 0.3, 1200.0));
        for name in Material::names() {
            Material::parse(name).expect("an entry of the table");
        }
    }

    #[test]
    fn manual_lists_the_table() {
        let manual = include_str!("../README.md");
        for (name, youngs_modulus, poissons_ratio, density, damping_ratio) in TABLE {
            // Decimal fractions, as 1e5 / 1e9 is not exactly 0.0001.
            let modulus = (youngs_modulus / 1e5).round() / 1e4;
            let row = format!("| {name} | {modulus} | {poissons_ratio} | {density} | {damping_ratio} |");
            assert!(manual.contains(&row), "{row}");
        }
    }

    #[test]
    fn wrong_materials_name_what_is_expected() {
        for (text, message) in [
            ("steal", "one of steel, stainless-steel"),
            ("E=1e9,nu=0.5,rho=1000", "below 0.5, got 0.5"),
            ("E=-1,nu=0.3,rho=1000", "above 0 Pa, got -1"),
            ("E=1e9,nu=0.3", "all of E, nu and rho"),
            ("E=1e9,nu=NaN,rho=1000", "got NaN"),
            ("E=1e9,mu=0.3,rho=1000", "E=PASCALS,nu=RATIO,rho=KG_PER_M3"),
            ("E=inf,nu=0.3,rho=1000", "got inf"),
        ] {
            let error = Material::parse(text).expect_err("expected an error").to_string();
            assert!(error.contains(message), "{text}: {error}");
        }
    }
}
