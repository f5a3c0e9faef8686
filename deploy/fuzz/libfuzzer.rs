//! The functions that libFuzzer calls. The fuzzer that includes this file has the functions `seeds` and `run`.

use std::ffi::{c_char, c_int};
use std::path::Path;

/// Called once. A panic of any thread ends the program, which libFuzzer reports as a crash. If `MODALCAST_FUZZ_SEEDS`
/// names a folder, the seeds of the target `MODALCAST_FUZZ_TARGET` are written to it.
#[unsafe(no_mangle)]
extern "C" fn LLVMFuzzerInitialize(_argument_count: *const c_int, _arguments: *const *const *const c_char) -> c_int {
    let print_panic = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
        print_panic(info);
        std::process::abort();
    }));
    if let Ok(folder) = std::env::var("MODALCAST_FUZZ_SEEDS") {
        for (index, seed) in crate::seeds(&target_name()).into_iter().enumerate() {
            std::fs::write(Path::new(&folder).join(format!("seed-{index}")), seed).expect("expected a writable folder");
        }
    }
    0
}

/// Called with every input.
#[unsafe(no_mangle)]
extern "C" fn LLVMFuzzerTestOneInput(data: *const u8, size: usize) -> c_int {
    let input = match size {
        0 => &[][..],
        // SAFETY: libFuzzer passes the address and the size of its buffer, which remains unchanged during this call.
        size => unsafe { std::slice::from_raw_parts(data, size) },
    };
    crate::run(input);
    0
}

/// The target of this process.
pub(crate) fn target_name() -> String {
    std::env::var("MODALCAST_FUZZ_TARGET").unwrap_or_default()
}
