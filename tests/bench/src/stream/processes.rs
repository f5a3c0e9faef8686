//! Child processes of the report: the programs of this project that are in the folder of this executable. A child ends
//! when its [`Process`] is dropped, and also when the report ends for another reason.

use std::collections::VecDeque;
use std::ffi::OsString;
use std::io::{BufRead as _, BufReader, Read};
use std::os::unix::process::CommandExt as _;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rustix::process::{Signal, set_parent_process_death_signal};

use modalcast_model::error::{Error, Result, fault, fault_in};

/// Buffered output lines per child. A child that prints more lines blocks until lines are read.
const LINE_CAPACITY: usize = 1024;

/// Number of lines at the end of a child's standard error that an error of the child contains.
const ERROR_LINES: usize = 20;

/// Longest time to wait for an output line or the end of a child.
pub(super) const PROCESS_TIMEOUT: Duration = Duration::from_secs(180);

/// The programs that the report starts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Program {
    /// `modalcast`, the server.
    Server,
    /// `modalcast-sim`, the physics process.
    Physics,
    /// `modalcast-report`, which is also the viewers, the raw socket and the delaying proxy ([`super::peers`]).
    Report,
}

impl Program {
    const fn file_name(self) -> &'static str {
        match self {
            Self::Server => "modalcast",
            Self::Physics => "modalcast-sim",
            Self::Report => "modalcast-report",
        }
    }

    /// The path of the program.
    ///
    /// # Errors
    /// `Unavailable` when the program does not exist.
    fn path(self) -> Result<PathBuf> {
        let own_path = std::env::current_exe().map_err(fault_in("report"))?;
        let path = own_path.with_file_name(self.file_name());
        match path.exists() {
            true => Ok(path),
            false => Err(Error::Unavailable {
                what: "program of the report",
                reason: format!("{} does not exist", path.display()),
                remedy: "Build it with: cargo build --release --workspace --bins".into(),
            }),
        }
    }
}

/// A running child process. Dropping it kills the process.
pub(super) struct Process {
    /// Name in errors: the program and its role.
    name: String,
    child: Child,
    lines: Receiver<String>,
    /// Reads standard error until it is closed. Returns the last [`ERROR_LINES`] lines.
    error_reader: Option<JoinHandle<VecDeque<String>>>,
}

impl Process {
    /// Starts a program. Must be called on the main thread of the report, because Linux kills the child when the thread
    /// that started it ends.
    ///
    /// # Errors
    /// `Unavailable` when the program does not exist; `Fault` when it cannot be started.
    pub(super) fn start(program: Program, arguments: &[OsString]) -> Result<Self> {
        let path = program.path()?;
        let role = arguments.first().map(|argument| argument.to_string_lossy().into_owned()).unwrap_or_default();
        let mut command = Command::new(&path);
        command.args(arguments);
        Self::spawn(format!("{} {role}", program.file_name()), &mut command)
    }

    /// Starts a command as a child process with this name. Must be called on the main thread of the report, as
    /// [`Self::start`].
    ///
    /// # Errors
    /// `Fault` when the command cannot be started.
    pub(super) fn spawn(name: String, command: &mut Command) -> Result<Self> {
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        // SAFETY: the closure runs in the child between fork and exec. It makes one system call, which is
        // async-signal-safe, and it does not allocate.
        unsafe {
            command.pre_exec(|| Ok(set_parent_process_death_signal(Some(Signal::KILL))?));
        }
        let mut child = command.spawn().map_err(|error| fault("report", format!("{name}: {error}")))?;
        let missing_pipe = || fault("report", "expected pipes for the output of a child process");
        let (output, errors) =
            (child.stdout.take().ok_or_else(missing_pipe)?, child.stderr.take().ok_or_else(missing_pipe)?);
        let (line_sender, lines) = sync_channel(LINE_CAPACITY);
        std::thread::spawn(move || {
            for line in BufReader::new(output).lines().map_while(std::io::Result::ok) {
                if line_sender.send(line).is_err() {
                    break;
                }
            }
        });
        let error_reader = Some(std::thread::spawn(move || read_last_lines(errors)));
        Ok(Self { name, child, lines, error_reader })
    }

    /// Waits for a line that starts with `prefix`. Returns the rest of the line.
    ///
    /// # Errors
    /// `Fault` when the process ends or prints no such line in time.
    pub(super) fn wait_for(&mut self, prefix: &str) -> Result<String> {
        let deadline = Instant::now() + PROCESS_TIMEOUT;
        loop {
            match self.next_line(deadline)? {
                Some(line) if line.starts_with(prefix) => return Ok(line[prefix.len()..].trim().to_owned()),
                Some(_) => {}
                None => return Err(self.failure(&format!("it ended before it printed '{prefix}'"))),
            }
        }
    }

    /// Waits until the process ends. Returns its last output line, which must be JSON.
    ///
    /// # Errors
    /// `Fault` when the process fails, does not end in time, or prints no JSON.
    pub(super) fn finish<T: serde::de::DeserializeOwned>(mut self) -> Result<T> {
        let (deadline, mut last_line) = (Instant::now() + PROCESS_TIMEOUT, String::new());
        while let Some(line) = self.next_line(deadline)? {
            last_line = line;
        }
        let status = self.child.wait().map_err(fault_in("report"))?;
        if !status.success() {
            return Err(self.failure(&format!("it ended with {status}")));
        }
        let parsed = serde_json::from_str(&last_line);
        parsed.map_err(|error| self.failure(&format!("expected a line of JSON, got '{last_line}': {error}")))
    }

    /// The next output line; `None` when the process has closed its output.
    fn next_line(&mut self, deadline: Instant) -> Result<Option<String>> {
        match self.lines.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
            Ok(line) => Ok(Some(line)),
            Err(RecvTimeoutError::Disconnected) => Ok(None),
            Err(RecvTimeoutError::Timeout) => {
                Err(self.failure(&format!("it printed no line within {} s", PROCESS_TIMEOUT.as_secs())))
            }
        }
    }

    /// Waits for the end of the process, at most for a time. Returns whether it has ended.
    pub(super) fn ends_within(&mut self, limit: Duration) -> bool {
        let deadline = Instant::now() + limit;
        loop {
            let has_ended = matches!(self.child.try_wait(), Ok(Some(_)));
            if has_ended || Instant::now() >= deadline {
                return has_ended;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// Ends the process and describes its failure, with the end of its standard error.
    pub(super) fn failure(&mut self, what: &str) -> Error {
        self.kill();
        let lines = self.error_reader.take().and_then(|reader| reader.join().ok()).unwrap_or_default();
        let error_text: String = lines.iter().map(|line| format!("\n  {line}")).collect();
        fault("report", format!("{}: {what}; its standard error ends with:{error_text}", self.name))
    }

    fn kill(&mut self) {
        // Killing fails if the process has already ended.
        self.child.kill().ok();
        self.child.wait().ok();
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        self.kill();
    }
}

fn read_last_lines(errors: impl Read) -> VecDeque<String> {
    let mut last_lines = VecDeque::with_capacity(ERROR_LINES + 1);
    for line in BufReader::new(errors).lines().map_while(std::io::Result::ok) {
        last_lines.push_back(line);
        if last_lines.len() > ERROR_LINES {
            last_lines.pop_front();
        }
    }
    last_lines
}

/// Converts anything that can be an argument of a program.
pub(super) fn arguments<const N: usize>(list: [&dyn AsRef<std::ffi::OsStr>; N]) -> Vec<OsString> {
    list.iter().map(|argument| argument.as_ref().to_owned()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hang_guard::HANG_GUARD;

    fn shell(script: &str) -> Process {
        Process::spawn("shell".into(), Command::new("sh").args(["-c", script])).expect("expected a shell")
    }

    #[test]
    fn returns_the_awaited_line_and_the_last_line_as_json() {
        let mut process = shell("echo start; echo 'port 7'; echo '{\"a\": 1}'");
        assert_eq!(process.wait_for("port").expect("expected the line"), "7");
        let value: serde_json::Value = process.finish().expect("expected JSON");
        assert_eq!(value["a"], 1);
    }

    #[test]
    fn errors_contain_the_end_of_standard_error() {
        let script = "for line in $(seq 100); do echo line $line >&2; done; exit 3";
        let error = shell(script).finish::<serde_json::Value>().expect_err("expected a failure").to_string();
        assert!(error.contains("exit status: 3") && error.contains("line 100"), "{error}");
        assert!(!error.contains("line 80\n"), "expected the last {ERROR_LINES} lines only, got {error}");
        let error = shell("echo cause >&2").wait_for("ready").expect_err("expected a failure").to_string();
        assert!(error.contains("'ready'") && error.contains("cause"), "{error}");
        let error = shell("echo text").finish::<serde_json::Value>().expect_err("expected no JSON").to_string();
        assert!(error.contains("got 'text'"), "{error}");
    }

    /// Linux kills the process as it does when the report itself is killed.
    #[test]
    fn process_ends_with_the_thread_that_started_it() {
        assert!(!shell("sleep 1000").ends_within(Duration::from_millis(50)), "control: this thread goes on");
        let mut process = std::thread::spawn(|| shell("sleep 1000")).join().expect("expected no panic");
        assert!(process.ends_within(HANG_GUARD), "expected the end of the process");
    }

    #[test]
    fn dropping_kills_the_process() {
        let process = shell("echo ready; sleep 1000");
        let folder = format!("/proc/{}", process.child.id());
        assert!(std::path::Path::new(&folder).exists());
        drop(process);
        assert!(!std::path::Path::new(&folder).exists(), "expected no process");
    }
}
