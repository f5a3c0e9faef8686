//! Launches `kernels/deform.cu`: x = T (x0 + U q) of all domains at once, their rigid normals and tangents, and a box
//! of each warp's vertices.

use std::sync::Arc;

use cudarc::driver::{CudaFunction, CudaSlice, LaunchConfig, PushKernelArg as _};

use super::apply::max_changed_domains;
use super::batch::{BatchKernel, SharedTables};
use super::device::Device;
use super::inputs::{DirtyTileLayout, InputAddresses, InputPacker};
use super::layout::{BoxSegment, DeformArgs};
use super::memory::{address, alloc_zeroed, upload};
use super::plan::{DeviceTables, KernelDescriptor};
use super::work::{WordSource, WorkList, rest_directions, rest_positions, side_by_side};
use crate::storage::{PackedWord, TILE_QUADS, TiledModes};
use modalcast_model::error::{Error, Result, fault_in};
use modalcast_model::scene::Scene;

/// Approximate cost of one batched tile of a group in tiles of `deform`.
const DEFORM_TILES_PER_BATCH_TILE: usize = 2;

/// Words of U per upload, which limits the staging memory while U is packed.
const UPLOAD_WORDS: usize = 1 << 22;

/// The kernel and the constant tables of a scene.
#[derive(Debug)]
pub struct DeformKernel {
    function: CudaFunction,
    config: LaunchConfig,
    /// Only in a scene with batches: domains whose U is read once per group.
    batch: Option<BatchKernel>,
    /// The kernel for a tile list; only in a scene that can have partial steps.
    list_function: Option<CudaFunction>,
    tiles: CudaSlice<u8>,
    mixed_quads: CudaSlice<u8>,
    mixed_quad_scales: CudaSlice<u8>,
    words: CudaSlice<u8>,
    rest: CudaSlice<u8>,
    normals: CudaSlice<u8>,
    tangents: CudaSlice<u8>,
    corner_offsets: CudaSlice<u8>,
    scales: CudaSlice<u8>,
    list: CudaSlice<u8>,
    /// Four boxes of six keys per tile.
    boxes: CudaSlice<u8>,
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
    /// Uploads everything that the tables refer to. `batch` is the kernel of scenes with batches.
    pub fn new(
        device: &Device,
        scene: &Arc<Scene>,
        (kernel, batch): (&KernelDescriptor, Option<&KernelDescriptor>),
        tables: DeviceTables,
    ) -> Result<Self> {
        let DeviceTables { coordinates, work, segments } = tables;
        let mut load = ModeUploader::new(device, scene, &work)?;
        work.sources.iter().try_for_each(|source| load.add(source))?;
        let (words, load) = load.finish()?;
        let (scales, factors) = (upload(device, &load.scales)?, load.factors);
        let [normals, tangents] = rest_directions(scene, &work);
        let has_lists = max_changed_domains(scene) > 0;
        // Without ORIENT there is nothing to compute in tiles of corners alone.
        let full_step_tiles =
            if kernel.defines.contains(&"RIGID_NORMALS") { work.full_step_tiles } else { work.vertex_tiles };
        let config = LaunchConfig { grid_dim: (blocks(kernel, full_step_tiles), 1, 1), ..config(kernel) };
        Ok(Self {
            function: function(device, kernel)?,
            config,
            batch: batch.map(|kernel| BatchKernel::new(device, kernel, &work.batched)).transpose()?,
            list_function: has_lists.then(|| list_function(device, kernel)).transpose()?,
            tiles: upload(device, &work.tiles)?,
            mixed_quads: upload(device, &work.mixed_quads)?,
            mixed_quad_scales: upload(device, &work.mixed_quad_scales)?,
            words,
            rest: upload(device, &rest_positions(scene, &work))?,
            normals: upload(device, &normals)?,
            tangents: upload(device, &tangents)?,
            corner_offsets: upload(device, &work.corner_offsets)?,
            scales,
            list: alloc_zeroed(device, if has_lists { 4 * work.tiles.len() as u64 } else { 0 })?,
            boxes: alloc_zeroed(device, 96 * work.tiles.len() as u64)?,
            count: work.tiles.len() as u32,
            full_step_tiles: full_step_tiles as u32,
            first_with_normals: work.quads.first_with_normals,
            segments: scene.needs.boxes.then_some(segments),
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
    pub fn segments(&self) -> Option<&[BoxSegment]> {
        self.segments.as_deref()
    }

    /// The address of the boxes, and their number.
    pub fn boxes(&self, device: &Device) -> (u64, u32) {
        (address(device, &self.boxes), 4 * self.count)
    }

    /// Address of the tile list that `apply` writes.
    pub fn list(&self, device: &Device) -> u64 {
        address(device, &self.list)
    }

    /// The kernels that a full step launches.
    pub fn kernels(&self) -> Vec<(&'static str, &CudaFunction)> {
        let batch = self.batch.as_ref().map(|batch| ("batch", &batch.function));
        batch.into_iter().chain((self.full_step_tiles > 0).then_some(("deform", &self.function))).collect()
    }

    /// Starts the kernels of a full step; the header among `values` has the output addresses.
    pub fn launch(&self, device: &Device, values: InputAddresses) -> Result<()> {
        if let Some(batch) = &self.batch {
            let [words, rest, scales, boxes] =
                [&self.words, &self.rest, &self.scales, &self.boxes].map(|buffer| address(device, buffer));
            batch.launch(device, values, SharedTables { words, rest, scales, boxes })?;
        }
        // `batch` may have covered all tiles.
        if self.full_step_tiles == 0 {
            return Ok(());
        }
        self.launch_variant(device, values, (&self.function, self.config))
    }

    /// Starts the kernel on the tiles of the list, whose length is in the header.
    pub fn launch_tile_list(&self, device: &Device, values: InputAddresses) -> Result<()> {
        let grid_dim = ((4 * self.count).min(MAX_LIST_BLOCKS), 1, 1);
        let config = LaunchConfig { grid_dim, block_dim: (TILE_QUADS as u32, 1, 1), shared_mem_bytes: 0 };
        let missing = || Error::Fault { stage: "deform", reason: "the scene has no lists".into() };
        self.launch_variant(device, values, (self.list_function.as_ref().ok_or_else(missing)?, config))
    }

    fn launch_variant(
        &self,
        device: &Device,
        values: InputAddresses,
        (function, config): (&CudaFunction, LaunchConfig),
    ) -> Result<()> {
        let at = |buffer: &CudaSlice<u8>| address(device, buffer);
        let args = DeformArgs {
            header: values.header,
            tiles: at(&self.tiles),
            mixed_quads: at(&self.mixed_quads),
            words: at(&self.words),
            rest: at(&self.rest),
            // Quads without normals come first and have no storage. No tile with corners refers to them.
            rest_normals: at(&self.normals).wrapping_sub(48 * self.first_with_normals),
            rest_tangents: at(&self.tangents).wrapping_sub(64 * self.first_with_normals),
            corner_offsets: at(&self.corner_offsets),
            scales: at(&self.scales),
            mixed_quad_scales: at(&self.mixed_quad_scales),
            transforms: values.transforms,
            transform_links: values.transform_links,
            frames: values.frames,
            q: values.q,
            list: at(&self.list),
            retained_counts: values.retained_counts,
            retained: values.retained,
            boxes: at(&self.boxes),
            count: self.full_step_tiles,
            reserved: 0,
        };
        let mut launch = device.stream().launch_builder(function);
        // SAFETY: `DeformArgs` is the kernel's only argument. The tables come from `WorkList`, whose tiles lie inside the
        // words, x0, normals, transforms and q of the same scene, and the list contains only such tiles. There are four
        // boxes per tile, at least one for each warp. The header's outputs have the sizes that `OutputBuffers` checked or the
        // plan states. Tangents and shifts are read only by a kernel that was compiled for a scene that has them.
        unsafe { launch.arg(&args).launch(config) }.map_err(fault_in("deform"))?;
        Ok(())
    }
}

/// Number of blocks for so many tiles.
pub(super) fn blocks(kernel: &KernelDescriptor, tiles: usize) -> u32 {
    let warps = tiles * if kernel.defines.contains(&"ONE_ITEM_PER_LANE") { 4 } else { 1 };
    warps.div_ceil(kernel.threads as usize / TILE_QUADS) as u32
}

/// The function of a kernel.
///
/// # Errors
/// `Fault` when it is compiled for another block size than planned.
fn function(device: &Device, kernel: &KernelDescriptor) -> Result<CudaFunction> {
    let function = device.function(kernel.name, kernel.source.0, &kernel.defines)?;
    let most = function.max_threads_per_block().map_err(fault_in("deform"))?;
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
    device.function(kernel.name, kernel.source.0, &list_function)
}

/// Blocks that loop over a tile list: as many as are resident on a large device.
const MAX_LIST_BLOCKS: u32 = 132 * 12;

pub(super) fn config(kernel: &KernelDescriptor) -> LaunchConfig {
    LaunchConfig { grid_dim: (kernel.blocks, 1, 1), block_dim: (kernel.threads, 1, 1), shared_mem_bytes: 0 }
}

/// Upload of U, source by source. Collects the small tables of all shapes until the end.
struct ModeUploader<'a> {
    device: &'a Device,
    scene: &'a Scene,
    work: &'a WorkList,
    words: CudaSlice<u8>,
    sent: usize,
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
            words: alloc_zeroed(device, 16 * work.words)?,
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
        let bytes: &[u8] = bytemuck::cast_slice(&self.piece);
        let mut part = self.words.slice_mut(self.sent..self.sent + bytes.len());
        self.device.stream().memcpy_htod(bytes, &mut part).map_err(fault_in("upload"))?;
        self.sent += bytes.len();
        self.piece.clear();
        Ok(())
    }

    /// Uploads the remaining words. Returns the buffer, and the collected small tables.
    fn finish(mut self) -> Result<(CudaSlice<u8>, Self)> {
        if !self.piece.is_empty() {
            self.send()?;
        }
        let words = std::mem::replace(&mut self.words, alloc_zeroed(self.device, 0)?);
        Ok((words, self))
    }
}
