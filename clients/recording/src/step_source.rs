//! The steps of a replay, with the times at which they are due.

use modalcast_client::Step;

use crate::error::{Error, Result};
use crate::reader::Recording;
use crate::states::{RecordedState, RecordedStates};
use crate::steps::{StepConverter, StepTarget};

/// The part of a recording to play, in nanoseconds since the first state. Begins with the state that is current at
/// `from`, and ends with the last state at or before `to`.
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
    /// Without `frame_rate`, every state is a step. With one, in frames per second, only the states that are current at
    /// the times of frames are steps.
    pub(crate) fn new(
        recording: &Recording,
        target: StepTarget,
        range: TimeRange,
        frame_rate: Option<f64>,
    ) -> Result<Self> {
        Ok(Self {
            states: recording.states(range.from, range.to)?,
            converter: StepConverter::new(recording.description(), target),
            numbers: StepNumbers::default(),
            sampler: frame_rate.map(Sampler::new),
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

/// The numbers of the sent steps. They increase within a stream, whereas recorded numbers may start again with a new
/// run.
#[derive(Debug, Default)]
struct StepNumbers {
    last: Option<u64>,
    /// Added to recorded numbers.
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

/// Selects the states that are current at the times of frames. The first frame is at the time of the first state.
struct Sampler {
    /// Frames per second.
    rate: f64,
    /// The last state that was read. Its frames are counted when the next one is read.
    current: Option<RecordedState>,
    /// Time of the first frame in nanoseconds.
    start: Option<u64>,
    /// Index of the next frame.
    next_frame: u64,
}

impl Sampler {
    const fn new(rate: f64) -> Self {
        Self { rate, current: None, start: None, next_frame: 0 }
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
            let start = *self.start.get_or_insert(current.time);
            // The last state is shown by the frame at its time.
            let end = next.as_ref().map_or(current.time + 1, |next| next.time);
            let end_frame = frames_before(end - start, self.rate).max(self.next_frame);
            let frames = end_frame - self.next_frame;
            self.next_frame = end_frame;
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

/// The number of frames before a time in nanoseconds. Frame k is at k / rate seconds, rounded to nanoseconds, so that
/// frames at the rate of the states show one state each.
fn frames_before(time: u64, rate: f64) -> u64 {
    let frame_time = |frame: u64| (frame as f64 / rate * 1e9).round() as u64;
    let mut frame = (time as f64 * 1e-9 * rate) as u64;
    while frame > 0 && frame_time(frame - 1) >= time {
        frame -= 1;
    }
    // Adds at most one frame: the estimate is rounded down, and the count is rounded up. The second condition ends the
    // loop where f64 cannot distinguish the times of two frames.
    while frame_time(frame) < time && frame_time(frame + 1) > frame_time(frame) {
        frame += 1;
    }
    frame
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_at_multiples_of_the_rate_are_counted_exactly() {
        for (rate, states_per_second) in [(48.0, 24.0), (30.0, 30.0), (60.0, 60.0), (25.0, 100.0), (1e3, 60.0)] {
            for state in 0..10_000_u64 {
                let time = (state as f64 / states_per_second * 1e9).round() as u64;
                let expected = (state as f64 * rate / states_per_second).ceil() as u64;
                // An exact multiple can be one unit in the last place above an integer.
                let is_exact = (state as f64 * rate) % states_per_second == 0.0;
                let expected =
                    if is_exact { (state as f64 * rate / states_per_second).round() as u64 } else { expected };
                assert_eq!(frames_before(time, rate), expected, "state {state} at {rate} Hz");
                if is_exact {
                    assert_eq!(frames_before(time + 1, rate), expected + 1, "state {state} at {rate} Hz");
                }
            }
        }
        assert_eq!((frames_before(0, 24.0), frames_before(1, 24.0)), (0, 1));
        // The computation also ends for times beyond the precision of f64.
        frames_before(u64::MAX, 1e3);
    }

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
