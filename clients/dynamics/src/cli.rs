//! The command line of `modalcast-sim`.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Parser, Subcommand, ValueEnum};
use modalcast_client::{Delivery, MAX_STALL_BUDGET};
use modalcast_dynamics::bridge::LoadDirection;
use modalcast_dynamics::deflection::{VertexForce, VertexName};
use modalcast_dynamics::implicit::ImplicitMethod;
use modalcast_dynamics::slow_motion::slow_factor;

const EXAMPLES: &str = "\
Examples:
  modalcast-sim tree --forces --seconds 0 --realtime
  modalcast-sim --open tree --scene tree --steps 60 --json
  modalcast-sim --open simpleBridge --scene bridge --cubic simpleBridge.cub --seconds 4
  modalcast-sim fork --slow 100 --forces --seconds 0 --realtime
  modalcast-sim sweep --open MorphStressTest --scene morph --record out/record
  modalcast-sim tree --wind 12 --seconds 60 --realtime
  modalcast-sim part --free --forces --seconds 0 --realtime
  modalcast-sim static tree --force trunk:100:0,0,50 --json
  modalcast-sim tree --seconds 3600 --checkpoint tree.checkpoint
  modalcast-sim tree --seconds 3600 --checkpoint tree.checkpoint --resume tree.checkpoint

Exit codes: 0 done; 1 rejected by the server (unknown scene, or a scene with another writer); 2 invalid command line;
3 connection failed or lost; 4 local file error; 5 invalid content of a file, a scene or a reply; 6 done, but the server
rejected steps; 7 stopped before a step that has no solution, is not finite or is far out of range.";

/// Drives a scene of a modalcast server by the physics that the scene has. Eigenvalues: linear modes; domains that are
/// attached to each other (a tree) act on each other at their joints, and move in a wind. Cubic forces of large motion:
/// implicit integration, under a pulsating load on the middle (a bridge of the FEM library Vega) or under the forces of
/// viewers alone (a model of `modalcast model --large`). Neither: one mode after another is shown; with --forces,
/// which such a scene cannot follow, this is an error.
///
/// The notes damping_ratio and rigid_modes of a domain set its damping and the number of modes that are held still.
#[derive(Debug, Parser)]
#[command(name = "modalcast-sim", version, after_help = EXAMPLES, args_conflicts_with_subcommands = true)]
pub(crate) struct Cli {
    #[command(subcommand)]
    pub(crate) command: Option<Command>,
    #[command(flatten)]
    pub(crate) common: CommonOptions,
    #[command(flatten)]
    pub(crate) physics: PhysicsOptions,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Moves one coordinate after another; rocks a scene without coordinates. Needs no physics.
    #[command(after_help = EXAMPLES)]
    Sweep {
        #[command(flatten)]
        common: CommonOptions,
        /// Largest displacement as a fraction of the diagonal of the scene's bounds.
        #[arg(long = "share", value_name = "SHARE", default_value_t = SWEEP_SHARE, value_parser = parse_fraction)]
        displacement_fraction: f64,
    },
    /// Computes the displacements of a scene at rest under forces, and sends no steps. Domains that carry the loaded ones
    /// bend as well.
    #[command(after_help = EXAMPLES)]
    Static {
        #[command(flatten)]
        server: ServerOptions,
        /// A force in newtons and world axes at a vertex of a domain, which has a name or an index. Repeat for several
        /// forces.
        #[arg(
            long = "force",
            value_name = "DOMAIN:VERTEX:FX,FY,FZ",
            required = true,
            value_parser = parse_vertex_force,
            allow_hyphen_values = true
        )]
        forces: Vec<VertexForce>,
        /// A vertex whose displacement is reported, in addition to those with forces. Repeat for several vertices.
        #[arg(long = "at", value_name = "DOMAIN:VERTEX", value_parser = parse_vertex)]
        vertices: Vec<VertexName>,
    },
}

/// Largest displacement of a sweep as a fraction of the diagonal of the scene's bounds.
pub(crate) const SWEEP_SHARE: f64 = 0.06;

/// Options of the physics of a scene.
#[derive(Debug, Clone, Args)]
pub(crate) struct PhysicsOptions {
    #[command(flatten)]
    pub(crate) wind: WindOptions,
    /// Let every domain without a parent move and turn freely, with all that it carries: by the forces of viewers
    /// (--forces) and, with --wind, by the wind relative to it. Needs the masses of the domains, which plants have and
    /// `modalcast model` writes for parts without clamps. Linear modes; there is no gravity and no contact. A body that is
    /// more than 5 diagonals of the scene away returns to rest.
    #[arg(long, conflicts_with_all = ["cubic", "deflection_fraction"])]
    pub(crate) free: bool,
    #[command(flatten)]
    pub(crate) files: ForceFileOptions,
    #[command(flatten)]
    pub(crate) load: LoadOptions,
    #[command(flatten)]
    pub(crate) integration: IntegrationOptions,
}

/// The server, the scene, and the format of the output.
#[derive(Debug, Clone, Args)]
pub(crate) struct ServerOptions {
    /// URL of the server: http://HOST:PORT, https://HOST:PORT or unix:PATH.
    #[arg(long, env = "MODALCAST_SERVER", default_value = "http://127.0.0.1:50051")]
    pub(crate) server: String,
    /// Maximum time to retry until the server answers, in seconds.
    #[arg(long, default_value_t = 0.0, value_parser = parse_non_negative)]
    pub(crate) wait: f64,
    /// The scene's name on the server.
    #[arg(value_name = "SCENE", conflicts_with = "scene")]
    positional_scene: Option<String>,
    /// The scene's name on the server, as SCENE.
    #[arg(long, value_name = "NAME", default_value = "tree")]
    scene: String,
    /// First opens a scene from this source in the server's scene repository, and names it as --scene says.
    #[arg(long, value_name = "SOURCE")]
    pub(crate) open: Option<String>,
    /// Print a machine-readable summary on standard output.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct CommonOptions {
    #[command(flatten)]
    pub(crate) server: ServerOptions,
    /// Simulated time in seconds, with the time before a checkpoint that --resume continues; 0 runs until interrupted.
    #[arg(long, default_value_t = 10.0, value_parser = parse_non_negative)]
    pub(crate) seconds: f64,
    /// Number of steps, in place of --seconds; 0 runs until interrupted.
    #[arg(long, conflicts_with = "seconds")]
    pub(crate) steps: Option<u64>,
    /// Seconds per step, in which --realtime sends a step.
    #[arg(long, default_value_t = 1.0 / 60.0, value_parser = parse_positive)]
    pub(crate) dt: f64,
    /// Slow motion: the simulated time of a step is --dt divided by this factor. A tuning fork vibrates too fast for 60
    /// steps per second; at 100 its vibration is visible. auto: a factor with which the lowest frequency is visible, and
    /// 1 if it is at most 5 Hz.
    #[arg(long, value_name = "FACTOR|auto", default_value = "1", value_parser = parse_slow)]
    pub(crate) slow: SlowMotion,
    /// lossless: process every step; latest: skip to the newest step.
    #[arg(long, value_enum, default_value = "lossless")]
    pub(crate) delivery: DeliveryOption,
    /// Wait for acknowledgments, so that at most this many steps are in flight. 0 selects the server's default. Without
    /// this option the server slows the process down by flow control.
    #[arg(long, value_name = "STEPS")]
    pub(crate) window: Option<u32>,
    /// Seconds for which lossless readers, such as `modalcast record`, may make the run wait; at most a day (86400). The
    /// budget is refilled by a tenth of the elapsed time, and the server disconnects readers that exceed it. Default: that
    /// of the server, 2 s. Choose a large budget if a recording must have every step of a run that is faster than its
    /// reader.
    #[arg(long, value_name = "SECONDS", value_parser = parse_stall_budget)]
    pub(crate) stall_budget: Option<Duration>,
    /// Run in real time instead of as fast as possible.
    #[arg(long)]
    pub(crate) realtime: bool,
    /// Add the forces that viewers apply to the scene (ApplyForces). A scene that is neither a tree nor a bridge then
    /// moves by these forces alone.
    #[arg(long)]
    pub(crate) forces: bool,
    /// Write q.npy (steps x coordinates) and transforms.npy (steps x domains x 12), float32, into this folder. With
    /// --resume, a record in the folder continues after the steps of the checkpoint.
    #[arg(long, value_name = "DIR")]
    pub(crate) record: Option<PathBuf>,
    /// Write the state of the run into this file: regularly, and at the end or when interrupted (Ctrl-C, SIGTERM). The
    /// file is replaced at once, so that it is complete at any time.
    #[arg(long, value_name = "FILE")]
    pub(crate) checkpoint: Option<PathBuf>,
    /// Number of steps after which --checkpoint writes the file again.
    #[arg(
        long = "checkpoint-every",
        value_name = "STEPS",
        default_value_t = 600,
        value_parser = clap::value_parser!(u64).range(1..),
        requires = "checkpoint"
    )]
    pub(crate) checkpoint_interval: u64,
    /// Continue the run whose state is in this file, with the next step. Needs the same scene and the same options of
    /// the motion. On the same machine, all steps are those of a run without interruption, bit by bit. To write
    /// checkpoints again, add --checkpoint, also with the same file.
    #[arg(long, value_name = "FILE")]
    pub(crate) resume: Option<PathBuf>,
}

/// Slow motion of a run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum SlowMotion {
    /// Real seconds per simulated second.
    Factor(f64),
    /// By the lowest frequency of the scene.
    Auto,
}

/// The times of a run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Timing {
    /// Simulated seconds per step.
    pub(crate) dt: f64,
    /// Real seconds per simulated second, with --realtime.
    pub(crate) slow: f64,
    /// The number of steps; `None` for an unlimited run.
    pub(crate) steps: Option<u64>,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub(crate) enum DeliveryOption {
    Lossless,
    Latest,
}

impl From<DeliveryOption> for Delivery {
    fn from(option: DeliveryOption) -> Self {
        match option {
            DeliveryOption::Lossless => Self::Lossless,
            DeliveryOption::Latest => Self::Latest,
        }
    }
}

#[derive(Debug, Clone, Copy, Args)]
pub(crate) struct WindOptions {
    /// Mean speed of the wind at the crown in m/s: 4 moves leaves and twigs, 8 small branches, 20 breaks branches. The
    /// drag on all surfaces is proportional to the square of the speed. The wind has the spectrum of turbulence above
    /// suburbs or forest, and begins with its strongest gust. Default: 0 for a single body; if domains are attached to
    /// each other, at most 8, and less if its gusts would move a part by more than 0.3 of the height, or bend one by
    /// more than 0.3 of its size, at rest.
    #[arg(long = "wind", value_name = "SPEED", value_parser = parse_non_negative)]
    pub(crate) speed: Option<f64>,
    /// Direction that the wind blows to, in degrees about the up axis from x (from y if x is up). At 25, the
    /// default camera sees the sway from the side.
    #[arg(
        long = "direction",
        value_name = "DIRECTION",
        default_value_t = 25.0,
        value_parser = parse_degrees,
        allow_hyphen_values = true
    )]
    pub(crate) direction_degrees: f64,
    /// Random seed of the turbulence.
    #[arg(long, default_value_t = 7)]
    pub(crate) seed: u64,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct ForceFileOptions {
    /// The file of reduced cubic forces that `modalcast model --large` or the FEM library Vega wrote.
    #[arg(long, value_name = "FILE.cub")]
    pub(crate) cubic: Option<PathBuf>,
    /// Name or index of the domain that the cubic forces act on. Default: the one whose modes are those of the
    /// .URendering.float file next to the file of cubic forces, or else the one whose note `modes.cubic_sha256` has the
    /// hash of the file.
    #[arg(long, value_name = "DOMAIN")]
    pub(crate) domain: Option<String>,
    /// Vega's file of frequency scale and damping. Default: the .config file next to the file of cubic forces, if it
    /// exists.
    #[arg(long, value_name = "FILE.config")]
    pub(crate) config: Option<PathBuf>,
    /// Folder with the file of cubic forces. The note `vega.cubic` of the scene has the name of this file. The server
    /// adds the note to an OBJ or npz model that has a .cub file of the same name.
    #[arg(long = "files", value_name = "DIR")]
    pub(crate) folder: Option<PathBuf>,
}

#[derive(Debug, Clone, Copy, Args)]
pub(crate) struct LoadOptions {
    /// Deflection at equilibrium, as a fraction of the diagonal of the scene's bounds. 0: no load. Default: 0 if the
    /// domain has eigenvalues, as models of `modalcast model --large` have, else 0.03.
    #[arg(long = "deflection", value_name = "DEFLECTION", value_parser = parse_fraction)]
    pub(crate) deflection_fraction: Option<f64>,
    /// Period of the load in seconds.
    #[arg(long, default_value_t = 2.0, value_parser = parse_positive)]
    pub(crate) period: f64,
    /// Direction of the load: across the bridge and slightly upwards (a wind), down (a weight), or up.
    #[arg(long = "toward", value_name = "TOWARD", value_enum, default_value = "across")]
    pub(crate) direction: LoadDirectionOption,
}

#[derive(Debug, Clone, Copy, Args)]
pub(crate) struct IntegrationOptions {
    /// Integrator of cubic forces. average-vector-field conserves the energy; backward-euler damps fast vibrations.
    #[arg(long = "integrator", value_name = "INTEGRATOR", value_enum, default_value = "average-vector-field")]
    pub(crate) method: MethodOption,
    /// Integrate cubic forces with one step per step sent, instead of up to 64 sub-steps by an estimate of the error.
    #[arg(long = "fixed-step")]
    pub(crate) has_fixed_step: bool,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub(crate) enum MethodOption {
    AverageVectorField,
    BackwardEuler,
}

impl From<MethodOption> for ImplicitMethod {
    fn from(option: MethodOption) -> Self {
        match option {
            MethodOption::AverageVectorField => Self::AverageVectorField,
            MethodOption::BackwardEuler => Self::BackwardEuler,
        }
    }
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub(crate) enum LoadDirectionOption {
    Across,
    Down,
    Up,
}

impl From<LoadDirectionOption> for LoadDirection {
    fn from(option: LoadDirectionOption) -> Self {
        match option {
            LoadDirectionOption::Across => Self::Across,
            LoadDirectionOption::Down => Self::Down,
            LoadDirectionOption::Up => Self::Up,
        }
    }
}

impl Cli {
    /// The options of every kind of motion.
    pub(crate) const fn common(&self) -> &CommonOptions {
        match &self.command {
            Some(Command::Sweep { common, .. }) => common,
            Some(Command::Static { .. }) | None => &self.common,
        }
    }

    /// The server, the scene, and the format of the output.
    pub(crate) const fn server(&self) -> &ServerOptions {
        match &self.command {
            Some(Command::Static { server, .. }) => server,
            Some(Command::Sweep { .. }) | None => &self.common().server,
        }
    }
}

impl ServerOptions {
    /// The scene's name on the server.
    pub(crate) fn scene(&self) -> &str {
        self.positional_scene.as_deref().unwrap_or(&self.scene)
    }
}

impl CommonOptions {
    /// The times of a run of a scene whose lowest frequency in hertz is known, or unknown.
    pub(crate) fn timing(&self, lowest_frequency: Option<f64>) -> Timing {
        let slow = match self.slow {
            SlowMotion::Factor(factor) => factor,
            SlowMotion::Auto => lowest_frequency.map_or(1.0, slow_factor),
        };
        let dt = self.dt / slow;
        let steps = match (self.steps, self.seconds) {
            (Some(0), _) => None,
            (Some(steps), _) => Some(steps),
            (None, seconds) if seconds > 0.0 => Some((seconds / dt).ceil().max(1.0) as u64),
            (None, _) => None,
        };
        Timing { dt, slow, steps }
    }
}

fn parse_non_negative(text: &str) -> Result<f64, String> {
    let number = text.parse().ok().filter(|number| (0.0..=1e6).contains(number));
    number.ok_or_else(|| "expected a number from 0 to 1000000".into())
}

fn parse_vertex(text: &str) -> Result<VertexName, String> {
    // The name of a domain may have colons.
    let (domain, vertex) = text.rsplit_once(':').ok_or("expected DOMAIN:VERTEX")?;
    let vertex = vertex.parse().map_err(|_| format!("expected the index of a vertex, got '{vertex}'"))?;
    Ok(VertexName { domain: domain.to_owned(), vertex })
}

fn parse_vertex_force(text: &str) -> Result<VertexForce, String> {
    let (vertex, force) = text.rsplit_once(':').ok_or("expected DOMAIN:VERTEX:FX,FY,FZ")?;
    let numbers: Vec<f64> = force.split(',').filter_map(|number| number.trim().parse().ok()).collect();
    let force = <[f64; 3]>::try_from(numbers).ok().filter(|force| force.iter().all(|number| number.abs() <= 1e30));
    let force = force.ok_or("expected three numbers FX,FY,FZ of at most 1e30")?;
    Ok(VertexForce { vertex: parse_vertex(vertex)?, force })
}

fn parse_degrees(text: &str) -> Result<f64, String> {
    let degrees = text.parse().ok().filter(|degrees: &f64| degrees.abs() <= 360.0);
    degrees.ok_or_else(|| "expected degrees, -360 to 360".into())
}

fn parse_slow(text: &str) -> Result<SlowMotion, String> {
    match text {
        "auto" => Ok(SlowMotion::Auto),
        _ => parse_positive(text).map(SlowMotion::Factor).map_err(|error| format!("{error}, or auto")),
    }
}

fn parse_positive(text: &str) -> Result<f64, String> {
    let number = parse_non_negative(text)?;
    if number > 0.0 { Ok(number) } else { Err("expected a positive number".into()) }
}

fn parse_stall_budget(text: &str) -> Result<Duration, String> {
    let budget = text.parse().ok().and_then(|seconds| Duration::try_from_secs_f64(seconds).ok());
    budget
        .filter(|budget| !budget.is_zero() && *budget <= MAX_STALL_BUDGET)
        .ok_or_else(|| format!("expected a number of seconds above 0 and at most {}", MAX_STALL_BUDGET.as_secs()))
}

/// Parses a displacement as a fraction of the scene's diagonal or height, from 0 to 0.5.
fn parse_fraction(text: &str) -> Result<f64, String> {
    let number = parse_non_negative(text)?;
    if number <= 0.5 { Ok(number) } else { Err("expected 0 to 0.5".into()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn command_line_is_valid() {
        use clap::CommandFactory as _;
        Cli::command().debug_assert();
    }

    #[test]
    fn slow_motion_divides_the_simulated_time() {
        let parse = |arguments: &[&str]| Cli::try_parse_from([&["modalcast-sim"][..], arguments].concat());
        let cli = parse(&["fork", "--slow", "100", "--dt", "0.5", "--seconds", "2"]).expect("valid arguments");
        let common = cli.common();
        let timing = Timing { dt: 0.005, slow: 100.0, steps: Some(400) };
        assert_eq!((common.server.scene(), common.timing(Some(5000.0))), ("fork", timing));
        let sweep = parse(&["sweep", "fork", "--dt", "0.5", "--seconds", "2"]).expect("valid arguments");
        assert_eq!((sweep.server().scene(), sweep.common().timing(None).steps), ("fork", Some(4)));
        assert_eq!(parse(&[]).expect("valid arguments").server().scene(), "tree");
        let auto = parse(&["--slow", "auto", "--dt", "0.5", "--steps", "9"]).expect("valid arguments");
        assert_eq!(auto.common().timing(Some(206.0)), Timing { dt: 0.005, slow: 100.0, steps: Some(9) });
        assert_eq!(auto.common().timing(None), Timing { dt: 0.5, slow: 1.0, steps: Some(9) });
        for invalid in [&["fork", "--scene", "tree"][..], &["--slow", "0"], &["--slow", "nan"]] {
            assert!(parse(invalid).is_err(), "{invalid:?}");
        }
    }

    #[test]
    fn forces_at_vertices_are_parsed_from_the_end() {
        let vertex = VertexName { domain: "limb: 3".into(), vertex: 7 };
        assert_eq!(parse_vertex("limb: 3:7"), Ok(vertex.clone()));
        assert_eq!(parse_vertex_force("limb: 3:7:0,-1.5,2e-2"), Ok(VertexForce { vertex, force: [0.0, -1.5, 0.02] }));
        for text in ["limb:7", "limb:7:1,2", "limb:7:1,2,x", "limb:7:1,2,nan", "limb:-7:1,2,3", "7:1,2,3", "1,2,3", ""]
        {
            assert!(parse_vertex_force(text).is_err(), "{text}");
        }
    }

    #[test]
    fn invalid_numbers_are_rejected() {
        for text in ["nan", "-1", "inf", "x", ""] {
            assert!(parse_non_negative(text).is_err(), "{text}");
        }
        assert!(parse_positive("0").is_err() && parse_fraction("0.6").is_err() && parse_fraction("0.5").is_ok());
    }
}
