//! Tests with a device whose commands the test answers.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{mpsc, oneshot};
use tokio::time::timeout;

use super::super::message::StepSelector;
use super::super::step_queue::{Overflow, QueuedStep, StepQueue, StepReport};
use super::super::subscriber::Subscription;
use super::*;
use crate::admission::{Account, Client, Limit, Permit};
use crate::engine::device::command::{Command, Reply};
use crate::engine::output::output_spec::{FrameOutput, OutputSpec, PictureSpec};
use crate::engine::output::rendered_picture::RenderedPicture;
use crate::engine::output::step_output::{OutputBody, SharedPicture, StepOutput};
use crate::engine::testing;
use crate::hang_guard::HANG_GUARD;
use modalcast_model::scene::{CameraSource, FrameSize, FrameStyle, RawStepUpdate, SceneState, StepUpdate};
use modalcast_render::{FrameImage, FrameInfo, FramePixels, FrameTimes, MAX_FRAMES_IN_FLIGHT};

const WITHOUT_NEXT_STEP: DeliveryMode = DeliveryMode { overlaps_next_step: false };
const WITH_NEXT_STEP: DeliveryMode = DeliveryMode { overlaps_next_step: true };

/// A frame that was requested from the device.
struct DrawRequest {
    width: u32,
    reply: Reply<Arc<RenderedPicture>>,
}

/// Creates the delivery of a scene to some subscribers, and the receiver of its device commands.
fn delivery_to(subscribers: Vec<Subscriber>) -> (OutputDelivery, mpsc::Receiver<Command>) {
    let (device, commands) = DeviceHandle::mock();
    let scene = SceneOnDevice { name: "strips".into(), id: 1 };
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
    let camera = CameraSource::framing(&testing::two_strips(), FrameSize::new(width, 8));
    let size = FrameSize::new(width, 8);
    let picture = PictureSpec { camera, size, output: FrameOutput::Color, style: FrameStyle::default() };
    let permit = Permit::for_test(Limit::SUBSCRIPTIONS);
    Subscription::new(permit, OutputSpec::Frames([picture].into()), delivery.into(), Arc::default())
}

/// Grants the credit of a [`Delivery::Latest`] subscription, which has no result yet.
async fn grant_credit(subscription: &mut Subscription) {
    timeout(Duration::ZERO, subscription.next()).await.expect_err("expected no result yet");
}

/// Wait for a request that must not arrive.
const SHORT_WAIT: Duration = Duration::from_millis(500);

/// Returns the next frame that is requested from the device.
async fn next_draw_request(device: &mut mpsc::Receiver<Command>) -> DrawRequest {
    match timeout(HANG_GUARD, device.recv()).await.expect("expected a frame") {
        Some(Command::Draw { picture, reply, .. }) => DrawRequest { width: picture.size.width, reply },
        _ => panic!("expected a frame, got another command"),
    }
}

/// Checks that the device gets no command.
async fn expect_no_command(device: &mut mpsc::Receiver<Command>) {
    assert!(timeout(SHORT_WAIT, device.recv()).await.is_err(), "expected no command");
}

fn answer(DrawRequest { width, reply }: DrawRequest) {
    let (rgba, times, info) = (FramePixels::from(vec![]), FrameTimes::default(), FrameInfo::default());
    let image = FrameImage { width, height: 8, rgba, times, info };
    assert!(reply.send(Ok(Arc::new(image.into()))), "expected a reader that waits");
}

/// The step number and the picture of the next result, which must be there.
async fn receive(subscription: &mut Subscription) -> (u64, SharedPicture) {
    let output = timeout(Duration::ZERO, subscription.next()).await.expect("expected a result").expect("no error");
    let OutputBody::Frames(frames) = &output.body else { panic!("expected frames") };
    (output.step.number, Arc::clone(&frames.pictures[0]))
}

async fn width_of(picture: &SharedPicture) -> u32 {
    timeout(HANG_GUARD, picture.wait()).await.expect("expected a picture").expect("expected no error").width
}

/// The scene does not wait for the device, so a reader of two steps gets both before the first is drawn.
#[tokio::test]
async fn results_are_sent_in_order_before_they_are_drawn() {
    let (subscriber, mut subscription) = subscribe(Delivery::Lossless, 16);
    let (mut delivery, mut device) = delivery_to(vec![subscriber]);
    delivery.serve_subscribers(&current_step(1), WITH_NEXT_STEP).await;
    delivery.begin_step();
    delivery.serve_subscribers(&current_step(2), WITH_NEXT_STEP).await;
    let ((first_step, first), (second_step, second)) =
        (receive(&mut subscription).await, receive(&mut subscription).await);
    assert_eq!((first_step, second_step), (1, 2));
    let (first_request, second_request) = (next_draw_request(&mut device).await, next_draw_request(&mut device).await);
    answer(second_request);
    assert_eq!(width_of(&second).await, 16);
    timeout(Duration::ZERO, first.wait()).await.expect_err("expected a picture that is not drawn");
    answer(first_request);
    assert_eq!(width_of(&first).await, 16);
}

/// A slow subscriber has no credit for the second step, because it has not read the first.
#[tokio::test]
async fn subscriber_without_credit_delays_no_other_subscriber() {
    let (slow_subscriber, mut slow_subscription) = subscribe(Delivery::Latest, 16);
    let (fast_subscriber, mut fast_subscription) = subscribe(Delivery::Lossless, 24);
    grant_credit(&mut slow_subscription).await;
    let (mut delivery, mut device) = delivery_to(vec![slow_subscriber, fast_subscriber]);
    for number in [1, 2] {
        delivery.serve_subscribers(&current_step(number), WITH_NEXT_STEP).await;
        delivery.begin_step();
    }
    for width in [16, 24, 24] {
        assert_eq!(next_draw_request(&mut device).await.width, width);
    }
    assert_eq!([receive(&mut fast_subscription).await.0, receive(&mut fast_subscription).await.0], [1, 2]);
    assert_eq!(receive(&mut slow_subscription).await.0, 1);
    grant_credit(&mut slow_subscription).await;
}

/// Of three subscribers, the first and the third have the same view.
#[tokio::test]
async fn subscribers_with_the_same_view_share_one_frame() {
    for mode in [WITHOUT_NEXT_STEP, WITH_NEXT_STEP] {
        let (subscribers, mut subscriptions): (Vec<_>, Vec<_>) =
            [16, 24, 16].map(|width| subscribe(Delivery::Lossless, width)).into_iter().unzip();
        let (mut delivery, mut device) = delivery_to(subscribers);
        delivery.serve_subscribers(&current_step(1), mode).await;
        let (first, second) = (next_draw_request(&mut device).await, next_draw_request(&mut device).await);
        assert_eq!([first.width, second.width], [16, 24], "{mode:?}");
        answer(first);
        answer(second);
        for (subscription, width) in subscriptions.iter_mut().zip([16, 24, 16]) {
            assert_eq!(width_of(&receive(subscription).await.1).await, width, "{mode:?}");
        }
        expect_no_command(&mut device).await;
    }
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
            if !is_drawn {
                expect_no_command(&mut device).await;
                continue;
            }
            // Without the answer, the equal picture would be shared.
            answer(next_draw_request(&mut device).await);
            let output = subscription.next().await.expect("expected frames");
            let OutputBody::Frames(frames) = output.body else { panic!("expected frames") };
            let received = (output.step.number, output.skipped, frames.camera_version);
            assert_eq!(received, (1, 0, camera_version), "{mode:?}");
        }
    }
}

#[tokio::test]
async fn dropped_answer_cancels_its_frame() {
    let (mut delivery, mut device) = delivery_to(Vec::new());
    let (subscriber, _subscription) = subscribe(Delivery::Lossless, 16);
    let (reply, answer) = oneshot::channel();
    delivery.add_request(StepRequest { selector: StepSelector::Current, spec: subscriber.spec, reply });
    delivery.answer_requests(&current_step(1), 1).await;
    let request = next_draw_request(&mut device).await;
    let output = answer.await.expect("expected an answer").expect("expected no error");
    assert!(!request.reply.is_closed(), "expected a reader that waits");
    drop(output);
    timeout(HANG_GUARD, request.reply.closed()).await.expect("expected the cancellation");
}

/// The request has one more picture than may be in flight.
#[tokio::test]
async fn cancelled_request_ends_the_wait_for_capacity() {
    let (mut delivery, mut device) = delivery_to(Vec::new());
    let widths = (0..=MAX_FRAMES_IN_FLIGHT as u32).map(|index| 16 + 8 * index);
    let pictures: Vec<PictureSpec> = widths
        .map(|width| match subscribe(Delivery::Lossless, width).0.spec {
            OutputSpec::Frames(pictures) => pictures[0],
            _ => panic!("expected frames"),
        })
        .collect();
    let (reply, answer) = oneshot::channel();
    let spec = OutputSpec::Frames(pictures.into());
    delivery.add_request(StepRequest { selector: StepSelector::Current, spec, reply });
    let step = current_step(1);
    let cancel = async {
        let request = next_draw_request(&mut device).await;
        drop(answer);
        request.reply.closed().await;
    };
    let both = async { tokio::join!(delivery.answer_requests(&step, 1), cancel) };
    timeout(HANG_GUARD, both).await.expect("expected the cancellation");
}

#[tokio::test]
async fn dropped_subscription_cancels_its_frame_only() {
    let (first_subscriber, mut first_subscription) = subscribe(Delivery::Lossless, 16);
    let (second_subscriber, second_subscription) = subscribe(Delivery::Lossless, 24);
    let (mut delivery, mut device) = delivery_to(vec![first_subscriber, second_subscriber]);
    delivery.serve_subscribers(&current_step(1), WITHOUT_NEXT_STEP).await;
    let (first, second) = (next_draw_request(&mut device).await, next_draw_request(&mut device).await);
    drop(second_subscription);
    timeout(HANG_GUARD, second.reply.closed()).await.expect("expected the cancellation");
    answer(first);
    assert_eq!(width_of(&receive(&mut first_subscription).await.1).await, 16);
    delivery.serve_subscribers(&current_step(1), WITHOUT_NEXT_STEP).await;
    assert_eq!(delivery.subscribers.len(), 1);
}

/// The second subscriber has the view of the first one, and gets its credit while the first one has the picture, or
/// after it has dropped the picture.
#[tokio::test]
async fn late_credit_shares_the_frame_that_a_reader_has() {
    for (first_keeps_picture, is_shared) in [(true, true), (false, false)] {
        let (first_subscriber, mut first_subscription) = subscribe(Delivery::Lossless, 16);
        let (second_subscriber, mut second_subscription) = subscribe(Delivery::Latest, 16);
        let (mut delivery, mut device) = delivery_to(vec![first_subscriber, second_subscriber]);
        let step = current_step(1);
        delivery.serve_subscribers(&step, WITH_NEXT_STEP).await;
        let request = next_draw_request(&mut device).await;
        let (_, picture) = receive(&mut first_subscription).await;
        let kept = first_keeps_picture.then_some(picture);
        grant_credit(&mut second_subscription).await;
        delivery.serve_subscribers(&step, WITH_NEXT_STEP).await;
        let (_, second) = receive(&mut second_subscription).await;
        match is_shared {
            true => expect_no_command(&mut device).await,
            false => assert_eq!(next_draw_request(&mut device).await.width, 16),
        }
        assert_eq!(kept.is_some_and(|kept| Arc::ptr_eq(&kept, &second)), is_shared);
        drop(request);
    }
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
        requests.push_back(next_draw_request(&mut device).await);
    }
    grant_credit(&mut subscriptions[3]).await;
    let draw = async {
        expect_no_command(&mut device).await;
        answer(requests.pop_front().expect("expected the oldest request"));
        assert_eq!(next_draw_request(&mut device).await.width, 40);
    };
    let both = async { tokio::join!(delivery.serve_subscribers(&step, WITH_NEXT_STEP), draw) };
    timeout(HANG_GUARD, both).await.expect("expected the fourth frame");
}

/// The second subscriber to vertices receives its credit while the copy for the first one is in flight.
#[tokio::test]
async fn late_credit_shares_the_copy_in_flight() {
    let spec = || OutputSpec::Vertices(VertexAttributes::POSITIONS_AND_NORMALS);
    let subscribe = |delivery: Delivery| {
        Subscription::new(Permit::for_test(Limit::SUBSCRIPTIONS), spec(), delivery.into(), Arc::default())
    };
    let (first_subscriber, mut first_subscription) = subscribe(Delivery::Lossless);
    let (second_subscriber, mut second_subscription) = subscribe(Delivery::Latest);
    let (mut delivery, mut device) = delivery_to(vec![first_subscriber, second_subscriber]);
    let step = current_step(1);
    delivery.serve_subscribers(&step, WITH_NEXT_STEP).await;
    let command = timeout(HANG_GUARD, device.recv()).await.expect("expected a command");
    let Some(Command::ReadVertices { reply, .. }) = command else { panic!("expected a copy") };
    grant_credit(&mut second_subscription).await;
    delivery.serve_subscribers(&step, WITH_NEXT_STEP).await;
    assert!(reply.send(Ok(Arc::default())), "expected readers that wait");
    for subscription in [&mut first_subscription, &mut second_subscription] {
        let StepOutput { step, body: OutputBody::Vertices(vertices), .. } =
            subscription.next().await.expect("expected vertices")
        else {
            panic!("expected vertices");
        };
        timeout(HANG_GUARD, vertices.wait()).await.expect("expected vertices").expect("expected no error");
        assert_eq!(step.number, 1);
    }
    expect_no_command(&mut device).await;
}

/// After an error, a later reader of the same step gets a new copy.
#[tokio::test]
async fn failed_copy_is_not_shared() {
    let (mut delivery, mut device) = delivery_to(Vec::new());
    let step = current_step(1);
    for (answer_of_device, is_error) in [(Err(testing::fault_error()), true), (Ok(Arc::default()), false)] {
        let (reply, answer) = oneshot::channel();
        let spec = OutputSpec::Vertices(VertexAttributes::POSITIONS_AND_NORMALS);
        delivery.add_request(StepRequest { selector: StepSelector::Current, spec, reply });
        delivery.answer_requests(&step, 1).await;
        let command = timeout(HANG_GUARD, device.recv()).await.expect("expected a command");
        let Some(Command::ReadVertices { reply, .. }) = command else { panic!("expected a copy") };
        assert!(reply.send(answer_of_device), "expected a reader that waits");
        let output = answer.await.expect("expected an answer").expect("expected no error");
        let OutputBody::Vertices(vertices) = output.body else { panic!("expected vertices") };
        assert_eq!(vertices.wait().await.is_err(), is_error);
    }
}

/// The second step has no output of its own, and its acknowledgment comes after that of the first.
#[tokio::test]
async fn steps_are_acknowledged_in_order_after_their_outputs() {
    let step_queue = Arc::new(StepQueue::new(Delivery::Lossless, Overflow::Reject, 2, Arc::default()));
    for number in [1, 2] {
        let raw = RawStepUpdate { number, ..RawStepUpdate::default() };
        let update = StepUpdate::parse(&testing::two_strips(), &raw).expect("expected a valid step");
        step_queue.push(QueuedStep::new(update, 0.0)).expect("expected capacity");
        step_queue.take().expect("expected a queued step");
    }
    let complete = || CompletedStep::new(Arc::clone(&step_queue), Vec::new());
    let (subscriber, mut subscription) = subscribe(Delivery::Lossless, 16);
    let (mut delivery, mut device) = delivery_to(vec![subscriber]);
    delivery.serve_subscribers(&current_step(1), WITH_NEXT_STEP).await;
    let (_, picture) = receive(&mut subscription).await;
    delivery.acknowledge(complete());
    delivery.acknowledge(complete());
    let request = next_draw_request(&mut device).await;
    timeout(SHORT_WAIT, delivery.finish_outputs()).await.expect_err("expected an output in flight");
    timeout(Duration::ZERO, step_queue.next_report()).await.expect_err("expected no acknowledgment");
    answer(request);
    timeout(HANG_GUARD, delivery.finish_outputs()).await.expect("expected the end of the output");
    assert_eq!(width_of(&picture).await, 16);
    for number in [1, 2] {
        let report = step_queue.next_report().await.expect("expected a report");
        assert!(matches!(report, StepReport::Done { step, .. } if step == number), "{report:?}");
    }
}

/// The stall budget of a test. It exceeds the run time of the test, so that only the stalls that the test adds count.
const STALL_BUDGET: Duration = Duration::from_secs(3600);

/// A lossless subscription to states of a client, which has subscribed long ago.
fn subscribe_client(client: u64) -> (Subscriber, Subscription) {
    let permit = Permit::for_test(Limit::SUBSCRIPTIONS);
    let (mut subscriber, subscription) =
        Subscription::new(permit, OutputSpec::State, Delivery::Lossless.into(), Arc::default());
    subscriber.account = Account::anonymous(Client::Connection(client));
    (subscriber, subscription)
}

/// Delivers steps from `first` on until the writer must wait for a subscription, and returns the last one. `None` if the
/// writer does not wait within four steps. `reader` reads every step.
async fn deliver_until_blocked(
    delivery: &mut OutputDelivery,
    first: u64,
    mut reader: Option<&mut Subscription>,
) -> Option<CurrentStep> {
    for number in first..first + 4 {
        let step = current_step(number);
        delivery.serve_subscribers(&step, WITH_NEXT_STEP).await;
        if let Some(reader) = &mut reader {
            reader.next().await.expect("expected a result");
        }
        if delivery.blocks_writer(&step, Instant::now()) {
            return Some(step);
        }
    }
    None
}

#[tokio::test]
async fn only_subscribers_that_exceed_the_budget_end() {
    let (unread_subscriber, mut unread) = subscribe_client(1);
    let (reading_subscriber, mut reading) = subscribe_client(2);
    let (mut delivery, _device) = delivery_to(vec![unread_subscriber, reading_subscriber]);
    delivery.stall_budget = StallBudget::new(STALL_BUDGET, Instant::now());
    let step = deliver_until_blocked(&mut delivery, 1, Some(&mut reading)).await.expect("expected a wait");
    let later = Instant::now() + STALL_BUDGET / 4;
    delivery.charge_stall(later);
    assert!(delivery.blocks_writer(&step, later), "expected a writer that waits within the budget");
    let end = Instant::now() + STALL_BUDGET;
    delivery.charge_stall(end);
    assert!(!delivery.blocks_writer(&step, end), "expected a writer that continues");
    assert_eq!(delivery.next_stall_check(), None);
    assert_eq!(delivery.subscribers.len(), 1);
    let missing = StepNumber { run: 1, number: step.state.step };
    assert_eq!(unread.disconnected().await, Error::SlowSubscriber { received: None, missing });
    for number in 1..step.state.step {
        assert_eq!(unread.next().await.expect("expected a buffered result").step.number, number);
    }
    unread.next().await.expect_err("expected the end");
}

/// The second subscription makes the writer wait after the first one has ended.
#[tokio::test]
async fn subscriptions_of_a_client_share_its_stall_time() {
    for (second_client, remains) in [(1, false), (2, true)] {
        let ((first, _first_unread), (second, mut reading)) = (subscribe_client(1), subscribe_client(second_client));
        let (mut delivery, _device) = delivery_to(vec![first, second]);
        delivery.stall_budget = StallBudget::new(STALL_BUDGET, Instant::now());
        let step = deliver_until_blocked(&mut delivery, 1, Some(&mut reading)).await.expect("expected a wait");
        let end = Instant::now() + STALL_BUDGET * 6 / 10;
        delivery.charge_stall(end);
        assert!(!delivery.blocks_writer(&step, end) && delivery.subscribers.len() == 1, "expected one subscription");
        let blocked = deliver_until_blocked(&mut delivery, step.state.step + 1, None).await;
        assert_eq!((blocked.is_some(), delivery.subscribers.len()), (remains, usize::from(remains)));
    }
}

#[tokio::test]
async fn work_of_the_server_is_not_charged() {
    let (subscriber, subscription) = subscribe_client(1);
    let work_timer = Arc::clone(subscription.work_timer());
    let (mut delivery, _device) = delivery_to(vec![subscriber]);
    delivery.stall_budget = StallBudget::new(STALL_BUDGET, Instant::now());
    let work = async {
        let step = deliver_until_blocked(&mut delivery, 1, None).await.expect("expected a wait");
        let later = Instant::now() + 100 * STALL_BUDGET;
        delivery.charge_stall(later);
        assert!(delivery.blocks_writer(&step, later), "expected a subscriber that remains");
    };
    work_timer.measure(work).await;
    assert_eq!(delivery.subscribers.len(), 1);
}
