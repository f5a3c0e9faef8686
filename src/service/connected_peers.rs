//! The other ends of the open connections, by which people recognize clients.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

use super::peer::Peer;
use crate::admission::{Client, PermitHandle};
use crate::engine::lock;

/// The peers of the open connections, by the number of the connection. Used when a connection begins and ends, and for
/// lists of clients.
#[derive(Debug, Default)]
pub(super) struct ConnectedPeers(Mutex<BTreeMap<u64, ConnectedPeer>>);

#[derive(Debug)]
struct ConnectedPeer {
    name: String,
    /// The permit of the connection, which knows its client.
    permit: PermitHandle,
}

/// The entry of a connection. Dropping it removes the entry.
#[derive(Debug)]
pub(super) struct ConnectedPeerEntry {
    peers: Arc<ConnectedPeers>,
    number: u64,
}

impl ConnectedPeers {
    /// Adds the peer of a connection that has the permit.
    pub(super) fn add(self: &Arc<Self>, peer: &Peer, permit: &PermitHandle) -> ConnectedPeerEntry {
        let (name, permit) = (peer.name.clone(), permit.clone());
        lock(&self.0).insert(peer.number, ConnectedPeer { name, permit });
        ConnectedPeerEntry { peers: Arc::clone(self), number: peer.number }
    }

    /// The clients that have connections, each with the name of the peer of its newest connection.
    pub(super) fn names(&self) -> BTreeMap<Client, String> {
        let peers = lock(&self.0);
        peers.values().map(|peer| (peer.permit.account().client, peer.name.clone())).collect()
    }
}

impl Drop for ConnectedPeerEntry {
    fn drop(&mut self) {
        lock(&self.peers.0).remove(&self.number);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::admission::{Account, Admission, Limit};

    #[test]
    fn peers_are_listed_while_their_connections_are_open() {
        let (peers, pool) = (Arc::<ConnectedPeers>::default(), Admission::default().pool(Limit::CONNECTIONS, 16));
        let tcp = Peer::new("127.0.0.1:1".into(), None, None);
        let processes = [(); 2].map(|()| Peer::new("process 7".into(), Some(1000), Some(7)));
        let connect = |peer: &Peer| {
            let permit = pool.acquire(&Account::anonymous(peer.client())).expect("expected a permit");
            (peers.add(peer, permit.handle()), permit)
        };
        let connected_tcp = connect(&tcp);
        let [first, second] = processes.each_ref().map(connect);
        let process = (Client::Process(7), "process 7".to_owned());
        let connection = (Client::Connection(tcp.number), "127.0.0.1:1".to_owned());
        assert_eq!(peers.names(), [process.clone(), connection].into());
        drop((connected_tcp, first));
        assert_eq!(peers.names(), [process].into());
        drop(second);
        assert!(peers.names().is_empty());
    }
}
