//! Seeds and kept inputs of the fuzzers of model files and steps neither cause a panic nor use much memory.

#[path = "../replay.rs"]
mod replay;
mod seeds;
#[path = "../steps/target.rs"]
mod step_target;
mod target;

use std::path::Path;

use step_target::StepTarget;
use target::{FileTarget, TARGETS};

#[test]
fn kept_files_neither_panic_nor_use_much_memory() {
    let fuzz = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../deploy/fuzz");
    replay::replay("kept_files_neither_panic_nor_use_much_memory", || {
        for name in TARGETS {
            eprintln!("{name}");
            let target = FileTarget::new(name);
            for (index, seed) in seeds::seeds(name).iter().enumerate() {
                assert!(target.run(seed), "expected seed {index} of {name} to open");
            }
            replay::kept_inputs(&fuzz, name).iter().for_each(|input| _ = target.run(input));
        }
    });
}

#[test]
fn kept_steps_neither_panic_nor_use_much_memory() {
    let fuzz = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../deploy/fuzz");
    replay::replay("kept_steps_neither_panic_nor_use_much_memory", || {
        let target = StepTarget::new();
        for (index, seed) in step_target::seeds("step").iter().enumerate() {
            assert!(target.run(seed), "expected seed {index} to be valid");
        }
        replay::kept_inputs(&fuzz, "step").iter().for_each(|input| _ = target.run(input));
    });
}
