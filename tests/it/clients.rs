//! Administrators list the clients of a server with what they hold, and end them.

use modalcast::config::Config;
use modalcast::identity::Role;
use modalcast_client::{Client, ConnectOptions, Error, Reason};
use modalcast_proto::v1;
use tokio_stream::wrappers::ReceiverStream;
use tonic::transport::Channel;
use tonic::{Code, Status, Streaming};
use v1::Delivery;
use v1::state_service_client::StateServiceClient;

use crate::identity::{GuardedServer, token_of_name, with_token, write_named_principals};
use crate::service_harness::{StepWriter, rejection_details, with_timeout};

const SCENE: &str = "strips";

/// `root` opens the scene and shares it with the others.
const PRINCIPALS: [(&str, Role); 3] = [("root", Role::Admin), ("anna", Role::Drive), ("ben", Role::Upload)];

/// A server with eight streams per scene, of which one client may have seven.
async fn start() -> GuardedServer {
    let guarded = GuardedServer::start_with(|config| {
        let path = config.principals.as_deref().expect("expected a file of principals");
        write_named_principals(path, &PRINCIPALS);
        Config { max_subscribers: 8, ..config }
    })
    .await;
    let root = client(&guarded, "root").await;
    root.open_scene(SCENE, "").await.expect("expected a scene");
    root.share_scene(SCENE, &["*"]).await.expect("expected a shared scene");
    guarded
}

async fn client(guarded: &GuardedServer, name: &str) -> Client {
    let options = ConnectOptions::default().with_token(token_of_name(name));
    Client::connect_with(&guarded.server.address, &options).await.expect("expected a connection")
}

type States = Streaming<v1::StreamStatesResponse>;

async fn subscribe(channel: &Channel, name: &str) -> Result<States, Status> {
    let delivery = Delivery::Latest.into();
    let request = v1::StreamStatesRequest { scene: SCENE.into(), delivery, ..Default::default() };
    let request = with_token(request, Some(&token_of_name(name)));
    let mut stream = StateServiceClient::new(channel.clone()).stream_states(request).await?.into_inner();
    // The first message has the settings.
    with_timeout(stream.message()).await?;
    Ok(stream)
}

/// The error at the end of a stream.
async fn end_of(mut stream: States) -> Status {
    loop {
        match with_timeout(stream.message()).await {
            Ok(message) => assert!(message.is_some(), "expected an error at the end of the stream"),
            Err(status) => return status,
        }
    }
}

async fn list(admin: &Client) -> Vec<v1::ClientInfo> {
    let list = admin.list_clients().await.expect("expected the rights of an administrator");
    assert_eq!(list.omitted, 0);
    list.clients
}

/// The only client of a principal.
fn client_of<'a>(clients: &'a [v1::ClientInfo], principal: &str) -> Option<&'a v1::ClientInfo> {
    let mut of_principal = clients.iter().filter(|client| client.principal == principal);
    let client = of_principal.next();
    assert!(of_principal.next().is_none(), "expected one client of {principal}: {clients:?}");
    client
}

/// What a client holds of a resource.
fn held(client: &v1::ClientInfo, resource: &str) -> u64 {
    client.held.iter().filter(|held| held.resource == resource).map(|held| held.held).sum()
}

fn reason_of<T: std::fmt::Debug>(result: Result<T, Error>) -> Option<Reason> {
    result.expect_err("expected an error").rejection().map(|rejection| rejection.reason)
}

#[tokio::test(flavor = "multi_thread")]
async fn admin_finds_and_ends_the_client_that_fills_a_scene() {
    let guarded = start().await;
    let greedy = guarded.channel().await;
    let mut of_anna = Vec::new();
    for _ in 0..7 {
        of_anna.push(subscribe(&greedy, "anna").await.expect("expected a stream"));
    }
    let (sender, requests) = tokio::sync::mpsc::channel(4);
    let token = token_of_name("anna");
    let mut writer =
        StepWriter::connect_with(greedy.clone(), |_| with_token(ReceiverStream::new(requests), Some(&token))).await;
    let open = v1::OpenDrive { scene: SCENE.into(), delivery: Delivery::Latest.into(), ..Default::default() };
    let kind = Some(v1::drive_scene_request::Kind::Open(open));
    sender.send(v1::DriveSceneRequest { kind }).await.expect("expected an open stream");
    writer.receive_reply().await;
    let mut of_ben = subscribe(&guarded.channel().await, "ben").await.expect("expected a stream");

    let admin = client(&guarded, "root").await;
    let clients = list(&admin).await;
    let [first, ..] = &clients[..] else { panic!("expected clients") };
    assert_eq!((first.principal.as_str(), first.kind()), ("anna", v1::ClientKind::Connection));
    assert!(first.id.starts_with("anna/connection-") && first.address.starts_with("127.0.0.1:"), "{first:?}");
    assert_eq!((held(first, "subscriptions"), held(first, "connections")), (7, 1));
    assert_eq!(first.held.iter().find(|held| held.resource == "subscriptions").map(|held| held.limit), Some(8));
    assert_eq!(first.driven_scenes, [SCENE]);
    assert!(first.idle_ms.is_some_and(|idle| idle <= first.age_ms), "{first:?}");
    let ben = client_of(&clients, "ben").expect("expected ben");
    assert_eq!(held(ben, "subscriptions"), 1);
    let scene = admin.list_scenes().await.expect("expected a list").scenes.remove(0);
    assert_eq!((scene.writer.as_str(), scene.streams), ("anna", 8));
    assert!(clients.iter().any(|client| client.is_caller && client.principal == "root"), "{clients:?}");

    let ended = admin.end_client(&first.id).await.expect("expected the end of the client");
    assert_eq!((&ended.ids, ended.ended), (&vec![first.id.clone()], 8));
    for stream in of_anna {
        let status = end_of(stream).await;
        assert_eq!(
            (status.code(), rejection_details(&status).reason()),
            (Code::ResourceExhausted, v1::Reason::EndedByAdministrator)
        );
    }
    let status = with_timeout(writer.replies.message()).await.expect_err("expected the end of the drive");
    assert_eq!(rejection_details(&status).reason(), v1::Reason::EndedByAdministrator);
    let clients = list(&admin).await;
    assert_eq!(client_of(&clients, "anna"), None, "expected an ended client to be unlisted");
    assert_eq!(client_of(&clients, "ben").map(|ben| held(ben, "subscriptions")), Some(1));
    assert_eq!(reason_of(admin.end_client(&first.id).await), Some(Reason::InvalidField));
    let next = tokio::time::timeout(std::time::Duration::from_millis(200), of_ben.message()).await;
    assert!(next.is_err() || next.is_ok_and(|message| message.is_ok()), "expected the stream of ben to continue");

    // The scene is open and free, and anna may come again.
    guarded.server.engine.find(SCENE).expect("expected an open scene");
    let is_free = async {
        while !guarded.server.engine.driven_scenes().is_empty() {
            tokio::time::sleep(std::time::Duration::from_millis(10)).await;
        }
    };
    with_timeout(is_free).await;
    subscribe(&guarded.channel().await, "anna").await.expect("expected a stream of a new connection");
}

#[tokio::test(flavor = "multi_thread")]
async fn others_than_admins_neither_list_nor_end_clients() {
    let guarded = start().await;
    let stream = subscribe(&guarded.channel().await, "anna").await.expect("expected a stream");
    let admin = client(&guarded, "root").await;
    let id = client_of(&list(&admin).await, "anna").expect("expected anna").id.clone();
    let ben = client(&guarded, "ben").await;
    assert_eq!(reason_of(ben.list_clients().await), Some(Reason::PermissionDenied));
    assert_eq!(reason_of(ben.end_client(&id).await), Some(Reason::PermissionDenied));
    assert!(client_of(&list(&admin).await, "anna").is_some());
    // Control: an administrator ends it.
    admin.end_client(&id).await.expect("expected the end of the client");
    assert_eq!(rejection_details(&end_of(stream).await).reason(), v1::Reason::EndedByAdministrator);
}

#[tokio::test(flavor = "multi_thread")]
async fn clients_of_a_principal_end_together_except_the_caller() {
    let guarded = start().await;
    let (admin, second) = (client(&guarded, "root").await, client(&guarded, "root").await);
    let mut streams = Vec::new();
    for _ in 0..3 {
        streams.push(subscribe(&guarded.channel().await, "root").await.expect("expected a stream"));
    }
    let ended = admin.end_client("root/*").await.expect("expected the end of the other clients");
    assert!(ended.ids.len() >= 4, "{ended:?}");
    for stream in streams {
        assert_eq!(rejection_details(&end_of(stream).await).reason(), v1::Reason::EndedByAdministrator);
    }
    let clients = list(&admin).await;
    let of_root: Vec<_> = clients.iter().filter(|client| held(client, "connections") > 0).collect();
    assert!(of_root.len() == 1 && of_root[0].is_caller, "{clients:?}");
    // The client that has opened the scene is known as long as the scene is open.
    assert_eq!(admin.end_client("root/*").await.expect("expected the holder of the scene").ended, 0);
    for id in ["", "*", "/*", "root", "root/", "nobody/*", "root/connection-999999"] {
        assert_eq!(reason_of(admin.end_client(id).await), Some(Reason::InvalidField), "{id}");
    }
    // The caller ends by its own id.
    let own = of_root[0].id.clone();
    let result = admin.end_client(&own).await;
    assert!(result.is_ok() || reason_of(result) == Some(Reason::EndedByAdministrator));
    drop(second);
}

#[tokio::test(flavor = "multi_thread")]
async fn client_of_a_socket_is_its_process() {
    let guarded = start().await;
    let owner = Client::connect(&format!("unix:{}", guarded.socket().display())).await.expect("expected a connection");
    owner.open_scene(SCENE, "of-owner").await.expect("expected a scene");
    let clients = list(&owner).await;
    let own = clients.iter().find(|client| client.is_caller).expect("expected the own client");
    assert_eq!(
        (own.id.clone(), own.kind()),
        (format!("owner/process-{}", std::process::id()), v1::ClientKind::Process)
    );
    assert_eq!((own.process_id, own.address.as_str()), (std::process::id(), ""));
    assert!(!own.process_name.is_empty());
    assert_eq!(held(own, "open_scenes"), 1);
    // Its scene counts to the process after its connection has ended.
    drop(owner);
    let admin = client(&guarded, "root").await;
    let is_disconnected = async {
        loop {
            let clients = list(&admin).await;
            let former = client_of(&clients, "owner").expect("expected the holder of a scene").clone();
            if held(&former, "connections") == 0 {
                return former;
            }
            tokio::time::sleep(std::time::Duration::from_millis(20)).await;
        }
    };
    let former = with_timeout(is_disconnected).await;
    assert_eq!((held(&former, "open_scenes"), former.process_name.as_str()), (1, ""));
    let ended = admin.end_client(&former.id).await.expect("expected a known client");
    assert_eq!(ended.ended, 0, "expected that scenes do not end");
    guarded.server.engine.find("of-owner").expect("expected an open scene");
}
