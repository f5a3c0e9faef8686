//! Faults that need a server in a process of its own: its memory while clients do not read, and `kill -9`.

use std::io::{BufRead as _, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use modalcast_client::{
    ArrayUpload, Client, Delivery, DriveRequest, Force, ForceRequest, SceneDescription, ShapeArray, StateLayout,
    StateRequest, Step, StepStream, UploadDomain, UploadShape, VertexRequest, VertexSelection,
};
use modalcast_proto::v1;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use tokio_stream::StreamExt as _;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Status;
use tonic::transport::Channel;
use v1::drive_scene_request::Kind;
use v1::frame_service_client::FrameServiceClient;
use v1::scene_service_client::SceneServiceClient;
use v1::step_service_client::StepServiceClient;
use v1::vertex_service_client::VertexServiceClient;

use crate::message_streams::{MessageSizes, StreamKind, message_sizes};
use crate::service_harness::{LONG_LIMITS, with_timeout};

/// A server in a process of its own, which is killed when it is dropped.
pub(crate) struct ServerProcess {
    process: Child,
    pub(crate) address: String,
}

impl ServerProcess {
    /// Starts a server that deforms and draws on the CPU, and waits until it listens. `folder` has its state and its
    /// scenes.
    fn start(folder: &Path) -> Self {
        Self::start_with(folder, &[])
    }

    /// As [`Self::start`], with further options.
    pub(crate) fn start_with(folder: &Path, options: &[&str]) -> Self {
        Self::start_in(folder, options, &[])
    }

    /// As [`Self::start_with`], with further variables of the environment.
    fn start_in(folder: &Path, options: &[&str], variables: &[(&str, &str)]) -> Self {
        let scenes = folder.join("scenes");
        std::fs::create_dir_all(&scenes).expect("expected a folder");
        let mut process = Command::new(env!("CARGO_BIN_EXE_modalcast"))
            .args([
                "serve",
                "--no-auth",
                "--listen",
                "127.0.0.1:0",
                "--backend",
                "cpu",
                "--renderer",
                "software",
                "--state",
            ])
            .arg(folder.join("state"))
            .arg("--scenes")
            .arg(scenes)
            .args(LONG_LIMITS)
            .args(options)
            .envs(variables.iter().copied())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .expect("expected the server to start");
        let mut lines = BufReader::new(process.stdout.take().expect("expected an output")).lines();
        let line = lines.next().expect("expected the address").expect("expected text");
        let address = line.strip_prefix("listening on ").expect("expected the address").to_owned();
        Self { process, address }
    }

    async fn channel(&self) -> Channel {
        let endpoint = Channel::from_shared(self.address.clone()).expect("expected a URL");
        endpoint.connect().await.expect("expected a connection")
    }

    pub(crate) async fn client(&self) -> Client {
        Client::connect(&self.address).await.expect("expected a connection")
    }

    /// The number of mappings of files whose path contains `name`.
    pub(crate) fn mappings(&self, name: &str) -> usize {
        let maps = std::fs::read_to_string(format!("/proc/{}/maps", self.process.id())).expect("expected a process");
        maps.lines().filter(|line| line.contains(name)).count()
    }

    /// The number of mappings that arenas of glibc begin with: without a file, at a multiple of 64 MiB.
    #[cfg(target_env = "gnu")]
    fn arenas(&self) -> usize {
        let maps = std::fs::read_to_string(format!("/proc/{}/maps", self.process.id())).expect("expected a process");
        let is_arena = |line: &&str| {
            let fields: Vec<&str> = line.split_whitespace().collect();
            let start = fields[0].split('-').next().expect("expected a range");
            let start = u64::from_str_radix(start, 16).expect("expected an address");
            fields.len() == 5 && start.is_multiple_of(64 << 20)
        };
        maps.lines().filter(is_arena).count()
    }

    /// The number of open files and sockets.
    pub(crate) fn open_files(&self) -> usize {
        std::fs::read_dir(format!("/proc/{}/fd", self.process.id())).expect("expected a process").count()
    }

    /// The resident memory of the process in bytes.
    pub(crate) fn resident_bytes(&self) -> u64 {
        let status =
            std::fs::read_to_string(format!("/proc/{}/status", self.process.id())).expect("expected a process");
        let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).expect("expected its memory");
        line.trim().trim_end_matches(" kB").parse::<u64>().expect("expected a number") << 10
    }
}

impl Drop for ServerProcess {
    /// Sends SIGKILL.
    fn drop(&mut self) {
        self.process.kill().expect("expected a process");
        self.process.wait().expect("expected the end of the process");
    }
}

/// Arenas of the allocator keep the most memory that they have had in use at once.
#[test]
#[cfg(target_env = "gnu")]
fn threads_share_few_arenas_of_the_allocator() {
    let folder = tempfile::tempdir().expect("expected a folder");
    let cores = std::thread::available_parallelism().expect("expected a number of cores").get();
    assert!(ServerProcess::start(folder.path()).arenas() <= cores);
    let many = ServerProcess::start_in(folder.path(), &[], &[("MALLOC_ARENA_MAX", "1000")]);
    assert!(many.arenas() > cores, "negative control: {} arenas", many.arenas());
}

#[tokio::test(flavor = "multi_thread")]
async fn strict_server_refuses_what_a_remark_would_report() {
    let folder = tempfile::tempdir().expect("expected a folder");
    let scenes = folder.path().join("scenes");
    std::fs::create_dir_all(&scenes).expect("expected a folder");
    let text = "mtllib absent.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n";
    std::fs::write(scenes.join("a.obj"), text).expect("expected a written file");
    for options in [&[][..], &["--strict"]] {
        let server = ServerProcess::start_with(folder.path(), options);
        let client = server.client().await;
        let opened = client.open_scene("a.obj", "opened").await;
        let uploaded = client.upload_scene(&scenes.join("a.obj"), "uploaded", "a.obj").await;
        for result in [opened, uploaded] {
            match (result, options.is_empty()) {
                (Ok(info), true) => {
                    assert!(info.remarks.iter().any(|remark| remark.contains("absent.mtl")), "{:?}", info.remarks);
                    client.delete_scene(&info.scene).await.expect("expected a deleted scene");
                }
                (Err(error), false) => assert!(error.to_string().contains("(strict mode)"), "{error}"),
                (result, _) => panic!("{options:?}: {result:?}"),
            }
        }
    }
}

/// Number of clients that never read, for each kind of stream.
const STALLED_READERS: u64 = 16;

/// Limit on the growth of the server's memory in bytes.
const MAX_GROWTH: u64 = 96 << 20;

const ALL_ARRAYS: [ShapeArray; 6] = [
    ShapeArray::Indices,
    ShapeArray::CornerVertices,
    ShapeArray::RestPositions,
    ShapeArray::Uvs,
    ShapeArray::RestNormals,
    ShapeArray::Modes,
];

/// Rank of the domain that receives forces.
const FORCE_RANK: usize = 512;

/// Number of domains of [`crowded_upload`].
const DOMAINS: usize = 2000;

/// A grid of 100 x 100 vertices with 16 modes, a triangle with 512 modes and many triangles without modes: vertices,
/// states and forces are large enough that unbounded buffers would be seen.
pub(crate) fn crowded_upload() -> ArrayUpload {
    const SIDE: u32 = 100;
    let positions = (0..SIDE * SIDE).map(|index| [(index % SIDE) as f32, (index / SIDE) as f32, 0.0]).collect();
    let cells = (0..(SIDE - 1) * (SIDE - 1)).map(|cell| cell % (SIDE - 1) + cell / (SIDE - 1) * SIDE);
    let triangles = cells.map(|vertex| [vertex, vertex + 1, vertex + SIDE]).collect();
    let modes = (0..3 * SIDE * SIDE * 16).map(|entry| (entry % 101) as f32 * 0.001).collect();
    let grid = UploadShape::Arrays { positions, triangles, rank: 16, modes };
    let triangle = |rank: u32| UploadShape::Arrays {
        positions: vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
        triangles: vec![[0, 1, 2]],
        rank,
        modes: vec![0.01; 9 * rank as usize],
    };
    let upload = ArrayUpload::new("crowded").domain(UploadDomain::new("grid", grid));
    let upload = upload.domain(UploadDomain::new("modes", triangle(FORCE_RANK as u32)));
    let upload = upload.domain(UploadDomain::new("leaf", triangle(0)));
    (3..DOMAINS)
        .fold(upload, |upload, index| upload.domain(UploadDomain::new(&index.to_string(), UploadShape::OfDomain(2))))
}

/// The x translation of all domains in a step of [`crowded_step`].
fn step_offset(number: u64) -> f32 {
    0.001 * (number + 1) as f32
}

/// A step that moves every domain of [`crowded_upload`]: about 100 KB.
pub(crate) fn crowded_step(number: u64) -> Step {
    let transform = [1.0, 0.0, 0.0, step_offset(number), 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];
    (0..DOMAINS as u32).fold(Step::new(number, 0.0), |step, domain| step.transform(domain, &transform))
}

/// A plate that is drawn fast: no shadow, no ground and one sample per pixel.
fn write_plate(scenes: &Path) {
    let folder = scenes.join("plate");
    std::fs::create_dir_all(&folder).expect("expected a folder");
    let model = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n";
    let settings = "model = 'plate.obj'\nground = false\nshadows = false\nlook.samples = 1\nlook.antialias = 'none'\n";
    for (name, text) in [("plate.obj", model), ("scene.toml", settings)] {
        std::fs::write(folder.join(name), text).expect("expected a written file");
    }
}

fn plate_step(number: u64) -> Step {
    let transform = [1.0, 0.0, 0.0, 0.01 * number as f32, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];
    Step::new(number, 0.0).transform(0, &transform)
}

pub(crate) async fn drive(client: &Client, scene: &str) -> StepStream {
    let request = DriveRequest::new(scene, Delivery::Lossless).take_over();
    with_timeout(client.drive(&request)).await.expect("expected the writer lease")
}

/// Sends data that exceed the limit if each stalled reader buffers them. Returns their size for one reader in bytes.
async fn send_data(client: &Client, kind: StreamKind) -> u64 {
    let (scene, steps, bytes_per_step) = match kind {
        StreamKind::Frames => ("plate", 24, 640 * 360 * 4),
        // Color, and three f32 for the normal.
        StreamKind::Pictures => ("plate", 8, 640 * 360 * (4 + 12)),
        // Positions and normals of 10,000 vertices of the grid.
        StreamKind::Vertices => ("crowded", 80, 10_000 * 24),
        StreamKind::States => ("crowded", 200, DOMAINS as u64 * 52),
        StreamKind::Forces => return send_forces(client).await,
    };
    let mut writer = drive(client, scene).await;
    for number in 0..steps {
        let step = if scene == "plate" { plate_step(number) } else { crowded_step(number) };
        with_timeout(writer.step(&step)).await.expect("expected the step to be sent");
    }
    with_timeout(writer.finish()).await.expect("expected all steps to complete");
    steps * bytes_per_step
}

async fn send_forces(client: &Client) -> u64 {
    const SETS: u64 = 600;
    for number in 0..SETS {
        let forces = (0..16).map(|id| Force::on_modes(id, 1, &[number as f32; FORCE_RANK]));
        let request = ForceRequest::new("crowded", &[7; 16]).lifetime_ms(10_000);
        let request = forces.fold(request, ForceRequest::force);
        with_timeout(client.apply_forces(&request)).await.expect("expected valid forces");
    }
    SETS * 16 * 4 * FORCE_RANK as u64
}

/// Calls with large replies that nobody reads, on one connection.
async fn unread_calls(channel: &Channel) -> Vec<MessageSizes> {
    let mut calls = Vec::new();
    let scene = || "crowded".to_owned();
    let picture = v1::Picture { width: 640, height: 360, format: v1::Format::Rgba.into(), ..Default::default() };
    for _ in 0..12 {
        let mut scenes = SceneServiceClient::new(channel.clone());
        let describe =
            v1::DescribeSceneRequest { scene: scene(), arrays: vec![1, 2, 3, 4, 5, 6], ..Default::default() };
        calls.push(message_sizes(scenes.describe_scene(describe).await.expect("expected a reply")));
        let modes = v1::ReadModesRequest { scene: scene(), ..Default::default() };
        calls.push(message_sizes(scenes.read_modes(modes).await.expect("expected a reply")));
        let vertices = v1::GetVerticesRequest { scene: scene(), ..Default::default() };
        let reply = VertexServiceClient::new(channel.clone()).get_vertices(vertices).await;
        calls.push(message_sizes(reply.expect("expected a reply")));
        let pictures = vec![picture.clone(); 4];
        let frame = v1::RenderFrameRequest { scene: "plate".into(), pictures, ..Default::default() };
        let reply = FrameServiceClient::new(channel.clone()).render_frame(frame).await;
        calls.push(message_sizes(reply.expect("expected a reply")));
    }
    calls
}

/// A writer that never reads its replies can continue to send steps.
async fn send_steps_without_reading(server: &ServerProcess, client: &Client) {
    const STEPS: u64 = 5000;
    let (sender, requests) = mpsc::channel(16);
    let open = v1::OpenDrive { scene: "plate".into(), delivery: v1::Delivery::Lossless.into(), ..Default::default() };
    sender.send(v1::DriveSceneRequest { kind: Some(Kind::Open(open)) }).await.expect("expected an open stream");
    let mut service = StepServiceClient::new(server.channel().await);
    let replies = service.drive_scene(ReceiverStream::new(requests)).await.expect("expected a stream");
    for number in 1..=STEPS {
        let step = v1::Step { number, ..Default::default() };
        let request = v1::DriveSceneRequest { kind: Some(Kind::Step(step)) };
        with_timeout(sender.send(request)).await.expect("expected an open stream");
    }
    let layout = StateLayout::new(&client.describe("plate", &[]).await.expect("expected a description"));
    let request = StateRequest::new("plate", ()).minimum_step(STEPS);
    with_timeout(client.get_state(&request, &layout.expect("expected a layout")))
        .await
        .expect("expected the last step");
    drop(replies);
}

/// Clients of every kind of stream never read. The memory of the server remains bounded, and a client that reads
/// receives every step.
#[tokio::test(flavor = "multi_thread")]
async fn stalled_readers_take_bounded_memory() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    write_plate(&folder.path().join("scenes"));
    let server = ServerProcess::start(folder.path());
    let client = server.client().await;
    client.upload_arrays(crowded_upload()).await.expect("expected the upload to succeed");
    client.open_scene("plate", "").await.expect("expected the scene to open");
    for kind in StreamKind::ALL {
        let scene = if matches!(kind, StreamKind::Frames | StreamKind::Pictures) { "plate" } else { "crowded" };
        let subscribe = async |delivery| {
            let stream = kind.subscribe(&server.channel().await, scene, delivery).await;
            stream.expect("expected a subscription")
        };
        let mut stalled = Vec::new();
        for _ in 0..STALLED_READERS {
            stalled.push(subscribe(v1::Delivery::Latest).await);
        }
        let mut read = subscribe(v1::Delivery::Lossless).await;
        let reader = tokio::spawn(async move { while let Some(Ok(_)) = read.next().await {} });
        // The first data of a kind create caches and programs, and fill the buffers of the transport.
        send_data(&client, kind).await;
        let before = server.resident_bytes();
        let bytes = send_data(&client, kind).await;
        let growth = server.resident_bytes().saturating_sub(before);
        println!("{kind:?}: {} MB for each reader, growth {} MB", bytes >> 20, growth >> 20);
        assert!(bytes * STALLED_READERS > 2 * MAX_GROWTH, "control: {kind:?}: expected data above the limit");
        assert!(growth < MAX_GROWTH, "{kind:?}: {STALLED_READERS} stalled readers took {growth} bytes");
        reader.abort();
    }
    send_steps_without_reading(&server, &client).await;
    let channel = server.channel().await;
    drop(unread_calls(&channel).await);
    let before = server.resident_bytes();
    let calls = unread_calls(&channel).await;
    // The server packs the vertices of this call after those of the unread calls.
    client.get_vertices(&VertexRequest::new("crowded", VertexSelection::default())).await.expect("expected vertices");
    let growth = server.resident_bytes().saturating_sub(before);
    println!("{} unread calls: growth {} MB", calls.len(), growth >> 20);
    assert!(growth < MAX_GROWTH, "{} unread calls took {growth} bytes", calls.len());
}

/// Run and number of the last step in the checkpoint of the scene `crowded`.
fn checkpoint_step(state: &Path) -> Option<(u64, u64)> {
    let bytes = std::fs::read(state.join("steps/crowded.step")).ok()?;
    let [run, number] = [8..16, 16..24].map(|range| Some(u64::from_le_bytes(bytes.get(range)?.try_into().ok()?)));
    run.zip(number)
}

/// Asserts that the scene shows all domains of one step. `kept_step` is the run and the number of a step of the same
/// run that is not newer.
async fn assert_whole_step(client: &Client, description: &SceneDescription, kept_step: (u64, u64)) {
    let layout = StateLayout::new(description).expect("expected a layout");
    let state = client.get_state(&StateRequest::new("crowded", ()), &layout).await.expect("expected a state");
    assert!(state.step.run == kept_step.0 && state.step.number >= kept_step.1, "{:?} {kept_step:?}", state.step);
    let offset = if state.step.run == 0 { 0.0 } else { step_offset(state.step.number) };
    for domain in 0..DOMAINS {
        let transform = state.transform(domain).expect("expected a transform");
        assert_eq!(transform[3].to_bits(), offset.to_bits(), "domain {domain}");
    }
}

/// An upload that has sent its header and a part of its arrays. The call ends when the server does.
async fn begin_upload(server: &ServerProcess) -> JoinHandle<Result<(), Status>> {
    use v1::upload_arrays_request::Part;
    let header = v1::UploadArraysHeader { scene: "half".into(), domains: 1, total_bytes: 48, ..Default::default() };
    let domain = v1::UploadedDomain { name: "a".into(), vertices: 3, triangles: 1, ..Default::default() };
    let parts = [Part::Header(header), Part::Domain(domain), Part::Chunk(vec![0; 30].into())];
    let requests = parts.map(|part| v1::UploadArraysRequest { part: Some(part) });
    let requests = tokio_stream::iter(requests).chain(tokio_stream::pending());
    let channel = server.channel().await;
    tokio::spawn(async move { SceneServiceClient::new(channel).upload_arrays(requests).await.map(drop) })
}

/// Begins an upload and every kind of stream, and leaves them in progress.
async fn begin_calls(server: &ServerProcess) -> Vec<JoinHandle<Result<(), Status>>> {
    let mut calls = vec![begin_upload(server).await];
    for kind in StreamKind::ALL {
        for delivery in [v1::Delivery::Lossless, v1::Delivery::Latest] {
            let mut stream =
                kind.subscribe(&server.channel().await, "crowded", delivery).await.expect("a subscription");
            calls.push(tokio::spawn(async move {
                while let Some(message) = stream.next().await {
                    message?;
                }
                Ok(())
            }));
        }
    }
    calls
}

/// A server that is killed while all kinds of calls are in progress keeps its scenes and a complete step, and later
/// runs have larger numbers. Nothing remains of the upload that was in progress, and every client gets an error.
#[tokio::test(flavor = "multi_thread")]
async fn killed_server_keeps_scenes_steps_and_runs() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let server = ServerProcess::start(folder.path());
    let client = server.client().await;
    client.upload_arrays(crowded_upload()).await.expect("expected the upload to succeed");
    let described = client.describe("crowded", &ALL_ARRAYS).await.expect("expected a description");
    drop((client, server));
    let state = folder.path().join("state");
    // Run and number of a step that was on disk before the server was killed.
    let mut kept_step = (0, 0);
    for _ in 0..3 {
        let server = ServerProcess::start(folder.path());
        let client = server.client().await;
        let described_again = client.describe("crowded", &ALL_ARRAYS).await.expect("expected to wait for the scene");
        assert_eq!(described_again.domains, described.domains);
        let scenes = client.list_scenes().await.expect("expected a list").scenes;
        assert_eq!(scenes.iter().map(|scene| scene.scene.as_str()).collect::<Vec<_>>(), ["crowded"]);
        let uploads = std::fs::read_dir(state.join("uploads")).expect("expected an uploads folder").count();
        assert_eq!(uploads, 1, "expected no files of the broken upload");
        let description = client.describe("crowded", &ALL_ARRAYS).await.expect("expected a description");
        assert_eq!((&description.shapes, &description.domains), (&described.shapes, &described.domains));
        assert_whole_step(&client, &description, kept_step).await;
        let mut writer = drive(&client, "crowded").await;
        assert!(writer.run > kept_step.0, "expected a run above {}, got {}", kept_step.0, writer.run);
        let calls = begin_calls(&server).await;
        let run = writer.run;
        let sending = tokio::spawn(async move {
            let mut number = 0;
            while writer.step(&crowded_step(number)).await.is_ok() {
                number += 1;
            }
        });
        let written = async {
            while checkpoint_step(&state).is_none_or(|step| step < (run, 5)) {
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        };
        with_timeout(written).await;
        kept_step = (run, 5);
        drop(server);
        with_timeout(sending).await.expect("expected no panic");
        for call in calls {
            let end = with_timeout(call).await.expect("expected no panic");
            assert!(end.is_err(), "expected an error, because the server was killed");
        }
    }
}

/// A signal that arrives as soon as the server has printed its address is not lost, and the exit code is 0.
#[test]
fn sigterm_after_the_start_is_a_clean_exit() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    for _ in 0..3 {
        let mut server = ServerProcess::start(folder.path());
        let process = rustix::process::Pid::from_child(&server.process);
        rustix::process::kill_process(process, rustix::process::Signal::TERM).expect("expected a process");
        let status = server.process.wait().expect("expected an exit status");
        assert!(status.success(), "{status}");
    }
}
