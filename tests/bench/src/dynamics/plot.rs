//! Plots errors against steps and times, one panel per system, with the slopes of the orders.

use super::oscillators::{SINGLE_MODES, STIFF_SYSTEM};
use super::row::{Expectation, IntegrationRow};
use super::{DynamicsReport, beam, cubic};
use crate::plot::panel::{Curve, Panel, Point};
use crate::plot::{
    HEADER_HEIGHT, LEGEND_LINE_HEIGHT, MARGIN, PANEL_SIZE, begin_svg, draw_header, draw_legend, plot_width,
    style_of_name,
};
use crate::table::TimeAndError;

/// Panels per row.
const COLUMNS: usize = 3;
/// Orders whose slopes are drawn.
const ORDERS: [f64; 2] = [1.0, 2.0];
const SLOPE_COLOR: &str = "#999999";
/// Smaller displacement errors are drawn at the lower end of the axis, so that the others remain apart.
const MIN_ERROR: f64 = 1e-9;
/// The step of the beam's panel with errors by number of modes, seconds.
const BEAM_DT: f64 = 1.0 / 480.0;

/// What a panel shows. A panel without a Pareto front has a line through the points of each name.
struct PanelContents<'a> {
    title: String,
    x_label: &'a str,
    error_label: &'a str,
    points: Vec<Point<'a>>,
    /// Whether the x axis has counts in place of times.
    has_counts: bool,
    /// Lines with the slopes of the orders.
    slopes: Vec<Curve>,
}

/// Draws the plot as SVG.
pub(super) fn draw_svg(report: &DynamicsReport) -> String {
    let panels = list_panels(report);
    let mut names: Vec<&str> = Vec::new();
    for point in panels.iter().flat_map(|panel| &panel.points) {
        if !names.contains(&point.name) {
            names.push(point.name);
        }
    }
    let header = [
        report.provenance.line(),
        "errors are relative; dashed gray: slopes of the orders 1 and 2 through the smallest step; ringed: Pareto front".into(),
        "hollow: negative control, which ignores cubic forces; at the lower edge: displacement errors below 1e-9".into(),
    ];
    let width = plot_width(COLUMNS, &header);
    let (legend, lines) = draw_legend(names.iter().map(|name| (*name, style_of_name(&names, name))), width);
    let panels_top = MARGIN + HEADER_HEIGHT + lines as f64 * LEGEND_LINE_HEIGHT;
    let height = panels_top + panels.len().div_ceil(COLUMNS) as f64 * PANEL_SIZE.1 + MARGIN;
    let mut svg = begin_svg(width, height);
    draw_header(&mut svg, "Dynamics: error against step and time", &header);
    svg.push_str(&legend);
    for (index, contents) in panels.iter().enumerate() {
        let corner =
            (MARGIN + (index % COLUMNS) as f64 * PANEL_SIZE.0, panels_top + (index / COLUMNS) as f64 * PANEL_SIZE.1);
        let axis_labels = [contents.x_label, contents.error_label];
        let panel = Panel::new(corner, &contents.title, axis_labels, contents.points.clone());
        let panel = panel.with_curves(list_curves(contents, &names));
        let panel = if contents.has_counts { panel.with_counts() } else { panel };
        panel.draw(&mut svg, |name| style_of_name(&names, name));
    }
    svg.push_str("</svg>\n");
    svg
}

/// All panels; cases without rows have none.
fn list_panels(report: &DynamicsReport) -> Vec<PanelContents<'_>> {
    let select = |is_selected: &dyn Fn(&IntegrationRow) -> bool| {
        report.rows.iter().filter(|row| is_selected(row)).collect::<Vec<&IntegrationRow>>()
    };
    let single = |system: &str| select(&|row| row.case == SINGLE_MODES && row.system == system);
    let (undamped, damped) = (single("1 Hz, undamped"), single("1 Hz, damping ratio 0.02"));
    let stiff = select(&|row| row.case == STIFF_SYSTEM && row.system.ends_with("undamped"));
    let largest_dt = stiff.iter().map(|row| row.dt_seconds).fold(0.0, f64::max);
    let stiff: Vec<_> = stiff.into_iter().filter(|row| row.dt_seconds == largest_dt).collect();
    let beam_rows = select(&|row| row.case == beam::CASE);
    let beam_at_step = select(&|row| row.case == beam::CASE && (row.dt_seconds / BEAM_DT - 1.0).abs() < 1e-9);
    let most_modes = beam_rows.iter().map(|row| row.coordinates).max().unwrap_or(0);
    let beam_of_most = select(&|row| row.case == beam::CASE && row.coordinates == most_modes);
    let mut panels = vec![
        step_panel("mode of 1 Hz, undamped, 4 periods: by step", &undamped, visible_error),
        step_panel("mode of 1 Hz, damping 2 %, 4 periods: by step", &damped, visible_error),
        time_panel("mode of 1 Hz, undamped, 4 periods: by time", &undamped),
        PanelContents {
            title: "ten modes in one system, steps of 1/60 s".into(),
            x_label: "period of the mode",
            error_label: "largest displacement error",
            points: list_points(&stiff, |row| row.mode_hertz.map(|hertz| 1e6 / hertz), visible_error),
            has_counts: false,
            slopes: Vec::new(),
        },
        PanelContents {
            title: "beam: total error by modes, steps of 1/480 s".into(),
            x_label: "number of modes",
            error_label: "largest error of the tip",
            points: list_points(&beam_at_step, |row| Some(row.coordinates as f64), visible_error),
            has_counts: true,
            slopes: Vec::new(),
        },
        PanelContents {
            error_label: "largest error of the tip",
            ..step_panel(&format!("beam of {most_modes} modes: total error by step"), &beam_of_most, visible_error)
        },
    ];
    for (case, title) in [(cubic::CHAIN, "chain of Duffing oscillators"), (cubic::BRIDGE, "bridge with cubic forces")] {
        let rows = select(&|row| row.case == case);
        panels.push(step_panel(&format!("{title}: by step"), &rows, visible_error));
        panels.push(time_panel(&format!("{title}: by time"), &rows));
        panels.push(PanelContents {
            error_label: "largest energy error",
            slopes: Vec::new(),
            ..step_panel(&format!("{title}: energy"), &rows, |row| row.errors?.energy)
        });
    }
    panels.push(solids_panel(report));
    panels.retain(|panel| !panel.points.is_empty());
    panels
}

/// The error that a user sees; 0, which is drawn at the lower end of the axis, if it is too small to matter.
fn visible_error(row: &IntegrationRow) -> Option<f64> {
    let error = row.errors?.visible_error();
    Some(if error < MIN_ERROR { 0.0 } else { error })
}

fn step_panel<'a>(
    title: &str,
    rows: &[&'a IntegrationRow],
    error: fn(&IntegrationRow) -> Option<f64>,
) -> PanelContents<'a> {
    PanelContents {
        title: title.to_owned(),
        x_label: "mean step",
        error_label: "largest displacement error",
        points: list_points(rows, |row| Some(1e6 * row.mean_sub_step()), error),
        has_counts: false,
        slopes: list_slopes(rows),
    }
}

fn time_panel<'a>(title: &str, rows: &[&'a IntegrationRow]) -> PanelContents<'a> {
    let mut points = list_points(rows, |row| row.run_us, visible_error);
    points.iter_mut().for_each(|point| point.is_candidate = point.is_filled);
    PanelContents {
        title: title.to_owned(),
        x_label: "time of the run, one thread",
        error_label: "largest displacement error",
        points,
        has_counts: false,
        slopes: Vec::new(),
    }
}

fn solids_panel(report: &DynamicsReport) -> PanelContents<'_> {
    let points = report.solids.iter().filter_map(|row| {
        let time_us = 1e6 * row.seconds;
        let value = TimeAndError { time_us, quartiles_us: [time_us; 2], error: row.worst_error? };
        Some(Point { name: row.solid, value, is_filled: true, is_candidate: false })
    });
    PanelContents {
        title: "modes of solids".into(),
        x_label: "time, all cores",
        error_label: "worst of 20 frequencies",
        points: points.collect(),
        has_counts: false,
        slopes: Vec::new(),
    }
}

/// Points that are on no Pareto front.
fn list_points<'a>(
    rows: &[&'a IntegrationRow],
    x: impl Fn(&IntegrationRow) -> Option<f64>,
    error: impl Fn(&IntegrationRow) -> Option<f64>,
) -> Vec<Point<'a>> {
    let point = |row: &&'a IntegrationRow| {
        let time_us = x(row)?;
        let value = TimeAndError { time_us, quartiles_us: [time_us; 2], error: error(row)? };
        let is_filled = row.expectation != Expectation::LargeError;
        Some(Point { name: &row.method, value, is_filled, is_candidate: false })
    };
    rows.iter().filter_map(point).collect()
}

/// Lines through the points of each name, if the panel has no Pareto front, and the slopes.
fn list_curves(contents: &PanelContents<'_>, names: &[&str]) -> Vec<Curve> {
    let mut curves = contents.slopes.clone();
    if contents.points.iter().all(|point| !point.is_candidate) {
        curves.extend(names.iter().map(|name| {
            let of_name = contents.points.iter().filter(|point| point.name == *name);
            let mut points: Vec<(f64, f64)> = of_name.map(|point| (point.value.time_us, point.value.error)).collect();
            points.sort_by(|a, b| a.0.total_cmp(&b.0));
            Curve { points, color: style_of_name(names, name).color, is_dashed: false, label: None }
        }));
    }
    curves
}

/// For each method with an order, a line with the slope of this order through the point with the smallest step, up to the
/// largest error of all methods.
fn list_slopes(rows: &[&IntegrationRow]) -> Vec<Curve> {
    let with_error = || rows.iter().filter_map(|row| Some((row, 1e6 * row.dt_seconds, visible_error(row)?)));
    let Some(top) = with_error().map(|(_, _, error)| error).reduce(f64::max) else { return Vec::new() };
    let slope = |order: f64| {
        let of_order = || with_error().filter(|(row, ..)| row.theoretical_order == Some(order));
        let (_, left, error) = of_order().min_by(|a, b| a.1.total_cmp(&b.1))?;
        let largest_dt = of_order().map(|(_, dt, _)| dt).fold(left, f64::max);
        let right = largest_dt.min(left * (top / error).powf(1.0 / order));
        let points = vec![(left, error), (right, error * (right / left).powf(order))];
        Some(Curve { points, color: SLOPE_COLOR, is_dashed: true, label: Some(format!("order {order}")) })
    };
    ORDERS.iter().filter_map(|order| slope(*order)).collect()
}
