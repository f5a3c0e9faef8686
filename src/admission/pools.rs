//! All pools of a server, and the counters of refused and preempted permits by resource.

use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;

/// A counter for each resource.
type ResourceCounters = Family<[(&'static str, &'static str); 1], Counter>;

/// The pools of a server with their counters. A clone is shallow.
#[derive(Debug, Clone, Default)]
pub struct Admission {
    pub refused: ResourceCounters,
    pub preempted: ResourceCounters,
}

/// The counters of one resource.
#[derive(Debug, Clone)]
pub(super) struct ResourceMetrics {
    pub(super) refused: Counter,
    pub(super) preempted: Counter,
}

impl Admission {
    /// The counters of a resource, by its name in metrics.
    pub(super) fn of_resource(&self, resource: &'static str) -> ResourceMetrics {
        let counter = |counters: &ResourceCounters| counters.get_or_create_owned(&[("resource", resource)]);
        ResourceMetrics { refused: counter(&self.refused), preempted: counter(&self.preempted) }
    }
}
