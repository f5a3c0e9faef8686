//! The `modalcast` binary; see `modalcast --help`.

use std::process::ExitCode;

use modalcast::cli::{EXIT_CODE_OF_LOST_DEVICE, run};

fn main() -> ExitCode {
    let code = run();
    if code == EXIT_CODE_OF_LOST_DEVICE {
        // A thread may be in a call of a driver that never returns. The exit handlers of the driver can then crash, and
        // a supervisor would see a signal in place of the exit code.
        signal_hook::low_level::exit(code.into());
    }
    ExitCode::from(code)
}
