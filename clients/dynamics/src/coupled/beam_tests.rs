//! Beams that are divided into coupled domains, against undivided beams and frames.

use modalcast_beam::{Beam, ElasticConstants, ModalInertia, RigidInertia, Station};
use nalgebra::{DMatrix, DVector, Matrix6, Matrix6xX, Rotation3, SMatrix, Vector3, Vector6};

use super::testing::{Branch, create_scene};
use super::*;
use crate::affine::AffineTransform;
use crate::loads::DomainLoads;
use crate::model::{DomainInertia, DomainModel, Joint, Sample};

const MATERIAL: ElasticConstants = ElasticConstants { youngs_modulus: 1e7, shear_modulus: 4e6, density: 1000.0 };

/// Vertices of a section.
pub(crate) const RING: usize = 6;

/// A straight beam along y from the origin of its frame, with the frame on its parent.
#[derive(Clone, Copy)]
pub(crate) struct BeamPart {
    pub(crate) parent: Option<usize>,
    pub(crate) rotation: Rotation3<f64>,
    pub(crate) length: f64,
    pub(crate) radius: f64,
}

/// Elements of a part.
const ELEMENTS: usize = 8;

/// The radius of a round section with the bending stiffness and the mass of a square one, nearly.
fn radius_of_square(width: f64) -> f64 {
    // pi r^4 / 4 = w^4 / 12.
    width * (1.0 / (3.0 * std::f64::consts::PI)).powf(0.25)
}

fn create_beam(part: &BeamPart, elements: usize) -> Beam {
    let points = [Vector3::zeros(), Vector3::y() * part.length];
    Beam::along(&points, &[part.radius; 2], MATERIAL, elements).expect("a valid beam")
}

/// The last section of a beam.
const fn tip(elements: usize) -> Station {
    Station { element: elements - 1, fraction: 1.0 }
}

/// The scene of parts, each with `rank` loaded-interface modes. Parents precede their children, which stand on the tip
/// of the parent.
pub(crate) fn create_model(parts: &[BeamPart], rank: usize) -> Model {
    let mut beams: Vec<Beam> = parts.iter().map(|part| create_beam(part, ELEMENTS)).collect();
    // The rigid inertia of every part and its descendants about its origin.
    let mut carried = vec![RigidInertia::zero(); parts.len()];
    for index in (0..parts.len()).rev() {
        let inertia = beams[index].rigid_inertia() + carried[index];
        let Some(parent) = parts[index].parent else { continue };
        let body = inertia.seen_from(&parts[index].rotation, &Vector3::zeros());
        beams[parent].carry(tip(ELEMENTS), body);
        carried[parent] =
            carried[parent] + inertia.seen_from(&parts[index].rotation, &(Vector3::y() * parts[parent].length));
    }
    let seed = Branch { rank: 1, length: 1.0, mass: 1.0, hertz: 1.0 };
    let mut model = create_scene(&vec![seed; parts.len()], &vec![None; parts.len()], 1);
    model.coordinate_count = 0;
    for (index, (part, beam)) in parts.iter().zip(&beams).enumerate() {
        let joint = part.parent.map(|parent| {
            let translation = Vector3::y() * parts[parent].length;
            let parent_from_child = AffineTransform { linear: *part.rotation.matrix(), translation };
            Joint { parent, parent_from_child, attachment_samples: (RING * ELEMENTS..RING * (ELEMENTS + 1)).collect() }
        });
        let placement = joint.as_ref().map_or_else(AffineTransform::identity, |joint| {
            model.domains[joint.parent].placement.compose(&joint.parent_from_child)
        });
        let domain = &mut model.domains[index];
        fill_domain(domain, beam, part, rank);
        domain.first_coordinate = model.coordinate_count;
        model.coordinate_count += domain.rank;
        (domain.joint, domain.placement) = (joint, placement);
    }
    model
}

/// Sets modes, samples and mass properties of a beam.
fn fill_domain(domain: &mut DomainModel, beam: &Beam, part: &BeamPart, rank: usize) {
    let modes = beam.solve_modes(rank).expect("modes");
    domain.rank = modes.eigenvalues.len();
    domain.samples.clear();
    for section in 0..=ELEMENTS {
        let station = if section < ELEMENTS { Station { element: section, fraction: 0.0 } } else { tip(ELEMENTS) };
        let center = beam.center(station);
        for vertex in 0..RING {
            let angle = std::f64::consts::TAU * vertex as f64 / RING as f64;
            let point = center + Vector3::new(angle.cos(), 0.0, angle.sin()) * part.radius;
            let displacement = |mode: usize| {
                beam.section_motion(&modes.mode_shapes.column(mode).into_owned(), station).displacement_of(&point)
            };
            let columns: Vec<Vector3<f64>> = (0..domain.rank).map(displacement).collect();
            let mode_rows = (0..3).flat_map(|axis| columns.iter().map(move |column| column[axis])).collect();
            domain.samples.push(Sample { rest_position: point, mode_rows, part: 0 });
        }
    }
    domain.surface_sample_count = domain.samples.len();
    domain.base_sample = Some(0);
    let ModalInertia { momenta, masses } = beam.modal_inertia(&modes);
    domain.inertia = Some(DomainInertia {
        rigid: *beam.rigid_inertia().matrix(),
        coupling: momenta.column_iter().map(|column| column.into_owned()).collect(),
        modal: masses,
    });
    (domain.eigenvalues, domain.diagonal) = (modes.eigenvalues, part.length);
}

/// The frequencies of a scene in hertz, ascending, by the dense mass matrix of its coordinates.
fn frequencies(model: &Model) -> Vec<f64> {
    let tree = JointTree::new(model).expect("a valid scene");
    let parameters = ModalParameters::read(model).expect("valid parameters");
    let count = model.coordinate_count;
    let mut frames = vec![DMatrix::zeros(6, count); model.domains.len()];
    for coordinate in 0..count {
        let mut q = vec![0.0; count];
        q[coordinate] = 1.0;
        for (frame, motion) in frames.iter_mut().zip(tree.frame_motions(&q)) {
            frame.set_column(coordinate, &motion);
        }
    }
    let mut mass = DMatrix::zeros(count, count);
    for (domain, frame) in model.domains.iter().zip(&frames) {
        let inertia = domain.inertia.as_ref().expect("an inertia");
        let rotation = domain.placement.linear.transpose();
        let mut axes = Matrix6::zeros();
        [0, 3].into_iter().for_each(|start| axes.fixed_view_mut::<3, 3>(start, start).copy_from(&rotation));
        let frame = axes * frame;
        let coupling = Matrix6xX::from_columns(&inertia.coupling);
        let range = (domain.first_coordinate, domain.rank);
        let mut selection = DMatrix::zeros(domain.rank, count);
        selection.columns_mut(range.0, range.1).fill_with_identity();
        let cross = frame.transpose() * coupling * &selection;
        mass += frame.transpose() * inertia.rigid * &frame + &cross + cross.transpose();
        mass += selection.transpose() * &inertia.modal * &selection;
    }
    let stiffness = parameters.modes.iter().map(|mode| mode.expect("a mode").eigenvalue);
    let scale = DMatrix::from_diagonal(&DVector::from_iterator(count, stiffness.map(|value| value.sqrt().recip())));
    sorted_frequencies(&(&scale * mass * &scale))
}

/// The frequencies in hertz, ascending, of the matrix with the eigenvalues 1 / omega^2.
fn sorted_frequencies(matrix: &DMatrix<f64>) -> Vec<f64> {
    let eigenvalues = matrix.clone().symmetric_eigenvalues();
    let mut hertz: Vec<f64> =
        eigenvalues.iter().map(|value| value.max(1e-300).sqrt().recip() / std::f64::consts::TAU).collect();
    hertz.sort_by(f64::total_cmp);
    hertz
}

/// A chain of equal parts.
fn chain(count: usize, length: f64, radius: f64) -> Vec<BeamPart> {
    let part = |index: usize| BeamPart {
        parent: index.checked_sub(1),
        rotation: Rotation3::identity(),
        length: length / count as f64,
        radius,
    };
    (0..count).map(part).collect()
}

/// The deflection of the tip of a chain under a unit force at its tip, along x.
fn tip_deflection(model: &Model) -> f64 {
    let system = StaticSystem::new(model, &ModalParameters::read(model).expect("parameters")).expect("a scene");
    let last = model.domains.len() - 1;
    let mut loads = DomainLoads::none(model);
    let samples = &model.domains[last].samples[RING * ELEMENTS..];
    for sample in samples {
        loads.add_force(model, last, sample, &(Vector3::x() / RING as f64));
    }
    let response = system.solve(&loads);
    samples.iter().map(|sample| response.displacement(model, last, sample).x).sum::<f64>() / RING as f64
}

/// The figures of substructuring: 2, 5 and 20 domains against the undivided beam.
#[test]
fn divided_cantilever_has_the_frequencies_of_the_whole() {
    for width in [0.025, 0.1] {
        let radius = radius_of_square(width);
        let whole = create_beam(&chain(1, 1.0, radius)[0], 40);
        let modes = whole.solve_modes(12).expect("modes");
        let whole_hertz: Vec<f64> =
            modes.eigenvalues.iter().map(|value| value.sqrt() / std::f64::consts::TAU).collect();
        let force = Vector6::new(1.0, 0.0, 0.0, 0.0, 0.0, 0.0);
        let dofs = whole.solve_static(tip(40), &force).expect("a solution");
        let whole_tip = whole.section_motion(&dofs, tip(40)).translation.x;
        for count in [2, 5, 20] {
            let model = create_model(&chain(count, 1.0, radius), 6);
            let hertz = frequencies(&model);
            let errors: Vec<f64> = hertz.iter().zip(&whole_hertz).take(8).map(|(a, b)| a / b - 1.0).collect();
            let tip_error = tip_deflection(&model) / whole_tip - 1.0;
            println!("width {width}, {count} domains: errors {errors:.6?}, tip {tip_error:.2e}");
            assert!(errors[..5].iter().all(|error| error.abs() <= 5e-3), "width {width}, {count}: {errors:?}");
            assert!(tip_error.abs() <= 2e-3, "width {width}, {count} domains: {tip_error}");
        }
        // Control: without the inertia of its descendants, a domain has the modes of a clamped-free beam.
        let mut free = create_model(&chain(5, 1.0, radius), 6);
        for domain in &mut free.domains {
            let part = BeamPart { length: 0.2, ..chain(1, 1.0, radius)[0] };
            let (joint, placement, first) = (domain.joint.clone(), domain.placement, domain.first_coordinate);
            fill_domain(domain, &create_beam(&part, ELEMENTS), &part, 6);
            (domain.joint, domain.placement, domain.first_coordinate) = (joint, placement, first);
        }
        let error = frequencies(&free)[2] / whole_hertz[2] - 1.0;
        assert!(error > 1e-2, "control: {error}");
    }
}

/// K and M of an Euler-Bernoulli element along y with a round section, for the displacements and rotation vectors of
/// both ends (Przemieniecki 1968, "Theory of Matrix Structural Analysis", 5.6 and 11.3).
fn frame_element(length: f64, radius: f64) -> [SMatrix<f64, 12, 12>; 2] {
    let (area, moment) = (std::f64::consts::PI * radius.powi(2), std::f64::consts::FRAC_PI_4 * radius.powi(4));
    let (mut stiffness, mut mass) = (SMatrix::zeros(), SMatrix::zeros());
    let mut add = |indices: &[usize], k: &[f64], m: &[f64], stiffness_factor: f64, mass_factor: f64| {
        for (row, i) in indices.iter().enumerate() {
            for (column, j) in indices.iter().enumerate() {
                stiffness[(*i, *j)] += stiffness_factor * k[row * indices.len() + column];
                mass[(*i, *j)] += mass_factor * m[row * indices.len() + column];
            }
        }
    };
    let line_mass = MATERIAL.density * area;
    // Axial and torsional motions.
    let (bar_k, bar_m) = ([1.0, -1.0, -1.0, 1.0], [2.0, 1.0, 1.0, 2.0]);
    add(&[1, 7], &bar_k, &bar_m, MATERIAL.youngs_modulus * area / length, line_mass * length / 6.0);
    let polar = 2.0 * moment;
    add(&[4, 10], &bar_k, &bar_m, MATERIAL.shear_modulus * polar / length, MATERIAL.density * polar * length / 6.0);
    // Bending: the slope of the displacement along x is -(rotation about z), and that along z is the rotation about x.
    for (displacement, rotation, sign) in [(0, 5, -1.0), (2, 3, 1.0)] {
        let l = sign * length;
        let (ll, s) = (length * length, 1.0);
        let k = [
            12.0 * s,
            6.0 * l,
            -12.0 * s,
            6.0 * l, //
            6.0 * l,
            4.0 * ll,
            -6.0 * l,
            2.0 * ll, //
            -12.0 * s,
            -6.0 * l,
            12.0 * s,
            -6.0 * l, //
            6.0 * l,
            2.0 * ll,
            -6.0 * l,
            4.0 * ll,
        ];
        let m = [
            156.0,
            22.0 * l,
            54.0,
            -13.0 * l, //
            22.0 * l,
            4.0 * ll,
            13.0 * l,
            -3.0 * ll, //
            54.0,
            13.0 * l,
            156.0,
            -22.0 * l, //
            -13.0 * l,
            -3.0 * ll,
            -22.0 * l,
            4.0 * ll,
        ];
        let indices = [displacement, rotation, displacement + 6, rotation + 6];
        add(&indices, &k, &m, MATERIAL.youngs_modulus * moment / length.powi(3), line_mass * length / 420.0);
    }
    [stiffness, mass]
}

/// The frequencies of the frame of all parts with common nodes, clamped at the first one.
fn frame_frequencies(parts: &[BeamPart]) -> Vec<f64> {
    let node_count = 1 + parts.len() * ELEMENTS;
    let (mut stiffness, mut mass) =
        (DMatrix::zeros(6 * node_count, 6 * node_count), DMatrix::zeros(6 * node_count, 6 * node_count));
    let mut rotations: Vec<Rotation3<f64>> = vec![];
    for (index, part) in parts.iter().enumerate() {
        let rotation = part.parent.map_or(part.rotation, |parent| rotations[parent] * part.rotation);
        rotations.push(rotation);
        let mut axes = SMatrix::<f64, 12, 12>::zeros();
        for block in 0..4 {
            axes.fixed_view_mut::<3, 3>(3 * block, 3 * block).copy_from(rotation.matrix());
        }
        let [k, m] =
            frame_element(part.length / ELEMENTS as f64, part.radius).map(|matrix| axes * matrix * axes.transpose());
        // The last node of a part has the number of its last element; the first part begins at node 0.
        let first_node = part.parent.map_or(0, |parent| (parent + 1) * ELEMENTS);
        for element in 0..ELEMENTS {
            let end = index * ELEMENTS + element + 1;
            let start = if element == 0 { first_node } else { end - 1 };
            let dof = |local: usize| if local < 6 { 6 * start + local } else { 6 * end + local - 6 };
            for (row, column) in (0..12).flat_map(|row| (0..12).map(move |column| (row, column))) {
                stiffness[(dof(row), dof(column))] += k[(row, column)];
                mass[(dof(row), dof(column))] += m[(row, column)];
            }
        }
    }
    let free = 6 * (node_count - 1);
    let stiffness = stiffness.view((6, 6), (free, free)).into_owned();
    let mass = mass.view((6, 6), (free, free)).into_owned();
    let lower = stiffness.cholesky().expect("a stiff frame").l();
    let half = lower.solve_lower_triangular(&mass).expect("a factor");
    let matrix = lower.solve_lower_triangular(&half.transpose()).expect("a factor");
    sorted_frequencies(&((&matrix + matrix.transpose()) * 0.5))
}

/// A trunk, two branches, and two twigs on each branch.
fn seven_beams() -> Vec<BeamPart> {
    let part = |parent: Option<usize>, angles: [f64; 2], length: f64, radius: f64| BeamPart {
        parent,
        rotation: Rotation3::from_euler_angles(angles[0], 0.0, angles[1]),
        length,
        radius,
    };
    vec![
        part(None, [0.0, 0.0], 1.2, 0.02),
        part(Some(0), [0.5, 0.2], 0.8, 0.014),
        part(Some(0), [-0.6, -0.3], 0.7, 0.012),
        part(Some(1), [0.4, 0.5], 0.5, 0.008),
        part(Some(1), [-0.3, -0.6], 0.45, 0.009),
        part(Some(2), [0.7, -0.2], 0.4, 0.007),
        part(Some(2), [-0.5, 0.4], 0.5, 0.008),
    ]
}

#[test]
fn branching_tree_has_the_frequencies_of_one_frame() {
    let expected = frame_frequencies(&seven_beams());
    let errors = |parts: &[BeamPart]| -> Vec<f64> {
        let hertz = frequencies(&create_model(parts, 10));
        hertz.iter().zip(&expected).take(10).map(|(a, b)| a / b - 1.0).collect()
    };
    let coupled_errors = errors(&seven_beams());
    println!("{:.4?} Hz, errors {coupled_errors:.6?}", &expected[..10]);
    assert!(coupled_errors.iter().all(|error| error.abs() <= 1e-2), "{coupled_errors:?}");
    // Control: another angle of one branch.
    let mut parts = seven_beams();
    parts[1].rotation = Rotation3::from_euler_angles(1.5, 0.0, 0.2);
    assert!(errors(&parts).iter().any(|error| error.abs() > 1e-2));
}

/// Time steps, not eigenvalues: the free vibration of a divided beam in its first mode has the frequency of the whole.
#[test]
fn divided_cantilever_vibrates_with_the_frequency_of_the_whole() {
    let parts = chain(5, 1.0, radius_of_square(0.025));
    let hertz = create_beam(&chain(1, 1.0, parts[0].radius)[0], 40).solve_modes(1).expect("modes").eigenvalues[0]
        .sqrt()
        / std::f64::consts::TAU;
    let model = create_model(&parts, 6);
    let parameters = ModalParameters::read(&model).expect("parameters");
    let mut undamped = parameters.clone();
    undamped.modes.iter_mut().flatten().for_each(|mode| mode.damping_ratio = 0.0);
    let system = StaticSystem::new(&model, &parameters).expect("a scene");
    let mut loads = DomainLoads::none(&model);
    loads.add_force(&model, 4, &model.domains[4].samples[RING * ELEMENTS], &Vector3::x());
    let start = system.solve(&loads).q;
    let dt = 1e-3 / hertz;
    let modes = CoupledModes::new(&model, &undamped, dt).expect("a scene");
    let mut state = MotionState::resting(DVector::from_vec(start));
    let none = DVector::zeros(model.coordinate_count);
    // Count the periods of the tip by its zero crossings.
    let tip_of = |state: &MotionState| modes.joints().frame_motions(state.q.as_slice())[4].x;
    let (mut last, mut crossings) = (tip_of(&state), vec![]);
    for step in 0..10_500 {
        modes.advance(&mut state, LoadChange { start: &none, end: &none }).expect("a step");
        let now = tip_of(&state);
        if last < 0.0 && now >= 0.0 {
            crossings.push(dt * (f64::from(step) + last / (last - now)));
        }
        last = now;
    }
    let period = (crossings[crossings.len() - 1] - crossings[0]) / (crossings.len() - 1) as f64;
    assert!((period * hertz - 1.0).abs() <= 5e-3, "{} of {hertz} Hz", period.recip());
}
