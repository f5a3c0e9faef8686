//! Displacements and boxes over the wire: the server sends them with or without vertices if the scene enables them, and
//! rejects requests for disabled ones.

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
    ReceivedVertices, ReferenceVertices, Server, get_vertices, next_vertices, reference_vertices, rejection_details,
    state_after_steps, step, strips_with_attributes, with_timeout,
};

fn vertex_request(scene: &str, selection: v1::VertexSelection) -> v1::GetVerticesRequest {
    v1::GetVerticesRequest { scene: scene.into(), selection: Some(selection), ..v1::GetVerticesRequest::default() }
}

/// Selects vertices, displacements and boxes of some domains, or of all domains if the list is empty.
fn select_vertices_and_attributes(domains: &[u32]) -> v1::VertexSelection {
    v1::VertexSelection { domains: domains.to_vec(), displacements: true, boxes: true, ..Default::default() }
}

/// Selects displacements and boxes without vertices.
fn select_attributes(domains: &[u32]) -> v1::VertexSelection {
    v1::VertexSelection { without_vertices: true, ..select_vertices_and_attributes(domains) }
}

/// Displacements u of the f64 reference after some steps.
fn reference_displacements(steps: &[v1::Step]) -> Vec<f32> {
    let scene = strips_with_attributes();
    let u = reference::displacements(&scene, &state_after_steps(&scene, steps));
    u.into_flattened().into_iter().map(|number| number as f32).collect()
}

/// Bounding boxes of consecutive domains with four vertices each.
fn compute_boxes(positions: &[f32]) -> Vec<f32> {
    let min_and_max = |positions| {
        let BoundingBox { min, max } = BoundingBox::from_positions(positions);
        [min, max].concat().into_iter().map(|number| number as f32)
    };
    positions.chunks_exact(12).flat_map(min_and_max).collect()
}

fn max_abs_error(numbers: &[f32], expected_numbers: &[f32]) -> f32 {
    assert_eq!(numbers.len(), expected_numbers.len());
    numbers.iter().zip(expected_numbers).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
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
        server.open("attributes").await;
        let mut writer = server.drive_lossless("attributes").await;
        let steps = [step(1, &[1], &[0.5, -0.25]), rotated_step()];
        for index in 0..steps.len() {
            writer.send_step_and_wait(steps[index].clone()).await;
            let (positions, displacements) = (
                reference_vertices(&strips_with_attributes(), &steps[..=index]).positions,
                reference_displacements(&steps[..=index]),
            );
            let assert_attributes = |reply: &ReceivedVertices, domains: std::ops::Range<usize>| {
                // Four vertices of three numbers per domain.
                let floats = 12 * domains.start..12 * domains.end;
                assert!(max_abs_error(&reply.displacements, &displacements[floats.clone()]) < 1e-6);
                assert!(max_abs_error(&reply.boxes, &compute_boxes(&positions[floats])) < 1e-6);
            };
            // The first request reads only the attributes. The second request also reads the vertices of the same step.
            let attributes = get_vertices(&server, vertex_request("attributes", select_attributes(&[])))
                .await
                .expect("expected vertices");
            assert!(attributes.positions.is_empty() && attributes.normals.is_empty());
            // Eight displacements of 12 bytes, and two boxes of 24 bytes.
            assert_eq!(
                (attributes.head.displacement_bytes, attributes.head.box_bytes, attributes.head.total),
                (96, 48, 144)
            );
            assert_attributes(&attributes, 0..2);
            let vertices_and_attributes =
                get_vertices(&server, vertex_request("attributes", select_vertices_and_attributes(&[])))
                    .await
                    .expect("expected vertices");
            assert_attributes(&vertices_and_attributes, 0..2);
            assert_eq!(
                (vertices_and_attributes.normals.len(), vertices_and_attributes.boxes.clone()),
                (24, compute_boxes(&vertices_and_attributes.positions))
            );
            assert!(max_abs_error(&vertices_and_attributes.positions, &positions) < 1e-6);
            let second_domain = get_vertices(&server, vertex_request("attributes", select_attributes(&[1])))
                .await
                .expect("expected vertices");
            assert_attributes(&second_domain, 1..2);
            let vertices = get_vertices(&server, vertex_request("attributes", Default::default()))
                .await
                .expect("expected vertices");
            assert!(vertices.displacements.is_empty() && vertices.boxes.is_empty());
            assert_eq!(vertices.positions, vertices_and_attributes.positions);
        }
        // Negative control: other steps give other displacements.
        assert!(max_abs_error(&reference_displacements(&steps[..1]), &reference_displacements(&steps)) > 0.1);
        writer.finish().await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn box_stream_delivers_every_step() {
    let server = Server::start_default().await;
    server.open("attributes").await;
    let selection = v1::VertexSelection { boxes: true, without_vertices: true, ..Default::default() };
    let request = v1::StreamVerticesRequest {
        scene: "attributes".into(),
        selection: Some(selection),
        delivery: v1::Delivery::Lossless.into(),
        steps: 2,
    };
    let mut stream =
        server.vertices().await.stream_vertices(request).await.expect("expected a subscription").into_inner();
    let mut writer = server.drive_lossless("attributes").await;
    let steps = [step(1, &[1], &[0.5, -0.25]), rotated_step()];
    for index in 0..steps.len() {
        writer.send_step_and_wait(steps[index].clone()).await;
        let reply = next_vertices(&mut stream).await.expect("expected another message").expect("expected a valid step");
        assert_eq!(reply.step().number, steps[index].number);
        assert_eq!(
            reply.boxes,
            compute_boxes(&reference_vertices(&strips_with_attributes(), &steps[..=index]).positions)
        );
        assert!(reply.displacements.is_empty() && reply.positions.is_empty());
    }
}

/// Step number and vertex data of an output.
fn vertices_of_output(output: &modalcast::engine::StepOutput) -> (usize, &DeformedSurface) {
    let modalcast::engine::OutputBody::Vertices(surface) = &output.body else { panic!("expected vertices") };
    (output.step.number as usize, surface)
}

/// The corners of all boxes, rounded to f32 as on the wire.
fn box_numbers(surface: &DeformedSurface) -> Vec<f32> {
    let corners = surface.boxes.iter().flat_map(|bounding_box| [bounding_box.min, bounding_box.max].concat());
    corners.map(|number| number as f32).collect()
}

/// Subscriptions with different attributes receive every step, although later steps are computed meanwhile.
#[tokio::test(flavor = "multi_thread")]
async fn subscribers_of_different_attributes_get_every_step() {
    const STEP_COUNT: u64 = 40;
    let server = Server::start_default().await;
    server.open("attributes").await;
    let scene_handle = server.engine.find("attributes").expect("expected an open scene");
    let no_attributes = VertexAttributes::default();
    let selections = [
        VertexAttributes { positions: true, ..no_attributes },
        VertexAttributes { boxes: true, ..no_attributes },
        VertexAttributes { displacements: true, normals: true, ..no_attributes },
    ];
    let mut subscriptions = Vec::new();
    for selection in selections {
        subscriptions.push(
            scene_handle
                .subscribe(OutputSpec::Vertices(selection), Delivery::Lossless)
                .await
                .expect("expected a subscription"),
        );
    }
    let mut latest_subscription = scene_handle
        .subscribe(OutputSpec::Vertices(VertexAttributes::ALL), Delivery::Latest)
        .await
        .expect("expected a subscription");
    let steps: Vec<_> = (0..STEP_COUNT).map(|number| step(number, &[1], &[0.01 * number as f32, 1.0])).collect();
    let mut writer = server.drive("attributes", Policy::Lossless, STEP_COUNT as u32).await;
    for step in &steps {
        writer.send_step(step.clone()).await;
    }
    let expected_output = |index: usize| {
        let ReferenceVertices { positions, normals } = reference_vertices(&strips_with_attributes(), &steps[..=index]);
        (positions, normals, reference_displacements(&steps[..=index]))
    };
    let output = with_timeout(latest_subscription.next()).await.expect("expected the newest step");
    let (index, surface) = vertices_of_output(&output);
    let (positions, normals, displacements) = expected_output(index);
    assert!(
        surface.positions == positions
            && surface.normals == normals
            && box_numbers(surface) == compute_boxes(&positions)
    );
    assert!(max_abs_error(&surface.displacements, &displacements) < 1e-6);
    drop(latest_subscription);
    for index in 0..STEP_COUNT as usize {
        let (positions, normals, displacements) = expected_output(index);
        for (subscription, selection) in subscriptions.iter_mut().zip(selections) {
            let output = with_timeout(subscription.next()).await.expect("expected another message");
            let (number, surface) = vertices_of_output(&output);
            assert_eq!((number, output.skipped), (index, 0));
            assert!(!selection.positions || surface.positions == positions, "step {index}");
            assert!(!selection.boxes || box_numbers(surface) == compute_boxes(&positions), "step {index}");
            assert!(
                !selection.displacements || max_abs_error(&surface.displacements, &displacements) < 1e-6,
                "step {index}"
            );
            assert!(!selection.normals || surface.normals == normals, "step {index}");
        }
    }
    // Negative control: the first two steps differ in positions, boxes and displacements.
    let [(positions, _, displacements), (next_positions, _, next_displacements)] = [0, 1].map(expected_output);
    assert!(
        positions != next_positions
            && compute_boxes(&positions) != compute_boxes(&next_positions)
            && max_abs_error(&displacements, &next_displacements) > 1e-6
    );
    for number in 0..STEP_COUNT {
        assert!(matches!(writer.receive_reply().await, ResponseKind::Ack(ack) if ack.step == number));
    }
    writer.finish().await;
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
    server.open("attributes").await;
    let mut writer = server.drive_lossless("attributes").await;
    writer.send_step_and_wait(step(1, &[1], &[0.5, -0.25])).await;
    let previous_reply =
        get_vertices(&server, vertex_request("attributes", select_attributes(&[]))).await.expect("expected vertices");
    // The transform scales x into the range of f32, but u overflows.
    let matrix = [1e-24_f32, 0.0, 0.0, 0.0, 0.0, 1e-24, 0.0, 0.0, 0.0, 0.0, 1e-24, 0.0];
    let transforms = matrix.iter().flat_map(|number| number.to_le_bytes()).collect::<Vec<u8>>().into();
    let overflowing_step = v1::Step { transform_domains: vec![1], transforms, ..step(2, &[1], &[f32::MAX; 2]) };
    writer.send_step(overflowing_step).await;
    let rejection = writer.receive_rejection().await;
    assert!(rejection.field.contains("domain 'right'"), "{rejection:?}");
    let reply =
        get_vertices(&server, vertex_request("attributes", select_attributes(&[]))).await.expect("expected vertices");
    assert_eq!((reply.displacements, reply.boxes), (previous_reply.displacements, previous_reply.boxes));
    assert_eq!(reply.head.step, previous_reply.head.step);
}

#[test]
fn reference_deformer_has_displacements_and_boxes() {
    let reference = |scene: &std::sync::Arc<_>| ReferenceDeformer::new(scene).with_bounding_axes(scene.light_axes());
    attributes::check_displacements_and_boxes(reference);
    attributes::check_scene_without_modes(reference);
    assert!(!reference(&strips_with_attributes()).shares_buffers());
}
