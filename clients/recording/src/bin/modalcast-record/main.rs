//! `modalcast-record`: see `modalcast record --help`.

mod cli;
mod export;
mod frame_folder;
mod options;
mod replay;

use std::process::ExitCode;

use clap::Parser as _;
use modalcast_client::program;

use cli::Cli;
use modalcast_recording::Error;

/// Hash of all sources that this program was built from, which `modalcast` compares with its own.
const BUILD: &str = env!("MODALCAST_BUILD");

fn main() -> ExitCode {
    let cli = Cli::parse();
    if cli.build {
        println!("{BUILD}");
        return ExitCode::SUCCESS;
    }
    program::run("modalcast", cli.run(), Error::exit_code)
}
