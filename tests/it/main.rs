//! Tests that need no GPU, in one binary. The tests that render need an EGL driver; a software driver is enough.

mod array_uploads;
mod attribute_streams;
mod broken_streams;
mod budgets;
mod bulk_steps;
#[path = "../common/mod.rs"]
mod common;
mod cpu_checks;
mod cut_outs;
mod deformers;
mod descriptions;
mod error_reasons;
mod far;
mod following;
mod forces;
mod frames;
mod import_cycles;
mod invalid_input;
mod layering;
mod light;
mod message_streams;
mod moved_cameras;
mod normals;
mod picks;
mod pictures;
mod pixels;
mod raster;
mod real;
mod restart;
#[path = "../gpu/scenes.rs"]
mod scenes;
mod server_process;
mod service;
mod service_faults;
mod service_files;
mod service_harness;
mod shared_memory;
mod shared_memory_faults;
mod states;
mod steps;
mod storages;
mod stream_settings;
mod streams;
mod tolerance;
mod unix_sockets;
mod writers;
