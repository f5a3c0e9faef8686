//! The registry of scenes by name. A name is reserved before its scene is loaded, so that concurrent openings of one
//! name share one load.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};

use tokio::sync::{OnceCell, watch};

use super::lock::lock;
use super::scene_not_open;
use crate::admission::{Account, Permit, PermitPool};
use crate::engine::device::command::SceneId;
use crate::engine::scene::handle::SceneHandle;
use crate::engine::storage::provenance::SceneProvenance;
use crate::engine::storage::scene_record::{SceneAccess, SceneRecord, SharedAccess};
use crate::identity::Principal;
use modalcast_model::error::{Error, Result};

/// A scene that is to be opened.
#[derive(Debug, Clone)]
pub(super) struct OpenRequest {
    pub(super) name: String,
    pub(super) record: SceneRecord,
    /// What the scene counts to.
    pub(super) account: Account,
    /// Whether the scene was open in the last run of the server, and then only needs a free permit.
    pub(super) is_reopened: bool,
    pub(super) is_built_in: bool,
}

/// The scenes of a server at one moment.
#[derive(Debug, Clone)]
pub struct SceneList {
    pub open: Vec<Arc<SceneHandle>>,
    /// Names of the scenes that are being opened.
    pub opening: Vec<String>,
    pub failed: Vec<FailedScene>,
}

/// A scene that has failed, or that could not be opened again.
#[derive(Debug, Clone, PartialEq)]
pub struct FailedScene {
    pub name: String,
    /// Readable description of where the scene comes from.
    pub source: String,
    pub error: Error,
    pub access: SceneAccess,
}

/// A reserved name, and its scene once the scene is loaded.
pub(super) struct RegistryEntry {
    provenance: SceneProvenance,
    access: SharedAccess,
    account: Account,
    /// `None` for the first scene of each built-in source, which does not count.
    _permit: Option<Permit>,
    /// Empty until the scene is loaded.
    cell: OnceCell<Arc<SceneHandle>>,
    /// Number of concurrent openings; modified only under the registry's lock.
    open_calls: AtomicUsize,
}

impl RegistryEntry {
    /// Returns the scene. The first caller loads it while the others wait. If the load fails, the next caller retries
    /// it.
    ///
    /// # Errors
    /// The error of `load`; the error of a scene that has failed; `Busy` when the scene is being closed.
    pub(super) async fn get_or_open<F>(&self, load: impl FnOnce() -> F) -> Result<Arc<SceneHandle>>
    where
        F: Future<Output = Result<Arc<SceneHandle>>>,
    {
        let scene_handle = self.cell.get_or_try_init(load).await?;
        match scene_handle.failure() {
            Some(error) => Err(error.clone()),
            None if scene_handle.is_closing() => {
                Err(Error::Busy { queue: "queue for a scene that is being closed", limit: 1 })
            }
            None => Ok(Arc::clone(scene_handle)),
        }
    }

    /// The record of the scene in the catalog.
    pub(super) fn record(&self) -> SceneRecord {
        SceneRecord { provenance: self.provenance.clone(), access: self.access.borrow().clone() }
    }

    pub(super) const fn access(&self) -> &SharedAccess {
        &self.access
    }

    /// What the scene counts to.
    pub(super) const fn account(&self) -> &Account {
        &self.account
    }

    /// The scene; `None` while it is not loaded.
    pub(super) fn scene_handle(&self) -> Option<&Arc<SceneHandle>> {
        self.cell.get()
    }
}

/// All reserved names.
pub(super) struct Registry {
    permits: PermitPool,
    entries: Mutex<BTreeMap<String, Arc<RegistryEntry>>>,
    /// By name. At most one per name in the catalog.
    failed: Mutex<BTreeMap<String, FailedScene>>,
}

impl Registry {
    pub(super) const fn new(permits: PermitPool) -> Self {
        Self { permits, entries: Mutex::new(BTreeMap::new()), failed: Mutex::new(BTreeMap::new()) }
    }

    /// Reserves a name for a call of `principal` that opens it, or joins an existing reservation with the same provenance
    /// that the principal may use. With `must_be_new` an existing reservation is an error. The call ends with [`Self::release`]. The first scene of each
    /// built-in source does not count for the limits, so that other scenes cannot lock it out.
    ///
    /// # Errors
    /// `NameTaken` when the name is reserved for another provenance, `LimitReached` when the client has its share of the
    /// open scenes.
    pub(super) fn reserve(
        &self,
        request: &OpenRequest,
        principal: &Principal,
        must_be_new: bool,
    ) -> Result<Arc<RegistryEntry>> {
        let OpenRequest { name, record: SceneRecord { provenance, access }, account, is_reopened, is_built_in } =
            request;
        let mut entries = self.lock();
        if let Some(entry) = entries.get(name) {
            let may_join = entry.access.borrow().right_of(principal).is_some() && entry.provenance == *provenance;
            return match !must_be_new && may_join {
                true => {
                    entry.open_calls.fetch_add(1, Ordering::Relaxed);
                    Ok(Arc::clone(entry))
                }
                false => Err(name_taken_error(name, entry, principal)),
            };
        }
        let is_extra = *is_built_in && !entries.values().any(|entry| entry.provenance == *provenance);
        let permit = match (is_extra, is_reopened) {
            (true, _) => None,
            (false, true) => Some(self.permits.acquire_any(account)?),
            (false, false) => Some(self.permits.acquire(account)?),
        };
        let entry = Arc::new(RegistryEntry {
            provenance: provenance.clone(),
            access: Arc::new(watch::Sender::new(access.clone())),
            account: account.clone(),
            _permit: permit,
            cell: OnceCell::new(),
            open_calls: AtomicUsize::new(1),
        });
        entries.insert(name.clone(), Arc::clone(&entry));
        Ok(entry)
    }

    /// Checks that a client of `principal` can upload a scene with this name.
    ///
    /// # Errors
    /// `NameTaken` when the name is reserved, `LimitReached` when the client has its share of the open scenes.
    pub(super) fn check_upload(&self, name: &str, principal: &Principal, account: &Account) -> Result<()> {
        match self.lock().get(name) {
            Some(entry) => Err(name_taken_error(name, entry, principal)),
            None => self.permits.check(account),
        }
    }

    pub(super) fn find_entry(&self, name: &str) -> Option<Arc<RegistryEntry>> {
        self.lock().get(name).cloned()
    }

    /// The open scene with this name.
    ///
    /// # Errors
    /// `NotFound` when the name is not reserved or the scene is being closed, `Busy` while the scene is being opened.
    pub(super) fn find(&self, name: &str) -> Result<Arc<SceneHandle>> {
        let entries = self.lock();
        let entry = entries.get(name).ok_or_else(|| scene_not_open(name))?;
        match entry.scene_handle() {
            Some(scene_handle) if scene_handle.is_closing() => Err(scene_not_open(name)),
            Some(scene_handle) => Ok(Arc::clone(scene_handle)),
            None => Err(Error::Busy { queue: "queue for a scene that is being opened", limit: 1 }),
        }
    }

    /// Waits while a scene with this name is being opened.
    pub(super) async fn wait_until_opened(&self, name: &str) {
        if let Some(entry) = self.find_entry(name) {
            // Fails if the opening fails, or has not begun.
            entry.cell.get_or_try_init(async || Err(scene_not_open(name))).await.ok();
        }
    }

    /// The failed scenes, sorted by name.
    pub(super) fn failed(&self) -> Vec<FailedScene> {
        self.failed_among(&self.lock())
    }

    fn failed_among(&self, entries: &BTreeMap<String, Arc<RegistryEntry>>) -> Vec<FailedScene> {
        lock(&self.failed).values().filter(|failed| !entries.contains_key(&failed.name)).cloned().collect()
    }

    /// Records that a scene could not be opened again.
    pub(super) fn record_failure(&self, name: &str, record: &SceneRecord, error: Error) {
        let SceneRecord { provenance, access } = record;
        let failed = FailedScene { name: name.to_owned(), source: provenance.label(), error, access: access.clone() };
        lock(&self.failed).insert(name.to_owned(), failed);
    }

    /// Changes who may use a scene.
    pub(super) fn set_access(&self, name: &str, access: &SceneAccess) {
        if let Some(entry) = self.lock().get(name) {
            entry.access.send_replace(access.clone());
        }
        if let Some(failed) = lock(&self.failed).get_mut(name) {
            failed.access = access.clone();
        }
    }

    /// A deleted scene is no longer a failed one.
    pub(super) fn forget_failure(&self, name: &str) {
        lock(&self.failed).remove(name);
    }

    /// The scenes that a principal may use, sorted by name. The state of each scene is read once, so that a scene that is
    /// loaded meanwhile is not missing.
    pub(super) fn list(&self, principal: &Principal) -> SceneList {
        let entries = self.lock();
        let may_use = |access: &SceneAccess| access.right_of(principal).is_some();
        let mut failed = self.failed_among(&entries);
        failed.retain(|failed| may_use(&failed.access));
        let mut list = SceneList { open: Vec::new(), opening: Vec::new(), failed };
        for (name, entry) in entries.iter().filter(|(_, entry)| may_use(&entry.access.borrow())) {
            match entry.scene_handle() {
                Some(scene_handle) if scene_handle.is_closing() => {}
                Some(scene_handle) => list.open.push(Arc::clone(scene_handle)),
                None => list.opening.push(name.clone()),
            }
        }
        list
    }

    /// Ends one call that opens the name. The last such call releases the name if no scene was loaded.
    pub(super) fn release(&self, name: &str, entry: &Arc<RegistryEntry>) {
        let mut entries = self.lock();
        let is_last = entry.open_calls.fetch_sub(1, Ordering::Relaxed) == 1;
        if is_last && entry.scene_handle().is_none() {
            entries.remove(name);
        }
    }

    /// Releases the name of a closed scene unless another opening has reserved it since.
    pub(super) fn remove(&self, name: &str, entry: &Arc<RegistryEntry>) {
        let mut entries = self.lock();
        if entries.get(name).is_some_and(|registered| Arc::ptr_eq(registered, entry)) {
            entries.remove(name);
        }
    }

    /// Releases the name of a scene that has failed, and records the failure.
    pub(super) fn remove_failed_scene(&self, name: &str, id: SceneId) {
        let mut entries = self.lock();
        let is_registered = |entry: &&Arc<RegistryEntry>| entry.scene_handle().is_some_and(|scene| scene.id() == id);
        let Some(entry) = entries.get(name).filter(is_registered).cloned() else { return };
        if let Some(error) = entry.scene_handle().and_then(|scene_handle| scene_handle.failure()) {
            self.record_failure(name, &entry.record(), error.clone());
        }
        entries.remove(name);
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<String, Arc<RegistryEntry>>> {
        lock(&self.entries)
    }
}

/// The error of a name that another scene has. It does not describe a scene that the principal may not know of.
fn name_taken_error(name: &str, entry: &RegistryEntry, principal: &Principal) -> Error {
    let owner = match entry.access.borrow().right_of(principal) {
        Some(_) => entry.provenance.label(),
        None => return hidden_name_error(name),
    };
    Error::NameTaken { name: name.into(), owner }
}

/// The error of a name that belongs to a scene of which the principal may not know.
pub(super) fn hidden_name_error(name: &str) -> Error {
    Error::NameTaken { name: name.into(), owner: "a scene of another principal".into() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::admission::{Admission, Client, Limit};
    use crate::identity::Role;

    fn account(client: u64) -> Account {
        Account::new(&Principal::owner(), Client::Connection(client))
    }

    fn request(name: &str, client: u64, is_built_in: bool) -> OpenRequest {
        let source = if is_built_in { "tree" } else { name }.to_owned();
        let provenance = SceneProvenance::Repository { source };
        let record = SceneRecord { provenance, access: SceneAccess::new(&Principal::owner()) };
        let account = account(client);
        OpenRequest { name: name.to_owned(), record, account, is_reopened: false, is_built_in }
    }

    fn registry(max_scenes: usize) -> Registry {
        Registry::new(Admission::default().pool(Limit::OPEN_SCENES, max_scenes))
    }

    #[test]
    fn clients_share_scenes_and_the_built_in_one_does_not_count() {
        let registry = registry(4);
        let open = |request| registry.reserve(&request, &Principal::owner(), false);
        let reserve = |name: &str, client| open(request(name, client, false));
        let is_full = |result: Result<Arc<RegistryEntry>>| matches!(result, Err(Error::LimitReached { limit: 4, .. }));
        let first = reserve("a", 1).expect("expected a free permit");
        for name in ["b", "c"] {
            reserve(name, 1).expect("expected a free permit");
        }
        assert!(is_full(reserve("d", 1)), "expected a scene for others");
        reserve("a", 2).expect("expected another client to join");
        registry.release("a", &first);
        open(request("tree", 1, true)).expect("expected the built-in scene");
        assert!(is_full(open(request("tree 2", 1, true))), "expected one uncounted scene of each built-in source");
        open(OpenRequest { is_reopened: true, ..request("d", 1, false) }).expect("expected a scene of the last run");
        assert!(is_full(open(OpenRequest { is_reopened: true, ..request("e", 1, false) })));
        assert!(
            matches!(registry.find("tree"), Err(Error::Busy { .. }))
                && registry.list(&Principal::owner()).opening.contains(&"tree".into())
        );
        registry.release("a", &first);
        drop(first);
        let other = Account { principal: Some("anna".into()), ..account(3) };
        open(OpenRequest { account: other, ..request("e", 3, false) })
            .expect("expected the permit of the released name");
    }

    #[test]
    fn names_of_other_principals_are_taken_without_a_description() {
        let registry = registry(3);
        let [anna, ben] = ["anna", "ben"].map(|name| Principal { name: name.into(), role: Role::Upload });
        let mut of_anna = request("a", 1, false);
        of_anna.record.access = SceneAccess::new(&anna);
        let reserve = |principal| registry.reserve(&of_anna, principal, false);
        reserve(&anna).expect("expected a place");
        let taken = |result: Result<Arc<RegistryEntry>>| match result {
            Err(Error::NameTaken { owner, .. }) => owner,
            _ => panic!("expected NameTaken"),
        };
        assert_eq!(taken(reserve(&ben)), "a scene of another principal");
        let upload = registry.check_upload("a", &ben, &account(2));
        assert_eq!(
            upload.expect_err("expected an error"),
            Error::NameTaken { name: "a".into(), owner: "a scene of another principal".into() }
        );
        registry.set_access("a", &SceneAccess { shared_with: [ben.name.clone()].into(), ..SceneAccess::new(&anna) });
        reserve(&ben).expect("expected to join a shared scene");
    }

    #[test]
    fn failures_are_listed_until_the_scene_is_open_or_deleted() {
        let registry = registry(3);
        let OpenRequest { record, .. } = request("a", 1, false);
        registry.record_failure("a", &record, Error::ShuttingDown);
        let names = || registry.failed().into_iter().map(|failed| failed.name).collect::<Vec<_>>();
        assert_eq!(names(), ["a"]);
        let entry = registry.reserve(&request("a", 1, false), &Principal::owner(), false).expect("expected a place");
        assert!(names().is_empty());
        registry.release("a", &entry);
        assert_eq!(names(), ["a"]);
        registry.forget_failure("a");
        assert!(names().is_empty());
    }
}
