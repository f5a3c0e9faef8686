//! The inputs that the motion of a run follows from. A checkpoint continues only a run of the same inputs.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Display;
use std::path::Path;

use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};

use crate::affine::AffineTransform;
use crate::error::{Result, invalid_input};
use crate::model::{DomainInertia, DomainModel, FollowedDomain, Joint, Model, Sample};

/// Name of the input that is the hash of the scene.
const SCENE_HASH: &str = "scene (SHA-256)";

/// The inputs that the motion of a run follows from, as text by name.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunIdentity(BTreeMap<String, String>);

impl RunIdentity {
    /// Adds an input.
    #[must_use]
    pub fn with(mut self, name: &str, value: impl Display) -> Self {
        self.0.insert(name.to_owned(), value.to_string());
        self
    }

    /// Adds a number. Different numbers have different texts.
    #[must_use]
    pub fn with_number(self, name: &str, number: f64) -> Self {
        self.with(name, format_args!("{number:?}"))
    }

    /// Adds the hash of a scene.
    #[must_use]
    pub(crate) fn with_scene(self, model: &Model) -> Self {
        self.with(SCENE_HASH, hash_scene(model))
    }

    /// Checks that a checkpoint with the identity `self` at `path` belongs to a run with the identity `run`.
    ///
    /// # Errors
    /// `Invalid` with the first input that differs, and its two values.
    pub(crate) fn check(&self, run: &Self, path: &Path) -> Result<()> {
        // The kind of motion decides which other inputs there are, and the scene their defaults.
        let names: BTreeSet<&str> = self.0.keys().chain(run.0.keys()).map(String::as_str).collect();
        let mut names: Vec<&str> = names.into_iter().collect();
        names.sort_by_key(|name| (*name != "motion", *name != SCENE_HASH));
        let value = |identity: &Self, name: &str| identity.0.get(name).map_or("none", String::as_str).to_owned();
        match names.into_iter().find(|name| self.0.get(*name) != run.0.get(*name)) {
            None => Ok(()),
            Some(name) => {
                let expected = format!("{}, as in the checkpoint {}", value(self, name), path.display());
                Err(invalid_input(format!("{name} of this run"), expected, value(run, name)))
            }
        }
    }
}

/// Hexadecimal digits of bytes.
pub(crate) fn hexadecimal(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// The SHA-256 of everything in a model but the names of the scene and its domains; 64 hexadecimal digits.
fn hash_scene(model: &Model) -> String {
    let Model { scene: _, domains, coordinate_count, unit, up, bounds_min, bounds_max } = model;
    let mut hasher = ModelHasher(Sha256::new());
    hasher.add_counts(&[domains.len(), *coordinate_count]);
    hasher.add_numbers(&[*unit]);
    [up, bounds_min, bounds_max].into_iter().for_each(|vector| hasher.add_numbers(vector.as_slice()));
    domains.iter().for_each(|domain| hasher.add_domain(domain));
    hexadecimal(&hasher.0.finalize())
}

/// Hashes a model. The lengths of lists are hashed before their entries.
struct ModelHasher(Sha256);

impl ModelHasher {
    fn add_counts(&mut self, counts: &[usize]) {
        counts.iter().for_each(|count| self.0.update((*count as u64).to_le_bytes()));
    }

    fn add_numbers(&mut self, numbers: &[f64]) {
        self.add_counts(&[numbers.len()]);
        numbers.iter().for_each(|number| self.0.update(number.to_le_bytes()));
    }

    fn add_transform(&mut self, transform: &AffineTransform) {
        let AffineTransform { linear, translation } = transform;
        self.add_numbers(linear.as_slice());
        self.add_numbers(translation.as_slice());
    }

    fn add_domain(&mut self, domain: &DomainModel) {
        // Without `..`, so that a new field does not compile before it is hashed.
        let DomainModel {
            name: _,
            rank,
            first_coordinate,
            owns_q,
            placement,
            joint,
            follow,
            eigenvalues,
            inertia,
            notes,
            area,
            part_count,
            diagonal,
            samples,
            surface_sample_count,
            base_sample,
        } = domain;
        let base_sample = base_sample.map_or(0, |sample| sample + 1);
        self.add_counts(&[
            *rank,
            *first_coordinate,
            usize::from(*owns_q),
            *part_count,
            *surface_sample_count,
            base_sample,
        ]);
        self.add_transform(placement);
        self.add_counts(&[usize::from(joint.is_some()), usize::from(follow.is_some())]);
        if let Some(Joint { parent, parent_from_child, attachment_samples }) = joint {
            self.add_counts(&[*parent, attachment_samples.len()]);
            self.add_transform(parent_from_child);
            self.add_counts(attachment_samples);
        }
        if let Some(FollowedDomain { leader, leader_from_follower }) = follow {
            self.add_counts(&[*leader]);
            self.add_transform(leader_from_follower);
        }
        self.add_numbers(eigenvalues);
        self.add_counts(&[usize::from(inertia.is_some())]);
        if let Some(DomainInertia { rigid, coupling, modal }) = inertia {
            self.add_numbers(rigid.as_slice());
            coupling.iter().for_each(|momentum| self.add_numbers(momentum.as_slice()));
            self.add_numbers(modal.as_slice());
        }
        self.add_numbers(&[*area, *diagonal]);
        self.add_counts(&[notes.len()]);
        for text in notes.iter().flat_map(|(name, text)| [name, text]) {
            self.add_counts(&[text.len()]);
            self.0.update(text);
        }
        self.add_counts(&[samples.len()]);
        for Sample { rest_position, mode_rows, part } in samples {
            self.add_numbers(rest_position.as_slice());
            self.add_numbers(mode_rows);
            self.add_counts(&[*part]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hierarchy::tests::four_domain_model;

    #[test]
    fn every_input_of_the_motion_changes_the_hash_of_the_scene() {
        type Change = fn(&mut Model);
        let changes: [Change; 12] = [
            |model| model.domains[1].eigenvalues[0] *= 1.0 + f64::EPSILON,
            |model| model.domains[0].samples[3].mode_rows[1] += 1e-9,
            |model| model.domains[0].samples[3].rest_position.x += 1e-9,
            |model| model.domains[0].placement.translation.x = -0.0,
            |model| model.domains[1].joint.as_mut().expect("a joint").parent_from_child.linear[(0, 1)] += 1e-9,
            |model| model.domains[1].joint.as_mut().expect("a joint").attachment_samples.truncate(3),
            |model| drop(model.domains[0].notes.insert("damping_ratio".into(), "0.2".into())),
            |model| model.domains[2].area += 1e-9,
            |model| model.domains[3].joint = None,
            |model| drop(model.domains.pop()),
            |model| model.up = -model.up,
            |model| model.bounds_max.z += 1e-9,
        ];
        let hash = hash_scene(&four_domain_model());
        let mut hashes = BTreeSet::from([hash.clone()]);
        for change in changes {
            let mut model = four_domain_model();
            change(&mut model);
            assert!(hashes.insert(hash_scene(&model)), "expected a new hash: {} so far", hashes.len());
        }
        let mut renamed = four_domain_model();
        renamed.scene = "another name".into();
        assert_eq!(hash_scene(&renamed), hash, "control: names do not move the scene");
    }

    #[test]
    fn mismatch_names_the_input_and_both_values() {
        let identity = |dt: f64| RunIdentity::default().with("motion", "a tree").with_number("dt", dt);
        let path = Path::new("run.checkpoint");
        identity(0.25).check(&identity(0.25), path).expect("the same inputs");
        let message = |run: &RunIdentity| identity(0.25).check(run, path).expect_err("another input").to_string();
        let expected = "dt of this run: expected 0.25, as in the checkpoint run.checkpoint, got 0.5";
        assert_eq!(message(&identity(0.5)), expected);
        assert!(message(&identity(0.25 + f64::EPSILON)).contains("got 0.2500000000000002"));
        assert!(message(&identity(0.25).with("seed", 7)).starts_with("seed of this run: expected none"));
        // The kind of motion comes first.
        assert!(message(&identity(0.5).with("motion", "a sweep")).starts_with("motion of this run"));
    }
}
