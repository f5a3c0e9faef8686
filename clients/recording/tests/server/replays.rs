//! Recordings that are replayed: frames, vertices and states equal those of the recorded run.

use std::time::Duration;

use modalcast_client::{
    Client, Delivery, DriveRequest, Frame, Picture, SceneState, Step, VertexRequest, VertexSelection,
};
use modalcast_recording::{
    RecordRequest, Recording, ReplayRequest, Replayed, StepTarget, TimeRange, open_recorded_scene, record, replay,
};
use tokio::sync::Notify;

use crate::harness::{Renderer, Server, far_transform, new_file, record_steps, upload_pair};

const FRAMES: u64 = 9;

fn picture() -> Picture {
    Picture::default().size(96, 64)
}

/// Replays without pacing and returns the frames.
async fn replay_frames(client: &Client, recording: &Recording, request: &ReplayRequest) -> (Replayed, Vec<Frame>) {
    let scene = open_recorded_scene(client, recording, "").await.expect("an open scene");
    assert_eq!(scene.target, StepTarget::RecordedScene);
    let mut frames = Vec::new();
    let on_frame = |replayed: modalcast_recording::ReplayedFrame| {
        frames.push(replayed.frame);
        Ok(())
    };
    let replayed = replay(client, recording, &scene, request, on_frame, std::future::pending()).await;
    (replayed.expect("a replay"), frames)
}

/// The states of a recording, with the run number set to 0, so that two recordings compare equal.
fn states(recording: &Recording) -> Vec<SceneState> {
    let mut reader = recording.states(0, u64::MAX).expect("states");
    let mut list = Vec::new();
    while let Some(recorded) = reader.next().expect("a state") {
        let mut state = (*recorded.state).clone();
        state.step.run = 0;
        list.push(state);
    }
    list
}

#[tokio::test(flavor = "multi_thread")]
async fn frames_of_a_replay_equal_those_of_the_run_bit_for_bit() {
    let live = Server::start().await;
    live.client.open_scene("tree", "").await.expect("the built-in tree");
    let (_folder, path) = new_file("tree.mcap");
    let (recorded, live_frames) = record_steps(&live.client, "tree", &path, FRAMES, Some(picture())).await;
    assert_eq!((recorded.summary.states, recorded.summary.skipped), (FRAMES, 0));
    assert!(recorded.error.is_none(), "{:?}", recorded.error);
    let recording = Recording::open(&path).expect("a recording");
    assert_eq!(recording.metadata("recording", "source"), Some("tree"));
    for key in ["eye", "target", "up", "field_of_view", "antialiasing", "visibility_drawn_by"] {
        assert!(recording.metadata("view", key).is_some_and(|value| !value.is_empty()), "{key}");
    }

    let other = Server::start().await;
    let fast = ReplayRequest { speed: None, pictures: vec![picture()], ..ReplayRequest::default() };
    let (replayed, frames) = replay_frames(&other.client, &recording, &fast).await;
    assert_eq!((replayed.steps, frames.len()), (FRAMES, live_frames.len()));
    for (live, replayed) in live_frames.iter().zip(&frames) {
        assert_eq!(live.step.number, replayed.step.number);
        assert_eq!(live.bytes, replayed.bytes, "step {}", live.step.number);
    }
    assert_ne!(live_frames[2].bytes, frames[3].bytes, "control: expected another frame of another step");

    // A part of the recording begins with the complete state at its start.
    let range = TimeRange { from: 4_000_000_000 / 24 + 1, to: 6_500_000_000 / 24 };
    let (_, part) = replay_frames(&other.client, &recording, &ReplayRequest { range, ..fast }).await;
    let numbers: Vec<u64> = part.iter().map(|frame| frame.step.number).collect();
    assert_eq!(numbers, [4, 5, 6]);
    for frame in part {
        assert_eq!(frame.bytes, live_frames[frame.step.number as usize].bytes, "step {}", frame.step.number);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn recording_of_a_replay_has_the_recorded_states() {
    let server = Server::start_with(Renderer::Off).await;
    let client = &server.client;
    upload_pair(client, "pair", 1.0).await;
    let (folder, path) = new_file("first.mcap");
    record_steps(client, "pair", &path, 200, None).await;
    let recording = Recording::open(&path).expect("a recording");
    assert_eq!(recording.metadata("view", "eye"), None, "expected no view without a renderer");
    let again = [folder.path().join("second.mcap"), folder.path().join("third.mcap")];
    let scene = open_recorded_scene(client, &recording, "").await.expect("the open scene");
    assert_eq!(scene.target, StepTarget::RecordedScene);
    let ready = [Notify::new(), Notify::new()];
    let record_again = |index: usize| {
        let request = RecordRequest { max_states: 200, ..RecordRequest::new("pair") };
        let (path, ready) = (&again[index], &ready[index]);
        async move { record(client, &request, path, || ready.notify_one(), std::future::pending()).await }
    };
    let play = async {
        ready[0].notified().await;
        ready[1].notified().await;
        let request = ReplayRequest { speed: Some(1e3), ..ReplayRequest::default() };
        replay(client, &recording, &scene, &request, |_| Ok(()), std::future::pending()).await
    };
    let (first, second, replayed) = tokio::join!(record_again(0), record_again(1), play);
    assert_eq!(replayed.expect("a replay").steps, 200);
    assert_eq!(first.expect("a recording").summary, second.expect("a recording").summary);
    let read = |path| {
        let recording = Recording::open(path).expect("a recording");
        let mut messages = recording.messages(&[modalcast_recording::Topic::States]);
        std::iter::from_fn(move || messages.next().expect("a message")).collect::<Vec<_>>()
    };
    assert_eq!(read(&again[0]), read(&again[1]), "expected two recordings of a replay to be equal");
    let recording_again = Recording::open(&again[0]).expect("a recording");
    assert_eq!(states(&recording), states(&recording_again));
}

/// The positions of all vertices of the current step, relative to the scene's origin in scene units.
async fn positions(client: &Client, scene: &str) -> Vec<f64> {
    let set = client.get_vertices(&VertexRequest::new(scene, VertexSelection::default())).await.expect("vertices");
    let info = client.describe(scene, &[]).await.expect("a description").info;
    let origin = set.common_origin().expect("one origin");
    let offset = |axis: usize| (origin[axis] - info.origin[axis]) / info.unit;
    set.positions.iter().enumerate().map(|(index, number)| f64::from(*number) + offset(index % 3)).collect()
}

fn largest_difference(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

#[tokio::test(flavor = "multi_thread")]
async fn unknown_scene_is_uploaded_from_the_recording() {
    let live = Server::start_with(Renderer::Off).await;
    upload_pair(&live.client, "pair", 1.0).await;
    let (folder, path) = new_file("pair.mcap");
    record_steps(&live.client, "pair", &path, 20, None).await;
    let live_positions = positions(&live.client, "pair").await;
    let recording = Recording::open(&path).expect("a recording");

    let other = Server::start_with(Renderer::Off).await;
    let scene = open_recorded_scene(&other.client, &recording, "copy").await.expect("an uploaded scene");
    assert_eq!((scene.target, scene.info.scene.as_str()), (StepTarget::UploadedArrays, "copy"));
    let fast = ReplayRequest { speed: None, ..ReplayRequest::default() };
    replay(&other.client, &recording, &scene, &fast, |_| Ok(()), std::future::pending()).await.expect("a replay");
    assert_eq!(live_positions, positions(&other.client, "copy").await);

    // A scene of the same name with other modes is not the recorded one.
    upload_pair(&other.client, "pair", 2.0).await;
    let error = open_recorded_scene(&other.client, &recording, "").await.expect_err("another scene");
    assert_eq!(error.exit_code(), 3, "{error}");

    let by_hash = folder.path().join("hash.mcap");
    let request = RecordRequest { by_hash: true, duration: Some(Duration::ZERO), ..RecordRequest::new("pair") };
    record(&live.client, &request, &by_hash, || (), std::future::pending()).await.expect("a recording");
    let by_hash = Recording::open(by_hash).expect("a recording");
    let known = open_recorded_scene(&live.client, &by_hash, "").await.expect("the open scene");
    assert_eq!(known.target, StepTarget::RecordedScene);
    let error = open_recorded_scene(&other.client, &by_hash, "other").await.expect_err("no contents");
    assert_eq!(error.exit_code(), 5, "{error}");
}

/// Far from the scene's origin, states have other origins than the scene, and their steps have f64 translations.
#[tokio::test(flavor = "multi_thread")]
async fn far_domains_return_to_their_places() {
    let live = Server::start_with(Renderer::Off).await;
    upload_pair(&live.client, "pair", 1.0).await;
    let (_folder, path) = new_file("pair.mcap");
    let request = RecordRequest { max_states: 6, ..RecordRequest::new("pair") };
    let ready = Notify::new();
    let drive = async {
        ready.notified().await;
        let mut stream = live.client.drive(&DriveRequest::new("pair", Delivery::Lossless)).await.expect("a stream");
        for number in 0..6 {
            let far = far_transform(number);
            let step = Step::new(number, 0.0).domain_transform(0, &far).domain_transform(1, &far);
            stream.step(&step.q(0, &[number as f32, 0.5])).await.expect("an accepted step");
        }
        stream.finish().await.expect("acknowledged steps");
    };
    let recorder = record(&live.client, &request, &path, || ready.notify_one(), std::future::pending());
    tokio::join!(recorder, drive).0.expect("a recording");
    let expected = positions(&live.client, "pair").await;
    assert!(expected[0].abs() > 1e7, "control: expected positions far away, got {}", expected[0]);
    let recording = Recording::open(&path).expect("a recording");
    let other = Server::start_with(Renderer::Off).await;
    for (server, name) in [(&live, ""), (&other, "copy")] {
        let scene = open_recorded_scene(&server.client, &recording, name).await.expect("a scene");
        let fast = ReplayRequest { speed: None, ..ReplayRequest::default() };
        replay(&server.client, &recording, &scene, &fast, |_| Ok(()), std::future::pending()).await.expect("a replay");
        let difference = largest_difference(&expected, &positions(&server.client, &scene.info.scene).await);
        // 1.5e-5 of the size of a domain, which is about 4.
        assert!(difference < 6e-5, "{:?}: {difference}", scene.target);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn loops_repeat_the_states_until_they_are_stopped() {
    let server = Server::start().await;
    upload_pair(&server.client, "pair", 1.0).await;
    let (_folder, path) = new_file("pair.mcap");
    record_steps(&server.client, "pair", &path, 4, None).await;
    let recording = Recording::open(&path).expect("a recording");
    let scene = open_recorded_scene(&server.client, &recording, "").await.expect("a scene");
    let request = ReplayRequest { speed: None, repeats: true, pictures: vec![picture()], ..ReplayRequest::default() };
    let (stop, mut frames) = (Notify::new(), Vec::new());
    let on_frame = |replayed: modalcast_recording::ReplayedFrame| {
        frames.push(replayed.frame);
        if frames.len() == 10 {
            stop.notify_one();
        }
        Ok(())
    };
    let replayed = replay(&server.client, &recording, &scene, &request, on_frame, stop.notified()).await;
    let steps = replayed.expect("a replay").steps;
    assert!(steps >= 10 && frames.len() as u64 == steps, "{steps} steps, {} frames", frames.len());
    for (index, frame) in frames.iter().enumerate().take(10) {
        assert_eq!((frame.step.number, &frame.bytes), (index as u64, &frames[index % 4].bytes));
    }
    assert_ne!(frames[0].bytes, frames[1].bytes, "control: expected another frame of another state");
}

#[tokio::test(flavor = "multi_thread")]
async fn selected_frames_show_the_current_state() {
    let server = Server::start().await;
    upload_pair(&server.client, "pair", 1.0).await;
    let (_folder, path) = new_file("pair.mcap");
    record_steps(&server.client, "pair", &path, 10, None).await;
    let recording = Recording::open(&path).expect("a recording");
    let scene = open_recorded_scene(&server.client, &recording, "").await.expect("a scene");
    // States at 24 Hz, frames at 10, 48 and 50 Hz. Step n is current from n / 24 s on.
    for (rate, expected) in [
        (10.0, vec![(0, 1), (2, 1), (4, 1), (7, 1)]),
        (48.0, vec![(0, 2), (1, 2), (2, 2), (3, 2), (4, 2), (5, 2), (6, 2), (7, 2), (8, 2), (9, 1)]),
        (50.0, vec![(0, 3), (1, 2), (2, 2), (3, 2), (4, 2), (5, 2), (6, 2), (7, 2), (8, 2)]),
    ] {
        let request = ReplayRequest {
            speed: None,
            pictures: vec![picture()],
            frame_rate: Some(rate),
            ..ReplayRequest::default()
        };
        let mut shown = Vec::new();
        let on_frame = |replayed: modalcast_recording::ReplayedFrame| {
            shown.push((replayed.frame.step.number, replayed.repeats));
            Ok(())
        };
        replay(&server.client, &recording, &scene, &request, on_frame, std::future::pending()).await.expect("a replay");
        assert_eq!(shown[..expected.len()], expected, "{rate} Hz");
    }
}
