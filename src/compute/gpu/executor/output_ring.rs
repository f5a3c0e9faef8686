//! Multiple buffering of the outputs: chooses the output that a step writes, and records which domains of an output are
//! outdated. An output is one output set of `output`. This module does not access the device.
//!
//! While the host copies one output, the next step writes another, so neither waits. The other output shows an older
//! step. The ring records which domains have changed since then, and the step computes them again together with its own
//! changes. The second output is first used when a step begins while a readback is in flight.
//!
//! A step ahead is computed together with the step before it, and shown later. Until then, its output is not the one that is
//! shown.

use modalcast_model::scene::{DirtyDomains, SceneState};

/// The outputs, and the step that each of them shows.
#[derive(Debug)]
pub(super) struct OutputRing {
    /// The last step that began.
    last_step: u32,
    /// The last full step, which computed all domains.
    last_full_step: u32,
    /// Serial number of the state whose values are on the device; `None` after a fault.
    serial: Option<u64>,
    /// Whether the state of the current step directly follows the state on the device. Then its list of changes is
    /// complete.
    is_consecutive: bool,
    /// Index of the output of the last step that began.
    current_output: usize,
    /// Index of the output whose step is shown: the current one, unless a step ahead has begun.
    shown_index: usize,
    outputs: Vec<OutputState>,
    /// Maximum number of outputs.
    max_outputs: usize,
    /// Maximum number of domains in a list of changes.
    max_changes: usize,
    /// Number of readbacks so far.
    read_count: u64,
}

/// Content of one output.
#[derive(Debug, Default)]
struct OutputState {
    /// The last step that the output shows completely; 0 when its content is not valid.
    shown_step: u32,
    /// Domains that have changed since that step; `None` when they are too many for a list.
    dirty_domains: Option<Vec<u32>>,
    /// The last readback of the output, until the host knows that it has ended.
    read_id: Option<u64>,
    /// Whether OpenGL may still copy from the output.
    is_read_by_gl: bool,
}

impl OutputState {
    const fn is_being_read(&self) -> bool {
        self.read_id.is_some() || self.is_read_by_gl
    }
}

/// A step that begins.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct StepTarget {
    /// The output that the step writes.
    pub output: usize,
    /// Whether a copy may still be reading that output.
    pub is_being_read: bool,
    /// Number of the step.
    pub step: u32,
    /// The step that the output shows before this step.
    pub shown_step: u32,
    /// Outdated domains of the output if a partial step is possible; `None` requires a full step.
    pub dirty_domains: Option<Vec<u32>>,
}

impl OutputRing {
    /// `max_changes` is the maximum number of domains in a list of changes.
    pub(super) fn new(max_outputs: usize, max_changes: usize) -> Self {
        Self {
            last_step: 0,
            last_full_step: 0,
            serial: None,
            is_consecutive: false,
            current_output: 0,
            shown_index: 0,
            outputs: vec![OutputState::default()],
            max_outputs,
            max_changes,
            read_count: 0,
        }
    }

    /// The output that the next step writes: the current one, or another one while the current one is being read. If all
    /// are being read, the one that was written first.
    pub(super) fn next_output(&self) -> usize {
        if self.outputs[self.current_output].is_being_read() {
            self.ahead_output().unwrap_or((self.current_output + 1) % self.max_outputs)
        } else {
            self.current_output
        }
    }

    /// The output that a step ahead can write: one that is neither shown nor being read. `None` if there is no such output.
    pub(super) fn ahead_output(&self) -> Option<usize> {
        let count = self.outputs.len();
        let mut others = (1..count).map(|offset| (self.current_output + offset) % count);
        let free = others.find(|index| !self.outputs[*index].is_being_read());
        free.or_else(|| (count < self.max_outputs).then_some(count))
    }

    /// Disables outputs beyond the present ones, because the device has no memory for them.
    pub(super) fn forbid_more_outputs(&mut self) {
        self.max_outputs = self.outputs.len();
    }

    /// Begins a step of `state`, which writes [`Self::next_output`]. That output is shown, but is not valid until
    /// [`Self::end_step`].
    pub(super) fn begin_step(&mut self, state: &SceneState) -> StepTarget {
        if self.last_step == u32::MAX {
            // After the restart at 0, old step numbers on the device look new. The kernels then recompute unchanged
            // domains once; no result is wrong.
            self.invalidate();
            (self.last_step, self.last_full_step) = (0, 0);
        }
        let target = self.begin_step_in(self.next_output(), state);
        self.shown_index = target.output;
        target
    }

    /// Begins a step ahead, which writes [`Self::ahead_output`]. `None` if there is no such output.
    pub(super) fn begin_step_ahead(&mut self, state: &SceneState) -> Option<StepTarget> {
        let output = self.ahead_output().filter(|_| self.last_step < u32::MAX)?;
        Some(self.begin_step_in(output, state))
    }

    /// Shows the step ahead.
    pub(super) const fn show_step_ahead(&mut self) {
        self.shown_index = self.current_output;
    }

    fn begin_step_in(&mut self, output: usize, state: &SceneState) -> StepTarget {
        self.last_step += 1;
        self.current_output = output;
        if self.outputs.len() <= self.current_output {
            self.outputs.resize_with(self.current_output + 1, OutputState::default);
        }
        self.is_consecutive = self.serial.take().is_some_and(|serial| serial.checked_add(1) == Some(state.serial));
        let output_state = &mut self.outputs[self.current_output];
        let (shown_step, dirty_domains) =
            (std::mem::take(&mut output_state.shown_step), output_state.dirty_domains.take());
        let fits_list = |dirty_domains: &Vec<u32>| match &state.dirty_domains {
            DirtyDomains::Some(changed) => {
                self.is_consecutive && shown_step > 0 && changed.len() + dirty_domains.len() <= self.max_changes
            }
            DirtyDomains::All => false,
        };
        let dirty_domains = dirty_domains.filter(fits_list);
        StepTarget {
            output: self.current_output,
            is_being_read: output_state.read_id.is_some(),
            step: self.last_step,
            shown_step,
            dirty_domains,
        }
    }

    /// Returns the last full step, which is the current step if `is_full` is set.
    pub(super) const fn update_last_full_step(&mut self, is_full: bool) -> u32 {
        if is_full {
            self.last_full_step = self.last_step;
        }
        self.last_full_step
    }

    /// Ends the submission of a step. The output of the step then shows the step completely. In all other outputs, the
    /// domains that the step changed are outdated, also if the step was full.
    pub(super) fn end_step(&mut self, state: &SceneState) {
        self.serial = Some(state.serial);
        for (index, output) in self.outputs.iter_mut().enumerate() {
            if index == self.current_output {
                (output.shown_step, output.dirty_domains) = (self.last_step, Some(Vec::new()));
                continue;
            }
            match (&mut output.dirty_domains, &state.dirty_domains) {
                (Some(dirty_domains), DirtyDomains::Some(changed))
                    if self.is_consecutive && dirty_domains.len() + changed.len() <= self.max_changes =>
                {
                    dirty_domains.extend_from_slice(changed);
                }
                (dirty_domains, _) => *dirty_domains = None,
            }
        }
    }

    /// The output of the step that is shown; `None` if that step failed.
    pub(super) fn shown_output(&self) -> Option<usize> {
        (self.outputs[self.shown_index].shown_step > 0).then_some(self.shown_index)
    }

    /// The output of the last step that began; `None` if that step failed.
    pub(super) fn newest_output(&self) -> Option<usize> {
        (self.outputs[self.current_output].shown_step > 0).then_some(self.current_output)
    }

    /// Begins a readback of the output that is shown. Returns its number.
    pub(super) fn begin_read(&mut self) -> u64 {
        self.read_count += 1;
        self.outputs[self.shown_index].read_id = Some(self.read_count);
        self.read_count
    }

    /// Records that the host knows that a readback has ended.
    pub(super) fn end_read(&mut self, read_id: u64) {
        self.outputs
            .iter_mut()
            .filter(|output| output.read_id == Some(read_id))
            .for_each(|output| output.read_id = None);
    }

    /// Records whether OpenGL may still copy from an output.
    pub(super) fn set_read_by_gl(&mut self, output: usize, is_read: bool) {
        if let Some(output) = self.outputs.get_mut(output) {
            output.is_read_by_gl = is_read;
        }
    }

    /// Invalidates all outputs and the values on the device after a fault. Readbacks in flight continue.
    pub(super) fn invalidate(&mut self) {
        self.serial = None;
        self.outputs.iter_mut().for_each(|output| (output.shown_step, output.dirty_domains) = (0, None));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::tables::test_scenes::scene;

    /// A state whose changes since the state with the previous serial number are in `changed`.
    fn state(serial: u64, changed: &[u32]) -> SceneState {
        let mut state = SceneState::rest(&scene(&[(7, 1)]));
        (state.serial, state.dirty_domains) = (serial, DirtyDomains::Some(changed.to_vec()));
        state
    }

    /// Begins and ends a step as the deformer does.
    fn step(output_ring: &mut OutputRing, state: &SceneState) -> StepTarget {
        let target = output_ring.begin_step(state);
        assert_eq!(output_ring.shown_output(), None, "expected no valid output during a step");
        output_ring.update_last_full_step(target.dirty_domains.is_none());
        output_ring.end_step(state);
        assert_eq!(output_ring.shown_output(), Some(target.output));
        target
    }

    #[test]
    fn steps_without_readbacks_write_only_changes_to_one_output() {
        let mut output_ring = OutputRing::new(2, 10);
        let targets: Vec<StepTarget> = (1..5).map(|serial| step(&mut output_ring, &state(serial, &[3]))).collect();
        assert_eq!(targets[0].dirty_domains, None, "expected a full first step");
        for target in &targets[1..] {
            assert_eq!(
                (target.output, target.is_being_read, target.dirty_domains.as_deref()),
                (0, false, Some([].as_slice()))
            );
            assert_eq!(target.shown_step, target.step - 1);
        }
        // A readback that ended before the next step changes nothing.
        let read_id = output_ring.begin_read();
        output_ring.end_read(read_id);
        assert_eq!(step(&mut output_ring, &state(5, &[3])).output, 0);
    }

    #[test]
    fn outputs_alternate_while_they_are_read() {
        let mut output_ring = OutputRing::new(2, 10);
        step(&mut output_ring, &state(1, &[]));
        output_ring.begin_read();
        let second = step(&mut output_ring, &state(2, &[5]));
        assert_eq!((second.output, second.dirty_domains), (1, None), "expected a full step for a new output");
        output_ring.begin_read();
        let mut previous_changes = vec![5];
        for serial in 3..9 {
            let target = step(&mut output_ring, &state(serial, &[serial as u32]));
            output_ring.begin_read();
            assert_eq!(target.dirty_domains, Some(previous_changes), "step {serial}");
            // Step 1 wrote output 0, step 2 output 1, and so on.
            assert_eq!((target.output, target.shown_step), (usize::from(serial % 2 == 0), target.step - 2));
            assert!(target.is_being_read, "expected an unfinished copy");
            previous_changes = vec![serial as u32];
        }
    }

    #[test]
    fn outputs_alternate_while_opengl_copies_them() {
        let mut output_ring = OutputRing::new(2, 10);
        step(&mut output_ring, &state(1, &[]));
        output_ring.set_read_by_gl(0, true);
        // A vertex readback of the same output begins and ends meanwhile.
        let read_id = output_ring.begin_read();
        output_ring.end_read(read_id);
        assert_eq!(output_ring.next_output(), 1);
        assert_eq!(step(&mut output_ring, &state(2, &[5])).output, 1);
        output_ring.set_read_by_gl(0, false);
        assert_eq!(output_ring.next_output(), 1, "expected the current output, which OpenGL does not copy");
        output_ring.set_read_by_gl(1, true);
        let third = step(&mut output_ring, &state(3, &[6]));
        assert_eq!((third.output, third.is_being_read, third.dirty_domains), (0, false, Some(vec![5])));
    }

    #[test]
    fn idle_output_collects_changes_until_the_list_is_full() {
        // A list has at most 10 changes: one change by each of `steps` steps, and one by the step after them.
        for (steps, fits_list) in [(4, true), (9, true), (10, false)] {
            let mut output_ring = OutputRing::new(2, 10);
            // Make both outputs valid. Then end the readback of the current output, so that the next steps write only
            // the current output, and the other output is idle.
            for serial in 1..5 {
                step(&mut output_ring, &state(serial, &[]));
                output_ring.begin_read();
            }
            let idle = 1 - output_ring.current_output;
            output_ring.end_read(4); // the number of the last readback
            for serial in 5..5 + steps {
                assert_ne!(step(&mut output_ring, &state(serial, &[serial as u32])).output, idle);
            }
            output_ring.begin_read();
            let target = step(&mut output_ring, &state(5 + steps, &[1]));
            assert_eq!(target.output, idle);
            let expected: Vec<u32> = (5..5 + steps as u32).collect();
            assert_eq!(target.dirty_domains, fits_list.then_some(expected), "{steps} steps");
        }
    }

    #[test]
    fn ending_an_older_readback_does_not_end_a_later_one() {
        let mut output_ring = OutputRing::new(2, 10);
        step(&mut output_ring, &state(1, &[]));
        let first = output_ring.begin_read();
        step(&mut output_ring, &state(2, &[]));
        output_ring.begin_read();
        assert!(step(&mut output_ring, &state(3, &[])).is_being_read, "expected an unfinished first readback");
        let third = output_ring.begin_read();
        output_ring.end_read(first);
        assert_eq!(output_ring.next_output(), 1);
        output_ring.end_read(third);
        assert_eq!(output_ring.next_output(), 0);
    }

    #[test]
    fn every_output_gets_a_full_step_after_a_fault() {
        let mut output_ring = OutputRing::new(2, 10);
        for serial in 1..6 {
            step(&mut output_ring, &state(serial, &[1]));
            output_ring.begin_read();
        }
        output_ring.begin_step(&state(6, &[1]));
        output_ring.invalidate();
        assert_eq!(output_ring.shown_output(), None);
        // The first step in each of the two outputs is full.
        for (serial, is_full) in [(7, true), (8, true), (9, false), (10, false)] {
            let target = step(&mut output_ring, &state(serial, &[1]));
            assert_eq!(target.dirty_domains.is_none(), is_full, "state {serial}");
            output_ring.begin_read();
        }
    }

    #[test]
    fn nonconsecutive_states_and_step_overflow_need_full_steps() {
        let mut output_ring = OutputRing::new(2, 10);
        step(&mut output_ring, &state(1, &[]));
        // A serial number that skips one, is repeated, or decreases.
        for serial in [3, 3, 2] {
            assert_eq!(step(&mut output_ring, &state(serial, &[])).dirty_domains, None, "state {serial}");
        }
        assert!(step(&mut output_ring, &state(3, &[])).dirty_domains.is_some());
        let mut fully_changed_state = state(4, &[]);
        fully_changed_state.dirty_domains = DirtyDomains::All;
        assert_eq!(step(&mut output_ring, &fully_changed_state).dirty_domains, None);
        assert_eq!(output_ring.last_full_step, output_ring.last_step);
        output_ring.last_step = u32::MAX;
        let target = step(&mut output_ring, &state(5, &[]));
        assert_eq!((target.step, target.dirty_domains), (1, None));
    }

    #[test]
    fn step_ahead_is_shown_later_and_does_not_overwrite_what_is_read() {
        let mut output_ring = OutputRing::new(4, 10);
        step(&mut output_ring, &state(1, &[]));
        let mut shown = 0;
        for serial in (2..20).step_by(2) {
            // OpenGL still copies the two outputs of the last round.
            for output in 0..output_ring.outputs.len() {
                output_ring.set_read_by_gl(output, output == shown || output == output_ring.current_output);
            }
            let read = [shown, output_ring.current_output];
            let first = output_ring.begin_step(&state(serial, &[3]));
            output_ring.end_step(&state(serial, &[3]));
            let ahead = output_ring.begin_step_ahead(&state(serial + 1, &[4])).expect("expected a free output");
            output_ring.end_step(&state(serial + 1, &[4]));
            assert!(first.output != ahead.output && !read.contains(&first.output) && !read.contains(&ahead.output));
            assert_eq!(output_ring.shown_output(), Some(first.output), "step {serial}");
            let read_id = output_ring.begin_read();
            assert_eq!(output_ring.outputs[first.output].read_id, Some(read_id));
            output_ring.end_read(read_id);
            shown = first.output;
            output_ring.show_step_ahead();
            assert_eq!(output_ring.shown_output(), Some(ahead.output), "step {serial}");
            // The first step in a new output is full. Later ones add the changes since the output was written.
            assert_eq!(first.dirty_domains.is_some(), serial > 2, "step {serial}: {first:?}");
        }
        assert_eq!(output_ring.outputs.len(), 4);
        // Without a free output, there is no step ahead, and the next step waits for the output that was written first.
        (0..4).for_each(|output| output_ring.set_read_by_gl(output, true));
        assert_eq!(output_ring.begin_step_ahead(&state(20, &[])), None);
        assert_eq!(output_ring.next_output(), (output_ring.current_output + 1) % 4);
        let mut single = OutputRing::new(1, 10);
        step(&mut single, &state(1, &[]));
        assert_eq!(single.begin_step_ahead(&state(2, &[])), None);
    }

    #[test]
    fn single_output_is_reused_while_it_is_being_read() {
        for (max_outputs, forbid_more_outputs) in [(1, false), (2, true)] {
            let mut output_ring = OutputRing::new(max_outputs, 10);
            step(&mut output_ring, &state(1, &[]));
            output_ring.begin_read();
            if forbid_more_outputs {
                output_ring.forbid_more_outputs();
            }
            let target = step(&mut output_ring, &state(2, &[4]));
            assert_eq!((target.output, target.is_being_read, target.dirty_domains), (0, true, Some(vec![])));
        }
    }
}
