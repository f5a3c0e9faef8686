//! What NVRTC and its assembler make of a kernel, for tests: it needs no device.

#![allow(clippy::expect_used, clippy::panic, reason = "a test may fail")]

use super::nvrtc::{CompileJob, nvrtc};

/// Machine code of one variant of a kernel, and the log of the assembler.
#[derive(Debug)]
pub struct CompiledVariant {
    pub cubin: Vec<u8>,
    pub log: String,
}

impl CompiledVariant {
    /// Compiles a source with macros and asks for what the assembler says of registers.
    pub fn new(name: &str, source: &str, defines: &[&str], capability: (i32, i32)) -> Self {
        let mut job = CompileJob::new(name, source, defines, capability);
        job.options.push("--ptxas-options=-v".into());
        let (cubin, log) = nvrtc().expect("NVRTC").compile_with_log(&job).expect("compiles");
        assert!(cubin.starts_with(b"\x7fELF"), "machine code is an ELF file");
        Self { cubin, log }
    }

    /// Bytes that all functions together store for want of registers.
    pub fn spill_bytes(&self) -> usize {
        spill_bytes(&self.log)
    }
}

fn spill_bytes(log: &str) -> usize {
    let stores: Vec<&str> = log.split(" bytes spill stores").collect();
    assert!(stores.len() > 1, "the assembler says what it spills: {log}");
    let number = |before: &&str| before.rsplit(' ').next().and_then(|word| word.parse::<usize>().ok());
    stores[..stores.len() - 1].iter().map(|before| number(before).expect("a number")).sum()
}

/// Compute capabilities that the tests compile for: the oldest supported one, A100, H100 and H200, and consumer Blackwell.
pub const CAPABILITIES: [(i32, i32); 4] = [(7, 5), (8, 0), (9, 0), (12, 0)];

/// Compiles a source with each list of macros for each capability. Panics when a variant does not compile, lacks one of
/// the `functions` (the first names the program), or spills registers.
pub fn assert_compiles(source: &str, functions: &[&str], variants: &[&[&str]], capabilities: &[(i32, i32)]) {
    for &capability in capabilities {
        for defines in variants {
            let compiled = CompiledVariant::new(functions[0], source, defines, capability);
            for function in functions {
                assert!(compiled.log.contains(&format!("'{function}'")), "{function} is not in: {}", compiled.log);
            }
            assert_eq!(compiled.spill_bytes(), 0, "{defines:?} {capability:?}: {}", compiled.log);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spills_of_all_functions_are_added_and_a_log_without_them_is_no_proof() {
        let line = |bytes: usize| format!("    0 bytes stack frame, {bytes} bytes spill stores, 9 bytes spill loads\n");
        assert_eq!(spill_bytes(&[line(0), line(24), line(4)].concat()), 28);
        assert_eq!(spill_bytes(&line(0)), 0);
        assert!(std::panic::catch_unwind(|| spill_bytes("compiled")).is_err());
    }
}
