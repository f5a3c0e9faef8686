//! The gRPC services of the fake server and their router.

use std::convert::Infallible;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use bytes::Bytes;
use modalcast_proto::v1;
use sha2::{Digest as _, Sha256};
use tokio_stream::StreamExt as _;
use tokio_stream::wrappers::{BroadcastStream, ReceiverStream, TcpListenerStream};
use tonic::codegen::{BoxFuture, Service, http};
use tonic::{Request, Response, Status, Streaming};
use v1::force_service_server::{ForceService, ForceServiceServer};
use v1::frame_service_server::{FrameService, FrameServiceServer};
use v1::scene_service_server::{SceneService, SceneServiceServer};
use v1::server_service_server::{ServerService, ServerServiceServer};
use v1::step_service_server::{StepService, StepServiceServer};
use v1::vertex_service_server::{VertexService, VertexServiceServer};

use super::{FakeServer, StepOutput, pack, rejection, rejection_status};

/// Maximum size of a chunk of a reply, as on the real server.
const CHUNK_BYTES: usize = 1 << 20;

type ResponseStream<T> = Pin<Box<dyn tokio_stream::Stream<Item = Result<T, Status>> + Send>>;

/// Serves the fake server's scene on a free loopback port. Returns the URL.
pub(crate) async fn serve(fake_server: Arc<FakeServer>) -> String {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a free port");
    let url = format!("http://{}", listener.local_addr().expect("an address"));
    let server = tonic::transport::Server::builder();
    tokio::spawn(server.serve_with_incoming(Router(FakeService(fake_server)), TcpListenerStream::new(listener)));
    url
}

#[derive(Clone)]
struct FakeService(Arc<FakeServer>);

/// Routes calls to the services by their path.
#[derive(Clone)]
struct Router(FakeService);

impl Service<http::Request<tonic::body::Body>> for Router {
    type Response = http::Response<tonic::body::Body>;
    type Error = Infallible;
    type Future = BoxFuture<Self::Response, Infallible>;

    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, request: http::Request<tonic::body::Body>) -> Self::Future {
        let service = self.0.clone();
        let path = request.uri().path().to_owned();
        match path.split('/').nth(1).and_then(|service| service.strip_prefix("modalcast.v1.")) {
            Some("SceneService") => SceneServiceServer::new(service).call(request),
            Some("StepService") => StepServiceServer::new(service).call(request),
            Some("FrameService") => FrameServiceServer::new(service).call(request),
            Some("ForceService") => ForceServiceServer::new(service).call(request),
            Some("VertexService") => VertexServiceServer::new(service).call(request),
            // `ServerService`, which also answers unknown services with an error.
            _ => ServerServiceServer::new(service).call(request),
        }
    }
}

impl FakeService {
    /// The only scene and source is `toy`.
    fn check_scene(&self, scene: &str) -> Result<(), Status> {
        if scene == "toy" {
            return Ok(());
        }
        Err(rejection_status(tonic::Code::NotFound, &rejection(None, "scene", "an open scene", scene)))
    }
}

#[tonic::async_trait]
impl ServerService for FakeService {
    async fn create_viewer_link(
        &self,
        request: Request<v1::CreateViewerLinkRequest>,
    ) -> Result<Response<v1::CreateViewerLinkResponse>, Status> {
        let url_path = format!("/#code={}", request.into_inner().principal);
        Ok(Response::new(v1::CreateViewerLinkResponse { url_path, ..Default::default() }))
    }

    async fn list_clients(
        &self,
        _: Request<v1::ListClientsRequest>,
    ) -> Result<Response<v1::ListClientsResponse>, Status> {
        let client = v1::ClientInfo { id: "owner/connection-0".into(), is_caller: true, ..Default::default() };
        Ok(Response::new(v1::ListClientsResponse { clients: vec![client], ..Default::default() }))
    }

    /// Ends one connection of the client.
    async fn end_client(
        &self,
        request: Request<v1::EndClientRequest>,
    ) -> Result<Response<v1::EndClientResponse>, Status> {
        Ok(Response::new(v1::EndClientResponse { ids: vec![request.into_inner().id], ended: 1 }))
    }

    async fn get_server_info(
        &self,
        _: Request<v1::GetServerInfoRequest>,
    ) -> Result<Response<v1::GetServerInfoResponse>, Status> {
        let limits = v1::Limits { message_bytes: 4 << 20, window: self.0.window, ..Default::default() };
        Ok(Response::new(v1::GetServerInfoResponse {
            backend: "fake".into(),
            limits: Some(limits),
            protocol_version: self.0.protocol_version,
            // A feature of this contract, and one of a later contract.
            features: vec![v1::Feature::Frames.into(), 9999],
            ..Default::default()
        }))
    }
}

#[tonic::async_trait]
impl ForceService for FakeService {
    async fn apply_forces(
        &self,
        _: Request<v1::ApplyForcesRequest>,
    ) -> Result<Response<v1::ApplyForcesResponse>, Status> {
        Err(Status::unimplemented("the forces of the fake server are set by the test"))
    }

    type StreamForcesStream = ResponseStream<v1::StreamForcesResponse>;

    /// Sends the forces of the server once.
    async fn stream_forces(
        &self,
        request: Request<v1::StreamForcesRequest>,
    ) -> Result<Response<Self::StreamForcesStream>, Status> {
        self.check_scene(&request.into_inner().scene)?;
        let forces = v1::StreamForcesResponse { forces: self.0.forces.clone(), ..Default::default() };
        let stream = tokio_stream::once(Ok(forces)).chain(tokio_stream::pending());
        Ok(Response::new(Box::pin(stream)))
    }
}

#[tonic::async_trait]
impl SceneService for FakeService {
    async fn open_scene(
        &self,
        request: Request<v1::OpenSceneRequest>,
    ) -> Result<Response<v1::OpenSceneResponse>, Status> {
        self.check_scene(&request.into_inner().source)?;
        Ok(Response::new(v1::OpenSceneResponse { scene: Some(self.0.info()) }))
    }

    async fn upload_scene(
        &self,
        request: Request<Streaming<v1::UploadSceneRequest>>,
    ) -> Result<Response<v1::UploadSceneResponse>, Status> {
        use v1::upload_scene_request::Part;
        let mut stream = request.into_inner();
        let mut files: Vec<(String, Vec<u8>)> = vec![];
        while let Some(message) = stream.message().await? {
            match message.part {
                Some(Part::File(file)) if file.reuse && self.0.loses_contents => {
                    let reason = v1::Reason::ContentNotFound.into();
                    let lost = v1::Rejection { reason, ..rejection(None, "file.sha256", "a known hash", "another") };
                    return Err(rejection_status(tonic::Code::NotFound, &lost));
                }
                Some(Part::File(file)) => files.push((file.path, vec![])),
                Some(Part::Chunk(chunk)) => files.last_mut().expect("a file before its first chunk").1.extend(chunk),
                Some(Part::Header(_)) | None => {}
            }
        }
        *self.0.uploaded_files.lock().unwrap() = files;
        Ok(Response::new(v1::UploadSceneResponse { scene: Some(self.0.info()) }))
    }

    async fn upload_arrays(
        &self,
        _: Request<Streaming<v1::UploadArraysRequest>>,
    ) -> Result<Response<v1::UploadArraysResponse>, Status> {
        Err(Status::unimplemented("upload_arrays"))
    }

    async fn find_uploaded_files(
        &self,
        request: Request<v1::FindUploadedFilesRequest>,
    ) -> Result<Response<v1::FindUploadedFilesResponse>, Status> {
        let Some(known_hashes) = &self.0.known_hashes else { return Err(Status::unimplemented("find_uploaded_files")) };
        let is_known = |hash: &Bytes| known_hashes.iter().any(|known| known[..] == hash[..]);
        let found = request.into_inner().sha256.iter().map(is_known).collect();
        Ok(Response::new(v1::FindUploadedFilesResponse { found }))
    }

    async fn list_scenes(&self, _: Request<v1::ListScenesRequest>) -> Result<Response<v1::ListScenesResponse>, Status> {
        let reply =
            v1::ListScenesResponse { scenes: vec![self.0.info()], sources: vec!["toy".into()], ..Default::default() };
        Ok(Response::new(reply))
    }

    async fn delete_scene(
        &self,
        request: Request<v1::DeleteSceneRequest>,
    ) -> Result<Response<v1::DeleteSceneResponse>, Status> {
        self.check_scene(&request.into_inner().scene)?;
        Ok(Response::new(v1::DeleteSceneResponse {}))
    }

    async fn share_scene(
        &self,
        request: Request<v1::ShareSceneRequest>,
    ) -> Result<Response<v1::ShareSceneResponse>, Status> {
        let v1::ShareSceneRequest { scene, principals: shared_with } = request.into_inner();
        self.check_scene(&scene)?;
        Ok(Response::new(v1::ShareSceneResponse { owner: "owner".into(), shared_with }))
    }

    type DescribeSceneStream = ResponseStream<v1::DescribeSceneResponse>;

    async fn describe_scene(
        &self,
        request: Request<v1::DescribeSceneRequest>,
    ) -> Result<Response<Self::DescribeSceneStream>, Status> {
        use v1::describe_scene_response::Part;
        let request = request.into_inner();
        self.check_scene(&request.scene)?;
        let mut parts = vec![Part::Scene(self.0.info())];
        // Every domain has the default material 0.
        let color = || vec![1.0; 3];
        let material = v1::MaterialDescription {
            name: "white".into(),
            ambient: color(),
            diffuse: color(),
            specular: color(),
            ..Default::default()
        };
        parts.push(Part::Materials(v1::MaterialDescriptions { materials: vec![material] }));
        for domain in &self.0.domains {
            let mut shape = domain.shape.clone();
            if request.hashes {
                // The fake server has no hashes of other arrays.
                let modes = pack(&domain.modes);
                let (bytes, sha256) = (modes.len() as u64, Sha256::digest(&modes).to_vec().into());
                shape.arrays = vec![v1::ArrayDescription { array: v1::Array::Modes.into(), bytes, sha256 }];
            }
            parts.push(Part::Shapes(v1::ShapeDescriptions { shapes: vec![shape] }));
            parts.push(Part::Domains(v1::DomainDescriptions { domains: vec![domain.wire.clone()] }));
        }
        for domain in &self.0.domains {
            for array in &request.arrays {
                let bytes = match v1::Array::try_from(*array) {
                    Ok(v1::Array::Indices) => pack(&domain.indices),
                    Ok(v1::Array::CornerVertices) => pack(&(0..domain.shape.vertices).collect::<Vec<_>>()),
                    Ok(v1::Array::RestPositions) => pack(&domain.rest_positions),
                    Ok(v1::Array::Modes) => pack(&domain.modes),
                    _ => vec![],
                };
                for ByteChunk { offset, total, data } in split_bytes(bytes) {
                    let (shape, array) = (domain.shape.shape, *array);
                    parts.push(Part::Chunk(v1::ArrayChunk { shape, array, offset, total, data }));
                }
            }
        }
        Ok(stream_messages(parts.into_iter().map(|part| v1::DescribeSceneResponse { part: Some(part) }).collect()))
    }

    type ReadContentStream = ResponseStream<v1::ReadContentResponse>;

    /// The fake server reads no contents.
    async fn read_content(
        &self,
        _: Request<v1::ReadContentRequest>,
    ) -> Result<Response<Self::ReadContentStream>, Status> {
        Err(Status::unimplemented("read_content"))
    }

    type ReadModesStream = ResponseStream<v1::ReadModesResponse>;

    async fn read_modes(
        &self,
        request: Request<v1::ReadModesRequest>,
    ) -> Result<Response<Self::ReadModesStream>, Status> {
        let request = request.into_inner();
        self.check_scene(&request.scene)?;
        let domain = &self.0.domains[request.domain as usize];
        let entries_per_vertex = 3 * domain.shape.rank as usize;
        let all_vertices: Vec<u32> = (0..domain.shape.vertices).collect();
        let vertices = if request.vertices.is_empty() { all_vertices } else { request.vertices };
        let mut bytes = vec![];
        for vertex in vertices {
            bytes.extend(pack(&domain.modes[entries_per_vertex * vertex as usize..][..entries_per_vertex]));
        }
        let rank = domain.shape.rank;
        let message = |ByteChunk { offset, total, data }| v1::ReadModesResponse { rank, offset, total, data };
        Ok(stream_messages(split_bytes(bytes).into_iter().map(message).collect()))
    }
}

#[tonic::async_trait]
impl StepService for FakeService {
    type DriveSceneStream = ResponseStream<v1::DriveSceneResponse>;

    async fn drive_scene(
        &self,
        request: Request<Streaming<v1::DriveSceneRequest>>,
    ) -> Result<Response<Self::DriveSceneStream>, Status> {
        let (sender, responses) = tokio::sync::mpsc::channel(64);
        let service = self.clone();
        tokio::spawn(async move { service.drive(request.into_inner(), &sender).await });
        Ok(Response::new(Box::pin(ReceiverStream::new(responses))))
    }

    async fn reset_scene(
        &self,
        request: Request<v1::ResetSceneRequest>,
    ) -> Result<Response<v1::ResetSceneResponse>, Status> {
        self.check_scene(&request.get_ref().scene)?;
        let step = self.0.reset().map_err(|rejection| rejection_status(tonic::Code::AlreadyExists, &rejection))?;
        Ok(Response::new(v1::ResetSceneResponse { step: Some(step) }))
    }
}

type ResponseSender = tokio::sync::mpsc::Sender<Result<v1::DriveSceneResponse, Status>>;

impl FakeService {
    async fn drive(&self, mut requests: Streaming<v1::DriveSceneRequest>, sender: &ResponseSender) {
        use v1::drive_scene_request::Kind as RequestKind;
        use v1::drive_scene_response::Kind as ResponseKind;
        let mut has_lease = false;
        while let Ok(Some(request)) = requests.message().await {
            let response = match request.kind {
                Some(RequestKind::Open(open)) if open.scene != "toy" => {
                    ResponseKind::Rejection(rejection(None, "scene", "an open scene", open.scene))
                }
                Some(RequestKind::Open(open)) => match self.0.acquire_writer_lease() {
                    Err(rejection_reply) => ResponseKind::Rejection(rejection_reply),
                    Ok(run) => {
                        has_lease = true;
                        let window = if open.window == 0 { self.0.window } else { open.window.min(self.0.window) };
                        let scene = Some(self.0.info());
                        ResponseKind::Opened(v1::Opened {
                            run,
                            delivery: open.delivery,
                            window,
                            scene,
                            ..v1::Opened::default()
                        })
                    }
                },
                Some(RequestKind::Step(step)) => match self.0.apply(&step) {
                    Err(rejection_reply) => ResponseKind::Rejection(rejection_reply),
                    Ok(()) => {
                        self.0.ack_permits.acquire().await.expect("an open semaphore").forget();
                        let stages = vec![v1::StageTime { stage: "deform".into(), milliseconds: 1.5 }];
                        ResponseKind::Ack(v1::Acknowledgment {
                            step: step.number,
                            stages,
                            durable_step: Some(step.number),
                            ..Default::default()
                        })
                    }
                },
                None => continue,
            };
            if sender.send(Ok(v1::DriveSceneResponse { kind: Some(response) })).await.is_err() {
                break;
            }
        }
        if has_lease {
            self.0.release_writer_lease();
        }
    }
}

#[tonic::async_trait]
impl FrameService for FakeService {
    type RenderFrameStream = ResponseStream<v1::RenderFrameResponse>;

    async fn render_frame(
        &self,
        request: Request<v1::RenderFrameRequest>,
    ) -> Result<Response<Self::RenderFrameStream>, Status> {
        let request = request.into_inner();
        self.check_scene(&request.scene)?;
        let chunks = encode_frames(&self.0.output(), &request.pictures);
        Ok(stream_messages(chunks.into_iter().map(frame_reply).collect()))
    }

    type PickStream = ResponseStream<v1::PickResponse>;

    async fn pick(&self, _: Request<v1::PickRequest>) -> Result<Response<Self::PickStream>, Status> {
        Err(Status::unimplemented("the fake server does not pick"))
    }

    async fn update_frame_stream(
        &self,
        _: Request<v1::UpdateFrameStreamRequest>,
    ) -> Result<Response<v1::UpdateFrameStreamResponse>, Status> {
        Err(Status::unimplemented("the fake server does not move cameras"))
    }

    type StreamFramesStream = ResponseStream<v1::StreamFramesResponse>;

    async fn stream_frames(
        &self,
        request: Request<v1::StreamFramesRequest>,
    ) -> Result<Response<Self::StreamFramesStream>, Status> {
        let request = request.into_inner();
        self.check_scene(&request.scene)?;
        let limit = if request.steps == 0 { usize::MAX } else { request.steps as usize };
        let outputs = BroadcastStream::new(self.0.outputs.subscribe()).filter_map(Result::ok).take(limit);
        let (sender, receiver) = tokio::sync::mpsc::channel(4);
        tokio::spawn(async move {
            use v1::stream_frames_response::Part;
            let mut outputs = Box::pin(outputs);
            let mut parts = vec![Part::Settings(v1::FrameStreamSettings::default())];
            loop {
                for part in parts {
                    if sender.send(Ok(v1::StreamFramesResponse { part: Some(part) })).await.is_err() {
                        return;
                    }
                }
                let Some(output) = outputs.next().await else { return };
                parts = encode_frames(&output, &request.pictures).into_iter().map(Part::Chunk).collect();
            }
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(receiver))))
    }
}

#[tonic::async_trait]
impl VertexService for FakeService {
    type GetVerticesStream = ResponseStream<v1::GetVerticesResponse>;

    async fn get_vertices(
        &self,
        request: Request<v1::GetVerticesRequest>,
    ) -> Result<Response<Self::GetVerticesStream>, Status> {
        self.check_scene(&request.into_inner().scene)?;
        use v1::get_vertices_response::Part;
        let chunks = self.encode_vertices(&self.0.output()).into_iter().map(Part::Chunk);
        let parts = [Part::Layout(self.vertex_layout())].into_iter().chain(chunks);
        Ok(stream_messages(parts.map(|part| v1::GetVerticesResponse { part: Some(part) }).collect()))
    }

    type StreamVerticesStream = ResponseStream<v1::StreamVerticesResponse>;

    async fn stream_vertices(
        &self,
        request: Request<v1::StreamVerticesRequest>,
    ) -> Result<Response<Self::StreamVerticesStream>, Status> {
        let request = request.into_inner();
        self.check_scene(&request.scene)?;
        let limit = if request.steps == 0 { usize::MAX } else { request.steps as usize };
        let outputs = BroadcastStream::new(self.0.outputs.subscribe()).filter_map(Result::ok).take(limit);
        let (sender, receiver) = tokio::sync::mpsc::channel(4);
        let service = self.clone();
        tokio::spawn(async move {
            use v1::stream_vertices_response::Part;
            let mut outputs = Box::pin(outputs);
            let settings = v1::VertexStreamSettings { steps: request.steps, ..Default::default() };
            let mut parts = vec![Part::Settings(settings), Part::Layout(service.vertex_layout())];
            loop {
                for part in parts {
                    if sender.send(Ok(v1::StreamVerticesResponse { part: Some(part) })).await.is_err() {
                        return;
                    }
                }
                let Some(output) = outputs.next().await else { return };
                parts = service.encode_vertices(&output).into_iter().map(Part::Chunk).collect();
            }
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(receiver))))
    }
}

impl FakeService {
    fn vertex_layout(&self) -> v1::VertexLayout {
        v1::VertexLayout {
            domains: (0..self.0.domains.len() as u32).collect(),
            vertices: self.0.domains.iter().map(|domain| domain.shape.vertices).collect(),
            corners: self.0.domains.iter().map(|domain| domain.shape.corners).collect(),
            has_more: false,
        }
    }

    /// The positions of all domains, without normals, in chunks.
    fn encode_vertices(&self, output: &StepOutput) -> Vec<v1::VertexChunk> {
        let positions = pack(&output.positions);
        let section = |attribute: v1::Attribute, encoding: v1::Encoding, offset, bytes| v1::VertexSection {
            attribute: attribute.into(),
            encoding: encoding.into(),
            offset,
            bytes,
        };
        let position_bytes = positions.len() as u64;
        let bytes = [positions, pack(&[0.0_f64; 3])].concat();
        let mut head = Some(v1::VertexHead {
            step: Some(output.step),
            sections: vec![
                section(v1::Attribute::Positions, v1::Encoding::F32, 0, position_bytes),
                section(v1::Attribute::Origins, v1::Encoding::F64, position_bytes, 24),
            ],
            total: bytes.len() as u64,
            ..Default::default()
        });
        let chunk = |ByteChunk { offset, data, .. }| v1::VertexChunk { head: head.take(), offset, data, shared: None };
        split_bytes(bytes).into_iter().map(chunk).collect()
    }
}

fn frame_reply(chunk: v1::FrameChunk) -> v1::RenderFrameResponse {
    v1::RenderFrameResponse { part: Some(v1::render_frame_response::Part::Chunk(chunk)) }
}

/// One frame per picture, in chunks.
fn encode_frames(output: &StepOutput, pictures: &[v1::Picture]) -> Vec<v1::FrameChunk> {
    pictures.iter().zip(0..).flat_map(|(picture, index)| encode_frame(output, picture, index)).collect()
}

/// An RGBA frame in chunks. Every byte is the low byte of the step number.
fn encode_frame(output: &StepOutput, picture: &v1::Picture, index: u32) -> Vec<v1::FrameChunk> {
    let (width, height) = (picture.width.max(1), picture.height.max(1));
    let bytes = vec![output.step.number as u8; 4 * (width * height) as usize];
    let mut head = Some(v1::FrameHead {
        step: Some(output.step),
        width,
        height,
        format: v1::Format::Rgba.into(),
        total: bytes.len() as u64,
        skipped: 0,
        stages: vec![v1::StageTime { stage: "draw".into(), milliseconds: 2.0 }],
        shadow_drawn_by: v1::DrawnBy::Unspecified.into(),
        visibility_drawn_by: v1::DrawnBy::Cuda.into(),
        picture: index,
        camera_version: 0,
        look: Some(v1::FrameLook {
            preset: v1::LookPreset::Best.into(),
            antialiasing: v1::Antialiasing::Fxaa.into(),
            samples: 1,
            shadow_method: v1::ShadowMethod::Filtered.into(),
            shadow_size: 512,
        }),
        below_ground: 0.25,
        reframed: false,
    });
    let chunk = |ByteChunk { offset, data, .. }| v1::FrameChunk { head: head.take(), offset, data, shared: None };
    split_bytes(bytes).into_iter().map(chunk).collect()
}

/// A part of a reply. `total` is the size of the reply in bytes.
struct ByteChunk {
    offset: u64,
    total: u64,
    data: Bytes,
}

/// Splits bytes into chunks of at most 1 MiB. Empty input gives one empty chunk.
fn split_bytes(bytes: Vec<u8>) -> Vec<ByteChunk> {
    let bytes = Bytes::from(bytes);
    let total = bytes.len() as u64;
    let starts = (0..bytes.len().max(1)).step_by(CHUNK_BYTES);
    let chunk = |start: usize| {
        let data = bytes.slice(start..(start + CHUNK_BYTES).min(bytes.len()));
        ByteChunk { offset: start as u64, total, data }
    };
    starts.map(chunk).collect()
}

fn stream_messages<T: Send + 'static>(messages: Vec<T>) -> Response<ResponseStream<T>> {
    Response::new(Box::pin(tokio_stream::iter(messages.into_iter().map(Ok))))
}
