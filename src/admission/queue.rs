//! Queues for resources that are returned soon. What is free goes to the waiting client that holds the least.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, Weak};

use tokio::sync::oneshot;

use super::account::Account;
use super::grant::lock;
use super::limits::Limit;
use crate::config::Config;
use modalcast_model::error::{Result, fault_in};

/// The queue of one resource, for whose units clients wait: max-min between principals first, then between the clients of a
/// principal. A clone is shallow.
#[derive(Debug, Clone)]
pub struct Queue(Arc<Shared>);

#[derive(Debug)]
struct Shared {
    total: usize,
    /// What a single client can hold.
    max_of_client: usize,
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    free: usize,
    /// In the order of their arrival.
    waiting: Vec<Waiter>,
    /// Those that exist, and some that do not exist any more.
    principals: BTreeMap<Option<Arc<str>>, Weak<AtomicUsize>>,
    clients: BTreeMap<Account, Weak<Holder>>,
}

#[derive(Debug)]
struct Waiter {
    holder: Arc<Holder>,
    amount: usize,
    grant: oneshot::Sender<Units>,
}

/// What a client holds. It changes only while the state is locked.
#[derive(Debug)]
struct Holder {
    of_principal: Arc<AtomicUsize>,
    of_client: AtomicUsize,
}

/// The place of a client in a queue. A clone is shallow.
#[derive(Debug, Clone)]
pub struct QueueMember {
    queue: Arc<Shared>,
    holder: Arc<Holder>,
}

/// Units of a resource, which return to the queue when this is dropped.
#[derive(Debug)]
pub struct Units {
    member: QueueMember,
    amount: usize,
}

impl Queue {
    /// The queue for a resource of the table.
    pub fn new(limit: &Limit, config: &Config) -> Self {
        let (total, max_of_client) = ((limit.total)(config), limit.of_client(config));
        let (principals, clients) = (BTreeMap::new(), BTreeMap::new());
        let state = Mutex::new(State { free: total, waiting: Vec::new(), principals, clients });
        Self(Arc::new(Shared { total, max_of_client, state }))
    }

    pub fn total(&self) -> usize {
        self.0.total
    }

    #[cfg(test)]
    pub(crate) fn free(&self) -> usize {
        lock(&self.0.state).free
    }

    /// The place of an account.
    pub fn member(&self, account: &Account) -> QueueMember {
        QueueMember { queue: Arc::clone(&self.0), holder: lock(&self.0.state).find_holder(account) }
    }
}

impl Shared {
    /// Changes the state, and grants free units to waiters.
    fn update(self: &Arc<Self>, change: impl FnOnce(&mut State)) {
        let mut state = lock(&self.state);
        change(&mut state);
        let mut unclaimed = Vec::new();
        while let Some(Waiter { holder, amount, grant }) = state.take_next(self.max_of_client) {
            state.free -= amount;
            holder.add(amount);
            let member = QueueMember { queue: Arc::clone(self), holder };
            unclaimed.extend(grant.send(Units { member, amount }).err());
        }
        // A grant to a canceled waiter is returned by `update`, which needs the lock.
        drop(state);
    }
}

impl State {
    fn find_holder(&mut self, account: &Account) -> Arc<Holder> {
        if let Some(holder) = self.clients.get(account).and_then(Weak::upgrade) {
            return holder;
        }
        self.clients.retain(|_, holder| holder.strong_count() > 0);
        self.principals.retain(|_, held| held.strong_count() > 0);
        let of_principal = self.principals.get(&account.principal).and_then(Weak::upgrade).unwrap_or_default();
        self.principals.insert(account.principal.clone(), Arc::downgrade(&of_principal));
        let holder = Arc::new(Holder { of_principal, of_client: AtomicUsize::new(0) });
        self.clients.insert(account.clone(), Arc::downgrade(&holder));
        holder
    }

    /// Removes the waiter that is next, if its units are free: the earliest of those whose principals, and then clients,
    /// hold the least. Those of clients that hold their share are passed over.
    fn take_next(&mut self, max_of_client: usize) -> Option<Waiter> {
        self.waiting.retain(|waiter| !waiter.grant.is_closed());
        let waiters = self.waiting.iter().enumerate();
        let below_share = waiters.filter(|(_, waiter)| waiter.holder.of_client() + waiter.amount <= max_of_client);
        let (index, next) = below_share.min_by_key(|(_, waiter)| waiter.holder.rank())?;
        (next.amount <= self.free).then(|| self.waiting.remove(index))
    }
}

impl Holder {
    fn of_client(&self) -> usize {
        self.of_client.load(Ordering::Relaxed)
    }

    /// The order in which units are granted.
    fn rank(&self) -> [usize; 2] {
        [self.of_principal.load(Ordering::Relaxed), self.of_client()]
    }

    fn add(&self, amount: usize) {
        for held in [&*self.of_principal, &self.of_client] {
            held.fetch_add(amount, Ordering::Relaxed);
        }
    }

    fn remove(&self, amount: usize) {
        for held in [&*self.of_principal, &self.of_client] {
            held.fetch_sub(amount, Ordering::Relaxed);
        }
    }
}

impl QueueMember {
    /// Waits for units, at most all that a single client can hold. Cancel-safe.
    ///
    /// # Errors
    /// `Fault` if the place of the waiter is lost, which would be a fault of this module.
    pub async fn acquire(&self, amount: usize) -> Result<Units> {
        let amount = amount.min(self.queue.max_of_client);
        let _update = UpdateOnDrop(&self.queue);
        let (grant, granted) = oneshot::channel();
        let waiter = Waiter { holder: Arc::clone(&self.holder), amount, grant };
        self.queue.update(|state| state.waiting.push(waiter));
        granted.await.map_err(fault_in("queue"))
    }
}

/// Grants units to others when a waiter is canceled that was before them.
struct UpdateOnDrop<'a>(&'a Arc<Shared>);

impl Drop for UpdateOnDrop<'_> {
    fn drop(&mut self) {
        self.0.update(|_| ());
    }
}

impl Units {
    /// Removes `amount`, at most all of these.
    pub fn split(&mut self, amount: usize) -> Self {
        let amount = amount.min(self.amount);
        self.amount -= amount;
        Self { member: self.member.clone(), amount }
    }
}

impl Drop for Units {
    fn drop(&mut self) {
        let QueueMember { queue, holder } = &self.member;
        queue.update(|state| {
            state.free += self.amount;
            holder.remove(self.amount);
        });
    }
}

#[cfg(test)]
mod tests {
    use std::pin::Pin;

    use futures_util::FutureExt;

    use super::*;
    use crate::admission::Client;

    type Acquire = Pin<Box<dyn Future<Output = Units>>>;

    /// A queue for 100 bytes, of which one client can hold 88.
    fn queue() -> Queue {
        Queue::new(Limit::REPLY_BYTES, &Config { reply_bytes: 100, ..Config::default() })
    }

    fn member(queue: &Queue, principal: &str, client: u64) -> QueueMember {
        queue.member(&Account { principal: Some(principal.into()), client: Client::Connection(client) })
    }

    fn acquire(member: &QueueMember, amount: usize) -> Acquire {
        let member = member.clone();
        Box::pin(async move { member.acquire(amount).await.expect("expected a place") })
    }

    /// The units that are granted at once.
    fn granted(acquire: &mut Acquire) -> Option<Units> {
        acquire.now_or_never()
    }

    #[test]
    fn waiter_whose_client_has_the_least_is_first() {
        let queue = queue();
        let [large, small, empty] = [1, 2, 3].map(|client| member(&queue, "anna", client));
        let mut of_large = granted(&mut acquire(&large, 80)).expect("expected free units");
        let of_small = granted(&mut acquire(&small, 20)).expect("expected free units");
        let mut waiting =
            [(&large, 8), (&small, 10), (&empty, 10), (&empty, 20)].map(|(of, amount)| acquire(of, amount));
        assert!(waiting.iter_mut().all(|waiter| granted(waiter).is_none()));
        drop(of_large.split(10));
        assert!(granted(&mut waiting[1]).is_none() && granted(&mut waiting[0]).is_none());
        let of_empty = granted(&mut waiting[2]).expect("expected the units of the large client");
        // The larger request of the client with 10 units is next, and nothing passes it.
        drop(of_large.split(10));
        assert!(waiting.iter_mut().take(2).all(|waiter| granted(waiter).is_none()));
        let [first, second, _, last] = &mut waiting;
        assert!(granted(last).is_none());
        // A canceled waiter gives up its place and the units that it was granted.
        *last = acquire(&empty, 0);
        assert!(granted(second).is_some() && granted(first).is_some());
        drop((of_large, of_small, of_empty));
        assert_eq!(queue.free(), 100);
    }

    /// Clients of a principal that holds much wait for one of another principal, however many clients they are.
    #[test]
    fn principals_share_before_clients() {
        let queue = queue();
        let mut of_anna: Vec<_> = (0..10)
            .map(|client| granted(&mut acquire(&member(&queue, "anna", client), 10)).expect("expected free units"))
            .collect();
        let mut new_of_anna = acquire(&member(&queue, "anna", 10), 10);
        let [mut first, mut second] = [1, 1].map(|client| acquire(&member(&queue, "ben", client), 10));
        for waiter in [&mut new_of_anna, &mut first, &mut second] {
            assert!(granted(waiter).is_none());
        }
        of_anna.truncate(8);
        let of_ben = [&mut first, &mut second].map(|waiter| granted(waiter).expect("expected the returned units"));
        assert!(granted(&mut new_of_anna).is_none());
        of_anna.truncate(7);
        assert!(granted(&mut new_of_anna).is_some());
        drop((of_anna, of_ben));
        assert_eq!(queue.free(), 100);
    }

    /// One client cannot take everything, and its further requests do not delay those of others.
    #[test]
    fn client_leaves_units_for_others_and_is_passed_over() {
        let queue = queue();
        let [greedy, other] = [1, 2].map(|client| member(&queue, "anna", client));
        let all = granted(&mut acquire(&greedy, 1000)).expect("expected free units");
        assert_eq!(queue.free(), 12);
        let mut more = acquire(&greedy, 1);
        assert!(granted(&mut more).is_none());
        let of_other = granted(&mut acquire(&other, 12)).expect("expected what the first client leaves");
        drop(all);
        assert!(granted(&mut more).is_some());
        drop((of_other, more));
        assert_eq!(queue.free(), 100);
    }

    #[test]
    fn clients_that_do_not_exist_any_more_are_forgotten() {
        let queue = queue();
        for client in 0..100 {
            drop(member(&queue, &format!("principal {client}"), client));
        }
        let state = lock(&queue.0.state);
        assert!(state.clients.len() <= 1 && state.principals.len() <= 1);
    }
}
