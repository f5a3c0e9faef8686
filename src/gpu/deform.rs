//! Launches `kernels/deform.cu`: x = T (x0 + U q) of all domains at once, their rigid normals and tangents, and a box of
//! each warp's vertices.

use std::sync::Arc;

use cudarc::driver::{CudaFunction, CudaSlice, CudaStream, LaunchConfig, PushKernelArg as _};

use super::device::Device;
use super::inputs::{Packing, Values};
use super::layout::DeformArgs;
use super::memory::{address, room, upload};
use super::plan::{Kernel, Launch, warps};
use super::trial::KernelFacts;
use super::work::{Coordinates, Source, Work, corner_shifts, orients, side_by_side};
use crate::error::{Error, Result, during};
use crate::scene::Scene;
use crate::storage::{Plane, TILE_QUADS, Tiles};

/// Words of U that go to the device in one piece while packing, so that packing needs little memory of its own.
const PIECE: usize = 1 << 22;

/// The tiles that one launch computes.
#[derive(Debug)]
struct Class {
    function: CudaFunction,
    config: LaunchConfig,
    first: u32,
    count: u32,
}

/// The kernel and what it reads of a scene.
#[derive(Debug)]
pub(super) struct Deform {
    /// Of tiles with modes, and of those without.
    classes: Vec<Class>,
    /// For a list of tiles of either kind.
    listed: CudaFunction,
    /// A second stream, so that both classes run beside each other.
    beside: Arc<CudaStream>,
    tiles: CudaSlice<u8>,
    lanes: CudaSlice<u8>,
    lane_scales: CudaSlice<u8>,
    words: CudaSlice<u8>,
    rest: CudaSlice<u8>,
    normals: CudaSlice<u8>,
    tangents: CudaSlice<u8>,
    corner_shifts: CudaSlice<u8>,
    scales: CudaSlice<u8>,
    list: CudaSlice<u8>,
    /// Six keys per warp.
    boxes: CudaSlice<u8>,
    warps: u32,
    /// Quads before the first that has normals.
    directed: u64,
    packing: Arc<Packing>,
}

impl Deform {
    /// `kernels` are those of [`Launch::Modes`] and [`Launch::Rigid`] that the scene has.
    pub(super) fn new(device: &Device, scene: &Arc<Scene>, kernels: &[Kernel]) -> Result<Self> {
        let coordinates = Coordinates::new(scene);
        let work = Work::new(scene, &coordinates);
        let mut load = Load::new(device, scene, &work)?;
        work.sources.iter().try_for_each(|source| load.add(source))?;
        let (words, load) = load.finish()?;
        let (rest, scales, factors) = (upload(device, &load.rest)?, upload(device, &load.scales)?, load.factors);
        let (normals, tangents) = directions(scene, &work);
        let classes = kernels.iter().map(|kernel| Class::new(device, kernel, &work)).collect::<Result<Vec<_>>>()?;
        // With modes where any tile has them: tiles without do nothing there.
        let [kernel, ..] = kernels else { return Err(during("deform")("a scene without tiles")) };
        let listed: Vec<&str> = kernel.defines.iter().copied().chain(["LISTED"]).collect();
        Ok(Self {
            classes,
            listed: device.function(kernel.name, kernel.source, &listed)?,
            beside: device.context().new_stream().map_err(during("deform"))?,
            tiles: upload(device, &work.tiles)?,
            lanes: upload(device, &work.lanes)?,
            lane_scales: upload(device, &work.lane_scales)?,
            words,
            rest,
            normals: upload(device, &normals)?,
            tangents: upload(device, &tangents)?,
            corner_shifts: upload(device, &corner_shifts(scene))?,
            scales,
            list: room(device, 4 * work.tiles.len() as u64)?,
            boxes: room(device, 24 * warps(&work))?,
            warps: warps(&work) as u32,
            directed: work.quads.directed,
            packing: Arc::new(Packing {
                scene: Arc::clone(scene),
                coordinates,
                factors,
                spans: work.spans,
                tiles: work.tiles.len(),
            }),
        })
    }

    /// How coordinates are to be laid out for it.
    pub(super) const fn packing(&self) -> &Arc<Packing> {
        &self.packing
    }

    /// The address of its boxes, and how many there are.
    pub(super) fn boxes(&self, device: &Device) -> (u64, u32) {
        (address(device, &self.boxes), self.warps)
    }

    /// Where `apply` puts the list of tiles.
    pub(super) fn list(&self, device: &Device) -> u64 {
        address(device, &self.list)
    }

    /// Starts the kernel on all tiles; the header among the values says where everything goes.
    pub(super) fn launch(&self, device: &Device, values: Values) -> Result<()> {
        let fail = during("deform");
        let [first, others @ ..] = self.classes.as_slice() else { return Ok(()) };
        if !others.is_empty() {
            self.beside.join(device.stream()).map_err(&fail)?;
        }
        self.launch_as(device, values, (device.stream(), first))?;
        for class in others {
            self.launch_as(device, values, (&self.beside, class))?;
            device.stream().join(&self.beside).map_err(&fail)?;
        }
        Ok(())
    }

    /// Starts it on the tiles of the list, as many as the header says.
    pub(super) fn launch_listed(&self, device: &Device, values: Values) -> Result<()> {
        let grid_dim = (self.warps.min(LISTED_BLOCKS), 1, 1);
        let config = LaunchConfig { grid_dim, block_dim: (TILE_QUADS as u32, 1, 1), shared_mem_bytes: 0 };
        let class = Class { function: self.listed.clone(), config, first: 0, count: 0 };
        self.launch_as(device, values, (device.stream(), &class))
    }

    /// Launches of a whole step.
    pub(super) fn launches(&self) -> usize {
        self.classes.len()
    }

    /// What the driver says of the kernels.
    pub(super) fn facts(&self) -> Vec<KernelFacts> {
        self.classes.iter().filter_map(|class| KernelFacts::of("deform", &class.function).ok()).collect()
    }

    fn launch_as(&self, device: &Device, values: Values, (stream, class): (&Arc<CudaStream>, &Class)) -> Result<()> {
        let at = |buffer: &CudaSlice<u8>| address(device, buffer);
        let args = DeformArgs {
            header: values.header,
            tiles: at(&self.tiles),
            lanes: at(&self.lanes),
            words: at(&self.words),
            rest: at(&self.rest),
            // Quads without normals come first and have no room; nobody reads them.
            rest_normals: at(&self.normals).wrapping_sub(48 * self.directed),
            rest_tangents: at(&self.tangents).wrapping_sub(64 * self.directed),
            corner_shifts: at(&self.corner_shifts),
            scales: at(&self.scales),
            lane_scales: at(&self.lane_scales),
            transforms: values.transforms,
            q: values.q,
            list: at(&self.list),
            kept_counts: values.kept_counts,
            kept: values.kept,
            boxes: at(&self.boxes),
            first: class.first,
            count: class.count,
        };
        let mut launch = stream.launch_builder(&class.function);
        // SAFETY: `DeformArgs` is the kernel's only argument. The tables come from `Work`, whose tiles lie inside the
        // words, x0, normals, transforms and q of the same scene, and the list names such tiles; there are as many boxes
        // as warps; and the header's outputs have the sizes that `Output` checked. Tangents and shifts are read only by
        // a kernel that was compiled for a scene that has them.
        unsafe { launch.arg(&args).launch(class.config) }.map_err(during("deform"))?;
        Ok(())
    }
}

impl Class {
    fn new(device: &Device, kernel: &Kernel, work: &Work) -> Result<Self> {
        let function = device.function(kernel.name, kernel.source, &kernel.defines)?;
        let most = function.max_threads_per_block().map_err(during("deform"))?;
        if most != kernel.threads as i32 {
            let reason = format!("the kernel is made for {most} threads a block, {} were planned", kernel.threads);
            return Err(Error::Fault { stage: "deform", reason });
        }
        let with_modes = work.tiles.iter().filter(|tile| tile.chunks > 0).count() as u32;
        let (first, count) = match kernel.launch {
            Launch::Modes => (0, with_modes),
            _ => (with_modes, work.tiles.len() as u32 - with_modes),
        };
        Ok(Self { function, config: config(kernel), first, count })
    }
}

/// Blocks that walk over a list of tiles: as many as a large device holds at once.
const LISTED_BLOCKS: u32 = 132 * 16;

/// Normals and tangents at rest as quads, [4 x][4 y][4 z] and [4 x][4 y][4 z][4 signs]; none where a scene needs none.
fn directions(scene: &Scene, work: &Work) -> (Vec<[f32; 12]>, Vec<[f32; 16]>) {
    if !orients(scene) {
        return (Vec::new(), Vec::new());
    }
    let count = (work.quads.end - work.quads.directed) as usize;
    let mut normals = vec![[0.0; 12]; count];
    let mut tangents = vec![[0.0; 16]; if scene.needs.normal_maps { count } else { 0 }];
    for (shape, first) in scene.shapes.iter().zip(&work.quads.corners) {
        let first = *first as usize - work.quads.directed as usize;
        for (at, normal) in shape.mesh.corners().normals.iter().enumerate() {
            (0..3).for_each(|axis| normals[first + at / 4][4 * axis + at % 4] = normal[axis]);
        }
        for (at, tangent) in shape.tangents().iter().enumerate() {
            (0..4).for_each(|axis| tangents[first + at / 4][4 * axis + at % 4] = tangent[axis]);
        }
    }
    (normals, tangents)
}

pub(super) fn config(kernel: &Kernel) -> LaunchConfig {
    LaunchConfig { grid_dim: (kernel.blocks, 1, 1), block_dim: (kernel.threads, 1, 1), shared_mem_bytes: 0 }
}

/// U on its way to the device, source by source, and what is small of all shapes, kept until the end.
struct Load<'a> {
    device: &'a Device,
    scene: &'a Scene,
    work: &'a Work,
    words: CudaSlice<u8>,
    sent: usize,
    piece: Vec<Plane>,
    rest: Vec<[f32; 12]>,
    scales: Vec<f32>,
    factors: Vec<Vec<f32>>,
    seen: Vec<bool>,
}

impl<'a> Load<'a> {
    fn new(device: &'a Device, scene: &'a Scene, work: &'a Work) -> Result<Self> {
        let shapes = scene.shapes.len();
        Ok(Self {
            device,
            scene,
            work,
            words: room(device, 16 * work.words)?,
            sent: 0,
            piece: Vec::new(),
            rest: vec![[0.0; 12]; work.quads.rest as usize],
            scales: vec![0.0; work.scales as usize],
            factors: vec![Vec::new(); shapes],
            seen: vec![false; shapes],
        })
    }

    fn add(&mut self, source: &Source) -> Result<()> {
        match source {
            Source::Shape(shape) => {
                let tiles = self.tiles_of(*shape);
                self.piece.extend_from_slice(tiles.planes());
            }
            Source::Mixed(shapes) => {
                let all: Vec<Tiles> = shapes.iter().map(|shape| self.tiles_of(*shape)).collect();
                self.piece.extend(side_by_side(&all));
            }
        }
        if self.piece.len() >= PIECE { self.send() } else { Ok(()) }
    }

    /// The tiles of a shape; what is small of them is kept.
    fn tiles_of(&mut self, shape: usize) -> Tiles {
        let tiles = Tiles::new(&self.scene.shapes[shape], self.scene.deformation.storage);
        let (rest, scale) = (self.work.quads.vertices[shape] as usize, self.work.first_scale[shape] as usize);
        self.rest[rest..][..tiles.rest().len()].copy_from_slice(tiles.rest());
        self.scales[scale..][..tiles.scales().len()].copy_from_slice(tiles.scales());
        self.factors[shape] = tiles.factors().to_vec();
        self.seen[shape] = true;
        tiles
    }

    fn send(&mut self) -> Result<()> {
        let bytes: &[u8] = bytemuck::cast_slice(&self.piece);
        let mut part = self.words.slice_mut(self.sent..self.sent + bytes.len());
        self.device.stream().memcpy_htod(bytes, &mut part).map_err(during("upload"))?;
        self.sent += bytes.len();
        self.piece.clear();
        Ok(())
    }

    /// The words, all there, and the rest with the shapes that have no modes.
    fn finish(mut self) -> Result<(CudaSlice<u8>, Self)> {
        if !self.piece.is_empty() {
            self.send()?;
        }
        for shape in 0..self.seen.len() {
            if !self.seen[shape] && self.scene.shapes[shape].modes.rank() == 0 {
                self.tiles_of(shape);
            }
        }
        let words = std::mem::replace(&mut self.words, room(self.device, 0)?);
        Ok((words, self))
    }
}
