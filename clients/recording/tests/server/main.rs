//! Recordings of a real server, which draws with a software renderer.

mod exports;
mod harness;
mod programs;
mod replays;
