//! Double buffering of the outputs: which output a step writes, and which domains that output lacks besides the step's
//! own changes. Pure.
//!
//! While the host copies one output, the next step writes another, so neither waits. The other output shows an older
//! step. The rotation records which domains changed since then, and the step computes them again together with its own
//! changes. As long as no readback is in flight when a step begins, there is one output.

use modalcast_model::scene::{Changed, State};

/// The steps, the outputs, and the step that each output shows.
#[derive(Debug)]
pub(super) struct Rotation {
    /// The last step that began.
    begun: u32,
    /// The last step that changed all domains.
    everything: u32,
    /// Serial number of the state whose values are on the device; `None` after a fault.
    serial: Option<u64>,
    /// Whether the current step directly follows that state, so that its list of changes is complete.
    follows: bool,
    /// The output that the last step wrote.
    at: usize,
    outputs: Vec<Age>,
    /// Maximum number of outputs.
    most_outputs: usize,
    /// Maximum number of domains in a list of changes.
    most_changes: usize,
    /// Number of readbacks that began.
    readings: u64,
}

/// Content of one output.
#[derive(Debug, Default)]
struct Age {
    /// The last step that the output shows completely; 0 when its content is not valid.
    shown: u32,
    /// Domains that changed since then; `None` when they are too many for a list.
    behind: Option<Vec<u32>>,
    /// The last readback of the output, until the host knows that it has ended.
    reading: Option<u64>,
}

/// A step that begins.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Turn {
    /// The output that the step writes.
    pub output: usize,
    /// Whether a copy may still be reading that output.
    pub is_read: bool,
    pub step: u32,
    /// The step that the output shows.
    pub shown: u32,
    /// Domains that the output lacks, if a partial step is possible; `None` requires a full step.
    pub behind: Option<Vec<u32>>,
}

impl Rotation {
    /// `most_changes`: maximum number of domains in a list of changes.
    pub(super) fn new(most_outputs: usize, most_changes: usize) -> Self {
        Self {
            begun: 0,
            everything: 0,
            serial: None,
            follows: false,
            at: 0,
            outputs: vec![Age::default()],
            most_outputs,
            most_changes,
            readings: 0,
        }
    }

    /// The output that the next step writes: the other one while the last one is being read.
    pub(super) fn next_output(&self) -> usize {
        if self.outputs[self.at].reading.is_some() { (self.at + 1) % self.most_outputs } else { self.at }
    }

    /// Disables the second output, because the device has no memory for it.
    pub(super) fn stay(&mut self) {
        self.most_outputs = self.at + 1;
    }

    /// Begins a step of `state`, which writes [`Self::next_output`]. That output is not valid until [`Self::end`].
    pub(super) fn begin(&mut self, state: &State) -> Turn {
        if self.begun == u32::MAX {
            // The old stamps on the device then look new, which costs work once and is never wrong.
            self.forget();
            (self.begun, self.everything) = (0, 0);
        }
        self.begun += 1;
        self.at = self.next_output();
        if self.outputs.len() <= self.at {
            self.outputs.resize_with(self.at + 1, Age::default);
        }
        self.follows = self.serial.take().is_some_and(|serial| serial.checked_add(1) == Some(state.serial));
        let age = &mut self.outputs[self.at];
        let (shown, behind) = (std::mem::take(&mut age.shown), age.behind.take());
        let fits = |behind: &Vec<u32>| match &state.changed {
            Changed::Some(list) => self.follows && shown > 0 && list.len() + behind.len() <= self.most_changes,
            Changed::All => false,
        };
        let behind = behind.filter(fits);
        Turn { output: self.at, is_read: age.reading.is_some(), step: self.begun, shown, behind }
    }

    /// The last step that changed all domains; the current step if `all` is set.
    pub(super) const fn everything(&mut self, all: bool) -> u32 {
        if all {
            self.everything = self.begun;
        }
        self.everything
    }

    /// Ends the submission of a step: its output shows it completely, and all other outputs lack the domains that it
    /// changed, whether the step was full or partial.
    pub(super) fn end(&mut self, state: &State) {
        self.serial = Some(state.serial);
        for (index, age) in self.outputs.iter_mut().enumerate() {
            if index == self.at {
                (age.shown, age.behind) = (self.begun, Some(Vec::new()));
                continue;
            }
            match (&mut age.behind, &state.changed) {
                (Some(behind), Changed::Some(list))
                    if self.follows && behind.len() + list.len() <= self.most_changes =>
                {
                    behind.extend_from_slice(list);
                }
                (behind, _) => *behind = None,
            }
        }
    }

    /// The output that shows the last step, unless that step failed.
    pub(super) fn shown(&self) -> Option<usize> {
        (self.outputs[self.at].shown > 0).then_some(self.at)
    }

    /// Begins a readback of the last output. Returns its number.
    pub(super) fn read(&mut self) -> u64 {
        self.readings += 1;
        self.outputs[self.at].reading = Some(self.readings);
        self.readings
    }

    /// Records that the host has seen the end of a readback.
    pub(super) fn has_read(&mut self, number: u64) {
        self.outputs.iter_mut().filter(|age| age.reading == Some(number)).for_each(|age| age.reading = None);
    }

    /// Invalidates all outputs and the values on the device after a fault. Readbacks in flight continue.
    pub(super) fn forget(&mut self) {
        self.serial = None;
        self.outputs.iter_mut().for_each(|age| (age.shown, age.behind) = (0, None));
    }
}

#[cfg(test)]
mod tests {
    use super::super::pack::tests::scene;
    use super::*;

    /// A state that follows the previous one by these changes.
    fn state(serial: u64, changed: &[u32]) -> State {
        let mut state = State::rest(&scene(&[(7, 1)], false, false));
        (state.serial, state.changed) = (serial, Changed::Some(changed.to_vec()));
        state
    }

    /// Makes a step as the deformer does: partial where the turn allows it.
    fn step(rotation: &mut Rotation, state: &State) -> Turn {
        let turn = rotation.begin(state);
        assert_eq!(rotation.shown(), None, "half a step is shown to nobody");
        rotation.everything(turn.behind.is_none());
        rotation.end(state);
        assert_eq!(rotation.shown(), Some(turn.output));
        turn
    }

    #[test]
    fn without_readers_there_is_one_output_and_each_step_adds_its_own_changes_alone() {
        let mut rotation = Rotation::new(2, 10);
        let turns: Vec<Turn> = (1..5).map(|serial| step(&mut rotation, &state(serial, &[3]))).collect();
        assert_eq!(turns[0].behind, None, "the first is whole");
        for turn in &turns[1..] {
            assert_eq!((turn.output, turn.is_read, turn.behind.as_deref()), (0, false, Some([].as_slice())));
            assert_eq!(turn.shown, turn.step - 1);
        }
        // A readback that ended before the next step changes nothing.
        let number = rotation.read();
        rotation.has_read(number);
        assert_eq!(step(&mut rotation, &state(5, &[3])).output, 0);
    }

    #[test]
    fn outputs_take_turns_while_they_are_read_and_each_gets_what_it_lacks() {
        let mut rotation = Rotation::new(2, 10);
        step(&mut rotation, &state(1, &[]));
        rotation.read();
        let second = step(&mut rotation, &state(2, &[5]));
        assert_eq!((second.output, second.behind), (1, None), "a new output is written whole");
        rotation.read();
        let mut last = vec![5];
        for serial in 3..9 {
            let turn = step(&mut rotation, &state(serial, &[serial as u32]));
            rotation.read();
            assert_eq!(turn.behind, Some(last), "step {serial}");
            assert_eq!((turn.output, turn.shown), (usize::from(serial % 2 == 0), turn.step - 2));
            assert!(turn.is_read, "nobody has waited for its copy");
            last = vec![serial as u32];
        }
    }

    #[test]
    fn an_output_that_waits_collects_changes_until_they_are_too_many() {
        for (steps, listed) in [(4, true), (9, true), (10, false)] {
            let mut rotation = Rotation::new(2, 10);
            // Make both outputs valid, then leave one of them idle.
            for serial in 1..5 {
                step(&mut rotation, &state(serial, &[]));
                rotation.read();
            }
            let idle = 1 - rotation.at;
            rotation.has_read(4);
            for serial in 5..5 + steps {
                assert_ne!(step(&mut rotation, &state(serial, &[serial as u32])).output, idle);
            }
            rotation.read();
            let turn = step(&mut rotation, &state(5 + steps, &[1]));
            assert_eq!(turn.output, idle);
            let want: Vec<u32> = (5..5 + steps as u32).collect();
            assert_eq!(turn.behind, listed.then_some(want), "{steps} steps");
        }
    }

    #[test]
    fn a_reading_that_was_overtaken_ends_no_later_one() {
        let mut rotation = Rotation::new(2, 10);
        step(&mut rotation, &state(1, &[]));
        let first = rotation.read();
        step(&mut rotation, &state(2, &[]));
        rotation.read();
        assert!(step(&mut rotation, &state(3, &[])).is_read, "nobody has waited for the first");
        let third = rotation.read();
        rotation.has_read(first);
        assert_eq!(rotation.next_output(), 1);
        rotation.has_read(third);
        assert_eq!(rotation.next_output(), 0);
    }

    #[test]
    fn after_a_fault_every_output_is_written_whole() {
        let mut rotation = Rotation::new(2, 10);
        for serial in 1..6 {
            step(&mut rotation, &state(serial, &[1]));
            rotation.read();
        }
        rotation.begin(&state(6, &[1]));
        rotation.forget();
        assert_eq!(rotation.shown(), None);
        for (serial, whole) in [(7, true), (8, true), (9, false), (10, false)] {
            let turn = step(&mut rotation, &state(serial, &[1]));
            assert_eq!(turn.behind.is_none(), whole, "state {serial}");
            rotation.read();
        }
    }

    #[test]
    fn states_that_do_not_follow_are_whole_and_so_is_the_step_after_the_last_number() {
        let mut rotation = Rotation::new(2, 10);
        step(&mut rotation, &state(1, &[]));
        for serial in [3, 3, 2] {
            assert_eq!(step(&mut rotation, &state(serial, &[])).behind, None, "state {serial}");
        }
        assert!(step(&mut rotation, &state(3, &[])).behind.is_some());
        let mut all = state(4, &[]);
        all.changed = Changed::All;
        assert_eq!(step(&mut rotation, &all).behind, None);
        assert_eq!(rotation.everything, rotation.begun);
        rotation.begun = u32::MAX;
        let turn = step(&mut rotation, &state(5, &[]));
        assert_eq!((turn.step, turn.behind), (1, None));
    }

    #[test]
    fn without_room_for_a_second_output_the_first_is_waited_for() {
        for (most, stay) in [(1, false), (2, true)] {
            let mut rotation = Rotation::new(most, 10);
            step(&mut rotation, &state(1, &[]));
            rotation.read();
            if stay {
                rotation.stay();
            }
            let turn = step(&mut rotation, &state(2, &[4]));
            assert_eq!((turn.output, turn.is_read, turn.behind), (0, true, Some(vec![])));
        }
    }
}
