//! The program `modalcast-record`: signals, kill -9, and exit codes.

use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

use modalcast_client::{Client, Delivery, DriveRequest};
use modalcast_recording::Recording;

use crate::harness::{Renderer, Server, new_file, step, upload_pair};

const PROGRAM: &str = env!("CARGO_BIN_EXE_modalcast-record");

/// A recorder that is subscribed to the scene `pair`.
struct Recorder {
    process: Child,
    lines: std::io::Lines<BufReader<std::process::ChildStdout>>,
}

impl Recorder {
    fn start(url: &str, path: &Path) -> Self {
        let mut process = Command::new(PROGRAM)
            .args(["record", "pair", "--server", url, "--out"])
            .arg(path)
            .stdout(Stdio::piped())
            .spawn()
            .expect("a process");
        let mut lines = BufReader::new(process.stdout.take().expect("a pipe")).lines();
        assert_eq!(lines.next().expect("a line").expect("text"), "ready");
        Self { process, lines }
    }
}

/// Drives the scene until `condition` holds, at most 100 steps per second. Returns the number of steps.
async fn drive_until(client: &Client, condition: impl Fn(u64) -> bool) -> u64 {
    let mut stream = client.drive(&DriveRequest::new("pair", Delivery::Lossless)).await.expect("a stream");
    let mut number = 0;
    while !condition(number) {
        stream.step(&step(number, 2)).await.expect("an accepted step");
        stream.flush().await.expect("an acknowledged step");
        number += 1;
        tokio::time::sleep(std::time::Duration::from_millis(10)).await;
    }
    stream.finish().await.expect("acknowledged steps");
    number
}

fn count_states(path: &Path) -> u64 {
    let mut states = Recording::open(path).expect("a recording").states(0, u64::MAX).expect("states");
    let mut count = 0;
    while let Some(recorded) = states.next().expect("a state") {
        assert_eq!(recorded.state.step.number, count);
        count += 1;
    }
    count
}

fn run(arguments: &[&str]) -> Output {
    Command::new(PROGRAM).args(arguments).output().expect("a process")
}

fn text(path: &Path) -> String {
    path.display().to_string()
}

/// The recorder is interrupted while the file has some of the states. All that it has received are in the file, also
/// those of the chunk that was open.
#[tokio::test(flavor = "multi_thread")]
async fn interrupt_ends_a_recording_without_loss() {
    let server = Server::start_with(Renderer::Off).await;
    upload_pair(&server.client, "pair", 1.0).await;
    let (folder, path) = new_file("pair.mcap");
    let mut recorder = Recorder::start(&server.url, &path);
    let probe = folder.path().join("probe.mcap");
    let has_states = |number| number >= 20 && modalcast_recording::recover(&path, &probe).is_ok();
    let steps = drive_until(&server.client, has_states).await;
    let pid = rustix::process::Pid::from_child(&recorder.process);
    rustix::process::kill_process(pid, rustix::process::Signal::INT).expect("a running process");
    let summary = recorder.lines.next().expect("a summary").expect("text");
    assert!(recorder.process.wait().expect("an end").success(), "{summary}");
    let states = count_states(&path);
    assert!((count_states(&probe)..=steps).contains(&states), "{states} of {steps}");
    assert!(summary.contains(&format!("{states} states")), "{summary}");
}

/// The chunks that were in the file when the recorder was killed are recovered.
#[tokio::test(flavor = "multi_thread")]
async fn killed_recorder_loses_the_open_chunk_only() {
    let server = Server::start_with(Renderer::Off).await;
    upload_pair(&server.client, "pair", 1.0).await;
    let (folder, path) = new_file("pair.mcap");
    let mut recorder = Recorder::start(&server.url, &path);
    // A recovery succeeds once the file has a chunk with states.
    let probe = folder.path().join("probe.mcap");
    let steps = drive_until(&server.client, |_| modalcast_recording::recover(&path, &probe).is_ok()).await;
    recorder.process.kill().expect("a running process");
    recorder.process.wait().expect("an end");
    let out = folder.path().join("recovered.mcap");
    let output = run(&["recover", &text(&path), "--out", &text(&out)]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let states = count_states(&out);
    assert!(states > 0 && states <= steps, "{states} of {steps}");
    assert_eq!(run(&["export", &text(&path), "--to", "npz", "--out", "x.npz"]).status.code(), Some(3));
}

#[tokio::test(flavor = "multi_thread")]
async fn errors_exit_with_the_documented_codes() {
    let server = Server::start_with(Renderer::Off).await;
    upload_pair(&server.client, "pair", 1.0).await;
    let (folder, path) = new_file("pair.mcap");
    let out = text(&path);
    let record = |arguments: &[&str]| {
        let arguments = [&["record"], arguments, &["--out", &out]].concat();
        run(&arguments).status.code()
    };
    assert_eq!(record(&["pair", "--server", &server.url, "--duration", "0"]), Some(0));
    assert_eq!(record(&["missing", "--server", &server.url]), Some(4));
    assert_eq!(record(&["pair", "--server", "http://127.0.0.1:1"]), Some(5));
    assert_eq!(record(&["pair", "--speed", "1"]), Some(2));
    let missing = text(&folder.path().join("missing.mcap"));
    assert_eq!(run(&["replay", &missing]).status.code(), Some(4));
    let no_file = text(&folder.path().join("no/such/folder.mcap"));
    assert_eq!(run(&["recover", &missing, "--out", &no_file]).status.code(), Some(4));
    // Formats without times that could be changed.
    for format in ["npz", "png"] {
        let output = run(&["export", &out, "--to", format, "--slow", "2", "--out", &missing]);
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.code() == Some(3) && message.contains("--slow: expected 1"), "{message}");
    }
    let video = text(&folder.path().join("x.mp4"));
    let arguments =
        ["export", &out, "--to", "video", "--out", &video, "--server", &server.url, "--ffmpeg", "./no-ffmpeg"];
    let output = run(&arguments);
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    // The recording has no states and the server has no renderer, but ffmpeg is started first, so that its error is
    // reported.
    assert!(output.status.code() == Some(5) && message.contains("no-ffmpeg"), "{message}");
    // The hash of the build.
    assert_eq!(String::from_utf8_lossy(&run(&["--build"]).stdout).trim().len(), 16);
}

/// A substitute for ffmpeg: copies its standard input to the file that is its last argument.
fn copying_encoder(folder: &Path) -> PathBuf {
    use std::os::unix::fs::PermissionsExt as _;
    let path = folder.join("encoder");
    std::fs::write(&path, "#!/bin/sh\nfor last; do :; done\nexec cat > \"$last\"\n").expect("a program");
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).expect("permissions");
    path
}

#[tokio::test(flavor = "multi_thread")]
async fn pictures_and_videos_have_a_frame_per_interval() {
    let server = Server::start().await;
    upload_pair(&server.client, "pair", 1.0).await;
    let (folder, path) = new_file("pair.mcap");
    crate::harness::record_steps(&server.client, "pair", &path, 7, None).await;
    let export = |arguments: &[&str]| {
        let common = ["export", &text(&path), "--server", &server.url, "--size", "32x16"].map(str::to_owned);
        let arguments = common.into_iter().chain(arguments.iter().map(|argument| (*argument).to_owned()));
        let output = Command::new(PROGRAM).args(arguments).output().expect("a process");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    };
    let frames = folder.path().join("frames");
    export(&["--to", "png", "--out", &text(&frames)]);
    assert_eq!(std::fs::read_dir(&frames).expect("a folder").count(), 7);
    let raw = folder.path().join("raw");
    export(&["--to", "png", "--format", "raw", "--fps", "48", "--out", &text(&raw)]);
    // States at 24 Hz have two frames each at 48 Hz; the last one has one.
    assert_eq!(std::fs::read_dir(&raw).expect("a folder").count(), 13);
    let video = folder.path().join("video.mp4");
    let encoder = copying_encoder(folder.path());
    export(&["--to", "video", "--fps", "48", "--ffmpeg", &text(&encoder), "--out", &text(&video)]);
    // A tenth of the frames per second, ten times slower: the same frames.
    let slow_video = folder.path().join("slow.mp4");
    let slow = ["--to", "video", "--fps", "4.8", "--slow", "10", "--ffmpeg", &text(&encoder), "--out"];
    export(&[&slow[..], &[&text(&slow_video)]].concat());
    let video = std::fs::read(video).expect("a file");
    assert_eq!(video.len(), 13 * 4 * 32 * 16);
    assert_eq!(std::fs::read(slow_video).expect("a file"), video);
    // Six intervals of 1/24 s, which last 25 s at 1/100 of real time, have 10 frames per second and a last one.
    let frames = folder.path().join("slow");
    export(&["--to", "png", "--fps", "10", "--slow", "100", "--out", &text(&frames)]);
    assert_eq!(std::fs::read_dir(&frames).expect("a folder").count(), 251);
    let frame = |index: usize| std::fs::read(raw.join(format!("frame_{index:05}.rgba"))).expect("a frame");
    // A frame has 32x16 pixels of four bytes.
    for index in 0..13 {
        assert_eq!(video[2048 * index..][..2048], frame(index), "frame {index}");
    }
    assert_ne!(frame(0), frame(2), "control: expected frames of different states to differ");
    assert_eq!(frame(0), frame(1), "expected equal frames of one state");
}
