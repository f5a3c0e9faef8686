//! The command line: the commands, one per file, and their exit codes.

mod demo;
mod doctor;
mod inspect;
pub mod options;
mod render;
mod report;
mod serve;
mod view;

use std::io::Write as _;

use clap::{Parser, Subcommand};

use modalcast_model::error::Error;

/// A GPU server for modal deformable objects: x = T (x0 + U q), rendered headless, streamed over gRPC.
#[derive(Debug, Parser)]
#[command(version, arg_required_else_help = true, after_help = EXIT_CODES)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Serve(serve::Args),
    View(view::Args),
    Demo(demo::Args),
    Render(render::Args),
    Report(report::Args),
    Inspect(inspect::Args),
    Doctor(doctor::Args),
}

/// Help text on the exit codes of all commands.
pub const EXIT_CODES: &str = "\
Exit codes:
  0  done
  1  a check failed (doctor: no frame can be drawn; demo: a criterion is not met; report: a variant exceeds its error
     bound)
  2  invalid command line
  3  invalid input; the message names the field, the expected and the given value
  4  not found
  5  a resource or a program is missing or in use; the message names it
  6  error of the server or the device";

/// Result of a command: whether its check passed, or an error. Commands without a check return `true`.
pub type Outcome = modalcast_model::error::Result<bool>;

/// Runs the command line and returns the process's exit code.
pub fn run() -> u8 {
    let cli = Cli::parse();
    crate::telemetry::init_logging();
    let outcome = match cli.command {
        Command::Serve(args) => serve::run(&args),
        Command::View(args) => view::run(&args),
        Command::Demo(args) => demo::run(&args),
        Command::Render(args) => render::run(&args),
        Command::Report(args) => report::run(&args),
        Command::Inspect(args) => inspect::run(&args),
        Command::Doctor(args) => doctor::run(&args),
    };
    finish(outcome)
}

/// Converts an outcome to an exit code. Prints an error on standard error.
pub fn finish(outcome: Outcome) -> u8 {
    match outcome {
        Ok(true) => 0,
        Ok(false) => 1,
        Err(error) => {
            eprintln!("modalcast: {error}");
            exit_code(&error)
        }
    }
}

fn exit_code(error: &Error) -> u8 {
    match error {
        Error::Invalid { .. } | Error::InvalidFile { .. } | Error::UnexpectedMessage { .. } => 3,
        Error::NotFound { .. } | Error::ContentNotFound { .. } | Error::StreamNotFound | Error::StepPassed { .. } => 4,
        Error::NameTaken { .. }
        | Error::LeaseTaken { .. }
        | Error::LeaseLost { .. }
        | Error::WindowFull { .. }
        | Error::Busy { .. }
        | Error::LimitReached { .. }
        | Error::SlowReader { .. }
        | Error::Unavailable { .. }
        | Error::ShuttingDown => 5,
        Error::Deadline { .. } | Error::Fault { .. } | Error::DeviceLost { .. } => 6,
    }
}

/// Prints a line of a command's result on standard output. Nothing else is printed there, so that logs never mix with
/// results.
pub fn print_line(line: impl std::fmt::Display) {
    if let Err(error) = writeln!(std::io::stdout(), "{line}")
        && error.kind() != std::io::ErrorKind::BrokenPipe
    {
        // A closed pipe is normal, for example with `head`. Other errors, such as a full disk, are reported.
        eprintln!("modalcast: standard output: {error}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn command_line_is_valid_and_every_command_has_examples() {
        use clap::CommandFactory as _;
        let mut command = Cli::command();
        command.clone().debug_assert();
        for subcommand in command.get_subcommands_mut() {
            let name = subcommand.get_name().to_owned();
            if name != "help" {
                let help = subcommand.render_long_help().to_string();
                assert!(help.contains("Examples:"), "expected examples in the help of {name}");
            }
        }
    }
}
