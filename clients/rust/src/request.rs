//! Requests for one step of a scene, and subscriptions to all steps. [`StepRequest`] builds the frame, vertex and pick
//! requests.

use modalcast_proto::v1;

/// The step that a reply must show.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum StepSelector {
    /// The newest state; the rest state before the first step.
    #[default]
    Current,
    /// Exactly this step of the current run. The server rejects a step that it no longer has.
    Exact(u64),
    /// This step of the current run or a later one.
    Minimum(u64),
}

impl StepSelector {
    /// Converts to the field `step` of a wire request. Each request message has its own type `S` of this field; `exact`
    /// and `minimum` construct its variants.
    pub(crate) fn to_wire<S>(self, exact: fn(u64) -> S, minimum: fn(u64) -> S) -> Option<S> {
        match self {
            Self::Current => None,
            Self::Exact(step) => Some(exact(step)),
            Self::Minimum(step) => Some(minimum(step)),
        }
    }
}

/// A request for one step of a scene. `query` states the requested data: a picture, vertices or a pick.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct StepRequest<Q> {
    pub scene: String,
    pub query: Q,
    pub step: StepSelector,
    /// The longest time that the server may spend on the reply, in milliseconds; 0 selects the server's default.
    pub deadline_ms: u32,
}

impl<Q> StepRequest<Q> {
    /// A request for the newest state, with the server's default deadline.
    pub fn new(scene: &str, query: Q) -> Self {
        Self { scene: scene.to_owned(), query, step: StepSelector::Current, deadline_ms: 0 }
    }

    /// Sets [`Self::step`].
    #[must_use]
    pub fn step(mut self, step: StepSelector) -> Self {
        self.step = step;
        self
    }

    /// Selects [`StepSelector::Exact`].
    #[must_use]
    pub fn exact_step(self, step: u64) -> Self {
        self.step(StepSelector::Exact(step))
    }

    /// Selects [`StepSelector::Minimum`].
    #[must_use]
    pub fn minimum_step(self, step: u64) -> Self {
        self.step(StepSelector::Minimum(step))
    }

    /// Sets [`Self::deadline_ms`].
    #[must_use]
    pub fn deadline_ms(mut self, milliseconds: u32) -> Self {
        self.deadline_ms = milliseconds;
        self
    }
}

/// A subscription to the steps of a scene. `query` states the data of each reply.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Subscription<Q> {
    pub scene: String,
    pub query: Q,
    pub delivery: Delivery,
    /// Number of replies after which the subscription ends; 0 for no limit.
    pub max_replies: u64,
}

impl<Q> Subscription<Q> {
    /// A lossless subscription without a limit.
    pub fn new(scene: &str, query: Q) -> Self {
        Self { scene: scene.to_owned(), query, delivery: Delivery::Lossless, max_replies: 0 }
    }

    /// Sets [`Self::delivery`].
    #[must_use]
    pub fn delivery(mut self, delivery: Delivery) -> Self {
        self.delivery = delivery;
        self
    }

    /// Sets [`Self::max_replies`].
    #[must_use]
    pub fn max_replies(mut self, max_replies: u64) -> Self {
        self.max_replies = max_replies;
        self
    }
}

/// Which steps a subscriber receives.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Delivery {
    /// Every step, in order; back-pressure from a slow reader slows the writer.
    #[default]
    Lossless,
    /// The newest step. Each reply states the number of steps skipped since the previous reply.
    Latest,
}

impl From<Delivery> for v1::Delivery {
    fn from(delivery: Delivery) -> Self {
        match delivery {
            Delivery::Lossless => Self::Lossless,
            Delivery::Latest => Self::Latest,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn step_selector_converts_to_the_variants_of_each_message() {
        use v1::{get_vertices_request, render_frame_request};
        let request = StepRequest::new("toy", ()).minimum_step(3).exact_step(7).deadline_ms(20);
        // The last selector wins.
        assert_eq!((request.step, request.deadline_ms), (StepSelector::Exact(7), 20));
        let frame_step = |step: StepSelector| {
            step.to_wire(render_frame_request::Step::ExactStep, render_frame_request::Step::MinimumStep)
        };
        assert_eq!(frame_step(request.step), Some(render_frame_request::Step::ExactStep(7)));
        assert_eq!(frame_step(StepSelector::Current), None);
        let selector = StepSelector::Minimum(4);
        let step = selector.to_wire(get_vertices_request::Step::ExactStep, get_vertices_request::Step::MinimumStep);
        assert_eq!(step, Some(get_vertices_request::Step::MinimumStep(4)));
    }
}
