//! Delivery of a scene's outputs: to single requests whose step has been reached, and to subscribers that have not
//! received the current step yet. A subscriber receives one result per credit ([`super::subscriber`]).

use std::mem;
use std::time::{Duration, Instant};

use super::current_step::CurrentStep;
use super::delivery::Delivery;
use super::message::StepRequest;
use super::output_producer::{DeliveryMode, OutputProducer, SceneOnDevice, SharedNeeds, attributes_for};
use super::stall_budget::StallBudget;
use super::step_queue::CompletedStep;
use super::subscriber::Subscriber;
use crate::config::Config;
use crate::engine::device::handle::{DeviceHandle, PendingReply};
use crate::engine::output::output_spec::PictureContent;
use modalcast_model::deform::VertexAttributes;
use modalcast_model::error::{Error, Result, StepNumber};

/// Shortest time between two checks of the stall budget while the writer waits. A check is only necessary because a
/// subscriber may wait for its client at the end of the server's work, of which the scene is not notified.
const MIN_STALL_CHECK_INTERVAL: Duration = Duration::from_millis(1);

/// Owns the subscribers and the single requests of one scene, and starts their outputs.
pub(super) struct OutputDelivery {
    subscribers: Vec<Subscriber>,
    requests: Vec<StepRequest>,
    stall_budget: StallBudget,
    /// When a subscriber may exceed the stall budget. `None` while the writer does not wait.
    next_stall_check: Option<Instant>,
    producer: OutputProducer,
}

impl OutputDelivery {
    pub(super) fn new(scene_on_device: SceneOnDevice, device: DeviceHandle, config: &Config) -> Self {
        Self {
            subscribers: Vec::new(),
            requests: Vec::new(),
            stall_budget: StallBudget::new(config.stall_budget, Instant::now()),
            next_stall_check: None,
            producer: OutputProducer::new(scene_on_device, device),
        }
    }

    /// Adds a subscriber. With [`Delivery::Latest`] it receives the current step unless the scene has had no step. The
    /// permits of the subscriptions bound their number.
    pub(super) fn add_subscriber(&mut self, mut subscriber: Subscriber, current: &CurrentStep) {
        self.drop_closed_subscribers();
        let receives_current = subscriber.delivery == Delivery::Latest && current.state.run > 0;
        // Counts as if the subscriber had received the step before its first one.
        subscriber.delivered_step_count =
            if receives_current { current.step_count.saturating_sub(1) } else { current.step_count };
        let same_client = self.subscribers.iter().find(|other| other.account == subscriber.account);
        subscriber.stall_time =
            same_client.map_or_else(|| self.stall_budget.new_client(Instant::now()), |other| other.stall_time);
        self.subscribers.push(subscriber);
    }

    /// Adds a request. The permits of the callers bound the number of requests.
    pub(super) fn add_request(&mut self, request: StepRequest) {
        self.requests.retain(|request| !request.reply.is_closed());
        self.requests.push(request);
    }

    /// Begins a full stall budget for a new writer.
    pub(super) fn reset_stall_budget(&mut self, capacity: Duration, now: Instant) {
        self.stall_budget = StallBudget::new(capacity, now);
        let stall_time = self.stall_budget.new_client(now);
        self.subscribers.iter_mut().for_each(|subscriber| subscriber.stall_time = stall_time);
    }

    /// When [`Self::charge_stall`] and [`Self::blocks_writer`] must be called again. `None` while the writer does not
    /// wait.
    pub(super) const fn next_stall_check(&self) -> Option<Instant> {
        self.next_stall_check
    }

    /// Takes the wait of the writer since the last call of [`Self::blocks_writer`] from the stall budget.
    pub(super) fn charge_stall(&mut self, now: Instant) {
        if self.next_stall_check.take().is_none() {
            return;
        }
        let end_stall = |subscriber: &mut Subscriber| Some((subscriber.account.clone(), subscriber.end_stall(now)?));
        let stalls: Vec<_> = self.subscribers.iter_mut().filter_map(end_stall).collect();
        let longest_stall = stalls.iter().map(|(_, stall)| *stall).max();
        self.stall_budget.spend(longest_stall.unwrap_or_default(), now);
        // All subscriptions of a client share its stall time.
        for subscriber in &mut self.subscribers {
            let of_client = stalls.iter().filter(|(account, _)| *account == subscriber.account);
            let longest_stall = of_client.map(|(_, stall)| *stall).max();
            subscriber.stall_time.add(longest_stall.unwrap_or_default(), now);
        }
    }

    /// Whether the writer must wait until lossless subscribers have received the current step. Disconnects those of
    /// them that have exceeded the stall budget.
    pub(super) fn blocks_writer(&mut self, current: &CurrentStep, now: Instant) -> bool {
        let budget = self.stall_budget;
        let exceeds_budget = |subscriber: &Subscriber| {
            subscriber.lacks_step(current.step_count)
                && subscriber.waits_for_client()
                && budget.remaining(&subscriber.stall_time, now).is_zero()
        };
        for slow_subscriber in self.subscribers.extract_if(.., |subscriber| exceeds_budget(subscriber)) {
            let scene = self.producer.scene_name();
            tracing::warn!(scene, "a lossless subscriber has exceeded the stall budget and is disconnected");
            let missing = StepNumber { run: current.state.run, number: current.state.step };
            slow_subscriber.disconnect(Error::SlowSubscriber { received: None, missing });
        }
        let blocking = self.subscribers.iter_mut().filter(|subscriber| subscriber.lacks_step(current.step_count));
        let remaining = blocking.map(|subscriber| {
            subscriber.begin_stall(now);
            budget.remaining(&subscriber.stall_time, now)
        });
        self.next_stall_check = remaining.min().map(|remaining| now + remaining.max(MIN_STALL_CHECK_INTERVAL));
        self.next_stall_check.is_some()
    }

    /// Answers every request whose step has been reached or passed. Drops requests whose caller no longer waits. `run`
    /// is the run of the latest writer.
    pub(super) async fn answer_requests(&mut self, current: &CurrentStep, run: u64) {
        for mut request in mem::take(&mut self.requests) {
            if request.reply.is_closed() {
                continue;
            }
            let answer = match self.producer.is_reached(request.selector, current, run) {
                Ok(true) => tokio::select! {
                    biased;
                    answer = self.producer.answer(&request.spec, current) => Ok(answer),
                    // The caller no longer waits. Dropping the outputs cancels their commands to the device.
                    () = request.reply.closed() => continue,
                },
                Ok(false) => {
                    self.requests.push(request);
                    continue;
                }
                Err(error) => Err(error),
            };
            request.reply.send(answer).ok(); // Fails only if the caller no longer waits.
        }
    }

    /// Delivers the current step to every subscriber with a credit. Subscribers with equal pictures share one drawing,
    /// and subscribers to vertices share one copy.
    pub(super) async fn serve_subscribers(&mut self, current: &CurrentStep, mode: DeliveryMode) {
        let needs = SharedNeeds { attributes: self.combined_attributes(current), content: self.combined_content() };
        let mut index = 0;
        while let Some(subscriber) = self.subscribers.get_mut(index) {
            if !subscriber.is_closed() && self.producer.serve(subscriber, current, mode, needs).await {
                index += 1;
            } else {
                self.subscribers.remove(index);
            }
        }
    }

    /// Whether the device has not finished all outputs.
    pub(super) fn has_outputs_in_flight(&self) -> bool {
        !self.producer.in_flight.is_empty()
    }

    /// Waits for the oldest output in flight. Cancel-safe.
    pub(super) async fn finish_oldest_output(&mut self) {
        self.producer.in_flight.finish_oldest().await;
    }

    /// Waits for all outputs in flight.
    pub(super) async fn finish_outputs(&mut self) {
        self.producer.in_flight.finish_all().await;
    }

    /// Waits for the answer to the next step. Afterwards only outputs of the step in `current` may be in flight.
    pub(super) async fn wait_for_step<T: Clone>(
        &mut self,
        pending_reply: &PendingReply<T>,
        current: &CurrentStep,
    ) -> Result<T> {
        let in_flight = &mut self.producer.in_flight;
        let mut reply = std::pin::pin!(pending_reply.wait());
        let result = loop {
            tokio::select! {
                biased;
                result = &mut reply => break result,
                () = in_flight.finish_oldest(), if !in_flight.is_empty() => {}
            }
        };
        in_flight.finish_before(current.step_count).await;
        result
    }

    /// Acknowledges the current step after all outputs that are in flight.
    pub(super) fn acknowledge(&mut self, step: CompletedStep) {
        self.producer.in_flight.acknowledge(step);
    }

    /// Forgets the outputs of the previous step.
    pub(super) fn begin_step(&mut self) {
        self.producer.begin_step();
    }

    /// Ends every subscription and every request with `error`.
    pub(super) fn end(self, error: &Error) {
        self.subscribers.iter().for_each(|subscriber| subscriber.end(error.clone()));
        for request in self.requests {
            request.reply.send(Err(error.clone())).ok(); // Fails only if the caller no longer waits.
        }
    }

    /// The union of the vertex attributes that all subscribers request, so that one copy serves them all.
    fn combined_attributes(&self, current: &CurrentStep) -> VertexAttributes {
        let open_subscribers = self.subscribers.iter().filter(|subscriber| !subscriber.is_closed());
        open_subscribers
            .filter_map(|subscriber| attributes_for(subscriber, current))
            .fold(VertexAttributes::default(), VertexAttributes::union)
    }

    /// The union of the forms in which all subscribers read color pictures, so that equal pictures are drawn once.
    fn combined_content(&self) -> PictureContent {
        let open_subscribers = self.subscribers.iter().filter(|subscriber| !subscriber.is_closed());
        let contents = open_subscribers.filter_map(Subscriber::content);
        contents.reduce(PictureContent::union).unwrap_or(PictureContent::PIXELS)
    }

    fn drop_closed_subscribers(&mut self) {
        self.subscribers.retain(|subscriber| !subscriber.is_closed());
    }
}

#[cfg(test)]
mod tests;
