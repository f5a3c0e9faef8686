//! Benchmarks the CUDA rasterizer without OpenGL. The benchmark owns the buffers of positions and samples, so that the
//! samples can be read back. A sample is the depth of a pixel or, with triangle ids, a key: depth and id in 64 bits.

use super::kernel_benchmark::{ArrayTraffic, KernelAttributes, KernelBenchmark};
use modalcast_compute::gpu::Device;
use modalcast_compute::gpu::RasterVariant;
use modalcast_compute::gpu::launch::DeviceBuffer;
use modalcast_compute::gpu::launchers::{RasterFunctions, RasterPass, RasterPipeline, check_cut_outs, check_mesh};
use modalcast_model::error::Result;
use modalcast_model::raster::{ALL_TRIANGLES, CutOuts};
use modalcast_model::scene::{DrawRange, Viewport};

/// The mesh to draw.
#[derive(Debug, Clone, Copy)]
pub struct RasterMesh<'a> {
    /// World or camera-relative positions, three f32 per vertex.
    pub positions: &'a [f32],
    /// Vertex indices of each triangle. The id of a triangle is its index here.
    pub triangles: &'a [[u32; 3]],
    /// Ranges of triangles to draw, each with its cull mode.
    pub groups: &'a [DrawRange],
    /// The alpha-tested triangles.
    pub cut_outs: Option<&'a CutOuts>,
}

/// Number of triangles by outcome. A thread, a warp or several warps draw a triangle, depending on its size.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RasterCounts {
    /// Drawn by one thread.
    pub small: u32,
    /// Drawn by one warp.
    pub medium: u32,
    /// Drawn by several warps, each with some tiles of pixels.
    pub large: u32,
    /// Skipped: a corner is not finite in clip space.
    pub not_finite: u32,
    /// Skipped: outside of a plane of the view frustum.
    pub outside: u32,
    /// Skipped: no area at a resolution of 1/256 pixel.
    pub flat: u32,
    /// Skipped: back face.
    pub back: u32,
    /// Skipped: no sample is covered.
    pub missed: u32,
}

/// A mesh and its render target on the device, and the kernels that draw the mesh.
#[derive(Debug)]
pub struct RasterBenchmark {
    variant: RasterVariant,
    functions: RasterFunctions,
    attributes: Vec<KernelAttributes>,
    groups: Vec<DrawRange>,
    positions: DeviceBuffer,
    target: DeviceBuffer,
    pipeline: RasterPipeline,
    viewport: Viewport,
    traffic: Vec<ArrayTraffic>,
}

impl RasterBenchmark {
    /// Compiles the kernels and uploads the mesh.
    ///
    /// # Errors
    /// `Invalid` when there are 2^24 triangles or more, or an index of a vertex or of a triangle is out of range;
    /// `Unavailable` when NVRTC is missing; `Fault` when the device fails.
    pub fn new(device: &Device, mesh: RasterMesh<'_>, viewport: Viewport, variant: RasterVariant) -> Result<Self> {
        check_mesh(mesh.positions.len() as u64 / 3, mesh.triangles, mesh.groups)?;
        if let Some(cut_outs) = mesh.cut_outs {
            check_cut_outs(mesh.triangles.len(), cut_outs)?;
        }
        let pipeline = RasterPipeline::new(device, mesh.triangles, mesh.cut_outs)?;
        let functions = RasterFunctions::new(device, variant, pipeline.has_cut_outs())?;
        let attributes = functions
            .with_names()
            .map(|(name, function)| KernelAttributes::query(name, function))
            .collect::<Result<_>>()?;
        let (target_bytes, triangle_bytes) = (variant.bytes(&viewport), size_of_val(mesh.triangles) as u64);
        Ok(Self {
            variant,
            functions,
            attributes,
            groups: mesh.groups.to_vec(),
            positions: DeviceBuffer::upload(device, mesh.positions)?,
            target: DeviceBuffer::zeroed(device, target_bytes)?,
            pipeline,
            viewport,
            traffic: vec![
                ArrayTraffic::new("samples", target_bytes),
                ArrayTraffic::new("x", size_of_val(mesh.positions) as u64),
                ArrayTraffic::new("triangles", triangle_bytes),
            ],
        })
    }

    /// The keys of the last launch, row by row from the top; empty for depth-only targets. The upper 32 bits of a key
    /// are the inverted bits of the depth, the lower 32 bits are the id of the triangle. A key is all ones where
    /// nothing was drawn.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    pub fn keys(&self, device: &Device) -> Result<Vec<u64>> {
        let mut keys = vec![0; if self.variant.depth_only { 0 } else { self.viewport.pixel_count() }];
        self.target.read(device, 0, &mut keys)?;
        Ok(keys)
    }

    /// The depths of the last launch, row by row from the top, for depth-only targets; otherwise empty. A depth is 1 at
    /// the near plane, and 0 at the far plane and where nothing was drawn.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    pub fn depths(&self, device: &Device) -> Result<Vec<f32>> {
        let mut depths = vec![0.0; if self.variant.depth_only { self.viewport.pixel_count() } else { 0 }];
        self.target.read(device, 0, &mut depths)?;
        Ok(depths)
    }

    /// Triangle counts of the last launch; zeros without [`RasterVariant::count_triangles`].
    ///
    /// # Errors
    /// `Fault` when the device fails.
    pub fn counts(&self, device: &Device) -> Result<RasterCounts> {
        let [small, medium, large, not_finite, outside, flat, back, missed] = self.pipeline.counts(device)?;
        Ok(RasterCounts { small, medium, large, not_finite, outside, flat, back, missed })
    }
}

impl KernelBenchmark for RasterBenchmark {
    fn name(&self) -> String {
        let [width, height] = self.viewport.size();
        format!("raster {} {width}x{height}", if self.variant.depth_only { "depth" } else { "ids" })
    }

    fn input_set_count(&self) -> usize {
        1
    }

    fn launch(&self, device: &Device, _: usize) -> Result<()> {
        let pass = RasterPass {
            functions: &self.functions,
            groups: &self.groups,
            window: &self.viewport,
            positions: self.positions.address(),
            target: self.target.address(),
            range: ALL_TRIANGLES,
        };
        // SAFETY: `new` checked mesh and groups. Both buffers have the sizes of the pass, and releasing device memory
        // is stream-ordered.
        unsafe { self.pipeline.draw(device, &pass) }
    }

    fn traffic(&self) -> Vec<ArrayTraffic> {
        self.traffic.clone()
    }

    fn launches_per_step(&self) -> usize {
        self.pipeline.launches(&self.groups)
    }

    fn kernel_attributes(&self) -> Vec<KernelAttributes> {
        self.attributes.clone()
    }
}
