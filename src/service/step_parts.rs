//! Assembles steps that are sent in several messages.

use bytes::BytesMut;
use modalcast_proto::v1;
use prost::Message as _;
use tokio::time::Instant;

use super::receive_budget::{MessageLimits, ReceivedMemory};
use super::shared_memory::CallMemory;
use modalcast_model::error::{Error, Result, invalid};

/// The parts of the step that is being received.
pub(super) struct StepAssembler {
    state: State,
    /// Memory of the received parts.
    memory: ReceivedMemory,
    limits: MessageLimits,
    /// Contains the values of parts whose messages only refer to them.
    shared_memory: CallMemory,
}

enum State {
    /// No part has arrived.
    Empty,
    Assembling(Box<PartialStep>),
    /// A part of this step was rejected. Its other parts are ignored.
    Discarding {
        number: u64,
    },
}

struct PartialStep {
    /// The first part without `q` and `transforms`. The domains of the other parts are appended to it.
    step: v1::Step,
    q: BytesMut,
    transforms: BytesMut,
    /// Size of the parts in bytes.
    bytes: usize,
    /// When the next part is overdue.
    deadline: Instant,
}

impl StepAssembler {
    pub(super) const fn new(memory: ReceivedMemory, limits: MessageLimits, shared_memory: CallMemory) -> Self {
        Self { state: State::Empty, memory, limits, shared_memory }
    }

    /// Adds a message. Returns the step when it is complete. A step of one message is not copied.
    ///
    /// # Errors
    /// `Invalid` for a part of another step, a step that is too large or a wrong range of shared memory; `LimitReached`
    /// or `Preempted` when the client holds its share of the bytes. The parts of the step are dropped.
    pub(super) fn push(&mut self, mut part: v1::Step) -> Result<Option<v1::Step>> {
        // The values in shared memory count like those of several messages.
        let is_one_message = !part.has_more && part.shared_q.is_none() && part.shared_transforms.is_none();
        // Called also for a part that is ignored below, because the client waits until the server returns its slots of
        // shared memory.
        let received = self.shared_memory.receive(&mut part);
        if let State::Discarding { number } = self.state {
            if number == part.number {
                if !part.has_more {
                    self.state = State::Empty;
                }
                return Ok(None);
            }
            self.state = State::Empty;
        }
        let (number, has_more) = (part.number, part.has_more);
        if is_one_message && matches!(self.state, State::Empty) {
            return Ok(Some(part));
        }
        match received.and_then(|()| self.append(part)) {
            Ok(()) if has_more => Ok(None),
            Ok(()) => Ok(self.finish()),
            Err(error) => {
                self.discard();
                if has_more {
                    self.state = State::Discarding { number };
                }
                Err(error)
            }
        }
    }

    fn append(&mut self, mut part: v1::Step) -> Result<()> {
        let received_bytes = match &self.state {
            State::Assembling(partial) => partial.bytes,
            _ => 0,
        };
        let bytes = received_bytes + part.encoded_len();
        if bytes > self.limits.max_bytes {
            return Err(invalid("step", format!("at most {} bytes in all parts", self.limits.max_bytes), bytes));
        }
        self.memory.resize(bytes)?;
        let deadline = Instant::now() + self.limits.timeout;
        if let State::Assembling(partial) = &mut self.state {
            if part.number != partial.step.number {
                let expected = format!("{}, whose last part is missing", partial.step.number);
                return Err(invalid("step.number", expected, part.number));
            }
            partial.step.q_domains.append(&mut part.q_domains);
            partial.step.transform_domains.append(&mut part.transform_domains);
            partial.q.extend_from_slice(&part.q);
            partial.transforms.extend_from_slice(&part.transforms);
            (partial.bytes, partial.deadline) = (bytes, deadline);
            return Ok(());
        }
        let (q, transforms) = (std::mem::take(&mut part.q).into(), std::mem::take(&mut part.transforms).into());
        part.has_more = false;
        self.state = State::Assembling(Box::new(PartialStep { step: part, q, transforms, bytes, deadline }));
        Ok(())
    }

    /// Takes the complete step.
    fn finish(&mut self) -> Option<v1::Step> {
        let State::Assembling(partial) = std::mem::replace(&mut self.state, State::Empty) else { return None };
        // Fewer bytes are always granted.
        self.memory.resize(0).ok();
        let (q, transforms) = (partial.q.freeze(), partial.transforms.freeze());
        Some(v1::Step { q, transforms, ..partial.step })
    }

    fn discard(&mut self) {
        self.state = State::Empty;
        self.memory.resize(0).ok();
    }

    /// Waits until the parts of an incomplete step are lost to another client, or the next part is overdue. Pends forever
    /// without an incomplete step. Cancel-safe.
    pub(super) async fn stalled(&self) -> Error {
        let State::Assembling(partial) = &self.state else { return std::future::pending().await };
        tokio::select! {
            error = self.memory.preempted() => error,
            () = tokio::time::sleep_until(partial.deadline) => Error::Deadline {
                what: "the next part of a step".into(),
                ms: self.limits.timeout.as_millis() as u64,
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::admission::{Account, Admission};
    use crate::config::Config;
    use crate::service::receive_budget::ReceiveBudget;

    fn assembler(config: &Config) -> StepAssembler {
        let budget = ReceiveBudget::new(config, &Admission::default());
        let connection = budget.new_connection(&Account::server());
        StepAssembler::new(connection.new_memory(), connection.limits(), CallMemory::default())
    }

    /// A part whose values are in shared memory that the call does not have.
    #[test]
    fn step_with_a_wrong_range_is_rejected_once() {
        let mut assembler = assembler(&Config::default());
        let wrong =
            |number, has_more| v1::Step { shared_q: Some(v1::SharedRange::default()), ..part(number, 0, has_more) };
        assert!(assembler.push(wrong(1, false)).is_err());
        assert!(matches!(assembler.push(part(2, 0, true)), Ok(None)));
        assert!(assembler.push(wrong(2, true)).is_err());
        assert!(matches!(assembler.push(wrong(2, true)), Ok(None)));
        assert!(matches!(assembler.push(part(2, 0, false)), Ok(None)), "expected the rest of the step to be ignored");
        assert!(matches!(assembler.push(part(3, 0, false)), Ok(Some(_))));
    }

    /// A part with two transforms.
    fn part(number: u64, first_domain: u32, has_more: bool) -> v1::Step {
        let transforms = vec![first_domain as u8; 96].into();
        let (q_domains, q) = (vec![first_domain], vec![first_domain as u8; 8].into());
        let transform_domains = vec![first_domain, first_domain + 1];
        v1::Step { number, q_domains, q, transform_domains, transforms, has_more, ..v1::Step::default() }
    }

    #[test]
    fn parts_are_concatenated_and_a_single_message_is_unchanged() {
        let mut assembler = assembler(&Config::default());
        let single = part(1, 7, false);
        assert_eq!(assembler.push(single.clone()).expect("expected no error"), Some(single));
        let first = v1::Step { time: 2.5, transform_format: 2, ..part(2, 0, true) };
        assert_eq!(assembler.push(first).expect("expected no error"), None);
        assert_eq!(assembler.push(part(2, 2, true)).expect("expected no error"), None);
        let step = assembler.push(part(2, 4, false)).expect("expected no error").expect("expected a step");
        assert_eq!((step.number, step.time, step.transform_format, step.has_more), (2, 2.5, 2, false));
        assert_eq!((step.q_domains, step.transform_domains), (vec![0, 2, 4], vec![0, 1, 2, 3, 4, 5]));
        let repeat = |bytes: usize| -> Vec<u8> { [0, 2, 4].iter().flat_map(|byte| vec![*byte; bytes]).collect() };
        assert_eq!((step.q.to_vec(), step.transforms.to_vec()), (repeat(8), repeat(96)));
        assert!(!assembler.memory.is_in_use());
    }

    #[test]
    fn rejected_step_is_reported_once_and_the_next_one_is_accepted() {
        let config = Config { message_bytes: 400, ..Config::default() };
        let mut assembler = assembler(&config);
        let send = |assembler: &mut StepAssembler, number, has_more| assembler.push(part(number, 0, has_more));
        let results: Vec<_> = (0..5).map(|index| send(&mut assembler, 1, index < 4)).collect();
        assert_eq!(results.iter().filter(|result| result.is_err()).count(), 1, "{results:?}");
        assert!(results.iter().all(|result| !matches!(result, Ok(Some(_)))));
        assert!(matches!(send(&mut assembler, 2, false), Ok(Some(_))));
        // Another step begins before the last part of the previous one.
        assert!(matches!(send(&mut assembler, 3, true), Ok(None)));
        let error = send(&mut assembler, 4, true).expect_err("expected another part of step 3");
        assert!(error.to_string().starts_with("step.number: expected 3"), "{error}");
        assert!(matches!(send(&mut assembler, 4, false), Ok(None)));
        assert!(matches!(send(&mut assembler, 5, false), Ok(Some(_))));
    }

    #[tokio::test]
    async fn missing_part_is_overdue() {
        let mut assembler = assembler(&Config { message_timeout: Duration::from_millis(20), ..Config::default() });
        let wait = async |assembler: &StepAssembler| {
            tokio::time::timeout(Duration::from_millis(200), assembler.stalled()).await
        };
        assert!(wait(&assembler).await.is_err());
        assembler.push(part(1, 0, true)).expect("expected no error");
        assert!(matches!(wait(&assembler).await, Ok(Error::Deadline { ms: 20, .. })));
        assembler.push(part(1, 0, false)).expect("expected no error");
        assert!(wait(&assembler).await.is_err());
    }
}
