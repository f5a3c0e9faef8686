//! The steps that a stream has sent, so that its last error says where it broke off.

use tonic::Status;

use super::status::to_status;
use crate::engine::StepId;
use modalcast_model::error::{Error, StepNumber};

/// The steps that a stream has sent so far.
#[derive(Debug, Default)]
pub(super) struct SentSteps {
    /// The last step that was sent completely.
    last: Option<StepNumber>,
}

impl SentSteps {
    /// Records a step that was sent completely.
    pub(super) const fn complete(&mut self, step: StepId) {
        self.last = Some(number_of(step));
    }

    /// The status of a stream that ends with `error`. `unfinished` is the step that was being sent.
    pub(super) fn end(&self, error: Error, unfinished: Option<StepId>) -> Status {
        let error = match error {
            Error::SlowSubscriber { missing, .. } => {
                Error::SlowSubscriber { received: self.last, missing: unfinished.map_or(missing, number_of) }
            }
            other => other,
        };
        to_status(error)
    }
}

const fn number_of(step: StepId) -> StepNumber {
    StepNumber { run: step.run, number: step.number }
}

#[cfg(test)]
mod tests {
    use tonic::Code;
    use tonic_types::StatusExt as _;

    use super::*;

    #[test]
    fn error_of_a_slow_subscriber_names_the_steps_around_the_gap() {
        let step = |number| StepId { run: 3, number, time: 0.0 };
        let error = Error::SlowSubscriber { received: None, missing: StepNumber { run: 3, number: 9 } };
        let metadata = |status: &Status| status.get_details_error_info().expect("expected details").metadata;
        let mut sent = SentSteps::default();
        let status = sent.end(error.clone(), None);
        assert_eq!(status.code(), Code::ResourceExhausted);
        assert_eq!(metadata(&status)["missing_step"], "9");
        assert!(!metadata(&status).contains_key("received_step"), "expected no complete step");
        sent.complete(step(4));
        sent.complete(step(5));
        let status = sent.end(error, Some(step(7)));
        let metadata = metadata(&status);
        for (key, expected) in
            [("received_run", "3"), ("received_step", "5"), ("missing_run", "3"), ("missing_step", "7")]
        {
            assert_eq!(metadata[key], expected, "{key}");
        }
        assert!(status.message().contains("step 7 of run 3"), "{}", status.message());
    }

    #[test]
    fn other_errors_are_unchanged() {
        let error = Error::ShuttingDown;
        let status = SentSteps::default().end(error.clone(), None);
        assert_eq!(status.message(), to_status(error).message());
    }
}
