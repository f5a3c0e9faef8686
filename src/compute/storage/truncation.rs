//! Modal truncation: the modes that can be left out at a step's q, and a bound of the resulting error.
//!
//! Leaving out a set D of modes moves no vertex by more than `||A||_2 sum_{j in D} |q_j| max_i ||U_ij||_2`, where A is
//! the linear part of T, and U_ij is the block of three entries of vertex i and mode j. This follows from the triangle
//! inequality.
//!
//! Hysteresis prevents popping of a mode whose q oscillates around a limit. A mode becomes truncated only if all
//! truncated modes together stay within half the error budget. It is restored when they exceed the whole budget.

use modalcast_model::domain::Modes;

/// Safety factor: more than the rounding error of three products and of one addition per mode in f64.
const ROUND_UP: f64 = 1.0 + 1e-12;

/// `max_i ||U_ij||_2` per mode j, rounded up: the largest displacement of a vertex by the mode, in scene units per unit
/// of q.
pub fn max_row_norms(modes: &Modes) -> Vec<f64> {
    let norm_squared = |row: &[f32]| row.iter().map(|entry| f64::from(*entry).powi(2)).sum::<f64>();
    let max_row_norm =
        |mode: usize| modes.column(mode).chunks_exact(3).map(norm_squared).fold(0.0, f64::max).sqrt() * ROUND_UP;
    (0..modes.rank()).map(max_row_norm).collect()
}

/// Inputs of the truncation of a domain in one step.
#[derive(Debug, Clone, Copy)]
pub struct TruncationInput<'a> {
    /// Finite coordinates, one per mode.
    pub q: &'a [f32],
    /// From [`max_row_norms`].
    pub max_row_norms: &'a [f64],
    /// Upper bound of `||A||_2` for the domain's transform, from [`super::bound::linear_norm_bound`].
    pub norm: f64,
}

/// The truncated modes of one domain, updated step by step.
#[derive(Debug, Clone, PartialEq)]
pub struct Truncation {
    /// Per mode.
    is_truncated: Vec<bool>,
    /// Per mode: maximum displacement of a vertex by the mode in this step, in scene units.
    costs: Vec<f64>,
    /// All modes by ascending cost.
    modes_by_cost: Vec<u16>,
    /// Modes that are not truncated, ascending.
    retained: Vec<u16>,
    /// Sum of the costs of truncated modes, rounded up.
    bound: f64,
}

impl Truncation {
    /// Creates the state of a domain with `rank` modes, none truncated.
    pub fn new(rank: usize) -> Self {
        let all_modes: Vec<u16> = (0..rank as u16).collect();
        Self {
            is_truncated: vec![false; rank],
            costs: vec![0.0; rank],
            modes_by_cost: all_modes.clone(),
            retained: all_modes,
            bound: 0.0,
        }
    }

    /// Resets to the initial state, in which no mode is truncated.
    pub fn reset(&mut self) {
        *self = Self::new(self.is_truncated.len());
    }

    /// Updates the truncation for a step. `budget` is the maximum error of a vertex, in scene units.
    pub fn update(&mut self, input: TruncationInput, budget: f64) {
        for (cost, (q, max_row_norm)) in self.costs.iter_mut().zip(input.q.iter().zip(input.max_row_norms)) {
            *cost = input.norm * (f64::from(q.abs()) * max_row_norm);
        }
        let costs = &self.costs;
        self.modes_by_cost.sort_unstable_by(|a, b| {
            let order = costs[usize::from(*a)].total_cmp(&costs[usize::from(*b)]);
            order.then(a.cmp(b))
        });
        let total = self.restore_modes(budget);
        self.bound = self.truncate_modes(total, budget / 2.0) * ROUND_UP;
        self.retained.clear();
        self.retained.extend((0..self.is_truncated.len() as u16).filter(|mode| !self.is_truncated[usize::from(*mode)]));
    }

    /// The modes to sum, ascending.
    pub fn retained(&self) -> &[u16] {
        &self.retained
    }

    /// Upper bound of the error of any vertex by the truncated modes, in scene units. At most the budget of the last
    /// update.
    pub const fn bound(&self) -> f64 {
        self.bound
    }

    /// Restores the costliest truncated modes until the remaining truncated modes fit the budget. Returns the total
    /// cost of the remaining ones.
    fn restore_modes(&mut self, budget: f64) -> f64 {
        let mut total = 0.0;
        for mode in self.modes_by_cost.iter().map(|mode| usize::from(*mode)) {
            if self.is_truncated[mode] {
                let new_total = total + self.costs[mode];
                self.is_truncated[mode] = new_total * ROUND_UP <= budget;
                total = if self.is_truncated[mode] { new_total } else { total };
            }
        }
        total
    }

    /// Truncates the cheapest retained modes while the total cost of all truncated modes fits the budget. `total` is
    /// the cost of the modes that are already truncated. Returns the new total cost.
    fn truncate_modes(&mut self, mut total: f64, budget: f64) -> f64 {
        for mode in self.modes_by_cost.iter().map(|mode| usize::from(*mode)) {
            if self.is_truncated[mode] {
                continue;
            }
            let new_total = total + self.costs[mode];
            if new_total * ROUND_UP > budget {
                break;
            }
            self.is_truncated[mode] = true;
            total = new_total;
        }
        total
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{TestRng, shape};
    use modalcast_model::domain::Shape;

    fn update(truncation: &mut Truncation, q: &[f32], max_row_norms: &[f64], budget: f64) {
        truncation.update(TruncationInput { q, max_row_norms, norm: 1.0 }, budget);
    }

    /// The largest displacement of a vertex by all modes that are not in `retained`.
    fn max_truncated_displacement(shape: &Shape, q: &[f32], retained: &[u16]) -> f64 {
        let truncated_modes = || (0..q.len()).filter(|mode| !retained.contains(&(*mode as u16)));
        let coordinate_sum = |vertex: usize, axis: usize| -> f64 {
            truncated_modes().map(|mode| f64::from(q[mode]) * f64::from(shape.modes.entry(vertex, axis, mode))).sum()
        };
        let length = |vertex| (0..3).map(|axis| coordinate_sum(vertex, axis).powi(2)).sum::<f64>().sqrt();
        (0..shape.modes.vertices()).map(length).fold(0.0, f64::max)
    }

    #[test]
    fn truncation_error_stays_within_bound_and_bound_within_budget() {
        let (mut truncated_count, mut exceeded_count) = (0, 0);
        for seed in 0..120 {
            let mut rng = TestRng(seed);
            let rank = 1 + seed as usize % 40;
            let shape = shape(30, rank, &mut rng);
            let max_row_norms = max_row_norms(&shape.modes);
            let mut truncation = Truncation::new(rank);
            for step in 0..4 {
                let q: Vec<f32> = (0..rank).map(|mode| rng.next() * f32::exp2(-(mode as f32))).collect();
                let budget = 0.4 / f64::from(1 << (4 * step));
                update(&mut truncation, &q, &max_row_norms, budget);
                let error = max_truncated_displacement(&shape, &q, truncation.retained());
                assert!(error <= truncation.bound() && truncation.bound() <= budget, "seed {seed}: {error}");
                assert!(truncation.retained().is_sorted());
                truncated_count += rank - truncation.retained().len();
                // Control: with the first retained mode truncated too, the error often exceeds the bound.
                let fewer_modes = truncation.retained().split_first().map_or(&[][..], |(_, others)| others);
                exceeded_count += usize::from(max_truncated_displacement(&shape, &q, fewer_modes) > truncation.bound());
            }
        }
        assert!(truncated_count > 1000, "expected more than 1000 truncated modes, got {truncated_count}");
        assert!(
            exceeded_count > 300,
            "expected one more truncated mode to exceed the bound, got {exceeded_count} cases"
        );
    }

    #[test]
    fn one_mode_on_one_vertex_meets_the_bound_exactly() {
        let shape = shape(1, 1, &mut TestRng(5));
        let max_row_norms = max_row_norms(&shape.modes);
        let mut truncation = Truncation::new(1);
        update(&mut truncation, &[0.25], &max_row_norms, 10.0);
        let error = max_truncated_displacement(&shape, &[0.25], &[]);
        assert!(truncation.retained().is_empty());
        assert!(error <= truncation.bound() && truncation.bound() <= error * (1.0 + 1e-11));
    }

    #[test]
    fn hysteresis_prevents_flicker_of_a_mode_near_the_limit() {
        // The cost of mode 1 oscillates around 0.5, half the budget of 1.
        let oscillation = |step: i32| (0.5 + 0.1 * f64::from(step).sin()) as f32;
        let mut truncation = Truncation::new(2);
        let (mut changes, mut naive_changes) = (0, 0);
        let mut previous_modes = truncation.retained().to_vec();
        let mut naive_previous_count = previous_modes.len();
        for step in 0..200 {
            let q = [1.0, oscillation(step)];
            update(&mut truncation, &q, &[1.0, 1.0], 1.0);
            changes += usize::from(truncation.retained() != previous_modes);
            previous_modes = truncation.retained().to_vec();
            // A new `Truncation` has no hysteresis: it truncates every mode that fits half the budget.
            let mut naive = Truncation::new(2);
            update(&mut naive, &q, &[1.0, 1.0], 1.0);
            naive_changes += usize::from(naive.retained().len() != naive_previous_count);
            naive_previous_count = naive.retained().len();
        }
        assert_eq!(changes, 1, "expected the mode to be truncated once");
        assert!(naive_changes > 50, "expected more than 50 changes without hysteresis, got {naive_changes}");
    }

    #[test]
    fn mode_is_truncated_below_half_and_restored_above_full_budget() {
        // Per step, the coordinate of the only mode and the number of retained modes. The budget is 1.
        let mut truncation = Truncation::new(1);
        let mut retained = |q: f32| {
            update(&mut truncation, &[q], &[1.0], 1.0);
            truncation.retained().len()
        };
        assert_eq!([0.6, 0.51, 0.49, 0.9, 0.99, 1.01, 0.8, 0.51, 0.4].map(&mut retained), [1, 1, 0, 0, 0, 1, 1, 1, 0]);
    }

    #[test]
    fn huge_tiny_and_zero_coordinates_do_not_overflow() {
        let huge = [f32::MAX, 1e-45, 0.0, -f32::MAX];
        let max_row_norms = [f64::from(f32::MAX); 4];
        let mut truncation = Truncation::new(4);
        truncation.update(TruncationInput { q: &huge, max_row_norms: &max_row_norms, norm: 1e39 }, 1e-6);
        assert_eq!(truncation.retained(), [0, 1, 3]);
        assert_eq!(truncation.bound(), 0.0);
        let mut rigid = Truncation::new(0);
        update(&mut rigid, &[], &[], 1.0);
        assert!(rigid.retained().is_empty());
    }
}
