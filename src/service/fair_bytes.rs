//! A limited number of bytes. Those that are free go to the waiting holder that has the fewest (max-min fairness), so
//! that a holder of many bytes does not delay one that returns its bytes.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

use tokio::sync::oneshot;
use tonic::Status;

use super::status::internal_fault;
use crate::engine::lock;

/// The bytes of all holders.
#[derive(Debug)]
pub(super) struct FairBytes {
    max_bytes: usize,
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    free_bytes: usize,
    /// In the order of their arrival.
    waiting: Vec<Waiter>,
}

#[derive(Debug)]
struct Waiter {
    holder: Arc<ByteHolder>,
    bytes: usize,
    grant: oneshot::Sender<ByteGrant>,
}

/// A connection, or another user of bytes.
#[derive(Debug)]
pub(super) struct ByteHolder {
    total: Arc<FairBytes>,
    /// Changes only while `FairBytes::state` is locked.
    held_bytes: AtomicUsize,
}

/// Bytes that return to the total when this is dropped.
#[derive(Debug)]
pub(super) struct ByteGrant {
    holder: Arc<ByteHolder>,
    bytes: usize,
}

impl FairBytes {
    pub(super) fn new(max_bytes: usize) -> Arc<Self> {
        Arc::new(Self { max_bytes, state: Mutex::new(State { free_bytes: max_bytes, waiting: Vec::new() }) })
    }

    pub(super) fn max_bytes(&self) -> usize {
        self.max_bytes
    }

    pub(super) fn new_holder(self: &Arc<Self>) -> Arc<ByteHolder> {
        Arc::new(ByteHolder { total: Arc::clone(self), held_bytes: AtomicUsize::new(0) })
    }

    #[cfg(test)]
    pub(super) fn free_bytes(&self) -> usize {
        lock(&self.state).free_bytes
    }

    /// Changes the state, and grants free bytes to waiters.
    fn update(&self, change: impl FnOnce(&mut State)) {
        let mut state = lock(&self.state);
        change(&mut state);
        let mut unclaimed = Vec::new();
        while let Some(Waiter { holder, bytes, grant }) = state.take_next() {
            state.free_bytes -= bytes;
            holder.held_bytes.fetch_add(bytes, Ordering::Relaxed);
            unclaimed.extend(grant.send(ByteGrant { holder, bytes }).err());
        }
        // A grant to a canceled waiter is returned by `update`, which needs the lock.
        drop(state);
    }
}

impl State {
    /// Removes the waiter that is next, if its bytes are free: the earliest of those whose holders have the fewest.
    fn take_next(&mut self) -> Option<Waiter> {
        self.waiting.retain(|waiter| !waiter.grant.is_closed());
        let waiters = self.waiting.iter().enumerate();
        let (index, next) = waiters.min_by_key(|(_, waiter)| waiter.holder.held_bytes.load(Ordering::Relaxed))?;
        (next.bytes <= self.free_bytes).then(|| self.waiting.remove(index))
    }
}

impl ByteHolder {
    /// Waits for bytes, at most all that exist. Cancel-safe.
    ///
    /// # Errors
    /// `INTERNAL` if the place of the waiter is lost, which would be a fault of this module.
    pub(super) async fn acquire(self: &Arc<Self>, bytes: usize) -> Result<ByteGrant, Status> {
        let bytes = bytes.min(self.total.max_bytes);
        let _update = UpdateOnDrop(&self.total);
        let (grant, granted) = oneshot::channel();
        self.total.update(|state| state.waiting.push(Waiter { holder: Arc::clone(self), bytes, grant }));
        granted.await.map_err(|_| internal_fault("a wait for the reply budget was lost"))
    }
}

/// Grants bytes to others when a waiter is canceled that was before them.
struct UpdateOnDrop<'a>(&'a FairBytes);

impl Drop for UpdateOnDrop<'_> {
    fn drop(&mut self) {
        self.0.update(|_| ());
    }
}

impl ByteGrant {
    /// Removes `bytes`, at most all of these.
    pub(super) fn split(&mut self, bytes: usize) -> Self {
        let bytes = bytes.min(self.bytes);
        self.bytes -= bytes;
        Self { holder: Arc::clone(&self.holder), bytes }
    }
}

impl Drop for ByteGrant {
    fn drop(&mut self) {
        self.holder.total.update(|state| {
            state.free_bytes += self.bytes;
            self.holder.held_bytes.fetch_sub(self.bytes, Ordering::Relaxed);
        });
    }
}

#[cfg(test)]
mod tests {
    use std::pin::Pin;

    use futures_util::FutureExt;

    use super::*;

    type Acquire = Pin<Box<dyn Future<Output = ByteGrant>>>;

    fn acquire(holder: &Arc<ByteHolder>, bytes: usize) -> Acquire {
        let holder = Arc::clone(holder);
        Box::pin(async move { holder.acquire(bytes).await.expect("expected a place") })
    }

    /// The bytes that are granted at once.
    fn granted(acquire: &mut Acquire) -> Option<ByteGrant> {
        acquire.now_or_never()
    }

    #[test]
    fn waiter_whose_holder_has_the_fewest_bytes_is_first() {
        let total = FairBytes::new(100);
        let [large, small, empty] = [(); 3].map(|()| total.new_holder());
        let mut of_large = granted(&mut acquire(&large, 80)).expect("expected free bytes");
        let of_small = granted(&mut acquire(&small, 20)).expect("expected free bytes");
        let mut waiting =
            [(&large, 10), (&small, 10), (&empty, 10), (&empty, 20)].map(|(of, bytes)| acquire(of, bytes));
        assert!(waiting.iter_mut().all(|waiter| granted(waiter).is_none()));
        drop(of_large.split(10));
        assert!(granted(&mut waiting[1]).is_none() && granted(&mut waiting[0]).is_none());
        let of_empty = granted(&mut waiting[2]).expect("expected the bytes of the large holder");
        // The larger request of the holder with 10 bytes is next, and nothing passes it.
        drop(of_large.split(10));
        assert!(waiting.iter_mut().take(2).all(|waiter| granted(waiter).is_none()));
        let [first, second, _, last] = &mut waiting;
        assert!(granted(last).is_none());
        // A canceled waiter gives up its place and the bytes that it was granted.
        *last = acquire(&empty, 0);
        assert!(granted(second).is_some() && granted(first).is_some());
        drop((of_large, of_small, of_empty));
        assert_eq!(total.free_bytes(), 100);
    }

    #[test]
    fn more_bytes_than_exist_are_granted_alone() {
        let total = FairBytes::new(100);
        let [first, second] = [(); 2].map(|()| total.new_holder());
        let all = granted(&mut acquire(&first, 1000)).expect("expected free bytes");
        let mut waiting = acquire(&second, 1);
        assert!(granted(&mut waiting).is_none());
        drop(all);
        assert!(granted(&mut waiting).is_some());
        assert_eq!(total.free_bytes(), 100);
    }
}
