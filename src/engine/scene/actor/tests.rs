//! Tests of the actor with a device whose commands the test answers.

use std::time::Duration;

use tokio::time::timeout;

use super::super::delivery::Delivery;
use super::super::handle::{OpenParams, SceneHandle, WriterSession};
use super::super::subscriber::Subscription;
use super::*;
use crate::admission::Account;
use crate::config::Config;
use crate::engine::device::command::Command;
use crate::engine::memory_limits::MemoryLimits;
use crate::engine::output::output_spec::{FrameOutput, OutputSpec, PictureSpec};
use crate::engine::output::step_output::{OutputBody, SharedPicture};
use crate::engine::scene_memory::MemoryBudgets;
use crate::engine::storage::file_system::{DiskFileSystem, FileSystem};
use crate::engine::storage::provenance::SceneProvenance;
use crate::engine::storage::scene_record::SceneAccess;
use crate::engine::testing;
use crate::hang_guard::HANG_GUARD;
use crate::identity::Principal;
use modalcast_model::scene::{BoundingBox, CameraSource, DirtyDomains, FrameSize, FrameStyle, RawStepUpdate};
use modalcast_render::{FrameImage, FrameInfo, FramePixels, FrameTimes};

/// Wait for a command that must not arrive.
const SHORT_WAIT: Duration = Duration::from_millis(500);

/// An open scene, its device and its folder.
struct TestScene {
    handle: SceneHandle,
    commands: mpsc::Receiver<Command>,
    _folder: tempfile::TempDir,
}

impl TestScene {
    async fn open() -> Self {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let disk: Arc<dyn FileSystem> = Arc::new(DiskFileSystem);
        let config = Config::default();
        let memory = MemoryBudgets::new(MemoryLimits::new(&config, None), true).new_scene("anna");
        let (device, mut commands) = DeviceHandle::mock();
        let services = SceneServices {
            device,
            checkpoints: Arc::new(CheckpointStore::without_thread(folder.path().into(), &disk)),
            run_counter: Arc::new(RunCounter::open(folder.path(), &disk).expect("expected a new counter")),
            config: Arc::new(config.validated().expect("expected valid defaults")),
            admission: Admission::default(),
        };
        let params = OpenParams {
            name: "strips".into(),
            provenance: SceneProvenance::Repository { source: "strips".into() },
            access: Arc::new(watch::Sender::new(SceneAccess::new(&Principal::owner()))),
            scene: testing::two_strips(),
            backends: Default::default(),
            id: 1,
            on_failure: Box::new(|| {}),
            state: None,
            frames_unavailable: None,
            memory,
        };
        let load = async {
            match commands.recv().await {
                Some(Command::LoadScene { reply, .. }) => assert!(reply.send(Ok(())), "expected a caller that waits"),
                _ => panic!("expected the command that loads the scene"),
            }
        };
        let (handle, ()) = tokio::join!(SceneHandle::open(params, services), load);
        Self { handle: handle.expect("expected an open scene"), commands, _folder: folder }
    }

    /// Subscribes to frames of one view.
    async fn subscribe(&self, delivery: Delivery) -> Subscription {
        let picture = PictureSpec {
            camera: CameraSource::framing(&testing::two_strips(), FrameSize::new(16, 8)),
            size: FrameSize::new(16, 8),
            output: FrameOutput::Color,
            style: FrameStyle::default(),
        };
        self.handle
            .subscribe(&Account::server(), OutputSpec::Frames([picture].into()), delivery)
            .await
            .expect("expected a subscription")
    }

    async fn next_command(&mut self) -> Command {
        timeout(HANG_GUARD, self.commands.recv()).await.expect("expected a command").expect("expected a scene")
    }

    async fn deform(&mut self) {
        let Command::Deform { reply, .. } = self.next_command().await else { panic!("expected a step") };
        let summary = DeformSummary { bounds: BoundingBox::EMPTY, oriented_bounds: None, ms: 0.0 };
        assert!(reply.send(Ok(summary)), "expected a caller that waits");
    }

    /// Takes the next command, which must draw a frame. Calling the result answers it.
    async fn draw(&mut self) -> impl FnOnce() {
        let Command::Draw { picture, reply, .. } = self.next_command().await else { panic!("expected a frame") };
        let (rgba, times, info) = (FramePixels::from(vec![]), FrameTimes::default(), FrameInfo::default());
        let image = FrameImage { width: picture.size.width, height: picture.size.height, rgba, times, info };
        move || assert!(reply.send(Ok(Arc::new(image.into()))), "expected a caller that waits")
    }

    /// Whether a frame is drawn although none is expected.
    async fn draws_again(&mut self) -> bool {
        matches!(timeout(SHORT_WAIT, self.commands.recv()).await, Ok(Some(Command::Draw { .. })))
    }
}

async fn push_step(writer: &mut WriterSession, number: u64) {
    writer.push_step(RawStepUpdate { number, ..RawStepUpdate::default() }).await.expect("expected capacity");
}

/// The picture of the next step, which may not be drawn yet.
async fn next_picture(subscription: &mut Subscription) -> SharedPicture {
    let output = timeout(HANG_GUARD, subscription.next()).await.expect("expected a result").expect("expected no error");
    let OutputBody::Frames(frames) = &output.body else { panic!("expected frames") };
    Arc::clone(&frames.pictures[0])
}

/// Waits for the picture of the next step, and returns the number of the step.
async fn receive(subscription: &mut Subscription) -> u64 {
    let receive = async {
        let output = subscription.next().await.expect("expected no error");
        let OutputBody::Frames(frames) = &output.body else { panic!("expected frames") };
        frames.pictures[0].wait().await.expect("expected a picture");
        output.step.number
    };
    timeout(HANG_GUARD, receive).await.expect("expected a frame")
}

/// A lossless subscriber blocks the step until it reads an earlier frame, while the other subscriber's frame of this
/// step is in flight.
#[tokio::test]
async fn credit_during_back_pressure_shares_the_frame_in_flight() {
    let mut scene = TestScene::open().await;
    let mut first = scene.subscribe(Delivery::Lossless).await;
    let mut second = scene.subscribe(Delivery::Lossless).await;
    let mut writer = scene.handle.drive("test", testing::lossless_lease(8)).await.expect("expected the lease");
    for number in 1..=2 {
        push_step(&mut writer, number).await;
        scene.deform().await;
        let finish = scene.draw().await;
        finish();
        assert_eq!(receive(&mut first).await, number);
    }
    push_step(&mut writer, 3).await;
    scene.deform().await;
    let finish = scene.draw().await;
    assert_eq!(receive(&mut second).await, 1);
    // The actor runs until it waits for the frame.
    tokio::time::sleep(SHORT_WAIT).await;
    finish();
    assert!(!scene.draws_again().await, "expected one frame for both");
    assert_eq!(receive(&mut first).await, 3);
    assert_eq!([receive(&mut second).await, receive(&mut second).await], [2, 3]);
}

/// A subscriber to the latest step receives its credit while no step is queued and the frame of another subscriber is in
/// flight.
#[tokio::test]
async fn credit_without_a_queued_step_shares_the_frame_in_flight() {
    let mut scene = TestScene::open().await;
    let mut first = scene.subscribe(Delivery::Lossless).await;
    let mut second = scene.subscribe(Delivery::Latest).await;
    let mut writer = scene.handle.drive("test", testing::lossless_lease(8)).await.expect("expected the lease");
    push_step(&mut writer, 1).await;
    scene.deform().await;
    let finish = scene.draw().await;
    // Polling grants the credit. The result is there before its picture.
    let second_picture = next_picture(&mut second).await;
    finish();
    assert!(!scene.draws_again().await, "expected one frame for both");
    assert!(Arc::ptr_eq(&next_picture(&mut first).await, &second_picture));
}

/// A restored state has the serial number of the rest state. Only the list of changed domains tells the two apart.
#[test]
fn step_from_rest_changes_every_domain() {
    let scene = testing::two_strips();
    let mut restored_state = SceneState::rest(&scene);
    restored_state.q[0] = 0.5;
    let q = vec![0; 4 * scene.layout.domains[1].rank].into();
    let raw = RawStepUpdate { number: 1, q_domains: vec![1], q, ..RawStepUpdate::default() };
    let update = StepUpdate::parse(&scene, &raw).expect("expected a valid step");
    let from_rest = state_from_rest(&scene, &restored_state, 1, &update);
    let from_restored = StatePool::default().apply(&scene, &Arc::new(restored_state.clone()), 1, &update);
    for (state, first_q, dirty_domains) in
        [(&from_rest, 0.0, DirtyDomains::All), (&*from_restored, 0.5, DirtyDomains::Some(vec![1]))]
    {
        assert_eq!((state.q[0], &state.dirty_domains), (first_q, &dirty_domains));
        assert!(state.serial > restored_state.serial);
    }
}
