//! Plots the rates of all cases beside the rates of their slowest stages, and the vertex encodings as error against
//! time.

use std::fmt::Write as _;

use super::rates::RateResult;
use super::vertex_encodings::VertexEncodingRow;
use super::{CaseResult, StreamReport};
use crate::plot::panel::{MarkerStyle, Panel, Point};
use crate::plot::{COLORS, MARGIN, PANEL_SIZE, begin_svg, write_text};
use crate::table::TimeAndError;
use modalcast_model::deform::Backend;

/// Height of the title and the subtitle.
const HEADER_HEIGHT: f64 = 66.0;
/// Height of the bars of one case.
const BAR_ROW_HEIGHT: f64 = 26.0;
/// Width of the names of the cases, and of the longest bar. The rest of a row is for the number.
const NAME_WIDTH: f64 = 250.0;
const MAX_BAR_WIDTH: f64 = 480.0;

const TITLE_STYLE: &str = "font-size=\"20\" font-weight=\"bold\" fill=\"#222222\"";
const TEXT_STYLE: &str = "font-size=\"12\" fill=\"#555555\"";
const NAME_STYLE: &str = "font-size=\"12\" fill=\"#222222\"";

/// Draws the plot as SVG.
pub(super) fn draw_svg(report: &StreamReport) -> String {
    let rates = rates_by_case(report);
    let encodings = encoding_panels(report);
    let width = 2.0 * MARGIN + 2.0 * PANEL_SIZE.0;
    let bars_top = MARGIN + HEADER_HEIGHT;
    let panels_top = bars_top + rates.len() as f64 * BAR_ROW_HEIGHT + MARGIN;
    let height = panels_top + encodings.len().div_ceil(2) as f64 * PANEL_SIZE.1 + MARGIN;
    let mut svg = begin_svg(width, height);
    write_text(&mut svg, (MARGIN, MARGIN + 18.0), TITLE_STYLE, "Rates at the client");
    write_text(&mut svg, (MARGIN, MARGIN + 38.0), TEXT_STYLE, &report.provenance.line());
    let explanation =
        "per second; filled: received by the slowest viewer (without viewers: steps), line: slowest stage alone";
    write_text(&mut svg, (MARGIN, MARGIN + 54.0), TEXT_STYLE, explanation);
    draw_bars(&mut svg, bars_top, &rates);
    for (index, (title, rows)) in encodings.iter().enumerate() {
        let corner = (MARGIN + (index % 2) as f64 * PANEL_SIZE.0, panels_top + (index / 2) as f64 * PANEL_SIZE.1);
        draw_encodings(&mut svg, corner, title, rows);
    }
    svg.push_str("</svg>\n");
    svg
}

/// The cases that measure a rate.
fn rates_by_case(report: &StreamReport) -> Vec<(&str, &RateResult)> {
    let mut rates = Vec::new();
    for case in &report.cases {
        rates.extend(case.result.rate().map(|rate| (case.name, rate)));
    }
    rates
}

fn draw_bars(svg: &mut String, top: f64, rates: &[(&str, &RateResult)]) {
    let stage_rate = |result: &RateResult| result.stage_rates.first().map_or(0.0, |rate| rate.per_second);
    let max_rate = rates.iter().map(|(_, result)| result.per_second.max(stage_rate(result))).fold(0.0, f64::max);
    // Without rates there are no bars.
    let scale = MAX_BAR_WIDTH / max_rate.max(f64::MIN_POSITIVE);
    for (index, (name, result)) in rates.iter().enumerate() {
        let (y, left) = (top + index as f64 * BAR_ROW_HEIGHT, MARGIN + NAME_WIDTH);
        write_text(svg, (MARGIN, y + 15.0), NAME_STYLE, name);
        let (bar_width, stage_x) = (scale * result.per_second, left + scale * stage_rate(result));
        // Writing into a string cannot fail.
        let _ = writeln!(
            svg,
            "<rect x=\"{left}\" y=\"{:.1}\" width=\"{bar_width:.1}\" height=\"14\" fill=\"{}\"/>\n\
             <line x1=\"{stage_x:.1}\" y1=\"{:.1}\" x2=\"{stage_x:.1}\" y2=\"{:.1}\" stroke=\"#222222\" stroke-width=\"2\"/>",
            y + 4.0,
            COLORS[0],
            y + 1.0,
            y + 21.0
        );
        let number_x = left + bar_width.max(stage_x - left) + 8.0;
        write_text(svg, (number_x, y + 15.0), TEXT_STYLE, &format!("{:.1}", result.per_second));
    }
}

/// One panel per scene and attribute: a title and its rows.
fn encoding_panels(report: &StreamReport) -> Vec<(String, Vec<&VertexEncodingRow>)> {
    let mut panels: Vec<(String, Vec<&VertexEncodingRow>)> = Vec::new();
    for case in &report.cases {
        let CaseResult::VertexEncodings(rows) = &case.result else { continue };
        for row in rows {
            let title = format!("{}: {}", case.scene, row.attribute);
            match panels.iter_mut().find(|(other, _)| *other == title) {
                Some((_, rows)) => rows.push(row),
                None => panels.push((title, vec![row])),
            }
        }
    }
    panels
}

/// Draws the errors of encodings against their times. The error of f32 is 0, which is drawn at the lower end.
fn draw_encodings(svg: &mut String, corner: (f64, f64), title: &str, rows: &[&VertexEncodingRow]) {
    let names: Vec<String> =
        rows.iter().map(|row| format!("{}, {} kB", row.encoding, row.bytes.div_ceil(1000))).collect();
    let points = rows.iter().zip(&names).map(|(row, name)| {
        let time_us = 1e3 * (row.pack_ms + row.decode_ms);
        let value = TimeAndError { time_us, quartiles_us: [time_us; 2], error: row.errors.largest };
        Point { name, value, is_filled: true, is_candidate: true }
    });
    let unit = rows.first().map_or("", |row| row.error_unit());
    let error_label = format!("largest error, {unit}");
    let labels = ["time to pack and to decode", error_label.as_str()];
    let marker_style = |name: &str| MarkerStyle {
        color: COLORS[names.iter().position(|other| other == name).unwrap_or(0) % COLORS.len()],
        backend: Backend::Cpu,
        color_reuse: 0,
    };
    Panel::new(corner, title, labels, points.collect()).draw(svg, marker_style);
}
