//! The compute rasterizer on OpenGL's buffers, or on memory that OpenGL imports. It can replace OpenGL's depth pass and id
//! pass.

use std::ops::Range;
use std::rc::Rc;
use std::sync::Arc;

use cudarc::driver::CudaEvent;
use cudarc::driver::sys::CUevent_flags;

use super::super::interop::{GlInterop, MapAccess, Mapping, RegisteredBuffer, with_mapped};
use super::super::shared_range::CudaRange;
use super::{RasterFunctions, RasterPass, RasterPipeline, RasterVariant, check_cut_outs, check_mesh};
use crate::gpu::launch::cleanup::WaitForStream;
use crate::gpu::launch::error::cuda_error;
use crate::gpu::launch::{Device, ExportedMemory};
use modalcast_model::error::{Error, Result, fault};
use modalcast_model::fault_injection::{self, InjectionPoint};
use modalcast_model::raster::{ALL_TRIANGLES, DrawTarget, GlBuffer, NewTarget, RasterGeometry, Rasterizer, SharedDraw};
use modalcast_model::scene::{CullMode, DrawRange};

/// Bytes of a vertex position.
const POSITION_BYTES: u64 = 12;

/// Draws one mesh with CUDA. It stays on the thread that created it, which owns the OpenGL context. Dropping it waits
/// for all passes before any memory that they use is released.
#[derive(Debug)]
pub struct CudaRasterizer {
    positions: RegisteredBuffer,
    depth: PassState,
    ids: PassState,
    interop: GlInterop,
    pipeline: RasterPipeline,
    /// Begin and end of [`Rasterizer::draw_shared`]; `None` before the first call.
    shared_draw_events: Option<[CudaEvent; 2]>,
    device: Arc<Device>,
}

/// The state of the depth pass or the id pass. Its first draw compiles the kernels and registers the target buffer.
#[derive(Debug)]
struct PassState {
    target: Option<RegisteredBuffer>,
    functions: Option<RasterFunctions>,
    variant: RasterVariant,
    groups: Vec<DrawRange>,
}

/// A pass that is ready to be drawn.
struct PreparedPass<'a> {
    functions: &'a RasterFunctions,
    groups: &'a [DrawRange],
    target: &'a mut RegisteredBuffer,
}

impl PassState {
    const fn new(variant: RasterVariant, groups: Vec<DrawRange>) -> Self {
        Self { target: None, functions: None, variant, groups }
    }

    /// Returns the kernels, compiled at the first call.
    fn ensure_compiled(&mut self, device: &Device, pipeline: &RasterPipeline) -> Result<&RasterFunctions> {
        let functions = match self.functions.take() {
            Some(functions) => functions,
            None => RasterFunctions::new(device, self.variant, pipeline.has_cut_outs())?,
        };
        Ok(self.functions.insert(functions))
    }

    /// Compiles the kernels and registers the target, if this is not yet done.
    fn prepare(
        &mut self,
        device: &Device,
        interop: &GlInterop,
        pipeline: &RasterPipeline,
        target: &GlBuffer,
    ) -> Result<PreparedPass<'_>> {
        self.ensure_compiled(device, pipeline)?;
        if self.target.as_ref().is_some_and(|registered| registered.buffer() != target) {
            self.release(device);
        }
        let registered = match self.target.take() {
            Some(registered) => registered,
            None => interop.register(device, target.clone())?,
        };
        let missing_functions = || fault("raster", "expected compiled kernels");
        Ok(PreparedPass {
            functions: self.functions.as_ref().ok_or_else(missing_functions)?,
            groups: &self.groups,
            target: self.target.insert(registered),
        })
    }

    /// Unregisters the target after all work on it has completed.
    fn release(&mut self, device: &Device) {
        // Ignore a fault: the next call to the device reports it.
        device.stream().synchronize().ok();
        self.target = None;
    }
}

impl CudaRasterizer {
    /// Uploads the triangles of a mesh and registers the OpenGL buffer of its positions. Kernels are compiled by
    /// [`Rasterizer::precompile`], or at the first pass that needs them.
    ///
    /// # Errors
    /// `Invalid` when [`check_mesh`] or [`check_cut_outs`] rejects the mesh. `Fault` when the device fails, or when
    /// CUDA cannot share OpenGL's buffer.
    pub fn new(device: &Arc<Device>, mesh: RasterGeometry) -> Result<Self> {
        check_mesh(mesh.positions.bytes / POSITION_BYTES, &mesh.triangles, &mesh.groups)?;
        let cut_outs = mesh.cut_outs.filter(|cut_outs| (cut_outs.first as usize) < mesh.triangles.len());
        if let Some(cut_outs) = &cut_outs {
            check_cut_outs(mesh.triangles.len(), cut_outs)?;
        }
        let _current = device.enter()?;
        let interop = GlInterop::open(device, &mesh.positions)?;
        let all_triangles =
            DrawRange { first_triangle: 0, triangle_count: mesh.triangles.len() as u32, cull_mode: CullMode::None };
        let depth_variant = RasterVariant { depth_only: true, ..RasterVariant::default() };
        Ok(Self {
            positions: interop.register(device, mesh.positions)?,
            depth: PassState::new(depth_variant, vec![all_triangles]),
            ids: PassState::new(RasterVariant::default(), mesh.groups),
            interop,
            pipeline: RasterPipeline::new(device, &mesh.triangles, cut_outs.as_ref())?,
            shared_draw_events: None,
            device: Arc::clone(device),
        })
    }

    /// Draws the depth pass, the id pass or both, with all buffers mapped together.
    fn draw_passes(
        &mut self,
        depth: Option<DrawTarget<'_>>,
        ids: Option<DrawTarget<'_>>,
        range: &Range<u32>,
    ) -> Result<()> {
        let Self { positions, depth: depth_pass, ids: id_pass, interop, pipeline, device, .. } = self;
        let _current = device.enter()?;
        let mut prepared = Vec::new();
        for (pass_state, draw_target) in [(depth_pass, depth), (id_pass, ids)] {
            let Some((window, target)) = draw_target else { continue };
            let needed_bytes = pass_state.variant.bytes(window);
            if target.bytes < needed_bytes {
                let reason =
                    format!("buffer {}: expected at least {needed_bytes} bytes, got {}", target.name, target.bytes);
                return Err(Error::Fault { stage: "raster", reason });
            }
            prepared.push((window, pass_state.prepare(device, interop, pipeline, target)?));
        }
        // Targets are mapped as `ReadWrite`, not `WriteDiscard`, because the atomic operations also read samples.
        let mut mappings = vec![Mapping { buffer: positions, access: MapAccess::Read }];
        let mut passes = Vec::new();
        for (window, PreparedPass { functions, groups, target }) in prepared {
            mappings.push(Mapping { buffer: target, access: MapAccess::ReadWrite });
            passes.push((window, functions, groups));
        }
        with_mapped(device, &mut mappings, |addresses| {
            let Some((&positions, targets)) = addresses.split_first() else { return Ok(()) };
            passes.iter().zip(targets).try_for_each(|((window, functions, groups), &target)| {
                let pass = RasterPass { functions, groups, window, positions, target, range: range.clone() };
                // SAFETY: `new` checked mesh and groups against the size of the positions, and this function checked
                // the size of the target. The mapping checks that the buffers have these sizes, and they stay
                // registered until `release` or `drop` has waited for the pass.
                unsafe { pipeline.draw(device, &pass) }
            })
        })
    }
}

impl CudaRasterizer {
    /// Submits the passes of one step, from and into shared memory.
    fn submit_shared(&mut self, draw: &SharedDraw<'_>) -> Result<()> {
        let Self { positions, depth, ids, pipeline, device, .. } = self;
        let positions = CudaRange::address_of(draw.positions, device, positions.buffer().bytes)?;
        for (pass_state, draw_target) in [(depth, draw.depth), (ids, draw.ids)] {
            let Some((window, range)) = draw_target else { continue };
            let target = CudaRange::address_of(range, device, pass_state.variant.bytes(window))?;
            pass_state.ensure_compiled(device, pipeline)?;
            let Some(functions) = &pass_state.functions else { continue };
            let groups = &pass_state.groups;
            let pass = RasterPass { functions, groups, window, positions, target, range: ALL_TRIANGLES };
            // SAFETY: `new` checked mesh and groups against the size of OpenGL's buffer of positions, and the shared
            // positions have at least this size. The target has the bytes of the pass. `draw_shared` borrows the handles
            // of both until the passes have ended.
            unsafe { pipeline.draw(device, &pass) }?;
        }
        Ok(())
    }
}

/// The two events of [`Rasterizer::draw_shared`], which record when they are reached.
fn new_timed_events(device: &Device) -> Result<[CudaEvent; 2]> {
    let new_event = || device.context().new_event(Some(CUevent_flags::CU_EVENT_DEFAULT)).map_err(cuda_error("raster"));
    Ok([new_event()?, new_event()?])
}

impl Rasterizer for CudaRasterizer {
    /// Draws the requested passes. After a failure the targets are unregistered.
    fn draw(&mut self, depth: Option<DrawTarget<'_>>, ids: Option<DrawTarget<'_>>, range: Range<u32>) -> Result<()> {
        let result = if depth.is_some() || ids.is_some() { self.draw_passes(depth, ids, &range) } else { Ok(()) };
        if result.is_err() {
            self.depth.release(&self.device);
            self.ids.release(&self.device);
        }
        result
    }

    fn precompile(&mut self, depth: bool, ids: bool) -> Result<()> {
        let Self { depth: depth_pass, ids: id_pass, pipeline, device, .. } = self;
        for (pass_state, is_requested) in [(depth_pass, depth), (id_pass, ids)] {
            if is_requested {
                pass_state.ensure_compiled(device, pipeline)?;
            }
        }
        Ok(())
    }

    fn create_target(&mut self, bytes: u64) -> Result<NewTarget> {
        let _current = self.device.enter()?;
        let memory = Rc::new(ExportedMemory::new(&self.device, bytes as usize)?);
        Ok(NewTarget {
            descriptor: memory.export()?,
            allocated_bytes: memory.bytes() as u64,
            range: Rc::new(CudaRange::new(&self.device, &memory, 0..bytes)),
        })
    }

    fn draw_shared(&mut self, draws: &[SharedDraw<'_>]) -> Result<f64> {
        let device = Arc::clone(&self.device);
        let _current = device.enter()?;
        fault_injection::check(InjectionPoint::Interop)?;
        let [begin, end] = match self.shared_draw_events.take() {
            Some(events) => events,
            None => new_timed_events(&device)?,
        };
        // Also waits if a draw fails or panics, because the caller may then free the memory.
        let guard = WaitForStream::new(device.stream());
        begin.record(device.stream()).map_err(cuda_error("raster"))?;
        draws.iter().try_for_each(|draw| self.submit_shared(draw))?;
        end.record(device.stream()).map_err(cuda_error("raster"))?;
        end.synchronize().map_err(cuda_error("raster"))?;
        guard.disarm();
        let ms = begin.elapsed_ms(&end).map(f64::from).map_err(cuda_error("raster"))?;
        self.shared_draw_events = Some([begin, end]);
        Ok(ms)
    }
}

impl Drop for CudaRasterizer {
    fn drop(&mut self) {
        // Ignore a fault: the next call to the device reports it.
        self.device.stream().synchronize().ok();
    }
}
