//! Coordinates and transforms of a step, and their conversion to a message with the values that have changed.

use modalcast_client::Step;

use crate::hierarchy::compute_transforms;
use crate::model::Model;

/// The values of one step.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct StepValues {
    /// All coordinates of the scene.
    pub q: Vec<f32>,
    /// `world_from_domain` of every domain, row-major 3x4.
    pub transforms: Vec<[f32; 12]>,
}

impl StepValues {
    /// The values at the given coordinates of the whole scene. The transforms keep every domain attached to its parent.
    pub fn new(model: &Model, q: &[f64]) -> Self {
        let transforms = compute_transforms(model, q, &[]);
        Self {
            q: q.iter().map(|coordinate| *coordinate as f32).collect(),
            transforms: transforms.iter().map(|transform| transform.to_row_major()).collect(),
        }
    }

    /// A step with all values, at `time` seconds.
    pub fn to_step(&self, model: &Model, number: u64, time: f64) -> Step {
        add_changes(model, Step::new(number, time), None, self)
    }
}

/// Adds to a step the values whose bits changed since the last step sent, or all values if there is none. A domain that
/// follows another one has no transform in steps.
pub(crate) fn add_changes(
    model: &Model,
    mut step: Step,
    last_sent_values: Option<&StepValues>,
    current_values: &StepValues,
) -> Step {
    let are_equal = |a: &[f32], b: &[f32]| a.iter().map(|x| x.to_bits()).eq(b.iter().map(|x| x.to_bits()));
    for (index, domain) in model.domains.iter().enumerate() {
        let range = domain.first_coordinate..domain.first_coordinate + domain.rank;
        let q_changed = last_sent_values.is_none_or(|last_sent_values| {
            !are_equal(&last_sent_values.q[range.clone()], &current_values.q[range.clone()])
        });
        if domain.owns_q && domain.rank > 0 && q_changed {
            step.set_q(index as u32, &current_values.q[range]);
        }
        if domain.follow.is_some() {
            continue;
        }
        let transform = &current_values.transforms[index];
        if last_sent_values.is_none_or(|last_sent_values| !are_equal(&last_sent_values.transforms[index], transform)) {
            step.set_transform(index as u32, transform);
        }
    }
    step
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hierarchy::tests::four_domain_model;

    #[test]
    fn later_steps_send_only_changed_values() {
        let model = four_domain_model();
        let rest_values = StepValues { q: vec![0.0; 6], transforms: vec![[0.0; 12]; 4] };
        let encode_step = |last_sent_values, current_values| {
            add_changes(&model, Step::new(3, 0.5), last_sent_values, current_values).to_wire()
        };
        let all_values = encode_step(None, &rest_values);
        assert_eq!((all_values.q_domains, all_values.transform_domains), (vec![0, 1, 2], vec![0, 1, 2, 3]));
        // Six coordinates and four 3x4 matrices in f32.
        assert_eq!((all_values.q.len(), all_values.transforms.len()), (6 * 4, 4 * 48));
        let mut changed_values = rest_values.clone();
        // Coordinate 3 belongs to domain 1; the changed transform is the one of domain 3.
        (changed_values.q[3], changed_values.transforms[3][7]) = (1.0, 2.0);
        let changes = encode_step(Some(&rest_values), &changed_values);
        assert_eq!((changes.q_domains, changes.transform_domains), (vec![1], vec![3]));
        let no_changes = encode_step(Some(&changed_values), &changed_values);
        assert!(no_changes.q.is_empty() && no_changes.transforms.is_empty() && no_changes.q_domains.is_empty());
    }
}
