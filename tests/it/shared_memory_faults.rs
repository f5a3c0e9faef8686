//! Faults of clients and servers that share memory, with a server in a process of its own: stalled readers, cancelled
//! calls, and `kill -9` of either side.

use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use modalcast_client::{Client, Delivery, VertexRequest, VertexSelection, VertexStream, VertexStreamRequest};

use crate::common::hang_guard::HANG_GUARD;
use crate::server_process::{ServerProcess, crowded_step, crowded_upload, drive};
use crate::service_harness::with_timeout;

/// Name of the memory in the maps of a process.
const MEMORY_NAME: &str = "/memfd:modalcast-replies";

/// Environment variables of a child process: the URL of the server and its socket for shared memory.
const CHILD_VARIABLES: [&str; 2] = ["MODALCAST_TEST_URL", "MODALCAST_TEST_SHARED_MEMORY"];

fn start_server(folder: &Path) -> ServerProcess {
    let path = socket_path(folder);
    ServerProcess::start_with(folder, &["--shared-memory", path.to_str().expect("expected text")])
}

fn socket_path(folder: &Path) -> PathBuf {
    folder.join("memory.sock")
}

/// A client with shared memory.
async fn local_client(server: &ServerProcess, folder: &Path) -> Client {
    server.client().await.with_shared_memory(socket_path(folder)).await.expect("expected shared memory")
}

async fn subscribe(client: &Client, delivery: Delivery) -> VertexStream {
    let request = VertexStreamRequest::new("crowded", VertexSelection::default()).delivery(delivery);
    client.stream_vertices(&request).await.expect("expected a subscription")
}

/// Waits until the server has mapped the memory of this number of connections.
async fn wait_for_mappings(server: &ServerProcess, count: usize) {
    let waiting = async {
        while server.mappings(MEMORY_NAME) != count {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    let result = tokio::time::timeout(HANG_GUARD, waiting).await;
    assert!(result.is_ok(), "expected {count} mappings, got {}", server.mappings(MEMORY_NAME));
}

/// Sends `count` steps with the numbers from 0 on.
async fn send_steps(client: &Client, count: u64) {
    let mut writer = drive(client, "crowded").await;
    for number in 0..count {
        with_timeout(writer.step(&crowded_step(number))).await.expect("expected a sent step");
    }
    with_timeout(writer.finish()).await.expect("expected all steps to complete");
}

/// Reads `count` steps and asserts that their numbers count from 0.
async fn read_steps(mut stream: VertexStream, count: u64) {
    let mut numbers = Vec::new();
    for _ in 0..count {
        let set = with_timeout(stream.next()).await.expect("expected a step").expect("expected no error");
        numbers.push(set.step.number);
    }
    assert!(numbers.iter().copied().eq(0..count), "{numbers:?}");
}

/// Stalled readers of the newest steps occupy their slots and no other memory. A lossless reader gets every step.
#[tokio::test(flavor = "multi_thread")]
async fn stalled_readers_hold_no_more_than_their_slots() {
    const READERS: usize = 12;
    const STEPS: u64 = 150;
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let server = start_server(folder.path());
    let client = local_client(&server, folder.path()).await;
    client.upload_arrays(crowded_upload()).await.expect("expected the upload to succeed");
    let mut stalled = Vec::new();
    for _ in 0..READERS {
        stalled.push(subscribe(&client, Delivery::Latest).await);
    }
    // The first steps fill the slots.
    for is_first in [true, false] {
        let reader = tokio::spawn(read_steps(subscribe(&client, Delivery::Lossless).await, STEPS));
        let before = server.resident_bytes();
        send_steps(&client, STEPS).await;
        with_timeout(reader).await.expect("expected every step");
        let growth = server.resident_bytes().saturating_sub(before);
        println!("{READERS} stalled readers, first steps {is_first}: growth {} MB", growth >> 20);
        assert!(is_first || growth < 48 << 20, "expected flat memory, got a growth of {growth} bytes");
    }
    wait_for_mappings(&server, READERS).await;
    drop(stalled);
    wait_for_mappings(&server, 0).await;
}

/// The next call reuses the memory of a call that was read to its end.
#[tokio::test(flavor = "multi_thread")]
async fn calls_reuse_memory() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let server = start_server(folder.path());
    let client = local_client(&server, folder.path()).await;
    client.upload_arrays(crowded_upload()).await.expect("expected the upload to succeed");
    for _ in 0..5 {
        let request = VertexRequest::new("crowded", VertexSelection::default());
        client.get_vertices(&request).await.expect("expected vertices");
        let request = VertexStreamRequest::new("crowded", VertexSelection::default()).max_steps(2);
        let mut stream = client.stream_vertices(&request).await.expect("expected a subscription");
        send_steps(&client, 2).await;
        while let Some(set) = with_timeout(stream.next()).await {
            set.expect("expected no error");
        }
        // The connection of the writer ends with its stream.
        wait_for_mappings(&server, 1).await;
    }
}

/// A cancelled stream frees its memory, and the other streams of the client continue.
#[tokio::test(flavor = "multi_thread")]
async fn cancelled_stream_frees_its_memory() {
    const STEPS: u64 = 60;
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let server = start_server(folder.path());
    let client = local_client(&server, folder.path()).await;
    client.upload_arrays(crowded_upload()).await.expect("expected the upload to succeed");
    let reader = tokio::spawn(read_steps(subscribe(&client, Delivery::Lossless).await, STEPS));
    let mut cancelled = subscribe(&client, Delivery::Lossless).await;
    wait_for_mappings(&server, 2).await;
    let sending = tokio::spawn({
        let client = client.clone();
        async move { send_steps(&client, STEPS).await }
    });
    for _ in 0..3 {
        with_timeout(cancelled.next()).await.expect("expected a step").expect("expected no error");
    }
    drop(cancelled);
    with_timeout(sending).await.expect("expected all steps");
    with_timeout(reader).await.expect("expected every step");
    drop(client);
    wait_for_mappings(&server, 0).await;
}

/// Starts an ignored test as a child process.
fn start_child(server: &ServerProcess, folder: &Path, name: &str) -> Child {
    Command::new(std::env::current_exe().expect("expected this program"))
        .args(["--ignored", "--exact", "--nocapture", &format!("shared_memory_faults::{name}")])
        .env(CHILD_VARIABLES[0], &server.address)
        .env(CHILD_VARIABLES[1], socket_path(folder))
        .stdout(Stdio::piped())
        .spawn()
        .expect("expected a child process")
}

/// The client of a child process.
async fn client_of_parent() -> Client {
    let [url, path] = CHILD_VARIABLES.map(|name| std::env::var(name).expect("expected the variable"));
    let client = Client::connect(&url).await.expect("expected a connection");
    client.with_shared_memory(path).await.expect("expected shared memory")
}

/// The program of [`killed_client_frees_its_memory`]: reads vertices until it is killed.
#[tokio::test(flavor = "multi_thread")]
#[ignore = "a child process of another test"]
async fn reader_process() {
    let client = client_of_parent().await;
    let mut stream = subscribe(&client, Delivery::Lossless).await;
    println!("\nready");
    while stream.next().await.is_some_and(|set| set.is_ok()) {
        println!("received");
    }
}

/// A reader that is killed while it reads leaves nothing behind. The writer and another reader continue.
#[tokio::test(flavor = "multi_thread")]
async fn killed_client_frees_its_memory() {
    const STEPS: u64 = 300;
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let server = start_server(folder.path());
    let client = local_client(&server, folder.path()).await;
    client.upload_arrays(crowded_upload()).await.expect("expected the upload to succeed");
    let mut open_files = Vec::new();
    for _ in 0..3 {
        let mut child = start_child(&server, folder.path(), "reader_process");
        let mut lines = BufReader::new(child.stdout.take().expect("expected an output")).lines();
        let mut wait_for = |text: &str| assert!(lines.any(|line| line.expect("expected text") == text), "{text}");
        wait_for("ready");
        let reader = tokio::spawn(read_steps(subscribe(&client, Delivery::Lossless).await, STEPS));
        assert_eq!(server.mappings(MEMORY_NAME), 2);
        let sending = tokio::spawn({
            let client = client.clone();
            async move { send_steps(&client, STEPS).await }
        });
        (0..5).for_each(|_| wait_for("received"));
        child.kill().expect("expected a running process");
        child.wait().expect("expected the end of the process");
        with_timeout(sending).await.expect("expected all steps");
        with_timeout(reader).await.expect("expected every step");
        // The reader did not read its stream to the end, so its connection is closed instead of reused.
        wait_for_mappings(&server, 0).await;
        let until_closed = async {
            while open_files.first().is_some_and(|count| server.open_files() > *count) {
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        };
        with_timeout(until_closed).await;
        open_files.push(server.open_files());
    }
}

/// The program of [`killed_writer_frees_its_memory`]: sends steps until it is killed.
#[tokio::test(flavor = "multi_thread")]
#[ignore = "a child process of another test"]
async fn writer_process() {
    let client = client_of_parent().await;
    let mut writer = drive(&client, "crowded").await;
    for number in 0.. {
        with_timeout(writer.step(&crowded_step(number))).await.expect("expected a sent step");
    }
}

/// A writer that is killed while it sends leaves nothing behind. A reader gets complete steps, including those of the
/// next writer.
#[tokio::test(flavor = "multi_thread")]
async fn killed_writer_frees_its_memory() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let server = start_server(folder.path());
    let client = local_client(&server, folder.path()).await;
    client.upload_arrays(crowded_upload()).await.expect("expected the upload to succeed");
    let mut stream = subscribe(&client, Delivery::Lossless).await;
    for _ in 0..3 {
        let mut child = start_child(&server, folder.path(), "writer_process");
        for number in 0..20 {
            let set = with_timeout(stream.next()).await.expect("expected a step").expect("expected no error");
            assert_eq!(set.step.number, number);
        }
        child.kill().expect("expected a running process");
        child.wait().expect("expected the end of the process");
        // Reads the steps that the server had accepted.
        let reading = async {
            while server.mappings(MEMORY_NAME) > 1 {
                tokio::time::timeout(Duration::from_millis(20), stream.next()).await.ok();
            }
        };
        with_timeout(reading).await;
        let rest = async { while stream.next().await.is_some_and(|set| set.is_ok()) {} };
        assert!(tokio::time::timeout(Duration::from_secs(1), rest).await.is_err(), "expected an open stream");
    }
}

/// A client of a server that is killed gets an error. The next server replaces the socket, and the client finds it.
#[tokio::test(flavor = "multi_thread")]
async fn killed_server_ends_the_streams_of_its_clients() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let mut server = start_server(folder.path());
    server.client().await.upload_arrays(crowded_upload()).await.expect("expected the upload to succeed");
    for _ in 0..3 {
        let client = local_client(&server, folder.path()).await;
        let mut stream = subscribe(&client, Delivery::Lossless).await;
        let mut writer = drive(&client, "crowded").await;
        let sending = tokio::spawn(async move {
            let mut number = 0;
            while writer.step(&crowded_step(number)).await.is_ok() {
                number += 1;
            }
        });
        for _ in 0..5 {
            with_timeout(stream.next()).await.expect("expected a step").expect("expected no error");
        }
        drop(server);
        let until_error = async {
            loop {
                match stream.next().await {
                    Some(Ok(_)) => {}
                    Some(Err(_)) => return,
                    None => panic!("expected an error"),
                }
            }
        };
        with_timeout(until_error).await;
        with_timeout(sending).await.expect("expected no panic");
        server = start_server(folder.path());
    }
    let mut stream = subscribe(&local_client(&server, folder.path()).await, Delivery::Latest).await;
    with_timeout(stream.next()).await.expect("expected the current step").expect("expected no error");
}
