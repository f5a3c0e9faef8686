//! The fuzzer of calls to the server.

#![no_main]

#[path = "../libfuzzer.rs"]
mod libfuzzer;
mod seeds;
mod target;

use std::cell::OnceCell;

pub(crate) use seeds::seeds;
use target::CallTarget;

thread_local! {
    static TARGET: OnceCell<CallTarget> = const { OnceCell::new() };
}

pub(crate) fn run(input: &[u8]) {
    TARGET.with(|target| _ = target.get_or_init(|| CallTarget::new(&libfuzzer::target_name())).run(input));
}
