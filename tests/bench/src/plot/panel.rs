//! One panel of a plot: frame, grid, curves, points, Pareto front, and labels that do not overlap.

use std::fmt::Write as _;

use super::axis::{self, Axis};
use super::{PANEL_SIZE, write_text};
use crate::table::{TimeAndError, pareto_front};
use modalcast_model::deform::Backend;

/// Margins of the plotted area for axis labels and the title, SVG units.
const LEFT_MARGIN: f64 = 66.0;
const RIGHT_MARGIN: f64 = 18.0;
const TOP_MARGIN: f64 = 34.0;
const BOTTOM_MARGIN: f64 = 52.0;
/// Font size of point labels.
const LABEL_SIZE: f64 = 11.0;

/// A rectangle in SVG units, with y downwards.
#[derive(Debug, Clone, Copy)]
struct Rectangle {
    x: f64,
    y: f64,
    width: f64,
    height: f64,
}

impl Rectangle {
    fn overlaps(&self, other: &Self) -> bool {
        self.x < other.x + other.width
            && other.x < self.x + self.width
            && self.y < other.y + other.height
            && other.y < self.y + self.height
    }

    fn contains(&self, other: &Self) -> bool {
        other.x >= self.x
            && other.x + other.width <= self.x + self.width
            && other.y >= self.y
            && other.y + other.height <= self.y + self.height
    }
}

/// One measurement in a panel.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Point<'a> {
    pub(crate) name: &'a str,
    /// Time, and error in the unit of the y axis.
    pub(crate) value: TimeAndError,
    /// Whether the marker is filled; filled markers are drawn on top.
    pub(crate) is_filled: bool,
    /// Whether the point may be on the Pareto front.
    pub(crate) is_candidate: bool,
}

/// A line through points, given as (x, error).
#[derive(Debug, Clone)]
pub(crate) struct Curve {
    pub(crate) points: Vec<(f64, f64)>,
    pub(crate) color: &'static str,
    pub(crate) is_dashed: bool,
    /// Text beside the last point.
    pub(crate) label: Option<String>,
}

/// The panel of one workload.
pub(crate) struct Panel<'a> {
    /// Top left corner.
    corner: (f64, f64),
    title: &'a str,
    /// Labels of the x and y axes.
    axis_labels: [&'a str; 2],
    points: Vec<Point<'a>>,
    curves: Vec<Curve>,
    time_axis: Axis,
    /// Formats a tick of the x axis.
    format_time: fn(f64) -> String,
    error_axis: Axis,
}

impl<'a> Panel<'a> {
    pub(crate) fn new(corner: (f64, f64), title: &'a str, axis_labels: [&'a str; 2], points: Vec<Point<'a>>) -> Self {
        let x_range = (corner.0 + LEFT_MARGIN, corner.0 + PANEL_SIZE.0 - RIGHT_MARGIN);
        // The smallest error is at the bottom.
        let y_range = (corner.1 + PANEL_SIZE.1 - BOTTOM_MARGIN, corner.1 + TOP_MARGIN);
        // The ranges (1 us to 1 ms, 1e-8 to 1e-6) are those of a panel without points.
        let time_axis = Axis::new(points.iter().map(|point| point.value.time_us), (1.0, 1e3), x_range);
        let error_axis = Axis::new(points.iter().map(|point| point.value.error), (1e-8, 1e-6), y_range);
        let (curves, format_time) = (Vec::new(), axis::format_time as fn(f64) -> String);
        Self { corner, title, axis_labels, points, curves, time_axis, format_time, error_axis }
    }

    /// The panel with lines below its points. They do not widen the axes.
    pub(crate) fn with_curves(self, curves: Vec<Curve>) -> Self {
        Self { curves, ..self }
    }

    /// The panel with counts in place of times.
    pub(crate) fn with_counts(self) -> Self {
        Self { format_time: axis::format_count, ..self }
    }

    /// Appends the panel to an SVG. `marker_style` gives the style of a variant by its name.
    pub(crate) fn draw(&self, svg: &mut String, marker_style: impl Fn(&str) -> MarkerStyle) {
        self.draw_axes(svg);
        let positions: Vec<(f64, f64)> = self
            .points
            .iter()
            .map(|point| (self.time_axis.pixel(point.value.time_us), self.error_axis.pixel(point.value.error)))
            .collect();
        // Areas of markers and of the labels drawn so far.
        let mut occupied: Vec<Rectangle> =
            positions.iter().map(|(x, y)| Rectangle { x: x - 7.0, y: y - 7.0, width: 14.0, height: 14.0 }).collect();
        for curve in &self.curves {
            self.draw_curve(svg, curve, &mut occupied);
        }
        let front = self.pareto_front();
        let vertices: Vec<(f64, f64)> = front.iter().map(|index| positions[*index]).collect();
        draw_line(svg, &vertices, "#999999", true);
        for index in &front {
            let (x, y) = positions[*index];
            let _ = writeln!(
                svg,
                "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"9\" fill=\"none\" stroke=\"#444444\" stroke-width=\"1.2\"/>"
            );
        }
        // Hollow markers are drawn first, so that they do not cover filled ones.
        for is_filled in [false, true] {
            for (point, position) in
                self.points.iter().zip(&positions).filter(|(point, _)| point.is_filled == is_filled)
            {
                let style = marker_style(point.name);
                let attributes =
                    if is_filled { filled_attributes(style.color) } else { hollow_attributes(style.color) };
                draw_marker(svg, *position, style, &attributes);
            }
        }
        self.draw_point_labels(svg, &positions, &front, &marker_style, &mut occupied);
        if self.points.is_empty() {
            let center = (self.corner.0 + PANEL_SIZE.0 / 2.0, self.corner.1 + PANEL_SIZE.1 / 2.0);
            write_text(svg, center, "font-size=\"13\" fill=\"#b2182b\" text-anchor=\"middle\"", "no points to show");
        }
    }

    /// Indices of the points on the Pareto front of the candidates.
    fn pareto_front(&self) -> Vec<usize> {
        let candidates: Vec<usize> = (0..self.points.len()).filter(|index| self.points[*index].is_candidate).collect();
        let points: Vec<TimeAndError> = candidates.iter().map(|index| self.points[*index].value).collect();
        pareto_front(&points).into_iter().map(|index| candidates[index]).collect()
    }

    /// The plotted area within the margins.
    fn plot_area(&self) -> Rectangle {
        Rectangle {
            x: self.corner.0 + LEFT_MARGIN,
            y: self.corner.1 + TOP_MARGIN,
            width: PANEL_SIZE.0 - LEFT_MARGIN - RIGHT_MARGIN,
            height: PANEL_SIZE.1 - TOP_MARGIN - BOTTOM_MARGIN,
        }
    }

    /// Draws the frame, the grid, the title and the labels of the axes.
    fn draw_axes(&self, svg: &mut String) {
        let Rectangle { x: left, y: top, width, height } = self.plot_area();
        let (right, bottom) = (left + width, top + height);
        let _ = writeln!(
            svg,
            "<rect x=\"{left}\" y=\"{top}\" width=\"{width}\" height=\"{height}\" fill=\"#fafafa\" stroke=\"#888888\"/>"
        );
        for tick in self.time_axis.ticks() {
            let x = self.time_axis.pixel(tick);
            let _ =
                writeln!(svg, "<line x1=\"{x:.1}\" y1=\"{top}\" x2=\"{x:.1}\" y2=\"{bottom}\" stroke=\"#e2e2e2\"/>");
            write_text(
                svg,
                (x, bottom + 15.0),
                "font-size=\"11\" fill=\"#444444\" text-anchor=\"middle\"",
                &(self.format_time)(tick),
            );
        }
        for tick in self.error_axis.ticks() {
            let y = self.error_axis.pixel(tick);
            let _ =
                writeln!(svg, "<line x1=\"{left}\" y1=\"{y:.1}\" x2=\"{right}\" y2=\"{y:.1}\" stroke=\"#e2e2e2\"/>");
            write_text(
                svg,
                (left - 6.0, y + 4.0),
                "font-size=\"11\" fill=\"#444444\" text-anchor=\"end\"",
                &axis::format_power(tick),
            );
        }
        write_text(svg, (left, top - 9.0), "font-size=\"14\" font-weight=\"bold\" fill=\"#222222\"", self.title);
        let center = (left + right) / 2.0;
        let label_style = "font-size=\"11\" fill=\"#444444\" text-anchor=\"middle\"";
        write_text(svg, (center, bottom + 33.0), label_style, self.axis_labels[0]);
        let (x, y) = (self.corner.0 + 14.0, (top + bottom) / 2.0);
        let rotated_style = format!("{label_style} transform=\"rotate(-90 {x:.1} {y:.1})\"");
        write_text(svg, (x, y), &rotated_style, self.axis_labels[1]);
    }

    /// Draws a curve and its label.
    fn draw_curve(&self, svg: &mut String, curve: &Curve, occupied: &mut Vec<Rectangle>) {
        let position = |(x, error): &(f64, f64)| (self.time_axis.pixel(*x), self.error_axis.pixel(*error));
        let vertices: Vec<(f64, f64)> = curve.points.iter().map(position).collect();
        draw_line(svg, &vertices, curve.color, curve.is_dashed);
        if let (Some(label), Some(end)) = (&curve.label, vertices.last()) {
            self.draw_label(svg, *end, label, curve.color, occupied);
        }
    }

    /// Labels the points of the front, and all filled points if the panel has few points. A name is drawn once.
    fn draw_point_labels(
        &self,
        svg: &mut String,
        positions: &[(f64, f64)],
        front: &[usize],
        marker_style: &impl Fn(&str) -> MarkerStyle,
        occupied: &mut Vec<Rectangle>,
    ) {
        let has_few_points = self.points.len() <= 8;
        let has_label = |index: &usize| front.contains(index) || (has_few_points && self.points[*index].is_filled);
        let mut labeled: Vec<&str> = Vec::new();
        for index in (0..self.points.len()).filter(has_label) {
            let name = self.points[index].name;
            if !labeled.contains(&name)
                && self.draw_label(svg, positions[index], name, marker_style(name).color, occupied)
            {
                labeled.push(name);
            }
        }
    }

    /// Draws a label near a point. Returns false without free space; the legend also names the point.
    fn draw_label(
        &self,
        svg: &mut String,
        position: (f64, f64),
        text: &str,
        color: &str,
        occupied: &mut Vec<Rectangle>,
    ) -> bool {
        let Some(area) = self.find_label_area(position, text_width(text, LABEL_SIZE), occupied) else { return false };
        let style = format!(
            "font-size=\"{LABEL_SIZE}\" fill=\"{color}\" stroke=\"#fafafa\" stroke-width=\"3\" paint-order=\"stroke\""
        );
        write_text(svg, (area.x, area.y + LABEL_SIZE), &style, text);
        occupied.push(area);
        true
    }

    /// Finds free space for a label of this width near a point: to its right or left, else above or below it.
    fn find_label_area(&self, (x, y): (f64, f64), width: f64, occupied: &[Rectangle]) -> Option<Rectangle> {
        let height = LABEL_SIZE + 3.0;
        // Top left corners to try, in this order. The distances are SVG units, chosen by eye.
        let side_corners = [(x + 12.0, y - height / 2.0), (x - 12.0 - width, y - height / 2.0)];
        let vertical_corners = [14.0, 28.0, 42.0].into_iter().flat_map(|distance| {
            let tops = [y - distance - height / 2.0 - 4.0, y + distance - height / 2.0 + 4.0];
            tops.into_iter().flat_map(move |top| [(x - width / 2.0, top), (x + 4.0, top), (x - 4.0 - width, top)])
        });
        let plot_area = self.plot_area();
        let label_bounds = Rectangle {
            x: plot_area.x + 2.0,
            y: plot_area.y + 2.0,
            width: plot_area.width - 4.0,
            height: plot_area.height - 4.0,
        };
        side_corners
            .into_iter()
            .chain(vertical_corners)
            .map(|(x, y)| Rectangle { x, y, width, height })
            .find(|label| label_bounds.contains(label) && !occupied.iter().any(|area| area.overlaps(label)))
    }
}

/// Draws a line through points in SVG units; nothing for fewer than two points.
fn draw_line(svg: &mut String, vertices: &[(f64, f64)], color: &str, is_dashed: bool) {
    if vertices.len() < 2 {
        return;
    }
    let points: Vec<String> = vertices.iter().map(|(x, y)| format!("{x:.1},{y:.1}")).collect();
    let dashes = if is_dashed { " stroke-dasharray=\"5 3\"" } else { "" };
    // Writing into a string cannot fail.
    let _ = writeln!(
        svg,
        "<polyline points=\"{}\" fill=\"none\" stroke=\"{color}\" stroke-width=\"1.5\"{dashes}/>",
        points.join(" ")
    );
}

/// Approximate width of a text in `DejaVu Sans`, whose letters are 0.61 of the font size wide on average.
pub(crate) fn text_width(text: &str, font_size: f64) -> f64 {
    0.61 * font_size * text.chars().count() as f64
}

/// SVG attributes of a filled marker.
pub(crate) fn filled_attributes(color: &str) -> String {
    format!("fill=\"{color}\" stroke=\"#ffffff\" stroke-width=\"0.8\"")
}

/// SVG attributes of a hollow marker.
fn hollow_attributes(color: &str) -> String {
    format!("fill=\"#fafafa\" stroke=\"{color}\" stroke-width=\"1.8\"")
}

/// Color and shape of a marker, unique per variant of a report.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct MarkerStyle {
    pub(crate) color: &'static str,
    pub(crate) backend: Backend,
    /// Number of earlier variants with the same color. It selects one of five shapes of CUDA markers: a
    /// square, and triangles in four directions.
    pub(crate) color_reuse: usize,
}

/// Draws the marker of a variant at a point.
pub(crate) fn draw_marker(svg: &mut String, (x, y): (f64, f64), style: MarkerStyle, attributes: &str) {
    let shape = match (style.backend, style.color_reuse % 5) {
        (Backend::Cpu, _) => format!("<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"5\" {attributes}/>"),
        (Backend::Reference, _) => format!("<path d=\"M{x:.1} {:.1}l6 6l-6 6l-6 -6z\" {attributes}/>", y - 6.0),
        (Backend::Cuda, 0) => {
            format!("<rect x=\"{:.1}\" y=\"{:.1}\" width=\"9\" height=\"9\" {attributes}/>", x - 4.5, y - 4.5)
        }
        (Backend::Cuda, 1) => format!("<path d=\"M{x:.1} {:.1}l6 10h-12z\" {attributes}/>", y - 6.0),
        (Backend::Cuda, 2) => format!("<path d=\"M{x:.1} {:.1}l6 -10h-12z\" {attributes}/>", y + 6.0),
        (Backend::Cuda, 3) => format!("<path d=\"M{:.1} {y:.1}l10 6v-12z\" {attributes}/>", x - 6.0),
        (Backend::Cuda, _) => format!("<path d=\"M{:.1} {y:.1}l-10 6v-12z\" {attributes}/>", x + 6.0),
    };
    svg.push_str(&shape);
    svg.push('\n');
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn front_has_only_candidates_and_labels_do_not_overlap() {
        // Arguments: name, is_filled, is_candidate, time_us, error.
        let point = |name, is_filled, is_candidate, time_us, error| {
            let value = TimeAndError { time_us, quartiles_us: [time_us; 2], error };
            Point { name, value, is_filled, is_candidate }
        };
        let points = vec![
            point("cold and best", false, false, 0.1, 1e-9),
            point("first", true, true, 1.0, 1e-6),
            point("second", true, true, 1.05, 9e-7),
            point("dominated", true, true, 2.0, 1e-5),
            point("partial", true, false, 0.5, 1e-8),
        ];
        let panel = Panel::new((0.0, 0.0), "a", ["time", "error"], points);
        assert_eq!(panel.pareto_front(), [1, 2]);
        let mut svg = String::new();
        panel.draw(&mut svg, |_| MarkerStyle { color: "#0072b2", backend: Backend::Cpu, color_reuse: 0 });
        for name in ["first", "second", "dominated"] {
            assert!(svg.contains(&format!(">{name}</text>")), "expected a label for '{name}'");
        }
        assert!(!svg.contains("cold and best"), "expected no label for a hollow point off the front");
    }

    #[test]
    fn curves_have_labels_and_repeated_names_have_one() {
        let point = |time_us: f64| {
            let value = TimeAndError { time_us, quartiles_us: [time_us; 2], error: 1.0 / time_us };
            Point { name: "repeated", value, is_filled: true, is_candidate: false }
        };
        let curve = |label: Option<&str>, is_dashed| {
            let (points, label) = (vec![(1.0, 1.0), (20.0, 0.05)], label.map(String::from));
            Curve { points, color: "#999999", is_dashed, label }
        };
        let panel = Panel::new((0.0, 0.0), "a", ["modes", "error"], vec![point(1.0), point(20.0)]);
        let mut svg = String::new();
        panel
            .with_curves(vec![curve(Some("order 1"), true), curve(None, false)])
            .with_counts()
            .draw(&mut svg, |_| MarkerStyle { color: "#0072b2", backend: Backend::Cpu, color_reuse: 0 });
        let count = |text: &str| svg.matches(text).count();
        assert_eq!((count(">repeated</text>"), count(">order 1</text>"), count("<polyline")), (1, 1, 2), "{svg}");
        assert!(count("stroke-dasharray") == 1 && count(">10</text>") == 1 && count("µs") == 0, "{svg}");
    }

    #[test]
    fn rectangles_overlap_only_if_both_axes_do() {
        let square = |x: f64, y: f64| Rectangle { x, y, width: 2.0, height: 2.0 };
        assert!(square(0.0, 0.0).overlaps(&square(1.0, 1.0)));
        assert!(!square(0.0, 0.0).overlaps(&square(2.0, 0.0)));
        assert!(!square(0.0, 0.0).overlaps(&square(1.0, 3.0)));
    }
}
