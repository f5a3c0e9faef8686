//! The benchmarks on a real device. Everything that needs one is ignored without it; run with
//! `--include-ignored --test-threads=1`. The binary needs no build tree.

#[expect(dead_code, reason = "shared with the tests of the deformer")]
#[path = "../../../gpu/judge.rs"]
mod judge;
mod raster;
mod report;
#[path = "../../../gpu/scenes.rs"]
mod scenes;
#[path = "../../../both/soups.rs"]
mod soups;
mod trials;
