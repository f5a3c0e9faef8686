//! modalcast is a server for modal deformable objects. A scene consists of domains. Each domain is a mesh with a modal
//! matrix U. A separate physics process sends reduced coordinates q and transforms T, and the server computes
//!
//! ```text
//! x = T (x0 + U q)
//! ```
//!
//! for the rest position x0 of every vertex, renders without a display and streams frames or vertices to clients.
//!
//! # Crates
//! Cargo enforces the tiers: a crate depends only on the crates below it in this table.
//!
//! | crate | contents | depends on |
//! |---|---|---|
//! | `modalcast` (`src`) | the server: gRPC services, engine, command line | `modalcast-compute`, `modalcast-render`, `modalcast-model`, `modalcast-proto` |
//! | `modalcast-compute` (`src/compute`) | deformers for CUDA and the CPU, and an f64 reference; exports its kernels | `modalcast-model` |
//! | `modalcast-render` (`src/render`) | the renderer: EGL and OpenGL buffers, passes and readback | `modalcast-model` |
//! | `modalcast-model` (`src/model`) | scenes, their file formats, the traits of deformers and rasterizers | `modalcast-beam` |
//! | `modalcast-beam` (`src/beam`) | modes and inertia of beams, for branches and leaves | |
//!
//! Further crates: `proto` (the gRPC contract), `clients/rust`, `clients/dynamics` and `clients/recording` (they use none
//! of the crates in the table; the last one is started by `modalcast record` and `replay`), `clients/modes` (modes of
//! surfaces and volume meshes by finite elements, started by `modalcast model` and `view`; it uses `modalcast-model` for
//! its loaders), and `tests/bench` (all benchmarks, started by `modalcast report`). `clients/python` is a client in Python.
//!
//! # Modules
//! A test (`tests/it/layering.rs`) reads this table. It checks that a module uses only the modules in its row and that
//! there is no cycle.
//!
//! | module | contents | may use |
//! |---|---|---|
//! | `modalcast::cli` | the command line: one file per command | `config`, `service`, `engine`, `admission`, `identity`, `frame`, `telemetry` |
//! | `modalcast::service` | gRPC services, and the viewer's page and WebSocket on the same port, over TLS if it is on; health and metrics on a port of their own: convert between wire messages and engine types; the only module that uses the protobuf types | `config`, `engine`, `admission`, `identity`, `telemetry` |
//! | `modalcast::engine` | the device thread, open scenes and who may use them, step queues, subscriptions, worlds of small views, forces, persistent state | `config`, `frame`, `admission`, `identity`, `telemetry` |
//! | `modalcast::admission` | permits for everything that is limited in number, shared between principals and clients | `config`, `identity` |
//! | `modalcast::identity` | principals, their credentials and their roles | |
//! | `modalcast::frame` | PNG and JPEG encoding, color maps with legends; pure functions | |
//! | `modalcast::telemetry` | stage names and times, logging | |
//! | `modalcast::config` | all limits and paths, validated once | |
//! | `modalcast-compute::gpu` | the CUDA deformer, rasterizer, view renderer and PNG encoder, in the three tiers below | `storage` |
//! | `modalcast-compute::gpu::executor` | one launcher per kernel, with the kernel's name; steps in flight, outputs, readbacks, OpenGL interop, PNG files | `tables`, `launch` |
//! | `modalcast-compute::gpu::tables` | device arrays and launch plan of a scene, inputs of a step, strips of a PNG; pure functions | `launch` |
//! | `modalcast-compute::gpu::launch` | access to a CUDA device: context, memory, compilation, launches, graphs | |
//! | `modalcast-compute::cpu` | the f32 deformer for machines without a GPU | `storage` |
//! | `modalcast-compute::reference` | the f64 reference deformer, rasterizer and view renderer, which the others are tested against | |
//! | `modalcast-compute::storage` | tiled storage of U for CPU and GPU: storage types, a-priori bounds; pure functions | |
//! | `modalcast-render::renderer` | the calls that load scenes and draw them; frames in flight, choice of rasterizers | `passes`, `resources`, `shaders`, `layout`, `uniforms`, `scene_data`, `device`, `pieces`, `region`, `types`, `pass` |
//! | `modalcast-render::view_data` | static data and cameras of batches of small views; pure functions | `resources`, `scene_data`, `uniforms`, `types` |
//! | `modalcast-render::passes` | the commands of each pass (culling, shadow, visibility, transparency, shading, post-processing, picking, AOV), its inputs, outputs and barriers | `resources`, `shaders`, `layout`, `scene_data`, `uniforms`, `device`, `pieces`, `region`, `types`, `pass` |
//! | `modalcast-render::resources` | buffers, textures and programs of a scene, images of a frame | `shaders`, `plan`, `layout`, `scene_data`, `device`, `pieces`, `region`, `types` |
//! | `modalcast-render::shaders` | shader sources, specialized to the features of a scene | `plan`, `layout`, `scene_data`, `device`, `types` |
//! | `modalcast-render::plan` | buffers, passes and shader features of a scene; pure functions | `layout`, `scene_data`, `uniforms`, `device`, `types`, `pass` |
//! | `modalcast-render::layout` | host structs that mirror GLSL blocks; texture units and bindings | `scene_data`, `types` |
//! | `modalcast-render::scene_data` | draw groups, index lists and texture levels, computed on the host | |
//! | `modalcast-render::uniforms` | uniforms of a frame: camera, shadow map, cascades | `types` |
//! | `modalcast-render::device` | EGL and OpenGL: contexts, typed objects, readback ring; the only module that calls OpenGL | `pieces`, `region`, `types` |
//! | `modalcast-render::pieces` | parts of an output that are drawn without a break, sized by measured times; pure functions | |
//! | `modalcast-render::region` | rectangles of a frame that are drawn or cleared | |
//! | `modalcast-render::types` | parameters and results of the renderer | `pass` |
//! | `modalcast-render::pass` | names of the passes and stages, and their times | |
//! | `modalcast-model::load` | scene loaders: OBJ, glTF, PLY, STL, Vega, NumPy, safetensors, SOFA, plants with one object per organ and their modes, `scene.toml`; the scene repository (a folder of scene sources) | `tree`, `beam_shape`, `backend_settings`, `scene`, `domain`, `memory`, `rounding`, `escaping`, `error` |
//! | `modalcast-model::tree` | the built-in scene: a tree of beams, and the surface mesh that they deform | `beam_shape`, `scene`, `domain`, `error` |
//! | `modalcast-model::beam_shape` | meshes that follow the sections of beams, and the inertia of beams | `domain`, `error` |
//! | `modalcast-model::deform` | the trait of deformers | `scene`, `shared_memory`, `error` |
//! | `modalcast-model::raster` | the trait of compute rasterizers, which replace OpenGL in selected passes | `scene`, `shared_memory`, `error` |
//! | `modalcast-model::views` | batches of small views: scene, cameras and outputs as plain data | `raster`, `scene`, `error` |
//! | `modalcast-model::shared_memory` | the traits of device memory that OpenGL and CUDA share, and of its copies to the host | `error` |
//! | `modalcast-model::backend_settings` | settings of deformers and rasterizers, which are not part of a scene | `scene` |
//! | `modalcast-model::scene` | the set of domains, its memory layout and feature set; steps; cameras | `domain`, `rounding`, `escaping`, `error` |
//! | `modalcast-model::domain` | mesh, modes U, material, texture; validated once, immutable | `memory`, `escaping`, `error` |
//! | `modalcast-model::memory` | budgets of memory, which scenes reserve before they allocate | `error` |
//! | `modalcast-model::fault_injection` | planned faults of devices, for tests of the recovery; empty without the feature `fault-injection` | `error` |
//! | `modalcast-model::rounding` | numbers in messages | |
//! | `modalcast-model::escaping` | texts of files and clients in messages | |
//! | `modalcast-model::error` | the error type, with variants for errors of the caller, of the operator and of the server | |
//! | `modalcast-beam::similarity` | rotated and scaled copies of beams | `beam`, `profile`, `inertia`, `station` |
//! | `modalcast-beam::polyline` | beams along polylines with radii | `beam`, `station`, `profile`, `error` |
//! | `modalcast-beam::beam` | the modes of a clamped beam that carries rigid bodies, and its inertia | `element`, `band`, `inertia`, `station`, `profile`, `frame_model`, `error` |
//! | `modalcast-beam::element` | stiffness and mass of one element | `inertia`, `profile` |
//! | `modalcast-beam::frame_model` | an independent model of a beam, for tests | `inertia`, `profile` |
//! | `modalcast-beam::band` | symmetric band matrices | |
//! | `modalcast-beam::inertia` | the inertia of a rigid body | |
//! | `modalcast-beam::station` | positions along a beam | |
//! | `modalcast-beam::profile` | cross sections and materials | |
//! | `modalcast-beam::error` | the error type of the beams | |
//!
//! # Invariants
//! 1. No module or crate depends on a higher tier.
//! 2. Only `service` uses protobuf types.
//! 3. In the server, OpenGL and CUDA are called on the device thread only. Exceptions: another thread prepares a deformer,
//!    and the last reader of a picture may free its pinned memory.
//! 4. Every channel is bounded, and its documentation states what happens when it is full.
//! 5. Every kernel has a launcher of the same name and a CPU twin. The twin has the same name unless the table in
//!    `tests/it/layering.rs` names another one.
//! 6. The constructors of `domain` and `scene` validate every length, index and float. Later code relies on that.
//! 7. Nothing below `engine` depends on streams or sessions.
//! 8. No input causes a panic.

#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout))]

#[cfg(test)]
#[path = "../tests/common/hang_guard.rs"]
mod hang_guard;

pub mod admission;
pub mod cli;
pub mod config;
pub mod engine;
pub mod frame;
pub mod identity;
pub mod service;
pub mod telemetry;

/// Hash of all sources that this program was built from; 16 hexadecimal digits.
pub const BUILD: &str = env!("MODALCAST_BUILD");
