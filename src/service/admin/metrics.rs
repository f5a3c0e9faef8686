//! Metrics in the text format of Prometheus, version 0.0.4.

use std::collections::BTreeSet;

use prometheus_client::encoding::text;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::Registry;

use super::super::connection_gauges::ConnectionGauges;
use crate::BUILD;
use crate::admission::Admission;
use crate::engine::Engine;
use crate::identity::Principal;
use modalcast_model::error::{Result, fault_in};

/// The metrics of a server. Those of the engine are read when they are asked for.
pub(super) struct Metrics {
    registry: Registry,
    engine: Engine,
    open_scenes: Gauge,
    memory: Family<[(&'static str, &'static str); 2], Gauge>,
}

impl Metrics {
    /// `auth_failures` counts rejected calls.
    pub(super) fn new(engine: Engine, connections: &ConnectionGauges, auth_failures: Counter) -> Self {
        let mut registry = Registry::with_prefix("modalcast");
        let build = Family::<[(&'static str, &'static str); 2], Gauge>::default();
        build.get_or_create(&[("version", env!("CARGO_PKG_VERSION")), ("sources", BUILD)]).set(1);
        registry.register("build_info", "Version of the server, and the hash of its sources", build);
        let open_scenes = Gauge::default();
        registry.register("open_scenes", "Open scenes", open_scenes.clone());
        registry.register("connections", "Open connections after their first bytes", connections.family());
        let help = "Calls without a known credential, and calls that the role does not permit";
        registry.register("auth_failures", help, auth_failures);
        let Admission { refused, preempted, .. } = engine.admission().clone();
        registry.register("refused", "Clients that were refused, because they hold their share", refused);
        registry.register("preempted", "What was ended to make room for other clients", preempted);
        let memory = Family::<[(&'static str, &'static str); 2], Gauge>::default();
        registry.register("memory_bytes", "Memory that the scenes have reserved", memory.clone());
        let limits = Family::<[(&'static str, &'static str); 1], Gauge>::default();
        for (kind, bytes) in engine.memory_use().map(|(kind, memory)| (kind, memory.limit)) {
            limits.get_or_create(&[("kind", kind)]).set(to_gauge(bytes));
        }
        registry.register("memory_limit_bytes", "Limit on the memory of all scenes", limits);
        Self { registry, engine, open_scenes, memory }
    }

    /// The text of all metrics.
    ///
    /// # Errors
    /// `Fault` when the text cannot be written.
    pub(super) fn render(&self) -> Result<String> {
        self.open_scenes.set(self.engine.list(&Principal::owner()).open.len() as i64);
        for (kind, memory) in self.engine.memory_use() {
            self.memory.get_or_create(&[("kind", kind), ("use", "scenes")]).set(to_gauge(memory.reserved));
        }
        let mut text = String::new();
        text::encode(&mut text, &self.registry).map_err(fault_in("metrics"))?;
        Ok(to_prometheus_text(&text))
    }
}

/// Converts a text in the format of OpenMetrics, which the library writes and `promtool` does not read. In the format of
/// Prometheus, the name of a counter has the suffix of its samples.
fn to_prometheus_text(open_metrics: &str) -> String {
    let declared_counter = |line: &'_ str| line.strip_prefix("# TYPE ")?.strip_suffix(" counter").map(str::to_owned);
    let counters: BTreeSet<String> = open_metrics.lines().filter_map(declared_counter).collect();
    let convert = |line: &str| {
        let mut words = line.splitn(4, ' ');
        match (words.next(), words.next(), words.next(), words.next()) {
            (Some("#"), Some(keyword), Some(name), Some(rest)) if counters.contains(name) => {
                format!("# {keyword} {name}_total {rest}\n")
            }
            _ => format!("{line}\n"),
        }
    };
    open_metrics.lines().filter(|line| *line != "# EOF").map(convert).collect()
}

fn to_gauge(bytes: u64) -> i64 {
    i64::try_from(bytes).unwrap_or(i64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counters_are_declared_with_their_suffix() {
        let (mut registry, mut text) = (Registry::with_prefix("a"), String::new());
        registry.register("calls", "All calls", Counter::<u64>::default());
        registry.register("open", "Open calls", Gauge::<i64>::default());
        text::encode(&mut text, &registry).expect("expected a text");
        let expected = "# HELP a_calls_total All calls.\n# TYPE a_calls_total counter\na_calls_total 0\n\
                        # HELP a_open Open calls.\n# TYPE a_open gauge\na_open 0\n";
        assert_eq!(to_prometheus_text(&text), expected);
    }
}
