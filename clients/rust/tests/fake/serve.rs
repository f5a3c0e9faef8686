//! The gRPC services of the fake server and their router.

use std::convert::Infallible;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use bytes::Bytes;
use modalcast_proto::v1;
use tokio_stream::StreamExt as _;
use tokio_stream::wrappers::{BroadcastStream, ReceiverStream, TcpListenerStream};
use tonic::codegen::{BoxFuture, Service, http};
use tonic::{Request, Response, Status, Streaming};
use v1::frame_service_server::{FrameService, FrameServiceServer};
use v1::scene_service_server::{SceneService, SceneServiceServer};
use v1::server_service_server::{ServerService, ServerServiceServer};
use v1::step_service_server::{StepService, StepServiceServer};
use v1::vertex_service_server::{VertexService, VertexServiceServer};

use super::{FakeServer, StepOutput, pack, refuse, rejection};

const CHUNK: usize = 1 << 20;

type Replies<T> = Pin<Box<dyn tokio_stream::Stream<Item = Result<T, Status>> + Send>>;

/// Serves a world on a free loopback port. Returns its URL.
pub(crate) async fn serve(world: Arc<FakeServer>) -> String {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a free port");
    let url = format!("http://{}", listener.local_addr().expect("bound"));
    let server = tonic::transport::Server::builder();
    tokio::spawn(server.serve_with_incoming(Router(FakeService(world)), TcpListenerStream::new(listener)));
    url
}

#[derive(Clone)]
struct FakeService(Arc<FakeServer>);

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
        let fake = self.0.clone();
        let path = request.uri().path().to_owned();
        match path.split('/').nth(1).and_then(|service| service.strip_prefix("modalcast.v1.")) {
            Some("SceneService") => SceneServiceServer::new(fake).call(request),
            Some("StepService") => StepServiceServer::new(fake).call(request),
            Some("FrameService") => FrameServiceServer::new(fake).call(request),
            Some("VertexService") => VertexServiceServer::new(fake).call(request),
            _ => ServerServiceServer::new(fake).call(request),
        }
    }
}

impl FakeService {
    fn known(&self, scene: &str) -> Result<(), Status> {
        if scene == "toy" {
            return Ok(());
        }
        Err(refuse(tonic::Code::NotFound, &rejection(None, "scene", "an open scene", scene)))
    }
}

#[tonic::async_trait]
impl ServerService for FakeService {
    async fn get_server_info(
        &self,
        _: Request<v1::GetServerInfoRequest>,
    ) -> Result<Response<v1::GetServerInfoResponse>, Status> {
        let limits = v1::Limits { message_bytes: 4 << 20, window: self.0.window, ..Default::default() };
        let info = v1::GetServerInfoResponse { backend: "fake".into(), limits: Some(limits), ..Default::default() };
        Ok(Response::new(info))
    }
}

#[tonic::async_trait]
impl SceneService for FakeService {
    async fn open_scene(
        &self,
        request: Request<v1::OpenSceneRequest>,
    ) -> Result<Response<v1::OpenSceneResponse>, Status> {
        self.known(&request.into_inner().source)?;
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
                Some(Part::File(file)) => files.push((file.path, vec![])),
                Some(Part::Chunk(chunk)) => files.last_mut().expect("a file first").1.extend(chunk),
                Some(Part::Header(_)) | None => {}
            }
        }
        *self.0.uploads.lock().unwrap() = files;
        Ok(Response::new(v1::UploadSceneResponse { scene: Some(self.0.info()) }))
    }

    async fn list_scenes(&self, _: Request<v1::ListScenesRequest>) -> Result<Response<v1::ListScenesResponse>, Status> {
        let reply = v1::ListScenesResponse { scenes: vec![self.0.info()], sources: vec!["toy".into()] };
        Ok(Response::new(reply))
    }

    async fn delete_scene(
        &self,
        request: Request<v1::DeleteSceneRequest>,
    ) -> Result<Response<v1::DeleteSceneResponse>, Status> {
        self.known(&request.into_inner().scene)?;
        Ok(Response::new(v1::DeleteSceneResponse {}))
    }

    type DescribeSceneStream = Replies<v1::DescribeSceneResponse>;

    async fn describe_scene(
        &self,
        request: Request<v1::DescribeSceneRequest>,
    ) -> Result<Response<Self::DescribeSceneStream>, Status> {
        use v1::describe_scene_response::Part;
        let request = request.into_inner();
        self.known(&request.scene)?;
        let mut parts = vec![Part::Scene(self.0.info())];
        for domain in &self.0.domains {
            parts.push(Part::Domains(v1::DomainDescriptions { domains: vec![domain.wire.clone()] }));
        }
        for domain in &self.0.domains {
            for array in &request.arrays {
                let bytes = match v1::Array::try_from(*array) {
                    Ok(v1::Array::Indices) => pack(&domain.indices),
                    Ok(v1::Array::CornerVertices) => pack(&(0..domain.wire.vertices).collect::<Vec<_>>()),
                    Ok(v1::Array::RestPositions) => pack(&domain.rest),
                    _ => vec![],
                };
                for (offset, data) in chunks(bytes) {
                    let total = data.1;
                    let (domain, array, data) = (domain.wire.domain, *array, data.0);
                    parts.push(Part::Chunk(v1::ArrayChunk { domain, array, offset, total, data }));
                }
            }
        }
        Ok(replies(parts.into_iter().map(|part| v1::DescribeSceneResponse { part: Some(part) }).collect()))
    }

    type ReadModesStream = Replies<v1::ReadModesResponse>;

    async fn read_modes(
        &self,
        request: Request<v1::ReadModesRequest>,
    ) -> Result<Response<Self::ReadModesStream>, Status> {
        let request = request.into_inner();
        self.known(&request.scene)?;
        let domain = &self.0.domains[request.domain as usize];
        let width = 3 * domain.wire.rank as usize;
        let all: Vec<u32> = (0..domain.wire.vertices).collect();
        let vertices = if request.vertices.is_empty() { all } else { request.vertices };
        let mut bytes = vec![];
        for vertex in vertices {
            bytes.extend(pack(&domain.modes[width * vertex as usize..][..width]));
        }
        let rank = domain.wire.rank;
        let message = |(offset, (data, total))| v1::ReadModesResponse { rank, offset, total, data };
        Ok(replies(chunks(bytes).into_iter().map(message).collect()))
    }
}

#[tonic::async_trait]
impl StepService for FakeService {
    type DriveSceneStream = Replies<v1::DriveSceneResponse>;

    async fn drive_scene(
        &self,
        request: Request<Streaming<v1::DriveSceneRequest>>,
    ) -> Result<Response<Self::DriveSceneStream>, Status> {
        let (sender, replies) = tokio::sync::mpsc::channel(64);
        let fake = self.clone();
        tokio::spawn(async move { fake.drive(request.into_inner(), &sender).await });
        Ok(Response::new(Box::pin(ReceiverStream::new(replies))))
    }
}

type Answers = tokio::sync::mpsc::Sender<Result<v1::DriveSceneResponse, Status>>;

impl FakeService {
    async fn drive(&self, mut requests: Streaming<v1::DriveSceneRequest>, answers: &Answers) {
        use v1::drive_scene_request::Kind as RequestKind;
        use v1::drive_scene_response::Kind as ResponseKind;
        let mut mine = false;
        while let Ok(Some(request)) = requests.message().await {
            let answer = match request.kind {
                Some(RequestKind::Open(open)) if open.scene != "toy" => {
                    ResponseKind::Rejection(rejection(None, "scene", "an open scene", open.scene))
                }
                Some(RequestKind::Open(open)) => match self.0.take() {
                    Err(refusal) => ResponseKind::Rejection(refusal),
                    Ok(run) => {
                        mine = true;
                        let window = if open.window == 0 { self.0.window } else { open.window.min(self.0.window) };
                        let scene = Some(self.0.info());
                        ResponseKind::Opened(v1::Opened { run, policy: open.policy, window, scene })
                    }
                },
                Some(RequestKind::Step(step)) => match self.0.apply(&step) {
                    Err(refusal) => ResponseKind::Rejection(refusal),
                    Ok(()) => {
                        self.0.permits.acquire().await.expect("open").forget();
                        let stages = vec![v1::StageTime { stage: "deform".into(), milliseconds: 1.5 }];
                        ResponseKind::Ack(v1::Acknowledgement { step: step.number, skipped: 0, stages })
                    }
                },
                None => continue,
            };
            if answers.send(Ok(v1::DriveSceneResponse { kind: Some(answer) })).await.is_err() {
                break;
            }
        }
        if mine {
            self.0.release();
        }
    }
}

#[tonic::async_trait]
impl FrameService for FakeService {
    type RenderFrameStream = Replies<v1::RenderFrameResponse>;

    async fn render_frame(
        &self,
        request: Request<v1::RenderFrameRequest>,
    ) -> Result<Response<Self::RenderFrameStream>, Status> {
        let request = request.into_inner();
        self.known(&request.scene)?;
        let chunks = frame(&self.0.output(), &request.picture.unwrap_or_default());
        Ok(replies(chunks.into_iter().map(|chunk| v1::RenderFrameResponse { chunk: Some(chunk) }).collect()))
    }

    type PickStream = Replies<v1::PickResponse>;

    async fn pick(&self, _: Request<v1::PickRequest>) -> Result<Response<Self::PickStream>, Status> {
        Err(Status::unimplemented("there is no surface here"))
    }

    type StreamFramesStream = Replies<v1::StreamFramesResponse>;

    async fn stream_frames(
        &self,
        request: Request<v1::StreamFramesRequest>,
    ) -> Result<Response<Self::StreamFramesStream>, Status> {
        let request = request.into_inner();
        self.known(&request.scene)?;
        let picture = request.picture.unwrap_or_default();
        let limit = if request.frames == 0 { usize::MAX } else { request.frames as usize };
        let shown = BroadcastStream::new(self.0.shown.subscribe()).filter_map(Result::ok).take(limit);
        let (sender, receiver) = tokio::sync::mpsc::channel(4);
        tokio::spawn(async move {
            let mut shown = Box::pin(shown);
            while let Some(shown) = shown.next().await {
                for chunk in frame(&shown, &picture) {
                    let sent = sender.send(Ok(v1::StreamFramesResponse { chunk: Some(chunk) })).await;
                    if sent.is_err() {
                        return;
                    }
                }
            }
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(receiver))))
    }
}

#[tonic::async_trait]
impl VertexService for FakeService {
    type GetVerticesStream = Replies<v1::GetVerticesResponse>;

    async fn get_vertices(
        &self,
        request: Request<v1::GetVerticesRequest>,
    ) -> Result<Response<Self::GetVerticesStream>, Status> {
        self.known(&request.into_inner().scene)?;
        let chunks = self.vertices(&self.0.output());
        Ok(replies(chunks.into_iter().map(|chunk| v1::GetVerticesResponse { chunk: Some(chunk) }).collect()))
    }

    type StreamVerticesStream = Replies<v1::StreamVerticesResponse>;

    async fn stream_vertices(
        &self,
        request: Request<v1::StreamVerticesRequest>,
    ) -> Result<Response<Self::StreamVerticesStream>, Status> {
        let request = request.into_inner();
        self.known(&request.scene)?;
        let limit = if request.steps == 0 { usize::MAX } else { request.steps as usize };
        let shown = BroadcastStream::new(self.0.shown.subscribe()).filter_map(Result::ok).take(limit);
        let (sender, receiver) = tokio::sync::mpsc::channel(4);
        let fake = self.clone();
        tokio::spawn(async move {
            let mut shown = Box::pin(shown);
            while let Some(shown) = shown.next().await {
                for chunk in fake.vertices(&shown) {
                    let sent = sender.send(Ok(v1::StreamVerticesResponse { chunk: Some(chunk) })).await;
                    if sent.is_err() {
                        return;
                    }
                }
            }
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(receiver))))
    }
}

impl FakeService {
    /// All positions, without normals.
    fn vertices(&self, shown: &StepOutput) -> Vec<v1::VertexChunk> {
        let bytes = pack(&shown.positions);
        let mut head = Some(v1::VertexHead {
            step: Some(shown.step),
            origin: vec![0.0; 3],
            domains: (0..self.0.domains.len() as u32).collect(),
            vertices: self.0.domains.iter().map(|domain| domain.wire.vertices).collect(),
            corners: self.0.domains.iter().map(|domain| domain.wire.corners).collect(),
            position_bytes: bytes.len() as u64,
            total: bytes.len() as u64,
            ..Default::default()
        });
        let chunk = |(offset, (data, _))| v1::VertexChunk { head: head.take(), offset, data };
        chunks(bytes).into_iter().map(chunk).collect()
    }
}

/// A raw picture in chunks. Every byte is the number of the step.
fn frame(shown: &StepOutput, picture: &v1::Picture) -> Vec<v1::FrameChunk> {
    let (width, height) = (picture.width.max(1), picture.height.max(1));
    let bytes = vec![shown.step.number as u8; 4 * (width * height) as usize];
    let mut head = Some(v1::FrameHead {
        step: Some(shown.step),
        width,
        height,
        format: v1::Format::Rgba.into(),
        total: bytes.len() as u64,
        skipped: 0,
        stages: vec![v1::StageTime { stage: "draw".into(), milliseconds: 2.0 }],
        shadow_drawn_by: v1::DrawnBy::Unspecified.into(),
        visibility_drawn_by: v1::DrawnBy::Cuda.into(),
    });
    chunks(bytes).into_iter().map(|(offset, (data, _))| v1::FrameChunk { head: head.take(), offset, data }).collect()
}

/// Splits bytes into pieces of at most 1 MiB: offset, piece, total. Empty input gives one empty piece.
fn chunks(bytes: Vec<u8>) -> Vec<(u64, (Bytes, u64))> {
    let (bytes, total) = (Bytes::from(bytes), 0);
    let total = total + bytes.len() as u64;
    let starts = (0..bytes.len().max(1)).step_by(CHUNK);
    starts.map(|at| (at as u64, (bytes.slice(at..(at + CHUNK).min(bytes.len())), total))).collect()
}

fn replies<T: Send + 'static>(messages: Vec<T>) -> Response<Replies<T>> {
    Response::new(Box::pin(tokio_stream::iter(messages.into_iter().map(Ok))))
}
