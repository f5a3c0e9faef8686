//! Vertices, frames and steps in shared memory: the same data as on the socket, and the rules of the protocol. The
//! memory is divided into slots, each for the data of one message. The receiver returns a slot after reading it.

use std::io::IoSliceMut;
use std::mem::MaybeUninit;
use std::os::fd::{AsFd as _, OwnedFd};
use std::path::{Path, PathBuf};
use std::time::Duration;

use memmap2::{MmapOptions, MmapRaw};
use modalcast::config::{Config, RendererChoice};
use modalcast_client::{
    Attribute, Client, Delivery, DriveRequest, Encoding, Error, Feature, FrameFormat, FrameStreamRequest,
    FramesRequest, Picture, Step, VertexRequest, VertexSelection, VertexStreamRequest,
};
use modalcast_proto::v1;
use rustix::net::{RecvAncillaryBuffer, RecvAncillaryMessage, RecvFlags, recvmsg};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _, Interest};
use tokio::net::UnixStream;
use tonic::metadata::MetadataValue;
use tonic::{Code, Request, Streaming};
use v1::drive_scene_response::Kind as ResponseKind;
use v1::stream_vertices_response::Part;
use v1::vertex_service_client::VertexServiceClient;

use crate::service_harness::{Server, StepWriter, rejection_details, step, with_timeout};

/// Metadata key of a call that uses shared memory.
const TOKEN_KEY: &str = "modalcast-shared-memory-bin";

/// A server that offers shared memory in a temporary folder.
struct SharedMemoryServer {
    server: Server,
    folder: tempfile::TempDir,
}

impl SharedMemoryServer {
    async fn start(renderer: RendererChoice) -> Self {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let shared_memory = Some(folder.path().join("memory.sock"));
        let server =
            Server::start_with(|config| Config { shared_memory, renderer, message_bytes: 16 << 20, ..config }).await;
        server.open("sheet").await;
        Self { server, folder }
    }

    fn path(&self) -> PathBuf {
        self.folder.path().join("memory.sock")
    }

    /// A client with shared memory.
    async fn client(&self) -> Client {
        let client = Client::connect(&self.server.address).await.expect("expected a connection");
        client.with_shared_memory(self.path()).await.expect("expected shared memory")
    }

    /// Subscribes to the vertices of `sheet`, of which each step has more than one chunk in shared memory.
    async fn subscribe(&self, memory: &RawMemory) -> Streaming<v1::StreamVerticesResponse> {
        let delivery = v1::Delivery::Latest.into();
        let request = v1::StreamVerticesRequest { scene: "sheet".into(), delivery, ..Default::default() };
        let mut service = VertexServiceClient::new(self.server.channel().await);
        service.stream_vertices(memory.request(request)).await.expect("expected a subscription").into_inner()
    }
}

/// A connection for shared memory, as the contract describes it.
struct RawMemory {
    socket: UnixStream,
    mapping: MmapRaw,
    /// The memory for steps.
    requests: OwnedFd,
    /// The numbers of the handshake: version, bytes per slot, number of slots, and 0.
    numbers: [u32; 4],
    token: Vec<u8>,
}

impl RawMemory {
    async fn connect(path: &Path) -> Self {
        let socket = UnixStream::connect(path).await.expect("expected a connection");
        let mut message = [0; 32];
        let receive = || {
            let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(2))];
            let mut control = RecvAncillaryBuffer::new(&mut space);
            let mut buffers = [IoSliceMut::new(&mut message)];
            let received = recvmsg(socket.as_fd(), &mut buffers, &mut control, RecvFlags::CMSG_CLOEXEC)?;
            assert_eq!(received.bytes, 32);
            let files = control.drain().find_map(|message| match message {
                RecvAncillaryMessage::ScmRights(files) => <[OwnedFd; 2]>::try_from(files.collect::<Vec<_>>()).ok(),
                _ => None,
            });
            Ok(files.expect("expected two files"))
        };
        let [replies, requests] =
            with_timeout(socket.async_io(Interest::READABLE, receive)).await.expect("expected a handshake");
        let numbers =
            std::array::from_fn(|index| u32::from_le_bytes(std::array::from_fn(|byte| message[4 * index + byte])));
        let mapping = MmapOptions::new().map_raw_read_only(&replies).expect("expected a mapping");
        Self { socket, mapping, requests, numbers, token: message[16..].to_vec() }
    }

    fn slot_count(&self) -> usize {
        self.numbers[2] as usize
    }

    fn request<T>(&self, message: T) -> Request<T> {
        request_with_token(message, &self.token)
    }

    fn read(&self, range: v1::SharedRange) -> Vec<u8> {
        let start = range.slot as usize * self.numbers[1] as usize;
        assert!(start + range.bytes as usize <= self.mapping.len());
        // SAFETY: the range is within the mapping, and the server does not write to the slot until it is returned.
        unsafe { std::slice::from_raw_parts(self.mapping.as_ptr().add(start), range.bytes as usize).to_vec() }
    }

    async fn return_slot(&mut self, slot: u32) {
        self.socket.write_u32_le(slot).await.expect("expected an open connection");
    }

    /// Waits until the server closes the connection.
    async fn wait_until_closed(&mut self) {
        let result = with_timeout(self.socket.read(&mut [0; 1])).await;
        assert!(matches!(result, Ok(0) | Err(_)), "{result:?}");
    }
}

fn request_with_token<T>(message: T, token: &[u8]) -> Request<T> {
    let mut request = Request::new(message);
    request.metadata_mut().insert_bin(TOKEN_KEY, MetadataValue::from_bytes(token));
    request
}

/// The next chunk of a stream, without the settings and the layout.
async fn next_chunk(stream: &mut Streaming<v1::StreamVerticesResponse>) -> v1::VertexChunk {
    loop {
        let message = with_timeout(stream.message()).await.expect("expected a message").expect("expected no end");
        if let Some(Part::Chunk(chunk)) = message.part {
            return chunk;
        }
    }
}

/// Sends steps until `end` is dropped.
async fn keep_driving(client: Client, mut end: tokio::sync::oneshot::Receiver<()>) {
    let mut writer = client.drive(&DriveRequest::new("sheet", Delivery::Latest)).await.expect("expected the lease");
    let mut number = 0;
    while end.try_recv() == Err(tokio::sync::oneshot::error::TryRecvError::Empty) {
        number += 1;
        let step = Step::new(number, 0.0).q(0, &[0.01 * number as f32, 0.0, 0.1, 0.2]);
        with_timeout(writer.step(&step)).await.expect("expected a sent step");
        with_timeout(writer.flush()).await.expect("expected an acknowledgment");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn vertices_are_equal_in_shared_memory() {
    let shared = SharedMemoryServer::start(RendererChoice::Off).await;
    let local = shared.client().await;
    assert!(local.server_info().await.expect("expected information").has_feature(Feature::SharedMemory));
    let remote = Client::connect(&shared.server.address).await.expect("expected a connection");
    let default = VertexSelection::default();
    let compact = default.clone().encoded_attribute(Attribute::Positions, Encoding::U16Box);
    let compact = compact.encoded_attribute(Attribute::Normals, Encoding::OctahedralI16);
    let half = default.clone().encoded_attribute(Attribute::Positions, Encoding::F16);
    const STEPS: u64 = 5;
    for selection in [default, compact, half] {
        let request = VertexStreamRequest::new("sheet", selection.clone()).max_steps(STEPS);
        let mut streams = Vec::new();
        for client in [&local, &remote] {
            streams.push(client.stream_vertices(&request).await.expect("expected a subscription"));
        }
        let mut writer = shared.server.drive_lossless("sheet").await;
        for number in 1..=STEPS {
            writer.send_step_and_wait(step(number, &[0], &[0.1 * number as f32, -0.5, 0.0, 1.0])).await;
        }
        writer.finish().await;
        let [mut local_stream, mut remote_stream] = <[_; 2]>::try_from(streams).unwrap_or_else(|_| unreachable!());
        for _ in 0..STEPS {
            let read = async |stream: &mut modalcast_client::VertexStream| {
                let mut set = with_timeout(stream.next()).await.expect("expected a step").expect("expected no error");
                set.stages.clear();
                set
            };
            assert_eq!(read(&mut local_stream).await, read(&mut remote_stream).await);
        }
        assert!(with_timeout(local_stream.next()).await.is_none());
        let request = VertexRequest::new("sheet", selection);
        let sets = [&local, &remote].map(async |client| {
            let mut set = client.get_vertices(&request).await.expect("expected vertices");
            set.stages.clear();
            set
        });
        let [local_set, remote_set] = sets;
        assert_eq!(local_set.await, remote_set.await);
    }
}

/// Frames of several chunks, frames of one chunk, and frames that are too small for shared memory.
#[tokio::test(flavor = "multi_thread")]
async fn frames_are_equal_in_shared_memory() {
    let shared = SharedMemoryServer::start(RendererChoice::Auto).await;
    let local = shared.client().await;
    let remote = Client::connect(&shared.server.address).await.expect("expected a connection");
    let picture = |width, height, format| Picture::default().size(width, height).format(format);
    let pictures = vec![
        picture(1024, 768, FrameFormat::Rgba),
        picture(512, 256, FrameFormat::Rgba),
        picture(64, 48, FrameFormat::Rgba),
        picture(512, 256, FrameFormat::Png),
    ];
    let request = FrameStreamRequest::new("sheet", pictures.clone()).max_steps(3);
    let mut local_stream = local.stream_frames(&request).await.expect("expected a subscription");
    let mut remote_stream = remote.stream_frames(&request).await.expect("expected a subscription");
    let mut writer = shared.server.drive_lossless("sheet").await;
    // A frame that the caller keeps does not occupy its slot, so more frames arrive than there are slots.
    let mut held = Vec::new();
    for number in 1..=3 {
        writer.send_step_and_wait(step(number, &[0], &[0.1 * number as f32, 0.0, 0.0, 0.0])).await;
        for _ in &pictures {
            let local_frame = with_timeout(local_stream.next()).await.expect("a frame").expect("expected no error");
            let remote_frame = with_timeout(remote_stream.next()).await.expect("a frame").expect("expected no error");
            assert_eq!(
                (local_frame.step, local_frame.picture, local_frame.width),
                (remote_frame.step, remote_frame.picture, remote_frame.width)
            );
            assert!(local_frame.bytes == remote_frame.bytes, "picture {}", local_frame.picture);
            held.push(local_frame);
        }
    }
    assert!(with_timeout(local_stream.next()).await.is_none());
    let request = FramesRequest::new("sheet", pictures);
    let local_frames = local.render_frames(&request).await.expect("expected frames");
    let remote_frames = remote.render_frames(&request).await.expect("expected frames");
    assert!(local_frames.iter().zip(&remote_frames).all(|(local, remote)| local.bytes == remote.bytes));
    assert_eq!(held[0].bytes.len(), 1024 * 768 * 4);
}

/// A client that returns no slots receives as many chunks as there are slots. Another client is not affected.
#[tokio::test(flavor = "multi_thread")]
async fn stream_waits_for_slots() {
    let shared = SharedMemoryServer::start(RendererChoice::Off).await;
    let mut memory = RawMemory::connect(&shared.path()).await;
    assert_eq!((memory.numbers[0], memory.numbers[3]), (1, 0));
    let mut stream = shared.subscribe(&memory).await;
    let (end, ended) = tokio::sync::oneshot::channel();
    let driving = tokio::spawn(keep_driving(shared.client().await, ended));
    let mut slots = Vec::new();
    while slots.len() < memory.slot_count() {
        let chunk = next_chunk(&mut stream).await;
        match chunk.shared {
            Some(range) => slots.push(range.slot),
            None => assert!(chunk.data.len() < 64 << 10, "expected {} bytes in shared memory", chunk.data.len()),
        }
    }
    slots.sort_unstable();
    assert!(slots.iter().copied().eq(0..memory.slot_count() as u32), "expected each slot once, got {slots:?}");
    // Further messages may have data that are too small for a slot.
    let no_slot = async { while next_chunk(&mut stream).await.shared.is_none() {} };
    assert!(tokio::time::timeout(Duration::from_millis(300), no_slot).await.is_err(), "expected no further slot");
    let other = shared.client().await;
    for _ in 0..3 {
        let request = VertexRequest::new("sheet", VertexSelection::default());
        with_timeout(other.get_vertices(&request)).await.expect("expected vertices");
    }
    memory.return_slot(5).await;
    let range = loop {
        if let Some(range) = next_chunk(&mut stream).await.shared {
            break range;
        }
    };
    assert_eq!(range.slot, 5);
    assert_eq!(memory.read(range).len(), range.bytes as usize);
    drop(end);
    driving.await.expect("expected no panic");
}

/// Returns slots that the client does not have: one that was never sent, one that does not exist, and one that was
/// returned before.
#[tokio::test(flavor = "multi_thread")]
async fn forged_slot_ends_the_connection_but_not_the_call() {
    let shared = SharedMemoryServer::start(RendererChoice::Off).await;
    let (end, ended) = tokio::sync::oneshot::channel();
    let driving = tokio::spawn(keep_driving(shared.client().await, ended));
    for forged_slot in [Some(7), Some(u32::MAX), None] {
        let mut memory = RawMemory::connect(&shared.path()).await;
        let mut stream = shared.subscribe(&memory).await;
        let range = loop {
            if let Some(range) = next_chunk(&mut stream).await.shared {
                break range;
            }
        };
        memory.return_slot(range.slot).await;
        memory.return_slot(forged_slot.unwrap_or(range.slot)).await;
        memory.wait_until_closed().await;
        // The call continues on the socket.
        while next_chunk(&mut stream).await.data.len() < 1 << 20 {}
        let request = v1::GetVerticesRequest { scene: "sheet".into(), ..Default::default() };
        let mut service = VertexServiceClient::new(shared.server.channel().await);
        let status = service.get_vertices(memory.request(request)).await.expect_err("expected an unknown token");
        assert_eq!(status.code(), Code::InvalidArgument);
    }
    drop(end);
    driving.await.expect("expected no panic");
}

#[tokio::test(flavor = "multi_thread")]
async fn wrong_token_is_rejected() {
    let shared = SharedMemoryServer::start(RendererChoice::Off).await;
    let memory = RawMemory::connect(&shared.path()).await;
    let without_memory = Server::start_default().await;
    without_memory.open("sheet").await;
    let request = v1::GetVerticesRequest { scene: "sheet".into(), ..Default::default() };
    for (server, token) in [
        (&shared.server, &memory.token[..15]),
        (&shared.server, &[0; 16]),
        (&shared.server, &[]),
        (&without_memory, &memory.token),
    ] {
        let mut service = VertexServiceClient::new(server.channel().await);
        let status = service.get_vertices(request_with_token(request.clone(), token)).await;
        let rejection = rejection_details(&status.expect_err("expected an unknown token"));
        assert_eq!((rejection.reason(), rejection.field.as_str()), (v1::Reason::InvalidField, TOKEN_KEY));
    }
}

/// The 65th connection is closed. Another one is accepted when one of the others has ended.
#[tokio::test(flavor = "multi_thread")]
async fn connections_are_limited() {
    let shared = SharedMemoryServer::start(RendererChoice::Off).await;
    let mut connections = Vec::new();
    // A single client leaves an eighth of 64 for others.
    for _ in 0..56 {
        connections.push(RawMemory::connect(&shared.path()).await);
    }
    let connect = async || {
        let client = Client::connect(&shared.server.address).await.expect("expected a connection");
        client.with_shared_memory(shared.path()).await.map(drop)
    };
    let error = connect().await.expect_err("expected a limit");
    assert!(matches!(&error, Error::Connect { reason, .. } if reason.contains("too many")), "{error}");
    connections.pop();
    let accepted = async {
        while connect().await.is_err() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    with_timeout(accepted).await;
}

/// A step that moves all domains of `crowd`.
fn crowd_step(number: u64) -> Step {
    (0..70_000).fold(Step::new(number, 0.0), |step, domain| {
        let offset = 0.001 * (number * 70_000 + u64::from(domain)) as f32;
        step.transform(domain, &[1.0, 0.0, 0.0, offset, 0.0, 1.0, 0.0, -offset, 0.0, 0.0, 1.0, 0.5])
    })
}

/// The steps have more parts than there are slots.
#[tokio::test(flavor = "multi_thread")]
async fn steps_are_equal_in_shared_memory() {
    let shared = SharedMemoryServer::start(RendererChoice::Off).await;
    shared.server.open("crowd").await;
    let remote = Client::connect(&shared.server.address).await.expect("expected a connection");
    let request = VertexRequest::new("crowd", VertexSelection::default().attribute(Attribute::Positions));
    let mut sets = Vec::new();
    for client in [shared.client().await, remote.clone()] {
        let mut writer = client.drive(&DriveRequest::new("crowd", Delivery::Latest)).await.expect("expected the lease");
        for number in 1..=4 {
            with_timeout(writer.step(&crowd_step(number))).await.expect("expected a sent step");
        }
        let summary = with_timeout(writer.finish()).await.expect("expected acknowledgments");
        assert_eq!((summary.acknowledged, summary.rejected), (Some(4), 0));
        sets.push(remote.get_vertices(&request).await.expect("expected vertices"));
    }
    assert_eq!(sets[0].step.number, 4);
    assert!(sets[0].positions == sets[1].positions && sets[0].step.run < sets[1].step.run);
    assert!(sets[0].positions.iter().any(|number| *number > 100.0), "expected moved domains");
}

/// Steps with values in a slot are accepted. Ranges outside of a slot are rejected, and the stream remains open.
#[tokio::test(flavor = "multi_thread")]
async fn wrong_range_of_a_step_is_rejected() {
    let shared = SharedMemoryServer::start(RendererChoice::Off).await;
    let mut memory = RawMemory::connect(&shared.path()).await;
    let mut writer = StepWriter::connect_with(shared.server.channel().await, |steps| memory.request(steps)).await;
    writer.open("sheet", v1::Delivery::Lossless, 0).await;
    let q = step(1, &[0], &[0.5, -0.25, 0.0, 1.0]).q;
    let slot_bytes = memory.numbers[1];
    rustix::io::pwrite(&memory.requests, &q, 6 * u64::from(slot_bytes)).expect("expected a writable file");
    let slot_count = memory.numbers[2];
    let shared_q = |slot, bytes| Some(v1::SharedRange { slot, bytes });
    let in_slot = |number, shared_q| v1::Step { shared_q, ..step(number, &[0], &[]) };
    writer.send_step_and_wait(in_slot(1, shared_q(6, 16))).await;
    assert_eq!(memory.socket.read_u32_le().await.expect("expected the slot"), 6);
    for range in [shared_q(slot_count, 16), shared_q(u32::MAX, 16), shared_q(0, slot_bytes + 1), shared_q(7, u32::MAX)]
    {
        writer.send_step(in_slot(2, range)).await;
        let rejection = writer.receive_rejection().await;
        assert_eq!((rejection.step, rejection.field.as_str()), (Some(2), "step.shared_q"));
    }
    // The values are validated as those of a message.
    writer.send_step(in_slot(3, shared_q(6, 12))).await;
    assert_eq!(writer.receive_rejection().await.field, "step.q");
    rustix::io::pwrite(&memory.requests, &f32::NAN.to_le_bytes(), 6 * u64::from(slot_bytes)).expect("a writable file");
    writer.send_step(in_slot(4, shared_q(6, 16))).await;
    assert!(writer.receive_rejection().await.field.starts_with("step.q"));
    writer.send_step_and_wait(step(5, &[0], &[0.5, -0.25, 0.0, 1.0])).await;
    writer.finish().await;
}

/// The client writes to a slot while the server reads it. The server accepts or rejects each step, and keeps running.
#[tokio::test(flavor = "multi_thread")]
async fn values_that_change_while_they_are_read_are_harmless() {
    let shared = SharedMemoryServer::start(RendererChoice::Off).await;
    let memory = RawMemory::connect(&shared.path()).await;
    let mut writer = StepWriter::connect_with(shared.server.channel().await, |steps| memory.request(steps)).await;
    writer.open("sheet", v1::Delivery::Lossless, 0).await;
    let is_done = std::sync::Arc::new(std::sync::atomic::AtomicBool::new(false));
    let requests = memory.requests.try_clone().expect("expected a file");
    let writing = std::thread::spawn({
        let is_done = std::sync::Arc::clone(&is_done);
        move || {
            while !is_done.load(std::sync::atomic::Ordering::Relaxed) {
                for number in [f32::NAN, 0.5] {
                    rustix::io::pwrite(&requests, &number.to_le_bytes(), 0).expect("expected a writable file");
                }
            }
        }
    });
    let (mut accepted, mut rejected) = (0, 0);
    for number in 1..=200 {
        let shared_q = Some(v1::SharedRange { slot: 0, bytes: 16 });
        writer.send_step(v1::Step { shared_q, ..step(number, &[0], &[]) }).await;
        match writer.receive_reply().await {
            ResponseKind::Ack(_) => accepted += 1,
            ResponseKind::Rejection(rejection) if rejection.field.starts_with("step.q") => rejected += 1,
            other => panic!("{other:?}"),
        }
    }
    is_done.store(true, std::sync::atomic::Ordering::Relaxed);
    writing.join().expect("expected no panic");
    println!("{accepted} steps accepted, {rejected} rejected");
    writer.finish().await;
    let request = VertexRequest::new("sheet", VertexSelection::default());
    let client = Client::connect(&shared.server.address).await.expect("expected a connection");
    let set = client.get_vertices(&request).await.expect("expected vertices");
    assert!(set.positions.iter().all(|number| number.is_finite()));
}
