//! Reference evaluation of x = T (x0 + U q) in f64, on request with U as an error model stores it, and the a-priori
//! bound on the f32 error.
//!
//! Where the modes cancel, u = U q is summed in double-double. Tiles of vertices are distributed over all cores, so
//! that scenes of millions of vertices can be evaluated hundreds of times. A test compares the results with
//! `reference::deform`, the definition.

use std::ops::Range;

use rayon::prelude::*;

use super::double_double::DoubleDouble;
use super::error_model::ErrorModel;
use super::exact_state::ExactState;
use modalcast_compute::storage::TiledModes;
use modalcast_model::domain::Modes;
use modalcast_model::scene::{Scene, SceneState};

/// Reference of one vertex: exact position, f32 error bound and condition number.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReferenceVertex {
    /// Exact position, scene units.
    pub position: [f64; 3],
    /// A-priori bound on the error of an f32 sum in any order, scene units.
    pub bound: f64,
    /// Condition number sum |U q| / |u|: infinite if u is 0 but some term is not, 0 if every term is 0.
    pub condition: f64,
}

/// Initial value of vertices that are not evaluated yet.
const UNSET: ReferenceVertex = ReferenceVertex { position: [0.0; 3], bound: 0.0, condition: 0.0 };
/// Roundings of an f32 sum x0 + U q in addition to one per mode. Two would suffice: one for the addition of x0, and one
/// for a product that is rounded before it is added. The third one is a margin.
const EXTRA_ROUNDINGS: usize = 3;
/// Vertices per tile. Tiles are the units of parallel work in this file; tiles of stored U are smaller.
const TILE: usize = 512;
/// Condition number above which an f64 sum is repeated in double-double. Below it, the relative error of the f64 sum is
/// about 1e6 x 1e-16 = 1e-10, far below the 6e-8 of f32.
const CANCELLING_CONDITION: f64 = 1e6;
/// Unit roundoff of f32.
const UNIT_ROUNDOFF: f64 = 1.0 / (1 << 24) as f64;
/// Largest absolute error of one operation with a subnormal f32 result: half the smallest positive f32, 2^-150, rounded
/// up.
const MAX_UNDERFLOW_ERROR: f64 = 7.1e-46;

/// World positions of an exact state in f64, scene units. With `storage`, U is as this model stores it; everything else
/// is exact.
pub fn positions(scene: &Scene, truth: &ExactState, storage: Option<&ErrorModel>) -> Vec<[f64; 3]> {
    map_tiles(scene, [0.0; 3], |domain, vertices, out| {
        let shape = scene.domains[domain].shape;
        let stored = storage.and_then(|error_model| error_model.tiles(shape));
        let entries = stored.map_or(ModeEntries::Exact(&scene.shapes[shape].modes), ModeEntries::Stored);
        let sums = sum_modes(vertices.clone(), entries, coordinates_of(scene, domain, truth));
        let (rest, transform) =
            (&scene.shapes[shape].mesh.rest_positions()[vertices], truth.transform_of(scene, domain));
        for ((rest, sum), out) in rest.iter().zip(&sums).zip(out) {
            let deformed = std::array::from_fn(|axis| f64::from(rest[axis]) + sum.u[axis]);
            *out = transform_point(&transform, deformed);
        }
    })
}

/// Exact positions at a state, with the bounds of an exact deformer.
pub fn reference_vertices(scene: &Scene, state: &SceneState) -> Vec<ReferenceVertex> {
    let truth = ExactState::of(state);
    map_tiles(scene, UNSET, |domain, vertices, references| {
        let shape = &scene.shapes[scene.domains[domain].shape];
        let q = coordinates_of(scene, domain, &truth);
        let sums = sum_modes(vertices.clone(), ModeEntries::Exact(&shape.modes), q);
        let (transform, absolute_transform) =
            (truth.transform_of(scene, domain), truth.absolute_transform_of(scene, domain));
        let (roundings, is_follower) =
            (q.len() + EXTRA_ROUNDINGS, scene.transform_roots.root_from_domain(domain).is_some());
        let rest = shape.mesh.rest_positions()[vertices].iter().map(|rest| rest.map(f64::from));
        for ((rest, sum), references) in rest.zip(&sums).zip(references) {
            let position = transform_point(&transform, std::array::from_fn(|axis| rest[axis] + sum.u[axis]));
            let bound = f32_error_bound((&absolute_transform, is_follower), &rest, sum, roundings);
            *references = ReferenceVertex { position, bound, condition: condition_number(sum) };
        }
    })
}

/// `references` with bounds widened for a deformer with this error model.
pub fn widen_bounds(
    scene: &Scene,
    state: &SceneState,
    references: &[ReferenceVertex],
    error_model: &ErrorModel,
) -> Vec<ReferenceVertex> {
    map_tiles(scene, UNSET, |domain, vertices, out| {
        let first = scene.layout.domains[domain].first_vertex + vertices.start;
        out.copy_from_slice(&references[first..][..vertices.len()]);
        error_model
            .bounds(domain, state)
            .widen_bounds(vertices.start, out.iter_mut().map(|reference| &mut reference.bound));
    })
}

/// u and sum |U q| of one vertex, per axis.
#[derive(Debug, Clone, Copy, Default)]
struct ModalSum {
    u: [f64; 3],
    magnitude: [f64; 3],
}

/// u and sum |U q| of one row of U.
#[derive(Debug, Clone, Copy, Default)]
struct RowSum {
    u: f64,
    magnitude: f64,
}

/// Source of the entries of U.
#[derive(Clone, Copy)]
enum ModeEntries<'a> {
    Exact(&'a Modes),
    Stored(&'a TiledModes),
}

impl ModeEntries<'_> {
    fn entry(&self, vertex: usize, axis: usize, mode: usize) -> f64 {
        match self {
            Self::Exact(modes) => f64::from(modes.entry(vertex, axis, mode)),
            Self::Stored(tiles) => tiles.decode_entry(vertex, axis, mode),
        }
    }

    /// Adds the terms of one mode to the rows of these vertices.
    fn add_mode(&self, vertices: &Range<usize>, (mode, q): (usize, f64), rows: &mut [RowSum]) {
        let add = |row: &mut RowSum, entry: f64| {
            let term = entry * q;
            row.u += term;
            row.magnitude += term.abs();
        };
        match self {
            Self::Exact(modes) => {
                let column = &modes.column(mode)[3 * vertices.start..3 * vertices.end];
                rows.iter_mut().zip(column).for_each(|(row, entry)| add(row, f64::from(*entry)));
            }
            Self::Stored(tiles) => {
                for (vertex, rows) in vertices.clone().zip(rows.as_chunks_mut::<3>().0) {
                    rows.iter_mut()
                        .enumerate()
                        .for_each(|(axis, row)| add(row, tiles.decode_entry(vertex, axis, mode)));
                }
            }
        }
    }
}

/// Modal coordinates of a domain.
fn coordinates_of<'a>(scene: &Scene, domain: usize, truth: &'a ExactState) -> &'a [f64] {
    let domain_layout = scene.layout.domains[domain];
    &truth.q[domain_layout.first_q..][..domain_layout.rank]
}

/// u and sum |U q| of consecutive vertices. Rows that cancel are summed in double-double.
fn sum_modes(vertices: Range<usize>, entries: ModeEntries<'_>, q: &[f64]) -> Vec<ModalSum> {
    let mut rows = vec![RowSum::default(); 3 * vertices.len()];
    for (mode, q) in q.iter().enumerate().filter(|(_, q)| **q != 0.0) {
        entries.add_mode(&vertices, (mode, *q), &mut rows);
    }
    for (index, row) in rows.iter_mut().enumerate() {
        if row.magnitude > CANCELLING_CONDITION * row.u.abs() {
            let mut double_double = DoubleDouble::default();
            let (vertex, axis) = (vertices.start + index / 3, index % 3);
            q.iter().enumerate().for_each(|(mode, q)| double_double.add(entries.entry(vertex, axis, mode), *q));
            row.u = double_double.value();
        }
    }
    let vertex_sum =
        |axes: &[RowSum; 3]| ModalSum { u: axes.map(|row| row.u), magnitude: axes.map(|row| row.magnitude) };
    rows.as_chunks().0.iter().map(vertex_sum).collect()
}

fn transform_point(transform: &[f64; 12], [px, py, pz]: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|row| {
        let [x, y, z, offset] = std::array::from_fn(|column| transform[4 * row + column]);
        x * px + y * py + z * pz + offset
    })
}

/// The factor k e / (1 - k e) for k roundings with the unit roundoff e. A sum of terms t in any order has an error of
/// at most this factor times sum |t| (Higham, "Accuracy and Stability of Numerical Algorithms", chapters 3 and 4).
fn gamma(roundings: usize) -> f64 {
    let relative_error = roundings as f64 * UNIT_ROUNDOFF;
    relative_error / (1.0 - relative_error)
}

/// Error bound of T (x0 + u), scene units. `absolute_transform` holds the absolute values of T. For a follower, T is a
/// product of two transforms, which adds three roundings per entry.
fn f32_error_bound(
    (absolute_transform, is_follower): (&[f64; 12], bool),
    rest: &[f64; 3],
    sum: &ModalSum,
    roundings: usize,
) -> f64 {
    let roundings_of_t = if is_follower { 3 } else { 0 };
    let magnitude: [f64; 3] = std::array::from_fn(|axis| rest[axis].abs() + sum.magnitude[axis]);
    let sum_error = magnitude.map(|magnitude| gamma(roundings) * magnitude + roundings as f64 * MAX_UNDERFLOW_ERROR);
    let row_bound = |row: usize| {
        let entry = |axis: usize| absolute_transform[4 * row + axis] * (1.0 + gamma(roundings_of_t));
        // The error of x0 + u, multiplied by T.
        let propagated: f64 = (0..3).map(|axis| entry(axis) * sum_error[axis]).sum();
        let row_magnitude: f64 = (0..3).map(|axis| entry(axis) * (magnitude[axis] + sum_error[axis])).sum();
        // Underflow in the entries of T, if T is a product.
        let underflow: f64 =
            magnitude.iter().map(|magnitude| roundings_of_t as f64 * MAX_UNDERFLOW_ERROR * (1.0 + magnitude)).sum();
        // A term of the row has up to four roundings: one product and three additions. Each of them may underflow.
        propagated
            + gamma(4 + roundings_of_t) * (row_magnitude + absolute_transform[4 * row + 3])
            + 4.0 * MAX_UNDERFLOW_ERROR
            + underflow
    };
    (0..3).map(|row| row_bound(row).powi(2)).sum::<f64>().sqrt()
}

fn condition_number(sum: &ModalSum) -> f64 {
    let norm = |vector: &[f64; 3]| vector.iter().map(|number| number * number).sum::<f64>().sqrt();
    match (norm(&sum.magnitude), norm(&sum.u)) {
        (0.0, _) => 0.0,
        (magnitude, u) => magnitude / u,
    }
}

/// A tile of vertices of one domain, and the part of the output that holds its values.
struct Tile<'a, T> {
    domain: usize,
    vertices: Range<usize>,
    out: &'a mut [T],
}

/// Values of all vertices in packed order, computed tile by tile on all cores. `compute` receives a domain, its
/// vertices in the tile, and their values, which are `initial` at first.
fn map_tiles<T: Copy + Send + Sync>(
    scene: &Scene,
    initial: T,
    compute: impl Fn(usize, Range<usize>, &mut [T]) + Sync,
) -> Vec<T> {
    let mut values: Vec<T> = rayon::iter::repeat_n(initial, scene.layout.vertices).collect();
    let (mut tiles, mut remaining): (Vec<Tile<'_, T>>, _) = (Vec::new(), values.as_mut_slice());
    for (domain, domain_layout) in scene.layout.domains.iter().enumerate() {
        for first in (0..domain_layout.vertices).step_by(TILE) {
            let vertices = first..domain_layout.vertices.min(first + TILE);
            let (out, rest) = std::mem::take(&mut remaining).split_at_mut(vertices.len());
            tiles.push(Tile { domain, vertices, out });
            remaining = rest;
        }
    }
    // 32 tiles share a task, because scheduling a task for one small domain takes longer than computing its vertices.
    let compute_tile = |tile: &mut Tile<'_, T>| compute(tile.domain, tile.vertices.clone(), tile.out);
    tiles.par_chunks_mut(32).for_each(|tiles| tiles.iter_mut().for_each(compute_tile));
    values
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::WorkloadMotion;
    use crate::workloads::{Size, Workload, WorkloadKind};
    use modalcast_model::deform::Deformer as _;

    fn workloads() -> Vec<Workload> {
        [WorkloadKind::ManyDomains, WorkloadKind::TinyDomains, WorkloadKind::Cancelling, WorkloadKind::Plant(1)]
            .map(|kind| kind.build(Size::Quick).expect("expected a workload"))
            .into()
    }

    #[test]
    fn positions_match_the_reference_deformer() {
        for workload in workloads() {
            let state = WorkloadMotion::new(&workload, None).random_state(0).state();
            let want = modalcast_compute::reference::deform(&workload.scene, &state);
            let got = positions(&workload.scene, &ExactState::of(&state), None);
            let differences = want.as_flattened().iter().zip(got.as_flattened()).map(|(want, got)| (want - got).abs());
            assert_eq!(want.len(), got.len());
            // f64 sums in another order differ by a few roundings of 1e-16.
            assert!(
                differences.fold(0.0, f64::max) <= 1e-14 * workload.scene.rest_bounds.diagonal(),
                "{}",
                workload.name
            );
        }
    }

    #[test]
    fn f32_error_stays_within_bound_and_bound_is_not_loose() {
        for workload in workloads() {
            let motion = WorkloadMotion::new(&workload, None);
            let mut cpu = modalcast_compute::cpu::CpuDeformer::new(&workload.scene);
            let mut max_of_bound = 0.0_f64;
            for seed in 0..4 {
                let state = motion.random_state(seed).state();
                cpu.deform(&state).expect("expected a deformation");
                let surface = &cpu.surface().expect("expected a surface").positions;
                for (got, want) in surface.as_chunks::<3>().0.iter().zip(reference_vertices(&workload.scene, &state)) {
                    let squared_error: f64 =
                        got.iter().zip(want.position).map(|(got, want)| (f64::from(*got) - want).powi(2)).sum();
                    max_of_bound = max_of_bound.max(squared_error.sqrt() / want.bound);
                }
            }
            // Below 0.01, the bound would be more than 100 times the largest error.
            assert!((0.01..=1.0).contains(&max_of_bound), "{}: {max_of_bound}", workload.name);
        }
    }

    #[test]
    fn cancelling_sums_have_large_or_infinite_condition() {
        let workload = WorkloadKind::Cancelling.build(Size::Quick).expect("built");
        let motion = WorkloadMotion::new(&workload, None);
        let median_condition = |seed: usize| {
            let references = reference_vertices(&workload.scene, &motion.random_state(seed).state());
            let mut conditions: Vec<f64> = references.iter().map(|reference| reference.condition).collect();
            conditions.sort_by(f64::total_cmp);
            conditions[conditions.len() / 2]
        };
        // Displacements cancel in random states of odd seeds only.
        assert!(
            median_condition(1) > 1e3 && median_condition(0) < 100.0,
            "{} {}",
            median_condition(1),
            median_condition(0)
        );
        let vanishing = ModalSum { u: [0.0; 3], magnitude: [1.0, 0.0, 0.0] };
        assert_eq!((condition_number(&vanishing), condition_number(&ModalSum::default())), (f64::INFINITY, 0.0));
    }

    #[test]
    fn repeats_cancelling_sum_in_double_double() {
        let columns = vec![1.0, 1.0, 1.0, 2f32.powi(-30), 0.0, 0.0, -1.0, -1.0, -1.0];
        let modes = Modes::from_columns(3, 3, columns).expect("valid modes");
        // The first row is 1e10 + 2^-30 - 1e10. f64 has 53 bits, and 2^-30 is 63 binary places below 1e10.
        let sums = sum_modes(0..1, ModeEntries::Exact(&modes), &[1e10, 1.0, 1e10]);
        assert_eq!(sums[0].u, [2f64.powi(-30), 0.0, 0.0]);
    }
}
