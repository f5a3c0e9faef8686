//! The client at the other end of a connection.

use std::sync::atomic::{AtomicU64, Ordering};

use crate::admission::Client;

/// The other end of a connection.
#[derive(Debug)]
pub(super) struct Peer {
    /// For the log: its address, or its process.
    pub(super) name: String,
    /// The user of a Unix socket's client at the time of its connection.
    pub(super) uid: Option<u32>,
    /// The process of a Unix socket's client at the time of its connection.
    pid: Option<i32>,
    /// A number that no other connection of the server has.
    pub(super) number: u64,
}

impl Peer {
    pub(super) fn new(name: String, uid: Option<u32>, pid: Option<i32>) -> Self {
        /// Number of connections so far.
        static COUNTER: AtomicU64 = AtomicU64::new(0);
        Self { name, uid, pid, number: COUNTER.fetch_add(1, Ordering::Relaxed) }
    }

    /// The client that the connection counts to.
    pub(super) fn client(&self) -> Client {
        // Processes of other namespaces have the id 0.
        self.pid.filter(|pid| *pid > 0).map_or(Client::Connection(self.number), Client::Process)
    }
}
