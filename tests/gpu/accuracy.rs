//! Comparisons with the f64 reference. A comparison with a NaN always fails.

use modalcast_compute::gpu::CudaDeformer;
use modalcast_compute::reference::{rigid_normals, rigid_tangents};
use modalcast_model::deform::{DeformSummary, Deformer};
use modalcast_model::scene::{BoundingBox, Scene, SceneState};

/// Largest accepted error of a position, relative to the scene's diagonal: the guarantee in README.md.
pub(crate) const MAX_POSITION_ERROR: f64 = 1e-5;
/// Largest accepted error of a component of a unit vector: a normal or a tangent.
pub(crate) const MAX_DIRECTION_ERROR: f64 = 1e-5;

/// The largest absolute error, or a description of the first number whose error exceeds `limit`.
pub(crate) fn max_error<const N: usize>(got: &[f32], want: &[[f64; N]], limit: f64) -> Result<f64, String> {
    let want = want.as_flattened();
    if got.len() != want.len() {
        return Err(format!("expected {} numbers, got {}", want.len(), got.len()));
    }
    let mut max = 0.0_f64;
    for (index, (got, want)) in got.iter().zip(want).enumerate() {
        let error = (f64::from(*got) - want).abs();
        let is_close = error <= limit;
        if !is_close {
            let (vector, component) = (index / N, index % N);
            return Err(format!("[{vector}] component {component}: expected {want} within {limit}, got {got}"));
        }
        max = max.max(error);
    }
    Ok(max)
}

/// Deforms a state and asserts that positions, bounds, normals and tangents equal those of the reference.
pub(crate) fn assert_equals_reference(
    name: &str,
    scene: &Scene,
    state: &SceneState,
    deformer: &mut CudaDeformer,
) -> DeformSummary {
    let summary = deformer.deform(state).expect("expected the step to succeed");
    let surface = deformer.surface().expect("expected a surface");
    let reference_positions = modalcast_compute::reference::deform(scene, state);
    let mut bounds = BoundingBox::EMPTY;
    reference_positions.iter().for_each(|position| bounds.include(*position));
    // At least the smallest normal f32, so that the tolerance of a scene of one point is not 0.
    let diagonal = bounds.diagonal().max(f64::from(f32::MIN_POSITIVE));
    let position_error = max_error(&surface.positions, &reference_positions, MAX_POSITION_ERROR * diagonal)
        .unwrap_or_else(|error| panic!("{name}: {error}"));
    let normal_error = max_error(&surface.normals, &rigid_normals(scene, state), MAX_DIRECTION_ERROR)
        .unwrap_or_else(|error| panic!("{name}: normal {error}"));
    let tangent_error = max_error(&surface.tangents, &rigid_tangents(scene, state), MAX_DIRECTION_ERROR)
        .unwrap_or_else(|error| panic!("{name}: tangent {error}"));
    assert_eq!(summary.bounds, bounds_of(&surface.positions), "{name}: expected the bounds of the positions");
    eprintln!(
        "{name}: error of positions {:.2e} of the diagonal, of normals {normal_error:.2e}, of tangents {tangent_error:.2e}",
        position_error / diagonal
    );
    summary
}

fn bounds_of(positions: &[f32]) -> BoundingBox {
    let mut bounds = BoundingBox::EMPTY;
    for position in positions.chunks_exact(3) {
        bounds.include([0, 1, 2].map(|axis| f64::from(position[axis])));
    }
    bounds
}

/// Whether two lists are equal bit by bit.
pub(crate) fn have_equal_bits(got: &[f32], want: &[f32]) -> bool {
    got.len() == want.len() && got.iter().zip(want).all(|(got, want)| got.to_bits() == want.to_bits())
}

#[test]
fn max_error_rejects_wrong_missing_and_non_finite_numbers() {
    let want = [[1.0, 2.0], [3.0, 4.0]];
    assert_eq!(max_error(&[1.0, 2.0, 3.0, 4.0], &want, 1e-5), Ok(0.0));
    let small_error = max_error(&[1.0, 2.0, 3.0, 4.000_005], &want, 1e-5).expect("an error within the limit");
    assert!(small_error > 1e-6);
    let wrong_lists: [&[f32]; 7] = [
        &[1.0, 2.0, 3.0, 4.1],
        &[1.0, 2.0, 4.0, 3.0],
        &[1.0, 2.0, 3.0, f32::NAN],
        &[f32::INFINITY, 2.0, 3.0, 4.0],
        &[1.0, 2.0, 3.0],
        &[1.0, 2.0, 3.0, 4.0, 5.0],
        &[],
    ];
    for got in wrong_lists {
        assert!(max_error(got, &want, 1e-5).is_err(), "expected an error for {got:?}");
    }
    assert!(max_error(&[1.0], &[[f64::NAN]], 1e-5).is_err(), "expected a NaN in the reference to fail");
    assert!(have_equal_bits(&[0.0], &[0.0]));
    assert!(!have_equal_bits(&[0.0], &[-0.0]));
    assert!(!have_equal_bits(&[0.0], &[]));
}
