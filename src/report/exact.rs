//! x = T (x0 + U q) in f64 with any ingredient exchanged, and the bound on what f32 makes of it.
//!
//! Where the modes cancel, u = U q is summed in double-double. Tiles of vertices go over all cores, so that scenes of
//! millions of vertices can be judged hundreds of times; `reference::deform` is the definition that a test holds it to.

use std::ops::Range;

use rayon::prelude::*;

use super::double::Double;
use super::motion::Truth;
use crate::domain::Modes;
use crate::scene::Scene;

/// What a deformer replaces in x = T (x0 + U q) before it computes, and how far off that may be.
///
/// The defaults replace nothing. Who replaces something says so in [`Self::is_exact`] too.
pub trait Ingredients: Sync {
    /// Whether nothing is replaced, so that all such deformers share their bounds.
    fn is_exact(&self) -> bool {
        true
    }

    /// U of a shape as it is stored, decoded; `None` when it is stored exactly.
    fn decoded(&self, _shape: usize) -> Option<&Modes> {
        None
    }

    /// How far the decoded entries of `mode` may lie from U at a vertex of a shape. Asked for only where
    /// [`Self::decoded`] gives something.
    fn entry_bound(&self, _shape: usize, _vertex: usize, _mode: usize) -> f64 {
        0.0
    }

    /// Which modes of a domain are left out at these coordinates, appended to `left_out` in ascending order.
    fn left_out(&self, _domain: usize, _truth: &Truth, _left_out: &mut Vec<usize>) {}

    /// How far leaving out modes may move a vertex, in scene units.
    fn truncation_bound(&self) -> f64 {
        0.0
    }

    /// Roundings of a sum beyond one per mode, of x0 and of a decoding scale.
    fn extra_roundings(&self) -> usize {
        0
    }
}

/// Nothing is replaced: U in f32 as it is, all modes.
#[derive(Debug, Clone, Copy, Default)]
pub struct Exact;

impl Ingredients for Exact {}

/// A vertex as it should be, and what f32 may make of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Judged {
    /// Exact position, scene units.
    pub at: [f64; 3],
    /// No sum in f32, in whatever order, errs by more than this; scene units.
    pub bound: f64,
    /// sum |U q| / |u|: infinite where u vanishes, 0 where every term does.
    pub condition: f64,
}

/// Vertices per tile.
const TILE: usize = 512;
/// Above this quotient sum |U q| / |u| a sum in f64 is repeated in double-double.
const CANCELS: f64 = 1e6;
/// Unit roundoff of f32.
const ROUND: f64 = 1.0 / (1 << 24) as f64;
/// No result below the normal numbers of f32 errs by more in one operation, a scale of up to 256 included.
const TINY: f64 = 7e-46 * 256.0;

/// Positions with all ingredients as given; `decode` and `truncate` say which of the deformer's replacements to take.
pub fn positions(
    scene: &Scene,
    truth: &Truth,
    ingredients: &dyn Ingredients,
    decode: bool,
    truncate: bool,
) -> Vec<[f64; 3]> {
    each_tile(scene, |domain, vertices, out| {
        let shape = scene.domains[domain].shape;
        let own = ingredients.decoded(shape).filter(|_| decode);
        let sums = sum(
            vertices.clone(),
            &Terms {
                modes: own.unwrap_or(&scene.shapes[shape].modes),
                q: &kept(scene, domain, truth, truncate.then_some(ingredients)),
            },
        );
        let rest = &scene.shapes[shape].mesh.rest()[vertices];
        let bent =
            rest.iter().zip(&sums).map(|(rest, sum)| std::array::from_fn(|axis| f64::from(rest[axis]) + sum.u[axis]));
        out.extend(bent.map(|bent| placed(&truth.transforms[domain], bent)));
    })
}

/// Exact positions with the bounds of a deformer that has these ingredients. `truth` is what it was given, exactly.
pub fn judge(scene: &Scene, truth: &Truth, ingredients: &dyn Ingredients) -> Vec<Judged> {
    each_tile(scene, |domain, vertices, out| {
        let shape = scene.domains[domain].shape;
        let q = kept(scene, domain, truth, None);
        let sums = sum(vertices.clone(), &Terms { modes: &scene.shapes[shape].modes, q: &q });
        let transform = &truth.transforms[domain];
        let stored = ingredients.decoded(shape).is_some();
        for (vertex, sum) in vertices.zip(&sums) {
            let rest = scene.shapes[shape].mesh.rest()[vertex].map(f64::from);
            let storage = match stored {
                true => {
                    q.iter().enumerate().map(|(mode, q)| q.abs() * ingredients.entry_bound(shape, vertex, mode)).sum()
                }
                false => 0.0,
            };
            let at = placed(transform, std::array::from_fn(|axis| rest[axis] + sum.u[axis]));
            let roundings = q.len() + 3 + ingredients.extra_roundings();
            let bound = bound(transform, &rest, sum, storage, roundings) + ingredients.truncation_bound();
            out.push(Judged { at, bound, condition: condition(sum) });
        }
    })
}

/// u and sum |U q| of one vertex.
#[derive(Debug, Clone, Copy, Default)]
struct Sum {
    u: [f64; 3],
    magnitude: [f64; 3],
}

struct Terms<'a> {
    modes: &'a Modes,
    q: &'a [f64],
}

/// Coordinates of a domain, zero for modes that a deformer leaves out.
fn kept(scene: &Scene, domain: usize, truth: &Truth, truncating: Option<&dyn Ingredients>) -> Vec<f64> {
    let slot = scene.layout.slots[domain];
    let mut q = truth.q[slot.first_q..][..slot.rank].to_vec();
    if let Some(ingredients) = truncating {
        let mut left_out = Vec::new();
        ingredients.left_out(domain, truth, &mut left_out);
        left_out.into_iter().for_each(|mode| q[mode] = 0.0);
    }
    q
}

fn sum(vertices: Range<usize>, terms: &Terms<'_>) -> Vec<Sum> {
    let count = 3 * vertices.len();
    let (mut u, mut magnitude) = (vec![0.0; count], vec![0.0; count]);
    for (mode, q) in terms.q.iter().enumerate() {
        let column = &terms.modes.column(mode)[3 * vertices.start..][..count];
        for ((u, magnitude), entry) in u.iter_mut().zip(&mut magnitude).zip(column) {
            let term = f64::from(*entry) * q;
            *u += term;
            *magnitude += term.abs();
        }
    }
    for (row, (u, magnitude)) in u.iter_mut().zip(&magnitude).enumerate() {
        if *magnitude > CANCELS * u.abs() {
            let mut double = Double::default();
            let (vertex, axis) = (vertices.start + row / 3, row % 3);
            terms.q.iter().enumerate().for_each(|(mode, q)| double.add(terms.modes.at(vertex, axis, mode).into(), *q));
            *u = double.value();
        }
    }
    let (u, magnitude) = (u.as_chunks().0, magnitude.as_chunks().0);
    u.iter().zip(magnitude).map(|(u, magnitude)| Sum { u: *u, magnitude: *magnitude }).collect()
}

fn placed(transform: &[f64; 12], bent: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|row| {
        let [x, y, z, offset] = std::array::from_fn(|column| transform[4 * row + column]);
        x * bent[0] + y * bent[1] + z * bent[2] + offset
    })
}

/// The standard bound on sums in any order: after k roundings a sum of terms t errs by at most
/// k e / (1 - k e) sum |t| (Higham, "Accuracy and Stability of Numerical Algorithms", chapters 3 and 4).
fn gamma(roundings: usize) -> f64 {
    let sum = roundings as f64 * ROUND;
    sum / (1.0 - sum)
}

fn bound(transform: &[f64; 12], rest: &[f64; 3], sum: &Sum, storage: f64, roundings: usize) -> f64 {
    let bent: [f64; 3] = std::array::from_fn(|axis| rest[axis].abs() + sum.magnitude[axis] + storage);
    let off = bent.map(|bent| storage + gamma(roundings) * bent + roundings as f64 * TINY);
    let row = |row: usize| {
        let entry = |axis: usize| transform[4 * row + axis].abs();
        let carried: f64 = (0..3).map(|axis| entry(axis) * off[axis]).sum();
        let whole: f64 = (0..3).map(|axis| entry(axis) * (bent[axis] + off[axis])).sum();
        carried + gamma(4) * (whole + transform[4 * row + 3].abs()) + 4.0 * TINY
    };
    (0..3).map(|axis| row(axis).powi(2)).sum::<f64>().sqrt()
}

fn condition(sum: &Sum) -> f64 {
    let norm = |vector: &[f64; 3]| vector.iter().map(|number| number * number).sum::<f64>().sqrt();
    match (norm(&sum.magnitude), norm(&sum.u)) {
        (0.0, _) => 0.0,
        (magnitude, u) => magnitude / u,
    }
}

/// Values of all vertices in packed order, computed tile by tile on all cores.
fn each_tile<T: Send + Clone>(scene: &Scene, work: impl Fn(usize, Range<usize>, &mut Vec<T>) + Sync) -> Vec<T> {
    let tiles = scene.layout.slots.iter().enumerate().flat_map(|(domain, slot)| {
        let tile = move |first| (domain, first..slot.vertices.min(first + TILE));
        (0..slot.vertices).step_by(TILE).map(tile)
    });
    let tiles: Vec<_> = tiles.collect();
    let part = |tiles: &[(usize, Range<usize>)]| {
        let mut out = Vec::with_capacity(tiles.iter().map(|(_, vertices)| vertices.len()).sum());
        tiles.iter().for_each(|(domain, vertices)| work(*domain, vertices.clone(), &mut out));
        out
    };
    // Small domains share a task: their own would cost more than their vertices.
    tiles.par_chunks(32).map(part).collect::<Vec<_>>().concat()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::deform::Deformer as _;
    use crate::report::loads::{Kind, Load, Size};
    use crate::report::motion::Motion;

    fn loads() -> Vec<Load> {
        [Kind::B, Kind::C, Kind::Cancelling, Kind::Plant(1)].map(|kind| kind.build(Size::Quick).expect("built")).into()
    }

    #[test]
    fn positions_are_those_of_the_reference() {
        for load in loads() {
            let state = Motion::new(&load, None).seed(0).state();
            let want = crate::reference::deform(&load.scene, &state);
            let got = positions(&load.scene, &Truth::of(&state), &Exact, true, true);
            let apart = want.as_flattened().iter().zip(got.as_flattened()).map(|(a, b)| (a - b).abs());
            assert_eq!(want.len(), got.len());
            assert!(apart.fold(0.0, f64::max) <= 1e-14 * load.scene.rest_bounds.diagonal(), "{}", load.name);
        }
    }

    #[test]
    fn f32_stays_within_the_bound_and_a_hundredth_of_it_would_be_too_little() {
        for load in loads() {
            let motion = Motion::new(&load, None);
            let mut cpu = crate::cpu::CpuDeformer::new(&load.scene);
            let mut tightest = 0.0_f64;
            for seed in 0..4 {
                let state = motion.seed(seed).state();
                cpu.deform(&state).expect("deforms");
                let surface = &cpu.surface().expect("a surface").positions;
                for (got, want) in surface.as_chunks::<3>().0.iter().zip(judge(&load.scene, &Truth::of(&state), &Exact))
                {
                    let square: f64 = got.iter().zip(want.at).map(|(got, want)| (f64::from(*got) - want).powi(2)).sum();
                    tightest = tightest.max(square.sqrt() / want.bound);
                }
            }
            assert!((0.01..=1.0).contains(&tightest), "{}: {tightest}", load.name);
        }
    }

    #[test]
    fn cancelling_coordinates_have_a_large_condition_number_and_a_vanishing_sum_an_infinite_one() {
        let load = Kind::Cancelling.build(Size::Quick).expect("built");
        let motion = Motion::new(&load, None);
        let median = |seed: usize| {
            let judged = judge(&load.scene, &motion.seed(seed), &Exact);
            let mut conditions: Vec<f64> = judged.iter().map(|judged| judged.condition).collect();
            conditions.sort_by(f64::total_cmp);
            conditions[conditions.len() / 2]
        };
        assert!(median(1) > 1e3 && median(0) < 100.0, "{} {}", median(1), median(0));
        let vanishing = Sum { u: [0.0; 3], magnitude: [1.0, 0.0, 0.0] };
        assert_eq!((condition(&vanishing), condition(&Sum::default())), (f64::INFINITY, 0.0));
    }

    #[test]
    fn a_sum_that_f64_loses_is_summed_again() {
        let columns = vec![1.0, 1.0, 1.0, 2f32.powi(-30), 0.0, 0.0, -1.0, -1.0, -1.0];
        let modes = Modes::from_columns(3, 3, columns).expect("modes");
        // 1e10 + 2^-30 - 1e10: f64 has 53 bits and 2^-30 lies 63 below.
        let sums = sum(0..1, &Terms { modes: &modes, q: &[1e10, 1.0, 1e10] });
        assert_eq!(sums[0].u, [2f64.powi(-30), 0.0, 0.0]);
    }
}
