//! The stall budget of a scene: the time for which lossless subscribers may make the writer wait.
//!
//! The budget is a token bucket of time. Waits of the writer are taken from it, and it is refilled by a tenth of the
//! elapsed time, so that the writer keeps nine tenths of its rate in the long run. The waits for one client are also
//! counted as its own [`StallTime`], which drains at the same rate. A client has exceeded the budget when its own stall
//! time is as long as what is left. One client that reads nothing therefore uses at most half of the budget, and the
//! other half covers short waits for clients that read.
//!
//! A new client counts as if the writer had already waited for it. Otherwise a series of new clients that read nothing
//! would leave nothing to the others.

use std::time::{Duration, Instant};

/// Stall time drains, and the budget is refilled, by the elapsed time divided by this number.
const DRAIN_DIVISOR: u32 = 10;

/// A new client counts as if it had used the whole budget divided by this number.
const NEW_CLIENT_DIVISOR: u32 = 4;

/// How long the writer has waited. Drains with time (a leaky bucket).
#[derive(Debug, Clone, Copy)]
pub(super) struct StallTime {
    duration: Duration,
    updated_at: Instant,
}

impl StallTime {
    pub(super) const fn new(duration: Duration, now: Instant) -> Self {
        Self { duration, updated_at: now }
    }

    fn at(&self, now: Instant) -> Duration {
        self.duration.saturating_sub(now.saturating_duration_since(self.updated_at) / DRAIN_DIVISOR)
    }

    pub(super) fn add(&mut self, stall: Duration, now: Instant) {
        *self = Self::new(self.at(now).saturating_add(stall), now);
    }
}

/// The stall budget of the present writer.
#[derive(Debug, Clone, Copy)]
pub(super) struct StallBudget {
    capacity: Duration,
    spent: StallTime,
}

impl StallBudget {
    /// A full budget.
    pub(super) const fn new(capacity: Duration, now: Instant) -> Self {
        Self { capacity, spent: StallTime::new(Duration::ZERO, now) }
    }

    /// The stall time of a client that subscribes now.
    pub(super) fn new_client(&self, now: Instant) -> StallTime {
        StallTime::new(self.capacity / NEW_CLIENT_DIVISOR, now)
    }

    /// Takes a wait of the writer from the budget, at most all that is left.
    pub(super) fn spend(&mut self, stall: Duration, now: Instant) {
        self.spent.add(stall.min(self.left(now)), now);
    }

    fn left(&self, now: Instant) -> Duration {
        self.capacity.saturating_sub(self.spent.at(now))
    }

    /// How much longer the writer may wait for a client. Zero if the client has exceeded the budget.
    pub(super) fn remaining(&self, of_client: &StallTime, now: Instant) -> Duration {
        // A wait reduces what is left and adds to the stall time of the client.
        self.left(now).saturating_sub(of_client.at(now)) / 2
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAPACITY: Duration = Duration::from_secs(2);

    fn seconds(count: f64) -> Duration {
        Duration::from_secs_f64(count)
    }

    /// A scene with virtual time.
    struct Simulation {
        now: Instant,
        budget: StallBudget,
        total_stall: Duration,
    }

    impl Simulation {
        fn new() -> Self {
            let now = Instant::now();
            Self { now, budget: StallBudget::new(CAPACITY, now), total_stall: Duration::ZERO }
        }

        fn new_client(&self) -> StallTime {
            self.budget.new_client(self.now)
        }

        fn run(&mut self, time: Duration) {
            self.now += time;
        }

        /// The writer waits for the clients.
        fn stall(&mut self, clients: &mut [&mut StallTime], time: Duration) {
            self.now += time;
            self.total_stall += time;
            self.budget.spend(time, self.now);
            clients.iter_mut().for_each(|client| client.add(time, self.now));
        }

        fn remaining(&self, client: &StallTime) -> Duration {
            self.budget.remaining(client, self.now)
        }

        /// The writer waits for a client until the client has exceeded the budget. Returns the time.
        fn stall_until_exceeded(&mut self, client: &mut StallTime) -> Duration {
            let before = self.total_stall;
            while !self.remaining(client).is_zero() {
                let time = self.remaining(client).max(Duration::from_millis(1));
                self.stall(&mut [client], time);
            }
            self.total_stall - before
        }
    }

    #[test]
    fn budget_is_refilled_by_a_tenth_up_to_its_capacity() {
        let mut scene = Simulation::new();
        let idle = StallTime::new(Duration::ZERO, scene.now);
        assert_eq!(scene.remaining(&idle), CAPACITY / 2);
        scene.budget.spend(seconds(1.5), scene.now);
        assert_eq!(scene.remaining(&idle), seconds(0.25));
        scene.run(seconds(5.0));
        assert_eq!(scene.remaining(&idle), seconds(0.5));
        scene.run(seconds(1000.0));
        assert_eq!(scene.remaining(&idle), CAPACITY / 2);
    }

    #[test]
    fn wait_beyond_the_budget_takes_only_what_is_left() {
        let mut scene = Simulation::new();
        let idle = StallTime::new(Duration::ZERO, scene.now);
        scene.budget.spend(seconds(100.0), scene.now);
        assert_eq!(scene.remaining(&idle), Duration::ZERO);
        scene.run(seconds(4.0));
        assert_eq!(scene.remaining(&idle), seconds(0.2));
    }

    #[test]
    fn one_client_uses_at_most_half_of_the_budget() {
        let mut scene = Simulation::new();
        let mut new_client = scene.new_client();
        let stall = scene.stall_until_exceeded(&mut new_client);
        assert!(stall > seconds(0.7) && stall < seconds(0.9), "{stall:?}");
        let mut scene = Simulation::new();
        let mut established = scene.new_client();
        scene.run(seconds(60.0));
        let stall = scene.stall_until_exceeded(&mut established);
        assert!(stall > seconds(0.95) && stall < seconds(1.2), "{stall:?}");
    }

    /// However many new clients read nothing, a client that reads has a part of the budget for its own short waits.
    #[test]
    fn series_of_new_clients_leaves_a_reserve() {
        for pause in [seconds(4.0), seconds(0.01)] {
            let mut scene = Simulation::new();
            let reader = StallTime::new(Duration::ZERO, scene.now);
            let begin = scene.now;
            while scene.now - begin < seconds(30.0) {
                let mut client = scene.new_client();
                scene.stall_until_exceeded(&mut client);
                assert!(scene.remaining(&reader) >= CAPACITY / 8, "{pause:?}: {:?}", scene.remaining(&reader));
                scene.run(pause);
            }
            let bound = CAPACITY + (scene.now - begin) / DRAIN_DIVISOR;
            assert!(scene.total_stall <= bound, "{pause:?}: {:?}, expected at most {bound:?}", scene.total_stall);
        }
    }

    #[test]
    fn client_with_the_longest_stall_time_exceeds_the_budget_first() {
        let mut scene = Simulation::new();
        let (mut slow, mut unread) = (scene.new_client(), scene.new_client());
        scene.run(seconds(30.0));
        while !scene.remaining(&unread).is_zero() {
            scene.stall(&mut [&mut unread], seconds(0.04));
            scene.stall(&mut [&mut slow, &mut unread], seconds(0.01));
            assert!(!scene.remaining(&slow).is_zero());
        }
    }

    /// Waits of less than a tenth of the time are covered by the refill.
    #[test]
    fn slightly_slow_client_never_exceeds_the_budget() {
        let mut scene = Simulation::new();
        let mut client = scene.new_client();
        for _ in 0..100_000 {
            scene.run(seconds(0.0092));
            scene.stall(&mut [&mut client], seconds(0.0008));
            assert!(!scene.remaining(&client).is_zero());
        }
    }
}
