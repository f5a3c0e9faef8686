//! What uploads count for: as one while they are in progress, and for their bytes on disk until their scene is deleted.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

use super::lock::lock;
use crate::admission::{Account, Admission, Client, Limit, Permit, PermitPool};
use crate::config::Config;
use modalcast_model::error::Result;

/// The uploads of all clients.
#[derive(Debug)]
pub(super) struct UploadPermits {
    uploads: PermitPool,
    bytes: PermitPool,
    /// For the files of each uploaded scene, by its name.
    stored: Mutex<BTreeMap<String, Permit>>,
}

/// Counts an upload in progress, with its declared bytes, until it is dropped.
#[derive(Debug)]
pub(super) struct UploadPermit {
    /// The client that uploads.
    pub(super) account: Account,
    pub(super) upload: Permit,
    _bytes: Permit,
}

/// An upload outlives its client, so that its bytes count to the principal alone.
fn account_of_principal(principal: Option<Arc<str>>) -> Account {
    Account { principal, client: Client::Server }
}

impl UploadPermits {
    pub(super) fn new(config: &Config, metrics: &Admission) -> Arc<Self> {
        let pool = |limit: &'static Limit| metrics.pool(limit, (limit.total)(config));
        Arc::new(Self { uploads: pool(Limit::UPLOADS), bytes: pool(Limit::STORED_BYTES), stored: Mutex::default() })
    }

    /// Admits an upload of so many bytes.
    ///
    /// # Errors
    /// `LimitReached` when the client has its share of the uploads in progress, or its principal has its share of the bytes.
    pub(super) fn admit(&self, account: Account, bytes: u64) -> Result<UploadPermit> {
        // First, because a rejected upload must not end another one.
        let of_principal = account_of_principal(account.principal.clone());
        let bytes = self.bytes.acquire_amount(&of_principal, to_amount(bytes))?;
        let upload = self.uploads.acquire(&account)?;
        Ok(UploadPermit { account, upload, _bytes: bytes })
    }

    /// Counts the files of a scene on disk.
    pub(super) fn store(&self, scene: &str, principal: Option<Arc<str>>, bytes: u64) {
        let permit = self.bytes.count_held(&account_of_principal(principal), to_amount(bytes));
        lock(&self.stored).insert(scene.to_owned(), permit);
    }

    /// No longer counts the files of a scene.
    pub(super) fn remove(&self, scene: &str) {
        lock(&self.stored).remove(scene);
    }
}

fn to_amount(bytes: u64) -> usize {
    usize::try_from(bytes).unwrap_or(usize::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;
    use modalcast_model::error::Error;

    const GIB: u64 = 1 << 30;

    fn account(principal: &str, connection: u64) -> Account {
        Account { principal: Some(principal.into()), client: Client::Connection(connection) }
    }

    fn permits(stored_bytes: u64) -> Arc<UploadPermits> {
        UploadPermits::new(&Config { stored_bytes, ..Config::default() }, &Admission::default())
    }

    fn limit_of(result: Result<UploadPermit>) -> &'static str {
        match result {
            Err(Error::LimitReached { objects, .. }) => objects,
            other => panic!("expected LimitReached, got {other:?}"),
        }
    }

    /// The bytes of a principal count whichever client it uploads with, from the header until the scene is deleted.
    #[test]
    fn a_principal_leaves_bytes_for_others() {
        let permits = permits(16 * GIB);
        permits.store("old", Some("anna".into()), 4 * GIB);
        let first = permits.admit(account("anna", 1), 7 * GIB).expect("expected room");
        assert_eq!(limit_of(permits.admit(account("anna", 2), 2 * GIB)), "bytes of uploads on disk");
        permits.store("a", first.account.principal.clone(), 8 * GIB);
        drop(first);
        assert_eq!(limit_of(permits.admit(account("anna", 3), 1)), "bytes of uploads on disk");
        let of_ben = permits.admit(account("ben", 4), 3 * GIB).expect("expected room for another principal");
        assert_eq!(limit_of(permits.admit(account("ben", 4), GIB)), "bytes of uploads on disk");
        permits.admit(account("carla", 5), GIB).expect("expected the minimum of a principal");
        permits.remove("old");
        drop(of_ben);
        permits.admit(account("anna", 3), GIB).expect("expected the room of the removed scene");
    }

    /// More bytes than the limit exist after a restart with a lower one.
    #[test]
    fn stored_bytes_beyond_the_limit_count() {
        let permits = permits(100);
        permits.store("old", Some("anna".into()), 1000);
        assert_eq!(limit_of(permits.admit(account("ben", 1), 1)), "bytes of uploads on disk");
        permits.remove("old");
        permits.admit(account("ben", 1), 50).expect("expected room");
    }

    /// A rejected upload ends no other one, and one above the limit on their number ends the one that does not go on.
    #[test]
    fn a_new_client_replaces_an_upload_without_progress() {
        let permits = permits(GIB);
        let total = permits.uploads.total() as u64;
        let uploads: Vec<_> =
            (0..total).map(|client| permits.admit(account("anna", client), 1).expect("expected a place")).collect();
        for upload in &uploads {
            upload.upload.handle().mark_progress();
        }
        let ended = || uploads.iter().filter(|upload| upload.upload.handle().is_preempted()).count();
        assert_eq!(limit_of(permits.admit(account("ben", total), 2 * GIB)), "bytes of uploads on disk");
        assert_eq!(ended(), 0);
        let _new = permits.admit(account("ben", total), 1).expect("expected the place of the slowest upload");
        assert!(uploads[0].upload.handle().is_preempted() && ended() == 1);
    }
}
