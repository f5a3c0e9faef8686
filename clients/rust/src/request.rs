//! Requests for one step of a scene, and subscriptions to all steps. [`StepRequest`] builds the frame, vertex and pick
//! requests.

use modalcast_proto::v1;

/// The step that a reply must show.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum StepSelector {
    /// The newest state; the rest state before the first step.
    #[default]
    Current,
    /// Exactly this step. The server rejects a step that it no longer has. A run is the sequence of steps from one
    /// writer; 0 selects the run of the latest writer.
    Exact { run: u64, number: u64 },
    /// This step or a later one. The steps of a later run come after those of an earlier one.
    Minimum { run: u64, number: u64 },
}

impl StepSelector {
    /// Converts to the field `step` of a wire request.
    pub(crate) const fn to_wire(self) -> Option<v1::StepSelector> {
        use v1::step_selector::Number;
        match self {
            Self::Current => None,
            Self::Exact { run, number } => Some(v1::StepSelector { run, number: Some(Number::Exact(number)) }),
            Self::Minimum { run, number } => Some(v1::StepSelector { run, number: Some(Number::Minimum(number)) }),
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
    pub fn new(scene: &str, query: impl Into<Q>) -> Self {
        Self { scene: scene.to_owned(), query: query.into(), step: StepSelector::Current, deadline_ms: 0 }
    }

    /// Sets [`Self::step`].
    #[must_use]
    pub fn step(mut self, step: StepSelector) -> Self {
        self.step = step;
        self
    }

    /// Selects [`StepSelector::Exact`] of the latest run.
    #[must_use]
    pub fn exact_step(self, number: u64) -> Self {
        self.step(StepSelector::Exact { run: 0, number })
    }

    /// Selects [`StepSelector::Minimum`] of the latest run.
    #[must_use]
    pub fn minimum_step(self, number: u64) -> Self {
        self.step(StepSelector::Minimum { run: 0, number })
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
    /// Number of steps after which the subscription ends; 0 for no limit.
    pub max_steps: u64,
    /// Maximum number of steps per second; 0 for no limit. The server accepts a limit only with [`Delivery::Latest`].
    pub max_hz: f64,
}

impl<Q> Subscription<Q> {
    /// A lossless subscription without a limit.
    pub fn new(scene: &str, query: impl Into<Q>) -> Self {
        Self { scene: scene.to_owned(), query: query.into(), delivery: Delivery::Lossless, max_steps: 0, max_hz: 0.0 }
    }

    /// Sets [`Self::delivery`].
    #[must_use]
    pub fn delivery(mut self, delivery: Delivery) -> Self {
        self.delivery = delivery;
        self
    }

    /// Sets [`Self::max_steps`].
    #[must_use]
    pub fn max_steps(mut self, max_steps: u64) -> Self {
        self.max_steps = max_steps;
        self
    }

    /// Sets [`Self::max_hz`].
    #[must_use]
    pub fn max_hz(mut self, max_hz: f64) -> Self {
        self.max_hz = max_hz;
        self
    }
}

/// The steps that a stream carries.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Delivery {
    /// Every step, in order. A slow reader slows the writer down.
    #[default]
    Lossless,
    /// The newest step. A slow reader skips steps, and queued steps of a writer are merged. Both are counted.
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
    fn last_selector_of_a_request_is_sent() {
        let request = StepRequest::<()>::new("toy", ()).minimum_step(3).exact_step(7).deadline_ms(20);
        assert_eq!((request.step, request.deadline_ms), (StepSelector::Exact { run: 0, number: 7 }, 20));
        let wire = request.step.to_wire().expect("expected a selector");
        assert_eq!((wire.run, wire.number), (0, Some(v1::step_selector::Number::Exact(7))));
        let wire = StepSelector::Minimum { run: 2, number: 4 }.to_wire().expect("expected a selector");
        assert_eq!((wire.run, wire.number), (2, Some(v1::step_selector::Number::Minimum(4))));
        assert_eq!(StepSelector::Current.to_wire(), None);
    }
}
