//! The command line of `modalcast-fetch`.

use std::path::{Path, PathBuf};

use clap::{Args, Parser, Subcommand, ValueEnum};
use modalcast_client::{Camera, Delivery, FrameFormat, Lens, Output, Picture, StepSelector, View};

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

/// Saves frames or vertices from a modalcast server, prints its scenes and settings, and resets or closes scenes.
#[derive(Debug, Parser)]
#[command(name = "modalcast-fetch", version, after_help = EXAMPLES)]
pub(crate) struct Cli {
    /// URL of the server: http://HOST:PORT or unix:PATH.
    #[arg(long, global = true, env = "MODALCAST_SERVER", default_value = "http://127.0.0.1:50051")]
    pub(crate) server: String,
    /// Receive frames and vertices in shared memory. PATH is the Unix socket of `modalcast serve --shared-memory PATH` on this machine.
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
    /// Return a scene to its rest state.
    Reset {
        /// The scene's name on the server.
        #[arg(long)]
        scene: String,
        /// Replace the physics process that drives the scene. Without this option, such a scene is not changed.
        #[arg(long)]
        take_over: bool,
    },
    /// Close a scene; the server deletes the files of an uploaded scene.
    Close {
        /// The scene's name on the server.
        #[arg(long)]
        scene: String,
    },
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

/// Options of the picture.
#[derive(Debug, Args)]
pub(crate) struct PictureOptions {
    /// Image size in pixels.
    #[arg(long, default_value = "1280x720", value_name = "WxH", value_parser = parse_size)]
    size: (u32, u32),
    /// Content of the picture: color, depth (f32 meters), domains (u32), normals (3 f32), or a color map of
    /// `displacement` or `mode-shape` with a legend. Several, separated by commas, are saved as one file each, with the
    /// name of the output at the end of the file name; all show the same step.
    #[arg(long = "output", value_enum, default_value = "color", value_delimiter = ',')]
    outputs: Vec<OutputOption>,
    /// Index of the column of U for `--output mode-shape`, from 0.
    #[arg(long, requires = "outputs", default_value_t = 0)]
    mode: u32,
    /// Value at the bright end of the color map, in meters (`displacement`) or meters per unit of q (`mode-shape`); 0
    /// fits the color map to each frame.
    #[arg(long = "largest", value_name = "VALUE", requires = "outputs", default_value_t = 0.0)]
    scale_max: f64,
    /// Encoding of color pictures and color maps: PNG, JPEG, or raw RGBA8 (top row first, sRGB). Default: that of the
    /// extension of a single file (.jpg, .jpeg or .rgba), else PNG.
    #[arg(long, value_enum)]
    pub(crate) format: Option<FormatOption>,
    /// Quality of JPEG, 1 (smallest file) to 100 (smallest error). Default: 90. Ignored by other formats.
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=100))]
    quality: Option<u32>,
    /// Position of the camera in scene units. Default: a camera that shows the whole scene.
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_vector, requires = "target", allow_hyphen_values = true)]
    eye: Option<[f64; 3]>,
    /// Point that the camera looks at, in scene units.
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_vector, requires = "eye", allow_hyphen_values = true)]
    target: Option<[f64; 3]>,
    /// Up direction of the camera. Default: the up axis of the scene.
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_vector, requires = "eye", allow_hyphen_values = true)]
    up: Option<[f64; 3]>,
    /// Vertical field of view in degrees. Default: 35.
    #[arg(long, requires = "eye", value_name = "DEGREES")]
    field_of_view: Option<f64>,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub(crate) enum FormatOption {
    Png,
    Jpeg,
    Raw,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub(crate) enum OutputOption {
    Color,
    Depth,
    DepthWithGround,
    Domains,
    Normals,
    Displacement,
    ModeShape,
}

impl PictureOptions {
    /// One picture per output.
    pub(crate) fn pictures(&self) -> Vec<Picture> {
        self.pictures_in(self.format.unwrap_or(FormatOption::Png))
    }

    /// One picture per output, for a single file. Its extension selects the encoding unless `--format` does.
    pub(crate) fn pictures_for_file(&self, path: &Path) -> Vec<Picture> {
        let extension = path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
        self.pictures_in(self.format.unwrap_or(match extension.as_str() {
            "jpg" | "jpeg" => FormatOption::Jpeg,
            "rgba" => FormatOption::Raw,
            _ => FormatOption::Png,
        }))
    }

    fn pictures_in(&self, format: FormatOption) -> Vec<Picture> {
        self.outputs.iter().map(|output| self.picture(*output, format)).collect()
    }

    /// The end of the file name of each picture: empty for a single picture, else `_` and the name of its output.
    pub(crate) fn file_suffixes(&self) -> Vec<String> {
        let suffix = |output: &OutputOption| match (self.outputs.len(), output.to_possible_value()) {
            (2.., Some(value)) => format!("_{}", value.get_name()),
            _ => String::new(),
        };
        self.outputs.iter().map(suffix).collect()
    }

    fn picture(&self, output: OutputOption, format: FormatOption) -> Picture {
        let view = self.eye.zip(self.target).map(|(eye, target)| View::LookAt { eye, target, up: self.up });
        let camera =
            view.map(|view| Camera { view, lens: Lens::FieldOfView(self.field_of_view.unwrap_or(35.0)), clip: None });
        let format = match format {
            FormatOption::Png => FrameFormat::Png,
            FormatOption::Jpeg => FrameFormat::Jpeg,
            FormatOption::Raw => FrameFormat::Rgba,
        };
        let (mode, scale_max) = (self.mode, self.scale_max);
        let output = match output {
            OutputOption::Color => Output::Color,
            OutputOption::Depth => Output::Depth,
            OutputOption::DepthWithGround => Output::DepthWithGround,
            OutputOption::Domains => Output::Domains,
            OutputOption::Normals => Output::Normals,
            OutputOption::Displacement => Output::Displacement { scale_max },
            OutputOption::ModeShape => Output::ModeShape { mode, scale_max },
        };
        let jpeg_quality = self.quality.unwrap_or(0);
        Picture { width: self.size.0, height: self.size.1, format, camera, output, jpeg_quality, edge_width: None }
    }
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
    /// Run of the step; 0 selects the run of the latest writer.
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

fn parse_size(text: &str) -> Result<(u32, u32), String> {
    let size = text.split_once('x').and_then(|(width, height)| Some((width.parse().ok()?, height.parse().ok()?)));
    size.filter(|(width, height)| *width > 0 && *height > 0)
        .ok_or_else(|| "expected WIDTHxHEIGHT with positive integers, such as 1280x720".into())
}

fn parse_vector(text: &str) -> Result<[f64; 3], String> {
    let numbers: Option<Vec<f64>> = text.split(',').map(|number| number.trim().parse().ok()).collect();
    let vector = numbers.and_then(|numbers| <[f64; 3]>::try_from(numbers).ok());
    vector
        .filter(|vector| vector.iter().all(|component| component.is_finite()))
        .ok_or_else(|| "expected three finite numbers X,Y,Z".into())
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

    /// The options of `frame` with these arguments.
    fn picture_options(arguments: &[&str]) -> PictureOptions {
        let command = [&["modalcast-fetch", "frame", "--scene", "tree", "--out", "x.png"], arguments].concat();
        match Cli::try_parse_from(command).expect("expected valid arguments").command {
            Command::Frame(options) => options.picture,
            other => panic!("expected the command `frame`, got {other:?}"),
        }
    }

    #[test]
    fn outputs_are_pictures_with_their_own_files() {
        let single = picture_options(&["--output", "depth"]);
        assert_eq!((single.pictures()[0].output, single.file_suffixes()), (Output::Depth, vec![String::new()]));
        let several = picture_options(&["--output", "color,mode-shape", "--mode", "2", "--format", "jpeg"]);
        assert_eq!(several.file_suffixes(), ["_color", "_mode-shape"]);
        let outputs = several.pictures().into_iter().map(|picture| (picture.format, picture.output));
        let expected = [Output::Color, Output::ModeShape { mode: 2, scale_max: 0.0 }];
        assert!(outputs.eq(expected.map(|output| (FrameFormat::Jpeg, output))));
        assert_eq!(picture_options(&["--format", "jpeg", "--quality", "35"]).pictures()[0].jpeg_quality, 35);
        for (arguments, file, format) in [
            (&[][..], "x.jpg", FrameFormat::Jpeg),
            (&[], "x.y.JPEG", FrameFormat::Jpeg),
            (&[], "x.rgba", FrameFormat::Rgba),
            (&[], "x", FrameFormat::Png),
            (&["--format", "png"], "x.jpg", FrameFormat::Png),
        ] {
            assert_eq!(picture_options(arguments).pictures_for_file(Path::new(file))[0].format, format, "{file}");
        }
    }

    #[test]
    fn valid_sizes_and_vectors_are_parsed() {
        assert_eq!(parse_size("1280x720"), Ok((1280, 720)));
        assert_eq!(parse_vector("1, -2,.5"), Ok([1.0, -2.0, 0.5]));
    }

    #[test]
    fn invalid_sizes_vectors_and_seconds_are_rejected() {
        for text in ["", "1280", "0x5", "-1x5", "axb", "5x5x5"] {
            assert!(parse_size(text).is_err(), "{text}");
        }
        for text in ["", "1,2", "1,2,3,4", "1,2,nan", "inf,0,0"] {
            assert!(parse_vector(text).is_err(), "{text}");
        }
        assert!(parse_seconds("-1").is_err() && parse_seconds("nan").is_err());
    }
}
