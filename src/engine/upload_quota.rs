//! Limits on uploads: their number at a time, and the bytes on disk, of one client and of all clients together.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

use super::lock::lock;
use crate::admission::Account;
use crate::config::Config;
use modalcast_model::error::{Error, Result};

/// Maximum number of uploads in progress at a time.
const MAX_UPLOADS: usize = 8;

/// Maximum number of uploads in progress of one client, so that others can upload, too.
const MAX_CLIENT_UPLOADS: usize = 4;

/// The uploads of all clients.
#[derive(Debug)]
pub(super) struct UploadQuota {
    client_bytes: u64,
    total_bytes: u64,
    uploads: Mutex<Uploads>,
}

#[derive(Debug, Default)]
struct Uploads {
    next_number: u64,
    /// By number: the client and the declared bytes.
    in_progress: BTreeMap<u64, (Account, u64)>,
    /// By name of the scene: the client, unless the upload is from an earlier run of the server, and the bytes.
    stored: BTreeMap<String, (Option<Account>, u64)>,
}

impl Uploads {
    /// Bytes of the uploads of a client, or of all clients.
    fn bytes(&self, client: Option<&Account>) -> u64 {
        let in_progress = self.in_progress.values().map(|(owner, bytes)| (Some(owner), *bytes));
        let stored = self.stored.values().map(|(owner, bytes)| (owner.as_ref(), *bytes));
        let counts = |owner: Option<&Account>| client.is_none() || owner == client;
        in_progress
            .chain(stored)
            .filter(|(owner, _)| counts(*owner))
            .fold(0, |sum, (_, bytes)| sum.saturating_add(bytes))
    }
}

/// Counts an upload in progress until it is dropped.
#[derive(Debug)]
pub(super) struct UploadPermit {
    quota: Arc<UploadQuota>,
    number: u64,
    pub(super) account: Account,
}

impl Drop for UploadPermit {
    fn drop(&mut self) {
        lock(&self.quota.uploads).in_progress.remove(&self.number);
    }
}

impl UploadQuota {
    /// The quota of a server that has uploads of an earlier run, with their sizes by the names of their scenes.
    pub(super) fn new(config: &Config, stored: BTreeMap<String, u64>) -> Arc<Self> {
        let stored = stored.into_iter().map(|(name, bytes)| (name, (None, bytes))).collect();
        let uploads = Mutex::new(Uploads { stored, ..Uploads::default() });
        Arc::new(Self { client_bytes: config.client_upload_bytes, total_bytes: config.stored_bytes, uploads })
    }

    /// Admits an upload of so many bytes.
    ///
    /// # Errors
    /// `Busy` when too many uploads are in progress; `LimitReached` when the client has too many uploads in progress, or
    /// the bytes of the client or of all clients exceed their limit.
    pub(super) fn admit(self: &Arc<Self>, client: Account, bytes: u64) -> Result<UploadPermit> {
        let mut uploads = lock(&self.uploads);
        if uploads.in_progress.len() >= MAX_UPLOADS {
            return Err(Error::Busy { queue: "queue of uploads", limit: MAX_UPLOADS });
        }
        if uploads.in_progress.values().filter(|(owner, _)| *owner == client).count() >= MAX_CLIENT_UPLOADS {
            return Err(Error::LimitReached { objects: "uploads of one client at a time", limit: MAX_CLIENT_UPLOADS });
        }
        let limits = [
            ("bytes in the uploads of one client", Some(&client), self.client_bytes),
            ("bytes in the uploads of all clients", None, self.total_bytes),
        ];
        for (objects, owner, limit) in limits {
            if uploads.bytes(owner).saturating_add(bytes) > limit {
                return Err(Error::LimitReached { objects, limit: limit as usize });
            }
        }
        let number = uploads.next_number;
        uploads.next_number += 1;
        uploads.in_progress.insert(number, (client.clone(), bytes));
        Ok(UploadPermit { quota: Arc::clone(self), number, account: client })
    }

    /// Counts the files of a scene on disk.
    pub(super) fn store(&self, scene: &str, client: Account, bytes: u64) {
        lock(&self.uploads).stored.insert(scene.to_owned(), (Some(client), bytes));
    }

    /// No longer counts the files of a scene.
    pub(super) fn remove(&self, scene: &str) {
        lock(&self.uploads).stored.remove(scene);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::admission::Client;

    fn account(connection: u64) -> Account {
        Account::anonymous(Client::Connection(connection))
    }

    fn quota(client_upload_bytes: u64, stored_bytes: u64) -> Arc<UploadQuota> {
        let config = Config { client_upload_bytes, stored_bytes, ..Config::default() };
        UploadQuota::new(&config, [("old".to_owned(), 10)].into())
    }

    fn limit_of(result: Result<UploadPermit>) -> (&'static str, usize) {
        match result {
            Err(Error::LimitReached { objects, limit }) => (objects, limit),
            other => panic!("expected LimitReached, got {other:?}"),
        }
    }

    #[test]
    fn bytes_count_from_the_header_until_the_scene_is_deleted() {
        let quota = quota(100, 170);
        let [first, second] = [1, 2].map(account);
        let permit = quota.admit(first.clone(), 60).expect("expected room");
        let client_limit = ("bytes in the uploads of one client", 100);
        assert_eq!(limit_of(quota.admit(first.clone(), 41)), client_limit);
        quota.store("a", first.clone(), 90);
        drop(permit);
        assert_eq!(limit_of(quota.admit(first.clone(), 11)), client_limit);
        assert_eq!(limit_of(quota.admit(second.clone(), 71)), ("bytes in the uploads of all clients", 170));
        quota.admit(second.clone(), 70).expect("expected room beside the uploads of the earlier run");
        quota.remove("old");
        quota.admit(second, 80).expect("expected the room of the removed scene");
        quota.remove("a");
        quota.admit(first, 100).expect("expected the room of the removed scene");
    }

    #[test]
    fn one_client_cannot_take_all_places() {
        let quota = quota(u64::MAX, u64::MAX);
        let admit = |client: u64| quota.admit(account(client), 1);
        let permits: Vec<_> = (0..MAX_CLIENT_UPLOADS).map(|_| admit(1).expect("expected a place")).collect();
        assert_eq!(limit_of(admit(1)), ("uploads of one client at a time", MAX_CLIENT_UPLOADS));
        let others: Vec<_> = (0..MAX_CLIENT_UPLOADS).map(|_| admit(2).expect("expected a place")).collect();
        assert!(matches!(admit(3), Err(Error::Busy { .. })));
        drop(permits);
        admit(3).expect("expected the place of a finished upload");
        drop(others);
    }
}
