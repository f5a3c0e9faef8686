//! Displacements and boxes over the wire: the server sends the attributes that a scene enables, with or without vertices,
//! and rejects requests for others.

use modalcast::config::{BackendChoice, Config};
use modalcast::engine::{Delivery, OutputSpec};
use modalcast_compute::reference::{self, ReferenceDeformer};
use modalcast_model::deform::{DeformedSurface, Deformer, VertexAttributes};
use modalcast_model::scene::BoundingBox;
use modalcast_proto::v1;
use tonic::Code;
use v1::Policy;
use v1::drive_scene_response::Kind as ResponseKind;

use crate::common::attributes;
use crate::service_harness::{
    ReceivedVertices, Server, get_vertices, next_vertices, reference_vertices, rejection_details, state_after_steps,
    step, strips_with_attributes, with_timeout,
};

fn vertex_request(scene: &str, selection: v1::VertexSelection) -> v1::GetVerticesRequest {
    v1::GetVerticesRequest { scene: scene.into(), selection: Some(selection), ..v1::GetVerticesRequest::default() }
}

fn with_attributes(domains: &[u32]) -> v1::VertexSelection {
    v1::VertexSelection { domains: domains.to_vec(), displacements: true, boxes: true, ..Default::default() }
}

fn attributes_only(domains: &[u32]) -> v1::VertexSelection {
    v1::VertexSelection { without_vertices: true, ..with_attributes(domains) }
}

/// Displacements u of the f64 reference after some steps.
fn reference_displacements(steps: &[v1::Step]) -> Vec<f32> {
    let scene = strips_with_attributes();
    let u = reference::displacements(&scene, &state_after_steps(&scene, steps));
    u.into_flattened().into_iter().map(|number| number as f32).collect()
}

/// Bounding boxes of packed domains with four vertices each.
fn boxes_of(positions: &[f32]) -> Vec<f32> {
    let sides = |positions| {
        let BoundingBox { min, max } = BoundingBox::from_positions(positions);
        [min, max].concat().into_iter().map(|number| number as f32)
    };
    positions.chunks_exact(12).flat_map(sides).collect()
}

fn max_abs_error(got: &[f32], want: &[f32]) -> f32 {
    assert_eq!(got.len(), want.len());
    got.iter().zip(want).map(|(got, want)| (got - want).abs()).fold(0.0, f32::max)
}

/// A step that rotates and moves the second domain, so that its u differs from x - x0.
fn rotated_step() -> v1::Step {
    let matrix = [0.0_f32, -1.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, -3.0];
    let transforms = matrix.iter().flat_map(|number| number.to_le_bytes()).collect::<Vec<u8>>().into();
    v1::Step { transform_domains: vec![1], transforms, ..step(2, &[0, 1], &[0.25, -0.5, 0.75, 0.125]) }
}

#[tokio::test(flavor = "multi_thread")]
async fn displacements_and_boxes_come_with_or_without_vertices() {
    for backend in [BackendChoice::Reference, BackendChoice::Cpu] {
        let server = Server::start_with(|config| Config { backend, ..config }).await;
        server.open("kept").await;
        let mut driver = server.drive("kept", Policy::Lossless, 0).await;
        let steps = [step(1, &[1], &[0.5, -0.25]), rotated_step()];
        for index in 0..steps.len() {
            driver.step_acknowledged(steps[index].clone()).await;
            let (x, u) = (
                reference_vertices(&strips_with_attributes(), &steps[..=index]).0,
                reference_displacements(&steps[..=index]),
            );
            let assert_attributes = |got: &ReceivedVertices, domains: std::ops::Range<usize>| {
                let floats = 12 * domains.start..12 * domains.end;
                assert!(max_abs_error(&got.displacements, &u[floats.clone()]) < 1e-6);
                assert!(max_abs_error(&got.boxes, &boxes_of(&x[floats])) < 1e-6);
            };
            // Read the attributes alone first; the vertices are then read from the same step.
            let attributes =
                get_vertices(&server, vertex_request("kept", attributes_only(&[]))).await.expect("expected vertices");
            assert!(attributes.positions.is_empty() && attributes.normals.is_empty());
            assert_eq!(
                (attributes.head.displacement_bytes, attributes.head.box_bytes, attributes.head.total),
                (96, 48, 144)
            );
            assert_attributes(&attributes, 0..2);
            let complete =
                get_vertices(&server, vertex_request("kept", with_attributes(&[]))).await.expect("expected vertices");
            assert_attributes(&complete, 0..2);
            assert_eq!((complete.normals.len(), complete.boxes.clone()), (24, boxes_of(&complete.positions)));
            assert!(max_abs_error(&complete.positions, &x) < 1e-6);
            let second =
                get_vertices(&server, vertex_request("kept", attributes_only(&[1]))).await.expect("expected vertices");
            assert_attributes(&second, 1..2);
            let vertices =
                get_vertices(&server, vertex_request("kept", Default::default())).await.expect("expected vertices");
            assert!(vertices.displacements.is_empty() && vertices.boxes.is_empty());
            assert_eq!(vertices.positions, complete.positions);
        }
        // Negative control: other steps give other displacements.
        assert!(max_abs_error(&reference_displacements(&steps[..1]), &reference_displacements(&steps)) > 0.1);
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
    let steps = [step(1, &[1], &[0.5, -0.25]), rotated_step()];
    for index in 0..steps.len() {
        driver.step_acknowledged(steps[index].clone()).await;
        let got = next_vertices(&mut stream).await.expect("expected another message").expect("expected a valid step");
        assert_eq!(got.step().number, steps[index].number);
        assert_eq!(got.boxes, boxes_of(&reference_vertices(&strips_with_attributes(), &steps[..=index]).0));
        assert!(got.displacements.is_empty() && got.positions.is_empty());
    }
}

/// Step number and vertex data of a message.
fn vertices_of_output(output: &modalcast::engine::StepOutput) -> (usize, &DeformedSurface) {
    let modalcast::engine::OutputBody::Vertices(surface) = &output.body else { panic!("not vertices") };
    (output.step.number as usize, surface)
}

/// Subscriptions with different attributes receive every step while the next step is computed.
#[tokio::test(flavor = "multi_thread")]
async fn subscribers_of_different_attributes_get_every_step() {
    let server = Server::start_default().await;
    server.open("kept").await;
    let engine = server.engine.find("kept").expect("expected an open scene");
    let none = VertexAttributes::default();
    let selections = [
        VertexAttributes { positions: true, ..none },
        VertexAttributes { boxes: true, ..none },
        VertexAttributes { displacements: true, normals: true, ..none },
    ];
    let mut subscriptions = Vec::new();
    for selection in selections {
        subscriptions.push(
            engine
                .subscribe(OutputSpec::Vertices(selection), Delivery::Lossless)
                .await
                .expect("expected a subscription"),
        );
    }
    let mut latest = engine
        .subscribe(OutputSpec::Vertices(VertexAttributes::ALL), Delivery::Latest)
        .await
        .expect("expected a subscription");
    let steps: Vec<_> = (0..40).map(|number| step(number, &[1], &[0.01 * number as f32, 1.0])).collect();
    let mut driver = server.drive("kept", Policy::Lossless, 40).await;
    for step in &steps {
        driver.step(step.clone()).await;
    }
    let want = |index: usize| {
        let ((x, n), u) = (
            reference_vertices(&strips_with_attributes(), &steps[..=index]),
            reference_displacements(&steps[..=index]),
        );
        (x, n, u)
    };
    let boxes = |surface: &DeformedSurface| -> Vec<f32> {
        surface.boxes.iter().flat_map(|side| [side.min, side.max].concat()).map(|number| number as f32).collect()
    };
    let output = with_timeout(latest.next()).await.expect("expected the newest step");
    let (index, surface) = vertices_of_output(&output);
    let (x, n, u) = want(index);
    assert!(surface.positions == x && surface.normals == n && boxes(surface) == boxes_of(&x));
    assert!(max_abs_error(&surface.displacements, &u) < 1e-6);
    drop(latest);
    for index in 0..40 {
        let (x, n, u) = want(index);
        for (subscription, selection) in subscriptions.iter_mut().zip(selections) {
            let output = with_timeout(subscription.next()).await.expect("expected another message");
            let (number, surface) = vertices_of_output(&output);
            assert_eq!((number, output.skipped), (index, 0));
            assert!(!selection.positions || surface.positions == x, "step {index}");
            assert!(!selection.boxes || boxes(surface) == boxes_of(&x), "step {index}");
            assert!(!selection.displacements || max_abs_error(&surface.displacements, &u) < 1e-6, "step {index}");
            assert!(!selection.normals || surface.normals == n, "step {index}");
        }
    }
    // Negative control: steps differ in positions, boxes and displacements.
    let (x, _, u) = want(0);
    assert!(x != want(1).0 && boxes_of(&x) != boxes_of(&want(1).0) && max_abs_error(&u, &want(1).2) > 1e-6);
    for index in 0..40 {
        assert!(matches!(driver.reply().await, ResponseKind::Ack(ack) if ack.step == index));
    }
    driver.finish().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn disabled_attributes_are_rejected_with_option_name() {
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
        let error = get_vertices(&server, vertex_request("strips", selection.clone()))
            .await
            .expect_err("expected a disabled-attribute error");
        let rejection = rejection_details(&error);
        assert_eq!(
            (error.code(), rejection.field.as_str()),
            (Code::InvalidArgument, format!("selection.{field}").as_str())
        );
        assert!(rejection.expected.contains(option), "{rejection:?}");
        let request = v1::StreamVerticesRequest {
            scene: "strips".into(),
            selection: Some(selection),
            ..v1::StreamVerticesRequest::default()
        };
        let error =
            server.vertices().await.stream_vertices(request).await.expect_err("expected a disabled-attribute error");
        assert_eq!(rejection_details(&error), rejection);
    }
}

/// A step with an overflowing displacement is rejected, and the state before it stays readable.
#[tokio::test(flavor = "multi_thread")]
async fn step_with_displacement_overflow_is_rejected() {
    let server = Server::start_with(|config| Config { backend: BackendChoice::Cpu, ..config }).await;
    server.open("kept").await;
    let mut driver = server.drive("kept", Policy::Lossless, 0).await;
    driver.step_acknowledged(step(1, &[1], &[0.5, -0.25])).await;
    let before = get_vertices(&server, vertex_request("kept", attributes_only(&[]))).await.expect("expected vertices");
    // The transform scales x into the range of f32, but u overflows.
    let matrix = [1e-24_f32, 0.0, 0.0, 0.0, 0.0, 1e-24, 0.0, 0.0, 0.0, 0.0, 1e-24, 0.0];
    let transforms = matrix.iter().flat_map(|number| number.to_le_bytes()).collect::<Vec<u8>>().into();
    let overflowing_step = v1::Step { transform_domains: vec![1], transforms, ..step(2, &[1], &[f32::MAX; 2]) };
    driver.step(overflowing_step).await;
    let rejection = driver.rejection().await;
    assert!(rejection.field.contains("domain 'right'"), "{rejection:?}");
    let after = get_vertices(&server, vertex_request("kept", attributes_only(&[]))).await.expect("expected vertices");
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
