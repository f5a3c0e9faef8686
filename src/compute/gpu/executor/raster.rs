//! The compute rasterizer: launches `kernels/raster.cu`. For each sample of a window it computes the visible triangle
//! and its depth, or depth alone, by atomic minima.
//!
//! A thread draws a triangle that is near few samples, a warp draws one of up to 64 x 64 pixels. A larger or clipped
//! triangle is cut into tiles, which warps draw. The queues between the kernels have capacity for every triangle, so
//! they cannot overflow, and their lengths stay on the device. Samples of cut-outs are tested for alpha before the
//! atomic minimum. Meshes without cut-outs compile none of that code.
//!
//! | file | content |
//! |---|---|
//! | `variant` | the variants of the kernels |
//! | [`check`] | validation of meshes |
//! | `cut_out` | texture coordinates, surfaces and images of cut-outs |
//! | `cuda_rasterizer` | positions and samples in OpenGL's buffers |

mod check;
mod cuda_rasterizer;
mod cut_out;
mod variant;

use bytemuck::{Pod, Zeroable};
use cudarc::driver::sys::{self, CUdevice_attribute};
use cudarc::driver::{CudaFunction, LaunchConfig};

pub use self::check::{check, check_cut_outs};
pub use self::cuda_rasterizer::CudaRasterizer;
use self::cut_out::CutOutBuffers;
use self::variant::{FUNCTIONS, OPAQUE_FUNCTIONS, SOURCE};
pub use self::variant::{RasterGranularity, RasterVariant};
use crate::gpu::launch::error::cuda_error;
use crate::gpu::launch::{Device, DeviceBuffer, LaunchOrder, launch_kernel};
use modalcast_model::error::{Result, fault_in};
use modalcast_model::raster::CutOuts;
use modalcast_model::scene::{CullMode, DrawRange, Viewport};

/// Threads per block, and resident blocks per multiprocessor for kernels that loop over a queue.
const BLOCK: u32 = 128;
const BLOCKS_PER_SM: u32 = 16;

/// Clear value of a sample.
const EMPTY_SAMPLE: u32 = u32::MAX;

/// Arguments of all kernels; pointers are device addresses.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct RasterArgs {
    positions: u64,
    triangles: u64,
    target: u64,
    medium: u64,
    large: u64,
    counters: u64,
    uvs: u64,
    material_indices: u64,
    materials: u64,
    clip: [f32; 16],
    half: [f32; 2],
    guard: [f32; 2],
    size: [u32; 2],
    first: u32,
    count: u32,
    faces: u32,
    first_cut_out: u32,
}

const _: () = assert!(size_of::<RasterArgs>() == 176, "RasterArgs differs from kernels/raster.cuh");

/// Lengths of the queues, and triangle counts by path.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct RasterCounters {
    medium: u32,
    pad: u32,
    large: u64,
    counts: [u32; 8],
}

const _: () = assert!(size_of::<RasterCounters>() == 48, "RasterCounters differs from kernels/raster.cuh");

/// Bytes per entry of the large queue.
const LARGE_ENTRY_BYTES: u64 = 16;

/// The compiled kernels of one form.
#[derive(Debug)]
pub struct RasterFunctions {
    variant: RasterVariant,
    raster: CudaFunction,
    /// Only for meshes with cut-outs.
    raster_cut_outs: Option<CudaFunction>,
    raster_warps: CudaFunction,
    raster_tiles: CudaFunction,
}

impl RasterFunctions {
    /// Compiles the kernels of a form, or takes them from the cache.
    ///
    /// # Errors
    /// `Unavailable` when NVRTC is missing; `Fault` when compiling fails.
    pub fn new(device: &Device, variant: RasterVariant, cut: bool) -> Result<Self> {
        let names: &[&str] = if cut { &FUNCTIONS } else { &OPAQUE_FUNCTIONS };
        let mut list = device.functions(names, SOURCE, &variant.defines(cut))?.into_iter();
        let mut next = || list.next().ok_or_else(|| fault_in("load kernel")("a function is missing"));
        Ok(Self {
            variant,
            raster: next()?,
            raster_cut_outs: if cut { Some(next()?) } else { None },
            raster_warps: next()?,
            raster_tiles: next()?,
        })
    }

    /// The functions with their names.
    pub fn with_names(&self) -> impl Iterator<Item = (&'static str, &CudaFunction)> {
        let list =
            [Some(&self.raster), self.raster_cut_outs.as_ref(), Some(&self.raster_warps), Some(&self.raster_tiles)];
        FUNCTIONS.into_iter().zip(list).filter_map(|(name, function)| function.map(|function| (name, function)))
    }
}

/// The inputs of one pass.
#[derive(Debug, Clone, Copy)]
pub struct RasterPass<'a> {
    pub functions: &'a RasterFunctions,
    pub groups: &'a [DrawRange],
    pub window: &'a Viewport,
    /// Device address of three f32 per vertex.
    pub positions: u64,
    /// Device address of one sample per pixel, [`RasterVariant::bytes`].
    pub target: u64,
}

/// A mesh's triangles on the device, and the queues between the kernels.
#[derive(Debug)]
pub struct RasterPipeline {
    triangles: DeviceBuffer,
    medium: DeviceBuffer,
    large: DeviceBuffer,
    counters: DeviceBuffer,
    cut: Option<CutOutBuffers>,
    /// Blocks of the kernels that loop over a queue.
    blocks: u32,
}

impl RasterPipeline {
    /// Uploads triangles and cut-outs, which [`check`] and [`check_cut_outs`] must have accepted.
    ///
    /// # Errors
    /// `Fault` when the device refuses.
    pub fn new(device: &Device, triangles: &[[u32; 3]], cut_outs: Option<&CutOuts>) -> Result<Self> {
        let units = device.context().attribute(CUdevice_attribute::CU_DEVICE_ATTRIBUTE_MULTIPROCESSOR_COUNT);
        let units = u32::try_from(units.map_err(cuda_error("device"))?).unwrap_or(1);
        let count = triangles.len() as u64;
        Ok(Self {
            triangles: DeviceBuffer::upload(device, triangles.as_flattened())?,
            medium: DeviceBuffer::zeroed(device, 4 * count)?,
            large: DeviceBuffer::zeroed(device, LARGE_ENTRY_BYTES * count)?,
            counters: DeviceBuffer::zeroed(device, size_of::<RasterCounters>() as u64)?,
            cut: cut_outs.map(|cut_outs| CutOutBuffers::new(device, cut_outs)).transpose()?,
            blocks: BLOCKS_PER_SM * units,
        })
    }

    /// Whether its passes need the functions for cut-outs.
    pub const fn has_cut_outs(&self) -> bool {
        self.cut.is_some()
    }

    /// Clears the target and draws into it, on the device's stream.
    ///
    /// # Safety
    /// [`check`] accepted this mesh and the groups of the pass for the number of vertices at `positions`. `positions` and
    /// `target` are addresses of device memory with the sizes that [`RasterPass`] states, which exists until the pass has
    /// ended.
    ///
    /// # Errors
    /// `Fault` when the device refuses.
    pub unsafe fn draw(&self, device: &Device, pass: &RasterPass<'_>) -> Result<()> {
        let _current = device.enter()?;
        // SAFETY: the caller guarantees the target.
        unsafe { self.clear(device, pass) }?;
        let (args, functions) = (self.args(pass), pass.functions);
        // SAFETY: the args refer to the mesh, whose triangles refer to existing vertices and whose groups to existing
        // triangles. The queues have capacity for each triangle. The caller guarantees positions and target.
        let start = |function, blocks, args| unsafe { start(device, function, blocks, args) };
        for group in pass.groups {
            let (whole, cut) = self.split(*group);
            for (function, own) in [(Some(&functions.raster), whole), (functions.raster_cut_outs.as_ref(), cut)] {
                if let Some(function) = function.filter(|_| own.triangles > 0) {
                    let faces = u32::from(own.cull_mode == CullMode::Back);
                    let args = RasterArgs { first: own.first, count: own.triangles, faces, ..args };
                    start(function, own.triangles.div_ceil(BLOCK), args)?;
                }
            }
        }
        start(&functions.raster_warps, self.blocks, args)?;
        start(&functions.raster_tiles, self.blocks, args)
    }

    /// Number of launches of a pass over these groups.
    pub fn launches(&self, groups: &[DrawRange]) -> usize {
        let of_group = |group: &DrawRange| {
            let (whole, cut) = self.split(*group);
            usize::from(whole.triangles > 0) + usize::from(cut.triangles > 0)
        };
        2 + groups.iter().map(of_group).sum::<usize>()
    }

    /// Splits a group before the first cut-out.
    fn split(&self, group: DrawRange) -> (DrawRange, DrawRange) {
        let first = self.cut.as_ref().map_or(u32::MAX, |cut| cut.first);
        let whole = first.saturating_sub(group.first).min(group.triangles);
        let cut = DrawRange { first: group.first + whole, triangles: group.triangles - whole, ..group };
        (DrawRange { triangles: whole, ..group }, cut)
    }

    /// Triangle counts of the last pass, indexed by `Path` of the kernels; zeros unless the form counts.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    pub fn counts(&self, device: &Device) -> Result<[u32; 8]> {
        let mut counters = [RasterCounters::zeroed()];
        self.counters.read(device, 0, &mut counters)?;
        Ok(counters[0].counts)
    }

    fn args(&self, pass: &RasterPass<'_>) -> RasterArgs {
        let cut = self.cut.as_ref();
        let addresses = cut.map(CutOutBuffers::addresses).unwrap_or_default();
        RasterArgs {
            positions: pass.positions,
            triangles: self.triangles.address(),
            target: pass.target,
            medium: self.medium.address(),
            large: self.large.address(),
            counters: self.counters.address(),
            clip: *pass.window.clip_from_positions(),
            half: pass.window.half_size(),
            guard: pass.window.guard_band(),
            size: pass.window.size(),
            uvs: addresses.uvs,
            material_indices: addresses.material_indices,
            materials: addresses.materials,
            first_cut_out: cut.map_or(u32::MAX, |cut| cut.first),
            ..RasterArgs::zeroed()
        }
    }

    /// Empties the queues and clears the samples.
    ///
    /// # Safety
    /// The target of the pass has the bytes of its window.
    unsafe fn clear(&self, device: &Device, pass: &RasterPass<'_>) -> Result<()> {
        let variant = pass.functions.variant;
        let nothing = if variant.depth_only { 1.0_f32.to_bits() } else { EMPTY_SAMPLE };
        let words = variant.bytes(pass.window) / 4;
        let counters = (self.counters.address(), 0, size_of::<RasterCounters>() as u64 / 4);
        for (buffer, word, words) in [(pass.target, nothing, words), counters] {
            let stream = device.stream().cu_stream();
            // SAFETY: the counters are one `RasterCounters`, and the caller guarantees the target. The stream orders the
            // writes before their readers.
            let set = unsafe { sys::cuMemsetD32Async(buffer, word, words as usize, stream) };
            set.result().map_err(cuda_error("raster"))?;
        }
        Ok(())
    }
}

/// # Safety
/// The addresses in `args` are those of memory that the kernels may access.
unsafe fn start(device: &Device, function: &CudaFunction, blocks: u32, args: RasterArgs) -> Result<()> {
    let config = LaunchConfig { grid_dim: (blocks, 1, 1), block_dim: (BLOCK, 1, 1), shared_mem_bytes: 0 };
    // SAFETY: the kernels' only argument is a `RasterArgs`; the caller guarantees the addresses.
    unsafe { launch_kernel(device, function, config, LaunchOrder::Serial, &args) }
}
