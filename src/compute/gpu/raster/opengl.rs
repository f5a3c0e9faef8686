//! The compute rasterizer on OpenGL's buffers, which can replace OpenGL's own passes of depth and ids.

use std::sync::Arc;

use super::super::device::Device;
use super::super::interop::{Access, Registered, Sharing, mapped};
use super::{Core, Functions, Pass, RasterForm, Spread, check, check_cut_outs};
use modalcast_model::error::{Error, Result, during};
use modalcast_model::raster::{GlBuffer, Mesh, Order, Rasteriser};
use modalcast_model::scene::{Faces, Group};

/// Bytes of a vertex position.
const VERTEX: u64 = 12;

/// Draws one mesh with CUDA. Create and drop it on the thread that owns the OpenGL context, and drop it before the
/// OpenGL buffers.
#[derive(Debug)]
pub struct GlRaster {
    // First, so dropped first: unregisters the OpenGL buffers.
    positions: Registered,
    depth: Kind,
    ids: Kind,
    sharing: Sharing,
    core: Core,
    device: Arc<Device>,
}

/// A kind of pass, depth or ids: its kernels, and the target buffer, registered by its first pass.
#[derive(Debug)]
struct Kind {
    into: Option<Registered>,
    functions: Option<Functions>,
    form: RasterForm,
    groups: Vec<Group>,
}

/// Kernels, groups and target of a pass that is ready.
type Ready<'a> = (&'a Functions, &'a [Group], &'a mut Registered);

impl Kind {
    const fn new(depth_only: bool, groups: Vec<Group>) -> Self {
        let form = RasterForm { depth_only, counted: false, spread: Spread::BySize };
        Self { into: None, functions: None, form, groups }
    }

    /// The kernels, compiled at the first call.
    fn compiled(&mut self, device: &Device, core: &Core) -> Result<&Functions> {
        let functions = match self.functions.take() {
            Some(functions) => functions,
            None => Functions::new(device, self.form, core.is_cut())?,
        };
        Ok(self.functions.insert(functions))
    }

    /// Compiles the kernels and registers the target of a pass, unless that has been done before.
    fn prepare(&mut self, device: &Device, (sharing, core): (&Sharing, &Core), into: GlBuffer) -> Result<Ready<'_>> {
        self.compiled(device, core)?;
        if self.into.as_ref().is_some_and(|own| own.buffer() != into) {
            self.let_go(device);
        }
        let registered = match self.into.take() {
            Some(own) => own,
            None => sharing.register(device, into)?,
        };
        let missing = || during("raster")("no kernels were compiled");
        Ok((self.functions.as_ref().ok_or_else(missing)?, &self.groups, self.into.insert(registered)))
    }

    /// Unregisters the target after all work on it has completed.
    fn let_go(&mut self, device: &Device) {
        // A fault is reported by the next call to the device.
        device.stream().synchronize().ok();
        self.into = None;
    }
}

impl GlRaster {
    /// Uploads a mesh's triangles and registers its positions, a buffer of the OpenGL context that is current on this
    /// thread. Kernels are compiled by [`Rasteriser::make_ready`], or at the first pass that needs them.
    ///
    /// # Errors
    /// `Invalid` when there are 2^24 triangles or more, a triangle refers to a missing vertex, a group to missing
    /// triangles, or the cut-outs do not fit the mesh. `Fault` when the device refuses, or CUDA cannot share OpenGL's
    /// buffer.
    pub fn new(device: &Arc<Device>, mesh: Mesh) -> Result<Self> {
        check(mesh.positions.bytes / VERTEX, &mesh.triangles, &mesh.groups)?;
        let cut_outs = mesh.cut_outs.filter(|cut_outs| (cut_outs.first as usize) < mesh.triangles.len());
        if let Some(cut_outs) = &cut_outs {
            check_cut_outs(mesh.triangles.len(), cut_outs)?;
        }
        device.context().bind_to_thread().map_err(during("device"))?;
        let sharing = Sharing::open(device)?;
        let all = Group { first: 0, triangles: mesh.triangles.len() as u32, faces: Faces::Both };
        let raster = Self {
            positions: sharing.register(device, mesh.positions)?,
            depth: Kind::new(true, vec![all]),
            ids: Kind::new(false, mesh.groups),
            sharing,
            core: Core::new(device, &mesh.triangles, cut_outs.as_ref())?,
            device: Arc::clone(device),
        };
        // Wait here: the triangles were copied from temporary host memory, and a fault of the copy is reported here.
        device.stream().synchronize().map_err(during("upload"))?;
        Ok(raster)
    }

    /// Draws one window or two, with all buffers mapped together.
    fn pass(&mut self, depth: Option<Order<'_>>, ids: Option<Order<'_>>) -> Result<()> {
        let Self { positions, depth: of_depth, ids: of_ids, sharing, core, device } = self;
        device.context().bind_to_thread().map_err(during("device"))?;
        let mut ready = Vec::new();
        for (kind, order) in [(of_depth, depth), (of_ids, ids)] {
            let Some((window, into)) = order else { continue };
            let needed = kind.form.bytes(window);
            if into.bytes < needed {
                let reason = format!("buffer {} has {} bytes, {needed} are needed", into.name, into.bytes);
                return Err(Error::Fault { stage: "raster", reason });
            }
            ready.push((window, kind.prepare(device, (sharing, core), into)?));
        }
        // Not `WriteAll`: the kernels read the samples that they wrote.
        let mut uses = vec![(positions, Access::Read)];
        let mut passes = Vec::new();
        for (window, (functions, groups, target)) in ready {
            uses.push((target, Access::WriteSome));
            passes.push((window, functions, groups));
        }
        mapped(device, &mut uses, |[positions, targets @ ..]| {
            let mut passes = passes.iter().zip(targets);
            passes.try_for_each(|((window, functions, groups), target)| {
                core.draw(device, &Pass { functions, groups, window, positions, target })
            })
        })
    }
}

impl Rasteriser for GlRaster {
    /// Draws the requested windows. After a failure the targets are unregistered.
    fn draw(&mut self, depth: Option<Order<'_>>, ids: Option<Order<'_>>) -> Result<()> {
        let drawn = if depth.is_some() || ids.is_some() { self.pass(depth, ids) } else { Ok(()) };
        if drawn.is_err() {
            self.depth.let_go(&self.device);
            self.ids.let_go(&self.device);
        }
        drawn
    }

    fn make_ready(&mut self, depth: bool, ids: bool) -> Result<()> {
        let Self { depth: of_depth, ids: of_ids, core, device, .. } = self;
        for (kind, wanted) in [(of_depth, depth), (of_ids, ids)] {
            if wanted {
                kind.compiled(device, core)?;
            }
        }
        Ok(())
    }

    fn forget(&mut self, name: u32) {
        for kind in [&mut self.depth, &mut self.ids] {
            if kind.into.as_ref().is_some_and(|own| own.buffer().name == name) {
                kind.let_go(&self.device);
            }
        }
    }
}

impl Drop for GlRaster {
    fn drop(&mut self) {
        // A fault is reported by the next call to the device.
        self.device.stream().synchronize().ok();
    }
}
