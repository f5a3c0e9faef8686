//! `modalcast-sim` is the physics process. It reads the description of a scene from its server, drives the scene, and
//! prints a summary.

mod cli;

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use clap::Parser as _;
use modalcast_client::{Client, program};
use modalcast_dynamics::bridge::{Bridge, Options as BridgeOptions};
use modalcast_dynamics::cubic::ReducedForce;
use modalcast_dynamics::model::Model;
use modalcast_dynamics::run::{Options, Scenario, Summary, run};
use modalcast_dynamics::sweep::{Options as SweepOptions, Sweep};
use modalcast_dynamics::tree::{Options as TreeOptions, TreeScenario};
use modalcast_dynamics::vega::VegaSettings;
use modalcast_dynamics::{Error, Result, invalid};
use tokio::sync::watch;

use cli::{Cli, Command, CommonOptions, ForceFileOptions};

/// The most sampled vertices per part, of a tree and of other scenes.
const TREE_SAMPLES: usize = 24;
const MAX_SAMPLES: usize = 1 << 16;

/// The exit code of a complete run in which the server rejected steps.
const REJECTED: u8 = 6;

fn main() -> ExitCode {
    let arguments = Cli::parse();
    let main = async {
        let summary = drive(&arguments).await?;
        print(&summary, arguments.command.common().json);
        Ok(if summary.rejected > 0 { REJECTED } else { 0 })
    };
    program::run("modalcast-sim", main, exit_code)
}

/// The documented exit code of an error.
const fn exit_code(error: &Error) -> u8 {
    match error {
        Error::Client(error) => program::exit_code(error),
        Error::Invalid { .. } => 5,
    }
}

async fn drive(arguments: &Cli) -> Result<Summary> {
    let common = arguments.command.common();
    let client = Client::connect_with_retry(&common.server, Duration::from_secs_f64(common.wait)).await?;
    let scene = match &common.open {
        Some(source) => client.open_scene(source, &common.scene).await?.scene,
        None => common.scene.clone(),
    };
    let mut scenario = scenario(&client, &scene, &arguments.command).await?;
    let (stopper, stop) = watch::channel(false);
    tokio::spawn(async move {
        shutdown_signal().await;
        stopper.send_replace(true);
        // The first signal ends the run in order. A later interrupt exits at once, also if the server has stalled.
        if tokio::signal::ctrl_c().await.is_ok() {
            std::process::exit(130);
        }
    });
    let options = Options {
        steps: common.count(),
        dt: common.dt,
        policy: common.policy.into(),
        window: common.window,
        realtime: common.realtime,
        record: common.record.clone(),
    };
    run(&client, scenario.as_mut(), &options, &stop).await
}

/// Waits for Ctrl-C or SIGTERM.
async fn shutdown_signal() {
    use tokio::signal::unix::{SignalKind, signal};
    let Ok(mut terminate) = signal(SignalKind::terminate()) else {
        tokio::signal::ctrl_c().await.ok(); // Without a SIGTERM handler, wait for Ctrl-C only.
        return;
    };
    tokio::select! {
        _ = tokio::signal::ctrl_c() => {}
        _ = terminate.recv() => {}
    }
}

async fn scenario(client: &Client, scene: &str, command: &Command) -> Result<Box<dyn Scenario>> {
    let common = command.common();
    let (dt, steps) = (common.dt, common.count());
    match command {
        Command::Tree { wind, .. } => {
            let model = Model::fetch(client, scene, TREE_SAMPLES).await?;
            let (strength, direction) = (wind.wind, wind.direction.to_radians());
            let options = TreeOptions { dt, steps, sway: wind.sway, wind: strength, direction, seed: wind.seed };
            Ok(Box::new(TreeScenario::new(model, options)?))
        }
        Command::Bridge { files, load, .. } => {
            let model = Model::fetch(client, scene, MAX_SAMPLES).await?;
            let options = BridgeOptions {
                dt,
                deflection: load.deflection,
                period: load.period,
                load_direction: load.toward.into(),
            };
            bridge(model, files, options)
        }
        Command::Sweep { share, .. } => {
            let model = Model::fetch(client, scene, MAX_SAMPLES).await?;
            Ok(Box::new(Sweep::new(model, SweepOptions { dt, steps, share: *share })))
        }
        Command::Auto { files, load, wind, share, .. } => {
            // A model with few samples is enough to choose the scenario.
            let model = Model::fetch(client, scene, TREE_SAMPLES).await?;
            let command = if cubic(&model, files).is_some() {
                Command::Bridge { common: common.clone(), files: files.clone(), load: *load }
            } else if model.parts.iter().any(|part| !part.eigenvalues.is_empty()) {
                Command::Tree { common: common.clone(), wind: *wind }
            } else {
                Command::Sweep { common: common.clone(), share: *share }
            };
            eprintln!("modalcast-sim: {scene}: scenario `{}`", command.name());
            Box::pin(scenario(client, scene, &command)).await
        }
    }
}

fn bridge(model: Model, files: &ForceFileOptions, options: BridgeOptions) -> Result<Box<dyn Scenario>> {
    let missing = || invalid("cubic", "--cubic FILE.cub, or --files DIR with the file that the scene names", "none");
    let cubic = cubic(&model, files).ok_or_else(missing)?;
    let beside = cubic.with_extension("config");
    let config = files.config.clone().or_else(|| beside.is_file().then_some(beside));
    let settings = config.map_or_else(|| Ok(VegaSettings::default()), |path| VegaSettings::read(&path))?;
    Ok(Box::new(Bridge::new(model, ReducedForce::read(&cubic)?, &settings, options)?))
}

/// The file of cubic forces: the one of `--cubic`, or the one in `--files` that a note of the scene names, or the only
/// one in `--files`.
fn cubic(model: &Model, files: &ForceFileOptions) -> Option<PathBuf> {
    if let Some(path) = &files.cubic {
        return Some(path.clone());
    }
    let folder = files.files.as_deref()?;
    let named = model.parts.iter().filter_map(|part| part.notes.get("vega.cubic"));
    let named = named.filter_map(|note| Path::new(note).file_name()).map(|name| folder.join(name));
    let mut found: Vec<PathBuf> = named.filter(|path| path.is_file()).collect();
    if found.is_empty() {
        let items = folder.read_dir().ok()?.filter_map(|item| Some(item.ok()?.path()));
        found = items.filter(|path| path.extension().is_some_and(|end| end == "cub")).collect();
    }
    if found.len() == 1 { found.pop() } else { None }
}

/// Prints the summary as one line of JSON, or with one line per value.
fn print(summary: &Summary, json: bool) {
    if json {
        println!("{}", summary.value);
        return;
    }
    for (name, value) in summary.value.as_object().into_iter().flatten() {
        println!("{name:24} {value}");
    }
}

impl CommonOptions {
    /// The number of steps; `None` for an unlimited run.
    fn count(&self) -> Option<u64> {
        match (self.steps, self.seconds) {
            (Some(0), _) => None,
            (Some(steps), _) => Some(steps),
            (None, seconds) if seconds > 0.0 => Some((seconds / self.dt).ceil().max(1.0) as u64),
            (None, _) => None,
        }
    }
}
