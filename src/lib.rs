//! modalcast is a server for modal deformable objects. A scene consists of domains; each domain is a mesh with a modal
//! matrix U. A separate physics process sends reduced coordinates q and transforms T, and the server computes
//!
//! ```text
//! x = T (x0 + U q)
//! ```
//!
//! for every vertex, renders headless and streams frames or vertices to clients.
//!
//! # Crates
//! Cargo enforces the tiers: a crate depends only on the crates below it in this table.
//!
//! | crate | contents | depends on |
//! |---|---|---|
//! | `modalcast` (`src`) | the server: gRPC services, engine, command line | `modalcast-compute`, `modalcast-render`, `modalcast-model`, `modalcast-proto` |
//! | `modalcast-compute` (`src/compute`) | deformers for CUDA and the CPU, and an f64 reference; exports its kernels | `modalcast-model` |
//! | `modalcast-render` (`src/render`) | the renderer: EGL and OpenGL buffers, passes and readback | `modalcast-model` |
//! | `modalcast-model` (`src/model`) | scenes, their file formats, the traits of deformers and rasterizers | |
//!
//! Further crates: `proto` (the gRPC contract), `clients/rust` and `clients/dynamics` (they use no crate of the
//! server), and `tests/bench` (all benchmarks; `modalcast report` starts its program).
//!
//! # Modules
//! A test (`tests/it/layering.rs`) reads this table. It checks that a module uses only the modules of its crate that
//! its row names, and that the dependencies have no cycle.
//!
//! | module | contents | may use |
//! |---|---|---|
//! | `modalcast::cli` | the command line: one file per command | `config`, `service`, `engine`, `frame`, `telemetry` |
//! | `modalcast::service` | gRPC services: convert between wire messages and values; the only module that uses the protobuf types | `config`, `engine`, `telemetry` |
//! | `modalcast::engine` | the device thread, scenes by name, admission, subscriptions, persistent state | `config`, `frame`, `telemetry` |
//! | `modalcast::frame` | PNG encoding, color maps with legends; pure functions | |
//! | `modalcast::telemetry` | stage names and times, logging | |
//! | `modalcast::config` | all limits and paths, validated once | |
//! | `modalcast-compute::gpu` | the CUDA deformer and rasterizer, in the three tiers below | `storage` |
//! | `modalcast-compute::gpu::executor` | one launcher per kernel, with the kernel's name; steps in flight, outputs, readbacks, interop | `tables`, `launch` |
//! | `modalcast-compute::gpu::tables` | the tables and the plan of a scene, the values of a step; pure functions | `launch` |
//! | `modalcast-compute::gpu::launch` | access to a CUDA device: context, memory, compilation, launches, graphs | |
//! | `modalcast-compute::cpu` | the f32 deformer for machines without a GPU | `storage` |
//! | `modalcast-compute::reference` | the f64 reference deformer, which the others are tested against | |
//! | `modalcast-compute::storage` | tiled storage of U for CPU and GPU: storage types, a-priori bounds, mode truncation; pure functions | |
//! | `modalcast-render::renderer` | the calls that load scenes and draw them; frames in flight, choice of rasterizers | `passes`, `resources`, `shaders`, `layout`, `uniforms`, `device`, `region`, `types`, `pass` |
//! | `modalcast-render::passes` | the commands of each pass (culling, shadow, visibility, transparency, shading, post-processing, picking, AOV), its inputs, outputs and barriers | `resources`, `shaders`, `layout`, `scene_data`, `uniforms`, `device`, `region`, `types`, `pass` |
//! | `modalcast-render::resources` | buffers, textures and programs of a scene, images of a frame | `shaders`, `plan`, `layout`, `scene_data`, `device`, `region`, `types` |
//! | `modalcast-render::shaders` | shader sources, with the branches that a scene needs | `plan`, `layout`, `scene_data`, `device`, `types` |
//! | `modalcast-render::plan` | buffers, passes and shader features of a scene; pure functions | `layout`, `scene_data`, `uniforms`, `device`, `types`, `pass` |
//! | `modalcast-render::layout` | twins of GLSL blocks; texture units and bindings | `scene_data`, `types` |
//! | `modalcast-render::scene_data` | draw groups, index lists and texture levels, computed on the host | |
//! | `modalcast-render::uniforms` | uniforms of a frame: camera, shadow map, cascades | `types` |
//! | `modalcast-render::device` | EGL and OpenGL: contexts, typed objects, readback ring; the only module that calls OpenGL | `region`, `types` |
//! | `modalcast-render::region` | rectangles of a frame that are drawn or cleared | |
//! | `modalcast-render::types` | parameters and results of the renderer | `pass` |
//! | `modalcast-render::pass` | names of the passes and stages, and their times | |
//! | `modalcast-model::load` | scene loaders: OBJ, glTF, Vega, NumPy, safetensors, SOFA, plants, `scene.toml`; the repository | `tree`, `backend_settings`, `scene`, `domain`, `error` |
//! | `modalcast-model::tree` | the built-in scene: a tree of beams, their modes, and the skin they deform | `scene`, `domain`, `error` |
//! | `modalcast-model::deform` | the trait of deformers | `scene`, `error` |
//! | `modalcast-model::raster` | the trait of compute rasterizers, which replace OpenGL in selected passes | `scene`, `error` |
//! | `modalcast-model::backend_settings` | settings of deformers and rasterizers that a scene does not contain | `scene` |
//! | `modalcast-model::scene` | the set of domains, its memory layout and feature set; steps; cameras | `domain`, `error` |
//! | `modalcast-model::domain` | mesh, modes U, material, texture; validated once, immutable | `error` |
//! | `modalcast-model::error` | the error type; its variants distinguish who can act on an error | |
//!
//! # Invariants
//! 1. No module or crate depends on a higher tier.
//! 2. Only `service` uses protobuf types.
//! 3. In the server, OpenGL and CUDA are called on the device thread only.
//! 4. Every channel is bounded, and its documentation states what happens when it is full.
//! 5. Every kernel has a launcher of the same name and a CPU twin. The twin has the same name unless the table in
//!    `tests/it/layering.rs` names another one.
//! 6. The constructors of `domain` and `scene` validate every length, index and float; later code relies on that.
//! 7. Nothing below `engine` depends on streams or sessions.
//! 8. Nothing panics on input.

#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout))]

pub mod cli;
pub mod config;
pub mod engine;
pub mod frame;
pub mod service;
pub mod telemetry;

/// Hash of all sources that this program was built from; 16 hexadecimal digits.
pub const BUILD: &str = env!("MODALCAST_BUILD");
