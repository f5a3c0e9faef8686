//! Runs that are interrupted or killed, and continue from their checkpoints.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::time::Duration;

use modalcast_client::v1;

use super::fake::{FakeServer, pack, serve};
use super::{beam, run_sim, tree_server, write_vega_files};

/// Long enough that no interrupted run ends before its signal.
const STEPS: usize = 100;

/// A temporary folder with the files of runs.
struct Files(tempfile::TempDir);

impl Files {
    fn new() -> Self {
        Self(tempfile::tempdir().expect("a temporary folder"))
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn text(&self, name: &str) -> String {
        self.path(name).display().to_string()
    }

    /// The files of a record.
    fn record(&self, name: &str) -> [Vec<u8>; 2] {
        ["q.npy", "transforms.npy"].map(|file| std::fs::read(self.path(name).join(file)).expect("a record"))
    }
}

fn start_sim(url: &str, arguments: &[&str]) -> Child {
    let mut command = Command::new(env!("CARGO_BIN_EXE_modalcast-sim"));
    command.args(arguments).args(["--server", url]).stdout(Stdio::null()).stderr(Stdio::null());
    command.spawn().expect("modalcast-sim to start")
}

/// Waits until the server has received `count` steps.
async fn wait_for_steps(server: &FakeServer, count: usize) {
    while server.steps.lock().expect("lock").len() < count {
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
}

async fn wait_for_end(mut child: Child) -> Option<i32> {
    tokio::task::spawn_blocking(move || child.wait()).await.expect("no panic").expect("an ended process").code()
}

/// A bridge with a note of its cubic forces, which are files in the folder.
fn bridge_server(folder: &Path) -> FakeServer {
    let mut domain = beam(0, 0.05);
    domain.wire.notes.insert("vega.cubic".into(), "bridge.cub".into());
    write_vega_files(folder, "bridge", &domain);
    FakeServer::new(vec![domain])
}

/// A server of the scene with a force on the second domain.
fn forced_server() -> FakeServer {
    let mut server = tree_server();
    let force = v1::Force { id: 1, domain: 1, kind: None };
    server.forces =
        vec![v1::AppliedForce { owner: 1, force: Some(force), f_q: pack(&[0.5_f32, 2.0]).into(), rest_point: vec![] }];
    server
}

/// Ctrl-C ends a run with a checkpoint. The rest of the run has the same numbers, times and values, and the record of
/// both processes is that of one.
#[tokio::test(flavor = "multi_thread")]
async fn interrupted_runs_continue_with_the_same_bits() {
    let files = Files::new();
    let folder = files.text("");
    let cases: [(FakeServer, &[&str]); 5] = [
        (tree_server(), &["toy"]),
        (forced_server(), &["toy", "--forces"]),
        (forced_server(), &["toy", "--forces", "--wind", "0"]),
        (bridge_server(files.0.path()), &["toy", "--files", &folder]),
        (tree_server(), &["sweep", "toy"]),
    ];
    for (server, motion) in cases {
        let server = Arc::new(server);
        let url = serve(Arc::clone(&server)).await;
        let (whole, parts, checkpoint) = (files.text("whole"), files.text("parts"), files.text("run.checkpoint"));
        let steps = STEPS.to_string();
        let common = [motion, &["--steps", &steps, "--dt", "0.02", "--json"]].concat();
        let sim_output = run_sim(&url, &[&common[..], &["--record", &whole]].concat()).await;
        assert_eq!(sim_output.exit_code, 0, "{}", sim_output.stderr);
        let whole_steps = std::mem::take(&mut *server.steps.lock().expect("lock"));
        let common = [&common[..], &["--record", &parts, "--checkpoint", &checkpoint]].concat();
        let child = start_sim(&url, &[&common[..], &["--realtime"]].concat());
        wait_for_steps(&server, 30).await;
        let process_id = child.id().to_string();
        assert!(Command::new("kill").args(["-INT", &process_id]).status().expect("kill to start").success());
        assert_eq!(wait_for_end(child).await, Some(0), "{motion:?}");
        let cut = server.steps.lock().expect("lock").len();
        assert!((30..STEPS).contains(&cut), "control: expected an interrupted run, got {cut} steps");
        let sim_output = run_sim(&url, &[&common[..], &["--resume", &checkpoint]].concat()).await;
        assert_eq!(sim_output.exit_code, 0, "{}", sim_output.stderr);
        let report = sim_output.report();
        assert_eq!((report["first_step"].as_u64(), report["rejected"].as_u64()), (Some(cut as u64), Some(0)));
        assert_eq!(files.record("parts"), files.record("whole"), "{motion:?}: another motion after step {cut}");
        let steps = server.steps.lock().expect("lock");
        let stamps = |steps: &[v1::Step]| steps.iter().map(|step| (step.number, step.time)).collect::<Vec<_>>();
        assert_eq!(stamps(&steps), stamps(&whole_steps));
        assert!(steps[cut].transform_domains.len() >= steps[0].transform_domains.len(), "expected all values");
        std::fs::remove_dir_all(files.path("parts")).expect("a record");
    }
}

/// The process is killed several times while it writes a checkpoint after every step.
#[tokio::test(flavor = "multi_thread")]
async fn killed_runs_continue_with_the_same_bits() {
    let files = Files::new();
    let server = Arc::new(tree_server());
    let url = serve(Arc::clone(&server)).await;
    let (whole, parts, checkpoint) = (files.text("whole"), files.text("parts"), files.text("run.checkpoint"));
    let common = ["toy", "--steps", "400"];
    let sim_output = run_sim(&url, &[&common[..], &["--record", &whole]].concat()).await;
    assert_eq!(sim_output.exit_code, 0, "{}", sim_output.stderr);
    let options = ["--record", &parts, "--checkpoint", &checkpoint, "--checkpoint-every", "1"];
    let arguments = [&common[..], &options].concat();
    let resumed_arguments = [&arguments[..], &["--resume", &checkpoint]].concat();
    let mut kills = 0;
    loop {
        server.steps.lock().expect("lock").clear();
        let has_checkpoint = files.path("run.checkpoint").exists();
        let mut child = start_sim(&url, if has_checkpoint { &resumed_arguments } else { &arguments });
        // Up to eight runs are killed, each after some more steps.
        while child.try_wait().expect("a process").is_none() {
            if kills < 8 && server.steps.lock().expect("lock").len() > 10 + 3 * kills {
                child.kill().expect("a running process");
                kills += 1;
            }
            tokio::time::sleep(Duration::from_micros(300)).await;
        }
        match wait_for_end(child).await {
            Some(0) => break,
            // The server has not noticed yet that the killed writer is gone (1), or the process was killed.
            Some(1) | None => {}
            code => panic!("expected 0, got {code:?}"),
        }
    }
    assert_eq!(kills, 8, "control: expected a run that is killed");
    assert_eq!(files.record("parts"), files.record("whole"));
    assert!(!files.path("run.checkpoint.tmp").exists());
}

/// Errors name the difference, and no step is sent.
#[tokio::test(flavor = "multi_thread")]
async fn checkpoint_of_another_run_or_an_invalid_file_is_rejected() {
    let files = Files::new();
    let checkpoint = files.text("run.checkpoint");
    let url = serve(Arc::new(tree_server())).await;
    let sim_output = run_sim(&url, &["toy", "--steps", "20", "--checkpoint", &checkpoint]).await;
    assert_eq!(sim_output.exit_code, 0, "{}", sim_output.stderr);
    let mut stiffer_server = tree_server();
    stiffer_server.domains[1].shape.eigenvalues[0] *= 1.0 + f64::EPSILON;
    let valid = std::fs::read(&checkpoint).expect("a checkpoint");
    let truncated = files.text("truncated");
    std::fs::write(&truncated, &valid[..valid.len() / 2]).expect("a writable folder");
    let altered = files.text("altered");
    let last_digit = valid.iter().rposition(u8::is_ascii_digit).expect("a digit");
    let mut altered_bytes = valid;
    altered_bytes[last_digit] ^= 1;
    std::fs::write(&altered, altered_bytes).expect("a writable folder");
    let cubic = files.text("other.cub");
    std::fs::write(&cubic, b"\x02\0\0\0").expect("a writable folder");
    let folder = files.text("");
    let missing = files.text("missing");
    let cases: [(FakeServer, &[&str], i32, &str); 12] = [
        (tree_server(), &["--resume", &checkpoint], 0, ""),
        (tree_server(), &["--resume", &checkpoint, "--dt", "0.5"], 5, "0.016666666666666666, as in the checkpoint"),
        (tree_server(), &["--resume", &checkpoint, "--slow", "2"], 5, "got 0.008333333333333333"),
        (tree_server(), &["--resume", &checkpoint, "--wind", "0.5"], 5, "--wind of this run: expected "),
        (tree_server(), &["--resume", &checkpoint, "--seed", "8"], 5, "--seed of this run: expected 7, as in the"),
        (tree_server(), &["--resume", &checkpoint, "--forces"], 5, "--forces of this run: expected false, as in the"),
        (stiffer_server, &["--resume", &checkpoint], 5, "scene (SHA-256) of this run"),
        (tree_server(), &["--resume", &truncated], 5, "the file was truncated or altered"),
        (tree_server(), &["--resume", &altered], 5, "the file was altered"),
        (tree_server(), &["--resume", &cubic], 5, "expected a checkpoint of modalcast-sim, got 4 bytes"),
        (tree_server(), &["--resume", &missing], 4, "missing"),
        (tree_server(), &["--resume", &folder], 4, ""),
    ];
    for (server, options, exit_code, message) in cases {
        let server = Arc::new(server);
        let url = serve(Arc::clone(&server)).await;
        let sim_output = run_sim(&url, &[&["toy", "--steps", "40"], options].concat()).await;
        assert_eq!(sim_output.exit_code, exit_code, "{options:?}: {}", sim_output.stderr);
        assert!(sim_output.stderr.contains(message), "expected {message}, got: {}", sim_output.stderr);
        let sent = server.steps.lock().expect("lock").len();
        assert_eq!(sent, if exit_code == 0 { 20 } else { 0 }, "{options:?}");
    }
    let sim_output = run_sim(&url, &["sweep", "toy", "--resume", &checkpoint]).await;
    let message = "motion of this run: expected modes in wind, as in the checkpoint";
    assert!(sim_output.exit_code == 5 && sim_output.stderr.contains(message), "{}", sim_output.stderr);
}

#[tokio::test(flavor = "multi_thread")]
async fn record_continues_only_where_the_checkpoint_has_it() {
    let files = Files::new();
    let (record, checkpoint) = (files.text("record"), files.text("run.checkpoint"));
    let url = serve(Arc::new(tree_server())).await;
    let run =
        async |steps: &str, options: &[&str]| run_sim(&url, &[&["toy", "--steps", steps], options].concat()).await;
    let rows = |name: &str| super::read_npy(&files.path(name).join("q.npy")).len() / 6;
    assert_eq!(run("10", &["--checkpoint", &checkpoint]).await.exit_code, 0);
    // Without a record before, a new one has the later steps.
    let sim_output = run("30", &["--resume", &checkpoint, "--record", &record]).await;
    assert_eq!((sim_output.exit_code, rows("record")), (0, 20), "{}", sim_output.stderr);
    // This record does not belong to the run of the checkpoint.
    let sim_output = run("30", &["--resume", &checkpoint, "--record", &record]).await;
    assert!(sim_output.exit_code == 5 && sim_output.stderr.contains("without --record"), "{}", sim_output.stderr);
    assert_eq!(rows("record"), 20);
    // A record with too few steps.
    let recorded = ["--checkpoint", &checkpoint, "--record", &files.text("other")];
    assert_eq!(run("25", &recorded).await.exit_code, 0);
    let sim_output = run("30", &["--resume", &checkpoint, "--record", &record]).await;
    let message = "expected at least 25 rows, got 20";
    assert!(sim_output.exit_code == 4 && sim_output.stderr.contains(message), "{}", sim_output.stderr);
    // Nothing is left to do.
    let sim_output = run("25", &["--resume", &checkpoint, "--json"]).await;
    assert_eq!((sim_output.exit_code, sim_output.report()["steps_sent"].as_u64()), (0, Some(0)));
    assert!(sim_output.stderr.contains("the checkpoint has all 25 steps"), "{}", sim_output.stderr);
}
