//! `modalcast render`: renders one frame without a server.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::loading_options::LoadingOptions;
use super::options::{parse_point, remark_lines, with_spinner};
use super::{Completion, Outcome, print_line};
use crate::config::{BackendChoice, Config, RendererChoice};
use crate::engine::{DeviceContext, FrameInfo, FrameOutput, LoadedScene, validate_mode};
use crate::frame;
use modalcast_model::error::{Error, Result, fault, invalid};
use modalcast_model::load::{self, OpenedScene};
use modalcast_model::scene::{Camera, FrameSize, FrameStyle, Lens, LookPreset, MeshEdges, Scene, SceneState, View};

/// Renders one frame of a scene to a PNG or JPEG file.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  modalcast render tree --out tree.png
  modalcast render path/to/simpleBridge --q bent.npy --out bridge.png --size 1920x1080
  modalcast render part.stl --unit mm --up y --out part.png
  modalcast render model.glb --out side.png --eye 4,1,0 --target 0,1,0 --look best
  modalcast render tree --q bent.npy --output displacement --largest 0.5 --out moved.png")]
pub(super) struct Args {
    /// A built-in name, a folder with scene.toml, a .glb, .gltf, .obj, .ply, .stl, .npz or
    /// .structure.json file, or a folder with one model.
    scene: String,
    #[command(flatten)]
    loading: LoadingOptions,
    /// Coordinates q of all domains in order, concatenated: a one-dimensional .npy file of f32 or f64. Default: at
    /// rest.
    #[arg(long)]
    q: Option<PathBuf>,
    /// File to write. Its extension selects PNG (.png) or JPEG (.jpg, .jpeg; quality 90).
    #[arg(long)]
    out: PathBuf,
    /// Image size in pixels.
    #[arg(long, default_value = "1280x720")]
    size: FrameSize,
    /// Position of the camera in scene units. Default: a camera that frames the scene.
    #[arg(long, value_parser = parse_point, value_name = "X,Y,Z", allow_hyphen_values = true, requires = "target")]
    eye: Option<[f64; 3]>,
    /// Point that the camera looks at, in scene units.
    #[arg(long, value_parser = parse_point, value_name = "X,Y,Z", allow_hyphen_values = true, requires = "eye")]
    target: Option<[f64; 3]>,
    /// Up direction of the camera. Default: the scene's up axis.
    #[arg(long, value_parser = parse_point, value_name = "X,Y,Z", allow_hyphen_values = true, requires = "eye")]
    camera_up: Option<[f64; 3]>,
    /// Vertical field of view in degrees. Default: 35.
    #[arg(long, requires = "eye", value_name = "DEGREES")]
    field_of_view: Option<f64>,
    /// Content of the picture: color, or a color map with a legend.
    #[arg(long, value_enum, default_value_t)]
    output: OutputOption,
    /// Index of the column of U for `--output mode-shape`, from 0.
    #[arg(long, requires = "output", default_value_t = 0)]
    mode: u32,
    /// Value at the bright end of the color map, in meters (`displacement`) or meters per unit of q (`mode-shape`); 0
    /// fits the color map to the frame.
    #[arg(long, requires = "output", default_value_t = 0.0)]
    largest: f64,
    /// Draws lines along the edges of the faces, of this width. Default: as `look.edges` of the scene. 0: no lines.
    #[arg(long, value_name = "PIXELS", num_args = 0..=1, default_missing_value = "1.25", conflicts_with = "output")]
    edges: Option<f32>,
    /// Preset of the antialiasing and the shadow map: preview, standard or best. Replaces the preset of the scene, but
    /// no other keys of the table `look` in scene.toml. Default: the preset of the scene; without one, the settings for
    /// a GPU (four samples per pixel and a large shadow map), also on a machine without a GPU.
    #[arg(long, value_name = "PRESET")]
    look: Option<LookPreset>,
    /// Deformation backend.
    #[arg(long, value_enum, default_value_t)]
    backend: BackendChoice,
    /// OpenGL renderer.
    #[arg(long, value_enum, default_value_t)]
    renderer: RendererChoice,
}

/// The values of `--output`.
#[derive(Debug, Clone, Copy, Default, clap::ValueEnum)]
enum OutputOption {
    #[default]
    Color,
    Displacement,
    ModeShape,
}

/// The format of the written file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum FileFormat {
    Png,
    Jpeg,
}

/// Quality of JPEG files, 1 to 100.
const JPEG_QUALITY: u8 = 90;

impl FileFormat {
    /// The format of a file by its extension, in any letter case.
    ///
    /// # Errors
    /// `Invalid` for an unknown extension.
    fn of(path: &Path) -> Result<Self> {
        let extension = path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
        match extension.as_str() {
            "png" => Ok(Self::Png),
            "jpg" | "jpeg" => Ok(Self::Jpeg),
            _ => Err(invalid("--out", "a file ending in .png, .jpg or .jpeg", path.display())),
        }
    }

    /// Encodes RGBA8 sRGB pixels, top row first.
    ///
    /// # Errors
    /// `Fault` when the encoder fails.
    fn encode(self, size: [u32; 2], rgba: &[u8]) -> Result<Vec<u8>> {
        match self {
            Self::Png => frame::encode_png(size[0], size[1], rgba),
            Self::Jpeg => frame::encode_jpeg(size[0], size[1], rgba, JPEG_QUALITY),
        }
    }
}

/// The lines along mesh edges: those of the scene, unless the command line sets their width.
fn mesh_edges(width: Option<f32>, scene: &Scene) -> Result<Option<MeshEdges>> {
    let edges = match width {
        None => scene.look.edges,
        Some(0.0) => None,
        Some(width) => Some(scene.look.edges.unwrap_or_default().with_width(width)),
    };
    edges.map_or(Ok(()), |edges| edges.check("--edges"))?;
    Ok(edges)
}

pub(super) fn run(args: &Args) -> Outcome {
    let format = FileFormat::of(&args.out)?;
    let open = || load::open_for_still(&args.scene, args.look, &args.loading.load_options());
    let OpenedScene { scene, backends } = with_spinner("loading", open)?;
    let mut state = SceneState::rest(&scene);
    if let Some(path) = &args.q {
        state.q = read_coordinates(&scene, path)?;
    }
    let mut device =
        DeviceContext::open(&Config { backend: args.backend, renderer: args.renderer, ..Config::default() })?;
    let mut loaded_scene = device.load_scene(&scene, backends)?;
    loaded_scene.deform(&Arc::new(state))?;
    let scale_max = args.largest;
    let mut info = FrameInfo::default();
    let rgba = match args.output {
        OutputOption::Color => {
            let style = FrameStyle { edges: mesh_edges(args.edges, &scene)?, samples: None };
            let image = device.draw_with_style(&mut loaded_scene, &camera(args, &scene), args.size, style)?;
            info = image.info;
            image.rgba
        }
        OutputOption::Displacement => {
            render_color_map(args, &mut device, &mut loaded_scene, FrameOutput::Displacement { scale_max })?
        }
        OutputOption::ModeShape => {
            let mode = validate_mode(&scene, args.mode)?;
            render_color_map(args, &mut device, &mut loaded_scene, FrameOutput::ModeShape { mode, scale_max })?
        }
    };
    let bytes = format.encode(args.size.to_array(), &rgba)?;
    let field = format!("--out {}", args.out.display());
    fs::write(&args.out, bytes).map_err(|error| invalid(field, "a file that can be written", error))?;
    device.unload_scene(loaded_scene);
    print_line(format!("{} ({}, {})", args.out.display(), args.size, device.backend().name()));
    info_lines(&info).into_iter().chain(remark_lines(&scene)).for_each(print_line);
    Ok(Completion::Success)
}

/// Lines about how a color picture was drawn; none for other pictures.
fn info_lines(info: &FrameInfo) -> Vec<String> {
    let look = info.look.map(|look| format!("look: {look}"));
    let below_ground = (info.below_ground > 0.0).then(|| {
        format!("remark: vertices lie up to {:.4} m below the ground, which hides no geometry", info.below_ground)
    });
    look.into_iter().chain(below_ground).collect()
}

/// Renders a color map with its legend, as RGBA8.
fn render_color_map(
    args: &Args,
    device: &mut DeviceContext,
    loaded_scene: &mut LoadedScene,
    frame_output: FrameOutput,
) -> Result<Vec<u8>> {
    let scene = Arc::clone(loaded_scene.scene());
    let (values, legend) = device.render_aov(loaded_scene, &camera(args, &scene), args.size, frame_output)?;
    let legend = legend.ok_or_else(|| fault("encode", "expected a legend of the color map"))?;
    frame::draw_color_map(&values.bytes, values.samples, args.size.to_array(), &legend)
}

/// The camera of the options. Its near and far planes are 0, so that nothing in front of it is clipped.
fn camera(args: &Args, scene: &Scene) -> Camera {
    let (Some(eye), Some(target)) = (args.eye, args.target) else {
        return Camera::fit_to_scene(scene, args.size.width, args.size.height);
    };
    let up = args.camera_up.unwrap_or_else(|| scene.up.vector().into());
    let view = View::LookAt { eye, target, up };
    Camera { view, lens: Lens::FieldOfView(args.field_of_view.unwrap_or(35.0)), near: 0.0, far: 0.0 }
}

/// Reads q from a .npy file and checks its shape against the scene.
fn read_coordinates(scene: &Scene, path: &PathBuf) -> Result<Vec<f32>> {
    let field = format!("q in {}", path.display());
    let expected = format!("{} coordinates, all domains in order", scene.layout.coordinates);
    if !path.exists() {
        return Err(Error::NotFound { what: "q", given: path.display().to_string() });
    }
    let file_bytes = fs::metadata(path).map_err(|error| invalid(&field, "a .npy file", error))?.len();
    // 8 bytes per f64 entry, and at most 64 KiB of header. The size is checked before the file is read into memory.
    let max_bytes = 8 * scene.layout.coordinates as u64 + 65536;
    if file_bytes > max_bytes {
        return Err(invalid(&field, format!("{expected}: at most {max_bytes} bytes"), format!("{file_bytes} bytes")));
    }
    let bytes = fs::read(path).map_err(|error| invalid(&field, "a readable file", error))?;
    let array = load::parse_numpy(&bytes).map_err(|error| error.prefix_field(&field))?;
    // Axes of length one are ignored, because an array of a single step may have a leading axis.
    let long_axes = array.shape.iter().filter(|length| **length != 1).count();
    if array.entries.len() != scene.layout.coordinates || long_axes > 1 {
        return Err(invalid(format!("{field}: shape"), expected, format!("{:?}", array.shape)));
    }
    match array.entries.iter().position(|number| !number.is_finite()) {
        None => Ok(array.entries),
        Some(index) => Err(invalid(format!("{field}, entry {index}"), "a finite number", array.entries[index])),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn extension_selects_the_format_or_is_rejected() {
        for (name, format, magic) in [
            ("a.png", FileFormat::Png, &b"\x89PNG"[..]),
            ("b.PNG", FileFormat::Png, b"\x89PNG"),
            ("c.jpg", FileFormat::Jpeg, b"\xff\xd8\xff"),
            ("d.x.JPEG", FileFormat::Jpeg, b"\xff\xd8\xff"),
        ] {
            let selected = FileFormat::of(Path::new(name)).expect(name);
            assert_eq!(selected, format, "{name}");
            let bytes = selected.encode([2, 1], &[9; 8]).expect("expected encoded pixels");
            assert!(bytes.starts_with(magic), "{name}: {:02x?}", &bytes[..4]);
        }
        for name in ["a.webp", "a", "png", "a.jpg.exr"] {
            let message = FileFormat::of(Path::new(name)).expect_err(name).to_string();
            assert_eq!(message, format!("--out: expected a file ending in .png, .jpg or .jpeg, got {name}"));
        }
    }
}
