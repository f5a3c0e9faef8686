//! Log lines about the frames of a scene: the look that the renderer chose (preset, antialiasing and shadow map), and
//! vertices below the ground.

use modalcast_render::{FrameInfo, FrameLook};

/// Logs the looks of a scene's frames and vertices below the ground, each once: a stream has many equal frames, and a
/// swinging object crosses the ground in every period.
#[derive(Debug, Default)]
pub(super) struct FrameLog {
    /// The looks of earlier frames. They differ only in their antialiasing, because the shadow map of a loaded scene is
    /// constant.
    looks: Vec<FrameLook>,
    has_warned_of_ground: bool,
}

impl FrameLog {
    /// Logs the look of a frame, unless an earlier frame had the same look. Logs that vertices lie below the ground,
    /// unless this was logged before. Returns whether the look and whether the vertices were logged.
    pub(super) fn record(&mut self, scene: &str, info: &FrameInfo) -> [bool; 2] {
        let new_look = info.look.filter(|look| !self.looks.contains(look));
        if let Some(look) = new_look {
            tracing::info!(scene, %look, "look of frames");
            self.looks.push(look);
        }
        let is_below_ground = info.below_ground > 0.0 && !self.has_warned_of_ground;
        if is_below_ground {
            let meters = info.below_ground;
            tracing::warn!(scene, meters, "vertices lie below the ground, which hides no geometry");
            self.has_warned_of_ground = true;
        }
        [new_look.is_some(), is_below_ground]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use modalcast_model::scene::Antialiasing;

    #[test]
    fn each_look_and_the_ground_are_logged_once() {
        let look = FrameLook { preset: None, antialias: Antialiasing::Msaa, samples: 4, shadow: None };
        let fxaa = FrameLook { antialias: Antialiasing::Fxaa, samples: 1, ..look };
        let frame = |look, below_ground| FrameInfo { look: Some(look), below_ground, ..FrameInfo::default() };
        let mut log = FrameLog::default();
        let frames = [(look, 0.0), (look, 0.5), (fxaa, 0.5), (look, 0.0), (fxaa, 1.0)];
        let logged = frames.map(|(look, below_ground)| log.record("toy", &frame(look, below_ground)));
        assert_eq!(logged, [[true, false], [false, true], [true, false], [false, false], [false, false]]);
        assert_eq!(log.record("toy", &FrameInfo::default()), [false, false]);
    }
}
