//! The compute rasterizer on OpenGL's buffers, which can replace OpenGL's own passes of depth and ids.

use std::sync::Arc;

use super::super::interop::{GlInterop, MapAccess, Mapping, RegisteredBuffer, with_mapped};
use super::{RasterFunctions, RasterGranularity, RasterPass, RasterPipeline, RasterVariant, check, check_cut_outs};
use crate::gpu::launch::Device;
use modalcast_model::error::{Error, Result, fault_in};
use modalcast_model::raster::{DrawTarget, GlBuffer, RasterGeometry, Rasterizer};
use modalcast_model::scene::{CullMode, DrawRange};

/// Bytes of a vertex position.
const POSITION_BYTES: u64 = 12;

/// Draws one mesh with CUDA. It stays on the thread that created it, which owns the OpenGL context. Dropping it waits for all passes before any memory that they use is released.
#[derive(Debug)]
pub struct CudaRasterizer {
    positions: RegisteredBuffer,
    depth: PassState,
    ids: PassState,
    sharing: GlInterop,
    core: RasterPipeline,
    device: Arc<Device>,
}

/// A kind of pass, depth or ids: its kernels, and the target buffer, registered by its first pass.
#[derive(Debug)]
struct PassState {
    target: Option<RegisteredBuffer>,
    functions: Option<RasterFunctions>,
    variant: RasterVariant,
    groups: Vec<DrawRange>,
}

/// Kernels, groups and target of a pass that is ready.
type PreparedPass<'a> = (&'a RasterFunctions, &'a [DrawRange], &'a mut RegisteredBuffer);

impl PassState {
    const fn new(depth_only: bool, groups: Vec<DrawRange>) -> Self {
        let variant = RasterVariant { depth_only, count_triangles: false, granularity: RasterGranularity::BySize };
        Self { target: None, functions: None, variant, groups }
    }

    /// The kernels, compiled at the first call.
    fn ensure_compiled(&mut self, device: &Device, core: &RasterPipeline) -> Result<&RasterFunctions> {
        let functions = match self.functions.take() {
            Some(functions) => functions,
            None => RasterFunctions::new(device, self.variant, core.has_cut_outs())?,
        };
        Ok(self.functions.insert(functions))
    }

    /// Compiles the kernels and registers the target of a pass, unless that has been done before.
    fn prepare(
        &mut self,
        device: &Device,
        (sharing, core): (&GlInterop, &RasterPipeline),
        target: &GlBuffer,
    ) -> Result<PreparedPass<'_>> {
        self.ensure_compiled(device, core)?;
        if self.target.as_ref().is_some_and(|own| own.buffer() != target) {
            self.release(device);
        }
        let registered = match self.target.take() {
            Some(own) => own,
            None => sharing.register(device, target.clone())?,
        };
        let missing = || fault_in("raster")("no kernels were compiled");
        Ok((self.functions.as_ref().ok_or_else(missing)?, &self.groups, self.target.insert(registered)))
    }

    /// Unregisters the target after all work on it has completed.
    fn release(&mut self, device: &Device) {
        // A fault is reported by the next call to the device.
        device.stream().synchronize().ok();
        self.target = None;
    }
}

impl CudaRasterizer {
    /// Uploads a mesh's triangles and registers its positions, a buffer of OpenGL. Kernels are compiled by
    /// [`Rasterizer::precompile`], or at the first pass that needs them.
    ///
    /// # Errors
    /// `Invalid` when there are 2^24 triangles or more, a triangle refers to a missing vertex, a group to missing
    /// triangles, or the cut-outs do not fit the mesh. `Fault` when the device refuses, or CUDA cannot share OpenGL's
    /// buffer.
    pub fn new(device: &Arc<Device>, mesh: RasterGeometry) -> Result<Self> {
        check(mesh.positions.bytes / POSITION_BYTES, &mesh.triangles, &mesh.groups)?;
        let cut_outs = mesh.cut_outs.filter(|cut_outs| (cut_outs.first as usize) < mesh.triangles.len());
        if let Some(cut_outs) = &cut_outs {
            check_cut_outs(mesh.triangles.len(), cut_outs)?;
        }
        let _current = device.enter()?;
        let sharing = GlInterop::open(device, &mesh.positions)?;
        let all = DrawRange { first: 0, triangles: mesh.triangles.len() as u32, cull_mode: CullMode::None };
        Ok(Self {
            positions: sharing.register(device, mesh.positions)?,
            depth: PassState::new(true, vec![all]),
            ids: PassState::new(false, mesh.groups),
            sharing,
            core: RasterPipeline::new(device, &mesh.triangles, cut_outs.as_ref())?,
            device: Arc::clone(device),
        })
    }

    /// Draws one window or two, with all buffers mapped together.
    fn pass(&mut self, depth: Option<DrawTarget<'_>>, ids: Option<DrawTarget<'_>>) -> Result<()> {
        let Self { positions, depth: of_depth, ids: of_ids, sharing, core, device } = self;
        let _current = device.enter()?;
        let mut ready = Vec::new();
        for (kind, order) in [(of_depth, depth), (of_ids, ids)] {
            let Some((window, target)) = order else { continue };
            let needed = kind.variant.bytes(window);
            if target.bytes < needed {
                let reason = format!("buffer {} has {} bytes, {needed} are needed", target.name, target.bytes);
                return Err(Error::Fault { stage: "raster", reason });
            }
            ready.push((window, kind.prepare(device, (sharing, core), target)?));
        }
        // Not `WriteDiscard`: the kernels read the samples that they wrote.
        let mut mappings = vec![Mapping { buffer: positions, access: MapAccess::Read }];
        let mut passes = Vec::new();
        for (window, (functions, groups, target)) in ready {
            mappings.push(Mapping { buffer: target, access: MapAccess::ReadWrite });
            passes.push((window, functions, groups));
        }
        with_mapped(device, &mut mappings, |addresses| {
            let Some((&positions, targets)) = addresses.split_first() else { return Ok(()) };
            passes.iter().zip(targets).try_for_each(|((window, functions, groups), &target)| {
                let pass = RasterPass { functions, groups, window, positions, target };
                // SAFETY: `new` checked mesh and groups against the size of the positions, and this function checked the
                // size of the target. The mapping checks that the buffers have these sizes, and they stay registered
                // until `release` or `drop` has waited for the pass.
                unsafe { core.draw(device, &pass) }
            })
        })
    }
}

impl Rasterizer for CudaRasterizer {
    /// Draws the requested windows. After a failure the targets are unregistered.
    fn draw(&mut self, depth: Option<DrawTarget<'_>>, ids: Option<DrawTarget<'_>>) -> Result<()> {
        let drawn = if depth.is_some() || ids.is_some() { self.pass(depth, ids) } else { Ok(()) };
        if drawn.is_err() {
            self.depth.release(&self.device);
            self.ids.release(&self.device);
        }
        drawn
    }

    fn precompile(&mut self, depth: bool, ids: bool) -> Result<()> {
        let Self { depth: of_depth, ids: of_ids, core, device, .. } = self;
        for (kind, wanted) in [(of_depth, depth), (of_ids, ids)] {
            if wanted {
                kind.ensure_compiled(device, core)?;
            }
        }
        Ok(())
    }
}

impl Drop for CudaRasterizer {
    fn drop(&mut self) {
        // A fault is reported by the next call to the device.
        self.device.stream().synchronize().ok();
    }
}
