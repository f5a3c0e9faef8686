//! Large motion of volume meshes against the Saint Venant-Kirchhoff material with all freedoms of the same mesh.

mod full_stvk;

use std::collections::BTreeSet;
use std::ops::Range;
use std::path::Path;
use std::process::{Command, Output};
use std::time::Instant;

use full_stvk::{FullSolid, norm};
use modalcast_dynamics::cubic;
use modalcast_model::load::{self, LoadOptions};
use modalcast_modes::assembly::{HELD_NODE, SystemMatrices, dot};
use modalcast_modes::eigensolver::{ElasticModes, find_elastic_modes};
use modalcast_modes::large_motion::{DEFAULT_LINEAR_MODES, add_large_motion};
use modalcast_modes::materials::Material;
use modalcast_modes::reduced_force::{self, ReducedForce};
use modalcast_modes::stvk::StvkSolid;
use modalcast_modes::tet10::{self, NODES, Tet10Matrices};
use modalcast_modes::volume_file;
use modalcast_modes::volume_mesh::{ElementGroup, NO_NODE, VolumeCells, VolumeMesh};
use nalgebra::{DMatrix, DVector, Vector3};
use sha2::{Digest as _, Sha256};

/// A box of six tetrahedra per cube, along x from 0.
fn beam(size: [f64; 3], cubes: [usize; 3]) -> VolumeMesh {
    let points = cubes.map(|count| count + 1);
    let index = |[x, y, z]: [usize; 3]| ((z * points[1] + y) * points[0] + x) as u32;
    let mut cells =
        VolumeCells { groups: vec![ElementGroup { name: "beam".into(), material: None }], ..Default::default() };
    for z in 0..points[2] {
        for y in 0..points[1] {
            for x in 0..points[0] {
                let position = [x, y, z];
                cells
                    .positions
                    .push(Vector3::from_fn(|axis, _| size[axis] * position[axis] as f64 / cubes[axis] as f64));
            }
        }
    }
    const PATHS: [[usize; 3]; 6] = [[0, 1, 2], [1, 0, 2], [1, 2, 0], [2, 1, 0], [2, 0, 1], [0, 2, 1]];
    for z in 0..cubes[2] {
        for y in 0..cubes[1] {
            for x in 0..cubes[0] {
                for path in PATHS {
                    let mut corner = [x, y, z];
                    let mut element = [NO_NODE; NODES];
                    element[0] = index(corner);
                    for (place, axis) in path.into_iter().enumerate() {
                        corner[axis] += 1;
                        element[place + 1] = index(corner);
                    }
                    cells.elements.push(element);
                    cells.element_groups.push(0);
                }
            }
        }
    }
    VolumeMesh::new(cells).expect("expected a mesh")
}

/// A solid, held where x = 0 or free, with its matrices.
struct Model {
    mesh: VolumeMesh,
    material: Material,
    is_held: Vec<bool>,
    /// The number of each node, or [`HELD_NODE`].
    numbers: Vec<u32>,
    element_nodes: Vec<[u32; NODES]>,
    node_count: usize,
    system: SystemMatrices,
    rigid: Vec<Vec<f64>>,
    shift: f64,
}

impl Model {
    fn new(mesh: VolumeMesh, poissons_ratio: f64, is_clamped: bool) -> Self {
        let material = Material::new(1e6, poissons_ratio, 1000.0).expect("expected a material");
        let is_held: Vec<bool> = mesh.positions.iter().map(|position| is_clamped && position.x < 1e-9).collect();
        Self::with_held(mesh, material, is_held)
    }

    /// Free if no node is held.
    fn with_held(mesh: VolumeMesh, material: Material, is_held: Vec<bool>) -> Self {
        let mut node_count = 0;
        let number = |is_held: &bool| match is_held {
            true => HELD_NODE,
            false => {
                node_count += 1;
                node_count - 1
            }
        };
        let numbers: Vec<u32> = is_held.iter().map(number).collect();
        let element_nodes: Vec<[u32; NODES]> =
            mesh.elements.iter().map(|element| element.map(|node| numbers[node as usize])).collect();
        let matrices: Vec<Tet10Matrices> = (0..mesh.elements.len())
            .map(|element| tet10::matrices(&mesh.nodes_of(element), &material).expect("expected an element"))
            .collect();
        let system = SystemMatrices::assemble(&element_nodes, node_count as usize, |element| {
            (&matrices[element].stiffness[..], &matrices[element].mass[..])
        });
        let motion = |displacement: &dyn Fn(&Vector3<f64>) -> Vector3<f64>| -> Vec<f64> {
            mesh.positions.iter().flat_map(|position| <[f64; 3]>::from(displacement(position))).collect()
        };
        let of_axis = |axis: usize| {
            let unit: Vector3<f64> = Vector3::ith(axis, 1.0);
            [motion(&|_| unit), motion(&|position| unit.cross(position))]
        };
        let rigid = if is_held.contains(&true) { vec![] } else { (0..3).flat_map(of_axis).collect() };
        // 1/100 of the eigenvalue of a plate, as for bodies of any shape.
        let (low, high) = mesh.bounds();
        let size = high - low;
        let shift = 0.01 * (material.bar_wave_speed() * size.z / size.x.powi(2)).powi(2);
        let node_count = node_count as usize;
        Self { mesh, material, is_held, numbers, element_nodes, node_count, system, rigid, shift }
    }

    fn solid(&self) -> StvkSolid<'_> {
        StvkSolid::new(&self.mesh, &self.element_nodes, self.node_count, std::slice::from_ref(&self.material))
    }

    fn full(&self) -> FullSolid<'_> {
        FullSolid {
            positions: &self.mesh.positions,
            elements: &self.mesh.elements,
            lame_parameters: self.material.lame_parameters(),
            is_held: self.is_held.clone(),
        }
    }

    fn linear_modes(&self, count: usize) -> ElasticModes {
        find_elastic_modes(&self.system, &self.rigid, self.shift, count, &|_, _| {}).expect("expected modes")
    }

    fn large(&self, linear_modes: usize) -> (ElasticModes, ReducedForce) {
        let mut modes = self.linear_modes(linear_modes);
        let large = add_large_motion(&self.solid(), &self.system, &self.rigid, self.shift, &mut modes, &|_, _| {});
        (modes, large.expect("expected forces").force)
    }

    /// A vector of all freedoms of the mesh, with zeros at held nodes.
    fn to_mesh(&self, vector: &[f64]) -> Vec<f64> {
        let entries = |number: &u32| match *number {
            HELD_NODE => [0.0; 3],
            number => std::array::from_fn(|axis| vector[3 * number as usize + axis]),
        };
        self.numbers.iter().flat_map(entries).collect()
    }

    fn without_held(&self, vector: &[f64]) -> Vec<f64> {
        let free = (0..vector.len()).filter(|freedom| !self.is_held[freedom / 3]);
        free.map(|freedom| vector[freedom]).collect()
    }

    /// U q in all freedoms of the mesh.
    fn displacements(&self, modes: &ElasticModes, q: &[f64]) -> Vec<f64> {
        let entry = |freedom: usize| modes.vectors.iter().zip(q).map(|(vector, q)| vector[freedom] * q).sum();
        self.to_mesh(&(0..3 * self.node_count).map(entry).collect::<Vec<f64>>())
    }

    /// U^T b.
    fn project(&self, modes: &ElasticModes, force: &[f64]) -> Vec<f64> {
        let force = self.without_held(force);
        modes.vectors.iter().map(|vector| dot(vector, &force)).collect()
    }
}

/// The force as the physics process reads it.
fn read_back(force: &ReducedForce) -> cubic::ReducedForce {
    cubic::ReducedForce::parse(&force.encode()).expect("expected a valid file")
}

/// The equilibrium of reduced forces, by Newton's method.
fn reduced_equilibrium(force: &cubic::ReducedForce, load: &[f64], steps: usize) -> Vec<f64> {
    let load = DVector::from_column_slice(load);
    let mut q = DVector::zeros(load.len());
    for step in 1..=steps {
        let target = &load * (step as f64 / steps as f64);
        let mut residual = f64::INFINITY;
        for _ in 0..40 {
            let evaluation = force.evaluate(&q);
            let missing = &target - evaluation.force;
            residual = missing.norm() / load.norm();
            if residual < 1e-11 {
                break;
            }
            q += evaluation.jacobian.lu().solve(&missing).expect("expected an invertible stiffness");
        }
        assert!(residual < 1e-11, "step {step}: residual {residual:e}");
    }
    q.as_slice().to_vec()
}

/// Writes the corners of a mesh in the format of Gmsh 2.2.
fn write_mesh(path: &Path, mesh: &VolumeMesh) {
    let corners = mesh.elements.iter().flat_map(|element| element[..4].to_vec()).collect::<BTreeSet<u32>>();
    let mut text = format!("$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n{}\n", corners.len());
    for node in &corners {
        let [x, y, z]: [f64; 3] = mesh.positions[*node as usize].into();
        text.push_str(&format!("{} {x} {y} {z}\n", node + 1));
    }
    text.push_str(&format!("$EndNodes\n$Elements\n{}\n", mesh.elements.len()));
    for (index, element) in mesh.elements.iter().enumerate() {
        let [a, b, c, d] = [0, 1, 2, 3].map(|corner| element[corner] + 1);
        text.push_str(&format!("{} 4 2 1 1 {a} {b} {c} {d}\n", index + 1));
    }
    text.push_str("$EndElements\n");
    std::fs::write(path, text).expect("expected a writable file");
}

fn run(folder: &Path, arguments: &str) -> Output {
    let program = env!("CARGO_BIN_EXE_modalcast-modes");
    Command::new(program)
        .current_dir(folder)
        .args(arguments.split(' '))
        .output()
        .expect("expected a program that starts")
}

/// The program writes the model and its forces; the loader of the server and the physics process read them.
#[test]
fn program_writes_model_and_forces() {
    let folder = tempfile::tempdir().expect("expected a folder");
    let path = |name: &str| folder.path().join(name);
    write_mesh(&path("arm.msh"), &beam([1.0, 0.1, 0.1], [8, 1, 1]));
    let arguments = "arm.msh --large --material rubber --clamp x<0.001 --json";
    let output = run(folder.path(), arguments);
    assert!(output.status.success(), "{output:?}");
    let result: serde_json::Value = serde_json::from_slice(&output.stdout).expect("expected JSON");
    let safe = result["safe_displacements"].as_array().expect("expected displacements");
    let first = safe[0].as_f64().expect("expected a displacement");
    assert!(result["linear_modes"] == 5 && safe.len() == 5 && (0.3..1.2).contains(&first), "{result}");
    let bytes = std::fs::read(path("arm.cub")).expect("expected a file of forces");
    let force = cubic::ReducedForce::parse(&bytes).expect("expected a valid file");
    let scene = load::open(&path("arm.npz").to_string_lossy()).expect("expected a scene").scene;
    let metadata = &scene.domains[0].metadata;
    assert_eq!((scene.shape_of(0).modes.rank(), metadata.eigenvalues.len(), force.rank()), (20, 20, 20));
    let stiffness = DMatrix::from_diagonal(&DVector::from_column_slice(&metadata.eigenvalues));
    assert_eq!(*force.rest_stiffness(), stiffness);
    let hash: String = Sha256::digest(&bytes).iter().map(|byte| format!("{byte:02x}")).collect();
    assert_eq!((metadata.notes["vega.cubic"].as_str(), &metadata.notes["modes.cubic_sha256"]), ("arm.cub", &hash));
    let error = |arguments: &str| {
        let output = run(folder.path(), arguments);
        assert_eq!(output.status.code(), Some(3), "{output:?}");
        String::from_utf8_lossy(&output.stderr).into_owned()
    };
    std::fs::remove_file(path("arm.npz")).expect("a file");
    assert!(error(arguments).contains("'arm.cub': expected a new file (--force"), "forces are not replaced");
    let size = reduced_force::file_bytes(65).to_string();
    assert!(error("arm.msh --large --modes 10 --force").contains(&size), "the size of larger forces");
    std::fs::write(path("flat.obj"), "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").expect("a file");
    assert!(error("flat.obj --large").contains("--large: expected a volume mesh"), "a surface");
    // Without --large, the forces of other modes remain, but are not used.
    let output = run(folder.path(), "arm.msh --modes 20 --clamp x<0.001");
    assert!(output.status.success(), "{output:?}");
    let scene = load::open(&path("arm.npz").to_string_lossy()).expect("expected a scene").scene;
    assert!(path("arm.cub").exists() && !scene.domains[0].metadata.notes.contains_key("vega.cubic"));
}

/// The surface of a stout block is compressed much more by bending than that of a slender beam.
#[test]
fn stout_block_has_a_smaller_safe_displacement() {
    let safe = |size: [f64; 3], cubes: [usize; 3]| {
        let model = Model::new(beam(size, cubes), 0.3, true);
        let mut modes = model.linear_modes(DEFAULT_LINEAR_MODES);
        let large = add_large_motion(&model.solid(), &model.system, &model.rigid, model.shift, &mut modes, &|_, _| {});
        large.expect("expected forces").safe_ranges[0].displacement / size[0]
    };
    let (slender, stout) = (safe([1.0, 0.05, 0.05], [16, 1, 1]), safe([1.0, 0.8, 0.8], [3, 2, 2]));
    println!("safe displacements: slender {slender}, stout {stout} of the length");
    assert!(stout > 0.0 && stout < 0.5 && slender > 0.5, "slender {slender}, stout {stout}");
}

fn random_numbers(seed: u64, count: usize) -> Vec<f64> {
    let mut random = fastrand::Rng::with_seed(seed);
    (0..count).map(|_| 2.0 * random.f64() - 1.0).collect()
}

fn difference(a: &[f64], b: &[f64]) -> f64 {
    norm(&a.iter().zip(b).map(|(a, b)| a - b).collect::<Vec<f64>>()) / norm(b)
}

/// A load on the nodes of the end face in the direction z, whose linear displacement of the tip is a fraction of the
/// length.
fn tip_load(model: &Model, fraction: f64) -> Vec<f64> {
    let (_, high) = model.mesh.bounds();
    let is_tip = |node: usize| model.mesh.positions[node].x > high.x - 1e-9;
    let load = |freedom: usize| f64::from(u8::from(freedom % 3 == 2 && is_tip(freedom / 3)));
    let load: Vec<f64> = (0..model.is_held.len() * 3).map(load).collect();
    let linear = model.full().linear_equilibrium(&load);
    let tip =
        (0..model.is_held.len()).filter(|node| is_tip(*node)).map(|node| linear[3 * node + 2]).fold(0.0, f64::max);
    load.iter().map(|entry| entry * fraction * high.x / tip).collect()
}

/// Errors of displacements and of the volume against the full solid.
fn errors(model: &Model, exact: &[f64], approximate: &[f64]) -> [f64; 2] {
    let full = model.full();
    let volume = full.volume(approximate) / full.volume(exact) - 1.0;
    [difference(approximate, exact), volume.abs()]
}

/// The guide of the method: 0.5 % with 5 modes and 15 derivatives, 29 % and a volume of +28 % with 20 linear modes.
#[test]
fn cantilever_bends_by_half_its_length_as_the_full_solid() {
    for (size, cubes, poissons_ratio) in
        [([1.0, 0.1, 0.1], [10, 2, 2], 0.3), ([1.0, 0.05, 0.05], [16, 1, 1], 0.3), ([1.0, 0.2, 0.2], [6, 2, 2], 0.45)]
    {
        let model = Model::new(beam(size, cubes), poissons_ratio, true);
        let load = tip_load(&model, 0.5);
        let exact = model.full().equilibrium(&load, 5);
        let (modes, force) = model.large(DEFAULT_LINEAR_MODES);
        assert_eq!(modes.vectors.len(), 20);
        let q = reduced_equilibrium(&read_back(&force), &model.project(&modes, &load), 10);
        let [displacement, volume] = errors(&model, &exact, &model.displacements(&modes, &q));
        println!("{size:?}: displacement {displacement:.2e}, volume {volume:.2e}");
        assert!(displacement <= 0.01 && volume <= 0.01, "{size:?}: {displacement}, volume {volume}");
        let linear = model.linear_modes(20);
        let q: Vec<f64> =
            model.project(&linear, &load).iter().zip(&linear.eigenvalues).map(|(load, k)| load / k).collect();
        let [displacement, volume] = errors(&model, &exact, &model.displacements(&linear, &q));
        println!("    control, 20 linear modes: displacement {displacement:.2e}, volume {volume:.2e}");
        assert!(displacement > 0.2 && volume > 0.1, "control: {displacement}, volume {volume}");
        let force = ReducedForce::integrate(&model.solid(), &linear.vectors).expect("expected forces");
        let q = reduced_equilibrium(&read_back(&force), &model.project(&linear, &load), 10);
        let [displacement, _] = errors(&model, &exact, &model.displacements(&linear, &q));
        println!("    control, cubic forces on 20 linear modes: displacement {displacement:.2e}");
        assert!(displacement > 0.5, "control: {displacement}");
    }
}

/// Reduced forces are U^T f(U q) of the full solid, and the gradient of a potential.
#[test]
fn reduced_forces_are_those_of_the_full_solid() {
    for is_clamped in [true, false] {
        let model = Model::new(beam([1.0, 0.3, 0.2], [4, 2, 1]), 0.35, is_clamped);
        let (modes, force) = model.large(3);
        check_forces(&model, &modes, &force, 0..4);
    }
}

/// Compares forces at random coordinates with U^T f(U q).
fn check_forces(model: &Model, modes: &ElasticModes, force: &ReducedForce, seeds: Range<u64>) {
    let (low, high) = model.mesh.bounds();
    let physics = read_back(force);
    assert_eq!(force.evaluate(&vec![0.0; modes.vectors.len()]), vec![0.0; modes.vectors.len()]);
    for seed in seeds {
        // Displacements of about the size of the body.
        let direction = random_numbers(seed, modes.vectors.len());
        let size = model.displacements(modes, &direction).iter().fold(0.0, |size: f64, entry| size.max(entry.abs()));
        let q: Vec<f64> = direction.iter().map(|entry| entry * (high - low).norm() / size).collect();
        let displacements = model.displacements(modes, &q);
        let exact = model.project(modes, &model.full().force(&displacements));
        let linear: Vec<f64> = q.iter().zip(&modes.eigenvalues).map(|(q, k)| q * k).collect();
        let error = difference(&force.evaluate(&q), &exact);
        assert!(error <= 1e-9, "seed {seed}: {error:e}");
        let evaluation = physics.evaluate(&DVector::from_column_slice(&q));
        let error = difference(evaluation.force.as_slice(), &exact);
        assert!(error <= 1e-9, "seed {seed}: read back: {error:e}");
        assert!(difference(&linear, &exact) > 0.5, "control: linear forces");
        let jacobian = finite_jacobian(force, &q);
        let asymmetry = (&jacobian - jacobian.transpose()).norm() / jacobian.norm();
        assert!(asymmetry <= 1e-10, "seed {seed}: {asymmetry:e}");
        let error = (&jacobian - evaluation.jacobian).norm() / jacobian.norm();
        assert!(error <= 1e-9, "seed {seed}: Jacobian {error:e}");
        let own = force.jacobian(&q);
        assert!((&jacobian - own).norm() <= 1e-9 * jacobian.norm(), "seed {seed}: own Jacobian");
    }
}

/// The bridge of the library Vega, held at the vertices that are fixed there.
#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
fn real_bridge_has_the_forces_of_the_full_solid() {
    let data = std::env::var_os("MODALCAST_DATA");
    let data = data.map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data"), Into::into);
    let path = data.join("vega/volumetric/simpleBridge/simpleBridge-ic_128_0.15_.1.veg");
    let file = volume_file::read(&path.to_string_lossy(), &LoadOptions::default()).expect("expected a mesh");
    let group = file.mesh.node_groups.iter().find(|group| group.name == "simpleBridge.bou").expect("fixed vertices");
    let mut is_held = vec![false; file.mesh.positions.len()];
    group.nodes.iter().for_each(|node| is_held[*node as usize] = true);
    let material = file.mesh.groups[0].material.clone().expect("expected a material");
    let model = Model::with_held(file.mesh, material, is_held);
    let start = Instant::now();
    let mut modes = model.linear_modes(DEFAULT_LINEAR_MODES);
    println!("{} freedoms, linear modes: {:.1} s", 3 * model.node_count, start.elapsed().as_secs_f64());
    let start = Instant::now();
    let large = add_large_motion(&model.solid(), &model.system, &model.rigid, model.shift, &mut modes, &|_, _| {});
    let large = large.expect("expected forces");
    println!(
        "derivatives, forces and limit of displacements: {:.1} s; limits {:?}, frequencies {:?} Hz",
        start.elapsed().as_secs_f64(),
        large.safe_ranges,
        modes.eigenvalues.iter().map(|eigenvalue| eigenvalue.sqrt() / std::f64::consts::TAU).collect::<Vec<_>>()
    );
    check_forces(&model, &modes, &large.force, 1..3);
}

/// The Jacobian of a cubic polynomial by differences: Simpson's rule for derivatives (Richardson) is exact for it.
fn finite_jacobian(force: &ReducedForce, q: &[f64]) -> DMatrix<f64> {
    let step = norm(q);
    let at = |index: usize, offset: f64| {
        let mut moved = q.to_vec();
        moved[index] += offset;
        DVector::from_vec(force.evaluate(&moved))
    };
    let columns: Vec<DVector<f64>> = (0..q.len())
        .map(|index| {
            let wide = (at(index, step) - at(index, -step)) / (2.0 * step);
            let narrow = (at(index, step / 2.0) - at(index, -step / 2.0)) / step;
            (narrow * 4.0 - wide) / 3.0
        })
        .collect();
    DMatrix::from_columns(&columns)
}

/// Linear users of the model see modes: mass-orthonormal vectors that diagonalize the stiffness.
#[test]
fn basis_is_that_of_linear_modes_for_small_motion() {
    for is_clamped in [true, false] {
        let model = Model::new(beam([1.0, 0.3, 0.2], [4, 2, 1]), 0.3, is_clamped);
        let (modes, force) = model.large(4);
        let rank = modes.vectors.len();
        assert_eq!(rank, 14);
        for i in 0..rank {
            let [mass, stiffness] =
                [model.system.apply_mass(&modes.vectors[i]), model.system.apply_stiffness(&modes.vectors[i])];
            for j in 0..rank {
                let expected = f64::from(u8::from(i == j));
                assert!((dot(&modes.vectors[j], &mass) - expected).abs() <= 1e-9, "mass {i}, {j}");
                let scale = (modes.eigenvalues[i] * modes.eigenvalues[j]).sqrt();
                let entry = dot(&modes.vectors[j], &stiffness) / scale;
                assert!((entry - expected).abs() <= 1e-7, "stiffness {i}, {j}: {entry}");
            }
            for motion in &model.rigid {
                let share = dot(motion, &mass) / dot(motion, &model.system.apply_mass(motion)).sqrt();
                assert!(share.abs() <= 1e-8, "vector {i} moves the free body: {share:e}");
            }
        }
        assert!(modes.eigenvalues.is_sorted());
        let linear = model.linear_modes(4);
        assert!(linear.eigenvalues.iter().zip(&modes.eigenvalues).all(|(a, b)| (a / b - 1.0).abs() < 1e-12));
        // The linear term of the integral itself.
        let integral = ReducedForce::integrate(&model.solid(), &modes.vectors).expect("expected forces");
        let pairs = force.stiffness().iter().zip(integral.stiffness());
        let error = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max) / modes.eigenvalues[rank - 1];
        assert!(error <= 1e-9, "{error:e}");
    }
}

#[test]
fn forces_do_not_depend_on_the_number_of_threads() {
    let model = Model::new(beam([1.0, 0.3, 0.2], [5, 2, 2]), 0.3, true);
    let encode = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("expected threads");
        pool.install(|| model.large(3).1.encode())
    };
    let one = encode(1);
    assert_eq!(one, encode(3));
    let softer = Model::new(beam([1.0, 0.3, 0.2], [5, 2, 2]), 0.31, true);
    assert_ne!(one, softer.large(3).1.encode(), "control");
}
