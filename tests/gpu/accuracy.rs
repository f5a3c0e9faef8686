//! Comparisons with the f64 twin. They are written such that a NaN cannot pass.

use modalcast_compute::gpu::CudaDeformer;
use modalcast_compute::reference::{rigid_normals, rigid_tangents};
use modalcast_model::deform::{DeformSummary, Deformer};
use modalcast_model::scene::{Bounds, Scene, SceneState};

/// Largest accepted error of a position, relative to the scene's diagonal.
pub(crate) const POSITION: f64 = 1e-5;
/// Largest accepted error of a component of a unit vector.
pub(crate) const DIRECTION: f64 = 1e-5;

/// The largest error, or a description of the first number that exceeds `limit`. The limit is absolute.
pub(crate) fn largest_error<const N: usize>(got: &[f32], want: &[[f64; N]], limit: f64) -> Result<f64, String> {
    let want = want.as_flattened();
    if got.len() != want.len() {
        return Err(format!("{} numbers, expected {}", got.len(), want.len()));
    }
    let mut largest = 0.0_f64;
    for (index, (got, want)) in got.iter().zip(want).enumerate() {
        let error = (f64::from(*got) - want).abs();
        let close = error <= limit;
        if !close {
            return Err(format!("[{}] component {} is {got}, expected {want} within {limit}", index / N, index % N));
        }
        largest = largest.max(error);
    }
    Ok(largest)
}

/// Deforms a state and compares positions, bounds, normals and tangents with the twin.
pub(crate) fn check(name: &str, scene: &Scene, state: &SceneState, deformer: &mut CudaDeformer) -> DeformSummary {
    let deformed = deformer.deform(state).expect("deforms");
    let surface = deformer.surface().expect("copies");
    let want = modalcast_compute::reference::deform(scene, state);
    let mut bounds = Bounds::EMPTY;
    want.iter().for_each(|position| bounds.include(*position));
    let diagonal = bounds.diagonal().max(f64::from(f32::MIN_POSITIVE));
    let position =
        largest_error(&surface.positions, &want, POSITION * diagonal).unwrap_or_else(|e| panic!("{name}: {e}"));
    let normal = largest_error(&surface.normals, &rigid_normals(scene, state), DIRECTION)
        .unwrap_or_else(|error| panic!("{name}: normal {error}"));
    let tangent = largest_error(&surface.tangents, &rigid_tangents(scene, state), DIRECTION)
        .unwrap_or_else(|error| panic!("{name}: tangent {error}"));
    assert_eq!(deformed.bounds, bounds_of(&surface.positions), "{name}: bounds are those of the positions");
    eprintln!(
        "{name}: position {:.2e} of the diagonal, normal {normal:.2e}, tangent {tangent:.2e}",
        position / diagonal
    );
    deformed
}

fn bounds_of(positions: &[f32]) -> Bounds {
    let mut bounds = Bounds::EMPTY;
    for position in positions.chunks_exact(3) {
        bounds.include([0, 1, 2].map(|axis| f64::from(position[axis])));
    }
    bounds
}

/// Whether two lists are equal bit by bit.
pub(crate) fn same_bits(got: &[f32], want: &[f32]) -> bool {
    got.len() == want.len() && got.iter().zip(want).all(|(got, want)| got.to_bits() == want.to_bits())
}

#[test]
fn judge_refuses_wrong_missing_and_non_finite_numbers() {
    let want = [[1.0, 2.0], [3.0, 4.0]];
    assert_eq!(largest_error(&[1.0, 2.0, 3.0, 4.0], &want, 1e-5), Ok(0.0));
    let slightly_off = largest_error(&[1.0, 2.0, 3.0, 4.000_005], &want, 1e-5).expect("within the limit");
    assert!(slightly_off > 1e-6);
    let wrong: [&[f32]; 7] = [
        &[1.0, 2.0, 3.0, 4.1],
        &[1.0, 2.0, 4.0, 3.0],
        &[1.0, 2.0, 3.0, f32::NAN],
        &[f32::INFINITY, 2.0, 3.0, 4.0],
        &[1.0, 2.0, 3.0],
        &[1.0, 2.0, 3.0, 4.0, 5.0],
        &[],
    ];
    for got in wrong {
        assert!(largest_error(got, &want, 1e-5).is_err(), "{got:?} passed");
    }
    assert!(largest_error(&[1.0], &[[f64::NAN]], 1e-5).is_err(), "a NaN is not near anything");
    assert!(same_bits(&[0.0], &[0.0]));
    assert!(!same_bits(&[0.0], &[-0.0]));
    assert!(!same_bits(&[0.0], &[]));
}
