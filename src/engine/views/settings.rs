//! What a session of views draws.

use std::sync::Arc;

use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::Camera;
use modalcast_model::views::{MAX_VIEW_SIDE, MAX_VIEWS, View, ViewFormat, ViewOutputs};

/// Bytes of the pictures that are drawn without a break. Three such pieces are in memory while a client reads.
const PIECE_BYTES: usize = 8 << 20;

/// Which worlds a camera sees.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Pairing {
    /// With C cameras, view w C + c shows world w as camera c sees it.
    Every,
    /// One world per camera, by the index of the camera: view c shows it as camera c sees it.
    One(Arc<[u32]>),
}

/// What a session draws in every step.
#[derive(Debug, Clone)]
pub struct ViewSettings {
    pub worlds: usize,
    pub format: ViewFormat,
    pub cameras: Arc<[Camera]>,
    pub pairing: Pairing,
}

impl ViewSettings {
    pub(super) fn check(&self) -> Result<()> {
        if !(1..=MAX_VIEWS).contains(&self.worlds) {
            return Err(invalid("worlds", format!("1 to {MAX_VIEWS}"), self.worlds));
        }
        for (name, side) in [("width", self.format.width), ("height", self.format.height)] {
            if !(1..=MAX_VIEW_SIDE).contains(&side) {
                return Err(invalid(name, format!("1 to {MAX_VIEW_SIDE} pixels"), side));
            }
        }
        if self.format.outputs == ViewOutputs::default() {
            return Err(invalid("outputs", "at least one output", "none"));
        }
        if self.cameras.is_empty() {
            return Err(invalid("cameras", "at least one camera", "none"));
        }
        if let Pairing::One(worlds) = &self.pairing {
            if worlds.len() != self.cameras.len() {
                return Err(invalid("camera_worlds", format!("{} worlds", self.cameras.len()), worlds.len()));
            }
            if let Some(index) = worlds.iter().position(|world| *world as usize >= self.worlds) {
                let expected = format!("a world below {}", self.worlds);
                return Err(invalid(format!("camera_worlds[{index}]"), expected, worlds[index]));
            }
        }
        match self.views() {
            views if views <= MAX_VIEWS => Ok(()),
            views => Err(invalid("cameras", format!("at most {MAX_VIEWS} views in a step"), views)),
        }
    }

    /// Number of views of a step in which all worlds are drawn.
    pub fn views(&self) -> usize {
        match self.pairing {
            Pairing::Every => self.worlds * self.cameras.len(),
            Pairing::One(_) => self.cameras.len(),
        }
    }

    /// Number of views of a step in which the first worlds are drawn; 0: all.
    pub(super) fn drawn_views(&self, drawn_worlds: usize) -> Result<usize> {
        match &self.pairing {
            _ if drawn_worlds == 0 => Ok(self.views()),
            Pairing::One(_) => Err(invalid("drawn_worlds", "0 with camera_worlds", drawn_worlds)),
            Pairing::Every if drawn_worlds > self.worlds => {
                Err(invalid("drawn_worlds", format!("at most {}", self.worlds), drawn_worlds))
            }
            Pairing::Every => Ok(drawn_worlds * self.cameras.len()),
        }
    }

    /// A view of a step by its index.
    pub(super) fn view(&self, view: usize) -> View {
        let cameras = self.cameras.len();
        let (camera, world) = match &self.pairing {
            Pairing::Every => (view % cameras, (view / cameras) as u32),
            Pairing::One(worlds) => (view, worlds[view]),
        };
        View { camera: camera as u32, world }
    }

    /// Bytes of one view in all arrays.
    pub fn view_bytes(&self) -> usize {
        let ViewOutputs { color, depth, domains, normals } = self.format.outputs;
        let pixel = [(color, 3), (depth, 4), (domains, 4), (normals, 12)];
        let pixel_bytes: usize = pixel.into_iter().filter(|(is_drawn, _)| *is_drawn).map(|(_, bytes)| bytes).sum();
        pixel_bytes * self.format.pixel_count()
    }

    /// Largest number of views of a piece.
    pub(super) fn max_piece_views(&self) -> usize {
        (PIECE_BYTES / self.view_bytes()).max(1)
    }

    /// Bytes of the pictures of the largest piece.
    pub(super) fn piece_bytes(&self) -> usize {
        self.max_piece_views().min(self.views()) * self.view_bytes()
    }
}
