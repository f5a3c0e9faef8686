//! The table of all resources that are limited in number or in bytes. `deploy/README.md` has the same table.

use crate::config::Config;

/// What happens to a client that asks for more than is free.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WhenFull {
    /// The permit with the least progress of the client that holds the most is preempted.
    Preempt,
    /// The client is refused. Of what one client leaves for others, this much is for principals that hold less, and the
    /// rest for clients that hold nothing.
    Refuse { minimum: usize },
    /// The client waits, and gets what is returned before clients that hold more.
    Wait,
}

/// A resource that is limited in number or in bytes.
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
    /// What a single client can hold.
    pub fn of_client(&self, config: &Config) -> usize {
        let total = (self.total)(config);
        total - total / self.reserve_divisor
    }

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

    pub const UPLOADS: &'static Self = &Self {
        resource: "uploads",
        objects: "uploads in progress",
        option: None,
        total: |_| 32,
        reserve_divisor: 8,
        when_full: WhenFull::Preempt,
    };

    /// Of messages that are not received completely, or not answered.
    pub const RECEIVED_BYTES: &'static Self = &Self {
        resource: "received_bytes",
        objects: "bytes of requests that are being received",
        option: Some("--receive-bytes"),
        total: |config| config.receive_bytes,
        reserve_divisor: 4,
        when_full: WhenFull::Preempt,
    };

    /// Of messages that HTTP/2 has not sent.
    pub const REPLY_BYTES: &'static Self = &Self {
        resource: "reply_bytes",
        objects: "bytes of replies that are being sent",
        option: Some("--reply-bytes"),
        total: |config| config.reply_bytes,
        reserve_divisor: 8,
        when_full: WhenFull::Wait,
    };

    /// Built-in scenes do not wait for slow files.
    pub const LOADS: &'static Self = &Self {
        resource: "loads",
        objects: "scenes that are being read",
        option: None,
        total: |_| 3,
        reserve_divisor: 3,
        when_full: WhenFull::Wait,
    };

    pub const BUILT_IN_LOADS: &'static Self = &Self {
        resource: "built_in_loads",
        objects: "built-in scenes that are being created",
        option: None,
        total: |_| 1,
        reserve_divisor: 2,
        when_full: WhenFull::Wait,
    };

    /// Each has 8 MiB in each direction.
    pub const SHARED_MEMORY: &'static Self = &Self {
        resource: "shared_memory",
        objects: "connections for shared memory",
        option: None,
        total: |_| 64,
        reserve_divisor: 8,
        when_full: WhenFull::Refuse { minimum: 1 },
    };

    pub const VIEW_CALLS: &'static Self = &Self {
        resource: "view_calls",
        objects: "calls that draw batches of small views",
        option: None,
        total: |_| 64,
        reserve_divisor: 8,
        when_full: WhenFull::Refuse { minimum: 1 },
    };

    /// They count to the principal, whichever client it uploads with.
    pub const STORED_BYTES: &'static Self = &Self {
        resource: "stored_bytes",
        objects: "bytes of uploads on disk",
        option: Some("--stored-bytes"),
        total: |config| usize::try_from(config.stored_bytes).unwrap_or(usize::MAX),
        reserve_divisor: 4,
        when_full: WhenFull::Refuse { minimum: 1 << 30 },
    };
}

/// All resources.
pub const LIMITS: [&Limit; 12] = [
    Limit::CONNECTIONS,
    Limit::SUBSCRIPTIONS,
    Limit::WAITING_REQUESTS,
    Limit::OPEN_SCENES,
    Limit::UPLOADS,
    Limit::RECEIVED_BYTES,
    Limit::REPLY_BYTES,
    Limit::LOADS,
    Limit::BUILT_IN_LOADS,
    Limit::SHARED_MEMORY,
    Limit::VIEW_CALLS,
    Limit::STORED_BYTES,
];

#[cfg(test)]
mod tests {
    use super::*;

    /// The page that users read has the same table.
    #[test]
    fn documented_table_is_that_of_the_server() {
        let page = include_str!("../../deploy/README.md");
        let row = |limit: &&Limit| {
            let total = (limit.total)(&Config::default());
            let shown = |amount: usize| match (amount >> 30, amount >> 20) {
                (0, 0) => amount.to_string(),
                (0, mib) => format!("{mib} MiB"),
                (gib, _) => format!("{gib} GiB"),
            };
            let option = limit.option.map_or_else(String::new, |option| format!("`{option}`"));
            let when_full = match limit.when_full {
                WhenFull::Wait => "waits; who holds the least is next".to_owned(),
                WhenFull::Preempt => "the one with the least progress ends".to_owned(),
                WhenFull::Refuse { minimum } => format!("refused; {} for a principal without any", shown(minimum)),
            };
            let (kept, total) = (shown(total / limit.reserve_divisor), shown(total));
            format!("| {} | `{}` | {option} | {total} | {kept} | {when_full} |", limit.objects, limit.resource)
        };
        let documented = page.lines().skip_while(|line| !line.starts_with("| what a client holds |"));
        let documented: Vec<_> = documented.skip(2).take_while(|line| line.starts_with('|')).collect();
        assert_eq!(documented, LIMITS.iter().map(row).collect::<Vec<_>>());
    }
}
