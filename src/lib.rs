//! modalcast owns deformable objects: each domain is a mesh with a modal matrix U. A physics process elsewhere sends
//! reduced coordinates q and transforms T; the server computes
//!
//! ```text
//! x = T (x0 + U q)
//! ```
//!
//! renders headless and streams frames or vertices back.
//!
//! # Modules
//! A test (`tests/it/layering.rs`) reads this table: a module uses only what its row names, and no arrow points up.
//!
//! | module | what lives here | may use |
//! |---|---|---|
//! | `cli` | the command line: one file per command | `config`, `service`, `report`, `engine`, `gpu`, `cpu`, `reference`, `render`, `frame`, `load`, `tree`, `deform`, `scene`, `domain`, `telemetry`, `error` |
//! | `service` | gRPC: wire to values and back; the only module that names proto | `config`, `engine`, `deform`, `scene`, `domain`, `telemetry`, `error` |
//! | `report` | error against run time: synthetic scenes, errors by source, timing, tables and plots | `gpu`, `cpu`, `reference`, `render`, `load`, `deform`, `raster`, `storage`, `scene`, `domain`, `error` |
//! | `engine` | the device thread, scenes by name, admission, subscribers, what survives a restart | `config`, `gpu`, `cpu`, `reference`, `render`, `frame`, `load`, `deform`, `raster`, `scene`, `domain`, `telemetry`, `error` |
//! | `gpu` | CUDA: one launcher per kernel, with the kernel's name | `storage`, `deform`, `raster`, `scene`, `domain`, `error` |
//! | `cpu` | the f32 deformer of machines without a GPU | `storage`, `deform`, `scene`, `domain`, `error` |
//! | `reference` | the same in f64, plain: the definition that the others are tested against | `deform`, `raster`, `scene`, `domain`, `error` |
//! | `render` | EGL and OpenGL: buffers, passes, readback | `deform`, `raster`, `scene`, `domain`, `error` |
//! | `frame` | pixels and numbers to bytes, colour maps with their legends; pure functions | `error` |
//! | `load` | files to scenes: OBJ, glTF, Vega, NumPy, safetensors, SOFA, plants, `scene.toml`; the repository | `tree`, `scene`, `domain`, `error` |
//! | `tree` | the built-in scene: beams to modes, modes to skin | `scene`, `domain`, `error` |
//! | `deform` | what every deformer does, as a trait | `scene`, `error` |
//! | `raster` | what draws into samples beside OpenGL, as a trait | `scene`, `error` |
//! | `storage` | U in tiles as cpu and gpu read it: storage types, a-priori bounds, mode truncation; pure | `scene`, `domain`, `error` |
//! | `scene` | the set of domains, its packing and needs; one step as values; cameras | `domain`, `error` |
//! | `domain` | mesh, modes U, material, texture; parsed once, immutable | `error` |
//! | `telemetry` | stage names and times, tracing | `error` |
//! | `config` | every limit and path, validated once | `error` |
//! | `error` | what can go wrong, sorted by who can act | |
//!
//! # Invariants
//! 1. No arrow points up.
//! 2. No proto type below `service`.
//! 3. No GL or CUDA call off the device thread.
//! 4. Every channel is bounded and says what it does when full.
//! 5. No kernel without a launcher of its name and a twin: of its name too, unless the test's table names another.
//! 6. Behind the constructors of `domain` and `scene` no length, index or float is checked again.
//! 7. Nothing below `engine` knows of streams or sessions.
//! 8. Nothing panics on input.

#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout))]

pub mod cli;
pub mod config;
pub mod cpu;
pub mod deform;
pub mod domain;
pub mod engine;
pub mod error;
pub mod frame;
pub mod gpu;
pub mod load;
pub mod raster;
pub mod reference;
pub mod render;
pub mod report;
pub mod scene;
pub mod service;
pub mod storage;
pub mod telemetry;
pub mod tree;
