//! The rule by which the permits of a pool are shared; see the documentation of the module.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::account::{Account, Client};
use super::grant::Grant;
use super::limits::WhenFull;

/// What a pool permits.
#[derive(Debug, Clone, Copy)]
pub(super) struct Share {
    /// Number of permits.
    pub(super) total: usize,
    /// Number of permits that a single client leaves for others.
    pub(super) reserve: usize,
    pub(super) when_full: WhenFull,
}

/// The answer to a client that asks for a permit.
#[derive(Debug)]
pub(super) enum Decision {
    Grant,
    /// Grant it after the preemption of this one.
    Preempt(Arc<Grant>),
    Refuse,
}

/// The granted permits of a pool, without the preempted ones.
#[derive(Debug, Default)]
pub(super) struct Holders {
    /// By name. The permits of anonymous clients have the key `None`.
    principals: BTreeMap<Option<Arc<str>>, PrincipalHolders>,
    count: usize,
}

#[derive(Debug, Default)]
struct PrincipalHolders {
    clients: BTreeMap<Client, Vec<Arc<Grant>>>,
    count: usize,
}

/// Whether a holder of `own` permits may take one of a holder of `other`: it then has at most as many, or has none and
/// replaces one with less progress.
const fn may_take(own: usize, other: usize) -> bool {
    own + 1 < other || (own == 0 && other > 0)
}

impl Holders {
    pub(super) const fn count(&self) -> usize {
        self.count
    }

    pub(super) fn insert(&mut self, account: &Account, grant: Arc<Grant>) {
        let principal = self.principals.entry(account.principal.clone()).or_default();
        principal.clients.entry(account.client).or_default().push(grant);
        principal.count += 1;
        self.count += 1;
    }

    /// Removes a permit. Has no effect if the account does not hold it.
    pub(super) fn remove(&mut self, account: &Account, grant: &Arc<Grant>) {
        let Some(principal) = self.principals.get_mut(&account.principal) else { return };
        let Some(grants) = principal.clients.get_mut(&account.client) else { return };
        let Some(index) = grants.iter().position(|held| Arc::ptr_eq(held, grant)) else { return };
        grants.remove(index);
        principal.count -= 1;
        self.count -= 1;
        if grants.is_empty() {
            principal.clients.remove(&account.client);
        }
        if principal.count == 0 {
            self.principals.remove(&account.principal);
        }
    }

    /// Number of permits of a client.
    pub(super) fn held_by(&self, account: &Account) -> usize {
        let principal = self.principals.get(&account.principal);
        principal.and_then(|principal| principal.clients.get(&account.client)).map_or(0, Vec::len)
    }

    /// Answers a client that asks for a permit.
    pub(super) fn decide(&self, account: &Account, share: Share) -> Decision {
        if self.held_by(account) + share.reserve >= share.total {
            return Decision::Refuse;
        }
        let free = share.total.saturating_sub(self.count);
        match share.when_full {
            WhenFull::Preempt if free > 0 => Decision::Grant,
            WhenFull::Preempt => self.find_for(account, share).map_or(Decision::Refuse, Decision::Preempt),
            WhenFull::Refuse { minimum } => {
                let of_principal = self.principals.get(&account.principal).map_or(0, |principal| principal.count);
                let is_free_for_all = free > share.reserve;
                let is_for_new_client = free > minimum.min(share.reserve) && self.held_by(account) == 0;
                let is_for_principal = free > 0 && of_principal < minimum;
                match is_free_for_all || is_for_new_client || is_for_principal {
                    true => Decision::Grant,
                    false => Decision::Refuse,
                }
            }
        }
    }

    /// The permit that is preempted for a client. `None` if the client has its share.
    fn find_for(&self, account: &Account, share: Share) -> Option<Arc<Grant>> {
        let (largest, principal) = self.largest_principal(share)?;
        let own = self.principals.get(&account.principal);
        let is_entitled =
            is_crowded(largest, principal, share) || may_take(own.map_or(0, |own| own.count), principal.count);
        let (name, principal) = if is_entitled { (largest, principal) } else { (&account.principal, own?) };
        let is_own = *name == account.principal;
        if is_own && !may_take(self.held_by(account), principal.largest_client()) {
            return None;
        }
        principal.least_progress(share)
    }

    /// The next permit to preempt, for any client.
    pub(super) fn find_any(&self, share: Share) -> Option<Arc<Grant>> {
        self.largest_principal(share)?.1.least_progress(share)
    }

    /// The principal that holds the most permits. Anonymous clients count as one principal, and go first if they hold more
    /// than the reserve: fewer may be clients whose first call is still on its way.
    fn largest_principal(&self, share: Share) -> Option<(&Option<Arc<str>>, &PrincipalHolders)> {
        let rank = |name: &Option<Arc<str>>, principal: &PrincipalHolders| {
            (is_crowded(name, principal, share), principal.count, name.is_none())
        };
        self.principals.iter().max_by_key(|(name, principal)| rank(name, principal))
    }
}

/// Whether anonymous clients hold more than the reserve.
fn is_crowded(name: &Option<Arc<str>>, principal: &PrincipalHolders, share: Share) -> bool {
    name.is_none() && principal.count > share.reserve
}

impl PrincipalHolders {
    /// The largest number of permits of a client.
    fn largest_client(&self) -> usize {
        self.clients.values().map(Vec::len).max().unwrap_or(0)
    }

    /// Among the clients that hold the most, the permit that has made no progress for the longest time. A permit without
    /// any progress belongs to a client that has just come, or does not work. Such permits go first if there are more than
    /// the reserve, and last otherwise, so that clients that come do not preempt each other before their first progress.
    fn least_progress(&self, share: Share) -> Option<Arc<Grant>> {
        let largest = self.largest_client();
        let candidates = || self.clients.values().filter(|grants| grants.len() == largest).flatten();
        let new = candidates().filter(|grant| grant.last_progress().is_none()).count();
        let is_crowded = new > share.reserve;
        let rank = |grant: &&Arc<Grant>| match grant.last_progress() {
            Some(time) => (is_crowded, time),
            None => (!is_crowded, grant.granted_at()),
        };
        candidates().min_by_key(rank).cloned()
    }
}

#[cfg(test)]
#[path = "sharing_tests.rs"]
mod tests;
