//! Displacements u = U q and bounding boxes over the wire. If the scene enables them, the server sends them with or
//! without the vertices. It rejects requests for disabled attributes.

use std::sync::Arc;

use modalcast::admission::Account;
use modalcast::config::{BackendChoice, Config};
use modalcast::engine::{Delivery, OutputSpec};
use modalcast_compute::reference::{self, ReferenceDeformer};
use modalcast_model::deform::{DeformedSurface, Deformer, VertexAttributes};
use modalcast_model::scene::BoundingBox;
use modalcast_proto::v1;
use tonic::Code;
use v1::drive_scene_response::Kind as ResponseKind;

use crate::common::attributes;
use crate::service_harness::{
    ReceivedVertices, ReferenceVertices, Server, get_vertices, next_vertices, reference_vertices, rejection_details,
    select, state_after_steps, step, strips_with_attributes, with_timeout,
};

/// Maximum error of positions and displacements in scene units. The values are below 8, where numbers in f32 are 5e-7
/// apart.
const TOLERANCE: f32 = 1e-6;

fn vertex_request(scene: &str, selection: v1::VertexSelection) -> v1::GetVerticesRequest {
    v1::GetVerticesRequest { scene: scene.into(), selection: Some(selection), ..v1::GetVerticesRequest::default() }
}

/// Selects vertices, displacements and boxes of the listed domains, or of all domains if the list is empty.
fn select_vertices_and_attributes(domains: &[u32]) -> v1::VertexSelection {
    use v1::Attribute::{Boxes, Displacements, Normals, Positions};
    select(domains, &[Positions, Normals, Displacements, Boxes]).expect("expected a selection")
}

/// Selects displacements and boxes of the listed domains, without vertices. An empty list selects all domains.
fn select_attributes(domains: &[u32]) -> v1::VertexSelection {
    select(domains, &[v1::Attribute::Displacements, v1::Attribute::Boxes]).expect("expected a selection")
}

/// Displacements of the f64 reference after `steps`, for the scene that the test server opens as `attributes`.
fn reference_displacements(steps: &[v1::Step]) -> Vec<f32> {
    let scene = strips_with_attributes();
    let u = reference::displacements(&scene, &state_after_steps(&scene, steps));
    u.into_flattened().into_iter().map(|number| number as f32).collect()
}

/// Numbers of the positions of a domain, or of its displacements: four vertices times three axes.
const NUMBERS_PER_DOMAIN: usize = 12;

/// Bounding boxes of consecutive domains, computed from their positions. A box is its minimum, then its maximum.
fn compute_boxes(positions: &[f32]) -> Vec<f32> {
    let min_and_max = |positions| {
        let BoundingBox { min, max } = BoundingBox::from_positions(positions);
        [min, max].concat().into_iter().map(|number| number as f32)
    };
    positions.chunks_exact(NUMBERS_PER_DOMAIN).flat_map(min_and_max).collect()
}

fn max_abs_error(numbers: &[f32], expected_numbers: &[f32]) -> f32 {
    assert_eq!(numbers.len(), expected_numbers.len());
    numbers.iter().zip(expected_numbers).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

/// A step that sets q of both domains, and rotates and moves domain 1. The displacements u of domain 1 thus differ from
/// x - x0.
fn rotated_step() -> v1::Step {
    // Row-major 3 x 4 matrix: a rotation by 90 degrees about z, then a translation by (2, 0, -3).
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
            let (expected_positions, expected_displacements) = (
                reference_vertices(&strips_with_attributes(), &steps[..=index]).positions,
                reference_displacements(&steps[..=index]),
            );
            let assert_attributes = |reply: &ReceivedVertices, domains: std::ops::Range<usize>| {
                let numbers = NUMBERS_PER_DOMAIN * domains.start..NUMBERS_PER_DOMAIN * domains.end;
                let expected_boxes = compute_boxes(&expected_positions[numbers.clone()]);
                assert!(max_abs_error(&reply.displacements, &expected_displacements[numbers]) < TOLERANCE);
                assert!(max_abs_error(&reply.boxes, &expected_boxes) < TOLERANCE);
            };
            // The first request reads only the attributes. The second request also reads the vertices of the same step.
            let attributes = get_vertices(&server, vertex_request("attributes", select_attributes(&[])))
                .await
                .expect("expected vertices");
            assert!(attributes.positions.is_empty() && attributes.normals.is_empty());
            // Eight displacements of 12 bytes, two boxes of 24 bytes, and one origin of 24 bytes.
            let section_bytes: Vec<u64> = attributes.head.sections.iter().map(|section| section.bytes).collect();
            assert_eq!((section_bytes, attributes.head.total), (vec![96, 48, 24], 168));
            assert_attributes(&attributes, 0..2);
            let vertices_and_attributes =
                get_vertices(&server, vertex_request("attributes", select_vertices_and_attributes(&[])))
                    .await
                    .expect("expected vertices");
            assert_attributes(&vertices_and_attributes, 0..2);
            assert_eq!(vertices_and_attributes.normals.len(), 2 * NUMBERS_PER_DOMAIN);
            assert_eq!(vertices_and_attributes.boxes, compute_boxes(&vertices_and_attributes.positions));
            assert!(max_abs_error(&vertices_and_attributes.positions, &expected_positions) < TOLERANCE);
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
        // Negative control: the second step changes the displacements.
        assert!(max_abs_error(&reference_displacements(&steps[..1]), &reference_displacements(&steps)) > 0.1);
        writer.finish().await;
    }
}

/// Requests vertices of the sheet with and without compact encodings through the client. Each error is within the bound
/// that `vertices.proto` states, and the compact reply has less than half of the bytes.
#[tokio::test(flavor = "multi_thread")]
async fn compact_encodings_stay_within_their_bounds() {
    use modalcast_client::{Attribute, Client, Encoding, VertexRequest, VertexSelection};
    let server = Server::start_default().await;
    server.open("sheet").await;
    let mut writer = server.drive_lossless("sheet").await;
    writer.send_step_and_wait(step(1, &[0], &[20.0, -3.0, 0.5, 7.0])).await;
    let client = Client::connect(&server.address).await.expect("expected a connection");
    let get = async |vectors, normals| {
        let selection = VertexSelection::default()
            .encoded_attribute(Attribute::Positions, vectors)
            .encoded_attribute(Attribute::Normals, normals);
        client.get_vertices(&VertexRequest::new("sheet", selection)).await.expect("expected vertices")
    };
    let exact = get(Encoding::F32, Encoding::F32).await;
    let compact = get(Encoding::U16Box, Encoding::OctahedralI16).await;
    let half = get(Encoding::F16, Encoding::F16).await;
    assert_eq!((exact.positions.len(), exact.common_origin()), (3 * 300 * 300, Some([0.0; 3])));
    for (block, compact_block) in exact.positions.chunks(3 * 256).zip(compact.positions.chunks(3 * 256)) {
        for axis in 0..3 {
            let coordinates = || block.iter().skip(axis).step_by(3).copied();
            let (min, max) = (coordinates().fold(f32::MAX, f32::min), coordinates().fold(f32::MIN, f32::max));
            // Half a step of the 65,535 steps between min and max, plus the rounding of the decoded number to f32.
            let bound = (max - min) / 131_070.0 + max.abs().max(min.abs()) * f32::EPSILON;
            let compact_coordinates = compact_block.iter().skip(axis).step_by(3);
            let errors = coordinates().zip(compact_coordinates).map(|(exact, compact)| (exact - compact).abs());
            assert!(errors.fold(0.0, f32::max) <= bound);
        }
    }
    for (number, half_number) in exact.positions.iter().zip(&half.positions) {
        // f16 has a relative error of 2^-11, or an absolute error of 2^-25 for subnormal numbers.
        assert!((number - half_number).abs() <= (number.abs() / 2048.0).max(2.0_f32.powi(-25)));
    }
    let max_angle = |normals: &[f32]| {
        let vector = |numbers: &[f32]| nalgebra::Vector3::from_column_slice(numbers).cast::<f64>();
        let pairs = exact.normals.chunks_exact(3).zip(normals.chunks_exact(3));
        pairs.map(|(a, b)| vector(a).normalize().cross(&vector(b)).norm().asin().to_degrees()).fold(0.0, f64::max)
    };
    assert!(max_angle(&compact.normals) <= 0.004 && max_angle(&half.normals) <= 0.05);
    let ratio = compact.encoded_bytes as f64 / exact.encoded_bytes as f64;
    // 10 bytes per vertex and the boxes of the blocks, instead of 24 bytes per vertex.
    assert!(ratio < 0.43, "expected less than 0.43 of the bytes, got {ratio}");
    assert_ne!(compact.positions, exact.positions, "control: expected an encoding that is not exact");
}

/// The layout of many domains arrives in several parts, before the first step.
#[tokio::test(flavor = "multi_thread")]
async fn stream_of_70000_domains_has_one_layout() {
    use modalcast_client::{Attribute, Client, VertexSelection, VertexStreamRequest};
    let server = Server::start_with(|config| Config { backend: BackendChoice::Cpu, ..config }).await;
    server.open("crowd").await;
    let client = Client::connect(&server.address).await.expect("expected a connection");
    let selection = VertexSelection::default().attribute(Attribute::Positions);
    let request = VertexStreamRequest::new("crowd", selection);
    let mut vertex_stream = client.stream_vertices(&request).await.expect("expected a subscription");
    let mut writer = server.drive_lossless("crowd").await;
    for number in 1..=2 {
        writer.send_step_and_wait(step(number, &[69_999], &[number as f32, 0.0])).await;
        let set = with_timeout(vertex_stream.next()).await.expect("expected a step").expect("expected vertices");
        assert_eq!((set.step.number, set.domains.len(), set.domains[69_999].index), (number, 70_000, 69_999));
        assert_eq!(set.positions.len(), 70_000 * NUMBERS_PER_DOMAIN);
        let (first_domain, last_domain) = (&set.positions[..12], &set.positions[69_999 * 12..]);
        assert_ne!(first_domain, last_domain, "expected the step to move the last domain only");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn box_stream_delivers_every_step() {
    // The deformer of this server is the f64 reference, so the boxes are exactly equal.
    let server = Server::start_default().await;
    server.open("attributes").await;
    let request = v1::StreamVerticesRequest {
        scene: "attributes".into(),
        selection: select(&[], &[v1::Attribute::Boxes]),
        delivery: v1::Delivery::Lossless.into(),
        steps: 2,
        max_hz: 0.0,
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
async fn vertices_of_output(output: &modalcast::engine::StepOutput) -> (usize, Arc<DeformedSurface>) {
    let modalcast::engine::OutputBody::Vertices(vertices) = &output.body else { panic!("expected vertices") };
    let vertices = with_timeout(vertices.wait()).await.expect("expected vertices");
    (output.step.number as usize, Arc::clone(&vertices.surface))
}

/// The corners of all boxes, rounded to f32 as on the wire.
fn box_numbers(surface: &DeformedSurface) -> Vec<f32> {
    let corners = surface.boxes.iter().flat_map(|bounding_box| [bounding_box.min, bounding_box.max].concat());
    corners.map(|number| number as f32).collect()
}

/// Lossless subscriptions with different attributes receive every step, although the server computes later steps in the
/// meantime.
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
                .subscribe(&Account::server(), OutputSpec::Vertices(selection), Delivery::Lossless)
                .await
                .expect("expected a subscription"),
        );
    }
    let mut latest_subscription = scene_handle
        .subscribe(&Account::server(), OutputSpec::Vertices(VertexAttributes::ALL), Delivery::Latest)
        .await
        .expect("expected a subscription");
    let steps: Vec<_> = (0..STEP_COUNT).map(|number| step(number, &[1], &[0.01 * number as f32, 1.0])).collect();
    let mut writer = server.drive("attributes", v1::Delivery::Lossless, STEP_COUNT as u32).await;
    for step in &steps {
        writer.send_step(step.clone()).await;
    }
    let expected_output = |index: usize| {
        let ReferenceVertices { positions, normals } = reference_vertices(&strips_with_attributes(), &steps[..=index]);
        (positions, normals, reference_displacements(&steps[..=index]))
    };
    // The first output may show any step, because the server may skip steps for this subscription.
    let output = with_timeout(latest_subscription.next()).await.expect("expected a step");
    let (index, surface) = vertices_of_output(&output).await;
    let (positions, normals, displacements) = expected_output(index);
    assert!(
        surface.positions == positions
            && surface.normals == normals
            && box_numbers(&surface) == compute_boxes(&positions)
    );
    assert!(max_abs_error(&surface.displacements, &displacements) < TOLERANCE);
    drop(latest_subscription);
    for index in 0..STEP_COUNT as usize {
        let (positions, normals, displacements) = expected_output(index);
        for (subscription, selection) in subscriptions.iter_mut().zip(selections) {
            let output = with_timeout(subscription.next()).await.expect("expected another message");
            let (number, surface) = vertices_of_output(&output).await;
            assert_eq!((number, output.skipped), (index, 0));
            assert!(!selection.positions || surface.positions == positions, "step {index}");
            assert!(!selection.boxes || box_numbers(&surface) == compute_boxes(&positions), "step {index}");
            assert!(
                !selection.displacements || max_abs_error(&surface.displacements, &displacements) < TOLERANCE,
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
            && max_abs_error(&displacements, &next_displacements) > TOLERANCE
    );
    for number in 0..STEP_COUNT {
        assert!(matches!(writer.receive_reply().await, ResponseKind::Ack(ack) if ack.step == number));
    }
    writer.finish().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn disabled_and_repeated_attributes_are_rejected() {
    let server = Server::start_default().await;
    let normals_in_boxes =
        v1::SelectedAttribute { attribute: v1::Attribute::Normals.into(), encoding: v1::Encoding::U16Box.into() };
    let normals_in_boxes = Some(v1::VertexSelection { domains: Vec::new(), attributes: vec![normals_in_boxes] });
    // This scene enables neither displacements nor boxes.
    server.open("strips").await;
    for (selection, field, expected) in [
        (select(&[], &[v1::Attribute::Displacements]), "attributes[0].attribute", "deform.displacements = true"),
        (
            select(&[], &[v1::Attribute::Positions, v1::Attribute::Boxes]),
            "attributes[1].attribute",
            "deform.boxes = true",
        ),
        (select(&[], &[v1::Attribute::Unspecified]), "attributes[0].attribute", "an attribute of this version"),
        (select(&[], &[v1::Attribute::Positions; 2]), "attributes[1]", "each attribute once"),
        (select(&[], &[v1::Attribute::Origins]), "attributes[0].attribute", "an attribute that can be selected"),
        (normals_in_boxes, "attributes[0].encoding", "ENCODING_OCTAHEDRAL_I16 for ATTRIBUTE_NORMALS"),
    ] {
        let selection = selection.expect("expected a selection");
        let error = get_vertices(&server, vertex_request("strips", selection.clone()))
            .await
            .expect_err("expected a rejected selection");
        let rejection = rejection_details(&error);
        assert_eq!(
            (error.code(), rejection.field.as_str()),
            (Code::InvalidArgument, format!("selection.{field}").as_str())
        );
        assert!(rejection.expected.contains(expected), "{rejection:?}");
        let request = v1::StreamVerticesRequest {
            scene: "strips".into(),
            selection: Some(selection),
            delivery: v1::Delivery::Latest.into(),
            ..v1::StreamVerticesRequest::default()
        };
        let error = server.vertices().await.stream_vertices(request).await.expect_err("expected a rejected selection");
        assert_eq!(rejection_details(&error), rejection);
    }
}

/// A step whose displacements overflow is rejected, and the previous state stays readable.
#[tokio::test(flavor = "multi_thread")]
async fn step_with_displacement_overflow_is_rejected() {
    let server = Server::start_with(|config| Config { backend: BackendChoice::Cpu, ..config }).await;
    server.open("attributes").await;
    let mut writer = server.drive_lossless("attributes").await;
    writer.send_step_and_wait(step(1, &[1], &[0.5, -0.25])).await;
    let previous_reply =
        get_vertices(&server, vertex_request("attributes", select_attributes(&[]))).await.expect("expected vertices");
    // The entries of U are up to 2, so u = U q overflows. x = T (x0 + u) would be finite, because T scales by 1e-24.
    let matrix = [1e-24_f32, 0.0, 0.0, 0.0, 0.0, 1e-24, 0.0, 0.0, 0.0, 0.0, 1e-24, 0.0];
    let transforms = matrix.iter().flat_map(|number| number.to_le_bytes()).collect::<Vec<u8>>().into();
    let overflowing_step = v1::Step { transform_domains: vec![1], transforms, ..step(2, &[1], &[f32::MAX; 2]) };
    writer.send_step(overflowing_step).await;
    let rejection = writer.receive_rejection().await;
    assert!(rejection.field == "step.q" && rejection.given.contains("domain 'right'"), "{rejection:?}");
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
    assert!(
        !reference(&strips_with_attributes()).fills_gl_buffers(),
        "expected a deformer that does not fill the renderer's buffers"
    );
}
