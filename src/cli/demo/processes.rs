//! Child processes of the demo: starts them, reads their output, and kills them when dropped.

use std::io::{BufRead as _, BufReader};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};

use modalcast_model::error::{Error, Result, fault_in};

/// Buffered output lines per child. A child that prints more blocks until lines are read, which is harmless here.
const LINES: usize = 1024;

/// The path of a program of this project in the folder of this executable.
///
/// # Errors
/// `Unavailable` when the program does not exist.
pub(super) fn program_path(name: &str) -> Result<PathBuf> {
    let here = std::env::current_exe().map_err(fault_in("demo"))?;
    let path = here.with_file_name(name);
    if path.exists() {
        return Ok(path);
    }
    Err(Error::Unavailable {
        what: "a program of the demo",
        reason: format!("{} does not exist", path.display()),
        remedy: "Build it with: cargo build --release --workspace --bins".into(),
    })
}

/// A running child process. Dropping it kills the process.
pub(super) struct Process {
    name: &'static str,
    child: Child,
    lines: Receiver<String>,
    begin: Instant,
}

impl Process {
    /// Starts a program; it inherits stderr.
    pub(super) fn start(
        name: &'static str,
        program_path: &PathBuf,
        flags: &[impl AsRef<std::ffi::OsStr>],
    ) -> Result<Self> {
        let mut child = Command::new(program_path)
            .args(flags)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(|error| fault_in("demo")(format!("{}: {error}", program_path.display())))?;
        let (send, lines) = sync_channel(LINES);
        let output = child.stdout.take().ok_or_else(|| fault_in("demo")("no output"))?;
        std::thread::spawn(move || {
            for line in BufReader::new(output).lines().map_while(std::io::Result::ok) {
                if send.send(line).is_err() {
                    break;
                }
            }
        });
        Ok(Self { name, child, lines, begin: Instant::now() })
    }

    /// Waits for a line that starts with `beginning` and returns the rest of it.
    pub(super) fn wait_for(&mut self, beginning: &str, end: Instant) -> Result<String> {
        loop {
            let line = self.next_line(end, beginning)?;
            if let Some(rest) = line.strip_prefix(beginning) {
                return Ok(rest.trim().to_owned());
            }
        }
    }

    /// Waits until the process exits and returns its last output line, which is JSON.
    pub(super) fn finish(mut self, end: Instant) -> Result<serde_json::Value> {
        let mut last = String::new();
        while let Some(line) = self.line_or_end(end, "its end")? {
            last = line;
        }
        let status = self.child.wait().map_err(fault_in("demo"))?;
        if !status.success() {
            return Err(fault_in("demo")(format!("{} ended with {status}", self.name)));
        }
        serde_json::from_str(&last)
            .map_err(|error| fault_in("demo")(format!("{}: expected a line of JSON, got '{last}': {error}", self.name)))
    }

    /// Sends SIGTERM and waits for at most 15 s; dropping the process kills it if it is still running.
    pub(super) fn stop(&mut self) {
        if let Some(pid) = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw) {
            kill_process(pid, Signal::TERM).ok(); // Fails only if it has already exited.
        }
        let end = Instant::now() + Duration::from_secs(15);
        while Instant::now() < end && matches!(self.child.try_wait(), Ok(None)) {
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    fn next_line(&mut self, end: Instant, what: &str) -> Result<String> {
        self.line_or_end(end, what)?.ok_or_else(|| {
            let status = self.child.wait().map(|status| status.to_string()).unwrap_or_default();
            fault_in("demo")(format!("{} ended with {status} before it printed '{what}'", self.name))
        })
    }

    fn line_or_end(&self, end: Instant, what: &str) -> Result<Option<String>> {
        match self.lines.recv_timeout(end.saturating_duration_since(Instant::now())) {
            Ok(line) => Ok(Some(line)),
            Err(RecvTimeoutError::Disconnected) => Ok(None),
            Err(RecvTimeoutError::Timeout) => {
                let ms = u64::try_from(self.begin.elapsed().as_millis()).unwrap_or(u64::MAX);
                Err(Error::Deadline { what: format!("'{what}' of {}", self.name), ms })
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
