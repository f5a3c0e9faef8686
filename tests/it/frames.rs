//! Frames over the wire, as single frames and as streams: step, size, format, pixels and deadlines. These tests need an
//! EGL driver that can render.

use std::time::Duration;

use modalcast::config::{Config, RendererChoice};
use modalcast_model::load::SceneRepository;
use modalcast_proto::v1;
use prost::Message as _;
use tonic::{Code, Status, Streaming};
use v1::Reason;

use crate::service_harness::{
    MAX_MESSAGE_BYTES, Server, exact_step, minimum_step, rejection_details, step, with_timeout,
};

async fn start_server() -> Server {
    let server = Server::start_with(|config| Config { renderer: RendererChoice::Auto, ..config }).await;
    server.open("strips").await;
    server
}

fn picture_of_size(width: u32, height: u32, format: v1::Format) -> Vec<v1::Picture> {
    vec![v1::Picture { width, height, format: format.into(), ..v1::Picture::default() }]
}

fn rgba_request() -> v1::RenderFrameRequest {
    let pictures = picture_of_size(64, 48, v1::Format::Rgba);
    v1::RenderFrameRequest { scene: "strips".into(), pictures, ..v1::RenderFrameRequest::default() }
}

/// A frame joined from its chunks.
struct Frame {
    head: v1::FrameHead,
    bytes: Vec<u8>,
}

async fn render(server: &Server, request: v1::RenderFrameRequest) -> Result<Frame, Status> {
    let mut stream = with_timeout(server.frames().await.render_frame(request)).await?.into_inner();
    let mut head = None;
    let mut bytes = Vec::new();
    while let Some(response) = with_timeout(stream.message()).await? {
        assert!(response.encoded_len() <= MAX_MESSAGE_BYTES);
        let Some(v1::render_frame_response::Part::Chunk(chunk)) = response.part else { panic!("expected a chunk") };
        assert_eq!(chunk.offset, bytes.len() as u64);
        head = head.or(chunk.head);
        bytes.extend_from_slice(&chunk.data);
    }
    let head = head.expect("expected a head");
    assert_eq!(head.total, bytes.len() as u64);
    Ok(Frame { head, bytes })
}

/// Reads the chunks of the next frame and returns its head; `None` at the end of the stream. Skips the settings.
async fn next_head(stream: &mut Streaming<v1::StreamFramesResponse>) -> Option<v1::FrameHead> {
    let mut head: Option<v1::FrameHead> = None;
    let mut received_bytes = 0;
    while let Some(response) = with_timeout(stream.message()).await.expect("expected another message") {
        let Some(v1::stream_frames_response::Part::Chunk(chunk)) = response.part else { continue };
        received_bytes += chunk.data.len() as u64;
        head = head.or(chunk.head);
        if head.as_ref().is_some_and(|head| head.total == received_bytes) {
            return head;
        }
    }
    None
}

/// With q = -8, the fourth vertex of the left strip moves from y = 1 to 1 - 8 * 0.5 = -3. The ground is at y = 0.
#[tokio::test(flavor = "multi_thread")]
async fn color_frame_names_its_look_and_vertices_below_ground() {
    let server = start_server().await;
    let mut writer = server.drive_lossless("strips").await;
    let rest_head = render(&server, rgba_request()).await.expect("expected a frame at rest").head;
    // The settings of the scene, which leave nothing to a preset.
    let look = v1::FrameLook {
        preset: v1::LookPreset::Unspecified.into(),
        antialiasing: v1::Antialiasing::Samples.into(),
        samples: 4,
        shadow_method: v1::ShadowMethod::Variance.into(),
        shadow_size: 128,
    };
    assert_eq!((rest_head.look, rest_head.below_ground), (Some(look), 0.0));
    writer.send_step_and_wait(step(1, &[], &[-8.0, 0.0, 0.0, 0.0])).await;
    let head = render(&server, rgba_request()).await.expect("expected a frame").head;
    assert!((head.below_ground - 3.0).abs() < 1e-6, "expected 3 m below the ground, got {} m", head.below_ground);
    writer.send_step_and_wait(step(2, &[], &[0.0; 4])).await;
    assert_eq!(render(&server, rgba_request()).await.expect("expected a frame").head.below_ground, 0.0);
    let mut pictures = picture_of_size(64, 48, v1::Format::Unspecified);
    pictures[0].output = v1::Output::Depth.into();
    let depth_head = render(&server, v1::RenderFrameRequest { pictures, ..rgba_request() }).await;
    assert_eq!(depth_head.expect("expected depth").head.look, None);
}

/// A stream of one picture, which sends its first frame after the next step.
async fn stream_picture(server: &Server, scene: &str, picture: v1::Picture) -> Streaming<v1::StreamFramesResponse> {
    let (scene, pictures, delivery) = (scene.into(), vec![picture], v1::Delivery::Latest.into());
    let request = v1::StreamFramesRequest { scene, pictures, delivery, ..Default::default() };
    with_timeout(server.frames().await.stream_frames(request)).await.expect("expected a subscription").into_inner()
}

/// Above 320 x 240 pixels, the rule draws one sample per pixel on a CPU. Single frames have four, unless the scene
/// names a preset or the request sets the samples.
#[tokio::test(flavor = "multi_thread")]
async fn single_frames_are_antialiased_by_default() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).expect("expected a file");
    write("plain.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n");
    std::fs::create_dir(folder.path().join("preview")).expect("expected a folder");
    write("preview/plain.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n");
    write("preview/scene.toml", "model = 'plain.obj'\nlook = 'preview'\n");
    let state = tempfile::tempdir().expect("expected a temporary folder");
    let config = Config { renderer: RendererChoice::Software, ..crate::service_harness::config(state.path()) };
    let repository = SceneRepository::new(Some(folder.path())).expect("expected a repository");
    let server = Server::start_from(config, std::sync::Arc::new(repository)).await;
    let picture = |samples| v1::Picture { samples, ..picture_of_size(400, 300, v1::Format::Rgba).remove(0) };
    let samples = |head: v1::FrameHead| head.look.expect("expected a look").samples;
    for (source, single_samples) in [("plain.obj", 4), ("preview", 1)] {
        let scene = &server.open(source).await.scene;
        let mut writer = server.drive_lossless(scene).await;
        let cases = [(0, single_samples, 1), (1, 1, 1), (4, 4, 4)];
        for (number, (requested, single, streamed)) in (1..).zip(cases) {
            let request =
                |picture| v1::RenderFrameRequest { scene: scene.into(), pictures: vec![picture], ..Default::default() };
            let frame = render(&server, request(picture(requested))).await.expect("expected a frame");
            assert_eq!(samples(frame.head), single, "{scene}, {requested} requested");
            let repeated = render(&server, request(picture(requested))).await.expect("expected a frame");
            assert!(repeated.bytes == frame.bytes, "expected equal pictures of {scene}");
            let mut stream = stream_picture(&server, scene, picture(requested)).await;
            writer.send_step_and_wait(step(number, &[], &[])).await;
            let head = next_head(&mut stream).await.expect("expected a frame");
            assert_eq!(samples(head), streamed, "stream of {scene}, {requested} requested");
        }
    }
    for (samples, output) in [(2, v1::Output::Color), (8, v1::Output::Color), (4, v1::Output::Depth)] {
        let picture = v1::Picture { output: output.into(), format: 0, ..picture(samples) };
        let request = v1::RenderFrameRequest { scene: "preview".into(), pictures: vec![picture], ..Default::default() };
        let status = render(&server, request).await.err().expect("expected a rejection");
        assert_eq!(rejection_details(&status).field, "pictures[0].samples");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn frame_names_its_step_and_png_equals_rgba() {
    let server = start_server().await;
    let mut writer = server.drive_lossless("strips").await;
    // The frame is of run 0, because no writer has sent a step. The first writer starts run 1.
    let rest_frame = render(&server, rgba_request()).await.expect("expected a frame at rest");
    assert_eq!(rest_frame.head.step.map(|step| step.run), Some(0));
    writer.send_step_and_wait(step(5, &[], &[0.9, 0.3, -0.9, 0.2])).await;
    let rgba_frame = render(&server, v1::RenderFrameRequest { step: exact_step(5), ..rgba_request() }).await;
    let rgba_frame = rgba_frame.expect("expected a frame");
    // `step` sets the time to half of the number.
    assert_eq!(rgba_frame.head.step, Some(v1::StepId { run: 1, number: 5, time: 2.5 }));
    assert_eq!((rgba_frame.head.width, rgba_frame.head.height, rgba_frame.bytes.len()), (64, 48, 64 * 48 * 4));
    assert_ne!(rgba_frame.bytes, rest_frame.bytes, "expected another image than at rest");
    let png_request = v1::RenderFrameRequest { pictures: picture_of_size(64, 48, v1::Format::Png), ..rgba_request() };
    let png_frame = render(&server, png_request).await.expect("expected a frame");
    let decoded_png = image::load_from_memory(&png_frame.bytes).expect("expected a PNG file").into_rgba8();
    assert_eq!(decoded_png.into_raw(), rgba_frame.bytes);
    let stages: Vec<&str> = png_frame.head.stages.iter().map(|stage| stage.stage.as_str()).collect();
    for stage in ["deform", "draw", "read", "encode"] {
        let count = stages.iter().filter(|other| **other == stage).count();
        assert_eq!(count, 1, "expected one time of stage {stage}, got {stages:?}");
    }
}

/// A raw frame of 6.4 MB reaches a client with default message limits. A request without a picture gets the default
/// size and format.
#[tokio::test(flavor = "multi_thread")]
async fn large_frame_is_chunked_for_default_client_limits() {
    let server = start_server().await;
    let large_request =
        v1::RenderFrameRequest { pictures: picture_of_size(1600, 1000, v1::Format::Rgba), ..rgba_request() };
    let frame = render(&server, large_request).await.expect("expected a frame");
    assert_eq!(frame.bytes.len(), 1600 * 1000 * 4);
    let default_request = v1::RenderFrameRequest { pictures: vec![], ..rgba_request() };
    let frame = render(&server, default_request).await.expect("expected a frame");
    assert_eq!((frame.head.width, frame.head.height, frame.head.format()), (1280, 720, v1::Format::Png));
}

/// A stream with `lossless` delivery has a frame of every step and ends after the requested number of frames. A stream
/// with `latest` delivery has frames of increasing steps, and each frame has the number of skipped steps.
#[tokio::test(flavor = "multi_thread")]
async fn lossless_frames_are_complete_and_latest_frames_increase() {
    let server = start_server().await;
    let stream_request = |delivery: v1::Delivery, steps| v1::StreamFramesRequest {
        scene: "strips".into(),
        pictures: picture_of_size(32, 32, v1::Format::Png),
        delivery: delivery.into(),
        steps,
        max_hz: 0.0,
    };
    let mut client = server.frames().await;
    let lossless =
        client.stream_frames(stream_request(v1::Delivery::Lossless, 12)).await.expect("expected a subscription");
    // 0 steps mean an endless stream.
    let latest = client.stream_frames(stream_request(v1::Delivery::Latest, 0)).await.expect("expected a subscription");
    let (mut lossless, mut latest) = (lossless.into_inner(), latest.into_inner());
    let mut writer = server.drive("strips", v1::Delivery::Lossless, 3).await;
    let send_steps = async {
        for number in 1..=12 {
            writer.send_step_and_wait(step(number, &[0], &[0.1 * number as f32, 0.0])).await;
        }
    };
    let read_lossless = async {
        for number in 1..=12 {
            let head = next_head(&mut lossless).await.expect("expected a frame");
            assert_eq!((head.step.map(|step| step.number), head.skipped), (Some(number), 0));
        }
        assert!(next_head(&mut lossless).await.is_none(), "expected the stream to end after 12 frames");
    };
    let read_latest = async {
        let mut last_number = 0;
        let mut counted_steps = 0;
        while last_number < 12 {
            let head = next_head(&mut latest).await.expect("expected a frame");
            let number = head.step.expect("expected a step in the head").number;
            assert!(number > last_number);
            counted_steps += 1 + head.skipped;
            assert_eq!(counted_steps, number, "expected each step to be received or counted as skipped");
            last_number = number;
        }
    };
    tokio::join!(send_steps, read_lossless, read_latest);
}

/// The look of the scene has no lines along mesh edges.
#[tokio::test(flavor = "multi_thread")]
async fn edge_width_of_a_picture_draws_lines_for_this_picture_only() {
    let server = start_server().await;
    let request = |edge_width: Option<f32>, output: v1::Output| {
        let mut request = rgba_request();
        request.pictures[0].edge_width = edge_width;
        (request.pictures[0].output, request.pictures[0].format) = (output.into(), v1::Format::Unspecified.into());
        request
    };
    let color = v1::Output::Color;
    let plain = render(&server, request(None, color)).await.expect("expected a frame").bytes;
    let lines = render(&server, request(Some(2.0), color)).await.expect("expected a frame").bytes;
    assert!(lines != plain, "expected lines");
    let mut request_of_both = request(Some(2.0), color);
    request_of_both.pictures.push(request(Some(0.0), color).pictures.remove(0));
    let mut stream = with_timeout(server.frames().await.render_frame(request_of_both)).await.expect("expected frames");
    let mut received: Vec<Vec<u8>> = Vec::new();
    while let Some(response) = with_timeout(stream.get_mut().message()).await.expect("expected a message") {
        let Some(v1::render_frame_response::Part::Chunk(chunk)) = response.part else { panic!("expected a chunk") };
        match chunk.head {
            Some(_) => received.push(chunk.data.to_vec()),
            None => received.last_mut().expect("expected a head").extend_from_slice(&chunk.data),
        }
    }
    assert!(received == [lines, plain], "expected lines in the first picture only");
    for (edge_width, output) in
        [(-1.0, color), (32.5, color), (f32::NAN, color), (f32::INFINITY, color), (1.0, v1::Output::Depth)]
    {
        let status = render(&server, request(Some(edge_width), output)).await.err().expect("expected a rejection");
        assert_eq!(
            (status.code(), &rejection_details(&status).field[..]),
            (Code::InvalidArgument, "pictures[0].edge_width")
        );
    }
    render(&server, request(Some(0.0), v1::Output::Depth)).await.expect("expected depth");
}

#[tokio::test(flavor = "multi_thread")]
async fn invalid_pictures_and_missed_deadlines_are_errors() {
    let server = start_server().await;
    let camera_at = |eye: Vec<f64>, up: Vec<f64>| v1::Camera {
        view: Some(v1::camera::View::LookAt(v1::LookAt { eye, target: vec![0.0; 3], up })),
        ..v1::Camera::default()
    };
    let camera_with_lens = |lens| v1::Camera { lens: Some(lens), ..v1::Camera::default() };
    let y_axis = || vec![0.0, 1.0, 0.0];
    let two_numbers = vec![0.0; 2];
    let nan_eye = vec![f64::NAN, 0.0, 1.0];
    let eye_at_target = vec![0.0; 3];
    let eye_along_up = vec![0.0, 2.0, 0.0];
    // Invalid cameras, and the beginning of the field in the rejection.
    let cameras: Vec<(v1::Camera, &str)> = vec![
        (camera_at(two_numbers, y_axis()), "pictures[0].camera.look_at.eye"),
        (camera_at(nan_eye, y_axis()), "pictures[0].camera.look_at"),
        (camera_at(eye_at_target, y_axis()), "pictures[0].camera.look_at"),
        (camera_at(eye_along_up, y_axis()), "pictures[0].camera.look_at"),
        (camera_with_lens(v1::camera::Lens::FieldOfView(180.0)), "pictures[0].camera.field_of_view"),
        (camera_with_lens(v1::camera::Lens::Intrinsics(v1::Intrinsics::default())), "pictures[0].camera.intrinsics"),
        (v1::Camera { near: 2.0, far: 1.0, ..v1::Camera::default() }, "pictures[0].camera.near"),
        (v1::Camera { near: f64::NAN, ..v1::Camera::default() }, "pictures[0].camera.near"),
        (
            v1::Camera {
                view: Some(v1::camera::View::Pose(v1::Pose { world_from_camera: vec![0.0; 12] })),
                ..v1::Camera::default()
            },
            "pictures[0].camera.pose",
        ),
    ];
    for (camera, field) in cameras {
        let mut invalid_request = rgba_request();
        invalid_request.pictures[0].camera = Some(camera);
        let status = render(&server, invalid_request).await.err().expect(field);
        assert_eq!(status.code(), Code::InvalidArgument, "{status:?}");
        assert!(rejection_details(&status).field.starts_with(field), "expected {field}, got {status:?}");
    }
    for (width, height) in [(0, 48), (48, 0), (1_000_000, 48), (48, u32::MAX)] {
        let invalid_request =
            v1::RenderFrameRequest { pictures: picture_of_size(width, height, v1::Format::Png), ..rgba_request() };
        let status = render(&server, invalid_request).await.err().expect("expected an invalid-size error");
        assert_eq!(
            (status.code(), rejection_details(&status).field.as_str()),
            (Code::InvalidArgument, "pictures[0].width")
        );
        assert_eq!(rejection_details(&status).given, format!("{width} x {height}"));
    }
    // The next two requests wait for a step that is never sent. The first has its deadline in the message, the second
    // in the gRPC header `grpc-timeout`.
    let unanswered_request = v1::RenderFrameRequest { step: minimum_step(1), deadline_ms: 60, ..rgba_request() };
    assert_eq!(
        render(&server, unanswered_request).await.err().map(|status| status.code()),
        Some(Code::DeadlineExceeded)
    );
    let mut request_with_header =
        tonic::Request::new(v1::RenderFrameRequest { step: minimum_step(1), ..rgba_request() });
    // 60 milliseconds.
    request_with_header.metadata_mut().insert("grpc-timeout", "60m".parse().expect("expected a header value"));
    let result = async {
        let mut stream = server.frames().await.render_frame(request_with_header).await?.into_inner();
        stream.message().await
    };
    assert_eq!(with_timeout(result).await.err().map(|status| status.code()), Some(Code::DeadlineExceeded));
}

/// A connection has a limit on the pixels of its streams and of its single frames. Streams above it are rejected, and
/// single frames wait.
#[tokio::test(flavor = "multi_thread")]
async fn pixels_of_a_connection_are_limited() {
    let limits =
        |config| Config { renderer: RendererChoice::Auto, frame_side: 64, connection_pixels: 64 * 64, ..config };
    let server = Server::start_with(limits).await;
    server.open("strips").await;
    let client = server.frames().await;
    let subscribe = async |width, height| {
        let pictures = picture_of_size(width, height, v1::Format::Rgba);
        let delivery = v1::Delivery::Latest.into();
        let request = v1::StreamFramesRequest { scene: "strips".into(), pictures, delivery, ..Default::default() };
        with_timeout(client.clone().stream_frames(request)).await.map(tonic::Response::into_inner)
    };
    let half = subscribe(64, 32).await.expect("expected a stream");
    let status = subscribe(64, 33).await.expect_err("expected a rejection");
    assert_eq!((status.code(), rejection_details(&status).reason()), (Code::ResourceExhausted, Reason::LimitReached));
    assert!(status.message().contains("4096"), "{status:?}");
    drop(half);
    while let Err(status) = subscribe(64, 64).await {
        assert_eq!(status.code(), Code::ResourceExhausted);
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    let mut frames = tokio::task::JoinSet::new();
    for _ in 0..10 {
        let pictures = picture_of_size(64, 64, v1::Format::Rgba);
        let mut client = client.clone();
        frames.spawn(async move {
            let mut reply =
                client.render_frame(v1::RenderFrameRequest { pictures, ..rgba_request() }).await?.into_inner();
            while reply.message().await?.is_some() {}
            Ok::<_, Status>(())
        });
    }
    while let Some(frame) = with_timeout(frames.join_next()).await {
        frame.expect("expected no panic").expect("expected a frame");
    }
}
