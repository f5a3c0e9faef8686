//! Commands that other programs of this project execute: executables in the same folder. They are separate, so that the
//! server is built without benchmarks, recordings and finite elements.

use std::ffi::OsString;
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::Command;

use modalcast_model::error::{Error, Result, fault_in};

use super::Outcome;

/// Arguments for another program.
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    /// Arguments of the command; --help lists them.
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, value_name = "ARGUMENTS")]
    arguments: Vec<OsString>,
}

/// A program that executes a command.
pub(super) struct Sibling {
    /// File name of the executable.
    program: &'static str,
    /// The package that contains it.
    package: &'static str,
    /// Whether the program must be of the same build. Clients of the server need only the same protocol.
    needs_same_build: bool,
}

/// Benchmarks.
pub(super) const REPORT: Sibling =
    Sibling { program: "modalcast-report", package: "modalcast-bench", needs_same_build: true };

/// Recordings: a client of the server.
pub(super) const RECORD: Sibling =
    Sibling { program: "modalcast-record", package: "modalcast-recording", needs_same_build: true };

/// Short calls: a client of the server.
pub(super) const FETCH: Sibling =
    Sibling { program: "modalcast-fetch", package: "modalcast-client", needs_same_build: false };

/// Modes of surfaces.
pub(super) const MODES: Sibling =
    Sibling { program: "modalcast-modes", package: "modalcast-modes", needs_same_build: true };

impl Sibling {
    /// File name of the executable.
    pub(super) const fn program(&self) -> &'static str {
        self.program
    }

    /// Replaces this process by the program, so that the program receives all signals and sets the exit code. Returns
    /// only if that fails. `command` precedes the arguments.
    pub(super) fn execute(&self, command: Option<&str>, args: &Args) -> Outcome {
        let program_path = self.checked_path()?;
        Err(fault_in("program")(Command::new(&program_path).args(command).args(&args.arguments).exec()))
    }

    /// The path of the program.
    ///
    /// # Errors
    /// `Unavailable` if it is missing or was built from other sources.
    pub(super) fn checked_path(&self) -> Result<PathBuf> {
        let own_path = std::env::current_exe().map_err(fault_in("program"))?;
        let program_path = own_path.with_file_name(self.program);
        if self.needs_same_build {
            self.check_build(&program_path)?;
        }
        Ok(program_path)
    }

    /// Fails if the program is missing or was built from other sources.
    fn check_build(&self, program_path: &Path) -> Result<()> {
        let unavailable = |reason: String| Error::Unavailable {
            what: self.program,
            reason,
            remedy: format!("Build it with `cargo build --release -p {}`", self.package),
        };
        let output = Command::new(program_path).arg("--build").output();
        let output = output.map_err(|error| unavailable(format!("{}: {error}", program_path.display())))?;
        let build = String::from_utf8_lossy(&output.stdout);
        match build.trim() == crate::BUILD {
            true => Ok(()),
            false => Err(unavailable(format!(
                "{}: expected build {}, got '{}'",
                program_path.display(),
                crate::BUILD,
                build.trim()
            ))),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;

    use super::*;

    /// `modalcast record` and `modalcast model` work after `deploy/demo`.
    #[test]
    fn demo_builds_recorder_and_modes() {
        let demo = include_str!("../../deploy/demo");
        let words: Vec<&str> = demo.split_whitespace().collect();
        for package in [RECORD.package, MODES.package] {
            assert!(words.windows(2).any(|pair| pair == ["-p", package]), "expected -p {package} in deploy/demo");
        }
    }

    #[test]
    fn missing_program_or_program_of_another_build_is_an_error() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let program_path = folder.path().join(REPORT.program);
        let error = REPORT.check_build(&program_path).expect_err("expected a missing program").to_string();
        assert!(error.contains("cargo build --release -p modalcast-bench"), "{error}");
        let write_program = |build: &str| {
            std::fs::write(&program_path, format!("#!/bin/sh\necho {build}\n")).expect("expected a written file");
            let permissions = std::fs::Permissions::from_mode(0o755);
            std::fs::set_permissions(&program_path, permissions).expect("expected changed permissions");
        };
        write_program("0123");
        let error = REPORT.check_build(&program_path).expect_err("expected another build").to_string();
        assert!(error.contains("got '0123'"), "{error}");
        write_program(crate::BUILD);
        REPORT.check_build(&program_path).expect("expected the same build");
    }
}
