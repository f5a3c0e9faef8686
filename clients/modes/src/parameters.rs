//! Parameters of a computation: modes, materials, units and constraints.

use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::LengthUnit;
use nalgebra::Vector3;

use crate::large_motion::check_linear_modes;
use crate::materials::Material;
use crate::region::list_names;

/// All settings of a computation. Lengths of clamps, point masses and thickness are in the unit of the file.
#[derive(Debug, Clone)]
pub struct ModelingParameters {
    /// The number of elastic modes.
    pub modes: usize,
    /// Higher modes are left out, Hz.
    pub max_frequency: Option<f64>,
    /// Limit on the freedoms.
    pub freedoms: usize,
    /// The material of groups without one of their own.
    pub material: Material,
    /// Whether `material` also replaces the materials of a file that has materials.
    pub replaces_materials: bool,
    /// Names of groups, and their materials.
    pub group_materials: Vec<(String, Material)>,
    /// Replaces the damping ratio of the material.
    pub damping_ratio: Option<f64>,
    /// The unit of the file.
    pub unit: LengthUnit,
    /// Regions that are held (see [`crate::region::Region::parse`]).
    pub clamps: Vec<String>,
    pub point_masses: Vec<PointMass>,
    /// The thickness of a sheet.
    pub thickness: Option<f64>,
    /// Whether modal derivatives and cubic forces of large motion are computed, which needs a volume mesh.
    pub is_large: bool,
}

/// A mass without extent.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointMass {
    /// In the unit and axes of the file.
    pub position: Vector3<f64>,
    /// Kilograms.
    pub mass: f64,
}

/// Freedoms unless another number is given.
pub const DEFAULT_FREEDOMS: usize = 25_000;
/// Modes unless another number is given.
pub const DEFAULT_MODES: usize = 20;
/// Limits on the freedoms. Fewer cannot show any bending, more need more memory than a workstation has.
const FREEDOM_LIMITS: std::ops::RangeInclusive<usize> = 300..=1_000_000;
/// Limit on the modes of a domain.
const MAX_MODES: usize = 512;

impl Default for ModelingParameters {
    fn default() -> Self {
        let steel = Material {
            damping_ratio: 0.001,
            name: "steel".into(),
            youngs_modulus: 200e9,
            poissons_ratio: 0.29,
            density: 7850.0,
        };
        Self {
            modes: DEFAULT_MODES,
            max_frequency: None,
            freedoms: DEFAULT_FREEDOMS,
            material: steel,
            replaces_materials: false,
            group_materials: Vec::new(),
            damping_ratio: None,
            unit: LengthUnit::METER,
            clamps: Vec::new(),
            point_masses: Vec::new(),
            thickness: None,
            is_large: false,
        }
    }
}

impl ModelingParameters {
    /// Checks the ranges of all numbers.
    ///
    /// # Errors
    /// `Invalid` with the option, the expected and the given value.
    pub fn validated(self) -> Result<Self> {
        let check = |is_valid: bool, option: &str, expected: &str, given: &dyn std::fmt::Display| match is_valid {
            true => Ok(()),
            false => Err(invalid(option, expected, given)),
        };
        let is_positive = |value: f64| value > 0.0 && value.is_finite();
        check((1..=MAX_MODES).contains(&self.modes), "--modes", "1 to 512", &self.modes)?;
        check(FREEDOM_LIMITS.contains(&self.freedoms), "--freedoms", "300 to 1000000", &self.freedoms)?;
        if let Some(frequency) = self.max_frequency {
            check(is_positive(frequency), "--max-frequency", "a frequency above 0 Hz", &frequency)?;
        }
        if let Some(ratio) = self.damping_ratio {
            check((0.0..1.0).contains(&ratio), "--damping", "a fraction of critical damping, 0 to below 1", &ratio)?;
        }
        if let Some(thickness) = self.thickness {
            check(is_positive(thickness), "--thickness", "a length above 0", &thickness)?;
        }
        if self.is_large {
            check_linear_modes(self.modes)?;
        }
        Ok(self)
    }

    /// Adds `MATERIAL` or `GROUP:MATERIAL`.
    ///
    /// # Errors
    /// Those of [`Material::parse`].
    pub fn add_material(&mut self, text: &str) -> Result<()> {
        match text.rsplit_once(':') {
            Some((group, material)) => self.group_materials.push((group.trim().into(), Material::parse(material)?)),
            None => {
                self.material = Material::parse(text)?;
                self.replaces_materials = true;
            }
        }
        Ok(())
    }

    /// The material of each group.
    ///
    /// # Errors
    /// `Invalid` if a material names a group that the surface does not have.
    pub fn materials_of(&self, groups: &[String]) -> Result<Vec<Material>> {
        if let Some((name, _)) = self.group_materials.iter().find(|(name, _)| !groups.contains(name)) {
            return Err(invalid("--material", format!("one of the groups {}", list_names(groups)), name));
        }
        let material_of = |group: &String| {
            let own = self.group_materials.iter().rfind(|(name, _)| name == group);
            own.map_or(&self.material, |(_, material)| material).clone()
        };
        Ok(groups.iter().map(material_of).collect())
    }
}

impl PointMass {
    /// Reads `X Y Z KG`.
    ///
    /// # Errors
    /// `Invalid` unless these are four finite numbers and the mass is positive.
    pub fn parse(text: &str) -> Result<Self> {
        let numbers: Result<Vec<f64>, _> = text.split_whitespace().map(str::parse).collect();
        let numbers = numbers.unwrap_or_default();
        match numbers[..] {
            [x, y, z, mass] if numbers.iter().all(|number| number.is_finite()) && mass > 0.0 => {
                Ok(Self { position: Vector3::new(x, y, z), mass })
            }
            _ => Err(invalid("--point-mass", "'X Y Z KG' with a mass above 0", format!("'{text}'"))),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn default_material_is_that_of_the_table() {
        assert_eq!(ModelingParameters::default().material, Material::parse("steel").expect("a material"));
    }

    #[test]
    fn numbers_out_of_range_are_rejected() {
        let default = ModelingParameters::default;
        for (parameters, message) in [
            (ModelingParameters { modes: 0, ..default() }, "--modes: expected 1 to 512, got 0"),
            (ModelingParameters { freedoms: 10, ..default() }, "--freedoms: expected 300 to 1000000, got 10"),
            (ModelingParameters { max_frequency: Some(f64::NAN), ..default() }, "--max-frequency"),
            (ModelingParameters { damping_ratio: Some(1.0), ..default() }, "--damping"),
            (ModelingParameters { thickness: Some(-1.0), ..default() }, "--thickness"),
            (ModelingParameters { is_large: true, modes: 10, ..default() }, "--modes with --large: expected at most 9"),
        ] {
            let error = parameters.validated().expect_err("expected an error").to_string();
            assert!(error.starts_with(message), "{error}");
        }
        assert!(PointMass::parse("1 2 3").is_err() && PointMass::parse("1 2 3 -1").is_err());
        assert!(PointMass::parse("1 foo 2 3 4").is_err() && PointMass::parse("0,5 0 1").is_err());
        assert_eq!(PointMass::parse("-1 0 2 0.5").expect("a mass").mass, 0.5);
    }

    #[test]
    fn materials_belong_to_groups() {
        let mut parameters = ModelingParameters::default();
        parameters.add_material("rubber").expect("a material");
        parameters.add_material("grip:E=1e9,nu=0.3,rho=1000").expect("a material");
        let groups = ["bar".to_owned(), "grip".to_owned()];
        let names: Vec<String> =
            parameters.materials_of(&groups).expect("materials").into_iter().map(|material| material.name).collect();
        assert_eq!(names, ["rubber", "custom"]);
        let error = parameters.materials_of(&groups[..1]).expect_err("expected an error").to_string();
        assert!(error.contains("one of the groups 'bar', got grip"), "{error}");
    }
}
