//! Seeds and kept inputs of the fuzzer of calls cause neither a panic of the server nor leftovers, and use little memory.

#[path = "../../deploy/fuzz/replay.rs"]
pub(crate) mod replay;
#[path = "../../deploy/fuzz/calls/seeds.rs"]
mod seeds;
#[path = "../../deploy/fuzz/calls/target.rs"]
mod target;

use std::path::Path;

use target::{CallTarget, TARGETS};

#[test]
fn kept_calls_neither_panic_nor_use_much_memory() {
    let fuzz = Path::new(env!("CARGO_MANIFEST_DIR")).join("deploy/fuzz");
    replay::replay("kept_calls::kept_calls_neither_panic_nor_use_much_memory", || {
        for name in TARGETS {
            eprintln!("{name}");
            let target = CallTarget::new(name);
            let run_seeds = || {
                for (index, seed) in seeds::seeds(name).iter().enumerate() {
                    assert!(target.run(seed), "expected seed {index} of {name} to be accepted");
                }
            };
            run_seeds();
            replay::kept_inputs(&fuzz, name).iter().for_each(|input| _ = target.run(input));
            // No input has taken a place or a name.
            run_seeds();
        }
    });
}
