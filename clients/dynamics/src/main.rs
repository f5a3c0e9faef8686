//! `modalcast-sim` is the physics process. It reads the description of a scene from its server, drives the scene, and
//! prints a summary.

mod cli;

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use clap::Parser as _;
use modalcast_client::{Client, program};
use modalcast_dynamics::bridge::{BridgeOptions, BridgeScenario};
use modalcast_dynamics::checkpoint::CheckpointOptions;
use modalcast_dynamics::cubic::ReducedForce;
use modalcast_dynamics::deflection::report_deflections;
use modalcast_dynamics::force_domain::{check_forces_belong, find_force_domain};
use modalcast_dynamics::free_bodies::{FreeOptions, FreeScenario};
use modalcast_dynamics::model::Model;
use modalcast_dynamics::parameters::ModalParameters;
use modalcast_dynamics::reduced_system::ReducedSystem;
use modalcast_dynamics::run::{Report, RunOptions, RunSummary, Scenario, drive_scene};
use modalcast_dynamics::sweep::{SweepOptions, SweepScenario};
use modalcast_dynamics::tree::{TreeOptions, TreeScenario, default_wind_speed};
use modalcast_dynamics::vega::VegaSettings;
use modalcast_dynamics::{Error, Result, invalid_input};
use tokio::sync::watch;

use cli::{Cli, Command, ForceFileOptions, PhysicsOptions, SWEEP_SHARE, ServerOptions, SlowMotion, Timing};

/// Maximum number of surface samples per domain of a tree. A tree may have thousands of domains, and the rows of U of
/// every sample are fetched from the server.
const MAX_TREE_SAMPLES: usize = 24;

/// Maximum number of surface samples per domain of other scenes, which usually have few domains.
const MAX_SAMPLES: usize = 1 << 16;

/// Deflection of a bridge under its load, as a fraction of the diagonal of the scene's rest bounds.
const DEFAULT_DEFLECTION: f64 = 0.03;

/// Maximum number of files that a remark names.
const MAX_NAMED_FILES: usize = 8;

/// The exit code of a complete run in which the server rejected steps.
const EXIT_STEPS_REJECTED: u8 = 6;

fn main() -> ExitCode {
    let arguments = Cli::parse();
    let main = async {
        let client = connect(arguments.server()).await?;
        let scene = open_scene(&client, arguments.server()).await?;
        if let Some(Command::Static { forces, vertices, .. }) = &arguments.command {
            let model = Model::fetch(&client, &scene, MAX_TREE_SAMPLES).await?;
            print_report(&report_deflections(&client, &model, forces, vertices).await?, arguments.server().json);
            return Ok(0);
        }
        let summary = run_scenario(&client, scene, &arguments).await?;
        print_report(&summary.report, arguments.server().json);
        Ok(if summary.rejected_steps > 0 { EXIT_STEPS_REJECTED } else { 0 })
    };
    program::run("modalcast-sim", main, exit_code)
}

/// The exit code of an error. The help text in `cli.rs` lists the codes.
const fn exit_code(error: &Error) -> u8 {
    match error {
        Error::Client(error) => program::exit_code(error),
        Error::Invalid { .. } => 5,
        Error::Diverged { .. } | Error::NotConverged { .. } => 7,
    }
}

async fn connect(options: &ServerOptions) -> Result<Client> {
    Ok(Client::connect_with_retry(&options.server, Duration::from_secs_f64(options.wait)).await?)
}

/// Opens the scene if the options say so, and returns its name.
async fn open_scene(client: &Client, options: &ServerOptions) -> Result<String> {
    match &options.open {
        Some(source) => Ok(client.open_scene(source, options.scene()).await?.scene),
        None => Ok(options.scene().to_owned()),
    }
}

async fn run_scenario(client: &Client, scene: String, arguments: &Cli) -> Result<RunSummary> {
    let common = arguments.common();
    let TimedScenario { mut scenario, timing } = create_scenario(client, &scene, arguments).await?;
    for remark in scenario.remarks() {
        eprintln!("modalcast-sim: {scene}: {remark}");
    }
    let (stop_sender, stop_receiver) = watch::channel(false);
    tokio::spawn(async move {
        wait_for_shutdown_signal().await;
        stop_sender.send_replace(true);
        // The first signal ends the run after the current step. A later Ctrl-C exits at once, even if the server
        // stalls.
        if tokio::signal::ctrl_c().await.is_ok() {
            std::process::exit(130); // The convention for a program that SIGINT (signal 2) ends: 128 + 2.
        }
    });
    let options = RunOptions {
        steps: timing.steps,
        dt: timing.dt,
        slow: timing.slow,
        delivery: common.delivery.into(),
        window: common.window,
        stall_budget: common.stall_budget,
        realtime: common.realtime,
        applies_viewer_forces: common.forces,
        record_folder: common.record.clone(),
        checkpoint: common
            .checkpoint
            .clone()
            .map(|path| CheckpointOptions { path, interval: common.checkpoint_interval }),
        resume_path: common.resume.clone(),
    };
    drive_scene(client, scenario.as_mut(), &options, &stop_receiver).await
}

/// Waits for Ctrl-C or SIGTERM.
async fn wait_for_shutdown_signal() {
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

/// A motion and the times of its steps.
struct TimedScenario {
    scenario: Box<dyn Scenario>,
    timing: Timing,
}

async fn create_scenario(client: &Client, scene: &str, arguments: &Cli) -> Result<TimedScenario> {
    let common = arguments.common();
    let sweep = |model: Model, displacement_fraction: f64| {
        let timing = common.timing(None);
        let options = SweepOptions { dt: timing.dt, steps: timing.steps, displacement_fraction };
        TimedScenario { scenario: Box::new(SweepScenario::new(model, options)), timing }
    };
    if let Some(Command::Sweep { displacement_fraction, .. }) = &arguments.command {
        return Ok(sweep(Model::fetch(client, scene, MAX_SAMPLES).await?, *displacement_fraction));
    }
    let PhysicsOptions { wind, files, .. } = &arguments.physics;
    // A model with few samples is enough to select the physics.
    let model = Model::fetch(client, scene, MAX_TREE_SAMPLES).await?;
    let announce = |motion: &str| eprintln!("modalcast-sim: {scene}: {motion}");
    if arguments.physics.free {
        announce("free bodies");
        return create_free_scenario(model, arguments);
    }
    if let Some(force_path) = find_force_file(&model, files)? {
        return create_bridge_scenario(client, scene, arguments, &force_path).await;
    }
    if let Some(remark) = unused_force_files(files) {
        announce(&remark);
    }
    let wind_speed = match wind.speed {
        None if is_tree(&model) => Some(default_wind_speed(&model, wind.direction_degrees.to_radians())?),
        speed => speed,
    };
    match wind_speed {
        Some(wind_speed) => {
            announce(&format!("modes in a wind of {wind_speed} m/s"));
            create_tree_scenario(model, arguments, wind_speed)
        }
        None if common.forces => {
            check_forces_move(&model)?;
            announce("modes under the forces of viewers");
            create_tree_scenario(model, arguments, 0.0)
        }
        None => {
            announce("sweep through all modes (no wind, no cubic forces and no --forces)");
            Ok(sweep(Model::fetch(client, scene, MAX_SAMPLES).await?, SWEEP_SHARE))
        }
    }
}

fn create_tree_scenario(model: Model, arguments: &Cli, wind_speed: f64) -> Result<TimedScenario> {
    let timing = choose_timing(&model.scene, arguments, ModalParameters::read(&model)?.lowest_frequency());
    let wind = &arguments.physics.wind;
    let options = TreeOptions {
        dt: timing.dt,
        wind_speed,
        direction_radians: wind.direction_degrees.to_radians(),
        seed: wind.seed,
    };
    Ok(TimedScenario { scenario: Box::new(TreeScenario::new(model, options)?), timing })
}

fn create_free_scenario(model: Model, arguments: &Cli) -> Result<TimedScenario> {
    let timing = choose_timing(&model.scene, arguments, ModalParameters::read(&model)?.lowest_frequency());
    let wind = &arguments.physics.wind;
    let options = FreeOptions {
        dt: timing.dt,
        wind_speed: wind.speed.unwrap_or(0.0),
        direction_radians: wind.direction_degrees.to_radians(),
        seed: wind.seed,
    };
    Ok(TimedScenario { scenario: Box::new(FreeScenario::new(model, options)?), timing })
}

/// The times of a run. Says by which factor `--slow auto` slows the motion down.
fn choose_timing(scene: &str, arguments: &Cli, lowest_frequency: Option<f64>) -> Timing {
    let common = arguments.common();
    let timing = common.timing(lowest_frequency);
    if let (SlowMotion::Auto, Some(hertz)) = (common.slow, lowest_frequency.filter(|_| timing.slow > 1.0)) {
        eprintln!(
            "modalcast-sim: {scene}: slow motion at 1/{} of real time, which shows the lowest frequency of {hertz:.4} Hz \
             as {:.2} Hz (--slow FACTOR sets it; --slow 1 is real time)",
            timing.slow,
            hertz / timing.slow
        );
    }
    timing
}

/// Whether wind moves the scene by default: some domain has eigenvalues, and some domain is attached to another one. A
/// single beam with eigenvalues is stiffer than a tree, so that wind would hardly move it.
fn is_tree(model: &Model) -> bool {
    let has_eigenvalues = model.domains.iter().any(|domain| !domain.eigenvalues.is_empty());
    has_eigenvalues && model.domains.iter().any(|domain| domain.joint.is_some())
}

/// Checks that forces can move the scene.
///
/// # Errors
/// `Invalid` if no mode has a stiffness. Says what the scene lacks.
fn check_forces_move(model: &Model) -> Result<()> {
    let parameters = ModalParameters::read(model)?;
    if parameters.modes.iter().any(Option::is_some) {
        return Ok(());
    }
    let given = match model.coordinate_count {
        0 => {
            "no modes: add the arrays U and eigenvalues in MODEL.npz, or compute them: modalcast view MODEL --modes 20"
                .to_owned()
        }
        count if model.domains.iter().all(|domain| domain.eigenvalues.is_empty()) => {
            format!("{count} modes without: add the array eigenvalues, in (rad/s)^2, next to U")
        }
        _ => parameters.remarks.join("; "),
    };
    Err(invalid_input("scene", "modes with eigenvalues", given))
}

async fn create_bridge_scenario(
    client: &Client,
    scene: &str,
    arguments: &Cli,
    force_path: &Path,
) -> Result<TimedScenario> {
    let PhysicsOptions { files, load, integration, .. } = &arguments.physics;
    let model = Model::fetch(client, scene, MAX_SAMPLES).await?;
    let default_config = force_path.with_extension("config");
    let config_path = files.config.clone().or_else(|| default_config.is_file().then_some(default_config));
    let settings = config_path.map_or_else(|| Ok(VegaSettings::default()), |path| VegaSettings::read(&path))?;
    let force_bytes = std::fs::read(force_path).map_err(|error| modalcast_client::Error::file(force_path, error))?;
    let domain = find_force_domain(client, scene, files.domain.as_deref(), force_path, &force_bytes).await?;
    if let Some(domain) = model.domains.get(domain) {
        check_forces_belong(domain, &force_bytes)?;
    }
    let force = ReducedForce::parse(&force_bytes)?;
    let linear_frequency = ModalParameters::read_except(&model, Some(domain))?.lowest_frequency();
    let frequencies = [linear_frequency, ReducedSystem::new(force.clone(), &settings).lowest_frequency()];
    let timing = choose_timing(scene, arguments, frequencies.into_iter().flatten().min_by(f64::total_cmp));
    // A model with eigenvalues is a part to pull; Vega's models have none.
    let has_eigenvalues = model.domains.get(domain).is_some_and(|domain| !domain.eigenvalues.is_empty());
    let default_deflection = if has_eigenvalues { 0.0 } else { DEFAULT_DEFLECTION };
    let deflection_fraction = load.deflection_fraction.unwrap_or(default_deflection);
    let load_name = if deflection_fraction > 0.0 { "a pulsating load" } else { "the forces of viewers" };
    eprintln!("modalcast-sim: {scene}: cubic forces under {load_name}");
    let options = BridgeOptions {
        domain,
        dt: timing.dt,
        deflection_fraction,
        period: load.period,
        load_direction: load.direction.into(),
        method: integration.method.into(),
        has_fixed_step: integration.has_fixed_step,
    };
    Ok(TimedScenario { scenario: Box::new(BridgeScenario::new(model, force, &settings, options)?), timing })
}

/// Finds the file of reduced forces: the file of `--cubic`, else the file in `--files` that the note `vega.cubic` of a
/// domain names (notes are metadata in the scene's description). `None` if there is no such file. No other file is
/// used, because the forces of another model would move this one in a wrong way.
///
/// # Errors
/// `Invalid` if the folder has several such files.
fn find_force_file(model: &Model, files: &ForceFileOptions) -> Result<Option<PathBuf>> {
    if let Some(path) = &files.cubic {
        return Ok(Some(path.clone()));
    }
    let Some(folder) = files.folder.as_deref() else { return Ok(None) };
    let notes = model.domains.iter().filter_map(|domain| domain.notes.get("vega.cubic"));
    let paths_in_notes = notes.filter_map(|note| Path::new(note).file_name()).map(|name| folder.join(name));
    let mut candidates: Vec<PathBuf> = paths_in_notes.filter(|path| path.is_file()).collect();
    // Several domains may name the same file.
    candidates.sort();
    candidates.dedup();
    if candidates.len() > 1 {
        let given = candidates.iter().map(|path| path.display().to_string()).collect::<Vec<_>>().join(", ");
        return Err(invalid_input("--files", "one file that a note vega.cubic names, or --cubic FILE.cub", given));
    }
    Ok(candidates.pop())
}

/// Names the .cub files in `--files`, of which none is used.
fn unused_force_files(files: &ForceFileOptions) -> Option<String> {
    let paths = files.folder.as_deref()?.read_dir().ok()?.filter_map(|entry| Some(entry.ok()?.path()));
    let is_cubic = |path: &PathBuf| path.extension().is_some_and(|extension| extension == "cub");
    let mut names: Vec<String> = paths.filter(is_cubic).map(|path| path.display().to_string()).collect();
    names.sort();
    names.truncate(MAX_NAMED_FILES);
    let hint = "no note vega.cubic of the scene names one of them; --cubic selects one";
    (!names.is_empty()).then(|| format!("not used as cubic forces: {} ({hint})", names.join(", ")))
}

/// Prints the report as one line of JSON, or with one line per value.
fn print_report(report: &Report, as_json: bool) {
    if as_json {
        println!("{}", serde_json::json!(report));
        return;
    }
    for (name, value) in report {
        println!("{name:24} {value}");
    }
}
