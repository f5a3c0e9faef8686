//! Clients share the open scenes, and the streams and waiting requests of a scene: one client leaves some for others, and a client without any gets one in any case.

use modalcast::admission::Client;
use modalcast::config::Config;
use modalcast::identity::{Principal, Role};
use modalcast_proto::v1;
use tokio::task::JoinSet;
use tonic::transport::Channel;
use tonic::{Code, Status, Streaming};
use tonic_types::StatusExt as _;
use v1::scene_service_client::SceneServiceClient;
use v1::state_service_client::StateServiceClient;
use v1::{Delivery, Reason};

use crate::service_harness::{Server, minimum_step, rejection_details, step, with_timeout};

type States = Streaming<v1::StreamStatesResponse>;

async fn subscribe(channel: &Channel) -> Result<States, Status> {
    let delivery = Delivery::Latest.into();
    let request = v1::StreamStatesRequest { scene: "strips".into(), delivery, ..Default::default() };
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

fn assert_preempted(status: &Status, object: &str, held: usize, limit: usize) {
    assert_eq!((status.code(), rejection_details(status).reason()), (Code::ResourceExhausted, Reason::Preempted));
    let metadata = status.get_details_error_info().expect("expected an ErrorInfo").metadata;
    assert_eq!((metadata["held"].clone(), metadata["limit"].clone()), (held.to_string(), limit.to_string()));
    assert_eq!(metadata["object"], object);
}

fn reason_of<T>(result: Result<T, Status>) -> Reason {
    rejection_details(&result.err().expect("expected an error")).reason()
}

#[tokio::test(flavor = "multi_thread")]
async fn streams_of_a_scene_are_shared_between_clients() {
    let server = Server::start_with(|config| Config { max_subscribers: 8, ..config }).await;
    server.open("strips").await;
    let mut writer = server.drive_lossless("strips").await;
    let greedy = server.channel().await;
    let mut of_greedy = Vec::new();
    for _ in 0..7 {
        of_greedy.push(subscribe(&greedy).await.expect("expected a stream"));
    }
    assert_eq!(reason_of(subscribe(&greedy).await), Reason::LimitReached, "expected one stream for others");
    let mut streams = Vec::new();
    for count in 1..=4 {
        streams.push(subscribe(&server.channel().await).await.expect("expected a stream"));
        // The first of these clients gets the stream that was left.
        assert_eq!(server.preempted("subscriptions"), count - 1);
    }
    let object = "frame, vertex and state streams of one scene";
    for (held, stream) in [7, 6, 5].into_iter().zip(of_greedy.drain(..3)) {
        assert_preempted(&end_of(stream).await, object, held, 8);
    }
    // The streams of the others, and those that are left, receive the next step.
    writer.send_step_and_wait(step(1, &[0], &[0.1, 0.2])).await;
    for stream in streams.iter_mut().chain(&mut of_greedy) {
        with_timeout(stream.message()).await.expect("expected no error").expect("expected a state");
    }
}

/// A request that waits for a step that is never sent.
async fn wait_for_step(channel: &Channel) -> Status {
    let request = v1::GetStateRequest { scene: "strips".into(), step: minimum_step(99), ..Default::default() };
    let mut stream = StateServiceClient::new(channel.clone()).get_state(request).await.expect("a stream").into_inner();
    with_timeout(stream.message()).await.expect_err("expected an error")
}

#[tokio::test(flavor = "multi_thread")]
async fn waiting_requests_of_a_scene_are_shared_between_clients() {
    let server = Server::start_with(|config| Config { max_pending_requests: 8, ..config }).await;
    server.open("strips").await;
    let greedy = server.channel().await;
    let mut of_greedy = JoinSet::new();
    for _ in 0..8 {
        let channel = greedy.clone();
        of_greedy.spawn(async move { wait_for_step(&channel).await });
    }
    let refused = with_timeout(of_greedy.join_next()).await.expect("a task").expect("expected no panic");
    assert_eq!(rejection_details(&refused).reason(), Reason::QueueFull, "expected one request for others");
    let mut others = JoinSet::new();
    for count in 1..=4 {
        let channel = server.channel().await;
        others.spawn(async move { wait_for_step(&channel).await });
        while server.preempted("waiting_requests") < count - 1 {
            tokio::task::yield_now().await;
        }
    }
    let mut ends = Vec::new();
    for _ in 0..3 {
        ends.push(with_timeout(of_greedy.join_next()).await.expect("a task").expect("expected no panic"));
    }
    ends.sort_by_key(|status| status.message().to_owned());
    for (status, held) in ends.iter().zip([5, 6, 7]) {
        assert_preempted(status, "requests that wait for a step of one scene", held, 8);
    }
    // A client without a request is answered while all permits are taken.
    let request = v1::GetStateRequest { scene: "strips".into(), ..Default::default() };
    let mut states = StateServiceClient::new(server.channel().await);
    let mut reply = states.get_state(request).await.expect("expected a stream").into_inner();
    with_timeout(reply.message()).await.expect("expected no error").expect("expected a state");
    assert!(others.try_join_next().is_none(), "expected the other clients to wait");
}

/// Scenes do not end for other clients. One client leaves some, and another principal gets one in any case.
#[tokio::test(flavor = "multi_thread")]
async fn open_scenes_are_shared_between_clients() {
    let server = Server::start_with(|config| Config { open_scenes: 8, ..config }).await;
    let open = async |channel: &Channel, scene: String| {
        let request = v1::OpenSceneRequest { source: "strips".into(), scene };
        with_timeout(SceneServiceClient::new(channel.clone()).open_scene(request)).await.map(drop)
    };
    let greedy = server.channel().await;
    for number in 0..6 {
        open(&greedy, format!("a{number}")).await.expect("expected a scene");
    }
    assert_eq!(reason_of(open(&greedy, "a6".into()).await), Reason::LimitReached);
    open(&server.channel().await, "b".into()).await.expect("expected a scene of a new client");
    let anna = Principal { name: "anna".into(), role: Role::Drive };
    assert_eq!(reason_of(open(&server.channel().await, "c".into()).await), Reason::LimitReached);
    server.engine.open("strips", "d", &anna, Client::Server).await.expect("expected a scene of another principal");
    for name in ["a0", "b", "d"] {
        assert!(server.engine.find(name).is_ok(), "expected '{name}' to stay open");
    }
    // The scene of a client counts until it is closed.
    let request = v1::DeleteSceneRequest { scene: "a0".into() };
    SceneServiceClient::new(greedy.clone()).delete_scene(request).await.expect("expected a closed scene");
    open(&server.channel().await, "e".into()).await.expect_err("expected the last scene to be left for principals");
    let request = v1::DeleteSceneRequest { scene: "a1".into() };
    SceneServiceClient::new(greedy.clone()).delete_scene(request).await.expect("expected a closed scene");
    open(&server.channel().await, "e".into()).await.expect("expected a scene of a new client");
}

/// An upload that begins and does not go on. Returns its error.
async fn begin_upload(channel: Channel, scene: String) -> Status {
    let header = v1::UploadHeader { scene, files: 1, total_bytes: 10, ..Default::default() };
    let part = v1::UploadSceneRequest { part: Some(v1::upload_scene_request::Part::Header(header)) };
    let parts = tokio_stream::StreamExt::chain(tokio_stream::once(part), tokio_stream::pending());
    SceneServiceClient::new(channel).upload_scene(parts).await.expect_err("expected an upload without an end")
}

/// A client with as many uploads as it can have leaves some for others, and loses one when there are none left.
#[tokio::test(flavor = "multi_thread")]
async fn uploads_are_shared_between_clients() {
    let server = Server::start_with(|config| config).await;
    let (mut of_greedy, mut of_others) = (JoinSet::new(), JoinSet::new());
    let greedy = server.channel().await;
    for number in 0..29 {
        of_greedy.spawn(begin_upload(greedy.clone(), format!("a{number}")));
    }
    let refused = with_timeout(of_greedy.join_next()).await.expect("a task").expect("expected no panic");
    assert_eq!(rejection_details(&refused).reason(), Reason::LimitReached, "expected 28 uploads of one client");
    for number in 0..5 {
        of_others.spawn(begin_upload(server.channel().await, format!("b{number}")));
    }
    let ended = with_timeout(of_greedy.join_next()).await.expect("a task").expect("expected no panic");
    assert_preempted(&ended, "uploads in progress", 28, 32);
    assert_eq!(server.preempted("uploads"), 1);
    assert_eq!((of_greedy.len(), of_others.len()), (27, 5));
    assert!(of_others.try_join_next().is_none() && of_greedy.try_join_next().is_none());
}
