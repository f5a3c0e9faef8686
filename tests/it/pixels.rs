//! Rendered pixels are compared with values that the tests compute. Most tests have a negative control: a changed input
//! that must change the result. The tests run on any EGL driver, including Mesa's llvmpipe.

mod aov;
mod below_ground;
mod contrast;
mod culling;
mod culling_real;
mod depth_range;
mod draw_region;
mod far;
mod far_models;
mod ground;
mod harness;
mod image_sizes;
mod limits;
mod look_presets;
mod mesh_edges;
mod oit;
mod picking;
mod post;
mod raster;
mod raster_backends;
mod shading;
mod shadow;
mod shadow_cache;
mod shadow_extremes;
mod shadow_ground;
mod shadow_layers;
mod shadow_methods;
mod shadow_terminator;
mod snapshots;
mod studio;
mod visibility;
