//! One panel of a plot: frame, grid, points, Pareto front, and labels that do not overlap.

use std::fmt::Write as _;

use super::axis::{self, Axis};
use super::{PANEL, text};
use crate::table::pareto;
use modalcast_model::deform::Backend;

/// Space for labels left, right, above and below the plotted area.
const LEFT: f64 = 66.0;
const RIGHT: f64 = 18.0;
const ABOVE: f64 = 34.0;
const BELOW: f64 = 52.0;
/// Height of the letters of labels.
const LETTERS: f64 = 11.0;

/// x, y, width and height.
type Area = (f64, f64, f64, f64);

/// A point of a panel.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Point<'a> {
    pub(crate) name: &'a str,
    /// Median time in microseconds, and error.
    pub(crate) at: (f64, f64),
    /// Whether its mark is filled; filled marks are drawn on top.
    pub(crate) filled: bool,
    /// Whether it is a candidate for the Pareto front.
    pub(crate) rival: bool,
}

/// A panel of one load.
pub(crate) struct Panel<'a> {
    corner: (f64, f64),
    title: &'a str,
    /// Labels of the x and y axes.
    words: [&'a str; 2],
    points: Vec<Point<'a>>,
    time: Axis,
    error: Axis,
}

impl<'a> Panel<'a> {
    pub(crate) fn new(corner: (f64, f64), title: &'a str, words: [&'a str; 2], points: Vec<Point<'a>>) -> Self {
        let across = (corner.0 + LEFT, corner.0 + PANEL.0 - RIGHT);
        let upwards = (corner.1 + PANEL.1 - BELOW, corner.1 + ABOVE);
        let time = Axis::around(points.iter().map(|point| point.at.0), (1.0, 1e3), across);
        let error = Axis::around(points.iter().map(|point| point.at.1), (1e-8, 1e-6), upwards);
        Self { corner, title, words, points, time, error }
    }

    pub(crate) fn draw(&self, out: &mut String, look: impl Fn(&str) -> MarkerStyle) {
        self.frame(out);
        let places: Vec<(f64, f64)> = self.points.iter().map(|point| self.place(point.at.0, point.at.1)).collect();
        let front = self.front();
        let steps: Vec<String> =
            front.iter().map(|index| format!("{:.1},{:.1}", places[*index].0, places[*index].1)).collect();
        if steps.len() > 1 {
            let _ = writeln!(
                out,
                "<polyline points=\"{}\" fill=\"none\" stroke=\"#999999\" stroke-width=\"1.5\" stroke-dasharray=\"5 3\"/>",
                steps.join(" ")
            );
        }
        for index in &front {
            let (x, y) = places[*index];
            let _ = writeln!(
                out,
                "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"9\" fill=\"none\" stroke=\"#444444\" stroke-width=\"1.2\"/>"
            );
        }
        // Hollow marks first, so that none covers a filled one.
        for full in [false, true] {
            for (point, place) in self.points.iter().zip(&places).filter(|(point, _)| point.filled == full) {
                let look = look(point.name);
                let style = if full { filled(look.color) } else { hollow(look.color) };
                mark(out, *place, look, &style);
            }
        }
        self.labels(out, &places, &front, &look);
        if self.points.is_empty() {
            let middle = (self.corner.0 + PANEL.0 / 2.0, self.corner.1 + PANEL.1 / 2.0);
            text(out, middle, "font-size=\"13\" fill=\"#b2182b\" text-anchor=\"middle\"", "nothing passed");
        }
    }

    fn place(&self, us: f64, error: f64) -> (f64, f64) {
        (self.time.place(us), self.error.place(error))
    }

    /// Indices of the points on the Pareto front of the candidates.
    fn front(&self) -> Vec<usize> {
        let rivals: Vec<usize> = (0..self.points.len()).filter(|at| self.points[*at].rival).collect();
        let points: Vec<(f64, f64)> = rivals.iter().map(|at| self.points[*at].at).collect();
        pareto(&points).into_iter().map(|at| rivals[at]).collect()
    }

    fn frame(&self, out: &mut String) {
        let (left, right) = (self.corner.0 + LEFT, self.corner.0 + PANEL.0 - RIGHT);
        let (top, bottom) = (self.corner.1 + ABOVE, self.corner.1 + PANEL.1 - BELOW);
        let _ = writeln!(
            out,
            "<rect x=\"{left}\" y=\"{top}\" width=\"{}\" height=\"{}\" fill=\"#fafafa\" stroke=\"#888888\"/>",
            right - left,
            bottom - top
        );
        for tick in self.time.ticks() {
            let x = self.time.place(tick);
            let _ =
                writeln!(out, "<line x1=\"{x:.1}\" y1=\"{top}\" x2=\"{x:.1}\" y2=\"{bottom}\" stroke=\"#e2e2e2\"/>");
            text(
                out,
                (x, bottom + 15.0),
                "font-size=\"11\" fill=\"#444444\" text-anchor=\"middle\"",
                &axis::time(tick),
            );
        }
        for tick in self.error.ticks() {
            let y = self.error.place(tick);
            let _ =
                writeln!(out, "<line x1=\"{left}\" y1=\"{y:.1}\" x2=\"{right}\" y2=\"{y:.1}\" stroke=\"#e2e2e2\"/>");
            text(
                out,
                (left - 6.0, y + 4.0),
                "font-size=\"11\" fill=\"#444444\" text-anchor=\"end\"",
                &axis::power(tick),
            );
        }
        text(out, (left, top - 9.0), "font-size=\"14\" font-weight=\"bold\" fill=\"#222222\"", self.title);
        let middle = (left + right) / 2.0;
        let label = "font-size=\"11\" fill=\"#444444\" text-anchor=\"middle\"";
        text(out, (middle, bottom + 33.0), label, self.words[0]);
        let (x, y) = (self.corner.0 + 14.0, (top + bottom) / 2.0);
        text(out, (x, y), &format!("{label} transform=\"rotate(-90 {x:.1} {y:.1})\""), self.words[1]);
    }

    /// Labels the points of the front, and all filled points when there are few.
    fn labels(&self, out: &mut String, places: &[(f64, f64)], front: &[usize], look: &impl Fn(&str) -> MarkerStyle) {
        let mut taken: Vec<Area> = places.iter().map(|(x, y)| (x - 7.0, y - 7.0, 14.0, 14.0)).collect();
        let few = self.points.len() <= 8;
        let named = |at: &usize| front.contains(at) || (few && self.points[*at].filled);
        for at in (0..self.points.len()).filter(named) {
            let name = self.points[at].name;
            // A label without free space is omitted; the legend names its point too.
            if let Some(area) = self.room(places[at], width_of(name, LETTERS), &taken) {
                let fill = look(name).color;
                let style = format!(
                    "font-size=\"{LETTERS}\" fill=\"{fill}\" stroke=\"#fafafa\" stroke-width=\"3\" paint-order=\"stroke\""
                );
                text(out, (area.0, area.1 + LETTERS), &style, name);
                taken.push(area);
            }
        }
    }

    /// Finds free space for a label of this width around a point.
    fn room(&self, (x, y): (f64, f64), width: f64, taken: &[Area]) -> Option<Area> {
        let height = LETTERS + 3.0;
        let beside = [(x + 12.0, y - height / 2.0), (x - 12.0 - width, y - height / 2.0)];
        let above = [14.0, 28.0, 42.0].into_iter().flat_map(|away| {
            let rows = [y - away - height / 2.0 - 4.0, y + away - height / 2.0 + 4.0];
            rows.into_iter().flat_map(move |row| [(x - width / 2.0, row), (x + 4.0, row), (x - 4.0 - width, row)])
        });
        let (left, right) = (self.corner.0 + LEFT + 2.0, self.corner.0 + PANEL.0 - RIGHT - 2.0);
        let (top, bottom) = (self.corner.1 + ABOVE + 2.0, self.corner.1 + PANEL.1 - BELOW - 2.0);
        let fits = |(x, y): &(f64, f64)| {
            let inside = *x >= left && x + width <= right && *y >= top && y + height <= bottom;
            inside && !taken.iter().any(|area| overlap(*area, (*x, *y, width, height)))
        };
        beside.into_iter().chain(above).find(fits).map(|(x, y)| (x, y, width, height))
    }
}

fn overlap(one: Area, other: Area) -> bool {
    let apart = |a: f64, wide: f64, b: f64, broad: f64| a + wide <= b || b + broad <= a;
    !apart(one.0, one.2, other.0, other.2) && !apart(one.1, one.3, other.1, other.3)
}

/// Approximate width of a text in `DejaVu Sans`.
pub(crate) fn width_of(words: &str, size: f64) -> f64 {
    0.61 * size * words.chars().count() as f64
}

pub(crate) fn filled(color: &str) -> String {
    format!("fill=\"{color}\" stroke=\"#ffffff\" stroke-width=\"0.8\"")
}

fn hollow(color: &str) -> String {
    format!("fill=\"#fafafa\" stroke=\"{color}\" stroke-width=\"1.8\"")
}

/// Color and shape of a mark, unique per variant of a report.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct MarkerStyle {
    pub(crate) color: &'static str,
    pub(crate) backend: Backend,
    /// Number of times that all colors were used before.
    pub(crate) round: usize,
}

/// Draws the mark of a variant at a point.
pub(crate) fn mark(out: &mut String, (x, y): (f64, f64), look: MarkerStyle, style: &str) {
    let shape = match (look.backend, look.round % 3) {
        (Backend::Cpu, _) => format!("<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"5\" {style}/>"),
        (Backend::Reference, _) => format!("<path d=\"M{x:.1} {:.1}l6 6l-6 6l-6 -6z\" {style}/>", y - 6.0),
        (Backend::Cuda, 0) => {
            format!("<rect x=\"{:.1}\" y=\"{:.1}\" width=\"9\" height=\"9\" {style}/>", x - 4.5, y - 4.5)
        }
        (Backend::Cuda, 1) => format!("<path d=\"M{x:.1} {:.1}l6 10h-12z\" {style}/>", y - 6.0),
        (Backend::Cuda, _) => format!("<path d=\"M{x:.1} {:.1}l6 -10h-12z\" {style}/>", y + 6.0),
    };
    out.push_str(&shape);
    out.push('\n');
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn front_contains_only_rivals_and_labels_do_not_overlap() {
        let point = |name, filled, rival, at| Point { name, at, filled, rival };
        let points = vec![
            point("cold and best", false, false, (0.1, 1e-9)),
            point("first", true, true, (1.0, 1e-6)),
            point("second", true, true, (1.05, 9e-7)),
            point("beaten", true, true, (2.0, 1e-5)),
            point("does less", true, false, (0.5, 1e-8)),
        ];
        let panel = Panel::new((0.0, 0.0), "a", ["time", "error"], points);
        assert_eq!(panel.front(), [1, 2]);
        let mut out = String::new();
        panel.draw(&mut out, |_| MarkerStyle { color: "#0072b2", backend: Backend::Cpu, round: 0 });
        for name in ["first", "second", "beaten"] {
            assert!(out.contains(&format!(">{name}</text>")), "{name}");
        }
        assert!(!out.contains("cold and best"));
    }

    #[test]
    fn areas_overlap_only_if_both_axes_do() {
        assert!(overlap((0.0, 0.0, 2.0, 2.0), (1.0, 1.0, 2.0, 2.0)));
        assert!(!overlap((0.0, 0.0, 2.0, 2.0), (2.0, 0.0, 2.0, 2.0)));
        assert!(!overlap((0.0, 0.0, 2.0, 2.0), (1.0, 3.0, 2.0, 2.0)));
    }
}
