//! The stall budget of a writer: readers that make it wait for too long end with the step from which they lack steps, and
//! all others receive every step.

use std::time::Duration;

use modalcast::config::{Config, MAX_STALL_BUDGET};
use modalcast_proto::v1;
use tonic::transport::{Channel, Endpoint};
use tonic::{Code, Status, Streaming};
use tonic_types::StatusExt as _;
use v1::drive_scene_request::Kind as RequestKind;
use v1::drive_scene_response::Kind as ResponseKind;
use v1::state_service_client::StateServiceClient;
use v1::stream_states_response::Part as StatePart;
use v1::stream_vertices_response::Part as VertexPart;
use v1::vertex_service_client::VertexServiceClient;
use v1::{Delivery, Reason};

use crate::service_harness::{Server, StepWriter, rejection_details, step, with_timeout};

/// Number of steps of a writer: more than an unread stream of vertices buffers.
const STEPS: u64 = 40;

/// A stall budget that every unread reader exceeds soon.
const SHORT_BUDGET: Duration = Duration::from_millis(50);

/// A stall budget that no reader exceeds because the machine is busy, and that unread readers exceed in seconds.
const LONG_BUDGET: Duration = Duration::from_secs(6);

async fn server_with(stall_budget: Duration) -> Server {
    let server = Server::start_with(|config| Config { stall_budget, ..config }).await;
    server.open("sheet").await;
    server
}

/// A connection that receives at most 64 KiB of a stream that is not read. A step of "sheet" has 2 MB.
async fn small_windows(server: &Server) -> Channel {
    let endpoint = Endpoint::from_shared(server.address.clone()).expect("expected a URL");
    endpoint.initial_stream_window_size(1 << 16).connect().await.expect("expected a connection")
}

async fn subscribe(channel: Channel, delivery: Delivery) -> Streaming<v1::StreamVerticesResponse> {
    let request = v1::StreamVerticesRequest { scene: "sheet".into(), delivery: delivery.into(), ..Default::default() };
    let stream = with_timeout(VertexServiceClient::new(channel).stream_vertices(request)).await;
    stream.expect("expected a subscription").into_inner()
}

fn bent(number: u64) -> v1::Step {
    step(number, &[0], &[number as f32, 0.0, 0.0, 0.0])
}

/// The steps that a stream sends completely, and the error with which it ends.
struct StreamEnd {
    complete_steps: Vec<u64>,
    status: Option<Status>,
}

/// Reads a stream up to its end, or until it has sent step `last` completely.
async fn read_until(stream: &mut Streaming<v1::StreamVerticesResponse>, last: u64) -> StreamEnd {
    let mut complete_steps = Vec::new();
    let (mut number, mut total) = (0, 0);
    while complete_steps.last() != Some(&last) {
        let chunk = match with_timeout(stream.message()).await {
            Ok(Some(v1::StreamVerticesResponse { part: Some(VertexPart::Chunk(chunk)) })) => chunk,
            Ok(Some(_)) => continue,
            Ok(None) => return StreamEnd { complete_steps, status: None },
            Err(status) => return StreamEnd { complete_steps, status: Some(status) },
        };
        if let Some(head) = &chunk.head {
            (number, total) = (head.step.expect("expected a step").number, head.total);
        }
        if chunk.offset + chunk.data.len() as u64 == total {
            complete_steps.push(number);
        }
    }
    StreamEnd { complete_steps, status: None }
}

/// Reads a stream up to the last step. Expects that it has skipped steps, and has not ended.
async fn assert_skips_steps(stream: &mut Streaming<v1::StreamVerticesResponse>) {
    let received = read_until(stream, STEPS).await;
    let skips_steps = received.complete_steps.len() < STEPS as usize;
    assert!(received.status.is_none() && skips_steps, "{:?}", received.complete_steps);
}

/// A number in the details of a status.
fn detail(status: &Status, key: &str) -> Option<u64> {
    let details = status.get_details_error_info().expect("expected an ErrorInfo");
    details.metadata.get(key).map(|text| text.parse().expect("expected a number"))
}

/// Opens a lossless step stream with a window of one step and a stall budget in milliseconds.
async fn open_writer(server: &Server, stall_budget_ms: u32) -> (StepWriter, ResponseKind) {
    let mut writer = StepWriter::connect(server.channel().await).await;
    let delivery = Delivery::Lossless.into();
    let open = v1::OpenDrive { scene: "sheet".into(), delivery, window: 1, stall_budget_ms, ..Default::default() };
    writer.send(RequestKind::Open(open)).await;
    let reply = writer.receive_reply().await;
    (writer, reply)
}

async fn send_all_steps(writer: &mut StepWriter) {
    for number in 1..=STEPS {
        writer.send_step_and_wait(bent(number)).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn slow_reader_learns_which_steps_it_lacks_and_can_resume() {
    let server = server_with(SHORT_BUDGET).await;
    let channel = small_windows(&server).await;
    let mut unread_stream = subscribe(channel.clone(), Delivery::Lossless).await;
    let mut writer = server.drive("sheet", Delivery::Lossless, 1).await;
    send_all_steps(&mut writer).await;
    let StreamEnd { complete_steps, status } = read_until(&mut unread_stream, STEPS).await;
    let status = status.expect("expected the end of a slow reader");
    assert_eq!((status.code(), rejection_details(&status).reason()), (Code::ResourceExhausted, Reason::SlowReader));
    assert_eq!(detail(&status, "received_step"), complete_steps.last().copied(), "{status:?}");
    assert_eq!(detail(&status, "missing_step"), Some(complete_steps.len() as u64 + 1), "{status:?}");
    assert_eq!(detail(&status, "missing_run"), Some(1));
    assert!(complete_steps.iter().copied().eq(1..=complete_steps.len() as u64), "{complete_steps:?}");
    assert!(status.message().contains("stall budget"), "{}", status.message());
    // The missing steps are those up to the first step of a new stream.
    let mut resumed_stream = subscribe(channel, Delivery::Lossless).await;
    writer.send_step_and_wait(bent(STEPS + 1)).await;
    assert_eq!(read_until(&mut resumed_stream, STEPS + 1).await.complete_steps, [STEPS + 1]);
}

#[tokio::test(flavor = "multi_thread")]
async fn honest_reader_receives_every_step_beside_unread_readers() {
    let server = server_with(LONG_BUDGET).await;
    let mut unread_streams = Vec::new();
    for _ in 0..3 {
        unread_streams.push(subscribe(small_windows(&server).await, Delivery::Lossless).await);
    }
    let request =
        v1::StreamStatesRequest { scene: "sheet".into(), delivery: Delivery::Lossless.into(), ..Default::default() };
    let mut states = StateServiceClient::new(server.channel().await)
        .stream_states(request)
        .await
        .expect("expected a subscription")
        .into_inner();
    let mut vertices = subscribe(server.channel().await, Delivery::Lossless).await;
    let honest_reader = tokio::spawn(async move { read_until(&mut vertices, STEPS).await });
    let mut writer = server.drive("sheet", Delivery::Lossless, 1).await;
    send_all_steps(&mut writer).await;
    for mut stream in unread_streams {
        let status = read_until(&mut stream, STEPS).await.status.expect("expected the end of a slow reader");
        assert_eq!(rejection_details(&status).reason(), Reason::SlowReader, "{status:?}");
    }
    let received = with_timeout(honest_reader).await.expect("expected no panic");
    assert!(received.complete_steps.iter().copied().eq(1..=STEPS), "{:?}", received.complete_steps);
    let mut state_numbers = Vec::new();
    while state_numbers.len() < STEPS as usize {
        let reply = with_timeout(states.message()).await.expect("expected a state").expect("expected a state");
        if let Some(StatePart::Chunk(v1::StateChunk { head: Some(head), .. })) = reply.part {
            state_numbers.push(head.step.expect("expected a step").number);
        }
    }
    assert!(state_numbers.iter().copied().eq(1..=STEPS), "{state_numbers:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn writer_with_a_large_budget_waits_for_its_readers() {
    let server = server_with(SHORT_BUDGET).await;
    let mut unread_stream = subscribe(small_windows(&server).await, Delivery::Lossless).await;
    let (mut writer, reply) = open_writer(&server, 3_600_000).await;
    let ResponseKind::Opened(opened) = reply else { panic!("expected the lease, got {reply:?}") };
    assert_eq!(opened.stall_budget_ms, 3_600_000);
    let sending = tokio::spawn(async move { send_all_steps(&mut writer).await });
    // A reader without the larger budget would have ended.
    tokio::time::sleep(4 * SHORT_BUDGET).await;
    assert!(!sending.is_finished(), "expected a writer that waits");
    let received = read_until(&mut unread_stream, STEPS).await;
    assert!(received.complete_steps.iter().copied().eq(1..=STEPS), "{:?}", received.complete_steps);
    with_timeout(sending).await.expect("expected no panic");
}

/// The allowance ends with its writer.
#[tokio::test(flavor = "multi_thread")]
async fn next_writer_has_the_default_budget() {
    let server = server_with(SHORT_BUDGET).await;
    let (writer, _) = open_writer(&server, 3_600_000).await;
    writer.finish().await;
    let mut unread_stream = subscribe(small_windows(&server).await, Delivery::Lossless).await;
    let (mut writer, reply) = open_writer(&server, 0).await;
    let ResponseKind::Opened(opened) = reply else { panic!("expected the lease, got {reply:?}") };
    assert_eq!(u128::from(opened.stall_budget_ms), SHORT_BUDGET.as_millis());
    send_all_steps(&mut writer).await;
    assert!(read_until(&mut unread_stream, STEPS).await.status.is_some());
}

#[tokio::test(flavor = "multi_thread")]
async fn stall_budget_above_a_day_is_rejected() {
    let server = server_with(SHORT_BUDGET).await;
    let limit = MAX_STALL_BUDGET.as_millis() as u32;
    let (_, reply) = open_writer(&server, limit + 1).await;
    let ResponseKind::Rejection(rejection) = reply else { panic!("expected a rejection, got {reply:?}") };
    assert_eq!((rejection.reason(), rejection.field.as_str()), (Reason::InvalidField, "open.stall_budget_ms"));
    let (_, reply) = open_writer(&server, limit).await;
    assert!(matches!(reply, ResponseKind::Opened(_)), "{reply:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn latest_streams_never_end_as_slow_readers() {
    let server = server_with(SHORT_BUDGET).await;
    let mut unread_stream = subscribe(small_windows(&server).await, Delivery::Latest).await;
    let mut writer = server.drive("sheet", Delivery::Lossless, 1).await;
    send_all_steps(&mut writer).await;
    tokio::time::sleep(4 * SHORT_BUDGET).await;
    assert_skips_steps(&mut unread_stream).await;
}

/// A writer of only the newest steps does not wait, so a lossless reader skips steps instead of using up the budget.
#[tokio::test(flavor = "multi_thread")]
async fn latest_writer_ends_no_reader() {
    let server = server_with(SHORT_BUDGET).await;
    let mut unread_stream = subscribe(small_windows(&server).await, Delivery::Lossless).await;
    let mut writer = server.drive("sheet", Delivery::Latest, 1).await;
    send_all_steps(&mut writer).await;
    tokio::time::sleep(4 * SHORT_BUDGET).await;
    assert_skips_steps(&mut unread_stream).await;
}
