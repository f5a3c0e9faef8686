//! The compute rasterizer: launches `kernels/raster.cu`. It computes the visible triangle and its depth, or depth
//! alone, by atomic minima and maxima. A pixel has one sample, at its center.
//!
//! A thread draws a small triangle, whose bounding box has at most 32 samples. A warp draws a medium triangle, of up to
//! 64 x 64 pixels. A larger or clipped triangle is divided into tiles of 64 x 64 pixels, which warps draw. Medium and
//! large triangles wait in two queues. Each queue has capacity for every triangle, so it cannot overflow, and its
//! length stays on the device. Samples of cut-outs are tested for alpha before the atomic operation. The kernels for
//! meshes without cut-outs are compiled without this test.
//!
//! | file | content |
//! |---|---|
//! | `variant` | the variants of the kernels |
//! | `check` | validation of meshes |
//! | `cut_out` | texture coordinates, materials and images of cut-outs |
//! | `cuda_rasterizer` | positions and samples in OpenGL's buffers or in shared memory |

mod check;
mod cuda_rasterizer;
pub(super) mod cut_out;
mod variant;

use std::ops::Range;

use bytemuck::{Pod, Zeroable};
use cudarc::driver::sys::{self, CUdevice_attribute};
use cudarc::driver::{CudaFunction, LaunchConfig};

pub use self::check::{check_cut_outs, check_mesh};
pub use self::cuda_rasterizer::CudaRasterizer;
use self::cut_out::CutOutBuffers;
use self::variant::{FUNCTIONS, OPAQUE_FUNCTIONS, SOURCE};
pub use self::variant::{RasterGranularity, RasterVariant};
use crate::gpu::launch::error::cuda_error;
use crate::gpu::launch::{Device, DeviceBuffer, LaunchOrder, launch_kernel};
use modalcast_model::error::{Result, fault};
use modalcast_model::raster::CutOuts;
use modalcast_model::scene::{CullMode, DrawRange, Viewport};

/// Threads per block.
const BLOCK_THREADS: u32 = 128;
/// Blocks per multiprocessor of the kernels that loop over a queue: 16 x 128 = 2048 threads, the largest number that
/// can be resident.
const BLOCKS_PER_SM: u32 = 16;

/// A sample has two 32-bit words: the depth with inverted bits, and the triangle. Both have this value where no triangle
/// covers the sample.
const EMPTY_SAMPLE: u32 = u32::MAX;
/// Bits of the depth of the far plane, 0, which is the depth of a sample that no triangle covers.
const FAR_DEPTH: u32 = 0;

/// Arguments of all kernels; pointers are device addresses. `kernels/raster.cuh` documents the fields.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct RasterArgs {
    positions: u64,
    triangles: u64,
    target: u64,
    medium_queue: u64,
    large_queue: u64,
    counters: u64,
    uvs: u64,
    material_indices: u64,
    materials: u64,
    clip_from_position: [f32; 16],
    half_size: [f32; 2],
    guard_band: [f32; 2],
    size: [u32; 2],
    first_triangle: u32,
    triangle_count: u32,
    culls_back_faces: u32,
    first_cut_out: u32,
}

const _: () = assert!(size_of::<RasterArgs>() == 176, "RasterArgs differs from kernels/raster.cuh");

/// Lengths of the queues, and numbers of triangles by `TriangleBin` of `kernels/raster.cuh`: small, medium, large, or
/// the reason why the triangle is culled.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct RasterCounters {
    medium_count: u32,
    pad: u32,
    large_count: u64,
    bin_counts: [u32; 8],
}

const _: () = assert!(size_of::<RasterCounters>() == 48, "RasterCounters differs from kernels/raster.cuh");

/// Bytes per entry of the large queue.
const LARGE_ENTRY_BYTES: u64 = 16;

/// The compiled kernels of one variant.
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
    /// Compiles the kernels of a variant, or takes them from the cache.
    ///
    /// # Errors
    /// `Unavailable` when NVRTC is missing; `Fault` when compiling fails.
    pub fn new(device: &Device, variant: RasterVariant, has_cut_outs: bool) -> Result<Self> {
        let names: &[&str] = if has_cut_outs { &FUNCTIONS } else { &OPAQUE_FUNCTIONS };
        let mut functions = device.functions(names, SOURCE, &variant.defines(has_cut_outs))?.into_iter();
        let mut next = || functions.next().ok_or_else(|| fault("load kernel", "expected another function"));
        Ok(Self {
            variant,
            raster: next()?,
            raster_cut_outs: if has_cut_outs { Some(next()?) } else { None },
            raster_warps: next()?,
            raster_tiles: next()?,
        })
    }

    /// The functions with their names.
    pub fn with_names(&self) -> impl Iterator<Item = (&'static str, &CudaFunction)> {
        let functions =
            [Some(&self.raster), self.raster_cut_outs.as_ref(), Some(&self.raster_warps), Some(&self.raster_tiles)];
        FUNCTIONS.into_iter().zip(functions).filter_map(|(name, function)| function.map(|function| (name, function)))
    }
}

/// The inputs and the target of one pass.
#[derive(Debug, Clone)]
pub struct RasterPass<'a> {
    pub functions: &'a RasterFunctions,
    pub groups: &'a [DrawRange],
    pub window: &'a Viewport,
    /// Device address of three f32 per vertex.
    pub positions: u64,
    /// Device address of the samples, one per pixel: [`RasterVariant::bytes`] bytes.
    pub target: u64,
    /// Only these triangles are drawn. A range that begins at 0 clears the samples first.
    pub range: Range<u32>,
}

/// A mesh's triangles on the device, and the queues between the kernels.
#[derive(Debug)]
pub struct RasterPipeline {
    triangles: DeviceBuffer,
    /// Indices of triangles that a warp draws.
    medium_queue: DeviceBuffer,
    /// Triangles that are divided into tiles.
    large_queue: DeviceBuffer,
    counters: DeviceBuffer,
    cut_outs: Option<CutOutBuffers>,
    /// Number of blocks of the kernels that loop over a queue.
    blocks: u32,
}

impl RasterPipeline {
    /// Uploads triangles and cut-outs, which [`check_mesh`] and [`check_cut_outs`] must have accepted.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    pub fn new(device: &Device, triangles: &[[u32; 3]], cut_outs: Option<&CutOuts>) -> Result<Self> {
        let multiprocessors = device
            .context()
            .attribute(CUdevice_attribute::CU_DEVICE_ATTRIBUTE_MULTIPROCESSOR_COUNT)
            .map_err(cuda_error("device"))?;
        let multiprocessors = u32::try_from(multiprocessors).unwrap_or(1);
        let count = triangles.len() as u64;
        Ok(Self {
            triangles: DeviceBuffer::upload(device, triangles.as_flattened())?,
            medium_queue: DeviceBuffer::zeroed(device, 4 * count)?,
            large_queue: DeviceBuffer::zeroed(device, LARGE_ENTRY_BYTES * count)?,
            counters: DeviceBuffer::zeroed(device, size_of::<RasterCounters>() as u64)?,
            cut_outs: cut_outs.map(|cut_outs| CutOutBuffers::new(device, cut_outs)).transpose()?,
            blocks: BLOCKS_PER_SM * multiprocessors,
        })
    }

    /// Whether passes need the functions for cut-outs.
    pub const fn has_cut_outs(&self) -> bool {
        self.cut_outs.is_some()
    }

    /// Clears the target if the range of the pass begins at 0, and draws into it, on the device's stream.
    ///
    /// # Safety
    /// [`check_mesh`] accepted this mesh and the groups of the pass for the number of vertices at `positions`.
    /// `positions` and `target` are addresses of device memory with the sizes that [`RasterPass`] states. This memory
    /// exists until the pass has ended.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    pub unsafe fn draw(&self, device: &Device, pass: &RasterPass<'_>) -> Result<()> {
        let _current = device.enter()?;
        // SAFETY: the caller guarantees the target.
        unsafe { self.clear(device, pass) }?;
        let (args, functions) = (self.args(pass), pass.functions);
        // SAFETY: `args` refers to the mesh, whose triangles refer to existing vertices. The groups refer to existing
        // triangles. The queues have capacity for each triangle. The caller guarantees positions and target.
        let start = |function, blocks, args| unsafe { start(device, function, blocks, args) };
        for group in pass.groups {
            let (opaque_range, cut_out_range) = self.split(intersect(*group, &pass.range));
            for (function, range) in
                [(Some(&functions.raster), opaque_range), (functions.raster_cut_outs.as_ref(), cut_out_range)]
            {
                if let Some(function) = function.filter(|_| range.triangle_count > 0) {
                    let args = RasterArgs {
                        first_triangle: range.first_triangle,
                        triangle_count: range.triangle_count,
                        culls_back_faces: u32::from(range.cull_mode == CullMode::Back),
                        ..args
                    };
                    start(function, range.triangle_count.div_ceil(BLOCK_THREADS), args)?;
                }
            }
        }
        start(&functions.raster_warps, self.blocks, args)?;
        start(&functions.raster_tiles, self.blocks, args)
    }

    /// Number of kernel launches of a pass over these groups.
    pub fn launches(&self, groups: &[DrawRange]) -> usize {
        let group_launches = |group: &DrawRange| {
            let (opaque_range, cut_out_range) = self.split(*group);
            usize::from(opaque_range.triangle_count > 0) + usize::from(cut_out_range.triangle_count > 0)
        };
        // `raster_warps` and `raster_tiles` are launched once per pass.
        2 + groups.iter().map(group_launches).sum::<usize>()
    }

    /// Splits a group into opaque triangles and cut-outs.
    fn split(&self, group: DrawRange) -> (DrawRange, DrawRange) {
        let first_cut_out = self.cut_outs.as_ref().map_or(u32::MAX, |cut_outs| cut_outs.first);
        let opaque_count = first_cut_out.saturating_sub(group.first_triangle).min(group.triangle_count);
        let cut_outs = DrawRange {
            first_triangle: group.first_triangle + opaque_count,
            triangle_count: group.triangle_count - opaque_count,
            ..group
        };
        (DrawRange { triangle_count: opaque_count, ..group }, cut_outs)
    }

    /// Numbers of triangles of the last pass, indexed by `TriangleBin` of the kernels. Zeros unless
    /// [`RasterVariant::count_triangles`] is set.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    pub fn counts(&self, device: &Device) -> Result<[u32; 8]> {
        let mut counters = [RasterCounters::zeroed()];
        self.counters.read(device, 0, &mut counters)?;
        Ok(counters[0].bin_counts)
    }

    fn args(&self, pass: &RasterPass<'_>) -> RasterArgs {
        let cut_outs = self.cut_outs.as_ref();
        let addresses = cut_outs.map(CutOutBuffers::addresses).unwrap_or_default();
        RasterArgs {
            positions: pass.positions,
            triangles: self.triangles.address(),
            target: pass.target,
            medium_queue: self.medium_queue.address(),
            large_queue: self.large_queue.address(),
            counters: self.counters.address(),
            clip_from_position: *pass.window.clip_from_positions(),
            half_size: pass.window.half_size(),
            guard_band: pass.window.guard_band(),
            size: pass.window.size(),
            uvs: addresses.uvs,
            material_indices: addresses.material_indices,
            materials: addresses.materials,
            first_cut_out: cut_outs.map_or(u32::MAX, |cut_outs| cut_outs.first),
            ..RasterArgs::zeroed()
        }
    }

    /// Empties the queues, and clears the samples if the range of the pass begins at 0.
    ///
    /// # Safety
    /// The target of the pass has at least as many bytes as all samples of its window ([`RasterVariant::bytes`]).
    unsafe fn clear(&self, device: &Device, pass: &RasterPass<'_>) -> Result<()> {
        let variant = pass.functions.variant;
        let clear_word = if variant.depth_only { FAR_DEPTH } else { EMPTY_SAMPLE };
        let words = if pass.range.start == 0 { variant.bytes(pass.window) / 4 } else { 0 };
        let counter_words = size_of::<RasterCounters>() as u64 / 4;
        for (address, word, word_count) in
            [(pass.target, clear_word, words), (self.counters.address(), 0, counter_words)]
        {
            if word_count == 0 {
                continue;
            }
            let stream = device.stream().cu_stream();
            // SAFETY: the counters are one `RasterCounters`, and the caller guarantees the target. The stream orders
            // the writes before their readers.
            let result = unsafe { sys::cuMemsetD32Async(address, word, word_count as usize, stream) };
            result.result().map_err(cuda_error("raster"))?;
        }
        Ok(())
    }
}

/// The part of a group in a range of triangles; without triangles if there is none.
fn intersect(group: DrawRange, range: &Range<u32>) -> DrawRange {
    let first_triangle = group.first_triangle.max(range.start);
    let end = (group.first_triangle + group.triangle_count).min(range.end);
    DrawRange { first_triangle, triangle_count: end.saturating_sub(first_triangle), ..group }
}

/// Starts a kernel of `blocks` blocks on the device's stream.
///
/// # Safety
/// The addresses in `args` are those of memory that the kernels may access.
unsafe fn start(device: &Device, function: &CudaFunction, blocks: u32, args: RasterArgs) -> Result<()> {
    let config = LaunchConfig { grid_dim: (blocks, 1, 1), block_dim: (BLOCK_THREADS, 1, 1), shared_mem_bytes: 0 };
    // SAFETY: the kernels' only argument is a `RasterArgs`; the caller guarantees the addresses.
    unsafe { launch_kernel(device, function, config, LaunchOrder::Serial, &args) }
}
