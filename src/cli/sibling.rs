//! Commands that other programs of this project execute: executables in the same folder. They are separate, so that the
//! server is built without benchmarks and recordings.

use std::ffi::OsString;
use std::os::unix::process::CommandExt as _;
use std::path::Path;
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
}

/// Benchmarks.
pub(super) const REPORT: Sibling = Sibling { program: "modalcast-report", package: "modalcast-bench" };

/// Recordings: a client of the server.
pub(super) const RECORD: Sibling = Sibling { program: "modalcast-record", package: "modalcast-recording" };

impl Sibling {
    /// Replaces this process by the program, so that the program receives all signals and sets the exit code. Returns
    /// only if that fails. `command` precedes the arguments.
    pub(super) fn execute(&self, command: Option<&str>, args: &Args) -> Outcome {
        let own_path = std::env::current_exe().map_err(fault_in("program"))?;
        let program_path = own_path.with_file_name(self.program);
        self.check_build(&program_path)?;
        Err(fault_in("program")(Command::new(&program_path).args(command).args(&args.arguments).exec()))
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

    /// `modalcast record` works after the first command of the README.
    #[test]
    fn demo_builds_the_recorder() {
        let demo = include_str!("../../deploy/demo");
        let words: Vec<&str> = demo.split_whitespace().collect();
        assert!(
            words.windows(2).any(|pair| pair == ["-p", RECORD.package]),
            "expected -p {} in deploy/demo",
            RECORD.package
        );
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
