//! The command line: the commands, one per file, and their exit codes.

mod allocator;
mod computed_modes;
mod demo;
mod doctor;
mod inspect;
mod loading_options;
mod modeling_options;
pub mod options;
mod physics;
mod recording;
mod render;
mod serve;
mod sibling;
mod tls_options;
mod token;
mod view;

use std::io::Write as _;

use clap::{Parser, Subcommand};

use modalcast_model::error::Error;
use modalcast_model::escaping::escape_controls;

/// A GPU server for modal deformable objects: x = T (x0 + U q), rendered headless, streamed over gRPC.
#[derive(Debug, Parser)]
#[command(version, arg_required_else_help = true, after_help = EXIT_CODES)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Serve(Box<serve::Args>),
    View(view::Args),
    Demo(demo::Args),
    Render(render::Args),
    /// Records the states of a scene of a server in an MCAP file.
    #[command(after_help = RECORD_EXAMPLES, disable_help_flag = true)]
    Record(sibling::Args),
    /// Drives a scene of a server with a recording.
    #[command(after_help = REPLAY_EXAMPLES, disable_help_flag = true)]
    Replay(sibling::Args),
    /// Repairs a recording that was cut off.
    #[command(after_help = RECOVER_EXAMPLES, disable_help_flag = true)]
    Recover(sibling::Args),
    /// Converts a recording to a web page, glTF, NumPy arrays, pictures or a video.
    #[command(after_help = EXPORT_EXAMPLES, disable_help_flag = true)]
    Export(sibling::Args),
    /// Computes the modes of a surface, so that the part can be pulled, and writes them in a model file.
    #[command(after_help = MODEL_EXAMPLES, disable_help_flag = true)]
    Model(sibling::Args),
    /// Measures error against run time on this machine and writes tables and plots.
    #[command(after_help = REPORT_EXAMPLES, disable_help_flag = true)]
    Report(sibling::Args),
    Token(token::Args),
    /// Prints a link to the viewer of a running server, which is valid once.
    #[command(after_help = LINK_EXAMPLES, disable_help_flag = true)]
    Link(sibling::Args),
    /// Lists the clients of a running server with what they hold, or ends them.
    #[command(after_help = CLIENTS_EXAMPLES, disable_help_flag = true)]
    Clients(sibling::Args),
    /// Shares a scene of a running server with other principals.
    #[command(after_help = SHARE_EXAMPLES, disable_help_flag = true)]
    Share(sibling::Args),
    Inspect(inspect::Args),
    Doctor(doctor::Args),
}

const RECORD_EXAMPLES: &str = "Examples:
  modalcast record --help
  modalcast record tree --out tree.mcap
  modalcast record tree --out tree.mcap --duration 10 --latest";

const REPLAY_EXAMPLES: &str = "Examples:
  modalcast replay --help
  modalcast replay tree.mcap --speed 0.5 --loop
  modalcast replay tree.mcap --fast --frames out";

const EXPORT_EXAMPLES: &str = "Examples:
  modalcast export --help
  modalcast export tree.mcap --to html --out tree.html
  modalcast export tree.mcap --to npz --out tree.npz";

const RECOVER_EXAMPLES: &str = "Examples:
  modalcast recover --help
  modalcast recover cut.mcap --out tree.mcap";

const MODEL_EXAMPLES: &str = "Examples:
  modalcast model --help
  modalcast model part.stl --modes 20 --material steel --clamp 'z < 0.01' --out part.npz
  modalcast view part.npz";

const LINK_EXAMPLES: &str = "Examples:
  modalcast link
  modalcast link anna
  modalcast link --scene tree --server http://127.0.0.1:50051";

const CLIENTS_EXAMPLES: &str = "Examples:
  modalcast clients
  modalcast clients --end anna/process-4711
  modalcast clients --end 'anonymous/*'";

const SHARE_EXAMPLES: &str = "Examples:
  modalcast share tree anna ben
  modalcast share tree '*'";

const REPORT_EXAMPLES: &str = "Examples:
  modalcast report --help
  modalcast report deform --out report --quick
  modalcast report render --out report --quick
  modalcast report stream --out report --quick
  modalcast report drift --out report
  modalcast report dynamics --out report";

/// Help text on the exit codes of all commands.
pub const EXIT_CODES: &str = "\
Exit codes:
  0  done
  1  a check failed (doctor: no frame can be drawn; demo: a criterion is not met; report: a variant exceeds its error
     bound, or errors grow)
  2  invalid command line
  3  invalid input; the message names the field, the expected and the given value
  4  not found
  5  a resource or a program is missing or in use; the message names it
  6  error of the server or the device
  7  the device is lost, or does not answer; the state is on disk, and a new process can go on";

/// The exit code of [`Error::DeviceLost`].
pub const EXIT_CODE_OF_LOST_DEVICE: u8 = 7;

/// How a command without an error ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Completion {
    /// The command is done. If it has a check, the check passed.
    Success,
    /// The command is done, and its check failed.
    CheckFailed,
    /// A program that the command started has failed with this exit code and printed the reason.
    ProgramFailed(u8),
}

impl Completion {
    /// The completion of a command with a check.
    pub const fn of_check(passed: bool) -> Self {
        if passed { Self::Success } else { Self::CheckFailed }
    }
}

/// Result of a command.
pub type Outcome = modalcast_model::error::Result<Completion>;

/// Runs the command line and returns the process's exit code.
pub fn run() -> u8 {
    allocator::limit_arenas();
    let cli = Cli::parse();
    crate::telemetry::init_logging();
    let outcome = match cli.command {
        Command::Serve(args) => serve::run(&args),
        Command::View(args) => view::run(&args),
        Command::Demo(args) => demo::run(&args),
        Command::Render(args) => render::run(&args),
        Command::Record(args) => sibling::RECORD.execute(Some("record"), &args),
        Command::Replay(args) => sibling::RECORD.execute(Some("replay"), &args),
        Command::Export(args) => sibling::RECORD.execute(Some("export"), &args),
        Command::Recover(args) => sibling::RECORD.execute(Some("recover"), &args),
        Command::Model(args) => sibling::MODES.execute(None, &args),
        Command::Report(args) => sibling::REPORT.execute(None, &args),
        Command::Inspect(args) => inspect::run(&args),
        Command::Token(args) => token::run(&args),
        Command::Link(args) => sibling::FETCH.execute(Some("link"), &args),
        Command::Clients(args) => sibling::FETCH.execute(Some("clients"), &args),
        Command::Share(args) => sibling::FETCH.execute(Some("share"), &args),
        Command::Doctor(args) => doctor::run(&args),
    };
    finish(outcome)
}

/// Converts an outcome to an exit code. Prints an error on standard error.
pub fn finish(outcome: Outcome) -> u8 {
    match outcome {
        Ok(Completion::Success) => 0,
        Ok(Completion::CheckFailed) => 1,
        Ok(Completion::ProgramFailed(code)) => code,
        Err(error) => {
            // Errors contain texts of files, which must not control the terminal.
            eprintln!("modalcast: {}", escape_controls(&error.to_string()));
            exit_code(&error)
        }
    }
}

fn exit_code(error: &Error) -> u8 {
    match error {
        Error::Invalid { .. } | Error::InvalidFile { .. } | Error::UnexpectedMessage { .. } => 3,
        Error::NotFound { .. } | Error::ContentNotFound { .. } | Error::StreamNotFound | Error::StepPassed { .. } => 4,
        Error::NameTaken { .. }
        | Error::NotPermitted { .. }
        | Error::LeaseTaken { .. }
        | Error::LeaseLost { .. }
        | Error::WindowFull { .. }
        | Error::Busy { .. }
        | Error::LimitReached { .. }
        | Error::Preempted { .. }
        | Error::ClientEnded
        | Error::OutOfMemory { .. }
        | Error::SlowReader { .. }
        | Error::SlowSubscriber { .. }
        | Error::Unavailable { .. }
        | Error::ShuttingDown => 5,
        Error::Deadline { .. } | Error::Fault { .. } | Error::RendererLost { .. } => 6,
        Error::DeviceLost { .. } => EXIT_CODE_OF_LOST_DEVICE,
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
