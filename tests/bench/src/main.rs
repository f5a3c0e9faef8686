//! `modalcast-report`: see `modalcast report --help`.

use std::process::ExitCode;

fn main() -> ExitCode {
    ExitCode::from(modalcast_bench::cli::run())
}
