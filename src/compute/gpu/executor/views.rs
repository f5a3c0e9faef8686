//! Batches of small views: launches `kernels/views.cu`, which draws all views of a batch in one launch.
//!
//! A block draws a strip of a view in shared memory, so no view needs memory besides its outputs. The kernel reads the
//! vertices where the deformer wrote them. If several views show one world of many triangles, a first launch bounds
//! chunks of 32 triangles, and each view skips the chunks outside of its view volume.

#[cfg(test)]
mod tests;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use bytemuck::{Pod, Zeroable};
use cudarc::driver::{CudaFunction, CudaStream, LaunchConfig};

use super::pinned_pixels::{PinnedArray, PinnedPool};
use super::raster::check_cut_outs;
use super::raster::cut_out::CutOutBuffers;
use super::texture::{MipmappedTexture, TextureImage};
use super::view_ring::{RingViews, ViewRing};
use crate::gpu::launch::{Device, DeviceBuffer, LaunchOrder, launch_kernel};
use modalcast_model::error::{Error, Result, fault, invalid};
use modalcast_model::scene::{CullMode, MAX_VIEWPORT_SIDE};
use modalcast_model::views::{
    View, ViewBatch, ViewCamera, ViewFormat, ViewLight, ViewMaterial, ViewOutputs, ViewPictures, ViewScene,
};

const SOURCE: &str = include_str!("../../../../kernels/views.cu");
const FUNCTIONS: [&str; 2] = ["views", "bound_chunks"];

/// Threads per block.
const BLOCK_THREADS: u32 = 256;
const WARPS_PER_BLOCK: u32 = BLOCK_THREADS / 32;
/// Largest number of pixels of a tile. Each takes 8 bytes of shared memory, and a block has 48 KiB.
const MAX_TILE_PIXELS: u32 = 4096;
/// Triangles of a chunk: one per lane of a warp.
const CHUNK_TRIANGLES: u32 = 32;
/// Chunks are bounded and culled if there are at least as many.
const MIN_CULLED_CHUNKS: usize = 64;
/// Each warp of a block takes chunks about four times, so that the warps finish at about the same time.
const TURNS_PER_WARP: u32 = 4;

/// Arguments of both kernels; pointers are device addresses. `kernels/views.cu` documents the fields.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct ViewsArgs {
    views: u64,
    cameras: u64,
    positions: u64,
    normals: u64,
    tangents: u64,
    boxes: u64,
    triangle_vertices: u64,
    triangle_corners: u64,
    triangle_materials: u64,
    triangle_domains: u64,
    chunks: u64,
    materials: u64,
    uvs: u64,
    cut_out_uvs: u64,
    cut_out_materials: u64,
    alpha_materials: u64,
    color: u64,
    depth: u64,
    domains: u64,
    out_normals: u64,
    vertex_count: u32,
    corner_count: u32,
    chunk_count: u32,
    world_count: u32,
    chunks_per_turn: u32,
    width: u32,
    height: u32,
    tile_height: u32,
    tiles_per_view: u32,
    first_cut_out: u32,
    guard_band: [f32; 2],
    depth_scale: f32,
    depth_includes_ground: u32,
    light: ViewLight,
}

const _: () = assert!(size_of::<ViewCamera>() == 136, "ViewCamera differs from kernels/view_shading.cuh");
const _: () = assert!(size_of::<ViewLight>() == 168, "ViewLight differs from kernels/view_shading.cuh");
const _: () = assert!(size_of::<ViewsArgs>() == 384, "ViewsArgs differs from kernels/views.cu");

/// An entry of the material table on the device. Images are handles of texture objects, or 0.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct DeviceMaterial {
    ambient: [f32; 3],
    diffuse: [f32; 3],
    specular: [f32; 3],
    exponent: f32,
    color_image: u64,
    normal_image: u64,
}

const _: () = assert!(size_of::<DeviceMaterial>() == 56, "DeviceMaterial differs from kernels/view_shading.cuh");

/// Consecutive triangles of one cull mode that are culled together.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
struct TriangleChunk {
    first_triangle: u32,
    triangle_count: u32,
    culls_back_faces: u32,
    pad: u32,
}

/// Draws batches of views of one scene.
///
/// Its static data belong to another stream than its work. So if it has drawn, dropping it waits for that work.
#[derive(Debug)]
pub struct CudaViewRenderer {
    device: Arc<Device>,
    views: CudaFunction,
    bound_chunks: CudaFunction,
    tables: SceneTables,
    /// The textures that the material table refers to.
    _images: Vec<MipmappedTexture>,
    /// Whether a kernel may use the static data. Without one, another thread than that of the device may drop this.
    has_drawn: AtomicBool,
}

/// The static data of a scene on the device.
#[derive(Debug)]
struct SceneTables {
    triangle_vertices: DeviceBuffer,
    triangle_corners: DeviceBuffer,
    triangle_materials: DeviceBuffer,
    triangle_domains: DeviceBuffer,
    chunks: DeviceBuffer,
    materials: DeviceBuffer,
    uvs: DeviceBuffer,
    cut_outs: Option<CutOutBuffers>,
    vertex_count: usize,
    corner_count: usize,
    chunk_count: usize,
    has_normal_maps: bool,
    light: ViewLight,
}

/// The vertices of all worlds in device memory, one world after another.
#[derive(Debug, Clone, Copy)]
pub struct DeviceVertices<'a> {
    positions: DeviceRange,
    normals: DeviceRange,
    tangents: DeviceRange,
    /// Orders the work that writes the vertices.
    stream: &'a Arc<CudaStream>,
}

/// A range of device memory.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct DeviceRange {
    pub(super) address: u64,
    pub(super) bytes: u64,
}

impl<'a> DeviceVertices<'a> {
    /// The vertices in these buffers: 3 f32 per vertex, 3 f32 per corner and, with normal maps, 4 f32 per corner.
    ///
    /// # Errors
    /// `Fault` if the buffers have different streams.
    pub fn new(
        positions: &'a DeviceBuffer,
        normals: &'a DeviceBuffer,
        tangents: Option<&'a DeviceBuffer>,
    ) -> Result<Self> {
        let stream = positions.stream();
        if ![Some(normals), tangents].into_iter().flatten().all(|buffer| Arc::ptr_eq(buffer.stream(), stream)) {
            return Err(fault("views", "expected vertices of one stream"));
        }
        let range = |buffer: &DeviceBuffer| DeviceRange { address: buffer.address(), bytes: buffer.bytes() };
        let ranges = [range(positions), range(normals), tangents.map(range).unwrap_or_default()];
        // SAFETY: the buffers exist during `'a`, and their stream orders their release.
        Ok(unsafe { Self::from_ranges(ranges, stream) })
    }

    /// Positions, normals and tangents in these ranges; empty without tangents.
    ///
    /// # Safety
    /// The ranges are memory of the stream's device. They exist during `'a`, and afterwards until the work that was
    /// submitted to the stream during `'a` has ended.
    pub(super) const unsafe fn from_ranges(
        [positions, normals, tangents]: [DeviceRange; 3],
        stream: &'a Arc<CudaStream>,
    ) -> Self {
        Self { positions, normals, tangents, stream }
    }
}

/// A batch on the device, with its outputs.
#[derive(Debug)]
pub struct DeviceViews {
    cameras: DeviceBuffer,
    views: DeviceBuffer,
    view_count: u32,
    /// Number of worlds that the views need.
    world_count: usize,
    format: ViewFormat,
    /// Chunks of the renderer that prepared the batch.
    chunk_count: usize,
    /// Boxes of the chunks of each world, if chunks are culled.
    boxes: Option<DeviceBuffer>,
    arrays: ViewArrays,
}

/// The memory of a batch's pictures.
#[derive(Debug)]
enum ViewArrays {
    /// Color, depth, domains and normals, as far as they are drawn.
    Own(Box<[Option<DeviceBuffer>; 4]>),
    Ring(RingViews),
}

impl ViewArrays {
    /// Addresses of color, depth, domains and normals; 0 for an array that is not drawn.
    fn addresses(&self) -> [u64; 4] {
        match self {
            Self::Own(arrays) => arrays.each_ref().map(|array| array.as_ref().map_or(0, DeviceBuffer::address)),
            Self::Ring(views) => views.addresses(),
        }
    }
}

impl DeviceViews {
    /// The colors: see [`modalcast_model::views::ViewOutputs`]. `None` if they were not requested, or are in a ring.
    pub fn color(&self) -> Option<&DeviceBuffer> {
        match &self.arrays {
            ViewArrays::Own(arrays) => arrays[0].as_ref(),
            ViewArrays::Ring(_) => None,
        }
    }

    /// Changes the cameras before the next call of [`CudaViewRenderer::draw`].
    ///
    /// # Errors
    /// `Invalid` if the number of cameras changes or a number is not finite; `Fault` when the device fails.
    pub fn set_cameras(&mut self, device: &Device, cameras: &[ViewCamera]) -> Result<()> {
        let count = self.cameras.bytes() as usize / size_of::<ViewCamera>();
        if cameras.len() != count {
            return Err(invalid("views.cameras", format!("{count} cameras"), cameras.len()));
        }
        ViewBatch { cameras, views: &[View { camera: 0, world: 0 }], format: self.format }.check()?;
        self.cameras.write(device, 0, cameras)
    }

    /// Waits for the pictures of the last draw and copies them to the host.
    ///
    /// # Errors
    /// `Fault` when they are in a ring, or when the device fails.
    pub fn read(&self, device: &Device) -> Result<ViewPictures> {
        fn list<T: Pod>(device: &Device, buffer: Option<&DeviceBuffer>) -> Result<Vec<T>> {
            let Some(buffer) = buffer else { return Ok(Vec::new()) };
            let mut list = vec![T::zeroed(); buffer.bytes() as usize / size_of::<T>()];
            buffer.read(device, 0, &mut list)?;
            Ok(list)
        }
        let ViewArrays::Own(arrays) = &self.arrays else { return Err(in_ring_error()) };
        let [color, depth, domains, normals] = &**arrays;
        Ok(ViewPictures {
            color: list(device, color.as_ref())?,
            depth: list(device, depth.as_ref())?,
            domains: list(device, domains.as_ref())?,
            normals: list(device, normals.as_ref())?,
        })
    }
}

impl DeviceViews {
    /// Waits for the pictures of the last draw and copies them to pinned memory: color, depth, domains and normals, as
    /// far as they are drawn.
    ///
    /// # Errors
    /// `Fault` when they are in a ring, when the driver cannot lock enough memory, or when the device fails.
    pub fn read_pinned(&self, device: &Device, pool: &mut PinnedPool) -> Result<[Option<PinnedArray>; 4]> {
        let ViewArrays::Own(arrays) = &self.arrays else { return Err(in_ring_error()) };
        let mut copies = [const { None }; 4];
        for (copy, array) in copies.iter_mut().zip(&**arrays) {
            let Some(array) = array else { continue };
            *copy = Some(pool.fill(device, array.bytes() as usize, |target| array.read(device, 0, target))?);
        }
        Ok(copies)
    }
}

fn in_ring_error() -> Error {
    fault("views", "expected pictures that are not in a ring")
}

impl CudaViewRenderer {
    /// Compiles the kernels and uploads the static data of a scene. Any thread may call this. The work has a stream of
    /// its own, and is complete when this returns.
    ///
    /// # Errors
    /// `Invalid` if the scene is inconsistent; `Unavailable` when NVRTC is missing; `Fault` when the device fails.
    pub fn new(device: &Arc<Device>, scene: &ViewScene) -> Result<Self> {
        scene.check()?;
        if let Some(cut_outs) = &scene.cut_outs {
            check_cut_outs(scene.triangle_vertices.len(), cut_outs)?;
        }
        let upload_device = device.with_own_stream()?;
        let _current = upload_device.enter()?;
        let mut functions = upload_device.functions(&FUNCTIONS, SOURCE, &defines(scene))?;
        let (Some(bound_chunks), Some(views)) = (functions.pop(), functions.pop()) else {
            return Err(fault("load kernel", "expected two functions"));
        };
        let upload_image = |image: &modalcast_model::views::ViewImage| {
            let size = [image.width, image.height];
            let texture_image = TextureImage { size, levels: &image.levels, channels: 4, is_srgb: image.is_srgb };
            MipmappedTexture::new(&upload_device, texture_image, scene.anisotropy)
        };
        let images = scene.images.iter().map(upload_image).collect::<Result<Vec<_>>>()?;
        let tables = SceneTables::new(&upload_device, scene, &images)?;
        upload_device.synchronize("upload")?;
        Ok(Self {
            device: Arc::clone(device),
            views,
            bound_chunks,
            tables,
            _images: images,
            has_drawn: AtomicBool::new(false),
        })
    }

    /// The device that draws.
    pub const fn device(&self) -> &Arc<Device> {
        &self.device
    }

    /// Uploads a batch and allocates its outputs.
    ///
    /// # Errors
    /// `Invalid` if the batch is; `Fault` when the device has not enough memory.
    pub fn prepare(&self, batch: &ViewBatch<'_>) -> Result<DeviceViews> {
        let pixels = (batch.views.len() * batch.format.pixel_count()) as u64;
        let array = |is_requested: bool, pixel_bytes: u64| {
            is_requested.then(|| DeviceBuffer::zeroed(&self.device, pixel_bytes * pixels)).transpose()
        };
        let ViewOutputs { color, depth, domains, normals } = batch.format.outputs;
        let arrays = [array(color, 3)?, array(depth, 4)?, array(domains, 4)?, array(normals, 12)?];
        self.prepare_arrays(batch, ViewArrays::Own(Box::new(arrays)))
    }

    /// Uploads a batch whose pictures are drawn into a slot of a ring, from the place of `first_view` on.
    ///
    /// # Errors
    /// `Invalid` if the batch is, or for a slot or views that the ring does not have; `Fault` if the ring belongs to
    /// another device or has other arrays, or when the device has not enough memory.
    pub fn prepare_in_ring(
        &self,
        batch: &ViewBatch<'_>,
        ring: &Arc<ViewRing>,
        slot: usize,
        first_view: usize,
    ) -> Result<DeviceViews> {
        let views = ring.views(slot, first_view, batch.views.len())?;
        if !Arc::ptr_eq(views.device(), &self.device) || !views.has_format(&batch.format) {
            return Err(fault("views", "expected a ring of this device with the arrays of the batch"));
        }
        self.prepare_arrays(batch, ViewArrays::Ring(views))
    }

    fn prepare_arrays(&self, batch: &ViewBatch<'_>, arrays: ViewArrays) -> Result<DeviceViews> {
        let (device, world_count) = (&*self.device, batch.check()?);
        let chunk_count = self.tables.chunk_count;
        let culls_chunks = chunk_count >= MIN_CULLED_CHUNKS && batch.views.len() >= 2 * world_count;
        let box_bytes = 6 * size_of::<f32>() * world_count * chunk_count;
        Ok(DeviceViews {
            cameras: DeviceBuffer::upload(device, batch.cameras)?,
            views: DeviceBuffer::upload(device, batch.views)?,
            view_count: batch.views.len() as u32,
            world_count,
            format: batch.format,
            chunk_count,
            boxes: culls_chunks.then(|| DeviceBuffer::zeroed(device, box_bytes as u64)).transpose()?,
            arrays,
        })
    }

    /// Draws a batch on the device's stream, without waiting.
    ///
    /// # Errors
    /// `Invalid` if there are too few vertices for the worlds of the batch; `Fault` if vertices or batch belong to
    /// another stream or scene, or when the device fails.
    pub fn draw(&self, vertices: &DeviceVertices<'_>, views: &mut DeviceViews) -> Result<()> {
        let tables = &self.tables;
        let tangent_count = if tables.has_normal_maps { tables.corner_count } else { 0 };
        for (field, range, world_floats) in [
            ("positions", vertices.positions, 3 * tables.vertex_count),
            ("normals", vertices.normals, 3 * tables.corner_count),
            ("tangents", vertices.tangents, 4 * tangent_count),
        ] {
            let needed = (size_of::<f32>() * world_floats * views.world_count) as u64;
            if range.bytes < needed {
                let expected = format!("{needed} bytes for {} worlds", views.world_count);
                return Err(invalid(format!("views.{field}"), expected, range.bytes));
            }
        }
        let is_own = |stream: &Arc<CudaStream>| Arc::ptr_eq(stream, self.device.stream());
        if !is_own(vertices.stream) || !is_own(views.views.stream()) || views.chunk_count != tables.chunk_count {
            return Err(fault("views", "expected vertices and a batch of this renderer"));
        }
        self.has_drawn.store(true, Ordering::Relaxed);
        let args = self.args(vertices, views);
        if views.boxes.is_some() {
            let chunks = views.world_count * tables.chunk_count;
            // SAFETY: as below; `boxes` has a box per chunk of each world.
            unsafe { self.start(&self.bound_chunks, (chunks as u32).div_ceil(WARPS_PER_BLOCK), 0, &args) }?;
        }
        let shared_bytes = size_of::<u64>() as u32 * args.tile_height * args.width;
        // SAFETY: `ViewScene::check` and `check_cut_outs` verified all indices of the tables. `ViewBatch::check`
        // verified those of the views, and the loop above the sizes of the vertices. `prepare_arrays` got outputs for
        // these views, aligned to 4 bytes, and allocated boxes for this number of chunks. All memory exists until the
        // kernels have ended: that of `views` is released in the order of the stream, a ring and `self` wait for the
        // stream before they are released, and `DeviceVertices` guarantees that the stream orders the release or waits.
        unsafe { self.start(&self.views, views.view_count * args.tiles_per_view, shared_bytes, &args) }
    }

    /// Starts a kernel on the device's stream.
    ///
    /// # Safety
    /// The addresses in `args` are those of memory that the kernels may access until they have ended.
    unsafe fn start(&self, function: &CudaFunction, blocks: u32, shared_bytes: u32, args: &ViewsArgs) -> Result<()> {
        let config =
            LaunchConfig { grid_dim: (blocks, 1, 1), block_dim: (BLOCK_THREADS, 1, 1), shared_mem_bytes: shared_bytes };
        // SAFETY: the kernels' only argument is a `ViewsArgs`; the caller guarantees the addresses.
        unsafe { launch_kernel(&self.device, function, config, LaunchOrder::Serial, args) }
    }

    fn args(&self, vertices: &DeviceVertices<'_>, views: &DeviceViews) -> ViewsArgs {
        let (tables, format) = (&self.tables, &views.format);
        let address = |buffer: &Option<DeviceBuffer>| buffer.as_ref().map_or(0, DeviceBuffer::address);
        let cut_outs = tables.cut_outs.as_ref().map(CutOutBuffers::addresses).unwrap_or_default();
        let [tile_height, tiles_per_view] = tile_layout(format);
        let [color, depth, domains, out_normals] = views.arrays.addresses();
        let chunks_per_turn = tables.chunk_count as u32 / (TURNS_PER_WARP * WARPS_PER_BLOCK);
        ViewsArgs {
            views: views.views.address(),
            cameras: views.cameras.address(),
            positions: vertices.positions.address,
            normals: vertices.normals.address,
            tangents: vertices.tangents.address,
            boxes: address(&views.boxes),
            triangle_vertices: tables.triangle_vertices.address(),
            triangle_corners: tables.triangle_corners.address(),
            triangle_materials: tables.triangle_materials.address(),
            triangle_domains: tables.triangle_domains.address(),
            chunks: tables.chunks.address(),
            materials: tables.materials.address(),
            uvs: tables.uvs.address(),
            cut_out_uvs: cut_outs.uvs,
            cut_out_materials: cut_outs.material_indices,
            alpha_materials: cut_outs.materials,
            color,
            depth,
            domains,
            out_normals,
            vertex_count: tables.vertex_count as u32,
            corner_count: tables.corner_count as u32,
            chunk_count: tables.chunk_count as u32,
            world_count: views.world_count as u32,
            chunks_per_turn: chunks_per_turn.clamp(1, 32),
            width: format.width,
            height: format.height,
            tile_height,
            tiles_per_view,
            first_cut_out: tables.cut_outs.as_ref().map_or(u32::MAX, |cut_outs| cut_outs.first),
            guard_band: [format.width, format.height].map(|side| MAX_VIEWPORT_SIDE as f32 / (0.5 * side as f32)),
            depth_scale: format.depth_scale,
            depth_includes_ground: u32::from(format.depth_includes_ground),
            light: tables.light,
        }
    }
}

impl Drop for CudaViewRenderer {
    fn drop(&mut self) {
        if *self.has_drawn.get_mut() {
            // After a fault the call fails, but then no kernel runs.
            self.device.stream().synchronize().ok();
        }
    }
}

impl SceneTables {
    fn new(device: &Device, scene: &ViewScene, images: &[MipmappedTexture]) -> Result<Self> {
        let handle = |image: Option<u32>| image.map_or(0, |image| images[image as usize].handle());
        let device_material = |material: &ViewMaterial| DeviceMaterial {
            ambient: material.ambient,
            diffuse: material.diffuse,
            specular: material.specular,
            exponent: material.exponent,
            color_image: handle(material.color_image),
            normal_image: handle(material.normal_image),
        };
        let materials: Vec<DeviceMaterial> = scene.materials.iter().map(device_material).collect();
        let chunks = triangle_chunks(scene);
        Ok(Self {
            triangle_vertices: DeviceBuffer::upload(device, scene.triangle_vertices.as_flattened())?,
            triangle_corners: DeviceBuffer::upload(device, scene.triangle_corners.as_flattened())?,
            triangle_materials: DeviceBuffer::upload(device, &scene.triangle_materials)?,
            triangle_domains: DeviceBuffer::upload(device, &scene.triangle_domains)?,
            chunks: DeviceBuffer::upload(device, &chunks)?,
            materials: DeviceBuffer::upload(device, &materials)?,
            uvs: DeviceBuffer::upload(device, scene.uvs.as_flattened())?,
            cut_outs: scene.cut_outs.as_ref().map(|cut_outs| CutOutBuffers::new(device, cut_outs)).transpose()?,
            vertex_count: scene.vertices,
            corner_count: scene.corners,
            chunk_count: chunks.len(),
            has_normal_maps: scene.has_normal_maps(),
            light: scene.light,
        })
    }
}

/// Macros of the features that a scene uses.
fn defines(scene: &ViewScene) -> Vec<&'static str> {
    let has_images = !scene.images.is_empty();
    [(scene.cut_outs.is_some(), "CUT_OUTS"), (has_images, "TEXTURES"), (scene.has_normal_maps(), "NORMAL_MAPS")]
        .into_iter()
        .filter_map(|(is_used, name)| is_used.then_some(name))
        .collect()
}

/// Height of the tiles, and their number per view. A tile is a strip of rows, so that its output is contiguous.
fn tile_layout(format: &ViewFormat) -> [u32; 2] {
    let max_rows = (MAX_TILE_PIXELS / format.width).max(1);
    let tile_height = format.height.div_ceil(format.height.div_ceil(max_rows));
    [tile_height, format.height.div_ceil(tile_height)]
}

/// Divides the groups, and the cut-outs among them, into chunks.
fn triangle_chunks(scene: &ViewScene) -> Vec<TriangleChunk> {
    let first_cut_out = scene.cut_outs.as_ref().map_or(u32::MAX, |cut_outs| cut_outs.first);
    let mut chunks = Vec::new();
    for group in &scene.groups {
        let (mut first, end) = (group.first_triangle, group.first_triangle + group.triangle_count);
        while first < end {
            let limit = if first < first_cut_out { end.min(first_cut_out) } else { end };
            let count = CHUNK_TRIANGLES.min(limit - first);
            let culls_back_faces = u32::from(group.cull_mode == CullMode::Back);
            chunks.push(TriangleChunk { first_triangle: first, triangle_count: count, culls_back_faces, pad: 0 });
            first += count;
        }
    }
    chunks
}
