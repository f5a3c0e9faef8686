//! Physical parameters of modes: eigenvalues and damping ratios. All of them are validated before the first step.

use crate::error::{Result, invalid_input};
use crate::model::{DomainModel, Model};

/// Damping ratio of domains without a note `damping_ratio`.
const DEFAULT_DAMPING_RATIO: f64 = 0.03;

/// Largest accepted damping ratio. A ratio of 1 is critical damping.
const MAX_DAMPING_RATIO: f64 = 1000.0;

/// Largest magnitude of an eigenvalue that counts as 0, as a fraction of the largest eigenvalue of its domain. Solvers
/// return the eigenvalues of rigid motions as rounding errors of either sign.
const ZERO_TOLERANCE: f64 = 1e-9;

/// Maximum number of domains that a remark names.
const MAX_NAMED_DOMAINS: usize = 3;

/// Parameters of one mode.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ModeParameters {
    /// omega^2 in (rad/s)^2; positive.
    pub eigenvalue: f64,
    /// Fraction of critical damping, 0 to 1000.
    pub damping_ratio: f64,
}

/// Parameters of all modes of a scene.
#[derive(Debug, Clone, PartialEq)]
pub struct ModalParameters {
    /// Per coordinate. `None` for a mode without stiffness: it would drift without bound in any wind, so it is held
    /// still.
    pub modes: Vec<Option<ModeParameters>>,
    /// Names the modes that are held still, and those without damping.
    pub remarks: Vec<String>,
}

impl ModalParameters {
    /// Reads the parameters of all domains with coordinates of their own.
    ///
    /// # Errors
    /// `Invalid` if a domain has another number of eigenvalues than modes, if an eigenvalue is negative or not finite,
    /// or if the note `damping_ratio` is not a number from 0 to 1000.
    pub fn read(model: &Model) -> Result<Self> {
        let mut modes = vec![None; model.coordinate_count];
        let (mut held_modes, mut undamped_modes) = (vec![], vec![]);
        for domain in model.domains.iter().filter(|domain| domain.owns_q) {
            let damping_ratio = read_damping_ratio(domain)?;
            let eigenvalues = read_eigenvalues(domain)?;
            for (mode, eigenvalue) in eigenvalues.iter().enumerate().filter(|(_, eigenvalue)| **eigenvalue > 0.0) {
                modes[domain.first_coordinate + mode] = Some(ModeParameters { eigenvalue: *eigenvalue, damping_ratio });
            }
            let held = eigenvalues.iter().filter(|eigenvalue| **eigenvalue == 0.0).count();
            if held > 0 {
                held_modes.push((domain.name.as_str(), held));
            }
            if damping_ratio == 0.0 && held < domain.rank {
                undamped_modes.push((domain.name.as_str(), domain.rank - held));
            }
        }
        let held = describe_modes("modes without stiffness (eigenvalue 0) are held still", &held_modes);
        let undamped =
            describe_modes("modes without damping (damping_ratio 0) keep the energy of all gusts", &undamped_modes);
        Ok(Self { modes, remarks: held.into_iter().chain(undamped).collect() })
    }

    /// The lowest frequency in hertz; `None` if no mode can move.
    pub fn lowest_frequency(&self) -> Option<f64> {
        let eigenvalues = self.modes.iter().flatten().map(|mode| mode.eigenvalue);
        eigenvalues.min_by(f64::total_cmp).map(|eigenvalue| eigenvalue.sqrt() / std::f64::consts::TAU)
    }
}

/// One eigenvalue per mode. It is 0 for a mode without stiffness, or of a domain without eigenvalues.
fn read_eigenvalues(domain: &DomainModel) -> Result<Vec<f64>> {
    if domain.eigenvalues.is_empty() {
        return Ok(vec![0.0; domain.rank]);
    }
    if domain.eigenvalues.len() != domain.rank {
        let field = format!("eigenvalues of '{}'", domain.name);
        let expected = format!("{} numbers, one per mode", domain.rank);
        return Err(invalid_input(field, expected, format!("{} numbers", domain.eigenvalues.len())));
    }
    let tolerance =
        ZERO_TOLERANCE * domain.eigenvalues.iter().fold(0.0, |largest: f64, value| largest.max(value.abs()));
    let eigenvalue = |(mode, eigenvalue): (usize, &f64)| {
        if !eigenvalue.is_finite() || *eigenvalue < -tolerance {
            let field = format!("eigenvalues[{mode}] of '{}'", domain.name);
            return Err(invalid_input(field, "a finite number >= 0 in (rad/s)^2: a stiffness", eigenvalue));
        }
        Ok(if *eigenvalue > tolerance { *eigenvalue } else { 0.0 })
    };
    domain.eigenvalues.iter().enumerate().map(eigenvalue).collect()
}

fn read_damping_ratio(domain: &DomainModel) -> Result<f64> {
    let Some(text) = domain.notes.get("damping_ratio") else { return Ok(DEFAULT_DAMPING_RATIO) };
    let number = text.trim().parse().ok().filter(|ratio| (0.0..=MAX_DAMPING_RATIO).contains(ratio));
    number.ok_or_else(|| {
        let field = format!("damping_ratio of '{}'", domain.name);
        invalid_input(field, format!("a number from 0 to {MAX_DAMPING_RATIO}"), format!("'{text}'"))
    })
}

/// A remark on some modes, with the name of each domain and the number of its modes. `None` without modes.
fn describe_modes(subject: &str, modes: &[(&str, usize)]) -> Option<String> {
    let count: usize = modes.iter().map(|(_, count)| count).sum();
    let mut names: Vec<String> =
        modes.iter().take(MAX_NAMED_DOMAINS).map(|(name, count)| format!("{count} of '{name}'")).collect();
    let unnamed_count = modes.len() - names.len();
    if unnamed_count > 0 {
        names.push(format!("and those of {unnamed_count} other domains"));
    }
    (count > 0).then(|| format!("{subject} ({count}): {}", names.join(", ")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hierarchy::tests::four_domain_model;

    /// Reads the parameters of a model whose second domain has the given eigenvalues and damping ratio.
    fn read(eigenvalues: &[f64], damping_ratio: Option<&str>) -> Result<ModalParameters> {
        let mut model = four_domain_model();
        let domain = &mut model.domains[1];
        domain.name = "branch".into();
        domain.eigenvalues = eigenvalues.to_vec();
        domain.notes.extend(damping_ratio.map(|text| ("damping_ratio".into(), text.into())));
        ModalParameters::read(&model)
    }

    #[test]
    fn invalid_damping_ratios_are_rejected() {
        for text in ["nan", "five", "inf", "-0.1", "1001", "", "0,05"] {
            let error = read(&[30.0, 35.0], Some(text)).expect_err("an invalid damping ratio").to_string();
            assert!(error.contains("damping_ratio of 'branch'") && error.contains(&format!("'{text}'")), "{error}");
        }
        let damping_ratio =
            |text| read(&[30.0, 35.0], text).expect("valid parameters").modes[2].expect("a mode").damping_ratio;
        assert_eq!((damping_ratio(Some(" 0.07 ")), damping_ratio(Some("0")), damping_ratio(None)), (0.07, 0.0, 0.03));
    }

    #[test]
    fn invalid_eigenvalues_are_rejected() {
        for (eigenvalues, field) in [
            (&[30.0, -1.0][..], "eigenvalues[1] of 'branch'"),
            (&[f64::NAN, 30.0], "eigenvalues[0] of 'branch'"),
            (&[30.0, f64::INFINITY], "eigenvalues[1] of 'branch'"),
            (&[30.0], "eigenvalues of 'branch'"),
            (&[30.0, 31.0, 32.0], "eigenvalues of 'branch'"),
        ] {
            let error = read(eigenvalues, None).expect_err("invalid eigenvalues").to_string();
            assert!(error.starts_with(field), "{error}");
        }
    }

    #[test]
    fn modes_without_stiffness_are_held_and_named() {
        // A rounding error of a rigid motion, and a domain without eigenvalues.
        let parameters = read(&[-1e-12, 30.0], None).expect("valid parameters");
        assert!(parameters.modes[2].is_none() && parameters.modes[3].is_some());
        assert!(parameters.remarks[0].contains("1 of 'branch'"), "{:?}", parameters.remarks);
        let remarks = read(&[], None).expect("valid parameters").remarks;
        assert!(remarks[0].contains("2 of 'branch'"), "{remarks:?}");
        assert_eq!(read(&[30.0, 35.0], None).expect("valid parameters").remarks, [""; 0]);
    }

    #[test]
    fn modes_without_damping_are_named() {
        let remarks = |damping_ratio| read(&[0.0, 30.0], Some(damping_ratio)).expect("valid parameters").remarks;
        let undamped = remarks("0");
        assert!(undamped.len() == 2 && undamped[1].starts_with("modes without damping"), "{undamped:?}");
        assert!(undamped[1].ends_with("(1): 1 of 'branch'"), "expected no mode that is held still: {undamped:?}");
        assert_eq!(remarks("1e-6").len(), 1);
    }
}
