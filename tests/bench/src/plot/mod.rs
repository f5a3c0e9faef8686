//! Plots error against time: one log-log panel per load, with the Pareto front marked.
//!
//! The SVG is generated here. The PNG is rendered from it with an embedded font, so that both are independent of the
//! machine.

mod axis;
pub(super) mod panel;

use std::fmt::Write as _;

use super::DeformReport;
use super::cuda_variants::is_partial;
use super::table::DeformRow;
use super::timing::CacheState;
use modalcast_model::deform::Backend;
use modalcast_model::error::{Result, fault_in};
use panel::{MarkerStyle, Panel, Point};

/// Pixels of the PNG per unit of the SVG.
const SCALE: f32 = 2.0;
/// Size of a panel, and the outer margin.
pub(super) const PANEL: (f64, f64) = (440.0, 320.0);
pub(super) const MARGIN: f64 = 24.0;
/// Height of title, subtitle and the explanation of the marks.
pub(super) const HEAD: f64 = 94.0;
/// Height of a line of the legend.
pub(super) const LEGEND: f64 = 22.0;

/// Colors that color-blind readers can distinguish, followed by a few more (Okabe and Ito; Tableau).
pub(super) const COLORS: [&str; 12] = [
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#6a3d9a", "#8c564b", "#7f7f7f", "#a6a800",
    "#17becf", "#b2182b",
];

/// Draws the plot as SVG.
pub fn svg(report: &DeformReport) -> String {
    let names = names(&report.rows);
    let loads: Vec<&str> = report.loads.iter().map(|load| load.name.as_str()).collect();
    let columns = match loads.len() {
        0..=3 => loads.len().max(1),
        4 => 2,
        5..=12 => 3,
        _ => 4,
    };
    let width = 2.0 * MARGIN + columns as f64 * PANEL.0;
    let (legend, lines) = legend(&names, width);
    let top = MARGIN + HEAD + lines as f64 * LEGEND;
    let height = top + loads.len().div_ceil(columns) as f64 * PANEL.1 + MARGIN;
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" \
         viewBox=\"0 0 {width} {height}\" font-family=\"'DejaVu Sans', Verdana, sans-serif\">\n\
         <rect width=\"{width}\" height=\"{height}\" fill=\"#ffffff\"/>\n"
    );
    text(
        &mut out,
        (MARGIN + 8.0, MARGIN + 18.0),
        "font-size=\"20\" font-weight=\"bold\" fill=\"#222222\"",
        "Error against run time",
    );
    text(&mut out, (MARGIN + 8.0, MARGIN + 40.0), "font-size=\"12\" fill=\"#555555\"", &report.provenance.line());
    let marks = [
        "filled: warm, hollow: cold; ringed: Pareto front (partial work aside)",
        "circle: CPU, square and triangle: CUDA, diamond: reference",
    ];
    for (line, mark) in marks.into_iter().enumerate() {
        let at = (MARGIN + 8.0, MARGIN + 57.0 + 15.0 * line as f64);
        text(&mut out, at, "font-size=\"12\" fill=\"#555555\"", mark);
    }
    out.push_str(&legend);
    for (index, load) in loads.iter().enumerate() {
        let corner = (MARGIN + (index % columns) as f64 * PANEL.0, top + (index / columns) as f64 * PANEL.1);
        let points = report.rows.iter().filter(|row| row.load == *load).filter_map(point).collect();
        let words = ["median time of a step", "largest error / diagonal"];
        Panel::new(corner, load, words, points).draw(&mut out, |name| look(&names, name));
    }
    out.push_str("</svg>\n");
    out
}

/// Renders an SVG as PNG.
///
/// # Errors
/// `Fault` when the SVG is invalid, or too large for memory.
pub fn png(svg: &str) -> Result<Vec<u8>> {
    let mut options = resvg::usvg::Options::default();
    let fonts = options.fontdb_mut();
    fonts.load_font_data(dejavu::sans::regular().to_vec());
    fonts.load_font_data(dejavu::sans::bold().to_vec());
    let tree = resvg::usvg::Tree::from_str(svg, &options).map_err(fault_in("plot"))?;
    let [width, height] = [tree.size().width(), tree.size().height()].map(|side| (side * SCALE).ceil() as u32);
    let too_large = || fault_in("plot")(format!("{width} x {height} pixels are too many"));
    let mut pixels = resvg::tiny_skia::Pixmap::new(width, height).ok_or_else(too_large)?;
    resvg::render(&tree, resvg::tiny_skia::Transform::from_scale(SCALE, SCALE), &mut pixels.as_mut());
    // The background is opaque, so premultiplied colors equal straight ones.
    let image = image::RgbaImage::from_raw(width, height, pixels.take()).ok_or_else(too_large)?;
    let mut bytes = std::io::Cursor::new(Vec::new());
    image::DynamicImage::from(image)
        .to_rgb8()
        .write_to(&mut bytes, image::ImageFormat::Png)
        .map_err(fault_in("plot"))?;
    Ok(bytes.into_inner())
}

/// Warm rows are filled. Variants that compute only a part of a step are excluded from the Pareto front.
fn point(row: &DeformRow) -> Option<Point<'_>> {
    let warm = row.cache == CacheState::Warm;
    Some(Point { name: &row.name, at: row.point()?, filled: warm, rival: warm && !is_partial(&row.name) })
}

/// Each variant once with its backend, in the order of the rows.
fn names(rows: &[DeformRow]) -> Vec<(&str, Backend)> {
    let mut names: Vec<(&str, Backend)> = Vec::new();
    for row in rows {
        if !names.iter().any(|(name, _)| *name == row.name) {
            names.push((&row.name, row.backend));
        }
    }
    names
}

fn look(names: &[(&str, Backend)], name: &str) -> MarkerStyle {
    let index = names.iter().position(|(own, _)| *own == name).unwrap_or(0);
    let backend = names.get(index).map_or(Backend::Cpu, |(_, backend)| *backend);
    MarkerStyle { color: COLORS[index % COLORS.len()], backend, round: index / COLORS.len() }
}

/// The legend's SVG and its number of lines.
fn legend(names: &[(&str, Backend)], width: f64) -> (String, usize) {
    let (mut out, mut x, mut line) = (String::new(), MARGIN + 8.0, 0);
    for (name, _) in names {
        let look = look(names, name);
        let wide = 30.0 + panel::width_of(name, 13.0);
        if x + wide > width - MARGIN && x > MARGIN + 8.0 {
            (x, line) = (MARGIN + 8.0, line + 1);
        }
        let y = MARGIN + HEAD + line as f64 * LEGEND;
        panel::mark(&mut out, (x + 6.0, y - 4.0), look, &panel::filled(look.color));
        text(&mut out, (x + 17.0, y), "font-size=\"13\" fill=\"#222222\"", name);
        x += wide + 10.0;
    }
    (out, line + 1)
}

pub(super) fn text(out: &mut String, (x, y): (f64, f64), style: &str, words: &str) {
    let words = words.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;");
    // Writing into a string cannot fail.
    let _ = writeln!(out, "<text x=\"{x:.1}\" y=\"{y:.1}\" {style}>{words}</text>");
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::table::tests::row;

    #[test]
    fn escapes_text_and_renders_with_the_embedded_font() {
        let mut out = String::from(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"80\" height=\"20\" font-family=\"DejaVu Sans\">",
        );
        out.push_str("<rect width=\"80\" height=\"20\" fill=\"#ffffff\"/>");
        let blank = png(&format!("{out}</svg>")).expect("a PNG");
        text(&mut out, (4.0, 14.0), "font-size=\"12\"", "a < b & c");
        out.push_str("</svg>");
        assert!(out.contains("a &lt; b &amp; c"));
        let dark = |bytes: &[u8]| {
            let image = image::load_from_memory(bytes).expect("a PNG").to_luma8();
            image.pixels().filter(|pixel| pixel.0[0] < 100).count()
        };
        assert_eq!(dark(&blank), 0);
        assert!(dark(&png(&out).expect("a PNG")) > 50, "letters are drawn");
        assert!(png("no svg").is_err());
    }

    #[test]
    fn variant_has_the_same_color_in_every_panel() {
        let rows = [
            row("a", "x", CacheState::Warm, (1.0, 1.0)),
            row("b", "y", CacheState::Warm, (1.0, 1.0)),
            row("b", "x", CacheState::Cold, (1.0, 1.0)),
        ];
        let names = names(&rows);
        assert_eq!(names, [("x", Backend::Cpu), ("y", Backend::Cpu)]);
        assert_ne!(look(&names, "x").color, look(&names, "y").color);
    }

    #[test]
    fn thirty_six_device_variants_have_distinct_marks() {
        let names: Vec<String> = (0..36).map(|index| index.to_string()).collect();
        let list: Vec<(&str, Backend)> = names.iter().map(|name| (name.as_str(), Backend::Cuda)).collect();
        let looks: Vec<MarkerStyle> = names.iter().map(|name| look(&list, name)).collect();
        assert!((0..36).all(|one| (0..one).all(|other| looks[one] != looks[other])));
    }
}
