//! Steps that are larger than one message should be: the client sends them in parts, and the server assembles them.

use modalcast::config::Config;
use modalcast_client::{Client, Delivery, DomainTransform, DriveRequest, Error, Reason, Step};
use modalcast_proto::v1;
use v1::drive_scene_response::Kind as ResponseKind;

use crate::service_harness::{
    DEFAULT_WINDOW, Server, StepWriter, crowd, get_vertices, reference_vertices, select, step, with_timeout,
};

/// Translations of all 70,000 domains, 3.4 MB.
fn translations(number: u64) -> Step {
    let mut step = Step::new(number, 0.0);
    for domain in 0..70_000 {
        let translation = [domain as f32, number as f32, 0.5];
        step.set_domain_transform(
            domain,
            &DomainTransform::Affine([
                1.0,
                0.0,
                0.0,
                translation[0],
                0.0,
                1.0,
                0.0,
                translation[1],
                0.0,
                0.0,
                1.0,
                translation[2],
            ]),
        );
    }
    step
}

#[tokio::test(flavor = "multi_thread")]
async fn large_step_arrives_as_it_was_sent() {
    let server = Server::start_with(|config| Config { message_bytes: 4 << 20, ..config }).await;
    server.open("crowd").await;
    let client = Client::connect(&server.address).await.expect("expected a connection");
    let mut steps = client.drive(&DriveRequest::new("crowd", Delivery::Lossless)).await.expect("expected a stream");
    for number in 1..=2 {
        steps.step(&translations(number)).await.expect("expected an accepted step");
    }
    with_timeout(steps.flush()).await.expect("expected acknowledgments");
    let attributes = [v1::Attribute::Positions];
    let selection = select(&[0, 40_000, 69_999], &attributes);
    let request = v1::GetVerticesRequest { scene: "crowd".into(), selection, ..Default::default() };
    let received = get_vertices(&server, request).await.expect("expected vertices");
    let expected = reference_vertices(&crowd(), &[translations(2).to_wire()]).positions;
    // Four vertices of three numbers per domain.
    let expected: Vec<f32> =
        [0, 40_000, 69_999].iter().flat_map(|domain| expected[12 * domain..][..12].to_vec()).collect();
    assert_eq!((received.step().number, received.positions), (2, expected));
}

/// A step whose parts exceed the limit is rejected once, and the stream continues.
#[tokio::test(flavor = "multi_thread")]
async fn step_above_the_limit_is_rejected_once() {
    let server = Server::start_with(|config| Config { message_bytes: 1 << 20, ..config }).await;
    server.open("crowd").await;
    let client = Client::connect(&server.address).await.expect("expected a connection");
    let mut steps = client.drive(&DriveRequest::new("crowd", Delivery::Lossless)).await.expect("expected a stream");
    // The rejection may arrive before the last part is sent.
    let error = match steps.step(&translations(1)).await {
        Ok(()) => with_timeout(steps.flush()).await.expect_err("expected a rejection"),
        Err(error) => error,
    };
    let Error::Rejected(rejection) = &error else { panic!("{error:?}") };
    assert_eq!((rejection.step, rejection.reason, rejection.field.as_str()), (Some(1), Reason::InvalidField, "step"));
    steps.step(&Step::new(2, 0.0).q(0, &[0.25, 0.5])).await.expect("expected a sent step");
    with_timeout(steps.flush()).await.expect("expected an accepted step");
    assert_eq!(steps.summary().rejected, 1);
}

/// A part without its successor ends the stream after the message timeout, so that its memory is released.
#[tokio::test(flavor = "multi_thread")]
async fn missing_part_of_a_step_ends_the_stream() {
    let message_timeout = std::time::Duration::from_millis(100);
    let server = Server::start_with(|config| Config { message_timeout, ..config }).await;
    server.open("strips").await;
    let mut writer = StepWriter::connect(server.channel().await).await;
    let opened = writer.open("strips", v1::Delivery::Lossless, DEFAULT_WINDOW).await;
    assert!(matches!(opened, ResponseKind::Opened(_)));
    writer.send_step(v1::Step { has_more: true, ..step(1, &[0], &[0.1, 0.2]) }).await;
    let status = with_timeout(writer.replies.message()).await.expect_err("expected the stream to end");
    assert_eq!(status.code(), tonic::Code::DeadlineExceeded);
}
