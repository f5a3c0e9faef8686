//! `modalcast report`: starts `modalcast-report`, a separate executable in the same folder, so that the server is built
//! without its benchmarks.

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
  modalcast report render --out report --quick";

/// Measures error against run time on this machine and writes tables and plots.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, disable_help_flag = true)]
pub(super) struct Args {
    /// Arguments for modalcast-report.
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, value_name = "ARGUMENTS")]
    arguments: Vec<OsString>,
}

pub(super) fn run(args: &Args) -> Outcome {
    let own = std::env::current_exe().map_err(fault_in("report"))?;
    let program = own.with_file_name(PROGRAM);
    check_build(&program)?;
    let status = Command::new(&program).args(&args.arguments).status().map_err(fault_in("report"))?;
    // `modalcast-report` uses the same exit codes.
    std::process::exit(status.code().unwrap_or(6));
}

/// Rejects a program that is missing or was built from other sources, because it would not measure this server.
fn check_build(program: &Path) -> Result<()> {
    let refusal = |reason: String| Error::Unavailable {
        what: PROGRAM,
        reason,
        remedy: "Build it with `cargo build --release -p modalcast-bench`".into(),
    };
    let output = Command::new(program).arg("--build").output();
    let output = output.map_err(|error| refusal(format!("{}: {error}", program.display())))?;
    let build = String::from_utf8_lossy(&output.stdout);
    match build.trim() == crate::BUILD {
        true => Ok(()),
        false => {
            Err(refusal(format!("{}: expected build {}, got '{}'", program.display(), crate::BUILD, build.trim())))
        }
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;

    use super::*;

    #[test]
    fn a_missing_sibling_and_one_of_another_build_are_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let program = folder.path().join(PROGRAM);
        let missing = check_build(&program).expect_err("missing").to_string();
        assert!(missing.contains("cargo build --release -p modalcast-bench"), "{missing}");
        let write = |build: &str| {
            std::fs::write(&program, format!("#!/bin/sh\necho {build}\n")).expect("writes");
            std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o755)).expect("permits");
        };
        write("0123");
        let other = check_build(&program).expect_err("another build").to_string();
        assert!(other.contains("got '0123'"), "{other}");
        write(crate::BUILD);
        check_build(&program).expect("the same build");
    }
}
