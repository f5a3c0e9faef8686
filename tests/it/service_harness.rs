//! Test harness: a server on a free loopback port, scenes built in code, and clients with default limits.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use modalcast::config::{Authentication, BackendChoice, Config, ListenAddress, RendererChoice};
use modalcast::engine::{Engine, SceneSource, StoredUpload};
use modalcast::service;
use modalcast_compute::reference;
use modalcast_model::domain::{
    Attachment, Domain, FollowConstraint, Material, Mesh, Metadata, Modes, Shape, Transform,
};
use modalcast_model::error::{Error, Result, invalid};
use modalcast_model::load::OpenedScene;
use modalcast_model::memory::MemoryReservation;
use modalcast_model::scene::{
    DeformationSettings, RawStepUpdate, RenderSettings, Scene, SceneParts, SceneState, ShadowSettings, StepUpdate,
    TransformFormat,
};
use modalcast_proto::v1;
use prost::Message as _;
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinHandle;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Streaming;
use tonic::transport::Channel;
use tonic_types::StatusExt as _;

use v1::drive_scene_request::Kind as RequestKind;
use v1::drive_scene_response::Kind as ResponseKind;
use v1::frame_service_client::FrameServiceClient;
use v1::scene_service_client::SceneServiceClient;
use v1::step_service_client::StepServiceClient;
use v1::vertex_service_client::VertexServiceClient;

use crate::common::hang_guard::HANG_GUARD;

/// A time that no test reaches: a server with this limit never ends anything because it was slow.
pub(crate) const NEVER: Duration = Duration::from_secs(3600);

/// A time limit of a server that ends silent clients, in tests that also have active ones: short enough to wait for,
/// and longer than a busy machine delays an active client.
pub(crate) const SILENCE_LIMIT: Duration = Duration::from_secs(4);

/// Size limit of one message of the server in bytes: a chunk of 1 MiB and the other fields.
pub(crate) const MAX_MESSAGE_BYTES: usize = (1 << 20) + 4096;

/// Selects the server's default window: the maximum number of steps without acknowledgment.
pub(crate) const DEFAULT_WINDOW: u32 = 0;

/// Source of scenes built in code: `strips` (two small domains), `far` (`strips` far from the world origin), `twig`
/// (with followers), `attributes` (with displacements and boxes), `sheet` (more than 1 MiB per array), `crowd`
/// (70,000 domains), `shadowless-strips`, `shadowless-twig` and `panic` (the loader panics).
pub(crate) struct SyntheticScenes;

impl SceneSource for SyntheticScenes {
    fn open(&self, source: &str, _: &Arc<MemoryReservation>) -> Result<OpenedScene> {
        let scene = match source {
            "strips" => strips(),
            "far" => far_strips(),
            "twig" => twig(),
            "attributes" => strips_with_attributes(),
            "sheet" => sheet(),
            "crowd" => crowd(),
            "shadowless-strips" => without_shadows(&strips()),
            "shadowless-twig" => without_shadows(&twig()),
            "panic" => panic!("intended panic of the loader"),
            _ => return Err(Error::NotFound { what: "scene", given: source.into() }),
        };
        Ok(scene.into())
    }

    /// Opens the source whose name is the text of a file; an empty `entry` means `scene.txt`.
    fn open_upload(&self, upload: &StoredUpload, memory: &Arc<MemoryReservation>) -> Result<OpenedScene> {
        let entry = if upload.entry.is_empty() { "scene.txt" } else { &upload.entry };
        let path = upload.folder.join(entry);
        let text = std::fs::read_to_string(path).map_err(|error| invalid("entry", "a file", error))?;
        self.open(text.trim(), memory)
    }

    fn list(&self) -> Vec<String> {
        ["panic", "sheet", "strips"].map(String::from).to_vec()
    }
}

/// Two domains, `left` and `right`, of one shape: a square with four vertices and two modes. `right` is attached to
/// `left`.
pub(crate) fn strips() -> Arc<Scene> {
    let (shape, domains) = two_strips(1.0);
    scene("strips", shape, domains)
}

/// [`strips`] with two more domains of the same shape: `leaf` follows `right`, and `leaflet` follows `leaf`.
pub(crate) fn twig() -> Arc<Scene> {
    let (shape, mut domains) = two_strips(1.0);
    let frame = Transform([0.0, -1.0, 0.0, 0.5, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, -0.25]);
    for (name, parent) in [("leaf", 1), ("leaflet", 2)] {
        domains.push(Domain { follows: Some(FollowConstraint { parent, frame }), ..domain(name, None) });
    }
    scene("twig", shape, domains)
}

/// [`strips`] with a unit of half a meter. The origin of the scene is 17,000 km from the world origin.
pub(crate) fn far_strips() -> Arc<Scene> {
    let (shape, domains) = two_strips(1.0);
    let (shapes, materials) = (vec![shape], vec![Material::default()]);
    let parts = SceneParts {
        shapes,
        materials,
        domains,
        unit: Some(0.5),
        origin: [1e7, -1e7, 1e7 + 0.25],
        ..SceneParts::named("far")
    };
    Scene::new(parts).expect("expected a valid scene")
}

/// [`strips`] with larger modes, displacements and boxes.
pub(crate) fn strips_with_attributes() -> Arc<Scene> {
    let (shape, domains) = two_strips(4.0);
    let deformation = DeformationSettings { displacements: true, boxes: true, ..DeformationSettings::default() };
    let (shapes, materials) = (vec![shape], vec![Material::default()]);
    Scene::new(SceneParts { shapes, materials, domains, deformation, ..SceneParts::named("attributes") })
        .expect("expected a valid scene")
}

/// A scene without shadows.
fn without_shadows(scene: &Scene) -> Arc<Scene> {
    let look = RenderSettings { shadow: None, ..scene.look };
    Scene::new(SceneParts { look, ..scene.parts() }).expect("expected a valid scene")
}

/// 70,000 squares of one shape, more than one part of a vertex layout has.
pub(crate) fn crowd() -> Arc<Scene> {
    let (shape, _) = two_strips(1.0);
    let domains = (0..70_000).map(|index: u32| domain(&index.to_string(), None)).collect();
    scene("crowd", shape, domains)
}

/// The shape and the domains of [`strips`], with the entries of U times `mode_scale`.
fn two_strips(mode_scale: f32) -> (Shape, Vec<Domain>) {
    // 12 rows (four vertices times three axes) and two columns of arbitrary numbers up to 0.5.
    let unscaled_entry = |index: u32| if index.is_multiple_of(5) { 0.5 } else { 0.125 * (index % 3) as f32 };
    let columns = (0..24).map(|index| mode_scale * unscaled_entry(index)).collect();
    let modes = Modes::from_columns(12, 2, columns).expect("expected valid modes");
    let shape = Shape::new(grid(2), modes).expect("expected a valid shape");
    // An attachment and metadata are sent to clients, but do not change the vertices.
    let attachment = Attachment { parent: 0, frame: Transform::IDENTITY, vertices: vec![1, 3] };
    let notes = [("species".to_owned(), "none".to_owned())].into();
    let metadata = Metadata { eigenvalues: vec![1.0, 4.0], inertia: None, notes };
    let left = Domain { metadata, ..domain("left", None) };
    (shape, vec![left, domain("right", Some(attachment))])
}

/// One sheet of 300 x 300 vertices and four modes.
pub(crate) fn sheet() -> Arc<Scene> {
    let rows = 3 * 300 * 300;
    let columns = (0..4 * rows).map(|entry| ((entry % 1009) as f32 - 504.0) / 1009.0).collect();
    let shape = Shape::new(grid(300), Modes::from_columns(rows, 4, columns).expect("expected valid modes"))
        .expect("expected a valid shape");
    scene("sheet", shape, vec![domain("sheet", None)])
}

/// A square of `side` x `side` vertices with unit spacing.
fn grid(side: u32) -> Mesh {
    let positions =
        (0..side * side).map(|index| [(index % side) as f32, (index / side) as f32, 0.0]).collect::<Vec<_>>();
    let uvs = positions.iter().map(|[x, y, _]| [x / side as f32, y / side as f32]).collect();
    let first_vertices = (0..(side - 1) * (side - 1)).map(|cell| cell % (side - 1) + cell / (side - 1) * side);
    let triangles = first_vertices
        .flat_map(|vertex| [[vertex, vertex + 1, vertex + side], [vertex + 1, vertex + side + 1, vertex + side]])
        .collect();
    let normals = vec![[0.0, 0.0, 1.0]; positions.len()];
    Mesh::from_indexed(positions, normals, uvs, triangles).expect("expected a valid mesh")
}

/// A domain of shape 0.
fn domain(name: &str, attachment: Option<Attachment>) -> Domain {
    Domain { attachment, ..Domain::new(name, 0) }
}

/// A scene of one shape.
fn scene(name: &str, shape: Shape, domains: Vec<Domain>) -> Arc<Scene> {
    // A small shadow map saves time. The tests do not check shadows.
    let look = RenderSettings {
        shadow: Some(ShadowSettings { size: 128, ..ShadowSettings::default() }),
        ..RenderSettings::default()
    };
    let materials = vec![Material::default()];
    let parts = SceneParts { shapes: vec![shape], materials, domains, look, ..SceneParts::named(name) };
    Scene::new(parts).expect("expected a valid scene")
}

/// Settings of a test server: reference deformer, no renderer, any free port, and no limit on the time that a client
/// takes, because a busy machine may delay any client. `state` is the folder of persistent state.
pub(crate) fn config(state: &Path) -> Config {
    Config {
        listen: vec![ListenAddress::Tcp(([127, 0, 0, 1], 0).into())],
        state: state.to_owned(),
        authentication: Authentication::Off,
        backend: BackendChoice::Reference,
        renderer: RendererChoice::Off,
        message_bytes: 1 << 20,
        message_timeout: NEVER,
        reply_timeout: NEVER,
        deadline: NEVER,
        max_deadline: NEVER,
        stall_budget: NEVER,
        upload_stall_budget: NEVER,
        handshake_timeout: NEVER,
        first_request_timeout: NEVER,
        keepalive_interval: NEVER,
        keepalive_timeout: NEVER,
        ..Config::default()
    }
}

/// Options of a server in a process of its own that raise the limits on the time that a client takes.
pub(crate) const LONG_LIMITS: [&str; 6] =
    ["--deadline-ms", "600000", "--message-timeout-ms", "600000", "--stall-budget-ms", "600000"];

/// A running server.
pub(crate) struct Server {
    pub(crate) engine: Engine,
    /// URL with the port.
    pub(crate) address: String,
    stop_sender: Option<oneshot::Sender<()>>,
    task: JoinHandle<Result<()>>,
    /// Deleted after the server has stopped.
    folder: Option<tempfile::TempDir>,
}

impl Server {
    /// Starts a server with the settings of [`config`] and a new state folder.
    pub(crate) async fn start_default() -> Self {
        Self::start_with(|config| config).await
    }

    /// Starts a server with the settings of [`config`] after `change`, and a new state folder.
    pub(crate) async fn start_with(change: impl FnOnce(Config) -> Config) -> Self {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let mut server = Self::start(change(config(folder.path()))).await;
        server.folder = Some(folder);
        server
    }

    /// Starts a server that can open the [`SyntheticScenes`].
    pub(crate) async fn start(config: Config) -> Self {
        Self::start_from(config, Arc::new(SyntheticScenes)).await
    }

    /// Starts a server that can open the scenes of a source.
    pub(crate) async fn start_from(config: Config, source: Arc<dyn SceneSource>) -> Self {
        let config = config.validated().expect("expected valid settings");
        let listener = service::bind(&config).await.expect("expected a free port");
        let address = listener.urls()[0].clone();
        let engine = Engine::start(config, source).await.expect("expected an engine");
        let mut are_reopened = engine.watch_reopening();
        are_reopened.wait_for(|are_reopened| *are_reopened).await.expect("expected a running engine");
        let (stop_sender, stop_receiver) = oneshot::channel();
        let shutdown = async {
            stop_receiver.await.ok();
        };
        let task = tokio::spawn(service::serve(engine.clone(), listener, shutdown));
        Self { engine, address, stop_sender: Some(stop_sender), task, folder: None }
    }

    /// Opens a new connection.
    pub(crate) async fn channel(&self) -> Channel {
        Channel::from_shared(self.address.clone())
            .expect("expected a socket address")
            .connect()
            .await
            .expect("expected a connection")
    }

    pub(crate) async fn scenes(&self) -> SceneServiceClient<Channel> {
        SceneServiceClient::new(self.channel().await)
    }

    pub(crate) async fn vertices(&self) -> VertexServiceClient<Channel> {
        VertexServiceClient::new(self.channel().await)
    }

    pub(crate) async fn frames(&self) -> FrameServiceClient<Channel> {
        FrameServiceClient::new(self.channel().await)
    }

    /// Opens a source under its own name.
    pub(crate) async fn open(&self, source: &str) -> v1::SceneInfo {
        let request = v1::OpenSceneRequest { source: source.into(), scene: String::new() };
        self.scenes()
            .await
            .open_scene(request)
            .await
            .expect("expected the scene to open")
            .into_inner()
            .scene
            .expect("expected the scene info")
    }

    /// Opens a step stream with lossless delivery and the default window, and expects success.
    pub(crate) async fn drive_lossless(&self, scene: &str) -> StepWriter {
        self.drive(scene, v1::Delivery::Lossless, DEFAULT_WINDOW).await
    }

    /// As [`Self::drive_lossless`], with a first step that changes the current state instead of the rest state.
    pub(crate) async fn drive_from_current_state(&self, scene: &str) -> StepWriter {
        let mut writer = StepWriter::connect(self.channel().await).await;
        let open = v1::OpenDrive {
            scene: scene.into(),
            delivery: v1::Delivery::Lossless.into(),
            initial_state: v1::InitialState::Keep.into(),
            ..v1::OpenDrive::default()
        };
        writer.send(RequestKind::Open(open)).await;
        let opened = writer.receive_reply().await;
        assert!(matches!(opened, ResponseKind::Opened(_)), "{opened:?}");
        writer
    }

    /// Opens a step stream and expects success. `window` is the maximum number of steps without acknowledgment.
    pub(crate) async fn drive(&self, scene: &str, delivery: v1::Delivery, window: u32) -> StepWriter {
        let mut writer = StepWriter::connect(self.channel().await).await;
        let opened = writer.open(scene, delivery, window).await;
        assert!(matches!(opened, ResponseKind::Opened(_)), "{opened:?}");
        writer
    }

    /// Number of permits of a resource that were preempted.
    pub(crate) fn preempted(&self, resource: &'static str) -> u64 {
        self.engine.admission().preempted.get_or_create(&[("resource", resource)]).get()
    }

    /// Stops the server and waits for its end.
    pub(crate) async fn stop(mut self) -> Result<()> {
        self.stop_sender.take().expect("expected a running server").send(()).ok();
        with_timeout(self.task).await.expect("expected the task not to panic")
    }
}

/// Awaits a future and panics after [`HANG_GUARD`].
pub(crate) async fn with_timeout<T>(work: impl Future<Output = T>) -> T {
    tokio::time::timeout(HANG_GUARD, work).await.expect("expected completion")
}

/// Client end of a step stream, as a physics process uses it.
pub(crate) struct StepWriter {
    sender: mpsc::Sender<v1::DriveSceneRequest>,
    pub(crate) replies: Streaming<v1::DriveSceneResponse>,
}

impl StepWriter {
    pub(crate) async fn connect(channel: Channel) -> Self {
        Self::connect_with(channel, tonic::Request::new).await
    }

    /// As [`Self::connect`], with metadata that `to_request` adds.
    pub(crate) async fn connect_with(
        channel: Channel,
        to_request: impl FnOnce(
            ReceiverStream<v1::DriveSceneRequest>,
        ) -> tonic::Request<ReceiverStream<v1::DriveSceneRequest>>,
    ) -> Self {
        let (sender, requests) = mpsc::channel(1024);
        let mut client = StepServiceClient::new(channel);
        let replies = with_timeout(client.drive_scene(to_request(ReceiverStream::new(requests))))
            .await
            .expect("expected a stream")
            .into_inner();
        Self { sender, replies }
    }

    /// Requests to drive a scene and returns the reply. `window` is the maximum number of steps without
    /// acknowledgment.
    pub(crate) async fn open(&mut self, scene: &str, delivery: v1::Delivery, window: u32) -> ResponseKind {
        let open = v1::OpenDrive { scene: scene.into(), delivery: delivery.into(), window, ..v1::OpenDrive::default() };
        self.send(RequestKind::Open(open)).await;
        self.receive_reply().await
    }

    pub(crate) async fn send(&self, kind: RequestKind) {
        self.sender.send(v1::DriveSceneRequest { kind: Some(kind) }).await.expect("expected an open stream");
    }

    pub(crate) async fn send_step(&self, step: v1::Step) {
        self.send(RequestKind::Step(step)).await;
    }

    pub(crate) async fn receive_reply(&mut self) -> ResponseKind {
        let reply =
            with_timeout(self.replies.message()).await.expect("expected another message").expect("expected a reply");
        reply.kind.expect("expected a message kind")
    }

    /// Sends a step, waits for the reply and expects its acknowledgment.
    pub(crate) async fn send_step_and_wait(&mut self, step: v1::Step) -> v1::Acknowledgment {
        let number = step.number;
        self.send_step(step).await;
        match self.receive_reply().await {
            ResponseKind::Ack(ack) if ack.step == number => ack,
            other => panic!("expected an acknowledgment of step {number}, got {other:?}"),
        }
    }

    /// Receives a reply and expects a rejection.
    pub(crate) async fn receive_rejection(&mut self) -> v1::Rejection {
        match self.receive_reply().await {
            ResponseKind::Rejection(rejection) => rejection,
            other => panic!("expected a rejection, got {other:?}"),
        }
    }

    /// Closes the requests and reads until the server ends the replies.
    pub(crate) async fn finish(self) {
        let Self { sender, mut replies } = self;
        drop(sender);
        while with_timeout(replies.message()).await.expect("expected the stream to end without an error").is_some() {}
    }

    /// Splits the stream into its two directions, for concurrent use.
    pub(crate) fn split(self) -> (mpsc::Sender<v1::DriveSceneRequest>, Streaming<v1::DriveSceneResponse>) {
        (self.sender, self.replies)
    }

    /// Drops both directions of the stream. Unlike [`Self::finish`], does not wait for the server.
    pub(crate) fn disconnect(self) {}
}

/// A step at the time `number / 2`. `q` has the coordinates of `q_domains`, or of all domains if `q_domains` is empty.
/// An empty `q` changes no coordinates.
pub(crate) fn step(number: u64, q_domains: &[u32], q: &[f32]) -> v1::Step {
    let q = q.iter().flat_map(|number| number.to_le_bytes()).collect::<Vec<u8>>().into();
    v1::Step { number, time: number as f64 * 0.5, q_domains: q_domains.to_vec(), q, ..v1::Step::default() }
}

/// A step in one of the two rigid formats. Each of `poses` consists of a domain, a rotation as a quaternion x y z w,
/// and a translation.
pub(crate) fn rigid_step(number: u64, format: v1::TransformFormat, poses: &[(u32, [f32; 4], [f64; 3])]) -> v1::Step {
    let mut bytes = Vec::new();
    for (_, rotation, translation) in poses {
        bytes.extend(rotation.iter().flat_map(|number| number.to_le_bytes()));
        match format {
            v1::TransformFormat::QuaternionXyzwF64 => {
                bytes.extend(translation.iter().flat_map(|number| number.to_le_bytes()))
            }
            _ => bytes.extend(translation.iter().flat_map(|number| (*number as f32).to_le_bytes())),
        }
    }
    v1::Step {
        transform_domains: poses.iter().map(|(domain, ..)| *domain).collect(),
        transforms: bytes.into(),
        transform_format: format.into(),
        ..step(number, &[], &[])
    }
}

/// Vertices of the f64 reference, rounded to f32.
#[derive(Debug, PartialEq)]
pub(crate) struct ReferenceVertices {
    pub(crate) positions: Vec<f32>,
    pub(crate) normals: Vec<f32>,
}

/// Positions and normals of the f64 reference after some steps from rest.
pub(crate) fn reference_vertices(scene: &Scene, steps: &[v1::Step]) -> ReferenceVertices {
    let state = state_after_steps(scene, steps);
    let round_to_f32 = |list: Vec<[f64; 3]>| list.into_flattened().into_iter().map(|number| number as f32).collect();
    ReferenceVertices {
        positions: round_to_f32(reference::deform(scene, &state)),
        normals: round_to_f32(reference::rigid_normals(scene, &state)),
    }
}

/// State of the scene after some steps from rest.
pub(crate) fn state_after_steps(scene: &Scene, steps: &[v1::Step]) -> SceneState {
    use v1::TransformFormat as WireFormat;
    let mut state = SceneState::rest(scene);
    for step in steps.iter().cloned() {
        let transform_format = match step.transform_format() {
            WireFormat::Unspecified | WireFormat::AffineF32 => TransformFormat::Affine,
            WireFormat::QuaternionXyzwF32 => TransformFormat::QuaternionXyzwF32,
            WireFormat::QuaternionXyzwF64 => TransformFormat::QuaternionXyzwF64,
        };
        let raw_update = RawStepUpdate {
            number: step.number,
            time: step.time,
            q_domains: step.q_domains,
            q: step.q,
            transform_domains: step.transform_domains,
            transforms: step.transforms,
            transform_format,
        };
        state.apply(scene, &StepUpdate::parse(scene, &raw_update).expect("expected a valid step"));
    }
    state
}

/// Vertex data of one step, joined from chunks.
#[derive(Debug)]
pub(crate) struct ReceivedVertices {
    /// Empty for a step of a stream.
    pub(crate) layout: v1::VertexLayout,
    pub(crate) head: v1::VertexHead,
    pub(crate) positions: Vec<f32>,
    pub(crate) normals: Vec<f32>,
    pub(crate) displacements: Vec<f32>,
    /// Six numbers per selected domain: minimum, then maximum.
    pub(crate) boxes: Vec<f32>,
    /// Three numbers for all domains or for each selected domain; empty if they have not changed.
    pub(crate) origins: Vec<f64>,
}

impl ReceivedVertices {
    pub(crate) fn step(&self) -> v1::StepId {
        self.head.step.expect("expected a valid step")
    }
}

/// A selection of attributes as f32.
pub(crate) fn select(domains: &[u32], attributes: &[v1::Attribute]) -> Option<v1::VertexSelection> {
    let to_wire = |attribute: &v1::Attribute| v1::SelectedAttribute { attribute: (*attribute).into(), encoding: 0 };
    Some(v1::VertexSelection { domains: domains.to_vec(), attributes: attributes.iter().map(to_wire).collect() })
}

/// Requests the vertices of a scene.
pub(crate) async fn get_vertices(
    server: &Server,
    request: v1::GetVerticesRequest,
) -> Result<ReceivedVertices, tonic::Status> {
    use v1::get_vertices_response::Part;
    let mut stream = with_timeout(server.vertices().await.get_vertices(request)).await?.into_inner();
    let (mut received_layout, mut chunks) = (None, Vec::new());
    while let Some(response) = with_timeout(stream.message()).await? {
        assert!(response.encoded_len() <= MAX_MESSAGE_BYTES, "{} bytes", response.encoded_len());
        match response.part.expect("expected a part") {
            Part::Layout(layout) => {
                assert!(chunks.is_empty() && !layout.has_more);
                received_layout = Some(layout);
            }
            Part::Chunk(chunk) => chunks.push(chunk),
        }
    }
    let layout = received_layout.expect("expected a layout before the first chunk");
    Ok(ReceivedVertices { layout, ..join_chunks(chunks) })
}

/// Reads the next step of a vertex stream; `None` at its end. Skips the layout.
pub(crate) async fn next_vertices(
    stream: &mut Streaming<v1::StreamVerticesResponse>,
) -> Result<Option<ReceivedVertices>, tonic::Status> {
    use v1::stream_vertices_response::Part;
    let mut chunks = Vec::<v1::VertexChunk>::new();
    while let Some(response) = with_timeout(stream.message()).await? {
        match response.part.expect("expected a part") {
            Part::Settings(_) | Part::Layout(_) => continue,
            Part::Chunk(chunk) => chunks.push(chunk),
        }
        let total = chunks[0].head.as_ref().expect("expected a head as the first message").total;
        if chunks.iter().map(|chunk| chunk.data.len() as u64).sum::<u64>() == total {
            return Ok(Some(join_chunks(chunks)));
        }
    }
    assert!(chunks.is_empty(), "expected the stream to end after a complete step");
    Ok(None)
}

fn join_chunks(mut chunks: Vec<v1::VertexChunk>) -> ReceivedVertices {
    let head = chunks[0].head.take().expect("expected a head as the first message");
    let mut bytes = Vec::new();
    for chunk in chunks {
        assert_eq!(chunk.offset, bytes.len() as u64);
        assert!(chunk.head.is_none(), "expected one head per reply");
        bytes.extend_from_slice(&chunk.data);
    }
    assert_eq!(head.total, bytes.len() as u64);
    // The sections follow each other without gaps.
    let ends = head.sections.iter().map(|section| section.offset + section.bytes);
    assert!(
        head.sections.iter().map(|section| section.offset).eq([0].into_iter().chain(ends).take(head.sections.len()))
    );
    let section = |attribute: v1::Attribute| -> &[u8] {
        let section = head.sections.iter().find(|section| section.attribute() == attribute);
        section.map_or(&[], |section| &bytes[section.offset as usize..][..section.bytes as usize])
    };
    let floats = |attribute: v1::Attribute| bytemuck::pod_collect_to_vec::<u8, f32>(section(attribute));
    ReceivedVertices {
        layout: v1::VertexLayout::default(),
        positions: floats(v1::Attribute::Positions),
        normals: floats(v1::Attribute::Normals),
        displacements: floats(v1::Attribute::Displacements),
        boxes: floats(v1::Attribute::Boxes),
        origins: bytemuck::pod_collect_to_vec::<u8, f64>(section(v1::Attribute::Origins)),
        head,
    }
}

/// Selects exactly this step of the latest run.
pub(crate) const fn exact_step(number: u64) -> Option<v1::StepSelector> {
    Some(v1::StepSelector { run: 0, number: Some(v1::step_selector::Number::Exact(number)) })
}

/// Selects this step of the latest run or a later one.
pub(crate) const fn minimum_step(number: u64) -> Option<v1::StepSelector> {
    Some(v1::StepSelector { run: 0, number: Some(v1::step_selector::Number::Minimum(number)) })
}

/// The standard details of a status, as a rejection.
pub(crate) fn rejection_details(status: &tonic::Status) -> v1::Rejection {
    let error_info = status.get_details_error_info().expect("expected an ErrorInfo in the status details");
    assert_eq!(error_info.domain, "modalcast");
    let text =
        |key: &str| error_info.metadata.get(key).cloned().unwrap_or_else(|| panic!("expected {key} in {status:?}"));
    let violations = status.get_details_bad_request().map_or_else(Vec::new, |bad_request| bad_request.field_violations);
    v1::Rejection {
        step: None,
        reason: v1::Reason::from_str_name(&error_info.reason).expect("expected a known reason").into(),
        field: violations.first().map_or_else(String::new, |violation| violation.field.clone()),
        expected: text("expected"),
        given: text("given"),
    }
}
