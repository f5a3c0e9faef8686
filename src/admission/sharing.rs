//! The rule by which the permits of a pool are shared; see the documentation of the module.

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::sync::Arc;

use super::account::{Account, Client};
use super::grant::Grant;
use super::limits::WhenFull;

/// What a pool permits. Amounts are in units of its resource: permits or bytes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Share {
    pub(super) total: usize,
    /// What a single client leaves for others.
    pub(super) reserve: usize,
    pub(super) when_full: WhenFull,
}

/// The answer to a client that asks for a permit.
#[derive(Debug)]
pub(super) enum Decision {
    Grant,
    /// Grant it after the preemption of these.
    Preempt(Vec<Arc<Grant>>),
    Refuse,
}

/// The granted permits of a pool, without the preempted ones.
#[derive(Debug, Default)]
pub(super) struct Holders {
    /// By name. The permits of anonymous clients have the key `None`.
    principals: BTreeMap<Option<Arc<str>>, PrincipalHolders>,
    amount: usize,
}

#[derive(Debug, Default)]
struct PrincipalHolders {
    clients: BTreeMap<Client, ClientHolder>,
    amount: usize,
}

#[derive(Debug, Default)]
struct ClientHolder {
    grants: Vec<Arc<Grant>>,
    amount: usize,
}

/// Whether a holder of `own` may take `amount` from a holder of `other`: it then has less, or has nothing and replaces
/// what has less progress.
const fn may_take(own: usize, amount: usize, other: usize) -> bool {
    own.saturating_add(amount) < other || (own == 0 && amount <= other)
}

impl Holders {
    pub(super) const fn amount(&self) -> usize {
        self.amount
    }

    pub(super) fn insert(&mut self, account: &Account, grant: Arc<Grant>) {
        let amount = grant.amount();
        let principal = self.principals.entry(account.principal.clone()).or_default();
        let client = principal.clients.entry(account.client).or_default();
        client.grants.push(grant);
        client.amount += amount;
        principal.amount += amount;
        self.amount += amount;
    }

    /// Removes a permit. Has no effect if the account does not hold it.
    pub(super) fn remove(&mut self, account: &Account, grant: &Arc<Grant>) {
        let Some(principal) = self.principals.get_mut(&account.principal) else { return };
        let Some(client) = principal.clients.get_mut(&account.client) else { return };
        let Some(index) = client.grants.iter().position(|held| Arc::ptr_eq(held, grant)) else { return };
        client.grants.swap_remove(index);
        let amount = grant.amount();
        client.amount -= amount;
        principal.amount -= amount;
        self.amount -= amount;
        if client.grants.is_empty() {
            principal.clients.remove(&account.client);
        }
        if principal.clients.is_empty() {
            self.principals.remove(&account.principal);
        }
    }

    /// Changes the amount of a permit that the account holds.
    pub(super) fn resize(&mut self, account: &Account, grant: &Grant, amount: usize) {
        let former = grant.set_amount(amount);
        let Some(principal) = self.principals.get_mut(&account.principal) else { return };
        let Some(client) = principal.clients.get_mut(&account.client) else { return };
        for held in [&mut client.amount, &mut principal.amount, &mut self.amount] {
            *held = *held - former + amount;
        }
    }

    /// Each client that holds anything, with its permits.
    pub(super) fn clients(&self) -> impl Iterator<Item = (Account, &[Arc<Grant>])> {
        self.principals.iter().flat_map(|(name, principal)| {
            let account = move |client: &Client| Account { principal: name.clone(), client: *client };
            let holders = principal.clients.iter().filter(|(_, holder)| holder.amount > 0);
            holders.map(move |(client, holder)| (account(client), holder.grants.as_slice()))
        })
    }

    /// What a client holds.
    pub(super) fn held_by(&self, account: &Account) -> usize {
        let principal = self.principals.get(&account.principal);
        principal.and_then(|principal| principal.clients.get(&account.client)).map_or(0, |client| client.amount)
    }

    /// Answers a client that asks for an amount.
    pub(super) fn decide(&self, account: &Account, amount: usize, share: Share) -> Decision {
        let held = self.held_by(account);
        if held.saturating_add(amount).saturating_add(share.reserve) > share.total {
            return Decision::Refuse;
        }
        let free = share.total.saturating_sub(self.amount);
        match share.when_full {
            WhenFull::Preempt if free >= amount => Decision::Grant,
            WhenFull::Preempt => {
                let victims = self.find_for(account, amount, amount - free, share);
                if victims.is_empty() { Decision::Refuse } else { Decision::Preempt(victims) }
            }
            // Resources for which clients wait have a `Queue`, not a pool.
            WhenFull::Wait => Decision::Refuse,
            WhenFull::Refuse { minimum } => {
                let of_principal = self.principals.get(&account.principal).map_or(0, |principal| principal.amount);
                let Some(left) = free.checked_sub(amount) else { return Decision::Refuse };
                let is_free_for_all = left >= share.reserve;
                let is_for_new_client = left >= minimum.min(share.reserve) && held == 0;
                let is_for_principal = of_principal.saturating_add(amount) <= minimum;
                match is_free_for_all || is_for_new_client || is_for_principal {
                    true => Decision::Grant,
                    false => Decision::Refuse,
                }
            }
        }
    }

    /// The permits that are preempted for a client that asks for `amount`, of which `missing` is not free. None if the
    /// client has its share.
    fn find_for(&self, account: &Account, amount: usize, missing: usize, share: Share) -> Vec<Arc<Grant>> {
        let Some((largest, principal)) = self.largest_principal(share) else { return Vec::new() };
        let own = self.principals.get(&account.principal);
        let is_entitled = is_crowded(largest, principal, share)
            || may_take(own.map_or(0, |own| own.amount), amount, principal.amount);
        let (name, principal) = match (is_entitled, own) {
            (true, _) => (largest, principal),
            (false, Some(own)) => (&account.principal, own),
            (false, None) => return Vec::new(),
        };
        let is_own = *name == account.principal;
        if is_own && !may_take(self.held_by(account), amount, principal.largest_client()) {
            return Vec::new();
        }
        principal.find_victims(missing, share)
    }

    /// The next permit to preempt, for any client.
    pub(super) fn find_any(&self, share: Share) -> Vec<Arc<Grant>> {
        self.largest_principal(share).map_or_else(Vec::new, |(_, principal)| principal.find_victims(1, share))
    }

    /// The principal that holds the most. Anonymous clients count as one principal, and go first if they hold more than
    /// the reserve: less may be of clients whose first call is still on its way.
    fn largest_principal(&self, share: Share) -> Option<(&Option<Arc<str>>, &PrincipalHolders)> {
        let rank = |name: &Option<Arc<str>>, principal: &PrincipalHolders| {
            (is_crowded(name, principal, share), principal.amount, name.is_none())
        };
        self.principals.iter().max_by_key(|(name, principal)| rank(name, principal))
    }
}

/// Whether anonymous clients hold more than the reserve.
fn is_crowded(name: &Option<Arc<str>>, principal: &PrincipalHolders, share: Share) -> bool {
    name.is_none() && principal.amount > share.reserve
}

impl PrincipalHolders {
    /// What the client holds that holds the most.
    fn largest_client(&self) -> usize {
        self.clients.values().map(|client| client.amount).max().unwrap_or(0)
    }

    /// Permits that count for `missing` together; fewer if there are not so many. Those of the client that holds the most
    /// come first, and among these, the one that has made no progress for the longest time. A permit without any progress
    /// belongs to a client that has just come, or does not work. Such permits go first if the largest clients have more of
    /// them than the reserve, and last otherwise, so that clients that come do not preempt each other before their first
    /// progress.
    fn find_victims(&self, missing: usize, share: Share) -> Vec<Arc<Grant>> {
        let largest = self.largest_client();
        let of_largest = self.clients.values().filter(|client| client.amount == largest);
        let new = of_largest.flat_map(|client| &client.grants).filter(|grant| grant.last_progress().is_none());
        let is_crowded = new.map(|grant| grant.amount()).sum::<usize>() > share.reserve;
        let progress = |grant: &Grant| match grant.last_progress() {
            Some(time) => (is_crowded, time),
            None => (!is_crowded, grant.granted_at()),
        };
        let mut candidates: Vec<_> = self
            .clients
            .values()
            .flat_map(|client| client.grants.iter().map(|grant| (Reverse(client.amount), progress(grant), grant)))
            .filter(|(_, _, grant)| grant.amount() > 0)
            .collect();
        candidates.sort_unstable_by_key(|(amount, progress, _)| (*amount, *progress));
        let mut found = 0;
        let mut is_needed = |grant: &Grant| {
            let is_missing = found < missing;
            found += grant.amount();
            is_missing
        };
        candidates.into_iter().map(|(_, _, grant)| grant).take_while(|grant| is_needed(grant)).cloned().collect()
    }
}

#[cfg(test)]
#[path = "sharing_tests.rs"]
mod tests;
