//! The table of all resources that are limited in number. `deploy/README.md` has the same table.

use crate::config::Config;

/// What happens to a client that asks for a permit when none is free.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WhenFull {
    /// The permit with the least progress of the client that holds the most is preempted.
    Preempt,
}

/// A resource that is limited in number.
#[derive(Debug)]
pub struct Limit {
    /// The name in metrics.
    pub resource: &'static str,
    /// The name in errors.
    pub objects: &'static str,
    /// The option of `serve` that sets the limit.
    pub option: Option<&'static str>,
    pub total: fn(&Config) -> usize,
    pub when_full: WhenFull,
}

impl Limit {
    pub const CONNECTIONS: &'static Self = &Self {
        resource: "connections",
        objects: "connections",
        option: Some("--connections"),
        total: |config| config.connections,
        when_full: WhenFull::Preempt,
    };

    pub const SUBSCRIPTIONS: &'static Self = &Self {
        resource: "subscriptions",
        objects: "frame, vertex and state streams of one scene",
        option: None,
        total: |config| config.max_subscribers,
        when_full: WhenFull::Preempt,
    };

    pub const WAITING_REQUESTS: &'static Self = &Self {
        resource: "waiting_requests",
        objects: "requests that wait for a step of one scene",
        option: None,
        total: |config| config.max_pending_requests,
        when_full: WhenFull::Preempt,
    };
}

/// All resources.
pub const LIMITS: [&Limit; 3] = [Limit::CONNECTIONS, Limit::SUBSCRIPTIONS, Limit::WAITING_REQUESTS];

#[cfg(test)]
mod tests {
    use super::*;

    /// The page that users read has the same table.
    #[test]
    fn documented_table_is_that_of_the_server() {
        let page = include_str!("../../deploy/README.md");
        let row = |limit: &&Limit| {
            let total = (limit.total)(&Config::default());
            let option = limit.option.map_or_else(String::new, |option| format!("`{option}`"));
            let when_full = match limit.when_full {
                WhenFull::Preempt => "the one with the least progress ends",
            };
            let kept = total / 8;
            format!("| {} | `{}` | {option} | {total} | {kept} | {when_full} |", limit.objects, limit.resource)
        };
        let documented = page.lines().skip_while(|line| !line.starts_with("| what a client holds |"));
        let documented: Vec<_> = documented.skip(2).take_while(|line| line.starts_with('|')).collect();
        assert_eq!(documented, LIMITS.iter().map(row).collect::<Vec<_>>());
    }
}
