//! Tests of the device loop with several scenes: large outputs in draw steps (parts of a frame, `partial_output`),
//! cancelled commands and full queues. The loop runs on the thread of the test, one command or draw step at a time, so
//! the order does not depend on times.

use std::sync::Arc;
use std::time::Duration;

use super::command::SceneId;
use super::command_queue::{CommandQueue, MAX_QUEUED_COMMANDS};
use super::context::DeviceContext;
use super::device_loop::DeviceLoop;
use super::device_loss::device_loss_channel;
use super::handle::{DeviceHandle, PendingReply};
use super::watchdog::WorkClock;
use super::work_owners::WorkOwners;
use crate::config::{BackendChoice, Config, RendererChoice};
use crate::engine::output::output_spec::{FrameOutput, PictureContent, PictureSpec};
use crate::engine::output::rendered_picture::{Pixels, RenderedPicture};
use crate::engine::testing;
use modalcast_model::backend_settings::BackendSettings;
use modalcast_model::error::Error;
use modalcast_model::scene::{CameraSource, FrameSize, FrameStyle, Scene, SceneState};

const LARGE: FrameSize = FrameSize::new(192, 512);
const SMALL: FrameSize = FrameSize::new(32, 32);
/// Samples of a band of 64 rows of [`LARGE`], with four samples per pixel. A draw step draws one band at most.
const BAND_SAMPLES: u64 = 4 * 192 * 64;

/// Time of a piece that no output of these tests reaches, so that only the first output of a size has pieces.
const PIECE_MS: f64 = 1e9;
/// Samples of a piece that contains all triangles.
const ALL_SAMPLES: u64 = 1 << 40;

/// A device loop with loaded scenes.
struct Fixture {
    device_loop: DeviceLoop,
    queue: Arc<CommandQueue>,
    handle: DeviceHandle,
    scene: Arc<Scene>,
}

impl Fixture {
    /// Loads the scenes 1 and 2, and draws a frame of each. Outputs of more than `max_band_samples` samples are drawn
    /// in several draw steps.
    async fn start(max_band_samples: u64) -> Self {
        let mut fixture = Self::load(max_band_samples).await;
        for id in [1, 2] {
            fixture.draw_first(id, SMALL).await;
        }
        // The scenes begin with equal shares.
        fixture.queue.reset_costs();
        fixture
    }

    /// Loads the scenes 1 and 2.
    async fn load(max_band_samples: u64) -> Self {
        let config = Config {
            backend: BackendChoice::Reference,
            renderer: RendererChoice::Auto,
            allow_software: true,
            ..Config::default()
        };
        let mut context = DeviceContext::open(&config).expect("expected a renderer");
        context.set_max_band_samples(max_band_samples);
        context.set_piece_limits(PIECE_MS, ALL_SAMPLES);
        let queue = CommandQueue::new();
        let (loss_sender, loss) = device_loss_channel();
        let handle = DeviceHandle::of_queue(&queue, loss);
        let device_loop =
            DeviceLoop::new(context, loss_sender, Arc::clone(&queue), WorkClock::new(), WorkOwners::new(None));
        let device_loop = device_loop.expect("expected a loop");
        let mut fixture = Self { device_loop, queue, handle, scene: testing::two_strips() };
        for id in [1, 2] {
            let (handle, scene) = (fixture.handle.clone(), Arc::clone(&fixture.scene));
            let loaded = tokio::spawn(async move { handle.load_scene(id, &scene, BackendSettings::default()).await });
            while fixture.queue.len(id) == 0 {
                tokio::task::yield_now().await;
            }
            fixture.run(1);
            loaded.await.expect("expected no panic").expect("expected a loaded scene");
        }
        // The scenes begin with equal shares.
        fixture.queue.reset_costs();
        fixture
    }

    fn draw(&self, id: SceneId, size: FrameSize) -> PendingReply<Arc<RenderedPicture>> {
        self.draw_output(id, size, FrameOutput::Color)
    }

    fn draw_output(&self, id: SceneId, size: FrameSize, output: FrameOutput) -> PendingReply<Arc<RenderedPicture>> {
        let camera = CameraSource::framing(&self.scene, size);
        let picture = PictureSpec { camera, size, output, style: FrameStyle::default() };
        self.handle.draw(id, picture, PictureContent::PIXELS)
    }

    /// Draws the first frame of a size, which is drawn in pieces, because its time is not known.
    async fn draw_first(&mut self, id: SceneId, size: FrameSize) {
        let first_frame = self.draw(id, size);
        while self.queue.len(id) > 0 {
            self.run(1);
        }
        first_frame.wait().await.expect("expected a frame");
    }

    /// Runs `count` commands or draw steps.
    fn run(&mut self, count: usize) {
        for _ in 0..count {
            assert!(self.device_loop.run_next());
        }
    }

    /// Runs commands and draw steps until none is queued. Returns their number.
    fn run_all(&mut self) -> usize {
        let mut count = 0;
        while self.queue.len(1) + self.queue.len(2) > 0 {
            self.run(1);
            count += 1;
        }
        // Ends the loop, which answers the frames in flight.
        self.queue.close();
        while self.device_loop.run_next() {}
        count
    }
}

/// The pixels or values of a picture.
async fn bytes_of(picture: PendingReply<Arc<RenderedPicture>>) -> Vec<u8> {
    let picture = picture.wait().await.expect("expected a picture");
    match &picture.pixels {
        Pixels::Color(bytes) | Pixels::Values(bytes) => bytes.to_vec(),
        Pixels::ColorMap(image, _) => image.bytes.clone(),
        Pixels::PngOnly => panic!("expected pixels"),
    }
}

/// Whether a command is answered.
async fn is_answered<T: Clone>(reply: &PendingReply<T>) -> bool {
    tokio::time::timeout(Duration::ZERO, reply.wait()).await.is_ok()
}

/// A state whose first coordinate is `q`.
fn state_with_q(scene: &Scene, q: f32) -> Arc<SceneState> {
    let mut state = SceneState::rest(scene);
    state.q[0] = q;
    Arc::new(state)
}

#[tokio::test]
async fn large_frame_does_not_delay_another_scene() {
    // Negative control: without a limit on a band, the frame is one draw step, for which the other scene waits.
    for (max_band_samples, is_divided) in [(BAND_SAMPLES, true), (u64::MAX, false)] {
        let mut fixture = Fixture::start(max_band_samples).await;
        fixture.draw_first(1, LARGE).await;
        let large = fixture.draw(1, LARGE);
        fixture.run(1);
        let state = state_with_q(&fixture.scene, 0.5);
        let deformed = fixture.handle.deform(2, &state, None);
        let mut waited = 0;
        while !is_answered(&deformed).await {
            fixture.run(1);
            waited += 1;
        }
        assert!((1..=2).contains(&waited), "the other scene waited for {waited} commands and draw steps");
        // Most of the divided frame is drawn after the answer to the other scene.
        let remaining_count = fixture.run_all();
        assert_eq!(remaining_count > 15, is_divided, "{remaining_count} draw steps after the answer");
        assert_eq!(large.wait().await.expect("expected a frame").height, LARGE.height);
    }
}

#[tokio::test]
async fn long_frame_does_not_delay_another_scene() {
    let (mut remaining_counts, mut triangles) = (Vec::new(), 0);
    // Negative control: without a limit on its samples, a piece contains all triangles.
    for piece_samples in [1, ALL_SAMPLES] {
        let mut fixture = Fixture::start(u64::MAX).await;
        // Each frame takes longer than a piece.
        fixture.device_loop.set_piece_limits(0.0, piece_samples);
        let long = fixture.draw(1, SMALL);
        fixture.run(1);
        let deformed = fixture.handle.deform(2, &state_with_q(&fixture.scene, 0.5), None);
        let mut waited = 0;
        while !is_answered(&deformed).await {
            fixture.run(1);
            waited += 1;
        }
        assert!((1..=2).contains(&waited), "the other scene waited for {waited} commands and draw steps");
        remaining_counts.push(fixture.run_all());
        triangles = fixture.scene.layout.triangles;
        long.wait().await.expect("expected a frame");
    }
    // The shadow map is that of the first frame.
    assert_eq!(remaining_counts[0], remaining_counts[1] + triangles - 1, "{triangles} triangles");
}

#[tokio::test]
async fn commands_of_a_scene_wait_for_its_large_outputs() {
    let mut fixture = Fixture::start(u64::MAX).await;
    let [whole, deformed_whole] = [fixture.draw(1, LARGE), {
        fixture.handle.deform(1, &state_with_q(&fixture.scene, 0.5), None);
        fixture.draw(1, LARGE)
    }];
    fixture.run_all();
    let (whole, deformed_whole) = (bytes_of(whole).await, bytes_of(deformed_whole).await);
    assert!(whole != deformed_whole, "expected different frames of different states");

    let mut fixture = Fixture::start(BAND_SAMPLES).await;
    let large = fixture.draw(1, LARGE);
    let deformed = fixture.handle.deform(1, &state_with_q(&fixture.scene, 0.5), None);
    let deformed_large = fixture.draw(1, LARGE);
    while fixture.queue.len(1) > 2 {
        assert!(!is_answered(&deformed).await, "expected the deformation to wait for the frame before it");
        fixture.run(1);
    }
    fixture.run_all();
    assert!(bytes_of(large).await == whole && bytes_of(deformed_large).await == deformed_whole);
}

#[tokio::test]
async fn one_large_output_is_drawn_at_a_time() {
    let mut fixture = Fixture::start(BAND_SAMPLES).await;
    let (first, second) = (fixture.draw(1, LARGE), fixture.draw(2, LARGE));
    fixture.run(1);
    let partial_scene = fixture.device_loop.partial_scene().expect("expected a divided frame");
    let other_scene = if partial_scene == 1 { 2 } else { 1 };
    while fixture.queue.len(partial_scene) > 0 {
        assert_eq!((fixture.queue.len(other_scene), fixture.device_loop.partial_scene()), (1, Some(partial_scene)));
        fixture.run(1);
    }
    fixture.run_all();
    assert!(bytes_of(first).await == bytes_of(second).await);
}

#[tokio::test]
async fn cancelled_command_leaves_a_full_queue_at_once() {
    let mut fixture = Fixture::start(u64::MAX).await;
    let mut draws: Vec<_> = (0..MAX_QUEUED_COMMANDS).map(|_| fixture.draw(1, SMALL)).collect();
    let busy = Error::Busy { queue: "device commands of the scene", limit: MAX_QUEUED_COMMANDS };
    assert_eq!(fixture.draw(1, SMALL).wait().await.expect_err("expected a full queue"), busy);
    // Another scene has a queue of its own.
    draws.push(fixture.draw(2, SMALL));
    drop(draws.remove(7));
    assert_eq!(fixture.queue.len(1), MAX_QUEUED_COMMANDS - 1);
    draws.push(fixture.draw(1, SMALL));
    assert_eq!(fixture.queue.len(1), MAX_QUEUED_COMMANDS);
    // A deformation changes the scene, so it is not cancelled.
    drop(draws.remove(0));
    drop(fixture.handle.deform(1, &state_with_q(&fixture.scene, 0.5), None));
    assert_eq!(fixture.queue.len(1), MAX_QUEUED_COMMANDS);
    let command_count = fixture.run_all();
    assert_eq!(command_count, MAX_QUEUED_COMMANDS + 1);
    for draw in draws {
        draw.wait().await.expect("expected a frame");
    }
}

#[tokio::test]
async fn cancelled_large_output_ends_after_its_draw_step() {
    let mut fixture = Fixture::start(BAND_SAMPLES).await;
    let large = fixture.draw(1, LARGE);
    fixture.run(3);
    drop(large);
    let aov = fixture.draw_output(1, LARGE, FrameOutput::Depth);
    // Ends the frame, and begins the AOV.
    fixture.run(2);
    assert_eq!((fixture.queue.len(1), fixture.device_loop.partial_scene()), (1, Some(1)));
    drop(aov);
    let state = state_with_q(&fixture.scene, 0.5);
    let deformed = fixture.handle.deform(1, &state, None);
    fixture.run(2);
    assert!(is_answered(&deformed).await && fixture.device_loop.partial_scene().is_none());
}

#[tokio::test]
async fn divided_aov_equals_the_undivided_aov() {
    let mut results = Vec::new();
    // An AOV has one sample per pixel. With bands of 64 rows, each of the two AOVs has eight bands.
    for max_band_samples in [u64::MAX, 192 * 64] {
        let mut fixture = Fixture::start(max_band_samples).await;
        let (mut step_count, mut aovs) = (0, Vec::new());
        for output in [FrameOutput::Depth, FrameOutput::Displacement { scale_max: 1.0 }] {
            let aov = fixture.draw_output(1, LARGE, output);
            while fixture.queue.len(1) > 0 {
                fixture.run(1);
                step_count += 1;
            }
            aovs.push(bytes_of(aov).await);
        }
        results.push((step_count, aovs));
    }
    assert!(results[0].0 == 2 && results[1].0 >= 16, "{} and {} commands and draw steps", results[0].0, results[1].0);
    assert!(results[0].1 == results[1].1);
}

/// Drivers compile programs at their first use, so the first frame takes long.
#[tokio::test]
async fn first_frame_of_a_scene_has_several_draw_steps() {
    let mut fixture = Fixture::load(u64::MAX).await;
    for (frame, is_divided) in [("first", true), ("second", false)] {
        let draw = fixture.draw(1, SMALL);
        fixture.run(1);
        assert_eq!(fixture.queue.len(1) > 0, is_divided, "{frame} frame: expected draw steps to remain: {is_divided}");
        let state = state_with_q(&fixture.scene, 0.5);
        let deformed = fixture.handle.deform(2, &state, None);
        while !is_answered(&deformed).await {
            fixture.run(1);
        }
        while fixture.queue.len(1) > 0 {
            fixture.run(1);
        }
        draw.wait().await.expect("expected a frame");
    }
}

#[tokio::test]
async fn scene_is_prepared_in_steps() {
    let mut fixture = Fixture::load(u64::MAX).await;
    let (draw, cancelled_draw) = (fixture.draw(1, SMALL), fixture.draw(1, SMALL));
    fixture.run(1);
    assert_eq!(fixture.queue.len(1), 3, "expected the preparation of programs, and the two frames that need it");
    let deformed = fixture.handle.deform(2, &state_with_q(&fixture.scene, 0.5), None);
    while !is_answered(&deformed).await {
        fixture.run(1);
    }
    assert_eq!(fixture.queue.len(1), 3, "expected an unfinished preparation");
    drop(cancelled_draw);
    assert_eq!(fixture.queue.len(1), 2);
    // Without the two frames, the preparation remains.
    drop(draw);
    assert_eq!(fixture.queue.len(1), 1);
    let draw = fixture.draw(1, SMALL);
    while fixture.queue.len(1) > 0 {
        fixture.run(1);
    }
    draw.wait().await.expect("expected a frame");
    // The other scene uses the same programs, so it needs no preparation: only the frame itself remains queued.
    let draw = fixture.draw(2, SMALL);
    fixture.run(1);
    assert_eq!(fixture.queue.len(2), 1);
    fixture.run_all();
    draw.wait().await.expect("expected a frame");
}
