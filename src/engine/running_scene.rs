//! The scene that a thread works for. The crash log names it when the work ends the process.

use std::cell::Cell;

/// The largest number of bytes of a scene's name.
const MAX_BYTES: usize = 64;

/// The name of a scene, padded with zeros. It owns no memory, so that a signal handler can read it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct SceneName([u8; MAX_BYTES]);

impl SceneName {
    const NONE: Self = Self([0; MAX_BYTES]);

    /// `name` must be valid, see [`super::validate_scene_name`].
    pub(super) fn new(name: &str) -> Self {
        let mut bytes = [0; MAX_BYTES];
        for (to, from) in bytes.iter_mut().zip(name.bytes()) {
            *to = from;
        }
        Self(bytes)
    }

    pub(super) fn bytes(&self) -> impl Iterator<Item = u8> {
        self.0.into_iter().take_while(|byte| *byte != 0)
    }
}

thread_local! {
    // A constant without a destructor, so that a signal handler can read it: an access neither allocates nor locks.
    static RUNNING: Cell<SceneName> = const { Cell::new(SceneName::NONE) };
}

/// Runs work of a scene on this thread. The work of another scene, inside of which this one is run, continues afterwards,
/// also after a panic.
pub(super) fn run_as<T>(scene: SceneName, work: impl FnOnce() -> T) -> T {
    struct Restore(SceneName);
    impl Drop for Restore {
        fn drop(&mut self) {
            RUNNING.set(self.0);
        }
    }
    let _restore = Restore(RUNNING.replace(scene));
    work()
}

/// The scene that this thread works for. Async-signal-safe.
pub(super) fn running_scene() -> Option<SceneName> {
    Some(RUNNING.get()).filter(|scene| *scene != SceneName::NONE)
}
