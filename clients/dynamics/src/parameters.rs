//! Physical parameters of modes: eigenvalues and damping ratios. All of them are validated before the first step.

use crate::error::{Result, invalid_input};
use crate::model::{DomainModel, Model};
use crate::rigid_modes::find_held_modes;

/// Damping ratio of domains without a note `damping_ratio`.
const DEFAULT_DAMPING_RATIO: f64 = 0.03;

/// Largest accepted damping ratio. A ratio of 1 is critical damping.
const MAX_DAMPING_RATIO: f64 = 1000.0;

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
    /// Names the modes that are held still, with their frequencies, and those without damping.
    pub remarks: Vec<String>,
}

impl ModalParameters {
    /// Reads the parameters of all domains with coordinates of their own.
    ///
    /// # Errors
    /// `Invalid` if a domain has another number of eigenvalues than modes, if an eigenvalue is negative or not finite,
    /// if the note `damping_ratio` is not a number from 0 to 1000, or if the note `rigid_modes` is not a number of
    /// modes or does not count a mode without stiffness.
    pub fn read(model: &Model) -> Result<Self> {
        Self::read_except(model, None)
    }

    /// As [`Self::read`], but the modes of the domain with index `skipped` have no parameters and no remarks.
    ///
    /// # Errors
    /// Those of [`Self::read`].
    pub fn read_except(model: &Model, skipped: Option<usize>) -> Result<Self> {
        let mut modes = vec![None; model.coordinate_count];
        let (mut held_count, mut held_modes) = (0, vec![]);
        let (mut unknown_modes, mut undamped_modes) = (vec![], vec![]);
        let domains =
            model.domains.iter().enumerate().filter(|(index, domain)| domain.owns_q && Some(*index) != skipped);
        for (_, domain) in domains {
            let damping_ratio = read_damping_ratio(domain)?;
            let is_held = find_held_modes(domain)?;
            if domain.eigenvalues.is_empty() {
                unknown_modes.push((domain.name.as_str(), domain.rank));
                continue;
            }
            let mut held = vec![];
            for (mode, eigenvalue) in domain.eigenvalues.iter().enumerate() {
                if is_held[mode] {
                    held.push(format!("q[{mode}] ({} Hz)", rounded_frequency(*eigenvalue)));
                } else {
                    let parameters = ModeParameters { eigenvalue: *eigenvalue, damping_ratio };
                    modes[domain.first_coordinate + mode] = Some(parameters);
                }
            }
            if damping_ratio == 0.0 {
                undamped_modes.push((domain.name.as_str(), domain.rank - held.len()));
            }
            held_count += held.len();
            if !held.is_empty() {
                held_modes.push(format!("'{}': {}", domain.name, held.join(", ")));
            }
        }
        let held = (held_count > 0).then(|| {
            let list = held_modes.join("; ");
            format!("modes without stiffness are held still ({held_count}; the note rigid_modes sets how many): {list}")
        });
        let unknown = describe_modes("modes without eigenvalues are held still", &unknown_modes);
        let undamped =
            describe_modes("modes without damping (damping_ratio 0) keep the energy of all gusts", &undamped_modes);
        Ok(Self { modes, remarks: [held, unknown, undamped].into_iter().flatten().collect() })
    }

    /// Names and frequencies in hertz of the modes that can move.
    pub fn frequencies(&self, model: &Model) -> Vec<(String, f64)> {
        let modes_of = |domain: &DomainModel| {
            let modes = self.modes[domain.first_coordinate..][..domain.rank].iter().enumerate();
            let frequency = |(mode, parameters): (usize, &Option<ModeParameters>)| {
                Some((format!("q[{mode}] of '{}'", domain.name), frequency(parameters.as_ref()?.eigenvalue)))
            };
            modes.filter_map(frequency).collect::<Vec<_>>()
        };
        model.domains.iter().filter(|domain| domain.owns_q).flat_map(modes_of).collect()
    }

    /// The lowest frequency in hertz; `None` if no mode can move.
    pub fn lowest_frequency(&self) -> Option<f64> {
        let eigenvalues = self.modes.iter().flatten().map(|mode| mode.eigenvalue);
        eigenvalues.min_by(f64::total_cmp).map(frequency)
    }
}

/// The frequency in hertz of a mode by its eigenvalue; 0 for a negative one.
fn frequency(eigenvalue: f64) -> f64 {
    eigenvalue.max(0.0).sqrt() / std::f64::consts::TAU
}

/// The frequency with four significant digits.
fn rounded_frequency(eigenvalue: f64) -> f64 {
    let hertz = frequency(eigenvalue);
    format!("{hertz:.3e}").parse().unwrap_or(hertz)
}

fn read_damping_ratio(domain: &DomainModel) -> Result<f64> {
    Ok(noted_damping_ratio(domain)?.unwrap_or(DEFAULT_DAMPING_RATIO))
}

/// The damping ratio in the note of a domain; `None` without the note.
///
/// # Errors
/// `Invalid` if the note is not a number from 0 to 1000.
pub(crate) fn noted_damping_ratio(domain: &DomainModel) -> Result<Option<f64>> {
    let Some(text) = domain.notes.get("damping_ratio") else { return Ok(None) };
    let number = text.trim().parse().ok().filter(|ratio| (0.0..=MAX_DAMPING_RATIO).contains(ratio));
    number.map(Some).ok_or_else(|| {
        let field = format!("damping_ratio of '{}'", domain.name);
        invalid_input(field, format!("a number from 0 to {MAX_DAMPING_RATIO}"), format!("'{text}'"))
    })
}

/// A remark on some modes, with the name of each domain and the number of its modes. `None` without modes.
fn describe_modes(subject: &str, modes: &[(&str, usize)]) -> Option<String> {
    let modes: Vec<_> = modes.iter().filter(|(_, count)| *count > 0).collect();
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
        assert!(parameters.remarks[0].ends_with("'branch': q[0] (0 Hz)"), "{:?}", parameters.remarks);
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
