//! The program `modalcast-modes`: from files to models.

mod solids;
mod volume_meshes;

use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use modalcast_model::load;
use modalcast_modes::surface_file::SurfaceFile;
use modalcast_modes::volume_mesh::VolumeCells;
use solids::{ellipsoid, solid_box};

fn program(folder: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_modalcast-modes"));
    command.current_dir(folder).args(arguments);
    command
}

fn run(folder: &Path, arguments: &[&str]) -> Output {
    program(folder, arguments).output().expect("expected the program to start")
}

fn error_of(output: &Output) -> String {
    assert_eq!(output.status.code(), Some(3), "{output:?}");
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Writes a surface as an STL file, scaled.
fn write_stl(folder: &Path, name: &str, surface: &SurfaceFile, scale: f64) -> PathBuf {
    let mut text = String::from("solid part\n");
    for triangle in &surface.mesh.triangles {
        text.push_str("facet normal 0 0 0\nouter loop\n");
        for vertex in triangle {
            let [x, y, z]: [f64; 3] = (surface.mesh.positions[*vertex as usize] * scale).into();
            text.push_str(&format!("vertex {x} {y} {z}\n"));
        }
        text.push_str("endloop\nendfacet\n");
    }
    text.push_str("endsolid part\n");
    let path = folder.join(name);
    std::fs::write(&path, text).expect("expected a writable file");
    path
}

#[test]
fn stl_becomes_a_model_with_modes_eigenvalues_and_notes() {
    let folder = tempfile::tempdir().expect("expected a folder");
    write_stl(folder.path(), "bar.stl", &solid_box([0.1, 0.01, 0.01]), 1000.0);
    let arguments = "bar.stl --unit mm --material aluminium --modes 6 --freedoms 2000 --damping 0.02 --json --clamp";
    let arguments: Vec<&str> = arguments.split(' ').chain(["x < -49"]).collect();
    let output = run(folder.path(), &arguments);
    assert!(output.status.success(), "{output:?}");
    let result: serde_json::Value = serde_json::from_slice(&output.stdout).expect("expected JSON");
    // Euler and Bernoulli: the first frequency of an aluminum bar of 99 mm with a square section of 10 mm.
    let expected = 1.875_104_f64.powi(2) / std::f64::consts::TAU * 0.01 / 12.0_f64.sqrt() / 0.099_f64.powi(2)
        * (69e9_f64 / 2700.0).sqrt();
    let first = result["frequencies"][0].as_f64().expect("expected a frequency");
    assert!((first / expected - 1.0).abs() < 0.02, "{first} instead of {expected}");
    assert_eq!(result["rigid_modes"], 0);
    let opened = load::open(&folder.path().join("bar.npz").to_string_lossy()).expect("expected a scene");
    let (shape, domain) = (opened.scene.shape_of(0), &opened.scene.domains[0]);
    assert_eq!((shape.modes.rank(), domain.metadata.eigenvalues.len()), (6, 6));
    let frequency = domain.metadata.eigenvalues[0].sqrt() / std::f64::consts::TAU;
    assert!((frequency / first - 1.0).abs() < 1e-12);
    for (note, value) in
        [("damping_ratio", "0.02"), ("rigid_modes", "0"), ("modes.source", "bar.stl"), ("modes.clamps", "x < -49")]
    {
        assert_eq!(domain.metadata.notes[note], value, "{note}");
    }
    // The bar has more vertices than the file, so that it bends, and its length is in meters.
    let positions = shape.mesh.rest_positions();
    assert!(positions.len() > 60, "{}", positions.len());
    assert!(positions.iter().all(|position| position[0].abs() <= 0.0501));
}

/// Writes a mesh of linear tetrahedra as a file of Vega.
fn write_veg(path: &Path, cells: &VolumeCells) {
    let mut text = format!("*VERTICES\n{} 3 0 0\n", cells.positions.len());
    for (index, position) in cells.positions.iter().enumerate() {
        text.push_str(&format!("{} {} {} {}\n", index + 1, position.x, position.y, position.z));
    }
    text.push_str(&format!("*ELEMENTS\nTET\n{} 4 0\n", cells.elements.len()));
    for (index, [a, b, c, d, ..]) in cells.elements.iter().enumerate() {
        text.push_str(&format!("{} {} {} {} {}\n", index + 1, a + 1, b + 1, c + 1, d + 1));
    }
    text.push_str("*MATERIAL alloy\nENU, 2700, 69e9, 0.33\n*REGION\nallElements, alloy\n");
    std::fs::write(path, text).expect("expected a writable file");
}

#[test]
fn volume_mesh_becomes_a_model_with_its_surface() {
    let folder = tempfile::tempdir().expect("expected a folder");
    let mut cells = volume_meshes::linear(volume_meshes::solid_box([0.1, 0.01, 0.01], [20, 2, 2]));
    write_veg(&folder.path().join("bar.veg"), &cells);
    let held: Vec<String> = (1..)
        .zip(&cells.positions)
        .filter(|(_, position)| position.x < -0.0499)
        .map(|(vertex, _): (i32, _)| vertex.to_string())
        .collect();
    std::fs::write(folder.path().join("bar.bou"), held.join(",")).expect("expected a writable file");
    let model = |threads: &str| {
        let output = format!("{threads}.npz");
        let flags = ["bar.veg", "--modes", "6", "--threads", threads, "--json", "--out", &output, "--clamp"];
        let output = run(folder.path(), &[&flags[..], &["group bar.bou"]].concat());
        assert!(output.status.success(), "{output:?}");
        output.stdout
    };
    let result: serde_json::Value = serde_json::from_slice(&model("1")).expect("expected JSON");
    model("3");
    let bytes = |name: &str| std::fs::read(folder.path().join(name)).expect("expected a model");
    assert_eq!(bytes("1.npz"), bytes("3.npz"));
    // Euler and Bernoulli: an aluminum bar of 100 mm with a square section of 10 mm.
    let expected = 1.875_104_f64.powi(2) / std::f64::consts::TAU * 0.01 / 12.0_f64.sqrt() / 0.1_f64.powi(2)
        * (69e9_f64 / 2700.0).sqrt();
    let first = result["frequencies"][0].as_f64().expect("expected a frequency");
    assert!((first / expected - 1.0).abs() < 0.02, "{first} instead of {expected}");
    assert_eq!((&result["rigid_modes"], &result["tetrahedra"]), (&0.into(), &480.into()));
    let scene = load::open(&folder.path().join("1.npz").to_string_lossy()).expect("expected a scene").scene;
    let (shape, domain) = (scene.shape_of(0), &scene.domains[0]);
    assert_eq!((shape.modes.rank(), domain.metadata.eigenvalues.len()), (6, 6));
    // 4 sides of 20 x 2 and 2 ends of 2 x 2 squares, each with two faces of four triangles.
    assert_eq!(shape.mesh.triangles().len(), 8 * (4 * 40 + 2 * 4));
    for (note, value) in [
        ("modes.tetrahedra", "480"),
        ("modes.material", "alloy: alloy: E = 6.9e10 Pa, nu = 0.33, rho = 2700 kg/m3"),
        ("modes.source", "bar.veg"),
        ("modes.clamps", "group bar.bou"),
    ] {
        assert_eq!(domain.metadata.notes[note], value, "{note}");
    }
    assert!(!domain.metadata.notes["modes.residuals"].is_empty());
    // Hexahedra and files without tetrahedra are refused with a way out.
    let text = std::fs::read_to_string(folder.path().join("bar.veg")).expect("expected a file");
    std::fs::write(folder.path().join("cubes.veg"), text.replace("TET", "CUBIC")).expect("expected a writable file");
    let error = error_of(&run(folder.path(), &["cubes.veg"]));
    assert!(error.contains("got 480 cubes (CUBIC)") && error.contains("-3 -order 2 -o cubes.msh"), "{error}");
    cells.elements.truncate(1);
    cells.positions[1] = cells.positions[0];
    write_veg(&folder.path().join("flat.veg"), &cells);
    let error = error_of(&run(folder.path(), &["flat.veg"]));
    assert!(error.contains("file 'flat.veg': mesh: expected elements with a volume"), "{error}");
}

/// The modes do not depend on threads, so that caches and tests can compare bytes.
#[test]
fn bytes_are_equal_for_any_number_of_threads() {
    let folder = tempfile::tempdir().expect("expected a folder");
    write_stl(folder.path(), "body.stl", &ellipsoid([0.5, 0.5, 0.3], 24), 1.0);
    let model = |threads: &str| {
        let output = format!("{threads}.npz");
        let flags = ["body.stl", "--freedoms", "2500", "--threads", threads, "--out", &output];
        assert!(run(folder.path(), &flags).status.success());
        std::fs::read(folder.path().join(output)).expect("expected a model")
    };
    let one = model("1");
    assert_eq!(one, model("2"));
    assert_eq!(one, model("5"));
    let flags = ["body.stl", "--freedoms", "2400", "--out", "other.npz"];
    assert!(run(folder.path(), &flags).status.success());
    assert_ne!(one, std::fs::read(folder.path().join("other.npz")).expect("a model"), "control: another grid");
}

#[test]
fn y_up_surface_becomes_a_z_up_model() {
    let folder = tempfile::tempdir().expect("expected a folder");
    let text = "v 0 0 0\nv 1 0 0\nv 0 3 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n";
    std::fs::write(folder.path().join("tetrahedron.obj"), text).expect("expected a writable file");
    let arguments = ["tetrahedron.obj", "--freedoms", "1500", "--modes", "4", "--material", "E=1e6,nu=0.3,rho=1000"];
    let heights = |extra: &[&str], out: &str| {
        let output = run(folder.path(), &[&arguments[..], extra, &["--out", out]].concat());
        assert!(output.status.success(), "{output:?}");
        let scene = load::open(&folder.path().join(out).to_string_lossy()).expect("expected a scene").scene;
        let positions = scene.shape_of(0).mesh.rest_positions();
        positions.iter().map(|position| position[2]).fold(0.0, f32::max)
    };
    assert_eq!(heights(&[], "a.npz"), 3.0);
    assert_eq!(heights(&["--up", "z"], "b.npz"), 1.0);
}

#[test]
fn strict_mode_refuses_surfaces_with_missing_files() {
    let folder = tempfile::tempdir().expect("expected a folder");
    let text = "mtllib absent.mtl\nv 0 0 0\nv 1 0 0\nv 0 3 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n";
    std::fs::write(folder.path().join("a.obj"), text).expect("expected a writable file");
    let arguments = ["a.obj", "--freedoms", "1500", "--modes", "4"];
    assert!(error_of(&run(folder.path(), &[&arguments[..], &["--strict"]].concat())).contains("absent.mtl"));
    assert!(run(folder.path(), &arguments).status.success(), "control");
}

#[test]
fn errors_name_what_is_wrong_and_leave_no_file() {
    let folder = tempfile::tempdir().expect("expected a folder");
    write_stl(folder.path(), "box.stl", &solid_box([1.0, 0.7, 0.4]), 1.0);
    std::fs::write(folder.path().join("nan.obj"), "v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").expect("a file");
    std::fs::write(folder.path().join("flat.obj"), "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").expect("a file");
    let entries = || std::fs::read_dir(folder.path()).expect("a folder").count();
    let before = entries();
    for (arguments, message) in [
        ("missing.stl", "missing.stl"),
        ("nan.obj", "finite"),
        ("flat.obj", "--thickness"),
        ("box.stl --material E=1e9,nu=0.5,rho=1000", "below 0.5, got 0.5"),
        ("box.stl --clamp z<-9", "touches the body"),
        ("box.stl --clamp h<1", "x, y and z"),
        ("box.stl --modes 0", "1 to 512"),
        ("box.stl --modes 300 --freedoms 500", "at most half"),
        ("box.stl --threads 0", "1 to 256"),
        ("box.stl --point-mass 1,2", "X Y Z KG"),
        ("box.stl --out box.stl --force", "another file than the part"),
        ("/dev/zero", "an existing model file"),
    ] {
        let output = run(folder.path(), &arguments.split(' ').collect::<Vec<_>>());
        let error = error_of(&output);
        assert!(error.starts_with("error: ") && error.contains(message), "{arguments}: {error}");
        assert_eq!(error.lines().count(), 1, "{error}");
    }
    assert_eq!(entries(), before);
    let flags = ["box.stl", "--freedoms", "1500", "--progress", "lines"];
    let output = run(folder.path(), &flags);
    assert!(output.status.success(), "{output:?}");
    let progress = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(
        progress.lines().all(|line| line.starts_with("progress 0.") || line.starts_with("progress 1.")),
        "{progress}"
    );
    assert!(String::from_utf8_lossy(&output.stdout).contains("1 part is free"), "{output:?}");
    assert!(error_of(&run(folder.path(), &flags)).contains("--force"), "the model exists now");
    assert!(run(folder.path(), &[&flags[..], &["--force"]].concat()).status.success());
}

/// Millimeters that are read as meters.
#[test]
fn implausible_sizes_are_remarks() {
    let folder = tempfile::tempdir().expect("expected a folder");
    write_stl(folder.path(), "part.stl", &solid_box([0.2, 0.1, 0.1]), 1000.0);
    let arguments = ["part.stl", "--freedoms", "1500", "--modes", "3", "--force"];
    let text = |extra: &[&str]| {
        let output = run(folder.path(), &[&arguments[..], extra].concat());
        assert!(output.status.success(), "{output:?}");
        String::from_utf8_lossy(&output.stdout).into_owned()
    };
    assert!(text(&[]).contains("is 'm' its --unit?"));
    assert!(!text(&["--unit", "mm"]).contains("--unit?"), "control");
    // Steel in newtons and millimeters.
    let steel = text(&["--unit", "mm", "--material", "E=210000,nu=0.3,rho=7.85e-9"]);
    assert!(steel.contains("E=...e6") && steel.contains("rho=...e12"), "{steel}");
    assert!(!text(&["--unit", "mm", "--material", "E=210e9,nu=0.3,rho=7850"]).contains("e12"), "control");
}

#[test]
fn interrupted_program_leaves_no_file() {
    let folder = tempfile::tempdir().expect("expected a folder");
    write_stl(folder.path(), "body.stl", &ellipsoid([0.5, 0.4, 0.3], 40), 1.0);
    let mut child = program(folder.path(), &["body.stl", "--freedoms", "60000", "--progress", "lines"])
        .stderr(Stdio::piped())
        .stdout(Stdio::null())
        .spawn()
        .expect("expected the program to start");
    // The first line of progress: the computation has begun.
    let mut line = String::new();
    let mut stderr = std::io::BufReader::new(child.stderr.take().expect("expected a pipe"));
    std::io::BufRead::read_line(&mut stderr, &mut line).expect("expected a line");
    assert!(line.starts_with("progress"), "{line}");
    let pid = rustix::process::Pid::from_child(&child);
    rustix::process::kill_process(pid, rustix::process::Signal::INT).expect("expected a signal");
    let deadline = Instant::now() + Duration::from_secs(60);
    while child.try_wait().expect("expected a status").is_none() {
        assert!(Instant::now() < deadline, "the program ignores SIGINT");
        std::thread::sleep(Duration::from_millis(20));
    }
    let status = child.wait().expect("expected a status");
    assert_eq!(std::os::unix::process::ExitStatusExt::signal(&status), Some(2), "{status:?}");
    assert_eq!(std::fs::read_dir(folder.path()).expect("a folder").count(), 1, "only the surface");
}
