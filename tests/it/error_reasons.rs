//! Every reason code that a client can provoke, with its status code and the standard details of the status.

use std::sync::Arc;
use std::time::Duration;

use modalcast::config::Config;
use modalcast_model::load::SceneRepository;
use modalcast_proto::v1;
use tonic::{Code, Status};
use tonic_types::StatusExt as _;
use v1::drive_scene_response::Kind as ResponseKind;
use v1::{Delivery, Reason};

use crate::service_harness::{
    Server, StepWriter, config, exact_step, get_vertices, minimum_step, rejection_details, step, with_timeout,
};

fn vertex_request(scene: &str) -> v1::GetVerticesRequest {
    v1::GetVerticesRequest { scene: scene.into(), ..v1::GetVerticesRequest::default() }
}

async fn vertex_error(server: &Server, request: v1::GetVerticesRequest) -> Status {
    get_vertices(server, request).await.expect_err("expected an error")
}

async fn open_error(server: &Server, source: &str, scene: &str) -> Status {
    let request = v1::OpenSceneRequest { source: source.into(), scene: scene.into() };
    server.scenes().await.open_scene(request).await.expect_err("expected an error")
}

/// Starts a server, provokes errors of calls and returns them with the expected codes and reasons.
async fn errors_of_calls() -> Vec<(Code, Reason, Status)> {
    let limits = |config| Config { open_scenes: 2, max_pending_requests: 1, message_bytes: 64 << 10, ..config };
    let server = Server::start_with(limits).await;
    server.open("strips").await;
    let mut writer = server.drive("strips", Delivery::Lossless, 0).await;
    writer.send_step_and_wait(step(5, &[0], &[0.0, 0.0])).await;
    let mut errors = Vec::new();

    let selection = Some(v1::VertexSelection { domains: vec![9], ..Default::default() });
    let unknown_domain = v1::GetVerticesRequest { selection, ..vertex_request("strips") };
    errors.push((Code::InvalidArgument, Reason::InvalidField, vertex_error(&server, unknown_domain).await));
    let empty_upload = server.scenes().await.upload_scene(tokio_stream::iter([])).await;
    errors.push((Code::InvalidArgument, Reason::UnexpectedMessage, empty_upload.expect_err("expected an error")));
    errors.push((Code::NotFound, Reason::SceneNotFound, vertex_error(&server, vertex_request("none")).await));
    errors.push((Code::AlreadyExists, Reason::SceneNameTaken, open_error(&server, "sheet", "strips").await));
    let passed_step = v1::GetVerticesRequest { step: exact_step(4), ..vertex_request("strips") };
    errors.push((Code::FailedPrecondition, Reason::StepPassed, vertex_error(&server, passed_step).await));
    let future_step = v1::GetVerticesRequest { step: minimum_step(99), ..vertex_request("strips") };
    let late_request = v1::GetVerticesRequest { deadline_ms: 50, ..future_step.clone() };
    errors.push((Code::DeadlineExceeded, Reason::DeadlineExpired, vertex_error(&server, late_request).await));
    let client = server.vertices().await;
    let waiting_requests = [client.clone(), client].map(|mut client| {
        let request = future_step.clone();
        tokio::spawn(async move { client.get_vertices(request).await?.into_inner().message().await })
    });
    // One of the two requests waits. The other is rejected.
    let [first, second] = waiting_requests;
    let rejected = with_timeout(async {
        tokio::select! { result = first => result, result = second => result }
    })
    .await;
    let rejected = rejected.expect("expected no panic").expect_err("expected a full queue");
    errors.push((Code::ResourceExhausted, Reason::QueueFull, rejected));
    let frame_request = v1::RenderFrameRequest { scene: "strips".into(), ..v1::RenderFrameRequest::default() };
    let mut frame = server.frames().await.render_frame(frame_request).await.expect("expected a stream").into_inner();
    let no_renderer = with_timeout(frame.message()).await.expect_err("expected an error");
    errors.push((Code::Unavailable, Reason::ResourceMissing, no_renderer));
    let update = v1::UpdateFrameStreamRequest { stream: vec![7; 16].into(), cameras: Vec::new() };
    let unknown_stream = server.frames().await.update_frame_stream(update).await.expect_err("expected an error");
    errors.push((Code::NotFound, Reason::StreamNotFound, unknown_stream));
    errors.push((Code::Internal, Reason::Internal, open_error(&server, "panic", "").await));
    server.open("attributes").await;
    errors.push((Code::ResourceExhausted, Reason::LimitReached, open_error(&server, "sheet", "").await));

    writer.send_step(step(6, &[0], &vec![0.0; 20_000])).await;
    let too_large = with_timeout(writer.replies.message()).await.expect_err("expected an error");
    errors.push((Code::ResourceExhausted, Reason::MessageTooLarge, too_large));
    let too_large_request = vertex_error(&server, vertex_request(&"x".repeat(65 << 10))).await;
    errors.push((Code::ResourceExhausted, Reason::MessageTooLarge, too_large_request));
    let channel = server.channel().await;
    server.engine.shutdown().await;
    let mut client = v1::vertex_service_client::VertexServiceClient::new(channel);
    let stopped = client.get_vertices(vertex_request("strips")).await.expect_err("expected an error");
    errors.push((Code::Unavailable, Reason::ShuttingDown, stopped));
    errors
}

#[tokio::test(flavor = "multi_thread")]
async fn errors_have_reasons_and_standard_details() {
    for (code, reason, status) in errors_of_calls().await {
        let rejection = rejection_details(&status);
        assert_eq!((status.code(), rejection.reason()), (code, reason), "{status:?}");
        assert_eq!(
            !rejection.field.is_empty(),
            matches!(reason, Reason::InvalidField | Reason::StepPassed),
            "{reason:?}"
        );
        let can_retry = matches!(reason, Reason::QueueFull | Reason::ShuttingDown);
        assert_eq!(status.get_details_retry_info().is_some(), can_retry, "{reason:?}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn invalid_file_is_reported_with_its_location() {
    let (state, scenes) = (tempfile::tempdir(), tempfile::tempdir());
    let (state, scenes) = (state.expect("expected a folder"), scenes.expect("expected a folder"));
    std::fs::write(scenes.path().join("bad.obj"), "v 0 0 zero\n").expect("expected a written file");
    let repository = SceneRepository::new(Some(scenes.path())).expect("expected a repository");
    let server = Server::start_from(config(state.path()), Arc::new(repository)).await;
    let status = open_error(&server, "bad.obj", "").await;
    assert_eq!((status.code(), rejection_details(&status).reason()), (Code::InvalidArgument, Reason::InvalidFile));
    let error_info = status.get_details_error_info().expect("expected an ErrorInfo");
    assert!(error_info.metadata["location"].contains("bad.obj"), "{error_info:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn rejections_on_step_streams_have_reasons() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let mut writer = StepWriter::connect(server.channel().await).await;
    writer.send_step(step(1, &[], &[])).await;
    assert_eq!(writer.receive_rejection().await.reason(), Reason::UnexpectedMessage);
    let ResponseKind::Rejection(unknown_scene) = writer.open("none", Delivery::Lossless, 0).await else {
        panic!("expected a rejection of an unknown scene")
    };
    assert_eq!(unknown_scene.reason(), Reason::SceneNotFound);
    assert!(matches!(writer.open("strips", Delivery::Lossless, 0).await, ResponseKind::Opened(_)));
    let mut second_writer = StepWriter::connect(server.channel().await).await;
    let ResponseKind::Rejection(second_lease) = second_writer.open("strips", Delivery::Lossless, 0).await else {
        panic!("expected a rejection of a second writer")
    };
    assert_eq!(second_lease.reason(), Reason::WriterLeaseTaken);
    writer.send_step(step(1, &[0], &[0.0])).await;
    let short_q = writer.receive_rejection().await;
    assert_eq!((short_q.reason(), short_q.field.as_str()), (Reason::InvalidField, "step.q"));
}

#[tokio::test(flavor = "multi_thread")]
async fn slow_reader_is_told_why_its_stream_ends() {
    let stall_budget = Duration::from_millis(50);
    let server = Server::start_with(|config| Config { stall_budget, ..config }).await;
    server.open("sheet").await;
    let request = v1::StreamVerticesRequest {
        scene: "sheet".into(),
        delivery: Delivery::Lossless.into(),
        ..v1::StreamVerticesRequest::default()
    };
    let mut unread_stream =
        server.vertices().await.stream_vertices(request).await.expect("expected a subscription").into_inner();
    let mut writer = server.drive("sheet", Delivery::Lossless, 1).await;
    for number in 1..=40 {
        writer.send_step_and_wait(step(number, &[0], &[number as f32, 0.0, 0.0, 0.0])).await;
    }
    let status = loop {
        match with_timeout(unread_stream.message()).await {
            Ok(message) => assert!(message.is_some(), "expected an error at the end of the stream"),
            Err(status) => break status,
        }
    };
    assert_eq!((status.code(), rejection_details(&status).reason()), (Code::ResourceExhausted, Reason::SlowReader));
}
