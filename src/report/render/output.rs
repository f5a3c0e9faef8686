//! The files of a report: JSON, CSV, Markdown, the plot as SVG and PNG, and the pictures.

use std::path::Path;

use serde_json::Value;

use super::{Report, Row, page, plot};
use crate::error::{Result, during};
use crate::report::plot::png;

/// The columns of `report.csv`: name, and where the value stands in a row of `report.json`. Times are found by name.
const COLUMNS: [(&str, &str); 49] = [
    ("load", "/load"),
    ("variant", "/name"),
    ("method", "/method"),
    ("map_size", "/shadow/size"),
    ("blur", "/shadow/blur"),
    ("moments", "/shadow/moments"),
    ("splits", "/shadow/splits"),
    ("bleeding_cut", "/shadow/bleeding"),
    ("passed", "/passed"),
    ("to_fail", "/to_fail"),
    ("bleeding_bound", "/bounds/bleeding"),
    ("frame_us", "frame"),
    ("frame_q1_us", "frame"),
    ("frame_q3_us", "frame"),
    ("shadow_us", "shadow"),
    ("blur_us", "blur"),
    ("draw_us", "draw"),
    ("visibility_us", "visibility"),
    ("blended_us", "blended"),
    ("shade_us", "shade"),
    ("encode_us", "encode"),
    ("read_us", "read"),
    ("bytes", "/bytes"),
    ("shadow_bytes", "/shadow_bytes"),
    ("samples", "/samples"),
    ("draws", "/draws"),
    ("colour_mean", "/colour/mean"),
    ("colour_p99", "/colour/p99"),
    ("colour_largest", "/colour/largest"),
    ("colour_of_aim_mean", "/colour_of_aim/mean"),
    ("colour_of_aim_p99", "/colour_of_aim/p99"),
    ("colour_of_aim_largest", "/colour_of_aim/largest"),
    ("light_mean", "/light/all/mean"),
    ("light_p99", "/light/all/p99"),
    ("light_largest", "/light/all/largest"),
    ("light_in_hard_umbra", "/light/in_umbra"),
    ("light_of_aim_mean", "/light_of_aim/all/mean"),
    ("light_of_aim_p99", "/light_of_aim/all/p99"),
    ("light_of_aim_largest", "/light_of_aim/all/largest"),
    ("light_of_aim_bias", "/light_of_aim/bias"),
    ("penumbra_mean", "/light_of_aim/penumbra/mean"),
    ("penumbra_p99", "/light_of_aim/penumbra/p99"),
    ("penumbra_pixels", "/light_of_aim/penumbra/count"),
    ("bleeding", "/light_of_aim/in_umbra"),
    ("lost", "/light_of_aim/lost"),
    ("flicker_mean", "/flicker/mean"),
    ("flicker_p99", "/flicker/p99"),
    ("no_flicker", "/no_flicker"),
    ("faults", ""),
];

impl Report {
    /// Writes `report.json`, `report.csv`, `report.md`, `report.svg`, `report.png` and `pictures/` into a folder, which is
    /// made.
    ///
    /// # Errors
    /// `Fault` when a file cannot be written.
    pub fn write(&self, folder: &Path) -> Result<()> {
        let pictures = folder.join("pictures");
        std::fs::create_dir_all(&pictures).map_err(during("report"))?;
        let svg = plot::svg(self);
        let files = [
            ("report.json", serde_json::to_vec_pretty(self).map_err(during("report"))?),
            ("report.csv", csv(&self.rows)?),
            ("report.md", page::markdown(self).into_bytes()),
            ("report.png", png(&svg)?),
            ("report.svg", svg.into_bytes()),
        ];
        for (name, bytes) in files {
            std::fs::write(folder.join(name), bytes).map_err(during("report"))?;
        }
        for file in &self.pictures {
            std::fs::write(pictures.join(&file.name), &file.png).map_err(during("report"))?;
        }
        Ok(())
    }
}

fn csv(rows: &[Row]) -> Result<Vec<u8>> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    writer.write_record(COLUMNS.map(|(name, _)| name)).map_err(during("report"))?;
    for row in rows {
        let value = serde_json::to_value(row).map_err(during("report"))?;
        writer.write_record(COLUMNS.map(|column| cell(row, &value, column))).map_err(during("report"))?;
    }
    writer.into_inner().map_err(during("report"))
}

fn cell(row: &Row, value: &Value, (name, place): (&str, &str)) -> String {
    if name == "faults" {
        return row.faults.join("; ");
    }
    if !place.starts_with('/') {
        let timing = row.passes.iter().find(|pass| pass.name == place).map(|pass| pass.timing);
        let us = timing.map(|timing| match name {
            "frame_q1_us" => timing.q1_us,
            "frame_q3_us" => timing.q3_us,
            _ => timing.median_us,
        });
        return us.map_or_else(String::new, |us| us.to_string());
    }
    match value.pointer(place) {
        None | Some(Value::Null) => String::new(),
        Some(Value::String(text)) => text.clone(),
        Some(other) => other.to_string(),
    }
}
