//! Child processes of the demo: starts them, reads their output, and kills them when dropped.

use std::io::{BufRead as _, BufReader};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};

use modalcast_model::error::{Error, Result, fault, fault_in};

/// Buffered output lines per child. A child that prints more lines blocks until lines are read. The children of a demo
/// print fewer.
const LINE_CAPACITY: usize = 1024;

/// The path of another program of this project, which is in the folder of this executable.
///
/// # Errors
/// `Unavailable` when the program does not exist.
pub(in crate::cli) fn program_path(name: &str) -> Result<PathBuf> {
    let executable = std::env::current_exe().map_err(fault_in("demo"))?;
    let path = executable.with_file_name(name);
    if path.exists() {
        return Ok(path);
    }
    Err(Error::Unavailable {
        what: "program of the demo",
        reason: format!("{} does not exist", path.display()),
        remedy: "Build it with: cargo build --release --workspace --bins".into(),
    })
}

/// A running child process. Dropping it kills the process.
pub(in crate::cli) struct Process {
    name: &'static str,
    child: Child,
    lines: Receiver<String>,
    start_time: Instant,
}

impl Process {
    /// Starts a program, which inherits standard error. `name` is the name of the process in errors.
    pub(in crate::cli) fn start(
        name: &'static str,
        program_path: &PathBuf,
        flags: &[impl AsRef<std::ffi::OsStr>],
    ) -> Result<Self> {
        let mut child = Command::new(program_path)
            .args(flags)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(|error| fault("demo", format!("{}: {error}", program_path.display())))?;
        let (line_sender, lines) = sync_channel(LINE_CAPACITY);
        let output = child.stdout.take().ok_or_else(|| fault("demo", "expected a pipe for standard output"))?;
        std::thread::spawn(move || {
            for line in BufReader::new(output).lines().map_while(std::io::Result::ok) {
                if line_sender.send(line).is_err() {
                    break;
                }
            }
        });
        Ok(Self { name, child, lines, start_time: Instant::now() })
    }

    /// Waits for a line that starts with `prefix`. Returns the rest of the line.
    pub(in crate::cli) fn wait_for(&mut self, prefix: &str, deadline: Instant) -> Result<String> {
        loop {
            let line = self.next_line(deadline, prefix)?;
            if let Some(rest) = line.strip_prefix(prefix) {
                return Ok(rest.trim().to_owned());
            }
        }
    }

    /// Waits until the process exits. Returns its last output line, which must be JSON.
    pub(in crate::cli) fn finish(mut self, deadline: Instant) -> Result<serde_json::Value> {
        let mut last_line = String::new();
        while let Some(line) = self.next_line_or_end(deadline, "the exit")? {
            last_line = line;
        }
        let status = self.child.wait().map_err(fault_in("demo"))?;
        if !status.success() {
            return Err(fault("demo", format!("{} ended with {status}", self.name)));
        }
        serde_json::from_str(&last_line).map_err(|error| {
            fault("demo", format!("{}: expected a line of JSON, got '{last_line}': {error}", self.name))
        })
    }

    /// Sends SIGTERM and waits for at most 15 s. If the process is still running then, dropping it kills it.
    pub(in crate::cli) fn stop(&mut self) {
        if let Some(pid) = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw) {
            kill_process(pid, Signal::TERM).ok(); // Fails only if the process has already exited.
        }
        let deadline = Instant::now() + Duration::from_secs(15);
        while Instant::now() < deadline && matches!(self.child.try_wait(), Ok(None)) {
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Waits for the next output line. `prefix` names the line that the caller waits for, in errors.
    fn next_line(&mut self, deadline: Instant, prefix: &str) -> Result<String> {
        self.next_line_or_end(deadline, &format!("the line '{prefix}'"))?.ok_or_else(|| {
            let status = self.child.wait().map(|status| status.to_string()).unwrap_or_default();
            fault("demo", format!("{} ended with {status} before it printed '{prefix}'", self.name))
        })
    }

    /// Waits for the next output line. Returns `None` when the process has closed its output. `what` names the output
    /// that the caller waits for, in errors.
    fn next_line_or_end(&self, deadline: Instant, what: &str) -> Result<Option<String>> {
        match self.lines.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
            Ok(line) => Ok(Some(line)),
            Err(RecvTimeoutError::Disconnected) => Ok(None),
            Err(RecvTimeoutError::Timeout) => {
                let ms = u64::try_from(self.start_time.elapsed().as_millis()).unwrap_or(u64::MAX);
                Err(Error::Deadline { what: format!("{what} of {}", self.name), ms })
            }
        }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // Killing fails if the process has already exited.
        self.child.kill().ok();
        self.child.wait().ok();
    }
}
