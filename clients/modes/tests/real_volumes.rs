//! Volume meshes of other projects: Vega FEM and SOFA.

use std::path::PathBuf;
use std::time::Instant;

use modalcast_model::load::LoadOptions;
use modalcast_modes::modeling::to_hertz;
use modalcast_modes::surface::Surface;
use modalcast_modes::volume_file::{self, VolumeFile};
use modalcast_modes::{Modeling, ModelingParameters, compute_volume_modes};

fn data_folder() -> PathBuf {
    std::env::var_os("MODALCAST_DATA").map_or_else(|| "../../../shared/data".into(), PathBuf::from)
}

fn read(path: &str) -> modalcast_model::error::Result<VolumeFile> {
    volume_file::read(&data_folder().join(path).to_string_lossy(), &LoadOptions::default())
}

fn open(path: &str) -> VolumeFile {
    read(path).unwrap_or_else(|error| panic!("{error}"))
}

/// Computes modes and prints the time.
fn compute(file: &VolumeFile, parameters: &ModelingParameters) -> Modeling {
    let start = Instant::now();
    let modeling = compute_volume_modes(file, parameters, &|_, _| {}).unwrap_or_else(|error| panic!("{error}"));
    let frequencies: Vec<f64> = modeling.eigenvalues.iter().take(6).map(|value| to_hertz(*value)).collect();
    println!(
        "{}: {} tetrahedra, {} freedoms, {:.1} s, {frequencies:.4?} Hz, {:?}",
        file.name,
        file.mesh.elements.len(),
        modeling.freedoms,
        start.elapsed().as_secs_f64(),
        modeling.remarks
    );
    let surface = Surface::new(&modeling.mesh.positions, &modeling.mesh.triangles, &modeling.mesh.triangle_groups);
    assert!(surface.is_closed && surface.volume() > 0.0);
    assert!(modeling.residuals.iter().all(|residual| *residual < 1e-3), "{:?}", modeling.residuals);
    modeling
}

fn parameters(modes: usize, clamp: Option<&str>) -> ModelingParameters {
    let clamps = clamp.map(str::to_owned).into_iter().collect();
    ModelingParameters { modes, freedoms: 100_000, clamps, ..ModelingParameters::default() }
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../../../shared/data (from this crate)"]
fn real_turtle_has_its_material_and_fixed_vertices() {
    let file = open("vega/volumetric/turtle/turtle-volumetric-homogeneous.veg");
    assert_eq!((file.mesh.elements.len(), file.up_axis), (1185, 1));
    let free = compute(&file, &parameters(20, None));
    assert_eq!(free.rigid_modes, 6);
    assert!((free.mass / (1000.0 * file.mesh.volume()) - 1.0).abs() < 1e-9);
    assert!(free.remarks.iter().any(|remark| remark.contains("--clamp 'group turtle-volumetric.bou'")));
    let held = compute(&file, &parameters(20, Some("group turtle-volumetric.bou")));
    assert_eq!(held.rigid_modes, 0);
    assert!(held.eigenvalues[0] < free.eigenvalues[0], "a held body has lower frequencies than a free one");
    let error = read("vega/volumetric/turtle/turtle-volumetric-heterogeneous.veg").expect_err("expected an error");
    assert!(error.to_string().contains("got 'shellElementList.txt'"), "{error}");
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../../../shared/data (from this crate)"]
fn real_bridge_volume_has_modes() {
    let file = open("vega/volumetric/simpleBridge/simpleBridge-ic_128_0.15_.1.veg");
    assert_eq!(file.mesh.elements.len(), 12_827);
    let default = ModelingParameters { clamps: vec!["group simpleBridge.bou".into()], ..ModelingParameters::default() };
    let error = compute_volume_modes(&file, &default, &|_, _| {}).expect_err("expected an error").to_string();
    assert!(error.contains("--freedoms: expected at least"), "{error}");
    let modeling = compute(&file, &parameters(20, Some("group simpleBridge.bou")));
    assert_eq!(modeling.rigid_modes, 0);
    // Vega's own frequencies have these ratios. Its linear elements are too stiff, so that the ratios differ.
    let vega = [1.0, 2.198, 3.117, 3.652, 3.872, 7.238];
    let first = to_hertz(modeling.eigenvalues[0]);
    for (eigenvalue, ratio) in modeling.eigenvalues.iter().zip(vega) {
        let own = to_hertz(*eigenvalue) / first;
        println!("ratio {own:.3}, Vega {ratio}");
        assert!((own / ratio - 1.0).abs() < 0.3, "{own} instead of {ratio}");
    }
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../../../shared/data (from this crate)"]
fn real_beam_of_tetrahedra_is_read_and_that_of_cubes_refused() {
    let file = open("vega/volumetric/beam3/beam3_tet.veg");
    let modeling = compute(&file, &parameters(6, Some("group beam3.bou")));
    assert!((modeling.mass / (1000.0 * 0.12 * 0.04) - 1.0).abs() < 1e-6, "{}", modeling.mass);
    let error = read("vega/volumetric/beam3/beam3.veg").expect_err("expected an error").to_string();
    assert!(error.contains("75 cubes (CUBIC)"), "{error}");
}

/// Files of Gmsh and ParaView in millimeters and other units, with triangles and without groups.
#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../../../shared/data (from this crate)"]
fn real_vtk_files_have_modes() {
    for (path, nodes, tetrahedra) in
        [("finger/finger.vtk", 158, 389), ("ball/sphere.vtk", 228, 716), ("diamond/diamond_4k_tet.vtu", 1628, 4147)]
    {
        let file = open(&format!("sofa/{path}"));
        assert_eq!(file.mesh.elements.len(), tetrahedra, "{path}");
        assert!(file.mesh.positions.len() > 4 * nodes, "{path}: middles of edges");
        let modeling = compute(&file, &parameters(10, None));
        assert_eq!((modeling.parts, modeling.rigid_modes), (1, 6), "{path}");
    }
}
