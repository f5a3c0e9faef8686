//! Frame streams while later steps are computed. Each frame shows the step that it names. Frames and acknowledgments
//! keep the order of the steps.

use std::sync::Arc;

use modalcast::admission::Account;
use modalcast::config::{BackendChoice, Config, RendererChoice};
use modalcast::engine::{
    Delivery, DeviceContext, FrameOutput, OutputBody, OutputSpec, PictureSpec, Pixels, StepFrames, StepOutput,
};
use modalcast::identity::Principal;
use modalcast_model::backend_settings::BackendSettings;
use modalcast_model::scene::{Camera, CameraSource, FrameSize, FrameStyle, Lens};
use modalcast_proto::v1;
use v1::drive_scene_response::Kind as ResponseKind;

use crate::service_harness::{Server, state_after_steps, step, strips_with_attributes, with_timeout};

const SIZE: FrameSize = FrameSize::new(48, 32);
/// Number of steps that a test sends.
const STEPS: u64 = 30;
/// Number of the step that is rejected because it moves vertices out of range.
const REJECTED_STEP: u64 = 13;

/// Cameras at the same place with different fields of view.
fn cameras(count: usize) -> Vec<Camera> {
    let fitted_camera = Camera::fit_to_scene(&strips_with_attributes(), SIZE.width, SIZE.height);
    (0..count).map(|index| Camera { lens: Lens::FieldOfView(30.0 + 4.0 * index as f64), ..fitted_camera }).collect()
}

fn frame_output(camera: Camera) -> OutputSpec {
    OutputSpec::Frames(
        [PictureSpec {
            camera: CameraSource::Fixed(camera),
            size: SIZE,
            output: FrameOutput::Color,
            style: FrameStyle::default(),
        }]
        .into(),
    )
}

/// Every step sets both coordinates of domain 1; the value of the first coordinate differs per step.
fn steps() -> Vec<v1::Step> {
    let q = |number: u64| if number == REJECTED_STEP { 1e30 } else { 0.03 * number as f32 };
    (0..STEPS).map(|number| step(number, &[1], &[q(number), 0.5])).collect()
}

/// The images of one step, one per camera.
struct StepImages {
    step: u64,
    images: Vec<Vec<u8>>,
}

/// Images of every valid step, each rendered before the next step is computed. A step sets all coordinates that differ
/// from rest, so its state does not depend on earlier steps.
fn reference_images(cameras: &[Camera]) -> Vec<StepImages> {
    let (scene, steps) = (strips_with_attributes(), steps());
    let config = Config { backend: BackendChoice::Cpu, ..Config::default() };
    let mut context = DeviceContext::open(&config).expect("expected a device context");
    let mut loaded_scene = context.load_scene(&scene, BackendSettings::default()).expect("expected the scene to load");
    let mut steps_with_images = Vec::new();
    for step in steps.iter().filter(|step| step.number != REJECTED_STEP) {
        loaded_scene
            .deform(&state_after_steps(&scene, std::slice::from_ref(step)))
            .expect("expected the step to succeed");
        let mut draw = |camera: &Camera| context.draw(&mut loaded_scene, camera, SIZE).expect("expected a frame").rgba;
        steps_with_images.push(StepImages { step: step.number, images: cameras.iter().map(&mut draw).collect() });
    }
    context.unload_scene(loaded_scene);
    steps_with_images
}

/// Waits for the first picture of an output.
async fn frame_bytes(output: &StepOutput) -> Vec<u8> {
    let OutputBody::Frames(frames) = &output.body else { panic!("expected frames") };
    let picture = with_timeout(frames.pictures[0].wait()).await.expect("expected a picture");
    let Pixels::Color(rgba) = &picture.pixels else { panic!("expected a color picture") };
    rgba.to_vec()
}

async fn start_server() -> Server {
    let server =
        Server::start_with(|config| Config { backend: BackendChoice::Cpu, renderer: RendererChoice::Auto, ..config })
            .await;
    server.open("attributes").await;
    server
}

/// There are more cameras than frames that can be in flight. Every frame shows the step that it names, and replies keep
/// the order of the steps.
#[tokio::test(flavor = "multi_thread")]
async fn frames_of_many_cameras_show_their_own_step() {
    let (server, cameras) = (start_server().await, cameras(5));
    let scene_handle = server.engine.find("attributes").expect("expected an open scene");
    let mut subscriptions = Vec::new();
    for camera in &cameras {
        subscriptions.push(
            scene_handle
                .subscribe(&Account::server(), frame_output(*camera), Delivery::Lossless)
                .await
                .expect("expected a subscription"),
        );
    }
    let positions = modalcast_model::deform::VertexAttributes { positions: true, ..Default::default() };
    let mut vertex_subscription = scene_handle
        .subscribe(&Account::server(), OutputSpec::Vertices(positions), Delivery::Lossless)
        .await
        .expect("expected a subscription");
    // One subscription is dropped at step 8, and one is never read.
    let mut dropped_subscription = Some(
        scene_handle
            .subscribe(&Account::server(), frame_output(cameras[0]), Delivery::Lossless)
            .await
            .expect("expected a subscription"),
    );
    let _unread_subscription = scene_handle
        .subscribe(&Account::server(), frame_output(cameras[0]), Delivery::Latest)
        .await
        .expect("expected a subscription");
    let mut writer = server.drive("attributes", v1::Delivery::Lossless, 40).await;
    for step in steps() {
        writer.send_step(step).await;
    }
    let expected_images = reference_images(&cameras);
    for StepImages { step: number, images } in &expected_images {
        if *number == 8 {
            dropped_subscription = None;
        }
        if let Some(subscription) = &mut dropped_subscription {
            assert_eq!(with_timeout(subscription.next()).await.expect("expected another message").step.number, *number);
        }
        for (subscription, image) in subscriptions.iter_mut().zip(images) {
            let output = with_timeout(subscription.next()).await.expect("expected another message");
            assert_eq!((output.step.number, output.skipped), (*number, 0));
            assert!(frame_bytes(&output).await == *image, "step {number}");
        }
        assert_eq!(
            with_timeout(vertex_subscription.next()).await.expect("expected another message").step.number,
            *number
        );
    }
    for number in 0..STEPS {
        match writer.receive_reply().await {
            ResponseKind::Ack(ack) => assert!(ack.step == number && number != REJECTED_STEP, "{ack:?}"),
            ResponseKind::Rejection(_) => {
                assert_eq!(number, REJECTED_STEP, "expected a rejection of step {REJECTED_STEP} only")
            }
            kind => panic!("expected an acknowledgment or a rejection, got {kind:?}"),
        }
    }
    assert!(
        expected_images[0].images[0] != expected_images[1].images[0]
            && expected_images[0].images[0] != expected_images[0].images[1],
        "negative control: expected other images of other steps and cameras"
    );
    writer.finish().await;
}

/// Each output of a subscription to several cameras has one image per camera, all of the step that it names. Another
/// subscription to one of the cameras shares its images.
#[tokio::test(flavor = "multi_thread")]
async fn pictures_of_one_subscription_show_the_same_step() {
    let (server, cameras) = (start_server().await, cameras(5));
    let scene_handle = server.engine.find("attributes").expect("expected an open scene");
    let color = |camera: &Camera| PictureSpec {
        camera: CameraSource::Fixed(*camera),
        size: SIZE,
        output: FrameOutput::Color,
        style: FrameStyle::default(),
    };
    let depth = PictureSpec { output: FrameOutput::Depth, ..color(&cameras[0]) };
    let pictures = cameras.iter().map(color).chain([depth]).collect();
    let subscribe = async |spec| {
        scene_handle.subscribe(&Account::server(), spec, Delivery::Lossless).await.expect("expected a subscription")
    };
    let mut all_cameras = subscribe(OutputSpec::Frames(pictures)).await;
    let mut last_camera = subscribe(frame_output(cameras[4])).await;
    let mut writer = server.drive("attributes", v1::Delivery::Lossless, 40).await;
    for step in steps() {
        writer.send_step(step).await;
    }
    for StepImages { step: number, images } in reference_images(&cameras) {
        let output = with_timeout(all_cameras.next()).await.expect("expected another output");
        assert_eq!((output.step.number, output.skipped), (number, 0));
        let OutputBody::Frames(StepFrames { pictures, .. }) = output.body else { panic!("expected frames") };
        assert_eq!(pictures.len(), 6);
        for (picture, image) in pictures.iter().zip(&images) {
            let picture = with_timeout(picture.wait()).await.expect("expected a picture");
            let Pixels::Color(rgba) = &picture.pixels else { panic!("expected a color picture") };
            assert!(rgba == image, "step {number}");
        }
        let depth = with_timeout(pictures[5].wait()).await.expect("expected a picture");
        assert!(matches!(depth.pixels, Pixels::Values(_)));
        let output = with_timeout(last_camera.next()).await.expect("expected another output");
        let OutputBody::Frames(single) = output.body else { panic!("expected frames") };
        assert!(Arc::ptr_eq(&single.pictures[0], &pictures[4]), "expected one drawing of step {number}");
        assert!(!Arc::ptr_eq(&single.pictures[0], &pictures[3]), "control: expected others");
    }
    for _ in 0..STEPS {
        writer.receive_reply().await;
    }
    writer.finish().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn closing_a_scene_delivers_frames_in_flight() {
    let (server, cameras) = (start_server().await, cameras(2));
    let scene_handle = Arc::clone(&server.engine.find("attributes").expect("expected an open scene"));
    let mut subscription = scene_handle
        .subscribe(&Account::server(), frame_output(cameras[0]), Delivery::Lossless)
        .await
        .expect("expected a subscription");
    let writer = server.drive("attributes", v1::Delivery::Lossless, 40).await;
    for step in steps().into_iter().take(12) {
        writer.send_step(step).await;
    }
    let expected_images = reference_images(&cameras);
    let output = with_timeout(subscription.next()).await.expect("expected a frame");
    assert!(frame_bytes(&output).await == expected_images[0].images[0]);
    with_timeout(server.engine.close("attributes", &Principal::owner())).await.expect("expected the scene to close");
    // The subscription ends after the frames of some of the 12 steps. No frame is missing in between.
    let mut number = 1;
    while let Ok(output) = with_timeout(subscription.next()).await {
        assert_eq!(output.step.number, number);
        assert!(frame_bytes(&output).await == expected_images[number as usize].images[0]);
        number += 1;
    }
    assert!(number <= 12);
    server.stop().await.expect("expected the server to stop without an error");
}
