//! The `modalcast` binary; see `modalcast --help`.

use std::process::ExitCode;

fn main() -> ExitCode {
    ExitCode::from(modalcast::cli::run())
}
