//! Steps over the wire: the scene shows the acknowledged steps, under both policies.

use modalcast::engine::{Delivery, OutputSpec, StepSelector};
use modalcast_model::deform::VertexAttributes;
use modalcast_proto::v1;
use v1::Policy;
use v1::drive_scene_response::Kind as ResponseKind;

use crate::service_harness::{
    Server, get_vertices, next_vertices, reference_vertices, sheet, step, strips, with_timeout,
};

fn vertices_of(scene: &str) -> v1::GetVerticesRequest {
    v1::GetVerticesRequest { scene: scene.into(), ..v1::GetVerticesRequest::default() }
}

#[tokio::test(flavor = "multi_thread")]
async fn acknowledged_steps_have_vertices_of_the_reference() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let mut driver = server.drive("strips", Policy::Lossless, 0).await;
    let mut turned = step(1, &[1], &[0.5, -0.25]);
    let turn = [0.0_f32, -1.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, -3.0];
    turned.transform_domains = vec![1];
    turned.transforms = turn.iter().flat_map(|number| number.to_le_bytes()).collect::<Vec<u8>>().into();
    let steps = [step(0, &[], &[0.1, 0.2, 0.3, 0.4]), turned, step(7, &[0], &[0.75, 0.0])];
    for sent in 0..steps.len() {
        let ack = driver.step_acknowledged(steps[sent].clone()).await;
        let stages: Vec<&str> = ack.stages.iter().map(|stage| stage.stage.as_str()).collect();
        assert_eq!(stages, ["parse", "queue", "deform"]);
        let got = get_vertices(&server, vertices_of("strips")).await.expect("vertices");
        assert_eq!((got.positions.clone(), got.normals.clone()), reference_vertices(&strips(), &steps[..=sent]));
        let want = v1::StepId { run: 1, number: steps[sent].number, time: steps[sent].time };
        assert_eq!(got.step(), want);
    }
    // Control: other steps give other vertices.
    assert_ne!(reference_vertices(&strips(), &steps[..2]), reference_vertices(&strips(), &steps));
    driver.finish().await;
}

/// The stream ends after the requested number of steps.
#[tokio::test(flavor = "multi_thread")]
async fn lossless_subscriber_gets_every_step_in_order() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let request = v1::StreamVerticesRequest {
        scene: "strips".into(),
        selection: Some(v1::VertexSelection { domains: vec![1], positions_only: true, ..Default::default() }),
        delivery: v1::Delivery::Lossless.into(),
        steps: 30,
    };
    // Subscribing needs no step and no writer.
    let mut stream =
        server.vertices().await.stream_vertices(request).await.expect("expected a subscription").into_inner();
    let mut driver = server.drive("strips", Policy::Lossless, 4).await;
    let steps: Vec<_> = (0..40).map(|number| step(number * 2, &[1], &[0.01 * number as f32, 1.0])).collect();
    let read = async {
        for sent in 0..30 {
            let got =
                next_vertices(&mut stream).await.expect("expected another message").expect("expected a valid step");
            assert_eq!((got.step().number, got.head.skipped), (steps[sent].number, 0));
            assert_eq!(got.positions, reference_vertices(&strips(), &steps[..=sent]).0[12..]);
            assert!(got.normals.is_empty());
        }
        assert!(next_vertices(&mut stream).await.expect("a clean end").is_none());
    };
    let write = async {
        for step in &steps {
            driver.step_acknowledged(step.clone()).await;
        }
    };
    tokio::join!(read, write);
}

/// Steps are computed while the vertices of earlier steps are still being sent.
#[tokio::test(flavor = "multi_thread")]
async fn overlapped_steps_keep_their_order_and_vertices() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let engine = server.engine.find("strips").expect("open");
    let mut feeds = Vec::new();
    for delivery in [Delivery::Lossless, Delivery::Lossless, Delivery::Latest] {
        feeds.push(engine.subscribe(OutputSpec::Vertices(VertexAttributes::VERTICES), delivery).await.expect("a feed"));
    }
    let steps: Vec<_> = (0..40).map(|number| step(number, &[1], &[0.01 * number as f32, 1.0])).collect();
    let mut driver = server.drive("strips", Policy::Lossless, 40).await;
    // All steps are sent at once, so that a step is always queued.
    for step in &steps {
        driver.step(step.clone()).await;
    }
    let judge = |shown: &modalcast::engine::StepOutput| {
        let modalcast::engine::OutputBody::Vertices(surface) = &shown.body else { panic!("not vertices") };
        let sent = shown.step.number as usize;
        let stages: Vec<_> = shown.stages.iter().map(|(stage, _)| stage.name()).collect();
        assert_eq!(stages, ["parse", "queue", "deform", "copy"]);
        assert_eq!(surface.positions, reference_vertices(&strips(), &steps[..=sent]).0, "step {sent}");
        assert_ne!(surface.positions, reference_vertices(&strips(), &steps[..=(sent + 1) % 40]).0, "negative control");
        sent
    };
    let mut latest = feeds.pop().expect("three");
    let seen = judge(&with_timeout(latest.next()).await.expect("the newest"));
    drop(latest);
    assert!(seen < 40);
    for sent in 0..40 {
        for feed in &mut feeds {
            let shown = with_timeout(feed.next()).await.expect("expected another message");
            assert_eq!((judge(&shown), shown.skipped), (sent, 0));
        }
    }
    for sent in 0..40 {
        assert!(matches!(driver.reply().await, ResponseKind::Ack(ack) if ack.step == sent));
    }
    driver.finish().await;
}

/// A subscriber that does not read holds back the writer. A step beyond the window is refused.
#[tokio::test(flavor = "multi_thread")]
async fn unread_lossless_feed_applies_back_pressure() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let mut feed = server
        .engine
        .find("strips")
        .expect("open")
        .subscribe(OutputSpec::Vertices(VertexAttributes::VERTICES), Delivery::Lossless)
        .await
        .expect("a feed");
    let mut driver = server.drive("strips", Policy::Lossless, 2).await;
    // Two steps are queued in the feed. The third is computed but not acknowledged, the fourth waits, and the fifth
    // exceeds the window.
    driver.step_acknowledged(step(1, &[0], &[0.1, 0.0])).await;
    driver.step_acknowledged(step(2, &[0], &[0.2, 0.0])).await;
    for number in 3..=5 {
        driver.step(step(number, &[0], &[number as f32 / 10.0, 0.0])).await;
    }
    let rejection = driver.rejection().await;
    assert_eq!((rejection.step, rejection.field.as_str()), (Some(5), "window"));
    assert_eq!(rejection.expected, "at most 2 steps without acknowledgement");
    // Reading releases the remaining steps. The refused step was not applied.
    for number in 1..=4 {
        assert_eq!(with_timeout(feed.next()).await.expect("expected another message").step.number, number);
    }
    for number in 3..=4 {
        assert!(matches!(driver.reply().await, ResponseKind::Ack(ack) if ack.step == number));
    }
    let got = get_vertices(&server, vertices_of("strips")).await.expect("vertices");
    assert_eq!(got.positions, reference_vertices(&strips(), &[step(4, &[0], &[0.4, 0.0])]).0);
}

#[tokio::test(flavor = "multi_thread")]
async fn stalled_subscriber_is_cut_off_and_the_writer_goes_on() {
    let stall_timeout = std::time::Duration::from_millis(50);
    let server = Server::start_with(|config| modalcast::config::Config { stall_timeout, ..config }).await;
    server.open("strips").await;
    let mut feed = server
        .engine
        .find("strips")
        .expect("open")
        .subscribe(OutputSpec::Vertices(VertexAttributes::VERTICES), Delivery::Lossless)
        .await
        .expect("a feed");
    let mut driver = server.drive("strips", Policy::Lossless, 1).await;
    for number in 1..=6 {
        driver.step_acknowledged(step(number, &[0], &[0.1, 0.0])).await;
    }
    let cut = with_timeout(feed.disconnected()).await;
    assert!(matches!(cut, modalcast_model::error::Error::Busy { .. }), "{cut}");
    with_timeout(feed.next()).await.expect("the first that it held");
    with_timeout(feed.next()).await.expect("the second");
    assert_eq!(with_timeout(feed.next()).await.expect_err("the end"), cut);
}

/// The final state equals that after applying every step.
#[tokio::test(flavor = "multi_thread")]
async fn latest_policy_merges_steps_and_counts_skipped_ones() {
    let server = Server::start_default().await;
    server.open("sheet").await;
    let mut driver = server.drive("sheet", Policy::Latest, 4).await;
    let transform = |offset: f32| -> Vec<u8> {
        let rows = [1.0, 0.0, 0.0, offset, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0_f32];
        rows.iter().flat_map(|number| number.to_le_bytes()).collect()
    };
    // Only the first step moves the sheet, so a lost step changes the result.
    let mut steps = vec![v1::Step { transforms: transform(5.0).into(), ..step(1, &[], &[]) }];
    steps.extend((2..=200).map(|number| step(number, &[0], &[0.001 * number as f32, 0.5, 0.0, 1.0])));
    for step in &steps {
        driver.step(step.clone()).await;
    }
    let mut acks = 0;
    let last = loop {
        match driver.reply().await {
            ResponseKind::Ack(ack) if ack.step == 200 => break ack,
            ResponseKind::Ack(_) => acks += 1,
            other => panic!("{other:?}"),
        }
    };
    assert!(last.skipped > 0, "200 steps were sent at once and {acks} acknowledged before the last");
    assert!(last.skipped + acks < 200);
    let got = get_vertices(&server, vertices_of("sheet")).await.expect("vertices");
    assert_eq!((got.positions, got.normals), reference_vertices(&sheet(), &steps));
}

#[tokio::test(flavor = "multi_thread")]
async fn latest_subscriber_gets_current_step_and_skip_count() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let mut driver = server.drive("strips", Policy::Lossless, 0).await;
    driver.step_acknowledged(step(3, &[0], &[0.1, 0.0])).await;
    let host = server.engine.find("strips").expect("open");
    let mut feed =
        host.subscribe(OutputSpec::Vertices(VertexAttributes::VERTICES), Delivery::Latest).await.expect("a feed");
    let first = with_timeout(feed.next()).await.expect("the current step");
    assert_eq!((first.step.number, first.skipped), (3, 0));
    for number in 4..=8 {
        driver.step_acknowledged(step(number, &[0], &[0.1, 0.0])).await;
    }
    let second = with_timeout(feed.next()).await.expect("the newest step");
    assert_eq!((second.step.number, second.skipped), (8, 4));
}

/// The refusal of the second writer names the address and the run of the first. The same stream opens the scene once
/// the first writer has left.
#[tokio::test(flavor = "multi_thread")]
async fn second_writer_waits_for_the_first_to_leave() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let mut first = server.drive("strips", Policy::Lossless, 0).await;
    first.step_acknowledged(step(100, &[0], &[0.1, 0.0])).await;
    let mut second = crate::service_harness::Driver::connect(server.channel().await).await;
    let ResponseKind::Rejection(refusal) = second.open("strips", Policy::Lossless, 0).await else { panic!("let in") };
    assert!(refusal.field.contains("writer"), "{refusal:?}");
    assert!(refusal.given.contains("127.0.0.1") && refusal.given.contains("run 1"), "{refusal:?}");
    first.step_acknowledged(step(101, &[0], &[0.2, 0.0])).await;
    first.finish().await;
    // The refused stream can open the scene now, and its step numbers start again.
    let ResponseKind::Opened(opened) = second.open("strips", Policy::Latest, 100_000).await else { panic!("kept out") };
    assert_eq!((opened.run, opened.window), (2, 256));
    assert_eq!(opened.scene.and_then(|scene| scene.last_step).map(|step| (step.run, step.number)), Some((1, 101)));
    second.step_acknowledged(step(0, &[0], &[0.3, 0.0])).await;
    second.disconnect();
    let third = async {
        loop {
            let mut third = crate::service_harness::Driver::connect(server.channel().await).await;
            if let ResponseKind::Opened(opened) = third.open("strips", Policy::Lossless, 0).await {
                return opened.run;
            }
        }
    };
    assert_eq!(with_timeout(third).await, 3);
}

#[tokio::test(flavor = "multi_thread")]
async fn requests_of_departed_clients_free_their_slots() {
    let server = Server::start_with(|config| modalcast::config::Config { max_pending_requests: 4, ..config }).await;
    server.open("strips").await;
    let step = Some(v1::get_vertices_request::Step::MinimumStep(99));
    let never = v1::GetVerticesRequest { deadline_ms: 600_000, step, ..vertices_of("strips") };
    let mut client = server.vertices().await;
    // Eight requests wait for a step that never comes. Four of them are refused, and so is every later request.
    let mut waits = Vec::new();
    for _ in 0..8 {
        waits.push(client.get_vertices(never.clone()).await.expect("expected a stream").into_inner());
    }
    let mut held = tokio::task::JoinSet::new();
    for mut stream in waits {
        held.spawn(async move { stream.message().await.expect_err("no step").code() });
    }
    for _ in 0..4 {
        let code = with_timeout(held.join_next()).await.expect("one of eight").expect("expected the task not to panic");
        assert_eq!(code, tonic::Code::ResourceExhausted);
    }
    let busy = get_vertices(&server, vertices_of("strips")).await.expect_err("all places are taken");
    assert_eq!(busy.code(), tonic::Code::ResourceExhausted);
    held.shutdown().await;
    let served = async { while get_vertices(&server, vertices_of("strips")).await.is_err() {} };
    with_timeout(served).await;
}

/// A request for a step that has passed is refused with the number of the step.
#[tokio::test(flavor = "multi_thread")]
async fn requests_wait_for_exact_and_minimum_steps() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let mut driver = server.drive("strips", Policy::Lossless, 0).await;
    let host = server.engine.find("strips").expect("open");
    let mut waiting = [StepSelector::Exact(2), StepSelector::Minimum(3), StepSelector::Exact(5)]
        .map(|selector| Box::pin(host.request_output(selector, OutputSpec::Vertices(VertexAttributes::VERTICES))));
    for request in &mut waiting {
        // One poll registers the request.
        assert!(tokio::time::timeout(std::time::Duration::ZERO, request).await.is_err(), "there is no step yet");
    }
    for number in [1, 2, 4, 5] {
        driver.step_acknowledged(step(number, &[0], &[number as f32, 0.0])).await;
    }
    let mut shown = Vec::new();
    for request in waiting {
        shown.push(with_timeout(request).await.expect("its step").step.number);
    }
    assert_eq!(shown, [2, 4, 5]);
    let ask = |step| v1::GetVerticesRequest { step: Some(step), ..vertices_of("strips") };
    use v1::get_vertices_request::Step::{ExactStep, MinimumStep};
    let gone = get_vertices(&server, ask(ExactStep(4))).await.expect_err("it has passed");
    assert_eq!(gone.code(), tonic::Code::FailedPrecondition);
    let why = crate::service_harness::rejection_details(&gone);
    assert!(why.given == "4" && why.expected.starts_with('5'), "{why:?}");
    let begin = std::time::Instant::now();
    let late = v1::GetVerticesRequest { deadline_ms: 80, ..ask(MinimumStep(99)) };
    let late = get_vertices(&server, late).await.expect_err("it never comes");
    assert_eq!(late.code(), tonic::Code::DeadlineExceeded);
    assert!(begin.elapsed() < std::time::Duration::from_secs(5), "{:?}", begin.elapsed());
}
