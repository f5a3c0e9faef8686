//! The rasteriser as a trial: positions and samples of its own on the device, to be timed without OpenGL and read back.

use cudarc::driver::CudaSlice;

use super::trial::{KernelFacts, Trial};
use modalcast_compute::gpu::Device;
use modalcast_compute::gpu::memory::{address, download, room, upload};
use modalcast_compute::gpu::raster::{Core, Functions, Pass, RasterForm, check, check_cut_outs};
use modalcast_model::error::Result;
use modalcast_model::raster::CutOuts;
use modalcast_model::scene::{Group, Window};

/// What is drawn.
#[derive(Debug, Clone, Copy)]
pub struct RasterMesh<'a> {
    /// World or relative positions, three numbers a vertex.
    pub positions: &'a [f32],
    /// Vertices; a triangle's id is its place here.
    pub triangles: &'a [[u32; 3]],
    pub groups: &'a [Group],
    pub cut_outs: Option<&'a CutOuts>,
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
    functions: Functions,
    facts: Vec<KernelFacts>,
    groups: Vec<Group>,
    positions: CudaSlice<u8>,
    target: CudaSlice<u8>,
    core: Core,
    window: Window,
    bytes: Vec<(&'static str, u64)>,
}

impl Raster {
    /// Compiles the kernels and puts the mesh onto the device.
    ///
    /// # Errors
    /// `Invalid` when there are 2^24 triangles or more, one names no vertex, or a group no triangle; `Unavailable` when
    /// NVRTC is missing; `Fault` when the device refuses.
    pub fn new(device: &Device, mesh: RasterMesh<'_>, window: Window, form: RasterForm) -> Result<Self> {
        check(mesh.positions.len() as u64 / 3, mesh.triangles, mesh.groups)?;
        if let Some(cut_outs) = mesh.cut_outs {
            check_cut_outs(mesh.triangles.len(), cut_outs)?;
        }
        let core = Core::new(device, mesh.triangles, mesh.cut_outs)?;
        let functions = Functions::new(device, form, core.is_cut())?;
        let facts = functions.named().map(|(name, function)| KernelFacts::of(name, function)).collect::<Result<_>>()?;
        let (target, triangles) = (form.bytes(&window), size_of_val(mesh.triangles) as u64);
        Ok(Self {
            form,
            functions,
            facts,
            groups: mesh.groups.to_vec(),
            positions: upload(device, mesh.positions)?,
            target: room(device, target)?,
            core,
            window,
            bytes: vec![("samples", target), ("x", size_of_val(mesh.positions) as u64), ("triangles", triangles)],
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
        let [small, medium, large, not_finite, outside, flat, back, missed] = self.core.counts(device)?;
        Ok(RasterCounts { small, medium, large, not_finite, outside, flat, back, missed })
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
        let pass = Pass {
            functions: &self.functions,
            groups: &self.groups,
            window: &self.window,
            positions: address(device, &self.positions),
            target: address(device, &self.target),
        };
        self.core.draw(device, &pass)
    }

    fn bytes(&self) -> Vec<(&'static str, u64)> {
        self.bytes.clone()
    }

    fn launches(&self) -> usize {
        self.core.launches(&self.groups)
    }

    fn kernels(&self) -> Vec<KernelFacts> {
        self.facts.clone()
    }
}
