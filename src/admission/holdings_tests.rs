//! Lists of clients, and their end.

use super::super::account::{Account, Client};
use super::super::limits::Limit;
use super::super::permit::Permit;
use super::super::pools::Admission;
use super::*;
use crate::hang_guard::HANG_GUARD;
use crate::identity::{Principal, TokenHash};
use modalcast_model::error::Error;

fn account(principal: &str, connection: u64) -> Account {
    let principal = (!principal.is_empty()).then(|| principal.into());
    Account { principal, client: Client::Connection(connection) }
}

/// The ids of the clients, each with its numbers of permits.
fn listed(admission: &Admission) -> Vec<String> {
    let text = |client: ClientHoldings| {
        let held = client.held.iter().map(|held| format!(" {} of {}", held.held, held.total));
        format!("{}{}", client.account, held.collect::<String>())
    };
    admission.clients().into_iter().map(text).collect()
}

#[test]
fn ids_name_principal_and_client() {
    let owner = Principal::owner();
    let token = TokenHash::of("abc").expect("expected a token");
    for (account, id) in [
        (Account::server(), "owner/server"),
        (Account::new(&owner, Client::Session(token)), "owner/session-ba7816bf"),
        (Account::new(&owner, Client::Process(4711)), "owner/process-4711"),
        (account("anna", 12), "anna/connection-12"),
        (account("", 12), "anonymous/connection-12"),
    ] {
        assert_eq!(account.to_string(), id);
    }
}

#[test]
fn clients_with_the_largest_share_come_first() {
    let admission = Admission::default();
    let connections = admission.pool(Limit::CONNECTIONS, 100);
    let streams = admission.pool_of_scene(Limit::SUBSCRIPTIONS, 32, "tree");
    let acquire = |principal: &str, connection: u64| {
        connections.acquire(&account(principal, connection)).expect("expected a permit")
    };
    let mut permits: Vec<_> = (0..9).map(|_| acquire("ben", 2)).collect();
    permits.extend([acquire("anna", 1), acquire("", 3)]);
    permits.extend((0..8).map(|_| streams.acquire(&account("anna", 1)).expect("expected a permit")));
    assert_eq!(
        listed(&admission),
        ["anna/connection-1 1 of 100 8 of 32", "ben/connection-2 9 of 100", "anonymous/connection-3 1 of 100"]
    );
    let anna = admission.clients().remove(0);
    assert_eq!((anna.held[1].limit.resource, anna.held[1].scene.as_deref()), ("subscriptions", Some("tree")));
    let in_use = admission.resources_in_use();
    let in_use: Vec<_> = in_use.iter().map(|resource| (resource.limit.resource, resource.held)).collect();
    assert_eq!(in_use, [("connections", 11), ("subscriptions", 8)]);
    drop(permits);
    assert!(admission.clients().is_empty() && admission.resources_in_use().is_empty());
}

#[test]
fn idle_time_begins_with_the_last_progress_of_any_permit() {
    let admission = Admission::default();
    let pool = admission.pool(Limit::CONNECTIONS, 8);
    let [first, second] = [(); 2].map(|()| pool.acquire(&account("anna", 1)).expect("expected a permit"));
    let idle = || admission.clients()[0].idle;
    assert_eq!(idle(), None);
    first.handle().mark_progress();
    std::thread::sleep(Duration::from_millis(20));
    let since_first = idle().expect("expected progress");
    assert!(since_first >= Duration::from_millis(20));
    second.handle().mark_progress();
    assert!(idle().expect("expected progress") < since_first);
    assert!(admission.clients()[0].age >= since_first);
}

#[test]
fn pools_of_closed_scenes_are_not_kept() {
    let admission = Admission::default();
    for number in 0..3 {
        let pool = admission.pool_of_scene(Limit::SUBSCRIPTIONS, 8, &number.to_string());
        let _permit = pool.acquire(&account("anna", 1)).expect("expected a permit");
        assert_eq!(listed(&admission), ["anna/connection-1 1 of 8"]);
    }
    assert!(listed(&admission).is_empty());
    assert!(admission.pool_count() <= 1, "expected at most the last pool");
}

/// Waits for the preemption of a permit.
async fn end_of(permit: &Permit) -> Error {
    tokio::time::timeout(HANG_GUARD, permit.handle().preempted()).await.expect("expected the end of the permit")
}

#[tokio::test]
async fn ended_client_keeps_only_its_open_scenes() {
    let admission = Admission::default();
    let connections = admission.pool(Limit::CONNECTIONS, 8);
    let streams = admission.pool_of_scene(Limit::SUBSCRIPTIONS, 8, "tree");
    let scenes = admission.pool(Limit::OPEN_SCENES, 8);
    let [anna, ben] = [account("anna", 1), account("ben", 2)];
    let of_anna = [&connections, &streams].map(|pool| pool.acquire(&anna).expect("expected a permit"));
    let scene = scenes.acquire(&anna).expect("expected a permit");
    let of_ben = connections.acquire(&ben).expect("expected a permit");
    let ended = admission.end_clients(|account| *account == anna);
    assert_eq!(ended, [EndedClient { account: anna.clone(), permits: 2 }]);
    for permit in &of_anna {
        assert_eq!(end_of(permit).await, Error::ClientEnded);
    }
    assert!(!scene.handle().is_preempted() && !of_ben.handle().is_preempted());
    assert_eq!(listed(&admission), ["anna/connection-1 1 of 8", "ben/connection-2 1 of 8"]);
    assert_eq!((connections.held(), connections.ending()), (1, 1));
    drop(of_anna);
    assert_eq!((connections.held(), connections.ending(), streams.ending()), (1, 0, 0));
    assert!(admission.end_clients(|account| account.principal_name() == "zoe").is_empty());
    // An ended client may come again.
    connections.acquire(&anna).expect("expected a permit");
}
