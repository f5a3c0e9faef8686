//! The fuzzer of credentials and of messages of browsers.

#![no_main]

#[path = "../libfuzzer.rs"]
mod libfuzzer;
mod target;

use std::cell::OnceCell;

use target::CredentialTarget;

pub(crate) use target::seeds;

thread_local! {
    static TARGET: OnceCell<CredentialTarget> = const { OnceCell::new() };
}

pub(crate) fn run(input: &[u8]) {
    TARGET.with(|target| _ = target.get_or_init(|| CredentialTarget::new(&libfuzzer::target_name())).run(input));
}
