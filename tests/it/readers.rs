//! Displacements and boxes over the wire: a scene sends the attributes that it keeps, alone if requested, and refuses
//! requests for others.

use modalcast::config::{BackendChoice, Config};
use modalcast::engine::{Delivery, OutputSpec};
use modalcast_compute::reference::{self, ReferenceDeformer};
use modalcast_model::deform::{DeformedSurface, Deformer, VertexAttributes};
use modalcast_model::scene::Bounds;
use modalcast_proto::v1;
use tonic::Code;
use v1::Policy;
use v1::drive_scene_response::Kind as ResponseKind;

use crate::common::attributes;
use crate::service_harness::{
    ReceivedVertices, Server, get_vertices, next_vertices, reference_vertices, rejection_details, state_after_steps,
    step, strips_with_attributes, with_timeout,
};

fn ask(scene: &str, selection: v1::VertexSelection) -> v1::GetVerticesRequest {
    v1::GetVerticesRequest { scene: scene.into(), selection: Some(selection), ..v1::GetVerticesRequest::default() }
}

fn all(domains: &[u32]) -> v1::VertexSelection {
    v1::VertexSelection { domains: domains.to_vec(), displacements: true, boxes: true, ..Default::default() }
}

fn alone(domains: &[u32]) -> v1::VertexSelection {
    v1::VertexSelection { without_vertices: true, ..all(domains) }
}

/// Displacements u of the f64 reference after some steps.
fn expected_u(steps: &[v1::Step]) -> Vec<f32> {
    let scene = strips_with_attributes();
    let u = reference::displacements(&scene, &state_after_steps(&scene, steps));
    u.into_flattened().into_iter().map(|number| number as f32).collect()
}

/// Bounding boxes of packed domains with four vertices each.
fn boxes_of(positions: &[f32]) -> Vec<f32> {
    let sides = |positions| {
        let Bounds { min, max } = Bounds::from_positions(positions);
        [min, max].concat().into_iter().map(|number| number as f32)
    };
    positions.chunks_exact(12).flat_map(sides).collect()
}

fn largest_error(got: &[f32], want: &[f32]) -> f32 {
    assert_eq!(got.len(), want.len());
    got.iter().zip(want).map(|(got, want)| (got - want).abs()).fold(0.0, f32::max)
}

/// A step that rotates and moves the second domain, so that its u differs from x - x0.
fn turned() -> v1::Step {
    let turn = [0.0_f32, -1.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, -3.0];
    let transforms = turn.iter().flat_map(|number| number.to_le_bytes()).collect::<Vec<u8>>().into();
    v1::Step { transform_domains: vec![1], transforms, ..step(2, &[0, 1], &[0.25, -0.5, 0.75, 0.125]) }
}

#[tokio::test(flavor = "multi_thread")]
async fn displacements_and_boxes_come_with_or_without_vertices() {
    for backend in [BackendChoice::Reference, BackendChoice::Cpu] {
        let server = Server::start_with(|config| Config { backend, ..config }).await;
        server.open("kept").await;
        let mut driver = server.drive("kept", Policy::Lossless, 0).await;
        let steps = [step(1, &[1], &[0.5, -0.25]), turned()];
        for sent in 0..steps.len() {
            driver.step_acknowledged(steps[sent].clone()).await;
            let (x, u) =
                (reference_vertices(&strips_with_attributes(), &steps[..=sent]).0, expected_u(&steps[..=sent]));
            let check = |got: &ReceivedVertices, domains: std::ops::Range<usize>| {
                let floats = 12 * domains.start..12 * domains.end;
                assert!(largest_error(&got.displacements, &u[floats.clone()]) < 1e-6);
                assert!(largest_error(&got.boxes, &boxes_of(&x[floats])) < 1e-6);
            };
            // Read the attributes alone first; the vertices are then read from the same step.
            let reader = get_vertices(&server, ask("kept", alone(&[]))).await.expect("kept");
            assert!(reader.positions.is_empty() && reader.normals.is_empty());
            assert_eq!((reader.head.displacement_bytes, reader.head.box_bytes, reader.head.total), (96, 48, 144));
            check(&reader, 0..2);
            let both = get_vertices(&server, ask("kept", all(&[]))).await.expect("kept");
            check(&both, 0..2);
            assert_eq!((both.normals.len(), both.boxes.clone()), (24, boxes_of(&both.positions)));
            assert!(largest_error(&both.positions, &x) < 1e-6);
            let second = get_vertices(&server, ask("kept", alone(&[1]))).await.expect("kept");
            check(&second, 1..2);
            let vertices = get_vertices(&server, ask("kept", Default::default())).await.expect("vertices");
            assert!(vertices.displacements.is_empty() && vertices.boxes.is_empty());
            assert_eq!(vertices.positions, both.positions);
        }
        // Control: other steps give other displacements.
        assert!(largest_error(&expected_u(&steps[..1]), &expected_u(&steps)) > 0.1);
        driver.finish().await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn box_stream_delivers_every_step() {
    let server = Server::start_default().await;
    server.open("kept").await;
    let boxes = v1::VertexSelection { boxes: true, without_vertices: true, ..Default::default() };
    let request = v1::StreamVerticesRequest {
        scene: "kept".into(),
        selection: Some(boxes),
        delivery: v1::Delivery::Lossless.into(),
        steps: 2,
    };
    let mut stream =
        server.vertices().await.stream_vertices(request).await.expect("expected a subscription").into_inner();
    let mut driver = server.drive("kept", Policy::Lossless, 0).await;
    let steps = [step(1, &[1], &[0.5, -0.25]), turned()];
    for sent in 0..steps.len() {
        driver.step_acknowledged(steps[sent].clone()).await;
        let got = next_vertices(&mut stream).await.expect("expected another message").expect("expected a valid step");
        assert_eq!(got.step().number, steps[sent].number);
        assert_eq!(got.boxes, boxes_of(&reference_vertices(&strips_with_attributes(), &steps[..=sent]).0));
        assert!(got.displacements.is_empty() && got.positions.is_empty());
    }
}

/// Step number and vertex data of a message.
fn parts_of(shown: &modalcast::engine::StepOutput) -> (usize, &DeformedSurface) {
    let modalcast::engine::OutputBody::Vertices(surface) = &shown.body else { panic!("not vertices") };
    (shown.step.number as usize, surface)
}

/// Feeds with different attributes receive every step while the next step is computed.
#[tokio::test(flavor = "multi_thread")]
async fn readers_of_different_parts_get_every_step() {
    let server = Server::start_default().await;
    server.open("kept").await;
    let engine = server.engine.find("kept").expect("open");
    let nothing = VertexAttributes::default();
    let wishes = [
        VertexAttributes { positions: true, ..nothing },
        VertexAttributes { boxes: true, ..nothing },
        VertexAttributes { displacements: true, normals: true, ..nothing },
    ];
    let mut feeds = Vec::new();
    for wanted in wishes {
        feeds.push(engine.subscribe(OutputSpec::Vertices(wanted), Delivery::Lossless).await.expect("a feed"));
    }
    let mut late =
        engine.subscribe(OutputSpec::Vertices(VertexAttributes::ALL), Delivery::Latest).await.expect("a feed");
    let steps: Vec<_> = (0..40).map(|number| step(number, &[1], &[0.01 * number as f32, 1.0])).collect();
    let mut driver = server.drive("kept", Policy::Lossless, 40).await;
    for step in &steps {
        driver.step(step.clone()).await;
    }
    let want = |sent: usize| {
        let ((x, n), u) = (reference_vertices(&strips_with_attributes(), &steps[..=sent]), expected_u(&steps[..=sent]));
        (x, n, u)
    };
    let boxes = |surface: &DeformedSurface| -> Vec<f32> {
        surface.boxes.iter().flat_map(|side| [side.min, side.max].concat()).map(|number| number as f32).collect()
    };
    let shown = with_timeout(late.next()).await.expect("the newest");
    let (sent, surface) = parts_of(&shown);
    let (x, n, u) = want(sent);
    assert!(surface.positions == x && surface.normals == n && boxes(surface) == boxes_of(&x));
    assert!(largest_error(&surface.displacements, &u) < 1e-6);
    drop(late);
    for sent in 0..40 {
        let (x, n, u) = want(sent);
        for (feed, wanted) in feeds.iter_mut().zip(wishes) {
            let shown = with_timeout(feed.next()).await.expect("expected another message");
            let (number, surface) = parts_of(&shown);
            assert_eq!((number, shown.skipped), (sent, 0));
            assert!(!wanted.positions || surface.positions == x, "step {sent}");
            assert!(!wanted.boxes || boxes(surface) == boxes_of(&x), "step {sent}");
            assert!(!wanted.displacements || largest_error(&surface.displacements, &u) < 1e-6, "step {sent}");
            assert!(!wanted.normals || surface.normals == n, "step {sent}");
        }
    }
    // Control: steps differ in positions, boxes and displacements.
    let (x, _, u) = want(0);
    assert!(x != want(1).0 && boxes_of(&x) != boxes_of(&want(1).0) && largest_error(&u, &want(1).2) > 1e-6);
    for sent in 0..40 {
        assert!(matches!(driver.reply().await, ResponseKind::Ack(ack) if ack.step == sent));
    }
    driver.finish().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn attributes_not_kept_are_refused_by_option_name() {
    let server = Server::start_default().await;
    server.open("strips").await;
    for (selection, field, option) in [
        (
            v1::VertexSelection { displacements: true, ..Default::default() },
            "displacements",
            "deform.displacements = true",
        ),
        (v1::VertexSelection { boxes: true, ..Default::default() }, "boxes", "deform.boxes = true"),
        (
            v1::VertexSelection { without_vertices: true, ..Default::default() },
            "without_vertices",
            "displacements or boxes",
        ),
    ] {
        let refusal = get_vertices(&server, ask("strips", selection.clone())).await.expect_err("not kept");
        let why = rejection_details(&refusal);
        assert_eq!(
            (refusal.code(), why.field.as_str()),
            (Code::InvalidArgument, format!("selection.{field}").as_str())
        );
        assert!(why.expected.contains(option), "{why:?}");
        let request = v1::StreamVerticesRequest {
            scene: "strips".into(),
            selection: Some(selection),
            ..v1::StreamVerticesRequest::default()
        };
        let refusal = server.vertices().await.stream_vertices(request).await.expect_err("not kept");
        assert_eq!(rejection_details(&refusal), why);
    }
}

/// The state before the refused step stays readable.
#[tokio::test(flavor = "multi_thread")]
async fn displacement_overflow_refuses_the_step() {
    let server = Server::start_with(|config| Config { backend: BackendChoice::Cpu, ..config }).await;
    server.open("kept").await;
    let mut driver = server.drive("kept", Policy::Lossless, 0).await;
    driver.step_acknowledged(step(1, &[1], &[0.5, -0.25])).await;
    let before = get_vertices(&server, ask("kept", alone(&[]))).await.expect("kept");
    // The transform shrinks x into the range of f32; u of up to 3 q overflows.
    let tiny = [1e-24_f32, 0.0, 0.0, 0.0, 0.0, 1e-24, 0.0, 0.0, 0.0, 0.0, 1e-24, 0.0];
    let transforms = tiny.iter().flat_map(|number| number.to_le_bytes()).collect::<Vec<u8>>().into();
    let lost = v1::Step { transform_domains: vec![1], transforms, ..step(2, &[1], &[f32::MAX; 2]) };
    driver.step(lost).await;
    let why = driver.rejection().await;
    assert!(why.field.contains("domain 'right'"), "{why:?}");
    let after = get_vertices(&server, ask("kept", alone(&[]))).await.expect("kept");
    assert_eq!((after.displacements, after.boxes), (before.displacements, before.boxes));
    assert_eq!(after.head.step, before.head.step);
}

#[test]
fn reference_keeps_displacements_and_boxes() {
    let reference = |scene: &std::sync::Arc<_>| ReferenceDeformer::new(scene).with_bounding_axes(scene.light_axes());
    attributes::check_displacements_and_boxes(reference);
    attributes::check_scene_without_modes(reference);
    assert!(!reference(&strips_with_attributes()).shares_buffers());
}
