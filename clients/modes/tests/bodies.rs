//! Bodies of several parts, clamps, point masses and sheets.

mod solids;

use modalcast_modes::modeling::to_hertz;
use modalcast_modes::parameters::PointMass;
use modalcast_modes::surface_file::SurfaceFile;
use modalcast_modes::{ModelingParameters, compute_modes};
use nalgebra::Vector3;
use solids::{compute, parameters, rotated, solid_box, surface};

/// Surfaces as one file, each with a group of its own.
fn joined(files: &[SurfaceFile]) -> SurfaceFile {
    let (mut positions, mut triangles, mut groups) = (vec![], vec![], vec![]);
    for (group, file) in files.iter().enumerate() {
        let first = positions.len() as u32;
        positions.extend(&file.mesh.positions);
        triangles.extend(file.mesh.triangles.iter().map(|triangle| triangle.map(|vertex| vertex + first)));
        groups.extend(vec![group as u32; file.mesh.triangles.len()]);
    }
    let mut file = surface(positions, triangles);
    file.mesh.triangle_groups = groups;
    file.groups = (0..files.len()).map(|group| format!("group {group}")).collect();
    file
}

fn moved(mut file: SurfaceFile, offset: [f64; 3]) -> SurfaceFile {
    file.mesh.positions.iter_mut().for_each(|position| *position += Vector3::from(offset));
    file
}

/// The first bending frequency of a clamped bar by Euler and Bernoulli, Hz.
fn cantilever_frequency(length: f64, thickness: f64, modulus: f64, density: f64) -> f64 {
    let radius_of_gyration = thickness / 12.0_f64.sqrt();
    1.875_104_f64.powi(2) / (std::f64::consts::TAU * length.powi(2)) * radius_of_gyration * (modulus / density).sqrt()
}

/// The clamp cuts through cells, and the free length is what remains.
#[test]
fn clamped_bar_has_the_frequency_of_a_cantilever() {
    let bar = moved(solid_box([1.0, 0.05, 0.05]), [0.5, 0.0, 0.0]);
    for (clamp, length) in [("x < 0.137", 0.863), ("x < 1e-6", 1.0)] {
        let clamped = ModelingParameters { clamps: vec![clamp.into()], ..parameters(4000, 4) };
        let modeling = compute(&bar, &clamped);
        let expected = cantilever_frequency(length, 0.05, 1e6, 1000.0);
        for mode in 0..2 {
            let frequency = to_hertz(modeling.eigenvalues[mode]);
            assert!((frequency / expected - 1.0).abs() < 0.015, "{clamp}: {frequency} instead of {expected}");
        }
        assert_eq!(modeling.rigid_modes, 0);
        // Vertices in the clamp do not move, the others do.
        let rank = modeling.eigenvalues.len();
        for (vertex, position) in modeling.mesh.positions.iter().enumerate() {
            let row = &modeling.modes[3 * vertex * rank..3 * (vertex + 1) * rank];
            let is_at_rest = row.iter().all(|entry| *entry == 0.0);
            assert_eq!(is_at_rest, position.x < 1.0 - length + 1e-6, "{position:?}");
        }
    }
}

#[test]
fn group_and_sphere_hold_a_bar_by_area() {
    let mut bar = moved(solid_box([1.0, 0.05, 0.05]), [0.5, 0.0, 0.0]);
    // The two triangles at x = 0 are a group.
    bar.mesh.triangle_groups[8..10].fill(1);
    bar.groups.push("foot".into());
    let expected = cantilever_frequency(1.0, 0.05, 1e6, 1000.0);
    let by_group = compute(&bar, &ModelingParameters { clamps: vec!["group foot".into()], ..parameters(3000, 2) });
    let frequency = to_hertz(by_group.eigenvalues[0]);
    assert!((frequency / expected - 1.0).abs() < 0.015, "{frequency} instead of {expected}");
    let by_sphere =
        compute(&bar, &ModelingParameters { clamps: vec!["near 0 0 0 0.04".into()], ..parameters(3000, 2) });
    let frequency = to_hertz(by_sphere.eigenvalues[0]);
    assert!(frequency / expected > 0.97 && frequency / expected < 1.1, "{frequency} instead of {expected}");
}

#[test]
fn separate_parts_have_six_rigid_modes_each() {
    let bodies = joined(&[
        rotated(solid_box([1.0, 0.3, 0.3]), 1),
        moved(rotated(solid_box([1.0, 0.3, 0.3]), 2), [0.0, 0.0, 2.0]),
        // Less than 0.1 % of the volume.
        moved(solid_box([0.04, 0.04, 0.04]), [2.0, 0.0, 0.0]),
    ]);
    let modeling = compute(&bodies, &parameters(4000, 6));
    assert_eq!((modeling.parts, modeling.rigid_modes), (2, 12));
    assert!(
        modeling.remarks.iter().any(|remark| remark.starts_with("1 part with less than 0.1 %")),
        "{:?}",
        modeling.remarks
    );
    // Both parts are equal, so that each frequency occurs twice.
    let ratio = to_hertz(modeling.eigenvalues[1]) / to_hertz(modeling.eigenvalues[0]);
    assert!((ratio - 1.0).abs() < 0.01, "{ratio}");
}

/// Two bars with a gap of less than a cell: with common nodes they would be one part.
#[test]
fn bars_with_a_narrow_gap_are_not_joined() {
    let gap = 0.06;
    let bars = joined(&[
        moved(solid_box([1.0, 0.1, 0.1]), [0.0, -0.05 - gap / 2.0, 0.0]),
        moved(solid_box([1.0, 0.1, 0.1]), [0.0, 0.05 + gap / 2.0, 0.0]),
    ]);
    let modeling = compute(&bars, &parameters(4000, 4));
    assert!(modeling.cell_size > gap, "control: the gap is narrower than a cell of {}", modeling.cell_size);
    assert_eq!(modeling.parts, 2);
}

#[test]
fn materials_belong_to_the_shells_of_their_groups() {
    let halves =
        [moved(solid_box([0.5, 0.3, 0.3]), [-0.25, 0.0, 0.0]), moved(solid_box([0.5, 0.3, 0.3]), [0.25, 0.0, 0.0])];
    let bar = joined(&halves);
    let mut two_materials = parameters(3000, 4);
    two_materials.add_material("group 1:E=1e8,nu=0.3,rho=3000").expect("a material");
    let modeling = compute(&bar, &two_materials);
    assert_eq!(modeling.parts, 1, "halves that touch are one part");
    assert!((modeling.mass / (0.045 * 1000.0 + 0.045 * 3000.0) - 1.0).abs() < 1e-3, "{}", modeling.mass);
    let soft = compute(&bar, &parameters(3000, 4));
    assert!(modeling.eigenvalues[0] > 1.2 * soft.eigenvalues[0], "a stiffer half raises the frequency");
}

#[test]
fn point_mass_at_the_tip_lowers_the_frequency_as_predicted() {
    let bar = moved(solid_box([1.0, 0.05, 0.05]), [0.5, 0.0, 0.0]);
    let clamped = ModelingParameters { clamps: vec!["x < 1e-6".into()], ..parameters(3000, 2) };
    let tip_mass = PointMass { position: Vector3::new(1.0, 0.0, 0.0), mass: 25.0 };
    let loaded = compute(&bar, &ModelingParameters { point_masses: vec![tip_mass], ..clamped });
    // Rayleigh: a tip mass m and 33/140 of the bar's mass on a spring of 3 E I / L^3.
    let spring = 3.0 * 1e6 * 0.05_f64.powi(4) / 12.0;
    let expected = (spring / (25.0 + 33.0 / 140.0 * 2.5)).sqrt() / std::f64::consts::TAU;
    let frequency = to_hertz(loaded.eigenvalues[0]);
    assert!((frequency / expected - 1.0).abs() < 0.02, "{frequency} instead of {expected}");
    assert!((loaded.mass - 27.5).abs() < 0.01, "{}", loaded.mass);
}

#[test]
fn sheet_needs_a_thickness() {
    let positions = [[0.0, 0.0], [1.0, 0.0], [1.0, 0.6], [0.0, 0.6]].map(|[x, y]| Vector3::new(x, y, 0.0));
    let sheet = surface(positions.to_vec(), vec![[0, 1, 2], [0, 2, 3]]);
    let error = compute_modes(&sheet, &parameters(3000, 4), &|_, _| {}).expect_err("expected an error").to_string();
    assert!(error.contains("--thickness"), "{error}");
    let thick = ModelingParameters { thickness: Some(0.01), ..parameters(6000, 4) };
    let modeling = compute(&sheet, &thick);
    let frequency = to_hertz(modeling.eigenvalues[0]);
    assert!((frequency / solids::PLATE[0] - 1.0).abs() < 0.02, "{frequency}");
}

/// A rod whose section is much smaller than an eighth of its length.
#[test]
fn slender_rod_is_resolved() {
    let rod = solids::cylinder(0.005, 1.0, 24);
    let modeling = compute(&rod, &parameters(4000, 4));
    // Euler and Bernoulli, free at both ends.
    let expected = 4.730_041_f64.powi(2) / std::f64::consts::TAU * 0.0025 * 1e3_f64.sqrt();
    for mode in 0..2 {
        let frequency = to_hertz(modeling.eigenvalues[mode]);
        assert!((frequency / expected - 1.0).abs() < 0.05, "{frequency} instead of {expected}");
    }
}

/// The fill of cut cells stiffens walls that are much thinner than a cell.
#[test]
fn walls_thinner_than_the_grid_resolves_are_remarked() {
    let has_remark = |thickness: f64| {
        let modeling = compute(&solid_box([1.0, 0.6, thickness]), &parameters(3000, 2));
        modeling.remarks.iter().any(|remark| remark.starts_with("the walls are about"))
    };
    assert!(has_remark(0.0002) && !has_remark(0.005));
}

/// A slotted clamp in the middle of a bar, thinner than the distance of the tested positions.
#[test]
fn thin_clamp_inside_holds_the_bar() {
    let bar = moved(solid_box([1.0, 0.05, 0.05]), [0.5, 0.0, 0.0]);
    let clamped = ModelingParameters { clamps: vec!["x > 0.499 && x < 0.501".into()], ..parameters(4000, 4) };
    let modeling = compute(&bar, &clamped);
    assert_eq!(modeling.rigid_modes, 0);
    let expected = cantilever_frequency(0.499, 0.05, 1e6, 1000.0);
    let frequency = to_hertz(modeling.eigenvalues[0]);
    assert!((frequency / expected - 1.0).abs() < 0.03, "{frequency} instead of {expected}");
}

/// An open bowl: points near it have winding numbers above 1/2.
#[test]
fn bowl_encloses_no_volume() {
    let mut bowl = solids::ellipsoid([0.5, 0.5, 0.5], 24);
    let positions = bowl.mesh.positions.clone();
    let is_lower = |triangle: &[u32; 3]| triangle.iter().all(|vertex| positions[*vertex as usize].z < 0.01);
    bowl.mesh.triangles.retain(is_lower);
    let count = bowl.mesh.triangles.len();
    bowl.mesh.corner_normals.truncate(count);
    bowl.mesh.triangle_groups.truncate(count);
    bowl.mesh.triangle_materials.truncate(count);
    let error = compute_modes(&bowl, &parameters(3000, 4), &|_, _| {}).expect_err("expected an error").to_string();
    assert!(error.contains("large openings"), "{error}");
}

#[test]
fn wrong_requests_are_errors_with_figures() {
    let solid = solid_box([1.0, 0.7, 0.4]);
    let with_clamp = |clamp: &str| ModelingParameters { clamps: vec![clamp.into()], ..parameters(1500, 4) };
    let mut with_unknown_group = parameters(1500, 4);
    with_unknown_group.add_material("hand:steel").expect("a material");
    for (parameters, message) in [
        (with_clamp("z < -1"), "z from -0.2000 to 0.2000"),
        (with_clamp("z < 1"), "leaves a part of the body free"),
        (with_clamp("group hand"), "one of the groups 'default'"),
        (with_unknown_group, "one of the groups 'default'"),
        (parameters(300, 200), "--modes: expected at most half of"),
        (
            ModelingParameters {
                point_masses: vec![PointMass { position: Vector3::new(4.0, 0.0, 0.0), mass: 1.0 }],
                ..parameters(1500, 4)
            },
            "a position at the body, outside of clamps",
        ),
        (ModelingParameters { max_frequency: Some(1.0), ..parameters(1500, 4) }, "the first frequency"),
    ] {
        let error = compute_modes(&solid, &parameters, &|_, _| {}).expect_err("expected an error").to_string();
        assert!(error.contains(message), "{error}");
    }
    let limited = ModelingParameters { max_frequency: Some(12.0), ..parameters(1500, 6) };
    assert_eq!(compute(&solid, &limited).eigenvalues.len(), 3, "7.6, 9.2 and 11.8 Hz");
}

/// Parts that are far apart: the shift of the eigensolver follows the size of a part, not that of the whole.
#[test]
fn small_parts_far_apart_converge() {
    let cubes = joined(&[solid_box([0.01; 3]), moved(solid_box([0.01; 3]), [1.0, 0.0, 0.0])]);
    let mut steel = parameters(3000, 4);
    steel.add_material("steel").expect("a material");
    let modeling = compute(&cubes, &steel);
    assert_eq!((modeling.parts, modeling.rigid_modes), (2, 12));
}

/// More modes than a block of the eigensolver has vectors many times over, of a stiff body.
#[test]
fn many_modes_of_a_bar_converge() {
    let mut steel = parameters(3000, 128);
    steel.add_material("steel").expect("a material");
    let modeling = compute(&solid_box([1.0, 0.1, 0.1]), &steel);
    assert_eq!(modeling.eigenvalues.len(), 128);
    assert!(modeling.eigenvalues.is_sorted() && modeling.residuals.iter().all(|residual| *residual < 1e-4));
}
