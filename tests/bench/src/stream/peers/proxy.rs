//! A TCP proxy that delays all bytes, as a network with a long round trip does. It does not limit the rate.

use std::net::{Ipv4Addr, SocketAddr};
use std::time::Duration;

use serde::{Deserialize, Serialize};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::tcp::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::mpsc;
use tokio::time::Instant;

use super::super::processes::Process;
use super::PeerJob;
use modalcast::cli::print_line;
use modalcast_model::error::{Result, fault_in};

/// Capacity of a chunk of bytes that is read at once.
const CHUNK_BYTES: usize = 64 << 10;

/// Maximum number of chunks of one direction of a connection that are delayed at a time (256 MiB). The proxy stops
/// reading when they are in flight, so that TCP slows the sender down.
const CHUNKS_IN_FLIGHT: usize = 4096;

/// The server behind a proxy, and the delay.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct ProxyJob {
    /// Host and port of the server.
    pub(in crate::stream) server: SocketAddr,
    /// Delay of each direction in milliseconds, rounded up to the timer's resolution of 1 ms.
    pub(in crate::stream) one_way_ms: u64,
}

/// A proxy in a child process. Dropping it ends the process.
pub(in crate::stream) struct DelayProxy {
    _process: Process,
    /// URL of the proxy.
    pub(in crate::stream) url: String,
}

impl DelayProxy {
    /// Starts a proxy.
    ///
    /// # Errors
    /// `Fault` when the process fails.
    pub(in crate::stream) fn start(server: SocketAddr, one_way_ms: u64) -> Result<Self> {
        let mut process = PeerJob::Proxy(ProxyJob { server, one_way_ms }).start()?;
        let address = process.wait_for("listening on ")?;
        Ok(Self { _process: process, url: format!("http://{address}") })
    }
}

/// Forwards connections until the process is killed.
///
/// # Errors
/// `Fault` when no port is free.
pub(in crate::stream) async fn run(job: &ProxyJob) -> Result<()> {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).await.map_err(fault_in("proxy"))?;
    print_line(format!("listening on {}", listener.local_addr().map_err(fault_in("proxy"))?));
    forward_connections(&listener, job).await
}

async fn forward_connections(listener: &TcpListener, job: &ProxyJob) -> Result<()> {
    let delay = Duration::from_millis(job.one_way_ms);
    loop {
        let (client, _) = listener.accept().await.map_err(fault_in("proxy"))?;
        let server = TcpStream::connect(job.server).await.map_err(fault_in("proxy"))?;
        for stream in [&client, &server] {
            stream.set_nodelay(true).map_err(fault_in("proxy"))?;
        }
        let (from_client, to_client) = client.into_split();
        let (from_server, to_server) = server.into_split();
        tokio::spawn(forward(from_client, to_server, delay));
        tokio::spawn(forward(from_server, to_client, delay));
    }
}

/// Forwards the bytes of one direction, each after the delay. Ends when either side is closed.
async fn forward(mut source: OwnedReadHalf, mut destination: OwnedWriteHalf, delay: Duration) {
    let (chunk_sender, mut chunks) = mpsc::channel(CHUNKS_IN_FLIGHT);
    let read = async move {
        loop {
            let mut chunk = Vec::with_capacity(CHUNK_BYTES);
            let is_closed = matches!(source.read_buf(&mut chunk).await, Ok(0) | Err(_));
            if is_closed || chunk_sender.send((Instant::now() + delay, chunk)).await.is_err() {
                return;
            }
        }
    };
    let write = async move {
        while let Some((due_time, chunk)) = chunks.recv().await {
            tokio::time::sleep_until(due_time).await;
            if destination.write_all(&chunk).await.is_err() {
                return;
            }
        }
        destination.shutdown().await.ok(); // Fails if the peer has closed the connection.
    };
    tokio::join!(read, write);
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Starts an echo server and a proxy to it. Returns a connection to the proxy.
    async fn connect(one_way_ms: u64) -> TcpStream {
        let server = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).await.expect("expected a free port");
        let job = ProxyJob { server: server.local_addr().expect("expected an address"), one_way_ms };
        tokio::spawn(async move {
            let (mut stream, _) = server.accept().await.expect("expected a connection");
            let (mut reader, mut writer) = stream.split();
            tokio::io::copy(&mut reader, &mut writer).await.ok();
        });
        let proxy = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).await.expect("expected a free port");
        let address = proxy.local_addr().expect("expected an address");
        tokio::spawn(async move { forward_connections(&proxy, &job).await });
        TcpStream::connect(address).await.expect("expected a connection")
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn delays_every_byte_and_keeps_their_order() {
        let mut connection = connect(60).await;
        let start = Instant::now();
        let sent: Vec<u8> = (0..1_000_000_u32).map(|index| (index % 251) as u8).collect();
        let (mut reader, mut writer) = connection.split();
        let mut received = vec![0; sent.len()];
        let write = async {
            writer.write_all(&sent).await.expect("expected an open connection");
            writer.shutdown().await.expect("expected an open connection");
        };
        tokio::join!(write, async { reader.read_exact(&mut received).await.expect("expected all bytes") });
        assert!(start.elapsed() >= Duration::from_millis(2 * 60), "expected the delay in both directions");
        assert_eq!(received, sent);
        assert_eq!(reader.read(&mut [0]).await.expect("expected the end"), 0);
    }
}
