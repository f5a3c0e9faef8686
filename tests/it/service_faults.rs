//! Transport faults and timeouts: more steps than the server can process, silent connections, frozen clients and
//! clients that do not read. The server disconnects only the faulty client.

use std::sync::Arc;
use std::time::Duration;

use modalcast::config::Config;
use modalcast_proto::v1;
use tokio::io::AsyncReadExt as _;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tonic::Code;
use tonic::transport::Channel;
use v1::Delivery;
use v1::drive_scene_response::Kind as ResponseKind;
use v1::upload_scene_request::Part;

use crate::common::hang_guard::HANG_GUARD;
use crate::service_harness::{DEFAULT_WINDOW, SILENCE_LIMIT, Server, StepWriter, step, with_timeout};

/// Under the policy `latest`, the server merges steps that it has no time to process. Another stream of the same
/// connection still gets all its acknowledgments.
#[tokio::test(flavor = "multi_thread")]
async fn latest_policy_merges_excess_steps() {
    const STEP_COUNT: u64 = 20_000;
    let server = Server::start_default().await;
    server.open("sheet").await;
    server.open("strips").await;
    let channel = server.channel().await;
    let mut fast_writer = StepWriter::connect(channel.clone()).await;
    assert!(matches!(fast_writer.open("sheet", Delivery::Latest, DEFAULT_WINDOW).await, ResponseKind::Opened(_)));
    let mut other_writer = StepWriter::connect(channel).await;
    assert!(matches!(other_writer.open("strips", Delivery::Lossless, DEFAULT_WINDOW).await, ResponseKind::Opened(_)));
    let (sender, mut replies) = fast_writer.split();
    let send_steps = async {
        for number in 1..=STEP_COUNT {
            let kind = Some(v1::drive_scene_request::Kind::Step(step(number, &[], &[])));
            sender.send(v1::DriveSceneRequest { kind }).await.expect("expected an open stream");
        }
    };
    let await_last_ack = async {
        loop {
            let message = with_timeout(replies.message()).await.expect("expected another message");
            match message.expect("expected a reply").kind {
                Some(ResponseKind::Ack(ack)) if ack.step == STEP_COUNT => return ack.skipped,
                Some(ResponseKind::Ack(_)) => {}
                kind => panic!("expected an acknowledgment, got {kind:?}"),
            }
        }
    };
    let send_other_steps = async {
        for number in 0..50 {
            other_writer.send_step_and_wait(step(number, &[0], &[0.1, 0.2])).await;
        }
    };
    let ((), skipped, ()) = tokio::join!(send_steps, await_last_ack, send_other_steps);
    assert!(skipped > 0 && skipped < STEP_COUNT, "expected some skipped steps, got {skipped} of {STEP_COUNT}");
}

/// The server ends the stream of a writer that reads no rejections. Other streams of the connection continue.
#[tokio::test(flavor = "multi_thread")]
async fn stream_of_writer_that_reads_no_rejections_ends() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let channel = server.channel().await;
    let mut writer = StepWriter::connect(channel.clone()).await;
    assert!(matches!(writer.open("strips", Delivery::Lossless, DEFAULT_WINDOW).await, ResponseKind::Opened(_)));
    // A second open message is rejected. The rejections fill every buffer between server and client.
    let open_message = v1::OpenDrive::default();
    let (sender, mut replies) = writer.split();
    let send_task = tokio::spawn(async move {
        for _ in 0..100_000 {
            let kind = Some(v1::drive_scene_request::Kind::Open(open_message.clone()));
            if sender.send(v1::DriveSceneRequest { kind }).await.is_err() {
                return;
            }
        }
    });
    // The first client reads nothing until another client has acquired the writer lease of the scene.
    let acquire_lease = async {
        loop {
            let mut candidate = StepWriter::connect(channel.clone()).await;
            if matches!(candidate.open("strips", Delivery::Lossless, DEFAULT_WINDOW).await, ResponseKind::Opened(_)) {
                return candidate;
            }
        }
    };
    let mut second_writer = with_timeout(acquire_lease).await;
    second_writer.send_step_and_wait(step(0, &[0], &[0.1, 0.2])).await;
    let mut rejections = 0;
    let error = loop {
        match with_timeout(replies.message()).await {
            Ok(Some(_)) => rejections += 1,
            Ok(None) => panic!("expected the stream to end with an error"),
            Err(status) => break status,
        }
    };
    assert!(rejections < 20_000, "expected the stream to end before 20,000 of 100,000 rejections, got {rejections}");
    assert_eq!(error.code(), Code::ResourceExhausted, "{error:?}");
    with_timeout(send_task).await.expect("expected the task to end with its stream");
    second_writer.send_step_and_wait(step(1, &[0], &[0.1, 0.2])).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn silent_connection_is_closed_and_active_one_is_not() {
    let server = Server::start_with(|config| Config { handshake_timeout: SILENCE_LIMIT, ..config }).await;
    server.open("strips").await;
    let mut writer = server.drive_lossless("strips").await;
    let address = server.address.trim_start_matches("http://").to_owned();
    let mut silent_connection = TcpStream::connect(address).await.expect("expected a connection");
    let result = with_timeout(silent_connection.read(&mut [0; 1])).await;
    assert!(matches!(result, Ok(0) | Err(_)), "{result:?}");
    writer.send_step_and_wait(step(1, &[0], &[0.1, 0.2])).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn frozen_writer_loses_its_lease() {
    // The server pings a connection every 100 ms and closes it if it does not answer.
    let (keepalive_interval, keepalive_timeout) = (Duration::from_millis(100), SILENCE_LIMIT);
    let server = Server::start_with(|config| Config { keepalive_interval, keepalive_timeout, ..config }).await;
    server.open("strips").await;
    let proxy = FreezableProxy::start(server.address.trim_start_matches("http://").to_owned()).await;
    let mut frozen_writer = StepWriter::connect(proxy.channel().await).await;
    assert!(matches!(frozen_writer.open("strips", Delivery::Lossless, DEFAULT_WINDOW).await, ResponseKind::Opened(_)));
    frozen_writer.send_step_and_wait(step(1, &[0], &[0.1, 0.2])).await;
    proxy.freeze();
    let acquire_lease = async {
        loop {
            let mut candidate = StepWriter::connect(server.channel().await).await;
            if matches!(candidate.open("strips", Delivery::Lossless, DEFAULT_WINDOW).await, ResponseKind::Opened(_)) {
                return;
            }
        }
    };
    with_timeout(acquire_lease).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn server_stops_in_time_despite_unread_streams() {
    // A stopping server gives its streams this time to end.
    let drain_timeout = Duration::from_millis(300);
    let server = Server::start_with(|config| Config { drain_timeout, ..config }).await;
    server.open("sheet").await;
    let request = v1::StreamVerticesRequest {
        scene: "sheet".into(),
        delivery: v1::Delivery::Lossless.into(),
        ..v1::StreamVerticesRequest::default()
    };
    // A subscriber that never reads, and a writer that never reads its replies.
    let unread_stream = server.vertices().await.stream_vertices(request).await.expect("expected a subscription");
    let unread_writer = server.drive("sheet", Delivery::Lossless, 8).await;
    for number in 1..=8 {
        unread_writer.send_step(step(number, &[], &[])).await;
    }
    server.stop().await.expect("expected the server to stop without an error");
    drop((unread_stream, unread_writer));
}

#[tokio::test(flavor = "multi_thread")]
async fn silent_upload_times_out_and_leaves_no_files() {
    let server = Server::start_with(|config| Config { upload_stall_budget: Duration::from_millis(60), ..config }).await;
    let header = v1::UploadHeader { scene: "up".into(), entry: String::new(), files: 1, total_bytes: 5 };
    let part = v1::UploadSceneRequest { part: Some(v1::upload_scene_request::Part::Header(header)) };
    let stalled_requests = tokio_stream::StreamExt::chain(tokio_stream::iter([part]), tokio_stream::pending());
    let status =
        with_timeout(server.scenes().await.upload_scene(stalled_requests)).await.expect_err("expected a timeout");
    assert_eq!(status.code(), Code::DeadlineExceeded);
    let uploads = server.engine.config().state.join("uploads");
    assert_eq!(std::fs::read_dir(uploads).expect("expected an uploads folder").count(), 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn upload_below_minimum_rate_times_out() {
    let server =
        Server::start_with(|config| Config { upload_stall_budget: Duration::from_millis(400), ..config }).await;
    let header = v1::UploadHeader { scene: "up".into(), entry: String::new(), files: 1, total_bytes: 5000 };
    let file = v1::UploadFile { path: "scene.txt".into(), bytes: 5000, sha256: vec![0; 32].into(), reuse: false };
    let parts = [Part::Header(header), Part::File(file)].into_iter();
    // One byte per chunk, at most 50 bytes per second. The minimum rate is a constant of the server.
    let parts = parts.chain(std::iter::repeat_with(|| Part::Chunk(b"x"[..].into())).take(5000));
    let requests = tokio_stream::iter(parts.map(|part| v1::UploadSceneRequest { part: Some(part) }));
    let slow_requests = tokio_stream::StreamExt::throttle(requests, Duration::from_millis(20));
    let status = with_timeout(server.scenes().await.upload_scene(slow_requests)).await.expect_err("expected a timeout");
    assert_eq!(status.code(), Code::DeadlineExceeded);
    let uploads = server.engine.config().state.join("uploads");
    assert_eq!(std::fs::read_dir(uploads).expect("expected an uploads folder").count(), 0);
}

/// Forwards connections until it is frozen. Then it keeps them open and forwards nothing.
struct FreezableProxy {
    address: String,
    /// Sends whether the proxy is frozen.
    freeze_sender: Arc<watch::Sender<bool>>,
}

impl FreezableProxy {
    async fn start(server_address: String) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("expected a free port");
        let address = format!("http://{}", listener.local_addr().expect("expected a socket address"));
        let freeze_sender = Arc::new(watch::Sender::new(false));
        let task_sender = Arc::clone(&freeze_sender);
        tokio::spawn(async move {
            while let Ok((mut client, _)) = listener.accept().await {
                let mut upstream =
                    TcpStream::connect(&server_address).await.expect("expected a connection to the server");
                let mut freeze_receiver = task_sender.subscribe();
                tokio::spawn(async move {
                    let until_frozen =
                        async { freeze_receiver.wait_for(|is_frozen| *is_frozen).await.map(drop).unwrap_or_default() };
                    tokio::select! {
                        _ = tokio::io::copy_bidirectional(&mut client, &mut upstream) => {}
                        () = until_frozen => tokio::time::sleep(HANG_GUARD).await,
                    }
                });
            }
        });
        Self { address, freeze_sender }
    }

    async fn channel(&self) -> Channel {
        Channel::from_shared(self.address.clone())
            .expect("expected a socket address")
            .connect()
            .await
            .expect("expected a connection")
    }

    fn freeze(&self) {
        self.freeze_sender.send_replace(true);
    }
}
