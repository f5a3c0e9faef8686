//! Device resources: buffers, textures and programs of a scene, and the images of a frame.

pub(crate) mod compute_rasterizer;
pub(crate) mod cull;
pub(crate) mod depth_pyramid;
pub(crate) mod oit;
pub(crate) mod programs;
pub(crate) mod raster_mesh;
pub(crate) mod scene_buffers;
pub(crate) mod shadow_cache;
pub(crate) mod shadow_map;
pub(crate) mod shared_targets;
pub(crate) mod shared_vertices;
pub(crate) mod target;
pub(crate) mod target_desc;
pub(crate) mod texture_arrays;
