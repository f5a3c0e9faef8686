//! Tests with a device whose commands the test answers.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{mpsc, oneshot};
use tokio::time::timeout;

use super::super::message::StepSelector;
use super::super::subscriber::Subscription;
use super::*;
use crate::engine::device::command::{Command, CopiedVertices, Reply};
use crate::engine::output::step_output::{FrameOutput, OutputBody, OutputSpec, PictureSpec, StepOutput};
use crate::engine::testing;
use crate::hang_guard::HANG_GUARD;
use modalcast_model::scene::{Camera, FrameSize, FrameStyle, SceneState};
use modalcast_render::{FrameImage, FrameInfo, FramePixels, MAX_FRAMES_IN_FLIGHT};

const WITHOUT_NEXT_STEP: DeliveryMode = DeliveryMode { applies_back_pressure: false, overlaps_next_step: false };
const WITH_NEXT_STEP: DeliveryMode = DeliveryMode { overlaps_next_step: true, ..WITHOUT_NEXT_STEP };

/// A frame that a subscriber of a test has received.
#[derive(Debug, PartialEq)]
struct ReceivedFrame {
    width: u32,
    step: u64,
}

/// A frame that was requested from the device.
struct DrawRequest {
    width: u32,
    reply: Reply<FrameImage<FramePixels>>,
}

/// Creates the delivery of a scene to some subscribers, and the receiver of its device commands.
fn delivery_to(subscribers: Vec<Subscriber>) -> (OutputDelivery, mpsc::Receiver<Command>) {
    let (device, commands) = DeviceHandle::mock();
    let scene = SceneOnDevice { name: "strips".into(), id: 1, scene: testing::two_strips() };
    let delivery = OutputDelivery::new(scene, device, &Config::default());
    (OutputDelivery { subscribers, ..delivery }, commands)
}

/// A current step. `number` is both its step number and the scene's step count.
fn current_step(number: u64) -> CurrentStep {
    let state = SceneState { run: 1, step: number, ..SceneState::rest(&testing::two_strips()) };
    CurrentStep { state: Arc::new(state), step_count: number, stages: Vec::new() }
}

/// Subscribes to frames of this width in pixels.
fn subscribe(delivery: Delivery, width: u32) -> (Subscriber, Subscription) {
    subscribe_with(delivery, width, &Arc::default())
}

/// Subscribes to frames of this width in pixels. Credits notify `wake`.
fn subscribe_with(delivery: Delivery, width: u32, wake: &Arc<Notify>) -> (Subscriber, Subscription) {
    let camera = Camera::fit_to_scene(&testing::two_strips(), width, 8);
    Subscription::new(
        OutputSpec::Frames(
            [PictureSpec {
                camera,
                size: FrameSize::new(width, 8),
                output: FrameOutput::Color,
                style: FrameStyle::default(),
            }]
            .into(),
        ),
        delivery.into(),
        Arc::clone(wake),
    )
}

/// Wait for a request that must not arrive.
const SHORT_WAIT: Duration = Duration::from_millis(500);

/// Returns the next frame that is requested from the device within `limit`.
async fn next_draw_request(device: &mut mpsc::Receiver<Command>, limit: Duration) -> Option<DrawRequest> {
    match timeout(limit, device.recv()).await.ok()?? {
        Command::Draw { size, reply, .. } => Some(DrawRequest { width: size.width, reply }),
        _ => None,
    }
}

fn answer(DrawRequest { width, reply }: DrawRequest) {
    reply
        .send(Ok(FrameImage {
            width,
            height: 8,
            rgba: vec![].into(),
            times: modalcast_render::FrameTimes::default(),
            info: FrameInfo::default(),
        }))
        .expect("expected a caller that waits");
}

/// Outcome of [`serve_slow_and_fast`].
struct ServedFrames {
    /// Width of the frame that is requested while the first frame is still in flight.
    early_frame_width: Option<u32>,
    /// First the frames of the slow subscriber, then the frames of the fast subscriber.
    received: Vec<ReceivedFrame>,
}

/// Delivers the second step to a slow subscriber (width 16) and to a fast one (width 24). The slow one waits for
/// its frame of the first step, and the fast one has credits.
async fn serve_slow_and_fast(slow_delivery: Delivery) -> ServedFrames {
    let (slow_subscriber, mut slow_subscription) = subscribe(slow_delivery, 16);
    let (fast_subscriber, mut fast_subscription) = subscribe(Delivery::Lossless, 24);
    // Polling grants a `Latest` subscription one credit. A lossless subscription has credits from the start.
    timeout(Duration::ZERO, slow_subscription.next()).await.expect_err("expected no frame yet");
    let (mut delivery, mut device) = delivery_to(vec![slow_subscriber]);
    delivery.serve_subscribers(&current_step(1), WITH_NEXT_STEP).await;
    let first_request = next_draw_request(&mut device, HANG_GUARD).await.expect("expected the first frame");
    delivery.subscribers.push(fast_subscriber);
    let second_step = current_step(2);
    let deliver = async {
        delivery.serve_subscribers(&second_step, WITHOUT_NEXT_STEP).await;
        delivery.flush().await;
    };
    let mut early_frame_width = None;
    let draw = async {
        let early_request = next_draw_request(&mut device, SHORT_WAIT).await;
        early_frame_width = early_request.as_ref().map(|request| request.width);
        answer(first_request);
        early_request.into_iter().for_each(answer);
        while let Some(request) = next_draw_request(&mut device, HANG_GUARD).await {
            answer(request);
        }
    };
    tokio::select! {
        () = deliver => {}
        () = draw => panic!("expected the delivery of all frames"),
    }
    let mut received = Vec::new();
    for subscription in [&mut slow_subscription, &mut fast_subscription] {
        while let Ok(Ok(StepOutput { step, body: OutputBody::Frames(frames), .. })) =
            timeout(Duration::ZERO, subscription.next()).await
        {
            received.push(ReceivedFrame { width: frames.pictures[0].width, step: step.number });
        }
    }
    ServedFrames { early_frame_width, received }
}

#[tokio::test]
async fn subscriber_without_credit_delays_no_other_subscriber() {
    let served = serve_slow_and_fast(Delivery::Latest).await;
    assert_eq!(served.early_frame_width, Some(24));
    assert_eq!(served.received, [ReceivedFrame { width: 16, step: 1 }, ReceivedFrame { width: 24, step: 2 }]);
}

#[tokio::test]
async fn lossless_subscriber_receives_its_frames_in_order() {
    let served = serve_slow_and_fast(Delivery::Lossless).await;
    // The slow subscriber is served first. Its second frame is requested while its first one is in flight.
    assert_eq!(served.early_frame_width, Some(16));
    let expected = [(16, 1), (16, 2), (24, 2)].map(|(width, step)| ReceivedFrame { width, step });
    assert_eq!(served.received, expected);
}

/// Outcome of [`serve_three_subscribers`].
#[derive(Debug, PartialEq)]
struct SharedFrames {
    drawn_count: usize,
    received_widths: Vec<u32>,
}

/// Delivers a step to three subscribers, of which the first and the third have the same view.
async fn serve_three_subscribers(mode: DeliveryMode) -> SharedFrames {
    let (subscribers, subscriptions): (Vec<_>, Vec<_>) =
        [16, 24, 16].map(|width| subscribe(Delivery::Lossless, width)).into_iter().unzip();
    let (mut delivery, mut device) = delivery_to(subscribers);
    let step = current_step(1);
    let deliver = async {
        delivery.serve_subscribers(&step, mode).await;
        delivery.flush().await;
    };
    let mut drawn_count = 0;
    let draw = async {
        while let Some(request) = next_draw_request(&mut device, HANG_GUARD).await {
            answer(request);
            drawn_count += 1;
        }
    };
    tokio::select! {
        () = deliver => {}
        () = draw => panic!("expected the delivery of all frames"),
    }
    let mut received_widths = Vec::new();
    for mut subscription in subscriptions {
        let output = timeout(HANG_GUARD, subscription.next()).await.expect("expected a frame");
        let Ok(StepOutput { body: OutputBody::Frames(frames), .. }) = output else { panic!("expected frames") };
        received_widths.push(frames.pictures[0].width);
    }
    SharedFrames { drawn_count, received_widths }
}

/// A camera that moves after the frame of the current step is drawn again, unless another step is queued.
#[tokio::test]
async fn moved_camera_redraws_the_step_if_no_step_is_queued() {
    for (mode, is_redrawn) in [(WITHOUT_NEXT_STEP, true), (WITH_NEXT_STEP, false)] {
        let (subscriber, mut subscription) = subscribe(Delivery::Lossless, 16);
        let cameras = subscription.cameras().expect("expected the cameras of frames").clone();
        let (mut delivery, mut device) = delivery_to(vec![subscriber]);
        let step = current_step(1);
        for (camera_version, is_drawn) in [(0, true), (3, is_redrawn)] {
            while camera_version > 0 && cameras.move_cameras(&[]) < camera_version {}
            delivery.serve_subscribers(&step, mode).await;
            let request = next_draw_request(&mut device, if is_drawn { HANG_GUARD } else { SHORT_WAIT }).await;
            assert_eq!(request.is_some(), is_drawn, "{mode:?}, version {camera_version}");
            let Some(request) = request else { continue };
            answer(request);
            delivery.flush().await;
            let output = subscription.next().await.expect("expected frames");
            let OutputBody::Frames(frames) = output.body else { panic!("expected frames") };
            let received = (output.step.number, output.skipped, frames.camera_version);
            assert_eq!(received, (1, 0, camera_version), "{mode:?}");
        }
    }
}

#[tokio::test]
async fn cancelled_request_cancels_its_frame() {
    let (mut delivery, mut device) = delivery_to(Vec::new());
    let (subscriber, _subscription) = subscribe(Delivery::Lossless, 16);
    let (reply, answer) = oneshot::channel();
    delivery.add_request(StepRequest { selector: StepSelector::Current, spec: subscriber.spec, reply });
    let step = current_step(1);
    let cancel = async {
        let mut request = next_draw_request(&mut device, HANG_GUARD).await.expect("expected a frame");
        assert!(!request.reply.is_closed(), "expected a caller that waits");
        drop(answer);
        request.reply.closed().await;
    };
    let both = async { tokio::join!(delivery.answer_requests(&step, 1), cancel) };
    timeout(HANG_GUARD, both).await.expect("expected the cancellation");
}

/// The frame of the second subscriber is cancelled while the first one is being drawn.
#[tokio::test]
async fn dropped_subscription_cancels_its_frame_at_once() {
    let (first_subscriber, mut first_subscription) = subscribe(Delivery::Lossless, 16);
    let (second_subscriber, second_subscription) = subscribe(Delivery::Lossless, 24);
    let (mut delivery, mut device) = delivery_to(vec![first_subscriber, second_subscriber]);
    delivery.serve_subscribers(&current_step(1), WITHOUT_NEXT_STEP).await;
    let cancel = async {
        let first_request = next_draw_request(&mut device, HANG_GUARD).await.expect("expected the first frame");
        let mut second_request = next_draw_request(&mut device, HANG_GUARD).await.expect("expected the second frame");
        assert!(!second_request.reply.is_closed(), "expected a subscriber that waits");
        drop(second_subscription);
        second_request.reply.closed().await;
        answer(first_request);
    };
    let both = async { tokio::join!(delivery.flush(), cancel) };
    timeout(HANG_GUARD, both).await.expect("expected the cancellation");
    first_subscription.next().await.expect("expected the frame of the first subscriber");
    assert_eq!(delivery.subscribers.len(), 1);
}

/// Serves the third step to two subscribers with the same view, the second of which has read none of its results
/// yet. It reads one while the frame of the first is in flight or, without `returns_when_woken`, afterwards. Returns
/// how often the third step was drawn.
async fn draws_for_late_credit(returns_when_woken: bool) -> usize {
    let wake = Arc::new(Notify::new());
    let (first_subscriber, mut first_subscription) = subscribe_with(Delivery::Lossless, 16, &wake);
    let (second_subscriber, mut second_subscription) = subscribe_with(Delivery::Lossless, 16, &wake);
    let (mut delivery, mut device) = delivery_to(vec![first_subscriber, second_subscriber]);
    for number in [1, 2] {
        delivery.serve_subscribers(&current_step(number), WITH_NEXT_STEP).await;
        answer(next_draw_request(&mut device, HANG_GUARD).await.expect("expected a frame"));
        delivery.flush().await;
        first_subscription.next().await.expect("expected a frame");
    }
    let step = current_step(3);
    let grant_late_credit = async {
        let request = next_draw_request(&mut device, HANG_GUARD).await.expect("expected a frame");
        if !returns_when_woken {
            answer(request);
            first_subscription.next().await.expect("expected a frame");
            second_subscription.next().await.expect("expected a frame");
            return None;
        }
        second_subscription.next().await.expect("expected a frame");
        Some(request)
    };
    wake.notified().await; // The credits of the first subscriber.
    delivery.serve_subscribers(&step, WITH_NEXT_STEP).await;
    let both = async { tokio::join!(delivery.flush_until_woken(&wake), grant_late_credit) };
    let ((), request_in_flight) = timeout(HANG_GUARD, both).await.expect("expected a return at the wake-up");
    timeout(HANG_GUARD, wake.notified()).await.expect("expected the wake-up to be left for the caller");
    delivery.serve_subscribers(&step, WITH_NEXT_STEP).await;
    let mut drawn_count = 1;
    let draw = async {
        request_in_flight.into_iter().for_each(answer);
        while let Some(request) = next_draw_request(&mut device, HANG_GUARD).await {
            answer(request);
            drawn_count += 1;
        }
    };
    tokio::select! {
        () = delivery.flush() => {}
        () = draw => panic!("expected the delivery of all frames"),
    }
    for expected in [2, 3] {
        let output = second_subscription.next().await.expect("expected a frame");
        assert_eq!(output.step.number, expected);
    }
    drawn_count
}

#[tokio::test]
async fn late_credit_shares_the_frame_in_flight() {
    assert_eq!(draws_for_late_credit(true).await, 1);
    assert_eq!(draws_for_late_credit(false).await, 2, "control: after its delivery, the frame is drawn again");
}

/// Four views, the last of which receives its credit while the frames of the others are in flight.
#[tokio::test]
async fn frames_in_flight_of_a_step_are_bounded_across_rounds() {
    let deliveries = [Delivery::Lossless, Delivery::Lossless, Delivery::Lossless, Delivery::Latest];
    let (subscribers, mut subscriptions): (Vec<_>, Vec<_>) =
        deliveries.into_iter().zip([16, 24, 32, 40]).map(|(delivery, width)| subscribe(delivery, width)).unzip();
    let (mut delivery, mut device) = delivery_to(subscribers);
    let step = current_step(1);
    delivery.serve_subscribers(&step, WITH_NEXT_STEP).await;
    let mut requests = VecDeque::new();
    for _ in 0..MAX_FRAMES_IN_FLIGHT {
        requests.push_back(next_draw_request(&mut device, HANG_GUARD).await.expect("expected a frame"));
    }
    // Polling grants the credit.
    timeout(Duration::ZERO, subscriptions[3].next()).await.expect_err("expected no frame yet");
    let serve = async {
        delivery.serve_subscribers(&step, WITH_NEXT_STEP).await;
        delivery.flush().await;
    };
    let draw = async {
        assert!(next_draw_request(&mut device, SHORT_WAIT).await.is_none(), "expected no fourth frame in flight");
        answer(requests.pop_front().expect("expected the oldest request"));
        requests.push_back(next_draw_request(&mut device, HANG_GUARD).await.expect("expected the fourth frame"));
        requests.into_iter().for_each(answer);
    };
    timeout(HANG_GUARD, async { tokio::join!(serve, draw) }).await.expect("expected the delivery of all frames");
    for subscription in &mut subscriptions {
        timeout(HANG_GUARD, subscription.next()).await.expect("expected a frame").expect("expected no error");
    }
}

/// The second subscriber to vertices receives its credit while the copy for the first one is in flight.
#[tokio::test]
async fn late_credit_shares_the_copy_in_flight() {
    let spec = || OutputSpec::Vertices(VertexAttributes::POSITIONS_AND_NORMALS);
    let (first_subscriber, mut first_subscription) =
        Subscription::new(spec(), Delivery::Lossless.into(), Arc::default());
    let (second_subscriber, mut second_subscription) =
        Subscription::new(spec(), Delivery::Latest.into(), Arc::default());
    let (mut delivery, mut device) = delivery_to(vec![first_subscriber, second_subscriber]);
    let step = current_step(1);
    delivery.serve_subscribers(&step, WITH_NEXT_STEP).await;
    let command = timeout(HANG_GUARD, device.recv()).await.expect("expected a command");
    let Some(Command::ReadVertices { reply, .. }) = command else { panic!("expected a copy") };
    // Polling grants the credit.
    timeout(Duration::ZERO, second_subscription.next()).await.expect_err("expected no vertices yet");
    delivery.serve_subscribers(&step, WITH_NEXT_STEP).await;
    reply.send(Ok(CopiedVertices { surface: Arc::default(), copy_ms: 0.0 })).expect("expected a caller that waits");
    timeout(HANG_GUARD, delivery.flush()).await.expect("expected no second copy");
    for subscription in [&mut first_subscription, &mut second_subscription] {
        let output = timeout(HANG_GUARD, subscription.next()).await.expect("expected vertices");
        assert_eq!(output.expect("expected no error").step.number, 1);
    }
    let second_copy = timeout(SHORT_WAIT, device.recv()).await;
    assert!(second_copy.is_err(), "expected one copy for both");
}

#[tokio::test]
async fn subscribers_with_the_same_view_share_one_frame() {
    for mode in [WITHOUT_NEXT_STEP, WITH_NEXT_STEP] {
        let expected = SharedFrames { drawn_count: 2, received_widths: vec![16, 24, 16] };
        assert_eq!(serve_three_subscribers(mode).await, expected, "{mode:?}");
    }
}

/// A camera that moves while the frame of the current step is in flight is drawn after the delivery of that frame.
#[tokio::test]
async fn moved_camera_is_drawn_after_the_frame_in_flight() {
    let (subscriber, mut subscription) = subscribe(Delivery::Lossless, 16);
    let cameras = subscription.cameras().expect("expected the cameras of frames").clone();
    let (mut delivery, mut device) = delivery_to(vec![subscriber]);
    let step = current_step(1);
    delivery.serve_subscribers(&step, WITHOUT_NEXT_STEP).await;
    let first_request = next_draw_request(&mut device, HANG_GUARD).await.expect("expected a frame");
    let moved = cameras.move_cameras(&[]);
    delivery.serve_subscribers(&step, WITHOUT_NEXT_STEP).await;
    assert!(next_draw_request(&mut device, SHORT_WAIT).await.is_none(), "expected one frame in flight");
    answer(first_request);
    timeout(HANG_GUARD, delivery.flush()).await.expect("expected no second frame");
    delivery.serve_subscribers(&step, WITHOUT_NEXT_STEP).await;
    answer(next_draw_request(&mut device, HANG_GUARD).await.expect("expected the frame of the moved camera"));
    delivery.flush().await;
    for expected in [0, moved] {
        let output = timeout(HANG_GUARD, subscription.next()).await.expect("expected a frame").expect("no error");
        let OutputBody::Frames(frames) = output.body else { panic!("expected frames") };
        assert_eq!(frames.camera_version, expected);
    }
}

/// Wake-ups that arrive without a pause must not delay frames that are ready.
#[tokio::test]
async fn ready_frame_is_delivered_before_a_wake_up_is_handled() {
    let wake = Arc::new(Notify::new());
    let (subscriber, mut subscription) = subscribe_with(Delivery::Lossless, 16, &wake);
    let (mut delivery, mut device) = delivery_to(vec![subscriber]);
    delivery.serve_subscribers(&current_step(1), WITH_NEXT_STEP).await;
    answer(next_draw_request(&mut device, HANG_GUARD).await.expect("expected a frame"));
    wake.notify_one();
    delivery.flush_until_woken(&wake).await;
    timeout(Duration::ZERO, subscription.next()).await.expect("expected the frame").expect("expected no error");
    timeout(HANG_GUARD, wake.notified()).await.expect("expected the wake-up to be left for the caller");
}
