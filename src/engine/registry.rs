//! The registry of scenes by name. A name is reserved before its scene is loaded, so that concurrent openings of one
//! name share one load.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::OnceCell;

use super::host::Host;
use super::ledger::Origin;
use super::not_open;
use modalcast_model::error::{Error, Result};

/// A reserved name, and its scene once the scene is loaded.
pub(super) struct Seat {
    origin: Origin,
    cell: OnceCell<Arc<Host>>,
    /// Number of concurrent openings; modified only under the registry's lock.
    openings: AtomicUsize,
}

impl Seat {
    /// The scene, loaded by the first caller. The other callers wait; if the load fails, the next caller retries it.
    ///
    /// # Errors
    /// The error of `load`; `Busy` when the scene is being closed.
    pub(super) async fn open<F>(&self, load: impl FnOnce() -> F) -> Result<Arc<Host>>
    where
        F: Future<Output = Result<Arc<Host>>>,
    {
        let host = self.cell.get_or_try_init(load).await?;
        match host.is_closing() {
            false => Ok(Arc::clone(host)),
            true => Err(Error::Busy { queue: "the name of a scene that is being closed", limit: 1 }),
        }
    }

    /// The scene; `None` while it is not loaded.
    pub(super) fn host(&self) -> Option<&Arc<Host>> {
        self.cell.get()
    }
}

/// All reserved names.
pub(super) struct Registry {
    limit: usize,
    seats: Mutex<BTreeMap<String, Arc<Seat>>>,
}

impl Registry {
    pub(super) const fn new(limit: usize) -> Self {
        Self { limit, seats: Mutex::new(BTreeMap::new()) }
    }

    /// Reserves a name until [`Self::leave`], or joins an existing reservation with the same origin. With `fresh` the
    /// name must be free.
    ///
    /// # Errors
    /// `Taken` when the name is reserved for another origin, `Busy` when too many scenes are open.
    pub(super) fn seat(&self, name: &str, origin: &Origin, fresh: bool) -> Result<Arc<Seat>> {
        let mut seats = self.lock();
        if let Some(seat) = seats.get(name) {
            return match !fresh && seat.origin == *origin {
                true => {
                    seat.openings.fetch_add(1, Ordering::Relaxed);
                    Ok(Arc::clone(seat))
                }
                false => Err(taken(name, seat)),
            };
        }
        if seats.len() >= self.limit {
            return Err(Error::Busy { queue: "list of open scenes", limit: self.limit });
        }
        let seat = Arc::new(Seat { origin: origin.clone(), cell: OnceCell::new(), openings: AtomicUsize::new(1) });
        seats.insert(name.to_owned(), Arc::clone(&seat));
        Ok(seat)
    }

    pub(super) fn check_free(&self, name: &str) -> Result<()> {
        self.lock().get(name).map_or(Ok(()), |seat| Err(taken(name, seat)))
    }

    pub(super) fn seat_of(&self, name: &str) -> Option<Arc<Seat>> {
        self.lock().get(name).cloned()
    }

    pub(super) fn find(&self, name: &str) -> Result<Arc<Host>> {
        let seats = self.lock();
        let host = seats.get(name).and_then(|seat| seat.host()).filter(|host| !host.is_closing());
        host.cloned().ok_or_else(|| not_open(name))
    }

    pub(super) fn list(&self) -> Vec<Arc<Host>> {
        self.lock().values().filter_map(|seat| seat.host().cloned()).filter(|host| !host.is_closing()).collect()
    }

    /// Ends an opening. The last one releases the name if no scene was loaded.
    pub(super) fn leave(&self, name: &str, seat: &Arc<Seat>) {
        let mut seats = self.lock();
        let is_last = seat.openings.fetch_sub(1, Ordering::Relaxed) == 1;
        if is_last && seat.host().is_none() {
            seats.remove(name);
        }
    }

    /// Releases the name of a closed scene unless another opening has reserved it since.
    pub(super) fn remove(&self, name: &str, seat: &Arc<Seat>) {
        let mut seats = self.lock();
        if seats.get(name).is_some_and(|held| Arc::ptr_eq(held, seat)) {
            seats.remove(name);
        }
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<String, Arc<Seat>>> {
        // Every change under the lock is one insertion or removal, so the map behind a poisoned lock is valid.
        self.seats.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn taken(name: &str, seat: &Seat) -> Error {
    Error::Taken { what: "the name of the scene", holder: format!("'{name}' is {}", seat.origin.source()) }
}
