//! Which scene owns each piece of work, so that the crash log can name the scene whose work ends the process.

use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use super::command::SceneId;
use crate::engine::lock::lock;
use crate::engine::running_scene::{SceneName, run_as};
use crate::engine::storage::crash_log::CrashLog;

/// The names of the scenes on the device, and the owner of the present work of the device thread.
#[derive(Debug)]
pub(in crate::engine) struct WorkOwners {
    /// `None` in tests.
    crash_log: Option<Arc<CrashLog>>,
    names: Mutex<HashMap<SceneId, SceneName>>,
    /// The scene of the device thread's present work; [`Self::NO_SCENE`] if there is none.
    present: AtomicU64,
}

impl WorkOwners {
    const NO_SCENE: SceneId = SceneId::MAX;

    pub(in crate::engine) fn new(crash_log: Option<Arc<CrashLog>>) -> Arc<Self> {
        Arc::new(Self { crash_log, names: Mutex::default(), present: AtomicU64::new(Self::NO_SCENE) })
    }

    pub(super) fn insert(&self, id: SceneId, name: &str) {
        lock(&self.names).insert(id, SceneName::new(name));
    }

    pub(super) fn remove(&self, id: SceneId) {
        lock(&self.names).remove(&id);
    }

    /// Runs work of a scene.
    pub(super) fn run<T>(&self, id: SceneId, work: impl FnOnce() -> T) -> T {
        match self.name(id) {
            Some(name) => run_as(name, work),
            None => work(),
        }
    }

    /// Runs work of a scene on the device thread, perhaps inside of other work. The work must not panic.
    pub(super) fn run_on_device<T>(&self, id: SceneId, work: impl FnOnce() -> T) -> T {
        let outer = self.present.swap(id, Ordering::Relaxed);
        let result = self.run(id, work);
        self.present.store(outer, Ordering::Relaxed);
        result
    }

    /// Records that the present work of the device thread does not end. The thread must be in this work.
    pub(super) fn record_hang(&self) {
        let owner = self.name(self.present.load(Ordering::Relaxed));
        if let (Some(log), Some(name)) = (&self.crash_log, owner) {
            log.record("watchdog", name);
        }
    }

    fn name(&self, id: SceneId) -> Option<SceneName> {
        lock(&self.names).get(&id).copied()
    }
}
