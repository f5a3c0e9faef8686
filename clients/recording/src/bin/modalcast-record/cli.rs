//! The command line.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, CommandFactory as _, Parser, Subcommand};
use modalcast_client::Delivery;
use modalcast_recording::{RecordRequest, Result, record, recover};

use crate::export::ExportOptions;
use crate::options::{ServerOptions, output_error, parse_seconds, termination_signal};
use crate::replay::ReplayOptions;

const EXIT_CODES: &str = "\
Exit codes:
  0  done
  2  invalid command line
  3  invalid input; the message names the field, the expected and the given value
  4  not found
  5  a resource or a program is missing or in use; the message names it
  6  error of the server, the device or a file";

/// Records the states of scenes, replays and exports them.
#[derive(Debug, Parser)]
#[command(name = "modalcast", version, after_help = EXIT_CODES)]
pub(crate) struct Cli {
    /// Print the hash of the sources that this program was built from, then exit.
    #[arg(long, hide = true)]
    pub(crate) build: bool,
    #[command(subcommand)]
    command: Option<Command>,
}

#[derive(Debug, Subcommand)]
enum Command {
    Record(RecordOptions),
    Replay(ReplayOptions),
    Recover(RecoverOptions),
    Export(ExportOptions),
}

/// Records the states of a scene of a server in an MCAP file, until Ctrl-C, a limit, or the end of the scene.
///
/// Prints the line `ready` on standard output when the server has accepted the subscription: the steps of a physics
/// process that starts after that line are recorded. The scene may also be driven already; the first state is complete.
/// Writes the recorded messages at least once per second: if this program is killed, `modalcast recover` repairs the
/// file.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  modalcast record tree --out tree.mcap
  modalcast record tree --out tree.mcap --duration 10 --latest
  modalcast record tree --out tree.mcap --steps 600 --by-hash")]
struct RecordOptions {
    /// Name of an open scene, or a source that the server opens.
    scene: String,
    /// File to write; replaced if it exists.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    #[command(flatten)]
    server: ServerOptions,
    /// Seconds after which the recording ends.
    #[arg(long, value_parser = parse_seconds)]
    duration: Option<f64>,
    /// Number of states after which the recording ends; 0 for no limit.
    #[arg(long, default_value_t = 0)]
    steps: u64,
    /// Record the newest states and skip steps, instead of slowing down the physics process, which ends the recording when
    /// the stall budget of the physics process is used up (modalcast-sim --stall-budget). The summary states the number of
    /// skipped steps.
    #[arg(long)]
    latest: bool,
    /// Record only the hashes of meshes, modes and textures. The recording can then be replayed only on servers that
    /// have the same scene.
    #[arg(long)]
    by_hash: bool,
}

/// Repairs a recording that was cut off, for example by a crash: copies everything up to the first incomplete or
/// damaged chunk into a new file with an index.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  modalcast recover cut.mcap --out tree.mcap")]
struct RecoverOptions {
    /// Recording to repair.
    file: PathBuf,
    /// File to write; replaced if it exists.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

impl Cli {
    pub(crate) async fn run(self) -> Result<u8> {
        match self.command {
            None => {
                Self::command().print_help().map_err(|error| output_error(&error))?;
                return Ok(2);
            }
            Some(Command::Record(options)) => options.run().await?,
            Some(Command::Replay(options)) => options.run().await?,
            Some(Command::Recover(options)) => options.run()?,
            Some(Command::Export(options)) => options.run().await?,
        }
        Ok(0)
    }
}

impl RecordOptions {
    async fn run(self) -> Result<()> {
        let client = self.server.connect().await?;
        let request = RecordRequest {
            delivery: if self.latest { Delivery::Latest } else { Delivery::Lossless },
            duration: self.duration.map(Duration::from_secs_f64),
            max_states: self.steps,
            by_hash: self.by_hash,
            ..RecordRequest::new(&self.scene)
        };
        let on_ready = || println!("ready");
        let recorded = record(&client, &request, &self.out, on_ready, termination_signal()?).await?;
        let summary = recorded.summary;
        println!(
            "{}: {} states in {:.3} s of simulation time, {} skipped steps, {} bytes",
            self.out.display(),
            summary.states,
            summary.last_time as f64 * 1e-9,
            summary.skipped,
            recorded.file_bytes
        );
        recorded.error.map_or(Ok(()), Err)
    }
}

impl RecoverOptions {
    fn run(&self) -> Result<()> {
        let recovered = recover(&self.file, &self.out)?;
        println!(
            "{}: {} messages in {} chunks; copied {} bytes, left out {} bytes",
            self.out.display(),
            recovered.messages,
            recovered.chunks,
            recovered.copied_bytes,
            recovered.lost_bytes
        );
        if let Some(reason) = recovered.reason {
            println!("reason: {reason}");
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn command_line_is_valid() {
        Cli::command().debug_assert();
    }
}
