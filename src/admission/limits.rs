//! The table of all resources that are limited in number. `deploy/README.md` has the same table.

use crate::config::Config;

/// What happens to a client that asks for a permit when none is free.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WhenFull {
    /// The permit with the least progress of the client that holds the most is preempted.
    Preempt,
    /// The client is refused. Of the permits that one client leaves for others, this number is for principals that hold
    /// fewer, and the rest for clients without any.
    Refuse { minimum: usize },
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
    /// A single client leaves this part of the total for others: 1 / `reserve_divisor`.
    pub reserve_divisor: usize,
    pub when_full: WhenFull,
}

impl Limit {
    pub const CONNECTIONS: &'static Self = &Self {
        resource: "connections",
        objects: "connections",
        option: Some("--connections"),
        total: |config| config.connections,
        reserve_divisor: 8,
        when_full: WhenFull::Preempt,
    };

    pub const SUBSCRIPTIONS: &'static Self = &Self {
        resource: "subscriptions",
        objects: "frame, vertex and state streams of one scene",
        option: None,
        total: |config| config.max_subscribers,
        reserve_divisor: 8,
        when_full: WhenFull::Preempt,
    };

    pub const WAITING_REQUESTS: &'static Self = &Self {
        resource: "waiting_requests",
        objects: "requests that wait for a step of one scene",
        option: None,
        total: |config| config.max_pending_requests,
        reserve_divisor: 8,
        when_full: WhenFull::Preempt,
    };

    /// An open scene is not ended for another client, because it has a state.
    pub const OPEN_SCENES: &'static Self = &Self {
        resource: "open_scenes",
        objects: "open scenes",
        option: Some("--open-scenes"),
        total: |config| config.open_scenes,
        reserve_divisor: 4,
        when_full: WhenFull::Refuse { minimum: 1 },
    };
}

/// All resources.
pub const LIMITS: [&Limit; 4] = [Limit::CONNECTIONS, Limit::SUBSCRIPTIONS, Limit::WAITING_REQUESTS, Limit::OPEN_SCENES];

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
                WhenFull::Preempt => "the one with the least progress ends".to_owned(),
                WhenFull::Refuse { minimum } => format!("refused; {minimum} for a principal without any"),
            };
            let kept = total / limit.reserve_divisor;
            format!("| {} | `{}` | {option} | {total} | {kept} | {when_full} |", limit.objects, limit.resource)
        };
        let documented = page.lines().skip_while(|line| !line.starts_with("| what a client holds |"));
        let documented: Vec<_> = documented.skip(2).take_while(|line| line.starts_with('|')).collect();
        assert_eq!(documented, LIMITS.iter().map(row).collect::<Vec<_>>());
    }
}
