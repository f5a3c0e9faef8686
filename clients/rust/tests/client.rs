//! Tests of the client against a fake server, over a real socket, with the default limits of gRPC.

mod fake;

use std::sync::Arc;
use std::time::Duration;

use fake::{FakeDomain, FakeServer, serve};
use modalcast_client::{
    Client, DomainArray, DrawnBy, Error, FrameFormat, FrameRequest, FrameStreamRequest, Picture, Policy, Step,
};
use modalcast_client::{VertexRequest, VertexSelection, VertexStreamRequest};
use tokio::sync::Semaphore;

/// One domain of n vertices and two modes. Each entry encodes its own index.
fn world(vertices: usize) -> FakeServer {
    let rest = (0..3 * vertices).map(|at| at as f32).collect();
    let modes = (0..6 * vertices).map(|at| (at % 1000) as f32).collect();
    FakeServer::new(vec![FakeDomain::new(0, rest, 2, modes)])
}

fn picture(width: u32, height: u32) -> Picture {
    Picture::default().size(width, height).format(FrameFormat::Rgba)
}

async fn connected(world: FakeServer) -> (Arc<FakeServer>, Client) {
    let world = Arc::new(world);
    let url = serve(Arc::clone(&world)).await;
    (world, Client::connect(&url).await.expect("connects"))
}

#[tokio::test]
async fn arrays_and_modes_above_4_mib_arrive_complete() {
    let (world, client) = connected(world(300_000)).await;
    let described = client
        .describe("toy", &[DomainArray::RestPositions, DomainArray::Indices, DomainArray::Uvs])
        .await
        .expect("describes");
    assert_eq!(described.domains[0].rest_positions, world.domains[0].rest);
    assert_eq!(described.domains[0].indices.len(), 3 * described.domains[0].triangle_count);
    assert!(described.domains[0].uvs.is_empty());
    let rows = client.read_modes("toy", 0, &[]).await.expect("reads");
    assert_eq!((rows.rank, &rows.rows), (2, &world.domains[0].modes));
    let chosen = client.read_modes("toy", 0, &[7, 2]).await.expect("reads");
    assert_eq!((chosen.rows_of(0), chosen.rows_of(1)), (Some(&rows.rows[42..48]), Some(&rows.rows[12..18])));
    assert_eq!(chosen.rows_of(2), None);
    let refusal = client.with_reply_limit(1000).read_modes("toy", 0, &[]).await.expect_err("too much").to_string();
    assert!(refusal.contains("modes.total") && refusal.contains("1000"), "{refusal}");
}

#[tokio::test]
async fn frame_above_4_mib_arrives_complete_and_names_its_step() {
    let (_, client) = connected(world(4)).await;
    let mut drive = client.drive("toy", Policy::Lossless, 0).await.expect("opens");
    drive.step(&Step::new(5, 0.1).q(0, &[1.0, 2.0])).await.expect("sent");
    drive.flush().await.expect("acknowledged");
    let request = FrameRequest::new("toy", picture(1920, 1080)).minimum_step(5);
    let frame = client.render_frame(&request).await.expect("comes");
    assert_eq!((frame.step.number, frame.width, frame.bytes.len()), (5, 1920, 1920 * 1080 * 4));
    assert!(frame.bytes.iter().all(|byte| *byte == 5));
    assert_eq!(frame.stages, [("draw".to_owned(), 2.0)]);
    assert_eq!((frame.shadow_drawn_by, frame.visibility_drawn_by), (None, Some(DrawnBy::Cuda)));
}

#[tokio::test]
async fn subscription_before_the_first_step_receives_every_step() {
    let (world, client) = connected(world(4)).await;
    let request = FrameStreamRequest::new("toy", picture(600, 600)).replies(20);
    let mut frames = client.stream_frames(&request).await.expect("accepted");
    let request = VertexStreamRequest::new("toy", VertexSelection::default()).replies(20);
    let mut sets = client.stream_vertices(&request).await.expect("accepted");
    let mut drive = client.drive("toy", Policy::Lossless, 3).await.expect("opens");
    assert_eq!((drive.run, drive.window), (1, 3));
    for number in 0..20 {
        drive.step(&Step::new(number, 0.0).q(0, &[number as f32, 0.0])).await.expect("sent");
    }
    assert_eq!(drive.take_acks().first().map(|ack| ack.step), Some(0));
    let end = drive.finish().await.expect("all acknowledged");
    assert_eq!((end.sent, end.acknowledged, end.rejected), (20, Some(19), 0));
    for number in 0..20 {
        assert_eq!(frames.next().await.expect("a frame").expect("whole").step.number, number);
        let set = sets.next().await.expect("a set").expect("whole");
        assert_eq!((set.step.number, set.float_range(0)), (number, Some(0..12)));
        assert_eq!(set.positions[3], 3.0 + 6.0 * number as f32);
    }
    assert!(frames.next().await.is_none() && sets.next().await.is_none());
    assert_eq!(world.steps.lock().expect("lock").len(), 20);
}

#[tokio::test]
async fn step_beyond_the_window_waits_for_an_acknowledgement() {
    let mut slow = world(4);
    (slow.window, slow.permits) = (2, Semaphore::new(0));
    let (world, client) = connected(slow).await;
    let mut drive = client.drive("toy", Policy::Lossless, 0).await.expect("opens");
    let step = |number| Step::new(number, 0.0).q(0, &[0.0, 0.0]);
    drive.step(&step(0)).await.expect("room");
    drive.step(&step(1)).await.expect("room");
    let third = step(2);
    let waited = tokio::time::timeout(Duration::from_millis(200), drive.step(&third)).await;
    assert!(waited.is_err(), "the window of two let a third step pass");
    world.permits.add_permits(100);
    drive.step(&third).await.expect("room again");
    assert_eq!(drive.finish().await.expect("acknowledged").acknowledged, Some(2));
}

#[tokio::test]
async fn refused_step_is_a_typed_error_and_stream_stays_open() {
    let (world, client) = connected(world(4)).await;
    let mut drive = client.drive("toy", Policy::Lossless, 0).await.expect("opens");
    drive.step(&Step::new(0, 0.0).q(0, &[1.0])).await.ok();
    let refusal = drive.flush().await.expect_err("one of two coordinates");
    let words = refusal.rejection().expect("typed").clone();
    assert_eq!((words.step, words.field.as_str()), (Some(0), "step.q"));
    assert_eq!((words.expected.as_str(), words.given.as_str()), ("8 bytes", "4 bytes"));
    drive.step(&Step::new(1, 0.0).q(0, &[1.0, 2.0])).await.expect("goes on");
    let end = drive.finish().await.expect("goes on");
    assert_eq!((end.sent, end.rejected, end.acknowledged), (2, 1, Some(1)));
    assert_eq!(world.steps.lock().expect("lock").len(), 1);
}

#[tokio::test]
async fn second_writer_is_refused_until_the_first_is_dropped() {
    let (_, client) = connected(world(4)).await;
    let first = client.drive("toy", Policy::Lossless, 0).await.expect("opens");
    let refusal = client.drive("toy", Policy::Latest, 0).await.err().expect("taken");
    assert!(refusal.to_string().contains("another run"), "{refusal}");
    drop(first);
    let start = std::time::Instant::now();
    while let Err(error) = client.drive("toy", Policy::Latest, 0).await {
        assert!(start.elapsed() < Duration::from_secs(5), "{error}");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

#[tokio::test]
async fn refused_calls_report_the_details_of_the_server() {
    let (_, client) = connected(world(4)).await;
    for error in [
        client.describe("none", &[]).await.expect_err("unknown"),
        client.read_modes("none", 0, &[]).await.expect_err("unknown"),
        client.render_frame(&FrameRequest::new("none", Picture::default())).await.expect_err("unknown"),
        client.get_vertices(&VertexRequest::new("none", VertexSelection::default())).await.expect_err("unknown"),
        client.open_scene("none", "").await.expect_err("unknown"),
    ] {
        let Error::Status { code, .. } = &error else { panic!("{error}") };
        let refusal = error.rejection().expect("details");
        assert_eq!((*code, refusal.field.as_str(), refusal.given.as_str()), (tonic::Code::NotFound, "scene", "none"));
    }
    assert!(matches!(Client::connect("http://127.0.0.1:1").await, Err(Error::Connect { .. })));
    assert!(matches!(Client::connect("not a url").await, Err(Error::Connect { .. })));
}

/// Forwards connections to a server on loopback. Dropping the set closes every connection and the listener.
async fn forward(server: &str) -> (String, tokio::task::JoinSet<()>) {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a free port");
    let url = format!("http://{}", listener.local_addr().expect("bound"));
    let server = server.trim_start_matches("http://").to_owned();
    let mut tasks = tokio::task::JoinSet::new();
    tasks.spawn(async move {
        let mut connections = tokio::task::JoinSet::new();
        while let Ok((mut from, _)) = listener.accept().await {
            let mut to = tokio::net::TcpStream::connect(&server).await.expect("connects");
            connections.spawn(async move { drop(tokio::io::copy_bidirectional(&mut from, &mut to).await) });
        }
    });
    (url, tasks)
}

#[tokio::test]
async fn lost_connection_names_the_server_in_calls_and_streams() {
    let server = serve(Arc::new(world(4))).await;
    let (url, mut connections) = forward(&server).await;
    let client = Client::connect(&url).await.expect("connects");
    let mut drive = client.drive("toy", Policy::Lossless, 0).await.expect("opens");
    let request = FrameStreamRequest::new("toy", picture(8, 8));
    let mut frames = client.stream_frames(&request).await.expect("accepted");
    connections.shutdown().await;
    let frame = frames.next().await.expect("an error").expect_err("lost");
    let step = Step::new(0, 0.0).q(0, &[0.0, 0.0]);
    drive.step(&step).await.ok();
    for error in [frame, drive.flush().await.expect_err("lost"), client.server_info().await.expect_err("lost")] {
        assert!(matches!(&error, Error::Connect { url: named, .. } if *named == url), "{error:?}");
    }
}

#[tokio::test]
async fn upload_sends_every_file_under_its_relative_path() {
    let (world, client) = connected(world(4)).await;
    let folder = tempfile::tempdir().expect("folder");
    std::fs::create_dir(folder.path().join("maps")).expect("folder");
    let big: Vec<u8> = (0..3_000_000_u32).map(|at| (at % 251) as u8).collect();
    std::fs::write(folder.path().join("scene.toml"), "x").expect("file");
    std::fs::write(folder.path().join("maps/bark.png"), &big).expect("file");
    std::fs::write(folder.path().join("empty"), "").expect("file");
    client.upload_scene(folder.path(), "mine", "").await.expect("uploads");
    let expected = [("empty".into(), vec![]), ("maps/bark.png".into(), big), ("scene.toml".into(), b"x".to_vec())];
    assert_eq!(*world.uploads.lock().expect("lock"), expected);
    assert!(matches!(client.upload_scene("/none".as_ref(), "mine", "").await, Err(Error::File { .. })));
}

/// All transitive dependencies of `package`, from the lock file of the workspace.
fn tree(package: &str) -> Vec<String> {
    let lock = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../../Cargo.lock")).expect("a lock file");
    let mut found = vec![package.to_owned()];
    for at in 0.. {
        let Some(name) = found.get(at).cloned() else { break };
        let entries = lock.split("[[package]]").filter(|entry| entry.contains(&format!("\nname = \"{name}\"\n")));
        for line in entries.flat_map(str::lines).filter(|line| line.starts_with(" \"")) {
            let needed = line.trim().trim_matches([' ', '"', ',']).split(' ').next().unwrap_or("").to_owned();
            if !found.contains(&needed) {
                found.push(needed);
            }
        }
    }
    found
}

#[test]
fn client_depends_on_neither_cuda_nor_opengl() {
    let drawing = ["cudarc", "glow", "khronos-egl", "modalcast"];
    let of = |package| tree(package).into_iter().filter(|name| drawing.contains(&name.as_str())).count();
    assert_eq!(of("modalcast-client"), 0);
    assert!(tree("modalcast-client").iter().any(|name| name == "tonic"), "the walk finds what is there");
    assert_eq!(of("modalcast"), drawing.len(), "the walk finds what the server needs");
}

/// Runs `modalcast-fetch`. Returns its exit code, standard output and standard error.
async fn fetch(url: &str, arguments: &[&str]) -> (i32, String, String) {
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_modalcast-fetch"));
    command.args(arguments).args(["--server", url]);
    let output = tokio::task::spawn_blocking(move || command.output().expect("starts")).await.expect("ends");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (output.status.code().unwrap_or(-1), text(&output.stdout), text(&output.stderr))
}

#[tokio::test(flavor = "multi_thread")]
async fn fetch_saves_files_and_exits_with_documented_codes() {
    let world = Arc::new(world(4));
    let url = serve(Arc::clone(&world)).await;
    let client = Client::connect(&url).await.expect("connects");
    let folder = tempfile::tempdir().expect("folder");
    let path = |name: &str| folder.path().join(name).display().to_string();
    let mut drive = client.drive("toy", Policy::Lossless, 0).await.expect("opens");
    // Send steps until the program ends, because its subscription starts at an unknown time.
    let flow = tokio::spawn(async move {
        for number in 0.. {
            drive.step(&Step::new(number, 0.0).q(0, &[number as f32, 0.0])).await.expect("sent");
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    });
    let (frames, vertices) = (path("frames"), path("vertices.npy"));
    let size = ["--scene", "toy", "--size", "20x10", "--format", "raw"];
    let all = [&["frames", "--json", "--count", "3", "--open", "toy", "--out", &frames], &size[..]].concat();
    let (code, out, fault) = fetch(&url, &all).await;
    assert_eq!(code, 0, "{fault}");
    let (ready, json) = out.trim().split_once('\n').expect("two lines");
    let summary: serde_json::Value = serde_json::from_str(json).expect("JSON");
    assert_eq!((ready, &summary["frames"], summary["stages_ms"]["draw"].as_f64()), ("ready", &3.into(), Some(2.0)));
    for (index, step) in summary["steps"].as_array().expect("steps").iter().enumerate() {
        let bytes = std::fs::read(format!("{frames}/frame_{index:05}.rgba")).expect("a frame");
        assert_eq!((bytes.len(), u64::from(bytes[0])), (800, step.as_u64().expect("a number") % 256));
    }
    let (code, _, fault) = fetch(&url, &["vertices", "--scene", "toy", "--count", "2", "--out", &vertices]).await;
    assert_eq!(code, 0, "{fault}");
    assert_eq!(std::fs::read(&vertices).expect("a file").len(), 128 + 2 * 48);
    flow.abort();
    let single = path("one.rgba");
    let one = [&["frame", "--out", &single], &size[..]].concat();
    assert_eq!(fetch(&url, &one).await.0, 0);
    assert_eq!(fetch(&url, &["info"]).await.0, 0);
    assert!(fetch(&url, &["list", "--json"]).await.1.contains("\"scene\":\"toy\""));
    assert_eq!(fetch(&url, &["frame", "--scene", "none", "--out", &path("x.png")]).await.0, 1);
    assert_eq!(fetch(&url, &["frame", "--out", &path("x.png")]).await.0, 2);
    assert_eq!(fetch("http://127.0.0.1:1", &["info"]).await.0, 3);
    let nowhere = [&["frame", "--out", "/nowhere/x.png"], &size[..]].concat();
    assert_eq!(fetch(&url, &nowhere).await.0, 4);
    let late = ["frames", "--scene", "toy", "--out", &frames, "--timeout", "0.2"];
    assert_eq!(fetch(&url, &late).await.0, 5);
}
