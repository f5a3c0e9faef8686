//! Launches `kernels/deform.cu`: x = T (x0 + U q) of all domains at once, and a box of each warp's vertices.

use std::sync::Arc;

use cudarc::driver::{CudaFunction, CudaSlice, LaunchConfig, PushKernelArg as _};

use super::device::Device;
use super::inputs::{Packing, Values};
use super::layout::DeformArgs;
use super::memory::{address, room, upload};
use super::plan::Kernel;
use super::work::{Coordinates, Source, Work, side_by_side};
use crate::error::{Result, during};
use crate::scene::Scene;
use crate::storage::{Plane, Tiles};

/// Words of U that go to the device in one piece while packing, so that packing needs little memory of its own.
const PIECE: usize = 1 << 22;

/// The kernel and what it reads of a scene.
#[derive(Debug)]
pub(super) struct Deform {
    pub(super) function: CudaFunction,
    config: LaunchConfig,
    tiles: CudaSlice<u8>,
    lanes: CudaSlice<u8>,
    lane_scales: CudaSlice<u8>,
    words: CudaSlice<u8>,
    rest: CudaSlice<u8>,
    scales: CudaSlice<u8>,
    /// Six keys per block.
    boxes: CudaSlice<u8>,
    tiles_count: u32,
    packing: Arc<Packing>,
}

impl Deform {
    pub(super) fn new(device: &Device, scene: &Arc<Scene>, kernel: &Kernel) -> Result<Self> {
        let coordinates = Coordinates::new(scene);
        let work = Work::new(scene, &coordinates);
        let mut load = Load::new(device, scene, &work)?;
        work.sources.iter().try_for_each(|source| load.add(source))?;
        let (words, load) = load.finish()?;
        let Load { rest, scales, factors, .. } = load;
        Ok(Self {
            function: device.function(kernel.name, kernel.source, &kernel.defines)?,
            config: config(kernel),
            tiles: upload(device, &work.tiles)?,
            lanes: upload(device, &work.lanes)?,
            lane_scales: upload(device, &work.lane_scales)?,
            words,
            rest: upload(device, &rest)?,
            scales: upload(device, &scales)?,
            boxes: room(device, 24 * u64::from(kernel.blocks))?,
            tiles_count: work.tiles.len() as u32,
            packing: Arc::new(Packing { scene: Arc::clone(scene), coordinates, factors }),
        })
    }

    /// How coordinates are to be laid out for it.
    pub(super) const fn packing(&self) -> &Arc<Packing> {
        &self.packing
    }

    /// The address of its boxes, and how many there are.
    pub(super) fn boxes(&self, device: &Device) -> (u64, u32) {
        (address(device, &self.boxes), self.config.grid_dim.0)
    }

    /// Starts the kernel; the header among the values says where positions go.
    pub(super) fn launch(&self, device: &Device, values: Values) -> Result<()> {
        let at = |buffer: &CudaSlice<u8>| address(device, buffer);
        let args = DeformArgs {
            header: values.header,
            tiles: at(&self.tiles),
            lanes: at(&self.lanes),
            words: at(&self.words),
            rest: at(&self.rest),
            scales: at(&self.scales),
            lane_scales: at(&self.lane_scales),
            transforms: values.transforms,
            q: values.q,
            stamps: values.stamps,
            kept_counts: values.kept_counts,
            kept: values.kept,
            boxes: at(&self.boxes),
            tiles_count: self.tiles_count,
            reserved: 0,
        };
        let mut launch = device.stream().launch_builder(&self.function);
        // SAFETY: `DeformArgs` is the kernel's only argument. The tables come from `Work`, whose tiles lie inside the
        // words, x0, transforms and q of the same scene; there are as many boxes as blocks; and the header's positions
        // have three floats per vertex, as `Output` checks.
        unsafe { launch.arg(&args).launch(self.config) }.map_err(during("deform"))?;
        Ok(())
    }
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
            rest: vec![[0.0; 12]; work.rest as usize],
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
        let (rest, scale) = (self.work.first_rest[shape] as usize, self.work.first_scale[shape] as usize);
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
