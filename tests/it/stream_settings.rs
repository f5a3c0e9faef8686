//! The settings of frame and vertex streams: the limit on the rate, and the first reply, which has the settings in
//! effect. The tests with frames need an EGL driver that can render.

use std::time::{Duration, Instant};

use modalcast::config::{Config, RendererChoice};
use modalcast_client::{Client, Delivery, FrameStreamRequest, Output, Picture, VertexSelection, VertexStreamRequest};
use modalcast_model::scene::{Camera, Lens, View};
use modalcast_proto::v1;
use tonic::{Code, Status};

use crate::service_harness::{Server, next_vertices, rejection_details, step, strips, with_timeout};

fn vertex_request(delivery: v1::Delivery, max_hz: f64) -> v1::StreamVerticesRequest {
    v1::StreamVerticesRequest { scene: "strips".into(), delivery: delivery.into(), max_hz, ..Default::default() }
}

/// The numbers of the step and of the skipped steps of a vertex stream's next result.
async fn next_step(stream: &mut tonic::Streaming<v1::StreamVerticesResponse>) -> (u64, u64) {
    let vertices = next_vertices(stream).await.expect("expected no error").expect("expected another step");
    (vertices.step().number, vertices.head.skipped)
}

/// A stream limited to one result in 1000 s carries one of ten steps, and a stream without a limit all of them.
#[tokio::test(flavor = "multi_thread")]
async fn rate_limit_bounds_the_results_of_a_stream() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let mut client = server.vertices().await;
    let mut subscribe = async |max_hz| {
        let request = vertex_request(v1::Delivery::Latest, max_hz);
        client.stream_vertices(request).await.expect("expected a subscription").into_inner()
    };
    // One result in 1000 s.
    let (mut limited, mut unlimited) = (subscribe(1e-3).await, subscribe(0.0).await);
    let mut writer = server.drive_lossless("strips").await;
    for number in 1..=10 {
        writer.send_step_and_wait(step(number, &[0], &[0.01 * number as f32, 0.0])).await;
        assert_eq!(next_step(&mut unlimited).await, (number, 0));
        if number == 1 {
            assert_eq!(next_step(&mut limited).await, (1, 0));
        }
    }
    let second_result = tokio::time::timeout(Duration::from_millis(300), next_vertices(&mut limited)).await;
    assert!(second_result.is_err(), "expected one result in 1000 s, got {second_result:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn limited_stream_counts_skipped_steps_and_ends_at_the_newest() {
    let (server, max_hz, steps) = (Server::start_default().await, 40.0, 200);
    server.open("strips").await;
    let (start, request) = (Instant::now(), vertex_request(v1::Delivery::Latest, max_hz));
    let mut stream = server.vertices().await.stream_vertices(request).await.expect("a subscription").into_inner();
    let mut writer = server.drive_lossless("strips").await;
    let send_steps = async {
        for number in 1..=steps {
            writer.send_step_and_wait(step(number, &[0], &[0.001 * number as f32, 0.0])).await;
        }
    };
    let receive_results = async {
        let (mut results, mut counted_steps, mut last_step) = (0, 0, 0);
        while last_step < steps {
            let (number, skipped) = next_step(&mut stream).await;
            (results, counted_steps, last_step) = (results + 1, counted_steps + 1 + skipped, number);
            assert_eq!(counted_steps, number, "expected each step to be received or counted as skipped");
            let max_results = 2.0 + max_hz * start.elapsed().as_secs_f64();
            assert!(f64::from(results) <= max_results, "{results} results, expected at most {max_results}");
        }
    };
    tokio::join!(send_steps, receive_results);
}

#[tokio::test(flavor = "multi_thread")]
async fn invalid_rate_limits_are_rejected() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let subscribe = async |delivery, max_hz| -> Result<(), Status> {
        let stream = with_timeout(server.vertices().await.stream_vertices(vertex_request(delivery, max_hz))).await;
        stream.map(drop)
    };
    subscribe(v1::Delivery::Latest, 30.0).await.expect("control: expected a valid limit");
    subscribe(v1::Delivery::Lossless, 0.0).await.expect("control: expected a stream without a limit");
    for (delivery, max_hz) in [
        (v1::Delivery::Lossless, 30.0),
        (v1::Delivery::Latest, -1.0),
        (v1::Delivery::Latest, f64::NAN),
        (v1::Delivery::Latest, f64::INFINITY),
    ] {
        let status = subscribe(delivery, max_hz).await.expect_err("expected an invalid limit");
        let rejection = rejection_details(&status);
        assert_eq!((status.code(), rejection.field.as_str()), (Code::InvalidArgument, "max_hz"), "{delivery:?}");
        assert_eq!(rejection.reason(), v1::Reason::InvalidField);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn first_reply_has_the_settings_in_effect() {
    let server = Server::start_with(|config| Config { renderer: RendererChoice::Auto, ..config }).await;
    server.open("strips").await;
    let client = Client::connect(&server.address).await.expect("expected a connection");
    let request = VertexStreamRequest::new("strips", VertexSelection::default());
    let request = request.delivery(Delivery::Latest).max_hz(12.5).max_steps(3);
    let vertices = client.stream_vertices(&request).await.expect("expected a subscription");
    let (delivery, max_hz, steps) = (v1::Delivery::Latest.into(), 12.5, 3);
    assert_eq!(*vertices.settings(), v1::VertexStreamSettings { delivery, max_hz, steps });
    let request = FrameStreamRequest::new("strips", Picture::default()).max_steps(7);
    let frames = client.stream_frames(&request).await.expect("expected a subscription");
    let settings = frames.settings();
    assert_eq!(settings.stream.len(), 16);
    assert_eq!((settings.delivery(), settings.max_hz, settings.steps), (v1::Delivery::Lossless, 0.0, 7));
    let camera = Camera::fit_to_scene(&strips(), 1280, 720);
    let (View::LookAt { eye, target, up }, Lens::FieldOfView(degrees)) = (camera.view, camera.lens) else {
        panic!("expected a camera with a target and a field of view")
    };
    let look_at = v1::LookAt { eye: eye.into(), target: target.into(), up: up.into() };
    let (view, lens) = (v1::camera::View::LookAt(look_at), v1::camera::Lens::FieldOfView(degrees));
    let expected_picture = v1::Picture {
        width: 1280,
        height: 720,
        format: v1::Format::Png.into(),
        camera: Some(v1::Camera { view: Some(view), lens: Some(lens), near: 0.0, far: 0.0 }),
        output: v1::Output::Color.into(),
        edge_width: Some(0.0),
        ..v1::Picture::default()
    };
    assert_eq!(settings.pictures, [expected_picture]);
    let output = Output::ModeShape { mode: 1, scale_max: 0.25 };
    let request = FrameStreamRequest::new("strips", Picture { output, ..Picture::default() }.size(32, 24));
    let frames = client.stream_frames(&request).await.expect("expected a subscription");
    let picture = &frames.settings().pictures[0];
    assert_eq!((picture.width, picture.height, picture.format()), (32, 24, v1::Format::Png));
    assert_eq!((picture.output(), picture.mode, picture.largest), (v1::Output::ModeShape, 1, 0.25));
}
