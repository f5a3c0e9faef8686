//! `modalcast-fetch` saves frames and vertices of a server as files, and administers its scenes and clients. It prints
//! progress on standard error and results on standard output.

mod cli;
mod clients;
mod frames;
mod output;
mod vertices;

use std::process::ExitCode;
use std::time::Duration;

use clap::Parser as _;
use modalcast_client::{Client, Result, program};

use cli::{Cli, Command};

fn main() -> ExitCode {
    let arguments = Cli::parse();
    program::run("modalcast-fetch", async { run_command(&arguments).await.map(|()| 0) }, program::exit_code)
}

async fn run_command(arguments: &Cli) -> Result<()> {
    let mut client = Client::connect_with_retry(&arguments.server, Duration::from_secs_f64(arguments.wait)).await?;
    if let Some(path) = &arguments.shared_memory {
        client = client.with_shared_memory(path).await?;
    }
    let as_json = arguments.json;
    match &arguments.command {
        Command::Frames(options) => frames::fetch_stream(&client, options, as_json).await,
        Command::Frame(options) => frames::fetch_single(&client, options, as_json).await,
        Command::Vertices(options) => vertices::fetch(&client, options, as_json).await,
        Command::Info => output::print_info(&client, as_json).await,
        Command::Clients(options) => clients::run(&client, options, as_json).await,
        Command::List => output::print_list(&client, as_json).await,
        Command::Reset { scene, take_over } => client.reset_scene(scene, *take_over).await.map(drop),
        Command::Close { scene } => client.delete_scene(scene).await,
        Command::Link { principal, scene } => {
            let link = client.create_viewer_link(principal).await?;
            output::print_links(&arguments.server, &link, scene.as_deref());
            Ok(())
        }
        Command::Share { scene, principals } => {
            client.share_scene(scene, &principals.iter().map(String::as_str).collect::<Vec<_>>()).await
        }
    }
}
