//! `modalcast-modes`: see `modalcast model --help`.

// `modalcast view` has the same options.
#[path = "../../../../../src/cli/modeling_options.rs"]
mod modeling_options;
mod progress;
mod summary;

use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use clap::Parser;
use modalcast_model::error::{Error, Result, fault_in, invalid};
use modalcast_modes::parameters::{PointMass, Unit, parse_axis};
use modalcast_modes::{ModelingParameters, compute_modes, model_file, surface_file};

use modeling_options::ModelingOptions;
use progress::{ProgressStyle, Reporter};

/// Hash of all sources that this program was built from, which `modalcast` compares with its own.
const BUILD: &str = env!("MODALCAST_BUILD");

/// The exit code after Ctrl-C, as shells report it.
const INTERRUPTED: u8 = 130;

/// Computes the modes of a solid part from its surface, and writes a model that deforms.
///
/// MODEL is an .stl, .obj, .ply, .glb, .gltf or .npz file. The surface may have holes and several shells.
#[derive(Debug, Parser)]
#[command(
    name = "modalcast model",
    bin_name = "modalcast model",
    after_help = "Examples:
  modalcast model bracket.stl --unit mm --material steel --clamp 'z < 1' --out bracket.npz
  modalcast model fork.stl --material E=70e9,nu=0.33,rho=2700 --modes 30 --out fork.npz
  modalcast view bracket.npz                    shows the model; drag the part to pull it"
)]
struct Cli {
    /// The surface of the part.
    #[arg(required_unless_present = "build")]
    model: Option<String>,
    #[command(flatten)]
    options: ModelingOptions,
    /// The model to write [default: the name of the surface with the ending .npz, in the working folder].
    #[arg(long, value_name = "FILE.npz")]
    out: Option<PathBuf>,
    /// Replace an existing file.
    #[arg(long)]
    force: bool,
    /// How progress is printed: a bar on terminals, lines elsewhere.
    #[arg(long, value_enum, default_value_t)]
    progress: ProgressStyle,
    /// Print the result as JSON.
    #[arg(long)]
    json: bool,
    /// Print the build and exit.
    #[arg(long, hide = true)]
    build: bool,
}

fn main() -> ExitCode {
    let cli = Cli::parse();
    if cli.build {
        println!("{BUILD}");
        return ExitCode::SUCCESS;
    }
    match run(&cli) {
        Ok(code) => code,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::from(if matches!(error, Error::Fault { .. }) { 1 } else { 2 })
        }
    }
}

fn run(cli: &Cli) -> Result<ExitCode> {
    let Some(model) = &cli.model else { return Ok(ExitCode::SUCCESS) };
    let parameters = parameters(&cli.options)?;
    if let Some(threads) = cli.options.threads {
        if threads == 0 {
            return Err(invalid("--threads", "at least 1", threads));
        }
        rayon::ThreadPoolBuilder::new().num_threads(threads).build_global().map_err(fault_in("threads"))?;
    }
    let file = surface_file::read(model, parameters.unit.meters)?;
    let out = cli.out.clone().unwrap_or_else(|| PathBuf::from(&file.name).with_extension("npz"));
    if out.exists() && !cli.force {
        let field = format!("file '{}'", out.display());
        return Err(invalid(field, "a new file (--force replaces an existing one)", "an existing file"));
    }
    let reporter = Reporter::new(cli.progress);
    let modeling = compute_modes(&file, &parameters, &|share, stage| reporter.report(share, stage))?;
    let bytes = model_file::encode(&file, &parameters, &modeling)?;
    // From here on, a signal ends the program only after the file is complete and has its name.
    let interrupted = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        signal_hook::flag::register(signal, interrupted.clone()).map_err(fault_in("signals"))?;
    }
    model_file::write(&out, &bytes, cli.force)?;
    reporter.finish();
    if interrupted.load(Ordering::Relaxed) {
        return Ok(ExitCode::from(INTERRUPTED));
    }
    match cli.json {
        true => println!("{}", summary::json(&out, &modeling)),
        false => print!("{}", summary::text(&out, &parameters, &modeling)),
    }
    Ok(ExitCode::SUCCESS)
}

/// Reads the strings of the options.
fn parameters(options: &ModelingOptions) -> Result<ModelingParameters> {
    let default = ModelingParameters::default();
    let mut parameters = ModelingParameters {
        modes: options.modes.unwrap_or(default.modes),
        max_frequency: options.max_frequency,
        freedoms: options.freedoms.unwrap_or(default.freedoms),
        damping_ratio: options.damping,
        unit: options.unit.as_deref().map_or(Ok(default.unit), Unit::parse)?,
        up_axis: options.up.as_deref().map(parse_axis).transpose()?,
        clamps: options.clamp.clone(),
        point_masses: options.point_mass.iter().map(|text| PointMass::parse(text)).collect::<Result<_>>()?,
        thickness: options.thickness,
        ..default
    };
    options.material.iter().try_for_each(|text| parameters.add_material(text))?;
    parameters.validated()
}
