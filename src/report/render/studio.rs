//! Frames of the renderer: one scene under one look, deformed on the CPU, drawn and timed.

use std::sync::Arc;

use serde::Serialize;

use crate::cpu::CpuDeformer;
use crate::deform::{Deformer, Surface};
use crate::error::{Result, during};
use crate::render::{Image, Plan, Prefer, Renderer, SceneBuffers, Shot};
use crate::report::timing::{FEWEST, Timing};
use crate::scene::{Bounds, Camera, Scene, State};

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

/// Everything that draws.
pub(super) struct Studio {
    pub(super) renderer: Renderer,
}

/// A scene on the device.
pub(super) struct Set {
    scene: Arc<Scene>,
    buffers: SceneBuffers,
    deformer: CpuDeformer,
    bounds: Bounds,
    pub(super) plan: Plan,
}

impl Studio {
    pub(super) fn open() -> Result<Self> {
        Ok(Self { renderer: Renderer::open(Prefer::Any)? })
    }

    /// Loads a scene.
    pub(super) fn set(&mut self, scene: &Arc<Scene>) -> Result<Set> {
        let (buffers, deformer) = (self.renderer.load(scene)?, CpuDeformer::new(scene));
        // What this device needs: one in software blurs by other passes.
        let plan = buffers.plan().clone();
        Ok(Set { scene: Arc::clone(scene), buffers, deformer, bounds: Bounds::EMPTY, plan })
    }

    /// Deforms it and uploads what came of that.
    pub(super) fn pose(&mut self, set: &mut Set, state: &State) -> Result<()> {
        set.bounds = set.deformer.deform(state)?.bounds;
        self.renderer.upload(&set.buffers, set.deformer.surface()?)
    }

    pub(super) fn draw(&mut self, set: &Set, camera: Camera, size: Size) -> Result<Image> {
        self.renderer.draw(&set.buffers, &set.shot(camera, size))
    }

    /// Draws the same frame again and again; the passes of the stages, and of all but reading back together ("frame").
    pub(super) fn time(&mut self, set: &Set, camera: Camera, size: Size, replays: usize) -> Result<Vec<Pass>> {
        let mut times: Vec<(&'static str, Vec<f64>)> = vec![("frame", Vec::new())];
        for replay in 0..=replays.max(FEWEST) {
            let image = self.draw(set, camera, size)?;
            if replay == 0 {
                // The first frame of a size compiles and allocates.
                continue;
            }
            // The blur is part of the shadow.
            let own = image.passes.iter().filter(|(name, _)| !["read", "blur"].contains(name));
            times[0].1.push(own.map(|(_, ms)| 1e3 * ms).sum());
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

    pub(super) fn strike(&mut self, set: Set) {
        self.renderer.unload(set.buffers);
    }
}

impl Set {
    pub(super) fn shot(&self, camera: Camera, size: Size) -> Shot {
        Shot { camera, width: size.width, height: size.height, bounds: self.bounds }
    }

    pub(super) fn scene(&self) -> &Arc<Scene> {
        &self.scene
    }

    /// The vertices that were drawn last.
    pub(super) fn surface(&mut self) -> Result<&Surface> {
        self.deformer.surface()
    }
}
