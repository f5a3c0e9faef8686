//! Who holds what: the permits of each client in all pools, for people who look for the client that fills the server.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use super::account::Account;
use super::limits::Limit;
use super::progress::now;

/// How much of a resource is in use, by one client or by all.
#[derive(Debug, Clone)]
pub struct ResourceUse {
    pub limit: &'static Limit,
    /// The scene of a pool that each scene has; `None` for a pool of the server.
    pub scene: Option<Arc<str>>,
    pub held: usize,
    /// What can be held of the pool at a time.
    pub total: usize,
}

/// A client and what it holds.
#[derive(Debug, Clone)]
pub struct ClientHoldings {
    pub account: Account,
    /// One entry per pool of which the client holds something.
    pub held: Vec<ResourceUse>,
    /// Time since the oldest of its permits was granted.
    pub age: Duration,
    /// Time since the last progress of any of its permits. `None` before the first one.
    pub idle: Option<Duration>,
}

/// A client whose permits an administrator has ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EndedClient {
    pub account: Account,
    /// Number of ended permits. 0 for a client that holds only permits that cannot be preempted.
    pub permits: usize,
}

/// The permits of one client in one pool. Times are those of [`now`].
#[derive(Debug)]
pub(super) struct PoolHolding {
    pub(super) account: Account,
    pub(super) held: ResourceUse,
    pub(super) granted_at: u64,
    pub(super) last_progress: Option<u64>,
}

impl ResourceUse {
    /// The part of the total that is held: 0 to 1.
    fn fraction(&self) -> f64 {
        self.held as f64 / self.total.max(1) as f64
    }
}

impl ClientHoldings {
    /// The largest part that the client holds of a pool: 0 to 1.
    pub fn largest_fraction(&self) -> f64 {
        self.held.iter().map(ResourceUse::fraction).fold(0.0, f64::max)
    }
}

/// The clients with their permits in all pools. Those that hold the largest part of a pool come first.
pub(super) fn merge_holdings(holdings: impl Iterator<Item = PoolHolding>) -> Vec<ClientHoldings> {
    let mut by_account = BTreeMap::<Account, Vec<PoolHolding>>::new();
    for holding in holdings {
        by_account.entry(holding.account.clone()).or_default().push(holding);
    }
    let now = now();
    let since = |time: u64| Duration::from_nanos(now.saturating_sub(time));
    let mut clients: Vec<_> = by_account
        .into_iter()
        .map(|(account, holdings)| ClientHoldings {
            account,
            age: since(holdings.iter().map(|holding| holding.granted_at).min().unwrap_or(now)),
            idle: holdings.iter().filter_map(|holding| holding.last_progress).max().map(since),
            held: holdings.into_iter().map(|holding| holding.held).collect(),
        })
        .collect();
    clients.sort_by(|a, b| b.largest_fraction().total_cmp(&a.largest_fraction()));
    clients
}

#[cfg(test)]
#[path = "holdings_tests.rs"]
mod tests;
