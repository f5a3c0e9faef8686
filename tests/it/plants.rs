//! Plants whose domains act on each other, as the server describes them. The built-in tree, and an almond tree of the
//! folder `MODALCAST_DATA`, by default `../shared/data`.

use std::path::Path;
use std::sync::Arc;

use modalcast::config::{BackendChoice, Config};
use modalcast_client::Client;
use modalcast_dynamics::coupled::StaticSystem;
use modalcast_dynamics::loads::DomainLoads;
use modalcast_dynamics::model::Model;
use modalcast_dynamics::parameters::ModalParameters;
use modalcast_model::load::SceneRepository;
use nalgebra::Vector3;

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
        "{}: {} coordinates, {coupled_pairs} of {PAIRS} pairs act on each other, asymmetry {error:.1e}, control {control:.1e}",
        plant.scene, model.coordinate_count
    );
    assert!(error <= 1e-9, "expected an asymmetry of at most 1e-9, got {error:e}");
    assert!(control > 1e-3, "control: expected an asymmetry above 1e-3, got {control:e}");
    assert!(coupled_pairs >= PAIRS / 2, "expected most points to act on each other, got {coupled_pairs} pairs");
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
