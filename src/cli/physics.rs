//! The physics process that `modalcast view` starts.

use std::path::Path;
use std::process::{ExitStatus, Stdio};
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};
use tokio::io::{AsyncBufReadExt as _, BufReader, Lines};
use tokio::process::{Child, ChildStderr, Command};
use tokio::sync::oneshot;

use crate::engine::Engine;
use modalcast_model::error::{Result, fault};

/// Time between SIGTERM and SIGKILL.
const EXIT_TIME: Duration = Duration::from_secs(15);

/// Maximum length in characters of the message that viewers receive.
const MAX_MESSAGE_CHARS: usize = 1000;

/// A running physics process. Dropping it kills the process.
pub(super) struct PhysicsProcess {
    /// File name of the program, with which its messages begin.
    name: String,
    child: Child,
    messages: Lines<BufReader<ChildStderr>>,
}

impl PhysicsProcess {
    /// Starts a program.
    pub(super) fn start(program: &Path, flags: &[String]) -> Result<Self> {
        let name = program.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let mut command = Command::new(program);
        command.args(flags).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped()).kill_on_drop(true);
        let start_error = |error| fault("view", format!("{}: {error}", program.display()));
        let mut child = command.spawn().map_err(start_error)?;
        let pipe = child.stderr.take().ok_or_else(|| fault("view", "expected a pipe for standard error"))?;
        Ok(Self { name, child, messages: BufReader::new(pipe).lines() })
    }

    /// Waits until the process has ended, and reports the reason to the viewers of `scene`; or ends it when `stopped`
    /// resolves.
    pub(super) async fn supervise(mut self, engine: Engine, scene: String, stopped: oneshot::Receiver<()>) {
        tokio::select! {
            message = self.wait_for_end() => {
                if let Ok(scene_handle) = engine.find(&scene) {
                    scene_handle.set_receiver_error(&message);
                }
            }
            _ = stopped => self.stop().await,
        }
    }

    /// Prints the messages of the process until it has ended. Returns the last one.
    async fn wait_for_end(&mut self) -> String {
        let mut last_message = String::new();
        while let Ok(Some(line)) = self.messages.next_line().await {
            eprintln!("{line}");
            last_message = line;
        }
        // Reaps the process.
        let status = self.child.wait().await;
        tracing::info!(?status, "{} has ended", self.name);
        end_message(&self.name, status.ok(), &last_message)
    }

    /// Sends SIGTERM, and SIGKILL if the process has not ended in time.
    async fn stop(mut self) {
        let pid = self.child.id().and_then(|id| i32::try_from(id).ok()).and_then(Pid::from_raw);
        if let Some(pid) = pid {
            kill_process(pid, Signal::TERM).ok(); // Fails only if the process has already ended.
        }
        if tokio::time::timeout(EXIT_TIME, self.child.wait()).await.is_err() {
            self.child.kill().await.ok();
        }
    }
}

/// Why a process has ended, for viewers: its last message without the name of the program, or its exit status if it has
/// not failed with a message.
fn end_message(name: &str, status: Option<ExitStatus>, last_message: &str) -> String {
    let message = last_message.strip_prefix(&format!("{name}: ")).unwrap_or(last_message);
    match status {
        Some(status) if status.code().is_none_or(|code| code == 0) || message.is_empty() => {
            format!("{name} has ended ({status})")
        }
        _ => message.chars().take(MAX_MESSAGE_CHARS).collect(),
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::process::ExitStatusExt as _;

    use super::*;

    #[test]
    fn viewers_receive_the_last_message_or_the_status() {
        let code = |code: i32| Some(ExitStatus::from_raw(code << 8));
        let killed = Some(ExitStatus::from_raw(9));
        let message = |status, last_message| end_message("sim", status, last_message);
        assert_eq!(message(code(5), "sim: forces: expected modes"), "forces: expected modes");
        assert_eq!(message(code(7), "panicked"), "panicked");
        let long_message = "x".repeat(2 * MAX_MESSAGE_CHARS);
        assert_eq!(message(code(5), &long_message).len(), MAX_MESSAGE_CHARS);
        // The last message of a process that has not failed, or that a signal has ended, is not the reason.
        assert_eq!(message(code(0), "sim: tree: modes in a wind of 8 m/s"), "sim has ended (exit status: 0)");
        assert_eq!(message(killed, "sim: tree: modes in a wind of 8 m/s"), "sim has ended (signal: 9 (SIGKILL))");
        assert_eq!(message(code(1), ""), "sim has ended (exit status: 1)");
    }
}
