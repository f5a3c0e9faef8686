//! Delivery of a scene's outputs: to single requests whose step has been reached, and to subscribers that have not
//! received the current step yet. A subscriber receives one result per credit ([`super::subscriber`]).

use std::collections::VecDeque;
use std::mem;
use std::time::Instant;

use tokio::sync::Notify;

use super::current_step::CurrentStep;
use super::delivery::Delivery;
use super::message::StepRequest;
use super::output_producer::{DeliveryMode, DeliveryRound, OutputProducer, SceneOnDevice, attributes_for};
use super::readback_queue::PendingReadback;
use super::step_queue::CompletedStep;
use super::subscriber::Subscriber;
use crate::config::Config;
use crate::engine::device::handle::{DeviceHandle, PendingReply};
use crate::engine::output::step_output::PictureContent;
use modalcast_model::deform::VertexAttributes;
use modalcast_model::error::{Error, Result};

/// Owns the subscribers and the single requests of one scene, and the readbacks in flight for them.
pub(super) struct OutputDelivery {
    subscribers: Vec<Subscriber>,
    requests: Vec<StepRequest>,
    max_subscribers: usize,
    max_pending_requests: usize,
    producer: OutputProducer,
}

impl OutputDelivery {
    pub(super) fn new(scene_on_device: SceneOnDevice, device: DeviceHandle, config: &Config) -> Self {
        Self {
            subscribers: Vec::new(),
            requests: Vec::new(),
            max_subscribers: config.max_subscribers,
            max_pending_requests: config.max_pending_requests,
            producer: OutputProducer::new(scene_on_device, device, config.stall_timeout),
        }
    }

    /// Adds a subscriber. With [`Delivery::Latest`] it receives the current step unless the scene has had no step.
    ///
    /// # Errors
    /// `LimitReached` when the scene has too many subscribers.
    pub(super) fn add_subscriber(&mut self, mut subscriber: Subscriber, current: &CurrentStep) -> Result<()> {
        self.drop_closed_subscribers();
        let limit = self.max_subscribers;
        if self.subscribers.len() >= limit {
            return Err(Error::LimitReached { objects: "subscribers of one scene", limit });
        }
        let receives_current = subscriber.delivery == Delivery::Latest && current.state.run > 0;
        // Counts as if the subscriber had received the step before its first one.
        subscriber.delivered_step_count =
            if receives_current { current.step_count.saturating_sub(1) } else { current.step_count };
        self.subscribers.push(subscriber);
        Ok(())
    }

    /// Adds a request. Answers it with `Busy` when too many requests wait.
    pub(super) fn add_request(&mut self, request: StepRequest) {
        self.requests.retain(|request| !request.reply.is_closed());
        let limit = self.max_pending_requests;
        if self.requests.len() < limit {
            self.requests.push(request);
        } else {
            let queue_full = Error::Busy { queue: "requests that wait for a step", limit };
            request.reply.send(Err(queue_full)).ok(); // Fails only if the caller no longer waits.
        }
    }

    /// Whether a lossless subscriber has not received the current step.
    pub(super) fn has_unserved_lossless(&self, current: &CurrentStep) -> bool {
        let lacks_current_step = |subscriber: &Subscriber| {
            subscriber.delivery == Delivery::Lossless && subscriber.delivered_step_count < current.step_count
        };
        self.subscribers.iter().any(lacks_current_step)
    }

    /// Deadline at which the subscriber that has blocked the writer for the longest time is disconnected.
    pub(super) fn next_stall_deadline(&self) -> Option<Instant> {
        let earliest_stall = self.subscribers.iter().filter_map(|subscriber| subscriber.stalled_since).min()?;
        Some(earliest_stall + self.producer.stall_timeout)
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
                    answer = self.producer.produce(&request.spec, current, VertexAttributes::default()) => answer,
                    // The caller no longer waits. Dropping the production cancels its commands to the device.
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
        let attributes = self.combined_attributes(current);
        let starts_shared_copy = mode.overlaps_next_step && !self.producer.cached_attributes().contains(attributes);
        let mut round = DeliveryRound {
            current,
            mode,
            attributes,
            starts_shared_copy,
            content: self.combined_content(),
            vertex_recipients: Vec::new(),
            started_pictures: VecDeque::new(),
            drawn_pictures: Vec::new(),
        };
        let mut index = 0;
        while let Some(subscriber) = self.subscribers.get_mut(index) {
            if !subscriber.is_closed() && self.producer.serve(subscriber, &mut round).await {
                index += 1;
            } else {
                self.subscribers.remove(index);
            }
        }
        let DeliveryRound { vertex_recipients, started_pictures, .. } = round;
        if !vertex_recipients.is_empty() {
            let reply = self.producer.device.read_vertices(self.producer.scene_on_device.id, attributes);
            self.producer.readbacks.push(PendingReadback::of_vertices(current, attributes, reply, vertex_recipients));
        }
        started_pictures.into_iter().for_each(|picture| self.producer.readbacks.push(picture));
        self.drop_closed_subscribers();
    }

    /// Delivers all readbacks in flight.
    pub(super) async fn flush(&mut self) {
        self.producer.readbacks.flush().await;
        self.drop_closed_subscribers();
    }

    /// Delivers the readbacks in flight that are ready, then waits for the others until `wake` is notified, and notifies
    /// it again for the caller. A subscriber that has received a credit meanwhile then shares a frame in flight. After
    /// the delivery of that frame, it would be drawn again.
    pub(super) async fn flush_until_woken(&mut self, wake: &Notify) {
        tokio::select! {
            biased;
            () = self.flush() => {}
            () = wake.notified() => wake.notify_one(),
        }
    }

    /// Delivers readbacks until the device answers `pending_reply`, which is the next step. Afterwards only frames of
    /// the step in `current` may be in flight.
    pub(super) async fn deliver_during<T>(
        &mut self,
        pending_reply: &mut PendingReply<T>,
        current: &CurrentStep,
    ) -> Result<T> {
        let readbacks = &mut self.producer.readbacks;
        readbacks.flush_vertices().await;
        let result = loop {
            tokio::select! {
                biased;
                result = pending_reply.recv() => break result,
                () = readbacks.deliver_oldest(), if !readbacks.is_empty() => {}
            }
        };
        readbacks.flush_before(current.step_count).await;
        self.drop_closed_subscribers();
        result
    }

    /// Acknowledges the current step after its last readback in flight, or now if it has none.
    pub(super) async fn acknowledge(&mut self, current: &CurrentStep, step: CompletedStep) {
        if let Some(step) = self.producer.readbacks.attach_acknowledgment(current.step_count, step) {
            self.flush().await;
            step.acknowledge();
        }
    }

    /// Drops the cached vertices of the previous step.
    pub(super) fn drop_cached_vertices(&mut self) {
        self.producer.cached_vertices = None;
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
