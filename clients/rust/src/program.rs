//! Entry point, exit codes and options that the programs of the clients share.

mod picture_options;

use std::fmt::Display;
use std::process::ExitCode;

use crate::error::Error;
pub use picture_options::PictureOptions;

/// The exit code of a program that cannot use a local file or another local resource.
const LOCAL_ERROR: u8 = 4;

/// Runs the main task of a program on a new multi-threaded runtime and returns its exit code. Prints an error as
/// `name: error` on standard error and maps it to an exit code with `exit_code_of`.
pub fn run<E: Display>(
    name: &str,
    main: impl Future<Output = Result<u8, E>>,
    exit_code_of: impl FnOnce(&E) -> u8,
) -> ExitCode {
    let runtime = match tokio::runtime::Builder::new_multi_thread().enable_all().build() {
        Ok(runtime) => runtime,
        Err(error) => {
            eprintln!("{name}: cannot start the async runtime: {error}");
            return ExitCode::from(LOCAL_ERROR);
        }
    };
    let code = runtime.block_on(main).unwrap_or_else(|error| {
        eprintln!("{name}: {error}");
        exit_code_of(&error)
    });
    ExitCode::from(code)
}

/// Maps an error of the client to an exit code:
/// - 1: the server rejected the request, or a step is too large to be encoded as one message
/// - 3: the connection failed or was lost, the server's certificate is not accepted, or the server has another protocol
///   version
/// - 4: a local file cannot be read or written
/// - 5: a reply is malformed, truncated or late
pub const fn exit_code(error: &Error) -> u8 {
    match error {
        Error::Connect { .. }
        | Error::Certificate { .. }
        | Error::ProtocolVersion { .. }
        | Error::Status { code: tonic::Code::Unavailable, .. } => 3,
        Error::Status { .. } | Error::Rejected(_) | Error::Step { .. } => 1,
        Error::File { .. } => LOCAL_ERROR,
        Error::Malformed { .. } | Error::StreamEnded { .. } | Error::Deadline { .. } => 5,
    }
}
