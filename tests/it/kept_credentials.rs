//! Seeds and kept inputs of the fuzzer of credentials cause no panic of the server, and use little memory.

#[path = "../../deploy/fuzz/credentials/target.rs"]
mod target;

use std::path::Path;

use crate::kept_calls::replay;
use target::{CredentialTarget, TARGETS, seeds};

#[test]
fn kept_credentials_neither_panic_nor_use_much_memory() {
    let fuzz = Path::new(env!("CARGO_MANIFEST_DIR")).join("deploy/fuzz");
    replay::replay("kept_credentials::kept_credentials_neither_panic_nor_use_much_memory", || {
        for name in TARGETS {
            eprintln!("{name}");
            let target = CredentialTarget::new(name);
            replay::kept_inputs(&fuzz, name).iter().for_each(|input| _ = target.run(input));
            // The server knows no session 'a'.
            let expected: &[bool] = if name == "principals" { &[true, true] } else { &[true, false, true] };
            let accepted: Vec<_> = seeds(name).iter().map(|seed| target.run(seed)).collect();
            assert_eq!(accepted, expected, "{name}");
        }
    });
}
