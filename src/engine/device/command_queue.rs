//! The queue of commands from the scenes to the device thread: one bounded queue for each scene, served by deficit
//! round-robin ([`super::fair_queue`]).
//!
//! A scene may queue at most [`MAX_QUEUED_COMMANDS`] commands. A further command is rejected with `Busy`, except the
//! command that unloads the scene, so that no scene stays on the device. A command whose caller no longer waits leaves
//! the queue at once.

use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;

use super::command::{Command, SceneId};
use super::fair_queue::{CostClass, FairQueue, Taken, Ticket};
use crate::engine::lock::lock;
use modalcast_model::error::{Error, Result};

/// Maximum number of queued commands of a scene. The task of a scene queues at most the frames of two steps, each at
/// most [`modalcast_render::MAX_FRAMES_IN_FLIGHT`], and a few other commands.
pub(super) const MAX_QUEUED_COMMANDS: usize = 16;

/// Queued work of a scene.
pub(super) enum Work {
    Command(Command),
    /// A command whose textures and programs were prepared.
    Prepared(Command),
    /// The next draw step of the output that the device thread has begun for this scene (`partial_output`).
    Continue,
}

/// Work that was taken from the queue.
pub(super) type TakenWork = Taken<SceneId, Work>;

/// A queue between many senders and the device thread.
pub(super) struct CommandQueue {
    state: Mutex<State>,
    /// Notified when work is added or the queue is closed.
    changed: Condvar,
}

struct State {
    /// The account that pays for work is its scene.
    work: FairQueue<SceneId, Work>,
    is_closed: bool,
}

/// Removes a queued command when it is dropped. Does nothing if the device thread has taken the command.
pub(super) struct CancelGuard {
    queue: Arc<CommandQueue>,
    scene: SceneId,
    ticket: Ticket,
}

impl CommandQueue {
    pub(super) fn new() -> Arc<Self> {
        let state = State { work: FairQueue::new(), is_closed: false };
        Arc::new(Self { state: Mutex::new(state), changed: Condvar::new() })
    }

    /// Queues a command. If the command can be canceled, returns a guard, whose drop removes it from the queue.
    ///
    /// # Errors
    /// `Busy` when the scene has too many queued commands; `None` when the queue is closed.
    pub(super) fn push(self: &Arc<Self>, command: Command) -> Result<Option<CancelGuard>, Option<Error>> {
        let (scene, class) = (command.scene(), command.cost_class());
        let (is_bounded, is_cancellable) = (command.is_bounded(), command.is_cancellable());
        let mut state = lock(&self.state);
        if state.is_closed {
            return Err(None);
        }
        if is_bounded && state.work.len(scene) >= MAX_QUEUED_COMMANDS {
            return Err(Some(Error::Busy { queue: "device commands of the scene", limit: MAX_QUEUED_COMMANDS }));
        }
        let ticket = state.work.push(scene, class, Work::Command(command));
        drop(state);
        self.changed.notify_all();
        Ok(is_cancellable.then(|| CancelGuard { queue: Arc::clone(self), scene, ticket }))
    }

    /// Puts the unfinished output of a scene at the head of the scene's queue, because draw steps remain.
    pub(super) fn push_continuation(&self, scene: SceneId, class: CostClass) {
        lock(&self.state).work.push_front(scene, class, Work::Continue);
    }

    /// Puts taken work back at the head of its scene's queue.
    pub(super) fn return_taken(&self, taken: TakenWork) {
        lock(&self.state).work.return_taken(taken);
    }

    /// Takes the work whose turn it is and for which `can_run` returns true.
    pub(super) fn take(&self, can_run: impl Fn(SceneId, &Work) -> bool) -> Option<TakenWork> {
        lock(&self.state).work.take(can_run)
    }

    /// Waits until the queue has work, at most `limit`. Returns false if it is closed and empty.
    pub(super) fn wait(&self, limit: Option<Duration>) -> bool {
        let state = lock(&self.state);
        let has_nothing = |state: &mut State| state.work.is_empty() && !state.is_closed;
        let state = match limit {
            Some(limit) => {
                let waited = self.changed.wait_timeout_while(state, limit, has_nothing);
                waited.unwrap_or_else(PoisonError::into_inner).0
            }
            None => self.changed.wait_while(state, has_nothing).unwrap_or_else(PoisonError::into_inner),
        };
        !(state.is_closed && state.work.is_empty())
    }

    /// Rejects further commands. Queued commands remain.
    pub(super) fn close(&self) {
        lock(&self.state).is_closed = true;
        self.changed.notify_all();
    }

    /// Closes the queue and drops all commands; their callers get an error.
    pub(super) fn clear(&self) {
        self.close();
        let mut state = lock(&self.state);
        let work = std::mem::replace(&mut state.work, FairQueue::new());
        // Dropping a command drops its reply channel, which wakes its caller.
        drop(state);
        drop(work);
    }

    /// Charges a scene the measured time of work instead of the estimate `charged_ms`.
    pub(super) fn record_cost(&self, scene: SceneId, class: CostClass, charged_ms: f64, measured_ms: f64) {
        lock(&self.state).work.record_cost(scene, class, charged_ms, measured_ms);
    }

    /// Charges a scene device time that no estimate covers.
    pub(super) fn charge(&self, scene: SceneId, ms: f64) {
        lock(&self.state).work.charge(scene, ms);
    }

    /// Forgets a scene that was unloaded.
    pub(super) fn forget(&self, scene: SceneId) {
        lock(&self.state).work.forget(scene);
    }

    /// Forgets the costs and the debts of all scenes.
    #[cfg(test)]
    pub(super) fn reset_costs(&self) {
        lock(&self.state).work.reset_costs();
    }

    /// Number of queued commands of a scene.
    #[cfg(test)]
    pub(super) fn len(&self, scene: SceneId) -> usize {
        lock(&self.state).work.len(scene)
    }
}

impl Drop for CancelGuard {
    fn drop(&mut self) {
        let removed = lock(&self.queue.state).work.remove(self.scene, self.ticket);
        drop(removed);
    }
}

impl std::fmt::Debug for CancelGuard {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        out.debug_struct("CancelGuard").field("scene", &self.scene).field("ticket", &self.ticket).finish()
    }
}

impl std::fmt::Debug for CommandQueue {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        out.debug_struct("CommandQueue").finish_non_exhaustive()
    }
}
