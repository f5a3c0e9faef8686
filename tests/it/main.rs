//! Claims that need no GPU. One binary.

mod deformers;
mod layering;
mod pixels;
mod tolerance;
