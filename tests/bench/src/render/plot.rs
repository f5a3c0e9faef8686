//! Plots error against frame time in one panel per load, and marks the Pareto front.

use std::fmt::Write as _;

use super::{RenderReport, RenderRow};
use crate::plot::panel::{MarkerStyle, Panel, Point, filled, mark, width_of};
use crate::plot::{COLORS, HEAD, LEGEND, MARGIN, PANEL, text};
use modalcast_model::deform::Backend;

/// Panels per row.
const COLUMNS: usize = 3;

/// Draws the plot as SVG.
pub(super) fn svg(report: &RenderReport) -> String {
    let mut names: Vec<&str> = Vec::new();
    for row in &report.rows {
        if !names.contains(&row.name.as_str()) {
            names.push(&row.name);
        }
    }
    let columns = report.loads.len().clamp(1, COLUMNS);
    let width = 2.0 * MARGIN + columns as f64 * PANEL.0;
    let (legend, lines) = legend(&names, width);
    let top = MARGIN + HEAD + lines as f64 * LEGEND;
    let height = top + report.loads.len().div_ceil(columns) as f64 * PANEL.1 + MARGIN;
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" \
         viewBox=\"0 0 {width} {height}\" font-family=\"'DejaVu Sans', Verdana, sans-serif\">\n\
         <rect width=\"{width}\" height=\"{height}\" fill=\"#ffffff\"/>\n"
    );
    draw_head(&mut out, report);
    out.push_str(&legend);
    let axis_labels = ["median frame time without readback", "mean error of a pixel, of 255"];
    for (index, load) in report.loads.iter().enumerate() {
        let corner = (MARGIN + (index % columns) as f64 * PANEL.0, top + (index / columns) as f64 * PANEL.1);
        let points = report.rows.iter().filter(|row| row.load == load.name).filter_map(row_point).collect();
        Panel::new(corner, &load.name, axis_labels, points).draw(&mut out, |name| marker_style(&names, name));
    }
    out.push_str("</svg>\n");
    out
}

fn draw_head(out: &mut String, report: &RenderReport) {
    let title_style = "font-size=\"20\" font-weight=\"bold\" fill=\"#222222\"";
    let text_style = "font-size=\"12\" fill=\"#555555\"";
    text(out, (MARGIN + 8.0, MARGIN + 18.0), title_style, "Rendering: error against run time");
    let size = format!("{} x {}", report.size.width, report.size.height);
    let lines = [
        report.provenance.line(),
        format!(
            "{}, {size} pixels; error against hard shadow rays, {} samples a pixel",
            report.renderer.renderer,
            min_samples(report)
        ),
        "ringed: Pareto front".into(),
    ];
    for (line, words) in lines.iter().enumerate() {
        text(out, (MARGIN + 8.0, MARGIN + 40.0 + 16.0 * line as f64), text_style, words);
    }
}

fn min_samples(report: &RenderReport) -> usize {
    report.loads.iter().map(|load| load.samples).min().unwrap_or(0)
}

fn row_point(row: &RenderRow) -> Option<Point<'_>> {
    Some(Point { name: &row.name, at: (row.median_us()?, row.color.mean), filled: true, rival: true })
}

fn marker_style(names: &[&str], name: &str) -> MarkerStyle {
    let index = names.iter().position(|known| *known == name).unwrap_or(0);
    // The CPU's marker is a circle, CUDA's markers are squares and triangles.
    let (backend, round) = match index / COLORS.len() {
        0 => (Backend::Cpu, 0),
        round => (Backend::Cuda, round - 1),
    };
    MarkerStyle { color: COLORS[index % COLORS.len()], backend, round }
}

/// The legend's SVG and its number of lines.
fn legend(names: &[&str], width: f64) -> (String, usize) {
    let (mut out, mut x, mut line) = (String::new(), MARGIN + 8.0, 0);
    for name in names {
        let entry_width = 30.0 + width_of(name, 13.0);
        if x + entry_width > width - MARGIN && x > MARGIN + 8.0 {
            (x, line) = (MARGIN + 8.0, line + 1);
        }
        let (y, style) = (MARGIN + HEAD + line as f64 * LEGEND, marker_style(names, name));
        mark(&mut out, (x + 6.0, y - 4.0), style, &filled(style.color));
        // Writing into a string cannot fail.
        let _ = writeln!(out);
        text(&mut out, (x + 17.0, y), "font-size=\"13\" fill=\"#222222\"", name);
        x += entry_width + 10.0;
    }
    (out, line + 1)
}
