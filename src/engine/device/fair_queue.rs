//! Deficit round-robin (Shreedhar and Varghese 1996) over accounts, by the measured cost of their work. The queue knows
//! neither devices nor scenes: an account is any key, and the caller measures the time.
//!
//! Each account has a queue in the order of its submissions. The accounts with work form a ring. In each round, an
//! account gains [`QUANTUM_MS`] of time, and spends it on the work at the head of its queue. The cost of work is an
//! estimate: the running mean of the measured times of earlier work of the same kind and size of the same account. Once
//! work is measured, the account is charged the measured time instead. So an account with many or slow commands does not
//! delay the others beyond its share, and an account that is alone never waits.
//!
//! An account that runs out of work loses the time that it has saved, but not its debt, which is at most
//! [`MAX_DEBT_MS`]. Work that cannot run yet, for example because the device has not finished its last step, delays no
//! other account.

use std::collections::{HashMap, VecDeque};
use std::hash::Hash;

/// Milliseconds that an account gains in each round: about the time of a few frames on a GPU.
const QUANTUM_MS: f64 = 5.0;
/// Maximum debt of an account in milliseconds, so that it soon pays back work that is slow only once, such as
/// loading.
const MAX_DEBT_MS: f64 = 100.0;
/// Weight of a new measurement in the running mean of costs.
const COST_WEIGHT: f64 = 0.25;

/// Work whose costs are similar: of one kind, with sizes that differ by less than a factor of two.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct CostClass {
    pub kind: &'static str,
    /// Binary logarithm of the number of pixels, rounded down; 0 for work without pixels.
    pub size_class: u32,
}

/// Identifies queued work, to remove it.
pub(super) type Ticket = u64;

/// Queued work of type `T`.
#[derive(Debug)]
struct Entry<T> {
    ticket: Ticket,
    class: CostClass,
    work: T,
}

#[derive(Debug)]
struct AccountQueue<T> {
    entries: VecDeque<Entry<T>>,
    /// Device time in milliseconds that the account may use in this round; negative after work that took longer.
    deficit_ms: f64,
    /// Running means of costs in milliseconds. The number of classes is bounded by the kinds of work and the sizes of
    /// frames.
    costs: HashMap<CostClass, f64>,
}

impl<T> AccountQueue<T> {
    fn new() -> Self {
        Self { entries: VecDeque::new(), deficit_ms: 0.0, costs: HashMap::new() }
    }

    fn cost_ms(&self, class: CostClass) -> f64 {
        self.costs.get(&class).copied().unwrap_or(0.0)
    }

    /// Rounds after which the account can afford the work at the head of its queue.
    fn rounds_until_affordable(&self) -> f64 {
        let head_cost_ms = self.entries.front().map_or(0.0, |head| self.cost_ms(head.class));
        ((head_cost_ms - self.deficit_ms) / QUANTUM_MS).ceil().max(0.0)
    }
}

/// Work that was taken from the queue.
#[derive(Debug, PartialEq)]
pub(super) struct Taken<A, T> {
    pub account: A,
    pub class: CostClass,
    /// Estimated cost in milliseconds that the account was charged.
    pub charged_ms: f64,
    pub ticket: Ticket,
    pub work: T,
}

/// The queues of all accounts.
#[derive(Debug)]
pub(super) struct FairQueue<A, T> {
    accounts: HashMap<A, AccountQueue<T>>,
    /// Accounts with work. The account at the front may spend its time.
    ring: VecDeque<A>,
    next_ticket: Ticket,
}

impl<A: Copy + Eq + Hash, T> FairQueue<A, T> {
    pub(super) fn new() -> Self {
        Self { accounts: HashMap::new(), ring: VecDeque::new(), next_ticket: 0 }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.ring.is_empty()
    }

    /// Number of queued entries of an account.
    pub(super) fn len(&self, account: A) -> usize {
        self.accounts.get(&account).map_or(0, |queue| queue.entries.len())
    }

    /// Appends work to the queue of an account. The caller limits the length of the queue.
    pub(super) fn push(&mut self, account: A, class: CostClass, work: T) -> Ticket {
        self.insert(account, class, work, VecDeque::push_back)
    }

    /// Puts unfinished work back at the head of its account's queue, and ends the turn of the account.
    pub(super) fn push_front(&mut self, account: A, class: CostClass, work: T) {
        self.insert(account, class, work, VecDeque::push_front);
        if self.ring.front() == Some(&account) {
            self.ring.rotate_left(1);
        }
    }

    /// Puts taken work back at the head of its account's queue, and refunds the charge.
    pub(super) fn return_taken(&mut self, taken: Taken<A, T>) {
        let Taken { account, class, charged_ms, ticket, work } = taken;
        self.push_front(account, class, work);
        if let Some(queue) = self.accounts.get_mut(&account) {
            queue.deficit_ms += charged_ms;
            if let Some(head) = queue.entries.front_mut() {
                head.ticket = ticket;
            }
        }
    }

    fn insert(&mut self, account: A, class: CostClass, work: T, push: fn(&mut VecDeque<Entry<T>>, Entry<T>)) -> Ticket {
        let ticket = self.next_ticket;
        self.next_ticket += 1;
        let queue = self.accounts.entry(account).or_insert_with(AccountQueue::new);
        if queue.entries.is_empty() {
            self.ring.push_back(account);
            // An account begins with a new quantum, less its debt.
            queue.deficit_ms = queue.deficit_ms.min(0.0) + QUANTUM_MS;
        }
        push(&mut queue.entries, Entry { ticket, class, work });
        ticket
    }

    /// Removes work that is still queued. Returns it, or `None` if it was taken.
    pub(super) fn remove(&mut self, account: A, ticket: Ticket) -> Option<T> {
        let queue = self.accounts.get_mut(&account)?;
        let index = queue.entries.iter().position(|entry| entry.ticket == ticket)?;
        let entry = queue.entries.remove(index)?;
        if queue.entries.is_empty() {
            // Takes back the quantum, so that cancelled work does not reduce the debt.
            queue.deficit_ms = (queue.deficit_ms - QUANTUM_MS).max(-MAX_DEBT_MS);
        }
        self.leave_ring_if_empty(account);
        Some(entry.work)
    }

    /// Takes the work whose turn it is and charges its account the estimated cost. Work
    /// for which `can_run` returns false is passed over. `None` if no work can run.
    pub(super) fn take(&mut self, can_run: impl Fn(A, &T) -> bool) -> Option<Taken<A, T>> {
        let Self { accounts, ring, .. } = self;
        let is_runnable = |queue: &AccountQueue<T>, account: A| {
            queue.entries.front().is_some_and(|head| can_run(account, &head.work))
        };
        let runnable: Vec<A> =
            ring.iter().copied().filter(|account| is_runnable(&accounts[account], *account)).collect();
        // Skips all rounds in which no account can afford its work: adds their quanta at once.
        let rounds = runnable.iter().map(|account| accounts[account].rounds_until_affordable());
        let rounds = rounds.min_by(f64::total_cmp)?;
        if rounds > 1.0 {
            for account in &runnable {
                if let Some(queue) = accounts.get_mut(account) {
                    queue.deficit_ms += (rounds - 1.0) * QUANTUM_MS;
                }
            }
        }
        // One round adds the last quantum, and the next one takes the work.
        for _ in 0..2 * ring.len() {
            let account = *ring.front()?;
            let queue = accounts.get_mut(&account)?;
            if runnable.contains(&account) {
                if queue.rounds_until_affordable() == 0.0 {
                    return self.take_head(account);
                }
                queue.deficit_ms += QUANTUM_MS;
            }
            ring.rotate_left(1);
        }
        runnable.first().and_then(|account| self.take_head(*account))
    }

    fn take_head(&mut self, account: A) -> Option<Taken<A, T>> {
        let queue = self.accounts.get_mut(&account)?;
        let Entry { ticket, class, work } = queue.entries.pop_front()?;
        let charged_ms = queue.cost_ms(class);
        queue.deficit_ms -= charged_ms;
        self.leave_ring_if_empty(account);
        Some(Taken { account, class, charged_ms, ticket, work })
    }

    /// Charges an account the measured time of work instead of `charged_ms`, and updates the estimate of its class.
    pub(super) fn record_cost(&mut self, account: A, class: CostClass, charged_ms: f64, measured_ms: f64) {
        let Some(queue) = self.accounts.get_mut(&account) else { return };
        let mean_ms = queue.costs.entry(class).or_insert(measured_ms);
        *mean_ms += COST_WEIGHT * (measured_ms - *mean_ms);
        self.charge(account, measured_ms - charged_ms);
    }

    /// Reduces the time that an account may use.
    pub(super) fn charge(&mut self, account: A, ms: f64) {
        if let Some(queue) = self.accounts.get_mut(&account) {
            queue.deficit_ms = (queue.deficit_ms - ms).max(-MAX_DEBT_MS);
        }
    }

    /// Forgets the costs of an account without work.
    pub(super) fn forget(&mut self, account: A) {
        if self.len(account) == 0 {
            self.accounts.remove(&account);
        }
    }

    #[cfg(test)]
    pub(super) fn reset_costs(&mut self) {
        for queue in self.accounts.values_mut() {
            (queue.deficit_ms, queue.costs) = (0.0, HashMap::new());
        }
    }

    fn leave_ring_if_empty(&mut self, account: A) {
        if self.len(account) == 0 {
            self.ring.retain(|ringed_account| *ringed_account != account);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SMALL: CostClass = CostClass { kind: "small", size_class: 0 };
    const LARGE: CostClass = CostClass { kind: "large", size_class: 20 };

    fn cost_ms(class: CostClass) -> f64 {
        if class == LARGE { 200.0 } else { 1.0 }
    }

    /// Takes up to `count` entries, records their costs, and returns their accounts.
    fn take_accounts(queue: &mut FairQueue<u32, u32>, count: usize) -> Vec<u32> {
        let mut accounts = Vec::new();
        for _ in 0..count {
            let Some(Taken { account, class, charged_ms, .. }) = queue.take(|_, _| true) else { break };
            queue.record_cost(account, class, charged_ms, cost_ms(class));
            accounts.push(account);
        }
        accounts
    }

    fn count_of(accounts: &[u32], account: u32) -> usize {
        accounts.iter().filter(|taken_account| **taken_account == account).count()
    }

    #[test]
    fn accounts_share_time_equally() {
        let mut queue = FairQueue::new();
        for number in 0..20 {
            queue.push(1, LARGE, number);
        }
        for number in 0..5000 {
            queue.push(2, SMALL, number);
        }
        let accounts = take_accounts(&mut queue, 2000);
        let (large_ms, small_ms) = (200 * count_of(&accounts, 1), count_of(&accounts, 2));
        // The accounts differ by at most the cost of one entry, and the work that was taken before any cost was measured.
        assert!(large_ms.abs_diff(small_ms) <= 600, "{large_ms} and {small_ms} ms");
        // Negative control: in the order of submission, the first account would have used all the time.
        assert!(small_ms > 1000, "{small_ms} ms");
    }

    #[test]
    fn account_with_many_commands_does_not_delay_another() {
        let mut queue = FairQueue::new();
        for number in 0..100 {
            queue.push(1, LARGE, number);
        }
        take_accounts(&mut queue, 3);
        queue.push(2, SMALL, 0);
        assert_eq!(take_accounts(&mut queue, 1), [2]);
        // An account that is alone does not wait.
        assert_eq!(take_accounts(&mut queue, 100).len(), 97);
        assert!(queue.is_empty() && queue.take(|_, _| true).is_none());
    }

    #[test]
    fn work_of_an_account_keeps_its_order() {
        let mut queue = FairQueue::new();
        for number in 0..50_u32 {
            queue.push(1, if number % 3 == 0 { LARGE } else { SMALL }, number);
            queue.push(2, SMALL, number);
        }
        let mut numbers = HashMap::<u32, Vec<u32>>::new();
        while let Some(Taken { account, class, charged_ms, work, .. }) = queue.take(|_, _| true) {
            queue.record_cost(account, class, charged_ms, cost_ms(class));
            numbers.entry(account).or_default().push(work);
            // Unfinished work continues before later work.
            if work == 7 && numbers[&account].iter().filter(|number| **number == 7).count() < 3 {
                queue.push_front(account, class, work);
            }
        }
        let expected: Vec<u32> = (0..7).chain([7, 7, 7]).chain(8..50).collect();
        assert_eq!((&numbers[&1], &numbers[&2]), (&expected, &expected));
    }

    #[test]
    fn work_that_cannot_run_delays_no_other_account() {
        let mut queue = FairQueue::new();
        queue.push(1, SMALL, 10);
        queue.push(1, SMALL, 11);
        queue.push(2, SMALL, 20);
        assert_eq!(queue.take(|account, _| account != 1).map(|taken| taken.work), Some(20));
        assert_eq!(queue.take(|account, _| account != 1), None);
        assert_eq!(queue.take(|_, _| true).map(|taken| taken.work), Some(10));
    }

    #[test]
    fn removed_work_leaves_the_queue_at_once() {
        let mut queue = FairQueue::new();
        let tickets: Vec<Ticket> = (0..3).map(|number| queue.push(1, SMALL, number)).collect();
        assert_eq!(queue.remove(1, tickets[1]), Some(1));
        assert_eq!((queue.len(1), queue.remove(1, tickets[1]), queue.remove(2, tickets[0])), (2, None, None));
        assert_eq!(queue.take(|_, _| true).map(|taken| taken.work), Some(0));
        assert_eq!(queue.remove(1, tickets[0]), None, "expected no removal of taken work");
        assert_eq!(queue.remove(1, tickets[2]), Some(2));
        assert!(queue.is_empty());
    }

    #[test]
    fn debt_is_bounded_and_remains_without_work() {
        let mut queue = FairQueue::new();
        queue.push(1, SMALL, 0);
        let Taken { charged_ms, .. } = queue.take(|_, _| true).expect("expected work");
        queue.record_cost(1, SMALL, charged_ms, 10_000.0);
        for number in 0..200 {
            queue.push(2, LARGE, number);
            queue.record_cost(2, LARGE, 0.0, 0.0);
        }
        // Cancelled work does not reduce the debt.
        for _ in 0..50 {
            let ticket = queue.push(1, CostClass { kind: "new", ..SMALL }, 0);
            queue.remove(1, ticket);
        }
        queue.push(1, CostClass { kind: "new", ..SMALL }, 1);
        let mut other_ms = 0.0;
        while let Some(Taken { account, class, charged_ms, .. }) = queue.take(|_, _| true) {
            queue.record_cost(account, class, charged_ms, 1.0);
            if account == 1 {
                break;
            }
            other_ms += 1.0;
        }
        assert!((MAX_DEBT_MS - 2.0 * QUANTUM_MS..=MAX_DEBT_MS + 2.0 * QUANTUM_MS).contains(&other_ms), "{other_ms} ms");
    }
}
