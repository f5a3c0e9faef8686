//! The fuzzer of model files.

#![no_main]

#[path = "../libfuzzer.rs"]
mod libfuzzer;
mod seeds;
mod target;

use std::cell::OnceCell;

pub(crate) use seeds::seeds;
use target::FileTarget;

thread_local! {
    static TARGET: OnceCell<FileTarget> = const { OnceCell::new() };
}

pub(crate) fn run(input: &[u8]) {
    TARGET.with(|target| _ = target.get_or_init(|| FileTarget::new(&libfuzzer::target_name())).run(input));
}
