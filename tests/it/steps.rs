//! Steps over the wire: vertices of acknowledged steps, back-pressure, one writer after another, and requests that wait
//! for a step.

use modalcast::admission::Account;
use modalcast::engine::{Delivery, OutputSpec, StepSelector, Subscription};
use modalcast_model::deform::VertexAttributes;
use modalcast_proto::v1;
use v1::drive_scene_response::Kind as ResponseKind;
use v1::vertex_service_client::VertexServiceClient;

use crate::service_harness::{
    DEFAULT_WINDOW, Server, StepWriter, exact_step, get_vertices, minimum_step, next_vertices, reference_vertices,
    select, sheet, step, strips, with_timeout,
};

fn vertex_request(scene: &str) -> v1::GetVerticesRequest {
    v1::GetVerticesRequest { scene: scene.into(), ..v1::GetVerticesRequest::default() }
}

/// Subscribes to positions and normals of all domains of the open scene "strips".
async fn subscribe_vertices(server: &Server, delivery: Delivery) -> Subscription {
    let scene = server.engine.find("strips").expect("expected an open scene");
    let spec = OutputSpec::Vertices(VertexAttributes::POSITIONS_AND_NORMALS);
    scene.subscribe(&Account::server(), spec, delivery).await.expect("expected a subscription")
}

#[tokio::test(flavor = "multi_thread")]
async fn acknowledged_steps_have_vertices_of_the_reference() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let mut writer = server.drive_lossless("strips").await;
    let mut rotated_step = step(1, &[1], &[0.5, -0.25]);
    // Row-major 3 x 4 matrix: a rotation by 90 degrees about z, then a translation by (2, 0, -3).
    let transform = [0.0_f32, -1.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, -3.0];
    rotated_step.transform_domains = vec![1];
    rotated_step.transforms = transform.iter().flat_map(|number| number.to_le_bytes()).collect::<Vec<u8>>().into();
    let steps = [step(0, &[], &[0.1, 0.2, 0.3, 0.4]), rotated_step, step(7, &[0], &[0.75, 0.0])];
    for index in 0..steps.len() {
        let ack = writer.send_step_and_wait(steps[index].clone()).await;
        let stages: Vec<&str> = ack.stages.iter().map(|stage| stage.stage.as_str()).collect();
        assert_eq!(stages, ["parse", "queue", "deform"]);
        let reply = get_vertices(&server, vertex_request("strips")).await.expect("expected vertices");
        let expected = reference_vertices(&strips(), &steps[..=index]);
        assert_eq!((&reply.positions, &reply.normals), (&expected.positions, &expected.normals));
        let expected_step = v1::StepId { run: 1, number: steps[index].number, time: steps[index].time };
        assert_eq!(reply.step(), expected_step);
    }
    // Negative control: the last step changes the vertices.
    assert_ne!(reference_vertices(&strips(), &steps[..2]), reference_vertices(&strips(), &steps));
    writer.finish().await;
}

/// The stream ends after the requested number of 30 steps, although the writer sends 40.
#[tokio::test(flavor = "multi_thread")]
async fn lossless_subscriber_gets_every_step_in_order() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let request = v1::StreamVerticesRequest {
        scene: "strips".into(),
        selection: select(&[1], &[v1::Attribute::Positions]),
        delivery: v1::Delivery::Lossless.into(),
        steps: 30,
        max_hz: 0.0,
    };
    // Subscribing needs no step and no writer.
    let mut stream =
        server.vertices().await.stream_vertices(request).await.expect("expected a subscription").into_inner();
    let mut writer = server.drive("strips", v1::Delivery::Lossless, 4).await;
    let steps: Vec<_> = (0..40).map(|number| step(number * 2, &[1], &[0.01 * number as f32, 1.0])).collect();
    let read_steps = async {
        for index in 0..30 {
            let vertices =
                next_vertices(&mut stream).await.expect("expected another message").expect("expected a valid step");
            assert_eq!((vertices.step().number, vertices.head.skipped), (steps[index].number, 0));
            // Domain 1 follows the 12 numbers of domain 0: four vertices times three axes.
            assert_eq!(vertices.positions, reference_vertices(&strips(), &steps[..=index]).positions[12..]);
            assert!(vertices.normals.is_empty());
        }
        assert!(next_vertices(&mut stream).await.expect("expected the stream to end without an error").is_none());
    };
    let send_steps = async {
        for step in &steps {
            writer.send_step_and_wait(step.clone()).await;
        }
    };
    tokio::join!(read_steps, send_steps);
}

/// Steps are computed while the vertices of earlier steps are still being sent.
#[tokio::test(flavor = "multi_thread")]
async fn overlapped_steps_keep_their_order_and_vertices() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let mut subscriptions = Vec::new();
    for delivery in [Delivery::Lossless, Delivery::Lossless, Delivery::Latest] {
        subscriptions.push(subscribe_vertices(&server, delivery).await);
    }
    let steps: Vec<_> = (0..40).map(|number| step(number, &[1], &[0.01 * number as f32, 1.0])).collect();
    let mut writer = server.drive("strips", v1::Delivery::Lossless, 40).await;
    // All steps are sent at once. While the server computes a step, the next one is thus queued.
    for step in &steps {
        writer.send_step(step.clone()).await;
    }
    let check_output = async |output: &modalcast::engine::StepOutput| {
        let modalcast::engine::OutputBody::Vertices(vertices) = &output.body else { panic!("expected vertices") };
        let vertices = with_timeout(vertices.wait()).await.expect("expected vertices");
        let surface = &vertices.surface;
        let index = output.step.number as usize;
        let stages: Vec<_> = output.stages.iter().map(|(stage, _)| stage.name()).collect();
        assert_eq!(stages, ["parse", "queue", "deform"]);
        assert_eq!(surface.positions, reference_vertices(&strips(), &steps[..=index]).positions, "step {index}");
        assert_ne!(
            surface.positions,
            reference_vertices(&strips(), &steps[..=(index + 1) % 40]).positions,
            "negative control: expected other positions in the next step"
        );
        index
    };
    let mut latest_subscription = subscriptions.pop().expect("expected three subscriptions");
    let latest_index = check_output(&with_timeout(latest_subscription.next()).await.expect("expected a step")).await;
    drop(latest_subscription);
    assert!(latest_index < 40);
    for index in 0..40 {
        for subscription in &mut subscriptions {
            let output = with_timeout(subscription.next()).await.expect("expected another message");
            assert_eq!((check_output(&output).await, output.skipped), (index, 0));
        }
    }
    for index in 0..40 {
        assert!(matches!(writer.receive_reply().await, ResponseKind::Ack(ack) if ack.step == index));
    }
    writer.finish().await;
}

/// A subscriber that does not read applies back-pressure to the writer. A step beyond the window is rejected.
#[tokio::test(flavor = "multi_thread")]
async fn unread_lossless_subscription_applies_back_pressure() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let mut subscription = subscribe_vertices(&server, Delivery::Lossless).await;
    let mut writer = StepWriter::connect(server.channel().await).await;
    let (delivery, overflow) = (v1::Delivery::Lossless.into(), v1::Overflow::Reject.into());
    let open = v1::OpenDrive { scene: "strips".into(), delivery, overflow, window: 2, ..v1::OpenDrive::default() };
    writer.send(v1::drive_scene_request::Kind::Open(open)).await;
    assert!(matches!(writer.receive_reply().await, ResponseKind::Opened(_)));
    // Steps 1 and 2 are queued in the subscription. Step 3 is computed but not acknowledged, step 4 waits, and step 5
    // exceeds the window of two steps.
    writer.send_step_and_wait(step(1, &[0], &[0.1, 0.0])).await;
    writer.send_step_and_wait(step(2, &[0], &[0.2, 0.0])).await;
    for number in 3..=5 {
        writer.send_step(step(number, &[0], &[number as f32 / 10.0, 0.0])).await;
    }
    let rejection = writer.receive_rejection().await;
    assert_eq!((rejection.step, rejection.reason()), (Some(5), v1::Reason::WindowFull));
    assert_eq!(rejection.expected, "at most 2 steps without acknowledgment");
    // Reading releases the remaining steps. The rejected step was not applied.
    for number in 1..=4 {
        assert_eq!(with_timeout(subscription.next()).await.expect("expected another message").step.number, number);
    }
    for number in 3..=4 {
        assert!(matches!(writer.receive_reply().await, ResponseKind::Ack(ack) if ack.step == number));
    }
    let reply = get_vertices(&server, vertex_request("strips")).await.expect("expected vertices");
    assert_eq!(reply.positions, reference_vertices(&strips(), &[step(4, &[0], &[0.4, 0.0])]).positions);
}

#[tokio::test(flavor = "multi_thread")]
async fn stalled_subscriber_is_disconnected_and_writer_continues() {
    let stall_budget = std::time::Duration::from_millis(50);
    let server = Server::start_with(|config| modalcast::config::Config { stall_budget, ..config }).await;
    server.open("strips").await;
    let mut subscription = subscribe_vertices(&server, Delivery::Lossless).await;
    let mut writer = server.drive("strips", v1::Delivery::Lossless, 1).await;
    for number in 1..=6 {
        writer.send_step_and_wait(step(number, &[0], &[0.1, 0.0])).await;
    }
    let error = with_timeout(subscription.disconnected()).await;
    assert!(matches!(error, modalcast_model::error::Error::SlowSubscriber { .. }), "{error}");
    with_timeout(subscription.next()).await.expect("expected the first queued step");
    with_timeout(subscription.next()).await.expect("expected the second queued step");
    assert_eq!(with_timeout(subscription.next()).await.expect_err("expected the subscription to end"), error);
}

/// Merging loses no update: the final state equals the state after applying every step.
#[tokio::test(flavor = "multi_thread")]
async fn latest_policy_merges_steps_and_counts_skipped_ones() {
    let server = Server::start_default().await;
    server.open("sheet").await;
    let mut writer = server.drive("sheet", v1::Delivery::Latest, 4).await;
    // Row-major 3 x 4 matrix: a translation by 5 along x. Only step 1 moves the sheet, so the final vertices show
    // whether step 1 was lost.
    let matrix = [1.0, 0.0, 0.0, 5.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0_f32];
    let transforms: Vec<u8> = matrix.iter().flat_map(|number| number.to_le_bytes()).collect();
    let mut steps = vec![v1::Step { transforms: transforms.into(), ..step(1, &[], &[]) }];
    steps.extend((2..=200).map(|number| step(number, &[0], &[0.001 * number as f32, 0.5, 0.0, 1.0])));
    for step in &steps {
        writer.send_step(step.clone()).await;
    }
    let mut earlier_acks = 0;
    let last_ack = loop {
        match writer.receive_reply().await {
            ResponseKind::Ack(ack) if ack.step == 200 => break ack,
            ResponseKind::Ack(_) => earlier_acks += 1,
            kind => panic!("expected an acknowledgment, got {kind:?}"),
        }
    };
    assert!(last_ack.skipped > 0, "expected skipped steps, got {earlier_acks} acknowledgments before the last");
    assert!(last_ack.skipped + earlier_acks < 200);
    let reply = get_vertices(&server, vertex_request("sheet")).await.expect("expected vertices");
    let expected = reference_vertices(&sheet(), &steps);
    assert_eq!((reply.positions, reply.normals), (expected.positions, expected.normals));
}

#[tokio::test(flavor = "multi_thread")]
async fn latest_subscriber_gets_current_step_and_skip_count() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let mut writer = server.drive_lossless("strips").await;
    writer.send_step_and_wait(step(3, &[0], &[0.1, 0.0])).await;
    let mut subscription = subscribe_vertices(&server, Delivery::Latest).await;
    let first_output = with_timeout(subscription.next()).await.expect("expected the current step");
    assert_eq!((first_output.step.number, first_output.skipped), (3, 0));
    for number in 4..=8 {
        writer.send_step_and_wait(step(number, &[0], &[0.1, 0.0])).await;
    }
    let second_output = with_timeout(subscription.next()).await.expect("expected the newest step");
    assert_eq!((second_output.step.number, second_output.skipped), (8, 4));
}

/// The rejection of the second writer names the run of the first writer, but not its address. After the first writer
/// has ended its stream, the second writer can drive the scene.
#[tokio::test(flavor = "multi_thread")]
async fn second_writer_is_rejected_until_the_first_ends() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let mut first_writer = server.drive_lossless("strips").await;
    first_writer.send_step_and_wait(step(100, &[0], &[0.1, 0.0])).await;
    let mut second_writer = StepWriter::connect(server.channel().await).await;
    let ResponseKind::Rejection(rejection) = second_writer.open("strips", v1::Delivery::Lossless, DEFAULT_WINDOW).await
    else {
        panic!("expected a rejection")
    };
    assert_eq!(rejection.reason(), v1::Reason::WriterLeaseTaken);
    assert!(rejection.given.contains("run 1"), "{rejection:?}");
    assert!(!format!("{rejection:?}").contains("127.0.0.1"), "expected no client address: {rejection:?}");
    first_writer.send_step_and_wait(step(101, &[0], &[0.2, 0.0])).await;
    first_writer.finish().await;
    // A new run may start at any step number. The server limits the window to 256 steps.
    let ResponseKind::Opened(opened) = second_writer.open("strips", v1::Delivery::Latest, 100_000).await else {
        panic!("expected the stream to open")
    };
    assert_eq!((opened.run, opened.window), (2, 256));
    assert_eq!(opened.scene.and_then(|scene| scene.last_step).map(|step| (step.run, step.number)), Some((1, 101)));
    second_writer.send_step_and_wait(step(0, &[0], &[0.3, 0.0])).await;
    // Ending the stream without waiting also releases the scene, after a short time.
    second_writer.disconnect();
    let open_third = async {
        loop {
            let mut third_writer = StepWriter::connect(server.channel().await).await;
            if let ResponseKind::Opened(opened) =
                third_writer.open("strips", v1::Delivery::Lossless, DEFAULT_WINDOW).await
            {
                return opened.run;
            }
        }
    };
    assert_eq!(with_timeout(open_third).await, 3);
}

#[tokio::test(flavor = "multi_thread")]
async fn canceled_requests_do_not_count_as_pending() {
    let server = Server::start_with(|config| modalcast::config::Config { max_pending_requests: 4, ..config }).await;
    server.open("strips").await;
    let step = minimum_step(99);
    let pending_request = v1::GetVerticesRequest { deadline_ms: 600_000, step, ..vertex_request("strips") };
    let mut client = server.vertices().await;
    // Eight requests wait for a step that is never sent. The server keeps four of them pending. It rejects the other
    // four and every later request.
    let mut streams = Vec::new();
    for _ in 0..8 {
        streams.push(client.get_vertices(pending_request.clone()).await.expect("expected a stream").into_inner());
    }
    let mut pending_requests = tokio::task::JoinSet::new();
    for mut stream in streams {
        pending_requests.spawn(async move { stream.message().await.expect_err("expected an error").code() });
    }
    for _ in 0..4 {
        let code = with_timeout(pending_requests.join_next())
            .await
            .expect("expected eight tasks")
            .expect("expected the task not to panic");
        assert_eq!(code, tonic::Code::ResourceExhausted);
    }
    let get_vertices = async |mut client: VertexServiceClient<tonic::transport::Channel>| {
        client.get_vertices(vertex_request("strips")).await?.into_inner().message().await
    };
    let error = get_vertices(client.clone()).await.expect_err("expected a busy error");
    assert_eq!(error.code(), tonic::Code::ResourceExhausted);
    // Cancels the four pending requests. The server then accepts requests again.
    pending_requests.shutdown().await;
    let retry = async { while get_vertices(client.clone()).await.is_err() {} };
    with_timeout(retry).await;
}

/// A request for exactly one step, or for a step with at least a given number, waits until the step is computed. A
/// request for an earlier step than the current one is rejected.
#[tokio::test(flavor = "multi_thread")]
async fn requests_wait_for_exact_and_minimum_steps() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let mut writer = server.drive_lossless("strips").await;
    let scene_handle = server.engine.find("strips").expect("expected an open scene");
    let account = Account::server();
    let mut pending_requests = [
        StepSelector::Exact { run: 0, number: 2 },
        StepSelector::Minimum { run: 0, number: 3 },
        StepSelector::Exact { run: 0, number: 5 },
    ]
    .map(|selector| {
        Box::pin(scene_handle.request_output(
            &account,
            selector,
            OutputSpec::Vertices(VertexAttributes::POSITIONS_AND_NORMALS),
        ))
    });
    for pending_request in &mut pending_requests {
        // One poll registers the request.
        assert!(
            tokio::time::timeout(std::time::Duration::ZERO, pending_request).await.is_err(),
            "expected no step yet"
        );
    }
    for number in [1, 2, 4, 5] {
        writer.send_step_and_wait(step(number, &[0], &[number as f32, 0.0])).await;
    }
    let mut step_numbers = Vec::new();
    for pending_request in pending_requests {
        step_numbers.push(with_timeout(pending_request).await.expect("expected the requested step").step.number);
    }
    // The request for at least step 3 gets step 4, because there is no step 3.
    assert_eq!(step_numbers, [2, 4, 5]);
    let request_step = |step| v1::GetVerticesRequest { step, ..vertex_request("strips") };
    let status =
        get_vertices(&server, request_step(exact_step(4))).await.expect_err("expected an error of a past step");
    assert_eq!(status.code(), tonic::Code::FailedPrecondition);
    let rejection = crate::service_harness::rejection_details(&status);
    assert!(rejection.given == "4" && rejection.expected.starts_with("run 1, step 5"), "{rejection:?}");
    let unanswered_request = v1::GetVerticesRequest { deadline_ms: 80, ..request_step(minimum_step(99)) };
    let status = get_vertices(&server, unanswered_request).await.expect_err("expected a timeout");
    assert_eq!(status.code(), tonic::Code::DeadlineExceeded);
}
