//! Pools of permits.

use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, Weak};
use std::time::{Duration, Instant};

use tokio::sync::Notify;

use super::account::Account;
use super::grant::{Grant, lock};
use super::holdings::{EndedClient, PoolHolding, ResourceUse};
use super::limits::{Limit, WhenFull};
use super::metrics::ResourceMetrics;
use super::sharing::{Decision, Holders, Share};
use modalcast_model::error::{Error, Result};

/// Shortest time between two log records of the preemptions of a pool.
const LOG_INTERVAL: Duration = Duration::from_secs(1);

/// The permits of one resource. A clone is shallow.
#[derive(Debug, Clone)]
pub struct PermitPool(Arc<Shared>);

/// Refers to a pool, and does not keep it.
#[derive(Debug)]
pub(super) struct WeakPermitPool(Weak<Shared>);

#[derive(Debug)]
struct Shared {
    limit: &'static Limit,
    /// The scene of a pool that each scene has.
    scene: Option<Arc<str>>,
    share: Share,
    metrics: ResourceMetrics,
    state: Mutex<State>,
    /// Notified when a permit is dropped.
    released: Notify,
}

#[derive(Debug, Default)]
struct State {
    holders: Holders,
    /// Number of preempted permits that are not dropped yet. They no longer count.
    ending: usize,
    log: PreemptionLog,
}

/// Preemptions since the last log record.
#[derive(Debug, Default)]
struct PreemptionLog {
    count: u64,
    last_record: Option<Instant>,
}

/// Counts for an amount of a resource until it is dropped.
#[derive(Debug)]
pub struct Permit(PermitHandle);

/// Refers to a permit, and does not keep it.
#[derive(Debug, Clone)]
pub struct PermitHandle {
    pool: Arc<Shared>,
    grant: Arc<Grant>,
}

impl WeakPermitPool {
    /// `None` once the pool is dropped.
    pub(super) fn upgrade(&self) -> Option<PermitPool> {
        self.0.upgrade().map(PermitPool)
    }
}

impl PermitPool {
    /// `scene` is that of a pool that each scene has.
    pub(super) fn new(limit: &'static Limit, total: usize, scene: Option<Arc<str>>, metrics: ResourceMetrics) -> Self {
        let share = Share { total, reserve: total / limit.reserve_divisor, when_full: limit.when_full };
        Self(Arc::new(Shared { limit, scene, share, metrics, state: Mutex::default(), released: Notify::new() }))
    }

    pub(super) fn downgrade(&self) -> WeakPermitPool {
        WeakPermitPool(Arc::downgrade(&self.0))
    }

    /// Grants a permit that counts as one, if necessary after the preemption of another one.
    ///
    /// # Errors
    /// `LimitReached` when no permit is free and the client has its share, or the client would take the reserve.
    pub fn acquire(&self, account: &Account) -> Result<Permit> {
        self.acquire_amount(account, 1)
    }

    /// [`Self::acquire`] for a permit that counts for `amount`, in units of the resource.
    ///
    /// # Errors
    /// As for [`Self::acquire`].
    pub fn acquire_amount(&self, account: &Account, amount: usize) -> Result<Permit> {
        let mut state = lock(&self.0.state);
        self.0.make_room(&mut state, account, amount)?;
        Ok(self.grant(&mut state, account, amount))
    }

    /// Grants a permit that counts as one if one is free, without regard to the shares of the holders.
    ///
    /// # Errors
    /// `LimitReached` when no permit is free.
    pub fn acquire_any(&self, account: &Account) -> Result<Permit> {
        let mut state = lock(&self.0.state);
        match state.holders.amount() < self.0.share.total {
            true => Ok(self.grant(&mut state, account, 1)),
            false => Err(self.0.refuse()),
        }
    }

    /// Counts what an account holds already, also beyond the limit.
    pub fn count_held(&self, account: &Account, amount: usize) -> Permit {
        self.grant(&mut lock(&self.0.state), account, amount)
    }

    /// Checks whether [`Self::acquire`] would grant a permit now.
    ///
    /// # Errors
    /// `LimitReached`.
    pub fn check(&self, account: &Account) -> Result<()> {
        match lock(&self.0.state).holders.decide(account, 1, self.0.share) {
            Decision::Grant | Decision::Preempt(_) => Ok(()),
            Decision::Refuse => Err(self.0.refuse()),
        }
    }

    fn grant(&self, state: &mut State, account: &Account, amount: usize) -> Permit {
        let grant = Grant::new(account, amount);
        state.holders.insert(account, Arc::clone(&grant));
        Permit(PermitHandle { pool: Arc::clone(&self.0), grant })
    }

    /// Preempts the permit that is next in order.
    pub fn preempt_one(&self) {
        let mut state = lock(&self.0.state);
        for victim in state.holders.find_any(self.0.share) {
            self.0.preempt(&mut state, &victim);
        }
    }

    /// Ends the permits of some clients, with an error that says that an administrator has ended the client. Permits that are
    /// never preempted stay. Returns the clients among those that hold permits.
    pub(super) fn end_clients(&self, is_selected: impl Fn(&Account) -> bool) -> Vec<EndedClient> {
        let mut state = lock(&self.0.state);
        let is_preemptible = self.0.share.when_full == WhenFull::Preempt;
        let (mut clients, mut ended) = (Vec::new(), Vec::new());
        for (account, grants) in state.holders.clients().filter(|(account, _)| is_selected(account)) {
            let grants = if is_preemptible { grants } else { &[] };
            ended.extend(grants.iter().cloned());
            clients.push(EndedClient { account, permits: grants.len() });
        }
        ended.iter().for_each(|grant| self.0.end(&mut state, grant, Error::ClientEnded));
        clients
    }

    /// What each client holds.
    pub(super) fn holdings(&self) -> Vec<PoolHolding> {
        let state = lock(&self.0.state);
        let holding = |(account, grants): (Account, &[Arc<Grant>])| PoolHolding {
            held: self.0.resource_use(state.holders.held_by(&account)),
            account,
            granted_at: grants.iter().map(|grant| grant.granted_at()).min().unwrap_or(0),
            last_progress: grants.iter().filter_map(|grant| grant.last_progress()).max(),
        };
        state.holders.clients().map(holding).collect()
    }

    /// What all clients hold together.
    pub(super) fn resource_use(&self) -> ResourceUse {
        self.0.resource_use(self.held())
    }

    /// The limit on the amounts of all permits together.
    pub fn total(&self) -> usize {
        self.0.share.total
    }

    /// The amount of all permits that are granted and not preempted.
    pub fn held(&self) -> usize {
        lock(&self.0.state).holders.amount()
    }

    /// Number of preempted permits that are not dropped yet.
    pub fn ending(&self) -> usize {
        lock(&self.0.state).ending
    }

    /// Waits until a permit is dropped, also one that was dropped since the last call. For one task at a time. Cancel-safe.
    pub async fn released(&self) {
        self.0.released.notified().await;
    }
}

impl Shared {
    /// Makes `amount` available to a client, if necessary by preemption.
    fn make_room(&self, state: &mut State, account: &Account, amount: usize) -> Result<()> {
        match state.holders.decide(account, amount, self.share) {
            Decision::Grant => Ok(()),
            Decision::Preempt(victims) => {
                victims.iter().for_each(|victim| self.preempt(state, victim));
                Ok(())
            }
            Decision::Refuse => Err(self.refuse()),
        }
    }

    /// Counts a refusal and returns its error.
    fn refuse(&self) -> Error {
        self.metrics.refused.inc();
        Error::LimitReached { objects: self.limit.objects, limit: self.share.total }
    }

    fn preempt(&self, state: &mut State, victim: &Arc<Grant>) {
        let held = state.holders.held_by(&lock(&victim.account));
        self.metrics.preempted.inc();
        let (objects, limit) = (self.limit.objects, self.share.total);
        self.end(state, victim, Error::Preempted { objects, held, limit });
        state.log.record(self.limit, limit);
    }

    /// Ends what a permit was granted for.
    fn end(&self, state: &mut State, victim: &Arc<Grant>, error: Error) {
        state.holders.remove(&lock(&victim.account), victim);
        state.ending += 1;
        victim.preemption.send_replace(Some(error));
    }

    fn resource_use(&self, held: usize) -> ResourceUse {
        ResourceUse { limit: self.limit, scene: self.scene.clone(), held, total: self.share.total }
    }
}

impl PreemptionLog {
    fn record(&mut self, limit: &Limit, total: usize) {
        self.count += 1;
        if self.last_record.is_none_or(|last_record| last_record.elapsed() >= LOG_INTERVAL) {
            tracing::warn!(resource = limit.resource, limit = total, count = self.count, "ended for other clients");
            *self = Self { count: 0, last_record: Some(Instant::now()) };
        }
    }
}

impl Permit {
    /// A permit of a pool of its own.
    #[cfg(test)]
    pub(crate) fn for_test(limit: &'static Limit) -> Self {
        let pool = PermitPool::new(limit, 1, None, ResourceMetrics::default());
        pool.acquire(&Account::server()).expect("expected a free permit")
    }

    pub const fn handle(&self) -> &PermitHandle {
        &self.0
    }

    /// What the permit counts for, in units of its resource.
    pub fn amount(&self) -> usize {
        self.0.grant.amount()
    }

    /// Changes what the permit counts for. Less is always granted.
    ///
    /// # Errors
    /// As for [`PermitPool::acquire`], and the error of a preempted permit. The amount is then unchanged.
    pub fn resize(&mut self, amount: usize) -> Result<()> {
        let PermitHandle { pool, grant } = &self.0;
        let mut state = lock(&pool.state);
        if let Some(error) = self.0.preemption() {
            return Err(error);
        }
        let account = lock(&grant.account).clone();
        if let Some(added) = amount.checked_sub(grant.amount()).filter(|added| *added > 0) {
            // The victims are not this permit: they belong to a client that holds more than this one will.
            pool.make_room(&mut state, &account, added)?;
        }
        state.holders.resize(&account, grant, amount);
        Ok(())
    }
}

impl PermitHandle {
    /// Records that the holder works. Takes no lock.
    pub fn mark_progress(&self) {
        self.grant.progress.mark();
    }

    /// What the permit counts to.
    pub fn account(&self) -> Account {
        lock(&self.grant.account).clone()
    }

    /// Moves an anonymous permit to the account of a principal, and returns true. Has no effect on a permit of a principal,
    /// and then takes no lock.
    pub fn identify(&self, account: impl FnOnce() -> Account) -> bool {
        if self.grant.has_principal.swap(true, Ordering::Relaxed) {
            return false;
        }
        let account = account();
        let mut state = lock(&self.pool.state);
        let former = std::mem::replace(&mut *lock(&self.grant.account), account.clone());
        if !self.is_preempted() {
            state.holders.remove(&former, &self.grant);
            state.holders.insert(&account, Arc::clone(&self.grant));
        }
        true
    }

    /// Waits until the permit is preempted, and returns the error with which its holder ends. Cancel-safe.
    pub fn preempted(&self) -> impl Future<Output = Error> + Send + use<> {
        let grant = Arc::clone(&self.grant);
        async move {
            let mut preemption = grant.preemption.subscribe();
            match preemption.wait_for(Option::is_some).await.map(|error| error.clone()) {
                Ok(Some(error)) => error,
                // The grant has the sender, so this is never reached.
                _ => std::future::pending().await,
            }
        }
    }

    pub fn is_preempted(&self) -> bool {
        self.grant.preemption.borrow().is_some()
    }

    /// The error with which the holder ends, if the permit is preempted.
    pub fn preemption(&self) -> Option<Error> {
        self.grant.preemption.borrow().clone()
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        let PermitHandle { pool, grant } = &self.0;
        let mut state = lock(&pool.state);
        if self.0.is_preempted() {
            state.ending -= 1;
        } else {
            state.holders.remove(&lock(&grant.account), grant);
        }
        drop(state);
        pool.released.notify_one();
    }
}
