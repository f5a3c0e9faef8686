//! GPU tests of the benchmarks. Tests that need a device are ignored by default; run them with `--include-ignored
//! --test-threads=1`. The test binary also runs on a machine without the sources and the build folder.

#[expect(dead_code, reason = "shared with the tests of the deformer")]
#[path = "../../../gpu/accuracy.rs"]
mod accuracy;
mod batch;
mod benchmarks;
#[path = "../../../common/cut_outs.rs"]
mod cut_outs;
#[path = "../../../gpu/instanced_scenes.rs"]
mod instanced_scenes;
mod light;
mod overlap;
mod raster;
mod raster_cut_outs;
mod report;
#[path = "../../../gpu/scenes.rs"]
mod scenes;
#[path = "../../../common/soups.rs"]
mod soups;
mod views;
