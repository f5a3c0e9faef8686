//! The outputs of a scene that the device has not finished: pictures, picks and copies of vertices. The readers wait for
//! an output themselves. The scene only counts the outputs, to bound the work of the device, and acknowledges a step
//! after its last one.
//!
//! Outputs of a step are produced while the next step is computed. In the diagrams, `k` is the number of a step, `read`
//! is the transfer of the pixels to host-readable memory, and `upload` is the copy of the new vertices into OpenGL
//! buffers.
//!
//! A deformer whose vertices are uploaded computes concurrently with the frames in flight:
//!
//! ```text
//! deformer  [deform k+1  ]          [deform k+2  ]
//! OpenGL    [draw k][read k][upload][draw k+1][read k+1][upload]
//! ```
//!
//! If OpenGL and CUDA share memory, CUDA deforms steps while OpenGL draws earlier frames, and its copy engine reads the
//! frames before them. CUDA deforms two steps at once if the second one is queued, because the GPU needs 0.2 ms for each
//! change between the contexts of OpenGL and CUDA. OpenGL copies the vertices of a step at the beginning of its frame, so
//! that four sets of vertices are sufficient.
//!
//! ```text
//! OpenGL       [draw k][draw k+1]                [draw k+2][draw k+3]
//! CUDA                           [deform k+2, k+3]                   [deform k+4, k+5]
//! copy engine          [read k]  [read k+1]                [read k+2][read k+3]
//! ```
//!
//! If CUDA maps OpenGL's buffers instead, a step and the copy of its vertices are submitted together while every step
//! is drawn. Both wait for all earlier OpenGL commands, including the readback of frame k, so only the host's work
//! overlaps. Frame k is copied out, encoded and sent while frame k+1 is drawn.
//!
//! ```text
//! device    [draw k][read k][deform k+1, copy] [draw k+1][read k+1][deform k+2, copy]
//! host      [submit k+1]                       [submit k+2]
//! frame k                                      [copy out, encode, send]
//! ```

use std::collections::VecDeque;

use super::step_queue::CompletedStep;
use crate::engine::device::command::CommandEnd;
use crate::engine::device::device_loss::DeviceLoss;

/// An output in flight.
struct OutputInFlight {
    /// The scene's step count when the output was started.
    step_count: u64,
    end: CommandEnd,
    /// The steps that are acknowledged after this output and all earlier ones.
    steps_to_acknowledge: Vec<CompletedStep>,
}

/// Outputs in flight, oldest first: those of the current step and of the step before it.
pub(super) struct OutputsInFlight {
    outputs: VecDeque<OutputInFlight>,
    loss: DeviceLoss,
}

impl OutputsInFlight {
    pub(super) const fn new(loss: DeviceLoss) -> Self {
        Self { outputs: VecDeque::new(), loss }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.outputs.is_empty()
    }

    /// Number of outputs in flight of the scene's `step_count`-th step.
    pub(super) fn count_of(&self, step_count: u64) -> usize {
        self.outputs.iter().filter(|output| output.step_count == step_count).count()
    }

    /// Adds an output of the scene's `step_count`-th step. `end` is the end of its command to the device.
    pub(super) fn push(&mut self, step_count: u64, end: CommandEnd) {
        self.outputs.push_back(OutputInFlight { step_count, end, steps_to_acknowledge: Vec::new() });
    }

    /// Acknowledges a step after all outputs that are in flight.
    pub(super) fn acknowledge(&mut self, step: CompletedStep) {
        match self.outputs.back_mut() {
            Some(newest) => newest.steps_to_acknowledge.push(step),
            None => step.acknowledge(),
        }
    }

    /// Waits for the oldest output and removes it. Returns at once if there is none. Cancel-safe.
    pub(super) async fn finish_oldest(&mut self) {
        if let Some(oldest) = self.outputs.front_mut() {
            tokio::select! {
                // The end of a command is that its sender is dropped.
                _ = &mut oldest.end => {}
                // A device thread in a call that does not return ends no command.
                _ = self.loss.wait() => {}
            }
        }
        let steps = self.outputs.pop_front().map(|output| output.steps_to_acknowledge);
        steps.into_iter().flatten().for_each(CompletedStep::acknowledge);
    }

    /// Waits for all outputs of the steps before the scene's `step_count`-th step.
    pub(super) async fn finish_before(&mut self, step_count: u64) {
        while self.outputs.front().is_some_and(|output| output.step_count < step_count) {
            self.finish_oldest().await;
        }
    }

    /// Waits for all outputs.
    pub(super) async fn finish_all(&mut self) {
        self.finish_before(u64::MAX).await;
    }
}
