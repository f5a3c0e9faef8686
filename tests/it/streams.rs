//! Frames streamed while later steps are computed: each frame shows its own step, frames keep their order, and a step
//! is acknowledged after its frames.

use std::sync::Arc;

use modalcast::config::{BackendChoice, Config, RendererChoice};
use modalcast::engine::{Delivery, DeviceContext, FrameOutput, OutputBody, OutputSpec, StepOutput};
use modalcast_model::backend_settings::BackendSettings;
use modalcast_model::scene::{Camera, FrameSize, Lens};
use modalcast_proto::v1;
use v1::Policy;
use v1::drive_scene_response::Kind as ResponseKind;

use crate::service_harness::{Server, state_after_steps, step, strips_with_attributes, with_timeout};

const SIZE: FrameSize = FrameSize::new(48, 32);
const STEPS: u64 = 30;
/// Number of the step that is refused.
const BAD: u64 = 13;

fn cameras(count: usize) -> Vec<Camera> {
    let first = Camera::fit_to_scene(&strips_with_attributes(), SIZE.width, SIZE.height);
    (0..count).map(|at| Camera { lens: Lens::FieldOfView(30.0 + 4.0 * at as f64), ..first }).collect()
}

fn view(camera: Camera) -> OutputSpec {
    OutputSpec::Frame { camera, size: SIZE, frame_output: FrameOutput::Color }
}

fn steps() -> Vec<v1::Step> {
    let q = |number: u64| if number == BAD { 1e30 } else { 0.03 * number as f32 };
    (0..STEPS).map(|number| step(number, &[1], &[q(number), 0.5])).collect()
}

/// Reference pictures of every valid step, rendered one by one.
fn reference_vertices(cameras: &[Camera]) -> Vec<(u64, Vec<Vec<u8>>)> {
    let (scene, steps) = (strips_with_attributes(), steps());
    let config = Config { backend: BackendChoice::Cpu, ..Config::default() };
    let mut bench = DeviceContext::open(&config).expect("opens");
    let mut staged = bench.load_scene(&scene, BackendSettings::default()).expect("expected the scene to load");
    let mut pictures = Vec::new();
    for step in steps.iter().filter(|step| step.number != BAD) {
        staged.deform(&state_after_steps(&scene, std::slice::from_ref(step))).expect("expected the step to succeed");
        let mut draw = |camera: &Camera| bench.draw(&mut staged, camera, SIZE).expect("expected a frame").rgba;
        pictures.push((step.number, cameras.iter().map(&mut draw).collect()));
    }
    bench.unload_scene(staged);
    pictures
}

fn pixels(shown: &StepOutput) -> &[u8] {
    let OutputBody::Frame(image) = &shown.body else { panic!("no frame") };
    &image.rgba
}

async fn server() -> Server {
    let server =
        Server::start_with(|config| Config { backend: BackendChoice::Cpu, renderer: RendererChoice::Auto, ..config })
            .await;
    server.open("kept").await;
    server
}

/// More cameras than frames can be in flight: every frame is that of its step, and the steps are answered in order.
#[tokio::test(flavor = "multi_thread")]
async fn frames_of_many_cameras_show_their_own_step() {
    let (server, cameras) = (server().await, cameras(5));
    let host = server.engine.find("kept").expect("open");
    let mut feeds = Vec::new();
    for camera in &cameras {
        feeds.push(host.subscribe(view(*camera), Delivery::Lossless).await.expect("a feed"));
    }
    let positions = modalcast_model::deform::VertexAttributes { positions: true, ..Default::default() };
    let mut vertices = host.subscribe(OutputSpec::Vertices(positions), Delivery::Lossless).await.expect("a feed");
    // One feed is dropped halfway, and one is never read.
    let mut leaver = Some(host.subscribe(view(cameras[0]), Delivery::Lossless).await.expect("a feed"));
    let _idle = host.subscribe(view(cameras[0]), Delivery::Latest).await.expect("a feed");
    let mut driver = server.drive("kept", Policy::Lossless, 40).await;
    for step in steps() {
        driver.step(step).await;
    }
    let want = reference_vertices(&cameras);
    for (number, pictures) in &want {
        if *number == 8 {
            leaver = None;
        }
        if let Some(feed) = &mut leaver {
            assert_eq!(with_timeout(feed.next()).await.expect("expected another message").step.number, *number);
        }
        for (feed, picture) in feeds.iter_mut().zip(pictures) {
            let shown = with_timeout(feed.next()).await.expect("expected another message");
            assert_eq!((shown.step.number, shown.skipped), (*number, 0));
            assert!(pixels(&shown) == picture, "step {number}");
        }
        assert_eq!(with_timeout(vertices.next()).await.expect("expected another message").step.number, *number);
    }
    for number in 0..STEPS {
        match driver.reply().await {
            ResponseKind::Ack(ack) => assert!(ack.step == number && number != BAD, "{ack:?}"),
            ResponseKind::Rejection(_) => assert_eq!(number, BAD, "refused in its turn"),
            other => panic!("{other:?}"),
        }
    }
    assert!(want[0].1[0] != want[1].1[0] && want[0].1[0] != want[0].1[1], "negative control: steps and cameras differ");
    driver.finish().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn closing_a_scene_delivers_frames_in_flight() {
    let (server, cameras) = (server().await, cameras(2));
    let host = Arc::clone(&server.engine.find("kept").expect("open"));
    let mut feed = host.subscribe(view(cameras[0]), Delivery::Lossless).await.expect("a feed");
    let driver = server.drive("kept", Policy::Lossless, 40).await;
    for step in steps().into_iter().take(12) {
        driver.step(step).await;
    }
    let want = reference_vertices(&cameras);
    let shown = with_timeout(feed.next()).await.expect("the first");
    assert!(pixels(&shown) == want[0].1[0]);
    with_timeout(server.engine.close("kept")).await.expect("expected the scene to close");
    let mut next = 1;
    while let Ok(shown) = with_timeout(feed.next()).await {
        assert_eq!(shown.step.number, next);
        assert!(pixels(&shown) == want[next as usize].1[0]);
        next += 1;
    }
    assert!(next <= 12);
    server.stop().await.expect("stops with nothing under way");
}
