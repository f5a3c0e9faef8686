//! Provenance of a report: machine, build and command.

use std::process::Command;

use serde::Serialize;

use modalcast_compute::gpu;

/// The machine, the program and the command.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Provenance {
    pub cpu: String,
    pub threads: usize,
    /// CUDA devices and their memory; versions of the driver, CUDA and NVRTC; the reason for a missing component.
    pub cuda: gpu::Probe,
    /// Version of this crate.
    pub version: &'static str,
    /// `MODALCAST_COMMIT`, otherwise git's HEAD in the current folder.
    pub commit: Option<String>,
    pub command: Vec<String>,
    /// Version of `rustc` on this machine, if it is installed.
    pub toolchain: Option<String>,
    /// Whether the build is optimized. Times of other builds are not meaningful.
    pub release: bool,
    pub os: &'static str,
}

impl Provenance {
    /// Collects the data of this machine and process.
    pub fn collect() -> Self {
        let commit = std::env::var("MODALCAST_COMMIT").ok().filter(|commit| !commit.is_empty());
        Self {
            cpu: cpu_name(),
            threads: std::thread::available_parallelism().map_or(1, std::num::NonZero::get),
            cuda: gpu::probe(),
            version: env!("CARGO_PKG_VERSION"),
            commit: commit.or_else(|| run_program("git", &["rev-parse", "HEAD"])),
            command: std::env::args().collect(),
            toolchain: run_program("rustc", &["--version"]),
            release: !cfg!(debug_assertions),
            os: std::env::consts::OS,
        }
    }

    /// CPU, threads and CUDA devices as one line, for titles.
    pub fn line(&self) -> String {
        let devices: Vec<&str> = self.cuda.devices.iter().map(|device| device.name.as_str()).collect();
        let devices = if devices.is_empty() { "no CUDA device".into() } else { devices.join(", ") };
        let build_note = if self.release { "" } else { ", unoptimized build" };
        format!("{}, {} threads; {devices}{build_note}", self.cpu, self.threads)
    }
}

/// UTC date and time of now, such as `2026-11-22T17:04:05Z`; empty if the program `date` is missing.
pub fn utc_date() -> String {
    run_program("date", &["-u", "+%Y-%m-%dT%H:%M:%SZ"]).unwrap_or_default()
}

/// Runs a program and returns its trimmed standard output; `None` when it cannot be started or fails.
fn run_program(program: &str, arguments: &[&str]) -> Option<String> {
    let output = Command::new(program).args(arguments).output().ok().filter(|output| output.status.success())?;
    String::from_utf8(output.stdout).ok().map(|text| text.trim().to_owned())
}

/// Model name of the CPU according to Linux, otherwise its architecture.
fn cpu_name() -> String {
    let text = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let name = text.lines().find_map(|line| line.strip_prefix("model name")?.split_once(':'));
    name.map_or_else(|| std::env::consts::ARCH.to_owned(), |(_, name)| name.trim().to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missing_or_failing_program_gives_no_output() {
        assert_eq!(run_program("no-such-program", &[]), None);
        assert_eq!(run_program("false", &[]), None);
        assert_eq!(run_program("echo", &["x"]).as_deref(), Some("x"));
    }

    #[test]
    fn date_has_the_form_of_iso_8601() {
        let form: String =
            utc_date().chars().map(|letter| if letter.is_ascii_digit() { '0' } else { letter }).collect();
        assert_eq!(form, "0000-00-00T00:00:00Z");
    }

    #[test]
    fn line_names_cpu_threads_and_device() {
        let provenance = Provenance::collect();
        assert!(provenance.threads >= 1 && !provenance.cpu.is_empty() && !provenance.command.is_empty());
        let device = provenance.cuda.devices.first().map_or("no CUDA device", |device| &device.name);
        assert!(provenance.line().contains(device) && provenance.line().contains("threads"), "{}", provenance.line());
    }
}
