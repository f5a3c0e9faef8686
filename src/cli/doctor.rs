//! `modalcast doctor`: reports the devices and libraries for deforming and drawing on this machine, and names missing
//! files or packages.

use serde_json::{Value, json};

use super::{Completion, Outcome, print_line};
use crate::engine::share_pictures;
use modalcast_compute::gpu;
use modalcast_model::error::{Result, fault_in};
use modalcast_render::{DevicePreference, Renderer, RendererInfo};

/// Checks the NVIDIA driver, the CUDA devices and compiler (NVRTC), and the OpenGL devices (EGL); exit code 1 if no
/// frame can be drawn.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  modalcast doctor
  modalcast doctor --json")]
pub(super) struct Args {
    /// Print the report as JSON.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args) -> Outcome {
    let report = diagnose();
    if args.json {
        print_line(serde_json::to_string_pretty(&report).map_err(fault_in("doctor"))?);
    } else {
        text_lines(&report).into_iter().for_each(print_line);
    }
    Ok(Completion::of_check(report["can_draw"] == true))
}

/// Collects the report as JSON.
pub(super) fn diagnose() -> Value {
    let (renderer, encoder) = match open_renderer() {
        Ok(opened) => (Ok(opened.info), opened.png_encoder),
        Err(error) => (Err(error), "no renderer".into()),
    };
    let devices = modalcast_render::devices();
    let cuda = gpu::probe();
    json!({
        "can_draw": renderer.is_ok(),
        "deforms_on": if deforms_on_cuda() { "cuda" } else { "cpu" },
        "cpu_threads": std::thread::available_parallelism().map_or(1, std::num::NonZero::get),
        "cuda": cuda,
        "renderer": renderer.as_ref().ok(),
        "renderer_problem": renderer.as_ref().err().map(ToString::to_string),
        "pixel_readback": renderer.as_ref().ok().map(|renderer| renderer.pixel_readback.to_string()),
        "cuda_png_encoder": encoder,
        "egl_devices": devices.as_ref().ok(),
        "egl_problem": devices.as_ref().err().map(ToString::to_string),
    })
}

struct OpenedRenderer {
    info: RendererInfo,
    /// Whether `--encode cuda` encodes on CUDA, or the reason why the CPU would.
    png_encoder: String,
}

/// Opens a renderer as the server does, which also tests whether it can share memory with CUDA.
fn open_renderer() -> Result<OpenedRenderer> {
    let mut renderer = Renderer::open(DevicePreference::Any)?;
    let picture_memory = match gpu::Device::open(0) {
        Ok(device) => share_pictures(&mut renderer, &device)?,
        Err(_) => None,
    };
    let png_encoder = match picture_memory.map(|memory| memory.prepare_encoder()) {
        Some(Ok(())) => "available with --encode cuda".into(),
        Some(Err(error)) => format!("not available: {error}"),
        None => "not available: CUDA and OpenGL share no pictures".into(),
    };
    Ok(OpenedRenderer { info: renderer.info().clone(), png_encoder })
}

/// Whether `--backend auto` would choose CUDA. It needs a CUDA device and an NVRTC version that supports it.
fn deforms_on_cuda() -> bool {
    gpu::Device::open(0).and_then(|device| device.check_compiler()).is_ok()
}

/// The report as text, one line per entry.
fn text_lines(report: &Value) -> Vec<String> {
    let text = |value: &Value| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    let mut lines = Vec::new();
    let mut push_line = |name: &str, value: &Value, text_if_null: &str| {
        let displayed = if value.is_null() { text_if_null.to_owned() } else { text(value) };
        lines.push(format!("{name:<18}{displayed}"));
    };
    let cuda = &report["cuda"];
    push_line("driver", &cuda["driver"], "no NVIDIA kernel driver");
    push_line("CUDA", &cuda["cuda"], &text(&cuda["cuda_problem"]));
    for device in cuda["devices"].as_array().into_iter().flatten() {
        let gib = device["memory_bytes"].as_f64().unwrap_or(0.0) / f64::from(1 << 30);
        let description =
            format!("{}, capability {}, {gib:.1} GiB", text(&device["name"]), text(&device["capability"]));
        push_line(&format!("CUDA device {}", device["ordinal"]), &description.into(), "");
    }
    push_line("NVRTC", &cuda["nvrtc"], &text(&cuda["nvrtc_problem"]));
    push_line("NVRTC version", &cuda["nvrtc_version"], "unknown");
    for (index, device) in report["egl_devices"].as_array().into_iter().flatten().enumerate() {
        let description = format!("{}, CUDA device {}", text(&device["vendor"]), text(&device["cuda_device"]));
        push_line(&format!("EGL device {index}"), &description.into(), "");
    }
    if !report["egl_problem"].is_null() {
        push_line("EGL", &report["egl_problem"], "");
    }
    let renderer = &report["renderer"];
    push_line("renderer", &renderer["renderer"], &text(&report["renderer_problem"]));
    push_line("OpenGL", &renderer["version"], "none");
    let rendering_mode = match renderer["software"].as_bool() {
        Some(true) => "software: frames are drawn on the CPU",
        Some(false) => "hardware",
        None => "none",
    };
    push_line("rendering", &rendering_mode.into(), "");
    push_line("pixels leave", &report["pixel_readback"], "none");
    push_line("PNG on CUDA", &report["cuda_png_encoder"], "not available");
    push_line("largest frame", &renderer["max_side"], "none");
    push_line("deforms on", &report["deforms_on"], "cpu");
    let verdict = if report["can_draw"] == true { "frames can be drawn" } else { "no frame can be drawn" };
    push_line("verdict", &verdict.into(), "");
    lines
}

#[cfg(test)]
mod tests {
    use modalcast_render::PixelReadback;

    use super::*;

    /// The text after the name of a line.
    fn line_text(report: &Value, name: &str) -> String {
        let lines = text_lines(report);
        let line = lines.iter().find_map(|line| line.strip_prefix(name)).expect("expected the line");
        line.trim().to_owned()
    }

    #[test]
    fn report_says_how_pixels_leave_the_device() {
        let mut report = diagnose();
        assert_eq!(report["can_draw"], true, "expected a renderer, at least Mesa's");
        let has_cuda = report["cuda"]["devices"].as_array().is_some_and(|devices| !devices.is_empty());
        if !has_cuda {
            assert_eq!(line_text(&report, "pixels leave"), "by OpenGL: CUDA is not used");
            assert_eq!(line_text(&report, "PNG on CUDA"), "not available: CUDA and OpenGL share no pictures");
        }
        report["pixel_readback"] = PixelReadback::CopyEngine.to_string().into();
        assert_eq!(line_text(&report, "pixels leave"), "by CUDA's copy engine from memory shared with OpenGL");
        report["pixel_readback"] = Value::Null;
        assert_eq!(line_text(&report, "pixels leave"), "none");
    }
}
