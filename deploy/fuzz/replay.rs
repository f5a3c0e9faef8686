//! Runs targets with their seeds and the inputs that are kept in `corpus` and `crashes`. This happens in another process,
//! so that a panic of any thread ends it and its memory can be measured.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// Set in the other process. The value says what it does.
const ROLE: &str = "MODALCAST_REPLAY";

/// Limit on the memory of the process. The largest image that is decoded takes 512 MiB.
const MAX_MEMORY: u64 = 1 << 30;

/// The body of the test `test`: calls `run` in another process, and checks that this process does not panic and has
/// bounded memory.
pub(crate) fn replay(test: &str, run: impl FnOnce()) {
    if let Ok(role) = std::env::var(ROLE) {
        return play(&role, run);
    }
    let output = start(test, "inputs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    // Two negative controls: a panic of another thread, and memory.
    for role in ["panic", "memory"] {
        assert!(!start(test, role).status.success(), "expected the role '{role}' to fail");
    }
}

/// Runs a test in another process.
fn start(test: &str, role: &str) -> Output {
    Command::new(std::env::current_exe().expect("expected the path of the test"))
        .args(["--exact", test, "--nocapture"])
        .env(ROLE, role)
        .output()
        .expect("expected a process")
}

fn play(role: &str, run: impl FnOnce()) {
    let print_panic = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
        print_panic(info);
        std::process::abort();
    }));
    match role {
        "panic" => {
            std::thread::spawn(|| panic!("intended panic")).join().ok();
        }
        "memory" => {
            std::hint::black_box(vec![1_u8; MAX_MEMORY as usize]);
        }
        _ => run(),
    }
    let memory = peak_memory();
    assert!(memory <= MAX_MEMORY, "expected at most {MAX_MEMORY} bytes of memory, got {memory}");
}

/// The kept inputs of a target. `fuzz` is the folder of this file.
pub(crate) fn kept_inputs(fuzz: &Path, target: &str) -> Vec<Vec<u8>> {
    let list = |kind: &str| -> Vec<PathBuf> {
        let entries = std::fs::read_dir(fuzz.join(kind).join(target)).into_iter().flatten();
        entries.map(|entry| entry.expect("expected a readable folder").path()).collect()
    };
    let read = |path: PathBuf| std::fs::read(path).expect("expected a readable file");
    list("corpus").into_iter().chain(list("crashes")).map(read).collect()
}

/// The largest memory of this process so far, in bytes.
fn peak_memory() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").expect("expected the status of the process");
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).expect("expected VmHWM");
    1024 * line.trim().trim_end_matches(" kB").parse::<u64>().expect("expected a number")
}
