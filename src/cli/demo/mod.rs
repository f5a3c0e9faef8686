//! `modalcast demo`: runs the server, a physics process and two receiving clients as separate processes on this
//! machine, then prints a table of the results and checks them against acceptance criteria.

mod evaluation;
mod input;
mod processes;
mod step_records;

use std::fs;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use clap::ValueEnum as _;

pub(super) use self::input::{DemoScene, ForceFiles, SceneLocation};
pub(super) use self::processes::{Process, program_path};

use super::options::with_spinner;
use super::{Completion, Outcome, print_line};
use crate::config::BackendChoice;
use evaluation::Evaluation;
use modalcast_model::error::{Result, fault_in};
use modalcast_model::scene::FrameSize;
use step_records::StepRecords;

/// Drives a scene with a physics process, receives its frames and vertices over the network, and checks them.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  modalcast demo                                the built-in tree in the wind: 60 frames into out/
  modalcast demo --scene path/to/simpleBridge   a model of the FEM library Vega with its internal forces
  modalcast demo --scene arm.npz                a model of `modalcast model --large`, with arm.cub beside it
  modalcast demo --frames 10 --size 640x360")]
pub(super) struct Args {
    /// Scene: a built-in name, or a path to a model or a scene folder.
    #[arg(long, default_value = "tree")]
    scene: String,
    /// Number of steps to drive and of frames to save.
    #[arg(long, default_value_t = 60, value_parser = clap::value_parser!(u32).range(2..=1000))]
    frames: u32,
    /// Frame size in pixels.
    #[arg(long, default_value = "1280x720")]
    size: FrameSize,
    /// Simulated time between frames, in seconds.
    #[arg(long, default_value_t = 1.0 / 24.0)]
    dt: f64,
    /// Folder for the frames. Frames of an earlier demo in it are replaced.
    #[arg(long, default_value = "out")]
    out: PathBuf,
    /// Deformation backend of the server.
    #[arg(long, value_enum, default_value_t = BackendChoice::Auto)]
    backend: BackendChoice,
    /// Also write the table as JSON to this file.
    #[arg(long)]
    report: Option<PathBuf>,
    /// Time limit for all processes together, in seconds.
    #[arg(long, default_value_t = 600, value_parser = clap::value_parser!(u64).range(1..=86_400))]
    timeout: u64,
}

pub(super) fn run(args: &Args) -> Outcome {
    let input = DemoScene::load(&args.scene)?;
    // For the temporary files of the processes. The folder is removed when this value is dropped.
    let temporary_folder = tempfile::tempdir().map_err(fault_in("demo"))?;
    let demo_run = run_processes(args, &input, temporary_folder.path())?;
    let evaluation =
        with_spinner("comparing with the f64 reference", || Evaluation::of(&input.scene, &demo_run, args.frames))?;
    for line in evaluation.table() {
        print_line(line);
    }
    if let Some(path) = &args.report {
        let text = serde_json::to_string_pretty(&report_json(&evaluation)).map_err(fault_in("demo"))?;
        fs::write(path, text + "\n").map_err(fault_in("demo"))?;
    }
    print_line(format!("frames in {}", args.out.display()));
    Ok(Completion::of_check(evaluation.failed_checks().is_empty()))
}

/// The results as JSON, with the command, version and machine for reproducibility.
fn report_json(evaluation: &Evaluation) -> serde_json::Value {
    let command: Vec<String> = std::env::args().skip(1).collect();
    serde_json::json!({
        "command": format!("modalcast {}", command.join(" ")),
        "commit": std::env::var("MODALCAST_COMMIT").ok(),
        "version": env!("CARGO_PKG_VERSION"),
        "machine": super::doctor::diagnose(),
        "result": evaluation.json(),
    })
}

/// The results of the demo's processes.
struct DemoRun {
    /// JSON output of the client that receives frames.
    frames: serde_json::Value,
    /// JSON output of the physics process.
    physics: serde_json::Value,
    /// JSON description of the server.
    server: serde_json::Value,
    /// Reduced coordinates as sent by the physics process; shape (steps, coordinates).
    q: StepRecords,
    /// Row-major 3x4 transforms as sent by the physics process; shape (steps, domains, 12).
    transforms: StepRecords,
    /// Vertex positions as received over the network; shape (steps, vertices, 3).
    vertices: StepRecords,
    /// Number of frame files in the output folder.
    frames_on_disk: usize,
}

/// Starts the server and the clients, waits until the physics process has sent all steps, and collects the results.
fn run_processes(args: &Args, input: &DemoScene, temporary_folder: &std::path::Path) -> Result<DemoRun> {
    let deadline = Instant::now() + Duration::from_secs(args.timeout);
    let (frame_count, dt) = (args.frames.to_string(), args.dt.to_string());
    clear_frames(&args.out)?;
    let mut server =
        Process::start("server", &program_path("modalcast")?, &server_flags(args, input, temporary_folder))?;
    let url = server.wait_for("listening on ", deadline)?;
    let common_flags = ["--server", url.as_str(), "--scene", "demo"];

    let out = args.out.to_string_lossy();
    let size = args.size.to_string();
    let mut flags =
        vec!["frames", "--open", input.location.source.as_str(), "--count", &frame_count, "--size", &size, "--json"];
    flags.extend(["--delivery", "lossless", "--out", &out]);
    // The frames are saved and looked at as still pictures.
    let samples = input.scene.look.still_samples().map(|samples| samples.to_string());
    if let Some(samples) = &samples {
        flags.extend(["--samples", samples]);
    }
    let mut frame_client =
        Process::start("fetch", &program_path("modalcast-fetch")?, &[&flags[..], &common_flags].concat())?;
    frame_client.wait_for("ready", deadline)?;

    let vertex_path = temporary_folder.join("vertices.npy").to_string_lossy().into_owned();
    let flags = ["vertices", "--count", &frame_count, "--delivery", "lossless", "--out", &vertex_path, "--json"];
    let mut vertex_client =
        Process::start("vertices", &program_path("modalcast-fetch")?, &[&flags[..], &common_flags].concat())?;
    vertex_client.wait_for("ready", deadline)?;

    let record_folder = temporary_folder.join("record").to_string_lossy().into_owned();
    let mut flags =
        vec!["--steps", &frame_count, "--dt", &dt, "--delivery", "lossless", "--record", &record_folder, "--json"];
    // Both clients must receive every step, also if they write to a slow disk.
    flags.extend(["--stall-budget", "600"]);
    let force_flags = input.force_files.demo_flags();
    flags.extend(force_flags.iter().map(String::as_str));
    let physics_process =
        Process::start("physics", &program_path("modalcast-sim")?, &[&flags[..], &common_flags].concat())?;

    let physics = physics_process.finish(deadline)?;
    let frames = frame_client.finish(deadline)?;
    vertex_client.finish(deadline)?;
    let info_client = Process::start("info", &program_path("modalcast-fetch")?, &["info", "--server", &url, "--json"])?;
    let server_info = info_client.finish(deadline)?;
    server.stop();
    let record_folder = temporary_folder.join("record");
    Ok(DemoRun {
        frames,
        physics,
        server: server_info,
        q: StepRecords::read(&record_folder.join("q.npy"))?,
        transforms: StepRecords::read(&record_folder.join("transforms.npy"))?,
        vertices: StepRecords::read(&temporary_folder.join("vertices.npy"))?,
        frames_on_disk: frame_files(&args.out)?.len(),
    })
}

fn server_flags<'a>(args: &'a Args, input: &'a DemoScene, temporary_folder: &'a std::path::Path) -> Vec<String> {
    let mut flags = vec!["serve".to_owned(), "--listen".into(), "127.0.0.1:0".into(), "--state".into()];
    flags.push(temporary_folder.join("state").to_string_lossy().into_owned());
    let backend = args.backend.to_possible_value().map_or_else(String::new, |value| value.get_name().to_owned());
    flags.extend(["--backend".into(), backend]);
    if let Some(repository) = &input.location.repository {
        flags.extend(["--scenes".into(), repository.to_string_lossy().into_owned()]);
    }
    flags
}

/// The frame files of a demo in a folder: `frame_00000.png` and so on. Other files are ignored.
fn frame_files(folder: &std::path::Path) -> Result<Vec<PathBuf>> {
    let entries = fs::read_dir(folder).map_err(fault_in("demo"))?;
    let mut paths: Vec<PathBuf> = entries.filter_map(|entry| Some(entry.ok()?.path())).collect();
    paths.retain(|path| path.file_name().is_some_and(|name| is_frame(&name.to_string_lossy())));
    Ok(paths)
}

/// Whether `modalcast-fetch frames` writes files of this name: at least five digits between prefix and extension.
fn is_frame(name: &str) -> bool {
    let number = name.strip_prefix("frame_").and_then(|rest| rest.strip_suffix(".png"));
    number.is_some_and(|number| number.len() >= 5 && number.bytes().all(|digit| digit.is_ascii_digit()))
}

fn clear_frames(folder: &std::path::Path) -> Result<()> {
    fs::create_dir_all(folder).map_err(fault_in("demo"))?;
    frame_files(folder)?.iter().try_for_each(fs::remove_file).map_err(fault_in("demo"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clear_frames_removes_only_frames_of_a_demo() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        for name in ["frame_00000.png", "frame_100000.png", "other.png", "frame_1.png", "frame_00001.jpg"] {
            fs::write(folder.path().join(name), b"x").expect("expected a written file");
        }
        assert_eq!(frame_files(folder.path()).expect("expected a list").len(), 2);
        clear_frames(folder.path()).expect("expected removed frames");
        let remaining_files = fs::read_dir(folder.path()).expect("expected a list").count();
        assert_eq!(remaining_files, 3, "expected the three other files to remain");
    }
}
