//! Rendered pixels compared with arithmetic; most tests have a negative control. Runs on any EGL driver, including
//! Mesa's llvmpipe.

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
