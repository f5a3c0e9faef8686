//! The deformer `cuda`: a step's values to the device in one copy, two kernels, the bounds back.

use std::sync::Arc;
use std::time::Instant;

use super::GlBuffers;
use super::deform::{Deform, Extent};
use super::device::Device;
use super::memory::{Inputs, PageLock};
use super::orient::Orient;
use super::output::{Output, sizes};
use super::plan::{Plan, plan};
use crate::deform::{Backend, Deformed, Deformer, Surface};
use crate::error::{Error, Result, during};
use crate::scene::{Bounds, Scene, State};

/// The CUDA deformer of one scene. Lives and dies on the thread that owns the OpenGL context, and before the buffers
/// that it shares.
#[derive(Debug)]
pub struct CudaDeformer {
    device: Arc<Device>,
    plan: Plan,
    deform: Deform,
    orient: Orient,
    inputs: Inputs,
    extent: Extent,
    output: Output,
    // Declared before `surface`, so dropped before it: the locks are on its memory.
    locks: Vec<PageLock>,
    surface: Surface,
    /// Whether `surface` holds what the device holds.
    fresh: bool,
}

impl CudaDeformer {
    /// Packs a scene onto the device. With `gl`, output goes straight into those buffers when the driver allows it.
    ///
    /// # Errors
    /// `Fault` when the device refuses; `Unavailable` when NVRTC is missing or the device's memory is too small.
    pub fn new(device: &Arc<Device>, scene: &Arc<Scene>, gl: Option<GlBuffers>) -> Result<Self> {
        let plan = plan(scene);
        device.context().bind_to_thread().map_err(during("device"))?;
        check_memory(device, &plan)?;
        let [deform, orient] = [0, 1].map(|index| &plan.kernels[index]);
        let (deform, orient) = (Deform::new(device, scene, deform)?, Orient::new(device, scene, orient)?);
        let deformer = Self {
            deform,
            orient,
            inputs: Inputs::new(device, scene.domains.len(), scene.layout.coordinates)?,
            extent: Extent::new(device)?,
            output: Output::new(device, &plan, gl)?,
            locks: Vec::new(),
            surface: Surface::default(),
            fresh: true,
            device: Arc::clone(device),
            plan,
        };
        // Tables were copied from memory that is gone by now; wait here, so that a fault of theirs shows here.
        deformer.device.stream().synchronize().map_err(during("upload"))?;
        Ok(deformer)
    }

    /// What it compiled and allocated.
    pub const fn plan(&self) -> &Plan {
        &self.plan
    }

    fn run(&mut self, state: &State) -> Result<Bounds> {
        let (device, deform, orient) = (&*self.device, &self.deform, &self.orient);
        self.inputs.send(device, state)?;
        self.extent.clear(device)?;
        let (inputs, extent) = (&self.inputs, &self.extent);
        self.output.write(device, |to| {
            deform.launch(device, inputs, extent, to.positions)?;
            orient.launch(device, inputs, to)
        })?;
        self.extent.read(device)
    }

    fn fetch(&mut self) -> Result<()> {
        let [positions, normals, tangents] = sizes(&self.plan).map(|bytes| bytes as usize / 4);
        if self.surface.positions.is_empty() {
            let Surface { positions: first, normals: second, tangents: third } = &mut self.surface;
            for (list, length) in [(first, positions), (second, normals), (third, tangents)] {
                list.resize(length, 0.0);
                // SAFETY: the list never changes its length again, and the locks are dropped before it.
                self.locks.extend(unsafe { PageLock::new(&self.device, list) });
            }
        }
        self.output.read(&self.device, &mut self.surface)
    }
}

impl Deformer for CudaDeformer {
    fn backend(&self) -> Backend {
        Backend::Cuda
    }

    fn deform(&mut self, state: &State) -> Result<Deformed> {
        let begin = Instant::now();
        self.fresh = false;
        let bounds = self.run(state).inspect_err(|_| {
            // Copies may be in flight that read what the next step overwrites. Their own failure adds nothing.
            self.device.stream().synchronize().ok();
        })?;
        Ok(Deformed { bounds, ms: begin.elapsed().as_secs_f64() * 1e3 })
    }

    fn shares_buffers(&self) -> bool {
        self.output.is_shared()
    }

    fn surface(&mut self) -> Result<&Surface> {
        if !self.fresh {
            self.fetch()?;
            self.fresh = true;
        }
        Ok(&self.surface)
    }
}

impl Drop for CudaDeformer {
    fn drop(&mut self) {
        // Nothing may be freed that the device still uses. After a fault the answer is an error, and nothing runs.
        self.device.stream().synchronize().ok();
    }
}

/// Refuses a scene that cannot fit before half of it is there.
fn check_memory(device: &Device, plan: &Plan) -> Result<()> {
    // What other scenes freed is given back when the stream has come to it.
    device.stream().synchronize().map_err(during("device"))?;
    let (free, _) = device.memory()?;
    if plan.total_bytes() <= free as u64 {
        return Ok(());
    }
    let reason = format!("the scene needs {} bytes, {free} are free on {}", plan.total_bytes(), device.name());
    Err(Error::Unavailable { what: "GPU memory", reason, remedy: "Close other scenes or other programs".into() })
}
