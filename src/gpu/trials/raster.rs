//! Launches `kernels/raster.cu`: which triangle each sample of a window sees and how deep, or depth alone, by atomic minima.
//!
//! A thread draws a triangle near few samples, a warp one of up to 64 x 64 pixels, and blocks draw larger and clipped ones
//! tile by tile. Queues between the kernels have room for every triangle, so that nothing overflows, and their lengths
//! stay on the device. Triangles of materials with alpha masks are drawn whole: nothing here knows of holes.

use bytemuck::{Pod, Zeroable};
use cudarc::driver::sys::{self, CUdevice_attribute};
use cudarc::driver::{CudaFunction, CudaSlice, DeviceRepr, LaunchConfig, PushKernelArg as _};

use super::super::device::Device;
use super::super::memory::{address, download, room, upload};
use super::trial::{Code, KernelFacts, Trial};
use crate::error::{Result, during, invalid};
use crate::scene::{Faces, Group, Window};

pub(super) const CODE: Code = Code {
    source: include_str!("../../../kernels/raster.cu"),
    functions: &["raster", "raster_warps", "raster_tiles"],
    variants: &[
        &[],
        &["DEPTH"],
        &["COUNT"],
        &["DEPTH", "COUNT"],
        &["FEW=0"],
        &["FEW=0", "NARROW=-1"],
        &["COUNT", "FEW=0"],
        &["COUNT", "FEW=0", "NARROW=-1"],
    ],
};

/// Threads of a block, and blocks of a multiprocessor where blocks take turns.
const BLOCK: u32 = 256;
const RESIDENT: u32 = 8;

/// The most triangles, exclusive: 24 bits count what is queued, beside 40 bits of tiles.
const MOST: usize = 1 << 24;

/// What a sample holds before anything is drawn.
const NOTHING: u32 = u32::MAX;

/// Arguments of all three kernels; pointers are device addresses.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct RasterArgs {
    positions: u64,
    triangles: u64,
    target: u64,
    medium: u64,
    large: u64,
    tally: u64,
    clip: [f32; 16],
    half: [f32; 2],
    guard: [f32; 2],
    size: [u32; 2],
    first: u32,
    count: u32,
    faces: u32,
    pad: u32,
}

const _: () = assert!(size_of::<RasterArgs>() == 152, "RasterArgs differs from kernels/raster.cuh");

// SAFETY: repr(C) without padding or Rust references, laid out as the struct of the same name in the kernel.
unsafe impl DeviceRepr for RasterArgs {}

/// What was queued and counted.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct Tally {
    medium: u32,
    pad: u32,
    large: u64,
    counts: [u32; 8],
}

const _: () = assert!(size_of::<Tally>() == 48, "Tally differs from kernels/raster.cuh");

/// Bytes of an entry of the large queue.
const LARGE: u64 = 16;

/// What is drawn.
#[derive(Debug, Clone, Copy)]
pub struct RasterMesh<'a> {
    /// World or relative positions, three numbers a vertex.
    pub positions: &'a [f32],
    /// Vertices; a triangle's id is its place here.
    pub triangles: &'a [[u32; 3]],
    pub groups: &'a [Group],
}

/// Who draws the triangles that could be drawn by a thread; for comparisons, the result is the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Spread {
    /// Threads, warps and blocks by size.
    #[default]
    BySize,
    /// No threads: warps and blocks.
    Warps,
    /// Blocks alone.
    Tiles,
}

/// Which variant of the kernels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RasterForm {
    /// Depth without ids, as shadow maps want it.
    pub depth_only: bool,
    /// Whether triangles are counted by their path.
    pub counted: bool,
    /// By size where depth is alone.
    pub spread: Spread,
}

impl RasterForm {
    fn defines(self) -> Vec<&'static str> {
        let counted = self.counted.then_some("COUNT");
        if self.depth_only {
            return std::iter::once("DEPTH").chain(counted).collect();
        }
        let spread: &[&str] = match self.spread {
            Spread::BySize => &[],
            Spread::Warps => &["FEW=0"],
            Spread::Tiles => &["FEW=0", "NARROW=-1"],
        };
        counted.into_iter().chain(spread.iter().copied()).collect()
    }
}

/// Triangles by what became of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RasterCounts {
    /// Drawn by a thread, a warp, or tile by tile.
    pub small: u32,
    pub medium: u32,
    pub large: u32,
    /// A corner is not finite in clip space.
    pub not_finite: u32,
    /// Beyond a plane of the view.
    pub outside: u32,
    /// Without area at 1/256 pixel.
    pub flat: u32,
    pub back: u32,
    /// Between the samples.
    pub missed: u32,
}

/// A mesh and a window on the device, and the kernels that draw one in the other.
#[derive(Debug)]
pub struct Raster {
    form: RasterForm,
    functions: Vec<CudaFunction>,
    facts: Vec<KernelFacts>,
    groups: Vec<Group>,
    positions: CudaSlice<u8>,
    triangles: CudaSlice<u8>,
    target: CudaSlice<u8>,
    medium: CudaSlice<u8>,
    large: CudaSlice<u8>,
    tally: CudaSlice<u8>,
    window: Window,
    /// Blocks of the kernels that take turns.
    blocks: u32,
    bytes: Vec<(&'static str, u64)>,
}

impl Raster {
    /// Compiles the kernels and puts the mesh onto the device.
    ///
    /// # Errors
    /// `Invalid` when there are 2^24 triangles or more, one names no vertex, or a group no triangle; `Unavailable` when
    /// NVRTC is missing; `Fault` when the device refuses.
    pub fn new(device: &Device, mesh: RasterMesh<'_>, window: Window, form: RasterForm) -> Result<Self> {
        check(&mesh)?;
        let (defines, count) = (form.defines(), mesh.triangles.len() as u64);
        let compile = |name: &&str| device.function(name, CODE.source, &defines);
        let functions = CODE.functions.iter().map(compile).collect::<Result<Vec<_>>>()?;
        let named = CODE.functions.iter().zip(&functions);
        let facts = named.map(|(name, function)| KernelFacts::of(name, function)).collect::<Result<_>>()?;
        let sample = if form.depth_only { 4 } else { 8 };
        let target = sample * window.pixels() as u64;
        let units = device.context().attribute(CUdevice_attribute::CU_DEVICE_ATTRIBUTE_MULTIPROCESSOR_COUNT);
        let units = u32::try_from(units.map_err(during("device"))?).unwrap_or(1);
        Ok(Self {
            form,
            functions,
            facts,
            groups: mesh.groups.to_vec(),
            positions: upload(device, mesh.positions)?,
            triangles: upload(device, mesh.triangles.as_flattened())?,
            target: room(device, target)?,
            medium: room(device, 4 * count)?,
            large: room(device, LARGE * count)?,
            tally: room(device, size_of::<Tally>() as u64)?,
            window,
            blocks: RESIDENT * units,
            bytes: vec![("samples", target), ("x", size_of_val(mesh.positions) as u64), ("triangles", 12 * count)],
        })
    }

    /// What the last launch left in each sample, row by row from the top: the bits of its depth, then the triangle; all
    /// ones where there is nothing. Empty where depth is alone.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    pub fn keys(&self, device: &Device) -> Result<Vec<u64>> {
        let mut keys = vec![0; if self.form.depth_only { 0 } else { self.window.pixels() }];
        // SAFETY: the buffer has a key for each sample when depth is not alone.
        unsafe { download(device, address(device, &self.target), &mut keys) }?;
        Ok(keys)
    }

    /// The depth of each sample where depth is alone, else nothing; 1 where there is nothing.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    pub fn depths(&self, device: &Device) -> Result<Vec<f32>> {
        let mut depths = vec![0.0; if self.form.depth_only { self.window.pixels() } else { 0 }];
        // SAFETY: the buffer has a depth for each sample when depth is alone.
        unsafe { download(device, address(device, &self.target), &mut depths) }?;
        Ok(depths)
    }

    /// What became of the triangles of the last launch; zeros unless they were counted.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    pub fn counts(&self, device: &Device) -> Result<RasterCounts> {
        let mut tally = [Tally::zeroed()];
        // SAFETY: the buffer is one tally.
        unsafe { download(device, address(device, &self.tally), &mut tally) }?;
        let [small, medium, large, not_finite, outside, flat, back, missed] = tally[0].counts;
        Ok(RasterCounts { small, medium, large, not_finite, outside, flat, back, missed })
    }

    fn args(&self, device: &Device) -> RasterArgs {
        RasterArgs {
            positions: address(device, &self.positions),
            triangles: address(device, &self.triangles),
            target: address(device, &self.target),
            medium: address(device, &self.medium),
            large: address(device, &self.large),
            tally: address(device, &self.tally),
            clip: *self.window.clip(),
            half: self.window.half(),
            guard: self.window.guard(),
            size: self.window.size(),
            ..RasterArgs::zeroed()
        }
    }

    /// Empty queues and samples without anything.
    fn clear(&self, device: &Device) -> Result<()> {
        let nothing = if self.form.depth_only { 1.0_f32.to_bits() } else { NOTHING };
        for (buffer, word) in [(&self.target, nothing), (&self.tally, 0)] {
            let stream = device.stream().cu_stream();
            // SAFETY: the buffer is whole words, all of which are written on the stream that orders its readers.
            let set = unsafe { sys::cuMemsetD32Async(address(device, buffer), word, buffer.len() / 4, stream) };
            set.result().map_err(during("raster"))?;
        }
        Ok(())
    }

    fn start(&self, device: &Device, function: usize, blocks: u32, args: RasterArgs) -> Result<()> {
        let mut launch = device.stream().launch_builder(&self.functions[function]);
        let config = LaunchConfig { grid_dim: (blocks, 1, 1), block_dim: (BLOCK, 1, 1), shared_mem_bytes: 0 };
        // SAFETY: `RasterArgs` is the kernels' only argument. `check` saw that triangles name vertices that are there and
        // groups triangles; queues have room for each of them, and the target a sample for each pixel.
        unsafe { launch.arg(&args).launch(config) }.map_err(during("raster"))?;
        Ok(())
    }
}

impl Trial for Raster {
    fn name(&self) -> String {
        let [width, height] = self.window.size();
        format!("raster {} {width}x{height}", if self.form.depth_only { "depth" } else { "ids" })
    }

    fn turns(&self) -> usize {
        1
    }

    fn launch(&self, device: &Device, _: usize) -> Result<()> {
        self.clear(device)?;
        let args = self.args(device);
        for group in self.groups.iter().filter(|group| group.triangles > 0) {
            let faces = u32::from(group.faces == Faces::Fronts);
            let own = RasterArgs { first: group.first, count: group.triangles, faces, ..args };
            self.start(device, 0, group.triangles.div_ceil(BLOCK), own)?;
        }
        self.start(device, 1, self.blocks, args)?;
        self.start(device, 2, self.blocks, args)
    }

    fn bytes(&self) -> Vec<(&'static str, u64)> {
        self.bytes.clone()
    }

    fn launches(&self) -> usize {
        2 + self.groups.iter().filter(|group| group.triangles > 0).count()
    }

    fn kernels(&self) -> Vec<KernelFacts> {
        self.facts.clone()
    }
}

/// Refuses what would be read or queued out of bounds. Groups may not overlap, or a triangle could be queued twice.
fn check(mesh: &RasterMesh<'_>) -> Result<()> {
    let (count, vertices) = (mesh.triangles.len(), mesh.positions.len() / 3);
    if count >= MOST {
        return Err(invalid("triangles", format!("fewer than {MOST}"), count));
    }
    if let Some(vertex) = mesh.triangles.as_flattened().iter().find(|vertex| **vertex as usize >= vertices) {
        return Err(invalid("triangles", format!("vertices below {vertices}"), vertex));
    }
    let mut end = 0;
    for group in mesh.groups {
        let own = group.first as usize + group.triangles as usize;
        if (group.first as usize) < end || own > count {
            let expected = format!("groups one after the other within {count} triangles");
            return Err(invalid("groups", expected, format!("{group:?}")));
        }
        end = own;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::super::trial::tests::compile_all;
    use super::*;

    #[test]
    fn every_form_is_a_variant_that_is_compiled_in_the_check() {
        for depth_only in [false, true] {
            for counted in [false, true] {
                for spread in [Spread::BySize, Spread::Warps, Spread::Tiles] {
                    let form = RasterForm { depth_only, counted, spread };
                    assert!(CODE.variants.contains(&form.defines().as_slice()), "{form:?}");
                }
            }
        }
    }

    #[test]
    fn meshes_that_would_be_read_out_of_bounds_are_refused() {
        let positions = [0.0; 9];
        let group = |first, triangles| Group { first, triangles, faces: Faces::Both };
        let of = |triangles: &[[u32; 3]], groups: &[Group]| {
            check(&RasterMesh { positions: &positions, triangles, groups }).is_ok()
        };
        let two = [[0, 1, 2], [2, 1, 0]];
        assert!(of(&two, &[group(0, 1), group(1, 1)]) && of(&[], &[]));
        assert!(!of(&[[0, 1, 3]], &[]));
        assert!(!of(&two, &[group(0, 3)]) && !of(&two, &[group(0, 2), group(1, 1)]) && !of(&two, &[group(2, 1)]));
    }

    #[test]
    #[ignore = "needs NVRTC: deploy/check installs it"]
    fn nvrtc_compiles_every_raster() {
        compile_all(&CODE);
    }
}
