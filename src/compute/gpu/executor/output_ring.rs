//! Double buffering of the outputs: which output a step writes, and which domains that output lacks besides the step's
//! own changes. Pure.
//!
//! While the host copies one output, the next step writes another, so neither waits. The other output shows an older
//! step. The rotation records which domains changed since then, and the step computes them again together with its own
//! changes. As long as no readback is in flight when a step begins, there is one output.

use modalcast_model::scene::{DirtyDomains, SceneState};

/// The steps, the outputs, and the step that each output shows.
#[derive(Debug)]
pub(super) struct OutputRing {
    /// The last step that began.
    last_step: u32,
    /// The last step that changed all domains.
    last_full_step: u32,
    /// Serial number of the state whose values are on the device; `None` after a fault.
    serial: Option<u64>,
    /// Whether the current step directly follows that state, so that its list of changes is complete.
    is_consecutive: bool,
    /// The output that the last step wrote.
    at: usize,
    outputs: Vec<OutputState>,
    /// Maximum number of outputs.
    max_outputs: usize,
    /// Maximum number of domains in a list of changes.
    max_changes: usize,
    /// Number of readbacks that began.
    reads: u64,
}

/// Content of one output.
#[derive(Debug, Default)]
struct OutputState {
    /// The last step that the output shows completely; 0 when its content is not valid.
    shown: u32,
    /// Domains that changed since then; `None` when they are too many for a list.
    dirty_domains: Option<Vec<u32>>,
    /// The last readback of the output, until the host knows that it has ended.
    read_id: Option<u64>,
}

/// A step that begins.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct StepTarget {
    /// The output that the step writes.
    pub output: usize,
    /// Whether a copy may still be reading that output.
    pub is_being_read: bool,
    pub step: u32,
    /// The step that the output shows.
    pub shown: u32,
    /// Domains that the output lacks, if a partial step is possible; `None` requires a full step.
    pub dirty_domains: Option<Vec<u32>>,
}

impl OutputRing {
    /// `max_changes`: maximum number of domains in a list of changes.
    pub(super) fn new(max_outputs: usize, max_changes: usize) -> Self {
        Self {
            last_step: 0,
            last_full_step: 0,
            serial: None,
            is_consecutive: false,
            at: 0,
            outputs: vec![OutputState::default()],
            max_outputs,
            max_changes,
            reads: 0,
        }
    }

    /// The output that the next step writes: the other one while the last one is being read.
    pub(super) fn next_output(&self) -> usize {
        if self.outputs[self.at].read_id.is_some() { (self.at + 1) % self.max_outputs } else { self.at }
    }

    /// Disables the second output, because the device has no memory for it.
    pub(super) fn forbid_more_outputs(&mut self) {
        self.max_outputs = self.at + 1;
    }

    /// Begins a step of `state`, which writes [`Self::next_output`]. That output is not valid until [`Self::end`].
    pub(super) fn begin(&mut self, state: &SceneState) -> StepTarget {
        if self.last_step == u32::MAX {
            // The old stamps on the device then look new, which costs work once and is never wrong.
            self.invalidate();
            (self.last_step, self.last_full_step) = (0, 0);
        }
        self.last_step += 1;
        self.at = self.next_output();
        if self.outputs.len() <= self.at {
            self.outputs.resize_with(self.at + 1, OutputState::default);
        }
        self.is_consecutive = self.serial.take().is_some_and(|serial| serial.checked_add(1) == Some(state.serial));
        let age = &mut self.outputs[self.at];
        let (shown, dirty_domains) = (std::mem::take(&mut age.shown), age.dirty_domains.take());
        let fits = |dirty_domains: &Vec<u32>| match &state.changed {
            DirtyDomains::Some(list) => {
                self.is_consecutive && shown > 0 && list.len() + dirty_domains.len() <= self.max_changes
            }
            DirtyDomains::All => false,
        };
        let dirty_domains = dirty_domains.filter(fits);
        StepTarget { output: self.at, is_being_read: age.read_id.is_some(), step: self.last_step, shown, dirty_domains }
    }

    /// The last step that changed all domains; the current step if `all` is set.
    pub(super) const fn last_full_step(&mut self, all: bool) -> u32 {
        if all {
            self.last_full_step = self.last_step;
        }
        self.last_full_step
    }

    /// Ends the submission of a step: its output shows it completely, and all other outputs lack the domains that it
    /// changed, whether the step was full or partial.
    pub(super) fn end(&mut self, state: &SceneState) {
        self.serial = Some(state.serial);
        for (index, age) in self.outputs.iter_mut().enumerate() {
            if index == self.at {
                (age.shown, age.dirty_domains) = (self.last_step, Some(Vec::new()));
                continue;
            }
            match (&mut age.dirty_domains, &state.changed) {
                (Some(dirty_domains), DirtyDomains::Some(list))
                    if self.is_consecutive && dirty_domains.len() + list.len() <= self.max_changes =>
                {
                    dirty_domains.extend_from_slice(list);
                }
                (dirty_domains, _) => *dirty_domains = None,
            }
        }
    }

    /// The output that shows the last step, unless that step failed.
    pub(super) fn shown(&self) -> Option<usize> {
        (self.outputs[self.at].shown > 0).then_some(self.at)
    }

    /// Begins a readback of the last output. Returns its number.
    pub(super) fn begin_read(&mut self) -> u64 {
        self.reads += 1;
        self.outputs[self.at].read_id = Some(self.reads);
        self.reads
    }

    /// Records that the host has seen the end of a readback.
    pub(super) fn end_read(&mut self, number: u64) {
        self.outputs.iter_mut().filter(|age| age.read_id == Some(number)).for_each(|age| age.read_id = None);
    }

    /// Invalidates all outputs and the values on the device after a fault. Readbacks in flight continue.
    pub(super) fn invalidate(&mut self) {
        self.serial = None;
        self.outputs.iter_mut().for_each(|age| (age.shown, age.dirty_domains) = (0, None));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::tables::test_scenes::scene;

    /// A state that follows the previous one by these changes.
    fn state(serial: u64, changed: &[u32]) -> SceneState {
        let mut state = SceneState::rest(&scene(&[(7, 1)], false, false));
        (state.serial, state.changed) = (serial, DirtyDomains::Some(changed.to_vec()));
        state
    }

    /// Makes a step as the deformer does: partial where the turn allows it.
    fn step(output_ring: &mut OutputRing, state: &SceneState) -> StepTarget {
        let turn = output_ring.begin(state);
        assert_eq!(output_ring.shown(), None, "half a step is shown to nobody");
        output_ring.last_full_step(turn.dirty_domains.is_none());
        output_ring.end(state);
        assert_eq!(output_ring.shown(), Some(turn.output));
        turn
    }

    #[test]
    fn without_readers_there_is_one_output_and_each_step_adds_its_own_changes_alone() {
        let mut output_ring = OutputRing::new(2, 10);
        let turns: Vec<StepTarget> = (1..5).map(|serial| step(&mut output_ring, &state(serial, &[3]))).collect();
        assert_eq!(turns[0].dirty_domains, None, "the first is whole");
        for turn in &turns[1..] {
            assert_eq!(
                (turn.output, turn.is_being_read, turn.dirty_domains.as_deref()),
                (0, false, Some([].as_slice()))
            );
            assert_eq!(turn.shown, turn.step - 1);
        }
        // A readback that ended before the next step changes nothing.
        let number = output_ring.begin_read();
        output_ring.end_read(number);
        assert_eq!(step(&mut output_ring, &state(5, &[3])).output, 0);
    }

    #[test]
    fn outputs_take_turns_while_they_are_read_and_each_gets_what_it_lacks() {
        let mut output_ring = OutputRing::new(2, 10);
        step(&mut output_ring, &state(1, &[]));
        output_ring.begin_read();
        let second = step(&mut output_ring, &state(2, &[5]));
        assert_eq!((second.output, second.dirty_domains), (1, None), "a new output is written whole");
        output_ring.begin_read();
        let mut last = vec![5];
        for serial in 3..9 {
            let turn = step(&mut output_ring, &state(serial, &[serial as u32]));
            output_ring.begin_read();
            assert_eq!(turn.dirty_domains, Some(last), "step {serial}");
            assert_eq!((turn.output, turn.shown), (usize::from(serial % 2 == 0), turn.step - 2));
            assert!(turn.is_being_read, "nobody has waited for its copy");
            last = vec![serial as u32];
        }
    }

    #[test]
    fn an_output_that_waits_collects_changes_until_they_are_too_many() {
        for (steps, listed) in [(4, true), (9, true), (10, false)] {
            let mut output_ring = OutputRing::new(2, 10);
            // Make both outputs valid, then leave one of them idle.
            for serial in 1..5 {
                step(&mut output_ring, &state(serial, &[]));
                output_ring.begin_read();
            }
            let idle = 1 - output_ring.at;
            output_ring.end_read(4);
            for serial in 5..5 + steps {
                assert_ne!(step(&mut output_ring, &state(serial, &[serial as u32])).output, idle);
            }
            output_ring.begin_read();
            let turn = step(&mut output_ring, &state(5 + steps, &[1]));
            assert_eq!(turn.output, idle);
            let want: Vec<u32> = (5..5 + steps as u32).collect();
            assert_eq!(turn.dirty_domains, listed.then_some(want), "{steps} steps");
        }
    }

    #[test]
    fn a_reading_that_was_overtaken_ends_no_later_one() {
        let mut output_ring = OutputRing::new(2, 10);
        step(&mut output_ring, &state(1, &[]));
        let first = output_ring.begin_read();
        step(&mut output_ring, &state(2, &[]));
        output_ring.begin_read();
        assert!(step(&mut output_ring, &state(3, &[])).is_being_read, "nobody has waited for the first");
        let third = output_ring.begin_read();
        output_ring.end_read(first);
        assert_eq!(output_ring.next_output(), 1);
        output_ring.end_read(third);
        assert_eq!(output_ring.next_output(), 0);
    }

    #[test]
    fn after_a_fault_every_output_is_written_whole() {
        let mut output_ring = OutputRing::new(2, 10);
        for serial in 1..6 {
            step(&mut output_ring, &state(serial, &[1]));
            output_ring.begin_read();
        }
        output_ring.begin(&state(6, &[1]));
        output_ring.invalidate();
        assert_eq!(output_ring.shown(), None);
        for (serial, whole) in [(7, true), (8, true), (9, false), (10, false)] {
            let turn = step(&mut output_ring, &state(serial, &[1]));
            assert_eq!(turn.dirty_domains.is_none(), whole, "state {serial}");
            output_ring.begin_read();
        }
    }

    #[test]
    fn states_that_do_not_follow_are_whole_and_so_is_the_step_after_the_last_number() {
        let mut output_ring = OutputRing::new(2, 10);
        step(&mut output_ring, &state(1, &[]));
        for serial in [3, 3, 2] {
            assert_eq!(step(&mut output_ring, &state(serial, &[])).dirty_domains, None, "state {serial}");
        }
        assert!(step(&mut output_ring, &state(3, &[])).dirty_domains.is_some());
        let mut all = state(4, &[]);
        all.changed = DirtyDomains::All;
        assert_eq!(step(&mut output_ring, &all).dirty_domains, None);
        assert_eq!(output_ring.last_full_step, output_ring.last_step);
        output_ring.last_step = u32::MAX;
        let turn = step(&mut output_ring, &state(5, &[]));
        assert_eq!((turn.step, turn.dirty_domains), (1, None));
    }

    #[test]
    fn without_room_for_a_second_output_the_first_is_waited_for() {
        for (most, forbid_more_outputs) in [(1, false), (2, true)] {
            let mut output_ring = OutputRing::new(most, 10);
            step(&mut output_ring, &state(1, &[]));
            output_ring.begin_read();
            if forbid_more_outputs {
                output_ring.forbid_more_outputs();
            }
            let turn = step(&mut output_ring, &state(2, &[4]));
            assert_eq!((turn.output, turn.is_being_read, turn.dirty_domains), (0, true, Some(vec![])));
        }
    }
}
