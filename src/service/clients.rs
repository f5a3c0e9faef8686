//! Lists the clients with what they hold, and ends them, for administrators.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use modalcast_proto::v1;
use prost::Message as _;

use super::authentication::Authenticator;
use super::connected_peers::ConnectedPeers;
use crate::admission::{Account, Client, ClientHoldings, ResourceUse};
use crate::engine::Engine;
use modalcast_model::error::{Result, invalid};
use modalcast_model::escaping::escape_controls;

/// Upper bound on the size of a list in bytes: clients up to [`MAX_CLIENTS_BYTES`], and the resources of all scenes.
pub(super) const MAX_LIST_BYTES: usize = 2 << 20;

/// Limit in bytes on the clients in one list.
const MAX_CLIENTS_BYTES: usize = 1 << 20;

/// Upper bound on the bytes that protobuf adds to a message in a list: tag and length.
const ENTRY_OVERHEAD_BYTES: usize = 8;

/// Upper bound on the length of an id in bytes, for the size of replies.
const MAX_ID_BYTES: usize = 128;

/// The clients of a server.
#[derive(Clone)]
pub(super) struct ClientTable {
    pub(super) engine: Engine,
    pub(super) authenticator: Arc<Authenticator>,
    pub(super) peers: Arc<ConnectedPeers>,
}

impl ClientTable {
    /// The clients that hold something. `caller` asks.
    pub(super) fn list(&self, caller: &Account) -> v1::ListClientsResponse {
        let admission = self.engine.admission();
        let (peers, mut drivers) = (self.peers.names(), self.engine.driven_scenes());
        let holdings = admission.clients();
        let (mut bytes, count) = (0, holdings.len());
        let clients = holdings.into_iter().map(|client| {
            let driven_scenes = drivers.remove(&client.account).unwrap_or_default();
            wire_client(client, &peers, driven_scenes, caller)
        });
        let is_within_limit = |client: &v1::ClientInfo| {
            bytes += client.encoded_len() + ENTRY_OVERHEAD_BYTES;
            bytes <= MAX_CLIENTS_BYTES
        };
        let clients: Vec<_> = clients.take_while(is_within_limit).collect();
        let omitted = (count - clients.len()) as u32;
        let resources = admission.resources_in_use().iter().map(wire_resource_use).collect();
        v1::ListClientsResponse { clients, omitted, resources }
    }

    /// Ends a client, or all clients of a principal except the caller; see `EndClientRequest`. A session of the viewer ends,
    /// too, because its page would connect again.
    ///
    /// # Errors
    /// `Invalid` when no client with this id holds anything.
    pub(super) fn end(&self, id: &str, caller: &Account) -> Result<v1::EndClientResponse> {
        let is_selected = |account: &Account| match id.strip_suffix("/*") {
            Some(principal) => account.principal_name() == principal && account != caller,
            None => account.to_string() == id,
        };
        let ended = self.engine.admission().end_clients(is_selected);
        if ended.is_empty() {
            let expected = "the id of a client that holds something, or the name of its principal and '/*'";
            return Err(invalid("id", expected, format!("'{}'", id.escape_debug())));
        }
        for client in &ended {
            if let Client::Session(token) = &client.account.client {
                self.authenticator.directory().viewer_sessions().end(token);
            }
        }
        let permits = ended.iter().map(|client| client.permits).sum::<usize>() as u32;
        let ids = ended.iter().map(|client| client.account.to_string());
        let ids = ids.take(MAX_CLIENTS_BYTES / MAX_ID_BYTES).collect();
        Ok(v1::EndClientResponse { ids, ended: permits })
    }
}

fn wire_client(
    client: ClientHoldings,
    peers: &BTreeMap<Client, String>,
    driven_scenes: Vec<String>,
    caller: &Account,
) -> v1::ClientInfo {
    let ClientHoldings { account, held, age, idle } = client;
    let peer = peers.get(&account.client);
    let process_id = match account.client {
        Client::Process(id) => id.unsigned_abs(),
        Client::Server | Client::Session(_) | Client::Connection(_) => 0,
    };
    let is_process = process_id != 0;
    v1::ClientInfo {
        id: account.to_string(),
        kind: client_kind(account.client).into(),
        address: peer.filter(|_| !is_process).cloned().unwrap_or_default(),
        process_id,
        // Without a connection, another process may have this id by now.
        process_name: peer.filter(|_| is_process).map(|_| process_name(process_id)).unwrap_or_default(),
        held: held.iter().map(wire_resource_use).collect(),
        age_ms: to_ms(age),
        idle_ms: idle.map(to_ms),
        is_caller: account == *caller,
        driven_scenes,
        principal: account.principal.as_deref().unwrap_or_default().to_owned(),
    }
}

const fn client_kind(client: Client) -> v1::ClientKind {
    match client {
        Client::Server => v1::ClientKind::Server,
        Client::Session(_) => v1::ClientKind::Session,
        Client::Process(_) => v1::ClientKind::Process,
        Client::Connection(_) => v1::ClientKind::Connection,
    }
}

/// The name of a process of this machine, which it may have chosen itself; empty if it has ended.
fn process_name(id: u32) -> String {
    let name = std::fs::read(format!("/proc/{id}/comm")).unwrap_or_default();
    escape_controls(String::from_utf8_lossy(&name).trim_end()).into_owned()
}

fn wire_resource_use(resource: &ResourceUse) -> v1::ResourceUse {
    v1::ResourceUse {
        resource: resource.limit.resource.to_owned(),
        objects: resource.limit.objects.to_owned(),
        scene: resource.scene.as_deref().unwrap_or_default().to_owned(),
        held: resource.held as u64,
        limit: resource.total as u64,
    }
}

fn to_ms(duration: Duration) -> u64 {
    u64::try_from(duration.as_millis()).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn own_process_has_a_name_and_absent_ones_have_none() {
        assert!(!process_name(std::process::id()).is_empty());
        assert_eq!(process_name(u32::MAX), "");
    }
}
