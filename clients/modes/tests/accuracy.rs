//! Frequencies of solids against exact references: free isotropic solids by the Rayleigh-Ritz method with polynomials
//! (Demarest 1971; Visscher et al. 1991), E = 1e6 Pa, nu = 0.3, rho = 1000 kg/m3.

mod solids;

use modalcast_modes::modeling::to_hertz;
use solids::{BOX, CYLINDER, ELLIPSOID, SPHERE, compute, cylinder, ellipsoid, parameters, rotated, solid_box};

/// The largest relative difference to the reference frequencies.
fn worst_difference(eigenvalues: &[f64], reference: &[f64]) -> f64 {
    assert!(eigenvalues.len() >= reference.len(), "{} modes", eigenvalues.len());
    let frequencies = eigenvalues.iter().map(|eigenvalue| to_hertz(*eigenvalue));
    let differences = frequencies.zip(reference).map(|(frequency, reference)| (frequency / reference - 1.0).abs());
    // The maximum of f64 ignores values that are no numbers.
    differences.fold(0.0, |largest, difference| if difference <= largest { largest } else { difference })
}

#[test]
fn rotated_box_has_the_exact_frequencies() {
    let modeling = compute(&rotated(solid_box([1.0, 0.7, 0.4]), 1), &parameters(6000, 10));
    let difference = worst_difference(&modeling.eigenvalues, &BOX[..10]);
    assert!(
        difference < 0.005,
        "{difference}: {:?}",
        modeling.eigenvalues.iter().map(|v| to_hertz(*v)).collect::<Vec<_>>()
    );
    assert_eq!(modeling.rigid_modes, 6);
    assert!((modeling.mass - 280.0).abs() < 0.5, "{}", modeling.mass);
    let worst_estimate = modeling.frequency_errors.iter().copied().fold(0.0, f64::max);
    assert!(modeling.frequency_errors.len() == 10 && worst_estimate < 0.03, "{worst_estimate}");
    let control = worst_difference(&modeling.eigenvalues, &ELLIPSOID[..10]);
    assert!(control > 0.1, "control: {control}");
}

#[test]
fn rotated_ellipsoid_has_the_exact_frequencies() {
    let modeling = compute(&rotated(ellipsoid([0.5, 0.35, 0.2], 60), 2), &parameters(6000, 10));
    let difference = worst_difference(&modeling.eigenvalues, &ELLIPSOID[..10]);
    assert!(difference < 0.005, "{difference}");
}

/// All copies of repeated frequencies are found: clusters of 5, 5, 3 and 7 modes.
#[test]
fn sphere_has_complete_clusters() {
    let modeling = compute(&rotated(ellipsoid([0.5; 3], 40), 3), &parameters(6000, 20));
    assert!(worst_difference(&modeling.eigenvalues, &SPHERE) < 0.01, "{:?}", modeling.eigenvalues);
    let mut first = 0;
    for count in [5, 5, 3, 7] {
        let cluster = &modeling.eigenvalues[first..first + count];
        let spread = (cluster[count - 1] / cluster[0]).sqrt() - 1.0;
        assert!(spread < 0.003, "{}: spread {spread}", SPHERE[first]);
        first += count;
    }
}

#[test]
fn cylinder_has_the_exact_frequencies() {
    let modeling = compute(&rotated(cylinder(0.25, 1.0, 96), 4), &parameters(6000, 9));
    let difference = worst_difference(&modeling.eigenvalues, &CYLINDER[..9]);
    assert!(difference < 0.005, "{difference}");
}

/// A plate much thinner than a cell. Reference: 1 x 0.6 x 0.01 m.
#[test]
fn thin_plate_has_the_exact_frequencies() {
    for rotation in [0, 5] {
        let modeling = compute(&rotated(solid_box([1.0, 0.6, 0.01]), rotation), &parameters(6000, 8));
        let difference = worst_difference(&modeling.eigenvalues, &solids::PLATE);
        let frequencies: Vec<f64> = modeling.eigenvalues.iter().map(|v| to_hertz(*v)).collect();
        assert!(difference < 0.025, "rotation {rotation}: {difference}: {frequencies:?}");
    }
}

/// 5 % of the triangles are deleted and 1 % are turned over.
#[test]
fn damaged_surfaces_have_the_frequencies_of_closed_ones() {
    let clean = rotated(ellipsoid([0.5, 0.35, 0.2], 50), 6);
    let expected: Vec<f64> =
        compute(&clean, &parameters(4000, 10)).eigenvalues.iter().map(|eigenvalue| to_hertz(*eigenvalue)).collect();
    for seed in 0..2 {
        let modeling = compute(&solids::damaged(clean.clone(), seed), &parameters(4000, 10));
        let difference = worst_difference(&modeling.eigenvalues, &expected);
        assert!(difference < 0.01, "seed {seed}: {difference}");
        assert!(modeling.remarks.iter().any(|remark| remark.contains("not closed")), "{:?}", modeling.remarks);
    }
}
