//! modalcast owns deformable objects: each domain is a mesh with a modal matrix U. A physics process elsewhere sends
//! reduced coordinates q and transforms T; the server computes
//!
//! ```text
//! x = T (x0 + U q)
//! ```
//!
//! renders headless and streams frames or vertices back.
//!
//! # Crates
//! Cargo enforces the tiers: a crate sees only the crates below it. Each lies in its folder of `src`.
//!
//! | crate | what it is | built on |
//! |---|---|---|
//! | `modalcast` (`src`) | the server: gRPC, the engine, the command line | `modalcast-compute`, `modalcast-render`, `modalcast-model`, `modalcast-proto` |
//! | `modalcast-compute` (`src/compute`) | deformers in CUDA, on the CPU and in f64; exports the kernels it launches | `modalcast-model` |
//! | `modalcast-render` (`src/render`) | EGL and OpenGL: buffers, passes, readback | `modalcast-model` |
//! | `modalcast-model` (`src/model`) | scenes as values, their files, the traits of deformers and rasterizers | |
//!
//! Beside them: `proto` (the contract), `clients/rust` and `clients/dynamics` (no crate of the server), `tests/bench` (every
//! measurement; `modalcast report` starts its program).
//!
//! # Modules
//! A test (`tests/it/layering.rs`) reads this table: inside of its crate a module uses only what its row names, and the
//! dependencies have no cycle.
//!
//! | module | what lives here | may use |
//! |---|---|---|
//! | `modalcast::cli` | the command line: one file per command | `config`, `service`, `engine`, `frame`, `telemetry` |
//! | `modalcast::service` | gRPC: wire to values and back; the only module that names proto | `config`, `engine`, `telemetry` |
//! | `modalcast::engine` | the device thread, scenes by name, admission, subscribers, what survives a restart | `config`, `frame`, `telemetry` |
//! | `modalcast::frame` | pixels and numbers to bytes, color maps with their legends; pure functions | |
//! | `modalcast::telemetry` | stage names and times, tracing | |
//! | `modalcast::config` | every limit and path, validated once | |
//! | `modalcast-compute::gpu` | CUDA: one launcher per kernel, with the kernel's name | `storage` |
//! | `modalcast-compute::cpu` | the f32 deformer of machines without a GPU | `storage` |
//! | `modalcast-compute::reference` | the same in f64, plain: the definition that the others are tested against | |
//! | `modalcast-compute::storage` | U in tiles as cpu and gpu read it: storage types, a-priori bounds, mode truncation; pure | |
//! | `modalcast-model::load` | files to scenes: OBJ, glTF, Vega, NumPy, safetensors, SOFA, plants, `scene.toml`; the repository | `tree`, `scene`, `domain`, `error` |
//! | `modalcast-model::tree` | the built-in scene: beams to modes, modes to skin | `scene`, `domain`, `error` |
//! | `modalcast-model::deform` | what every deformer does, as a trait | `scene`, `error` |
//! | `modalcast-model::raster` | what draws into samples beside OpenGL, as a trait | `scene`, `error` |
//! | `modalcast-model::scene` | the set of domains, its packing and needs; one step as values; cameras | `domain`, `error` |
//! | `modalcast-model::domain` | mesh, modes U, material, texture; parsed once, immutable | `error` |
//! | `modalcast-model::error` | what can go wrong, sorted by who can act | |
//!
//! # Invariants
//! 1. No dependency points up.
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
pub mod engine;
pub mod frame;
pub mod service;
pub mod telemetry;

/// A hash of all sources that this program was built from.
pub const BUILD: &str = env!("MODALCAST_BUILD");
