//! The command line of `modalcast-fetch`.

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};
use modalcast_client::program::PictureOptions;
use modalcast_client::{Delivery, StepSelector};

const EXAMPLES: &str = "\
Examples:
  modalcast-fetch frames --scene tree --open tree --count 60 --size 1280x720 --out out
  modalcast-fetch frame --scene tree --min-step 10 --out frame.png
  modalcast-fetch frame --scene tree --output color,depth,normals --out tree.png
  modalcast-fetch frames --scene tree --format jpeg --quality 80 --delivery latest --max-hz 10 --out out
  modalcast-fetch vertices --scene tree --count 60 --out vertices.npy --json
  modalcast-fetch --server http://10.0.0.2:50051 info

`frames`, and `vertices` with --count, print the line `ready` on standard output when the server has accepted the
subscription. The program then receives every step of a physics process that starts after that line.

Exit codes: 0 done; 1 rejected by the server; 2 invalid command line; 3 connection failed or lost; 4 local file error;
5 malformed, truncated or late reply.";

const CLIENTS_EXAMPLES: &str = "\
Examples:
  modalcast clients
  modalcast clients --json
  modalcast clients --end anna/process-4711
  modalcast clients --end 'anonymous/*' --server unix:/srv/modalcast/server.sock

SHARE is the largest part of a limit that the client holds, FOR the time for which it holds something, and IDLE the time
since its last step, reply or frame.";

/// Saves frames or vertices from a modalcast server, prints its scenes, settings and clients, and resets or closes scenes.
#[derive(Debug, Parser)]
#[command(name = "modalcast-fetch", version, after_help = EXAMPLES)]
pub(crate) struct Cli {
    /// URL of the server: http://HOST:PORT, https://HOST:PORT or unix:PATH.
    #[arg(long, global = true, env = "MODALCAST_SERVER", default_value = "http://127.0.0.1:50051")]
    pub(crate) server: String,
    /// Receive frames and vertices in shared memory. PATH is the Unix socket of `modalcast serve --shared-memory PATH`
    /// on this machine.
    #[arg(long, global = true, value_name = "PATH")]
    pub(crate) shared_memory: Option<PathBuf>,
    /// How long to retry until the server answers, in seconds.
    #[arg(long, global = true, default_value_t = 0.0, value_parser = parse_seconds)]
    pub(crate) wait: f64,
    /// Print a machine-readable summary on standard output.
    #[arg(long, global = true)]
    pub(crate) json: bool,
    #[command(subcommand)]
    pub(crate) command: Command,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Save one frame per step.
    #[command(after_help = EXAMPLES)]
    Frames(FrameStreamOptions),
    /// Save one frame.
    #[command(after_help = EXAMPLES)]
    Frame(SingleFrameOptions),
    /// Save deformed vertices as a NumPy file, steps x vertices x 3.
    #[command(after_help = EXAMPLES)]
    Vertices(VerticesOptions),
    /// Print backend, renderer and limits of the server.
    Info,
    /// List the open scenes and the sources that can be opened.
    List,
    /// List the clients with what they hold of limited resources, or end some. Needs the role `admin`.
    #[command(after_help = CLIENTS_EXAMPLES)]
    Clients(ClientsOptions),
    /// Return a scene to its rest state.
    Reset {
        /// The scene's name on the server.
        #[arg(long)]
        scene: String,
        /// Replace the physics process that drives the scene. Without this option, such a scene is not changed.
        #[arg(long)]
        take_over: bool,
    },
    /// Print a link to the viewer, which is valid once.
    Link {
        /// The principal whose rights the link gives. Default: your own.
        #[arg(default_value = "")]
        principal: String,
        /// The scene to show.
        #[arg(long)]
        scene: Option<String>,
    },
    /// Share a scene with other principals, in place of those with whom it was shared.
    Share {
        /// The scene's name on the server.
        scene: String,
        /// Names of principals, or '*' for all. Without names, the scene is no longer shared.
        principals: Vec<String>,
    },
    /// Close a scene; the server deletes the files of an uploaded scene.
    Close {
        /// The scene's name on the server.
        #[arg(long)]
        scene: String,
    },
}

#[derive(Debug, Args)]
pub(crate) struct ClientsOptions {
    /// End the connections, streams and waiting requests of a client, by its id in the list, or of all clients of a
    /// principal except this command: 'anna/*'. Open scenes stay open.
    #[arg(long, value_name = "ID", conflicts_with = "all")]
    pub(crate) end: Vec<String>,
    /// Show all clients. Without this option, the table shows ten of each principal.
    #[arg(long)]
    pub(crate) all: bool,
}

/// Options that select the scene.
#[derive(Debug, Args)]
pub(crate) struct SceneOptions {
    /// The scene's name on the server.
    #[arg(long)]
    pub(crate) scene: String,
    /// Source to open before the command (`list` prints the sources). The scene gets the name --scene.
    #[arg(long, value_name = "SOURCE")]
    pub(crate) open: Option<String>,
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

#[derive(Debug, Args)]
pub(crate) struct FrameStreamOptions {
    #[command(flatten)]
    pub(crate) scene: SceneOptions,
    #[command(flatten)]
    pub(crate) picture: PictureOptions,
    /// Number of steps. Each has one frame per output.
    #[arg(long, default_value_t = 60, value_parser = clap::value_parser!(u64).range(1..))]
    pub(crate) count: u64,
    /// Folder for frame_00000.png and so on; created if it does not exist.
    #[arg(long, value_name = "DIR")]
    pub(crate) out: PathBuf,
    /// lossless: receive every step; latest: skip to the newest step.
    #[arg(long, value_enum, default_value = "lossless")]
    pub(crate) delivery: DeliveryOption,
    /// Maximum number of steps per second, with `--delivery latest` only; 0 for no limit.
    #[arg(long, default_value_t = 0.0)]
    pub(crate) max_hz: f64,
    /// How long to wait for the next frame, in seconds.
    #[arg(long, default_value_t = 120.0, value_parser = parse_seconds)]
    pub(crate) timeout: f64,
}

/// Options that select the step.
#[derive(Debug, Args)]
pub(crate) struct StepOptions {
    /// Number of the step.
    #[arg(long, conflicts_with = "min_step")]
    pub(crate) step: Option<u64>,
    /// Smallest accepted step number: the reply has this step or a later one.
    #[arg(long)]
    pub(crate) min_step: Option<u64>,
    /// Run of the step: the number of the writer that sends the step; 0 selects the latest writer.
    #[arg(long, default_value_t = 0)]
    pub(crate) run: u64,
    /// How long the server may wait for the step, in milliseconds; 0 selects the server's default.
    #[arg(long, default_value_t = 0)]
    pub(crate) deadline_ms: u32,
}

impl StepOptions {
    pub(crate) fn selector(&self) -> StepSelector {
        let run = self.run;
        match (self.step, self.min_step) {
            (Some(number), _) => StepSelector::Exact { run, number },
            (None, Some(number)) => StepSelector::Minimum { run, number },
            (None, None) => StepSelector::Current,
        }
    }
}

#[derive(Debug, Args)]
pub(crate) struct SingleFrameOptions {
    #[command(flatten)]
    pub(crate) scene: SceneOptions,
    #[command(flatten)]
    pub(crate) picture: PictureOptions,
    #[command(flatten)]
    pub(crate) step: StepOptions,
    /// File to write.
    #[arg(long, value_name = "FILE")]
    pub(crate) out: PathBuf,
}

#[derive(Debug, Args)]
pub(crate) struct VerticesOptions {
    #[command(flatten)]
    pub(crate) scene: SceneOptions,
    #[command(flatten)]
    pub(crate) step: StepOptions,
    /// NumPy file for positions, float32, steps x vertices x 3.
    #[arg(long, value_name = "FILE.npy")]
    pub(crate) out: PathBuf,
    /// NumPy file for normals, float32, steps x corners x 3. A corner is a vertex with one of its normals.
    #[arg(long, value_name = "FILE.npy")]
    pub(crate) normals: Option<PathBuf>,
    /// NumPy file for u = U q, float32, steps x vertices x 3. Requires deform.displacements in scene.toml.
    #[arg(long, value_name = "FILE.npy")]
    pub(crate) displacements: Option<PathBuf>,
    /// NumPy file for bounding boxes, float32, steps x domains x 2 x 3. Requires deform.boxes in scene.toml.
    #[arg(long, value_name = "FILE.npy")]
    pub(crate) boxes: Option<PathBuf>,
    /// Domain indices, separated by commas. Default: all domains.
    #[arg(long, value_delimiter = ',')]
    pub(crate) domains: Vec<u32>,
    /// Transfer about half of the bytes: positions and displacements as 16-bit numbers in boxes of 256 vertices (error:
    /// 1/131070 of a box), normals with an error of 0.004 degrees. The files are float32 all the same.
    #[arg(long)]
    pub(crate) compact: bool,
    /// Subscribe and receive this many steps. Default: one step by a single request.
    #[arg(long, conflicts_with_all = ["step", "min_step"], value_parser = clap::value_parser!(u64).range(1..))]
    pub(crate) count: Option<u64>,
    /// lossless: receive every step; latest: skip to the newest step.
    #[arg(long, value_enum, default_value = "lossless")]
    pub(crate) delivery: DeliveryOption,
    /// Maximum number of steps per second, with `--count` and `--delivery latest` only; 0 for no limit.
    #[arg(long, default_value_t = 0.0)]
    pub(crate) max_hz: f64,
    /// How long to wait for the next step, in seconds.
    #[arg(long, default_value_t = 120.0, value_parser = parse_seconds)]
    pub(crate) timeout: f64,
}

fn parse_seconds(text: &str) -> Result<f64, String> {
    let seconds = text.parse().ok().filter(|seconds| (0.0..=1e6).contains(seconds));
    seconds.ok_or_else(|| "expected seconds, 0 to 1000000".into())
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
    fn invalid_seconds_are_rejected() {
        assert!(parse_seconds("-1").is_err() && parse_seconds("nan").is_err());
    }
}
