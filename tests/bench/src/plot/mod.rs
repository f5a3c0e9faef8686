//! Plots error against time: one log-log panel per workload, with the Pareto front marked.
//!
//! The SVG is generated here. The PNG is rendered from it with an embedded font, so that both are independent of the
//! machine.

mod axis;
pub(super) mod panel;

use std::fmt::Write as _;

use super::DeformReport;
use super::cuda_variants::is_partial_step;
use super::table::DeformRow;
use super::timing::CacheState;
use modalcast_model::deform::Backend;
use modalcast_model::error::{Result, fault, fault_in};
use panel::{MarkerStyle, Panel, Point};

/// Pixels of the PNG per unit of the SVG.
const SCALE: f32 = 2.0;
/// Width and height of a panel. All lengths are in SVG units.
pub(super) const PANEL_SIZE: (f64, f64) = (440.0, 320.0);
/// Outer margin of the plot.
pub(super) const MARGIN: f64 = 24.0;
/// Height of the title, the subtitle and the explanation of the markers.
pub(super) const HEADER_HEIGHT: f64 = 94.0;
/// Mean width of a character of the text below the title.
const CHARACTER_WIDTH: f64 = 6.8;
/// Height of a line of the legend.
pub(super) const LEGEND_LINE_HEIGHT: f64 = 22.0;

/// Eight colors that color-blind readers can distinguish (Okabe and Ito; Tableau), and four more.
pub(super) const COLORS: [&str; 12] = [
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#6a3d9a", "#8c564b", "#7f7f7f", "#a6a800",
    "#17becf", "#b2182b",
];

/// Draws the plot as SVG.
pub fn draw_svg(report: &DeformReport) -> String {
    let variants = list_variants(&report.rows);
    let workloads: Vec<&str> = report.loads.iter().map(|load| load.name.as_str()).collect();
    // Panels per row.
    let columns = match workloads.len() {
        0..=3 => workloads.len().max(1),
        4 => 2,
        5..=12 => 3,
        _ => 4,
    };
    let header = [
        report.provenance.line(),
        "filled: warm, hollow: cold; circle: CPU, square and triangle: CUDA, diamond: reference".into(),
        "ringed: Pareto front (gains beyond noise, without variants that compute only a part)".into(),
    ];
    let width = plot_width(columns, &header);
    let (legend, lines) = draw_legend(variants.iter().map(|(name, _)| (*name, marker_style(&variants, name))), width);
    let panels_top = MARGIN + HEADER_HEIGHT + lines as f64 * LEGEND_LINE_HEIGHT;
    let height = panels_top + workloads.len().div_ceil(columns) as f64 * PANEL_SIZE.1 + MARGIN;
    let mut svg = begin_svg(width, height);
    draw_header(&mut svg, "Error against run time", &header);
    svg.push_str(&legend);
    let axis_labels = ["median time of a step", "largest error / diagonal"];
    for (index, workload) in workloads.iter().enumerate() {
        let corner =
            (MARGIN + (index % columns) as f64 * PANEL_SIZE.0, panels_top + (index / columns) as f64 * PANEL_SIZE.1);
        let points = report.rows.iter().filter(|row| row.load == *workload).filter_map(row_point).collect();
        Panel::new(corner, workload, axis_labels, points).draw(&mut svg, |name| marker_style(&variants, name));
    }
    svg.push_str("</svg>\n");
    svg
}

/// Width of a plot with `columns` panels per row, or that of its header if that is wider.
pub(super) fn plot_width(columns: usize, header: &[String; 3]) -> f64 {
    let characters = header.iter().map(|line| line.chars().count()).max().unwrap_or(0);
    2.0 * MARGIN + (columns as f64 * PANEL_SIZE.0).max((characters as f64 * CHARACTER_WIDTH).ceil())
}

/// Draws the title and three lines below it, in the height [`HEADER_HEIGHT`].
pub(super) fn draw_header(svg: &mut String, title: &str, lines: &[String; 3]) {
    let title_style = "font-size=\"20\" font-weight=\"bold\" fill=\"#222222\"";
    write_text(svg, (MARGIN + 8.0, MARGIN + 18.0), title_style, title);
    for (index, line) in lines.iter().enumerate() {
        let baseline = MARGIN + 40.0 + 16.0 * index as f64;
        write_text(svg, (MARGIN + 8.0, baseline), "font-size=\"12\" fill=\"#555555\"", line);
    }
}

/// The opening tag and the white background of an SVG.
pub(super) fn begin_svg(width: f64, height: f64) -> String {
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" \
         viewBox=\"0 0 {width} {height}\" font-family=\"'DejaVu Sans', Verdana, sans-serif\">\n\
         <rect width=\"{width}\" height=\"{height}\" fill=\"#ffffff\"/>\n"
    )
}

/// Renders an SVG as PNG.
///
/// # Errors
/// `Fault` when the SVG is invalid, or too large for memory.
pub fn render_png(svg: &str) -> Result<Vec<u8>> {
    let mut options = resvg::usvg::Options::default();
    let fonts = options.fontdb_mut();
    fonts.load_font_data(dejavu::sans::regular().to_vec());
    fonts.load_font_data(dejavu::sans::bold().to_vec());
    let tree = resvg::usvg::Tree::from_str(svg, &options).map_err(fault_in("plot"))?;
    let [width, height] = [tree.size().width(), tree.size().height()].map(|side| (side * SCALE).ceil() as u32);
    let too_large = || fault("plot", format!("{width} x {height} pixels exceed the available memory"));
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

/// The point of a row. Rows with warm caches are filled and may be on the Pareto front, unless their variant computes
/// only a part of a step.
fn row_point(row: &DeformRow) -> Option<Point<'_>> {
    let is_filled = row.cache == CacheState::Warm;
    let is_candidate = is_filled && !is_partial_step(&row.name);
    Some(Point { name: &row.name, value: row.time_and_error()?, is_filled, is_candidate })
}

/// Each variant once with its backend, in the order of the rows.
fn list_variants(rows: &[DeformRow]) -> Vec<(&str, Backend)> {
    let mut variants: Vec<(&str, Backend)> = Vec::new();
    for row in rows {
        if !variants.iter().any(|(name, _)| *name == row.name) {
            variants.push((&row.name, row.backend));
        }
    }
    variants
}

/// The marker of a variant. After twelve variants, the colors repeat with another shape.
fn marker_style(variants: &[(&str, Backend)], name: &str) -> MarkerStyle {
    let index = variants.iter().position(|(variant, _)| *variant == name).unwrap_or(0);
    let backend = variants.get(index).map_or(Backend::Cpu, |(_, backend)| *backend);
    MarkerStyle { color: COLORS[index % COLORS.len()], backend, color_reuse: index / COLORS.len() }
}

/// Color and shape of a name in a list: circles until all colors are used, then squares and triangles. `backend` and
/// `color_reuse` select the shape.
pub(super) fn style_of_name(names: &[&str], name: &str) -> MarkerStyle {
    let index = names.iter().position(|known| *known == name).unwrap_or(0);
    let (backend, color_reuse) = match index / COLORS.len() {
        0 => (Backend::Cpu, 0),
        reuse => (Backend::Cuda, reuse - 1),
    };
    MarkerStyle { color: COLORS[index % COLORS.len()], backend, color_reuse }
}

/// Draws the legend of a plot of this width. Returns its SVG and its number of lines.
pub(super) fn draw_legend<'a>(
    entries: impl Iterator<Item = (&'a str, MarkerStyle)>,
    plot_width: f64,
) -> (String, usize) {
    let (mut svg, mut x, mut line) = (String::new(), MARGIN + 8.0, 0);
    for (name, style) in entries {
        let entry_width = 30.0 + panel::text_width(name, 13.0);
        if x + entry_width > plot_width - MARGIN && x > MARGIN + 8.0 {
            (x, line) = (MARGIN + 8.0, line + 1);
        }
        let y = MARGIN + HEADER_HEIGHT + line as f64 * LEGEND_LINE_HEIGHT;
        panel::draw_marker(&mut svg, (x + 6.0, y - 4.0), style, &panel::filled_attributes(style.color));
        write_text(&mut svg, (x + 17.0, y), "font-size=\"13\" fill=\"#222222\"", name);
        x += entry_width + 10.0;
    }
    (svg, line + 1)
}

/// Writes escaped text whose baseline starts at (x, y). `style` is a list of SVG attributes.
pub(super) fn write_text(svg: &mut String, (x, y): (f64, f64), style: &str, text: &str) {
    let text = text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;");
    // Writing into a string cannot fail.
    let _ = writeln!(svg, "<text x=\"{x:.1}\" y=\"{y:.1}\" {style}>{text}</text>");
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;
    use crate::table::tests::row;

    #[test]
    fn escapes_text_and_renders_with_the_embedded_font() {
        let mut svg = begin_svg(80.0, 20.0);
        let blank = render_png(&format!("{svg}</svg>")).expect("a PNG");
        write_text(&mut svg, (4.0, 14.0), "font-size=\"12\"", "a < b & c");
        svg.push_str("</svg>");
        assert!(svg.contains("a &lt; b &amp; c"));
        let count_dark_pixels = |bytes: &[u8]| {
            let image = image::load_from_memory(bytes).expect("a PNG").to_luma8();
            image.pixels().filter(|pixel| pixel.0[0] < 100).count()
        };
        assert_eq!(count_dark_pixels(&blank), 0);
        assert!(count_dark_pixels(&render_png(&svg).expect("a PNG")) > 50, "expected dark pixels of the letters");
        assert!(render_png("no svg").is_err());
    }

    #[test]
    fn lists_each_variant_once_with_a_distinct_color() {
        let rows = [
            row("a", "x", CacheState::Warm, (1.0, 1.0)),
            row("b", "y", CacheState::Warm, (1.0, 1.0)),
            row("b", "x", CacheState::Cold, (1.0, 1.0)),
        ];
        let variants = list_variants(&rows);
        assert_eq!(variants, [("x", Backend::Cpu), ("y", Backend::Cpu)]);
        assert_ne!(marker_style(&variants, "x").color, marker_style(&variants, "y").color);
    }

    #[test]
    fn sixty_cuda_variants_have_distinct_markers() {
        // Twelve colors, each with five shapes.
        let draw_markers = |count: usize| {
            let names: Vec<String> = (0..count).map(|index| index.to_string()).collect();
            let variants: Vec<(&str, Backend)> = names.iter().map(|name| (name.as_str(), Backend::Cuda)).collect();
            let draw = |name: &String| {
                let (style, mut svg) = (marker_style(&variants, name), String::new());
                panel::draw_marker(&mut svg, (0.0, 0.0), style, &panel::filled_attributes(style.color));
                svg
            };
            names.iter().map(draw).collect::<HashSet<String>>().len()
        };
        assert_eq!((draw_markers(60), draw_markers(61)), (60, 60));
    }
}
