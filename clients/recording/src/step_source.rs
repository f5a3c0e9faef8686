//! The steps of a replay, with the times at which they are due.

use modalcast_client::Step;

use crate::error::{Error, Result};
use crate::reader::Recording;
use crate::states::{RecordedState, RecordedStates};
use crate::steps::{StepConverter, StepTarget};

/// The part of a recording to play, in nanoseconds since the first state.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TimeRange {
    pub from: u64,
    pub to: u64,
}

impl TimeRange {
    /// The whole recording.
    pub const ALL: Self = Self { from: 0, to: u64::MAX };
}

/// A step of a replay.
pub(crate) struct TimedStep {
    /// Nanoseconds since the first step.
    pub(crate) time: u64,
    pub(crate) step: Step,
    /// Number of frames that show the step.
    pub(crate) frames: u64,
}

/// Reads states and converts them to steps.
pub(crate) struct StepSource {
    states: RecordedStates,
    converter: StepConverter,
    numbers: StepNumbers,
    sampler: Option<Sampler>,
    /// Time of the first state.
    start: Option<u64>,
}

impl StepSource {
    /// Without `frame_interval`, every state is a step. With one, in nanoseconds, only the states that are current at
    /// multiples of it are steps.
    pub(crate) fn new(
        recording: &Recording,
        target: StepTarget,
        range: TimeRange,
        frame_interval: Option<u64>,
    ) -> Result<Self> {
        Ok(Self {
            states: recording.states(range.from, range.to)?,
            converter: StepConverter::new(recording.description(), target),
            numbers: StepNumbers::default(),
            sampler: frame_interval.map(Sampler::new),
            start: None,
        })
    }

    /// Begins again with the first state of the range. Step numbers continue.
    pub(crate) fn rewind(&mut self, recording: &Recording, range: TimeRange) -> Result<()> {
        self.states = recording.states(range.from, range.to)?;
        self.start = None;
        Ok(())
    }

    pub(crate) fn next(&mut self) -> Result<Option<TimedStep>> {
        let sampled = match &mut self.sampler {
            Some(sampler) => sampler.next(&mut self.states)?,
            None => self.states.next()?.map(|state| SampledState { state, frames: 1 }),
        };
        let Some(SampledState { state, frames }) = sampled else { return Ok(None) };
        let start = *self.start.get_or_insert(state.time);
        let number = self.numbers.next(state.state.step.number)?;
        let step = self.converter.convert(&state, number, self.sampler.is_some())?;
        Ok(Some(TimedStep { time: state.time - start, step, frames }))
    }
}

/// Step numbers increase within a stream. Those of a recording may start again with a new run.
#[derive(Debug, Default)]
struct StepNumbers {
    last: Option<u64>,
    /// Is added to recorded numbers.
    offset: u64,
}

impl StepNumbers {
    fn next(&mut self, recorded: u64) -> Result<u64> {
        let mut number = recorded.wrapping_add(self.offset);
        if let Some(last) = self.last.filter(|last| number <= *last) {
            let next = last.checked_add(1);
            number = next.ok_or_else(|| Error::invalid("step.number", "below 2^64", "2^64"))?;
            self.offset = number.wrapping_sub(recorded);
        }
        self.last = Some(number);
        Ok(number)
    }
}

/// A state and the number of frames that show it.
struct SampledState {
    state: RecordedState,
    frames: u64,
}

/// Selects the states that are current at equidistant times, beginning with the time of the first state.
struct Sampler {
    interval: u64,
    /// The state before the next one.
    current: Option<RecordedState>,
    next_frame_time: Option<u64>,
}

impl Sampler {
    const fn new(interval: u64) -> Self {
        Self { interval, current: None, next_frame_time: None }
    }

    fn next(&mut self, states: &mut RecordedStates) -> Result<Option<SampledState>> {
        loop {
            let next = states.next()?;
            let Some(current) = self.current.take() else {
                if next.is_none() {
                    return Ok(None);
                }
                self.current = next;
                continue;
            };
            let frame_time = *self.next_frame_time.get_or_insert(current.time);
            // Frames until the next state; the last state has the frame at its own time or the next frame.
            let end = next.as_ref().map_or(current.time + 1, |next| next.time);
            let frames = end.saturating_sub(frame_time).div_ceil(self.interval);
            self.next_frame_time = Some(frame_time.saturating_add(frames.saturating_mul(self.interval)));
            self.current = next;
            if frames > 0 {
                return Ok(Some(SampledState { state: current, frames }));
            }
            match &mut self.current {
                Some(next) => next.sent_values.origins |= current.sent_values.origins,
                None => return Ok(None),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn step_numbers_continue_after_a_new_run() {
        let mut numbers = StepNumbers::default();
        let sent: Vec<u64> = [5, 6, 9, 0, 1, 4, u64::MAX - 20]
            .into_iter()
            .map(|number| numbers.next(number).expect("a number"))
            .collect();
        assert_eq!(sent[..6], [5, 6, 9, 10, 11, 14]);
        assert_eq!(sent[6], u64::MAX - 10);
        let mut numbers = StepNumbers::default();
        assert_eq!(numbers.next(u64::MAX).expect("a number"), u64::MAX);
        assert!(numbers.next(0).is_err());
    }
}
