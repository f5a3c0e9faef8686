//! All pools of a server, and the counters of refused and preempted permits by resource.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

use super::account::Account;
use super::grant::lock;
use super::holdings::{ClientHoldings, EndedClient, ResourceUse, merge_holdings};
use super::limits::Limit;
use super::metrics::{ResourceCounters, ResourceMetrics};
use super::permit::{PermitPool, WeakPermitPool};

/// The pools of a server with their counters. A clone is shallow.
#[derive(Debug, Clone, Default)]
pub struct Admission {
    pub refused: ResourceCounters,
    pub preempted: ResourceCounters,
    /// Used to list and end clients. Granting a permit does not use it.
    pools: Arc<Mutex<Vec<WeakPermitPool>>>,
}

impl Admission {
    /// A pool of `total` permits that is counted and listed here.
    pub fn pool(&self, limit: &'static Limit, total: usize) -> PermitPool {
        self.add(PermitPool::new(limit, total, None, self.of_resource(limit.resource)))
    }

    /// A pool of `total` permits of one scene that is counted and listed here.
    pub fn pool_of_scene(&self, limit: &'static Limit, total: usize, scene: &str) -> PermitPool {
        self.add(PermitPool::new(limit, total, Some(scene.into()), self.of_resource(limit.resource)))
    }

    /// The counters of a resource, by its name in metrics.
    fn of_resource(&self, resource: &'static str) -> ResourceMetrics {
        let counter = |counters: &ResourceCounters| counters.get_or_create_owned(&[("resource", resource)]);
        ResourceMetrics { refused: counter(&self.refused), preempted: counter(&self.preempted) }
    }

    /// Adds a pool to those that are listed, and removes those that are dropped.
    fn add(&self, pool: PermitPool) -> PermitPool {
        let mut pools = lock(&self.pools);
        pools.retain(|pool| pool.upgrade().is_some());
        pools.push(pool.downgrade());
        pool
    }

    /// Number of pools that are listed or were dropped since the last pool was added.
    #[cfg(test)]
    pub(super) fn pool_count(&self) -> usize {
        lock(&self.pools).len()
    }

    fn live_pools(&self) -> Vec<PermitPool> {
        lock(&self.pools).iter().filter_map(WeakPermitPool::upgrade).collect()
    }

    /// The clients that hold permits. Those that hold the largest part of a pool come first.
    pub fn clients(&self) -> Vec<ClientHoldings> {
        merge_holdings(self.live_pools().iter().flat_map(PermitPool::holdings))
    }

    /// The pools of which something is held.
    pub fn resources_in_use(&self) -> Vec<ResourceUse> {
        self.live_pools().iter().map(PermitPool::resource_use).filter(|resource| resource.held > 0).collect()
    }

    /// Ends the permits of the selected clients that can be preempted; open scenes stay. What they were granted for ends with
    /// [`modalcast_model::error::Error::ClientEnded`]. Returns the selected clients among those that hold permits.
    pub fn end_clients(&self, is_selected: impl Fn(&Account) -> bool) -> Vec<EndedClient> {
        let mut permits = BTreeMap::<Account, usize>::new();
        for client in self.live_pools().iter().flat_map(|pool| pool.end_clients(&is_selected)) {
            *permits.entry(client.account).or_default() += client.permits;
        }
        permits.into_iter().map(|(account, permits)| EndedClient { account, permits }).collect()
    }
}
