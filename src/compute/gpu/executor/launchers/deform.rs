//! Launches `kernels/deform.cu`: x = T (x0 + U q) of all domains at once, their rigid normals and tangents, and a box
//! of each warp's vertices.

use std::sync::Arc;

use cudarc::driver::{CudaFunction, LaunchConfig};

use super::batch::{BatchKernel, SharedTables};
use crate::gpu::executor::inputs::StepInputs;
use crate::gpu::launch::error::cuda_error;
use crate::gpu::launch::{Device, DeviceBuffer, KernelDescriptor, LaunchOrder, launch_kernel};
use crate::gpu::tables::device_tables::DeviceTables;
use crate::gpu::tables::input_packing::{DirtyTileLayout, InputPacker};
use crate::gpu::tables::kernels::deform_blocks;
use crate::gpu::tables::layout::{BoxSegment, DeformArgs};
use crate::gpu::tables::occupancy::deform_tuning;
use crate::gpu::tables::work::{WordSource, WorkList, side_by_side};
use crate::storage::{PackedWord, TILE_QUADS, TiledModes};
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::Scene;

/// Approximate cost of one batched tile of a group in tiles of `deform`.
const DEFORM_TILES_PER_BATCH_TILE: usize = 2;

/// Words of U per upload, which limits the staging memory while U is packed.
const UPLOAD_WORDS: usize = 1 << 22;

/// The descriptors of the kernels that write positions.
#[derive(Debug, Clone, Copy)]
pub struct PositionKernels<'a> {
    pub deform: &'a KernelDescriptor,
    /// Only in scenes with batches.
    pub batch: Option<&'a KernelDescriptor>,
}

/// The bounding boxes of warps on the device.
#[derive(Debug, Clone, Copy)]
pub(super) struct WarpBoxes {
    pub address: u64,
    /// Number of boxes.
    pub count: u32,
}

/// The kernel and the constant tables of a scene.
#[derive(Debug)]
pub struct DeformKernel {
    function: CudaFunction,
    config: LaunchConfig,
    /// Only in a scene with batches: domains whose U is read once per group.
    batch: Option<BatchKernel>,
    /// The kernel for a tile list; only in a scene that can have partial steps.
    list_function: Option<CudaFunction>,
    tiles: DeviceBuffer,
    mixed_quads: DeviceBuffer,
    mixed_quad_scales: DeviceBuffer,
    words: DeviceBuffer,
    rest: DeviceBuffer,
    normals: DeviceBuffer,
    tangents: DeviceBuffer,
    corner_offsets: DeviceBuffer,
    scales: DeviceBuffer,
    list: DeviceBuffer,
    /// Four boxes of six keys per tile.
    boxes: DeviceBuffer,
    /// Number of tiles, and number of those that a full step launches.
    count: u32,
    full_step_tiles: u32,
    /// Quads before the first that has normals.
    first_with_normals: u64,
    packing: Arc<InputPacker>,
    /// Pieces that `bounds` reduces to boxes; only if the scene keeps boxes.
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
        let DeviceTables { coordinates, work, segments, rest, rest_normals, rest_tangents, listed_tiles, .. } = tables;
        let kernel = kernels.deform;
        let mut load = ModeUploader::new(device, scene, &work)?;
        work.sources.iter().try_for_each(|source| load.add(source))?;
        let UploadedModes { words, scales, factors } = load.finish()?;
        let has_lists = listed_tiles > 0;
        // Without rigid normals there is nothing to compute in tiles of corners alone.
        let full_step_tiles =
            if kernel.defines.contains(&"RIGID_NORMALS") { work.full_step_tiles } else { work.vertex_tiles };
        let config = LaunchConfig { grid_dim: (deform_blocks(kernel, full_step_tiles), 1, 1), ..kernel.config() };
        Ok(Self {
            function: function(device, kernel)?,
            config,
            batch: kernels.batch.map(|kernel| BatchKernel::new(device, kernel, &work.batched)).transpose()?,
            list_function: has_lists.then(|| list_function(device, kernel)).transpose()?,
            tiles: DeviceBuffer::upload(device, &work.tiles)?,
            mixed_quads: DeviceBuffer::upload(device, &work.mixed_quads)?,
            mixed_quad_scales: DeviceBuffer::upload(device, &work.mixed_quad_scales)?,
            words,
            rest: DeviceBuffer::upload(device, &rest)?,
            normals: DeviceBuffer::upload(device, &rest_normals)?,
            tangents: DeviceBuffer::upload(device, &rest_tangents)?,
            corner_offsets: DeviceBuffer::upload(device, &work.corner_offsets)?,
            scales,
            list: DeviceBuffer::zeroed(device, 4 * listed_tiles as u64)?,
            boxes: DeviceBuffer::zeroed(device, work.box_bytes())?,
            count: work.tiles.len() as u32,
            full_step_tiles: full_step_tiles as u32,
            first_with_normals: work.quads.first_with_normals,
            segments: scene.features.boxes.then_some(segments),
            packing: Arc::new(InputPacker {
                scene: Arc::clone(scene),
                coordinates,
                factors,
                dirty_tile_layout: DirtyTileLayout {
                    spans: work.spans,
                    tiles: work.tiles.len(),
                    whole: work.full_step_tiles + DEFORM_TILES_PER_BATCH_TILE * work.batched.tiles(),
                },
            }),
        })
    }

    /// The layout of coordinates that the kernel expects.
    pub const fn packing(&self) -> &Arc<InputPacker> {
        &self.packing
    }

    /// The pieces that boxes of domains are made of, if the scene keeps boxes.
    pub(super) fn segments(&self) -> Option<&[BoxSegment]> {
        self.segments.as_deref()
    }

    /// The boxes of all warps.
    pub(super) fn boxes(&self) -> WarpBoxes {
        WarpBoxes { address: self.boxes.address(), count: 4 * self.count }
    }

    /// Address of the tile list that `apply` writes.
    pub(super) fn tile_list(&self) -> u64 {
        self.list.address()
    }

    /// Names and functions of the kernels that a full step launches.
    pub fn kernels(&self) -> Vec<(&'static str, &CudaFunction)> {
        let batch = self.batch.as_ref().map(|batch| ("batch", &batch.function));
        batch.into_iter().chain((self.full_step_tiles > 0).then_some(("deform", &self.function))).collect()
    }

    /// Starts the kernels of a full step.
    ///
    /// # Safety
    /// `inputs` has the layout of [`Self::packing`] and contains a whole step when the kernels run. Its header has the
    /// addresses of the outputs that the kernels write, with the sizes of the scene: positions; normals and tangents if
    /// they are rigid; displacements if the scene keeps them. All of them exist until the kernels have ended.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    pub unsafe fn launch(&self, device: &Device, inputs: &StepInputs) -> Result<()> {
        if let Some(batch) = &self.batch {
            let Self { words, rest, scales, boxes, .. } = self;
            // SAFETY: the caller guarantees the inputs; the tables are of the same scene.
            unsafe { batch.launch(device, inputs.addresses(), SharedTables { words, rest, scales, boxes }) }?;
        }
        // `batch` may have covered all tiles.
        if self.full_step_tiles == 0 {
            return Ok(());
        }
        // SAFETY: the caller guarantees it.
        unsafe { self.launch_variant(device, inputs, &self.function, self.config) }
    }

    /// Starts the kernel on the tiles of the list, whose length is in the header.
    ///
    /// # Safety
    /// As [`Self::launch`]; in addition, `apply` has written the list of that step.
    ///
    /// # Errors
    /// `Fault` when the scene's steps are always full, or when the device fails.
    pub unsafe fn launch_tile_list(&self, device: &Device, inputs: &StepInputs) -> Result<()> {
        let grid_dim = ((4 * self.count).min(MAX_LIST_BLOCKS), 1, 1);
        let config = LaunchConfig { grid_dim, block_dim: (TILE_QUADS as u32, 1, 1), shared_mem_bytes: 0 };
        let missing = || Error::Fault { stage: "deform", reason: "the scene has no lists".into() };
        let function = self.list_function.as_ref().ok_or_else(missing)?;
        // SAFETY: the caller guarantees it.
        unsafe { self.launch_variant(device, inputs, function, config) }
    }

    /// # Safety
    /// As [`Self::launch`], or as [`Self::launch_tile_list`] for the function for lists.
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
            rest: self.rest.address(),
            // Quads without normals come first and have no storage. No tile with corners refers to them.
            rest_normals: self.normals.address().wrapping_sub(48 * self.first_with_normals),
            rest_tangents: self.tangents.address().wrapping_sub(64 * self.first_with_normals),
            corner_offsets: self.corner_offsets.address(),
            scales: self.scales.address(),
            mixed_quad_scales: self.mixed_quad_scales.address(),
            transforms: values.transforms,
            transform_links: values.transform_links,
            frames: values.frames,
            q: values.q,
            tile_list: self.list.address(),
            retained_counts: values.retained_counts,
            retained: values.retained,
            boxes: self.boxes.address(),
            count: self.full_step_tiles,
            reserved: 0,
        };
        // SAFETY: the kernel's only argument is a `DeformArgs`. The tables come from `WorkList`, whose tiles lie inside the
        // words, x0, normals, transforms and q of the same scene, and the list contains only such tiles. There are four
        // boxes per tile, at least one for each warp. Tangents and corner offsets are read only by a kernel that was
        // compiled for a scene that has them. The caller guarantees the outputs.
        unsafe { launch_kernel(device, function, config, LaunchOrder::Serial, &args) }
    }
}

/// Compiles a variant with the tuning for the device.
fn compile(device: &Device, kernel: &KernelDescriptor, defines: &[&str]) -> Result<CudaFunction> {
    let tuning = deform_tuning(defines, device.capability());
    let defines: Vec<&str> = defines.iter().copied().chain([tuning.as_str()]).collect();
    device.function(kernel.name, kernel.source.0, &defines)
}

/// The function of a kernel.
///
/// # Errors
/// `Fault` when it is compiled for another block size than planned.
fn function(device: &Device, kernel: &KernelDescriptor) -> Result<CudaFunction> {
    let function = compile(device, kernel, &kernel.defines)?;
    let most = function.max_threads_per_block().map_err(cuda_error("deform"))?;
    if most == kernel.threads as i32 {
        return Ok(function);
    }
    let reason = format!("the kernel is made for {most} threads a block, {} were planned", kernel.threads);
    Err(Error::Fault { stage: "deform", reason })
}

/// The function of the kernel that computes the tiles of a list.
fn list_function(device: &Device, kernel: &KernelDescriptor) -> Result<CudaFunction> {
    // One lane per item: lists are short, and would otherwise leave most of the device idle.
    let defines = kernel.defines.iter().copied().filter(|define| *define != "ONE_ITEM_PER_LANE");
    let list_function: Vec<&str> = defines.chain(["ONE_ITEM_PER_LANE", "TILE_LIST"]).collect();
    compile(device, kernel, &list_function)
}

/// Blocks that loop over a tile list: as many as are resident on a large device.
const MAX_LIST_BLOCKS: u32 = 132 * 12;

/// Upload of U, source by source. Collects the small tables of all shapes until the end.
struct ModeUploader<'a> {
    device: &'a Device,
    scene: &'a Scene,
    work: &'a WorkList,
    words: DeviceBuffer,
    sent: u64,
    piece: Vec<PackedWord>,
    scales: Vec<f32>,
    factors: Vec<Vec<f32>>,
}

impl<'a> ModeUploader<'a> {
    fn new(device: &'a Device, scene: &'a Scene, work: &'a WorkList) -> Result<Self> {
        Ok(Self {
            device,
            scene,
            work,
            words: DeviceBuffer::zeroed(device, 16 * work.words)?,
            sent: 0,
            piece: Vec::new(),
            scales: vec![0.0; work.scales as usize],
            factors: vec![Vec::new(); scene.shapes.len()],
        })
    }

    fn add(&mut self, source: &WordSource) -> Result<()> {
        match source {
            WordSource::Shape(shape) => {
                let tiles = self.tiles_of(*shape);
                self.piece.extend_from_slice(tiles.packed_words());
            }
            WordSource::Mixed(shapes) => {
                let all: Vec<TiledModes> = shapes.iter().map(|shape| self.tiles_of(*shape)).collect();
                self.piece.extend(side_by_side(&all));
            }
        }
        if self.piece.len() >= UPLOAD_WORDS { self.send() } else { Ok(()) }
    }

    /// The tiles of a shape; collects their scales and factors.
    fn tiles_of(&mut self, shape: usize) -> TiledModes {
        let tiles = TiledModes::new(&self.scene.shapes[shape], self.scene.deformation.storage);
        let scale = self.work.first_scale[shape] as usize;
        self.scales[scale..][..tiles.scales().len()].copy_from_slice(tiles.scales());
        self.factors[shape] = tiles.factors().to_vec();
        tiles
    }

    fn send(&mut self) -> Result<()> {
        self.words.write(self.device, self.sent, &self.piece)?;
        self.sent += size_of_val(self.piece.as_slice()) as u64;
        self.piece.clear();
        Ok(())
    }

    /// Uploads the remaining words and the small tables.
    fn finish(mut self) -> Result<UploadedModes> {
        self.send()?;
        let scales = DeviceBuffer::upload(self.device, &self.scales)?;
        Ok(UploadedModes { words: self.words, scales, factors: self.factors })
    }
}

/// U on the device.
struct UploadedModes {
    words: DeviceBuffer,
    scales: DeviceBuffer,
    /// Per shape, the factors of its modes; empty unless the storage has factors.
    factors: Vec<Vec<f32>>,
}
