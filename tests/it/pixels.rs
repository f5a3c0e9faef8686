//! Pictures against arithmetic, each with a negative control. Runs on whatever EGL gives, Mesa's llvmpipe included.

mod build;
mod far;
mod layers;
mod limits;
mod shading;
mod shadow;
mod snapshots;
mod visibility;
