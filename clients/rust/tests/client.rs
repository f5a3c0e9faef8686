//! Tests of the client against a fake server, over a real socket, with the default limits of gRPC.

mod fake;
#[path = "../../../tests/common/hang_guard.rs"]
mod hang_guard;

use std::sync::Arc;
use std::time::Duration;

use fake::{FakeDomain, FakeServer, serve};
use hang_guard::HANG_GUARD;
use modalcast_client::{
    Client, Delivery, DrawnBy, DriveRequest, Error, Feature, FrameFormat, FrameRequest, FrameStreamRequest, Picture,
    ShapeArray, Step, v1,
};
use modalcast_client::{VertexRequest, VertexSelection, VertexStreamRequest};
use tokio::sync::Semaphore;

/// A server of the scene `toy`: one domain with two modes. Entry i of x0 is i, and entry i of U is i mod 1000.
fn one_domain_server(vertices: usize) -> FakeServer {
    let rest_positions = (0..3 * vertices).map(|index| index as f32).collect();
    let modes = (0..6 * vertices).map(|index| (index % 1000) as f32).collect();
    FakeServer::new(vec![FakeDomain::new(0, rest_positions, 2, modes)])
}

fn picture(width: u32, height: u32) -> Picture {
    Picture::default().size(width, height).format(FrameFormat::Rgba)
}

async fn connect(server: FakeServer) -> (Arc<FakeServer>, Client) {
    let server = Arc::new(server);
    let url = serve(Arc::clone(&server)).await;
    (server, Client::connect(&url).await.expect("a connection"))
}

#[tokio::test]
async fn arrays_and_modes_above_4_mib_arrive_complete() {
    let (server, client) = connect(one_domain_server(300_000)).await;
    let description = client
        .describe("toy", &[ShapeArray::RestPositions, ShapeArray::Indices, ShapeArray::Uvs, ShapeArray::Modes])
        .await
        .expect("a description");
    let shape = description.shape_of(&description.domains[0]);
    assert_eq!((&shape.rest_positions, &shape.modes), (&server.domains[0].rest_positions, &server.domains[0].modes));
    assert_eq!(shape.indices.len(), 3 * shape.triangle_count);
    assert!(shape.uvs.is_empty());
    let rows = client.read_modes("toy", 0, &[]).await.expect("rows of U");
    assert_eq!((rows.rank, &rows.rows), (2, &server.domains[0].modes));
    // A vertex has three rows of two entries.
    let selected_rows = client.read_modes("toy", 0, &[7, 2]).await.expect("rows of U");
    assert_eq!(
        (selected_rows.rows_of(0), selected_rows.rows_of(1)),
        (Some(&rows.rows[42..48]), Some(&rows.rows[12..18]))
    );
    assert_eq!(selected_rows.rows_of(2), None);
    let error =
        client.with_reply_limit(1000).read_modes("toy", 0, &[]).await.expect_err("a reply above the limit").to_string();
    assert!(error.contains("modes.total") && error.contains("1000"), "{error}");
}

#[tokio::test]
async fn frame_above_4_mib_arrives_complete_and_names_its_step() {
    let (_, client) = connect(one_domain_server(4)).await;
    let mut step_stream = client.drive(&DriveRequest::new("toy", Delivery::Lossless)).await.expect("a step stream");
    step_stream.step(&Step::new(5, 0.1).q(0, &[1.0, 2.0])).await.expect("a sent step");
    step_stream.flush().await.expect("acknowledged steps");
    let request = FrameRequest::new("toy", picture(1920, 1080)).minimum_step(5);
    let frame = client.render_frame(&request).await.expect("a frame");
    assert_eq!((frame.step.number, frame.width, frame.bytes.len()), (5, 1920, 1920 * 1080 * 4));
    // The fake server fills a frame with the step number and reports a fixed look, stage times, rasterizers and
    // distance below the ground.
    assert!(frame.bytes.iter().all(|byte| *byte == 5));
    assert_eq!(frame.stages, [("draw".to_owned(), 2.0)]);
    assert_eq!((frame.shadow_drawn_by, frame.visibility_drawn_by), (None, Some(DrawnBy::Cuda)));
    let look = frame.look.expect("a look").to_string();
    assert_eq!(look, "best, antialiasing fxaa, 1 per pixel, filtered shadow map 512 x 512");
    assert_eq!(frame.below_ground, 0.25);
}

#[tokio::test]
async fn subscription_before_the_first_step_receives_every_step() {
    let (server, client) = connect(one_domain_server(4)).await;
    let request = FrameStreamRequest::new("toy", picture(600, 600)).max_steps(20);
    let mut frames = client.stream_frames(&request).await.expect("a subscription");
    let request = VertexStreamRequest::new("toy", VertexSelection::default()).max_steps(20);
    let mut sets = client.stream_vertices(&request).await.expect("a subscription");
    let mut step_stream =
        client.drive(&DriveRequest::new("toy", Delivery::Lossless).window(3)).await.expect("a step stream");
    assert_eq!((step_stream.run, step_stream.window), (1, Some(3)));
    for number in 0..20 {
        step_stream.step(&Step::new(number, 0.0).q(0, &[number as f32, 0.0])).await.expect("a sent step");
    }
    assert_eq!(step_stream.take_acks().first().map(|ack| ack.step), Some(0));
    let summary = step_stream.finish().await.expect("acknowledged steps");
    assert_eq!((summary.sent, summary.acknowledged, summary.rejected), (20, Some(19), 0));
    for number in 0..20 {
        assert_eq!(frames.next().await.expect("a frame").expect("a valid reply").step.number, number);
        let set = sets.next().await.expect("a set").expect("a valid reply");
        assert_eq!((set.step.number, set.float_range(0)), (number, Some(0..12)));
        // The x coordinate of vertex 1: entry 3 of x0 is 3, and entry 6 of U, in the column of q[0], is 6.
        assert_eq!(set.positions[3], 3.0 + 6.0 * number as f32);
    }
    assert!(frames.next().await.is_none() && sets.next().await.is_none());
    assert_eq!(server.steps.lock().expect("lock").len(), 20);
}

#[tokio::test]
async fn step_beyond_the_window_waits_for_an_acknowledgment() {
    let mut slow_server = one_domain_server(4);
    (slow_server.window, slow_server.ack_permits) = (2, Semaphore::new(0));
    let (server, client) = connect(slow_server).await;
    let mut step_stream =
        client.drive(&DriveRequest::new("toy", Delivery::Lossless).window(0)).await.expect("a step stream");
    let step = |number| Step::new(number, 0.0).q(0, &[0.0, 0.0]);
    step_stream.step(&step(0)).await.expect("capacity in the window");
    step_stream.step(&step(1)).await.expect("capacity in the window");
    let third = step(2);
    let result = tokio::time::timeout(Duration::from_millis(200), step_stream.step(&third)).await;
    assert!(result.is_err(), "expected the third step to wait for capacity in a window of two");
    server.ack_permits.add_permits(100);
    step_stream.step(&third).await.expect("capacity in the window");
    assert_eq!(step_stream.finish().await.expect("acknowledged steps").acknowledged, Some(2));
}

#[tokio::test]
async fn rejected_step_is_a_typed_error_and_stream_stays_open() {
    let (server, client) = connect(one_domain_server(4)).await;
    let mut step_stream = client.drive(&DriveRequest::new("toy", Delivery::Lossless)).await.expect("a step stream");
    step_stream.step(&Step::new(0, 0.0).q(0, &[1.0])).await.ok();
    let error = step_stream.flush().await.expect_err("one of two coordinates");
    let rejection = error.rejection().expect("a rejection").clone();
    assert_eq!((rejection.step, rejection.field.as_str()), (Some(0), "step.q"));
    assert_eq!((rejection.expected.as_str(), rejection.given.as_str()), ("8 bytes", "4 bytes"));
    step_stream.step(&Step::new(1, 0.0).q(0, &[1.0, 2.0])).await.expect("an open stream");
    let summary = step_stream.finish().await.expect("an open stream");
    assert_eq!((summary.sent, summary.rejected, summary.acknowledged), (2, 1, Some(1)));
    assert_eq!(server.steps.lock().expect("lock").len(), 1);
}

#[tokio::test]
async fn second_writer_is_rejected_until_the_first_is_dropped() {
    let (_, client) = connect(one_domain_server(4)).await;
    let first_writer = client.drive(&DriveRequest::new("toy", Delivery::Lossless)).await.expect("a step stream");
    let error = client
        .drive(&DriveRequest::new("toy", Delivery::Latest))
        .await
        .err()
        .expect("a rejection of the second writer");
    assert!(error.to_string().contains("another run"), "{error}");
    drop(first_writer);
    let start = std::time::Instant::now();
    while let Err(error) = client.drive(&DriveRequest::new("toy", Delivery::Latest)).await {
        assert!(start.elapsed() < HANG_GUARD, "{error}");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

#[tokio::test]
async fn rejected_calls_report_the_details_of_the_server() {
    let (_, client) = connect(one_domain_server(4)).await;
    for error in [
        client.describe("none", &[]).await.expect_err("an unknown scene"),
        client.read_modes("none", 0, &[]).await.expect_err("an unknown scene"),
        client.render_frame(&FrameRequest::new("none", Picture::default())).await.expect_err("an unknown scene"),
        client
            .get_vertices(&VertexRequest::new("none", VertexSelection::default()))
            .await
            .expect_err("an unknown scene"),
        client.open_scene("none", "").await.expect_err("an unknown scene"),
    ] {
        let Error::Status { code, .. } = &error else { panic!("{error}") };
        let rejection = error.rejection().expect("details");
        assert_eq!(
            (*code, rejection.field.as_str(), rejection.given.as_str()),
            (tonic::Code::NotFound, "scene", "none")
        );
    }
    assert!(matches!(Client::connect("http://127.0.0.1:1").await, Err(Error::Connect { .. })));
    assert!(matches!(Client::connect("not a url").await, Err(Error::Connect { .. })));
}

#[tokio::test]
async fn other_protocol_version_is_an_error_with_both_numbers() {
    for version in [0, v1::PROTOCOL_VERSION + 1] {
        let mut server = one_domain_server(4);
        server.protocol_version = version;
        let url = serve(Arc::new(server)).await;
        // The wait would last an hour if the client tried again.
        let error = Client::connect_with_retry(&url, Duration::from_secs(3600)).await.expect_err("another version");
        assert!(matches!(error, Error::ProtocolVersion { server, .. } if server == version), "{error}");
        let expected = format!("expected a server of protocol version {}, got version {version}", v1::PROTOCOL_VERSION);
        assert!(error.to_string().ends_with(&expected), "{error}");
        assert_eq!(run_fetch(&url, &["info"]).await.exit_code, 3);
    }
    let (_, client) = connect(one_domain_server(4)).await;
    let info = client.server_info().await.expect("an answer");
    assert_eq!(info.features, [Feature::Frames], "expected the unknown feature to be left out");
    assert!(info.has_feature(Feature::Frames));
}

/// Forwards connections on a free port to a server. Returns the URL of that port. Dropping the tasks closes every
/// connection and the listener.
async fn forward(server_address: &str) -> (String, tokio::task::JoinSet<()>) {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a free port");
    let url = format!("http://{}", listener.local_addr().expect("an address"));
    let server_address = server_address.trim_start_matches("http://").to_owned();
    let mut tasks = tokio::task::JoinSet::new();
    tasks.spawn(async move {
        let mut connections = tokio::task::JoinSet::new();
        while let Ok((mut client, _)) = listener.accept().await {
            let mut server = tokio::net::TcpStream::connect(&server_address).await.expect("a connection");
            connections.spawn(async move { drop(tokio::io::copy_bidirectional(&mut client, &mut server).await) });
        }
    });
    (url, tasks)
}

/// The library and the program connect to a Unix socket, which is forwarded to a server.
#[tokio::test(flavor = "multi_thread")]
async fn connects_to_a_unix_socket_by_url() {
    let server = serve(Arc::new(one_domain_server(4))).await;
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("socket");
    let listener = tokio::net::UnixListener::bind(&path).expect("a socket");
    let server_address = server.trim_start_matches("http://").to_owned();
    tokio::spawn(async move {
        while let Ok((mut client, _)) = listener.accept().await {
            let mut server = tokio::net::TcpStream::connect(&server_address).await.expect("a connection");
            tokio::spawn(async move { drop(tokio::io::copy_bidirectional(&mut client, &mut server).await) });
        }
    });
    let url = format!("unix:{}", path.display());
    let client = Client::connect(&url).await.expect("a connection");
    let stream = client.drive(&DriveRequest::new("toy", Delivery::Lossless)).await.expect("a step stream");
    stream.finish().await.expect("a clean end");
    let output = run_fetch(&url, &["info"]).await;
    assert_eq!(output.exit_code, 0, "{}", output.stderr);
    let error = Client::connect("unix:/nonexistent/socket").await.expect_err("no server");
    assert!(error.to_string().starts_with("unix:/nonexistent/socket: no connection"), "{error}");
}

#[tokio::test]
async fn lost_connection_names_the_server_in_calls_and_streams() {
    let server = serve(Arc::new(one_domain_server(4))).await;
    let (url, mut connections) = forward(&server).await;
    let client = Client::connect(&url).await.expect("a connection");
    let mut step_stream = client.drive(&DriveRequest::new("toy", Delivery::Lossless)).await.expect("a step stream");
    let request = FrameStreamRequest::new("toy", picture(8, 8));
    let mut frames = client.stream_frames(&request).await.expect("a subscription");
    connections.shutdown().await;
    let frame_error = frames.next().await.expect("an error").expect_err("a lost connection");
    let step = Step::new(0, 0.0).q(0, &[0.0, 0.0]);
    step_stream.step(&step).await.ok();
    let step_error = step_stream.flush().await.expect_err("a lost connection");
    let call_error = client.server_info().await.expect_err("a lost connection");
    for error in [frame_error, step_error, call_error] {
        assert!(matches!(&error, Error::Connect { url: error_url, .. } if *error_url == url), "{error:?}");
    }
}

#[tokio::test]
async fn upload_sends_every_file_under_its_relative_path() {
    let (server, client) = connect(one_domain_server(4)).await;
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::create_dir(folder.path().join("maps")).expect("a folder");
    let texture_bytes: Vec<u8> = (0..3_000_000_u32).map(|index| (index % 251) as u8).collect();
    std::fs::write(folder.path().join("scene.toml"), "x").expect("a file");
    std::fs::write(folder.path().join("maps/bark.png"), &texture_bytes).expect("a file");
    std::fs::write(folder.path().join("empty"), "").expect("a file");
    client.upload_scene(folder.path(), "mine", "").await.expect("an upload");
    let expected =
        [("empty".into(), vec![]), ("maps/bark.png".into(), texture_bytes), ("scene.toml".into(), b"x".to_vec())];
    assert_eq!(*server.uploaded_files.lock().expect("lock"), expected);
    assert!(matches!(client.upload_scene("/none".as_ref(), "mine", "").await, Err(Error::File { .. })));
}

#[tokio::test]
async fn upload_sends_known_contents_only_if_the_server_loses_them() {
    use sha2::Digest as _;
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::write(folder.path().join("a.obj"), "known").expect("a file");
    std::fs::write(folder.path().join("b.obj"), "new").expect("a file");
    // The bytes of a.obj that the server receives. A server with `None` does not know the call.
    for (known_hashes, loses_contents, received) in [
        (Some(vec![sha2::Sha256::digest("known").to_vec()]), false, ""),
        (Some(vec![sha2::Sha256::digest("known").to_vec()]), true, "known"),
        (Some(vec![]), false, "known"),
        (None, false, "known"),
    ] {
        let mut server = one_domain_server(4);
        (server.known_hashes, server.loses_contents) = (known_hashes, loses_contents);
        let (server, client) = connect(server).await;
        client.upload_scene(folder.path(), "mine", "").await.expect("an upload");
        let expected = [("a.obj".into(), received.as_bytes().to_vec()), ("b.obj".into(), b"new".to_vec())];
        assert_eq!(*server.uploaded_files.lock().expect("lock"), expected);
    }
}

/// `package` and its transitive dependencies, from the lock file of the workspace.
fn list_dependencies(package: &str) -> Vec<String> {
    let lock_file =
        std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../../Cargo.lock")).expect("a lock file");
    let mut packages = vec![package.to_owned()];
    for index in 0.. {
        let Some(name) = packages.get(index).cloned() else { break };
        let entries = lock_file.split("[[package]]").filter(|entry| entry.contains(&format!("\nname = \"{name}\"\n")));
        for line in entries.flat_map(str::lines).filter(|line| line.starts_with(" \"")) {
            let dependency = line.trim().trim_matches([' ', '"', ',']).split(' ').next().unwrap_or("").to_owned();
            if !packages.contains(&dependency) {
                packages.push(dependency);
            }
        }
    }
    packages
}

#[test]
fn client_depends_on_neither_cuda_nor_opengl() {
    // The server, `modalcast`, is in the list because it depends on the others.
    let gpu_packages = ["cudarc", "glow", "khronos-egl", "modalcast"];
    let count_gpu_dependencies = |package| {
        let dependencies = list_dependencies(package);
        dependencies.iter().filter(|name| gpu_packages.contains(&name.as_str())).count()
    };
    assert_eq!(count_gpu_dependencies("modalcast-client"), 0);
    assert!(list_dependencies("modalcast-client").iter().any(|name| name == "tonic"), "expected a dependency on tonic");
    let server_count = count_gpu_dependencies("modalcast");
    assert_eq!(server_count, gpu_packages.len(), "control: expected the server to depend on all of {gpu_packages:?}");
}

struct FetchOutput {
    exit_code: i32,
    stdout: String,
    stderr: String,
}

/// Runs `modalcast-fetch` with a server.
async fn run_fetch(url: &str, arguments: &[&str]) -> FetchOutput {
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_modalcast-fetch"));
    command.args(arguments).args(["--server", url]);
    let output = tokio::task::spawn_blocking(move || command.output());
    let output = output.await.expect("a finished task").expect("modalcast-fetch starts");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    let exit_code = output.status.code().unwrap_or(-1);
    FetchOutput { exit_code, stdout: text(&output.stdout), stderr: text(&output.stderr) }
}

#[tokio::test(flavor = "multi_thread")]
async fn fetch_saves_files_and_exits_with_documented_codes() {
    let server = Arc::new(one_domain_server(4));
    let url = serve(Arc::clone(&server)).await;
    let client = Client::connect(&url).await.expect("a connection");
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name).display().to_string();
    let mut step_stream = client.drive(&DriveRequest::new("toy", Delivery::Lossless)).await.expect("a step stream");
    // The time at which the program subscribes is unknown, so send steps until it ends.
    let send_task = tokio::spawn(async move {
        for number in 0.. {
            step_stream.step(&Step::new(number, 0.0).q(0, &[number as f32, 0.0])).await.expect("a sent step");
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    });
    let (frames, vertices) = (path("frames"), path("vertices.npy"));
    let picture_arguments = ["--scene", "toy", "--size", "20x10", "--format", "raw"];
    let stream_arguments =
        [&["frames", "--json", "--count", "3", "--open", "toy", "--out", &frames], &picture_arguments[..]].concat();
    let output = run_fetch(&url, &stream_arguments).await;
    assert_eq!(output.exit_code, 0, "{}", output.stderr);
    let (ready, json) = output.stdout.trim().split_once('\n').expect("two lines");
    let summary: serde_json::Value = serde_json::from_str(json).expect("JSON");
    // The fake server reports 2 ms for the stage `draw`, and fills a frame with the low byte of the step number.
    assert_eq!((ready, &summary["frames"], summary["stages_ms"]["draw"].as_f64()), ("ready", &3.into(), Some(2.0)));
    for (index, step) in summary["steps"].as_array().expect("steps").iter().enumerate() {
        let bytes = std::fs::read(format!("{frames}/frame_{index:05}.rgba")).expect("a frame");
        // 20 x 10 pixels of 4 bytes.
        assert_eq!((bytes.len(), u64::from(bytes[0])), (800, step.as_u64().expect("a number") % 256));
    }
    let output = run_fetch(&url, &["vertices", "--scene", "toy", "--count", "2", "--out", &vertices]).await;
    assert_eq!(output.exit_code, 0, "{}", output.stderr);
    // A header of 128 bytes, and two steps of four positions (three f32 each).
    assert_eq!(std::fs::read(&vertices).expect("a file").len(), 128 + 2 * 48);
    send_task.abort();
    let frame_path = path("one.rgba");
    let frame_arguments = [&["frame", "--out", &frame_path], &picture_arguments[..]].concat();
    assert_eq!(run_fetch(&url, &frame_arguments).await.exit_code, 0);
    let several_outputs = [&frame_arguments[..], &["--output", "color,normals"]].concat();
    assert_eq!(run_fetch(&url, &several_outputs).await.exit_code, 0);
    // The fake server sends every picture as RGBA.
    let sizes = ["one_color.rgba", "one_normals.rgba"].map(|name| std::fs::read(path(name)).expect("a frame").len());
    assert_eq!(sizes, [800; 2]);
    let reset = ["reset", "--scene", "toy"];
    let mut resets = 0;
    // The server notices the end of the aborted stream some time later.
    while run_fetch(&url, &reset).await.exit_code == 1 && resets < 200 {
        resets += 1;
    }
    assert_eq!(run_fetch(&url, &reset).await.exit_code, 0);
    assert_eq!(server.output().positions, one_domain_server(4).output().positions);
    assert_eq!(run_fetch(&url, &["info"]).await.exit_code, 0);
    assert!(run_fetch(&url, &["list", "--json"]).await.stdout.contains("\"scene\":\"toy\""));
    assert_eq!(run_fetch(&url, &["frame", "--scene", "none", "--out", &path("x.png")]).await.exit_code, 1);
    assert_eq!(run_fetch(&url, &["frame", "--out", &path("x.png")]).await.exit_code, 2);
    assert_eq!(run_fetch("http://127.0.0.1:1", &["info"]).await.exit_code, 3);
    let unwritable_arguments = [&["frame", "--out", "/nowhere/x.png"], &picture_arguments[..]].concat();
    assert_eq!(run_fetch(&url, &unwritable_arguments).await.exit_code, 4);
    let timeout_arguments = ["frames", "--scene", "toy", "--out", &frames, "--timeout", "0.2"];
    assert_eq!(run_fetch(&url, &timeout_arguments).await.exit_code, 5);
}
