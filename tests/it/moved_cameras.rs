//! Frame streams whose cameras are moved while they run. These tests need an EGL driver that can render.

use modalcast::config::{Config, RendererChoice};
use modalcast_client::{
    Camera, Client, Code, Delivery, Frame, FrameFormat, FrameRequest, FrameStream, FrameStreamRequest, Lens, Picture,
    Reason, View,
};

use crate::service_harness::{Server, step, with_timeout};

async fn start_server() -> (Server, Client) {
    let server = Server::start_with(|config| Config { renderer: RendererChoice::Auto, ..config }).await;
    server.open("strips").await;
    let client = Client::connect(&server.address).await.expect("expected a connection");
    (server, client)
}

/// A camera in front of the strips at a height.
fn camera(height: f64) -> Camera {
    let view = View::LookAt { eye: [0.5, height, 4.0], target: [0.5, 0.5, 0.0], up: Some([0.0, 1.0, 0.0]) };
    Camera { view, lens: Lens::FieldOfView(40.0), clip: None }
}

fn picture(height: f64) -> Picture {
    Picture { camera: Some(camera(height)), ..Picture::default() }.size(40, 32).format(FrameFormat::Rgba)
}

async fn subscribe(client: &Client, delivery: Delivery, pictures: Vec<Picture>) -> FrameStream {
    let request = FrameStreamRequest::new("strips", pictures).delivery(delivery);
    client.stream_frames(&request).await.expect("expected a subscription")
}

async fn next_frame(frames: &mut FrameStream) -> Frame {
    with_timeout(frames.next()).await.expect("expected another frame").expect("expected a valid frame")
}

/// Moves the camera of the first picture to a height. Returns the camera version.
async fn move_camera(client: &Client, frames: &FrameStream, height: f64) -> u64 {
    let cameras = [(0, Some(camera(height)))];
    client.update_frame_stream(&frames.settings().stream, &cameras).await.expect("expected a moved camera")
}

async fn single_frame(client: &Client, height: f64) -> Frame {
    client.render_frame(&FrameRequest::new("strips", picture(height))).await.expect("expected a frame")
}

/// Step number, skipped steps and camera version of a frame.
fn identity(frame: &Frame) -> (u64, u64, u64) {
    (frame.step.number, frame.skipped, frame.camera_version)
}

#[tokio::test(flavor = "multi_thread")]
async fn moved_camera_redraws_a_static_scene() {
    let (server, client) = start_server().await;
    let mut writer = server.drive_lossless("strips").await;
    writer.send_step_and_wait(step(3, &[0, 1], &[0.2, -0.1, 0.15, 0.3])).await;
    for (delivery, next_step) in [(Delivery::Latest, 4), (Delivery::Lossless, 5)] {
        let mut frames = subscribe(&client, delivery, vec![picture(0.5)]).await;
        if delivery == Delivery::Latest {
            assert_eq!(identity(&next_frame(&mut frames).await), (next_step - 1, 0, 0));
        }
        let still_bytes = single_frame(&client, 0.5).await.bytes;
        for (version, height) in [(1, 1.5), (2, -0.5)] {
            assert_eq!(move_camera(&client, &frames, height).await, version);
            let frame = next_frame(&mut frames).await;
            assert_eq!(identity(&frame), (next_step - 1, 0, version), "{delivery:?}");
            assert_eq!(frame.bytes, single_frame(&client, height).await.bytes, "{delivery:?}");
            assert_ne!(frame.bytes, still_bytes, "control: expected another image than before the update");
        }
        writer.send_step_and_wait(step(next_step, &[0], &[0.05 * next_step as f32, 0.0])).await;
        let frame = next_frame(&mut frames).await;
        assert_eq!(identity(&frame), (next_step, 0, 2), "{delivery:?}");
        assert_eq!(frame.bytes, single_frame(&client, -0.5).await.bytes, "{delivery:?}");
    }
}

/// A stream that waits for the first step gets a frame of the rest state. Its run is 0, because no writer has sent a
/// step.
#[tokio::test(flavor = "multi_thread")]
async fn moved_camera_shows_the_rest_state_before_the_first_step() {
    let (_server, client) = start_server().await;
    let mut frames = subscribe(&client, Delivery::Lossless, vec![picture(0.5)]).await;
    move_camera(&client, &frames, 1.5).await;
    let frame = next_frame(&mut frames).await;
    assert_eq!((frame.step.run, identity(&frame)), (0, (0, 0, 1)));
    assert_eq!(frame.bytes, single_frame(&client, 1.5).await.bytes);
}

/// Two viewers share a camera until one of them moves its own. All pictures of the moved stream are sent again.
#[tokio::test(flavor = "multi_thread")]
async fn update_moves_one_picture_of_one_stream() {
    let (server, client) = start_server().await;
    let mut writer = server.drive_lossless("strips").await;
    let mut moved = subscribe(&client, Delivery::Lossless, vec![picture(0.5), picture(0.5)]).await;
    let mut still = subscribe(&client, Delivery::Lossless, vec![picture(0.5)]).await;
    assert_ne!(moved.settings().stream, still.settings().stream);
    move_camera(&client, &moved, 1.5).await;
    let redrawn = [next_frame(&mut moved).await, next_frame(&mut moved).await];
    assert_eq!(redrawn.each_ref().map(|frame| (frame.picture, frame.camera_version)), [(0, 1), (1, 1)]);
    writer.send_step_and_wait(step(1, &[0], &[0.2, 0.0])).await;
    let [first, second] = [next_frame(&mut moved).await, next_frame(&mut moved).await];
    let still_frame = next_frame(&mut still).await;
    assert_eq!([&first, &second, &still_frame].map(identity), [(1, 0, 1), (1, 0, 1), (1, 0, 0)]);
    assert_eq!(second.bytes, still_frame.bytes);
    assert_eq!(first.bytes, single_frame(&client, 1.5).await.bytes);
    assert_ne!(first.bytes, second.bytes);
}

#[tokio::test(flavor = "multi_thread")]
async fn updates_in_quick_succession_end_at_the_last_camera() {
    let (_server, client) = start_server().await;
    let mut frames = subscribe(&client, Delivery::Latest, vec![picture(0.5)]).await;
    let heights: Vec<f64> = (1..=40).map(|number| 0.5 + 0.05 * f64::from(number)).collect();
    for height in &heights {
        move_camera(&client, &frames, *height).await;
    }
    let (mut last_version, mut frame_count) = (0, 0);
    while last_version < 40 {
        let frame = next_frame(&mut frames).await;
        assert!(frame.camera_version > last_version, "expected increasing versions");
        (last_version, frame_count) = (frame.camera_version, frame_count + 1);
        let bytes = single_frame(&client, heights[last_version as usize - 1]).await.bytes;
        assert_eq!(frame.bytes, bytes, "expected the camera of update {last_version}");
    }
    assert!(frame_count <= 40);
}

#[tokio::test(flavor = "multi_thread")]
async fn invalid_updates_are_rejected() {
    let (_server, client) = start_server().await;
    let request = FrameStreamRequest::new("strips", vec![picture(0.5); 2]).max_steps(2);
    let mut frames = client.stream_frames(&request).await.expect("expected a subscription");
    let stream = frames.settings().stream.clone();
    let rejection = async |stream: &[u8], cameras: &[(u32, Option<Camera>)]| {
        let error = client.update_frame_stream(stream, cameras).await.expect_err("expected a rejection");
        error.rejection().expect("expected a rejection with details").clone()
    };
    let still = || Some(camera(0.5));
    let eye_at_target = View::LookAt { eye: [0.0; 3], target: [0.0; 3], up: Some([0.0, 1.0, 0.0]) };
    let invalid_camera = Some(Camera { view: eye_at_target, ..camera(0.5) });
    for (cameras, field) in [
        (vec![], "cameras"),
        (vec![(0, still()), (2, still())], "cameras[1].picture"),
        (vec![(1, still()), (1, still())], "cameras[1].picture"),
        (vec![(0, still()), (1, invalid_camera)], "cameras[1].camera.look_at"),
    ] {
        assert_eq!(rejection(&stream, &cameras).await.field, field);
    }
    assert_eq!(rejection(&stream[..15], &[(0, still())]).await.field, "stream");
    assert_eq!(rejection(&[7; 16], &[(0, still())]).await.reason, Reason::StreamNotFound);
    // The rejected updates have moved nothing: the first valid one has the version 1, and the fitted camera is valid.
    for version in 1..=2 {
        let cameras = [(0, still()), (1, None)];
        let updated = client.update_frame_stream(&stream, &cameras).await.expect("expected a running stream");
        assert_eq!(updated, version);
        for _ in 0..2 {
            assert_eq!(next_frame(&mut frames).await.camera_version, version);
        }
    }
    assert!(with_timeout(frames.next()).await.is_none(), "expected the end after two steps");
    let error = client.update_frame_stream(&stream, &[(0, still())]).await.expect_err("expected an ended stream");
    assert_eq!(error.rejection().expect("expected details").reason, Reason::StreamNotFound);
    assert!(matches!(error, modalcast_client::Error::Status { code: Code::NotFound, .. }));
}
