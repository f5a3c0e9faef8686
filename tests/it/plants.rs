//! Plants whose domains act on each other, from the server's description to the drawn vertices. The built-in tree, and
//! an almond tree of the folder `MODALCAST_DATA`, by default `../shared/data`.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use modalcast::config::{BackendChoice, Config};
use modalcast_client::{
    Attribute, Client, Delivery, Force, ForceKind, ForceRequest, SceneDescription, ShapeArray, SurfaceForce,
    VertexRequest, VertexSelection,
};
use modalcast_dynamics::coupled::{CoupledModes, StaticSystem};
use modalcast_dynamics::deflection::{VertexForce, VertexName, report_deflections};
use modalcast_dynamics::integrator::{Integrator as _, LoadChange, MotionState};
use modalcast_dynamics::loads::DomainLoads;
use modalcast_dynamics::model::Model;
use modalcast_dynamics::parameters::{ModalParameters, ModeParameters};
use modalcast_dynamics::run::{RunOptions, drive_scene};
use modalcast_dynamics::tree::{TreeOptions, TreeScenario};
use modalcast_model::load::SceneRepository;
use nalgebra::{DVector, Vector3};

use crate::deformers::TestRng;
use crate::real::input_path;
use crate::service_harness::{Server, config};

/// Surface samples per domain, as `modalcast-sim` reads them of a tree.
const SAMPLES: usize = 24;

/// Pairs of points of a test of reciprocity.
const PAIRS: usize = 100;

/// A scene on a running server.
struct Plant {
    _server: Server,
    client: Client,
    scene: String,
    _state: tempfile::TempDir,
}

impl Plant {
    /// Opens a source. `folder` is the server's folder of scenes.
    async fn open(source: &str, folder: Option<&Path>) -> Self {
        let state = tempfile::tempdir().expect("expected a temporary folder");
        let repository = SceneRepository::new(folder).expect("expected the folder of scenes");
        let config = Config { backend: BackendChoice::Cpu, ..config(state.path()) };
        let server = Server::start_from(config, Arc::new(repository)).await;
        let scene = server.open(source).await.scene;
        let client = Client::connect(&server.address).await.expect("expected a connection");
        Self { _server: server, client, scene, _state: state }
    }

    async fn model(&self) -> Model {
        Model::fetch(&self.client, &self.scene, SAMPLES).await.expect("expected a valid scene")
    }
}

fn open_almond() -> impl Future<Output = Plant> {
    let folder = input_path("");
    async move { Plant::open("plants/almond", Some(Path::new(&folder))).await }
}

/// A sample of a domain, and a direction.
struct Point {
    domain: usize,
    sample: usize,
    direction: Vector3<f64>,
}

impl Point {
    fn random(model: &Model, random: &mut TestRng) -> Self {
        let mut index = |count: usize| ((f64::from(random.next()) + 1.0) / 2.0 * count as f64) as usize % count;
        let domain = index(model.domains.len());
        let sample = index(model.domains[domain].samples.len());
        let direction = Vector3::from_fn(|_, _| f64::from(random.next())).normalize();
        Self { domain, sample, direction }
    }
}

/// c(A, B), the displacement at A under a unit force at B, is c(B, A).
async fn assert_compliances_are_reciprocal(plant: &Plant) {
    let model = plant.model().await;
    let system = StaticSystem::new(&model, &ModalParameters::read(&model).expect("expected eigenvalues"))
        .expect("expected a valid scene");
    // Without its moment about the joints, a force does not do the work of the motion: the control.
    let compliance = |at: &Point, of: &Point, has_moment: bool| {
        let mut loads = DomainLoads::none(&model);
        loads.add_force(&model, of.domain, &model.domains[of.domain].samples[of.sample], &of.direction);
        if !has_moment {
            loads.wrenches[of.domain].fixed_rows_mut::<3>(3).fill(0.0);
        }
        let sample = &model.domains[at.domain].samples[at.sample];
        system.solve(&loads).displacement(&model, at.domain, sample).dot(&at.direction)
    };
    let mut random = TestRng(44);
    let (mut error, mut control, mut coupled_pairs) = (0.0_f64, 0.0_f64, 0);
    for _ in 0..PAIRS {
        let [a, b] = [(); 2].map(|()| Point::random(&model, &mut random));
        let scale = (compliance(&a, &a, true) * compliance(&b, &b, true)).sqrt().max(f64::MIN_POSITIVE);
        let asymmetry = |has_moment| (compliance(&a, &b, has_moment) - compliance(&b, &a, has_moment)).abs() / scale;
        error = error.max(asymmetry(true));
        control = control.max(asymmetry(false));
        coupled_pairs += usize::from(compliance(&a, &b, true).abs() > 1e-6 * scale);
    }
    println!(
        "{}: {} coordinates, {coupled_pairs} of {PAIRS} pairs act on each other, asymmetry {error:.1e}, \
         control {control:.1e}",
        plant.scene, model.coordinate_count
    );
    assert!(error <= 1e-9, "expected an asymmetry of at most 1e-9, got {error:e}");
    assert!(control > 1e-3, "control: expected an asymmetry above 1e-3, got {control:e}");
    assert!(coupled_pairs >= PAIRS / 2, "expected most points to act on each other, got {coupled_pairs} pairs");
}

/// The domains from the root to a domain.
fn path_to(model: &Model, domain: usize) -> Vec<usize> {
    let mut path = vec![domain];
    while let Some(carrier) = model.domains[path[path.len() - 1]].carrier() {
        path.push(carrier);
    }
    path.reverse();
    path
}

/// The triangle and the corner of a vertex.
fn triangle_at(description: &SceneDescription, domain: usize, vertex: u32) -> (u32, [f64; 3]) {
    let shape = description.shape_of(&description.domains[domain]);
    let is_at = |corner: &u32| shape.corner_vertices[*corner as usize] == vertex;
    let index = shape.indices.iter().position(is_at).expect("expected a triangle at the vertex");
    let mut barycentric = [0.0; 3];
    barycentric[index % 3] = 1.0;
    ((index / 3) as u32, barycentric)
}

/// Drives a scene with the forces of its viewers for a minute of its time.
async fn run_until_rest(client: &Client, model: &mut Model) {
    // The rest shape does not depend on the damping, with which the motion ends sooner.
    model.domains.iter_mut().for_each(|domain| drop(domain.notes.insert("damping_ratio".into(), "0.7".into())));
    let options = TreeOptions { dt: 0.1, wind_speed: 0.0, direction_radians: 0.0, seed: 0 };
    let mut scenario = TreeScenario::new(model.clone(), options).expect("expected a valid scenario");
    let run = RunOptions {
        steps: Some(600),
        dt: options.dt,
        slow: 1.0,
        delivery: Delivery::Lossless,
        stall_budget: None,
        window: None,
        realtime: false,
        applies_viewer_forces: true,
        record_folder: None,
        checkpoint: None,
        resume_path: None,
    };
    let (_stop_sender, stop) = tokio::sync::watch::channel(false);
    let summary = drive_scene(client, &mut scenario, &run, &stop).await.expect("expected a complete run");
    assert_eq!((summary.sent_steps, summary.rejected_steps), (600, 0));
    assert!(!summary.report["remarks"].to_string().contains("scaled"), "expected a force that is not scaled");
}

/// A viewer holds a force at the tip of a twig until the plant rests. Every domain that carries the twig is drawn where the
/// `static` command says.
async fn assert_held_force_deflects_as_static(plant: &Plant, is_twig: impl Fn(&str) -> bool, force: [f64; 3]) {
    let Plant { client, scene, .. } = plant;
    let mut model = plant.model().await;
    let twigs = (0..model.domains.len()).filter(|domain| is_twig(&model.domains[*domain].name));
    let twig = twigs.max_by_key(|domain| path_to(&model, *domain).len()).expect("expected a twig");
    let path = path_to(&model, twig);
    assert!(path.len() >= 3, "expected a twig on a branch, got {} domains", path.len());
    let arrays = [ShapeArray::RestPositions, ShapeArray::Indices, ShapeArray::CornerVertices];
    let description = client.describe(scene, &arrays).await.expect("expected a description");
    // In each domain of the path, the vertex that is farthest from its origin.
    let tip = |domain: usize| {
        let shape = description.shape_of(&description.domains[domain]);
        let distance = |vertex: &u32| {
            let used = shape.corner_vertices.contains(vertex);
            let position = &shape.rest_positions[3 * *vertex as usize..][..3];
            if used { position.iter().map(|x| x * x).sum::<f32>() } else { -1.0 }
        };
        (0..shape.vertex_count as u32).max_by(|a, b| distance(a).total_cmp(&distance(b))).expect("expected a vertex")
    };
    let tips: Vec<u32> = path.iter().map(|domain| tip(*domain)).collect();
    let name = |position: usize| VertexName { domain: path[position].to_string(), vertex: tips[position] };
    let forces = [VertexForce { vertex: name(path.len() - 1), force }];
    let vertices: Vec<VertexName> = (0..path.len()).map(name).collect();
    let report = report_deflections(client, &model, &forces, &vertices).await.expect("expected a static response");

    let (triangle, barycentric) = triangle_at(&description, twig, tips[path.len() - 1]);
    let kind = ForceKind::Surface(SurfaceForce { triangle, barycentric, vector: force });
    let request = ForceRequest::new(scene, &[7; 16]).force(Force { id: 1, domain: twig as u32, kind });
    client.apply_forces(&request).await.expect("expected a valid force");
    let (renewing_client, renewed) = (client.clone(), request);
    let renewal = tokio::spawn(async move {
        loop {
            tokio::time::sleep(Duration::from_millis(300)).await;
            renewing_client.apply_forces(&renewed).await.expect("expected a valid force");
        }
    });
    run_until_rest(client, &mut model).await;
    renewal.abort();

    let domains: Vec<u32> = path.iter().map(|domain| *domain as u32).collect();
    let selection = VertexSelection::default().domains(&domains).attribute(Attribute::Positions);
    let drawn = client.get_vertices(&VertexRequest::new(scene, selection)).await.expect("expected vertices");
    // Positions are f32.
    let rounding = f64::from(f32::EPSILON) * model.diagonal();
    for (ordinal, domain) in path.iter().enumerate() {
        let start = drawn.float_range(ordinal).expect("expected positions").start + 3 * tips[ordinal] as usize;
        let position = Vector3::from_fn(|axis, _| f64::from(drawn.positions[start + axis]));
        let shape = description.shape_of(&description.domains[*domain]);
        let rest_position =
            Vector3::from_fn(|axis, _| f64::from(shape.rest_positions[3 * tips[ordinal] as usize + axis]));
        let displacement = position - model.domains[*domain].placement.apply(&rest_position);
        let number = |axis: usize| report["at"][ordinal]["displacement"][axis].as_f64().expect("expected a number");
        let expected = Vector3::from_fn(|axis, _| number(axis));
        let error = (displacement - expected).norm();
        let name = &model.domains[*domain].name;
        println!("{scene}: {name}: {:.3e}, relative error {:.1e}", expected.norm(), error / expected.norm());
        assert!(expected.norm() > 20.0 * rounding, "{name}: expected a visible deflection, got {expected}");
        assert!(error <= 1e-2 * expected.norm(), "{name}: expected the displacement {expected}, got {displacement}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn tree_has_reciprocal_compliances() {
    assert_compliances_are_reciprocal(&Plant::open("tree", None).await).await;
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
async fn real_almond_has_reciprocal_compliances() {
    assert_compliances_are_reciprocal(&open_almond().await).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn held_force_deflects_the_tree_as_static() {
    let plant = Plant::open("tree", None).await;
    assert_held_force_deflects_as_static(&plant, |_| true, [0.0, 0.0, 0.02]).await;
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
async fn real_held_force_deflects_the_almond_as_static() {
    let plant = open_almond().await;
    assert_held_force_deflects_as_static(&plant, |name| name.starts_with("shoot "), [0.02, 0.0, 0.0]).await;
}

/// Largest relative change of the energy of an undamped scene that moves freely, in steps of 1/60 s. All modes start with
/// about the same energy.
fn measure_energy_drift(mut model: Model, steps: usize) -> f64 {
    model.domains.iter_mut().for_each(|domain| drop(domain.notes.insert("damping_ratio".into(), "0".into())));
    let parameters = ModalParameters::read(&model).expect("expected eigenvalues");
    let modes = CoupledModes::new(&model, &parameters, 1.0 / 60.0).expect("expected a valid scene");
    let mut random = TestRng(45);
    let amplitude = |mode: &Option<ModeParameters>| mode.map_or(0.0, |mode| 0.1 / mode.eigenvalue.sqrt());
    let q = parameters.modes.iter().map(|mode| amplitude(mode) * f64::from(random.next()));
    let mut state = MotionState::resting(DVector::from_iterator(model.coordinate_count, q));
    let start = modes.energy(&model, &state);
    let none = DVector::zeros(model.coordinate_count);
    let mut drift = 0.0_f64;
    for step in 1..=steps {
        modes.advance(&mut state, LoadChange { start: &none, end: &none }).expect("expected a step");
        if step % 100 == 0 {
            drift = drift.max((modes.energy(&model, &state) / start - 1.0).abs());
        }
    }
    println!("{}: {} coordinates, {steps} steps: energy drift {drift:.1e}", model.scene, model.coordinate_count);
    assert!(state.v.norm() > 0.0, "expected a motion");
    drift
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
async fn real_undamped_almond_conserves_energy() {
    let model = open_almond().await.model().await;
    assert!(model.coordinate_count >= 4500, "expected at least 4,500 coordinates, got {}", model.coordinate_count);
    let drift = measure_energy_drift(model, 2000);
    assert!(drift <= 1e-9, "expected a drift of at most 1e-9, got {drift:e}");
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "the long run of the test above: minutes"]
async fn undamped_almond_conserves_energy_over_1e5_steps() {
    let drift = measure_energy_drift(open_almond().await.model().await, 100_000);
    assert!(drift <= 1e-9, "expected a drift of at most 1e-9, got {drift:e}");
}
