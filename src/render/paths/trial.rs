//! Which of two ways is the faster one, measured pass by pass on the scene itself.

use super::super::scene_buffers::SceneBuffers;
use super::super::{Image, Renderer, Shot};
use super::{Path, Paths};
use modalcast_model::error::Result;

/// Frames by each way; the first warms up, and of the others the median counts.
const FRAMES: usize = 6;

impl Renderer {
    /// Draws some frames by each way and keeps the fastest: each of both passes by OpenGL or beside it, because what one costs
    /// hangs on who draws the other. What was chosen; OpenGL where there is nothing else. What draws nothing goes.
    ///
    /// # Errors
    /// Those of drawing.
    pub fn choose_paths(&mut self, buffers: &mut SceneBuffers, shot: &Shot) -> Result<Paths> {
        let Some(beside) = &buffers.beside else { return Ok(Paths::default()) };
        let able = beside.draws.get();
        let mut measured = Vec::new();
        for ways in [[false, false], [true, false], [false, true], [true, true]] {
            if ways.iter().zip(able).all(|(wanted, able)| able || !wanted) {
                beside.draws.set(ways);
                let ms = self.median_ms(buffers, shot)?;
                // Where it failed it was given up, and OpenGL was measured.
                if beside.draws.get() == ways {
                    measured.push((ways, ms));
                }
            }
        }
        tracing::info!(?measured, "milliseconds a frame by who draws: shadow map, visibility beside OpenGL");
        let fastest = measured.into_iter().min_by(|one, other| one.1.total_cmp(&other.1));
        let ways = fastest.map_or([false; 2], |(ways, _)| ways);
        beside.draws.set(ways);
        if ways == [false; 2] {
            buffers.beside = None;
        }
        let path = |beside: bool| Some(if beside { Path::Cuda } else { Path::OpenGl });
        Ok(Paths { shadow: path(ways[0]), visibility: path(ways[1]) })
    }

    /// Milliseconds of a frame that draws its shadow, its pixels left where they are.
    fn median_ms(&mut self, buffers: &SceneBuffers, shot: &Shot) -> Result<f64> {
        let mut times = Vec::new();
        for _ in 0..FRAMES {
            buffers.shared_shadow.forget();
            // Nobody reads it, so that those whose frames are under way are not in its way.
            let ticket = self.submit_unread(buffers, shot)?;
            times.push(of_frame(&self.collect(ticket)?));
        }
        times.remove(0);
        times.sort_by(f64::total_cmp);
        Ok(times[times.len() / 2])
    }
}

fn of_frame(image: &Image) -> f64 {
    let stages = image.passes.iter().filter(|(name, _)| ["shadow", "draw"].contains(name));
    stages.fold(0.0, |sum, (_, ms)| sum + ms)
}
