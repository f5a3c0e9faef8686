//! Batches of small views. The tests that compare them with single pictures need an EGL driver that can render.

use std::collections::BTreeMap;
use std::time::Duration;

use modalcast::config::{Config, RendererChoice};
use modalcast_proto::v1;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Status, Streaming};

use v1::draw_views_request::Kind;
use v1::draw_views_response::Part;
use v1::view_service_client::ViewServiceClient;

use crate::service_harness::{MAX_MESSAGE_BYTES, Server, step, with_timeout};

const COLOR: i32 = v1::Output::Color as i32;
const DEPTH: i32 = v1::Output::Depth as i32;
const DOMAINS: i32 = v1::Output::Domains as i32;
const NORMALS: i32 = v1::Output::Normals as i32;

/// A call of `DrawViews`.
struct Views {
    requests: mpsc::Sender<v1::DrawViewsRequest>,
    replies: Streaming<v1::DrawViewsResponse>,
    views: usize,
    bytes_of_view: BTreeMap<i32, usize>,
}

/// The arrays of a step by their outputs.
type Arrays = BTreeMap<i32, Vec<u8>>;

impl Views {
    async fn open(server: &Server, open: v1::OpenViews) -> Result<Self, Status> {
        let mut client = ViewServiceClient::new(server.channel().await).max_decoding_message_size(MAX_MESSAGE_BYTES);
        let (requests, receiver) = mpsc::channel(4);
        requests.send(v1::DrawViewsRequest { kind: Some(Kind::Open(open)) }).await.expect("expected an open call");
        let mut replies = with_timeout(client.draw_views(ReceiverStream::new(receiver))).await?.into_inner();
        let reply = with_timeout(replies.message()).await?.expect("expected a reply");
        let Some(Part::Opened(opened)) = reply.part else { panic!("expected a confirmation, got {reply:?}") };
        let pixels = (opened.width * opened.height) as usize;
        let bytes = |output: &i32| match *output {
            COLOR => 3 * pixels,
            NORMALS => 12 * pixels,
            _ => 4 * pixels,
        };
        let bytes_of_view = opened.outputs.iter().map(|output| (*output, bytes(output))).collect();
        Ok(Self { requests, replies, views: opened.views as usize, bytes_of_view })
    }

    async fn send(&self, step: v1::ViewStep) {
        let request = v1::DrawViewsRequest { kind: Some(Kind::Step(step)) };
        self.requests.send(request).await.expect("expected an open call");
    }

    /// The pictures of the next step, which has this many views, or its rejection.
    async fn receive(&mut self, number: u64, views: usize) -> Result<Arrays, v1::Rejection> {
        let mut missing: usize = self.bytes_of_view.values().map(|bytes| views * bytes).sum();
        let mut arrays: Arrays =
            self.bytes_of_view.iter().map(|(output, bytes)| (*output, vec![0; views * bytes])).collect();
        while missing > 0 {
            let reply =
                with_timeout(self.replies.message()).await.expect("expected no error").expect("expected a reply");
            match reply.part {
                Some(Part::Chunk(chunk)) => {
                    assert_eq!(chunk.step, number);
                    let array = arrays.get_mut(&chunk.output).expect("expected a requested output");
                    array[chunk.offset as usize..][..chunk.data.len()].copy_from_slice(&chunk.data);
                    missing -= chunk.data.len();
                }
                Some(Part::Rejection(rejection)) => return Err(rejection),
                part => panic!("expected pictures, got {part:?}"),
            }
        }
        Ok(arrays)
    }

    /// Sends a step, and returns the pictures of all views.
    async fn draw(&mut self, step: v1::Step) -> Arrays {
        let number = step.number;
        self.send(v1::ViewStep { step: Some(step), ..v1::ViewStep::default() }).await;
        self.receive(number, self.views).await.expect("expected pictures")
    }
}

fn open_views(scene: &str, worlds: u32) -> v1::OpenViews {
    v1::OpenViews {
        scene: scene.into(),
        worlds,
        width: 40,
        height: 32,
        outputs: vec![COLOR, DEPTH, DOMAINS, NORMALS],
        ..v1::OpenViews::default()
    }
}

fn camera(height: f64) -> v1::Camera {
    let look_at = v1::LookAt { eye: vec![0.5, height, 4.0], target: vec![0.5, 0.5, 0.0], up: vec![0.0, 1.0, 0.0] };
    v1::Camera {
        view: Some(v1::camera::View::LookAt(look_at)),
        lens: Some(v1::camera::Lens::FieldOfView(40.0)),
        ..v1::Camera::default()
    }
}

/// q of one world after another, all different.
fn coordinates(worlds: usize, seed: u64) -> Vec<f32> {
    let mut random = fastrand::Rng::with_seed(seed);
    (0..4 * worlds).map(|_| 0.8 * (random.f32() - 0.5)).collect()
}

/// A step of all coordinates.
fn whole_step(number: u64, q: &[f32]) -> v1::Step {
    step(number, &[], q)
}

/// One picture of the scene's current step.
async fn frame(server: &Server, scene: &str, camera: &v1::Camera, output: i32) -> Vec<u8> {
    let picture = v1::Picture {
        width: 40,
        height: 32,
        output,
        format: if output == COLOR { v1::Format::Rgb.into() } else { 0 },
        camera: Some(camera.clone()),
        samples: u32::from(output == COLOR),
        ..v1::Picture::default()
    };
    let request =
        v1::RenderFrameRequest { scene: scene.into(), pictures: vec![picture], ..v1::RenderFrameRequest::default() };
    let mut client = server.frames().await;
    let mut chunks = client.render_frame(request).await.expect("expected a frame").into_inner();
    let mut bytes = Vec::new();
    while let Some(reply) = chunks.message().await.expect("expected a chunk") {
        let Some(v1::render_frame_response::Part::Chunk(chunk)) = reply.part else { continue };
        bytes.extend_from_slice(&chunk.data);
    }
    bytes
}

/// Fraction of the pixels of a view whose color differs by more than one level, whose depth differs by more than 1e-4
/// of itself, whose domain differs, and whose normal differs by more than 1e-3.
fn differences(arrays: &Arrays, view: usize, frames: &Arrays) -> [f64; 4] {
    let part = |output: i32| {
        let bytes = frames[&output].len();
        (&arrays[&output][view * bytes..][..bytes], &frames[&output][..])
    };
    fn numbers(bytes: &[u8]) -> Vec<f32> {
        bytes.as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect()
    }
    let fraction =
        |differs: Vec<bool>| differs.iter().filter(|differs| **differs).count() as f64 / differs.len() as f64;
    let (got, expected) = part(COLOR);
    let pixels = got.chunks(3).zip(expected.chunks(3));
    let colors = pixels.map(|(a, b)| a.iter().zip(b).any(|(a, b)| a.abs_diff(*b) > 1)).collect();
    let (got, expected) = part(DEPTH);
    let has_other_depth =
        |(a, b): (f32, f32)| a != b && (a.is_infinite() != b.is_infinite() || (a - b).abs() > 1e-4 * b.abs());
    let depths = numbers(got).into_iter().zip(numbers(expected)).map(has_other_depth).collect();
    let (got, expected) = part(DOMAINS);
    let domains = got.chunks(4).zip(expected.chunks(4)).map(|(a, b)| a != b).collect();
    let (got, expected) = part(NORMALS);
    let (got, expected) = (numbers(got), numbers(expected));
    let normals = got.chunks(3).zip(expected.chunks(3));
    let normals = normals.map(|(a, b)| a.iter().zip(b).any(|(a, b)| (a - b).abs() > 1e-3)).collect();
    [fraction(colors), fraction(depths), fraction(domains), fraction(normals)]
}

/// Views of random worlds, against single pictures of the scene in the same state. The control compares with another
/// world, and with the step before.
#[tokio::test(flavor = "multi_thread")]
async fn views_equal_single_pictures() {
    let server = Server::start_with(|config| Config { renderer: RendererChoice::Auto, ..config }).await;
    for (scene, coordinates_of_world) in [("shadowless-strips", 4), ("shadowless-twig", 8)] {
        server.open(scene).await;
        let cameras = [camera(0.5), camera(2.5)];
        let worlds = 3;
        let open = v1::OpenViews { cameras: cameras.to_vec(), ..open_views(scene, worlds) };
        let mut views = Views::open(&server, open).await.expect("expected worlds");
        assert_eq!(views.views, 6);
        let q = coordinates(worlds as usize * coordinates_of_world / 4, 1);
        let earlier = views.draw(whole_step(1, &coordinates(worlds as usize * coordinates_of_world / 4, 2))).await;
        let arrays = views.draw(whole_step(2, &q)).await;
        let mut writer = server.drive_lossless(scene).await;
        for (world, q) in q.chunks(coordinates_of_world).enumerate() {
            writer.send_step_and_wait(whole_step(world as u64 + 1, q)).await;
            for (index, camera) in cameras.iter().enumerate() {
                let mut frames = Arrays::new();
                for output in [COLOR, DEPTH, DOMAINS, NORMALS] {
                    frames.insert(output, frame(&server, scene, camera, output).await);
                }
                let view = 2 * world + index;
                let got = differences(&arrays, view, &frames);
                assert!(
                    got.iter().all(|fraction| *fraction < 0.005),
                    "{scene}, world {world}, camera {index}: {got:?}"
                );
                for (control, arrays, view) in [("world", &arrays, (view + 2) % 6), ("step", &earlier, view)] {
                    let control_differences = differences(arrays, view, &frames);
                    assert!(control_differences[1] > 0.02, "control: another {control}: {control_differences:?}");
                }
            }
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn steps_keep_other_values_and_rejected_steps_change_nothing() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let mut views = Views::open(&server, open_views("strips", 3)).await.expect("expected worlds");
    let q = coordinates(3, 3);
    let whole = views.draw(whole_step(1, &q)).await;
    let bytes = views.bytes_of_view[&DEPTH];
    let world_of = |arrays: &Arrays, world: usize| arrays[&DEPTH][world * bytes..][..bytes].to_vec();
    assert_ne!(world_of(&whole, 0), world_of(&whole, 1), "control: expected worlds that differ");
    // Domains 2 and 3 are those of world 1.
    let partial = views.draw(step(2, &[2, 3], &q[8..12])).await;
    assert_eq!([0, 1, 2].map(|world| world_of(&partial, world)), [0, 2, 2].map(|world| world_of(&whole, world)));
    for (number, values) in [(3, f32::NAN), (4, 1e30)] {
        let rejected = step(number, &[0], &[values; 2]);
        views.send(v1::ViewStep { step: Some(rejected), ..v1::ViewStep::default() }).await;
        let rejection = views.receive(number, 3).await.expect_err("expected a rejection");
        assert_eq!(rejection.step, Some(number));
        assert!(rejection.field.starts_with("step.q"), "{rejection:?}");
        let expected = if values.is_nan() { "NaN" } else { "domain 'left' of world 0" };
        assert!(rejection.given.contains(expected), "{rejection:?}");
    }
    let unchanged = views.draw(step(5, &[2], &q[8..10])).await;
    assert!(unchanged == partial, "expected the state before the rejected steps");
}

#[tokio::test(flavor = "multi_thread")]
async fn cameras_and_drawn_worlds_can_change_with_a_step() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let cameras = vec![camera(0.5), camera(2.5)];
    let open = v1::OpenViews { cameras: cameras.clone(), ..open_views("strips", 3) };
    let mut views = Views::open(&server, open).await.expect("expected worlds");
    let all = views.draw(whole_step(1, &coordinates(3, 4))).await;
    let bytes = views.bytes_of_view[&COLOR];
    let view_of = |arrays: &Arrays, view: usize| arrays[&COLOR][view * bytes..][..bytes].to_vec();
    // The cameras change places, and only two worlds are drawn.
    let cameras = vec![cameras[1].clone(), cameras[0].clone()];
    let moved = v1::ViewStep { step: Some(v1::Step { number: 2, ..v1::Step::default() }), cameras, drawn_worlds: 2 };
    views.send(moved).await;
    let moved = views.receive(2, 4).await.expect("expected pictures");
    assert_eq!([0, 1, 2, 3].map(|view| view_of(&moved, view)), [1, 0, 3, 2].map(|view| view_of(&all, view)));
    // Each camera sees one world.
    let open =
        v1::OpenViews { camera_worlds: vec![2, 0], cameras: vec![camera(2.5), camera(0.5)], ..open_views("strips", 3) };
    let mut paired = Views::open(&server, open).await.expect("expected worlds");
    assert_eq!(paired.views, 2);
    let pairs = paired.draw(whole_step(1, &coordinates(3, 4))).await;
    assert_eq!([0, 1].map(|view| view_of(&pairs, view)), [5, 0].map(|view| view_of(&all, view)));
    let step = v1::ViewStep { drawn_worlds: 1, ..v1::ViewStep::default() };
    paired.send(step).await;
    let rejection = paired.receive(0, 2).await.expect_err("expected a rejection");
    assert_eq!(rejection.field, "drawn_worlds");
}

/// Steps that are sent ahead are answered in their order, and the scene itself does not move.
#[tokio::test(flavor = "multi_thread")]
async fn steps_ahead_are_answered_in_order_and_leave_the_scene_alone() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let mut writer = server.drive_lossless("strips").await;
    writer.send_step_and_wait(step(7, &[0], &[0.1, 0.2])).await;
    let state = server.engine.find("strips").expect("expected a scene").last_step();
    // Several pieces per step.
    let mut views = Views::open(&server, open_views("strips", 40)).await.expect("expected worlds");
    let steps: Vec<v1::Step> = (1..=6).map(|number| whole_step(number, &coordinates(40, number))).collect();
    let mut one_by_one = Vec::new();
    for step in &steps {
        one_by_one.push(views.draw(step.clone()).await);
    }
    let requests = views.requests.clone();
    let send = async {
        for step in &steps {
            let step = v1::ViewStep { step: Some(step.clone()), ..v1::ViewStep::default() };
            requests.send(v1::DrawViewsRequest { kind: Some(Kind::Step(step)) }).await.expect("expected an open call");
        }
    };
    let receive = async {
        for (number, expected) in one_by_one.iter().enumerate() {
            let arrays = views.receive(number as u64 + 1, 40).await.expect("expected pictures");
            assert!(arrays == *expected, "step {}", number + 1);
        }
    };
    tokio::join!(send, receive);
    assert_eq!(server.engine.find("strips").expect("expected a scene").last_step(), state);
    // The call ends when the client has closed its side.
    let Views { requests: own_requests, mut replies, .. } = views;
    drop((requests, own_requests));
    assert!(with_timeout(replies.message()).await.expect("expected no error").is_none());
}

/// Worlds are copies of a scene, and end with it.
#[tokio::test(flavor = "multi_thread")]
async fn views_end_with_their_scene() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let mut views = Views::open(&server, open_views("strips", 2)).await.expect("expected worlds");
    views.draw(whole_step(1, &coordinates(2, 6))).await;
    let request = v1::DeleteSceneRequest { scene: "strips".into() };
    server.scenes().await.delete_scene(request).await.expect("expected a deleted scene");
    let status = with_timeout(views.replies.message()).await.expect_err("expected the end of the call");
    assert_eq!(status.code(), Code::NotFound, "{status}");
}

#[tokio::test(flavor = "multi_thread")]
async fn invalid_sessions_are_rejected_and_others_return_their_memory() {
    let server = Server::start_with(|config| Config { scenes_host_bytes: Some(96 << 20), ..config }).await;
    server.open("strips").await;
    type Change = fn(&mut v1::OpenViews);
    let changes: [(&str, Change); 9] = [
        ("worlds", |open| open.worlds = 1_000_000),
        ("width", |open| open.width = 1025),
        ("height", |open| open.height = 0),
        ("outputs[1]", |open| open.outputs = vec![DEPTH, v1::Output::DepthWithGround.into()]),
        ("outputs[0]", |open| open.outputs = vec![v1::Output::Displacement.into()]),
        ("outputs[0]", |open| open.outputs = vec![99]),
        ("cameras", |open| (open.worlds, open.cameras) = (65_536, vec![camera(0.5), camera(1.0)])),
        ("camera_worlds", |open| (open.cameras, open.camera_worlds) = (vec![camera(0.5)], vec![0, 1])),
        ("camera_worlds[0]", |open| (open.cameras, open.camera_worlds) = (vec![camera(0.5)], vec![2])),
    ];
    for (field, change) in changes {
        let mut open = open_views("strips", 2);
        change(&mut open);
        let status = Views::open(&server, open).await.err().expect("expected an error");
        assert_eq!(status.code(), Code::InvalidArgument, "{status}");
        assert!(status.message().starts_with(&format!("{field}: ")), "expected {field}, got {status}");
    }
    // More memory than there is, which is refused before it is taken.
    let status = Views::open(&server, open_views("strips", 65_536)).await.err().expect("expected an error");
    assert_eq!(status.code(), Code::ResourceExhausted, "{status}");
    assert!(status.message().contains("65536 worlds of scene 'strips'"), "{status}");
    let status = Views::open(&server, open_views("other", 1)).await.err().expect("expected an error");
    assert_eq!(status.code(), Code::NotFound);
    // A session returns its memory. All of them together need more than there is.
    for _ in 0..6 {
        let open = async {
            loop {
                match Views::open(&server, open_views("strips", 1000)).await {
                    Ok(views) => return views,
                    Err(status) => assert_eq!(status.code(), Code::ResourceExhausted, "{status}"),
                }
                tokio::time::sleep(Duration::from_millis(10)).await;
            }
        };
        let mut views = with_timeout(open).await;
        let step = Some(whole_step(1, &coordinates(1000, 5)));
        views.send(v1::ViewStep { step, drawn_worlds: 1, ..v1::ViewStep::default() }).await;
        views.receive(1, 1).await.expect("expected pictures");
    }
}
