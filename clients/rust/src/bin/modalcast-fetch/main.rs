//! `modalcast-fetch` saves frames and vertices of a server as files. It prints progress on standard error and results
//! on standard output.

mod cli;
mod frames;
mod output;
mod vertices;

use std::process::ExitCode;
use std::time::Duration;

use clap::Parser as _;
use modalcast_client::{Client, Error, Result};

use cli::{Cli, Command};

fn main() -> ExitCode {
    let arguments = Cli::parse();
    let runtime = match tokio::runtime::Builder::new_multi_thread().enable_all().build() {
        Ok(runtime) => runtime,
        Err(fault) => {
            eprintln!("modalcast-fetch: no runtime: {fault}");
            return ExitCode::from(4);
        }
    };
    match runtime.block_on(run(&arguments)) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("modalcast-fetch: {error}");
            ExitCode::from(code(&error))
        }
    }
}

/// The documented exit code of an error.
const fn code(error: &Error) -> u8 {
    match error {
        Error::Connect { .. } | Error::Status { code: modalcast_client::Code::Unavailable, .. } => 3,
        Error::Status { .. } | Error::Rejected(_) | Error::Step { .. } => 1,
        Error::File { .. } => 4,
        Error::Malformed { .. } | Error::StreamEnded { .. } | Error::Deadline { .. } => 5,
    }
}

async fn run(arguments: &Cli) -> Result<()> {
    let client = Client::connect_with_retry(&arguments.server, Duration::from_secs_f64(arguments.wait)).await?;
    let json = arguments.json;
    match &arguments.command {
        Command::Frames(options) => frames::stream(&client, options, json).await,
        Command::Frame(options) => frames::single(&client, options, json).await,
        Command::Vertices(options) => vertices::fetch(&client, options, json).await,
        Command::Info => output::info(&client, json).await,
        Command::List => output::list(&client, json).await,
        Command::Close { scene } => client.delete_scene(scene).await,
    }
}
