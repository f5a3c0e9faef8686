//! A plain TCP connection between two processes: the upper limit for a stream of the same bytes in the same chunks.

use std::io::{Read as _, Write as _};
use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream};
use std::time::Instant;

use serde::{Deserialize, Serialize};

use super::super::processes::PROCESS_TIMEOUT;
use super::PeerJob;
use super::viewer::{ViewerSummary, rate};
use modalcast::cli::print_line;
use modalcast::config::Config;
use modalcast_model::error::{Result, fault, fault_in};

/// Replies to send over a plain TCP connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct SocketJob {
    pub(in crate::stream) reply_bytes: usize,
    /// Every write has this size, except the last one of a reply, which has the rest.
    pub(in crate::stream) chunk_bytes: usize,
    pub(in crate::stream) replies: u64,
}

impl SocketJob {
    /// Replies in chunks of the same size as those of the server.
    pub(in crate::stream) fn new(reply_bytes: usize, replies: u64) -> Self {
        Self { reply_bytes, chunk_bytes: Config::default().chunk_bytes, replies }
    }
}

/// Size of the origin of the positions. Each single request has one, and a stream has one in its first reply.
const ORIGIN_BYTES: u64 = 24;

/// Rate of a plain TCP connection.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::stream) struct SocketRate {
    pub(in crate::stream) job: SocketJob,
    pub(in crate::stream) per_second: f64,
}

impl SocketRate {
    /// Bytes per second.
    pub(in crate::stream) fn bandwidth(&self) -> f64 {
        self.per_second * self.job.reply_bytes as f64
    }
}

/// Sends the replies from a child process to this process and measures their rate as that of a viewer.
///
/// # Errors
/// `Fault` when the child process fails or other bytes arrive.
pub(in crate::stream) fn measure(job: SocketJob) -> Result<SocketRate> {
    let mut source = PeerJob::SocketSource(job).start()?;
    let address = source.wait_for("listening on ")?;
    let address: SocketAddr = address.parse().map_err(fault_in("socket"))?;
    receive(address, job).map_err(|error| source.failure(&error.to_string()))
}

/// Accepts one connection, sends all replies, and ends.
///
/// # Errors
/// `Fault` when the socket fails.
pub(in crate::stream) fn run_source(job: &SocketJob) -> Result<()> {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).map_err(fault_in("socket"))?;
    print_line(format!("listening on {}", listener.local_addr().map_err(fault_in("socket"))?));
    let (stream, _) = listener.accept().map_err(fault_in("socket"))?;
    send(stream, job, &reply(job.reply_bytes))
}

/// The bytes of a reply. Neighboring bytes differ, so that shifted bytes are detected.
fn reply(bytes: usize) -> Vec<u8> {
    (0..bytes).map(|index| (index % 251) as u8).collect()
}

fn send(mut stream: TcpStream, job: &SocketJob, reply: &[u8]) -> Result<()> {
    stream.set_nodelay(true).map_err(fault_in("socket"))?;
    for _ in 0..job.replies {
        for chunk in reply.chunks(job.chunk_bytes) {
            stream.write_all(chunk).map_err(fault_in("socket"))?;
        }
    }
    Ok(())
}

/// Receives the replies into one buffer.
fn receive(address: SocketAddr, job: SocketJob) -> Result<SocketRate> {
    let mut stream = TcpStream::connect(address).map_err(fault_in("socket"))?;
    stream.set_read_timeout(Some(PROCESS_TIMEOUT)).map_err(fault_in("socket"))?;
    let (mut buffer, mut first_arrival) = (vec![0; job.reply_bytes], None);
    for _ in 0..job.replies {
        stream.read_exact(&mut buffer).map_err(fault_in("socket"))?;
        first_arrival.get_or_insert_with(Instant::now);
    }
    let seconds = first_arrival.map_or(0.0, |first| first.elapsed().as_secs_f64());
    let rest = stream.read(&mut [0]).map_err(fault_in("socket"))?;
    if rest != 0 || buffer != reply(job.reply_bytes) {
        let expected = format!("{} replies of {} bytes", job.replies, job.reply_bytes);
        return Err(fault("socket", format!("expected {expected}, got other bytes")));
    }
    Ok(SocketRate { job, per_second: rate(job.replies, seconds) })
}

/// Vertices beside a plain TCP connection with replies of the same size, in chunks of the same size.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SocketComparison {
    pub reply_bytes: u64,
    /// Largest part of a reply that is sent at once.
    pub chunk_bytes: u64,
    pub replies: u64,
    /// Replies per second of a lossless stream. The writer sends steps from memory, without computing them.
    pub stream_per_second: f64,
    /// Replies per second if the client requests the same step again and again.
    pub request_per_second: f64,
    /// The same two rates over a Unix socket.
    pub unix_stream_per_second: f64,
    pub unix_request_per_second: f64,
    /// The same two rates with the vertices in shared memory.
    pub shared_stream_per_second: f64,
    pub shared_request_per_second: f64,
    pub socket_per_second: f64,
    /// `stream_per_second` and `request_per_second` divided by `socket_per_second`.
    pub stream_of_socket: f64,
    pub request_of_socket: f64,
    pub stream_bytes_per_second: f64,
    pub socket_bytes_per_second: f64,
}

/// What viewers of vertices have received over the server's TCP socket, its Unix socket and in shared memory.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::stream) struct VertexViewers {
    pub(in crate::stream) stream: ViewerSummary,
    pub(in crate::stream) requests: ViewerSummary,
    pub(in crate::stream) unix_stream: ViewerSummary,
    pub(in crate::stream) unix_requests: ViewerSummary,
    pub(in crate::stream) shared_stream: ViewerSummary,
    pub(in crate::stream) shared_requests: ViewerSummary,
}

impl SocketComparison {
    /// Compares streams and single requests with a plain connection.
    ///
    /// # Errors
    /// `Fault` unless each has as many replies of as many bytes as the others, except for the origins.
    pub(in crate::stream) fn new(viewers: &VertexViewers, socket: &SocketRate) -> Result<Self> {
        let VertexViewers { stream, requests, unix_stream, unix_requests, shared_stream, shared_requests } = viewers;
        let job = socket.job;
        let socket_bytes = job.replies * job.reply_bytes as u64;
        let expected_bytes = socket_bytes..=socket_bytes + job.replies * ORIGIN_BYTES;
        for (name, summary) in [
            ("the stream", stream),
            ("the requests", requests),
            ("the stream over a Unix socket", unix_stream),
            ("the requests over a Unix socket", unix_requests),
            ("the stream in shared memory", shared_stream),
            ("the requests in shared memory", shared_requests),
        ] {
            if summary.replies != job.replies || !expected_bytes.contains(&summary.bytes) {
                let given = format!("{} replies, {} bytes", summary.replies, summary.bytes);
                let expected = format!("{} replies, {socket_bytes} bytes", job.replies);
                return Err(fault("socket", format!("{name}: expected {expected} as the socket, got {given}")));
            }
        }
        Ok(Self {
            reply_bytes: job.reply_bytes as u64,
            chunk_bytes: job.chunk_bytes as u64,
            replies: job.replies,
            stream_per_second: stream.per_second,
            request_per_second: requests.per_second,
            unix_stream_per_second: unix_stream.per_second,
            unix_request_per_second: unix_requests.per_second,
            shared_stream_per_second: shared_stream.per_second,
            shared_request_per_second: shared_requests.per_second,
            socket_per_second: socket.per_second,
            stream_of_socket: stream.per_second / socket.per_second,
            request_of_socket: requests.per_second / socket.per_second,
            stream_bytes_per_second: stream.per_second * job.reply_bytes as f64,
            socket_bytes_per_second: socket.bandwidth(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const JOB: SocketJob = SocketJob { reply_bytes: 1000, chunk_bytes: 300, replies: 5 };

    /// Receives [`JOB`] from a thread that sends `sent`.
    fn receive_from_thread(sent: SocketJob, reply: Vec<u8>) -> Result<SocketRate> {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).expect("expected a free port");
        let address = listener.local_addr().expect("expected an address");
        let sending = std::thread::spawn(move || {
            let (stream, _) = listener.accept().expect("expected a connection");
            send(stream, &sent, &reply).ok(); // Fails if the receiver ends early.
        });
        let received = receive(address, JOB);
        sending.join().expect("expected no panic");
        received
    }

    #[test]
    fn receives_exactly_the_bytes_of_the_job() {
        let socket_rate = receive_from_thread(JOB, reply(1000)).expect("expected the replies");
        assert_eq!(socket_rate.job, JOB);
        // Controls: a missing byte, too many replies, and a changed byte.
        let mut changed = reply(1000);
        changed[999] ^= 1;
        for (sent, reply) in [(JOB, reply(999)), (SocketJob { replies: 6, ..JOB }, reply(1000)), (JOB, changed)] {
            assert!(receive_from_thread(sent, reply).is_err());
        }
    }

    #[test]
    fn comparison_requires_equal_replies() {
        let socket_rate = SocketRate { job: JOB, per_second: 100.0 };
        let summary = |replies, bytes| ViewerSummary {
            replies,
            per_second: 50.0,
            bytes,
            skipped: 0,
            stages_ms: Default::default(),
        };
        let equal = summary(5, 5000);
        let viewers = VertexViewers {
            stream: equal.clone(),
            requests: equal.clone(),
            unix_stream: equal.clone(),
            unix_requests: equal.clone(),
            shared_stream: equal.clone(),
            shared_requests: equal,
        };
        let comparison = SocketComparison::new(&viewers, &socket_rate).expect("expected a comparison");
        assert_eq!((comparison.stream_of_socket, comparison.socket_bytes_per_second), (0.5, 1e5));
        let with_origins = summary(5, 5 * 1024);
        let with_requests = |requests| VertexViewers { requests, ..viewers.clone() };
        assert!(SocketComparison::new(&with_requests(with_origins), &socket_rate).is_ok());
        for unequal in [summary(4, 4000), summary(5, 4990), summary(5, 5 * 1024 + 1)] {
            let shared_stream = unequal.clone();
            for unequal_viewers in [
                with_requests(unequal.clone()),
                VertexViewers { stream: unequal.clone(), ..viewers.clone() },
                VertexViewers { shared_stream, ..viewers.clone() },
            ] {
                assert!(SocketComparison::new(&unequal_viewers, &socket_rate).is_err(), "{unequal:?}");
            }
        }
    }
}
