//! Frequencies that `modalcast model` computes against those of solids that are known exactly.

use std::time::Instant;

use serde::Serialize;

use super::row::larger;
use crate::workloads::Size;
use modalcast_modes::compute_modes;
use modalcast_modes::modeling::to_hertz;
use modalcast_modes::surface_file::SurfaceFile;
// The tests of the modes have the same solids and references.
#[path = "../../../../clients/modes/tests/solids/mod.rs"]
mod solids;

pub(super) const CASE: &str = "modes of solids";

/// The modes that are compared.
const MODES: usize = 20;
/// Limits on the freedoms; the last one is the default of `modalcast model`.
const FREEDOMS: [usize; 4] = [3_000, 6_000, 12_000, 25_000];

/// The modes of one solid with one limit on the freedoms.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SolidRow {
    pub solid: &'static str,
    pub triangles: usize,
    /// The option `--freedoms`.
    pub freedom_limit: usize,
    pub freedoms: usize,
    /// Largest and mean relative error of the first 20 frequencies; `None` if the computation failed.
    pub worst_error: Option<f64>,
    pub mean_error: Option<f64>,
    /// The largest error of a frequency that the computation estimates itself, from a coarser grid.
    pub estimated_error: Option<f64>,
    /// All cores, by the wall clock.
    pub seconds: f64,
    /// Largest memory of the report's process during the computation. `None` if the system does not tell.
    pub peak_bytes: Option<u64>,
    pub failure: Option<String>,
}

/// A surface and its exact frequencies.
pub(super) struct Solid {
    name: &'static str,
    surface: SurfaceFile,
    hertz: &'static [f64; MODES],
}

/// The solids, each rotated so that no face is parallel to the grid.
pub(super) fn all(size: Size) -> Vec<Solid> {
    // Rings of the ellipsoid, and sectors of the cylinder.
    let (rings, sectors) = if size == Size::Full { (100, 192) } else { (40, 96) };
    let solid = |name, surface, seed, hertz| Solid { name, surface: solids::rotated(surface, seed), hertz };
    vec![
        solid("box", solids::solid_box([1.0, 0.7, 0.4]), 1, &solids::BOX),
        solid("ellipsoid", solids::ellipsoid([0.5, 0.35, 0.2], rings), 2, &solids::ELLIPSOID),
        solid("sphere", solids::ellipsoid([0.5; 3], rings), 3, &solids::SPHERE),
        solid("cylinder", solids::cylinder(0.25, 1.0, sectors), 4, &solids::CYLINDER),
    ]
}

/// Measures all solids, those with few freedoms first, because the allocator keeps memory of earlier computations.
pub(super) fn measure(size: Size) -> Vec<SolidRow> {
    let freedoms = if size == Size::Full { &FREEDOMS[..] } else { &FREEDOMS[..2] };
    let solids = all(size);
    freedoms.iter().flat_map(|limit| solids.iter().map(|solid| solid.measure(*limit))).collect()
}

impl Solid {
    /// The surface with the frequencies of another solid.
    #[cfg(test)]
    pub(super) fn with_frequencies_of(&self, other: &Self) -> Self {
        Self { surface: self.surface.clone(), hertz: other.hertz, ..*self }
    }

    pub(super) fn measure(&self, freedom_limit: usize) -> SolidRow {
        let row = SolidRow {
            solid: self.name,
            triangles: self.surface.mesh.triangles.len(),
            freedom_limit,
            freedoms: 0,
            worst_error: None,
            mean_error: None,
            estimated_error: None,
            seconds: 0.0,
            peak_bytes: None,
            failure: None,
        };
        reset_peak_memory();
        let start = Instant::now();
        let modeling = compute_modes(&self.surface, &solids::parameters(freedom_limit, MODES), &|_, _| {});
        let (seconds, peak_bytes) = (start.elapsed().as_secs_f64(), peak_memory());
        let row = SolidRow { seconds, peak_bytes, ..row };
        let modeling = match modeling {
            Ok(modeling) if modeling.eigenvalues.len() >= MODES => modeling,
            Ok(modeling) => {
                let failure = format!("expected {MODES} modes, got {}", modeling.eigenvalues.len());
                return SolidRow { failure: Some(failure), ..row };
            }
            Err(error) => return SolidRow { failure: Some(error.to_string()), ..row },
        };
        let pairs = modeling.eigenvalues.iter().zip(self.hertz);
        let errors: Vec<f64> = pairs.map(|(eigenvalue, hertz)| (to_hertz(*eigenvalue) / hertz - 1.0).abs()).collect();
        SolidRow {
            freedoms: modeling.freedoms,
            worst_error: Some(errors.iter().copied().fold(0.0, larger)),
            mean_error: Some(errors.iter().sum::<f64>() / MODES as f64),
            estimated_error: modeling.frequency_errors.iter().copied().reduce(larger),
            ..row
        }
    }
}

/// Resets the peak of the process's memory. Without this feature of Linux, the peak is that since the start.
fn reset_peak_memory() {
    std::fs::write("/proc/self/clear_refs", "5").ok();
}

/// The peak of the process's memory in bytes.
fn peak_memory() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kilobytes: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kilobytes * 1024)
}
