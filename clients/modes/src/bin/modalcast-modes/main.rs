//! `modalcast-modes`: see `modalcast model --help`.

// `modalcast view` has the same options.
#[path = "../../../../../src/cli/loading_options.rs"]
mod loading_options;
#[path = "../../../../../src/cli/modeling_options.rs"]
mod modeling_options;
mod progress;
mod summary;

use std::io::Write as _;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use clap::Parser;
use modalcast_model::error::{Error, Result, fault_in, invalid};
use modalcast_modes::large_motion::DEFAULT_LINEAR_MODES;
use modalcast_modes::parameters::PointMass;
use modalcast_modes::{ModelingParameters, PartFile, model_file};

use loading_options::LoadingOptions;
use modeling_options::ModelingOptions;
use progress::{ProgressStyle, Reporter};

/// Hash of all sources that this program was built from, which `modalcast` compares with its own.
const BUILD: &str = env!("MODALCAST_BUILD");

/// The exit code after Ctrl-C, as shells report it.
const INTERRUPTED: u8 = 130;

/// Limit on threads.
const MAX_THREADS: usize = 256;

/// Computes the modes of a solid part from its surface or a volume mesh, and writes a model that deforms.
///
/// MODEL is a surface, which may have holes and several shells (.stl, .obj, .ply, .glb, .gltf or .npz), or a mesh of
/// tetrahedra (.msh of Gmsh, .vtk, .vtu, or .veg of Vega).
#[derive(Debug, Parser)]
#[command(
    name = "modalcast model",
    bin_name = "modalcast model",
    after_help = "Examples:
  modalcast model bracket.stl --unit mm --material steel --clamp 'z < 1' --out bracket.npz
  modalcast model bracket.msh --material flange:aluminum --clamp 'group foot'
  modalcast model fork.stl --material E=70e9,nu=0.33,rho=2700 --modes 30 --out fork.npz
  modalcast model arm.msh --large --material rubber --clamp 'x < 0.01'   bends far: also writes arm.cub
  modalcast view bracket.npz                    shows the model; drag the part to pull it"
)]
struct Cli {
    /// The surface of the part, or its volume mesh.
    #[arg(required_unless_present = "build")]
    model: Option<String>,
    #[command(flatten)]
    loading: LoadingOptions,
    #[command(flatten)]
    options: ModelingOptions,
    /// The model to write [default: the name of MODEL with the ending .npz, in the working folder].
    #[arg(long, value_name = "FILE.npz")]
    out: Option<PathBuf>,
    /// Replace existing files.
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
            ExitCode::from(exit_code(&error))
        }
    }
}

/// The exit code of an error, as `modalcast` has it.
const fn exit_code(error: &Error) -> u8 {
    match error {
        Error::Invalid { .. } | Error::InvalidFile { .. } => 3,
        Error::NotFound { .. } => 4,
        _ => 1,
    }
}

fn run(cli: &Cli) -> Result<ExitCode> {
    let Some(model) = &cli.model else { return Ok(ExitCode::SUCCESS) };
    let parameters = parameters(&cli.loading, &cli.options)?;
    if let Some(threads) = cli.options.threads {
        if !(1..=MAX_THREADS).contains(&threads) {
            return Err(invalid("--threads", format!("1 to {MAX_THREADS}"), threads));
        }
        rayon::ThreadPoolBuilder::new().num_threads(threads).build_global().map_err(fault_in("threads"))?;
    }
    let file = PartFile::read(model, &cli.loading.load_options())?;
    let out = cli.out.clone().unwrap_or_else(|| PathBuf::from(file.source().name).with_extension("npz"));
    let is_source = std::fs::canonicalize(&out).ok().is_some_and(|out| std::fs::canonicalize(model).ok() == Some(out));
    if is_source {
        return Err(invalid("--out", "another file than the part", format!("'{}'", out.display())));
    }
    let force_out = out.with_extension("cub");
    let outputs = [Some(&out), Some(&force_out).filter(|_| parameters.is_large)];
    for path in outputs.into_iter().flatten() {
        if path.exists() && !cli.force {
            let field = format!("file '{}'", path.display());
            return Err(invalid(field, "a new file (--force replaces an existing one)", "an existing file"));
        }
    }
    let reporter = Reporter::new(cli.progress);
    let modeling = file.compute_modes(&parameters, &|share, stage| reporter.report(share, stage))?;
    let bytes = model_file::encode(file.source(), &parameters, &modeling)?;
    // From here on, a signal ends the program only after the file is complete and has its name.
    let interrupted = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        signal_hook::flag::register(signal, interrupted.clone()).map_err(fault_in("signals"))?;
    }
    // The model is written last, because it has the hash of the forces: together they are complete.
    if let Some(large_motion) = &modeling.large_motion {
        model_file::write(&force_out, &large_motion.force.encode(), cli.force)?;
    }
    model_file::write(&out, &bytes, cli.force)?;
    reporter.finish();
    if interrupted.load(Ordering::Relaxed) {
        return Ok(ExitCode::from(INTERRUPTED));
    }
    let summary = match cli.json {
        true => format!("{}\n", summary::json(&out, &modeling)),
        false => summary::text(&out, &parameters, &modeling),
    };
    // The model is already written, so a closed stdout is not an error.
    std::io::stdout().write_all(summary.as_bytes()).ok();
    Ok(ExitCode::SUCCESS)
}

/// Reads the strings of the options.
fn parameters(loading: &LoadingOptions, options: &ModelingOptions) -> Result<ModelingParameters> {
    let default = ModelingParameters::default();
    let mut parameters = ModelingParameters {
        modes: options.modes.unwrap_or(if options.large { DEFAULT_LINEAR_MODES } else { default.modes }),
        is_large: options.large,
        max_frequency: options.max_frequency,
        freedoms: options.freedoms.unwrap_or(default.freedoms),
        damping_ratio: options.damping,
        unit: loading.unit.unwrap_or(default.unit),
        clamps: options.clamp.clone(),
        point_masses: options.point_mass.iter().map(|text| PointMass::parse(text)).collect::<Result<_>>()?,
        thickness: options.thickness,
        ..default
    };
    options.material.iter().try_for_each(|text| parameters.add_material(text))?;
    parameters.validated()
}
