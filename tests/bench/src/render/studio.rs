//! Frames of the renderer: one scene under one look, deformed on the CPU, drawn and timed.

use std::sync::Arc;
use std::time::{Duration, Instant};

use serde::Serialize;

use super::plants;
use crate::timing::{FEWEST, Timing};
use modalcast_compute::cpu::CpuDeformer;
use modalcast_compute::gpu::{Device, GlRaster};
use modalcast_model::deform::{Deformer, Surface};
use modalcast_model::error::{Result, during};
use modalcast_model::raster::{Mesh, Rasteriser};
use modalcast_model::scene::{Bounds, Camera, LightBounds, Rastering, Scene, State};
use modalcast_render::{Image, Prefer, Renderer, SceneBuffers, Shot};

/// Size of a picture in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Size {
    pub width: u32,
    pub height: u32,
}

/// The time of one pass, by the name of its stage.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Pass {
    pub name: &'static str,
    pub timing: Timing,
}

/// How long a device draws before the stopwatch counts.
pub(super) const WARM_UP: Duration = Duration::from_millis(500);

/// Everything that draws.
pub(super) struct Studio {
    pub(super) renderer: Renderer,
}

/// A scene on the device.
pub(super) struct Set {
    scene: Arc<Scene>,
    pub(super) buffers: SceneBuffers,
    deformer: CpuDeformer,
    bounds: Bounds,
    light: Option<LightBounds>,
}

impl Studio {
    pub(super) fn open() -> Result<Self> {
        Ok(Self { renderer: Renderer::open(Prefer::Any)? })
    }

    /// Loads a scene.
    pub(super) fn set(&mut self, scene: &Arc<Scene>) -> Result<Set> {
        let (buffers, deformer) = (self.renderer.load(scene)?, CpuDeformer::new(scene));
        Ok(Set { scene: Arc::clone(scene), buffers, deformer, bounds: Bounds::EMPTY, light: None })
    }

    /// Lets CUDA draw what it may of a scene.
    ///
    /// # Errors
    /// Those of the device.
    pub(super) fn draw_beside(&mut self, set: &mut Set, device: &Arc<Device>) -> Result<()> {
        let make = |mesh: Mesh| Ok(Box::new(GlRaster::new(device, mesh)?) as Box<dyn Rasteriser>);
        self.renderer.draw_beside(&mut set.buffers, make)
    }

    /// Lets those draw a posed scene that its look names, as far as they are there.
    ///
    /// # Errors
    /// Those of the device, and of drawing.
    pub(super) fn draw_as_named(&mut self, set: &mut Set, camera: Camera, size: Size) -> Result<()> {
        let wanted = set.scene.look.raster;
        let Some(device) = plants::device().filter(|_| wanted != Rastering::OpenGl) else { return Ok(()) };
        self.draw_beside(set, &device)?;
        if wanted == Rastering::Fastest {
            let shot = set.shot(camera, size);
            self.renderer.choose_paths(&mut set.buffers, &shot)?;
        }
        Ok(())
    }

    /// Deforms it and uploads what came of that.
    pub(super) fn pose(&mut self, set: &mut Set, state: &State) -> Result<()> {
        let deformed = set.deformer.deform(state)?;
        (set.bounds, set.light) = (deformed.bounds, deformed.light);
        self.renderer.upload(&set.buffers, set.deformer.surface()?)
    }

    pub(super) fn draw(&mut self, set: &Set, camera: Camera, size: Size) -> Result<Image> {
        self.renderer.draw(&set.buffers, &set.shot(camera, size))
    }

    /// Draws the same frame again and again; the passes of the stages, and of all but reading back together ("frame").
    pub(super) fn time(&mut self, set: &Set, camera: Camera, size: Size, replays: usize) -> Result<Vec<Pass>> {
        let mut times: Vec<(&'static str, Vec<f64>)> = vec![("frame", Vec::new())];
        self.warm_up(set, camera, size)?;
        for _ in 0..replays.max(FEWEST) {
            let image = self.draw(set, camera, size)?;
            // The two stages whole: the other times are parts of them.
            let frame = image.passes.iter().filter(|(name, _)| ["shadow", "draw"].contains(name));
            times[0].1.push(frame.map(|(_, ms)| 1e3 * ms).sum());
            for (name, ms) in &image.passes {
                match times.iter_mut().find(|(own, _)| own == name) {
                    Some((_, list)) => list.push(1e3 * ms),
                    None => times.push((name, vec![1e3 * ms])),
                }
            }
        }
        let pass = |(name, list): (&'static str, Vec<f64>)| {
            Timing::of(list).map(|timing| Pass { name, timing }).ok_or_else(|| during("time")("no frame was drawn"))
        };
        times.into_iter().map(pass).collect()
    }

    /// The first frame of a size compiles and allocates, and the clock of a device that rested rises for a while: the same
    /// pass took six times as long on an H200 at first.
    pub(super) fn warm_up(&mut self, set: &Set, camera: Camera, size: Size) -> Result<()> {
        let begin = Instant::now();
        loop {
            self.draw(set, camera, size)?;
            if self.renderer.info().software || begin.elapsed() >= WARM_UP {
                return Ok(());
            }
        }
    }

    pub(super) fn strike(&mut self, set: Set) {
        self.renderer.unload(set.buffers);
    }
}

impl Set {
    pub(super) fn shot(&self, camera: Camera, size: Size) -> Shot {
        Shot { camera, width: size.width, height: size.height, bounds: self.bounds, light: self.light }
    }

    /// Bounds of the vertices that were drawn last, and what they take up in light space.
    pub(super) const fn extents(&self) -> (Bounds, Option<LightBounds>) {
        (self.bounds, self.light)
    }

    pub(super) fn scene(&self) -> &Arc<Scene> {
        &self.scene
    }

    /// The vertices that were drawn last.
    pub(super) fn surface(&mut self) -> Result<&Surface> {
        self.deformer.surface()
    }
}
