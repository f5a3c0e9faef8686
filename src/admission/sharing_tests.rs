//! Properties of the sharing rule, in random sequences of clients that come, work and go.

use super::super::limits::Limit;
use super::super::permit::{Permit, PermitPool};
use super::super::pools::Admission;
use super::*;
use modalcast_model::error::Error;

const TOTAL: usize = 32;

fn pool(total: usize) -> PermitPool {
    Admission::default().pool(Limit::CONNECTIONS, total)
}

fn account(principal: &str, client: u64) -> Account {
    let principal = (!principal.is_empty()).then(|| principal.into());
    Account { principal, client: Client::Connection(client) }
}

fn acquire(pool: &PermitPool, principal: &str, client: u64) -> Permit {
    pool.acquire(&account(principal, client)).expect("expected a permit")
}

fn is_preempted(permit: &Permit) -> bool {
    permit.handle().is_preempted()
}

/// A generator of numbers below a bound (an LCG with the constants of Knuth's MMIX).
struct Random(u64);

impl Random {
    fn below(&mut self, bound: u64) -> u64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) % bound
    }
}

/// Numbers of permits before a decision.
struct Counts<'a>(&'a [(Account, Permit)]);

impl Counts<'_> {
    fn of_principal(&self, account: &Account) -> usize {
        self.0.iter().filter(|(holder, _)| holder.principal == account.principal).count()
    }

    fn of_client(&self, account: &Account) -> usize {
        self.0.iter().filter(|(holder, _)| holder == account).count()
    }

    /// Whether `other` holds more than a client that asks for a permit would take from it.
    fn exceeds(&self, other: &Account, account: &Account) -> bool {
        match other.principal == account.principal {
            true => self.of_client(other) > self.of_client(account),
            false => self.of_principal(other) > self.of_principal(account),
        }
    }

    /// Whether a client is preempted in favor of one that holds as many or more.
    fn is_unfair_preemption(&self, victim: &Account, account: &Account) -> bool {
        let is_anonymous_crowd = victim.principal.is_none() && self.of_principal(victim) > TOTAL / 8;
        let is_same_principal = victim.principal == account.principal;
        !self.exceeds(victim, account) && (is_same_principal || !is_anonymous_crowd)
    }

    /// Whether a client without permits is refused, or one that would hold fewer than another client of its principal.
    fn is_unfair_refusal(&self, account: &Account) -> bool {
        let held = self.of_client(account);
        let is_larger = |other: &Account| {
            other.principal == account.principal && other != account && self.of_client(other) > held + 1
        };
        self.0.len() < TOTAL && held + TOTAL / 8 < TOTAL
            || held == 0
            || self.0.iter().any(|(other, _)| is_larger(other))
    }
}

fn random_account(random: &mut Random) -> Account {
    // Few clients ask often, and many ask rarely.
    let client = if random.below(2) == 0 { random.below(3) } else { random.below(64) };
    account(["", "anna", "ben", "ben", "ben"][random.below(5) as usize], client)
}

#[test]
fn no_client_loses_to_one_with_more_permits() {
    let (mut preempted, mut refused) = (0, 0);
    for seed in 0..40 {
        let (mut random, pool) = (Random(seed), pool(TOTAL));
        let mut permits: Vec<(Account, Permit)> = Vec::new();
        for _ in 0..400 {
            match random.below(8) {
                0 if !permits.is_empty() => drop(permits.swap_remove(random.below(permits.len() as u64) as usize)),
                1 | 2 if !permits.is_empty() => {
                    permits[random.below(permits.len() as u64) as usize].1.handle().mark_progress();
                }
                _ => {}
            }
            let account = random_account(&mut random);
            let result = pool.acquire(&account);
            let victim = permits.iter().position(|(_, permit)| is_preempted(permit));
            let counts = Counts(&permits);
            match (&result, victim) {
                (Ok(_), Some(victim)) => {
                    preempted += 1;
                    let victim = &permits[victim].0;
                    assert!(!counts.is_unfair_preemption(victim, &account), "seed {seed}: {victim:?} for {account:?}");
                }
                (Ok(_), None) => assert!(permits.len() < TOTAL),
                (Err(error), victim) => {
                    refused += 1;
                    assert!(victim.is_none() && matches!(error, Error::LimitReached { limit: TOTAL, .. }));
                    assert!(!counts.is_unfair_refusal(&account), "seed {seed}: {account:?}");
                }
            }
            permits.retain(|(_, permit)| !is_preempted(permit));
            permits.extend(result.ok().map(|permit| (account, permit)));
            assert_eq!((pool.held(), pool.ending()), (permits.len(), 0));
        }
        drop(permits);
        assert_eq!((pool.held(), pool.ending()), (0, 0), "expected no permit after the last holder");
    }
    assert!(preempted > 1000 && refused > 100, "{preempted} preempted, {refused} refused");
}

/// Control: the properties reject a rule that preempts the holder of the fewest permits, and one that never preempts.
#[test]
fn unfair_rules_violate_the_properties() {
    let pool = pool(TOTAL);
    let mut permits: Vec<_> = (0..24).map(|_| (account("ben", 1), acquire(&pool, "ben", 1))).collect();
    permits.extend((0..8).map(|client| (account("anna", client), acquire(&pool, "anna", client))));
    let counts = Counts(&permits);
    assert!(counts.is_unfair_preemption(&account("anna", 0), &account("ben", 2)));
    assert!(counts.is_unfair_refusal(&account("ben", 2)));
    assert!(!counts.is_unfair_preemption(&account("ben", 1), &account("ben", 2)));
}

#[test]
fn single_client_leaves_an_eighth_for_others() {
    let pool = pool(TOTAL);
    let mut permits: Vec<_> = (0..28).map(|_| acquire(&pool, "ben", 1)).collect();
    let error = pool.acquire(&account("ben", 1)).expect_err("expected a refusal");
    assert_eq!(error, Error::LimitReached { objects: "connections", limit: TOTAL });
    permits.extend((0..4).map(|client| acquire(&pool, "ben", 2 + client)));
    assert!(!permits.iter().any(is_preempted), "expected a free permit for each other client");
}

#[test]
fn preempts_least_progress_of_the_largest_client() {
    let pool = pool(8);
    let largest: Vec<_> = (0..5).map(|_| acquire(&pool, "ben", 1)).collect();
    let others: Vec<_> = (2..5).map(|client| acquire(&pool, "ben", client)).collect();
    for permit in [4, 0, 1, 2, 3].map(|index| &largest[index]) {
        permit.handle().mark_progress();
    }
    let _new = acquire(&pool, "anna", 6);
    assert!(is_preempted(&largest[4]));
    assert!(!largest[..4].iter().chain(&others).any(is_preempted));
}

#[test]
fn anonymous_clients_go_first_above_the_reserve() {
    let pool = pool(16);
    let anna: Vec<_> = (0..13).map(|client| acquire(&pool, "anna", client)).collect();
    let anonymous: Vec<_> = (20..23).map(|client| acquire(&pool, "", client)).collect();
    let _new = acquire(&pool, "", 30);
    assert!(is_preempted(&anonymous[0]), "expected the oldest anonymous client to end");
    let _newer = acquire(&pool, "ben", 31);
    assert!(is_preempted(&anonymous[1]));
    let _newest = acquire(&pool, "ben", 32);
    assert!(!is_preempted(&anonymous[2]), "expected the reserve to protect clients that have just come");
    assert_eq!(anna.iter().filter(|permit| is_preempted(permit)).count(), 1);
}

/// Clients that come often do not preempt each other before their first progress, nor those that work.
#[test]
fn clients_without_progress_go_first_above_the_reserve() {
    let pool = pool(16);
    let working: Vec<_> = (0..13).map(|client| acquire(&pool, "ben", client)).collect();
    working.iter().for_each(|permit| permit.handle().mark_progress());
    let idle: Vec<_> = (20..23).map(|client| acquire(&pool, "ben", client)).collect();
    let mut new = vec![acquire(&pool, "ben", 30)];
    assert!(is_preempted(&idle[0]) && !working.iter().any(is_preempted));
    new.push(acquire(&pool, "ben", 31));
    assert!(is_preempted(&idle[1]) && !is_preempted(&idle[2]));
    new.iter().for_each(|permit| permit.handle().mark_progress());
    let _newest = acquire(&pool, "ben", 32);
    assert!(is_preempted(&working[0]) && !is_preempted(&idle[2]));
}

#[test]
fn identified_permit_counts_to_its_principal() {
    let pool = pool(8);
    let permits: Vec<_> = (0..8).map(|client| acquire(&pool, "", client)).collect();
    permits[0].handle().identify(|| account("anna", 0));
    permits[0].handle().identify(|| account("ben", 0));
    let _new = acquire(&pool, "", 9);
    assert!(is_preempted(&permits[1]) && !is_preempted(&permits[0]));
    // A preempted permit stays preempted.
    permits[1].handle().identify(|| account("anna", 1));
    assert_eq!((pool.held(), pool.ending()), (8, 1));
    drop(permits);
    assert_eq!((pool.held(), pool.ending()), (1, 0));
}

#[tokio::test]
async fn preempted_holder_learns_what_it_held() {
    let pool = pool(2);
    let permits = [acquire(&pool, "ben", 1), acquire(&pool, "ben", 1)];
    let handle = permits[0].handle().clone();
    let ended = handle.preempted();
    let _new = acquire(&pool, "anna", 2);
    let error = tokio::time::timeout(crate::hang_guard::HANG_GUARD, ended).await.expect("expected an end");
    assert_eq!(error, Error::Preempted { objects: "connections", held: 2, limit: 2 });
}

#[test]
fn scenes_are_left_for_new_clients_and_other_principals() {
    let pool = Admission::default().pool(Limit::OPEN_SCENES, 16);
    let is_granted = |permits: &mut Vec<Permit>, account: Account| match pool.acquire(&account) {
        Ok(permit) => {
            assert!(pool.held() <= 16);
            permits.push(permit);
            true
        }
        Err(error) => {
            assert_eq!(error, Error::LimitReached { objects: "open scenes", limit: 16 });
            false
        }
    };
    let mut permits = Vec::new();
    let count = |permits: &mut Vec<Permit>, principal, client| {
        (0..20).filter(|_| is_granted(permits, account(principal, client))).count()
    };
    assert_eq!(count(&mut permits, "ben", 1), 12, "expected a single client to leave a quarter");
    assert_eq!([2, 3, 4, 5].map(|client| count(&mut permits, "ben", client)), [1, 1, 1, 0]);
    assert_eq!(count(&mut permits, "anna", 6), 1, "expected a scene for another principal");
    assert_eq!(count(&mut permits, "carla", 7), 0);
    assert!(!permits.iter().any(is_preempted), "expected that no scene ends for another client");
    permits.clear();
    assert_eq!(count(&mut permits, "ben", 1), 12);
}
