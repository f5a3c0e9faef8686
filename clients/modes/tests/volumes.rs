//! Volume meshes: frequencies against exact references (see `accuracy.rs`), clamps, materials and errors.

mod solids;
mod volume_meshes;

use std::collections::HashMap;

use modalcast_modes::assembly::SystemMatrices;
use modalcast_modes::eigensolver::find_elastic_modes;
use modalcast_modes::materials::Material;
use modalcast_modes::modeling::to_hertz;
use modalcast_modes::parameters::PointMass;
use modalcast_modes::tet10::{self, EDGES, FREEDOMS, NODES};
use modalcast_modes::volume_mesh::{ElementGroup, NodeGroup, VolumeCells};
use modalcast_modes::{Modeling, ModelingParameters, compute_volume_modes};
use nalgebra::Vector3;
use solids::{BOX, CYLINDER, ELLIPSOID, SPHERE, parameters};
use volume_meshes::{cylinder, ellipsoid, file_of, linear, rotated, solid_box};

fn compute(cells: VolumeCells, parameters: &ModelingParameters) -> Modeling {
    compute_volume_modes(&file_of(cells), parameters, &|_, _| {}).unwrap_or_else(|error| panic!("{error}"))
}

fn error_of(cells: VolumeCells, parameters: &ModelingParameters) -> String {
    compute_volume_modes(&file_of(cells), parameters, &|_, _| {}).expect_err("expected an error").to_string()
}

fn frequencies(modeling: &Modeling) -> Vec<f64> {
    modeling.eigenvalues.iter().map(|eigenvalue| to_hertz(*eigenvalue)).collect()
}

/// The largest relative difference to the reference frequencies.
fn worst_difference(modeling: &Modeling, reference: &[f64]) -> f64 {
    assert!(modeling.eigenvalues.len() >= reference.len(), "{} modes", modeling.eigenvalues.len());
    let pairs = frequencies(modeling).into_iter().zip(reference);
    let differences = pairs.map(|(frequency, reference)| (frequency / reference - 1.0).abs());
    // The maximum of f64 ignores values that are no numbers.
    differences.fold(0.0, |largest, difference| if difference <= largest { largest } else { difference })
}

/// Prints the figures of the manual with `--nocapture`.
fn report(name: &str, modeling: &Modeling, difference: f64) {
    let tetrahedra = modeling.tetrahedra.unwrap_or_default();
    println!(
        "{name}: {tetrahedra} tetrahedra, {} triangles, {} freedoms, worst difference {:.4} %, worst residual {:.1e}",
        modeling.mesh.triangles.len(),
        modeling.freedoms,
        100.0 * difference,
        modeling.residuals.iter().copied().fold(0.0, f64::max)
    );
}

#[test]
fn rotated_box_has_the_exact_frequencies() {
    let modeling = compute(rotated(linear(solid_box([1.0, 0.7, 0.4], [12, 8, 5]))), &parameters(25_000, 20));
    let difference = worst_difference(&modeling, &BOX);
    report("box", &modeling, difference);
    assert!(modeling.mesh.triangles.len() >= 1280 && difference < 0.005, "{difference}");
    assert_eq!((modeling.rigid_modes, modeling.parts), (6, 1));
    assert!((modeling.mass / 280.0 - 1.0).abs() < 1e-12, "{}", modeling.mass);
    assert!(modeling.residuals.iter().all(|residual| *residual < 1e-5), "{:?}", modeling.residuals);
    assert!(modeling.remarks.iter().any(|remark| remark.starts_with("2880 linear")), "{:?}", modeling.remarks);
    let control = worst_difference(&modeling, &ELLIPSOID);
    assert!(control > 0.1, "control: {control}");
}

#[test]
fn ellipsoid_has_the_exact_frequencies() {
    let modeling = compute(rotated(ellipsoid([0.5, 0.35, 0.2], [10, 8, 6])), &parameters(25_000, 20));
    let difference = worst_difference(&modeling, &ELLIPSOID);
    report("ellipsoid", &modeling, difference);
    assert!(modeling.mesh.triangles.len() >= 1280 && difference < 0.005, "{difference}");
    // Control: the inscribed polyhedron has less volume.
    let straight = compute(linear(ellipsoid([0.5, 0.35, 0.2], [10, 8, 6])), &parameters(25_000, 20));
    let control = worst_difference(&straight, &ELLIPSOID);
    assert!(control > 0.005, "control: straight edges, {control}");
}

/// Control of the accuracy: the same elements without their middles, whose displacements are those between the corners.
#[test]
fn linear_elements_are_much_too_stiff() {
    let mesh = file_of(solid_box([1.0, 0.7, 0.4], [10, 7, 4])).mesh;
    let material = parameters(25_000, 1).material;
    let mut numbers = HashMap::new();
    let mut positions = Vec::new();
    let corners: Vec<[u32; 4]> = mesh
        .elements
        .iter()
        .map(|element| {
            std::array::from_fn(|corner| {
                *numbers.entry(element[corner]).or_insert_with(|| {
                    positions.push(mesh.positions[element[corner] as usize]);
                    positions.len() as u32 - 1
                })
            })
        })
        .collect();
    // The share of a corner in the displacement of a node of the quadratic element.
    let share = |node: usize, corner: usize| match node {
        0..4 => f64::from(u8::from(node == corner)),
        _ => f64::from(u8::from(EDGES[node - 4].contains(&corner))) / 2.0,
    };
    let matrices: Vec<(Vec<f64>, Vec<f64>)> = (0..mesh.elements.len())
        .map(|element| {
            let quadratic = tet10::matrices(&mesh.nodes_of(element), &material).expect("an element");
            let reduced = |entry: &dyn Fn(usize, usize) -> f64, i: usize, j: usize| -> f64 {
                let pairs = (0..NODES).flat_map(|a| (0..NODES).map(move |b| (a, b)));
                pairs.map(|(a, b)| share(a, i) * share(b, j) * entry(a, b)).sum()
            };
            let stiffness = (0..144).map(|index| {
                let [row, column] = [index / 12, index % 12];
                let entry = |a, b| quadratic.stiffness[(3 * a + row % 3) * FREEDOMS + 3 * b + column % 3];
                reduced(&entry, row / 3, column / 3)
            });
            let mass = (0..16).map(|index| reduced(&|a, b| quadratic.mass[a * NODES + b], index / 4, index % 4));
            (stiffness.collect(), mass.collect())
        })
        .collect();
    let system = SystemMatrices::assemble(&corners, positions.len(), |element| {
        (&matrices[element].0[..], &matrices[element].1[..])
    });
    let rigid: Vec<Vec<f64>> = (0..6)
        .map(|motion| {
            let unit: Vector3<f64> = Vector3::ith(motion % 3, 1.0);
            let displacement = |p: &Vector3<f64>| if motion < 3 { unit } else { unit.cross(p) };
            positions.iter().flat_map(|position| <[f64; 3]>::from(displacement(position))).collect()
        })
        .collect();
    let modes = find_elastic_modes(&system, &rigid, 1.0, 4, &|_, _| {}).expect("modes");
    let error = to_hertz(modes.eigenvalues[0]) / BOX[0] - 1.0;
    println!("linear elements: {:.2} % in the first frequency", 100.0 * error);
    assert!(error > 0.03, "{error}");
}

/// All copies of repeated frequencies are found: clusters of 5, 5, 3 and 7 modes.
#[test]
fn sphere_has_complete_clusters() {
    let modeling = compute(rotated(ellipsoid([0.5; 3], [8; 3])), &parameters(25_000, 20));
    let difference = worst_difference(&modeling, &SPHERE);
    report("sphere", &modeling, difference);
    assert!(modeling.mesh.triangles.len() >= 1280 && difference < 0.005, "{:?}", frequencies(&modeling));
}

#[test]
fn cylinder_has_the_exact_frequencies() {
    let modeling = compute(rotated(cylinder(0.25, 1.0, 4, 12)), &parameters(25_000, 20));
    let difference = worst_difference(&modeling, &CYLINDER);
    report("cylinder", &modeling, difference);
    assert!(modeling.mesh.triangles.len() >= 1280 && difference < 0.005, "{:?}", frequencies(&modeling));
}

/// The first bending frequency of a clamped bar by Euler and Bernoulli, Hz.
fn cantilever_frequency(length: f64) -> f64 {
    let radius_of_gyration = 0.05 / 12.0_f64.sqrt();
    1.875_104_f64.powi(2) / (std::f64::consts::TAU * length.powi(2)) * radius_of_gyration * 1e3_f64.sqrt()
}

/// A bar from x = 0 to 1. Its end faces and its halves have groups.
fn bar() -> VolumeCells {
    let mut cells = solid_box([1.0, 0.05, 0.05], [20, 1, 1]);
    cells.positions.iter_mut().for_each(|position| position.x += 0.5);
    let nodes_where = |holds: &dyn Fn(&Vector3<f64>) -> bool| -> Vec<u32> {
        (0..).zip(&cells.positions).filter(|(_, position)| holds(position)).map(|(node, _)| node).collect()
    };
    let foot = NodeGroup { name: "foot".into(), nodes: nodes_where(&|position| position.x < 1e-9) };
    let line = NodeGroup { name: "line".into(), nodes: nodes_where(&|p| p.x < 1e-9 && p.y < -0.0249) };
    let is_tip = |element: &[u32; 10]| element.iter().any(|node| cells.positions[*node as usize].x > 0.501);
    cells.element_groups = cells.elements.iter().map(|element| u32::from(is_tip(element))).collect();
    cells.groups.push(ElementGroup { name: "tip".into(), material: None });
    cells.node_groups = vec![foot, line];
    cells
}

#[test]
fn clamps_by_position_and_group_hold_nodes() {
    for (clamp, length) in [("group foot", 1.0), ("x < 1e-6", 1.0), ("x < 0.1001", 0.9), ("group default", 0.5)] {
        let clamped = ModelingParameters { clamps: vec![clamp.into()], ..parameters(25_000, 4) };
        let modeling = compute(bar(), &clamped);
        let expected = cantilever_frequency(length);
        let limit = if length < 0.9 { 0.03 } else { 0.015 };
        for frequency in &frequencies(&modeling)[..2] {
            assert!((frequency / expected - 1.0).abs() < limit, "{clamp}: {frequency} instead of {expected}");
        }
        assert_eq!(modeling.rigid_modes, 0);
        let rank = modeling.eigenvalues.len();
        for (vertex, position) in modeling.mesh.positions.iter().enumerate() {
            let row = &modeling.modes[3 * vertex * rank..3 * (vertex + 1) * rank];
            let is_at_rest = row.iter().all(|entry| *entry == 0.0);
            assert_eq!(is_at_rest, position.x < 1.0 - length + 1e-3, "{position:?}");
        }
    }
}

#[test]
fn materials_of_groups_options_and_files_are_used() {
    let mut two_materials = parameters(25_000, 4);
    two_materials.add_material("tip:E=1e8,nu=0.3,rho=3000").expect("a material");
    let modeling = compute(bar(), &two_materials);
    let volume = 0.05 * 0.05;
    assert!((modeling.mass / (volume * 2000.0) - 1.0).abs() < 1e-9, "{}", modeling.mass);
    let mut from_file = bar();
    for (group, density) in from_file.groups.iter_mut().zip([500.0, 700.0]) {
        group.material = Some(Material::new(1e6, 0.3, density).expect("a material"));
    }
    let modeling = compute(from_file.clone(), &parameters(25_000, 4));
    assert!((modeling.mass / (volume * 600.0) - 1.0).abs() < 1e-9, "{}", modeling.mass);
    let modeling = compute(from_file.clone(), &two_materials);
    assert!((modeling.mass / (volume * 1750.0) - 1.0).abs() < 1e-9, "{}", modeling.mass);
    let mut replaced = parameters(25_000, 4);
    replaced.add_material("E=1e6,nu=0.3,rho=100").expect("a material");
    let modeling = compute(from_file, &replaced);
    assert!((modeling.mass / (volume * 100.0) - 1.0).abs() < 1e-9, "{}", modeling.mass);
    let names: Vec<&str> = modeling.group_materials.iter().map(|(group, _)| group.as_str()).collect();
    assert_eq!(names, ["default", "tip"]);
}

#[test]
fn point_mass_at_the_tip_lowers_the_frequency_as_predicted() {
    let clamped = ModelingParameters { clamps: vec!["group foot".into()], ..parameters(25_000, 2) };
    let tip_mass = PointMass { position: Vector3::new(1.0, 0.0, 0.0), mass: 25.0 };
    let loaded = compute(bar(), &ModelingParameters { point_masses: vec![tip_mass], ..clamped.clone() });
    // Rayleigh: a tip mass m and 33/140 of the bar's mass on a spring of 3 E I / L^3.
    let spring = 3.0 * 1e6 * 0.05_f64.powi(4) / 12.0;
    let expected = (spring / (25.0 + 33.0 / 140.0 * 2.5)).sqrt() / std::f64::consts::TAU;
    let frequency = to_hertz(loaded.eigenvalues[0]);
    assert!((frequency / expected - 1.0).abs() < 0.02, "{frequency} instead of {expected}");
    assert!((loaded.mass - 27.5).abs() < 1e-9, "{}", loaded.mass);
    let far = PointMass { position: Vector3::new(1.0, 0.3, 0.0), mass: 25.0 };
    let error = error_of(bar(), &ModelingParameters { point_masses: vec![far], ..clamped });
    assert!(error.contains("a position at the body"), "{error}");
}

#[test]
fn separate_parts_have_six_rigid_modes_each_and_a_name() {
    let mut cells = solid_box([1.0, 0.3, 0.3], [4, 1, 1]);
    let (nodes, elements) = (cells.positions.len() as u32, cells.elements.clone());
    let moved: Vec<Vector3<f64>> =
        cells.positions.iter().map(|position| position + Vector3::new(0.0, 0.0, 2.0)).collect();
    cells.positions.extend(moved);
    cells.elements.extend(elements.iter().map(|element| element.map(|node| node + nodes)));
    cells.element_groups.extend(vec![0; elements.len()]);
    let modeling = compute(cells.clone(), &parameters(25_000, 6));
    assert_eq!((modeling.parts, modeling.rigid_modes), (2, 12));
    let frequencies = frequencies(&modeling);
    assert!((frequencies[1] / frequencies[0] - 1.0).abs() < 1e-9, "equal parts: {frequencies:?}");
    let held = ModelingParameters { clamps: vec!["group part 2".into()], ..parameters(25_000, 6) };
    assert_eq!(compute(cells, &held).rigid_modes, 6);
}

#[test]
fn wrong_requests_are_errors_with_figures() {
    let with_clamp = |clamp: &str| ModelingParameters { clamps: vec![clamp.into()], ..parameters(25_000, 4) };
    let mut with_unknown_group = parameters(25_000, 4);
    with_unknown_group.add_material("foot:steel").expect("a material");
    for (parameters, message) in [
        (with_clamp("x < -1"), "x from 0.0000 to 1.0000"),
        (with_clamp("x < 2"), "leaves a part of the body free"),
        (with_clamp("group hand"), "one of the groups 'default', 'tip', 'foot', 'line'"),
        (with_clamp("group line"), "not on a line"),
        (with_clamp("near 0 -0.025 -0.025 0.001"), "not on a line"),
        (with_unknown_group, "one of the groups 'default', 'tip'"),
        (parameters(1000, 4), "--freedoms: expected at least 1107"),
        (parameters(25_000, 600), "--modes: expected at most half of the 1107"),
        (ModelingParameters { thickness: Some(0.1), ..parameters(25_000, 4) }, "--thickness: expected none"),
        (ModelingParameters { max_frequency: Some(0.1), ..parameters(25_000, 4) }, "the first frequency"),
    ] {
        let error = error_of(bar(), &parameters);
        assert!(error.contains(message), "{error}");
    }
}

/// Two boxes that share the nodes of one edge can swing about it.
#[test]
fn hinged_pieces_are_an_error() {
    let mut cells = linear(solid_box([1.0; 3], [2, 1, 1]));
    let hinge = linear(solid_box([1.0; 3], [2, 1, 1]));
    let offset = Vector3::new(1.0, 1.0, 0.0);
    let numbers: Vec<u32> = hinge
        .positions
        .iter()
        .map(|position| {
            let moved = position + offset;
            let known = cells.positions.iter().position(|other| (other - moved).norm() < 1e-9);
            known.unwrap_or_else(|| {
                cells.positions.push(moved);
                cells.positions.len() - 1
            }) as u32
        })
        .collect();
    let renumbered = |node: u32| numbers.get(node as usize).copied().unwrap_or(node);
    cells.elements.extend(hinge.elements.iter().map(|element| element.map(renumbered)));
    cells.element_groups.extend(hinge.element_groups);
    let error = error_of(cells, &parameters(25_000, 4));
    assert!(error.contains("1 that other elements touch only at edges or points"), "{error}");
}
