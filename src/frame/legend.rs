//! The legend of a color map: a color bar with ticks, labels and a title, composited over a picture.

use std::fmt::Write as _;

use super::colormap::viridis;
use modalcast_model::error::{Result, fault_in};

/// Title and scale of a color map.
#[derive(Debug, Clone, PartialEq)]
pub struct Legend {
    /// The quantity and its unit.
    pub title: String,
    /// The value at the bright end of the scale; the dark end is 0.
    pub largest: f64,
}

/// The smallest width and height in pixels of a picture that gets a legend.
const MIN_SIZE: [u32; 2] = [240, 160];
/// Width and height of the legend's box in pixels of a picture with 720 rows; scaled for other sizes.
const WIDTH: f64 = 330.0;
const HEIGHT: f64 = 84.0;
/// The color bar inside the box: left, top, width, height, in the same unit.
const BAR: (f64, f64, f64, f64) = (26.0, 34.0, 278.0, 16.0);
/// Number of intervals of the color bar's gradient.
const STOPS: u32 = 64;

/// Draws the legend into the lower left corner of RGBA8 pixels, top row first. A picture smaller than 240 x 160 remains
/// unchanged.
///
/// # Errors
/// `Fault` when the legend cannot be rasterized.
pub fn draw(rgba: &mut [u8], [width, height]: [u32; 2], legend: &Legend) -> Result<()> {
    if width < MIN_SIZE[0] || height < MIN_SIZE[1] {
        return Ok(());
    }
    let scale = (f64::from(height) / 720.0).max(0.62).min(f64::from(width) / (1.15 * WIDTH));
    let mut options = resvg::usvg::Options::default();
    options.fontdb_mut().load_font_data(dejavu::sans::regular().to_vec());
    let tree = resvg::usvg::Tree::from_str(&svg(legend), &options).map_err(fault_in("legend"))?;
    let size = [(WIDTH * scale).ceil() as u32, (HEIGHT * scale).ceil() as u32];
    let too_large = || fault_in("legend")("it is too large");
    let mut pixels = resvg::tiny_skia::Pixmap::new(size[0], size[1]).ok_or_else(too_large)?;
    let scaled = resvg::tiny_skia::Transform::from_scale(scale as f32, scale as f32);
    resvg::render(&tree, scaled, &mut pixels.as_mut());
    let margin = (12.0 * scale) as u32;
    let top = height.saturating_sub(size[1] + margin);
    for (row, own) in (top..height).zip(pixels.data().chunks_exact(4 * size[0] as usize)) {
        let first = 4 * (row as usize * width as usize + margin as usize);
        let end = first.max(4 * (row as usize + 1) * width as usize).min(first + own.len());
        for (under, over) in rgba[first..end].chunks_exact_mut(4).zip(own.chunks_exact(4)) {
            // Premultiplied alpha, "over" operator.
            let left = 255 - u32::from(over[3]);
            (0..3).for_each(|at| under[at] = (u32::from(over[at]) + u32::from(under[at]) * left / 255).min(255) as u8);
        }
    }
    Ok(())
}

/// Rounds up to 1, 2, 2.5 or 5 times a power of ten, so that the scale has readable ticks. Returns 1 for values that
/// are not finite and positive.
pub fn nice_ceiling(value: f64) -> f64 {
    if !(value.is_finite() && value > 0.0) {
        return 1.0;
    }
    let decade = 10f64.powi(value.log10().floor() as i32);
    let steps = [1.0, 2.0, 2.5, 5.0, 10.0].map(|step| step * decade);
    // With a relative tolerance, so that rounding errors do not push 0.2 to 0.25.
    steps.into_iter().find(|step| *step >= value * (1.0 - 1e-9)).unwrap_or(10.0 * decade)
}

fn svg(legend: &Legend) -> String {
    let (left, top, width, height) = BAR;
    let mut text = format!(
        "<svg xmlns='http://www.w3.org/2000/svg' width='{WIDTH}' height='{HEIGHT}' font-family='DejaVu Sans'>\
         <rect width='{WIDTH}' height='{HEIGHT}' rx='6' fill='#ffffff' fill-opacity='0.86'/>\
         <text x='{left}' y='23' font-size='15' fill='#1a1a1a'>{}</text>",
        escaped(&legend.title)
    );
    text += "<defs><linearGradient id='map'>";
    for stop in 0..=STOPS {
        let share = stop as f32 / STOPS as f32;
        let [r, g, b] = viridis(share).map(|channel| (255.0 * channel).round() as u8);
        write!(text, "<stop offset='{share}' stop-color='rgb({r},{g},{b})'/>").ok();
    }
    text += "</linearGradient></defs>";
    write!(text, "<rect x='{left}' y='{top}' width='{width}' height='{height}' fill='url(#map)'/>").ok();
    for (share, label) in ticks(legend.largest) {
        let (x, y) = (left + share * width, top + height);
        write!(text, "<path d='M{x:.2} {y} v5' stroke='#1a1a1a' stroke-width='1.2'/>").ok();
        let y = y + 19.0;
        write!(text, "<text x='{x:.2}' y='{y}' font-size='13' text-anchor='middle' fill='#1a1a1a'>{label}</text>").ok();
    }
    text + "</svg>"
}

/// Tick positions from 0 to 1 and their labels: three to five equal intervals from 0 to the largest value.
fn ticks(largest: f64) -> Vec<(f64, String)> {
    let leading = largest / 10f64.powi(largest.log10().floor() as i32);
    let is = |round: f64| (leading - round).abs() < 1e-6;
    let steps = if [2.0, 4.0, 8.0].into_iter().any(is) {
        4
    } else if [3.0, 6.0].into_iter().any(is) {
        3
    } else {
        5
    };
    (0..=steps)
        .map(|step| (f64::from(step) / f64::from(steps), label(largest * f64::from(step) / f64::from(steps))))
        .collect()
}

/// Formats a number with at most three significant digits.
fn label(value: f64) -> String {
    if value == 0.0 {
        return "0".into();
    }
    let exponent = value.abs().log10().floor() as i32;
    if !(-3..4).contains(&exponent) {
        let digits = (value / 10f64.powi(exponent) * 100.0).round() / 100.0;
        return format!("{digits}e{exponent}");
    }
    let places = (2 - exponent).max(0);
    let power = 10f64.powi(places);
    format!("{}", (value * power).round() / power)
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scales_end_at_numbers_that_people_can_read() {
        let rounded = [0.013, 0.2, 0.21, 3.0, 7.0, 1e-9, 1e9, 0.0, f64::NAN].map(nice_ceiling);
        for (got, want) in rounded.iter().zip([0.02, 0.2, 0.25, 5.0, 10.0, 1e-9, 1e9, 1.0, 1.0]) {
            assert!((got / want - 1.0).abs() < 1e-9, "{got} is not {want}");
        }
        let labels = |largest| ticks(largest).into_iter().map(|(_, label)| label).collect::<Vec<_>>().join(" ");
        assert_eq!(labels(0.02), "0 0.005 0.01 0.015 0.02");
        assert_eq!((labels(2.5), labels(0.8)), ("0 0.5 1 1.5 2 2.5".into(), "0 0.2 0.4 0.6 0.8".into()));
        assert_eq!(labels(1e-7), "0 2e-8 4e-8 6e-8 8e-8 1e-7");
        assert_eq!(labels(1e9), "0 2e8 4e8 6e8 8e8 1e9");
    }

    #[test]
    fn the_bar_has_the_maps_colours_inside_of_the_picture_and_small_pictures_stay() {
        let legend = Legend { title: "|u| < 1 & more, m".into(), largest: 0.5 };
        for [width, height] in [[1280, 720], [300, 2000], [240, 160], [4000, 200]] {
            let mut rgba = vec![40; 4 * width as usize * height as usize];
            draw(&mut rgba, [width, height], &legend).expect("draws");
            let pixels: Vec<&[u8]> = rgba.chunks_exact(4).collect();
            for share in [0.1, 0.5, 0.9] {
                let want = viridis(share).map(|channel| 255.0 * channel);
                let near =
                    |pixel: &&&[u8]| pixel.iter().zip(want).all(|(got, want)| (f32::from(*got) - want).abs() < 4.0);
                assert!(pixels.iter().filter(near).count() > 4, "{width} x {height}: {share}");
            }
            assert!(pixels[..width as usize].iter().all(|pixel| pixel[..3] == [40; 3]), "the top row stays");
        }
        let mut small = vec![40; 4 * 239 * 160];
        draw(&mut small, [239, 160], &legend).expect("nothing to do");
        assert!(small.iter().all(|byte| *byte == 40));
    }
}
