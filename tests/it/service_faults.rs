//! Transport faults and timeouts: floods, silence, frozen peers and clients that do not read. Only the faulty client is
//! disconnected.

use std::sync::Arc;
use std::time::{Duration, Instant};

use modalcast::config::Config;
use modalcast_proto::v1;
use tokio::io::AsyncReadExt as _;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tonic::Code;
use tonic::transport::Channel;
use v1::Policy;
use v1::drive_scene_response::Kind as ResponseKind;
use v1::upload_scene_request::Part;

use crate::service_harness::{Driver, Server, TIMEOUT, step, with_timeout};

/// Another stream on the same connection continues.
#[tokio::test(flavor = "multi_thread")]
async fn flood_of_steps_is_merged_under_latest() {
    let server = Server::start_default().await;
    server.open("sheet").await;
    server.open("strips").await;
    let channel = server.channel().await;
    let mut flood = Driver::connect(channel.clone()).await;
    assert!(matches!(flood.open("sheet", Policy::Latest, 0).await, ResponseKind::Opened(_)));
    let mut other = Driver::connect(channel).await;
    assert!(matches!(other.open("strips", Policy::Lossless, 0).await, ResponseKind::Opened(_)));
    const COUNT: u64 = 20_000;
    let (sender, mut replies) = flood.split();
    let send = async {
        for number in 1..=COUNT {
            let kind = Some(v1::drive_scene_request::Kind::Step(step(number, &[], &[])));
            sender.send(v1::DriveSceneRequest { kind }).await.expect("expected an open stream");
        }
    };
    let read = async {
        loop {
            match with_timeout(replies.message())
                .await
                .expect("expected another message")
                .expect("expected a reply")
                .kind
            {
                Some(ResponseKind::Ack(ack)) if ack.step == COUNT => return ack.skipped,
                Some(ResponseKind::Ack(_)) => {}
                other => panic!("{other:?}"),
            }
        }
    };
    let live = async {
        for number in 0..50 {
            other.step_acknowledged(step(number, &[0], &[0.1, 0.2])).await;
        }
    };
    let ((), skipped, ()) = tokio::join!(send, read, live);
    assert!(skipped > 0 && skipped < COUNT);
}

/// Only the stream ends; its connection stays usable.
#[tokio::test(flavor = "multi_thread")]
async fn writer_that_reads_no_refusals_is_disconnected() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let channel = server.channel().await;
    let mut driver = Driver::connect(channel.clone()).await;
    assert!(matches!(driver.open("strips", Policy::Lossless, 0).await, ResponseKind::Opened(_)));
    // Enough long refusals to fill every buffer between server and client.
    let open = v1::OpenDrive { scene: "x".repeat(600), policy: 0, window: 0 };
    let (sender, mut replies) = driver.split();
    let flood = tokio::spawn(async move {
        for _ in 0..20_000 {
            let kind = Some(v1::drive_scene_request::Kind::Open(open.clone()));
            if sender.send(v1::DriveSceneRequest { kind }).await.is_err() {
                return;
            }
        }
    });
    // The client reads nothing until it has lost its writer lease and another client has acquired it.
    let next = async {
        loop {
            let mut next = Driver::connect(channel.clone()).await;
            if matches!(next.open("strips", Policy::Lossless, 0).await, ResponseKind::Opened(_)) {
                return next;
            }
        }
    };
    let mut next = with_timeout(next).await;
    next.step_acknowledged(step(0, &[0], &[0.1, 0.2])).await;
    let mut refusals = 0;
    let end = loop {
        match with_timeout(replies.message()).await {
            Ok(Some(_)) => refusals += 1,
            Ok(None) => panic!("the stream ended as if nothing was wrong"),
            Err(status) => break status,
        }
    };
    assert!(refusals < 20_000, "{refusals}");
    assert_eq!(end.code(), Code::ResourceExhausted, "{end:?}");
    with_timeout(flood).await.expect("it ends with its stream");
    next.step_acknowledged(step(1, &[0], &[0.1, 0.2])).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn silent_connection_is_closed_and_active_one_is_not() {
    let server = Server::start_with(|config| Config { first_byte_timeout: Duration::from_millis(60), ..config }).await;
    server.open("strips").await;
    let mut driver = server.drive("strips", Policy::Lossless, 0).await;
    let address = server.address.trim_start_matches("http://").to_owned();
    let mut silent = TcpStream::connect(address).await.expect("expected a connection");
    let read = with_timeout(silent.read(&mut [0; 1])).await;
    assert!(matches!(read, Ok(0) | Err(_)), "{read:?}");
    driver.step_acknowledged(step(1, &[0], &[0.1, 0.2])).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn frozen_writer_loses_its_lease() {
    let (keepalive_interval, keepalive_timeout) = (Duration::from_millis(100), Duration::from_millis(100));
    let server = Server::start_with(|config| Config { keepalive_interval, keepalive_timeout, ..config }).await;
    server.open("strips").await;
    let proxy = Proxy::start(server.address.trim_start_matches("http://").to_owned()).await;
    let mut frozen = Driver::connect(proxy.channel().await).await;
    assert!(matches!(frozen.open("strips", Policy::Lossless, 0).await, ResponseKind::Opened(_)));
    frozen.step_acknowledged(step(1, &[0], &[0.1, 0.2])).await;
    proxy.freeze();
    let begin = Instant::now();
    let next = async {
        loop {
            let mut next = Driver::connect(server.channel().await).await;
            if matches!(next.open("strips", Policy::Lossless, 0).await, ResponseKind::Opened(_)) {
                return;
            }
        }
    };
    with_timeout(next).await;
    assert!(begin.elapsed() < Duration::from_secs(10), "{:?}", begin.elapsed());
}

#[tokio::test(flavor = "multi_thread")]
async fn server_stops_in_time_despite_unread_streams() {
    let drain_timeout = Duration::from_millis(300);
    let server = Server::start_with(|config| Config { drain_timeout, ..config }).await;
    server.open("sheet").await;
    let subscribe =
        v1::StreamVerticesRequest { scene: "sheet".into(), delivery: 1, ..v1::StreamVerticesRequest::default() };
    // A subscriber that never reads, and a writer that never reads its replies.
    let unread = server.vertices().await.stream_vertices(subscribe).await.expect("expected a subscription");
    let driver = server.drive("sheet", Policy::Lossless, 8).await;
    for number in 1..=8 {
        driver.step(step(number, &[], &[])).await;
    }
    let begin = Instant::now();
    server.stop().await.expect("expected the server to stop without an error");
    assert!(begin.elapsed() < Duration::from_secs(5), "{:?}", begin.elapsed());
    drop((unread, driver));
}

#[tokio::test(flavor = "multi_thread")]
async fn silent_upload_times_out_and_leaves_no_files() {
    let server = Server::start_with(|config| Config { stall_timeout: Duration::from_millis(60), ..config }).await;
    let header = v1::UploadHeader { scene: "up".into(), entry: String::new(), files: 1, total_bytes: 5 };
    let part = v1::UploadSceneRequest { part: Some(v1::upload_scene_request::Part::Header(header)) };
    let never = tokio_stream::StreamExt::chain(tokio_stream::iter([part]), tokio_stream::pending());
    let status = with_timeout(server.scenes().await.upload_scene(never)).await.expect_err("it never ends");
    assert_eq!(status.code(), Code::DeadlineExceeded);
    let uploads = server.engine.config().state.join("uploads");
    assert_eq!(std::fs::read_dir(uploads).expect("expected a temporary folder").count(), 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn slow_upload_times_out_despite_short_pauses() {
    let server = Server::start_with(|config| Config { stall_timeout: Duration::from_millis(400), ..config }).await;
    let header = v1::UploadHeader { scene: "up".into(), entry: String::new(), files: 1, total_bytes: 5000 };
    let file = v1::UploadFile { path: "scene.txt".into(), bytes: 5000, sha256: vec![0; 32].into() };
    let parts = [Part::Header(header), Part::File(file)].into_iter();
    let parts = parts.chain(std::iter::repeat_with(|| Part::Chunk(b"x"[..].into())).take(5000));
    let requests = tokio_stream::iter(parts.map(|part| v1::UploadSceneRequest { part: Some(part) }));
    let trickle = tokio_stream::StreamExt::throttle(requests, Duration::from_millis(20));
    let status = with_timeout(server.scenes().await.upload_scene(trickle)).await.expect_err("too slow");
    assert_eq!(status.code(), Code::DeadlineExceeded);
    let uploads = server.engine.config().state.join("uploads");
    assert_eq!(std::fs::read_dir(uploads).expect("expected a temporary folder").count(), 0);
}

/// Forwards connections until it is frozen. Then it keeps them open and forwards nothing.
struct Proxy {
    address: String,
    frozen: Arc<watch::Sender<bool>>,
}

impl Proxy {
    async fn start(server: String) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("expected a free port");
        let address = format!("http://{}", listener.local_addr().expect("expected a socket address"));
        let frozen = Arc::new(watch::Sender::new(false));
        let freezing = Arc::clone(&frozen);
        tokio::spawn(async move {
            while let Ok((mut near, _)) = listener.accept().await {
                let mut far = TcpStream::connect(&server).await.expect("the server");
                let mut frozen = freezing.subscribe();
                tokio::spawn(async move {
                    tokio::select! {
                        _ = tokio::io::copy_bidirectional(&mut near, &mut far) => {}
                        () = async { frozen.wait_for(|frozen| *frozen).await.map(drop).unwrap_or_default() } => {
                            tokio::time::sleep(TIMEOUT).await;
                        }
                    }
                });
            }
        });
        Self { address, frozen }
    }

    async fn channel(&self) -> Channel {
        Channel::from_shared(self.address.clone())
            .expect("expected a socket address")
            .connect()
            .await
            .expect("expected a connection")
    }

    fn freeze(&self) {
        self.frozen.send_replace(true);
    }
}
