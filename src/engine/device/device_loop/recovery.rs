//! Recovery from the loss of the renderer, or from a step that has failed on the device: the device thread opens the
//! renderer again, loads all scenes again and deforms them to their last states. Commands that are queued meanwhile are
//! executed afterwards.

use std::sync::Arc;
use std::time::Instant;

use super::{DeviceLoop, InFlight, SceneId, answer, run_caught};
use crate::engine::device::recovery_limit::{MAX_RECOVERIES, RECOVERY_PERIOD};
use modalcast_model::backend_settings::BackendSettings;
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::{Scene, SceneState};

/// A scene that is loaded again.
struct SceneToRestore {
    id: SceneId,
    scene: Arc<Scene>,
    state: Arc<SceneState>,
    backends: BackendSettings,
}

impl DeviceLoop {
    /// Opens the renderer and loads all scenes again if an error demands it. If that fails, the device is lost.
    pub(super) fn recover(&mut self) {
        let Some(error) = self.loss.recovery_cause() else { return };
        let begin = Instant::now();
        let result = match self.recoveries.admits(begin) {
            true => self.reload_all(&error),
            false => Err(Error::DeviceLost {
                stage: "recovery",
                reason: format!("more than {MAX_RECOVERIES} in {} s: {error}", RECOVERY_PERIOD.as_secs()),
            }),
        };
        match result {
            Ok(scenes) => {
                tracing::warn!(scenes, ms = begin.elapsed().as_millis() as u64, "all scenes are loaded again");
                self.loss.record_recovery();
            }
            Err(lost @ Error::DeviceLost { .. }) => self.loss.record(&lost),
            Err(error) => self.loss.record(&Error::DeviceLost { stage: "recovery", reason: error.to_string() }),
        }
    }

    /// Answers all outputs in flight with an error, opens the renderer, and restores all scenes. Returns their number.
    fn reload_all(&mut self, cause: &Error) -> Result<usize> {
        let output_error = match cause {
            Error::RendererLost { .. } => cause.clone(),
            cause => Error::RendererLost { stage: "output", reason: cause.to_string() },
        };
        self.fail_outputs(&output_error);
        let scenes = self.unload_all();
        // Worlds are not loaded again: their calls get an error, and their clients can open them again.
        run_caught(|| self.worlds.clear());
        self.context.reopen_renderer()?;
        let count = scenes.len();
        for SceneToRestore { id, scene, state, backends } in scenes {
            let owners = Arc::clone(&self.owners);
            let loaded_scene = owners.run_on_device(id, || {
                let mut loaded_scene = self.context.load_scene(&scene, backends)?;
                loaded_scene.deform_shared(&state).map(|_| loaded_scene)
            })?;
            self.insert_scene(id, loaded_scene, backends);
        }
        Ok(count)
    }

    /// Answers all outputs in flight with an error. Vertices do not depend on the renderer, so these are answered.
    fn fail_outputs(&mut self, error: &Error) {
        while !self.vertices.is_empty() {
            self.finish_oldest_vertices();
        }
        while let Some(InFlight { reply, .. }) = self.picks.pop_oldest() {
            answer(reply, Err(error.clone()));
        }
        while let Some(InFlight { reply, .. }) = self.frames.pop_oldest() {
            answer(reply, Err(error.clone()));
        }
        for (_, output) in std::mem::take(&mut self.partial_outputs) {
            output.reply_error(error.clone());
        }
    }

    /// Unloads all scenes. Returns their contents and states, with which they are loaded again.
    fn unload_all(&mut self) -> Vec<SceneToRestore> {
        let mut scenes = Vec::new();
        for (id, loaded_scene) in std::mem::take(&mut self.scenes) {
            let (scene, state) = (Arc::clone(loaded_scene.scene()), Arc::clone(loaded_scene.current_state()));
            let backends = self.backends.remove(&id).unwrap_or_default();
            scenes.push(SceneToRestore { id, scene, state, backends });
            run_caught(|| self.context.unload_scene(loaded_scene));
        }
        scenes
    }
}
