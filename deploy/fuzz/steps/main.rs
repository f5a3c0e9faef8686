//! The fuzzer of steps.

#![no_main]

#[path = "../libfuzzer.rs"]
mod libfuzzer;
mod target;

use std::cell::OnceCell;

use target::StepTarget;

pub(crate) use target::seeds;

thread_local! {
    static TARGET: OnceCell<StepTarget> = const { OnceCell::new() };
}

pub(crate) fn run(input: &[u8]) {
    TARGET.with(|target| _ = target.get_or_init(StepTarget::new).run(input));
}
