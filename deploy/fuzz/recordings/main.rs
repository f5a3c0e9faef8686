//! The fuzzer of recordings.

#![no_main]

#[path = "../libfuzzer.rs"]
mod libfuzzer;
#[path = "../../../clients/recording/tests/synthetic/mod.rs"]
#[allow(dead_code, reason = "shared with the tests")]
mod synthetic;
mod target;

use std::cell::OnceCell;

use target::RecordingTarget;

thread_local! {
    static TARGET: OnceCell<RecordingTarget> = const { OnceCell::new() };
}

/// Recordings with and without the arrays of the scene.
pub(crate) fn seeds(_target: &str) -> Vec<Vec<u8>> {
    let mut without_arrays = synthetic::begin(Vec::new(), false);
    for step in 0..4 {
        without_arrays.state_chunk(synthetic::state(step, 1)).expect("expected memory");
    }
    vec![synthetic::recording(10, 4), without_arrays.finish().expect("expected memory")]
}

pub(crate) fn run(input: &[u8]) {
    TARGET.with(|target| target.get_or_init(RecordingTarget::new).run(input));
}
