//! Elastic constants of the organs of plants.

use modalcast_beam::ElasticConstants;

use crate::error::{Result, invalid};

/// Materials of a plant. `scene.toml` can override each number (`plant`).
///
/// The defaults are typical values. Green wood along the grain: E 8 to 14 GPa, G / E about 1 / 16 (Forest Products
/// Laboratory, "Wood Handbook", FPL-GTR-282, 2021, chapter 5), density with water 800 to 1000 kg/m^3. Petioles: E about 1 GPa
/// and a ratio of bending to torsional stiffness E I / G J of 2 to 10 (Vogel, "Twist-to-bend ratios and cross-sectional
/// shapes of petioles and stems", Journal of Experimental Botany 43, 1992), here 5. Blades: 0.2 kg/m^2 fresh mass at a
/// length of 0.1 m. The thickness is proportional to the length, so that scaled copies of a leaf are similar solids. The
/// modulus of 0.5 GPa is that of an even sheet whose first frequency is 2 to 10 Hz, as measured for leaves in wind (Tadrist et al., "Foliage motion under wind, from leaf flutter to branch buffeting", Journal of the
/// Royal Society Interface 15, 2018); it includes the stiffness of the veins. Damping ratios: 5 % for branches and 10 % for
/// leaves, dominated by the air (same source).
#[derive(Debug, Clone, Copy, PartialEq, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct PlantMaterials {
    /// Pa.
    wood_youngs_modulus: f64,
    /// Pa.
    wood_shear_modulus: f64,
    /// kg/m^3. Also the density of fruits.
    wood_density: f64,
    /// Pa.
    petiole_youngs_modulus: f64,
    /// Pa.
    petiole_shear_modulus: f64,
    /// kg/m^3.
    petiole_density: f64,
    /// Pa.
    blade_youngs_modulus: f64,
    /// Pa.
    blade_shear_modulus: f64,
    /// kg/m^3.
    blade_density: f64,
    /// Ratio of length to thickness.
    blade_slenderness: f64,
    /// Fraction of critical damping of branches, for clients.
    wood_damping: f64,
    /// Fraction of critical damping of leaves, for clients.
    leaf_damping: f64,
}

impl Default for PlantMaterials {
    fn default() -> Self {
        Self {
            wood_youngs_modulus: 1e10,
            wood_shear_modulus: 6.25e8,
            wood_density: 900.0,
            petiole_youngs_modulus: 1e9,
            petiole_shear_modulus: 1e8,
            petiole_density: 900.0,
            blade_youngs_modulus: 5e8,
            blade_shear_modulus: 2e8,
            blade_density: 800.0,
            blade_slenderness: 400.0,
            wood_damping: 0.05,
            leaf_damping: 0.1,
        }
    }
}

impl PlantMaterials {
    /// Checks that all numbers are finite and positive.
    ///
    /// # Errors
    /// `Invalid` with the name of the number.
    pub(super) fn check(&self) -> Result<()> {
        for (name, number) in [
            ("wood_youngs_modulus", self.wood_youngs_modulus),
            ("wood_shear_modulus", self.wood_shear_modulus),
            ("wood_density", self.wood_density),
            ("petiole_youngs_modulus", self.petiole_youngs_modulus),
            ("petiole_shear_modulus", self.petiole_shear_modulus),
            ("petiole_density", self.petiole_density),
            ("blade_youngs_modulus", self.blade_youngs_modulus),
            ("blade_shear_modulus", self.blade_shear_modulus),
            ("blade_density", self.blade_density),
            ("blade_slenderness", self.blade_slenderness),
            ("wood_damping", self.wood_damping),
            ("leaf_damping", self.leaf_damping),
        ] {
            if !(number.is_finite() && number > 0.0) {
                return Err(invalid(format!("plant.{name}"), "a positive finite number", number));
            }
        }
        Ok(())
    }

    pub(super) const fn wood(&self) -> ElasticConstants {
        ElasticConstants {
            youngs_modulus: self.wood_youngs_modulus,
            shear_modulus: self.wood_shear_modulus,
            density: self.wood_density,
        }
    }

    pub(super) const fn petiole(&self) -> ElasticConstants {
        ElasticConstants {
            youngs_modulus: self.petiole_youngs_modulus,
            shear_modulus: self.petiole_shear_modulus,
            density: self.petiole_density,
        }
    }

    pub(super) const fn blade(&self) -> ElasticConstants {
        ElasticConstants {
            youngs_modulus: self.blade_youngs_modulus,
            shear_modulus: self.blade_shear_modulus,
            density: self.blade_density,
        }
    }

    /// Ratio of the length of a blade to its thickness.
    pub(super) const fn blade_slenderness(&self) -> f64 {
        self.blade_slenderness
    }

    /// Fractions of critical damping of branches and of leaves.
    pub(super) const fn damping(&self) -> [f64; 2] {
        [self.wood_damping, self.leaf_damping]
    }
}
