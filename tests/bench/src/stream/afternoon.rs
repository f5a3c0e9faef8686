//! Compares the server with a program that a user could write in an afternoon: `tests/bench/peers/afternoon.py`, which
//! deforms with cupy or numpy, draws with moderngl, encodes with OpenCV and sends through ZeroMQ. The program gets the
//! arrays of the same scene and a recorded motion, so unlike the server it has no physics process beside it.

use std::ffi::OsString;
use std::path::Path;
use std::process::Command;

use serde::{Deserialize, Serialize};

use super::peers::viewer::Content;
use super::processes::Process;
use super::rates::{self, Viewers};
use super::session::Session;
use super::{RECORDED_STEPS, StreamReportOptions, afternoon_scene};
use modalcast_model::error::{Error, Result, fault, fault_in};

/// The program, and the files that it imports.
const FILES: [(&str, &str); 3] = [
    ("afternoon.py", include_str!("../../peers/afternoon.py")),
    ("draw.py", include_str!("../../peers/draw.py")),
    ("mesh.py", include_str!("../../peers/mesh.py")),
];

/// The variants of the program.
const VARIANTS: [&str; 4] = ["raw", "png", "png-pool", "vertices"];

/// Rates of the program and of the server in the same run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct AfternoonComparison {
    /// Width and height of the pictures.
    pub size: [u32; 2],
    pub frames: u64,
    /// The array library of the program: `cupy` or `numpy`.
    pub arrays: String,
    /// The OpenGL renderer of the program.
    pub renderer: String,
    pub variants: Vec<AfternoonVariant>,
    /// The rate of the server's PNG frames divided by that of the faster PNG variant of the program.
    pub of_best_png: f64,
}

/// A variant of the program, compared with the server.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct AfternoonVariant {
    /// `raw`, `png` (encoded on one thread), `png-pool` (on all cores) or `vertices`.
    pub name: String,
    /// Replies per second at a receiver in its own process.
    pub per_second: f64,
    /// Bytes of a reply on average.
    pub bytes: f64,
    /// The compared content of the server. It is RGBA where the program sends RGB, and its PNGs show the complete
    /// default look, which the program simplifies.
    pub server_content: String,
    pub server_per_second: f64,
    pub server_bytes: f64,
    /// `server_per_second` divided by `per_second`.
    pub server_of_program: f64,
}

/// The last output line of the program.
#[derive(Debug, Clone, PartialEq, Deserialize)]
struct ProgramSummary {
    per_second: f64,
    bytes: f64,
    arrays: String,
    renderer: Option<String>,
}

/// Measures all variants of the program, and the server with the same contents.
///
/// # Errors
/// `Unavailable` when Python or one of its modules is missing; `Fault` when a process fails.
pub(super) fn measure(session: &Session, size: [u32; 2], options: &StreamReportOptions) -> Result<AfternoonComparison> {
    check_modules()?;
    session.motion(options.steps.min(RECORDED_STEPS))?;
    let folder = session.recording();
    afternoon_scene::write(session, &folder, size)?;
    for (name, text) in FILES {
        std::fs::write(folder.join(name), text).map_err(fault_in("report"))?;
    }
    let [width, height] = size;
    let server_rate = |content| {
        let run = rates::run(session, Some(Viewers::one(content)), options.steps, &session.url())?;
        let bytes = run.viewers.iter().map(|viewer| viewer.bytes as f64 / viewer.replies.max(1) as f64).sum::<f64>();
        Ok((content.name(), run.per_second(), bytes))
    };
    let png = server_rate(Content::Png { width, height })?;
    let mut variants = Vec::new();
    let (mut arrays, mut renderer) = (String::new(), None);
    for name in VARIANTS {
        let program = run_program(&folder, name, options.steps)?;
        let (server_content, server_per_second, server_bytes) = match name {
            "raw" => server_rate(Content::Rgba { width, height })?,
            "vertices" => server_rate(Content::Positions)?,
            _ => png.clone(),
        };
        (arrays, renderer) = (program.arrays, renderer.or(program.renderer));
        variants.push(AfternoonVariant {
            name: name.to_owned(),
            per_second: program.per_second,
            bytes: program.bytes,
            server_content,
            server_per_second,
            server_bytes,
            server_of_program: server_per_second / program.per_second,
        });
    }
    let png_variants = variants.iter().filter(|variant| variant.name.starts_with("png"));
    let of_best_png = png_variants.map(|variant| variant.server_of_program).fold(f64::INFINITY, f64::min);
    let renderer = renderer.ok_or_else(|| fault("report", "expected the renderer of the program, got none"))?;
    Ok(AfternoonComparison { size, frames: options.steps, arrays, renderer, variants, of_best_png })
}

/// The Python interpreter: `MODALCAST_PYTHON`, or `python3`.
fn python() -> Command {
    Command::new(std::env::var_os("MODALCAST_PYTHON").unwrap_or_else(|| OsString::from("python3")))
}

fn check_modules() -> Result<()> {
    let unavailable = |reason: String| Error::Unavailable {
        what: "modules of the afternoon program",
        reason,
        remedy: "Set MODALCAST_PYTHON to a Python with: pip install moderngl pyzmq opencv-python-headless numpy".into(),
    };
    let output = python().args(["-c", "import cv2, moderngl, numpy, zmq"]).output();
    let output = output.map_err(|error| unavailable(error.to_string()))?;
    match output.status.success() {
        true => Ok(()),
        false => Err(unavailable(String::from_utf8_lossy(&output.stderr).lines().last().unwrap_or_default().into())),
    }
}

/// Runs a variant of the program to its end.
fn run_program(folder: &Path, variant: &str, frames: u64) -> Result<ProgramSummary> {
    let mut command = python();
    command.arg(folder.join("afternoon.py")).arg(folder).args([variant, &frames.to_string()]);
    command.env("PYTHONDONTWRITEBYTECODE", "1");
    Process::spawn(format!("afternoon.py {variant}"), &mut command)?.finish()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn program_imports_only_files_that_are_written_beside_it() {
        for (name, text) in FILES {
            let imports = text.lines().filter_map(|line| line.strip_prefix("from ")?.split_whitespace().next());
            let local: Vec<_> = imports.filter(|module| ["draw", "mesh"].contains(module)).collect();
            for module in local {
                assert!(FILES.iter().any(|(file, _)| *file == format!("{module}.py")), "{name} imports {module}");
            }
        }
        assert!(VARIANTS.iter().all(|variant| FILES[0].1.contains(&format!("\"{variant}\""))));
    }
}
