//! The command line of `modalcast-sim`.

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};
use modalcast_client::Policy;
use modalcast_dynamics::bridge::Toward;

const EXAMPLES: &str = "\
Examples:
  modalcast-sim tree --open tree --scene tree --steps 60 --json
  modalcast-sim bridge --open simpleBridge --scene bridge --cubic simpleBridge.cub --seconds 4
  modalcast-sim sweep --open MorphStressTest --scene morph --record out/record
  modalcast-sim auto --scene demo --files ../data/vega/simpleBridge --seconds 0 --realtime

Exit codes: 0 done; 1 the server refused (no such scene, or another writer holds it); 2 bad command line;
3 no connection, or lost; 4 a local file; 5 a file, a scene or a reply does not fit; 6 done, but steps were rejected.";

/// Moves a scene of a modalcast server: wind on trees, a load on a bridge, or a sweep through all coordinates.
#[derive(Debug, Parser)]
#[command(name = "modalcast-sim", version, after_help = EXAMPLES)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    pub(crate) command: Command,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Wind, by modal superposition: exact for every mode. The scene must state eigenvalues.
    #[command(after_help = EXAMPLES)]
    Tree {
        #[command(flatten)]
        common: Common,
        #[command(flatten)]
        wind: Wind,
    },
    /// A pulsating load in the middle, by Vega's reduced cubic forces under implicit Newmark.
    #[command(after_help = EXAMPLES)]
    Bridge {
        #[command(flatten)]
        common: Common,
        #[command(flatten)]
        files: Files,
        #[command(flatten)]
        load: Load,
    },
    /// Every coordinate in its turn; a rigid scene rocks.
    #[command(after_help = EXAMPLES)]
    Sweep {
        #[command(flatten)]
        common: Common,
        /// The largest displacement as a share of the diagonal.
        #[arg(long, default_value_t = 0.06, value_parser = share)]
        share: f64,
    },
    /// The bridge when cubic forces are there, else the tree when eigenvalues are, else the sweep.
    #[command(after_help = EXAMPLES)]
    Auto {
        #[command(flatten)]
        common: Common,
        #[command(flatten)]
        files: Files,
        #[command(flatten)]
        load: Load,
        #[command(flatten)]
        wind: Wind,
        /// The sweep's largest displacement as a share of the diagonal.
        #[arg(long, default_value_t = 0.06, value_parser = share)]
        share: f64,
    },
}

#[derive(Debug, Clone, Args)]
pub(crate) struct Common {
    /// The server.
    #[arg(long, env = "MODALCAST_SERVER", default_value = "http://127.0.0.1:50051")]
    pub(crate) server: String,
    /// Seconds to keep trying until the server answers.
    #[arg(long, default_value_t = 0.0, value_parser = number)]
    pub(crate) wait: f64,
    /// The scene's name on the server.
    #[arg(long, default_value = "tree")]
    pub(crate) scene: String,
    /// Open this source of the server's repository under that name first.
    #[arg(long, value_name = "SOURCE")]
    pub(crate) open: Option<String>,
    /// Seconds of simulation; 0 runs until interrupted.
    #[arg(long, default_value_t = 10.0, value_parser = number)]
    pub(crate) seconds: f64,
    /// Steps of simulation instead; 0 runs until interrupted.
    #[arg(long, conflicts_with = "seconds")]
    pub(crate) steps: Option<u64>,
    /// Seconds per step.
    #[arg(long, default_value_t = 1.0 / 60.0, value_parser = positive)]
    pub(crate) dt: f64,
    /// Every step is shown, or the newest.
    #[arg(long, value_enum, default_value = "lossless")]
    pub(crate) policy: PolicyOption,
    /// Steps without acknowledgement; 0 leaves it to the server.
    #[arg(long, default_value_t = 0)]
    pub(crate) window: u32,
    /// Keep pace with the clock instead of going as fast as possible.
    #[arg(long)]
    pub(crate) realtime: bool,
    /// Write q.npy (steps x coordinates) and transforms.npy (steps x domains x 12), float32, into this folder.
    #[arg(long, value_name = "DIR")]
    pub(crate) record: Option<PathBuf>,
    /// Print a machine-readable summary on standard output.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub(crate) enum PolicyOption {
    Lossless,
    Latest,
}

impl From<PolicyOption> for Policy {
    fn from(option: PolicyOption) -> Self {
        match option {
            PolicyOption::Lossless => Self::Lossless,
            PolicyOption::Latest => Self::Latest,
        }
    }
}

#[derive(Debug, Clone, Copy, Args)]
pub(crate) struct Wind {
    /// Strength: 1 sways the crown by `--sway`.
    #[arg(long, default_value_t = 1.0, value_parser = number)]
    pub(crate) wind: f64,
    /// The crown's peak displacement at wind 1, as a share of the height.
    #[arg(long, default_value_t = 0.05, value_parser = share)]
    pub(crate) sway: f64,
    /// Where the wind blows to, in degrees about up from the first horizontal axis; at 25 the default camera sees the
    /// sway from the side.
    #[arg(long, default_value_t = 25.0, value_parser = angle, allow_hyphen_values = true)]
    pub(crate) direction: f64,
    /// Seed of the turbulence.
    #[arg(long, default_value_t = 7)]
    pub(crate) seed: u64,
}

#[derive(Debug, Clone, Args)]
pub(crate) struct Files {
    /// Vega's file of reduced cubic forces.
    #[arg(long, value_name = "FILE.cub")]
    pub(crate) cubic: Option<PathBuf>,
    /// Vega's settings; without it the file beside the forces, if there is one.
    #[arg(long, value_name = "FILE.config")]
    pub(crate) config: Option<PathBuf>,
    /// A folder in which to look for the cubic forces.
    #[arg(long, value_name = "DIR")]
    pub(crate) files: Option<PathBuf>,
}

#[derive(Debug, Clone, Copy, Args)]
pub(crate) struct Load {
    /// Deflection in equilibrium, as a share of the diagonal.
    #[arg(long, default_value_t = 0.03, value_parser = share)]
    pub(crate) deflection: f64,
    /// Seconds per pulse.
    #[arg(long, default_value_t = 2.0, value_parser = positive)]
    pub(crate) period: f64,
    /// Where it pushes: across the span with some lift (a wind), down (a weight), or up.
    #[arg(long, value_enum, default_value = "across")]
    pub(crate) toward: TowardOption,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub(crate) enum TowardOption {
    Across,
    Down,
    Up,
}

impl From<TowardOption> for Toward {
    fn from(option: TowardOption) -> Self {
        match option {
            TowardOption::Across => Self::Across,
            TowardOption::Down => Self::Down,
            TowardOption::Up => Self::Up,
        }
    }
}

impl Command {
    pub(crate) const fn common(&self) -> &Common {
        match self {
            Self::Tree { common, .. }
            | Self::Bridge { common, .. }
            | Self::Sweep { common, .. }
            | Self::Auto { common, .. } => common,
        }
    }

    pub(crate) const fn name(&self) -> &'static str {
        match self {
            Self::Tree { .. } => "tree",
            Self::Bridge { .. } => "bridge",
            Self::Sweep { .. } => "sweep",
            Self::Auto { .. } => "auto",
        }
    }
}

fn number(text: &str) -> Result<f64, String> {
    let parsed = text.parse().ok().filter(|number| (0.0..=1e6).contains(number));
    parsed.ok_or_else(|| "expected a number from 0 to 1000000".into())
}

fn angle(text: &str) -> Result<f64, String> {
    let parsed = text.parse().ok().filter(|number: &f64| number.abs() <= 360.0);
    parsed.ok_or_else(|| "expected degrees, -360 to 360".into())
}

fn positive(text: &str) -> Result<f64, String> {
    number(text).and_then(|number| if number > 0.0 { Ok(number) } else { Err("expected a positive number".into()) })
}

fn share(text: &str) -> Result<f64, String> {
    number(text).and_then(|number| if number <= 0.5 { Ok(number) } else { Err("expected 0 to 0.5".into()) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_sound() {
        use clap::CommandFactory as _;
        Arguments::command().debug_assert();
    }

    #[test]
    fn nonsense_is_refused() {
        for wrong in ["nan", "-1", "inf", "x", ""] {
            assert!(number(wrong).is_err(), "{wrong}");
        }
        assert!(positive("0").is_err() && share("0.6").is_err() && share("0.5").is_ok());
    }
}
