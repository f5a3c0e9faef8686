//! Scenes whose work ends the process. Each server is a process of its own: this test program, restricted to one test.

use std::path::Path;
use std::process::{Command, Output};
use std::sync::Arc;
use std::time::Duration;

use super::testing::{FaultyDeformer, InjectedFault, StripsSource};
use super::*;
use crate::admission::Client;
use crate::hang_guard::HANG_GUARD;
use modalcast_model::scene::RawStepUpdate;

/// Variables of the environment of a server: its state folder, and the q of its fault.
const STATE: &str = "MODALCAST_TEST_CRASH_STATE";
const FAULT: &str = "MODALCAST_TEST_CRASH_FAULT";

/// The test that is the server.
const SERVER_TEST: &str = "engine::crash_tests::server_with_fault";

async fn start_engine(state: &Path) -> Engine {
    let device_work_limit = Duration::from_secs(5);
    let config = Config { state: state.to_owned(), stall_budget: HANG_GUARD, device_work_limit, ..Config::default() };
    let config = Arc::new(config.validated().expect("expected a valid configuration"));
    let open_device = || DeviceContext::with_deformer(FaultyDeformer::boxed);
    let engine = Engine::start_with_device(config, Arc::new(StripsSource), open_device).await;
    let engine = engine.expect("expected a running engine");
    let mut reopened = engine.watch_reopening();
    let reopened = tokio::time::timeout(HANG_GUARD, reopened.wait_for(|is_reopened| *is_reopened)).await;
    reopened.expect("expected the end of the openings").expect("expected a running engine");
    engine
}

/// Sends steps with the same coordinate to a scene for ever.
async fn send_steps(scene: Arc<SceneHandle>, q: f32) {
    let mut writer = scene.drive("test", crate::engine::lossless_lease(4)).await.expect("expected the writer lease");
    for number in 1.. {
        let q = bytes::Bytes::copy_from_slice(bytemuck::cast_slice(&[q, 0.0]));
        let step = RawStepUpdate { number, q_domains: vec![0], q, ..RawStepUpdate::default() };
        if writer.push_step(step).await.is_err() || writer.next_report().await.is_err() {
            return;
        }
    }
}

/// A server with two busy scenes, until the scene `faulty` has the fault. Not a test unless [`run_server`] starts it.
#[test]
fn server_with_fault() {
    let (Some(state), Ok(q)) = (std::env::var_os(STATE), std::env::var(FAULT)) else { return };
    let q = q.parse::<f32>().expect("expected a number");
    let runtime = tokio::runtime::Runtime::new().expect("expected a runtime");
    let loss = runtime.block_on(async {
        let engine = start_engine(state.as_ref()).await;
        for (name, q) in [("control", 0.25), ("faulty", q)] {
            let scene =
                engine.open("strips", name, &Principal::owner(), Client::Server).await.expect("expected an open scene");
            tokio::spawn(send_steps(scene, q));
        }
        tokio::time::timeout(HANG_GUARD, engine.device_lost()).await
    });
    // The exit code of a server whose device is lost.
    std::process::exit(if loss.is_ok() { 7 } else { 1 });
}

/// Runs a server until the fault has ended it.
fn run_server(state: &Path, fault: InjectedFault) -> Output {
    let program = std::env::current_exe().expect("expected the path of the program");
    let mut server = Command::new(program);
    server.args(["--exact", SERVER_TEST, "--nocapture"]).env(STATE, state).env(FAULT, fault.q().to_string());
    let output = server.output().expect("expected a server");
    // No code: a signal.
    assert!(matches!(output.status.code(), None | Some(7)), "expected the fault, got {output:?}");
    output
}

/// The names of the open scenes, and the failed ones with their errors.
fn list(engine: &Engine) -> (Vec<String>, Vec<(String, String)>) {
    let SceneList { open, failed, .. } = engine.list(&Principal::owner());
    let failed = failed.into_iter().map(|failed| (failed.name, failed.error.to_string()));
    (open.iter().map(|scene| scene.name.clone()).collect(), failed.collect())
}

fn both_open() -> (Vec<String>, Vec<(String, String)>) {
    (vec!["control".into(), "faulty".into()], Vec::new())
}

/// Checks that the faulty scene, and no other, is set aside after two starts, until it is opened by name.
async fn check_set_aside(fault: InjectedFault, cause: &str) {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let first = run_server(folder.path(), fault);
    if fault == InjectedFault::StackOverflow {
        let text = String::from_utf8_lossy(&first.stderr);
        assert!(text.contains("has overflowed its stack"), "expected the message of the standard library, got {text}");
    }
    let engine = start_engine(folder.path()).await;
    assert_eq!(list(&engine), both_open(), "{fault:?}: expected both scenes after one crash");
    engine.shutdown().await;
    run_server(folder.path(), fault);
    // Starts without a crash do not end it.
    for _ in 0..4 {
        let engine = start_engine(folder.path()).await;
        let (open, failed) = list(&engine);
        assert_eq!(open, ["control"], "{fault:?}");
        let [(name, reason)] = &failed[..] else { panic!("{fault:?}: expected one scene, got {failed:?}") };
        assert!(name == "faulty" && reason.contains(cause), "{fault:?}: expected {cause}, got {name}: {reason}");
        engine.shutdown().await;
    }
    let engine = start_engine(folder.path()).await;
    engine.open("", "faulty", &Principal::owner(), Client::Server).await.expect("expected an open scene");
    assert_eq!(list(&engine), both_open(), "{fault:?}: expected the opened scene");
    engine.shutdown().await;
    let engine = start_engine(folder.path()).await;
    assert_eq!(list(&engine), both_open(), "{fault:?}: expected the opened scene after a restart, too");
    engine.shutdown().await;
}

#[tokio::test]
async fn scene_that_aborts_twice_is_set_aside() {
    check_set_aside(InjectedFault::Abort, "SIGABRT").await;
}

#[tokio::test]
async fn scene_that_overflows_the_stack_twice_is_set_aside() {
    check_set_aside(InjectedFault::StackOverflow, "SIGABRT").await;
}

#[tokio::test]
async fn scene_that_hangs_twice_is_set_aside() {
    check_set_aside(InjectedFault::Endless, "watchdog").await;
}

/// Signals of other processes and missing memory end the process while the scene's step is computed.
#[tokio::test]
async fn causes_outside_the_process_set_no_scene_aside() {
    for fault in [InjectedFault::Kill, InjectedFault::SentAbort, InjectedFault::FailedAllocation] {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        for _ in 0..2 {
            run_server(folder.path(), fault);
        }
        let engine = start_engine(folder.path()).await;
        assert_eq!(list(&engine), both_open(), "{fault:?}");
        engine.shutdown().await;
    }
}

#[tokio::test]
async fn deleted_scene_leaves_no_crashes() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    run_server(folder.path(), InjectedFault::Abort);
    let engine = start_engine(folder.path()).await;
    engine.close("faulty", &Principal::owner()).await.expect("expected a deleted scene");
    engine.shutdown().await;
    run_server(folder.path(), InjectedFault::Abort);
    let engine = start_engine(folder.path()).await;
    assert_eq!(list(&engine), both_open(), "expected one crash of the new scene");
    engine.shutdown().await;
}

#[tokio::test]
async fn damaged_crash_log_is_ignored() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    for damage in [&b"\xff\xfe"[..], b"modalcast crashes 2\n", b"modalcast crashes 1\ncrash SIGABRT faulty\n"] {
        std::fs::write(folder.path().join("crashes"), damage).expect("expected a written file");
        let engine = start_engine(folder.path()).await;
        engine.open("strips", "faulty", &Principal::owner(), Client::Server).await.expect("expected an open scene");
        engine.shutdown().await;
    }
    // The server records crashes again.
    for _ in 0..2 {
        run_server(folder.path(), InjectedFault::Abort);
    }
    let engine = start_engine(folder.path()).await;
    assert_eq!(list(&engine).0, ["control"]);
    engine.shutdown().await;
}
