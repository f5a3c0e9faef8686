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

use super::options::with_spinner;
use super::{Outcome, print_line};
use crate::config::BackendChoice;
use evaluation::Evaluation;
use input::DemoScene;
use modalcast_model::error::{Result, fault_in};
use modalcast_model::scene::FrameSize;
use processes::{Process, program_path};
use step_records::StepRecords;

/// Drives a scene with a physics process, receives its frames and vertices over the network, and checks them.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  modalcast demo                                the built-in tree in the wind: 60 frames into out/
  modalcast demo --scene path/to/simpleBridge   a Vega folder under its own cubic forces
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
    let input = DemoScene::find(&args.scene)?;
    // Temporary files of the processes; removed with the folder.
    let scratch = tempfile::tempdir().map_err(fault_in("demo"))?;
    let run = drive(args, &input, scratch.path())?;
    let evaluation =
        with_spinner("comparing with the f64 reference", || Evaluation::of(&input.scene, &run, args.frames))?;
    for line in evaluation.table() {
        print_line(line);
    }
    if let Some(path) = &args.report {
        let text = serde_json::to_string_pretty(&record(&evaluation)).map_err(fault_in("demo"))?;
        fs::write(path, text + "\n").map_err(fault_in("demo"))?;
    }
    print_line(format!("frames in {}", args.out.display()));
    Ok(evaluation.failed_checks().is_empty())
}

/// The verdict as JSON, with the command, version and machine for reproducibility.
fn record(evaluation: &Evaluation) -> serde_json::Value {
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
    frames: serde_json::Value,
    sim: serde_json::Value,
    server: serde_json::Value,
    /// Shape (steps, coordinates), as sent by the physics process.
    q: StepRecords,
    /// Shape (steps, domains, 12), as sent by the physics process.
    transforms: StepRecords,
    /// Shape (steps, vertices, 3), as received over the network.
    vertices: StepRecords,
    frames_on_disk: usize,
}

fn drive(args: &Args, input: &DemoScene, scratch: &std::path::Path) -> Result<DemoRun> {
    let end = Instant::now() + Duration::from_secs(args.timeout);
    let (count, dt) = (args.frames.to_string(), args.dt.to_string());
    clear_frames(&args.out)?;
    let mut server = Process::start("server", &program_path("modalcast")?, &server_flags(args, input, scratch))?;
    let url = server.wait_for("listening on ", end)?;
    let common = ["--server", url.as_str(), "--scene", "demo"];

    let out = args.out.to_string_lossy();
    let size = args.size.to_string();
    let mut flags = vec!["frames", "--open", input.source.as_str(), "--count", &count, "--size", &size, "--json"];
    flags.extend(["--delivery", "lossless", "--out", &out]);
    let mut frames = Process::start("fetch", &program_path("modalcast-fetch")?, &[&flags[..], &common].concat())?;
    frames.wait_for("ready", end)?;

    let vertices_file = scratch.join("vertices.npy").to_string_lossy().into_owned();
    let flags = ["vertices", "--count", &count, "--delivery", "lossless", "--out", &vertices_file, "--json"];
    let mut vertices = Process::start("vertices", &program_path("modalcast-fetch")?, &[&flags[..], &common].concat())?;
    vertices.wait_for("ready", end)?;

    let record = scratch.join("record").to_string_lossy().into_owned();
    let mut flags = vec!["auto", "--steps", &count, "--dt", &dt, "--policy", "lossless", "--record", &record, "--json"];
    let cubic = input.cubic.as_ref().map(|path| path.to_string_lossy().into_owned());
    let config = input.vega_config.as_ref().map(|path| path.to_string_lossy().into_owned());
    if let Some(path) = &cubic {
        flags.extend(["--cubic", path.as_str()]);
    }
    if let Some(path) = &config {
        flags.extend(["--config", path.as_str()]);
    }
    let sim = Process::start("physics", &program_path("modalcast-sim")?, &[&flags[..], &common].concat())?;

    let sim = sim.finish(end)?;
    let frames = frames.finish(end)?;
    vertices.finish(end)?;
    let info = Process::start("info", &program_path("modalcast-fetch")?, &["info", "--server", &url, "--json"])?;
    let info = info.finish(end)?;
    server.stop();
    let record = scratch.join("record");
    Ok(DemoRun {
        frames,
        sim,
        server: info,
        q: StepRecords::read(&record.join("q.npy"))?,
        transforms: StepRecords::read(&record.join("transforms.npy"))?,
        vertices: StepRecords::read(&scratch.join("vertices.npy"))?,
        frames_on_disk: frame_files(&args.out)?.len(),
    })
}

fn server_flags<'a>(args: &'a Args, input: &'a DemoScene, scratch: &'a std::path::Path) -> Vec<String> {
    let mut flags = vec!["serve".to_owned(), "--listen".into(), "127.0.0.1:0".into(), "--state".into()];
    flags.push(scratch.join("state").to_string_lossy().into_owned());
    let backend = args.backend.to_possible_value().map_or_else(String::new, |value| value.get_name().to_owned());
    flags.extend(["--backend".into(), backend]);
    if let Some(repository) = &input.repository {
        flags.extend(["--scenes".into(), repository.to_string_lossy().into_owned()]);
    }
    flags
}

/// The frame files of a demo in a folder: `frame_00000.png` and so on. Other files are ignored.
fn frame_files(folder: &std::path::Path) -> Result<Vec<PathBuf>> {
    let entries = fs::read_dir(folder).map_err(fault_in("demo"))?;
    let mut files: Vec<PathBuf> = entries.filter_map(|entry| Some(entry.ok()?.path())).collect();
    files.retain(|path| path.file_name().is_some_and(|name| is_frame(&name.to_string_lossy())));
    Ok(files)
}

/// Whether this is a file name that `modalcast-fetch frames` writes.
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
    fn only_frames_of_a_demo_are_replaced() {
        let folder = tempfile::tempdir().expect("a folder");
        for name in ["frame_00000.png", "frame_100000.png", "holiday.png", "frame_1.png", "frame_00001.jpg"] {
            fs::write(folder.path().join(name), b"x").expect("written");
        }
        assert_eq!(frame_files(folder.path()).expect("listed").len(), 2);
        clear_frames(folder.path()).expect("cleared");
        let left = fs::read_dir(folder.path()).expect("listed").count();
        assert_eq!(left, 3, "what is no frame stays");
    }
}
