//! Counts refused and preempted permits by resource.

use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;

/// A counter for each resource.
pub(super) type ResourceCounters = Family<[(&'static str, &'static str); 1], Counter>;

/// The counters of one resource.
#[derive(Debug, Clone, Default)]
pub(super) struct ResourceMetrics {
    pub(super) refused: Counter,
    pub(super) preempted: Counter,
}
