use std::time::Duration;

use super::*;
use crate::admission::Client;
use crate::config::{BackendChoice, Config, RendererChoice};
use crate::engine::testing::{InjectedFault, StripsSource};
use crate::identity::Principal;
use modalcast_model::error::Error;
use modalcast_model::views::ViewOutputs;

fn settings(worlds: usize, cameras: usize, pairing: Pairing) -> ViewSettings {
    let outputs = ViewOutputs { depth: true, ..ViewOutputs::default() };
    let format = ViewFormat { width: 8, height: 8, outputs, depth_scale: 1.0, depth_includes_ground: false };
    let view =
        modalcast_model::scene::View::LookAt { eye: [0.5, 0.5, 3.0], target: [0.5, 0.5, 0.0], up: [0.0, 1.0, 0.0] };
    let camera = Camera { view, lens: modalcast_model::scene::Lens::FieldOfView(40.0), near: 0.0, far: 0.0 };
    ViewSettings { worlds, format, cameras: vec![camera; cameras].into(), pairing }
}

#[test]
fn every_camera_sees_every_world_or_one_each() {
    let every = settings(3, 2, Pairing::Every);
    let pairs = |settings: &ViewSettings| -> Vec<[u32; 2]> {
        (0..settings.views()).map(|view| settings.view(view)).map(|view| [view.world, view.camera]).collect()
    };
    assert_eq!(pairs(&every), [[0, 0], [0, 1], [1, 0], [1, 1], [2, 0], [2, 1]]);
    assert_eq!([0, 1, 3].map(|worlds| every.drawn_views(worlds)), [Ok(6), Ok(2), Ok(6)]);
    assert!(every.drawn_views(4).is_err());
    let one = settings(3, 2, Pairing::One([2, 0].into()));
    assert_eq!(pairs(&one), [[2, 0], [0, 1]]);
    assert!(one.drawn_views(0) == Ok(2) && one.drawn_views(1).is_err());
}

/// An engine with the open scene `strips`, whose deformers inject faults.
async fn start_engine(folder: &tempfile::TempDir) -> (Engine, Arc<SceneHandle>) {
    let config = Config {
        state: folder.path().to_owned(),
        backend: BackendChoice::Reference,
        renderer: RendererChoice::Off,
        ..Config::default()
    };
    let config = Arc::new(config.validated().expect("expected a valid configuration"));
    let open = || crate::engine::DeviceContext::with_deformer(crate::engine::testing::FaultyDeformer::boxed);
    let engine = Engine::start_with_device(config, Arc::new(StripsSource), open).await.expect("expected an engine");
    let scene = engine.open("strips", "strips", &Principal::owner(), Client::Server).await.expect("expected a scene");
    (engine, scene)
}

fn update(q: f32) -> ViewUpdate {
    let q = bytes::Bytes::copy_from_slice(bytemuck::cast_slice(&[q, 0.0]));
    let step = RawStepUpdate { number: 1, q_domains: vec![0], q, ..RawStepUpdate::default() };
    ViewUpdate { step, ..ViewUpdate::default() }
}

async fn draw(session: &ViewSession, q: f32) -> Result<Arc<DrawnViews>> {
    let mut step = session.prepare(update(q)).await?;
    session.draw_next(&mut step).expect("expected views").wait().await
}

/// A fault in the worlds of one caller does not end the scene, and a panic ends neither of them.
#[tokio::test]
async fn faults_of_worlds_leave_the_scene_alone() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let (engine, scene) = start_engine(&folder).await;
    let account = Account::server();
    let session = engine.open_views(&scene, &account, settings(2, 1, Pairing::Every)).await.expect("expected worlds");
    let expected = draw(&session, 0.25).await.expect("expected pictures").arrays.clone();
    let other = draw(&session, 0.5).await.expect("expected pictures").arrays.clone();
    assert!(expected != other, "control: expected another picture of another state");
    for fault in [InjectedFault::PanicInDeform, InjectedFault::Fault] {
        let error = draw(&session, fault.q()).await.expect_err("expected the fault");
        assert!(matches!(error, Error::Fault { .. }), "{error}");
        assert_eq!(draw(&session, 0.25).await.expect("expected pictures").arrays, expected, "{fault:?}");
        assert!(engine.find("strips").is_ok());
    }
}

#[tokio::test]
async fn dropped_sessions_return_their_memory() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let (engine, scene) = start_engine(&folder).await;
    let reserved = || engine.memory_use().map(|(_, memory)| memory.reserved).sum::<u64>();
    let (before, account) = (reserved(), Account::server());
    let session = engine.open_views(&scene, &account, settings(100, 1, Pairing::Every)).await.expect("expected worlds");
    assert!(reserved() > before, "control: expected reserved memory");
    drop(session);
    let returned = async {
        while reserved() > before {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    };
    tokio::time::timeout(crate::hang_guard::HANG_GUARD, returned).await.expect("expected the memory to be returned");
}

/// A client that opens calls as long as it can leaves some for another principal.
#[tokio::test]
async fn calls_of_one_client_leave_some_for_others() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let (engine, scene) = start_engine(&folder).await;
    let account = |principal: &str| Account { principal: Some(principal.into()), client: Client::Connection(1) };
    let open =
        async |principal: &str| engine.open_views(&scene, &account(principal), settings(1, 1, Pairing::Every)).await;
    let mut of_anna = Vec::new();
    let refusal = loop {
        match open("anna").await {
            Ok(session) => of_anna.push(session),
            Err(error) => break error,
        }
    };
    assert!(matches!(refusal, Error::LimitReached { .. }), "{refusal}");
    assert_eq!(of_anna.len(), 56, "expected 8 of 64 to be left");
    open("ben").await.expect("expected one of the others");
    of_anna.truncate(40);
    let returned = async {
        while open("anna").await.is_err() {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    };
    tokio::time::timeout(crate::hang_guard::HANG_GUARD, returned).await.expect("expected a returned permit");
}
