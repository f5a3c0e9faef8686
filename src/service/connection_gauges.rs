//! Numbers of open connections by protocol, for metrics.

use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;

/// A label with its value.
type Label = (&'static str, &'static str);

/// Counts open connections. Clones share the numbers.
#[derive(Debug, Clone, Default)]
pub(super) struct ConnectionGauges(Family<[Label; 1], Gauge>);

/// A counted connection, until it is dropped.
#[derive(Debug)]
pub(super) struct CountedConnection(Gauge);

impl ConnectionGauges {
    /// Counts a connection. `protocol` is the value of the label.
    pub(super) fn count(&self, protocol: &'static str) -> CountedConnection {
        let gauge = self.0.get_or_create_owned(&[("protocol", protocol)]);
        gauge.inc();
        CountedConnection(gauge)
    }

    pub(super) fn family(&self) -> Family<[Label; 1], Gauge> {
        self.0.clone()
    }
}

impl Drop for CountedConnection {
    fn drop(&mut self) {
        self.0.dec();
    }
}
