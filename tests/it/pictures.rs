//! Requests and streams of several pictures of one step. These tests need an EGL driver that can render.

use modalcast::config::{Config, RendererChoice};
use modalcast_client::{
    Camera, Client, Delivery, Error, FrameFormat, FrameRequest, FrameStreamRequest, FramesRequest, Lens, Output,
    Picture, View,
};

use crate::service_harness::{Server, step, with_timeout};

async fn start_server() -> (Server, Client) {
    let server = Server::start_with(|config| Config { renderer: RendererChoice::Auto, ..config }).await;
    server.open("strips").await;
    let client = Client::connect(&server.address).await.expect("expected a connection");
    (server, client)
}

/// A camera in front of the strips at a height.
fn camera(height: f64) -> Option<Camera> {
    let view = View::LookAt { eye: [0.5, height, 4.0], target: [0.5, 0.5, 0.0], up: Some([0.0, 1.0, 0.0]) };
    Some(Camera { view, lens: Lens::FieldOfView(40.0), clip: None })
}

/// Pictures of several cameras and of all kinds of outputs. The first two and the last two differ only in their format.
fn pictures() -> Vec<Picture> {
    let color = Picture { camera: camera(0.5), ..Picture::default() }.size(48, 32);
    let raw_color = color.format(FrameFormat::Rgba);
    let output = |output| Picture { output, ..color };
    vec![
        color,
        raw_color,
        Picture { camera: camera(1.5), ..raw_color },
        output(Output::Depth),
        output(Output::DepthWithGround),
        output(Output::Domains),
        output(Output::Normals).size(40, 40),
        output(Output::Displacement { scale_max: 0.0 }),
        Picture { camera: camera(-0.5), ..raw_color },
        Picture { camera: camera(-0.5), ..color.format(FrameFormat::Rgb) },
    ]
}

#[tokio::test(flavor = "multi_thread")]
async fn pictures_of_one_request_equal_single_requests() {
    let (server, client) = start_server().await;
    server.drive_lossless("strips").await.send_step_and_wait(step(3, &[0, 1], &[0.2, -0.1, 0.15, 0.3])).await;
    let request = FramesRequest::new("strips", pictures()).minimum_step(3);
    let frames = client.render_frames(&request).await.expect("expected frames");
    assert_eq!(frames.len(), pictures().len());
    for (index, (frame, picture)) in frames.iter().zip(pictures()).enumerate() {
        let single_frame = client.render_frame(&FrameRequest::new("strips", picture)).await.expect("expected a frame");
        assert_eq!((frame.picture, frame.step, single_frame.step.number), (index, single_frame.step, 3));
        assert!(frame.format == single_frame.format && frame.bytes == single_frame.bytes, "picture {index}");
        let is_unique = frames[..index].iter().all(|earlier| earlier.bytes != frame.bytes);
        assert!(is_unique, "negative control: expected different bytes of picture {index}");
    }
    let [.., rgba, rgb] = frames.as_slice() else { panic!("expected several frames") };
    let colors: Vec<u8> = rgba.bytes.as_chunks::<4>().0.iter().flat_map(|pixel| pixel[..3].to_vec()).collect();
    assert!(rgb.bytes == colors, "expected the colors of the same picture");
    let default_frames = client.render_frames(&FramesRequest::new("strips", vec![])).await.expect("expected a frame");
    assert_eq!((default_frames.len(), default_frames[0].width), (1, 1280));
}

/// The steps are sent without a wait, so the server computes steps while frames are in flight.
#[tokio::test(flavor = "multi_thread")]
async fn pictures_of_a_step_arrive_in_order_and_match_requests() {
    let (server, client) = start_server().await;
    let (steps, pictures) = (12, pictures());
    let request = FrameStreamRequest::new("strips", pictures.clone()).max_steps(steps);
    let mut frames = client.stream_frames(&request).await.expect("expected a subscription");
    let request = FrameStreamRequest::new("strips", pictures[2]).max_steps(steps);
    let mut single_frames = client.stream_frames(&request).await.expect("expected a subscription");
    let writer = server.drive_lossless("strips").await;
    for number in 1..=steps {
        writer.send_step(step(number, &[0, 1], &[0.02 * number as f32, -0.1, 0.15, 0.3])).await;
    }
    let mut last_frames = Vec::new();
    for number in 1..=steps {
        let single_frame = with_timeout(single_frames.next()).await.expect("a frame").expect("a valid frame");
        last_frames.clear();
        for index in 0..pictures.len() {
            let frame = with_timeout(frames.next()).await.expect("expected another frame").expect("a valid frame");
            assert_eq!((frame.step.number, frame.picture, frame.skipped), (number, index, 0));
            last_frames.push(frame);
        }
        assert_eq!((single_frame.step.number, &single_frame.bytes), (number, &last_frames[2].bytes));
        assert_ne!(single_frame.bytes, last_frames[1].bytes, "control: expected another image of another camera");
    }
    assert!(with_timeout(frames.next()).await.is_none(), "expected the end of the stream");
    let current_frames = client.render_frames(&FramesRequest::new("strips", pictures)).await.expect("expected frames");
    assert!(current_frames.iter().map(|frame| &frame.bytes).eq(last_frames.iter().map(|frame| &frame.bytes)));
    drop(writer);
}

/// A stream of the latest steps counts skipped steps once per step.
#[tokio::test(flavor = "multi_thread")]
async fn skipped_steps_are_counted_by_the_first_picture() {
    let (server, client) = start_server().await;
    let (steps, pictures) = (30, vec![Picture::default().size(16, 16); 3]);
    let request = FrameStreamRequest::new("strips", pictures).delivery(Delivery::Latest);
    let mut frames = client.stream_frames(&request).await.expect("expected a subscription");
    let mut writer = server.drive_lossless("strips").await;
    let send_steps = async {
        for number in 1..=steps {
            writer.send_step_and_wait(step(number, &[0], &[0.01 * number as f32, 0.0])).await;
        }
    };
    let receive_frames = async {
        let (mut counted_steps, mut last_step) = (0, 0);
        while last_step < steps {
            for index in 0..3 {
                let frame = with_timeout(frames.next()).await.expect("expected another frame").expect("a valid frame");
                counted_steps += if index == 0 { 1 } else { 0 } + frame.skipped;
                assert_eq!((frame.picture, counted_steps), (index, frame.step.number));
                last_step = frame.step.number;
            }
        }
    };
    tokio::join!(send_steps, receive_frames);
}

/// Mean difference of the color channels of two images, 0 to 255.
fn mean_error(image: &[u8], other: &[u8]) -> f64 {
    let decode = |bytes| image::load_from_memory(bytes).expect("expected a decodable image").into_rgb8().into_raw();
    let (image, other) = (decode(image), decode(other));
    assert_eq!(image.len(), other.len());
    image.iter().zip(&other).map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / image.len() as f64
}

#[tokio::test(flavor = "multi_thread")]
async fn jpeg_error_is_small_and_decreases_with_quality() {
    let (_server, client) = start_server().await;
    let color = Picture { camera: camera(0.5), ..Picture::default() }.size(160, 120);
    for output in [Output::Color, Output::ModeShape { mode: 1, scale_max: 0.0 }] {
        let png = Picture { output, ..color };
        let jpeg = |jpeg_quality| Picture { jpeg_quality, ..png.format(FrameFormat::Jpeg) };
        let request = FramesRequest::new("strips", vec![png, jpeg(100), jpeg(0), jpeg(90), jpeg(5)]);
        let frames = client.render_frames(&request).await.expect("expected frames");
        assert!(frames[1..].iter().all(|frame| frame.format == FrameFormat::Jpeg));
        assert_eq!(frames[2].bytes, frames[3].bytes, "expected quality 0 to select the default, 90");
        let errors = [1, 3, 4].map(|index: usize| mean_error(&frames[index].bytes, &frames[0].bytes));
        assert!(errors[1] < 2.0, "{output:?}: {errors:?}");
        assert!(errors.is_sorted_by(|a, b| a < b), "expected larger errors at lower quality: {output:?}, {errors:?}");
        assert!(frames[4].bytes.len() < frames[1].bytes.len());
        let other_picture = Picture { camera: camera(2.5), ..png };
        let other_frame = client.render_frame(&FrameRequest::new("strips", other_picture)).await;
        let other_frame = other_frame.expect("expected a frame");
        let control = mean_error(&frames[3].bytes, &other_frame.bytes);
        assert!(control > 2.0, "negative control: {control} against another camera");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn invalid_lists_of_pictures_are_rejected() {
    let (_server, client) = start_server().await;
    let small = Picture::default().size(8, 8);
    let render = async |pictures| client.render_frames(&FramesRequest::new("strips", pictures)).await;
    assert_eq!(render(vec![small; 16]).await.expect("control: expected 16 frames").len(), 16);
    let max_side = client.server_info().await.expect("expected the server's limits").limits.frame_side;
    let large = Picture::default().size(max_side, max_side);
    let missing_mode = Picture { output: Output::ModeShape { mode: 9, scale_max: 0.0 }, ..small };
    for (pictures, field) in [
        (vec![small; 17], "pictures"),
        (vec![small, large], "pictures"),
        (vec![small, small.format(FrameFormat::F32)], "pictures[1].format"),
        (vec![small, missing_mode], "pictures[1].mode"),
        (vec![small.size(8, 0)], "pictures[0].width"),
        (vec![Picture { jpeg_quality: 101, ..small.format(FrameFormat::Jpeg) }], "pictures[0].jpeg_quality"),
    ] {
        let error: Error = render(pictures).await.expect_err(field);
        assert_eq!(error.rejection().expect("expected a rejection").field, field);
    }
}
