//! Compiles kernels for tests and reads the report of the assembler. Needs no device.

#![allow(clippy::expect_used, clippy::panic, reason = "a test may fail")]

use super::nvrtc::{CompileJob, nvrtc};

/// Machine code of one variant of a kernel, and the log of the assembler.
#[derive(Debug)]
pub struct CompiledVariant {
    pub cubin: Vec<u8>,
    pub log: String,
}

impl CompiledVariant {
    /// Compiles a source with macros and requests the assembler's report of registers.
    pub fn new(name: &str, source: &str, defines: &[&str], capability: (i32, i32)) -> Self {
        let mut job = CompileJob::new(name, source, defines, capability);
        job.options.push("--ptxas-options=-v".into());
        let (cubin, log) = nvrtc().expect("NVRTC").compile_with_log(&job).expect("a kernel that compiles");
        assert!(cubin.starts_with(b"\x7fELF"), "expected an ELF file");
        Self { cubin, log }
    }

    /// Bytes of registers that all functions together spill to local memory.
    pub fn spill_bytes(&self) -> usize {
        spill_bytes(&self.log)
    }
}

fn spill_bytes(log: &str) -> usize {
    // Each text but the last one ends with a number of bytes.
    let texts: Vec<&str> = log.split(" bytes spill stores").collect();
    assert!(texts.len() > 1, "expected a report of spills, got: {log}");
    let last_number = |text: &&str| text.rsplit(' ').next().and_then(|word| word.parse::<usize>().ok());
    texts[..texts.len() - 1].iter().map(|text| last_number(text).expect("a number of bytes")).sum()
}

/// Compute capabilities that the tests compile for: the oldest supported one, A100, H100 and H200, and consumer
/// Blackwell.
pub const CAPABILITIES: [(i32, i32); 4] = [(7, 5), (8, 0), (9, 0), (12, 0)];

/// Compiles a source with each list of macros for each capability. Panics when a variant does not compile, lacks one of
/// the `functions` (the first names the program), or spills registers.
pub fn assert_compiles(source: &str, functions: &[&str], variants: &[&[&str]], capabilities: &[(i32, i32)]) {
    for &capability in capabilities {
        for defines in variants {
            let compiled = CompiledVariant::new(functions[0], source, defines, capability);
            for function in functions {
                assert!(compiled.log.contains(&format!("'{function}'")), "expected {function} in: {}", compiled.log);
            }
            assert_eq!(compiled.spill_bytes(), 0, "{defines:?} {capability:?}: {}", compiled.log);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn adds_spills_and_rejects_a_log_without_a_report() {
        let line = |bytes: usize| format!("    0 bytes stack frame, {bytes} bytes spill stores, 9 bytes spill loads\n");
        assert_eq!(spill_bytes(&[line(0), line(24), line(4)].concat()), 28);
        assert_eq!(spill_bytes(&line(0)), 0);
        assert!(std::panic::catch_unwind(|| spill_bytes("compiled")).is_err());
    }
}
