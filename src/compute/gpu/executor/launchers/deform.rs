//! Launches `kernels/deform.cu`: x = T (x0 + U q) of all domains at once, their rigid normals and tangents (those at
//! rest, transformed by T), and four bounding boxes per tile.
//!
//! A quad is four consecutive vertices or corners of a domain. A tile, the work of one warp, is up to 32 quads: of one
//! domain, or of several small domains (a mixed tile). A step that changes few domains is a partial step: the kernel
//! `apply` writes a list of tiles, and `deform` computes only these.

use std::sync::Arc;

use cudarc::driver::{CudaFunction, LaunchConfig};

use super::batch::{BatchKernel, SharedTables};
use crate::gpu::executor::inputs::StepInputs;
use crate::gpu::launch::error::cuda_error;
use crate::gpu::launch::{Device, DeviceBuffer, KernelDescriptor, LaunchOrder, launch_kernel};
use crate::gpu::tables::device_tables::DeviceTables;
use crate::gpu::tables::input_packing::{DirtyTileLayout, InputPacker};
use crate::gpu::tables::kernels::{AXIS_PER_WARP, deform_blocks};
use crate::gpu::tables::layout::{BoxSegment, DeformArgs, WARP_THREADS};
use crate::gpu::tables::occupancy::deform_tuning;
use crate::gpu::tables::work::{WordSource, WorkList, mix_tiles};
use crate::storage::{PackedWord, TiledModes};
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::Scene;

/// Approximate cost of one tile in `batch`, which computes it for all members of a group, in units of a tile of
/// `deform`.
const DEFORM_TILES_PER_BATCH_TILE: usize = 2;

/// Minimum number of 16-byte words of U per upload (64 MiB), except for the last upload. Packed words are uploaded as
/// soon as there are this many, which bounds the host memory.
const UPLOAD_WORDS: usize = 1 << 22;

/// The descriptors of the kernels that write positions.
#[derive(Debug, Clone, Copy)]
pub struct PositionKernels<'a> {
    pub deform: &'a KernelDescriptor,
    /// Only in scenes with batches.
    pub batch: Option<&'a KernelDescriptor>,
}

/// The bounding boxes of all tiles on the device.
#[derive(Debug, Clone, Copy)]
pub(super) struct TileBoxes {
    pub address: u64,
    /// Number of boxes, four per tile.
    pub count: u32,
}

/// The kernel and the constant tables of a scene.
#[derive(Debug)]
pub struct DeformKernel {
    function: CudaFunction,
    config: LaunchConfig,
    /// The kernel for groups of domains that share U; only in a scene with batches.
    batch: Option<BatchKernel>,
    /// The variant of the kernel for partial steps; only in a scene that can have them.
    tile_list_function: Option<CudaFunction>,
    tiles: DeviceBuffer,
    /// The quads of mixed tiles.
    mixed_quads: DeviceBuffer,
    /// With `Int8`, the index in `scales` of each of these quads.
    mixed_quad_scales: DeviceBuffer,
    /// U in packed words of 16 bytes.
    words: DeviceBuffer,
    rest_positions: DeviceBuffer,
    rest_normals: DeviceBuffer,
    rest_tangents: DeviceBuffer,
    /// Per domain, the index of its first corner minus that of its first vertex, both counted over all domains.
    corner_offsets: DeviceBuffer,
    /// With `Int8`, the scale of each tile and mode, by which the kernel multiplies q.
    scales: DeviceBuffer,
    /// Indices of the tiles that a partial step computes.
    tile_list: DeviceBuffer,
    /// Four boxes per tile, as six integer keys each (`tables::box_keys`).
    boxes: DeviceBuffer,
    /// Number of tiles.
    tile_count: u32,
    /// Number of tiles that this kernel computes in a full step: the first ones of the list. The kernel `batch`
    /// computes the other tiles with vertices.
    full_step_tiles: u32,
    /// Index of the first quad that has normals or tangents (directions).
    first_direction_quad: u64,
    packer: Arc<InputPacker>,
    /// Segments of domains that `bounds` reduces to boxes; only in scenes with the feature `boxes`.
    segments: Option<Vec<BoxSegment>>,
}

impl DeformKernel {
    /// Compiles the kernels, and uploads the tables and U.
    ///
    /// # Errors
    /// As [`Device::function`]; `Fault` when the device has not enough memory.
    pub fn new(
        device: &Device,
        scene: &Arc<Scene>,
        kernels: PositionKernels<'_>,
        tables: DeviceTables,
    ) -> Result<Self> {
        let DeviceTables {
            coordinates,
            work,
            segments,
            rest_positions,
            rest_normals,
            rest_tangents,
            tile_list_capacity,
            ..
        } = tables;
        let kernel = kernels.deform;
        let mut uploader = ModeUploader::new(device, scene, &work)?;
        work.sources.iter().try_for_each(|source| uploader.add(source))?;
        let UploadedModes { words, scales, factors } = uploader.finish()?;
        let factors = coordinates.spread_factors(scene, &factors);
        let has_partial_steps = tile_list_capacity > 0;
        // Tiles that have only corners are needed only for rigid normals.
        let full_step_tiles =
            if kernel.defines.contains(&"RIGID_NORMALS") { work.full_step_tiles } else { work.vertex_tiles };
        let config = LaunchConfig { grid_dim: (deform_blocks(kernel, full_step_tiles), 1, 1), ..kernel.config() };
        Ok(Self {
            function: compile_function(device, kernel)?,
            config,
            batch: kernels.batch.map(|kernel| BatchKernel::new(device, kernel, &work.batched)).transpose()?,
            tile_list_function: has_partial_steps.then(|| compile_tile_list_function(device, kernel)).transpose()?,
            tiles: DeviceBuffer::upload(device, &work.tiles)?,
            mixed_quads: DeviceBuffer::upload(device, &work.mixed_quads)?,
            mixed_quad_scales: DeviceBuffer::upload(device, &work.mixed_quad_scales)?,
            words,
            rest_positions: DeviceBuffer::upload(device, &rest_positions)?,
            rest_normals: DeviceBuffer::upload(device, &rest_normals)?,
            rest_tangents: DeviceBuffer::upload(device, &rest_tangents)?,
            corner_offsets: DeviceBuffer::upload(device, &work.corner_offsets)?,
            scales,
            tile_list: DeviceBuffer::zeroed(device, 4 * tile_list_capacity as u64)?,
            boxes: DeviceBuffer::zeroed(device, work.box_bytes())?,
            tile_count: work.tiles.len() as u32,
            full_step_tiles: full_step_tiles as u32,
            first_direction_quad: work.quads.first_direction_quad,
            segments: scene.features.boxes.then_some(segments),
            packer: Arc::new(InputPacker {
                scene: Arc::clone(scene),
                coordinates,
                factors,
                dirty_tile_layout: DirtyTileLayout {
                    domain_tiles: work.domain_tiles,
                    tile_count: work.tiles.len(),
                    full_step_cost: work.full_step_tiles + DEFORM_TILES_PER_BATCH_TILE * work.batched.tiles(),
                },
            }),
        })
    }

    /// The packer of input values in the layout that the kernels expect.
    pub const fn packer(&self) -> &Arc<InputPacker> {
        &self.packer
    }

    /// The segments of all domains, in scenes with the feature `boxes`.
    pub(super) fn segments(&self) -> Option<&[BoxSegment]> {
        self.segments.as_deref()
    }

    /// The boxes of all tiles.
    pub(super) fn boxes(&self) -> TileBoxes {
        TileBoxes { address: self.boxes.address(), count: 4 * self.tile_count }
    }

    /// Address of the tile list, which the kernel `apply` writes.
    pub(super) fn tile_list(&self) -> u64 {
        self.tile_list.address()
    }

    /// Names and functions of the kernels that a full step launches.
    pub fn kernels(&self) -> Vec<(&'static str, &CudaFunction)> {
        let batch = self.batch.as_ref().map(|batch| ("batch", &batch.function));
        batch.into_iter().chain((self.full_step_tiles > 0).then_some(("deform", &self.function))).collect()
    }

    /// Starts the kernels of a full step.
    ///
    /// # Safety
    /// `inputs` has the layout of [`Self::packer`] and contains a full step when the kernels run. Its header has the
    /// addresses of the outputs that the kernels write, with the sizes of the scene: positions; normals and tangents if
    /// they are rigid; displacements with the feature `displacements`. `inputs` and the outputs exist until the kernels
    /// have ended.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    pub unsafe fn launch(&self, device: &Device, inputs: &StepInputs) -> Result<()> {
        if let Some(batch) = &self.batch {
            let Self { words, rest_positions, scales, boxes, .. } = self;
            // SAFETY: the caller guarantees the inputs; the tables are of the same scene.
            unsafe { batch.launch(device, inputs.addresses(), SharedTables { words, rest_positions, scales, boxes }) }?;
        }
        // `batch` may have covered all tiles.
        if self.full_step_tiles == 0 {
            return Ok(());
        }
        // SAFETY: this function has the same safety conditions.
        unsafe { self.launch_variant(device, inputs, &self.function, self.config) }
    }

    /// Starts the kernel of a partial step, which computes the tiles of the tile list. The length of the list is in the
    /// header. In this variant, a block has one warp, and four warps share a tile.
    ///
    /// # Safety
    /// As [`Self::launch`]; in addition, the kernel `apply` has written the tile list of this step when the kernel
    /// runs.
    ///
    /// # Errors
    /// `Fault` when the scene's steps are always full, or when the device fails.
    pub unsafe fn launch_tile_list(&self, device: &Device, inputs: &StepInputs) -> Result<()> {
        let grid_dim = ((4 * self.tile_count).min(MAX_LIST_BLOCKS), 1, 1);
        let config = LaunchConfig { grid_dim, block_dim: (WARP_THREADS, 1, 1), shared_mem_bytes: 0 };
        let missing_function =
            || Error::Fault { stage: "deform", reason: "expected a scene with partial steps".into() };
        let function = self.tile_list_function.as_ref().ok_or_else(missing_function)?;
        // SAFETY: this function has the same safety conditions.
        unsafe { self.launch_variant(device, inputs, function, config) }
    }

    /// Starts `function`, a variant of the kernel.
    ///
    /// # Safety
    /// As [`Self::launch`], or as [`Self::launch_tile_list`] if `function` is the variant of partial steps.
    unsafe fn launch_variant(
        &self,
        device: &Device,
        inputs: &StepInputs,
        function: &CudaFunction,
        config: LaunchConfig,
    ) -> Result<()> {
        let values = inputs.addresses();
        let args = DeformArgs {
            header: values.header,
            tiles: self.tiles.address(),
            mixed_quads: self.mixed_quads.address(),
            words: self.words.address(),
            rest_positions: self.rest_positions.address(),
            // The tables begin with the first quad that has normals: 48 bytes of normals and 64 bytes of tangents per
            // quad. No tile with corners refers to an earlier quad.
            rest_normals: self.rest_normals.address().wrapping_sub(48 * self.first_direction_quad),
            rest_tangents: self.rest_tangents.address().wrapping_sub(64 * self.first_direction_quad),
            corner_offsets: self.corner_offsets.address(),
            scales: self.scales.address(),
            mixed_quad_scales: self.mixed_quad_scales.address(),
            transforms: values.transforms,
            transform_links: values.transform_links,
            follower_frames: values.follower_frames,
            q: values.q,
            tile_list: self.tile_list.address(),
            boxes: self.boxes.address(),
            tile_count: self.full_step_tiles,
            reserved: 0,
        };
        // SAFETY: the kernel's only argument is a `DeformArgs`. The tables come from `WorkList`, whose tiles lie inside
        // the words, x0, normals, transforms and q of the same scene, and the list contains only such tiles. There are
        // four boxes per tile, at least one for each warp. Tangents and corner offsets are read only by a kernel that
        // was compiled for a scene that has them. The caller guarantees the outputs.
        unsafe { launch_kernel(device, function, config, LaunchOrder::Serial, &args) }
    }
}

/// Compiles a variant with these macros, tuned for the device.
fn compile(device: &Device, kernel: &KernelDescriptor, defines: &[&str]) -> Result<CudaFunction> {
    let tuning = deform_tuning(defines, device.capability());
    let defines: Vec<&str> = defines.iter().copied().chain([tuning.as_str()]).collect();
    device.function(kernel.name, kernel.source.0, &defines)
}

/// Compiles the function of full steps.
///
/// # Errors
/// `Fault` when the function is compiled for another block size than planned.
fn compile_function(device: &Device, kernel: &KernelDescriptor) -> Result<CudaFunction> {
    let function = compile(device, kernel, &kernel.defines)?;
    let max_threads = function.max_threads_per_block().map_err(cuda_error("deform"))?;
    if max_threads == kernel.threads as i32 {
        return Ok(function);
    }
    let reason = format!("expected a kernel for blocks of {} threads, got {max_threads}", kernel.threads);
    Err(Error::Fault { stage: "deform", reason })
}

/// Compiles the function of partial steps.
fn compile_tile_list_function(device: &Device, kernel: &KernelDescriptor) -> Result<CudaFunction> {
    // Tile lists are short: with more than one item (vertex or corner) per lane, most of the device would be idle.
    // The list has tiles of any number, so the warps of a tile are not split further.
    let defines =
        kernel.defines.iter().copied().filter(|define| !["ONE_ITEM_PER_LANE", AXIS_PER_WARP].contains(define));
    let tile_list_defines: Vec<&str> = defines.chain(["ONE_ITEM_PER_LANE", "TILE_LIST"]).collect();
    compile(device, kernel, &tile_list_defines)
}

/// Maximum number of blocks that loop over a tile list: 12 resident blocks on each of 132 multiprocessors, as many as
/// an H200 has.
const MAX_LIST_BLOCKS: u32 = 132 * 12;

/// Uploads U source by source, and collects the scales (see [`DeformKernel`]) and the factors of all shapes. A factor
/// is a power of two per mode, by which the host multiplies q because U is stored divided by it.
struct ModeUploader<'a> {
    device: &'a Device,
    scene: &'a Scene,
    work: &'a WorkList,
    words: DeviceBuffer,
    uploaded_bytes: u64,
    /// Words that are not yet uploaded.
    pending_words: Vec<PackedWord>,
    scales: Vec<f32>,
    factors: Vec<Vec<f32>>,
}

impl<'a> ModeUploader<'a> {
    fn new(device: &'a Device, scene: &'a Scene, work: &'a WorkList) -> Result<Self> {
        Ok(Self {
            device,
            scene,
            work,
            words: DeviceBuffer::zeroed(device, 16 * work.word_count)?,
            uploaded_bytes: 0,
            pending_words: Vec::new(),
            scales: vec![0.0; work.scale_count as usize],
            factors: vec![Vec::new(); scene.shapes.len()],
        })
    }

    /// Encodes the words of a source, and uploads the pending words if there are at least [`UPLOAD_WORDS`].
    fn add(&mut self, source: &WordSource) -> Result<()> {
        match source {
            WordSource::Shape(shape) => {
                let tiles = self.tiles_of(*shape);
                self.pending_words.extend_from_slice(tiles.packed_words());
            }
            WordSource::Mixed(shapes) => {
                let shape_tiles: Vec<TiledModes> = shapes.iter().map(|shape| self.tiles_of(*shape)).collect();
                self.pending_words.extend(mix_tiles(&shape_tiles));
            }
        }
        if self.pending_words.len() >= UPLOAD_WORDS { self.flush() } else { Ok(()) }
    }

    /// Returns the tiles of a shape, and collects their scales and factors.
    fn tiles_of(&mut self, shape: usize) -> TiledModes {
        let tiles = TiledModes::new(&self.scene.shapes[shape], self.scene.deformation.storage);
        let first_scale = self.work.first_scales[shape] as usize;
        self.scales[first_scale..][..tiles.scales().len()].copy_from_slice(tiles.scales());
        self.factors[shape] = tiles.factors().to_vec();
        tiles
    }

    /// Uploads the pending words.
    fn flush(&mut self) -> Result<()> {
        self.words.write(self.device, self.uploaded_bytes, &self.pending_words)?;
        self.uploaded_bytes += size_of_val(self.pending_words.as_slice()) as u64;
        self.pending_words.clear();
        Ok(())
    }

    /// Uploads the remaining words and the scales.
    fn finish(mut self) -> Result<UploadedModes> {
        self.flush()?;
        let scales = DeviceBuffer::upload(self.device, &self.scales)?;
        Ok(UploadedModes { words: self.words, scales, factors: self.factors })
    }
}

/// U on the device.
struct UploadedModes {
    words: DeviceBuffer,
    scales: DeviceBuffer,
    /// Per shape, the factors of its modes; empty unless U is stored in 16 bits.
    factors: Vec<Vec<f32>>,
}
