//! Output files of a report: JSON, CSV, Markdown, and the plot as SVG and PNG.

use std::path::Path;

use serde::Serialize;

use super::{DynamicsReport, markdown, plot};
use crate::csv_table;
use crate::output_files::write_files;
use crate::plot::render_png;
use modalcast_model::error::{Result, fault_in};

/// Columns of `report.csv`: name, and JSON pointer of the value in a row of `report.json`. Errors are relative, `phase`
/// is in radians. `truncation` and `total` are errors of the beam.
pub(super) const COLUMNS: [(&str, &str); 29] = [
    ("case", "/case"),
    ("system", "/system"),
    ("mode_hz", "/mode_hertz"),
    ("method", "/method"),
    ("coordinates", "/coordinates"),
    ("highest_hz", "/highest_hertz"),
    ("dt_s", "/dt_seconds"),
    ("steps", "/steps"),
    ("expectation", "/expectation"),
    ("displacement", "/errors/displacement"),
    ("phase", "/errors/phase_radians"),
    ("energy", "/errors/energy"),
    ("truncation", "/errors/truncation"),
    ("total", "/errors/total"),
    ("observed_order", "/observed_order"),
    ("theoretical_order", "/theoretical_order"),
    ("conserves_energy", "/conserves_energy"),
    ("step_us", "/timing/median_us"),
    ("step_q1_us", "/timing/q1_us"),
    ("step_q3_us", "/timing/q3_us"),
    ("runs", "/timing/replays"),
    ("sub_steps", "/work/sub_steps"),
    ("max_sub_steps", "/work/max_sub_steps"),
    ("iterations", "/work/iterations"),
    ("rejections", "/work/rejections"),
    ("limited_steps", "/work/limited_steps"),
    ("max_residual", "/work/max_residual"),
    ("run_us", "/run_us"),
    ("failure", "/failure"),
];

/// Columns of `solids.csv`.
pub(super) const SOLID_COLUMNS: [(&str, &str); 10] = [
    ("solid", "/solid"),
    ("triangles", "/triangles"),
    ("freedom_limit", "/freedom_limit"),
    ("freedoms", "/freedoms"),
    ("worst_error", "/worst_error"),
    ("mean_error", "/mean_error"),
    ("estimated_error", "/estimated_error"),
    ("seconds", "/seconds"),
    ("peak_bytes", "/peak_bytes"),
    ("failure", "/failure"),
];

/// Columns of `plants.csv`.
pub(super) const PLANT_COLUMNS: [(&str, &str); 7] = [
    ("plant", "/plant"),
    ("domains", "/domains"),
    ("coordinates", "/coordinates"),
    ("steps", "/steps"),
    ("step_us", "/step_us"),
    ("step_cpu_us", "/step_cpu_us"),
    ("load_average", "/load_average"),
];

impl DynamicsReport {
    /// Writes `report.json`, `report.csv` (integrators), `solids.csv`, `plants.csv`, `report.md`, `report.svg` and
    /// `report.png` into a folder, which is created.
    ///
    /// # Errors
    /// `Fault` when a file cannot be written.
    pub fn write(&self, folder: &Path) -> Result<()> {
        let svg = plot::draw_svg(self);
        let files = [
            ("report.json", serde_json::to_vec_pretty(self).map_err(fault_in("report"))?),
            ("report.csv", csv(&COLUMNS, &self.rows)?),
            ("solids.csv", csv(&SOLID_COLUMNS, &self.solids)?),
            ("plants.csv", csv(&PLANT_COLUMNS, &self.plants)?),
            ("report.md", markdown::markdown(self).into_bytes()),
            ("report.png", render_png(&svg)?),
            ("report.svg", svg.into_bytes()),
        ];
        write_files(folder, files)
    }
}

fn csv(columns: &[(&str, &str)], rows: &[impl Serialize]) -> Result<Vec<u8>> {
    let values: Vec<_> = rows.iter().map(serde_json::to_value).collect::<Result<_, _>>().map_err(fault_in("report"))?;
    let line = |value| columns.iter().map(move |(_, pointer)| csv_table::cell_text(value, pointer));
    csv_table::encode(columns.iter().map(|(name, _)| (*name).to_owned()), values.iter().map(line))
}
