//! `modalcast report`: starts `modalcast-report`, an executable in the same folder. It is separate, so that the server
//! is built without the benchmarks.

use std::ffi::OsString;
use std::path::Path;
use std::process::Command;

use modalcast_model::error::{Error, Result, fault_in};

use super::Outcome;

/// File name of the executable with the benchmarks.
const PROGRAM: &str = "modalcast-report";

const EXAMPLES: &str = "Examples:
  modalcast report --help
  modalcast report deform --out report --quick
  modalcast report render --out report --quick
  modalcast report stream --out report --quick";

/// Measures error against run time on this machine and writes tables and plots.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, disable_help_flag = true)]
pub(super) struct Args {
    /// Arguments for modalcast-report.
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, value_name = "ARGUMENTS")]
    arguments: Vec<OsString>,
}

pub(super) fn run(args: &Args) -> Outcome {
    let own_path = std::env::current_exe().map_err(fault_in("report"))?;
    let program_path = own_path.with_file_name(PROGRAM);
    check_build(&program_path)?;
    let status = Command::new(&program_path).args(&args.arguments).status().map_err(fault_in("report"))?;
    // `modalcast-report` uses the same exit codes. It has none if a signal ended it, which is a fault: 6.
    std::process::exit(status.code().unwrap_or(6));
}

/// Fails if the program is missing or was built from other sources, because it would then not measure this server.
fn check_build(program_path: &Path) -> Result<()> {
    let unavailable = |reason: String| Error::Unavailable {
        what: PROGRAM,
        reason,
        remedy: "Build it with `cargo build --release -p modalcast-bench`".into(),
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

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;

    use super::*;

    #[test]
    fn missing_program_or_program_of_another_build_is_an_error() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let program_path = folder.path().join(PROGRAM);
        let error = check_build(&program_path).expect_err("expected a missing program").to_string();
        assert!(error.contains("cargo build --release -p modalcast-bench"), "{error}");
        let write_program = |build: &str| {
            std::fs::write(&program_path, format!("#!/bin/sh\necho {build}\n")).expect("expected a written file");
            let permissions = std::fs::Permissions::from_mode(0o755);
            std::fs::set_permissions(&program_path, permissions).expect("expected changed permissions");
        };
        write_program("0123");
        let error = check_build(&program_path).expect_err("expected another build").to_string();
        assert!(error.contains("got '0123'"), "{error}");
        write_program(crate::BUILD);
        check_build(&program_path).expect("expected the same build");
    }
}
