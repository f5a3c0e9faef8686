//! The command `clients`: a table of who holds what on the server, and the end of clients.

use std::collections::BTreeMap;

use modalcast_client::{Client, Result, v1};
use serde_json::{Value, json};

use crate::cli::ClientsOptions;

/// Number of clients of each principal that the table shows without `--all`.
const MAX_ROWS_PER_PRINCIPAL: usize = 10;

const HEADER: [&str; 6] = ["SHARE", "CLIENT", "PEER", "FOR", "IDLE", "HOLDS"];

/// Lists the clients, or ends those that the options name.
pub(crate) async fn run(client: &Client, options: &ClientsOptions, as_json: bool) -> Result<()> {
    if options.end.is_empty() {
        let list = client.list_clients().await?;
        match as_json {
            true => println!("{}", list_json(&list)),
            false => text_lines(&list, options.all).iter().for_each(|line| println!("{line}")),
        }
    }
    for id in &options.end {
        let v1::EndClientResponse { ids, ended } = client.end_client(id).await?;
        match as_json {
            true => println!("{}", json!({ "ids": ids, "ended": ended })),
            false => println!("{id}: ended {ended} connections, streams and waiting requests, of {}", count(ids.len())),
        }
    }
    Ok(())
}

fn list_json(list: &v1::ListClientsResponse) -> Value {
    let client = |client: &v1::ClientInfo| {
        json!({
            "id": client.id, "principal": client.principal, "kind": client.kind().as_str_name(),
            "address": client.address, "process_id": client.process_id, "process_name": client.process_name,
            "held": client.held.iter().map(resource_json).collect::<Vec<_>>(),
            "age_ms": client.age_ms, "idle_ms": client.idle_ms, "is_caller": client.is_caller,
            "driven_scenes": client.driven_scenes,
        })
    };
    json!({
        "clients": list.clients.iter().map(client).collect::<Vec<_>>(),
        "omitted": list.omitted,
        "resources": list.resources.iter().map(resource_json).collect::<Vec<_>>(),
    })
}

fn resource_json(resource: &v1::ResourceUse) -> Value {
    json!({
        "resource": resource.resource, "objects": resource.objects, "scene": resource.scene,
        "held": resource.held, "limit": resource.limit,
    })
}

/// A row of the table.
struct Row {
    /// The largest part of a limit that is held: 0 to 1.
    share: f64,
    id: String,
    peer: String,
    age: String,
    idle: String,
    holds: String,
}

impl Row {
    fn of_client(client: &v1::ClientInfo) -> Self {
        let peer = match client.process_name.as_str() {
            "" => client.address.as_str(),
            name => name,
        };
        let note = if client.is_caller { "(this command)" } else { "" };
        let mut holds: Vec<_> = client.driven_scenes.iter().map(|scene| format!("drives {scene}")).collect();
        holds.extend(describe_all(&client.held));
        Self {
            share: largest_share(&client.held),
            id: client.id.clone(),
            peer: [peer, note].join(" ").trim().to_owned(),
            age: describe_ms(client.age_ms),
            idle: client.idle_ms.map_or_else(|| "-".into(), describe_ms),
            holds: holds.join(", "),
        }
    }

    /// The sum of the clients of a principal, with the id by which `--end` ends all of them.
    fn of_principal(name: &str, clients: &[&v1::ClientInfo]) -> Self {
        let held = sum(clients.iter().flat_map(|client| &client.held));
        Self {
            share: largest_share(&held),
            id: format!("{name}/*"),
            peer: count(clients.len()),
            age: String::new(),
            idle: String::new(),
            holds: describe_all(&held).join(", "),
        }
    }

    fn cells(self) -> [String; 6] {
        [format!("{:.0} %", 100.0 * self.share), self.id, self.peer, self.age, self.idle, self.holds]
    }
}

/// The clients of a principal.
struct Group<'a> {
    sum: Row,
    /// Those with the largest share come first.
    clients: Vec<&'a v1::ClientInfo>,
}

impl<'a> Group<'a> {
    fn new(principal: &str, clients: Vec<&'a v1::ClientInfo>) -> Self {
        Self { sum: Row::of_principal(principal, &clients), clients }
    }
}

/// The table: for each principal its clients and, if there are several, their sum. The largest shares come first.
fn text_lines(list: &v1::ListClientsResponse, shows_all: bool) -> Vec<String> {
    let mut principals = BTreeMap::<&str, Vec<&v1::ClientInfo>>::new();
    for client in &list.clients {
        let name = client.id.split_once('/').map_or(client.id.as_str(), |(name, _)| name);
        principals.entry(name).or_default().push(client);
    }
    let mut groups: Vec<_> = principals.into_iter().map(|(name, clients)| Group::new(name, clients)).collect();
    groups.sort_by(|a, b| b.sum.share.total_cmp(&a.sum.share));
    let limit = if shows_all { usize::MAX } else { MAX_ROWS_PER_PRINCIPAL };
    let mut rows = vec![HEADER.map(str::to_owned)];
    for Group { sum, clients } in groups {
        if clients.len() > 1 {
            rows.push(sum.cells());
        }
        rows.extend(clients.iter().take(limit).map(|client| Row::of_client(client).cells()));
        if let Some(more) = clients.len().checked_sub(limit).filter(|more| *more > 0) {
            rows.push(["".into(), format!("... {more} more"), "".into(), "".into(), "".into(), "".into()]);
        }
    }
    let mut lines = aligned(&rows);
    if list.omitted > 0 {
        lines.push(format!("{} clients with smaller shares are not listed", list.omitted));
    }
    lines.push(format!("in use: {}", describe_all(&list.resources).join(", ")));
    lines
}

/// Lines with columns of equal width.
fn aligned(rows: &[[String; 6]]) -> Vec<String> {
    let width = |column: usize| rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0);
    let widths: [usize; 6] = std::array::from_fn(width);
    let line = |row: &[String; 6]| {
        let [share, id, peer, age, idle, holds] = row;
        let [share_width, id_width, peer_width, age_width, idle_width, _] = widths;
        let line = format!(
            "{share:>share_width$}  {id:id_width$}  {peer:peer_width$}  {age:>age_width$}  {idle:>idle_width$}  {holds}"
        );
        line.trim_end().to_owned()
    };
    rows.iter().map(line).collect()
}

/// What the clients hold together of each resource.
fn sum<'a>(held: impl Iterator<Item = &'a v1::ResourceUse>) -> Vec<v1::ResourceUse> {
    let mut sums = Vec::<v1::ResourceUse>::new();
    for resource in held {
        let is_same = |sum: &&mut v1::ResourceUse| (&sum.resource, &sum.scene) == (&resource.resource, &resource.scene);
        match sums.iter_mut().find(is_same) {
            Some(sum) => sum.held += resource.held,
            None => sums.push(resource.clone()),
        }
    }
    sums
}

fn largest_share(held: &[v1::ResourceUse]) -> f64 {
    held.iter().map(share).fold(0.0, f64::max)
}

/// The part of the limit that is held: 0 to 1.
fn share(resource: &v1::ResourceUse) -> f64 {
    resource.held as f64 / resource.limit.max(1) as f64
}

/// The resources as texts, those with the largest share first.
fn describe_all(held: &[v1::ResourceUse]) -> Vec<String> {
    let mut sorted: Vec<_> = held.iter().collect();
    sorted.sort_by(|a, b| share(b).total_cmp(&share(a)));
    sorted.into_iter().map(describe).collect()
}

fn count(clients: usize) -> String {
    if clients == 1 { "1 client".into() } else { format!("{clients} clients") }
}

fn describe(resource: &v1::ResourceUse) -> String {
    let v1::ResourceUse { resource, scene, held, limit, .. } = resource;
    let scene = if scene.is_empty() { String::new() } else { format!(" of {scene}") };
    let amount = |amount: u64| if resource.ends_with("bytes") { describe_bytes(amount) } else { amount.to_string() };
    format!("{} of {} {}{scene}", amount(*held), amount(*limit), resource.replace('_', " "))
}

/// A number of bytes without its unit, in the largest multiple of which it has at least one.
fn describe_bytes(bytes: u64) -> String {
    match bytes {
        0..0x400 => bytes.to_string(),
        0x400..0x10_0000 => format!("{} Ki", bytes >> 10),
        0x10_0000..0x4000_0000 => format!("{} Mi", bytes >> 20),
        _ => format!("{} Gi", bytes >> 30),
    }
}

/// A time in milliseconds, in the largest unit of which it has at least one.
fn describe_ms(ms: u64) -> String {
    match ms / 1000 {
        seconds @ ..60 => format!("{seconds} s"),
        seconds @ 60..3600 => format!("{} min", seconds / 60),
        seconds @ 3600..86_400 => format!("{} h", seconds / 3600),
        seconds => format!("{} d", seconds / 86_400),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn held(resource: &str, scene: &str, held: u64, limit: u64) -> v1::ResourceUse {
        v1::ResourceUse { resource: resource.into(), objects: String::new(), scene: scene.into(), held, limit }
    }

    fn client(id: &str, held: Vec<v1::ResourceUse>) -> v1::ClientInfo {
        v1::ClientInfo { id: id.into(), held, age_ms: 60_000, ..v1::ClientInfo::default() }
    }

    #[test]
    fn principals_with_the_largest_share_come_first() {
        let connection = || held("connections", "", 1, 64);
        let streams = vec![held("subscriptions", "tree", 28, 32)];
        let anna = v1::ClientInfo {
            process_name: "python3".into(),
            idle_ms: Some(2_999),
            driven_scenes: vec!["tree".into()],
            ..client("anna/process-4711", streams)
        };
        let owner = v1::ClientInfo { is_caller: true, ..client("owner/process-7", vec![connection()]) };
        let strangers = (0..60).map(|number| client(&format!("anonymous/connection-{number}"), vec![connection()]));
        let resources = vec![held("connections", "", 61, 64), held("subscriptions", "tree", 28, 32)];
        let clients = [anna, owner].into_iter().chain(strangers).collect();
        let lines = text_lines(&v1::ListClientsResponse { clients, omitted: 0, resources }, false);
        let expected = [
            "SHARE  CLIENT                  PEER              FOR  IDLE  HOLDS",
            " 94 %  anonymous/*             60 clients                   60 of 64 connections",
            "  2 %  anonymous/connection-0                  1 min     -  1 of 64 connections",
        ];
        assert_eq!(lines[..3], expected);
        let expected = [
            "       ... 50 more",
            " 88 %  anna/process-4711       python3         1 min   2 s  drives tree, 28 of 32 subscriptions of tree",
            "  2 %  owner/process-7         (this command)  1 min     -  1 of 64 connections",
            "in use: 61 of 64 connections, 28 of 32 subscriptions of tree",
        ];
        assert_eq!(lines[12..], expected);
    }

    #[test]
    fn bytes_have_the_largest_multiple() {
        assert_eq!(describe(&held("stored_bytes", "", 3 << 20, 64 << 30)), "3 Mi of 64 Gi stored bytes");
        assert_eq!(describe(&held("received_bytes", "", 1023, 1 << 20)), "1023 of 1 Mi received bytes");
    }

    #[test]
    fn times_have_the_largest_unit() {
        for (ms, text) in [(999, "0 s"), (59_999, "59 s"), (60_000, "1 min"), (7_200_000, "2 h"), (200_000_000, "2 d")]
        {
            assert_eq!(describe_ms(ms), text);
        }
    }
}
