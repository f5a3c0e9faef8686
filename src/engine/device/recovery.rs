//! Recovery from the loss of the renderer: the device thread opens the renderer again, loads all scenes again and deforms
//! them to their last states. Commands that are queued meanwhile are executed afterwards.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::command::SceneId;
use super::device_loop::DeviceLoop;
use modalcast_model::backend_settings::BackendSettings;
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::{Scene, SceneState};

/// Maximum number of recoveries within [`RECOVERY_PERIOD`]. A renderer that is lost more often is a lost device, so that a
/// frame that always loses it does not occupy the server for ever.
const MAX_RECOVERIES: usize = 3;
const RECOVERY_PERIOD: Duration = Duration::from_secs(60);

/// Limits how often the renderer is opened again.
#[derive(Debug, Default)]
pub(super) struct RecoveryLimit {
    /// When the renderer was lost, oldest first.
    losses: VecDeque<Instant>,
}

impl RecoveryLimit {
    /// Counts a loss. Returns whether the renderer may be opened again.
    fn admits(&mut self, now: Instant) -> bool {
        self.losses.retain(|loss| now.duration_since(*loss) < RECOVERY_PERIOD);
        self.losses.push_back(now);
        self.losses.len() <= MAX_RECOVERIES
    }
}

/// A scene that is loaded again.
pub(super) struct SceneToRestore {
    pub(super) id: SceneId,
    pub(super) scene: Arc<Scene>,
    pub(super) state: Arc<SceneState>,
    pub(super) backends: BackendSettings,
}

impl DeviceLoop {
    /// Opens the renderer again if it is lost. If that fails, the device is lost.
    pub(super) fn recover_renderer(&mut self) {
        let Some(error) = self.loss.renderer_error() else { return };
        let begin = Instant::now();
        let result = match self.recoveries.admits(begin) {
            true => self.reload_all(&error),
            false => Err(Error::DeviceLost {
                stage: "renderer",
                reason: format!("lost more than {MAX_RECOVERIES} times in {} s: {error}", RECOVERY_PERIOD.as_secs()),
            }),
        };
        match result {
            Ok(scenes) => {
                tracing::warn!(scenes, ms = begin.elapsed().as_millis() as u64, "the renderer is open again");
                self.loss.record_recovery();
            }
            Err(lost @ Error::DeviceLost { .. }) => self.loss.record(&lost),
            Err(error) => self.loss.record(&Error::DeviceLost { stage: "renderer", reason: error.to_string() }),
        }
    }

    /// Answers all outputs in flight with `error`, opens the renderer, and restores all scenes. Returns their number.
    fn reload_all(&mut self, error: &Error) -> Result<usize> {
        self.fail_outputs(error);
        let scenes = self.unload_all();
        self.context.reopen_renderer()?;
        let count = scenes.len();
        for SceneToRestore { id, scene, state, backends } in scenes {
            let mut loaded_scene = self.context.load_scene(&scene, backends)?;
            loaded_scene.deform_shared(&state, None)?;
            self.insert_scene(id, loaded_scene, backends);
        }
        Ok(count)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn recoveries_are_limited_within_the_period() {
        let (mut limit, start) = (RecoveryLimit::default(), Instant::now());
        let admitted: Vec<bool> = (0..5).map(|second| limit.admits(start + Duration::from_secs(second))).collect();
        assert_eq!(admitted, [true, true, true, false, false]);
        assert!(limit.admits(start + 2 * RECOVERY_PERIOD), "expected older losses to be forgotten");
    }
}
