//! The CUDA deformer compared with its f64 twin on a real device. Tests that need a device are ignored by default; run
//! them with `--include-ignored --test-threads=1`. The binary needs no build tree; real inputs come from
//! MODALCAST_DATA.

mod accuracy;
mod batch;
#[path = "../both/mod.rs"]
mod both;
mod device;
#[expect(dead_code, reason = "shared with the benchmarks")]
mod ensembles;
mod extremes;
mod gl;
mod interop;
mod light;
mod normals;
mod overlap;
mod raster_backends;
mod raster_gl;
mod real;
mod scenes;
mod stability;
mod twins;
