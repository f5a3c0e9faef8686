//! Pictures against arithmetic, each with a negative control. Runs on whatever EGL gives, Mesa's llvmpipe included.

mod below_ground;
mod beside;
mod build;
mod culling;
mod culling_real;
mod far;
mod ground;
mod layers;
mod limits;
mod picking;
mod post;
mod raster;
mod reach;
mod shading;
mod shadow;
mod shadow_extremes;
mod shadow_ground;
mod shadow_methods;
mod shadow_shared;
mod snapshots;
mod surveys;
mod visibility;
