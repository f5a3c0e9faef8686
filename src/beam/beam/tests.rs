use std::f64::consts::TAU;

use nalgebra::{Matrix3, Rotation3};

use super::*;
use crate::frame_model::FrameModel;
use crate::testing::{WOOD, curved_beam, eigen_residuals};

/// A rigid body about its joint: 0.3 kg, off its joint.
fn carried_body() -> RigidInertia {
    let center = Vector3::new(0.05, -0.08, 0.11);
    let tensor = Matrix3::new(2e-3, 1e-4, -2e-4, 1e-4, 3e-3, 3e-4, -2e-4, 3e-4, 1.5e-3);
    RigidInertia::body(0.3, Vector3::zeros(), tensor).seen_from(&Rotation3::identity(), &center)
}

fn hertz(modes: &BeamModes) -> Vec<f64> {
    modes.eigenvalues.iter().map(|eigenvalue| eigenvalue.sqrt() / TAU).collect()
}

fn straight(length: f64, radius: f64, material: ElasticConstants) -> Beam {
    let points = [Vector3::zeros(), Rotation3::from_euler_angles(0.4, 0.9, -1.3) * Vector3::new(0.0, length, 0.0)];
    Beam::along(&points, &[radius; 2], material, 24).expect("a valid beam")
}

#[test]
fn modes_solve_the_eigenproblem_at_every_slenderness() {
    // The ratio of length to diameter at the base. The length is about 1 m.
    for slenderness in [1.0, 10.0, 60.0, 2000.0] {
        for (bend, taper) in [(0.0, 1.0), (0.0, 0.1), (1.2, 1.0), (1.2, 0.1)] {
            let radius = 0.5 / slenderness;
            let mut beam = curved_beam(14, [radius, radius * taper], bend, WOOD);
            let mass = beam.element_mass();
            beam.carry(Station { element: 7, fraction: 0.25 }, RigidInertia::point_mass(0.3 * mass));
            beam.carry(
                Station { element: 13, fraction: 1.0 },
                RigidInertia::from_matrix(carried_body().matrix() * (mass / 0.3)),
            );
            let modes = beam.solve_modes(12).expect("a converged solution");
            let (residual, gram_error) = eigen_residuals(&beam, &modes);
            let case =
                format!("1:{slenderness}, bend {bend}, taper {taper}: residual {residual}, Gram error {gram_error}");
            assert!(residual <= 1e-6, "{case}");
            assert!(gram_error <= 1e-6, "{case}");
            assert!(modes.eigenvalues.windows(2).all(|pair| pair[0] <= pair[1] && pair[0] > 0.0), "{case}");
        }
    }
}

#[test]
fn residuals_detect_a_wrong_eigenvalue_or_shape() {
    let beam = curved_beam(10, [0.02, 0.01], 0.6, WOOD);
    let mut modes = beam.solve_modes(4).expect("a converged solution");
    modes.eigenvalues[2] *= 1.0 + 1e-4;
    assert!(eigen_residuals(&beam, &modes).0 > 1e-5);
    modes = beam.solve_modes(4).expect("a converged solution");
    modes.mode_shapes[(20, 1)] *= 1.001;
    let (residual, gram_error) = eigen_residuals(&beam, &modes);
    assert!(residual > 1e-6 && gram_error > 1e-9, "{residual} {gram_error}");
}

#[test]
fn uniform_cantilever_has_its_analytic_frequencies() {
    for radius in [0.0005, 0.00025] {
        let beam = straight(1.0, radius, WOOD);
        let modes = beam.solve_modes(6).expect("a converged solution");
        let base_frequency = (WOOD.youngs_modulus / WOOD.density).sqrt() * 0.5 * radius;
        // Roots of cos x cosh x = -1. Each bending mode occurs twice, once per plane.
        let roots = [1.875_104, 1.875_104, 4.694_091, 4.694_091, 7.854_757, 7.854_757];
        for (eigenvalue, root) in modes.eigenvalues.iter().zip(roots) {
            let expected = root * root * base_frequency;
            assert!((eigenvalue.sqrt() / expected - 1.0).abs() <= 5e-4, "{expected} rad/s, got {}", eigenvalue.sqrt());
        }
    }
}

#[test]
fn thick_cantilever_is_slower_than_a_slender_one() {
    // 1 m long and 0.1 m thick. Timoshenko theory: the first frequency solves a transcendental equation. Here it comes
    // from a fine frame.
    let beam = straight(1.0, 0.1, WOOD);
    let frequencies = hertz(&beam.solve_modes(4).expect("a converged solution"));
    let nodes: Vec<_> =
        (0..=160).map(|index| beam.nodes()[0].lerp(&beam.nodes()[24], f64::from(index) / 160.0)).collect();
    let expected = FrameModel::new(&nodes, &[0.1; 160], &WOOD).frequencies(4);
    for (actual, expected) in frequencies.iter().zip(&expected) {
        assert!((actual / expected - 1.0).abs() < 2e-3, "{frequencies:?} {expected:?}");
    }
    // Counterexample: without shear and rotary inertia, the frequency is much higher.
    let slender = 1.875_104_f64.powi(2) * (WOOD.youngs_modulus / WOOD.density).sqrt() * 0.05 / TAU;
    assert!(slender > 1.1 * frequencies[0], "{slender} {}", frequencies[0]);
}

#[test]
fn torsion_of_a_shaft_has_its_analytic_frequency() {
    let soft_constants = ElasticConstants { shear_modulus: 1e5, ..WOOD };
    let beam = straight(1.0, 0.05, soft_constants);
    let modes = beam.solve_modes(8).expect("a converged solution");
    let rotation = |mode: usize| modes.mode_shapes.fixed_view::<3, 1>(6 * 24 + 3, mode).norm();
    let translation = |mode: usize| modes.mode_shapes.fixed_view::<3, 1>(6 * 24, mode).norm();
    let twisting = (0..8).find(|mode| translation(*mode) < 1e-6 * rotation(*mode)).expect("a twisting mode");
    // A shaft of length 1 that is clamped at one end: omega = pi / 2 sqrt(G / rho).
    let expected = std::f64::consts::FRAC_PI_2 * (soft_constants.shear_modulus / soft_constants.density).sqrt();
    let omega = modes.eigenvalues[twisting].sqrt();
    assert!((omega / expected - 1.0).abs() <= 1e-3, "expected {expected} rad/s, got {omega}");
}

#[test]
fn static_tip_deflection_has_its_textbook_value() {
    // Slender, stub of 2 cm with 1 cm radius, twig of 0.38 m with 2 mm radius.
    for (length, radius) in [(1.0, 0.01), (0.02, 0.01), (0.38, 0.002)] {
        let beam = straight(length, radius, WOOD);
        let tip = Station { element: 23, fraction: 1.0 };
        let axis = (beam.nodes()[24] - beam.nodes()[0]).normalize();
        let across = axis.cross(&Vector3::x()).normalize();
        let solve = |force: Vector3<f64>, moment: Vector3<f64>| {
            let wrench = Vector6::from_fn(|row, _| if row < 3 { force[row] } else { moment[row - 3] });
            beam.section_motion(&beam.solve_static(tip, &wrench).expect("a stiff beam"), tip)
        };
        let (area, moment) = (std::f64::consts::PI * radius * radius, std::f64::consts::FRAC_PI_4 * radius.powi(4));
        let (e, g) = (WOOD.youngs_modulus, WOOD.shear_modulus);
        let bending = length.powi(3) / (3.0 * e * moment) + length / (0.9 * g * area);
        for (actual, expected) in [
            (solve(across, Vector3::zeros()).translation.dot(&across), bending),
            (solve(axis, Vector3::zeros()).translation.dot(&axis), length / (e * area)),
            (solve(Vector3::zeros(), axis).rotation.dot(&axis), length / (2.0 * g * moment)),
            (solve(Vector3::zeros(), across).rotation.dot(&across), length / (e * moment)),
        ] {
            assert!(
                (actual / expected - 1.0).abs() < 1e-6,
                "{length} m, {radius} m: expected {expected}, got {actual}"
            );
        }
    }
}

#[test]
fn strip_bends_across_its_plane() {
    let profile = Profile::Strip { widths: [0.02; 2], thickness: 5e-4, normal: Vector3::new(0.3, 0.0, 1.0) };
    let nodes: Vec<_> = (0..=12).map(|index| Vector3::new(0.0, 0.01 * f64::from(index), 0.0)).collect();
    let beam = Beam::new(nodes, vec![BeamElement { profile, material: WOOD }; 12]).expect("a valid beam");
    let modes = beam.solve_modes(1).expect("a converged solution");
    let expected = 1.875_104_f64.powi(2) * (WOOD.youngs_modulus / WOOD.density / 12.0).sqrt() * 5e-4 / 0.12_f64.powi(2);
    assert!((modes.eigenvalues[0].sqrt() / expected - 1.0).abs() < 2e-3);
    let tip = modes.mode_shapes.fixed_view::<3, 1>(72, 0).into_owned();
    assert!(tip.normalize().dot(&Vector3::new(0.3, 0.0, 1.0).normalize()).abs() > 1.0 - 1e-9, "{tip}");
}

#[test]
fn beam_with_a_heavy_tip_behaves_like_a_spring() {
    let mut beam = curved_beam(12, [0.002; 2], 0.0, WOOD);
    let tip_mass = 1000.0 * beam.element_mass();
    beam.carry(Station { element: 11, fraction: 1.0 }, RigidInertia::point_mass(tip_mass));
    // The tip stiffness of a cantilever of length 1: 3 E I.
    let expected_stiffness = 3.0 * WOOD.youngs_modulus * std::f64::consts::FRAC_PI_4 * 0.002_f64.powi(4);
    let eigenvalue = beam.solve_modes(1).expect("a converged solution").eigenvalues[0];
    assert!((eigenvalue * tip_mass / expected_stiffness - 1.0).abs() < 1e-3, "{eigenvalue}");
}

/// The station of a node of a frame with `parts` elements per element of a beam of 28 elements.
fn fine_station(index: usize, parts: usize) -> Station {
    let element = (index / parts).min(27);
    Station { element, fraction: (index - element * parts) as f64 / parts as f64 }
}

/// A tapered curved beam with bodies, and the same beam as a fine frame.
fn beam_and_frame(radii: [f64; 2], with_bodies: bool) -> (Beam, FrameModel) {
    const PARTS: usize = 5;
    let mut beam = curved_beam(28, radii, 1.2, WOOD);
    let nodes: Vec<_> = (0..=28 * PARTS).map(|index| beam.center(fine_station(index, PARTS))).collect();
    let radius = |index: usize| radii[0] + (radii[1] - radii[0]) * (index as f64 + 0.5) / (28 * PARTS) as f64;
    let fine_radii: Vec<f64> = (0..28 * PARTS).map(radius).collect();
    let mut frame = FrameModel::new(&nodes, &fine_radii, &WOOD);
    if with_bodies {
        let body = RigidInertia::from_matrix(carried_body().matrix() * (beam.element_mass() / 0.3));
        beam.carry(Station { element: 27, fraction: 1.0 }, body);
        beam.carry(Station { element: 11, fraction: 0.0 }, body);
        frame.add_body(28 * PARTS, &body);
        frame.add_body(11 * PARTS, &body);
    }
    (beam, frame)
}

#[test]
fn frequencies_agree_with_a_fine_frame() {
    for (radii, with_bodies) in [([0.02, 0.01], false), ([0.02, 0.01], true), ([0.2, 0.1], true)] {
        let (beam, frame) = beam_and_frame(radii, with_bodies);
        let actual = hertz(&beam.solve_modes(12).expect("a converged solution"));
        let expected = frame.frequencies(12);
        let errors: Vec<f64> = actual.iter().zip(&expected).map(|(actual, expected)| actual / expected - 1.0).collect();
        assert!(errors.iter().all(|error| error.abs() <= 5e-3), "{radii:?} {with_bodies}: {errors:.4?}");
    }
    // Counterexample: the frame without the bodies has other frequencies.
    let actual = beam_and_frame([0.02, 0.01], true).0.solve_modes(1).expect("a converged solution");
    let expected = beam_and_frame([0.02, 0.01], false).1.frequencies(1);
    assert!((hertz(&actual)[0] / expected[0] - 1.0).abs() > 0.1);
}

/// Integrates the products of section velocities over the beam and adds `bodies`: V^T M V for motions V whose section
/// motions are the columns of `motions(station)` (6 x r).
fn integrate(
    beam: &Beam,
    bodies: &[(Station, RigidInertia)],
    motions: impl Fn(Station) -> Matrix6xX<f64>,
) -> DMatrix<f64> {
    const POINTS: usize = 400;
    let product = |inertia: &RigidInertia, motions: &Matrix6xX<f64>| {
        DMatrix::from_iterator(
            motions.ncols(),
            motions.ncols(),
            (motions.transpose() * inertia.matrix() * motions).iter().copied(),
        )
    };
    let count = motions(Station { element: 0, fraction: 0.0 }).ncols();
    let mut sum = DMatrix::zeros(count, count);
    for (index, element) in beam.elements().iter().enumerate() {
        let axis = beam.nodes()[index + 1] - beam.nodes()[index];
        let Profile::Cone { radii } = element.profile else { panic!("expected a cone") };
        for point in 0..POINTS {
            let fraction = (point as f64 + 0.5) / POINTS as f64;
            let radius = radii[0] + (radii[1] - radii[0]) * fraction;
            let mass = element.material.density * std::f64::consts::PI * radius * radius * axis.norm() / POINTS as f64;
            let tangent = axis.normalize();
            let tensor = (Matrix3::identity() + tangent * tangent.transpose()) * (0.25 * mass * radius * radius);
            let slice = RigidInertia::body(mass, Vector3::zeros(), tensor);
            sum += product(&slice, &motions(Station { element: index, fraction }));
        }
    }
    bodies.iter().fold(sum, |sum, (station, body)| sum + product(body, &motions(*station)))
}

/// The six rigid motions about the origin, as motions of the section at a station.
fn rigid_motions(beam: &Beam, station: Station) -> Matrix6xX<f64> {
    let mut motions = Matrix6xX::identity(6);
    motions.fixed_view_mut::<3, 3>(0, 3).copy_from(&-beam.center(station).cross_matrix());
    motions
}

#[test]
fn inertia_is_the_integral_over_all_sections() {
    let mut beam = curved_beam(9, [0.03, 0.02], 1.1, WOOD);
    let own = (Station { element: 4, fraction: 0.3 }, carried_body());
    beam.add_own_body(own.0, own.1);
    let carried = (Station { element: 8, fraction: 1.0 }, carried_body());
    beam.carry(carried.0, carried.1);
    let modes = beam.solve_modes(7).expect("a converged solution");
    // Rigid motions and modes side by side.
    let motions = |station: Station| {
        let mut motions = rigid_motions(&beam, station).resize_horizontally(13, 0.0);
        motions.columns_mut(6, 7).copy_from(&beam.section_motions(&modes, station));
        motions
    };
    let own_mass = integrate(&beam, &[own], motions);
    let mut actual = DMatrix::zeros(13, 13);
    let ModalInertia { momenta, masses } = beam.modal_inertia(&modes);
    actual.view_mut((0, 0), (6, 6)).copy_from(beam.rigid_inertia().matrix());
    actual.view_mut((0, 6), (6, 7)).copy_from(&momenta);
    actual.view_mut((6, 0), (7, 6)).copy_from(&momenta.transpose());
    actual.view_mut((6, 6), (7, 7)).copy_from(&masses);
    // Relative to the diagonal, because masses and moments have different units.
    let error = |expected: &DMatrix<f64>| {
        let entry = |row: usize, column: usize| {
            (actual[(row, column)] - expected[(row, column)]).abs()
                / (expected[(row, row)] * expected[(column, column)]).sqrt()
        };
        (0..169).map(|index| entry(index / 13, index % 13)).fold(0.0, f64::max)
    };
    assert!(error(&own_mass) < 2e-5, "{}", error(&own_mass));
    // Counterexample: with the carried body, it is another mass, for which the modes are orthonormal.
    let total = integrate(&beam, &[own, carried], motions);
    assert!(error(&total) > 1e-2);
    let gram = total.view((6, 6), (7, 7)).into_owned() - DMatrix::<f64>::identity(7, 7);
    assert!(gram.abs().max() < 1e-4, "{}", gram.abs().max());
}

#[test]
fn rigid_inertia_agrees_with_a_fine_frame() {
    let (beam, frame) = beam_and_frame([0.2, 0.1], false);
    let expected = frame.mass();
    let nodes = expected.nrows() / 6;
    let parts = (nodes - 1) / 28;
    let mut rigid = DMatrix::zeros(6 * nodes, 6);
    for node in 0..nodes {
        let motions = rigid_motions(&beam, fine_station(node, parts));
        rigid.view_mut((6 * node, 0), (6, 6)).copy_from(&motions);
    }
    let expected = rigid.tr_mul(&(expected * &rigid));
    let difference = (beam.rigid_inertia().matrix() - &expected).norm() / expected.norm();
    assert!(difference < 1e-3, "{difference}");
}

#[test]
fn rigid_nodal_motion_moves_every_section_rigidly() {
    for (beam, tolerance) in [(curved_beam(5, [0.02, 0.01], 1.1, WOOD), 1e-12), (straight(0.02, 0.01, WOOD), 1e-11)] {
        let rigid = beam.rigid_dofs();
        let motion = Vector6::new(0.3, -0.2, 0.5, -0.4, 0.25, 0.1);
        let dofs = DVector::from_column_slice((&rigid * motion).as_slice());
        let point = Vector3::new(0.3, 0.7, -0.2);
        let (translation, rotation) = (Vector3::new(0.3, -0.2, 0.5), Vector3::new(-0.4, 0.25, 0.1));
        for element in 0..beam.elements().len() {
            for fraction in [0.0, 0.137, 0.5, 0.9, 1.0] {
                let section = beam.section_motion(&dofs, Station { element, fraction });
                assert!((section.rotation - rotation).norm() < tolerance, "got rotation {}", section.rotation);
                let expected = translation + rotation.cross(&point);
                assert!((section.displacement_of(&point) - expected).norm() < tolerance);
            }
        }
        let stiffness = beam.assemble_stiffness();
        let dofs = DMatrix::from_column_slice(dofs.nrows(), 1, dofs.as_slice());
        let scale = stiffness.to_dense().abs().max();
        assert!(stiffness.multiply(&dofs).abs().max() < 1e-9 * scale);
        // Counterexample: without the rotations of the nodes, the motion needs forces.
        let mut bent = dofs.clone();
        (0..beam.nodes().len()).for_each(|node| bent.view_mut((6 * node + 3, 0), (3, 1)).fill(0.0));
        assert!(stiffness.multiply(&bent).abs().max() > 1e-6 * scale);
    }
}

#[test]
fn section_motion_is_continuous_and_follows_the_slope() {
    let beam = curved_beam(6, [0.002, 0.001], 0.8, WOOD);
    let modes = beam.solve_modes(5).expect("a converged solution");
    for column in modes.mode_shapes.column_iter() {
        let dofs = column.into_owned();
        let motion_at = |element, fraction| beam.section_motion(&dofs, Station { element, fraction });
        for node in 1..6 {
            let (before, after) = (motion_at(node - 1, 1.0), motion_at(node, 0.0));
            let magnitude = before.translation.norm() + before.rotation.norm();
            assert!((before.translation - after.translation).norm() <= 1e-9 * magnitude);
            assert!((before.rotation - after.rotation).norm() <= 1e-9 * magnitude);
        }
        // The rotation is nearly the derivative of the transverse displacement, because the beam is slender.
        let (before, after) = (motion_at(3, 0.4 - 1e-5), motion_at(3, 0.4 + 1e-5));
        let axis = beam.nodes()[4] - beam.nodes()[3];
        let (distance, tangent) = (2e-5 * axis.norm(), axis.normalize());
        let transverse = |vector: Vector3<f64>| vector - tangent * tangent.dot(&vector);
        let slope = transverse((after.translation - before.translation) / distance);
        let rotated_tangent = transverse(motion_at(3, 0.4).rotation.cross(&tangent));
        assert!((slope - rotated_tangent).norm() <= 1e-3 * slope.norm().max(1e-3), "{slope} {rotated_tangent}");
    }
}

#[test]
fn stations_outside_the_beam_are_moved_to_its_ends() {
    let beam = curved_beam(3, [0.02; 2], 0.3, WOOD);
    let center = |element, fraction| beam.center(Station { element, fraction });
    assert_eq!(center(9, 0.2), beam.nodes()[3]);
    assert_eq!(center(0, f64::NAN), beam.nodes()[0]);
    assert_eq!(center(1, 7.0), beam.nodes()[2]);
}

#[test]
fn modes_of_a_chain_of_two_beams_are_those_of_the_whole_beam() {
    // The first half carries the second half as a rigid body. The coordinates are those of both halves.
    let whole = curved_beam(24, [0.02, 0.02], 0.0, WOOD);
    let expected = hertz(&whole.solve_modes(6).expect("a converged solution"));
    let half = |nodes: &[Vector3<f64>]| Beam::new(nodes.to_vec(), whole.elements()[..nodes.len() - 1].to_vec());
    let mut parent = half(&whole.nodes()[..13]).expect("a valid beam");
    let joint = whole.nodes()[12];
    let child_nodes: Vec<_> = whole.nodes()[12..].iter().map(|node| node - joint).collect();
    let child = half(&child_nodes).expect("a valid beam");
    let tip = Station { element: 11, fraction: 1.0 };
    parent.carry(tip, child.rigid_inertia());
    let count = 12;
    // Loaded-interface modes of both halves.
    let [parent_modes, child_modes] = [&parent, &child].map(|beam| beam.solve_modes(count).expect("a solution"));
    let joint_motions = parent.section_motions(&parent_modes, tip);
    let child_inertia = child.modal_inertia(&child_modes);
    let momenta = joint_motions.tr_mul(&child_inertia.momenta);
    let mut mass = DMatrix::zeros(2 * count, 2 * count);
    let carried = joint_motions.tr_mul(&(child.rigid_inertia().matrix() * &joint_motions));
    mass.view_mut((0, 0), (count, count)).copy_from(&(parent.modal_inertia(&parent_modes).masses + carried));
    mass.view_mut((0, count), (count, count)).copy_from(&momenta);
    mass.view_mut((count, 0), (count, count)).copy_from(&momenta.transpose());
    mass.view_mut((count, count), (count, count)).copy_from(&child_inertia.masses);
    let inverse_roots: Vec<f64> = parent_modes
        .eigenvalues
        .iter()
        .chain(&child_modes.eigenvalues)
        .map(|eigenvalue| eigenvalue.sqrt().recip())
        .collect();
    let scaled = DMatrix::from_fn(2 * count, 2 * count, |row, column| {
        mass[(row, column)] * inverse_roots[row] * inverse_roots[column]
    });
    let mut actual: Vec<f64> = scaled.symmetric_eigenvalues().iter().map(|mu| mu.sqrt().recip() / TAU).collect();
    actual.sort_by(f64::total_cmp);
    for (actual, expected) in actual.iter().zip(&expected) {
        assert!((actual / expected - 1.0).abs() < 2e-3, "expected {expected} Hz, got {actual}");
    }
}

#[test]
fn invalid_beams_are_errors() {
    let beam = curved_beam(4, [0.02; 2], 0.0, WOOD);
    for material in [
        ElasticConstants { youngs_modulus: 0.0, ..WOOD },
        ElasticConstants { youngs_modulus: f64::NAN, ..WOOD },
        ElasticConstants { density: f64::INFINITY, ..WOOD },
        ElasticConstants { shear_modulus: -1.0, ..WOOD },
    ] {
        let elements = beam.elements().iter().map(|element| BeamElement { material, ..*element }).collect();
        let error = Beam::new(beam.nodes().to_vec(), elements).expect_err("an invalid material");
        assert!(error.to_string().starts_with("material: expected positive finite constants"), "{error}");
    }
    assert!(Beam::new(beam.nodes().to_vec(), vec![]).is_err());
    assert!(Beam::new(vec![Vector3::zeros(); 2], beam.elements()[..1].to_vec()).is_err());
    let modes = beam.solve_modes(0).expect("no modes");
    let inertia = beam.modal_inertia(&modes);
    assert_eq!((modes.mode_shapes.ncols(), inertia.masses.nrows(), inertia.momenta.ncols()), (0, 0, 0));
    // A beam of one element has six modes.
    let short = Beam::new(beam.nodes()[..2].to_vec(), beam.elements()[..1].to_vec()).expect("a valid beam");
    assert_eq!(short.solve_modes(99).expect("a converged solution").eigenvalues.len(), 6);
}

#[test]
fn shapes_of_extreme_size_have_modes() {
    // Length and radius in meters, down to stubs and needles, with and without a heavy body at the tip.
    for (length, radius) in [(0.02, 0.01), (0.015, 0.002), (1e-4, 1e-3), (0.38, 0.002), (30.0, 1e-4)] {
        for mass in [0.0, 1.0] {
            let mut beam = straight(length, radius, WOOD);
            beam.carry(Station { element: 23, fraction: 1.0 }, RigidInertia::point_mass(mass));
            let modes = beam.solve_modes(12).unwrap_or_else(|error| panic!("{length} {radius} {mass}: {error}"));
            assert!(modes.eigenvalues.iter().all(|eigenvalue| eigenvalue.is_finite() && *eigenvalue > 0.0));
            let (residual, gram_error) = eigen_residuals(&beam, &modes);
            // Rounding errors grow with the ratio of the eigenvalues, up to 10^8 for a heavy body, and with the ratio of
            // axial to bending stiffness, 10^11 for the longest needle.
            let tolerance = if mass > 0.0 || length > 1e5 * radius { 1e-2 } else { 1e-5 };
            assert!(residual < tolerance && gram_error < 1e-4, "{length} {radius} {mass}: {residual} {gram_error}");
        }
    }
}

#[test]
fn similar_beams_have_similar_modes() {
    // Eigenvalues go as 1 / s^2, and displacements as s^-1.5.
    let [modes, small_modes] =
        [1.0, 1e-6].map(|scale| straight(scale, 0.2 * scale, WOOD).solve_modes(6).expect("a converged solution"));
    for mode in 0..6 {
        let ratio = small_modes.eigenvalues[mode] / modes.eigenvalues[mode];
        assert!((ratio * 1e-12 - 1.0).abs() < 1e-6, "{ratio}");
        let amplitude = |modes: &BeamModes| modes.mode_shapes.fixed_view::<3, 1>(6 * 24, mode).norm();
        // Modes of twist do not displace the centerline.
        if amplitude(&modes) > 1e-6 {
            assert!((amplitude(&small_modes) / amplitude(&modes) * 1e-9 - 1.0).abs() < 1e-4);
        }
    }
}
