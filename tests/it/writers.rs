//! Writers of a scene: flow control of their streams, leases, runs and initial states.

use std::time::Duration;

use modalcast::admission::Account;
use modalcast::config::Config;
use modalcast::engine::{Delivery as EngineDelivery, OutputSpec, Subscription};
use modalcast_client::{Client, Delivery as ClientDelivery, DriveRequest, StateLayout, StateRequest, Step};
use modalcast_model::deform::VertexAttributes;
use modalcast_proto::v1;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tonic::Code;
use tonic::transport::Channel;
use v1::drive_scene_request::Kind as RequestKind;
use v1::drive_scene_response::Kind as ResponseKind;
use v1::step_service_client::StepServiceClient;
use v1::{Delivery, InitialState, OpenDrive, Overflow, Reason};

use crate::service_harness::{
    Server, StepWriter, config, get_vertices, reference_vertices, rejection_details, step, strips, with_timeout,
};

fn lossless(scene: &str) -> OpenDrive {
    OpenDrive { scene: scene.into(), delivery: Delivery::Lossless.into(), ..OpenDrive::default() }
}

async fn open(server: &Server, open: OpenDrive) -> (StepWriter, ResponseKind) {
    let mut writer = StepWriter::connect(server.channel().await).await;
    writer.send(RequestKind::Open(open)).await;
    let reply = writer.receive_reply().await;
    (writer, reply)
}

async fn open_successfully(server: &Server, request: OpenDrive) -> (StepWriter, v1::Opened) {
    match open(server, request).await {
        (writer, ResponseKind::Opened(opened)) => (writer, opened),
        (_, other) => panic!("expected the stream to open, got {other:?}"),
    }
}

async fn rejection_of(server: &Server, request: OpenDrive) -> v1::Rejection {
    match open(server, request).await {
        (_, ResponseKind::Rejection(rejection)) => rejection,
        (_, other) => panic!("expected a rejection, got {other:?}"),
    }
}

/// A lossless subscription. It blocks the writer after two steps unless it is read.
async fn subscribe(server: &Server, scene: &str) -> Subscription {
    let scene_handle = server.engine.find(scene).expect("expected an open scene");
    let spec = OutputSpec::Vertices(VertexAttributes::POSITIONS_AND_NORMALS);
    scene_handle.subscribe(&Account::server(), spec, EngineDelivery::Lossless).await.expect("expected a subscription")
}

/// A client sends steps without reading replies. Back-pressure slows it down, and no step is rejected or lost.
#[tokio::test(flavor = "multi_thread")]
async fn blocked_writer_that_keeps_sending_loses_no_step() {
    const STEPS: u64 = 400;
    let server = Server::start_default().await;
    server.open("strips").await;
    let mut subscription = subscribe(&server, "strips").await;
    let (writer, opened) = open_successfully(&server, OpenDrive { window: 2, ..lossless("strips") }).await;
    assert_eq!((opened.delivery(), opened.overflow(), opened.window), (Delivery::Lossless, Overflow::Block, 2));
    let (sender, mut replies) = writer.split();
    let sending = tokio::spawn(async move {
        for number in 1..=STEPS {
            let kind = Some(RequestKind::Step(step(number, &[0], &[number as f32, 0.0])));
            sender.send(v1::DriveSceneRequest { kind }).await.expect("expected an open stream");
        }
        sender
    });
    // The subscriber has two credits, and the step after them blocks.
    let scene_handle = server.engine.find("strips").expect("expected an open scene");
    let until_first_step = async {
        while scene_handle.last_step().is_none() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    with_timeout(until_first_step).await;
    tokio::time::sleep(Duration::from_millis(200)).await;
    let last_step = scene_handle.last_step();
    assert!(last_step.is_some_and(|step| step.number <= 3), "expected a blocked writer, got {last_step:?}");
    for number in 1..=STEPS {
        let output = with_timeout(subscription.next()).await.expect("expected another step");
        assert_eq!((output.step.number, output.skipped), (number, 0));
    }
    let sender = with_timeout(sending).await.expect("expected no panic");
    drop(sender);
    let mut last_ack = 0;
    while let Some(reply) = with_timeout(replies.message()).await.expect("expected no error") {
        match reply.kind {
            Some(ResponseKind::Ack(ack)) => last_ack = ack.step,
            other => panic!("expected only acknowledgments, got {other:?}"),
        }
    }
    assert_eq!(last_ack, STEPS);
}

#[tokio::test(flavor = "multi_thread")]
async fn step_beyond_the_window_is_rejected_on_request() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let _unread_subscription = subscribe(&server, "strips").await;
    let request = OpenDrive { window: 2, overflow: Overflow::Reject.into(), ..lossless("strips") };
    let (mut writer, _) = open_successfully(&server, request).await;
    for number in 1..=12 {
        writer.send_step(step(number, &[0], &[0.5, 0.0])).await;
    }
    let rejection = loop {
        match writer.receive_reply().await {
            ResponseKind::Ack(_) => {}
            ResponseKind::Rejection(rejection) => break rejection,
            ResponseKind::Opened(_) => panic!("expected one opening"),
        }
    };
    assert_eq!((rejection.reason(), rejection.field.as_str()), (Reason::WindowFull, ""));
    assert!(rejection.step.is_some_and(|number| number > 2), "{rejection:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn stream_without_a_delivery_is_rejected_with_the_choices() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let rejection = rejection_of(&server, OpenDrive { delivery: 0, ..lossless("strips") }).await;
    assert_eq!((rejection.reason(), rejection.field.as_str()), (Reason::InvalidField, "open.delivery"));
    assert!(rejection.expected.contains("DELIVERY_LOSSLESS") && rejection.expected.contains("DELIVERY_LATEST"));
    let request = v1::StreamVerticesRequest { scene: "strips".into(), ..v1::StreamVerticesRequest::default() };
    let status = server.vertices().await.stream_vertices(request).await.expect_err("expected an error");
    assert_eq!((status.code(), rejection_details(&status).field.as_str()), (Code::InvalidArgument, "delivery"));
}

/// The connection of the first stream stays open, as after a crash of the client that the server has not noticed.
#[tokio::test(flavor = "multi_thread")]
async fn lease_token_replaces_its_own_stream_at_once() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let (mut first_writer, first_opened) = open_successfully(&server, lossless("strips")).await;
    first_writer.send_step_and_wait(step(1, &[0], &[1.0, 0.0])).await;
    let other_token = OpenDrive { lease_token: vec![1; 16].into(), ..lossless("strips") };
    for request in [lossless("strips"), other_token.clone()] {
        assert_eq!(rejection_of(&server, request).await.reason(), Reason::WriterLeaseTaken);
    }
    let same_token = OpenDrive { lease_token: first_opened.lease_token.clone(), ..lossless("strips") };
    let (mut second_writer, second_opened) = open_successfully(&server, same_token).await;
    assert_eq!(second_opened.lease_token, first_opened.lease_token);
    assert!(second_opened.run > first_opened.run);
    let status = with_timeout(first_writer.replies.message()).await.expect_err("expected the first stream to end");
    assert_eq!((status.code(), rejection_details(&status).reason()), (Code::Aborted, Reason::LeaseLost));
    second_writer.send_step_and_wait(step(1, &[0], &[2.0, 0.0])).await;
    let (_third_writer, third_opened) = open_successfully(&server, OpenDrive { take_over: true, ..other_token }).await;
    assert_eq!(third_opened.lease_token, [1_u8; 16].as_slice());
    let status = with_timeout(second_writer.replies.message()).await.expect_err("expected the second stream to end");
    assert_eq!(rejection_details(&status).reason(), Reason::LeaseLost);
}

#[tokio::test(flavor = "multi_thread")]
async fn malformed_lease_tokens_are_rejected() {
    let server = Server::start_default().await;
    server.open("strips").await;
    for bytes in [1, 15, 65] {
        let request = OpenDrive { lease_token: vec![1; bytes].into(), ..lossless("strips") };
        let rejection = rejection_of(&server, request).await;
        assert_eq!((rejection.reason(), rejection.field.as_str()), (Reason::InvalidField, "open.lease_token"));
    }
}

/// Three servers use the same state folder, one after another.
#[tokio::test(flavor = "multi_thread")]
async fn runs_never_repeat_on_any_scene_or_after_a_restart() {
    let state = tempfile::tempdir().expect("expected a temporary folder");
    let mut runs = Vec::new();
    for _ in 0..3 {
        let server = Server::start(config(state.path())).await;
        server.open("strips").await;
        server.open("sheet").await;
        for scene in ["strips", "sheet", "strips"] {
            let (writer, opened) = open_successfully(&server, OpenDrive { take_over: true, ..lossless(scene) }).await;
            runs.push(opened.run);
            writer.disconnect();
        }
        server.stop().await.expect("expected the state folder to be released");
    }
    assert!(runs.is_sorted_by(|run, next| run < next), "{runs:?}");
    assert_eq!(runs.len(), 9);
}

/// The device shows the restored state until the first step, which changes only one domain.
#[tokio::test(flavor = "multi_thread")]
async fn reset_after_a_restart_removes_the_restored_state() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let server = Server::start(config(folder.path())).await;
    server.open("strips").await;
    let (mut writer, _) = open_successfully(&server, lossless("strips")).await;
    writer.send_step_and_wait(step(1, &[0], &[0.5, 0.25])).await;
    writer.finish().await;
    server.stop().await.expect("expected the server to stop without an error");
    let server = Server::start(config(folder.path())).await;
    let request = OpenDrive { initial_state: InitialState::Reset.into(), ..lossless("strips") };
    let (mut writer, _) = open_successfully(&server, request).await;
    let first_step = step(1, &[1], &[0.125, 1.0]);
    writer.send_step_and_wait(first_step.clone()).await;
    let request = v1::GetVerticesRequest { scene: "strips".into(), ..v1::GetVerticesRequest::default() };
    let reply = get_vertices(&server, request).await.expect("expected vertices");
    assert_eq!(reply.positions, reference_vertices(&strips(), &[first_step]).positions);
}

#[tokio::test(flavor = "multi_thread")]
async fn first_step_starts_from_the_current_or_the_rest_state() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let (mut writer, _) = open_successfully(&server, lossless("strips")).await;
    let first_step = step(1, &[0], &[0.5, 0.25]);
    writer.send_step_and_wait(first_step.clone()).await;
    writer.finish().await;
    let second_step = step(2, &[1], &[0.125, 1.0]);
    let cases = [
        (InitialState::Reset, vec![second_step.clone()]),
        // The reset of the case before has removed the first step, so it is sent again.
        (InitialState::Keep, vec![first_step.clone(), second_step.clone()]),
    ];
    for (initial_state, steps) in cases {
        let request = OpenDrive { initial_state: initial_state.into(), ..lossless("strips") };
        let (mut writer, opened) = open_successfully(&server, request).await;
        assert_eq!(opened.initial_state(), initial_state);
        for step in &steps {
            writer.send_step_and_wait(step.clone()).await;
        }
        let request = v1::GetVerticesRequest { scene: "strips".into(), ..v1::GetVerticesRequest::default() };
        let reply = get_vertices(&server, request).await.expect("expected vertices");
        assert_eq!(reply.positions, reference_vertices(&strips(), &steps).positions, "{initial_state:?}");
        writer.finish().await;
    }
}

/// The vertices of the current step of "strips".
async fn strips_positions(server: &Server) -> Vec<f32> {
    let request = v1::GetVerticesRequest { scene: "strips".into(), ..v1::GetVerticesRequest::default() };
    get_vertices(server, request).await.expect("expected vertices").positions
}

#[tokio::test(flavor = "multi_thread")]
async fn new_writer_starts_from_rest_and_a_resumed_one_from_its_state() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let (first_step, second_step) = (step(1, &[0], &[0.5, 0.25]), step(2, &[1], &[0.125, 1.0]));
    let (mut writer, opened) = open_successfully(&server, lossless("strips")).await;
    assert_eq!(opened.initial_state(), InitialState::Reset);
    writer.send_step_and_wait(first_step.clone()).await;
    writer.finish().await;
    let own_token = OpenDrive { lease_token: opened.lease_token, ..lossless("strips") };
    // The token of the last writer, after its stream has ended.
    let (mut resumed, opened) = open_successfully(&server, own_token.clone()).await;
    assert_eq!(opened.initial_state(), InitialState::Keep);
    resumed.send_step_and_wait(second_step.clone()).await;
    let both = reference_vertices(&strips(), &[first_step.clone(), second_step.clone()]).positions;
    assert_eq!(strips_positions(&server).await, both);
    resumed.finish().await;
    // Another writer, which sends no step. The token of the first writer is then no longer that of the last writer.
    let (other, opened) = open_successfully(&server, lossless("strips")).await;
    assert_eq!(opened.initial_state(), InitialState::Reset);
    assert_eq!(strips_positions(&server).await, both, "expected no change before the first step");
    other.finish().await;
    let (mut writer, opened) = open_successfully(&server, own_token.clone()).await;
    assert_eq!(opened.initial_state(), InitialState::Reset);
    // The writer's connection breaks before its first step.
    let (replacement, opened) = open_successfully(&server, own_token).await;
    assert_eq!(opened.initial_state(), InitialState::Reset, "expected the rest state that the run has not left yet");
    drop(std::mem::replace(&mut writer, replacement));
    writer.send_step_and_wait(second_step.clone()).await;
    assert_eq!(strips_positions(&server).await, reference_vertices(&strips(), &[second_step]).positions);
}

#[tokio::test(flavor = "multi_thread")]
async fn reset_scene_shows_rest_and_respects_the_writer() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let (mut writer, _) = open_successfully(&server, lossless("strips")).await;
    writer.send_step_and_wait(step(1, &[0], &[0.5, 0.25])).await;
    let moved = strips_positions(&server).await;
    let reset = async |take_over: bool| {
        let request = v1::ResetSceneRequest { scene: "strips".into(), take_over };
        let mut service = StepServiceClient::new(server.channel().await);
        with_timeout(service.reset_scene(request)).await.map(tonic::Response::into_inner)
    };
    let status = reset(false).await.expect_err("expected the lease to be taken");
    assert_eq!(rejection_details(&status).reason(), Reason::WriterLeaseTaken);
    assert_eq!(strips_positions(&server).await, moved);
    let step_of_reset = reset(true).await.expect("expected a reset").step.expect("expected a step");
    let rest = reference_vertices(&strips(), &[step(0, &[], &[])]).positions;
    assert_eq!(strips_positions(&server).await, rest);
    // The lease is free again.
    let repeated = reset(false).await.expect("expected a reset").step.expect("expected a step");
    assert!(repeated.run > step_of_reset.run);
    let request = v1::ResetSceneRequest { scene: "none".into(), take_over: false };
    let status = StepServiceClient::new(server.channel().await).reset_scene(request).await;
    assert_eq!(status.expect_err("expected no such scene").code(), Code::NotFound);
}

/// The defaults of the Rust client.
#[tokio::test(flavor = "multi_thread")]
async fn client_starts_from_rest_unless_it_resumes_or_keeps_the_state() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let client = Client::connect(&server.address).await.expect("expected a connection");
    let request = || DriveRequest::new("strips", ClientDelivery::Lossless);
    let description = client.describe("strips", &[]).await.expect("expected a description");
    let layout = StateLayout::new(&description).expect("expected a layout");
    let first_q = async || {
        let state = client.get_state(&StateRequest::new("strips", ()), &layout).await.expect("expected a state");
        state.q(0).expect("expected domain 0")[0]
    };
    let mut token = Vec::new();
    let requests = [(request(), true), (request(), true), (request().keep_state(), false), (request().reset(), true)];
    for (request, starts_from_rest) in requests {
        let mut steps = client.drive(&request).await.expect("expected the lease");
        assert_eq!(steps.starts_from_rest, starts_from_rest, "{request:?}");
        let other_q = Step::new(1, 0.0).q(1, &[0.5, 0.5]);
        steps.step(&other_q).await.expect("expected an open stream");
        steps.flush().await.expect("expected an open stream");
        let expected = if starts_from_rest { 0.0 } else { 2.0 };
        assert_eq!(first_q().await, expected, "{request:?}");
        steps.step(&Step::new(2, 0.0).q(0, &[2.0, 0.0])).await.expect("expected an open stream");
        token = steps.lease_token.clone();
        steps.finish().await.expect("expected an open stream");
    }
    let steps = client.drive(&request().lease_token(&token)).await.expect("expected the lease");
    assert!(!steps.starts_from_rest);
    assert!(client.reset_scene("strips", false).await.is_err(), "expected the lease to be taken");
    steps.finish().await.expect("expected an open stream");
    client.reset_scene("strips", false).await.expect("expected a reset");
    assert_eq!(first_q().await, 0.0);
}

/// A proxy to a server that delays everything that the server sends until `open` is true.
async fn start_delaying_proxy(server_address: String, mut open: watch::Receiver<bool>) -> String {
    let listener = TcpListener::bind(("127.0.0.1", 0)).await.expect("expected a free port");
    let address = format!("http://{}", listener.local_addr().expect("expected a socket address"));
    tokio::spawn(async move {
        let (client, _) = listener.accept().await.expect("expected a client");
        let server = TcpStream::connect(server_address.trim_start_matches("http://")).await.expect("expected a server");
        let (mut from_client, mut to_client) = client.into_split();
        let (mut from_server, mut to_server) = server.into_split();
        tokio::spawn(async move { tokio::io::copy(&mut from_client, &mut to_server).await });
        let mut buffer = vec![0; 1 << 16];
        while let Ok(bytes @ 1..) = from_server.read(&mut buffer).await {
            open.wait_for(|is_open| *is_open).await.expect("expected the sender of the test");
            to_client.write_all(&buffer[..bytes]).await.expect("expected an open connection");
        }
    });
    address
}

/// On a connection with a long round trip, the steps in flight are bounded by flow control (64 KiB), not by the window
/// of 8 steps: the server completes 500 steps before the client has received any acknowledgment of them.
#[tokio::test(flavor = "multi_thread")]
async fn steps_do_not_wait_for_acknowledgments_of_a_distant_server() {
    const STEPS: u64 = 500;
    let server = Server::start_default().await;
    server.open("strips").await;
    let (open_sender, is_open) = watch::channel(true);
    let proxy_address = start_delaying_proxy(server.address.clone(), is_open).await;
    let channel = Channel::from_shared(proxy_address).expect("expected a URL").connect().await;
    let mut writer = StepWriter::connect(channel.expect("expected a connection")).await;
    writer.send(RequestKind::Open(lossless("strips"))).await;
    assert!(matches!(writer.receive_reply().await, ResponseKind::Opened(opened) if opened.window == 8));
    open_sender.send(false).expect("expected a running proxy");
    for number in 1..=STEPS {
        with_timeout(writer.send_step(step(number, &[0], &[number as f32, 0.0]))).await;
    }
    let scene_handle = server.engine.find("strips").expect("expected an open scene");
    let completed = async {
        while scene_handle.last_step().is_none_or(|step| step.number < STEPS) {
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
    };
    with_timeout(completed).await;
    open_sender.send(true).expect("expected a running proxy");
    let mut last_ack = 0;
    while last_ack < STEPS {
        match writer.receive_reply().await {
            ResponseKind::Ack(ack) => last_ack = ack.step,
            other => panic!("expected an acknowledgment, got {other:?}"),
        }
    }
}

/// Four blocked step streams of one connection, each with as many of the smallest steps as flow control admits, leave
/// the connection usable. A fifth stream is refused.
#[tokio::test(flavor = "multi_thread")]
async fn blocked_streams_of_tiny_steps_keep_the_connection_alive() {
    let stall_budget = Duration::from_secs(600);
    // A small window, because all windows are filled with small frames. Whether this is safe depends only on the ratio
    // to the window of the connection.
    let server = Server::start_with(|config| Config { stall_budget, stream_window: 64 << 10, ..config }).await;
    let channel = server.channel().await;
    let mut blocked = Vec::new();
    for name in ["a", "b", "c", "d"] {
        let request = v1::OpenSceneRequest { source: "strips".into(), scene: name.into() };
        server.scenes().await.open_scene(request).await.expect("expected the scene to open");
        let subscription = subscribe(&server, name).await;
        let mut writer = StepWriter::connect(channel.clone()).await;
        writer.send(RequestKind::Open(OpenDrive { window: 1, ..lossless(name) })).await;
        assert!(matches!(writer.receive_reply().await, ResponseKind::Opened(_)));
        let (sender, replies) = writer.split();
        let sending = tokio::spawn(async move {
            for number in 0..20_000 {
                let kind = Some(RequestKind::Step(v1::Step { number, ..v1::Step::default() }));
                if sender.send(v1::DriveSceneRequest { kind }).await.is_err() {
                    return;
                }
            }
        });
        blocked.push((subscription, replies, sending));
    }
    // Long enough for every stream to fill its window of 64 KiB.
    tokio::time::sleep(Duration::from_secs(2)).await;
    assert!(blocked.iter().all(|(_, _, sending)| !sending.is_finished()), "expected blocked streams");
    let mut client = v1::vertex_service_client::VertexServiceClient::new(channel.clone());
    let request = v1::GetVerticesRequest { scene: "a".into(), ..v1::GetVerticesRequest::default() };
    let mut reply = with_timeout(client.get_vertices(request)).await.expect("expected a live connection").into_inner();
    assert!(with_timeout(reply.message()).await.expect("expected vertices").is_some());
    let no_requests = tokio_stream::pending::<v1::DriveSceneRequest>();
    let status = with_timeout(StepServiceClient::new(channel.clone()).drive_scene(no_requests)).await;
    let status = status.expect_err("expected a limit on the step streams of a connection");
    assert_eq!((status.code(), rejection_details(&status).reason()), (Code::ResourceExhausted, Reason::LimitReached));
    // Another connection has a limit of its own.
    let (_, reply) = open(&server, lossless("a")).await;
    assert!(matches!(reply, ResponseKind::Rejection(rejection) if rejection.reason() == Reason::WriterLeaseTaken));
    for (_, _, sending) in blocked {
        sending.abort();
    }
}
