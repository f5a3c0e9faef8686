//! Which of two ways is the faster one, measured pass by pass on the scene itself.

use super::super::scene_buffers::SceneBuffers;
use super::super::{Image, Renderer, Shot};
use super::{Path, Paths};
use crate::error::Result;

/// Frames by each way; the first warms up, and of the others the median counts.
const FRAMES: usize = 6;

impl Renderer {
    /// Draws some frames by both ways and keeps the faster for each pass; what was chosen. OpenGL where there is no other.
    ///
    /// # Errors
    /// Those of drawing.
    pub fn choose_paths(&mut self, buffers: &SceneBuffers, shot: &Shot) -> Result<Paths> {
        let Some(beside) = &buffers.beside else { return Ok(Paths::default()) };
        let able = beside.draws.get();
        beside.draws.set([false; 2]);
        let opengl = self.median_ms(buffers, shot)?;
        beside.draws.set(able);
        let cuda = self.median_ms(buffers, shot)?;
        let faster: [bool; 2] = std::array::from_fn(|pass| able[pass] && cuda[pass] < opengl[pass]);
        beside.draws.set(faster);
        tracing::info!(?opengl, ?cuda, ?faster, "milliseconds of shadow map and visibility by both ways");
        let path = |pass: usize| Some(if faster[pass] { Path::Cuda } else { Path::OpenGl });
        Ok(Paths { shadow: path(0), visibility: path(1) })
    }

    /// Milliseconds of the shadow map with its blur, and of what the camera sees with its culling.
    fn median_ms(&mut self, buffers: &SceneBuffers, shot: &Shot) -> Result<[f64; 2]> {
        let mut times = Vec::new();
        for _ in 0..FRAMES {
            // Every frame draws its shadow.
            buffers.shared_shadow.forget();
            times.push(of_passes(&self.draw(buffers, shot)?));
        }
        let median = |pass: usize| {
            let mut own: Vec<f64> = times[1..].iter().map(|time| time[pass]).collect();
            own.sort_by(f64::total_cmp);
            own[own.len() / 2]
        };
        Ok([median(0), median(1)])
    }
}

fn of_passes(image: &Image) -> [f64; 2] {
    let sum = |names: &[&str]| {
        image.passes.iter().filter(|(name, _)| names.contains(name)).fold(0.0, |sum, (_, ms)| sum + ms)
    };
    [sum(&["shadow"]), sum(&["cull", "visibility"])]
}
