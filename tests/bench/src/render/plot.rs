//! Plots error against frame time in one panel per workload, and marks the Pareto front.

use super::{RenderReport, RenderRow};
use crate::plot::panel::{Panel, Point};
use crate::plot::{
    HEADER_HEIGHT, LEGEND_LINE_HEIGHT, MARGIN, PANEL_SIZE, begin_svg, draw_header, draw_legend, plot_width,
    style_of_name,
};
use crate::table::TimeAndError;
use crate::timing::Timing;

/// Panels per row.
const COLUMNS: usize = 3;

/// Draws the plot as SVG.
pub(super) fn draw_svg(report: &RenderReport) -> String {
    let mut variants: Vec<&str> = Vec::new();
    for row in &report.rows {
        if !variants.contains(&row.name.as_str()) {
            variants.push(&row.name);
        }
    }
    let columns = report.loads.len().clamp(1, COLUMNS);
    let header = header_lines(report);
    let width = plot_width(columns, &header);
    let (legend, lines) = draw_legend(variants.iter().map(|name| (*name, style_of_name(&variants, name))), width);
    let panels_top = MARGIN + HEADER_HEIGHT + lines as f64 * LEGEND_LINE_HEIGHT;
    let height = panels_top + report.loads.len().div_ceil(columns) as f64 * PANEL_SIZE.1 + MARGIN;
    let mut svg = begin_svg(width, height);
    draw_header(&mut svg, "Rendering: error against run time", &header);
    svg.push_str(&legend);
    let axis_labels = ["median frame time without readback", "mean error of a pixel, of 255"];
    for (index, workload) in report.loads.iter().enumerate() {
        let corner =
            (MARGIN + (index % columns) as f64 * PANEL_SIZE.0, panels_top + (index / columns) as f64 * PANEL_SIZE.1);
        let points = report.rows.iter().filter(|row| row.load == workload.name).filter_map(row_point).collect();
        Panel::new(corner, &workload.name, axis_labels, points).draw(&mut svg, |name| style_of_name(&variants, name));
    }
    svg.push_str("</svg>\n");
    svg
}

/// The lines below the title.
fn header_lines(report: &RenderReport) -> [String; 3] {
    let size = format!("{} x {}", report.size.width, report.size.height);
    [
        report.provenance.line(),
        format!(
            "{}, {size} pixels; error against hard shadow rays, {} samples per pixel",
            report.renderer.renderer,
            min_samples(report)
        ),
        "ringed: Pareto front".into(),
    ]
}

/// Minimum number of samples per pixel of the references.
fn min_samples(report: &RenderReport) -> usize {
    report.loads.iter().map(|workload| workload.samples).min().unwrap_or(0)
}

/// The point of a row; `None` for a row that was not timed. Every point may be on the Pareto front.
fn row_point(row: &RenderRow) -> Option<Point<'_>> {
    let Timing { median_us, q1_us, q3_us, .. } = row.frame_timing()?;
    let value = TimeAndError { time_us: median_us, quartiles_us: [q1_us, q3_us], error: row.color_errors.mean };
    Some(Point { name: &row.name, value, is_filled: true, is_candidate: true })
}
