//! The legend of a color map: a color bar with ticks, labels and a title, blended over an image.

use ab_glyph::{Font as _, FontRef, PxScale, ScaleFont as _};
use ab_glyph_rasterizer::{Point, Rasterizer, point};

use super::colormap::viridis;
use modalcast_model::error::{Result, fault_in};

/// Title and axis of a color map.
#[derive(Debug, Clone, PartialEq)]
pub struct Legend {
    /// The quantity and its unit.
    pub title: String,
    /// The value at the bright end of the axis. The value at the dark end is 0.
    pub scale_max: f64,
}

/// The smallest width and height in pixels of an image with a legend.
const MIN_SIZE: [u32; 2] = [240, 160];
/// Width and height of the legend's box in layout units. One layout unit is `height / 720` pixels, but at least
/// [`MIN_PIXELS_PER_UNIT`], unless the box would then be wider than the image.
const BOX_WIDTH: f32 = 330.0;
const BOX_HEIGHT: f32 = 84.0;
/// Pixels per layout unit at which labels are just readable.
const MIN_PIXELS_PER_UNIT: f32 = 0.62;
/// Radius of the box's corners, in layout units.
const CORNER_RADIUS: f32 = 6.0;
const BOX_OPACITY: f32 = 0.86;
/// Font sizes in layout units.
const TITLE_FONT_SIZE: f32 = 15.0;
const LABEL_FONT_SIZE: f32 = 13.0;
/// The color bar inside the box.
const BAR: Rectangle = Rectangle { left: 26.0, top: 34.0, width: 278.0, height: 16.0 };
/// sRGB of text and ticks.
const TEXT_COLOR: [u8; 3] = [0x1a; 3];

/// Draws the legend into the lower left corner of RGBA8 pixels, top row first. An image smaller than `MIN_SIZE` remains
/// unchanged.
///
/// # Errors
/// `Fault` when the embedded font cannot be read.
pub fn draw(rgba: &mut [u8], [width, height]: [u32; 2], legend: &Legend) -> Result<()> {
    if width < MIN_SIZE[0] || height < MIN_SIZE[1] {
        return Ok(());
    }
    let font = FontRef::try_from_slice(dejavu::sans::regular()).map_err(fault_in("legend"))?;
    // The factor 1.15 leaves room for the margins beside the box.
    let pixels_per_unit = (height as f32 / 720.0).max(MIN_PIXELS_PER_UNIT).min(width as f32 / (1.15 * BOX_WIDTH));
    let box_size = [(BOX_WIDTH * pixels_per_unit).ceil() as usize, (BOX_HEIGHT * pixels_per_unit).ceil() as usize];
    let margin = (12.0 * pixels_per_unit) as usize;
    let box_origin = [margin, (height as usize).saturating_sub(box_size[1] + margin)];
    let mut canvas = Canvas { rgba, width: width as usize, box_origin, box_size, pixels_per_unit, font };

    let background = Rectangle { left: 0.0, top: 0.0, width: BOX_WIDTH, height: BOX_HEIGHT };
    canvas.fill_rectangle(&background, CORNER_RADIUS, BOX_OPACITY, |_| [255; 3]);
    canvas.draw_text(&legend.title, Baseline { x: BAR.left, y: 23.0, is_centered: false }, TITLE_FONT_SIZE);
    canvas.fill_rectangle(&BAR, 0.0, 1.0, |x| {
        viridis((x - BAR.left) / BAR.width).map(|channel| (255.0 * channel).round() as u8)
    });
    // A tick is 1.2 layout units wide and 5 high. The baseline of its label is 19 units below the bar.
    for (position, label) in compute_ticks(legend.scale_max) {
        let (x, y) = (BAR.left + position as f32 * BAR.width, BAR.top + BAR.height);
        canvas.fill_rectangle(&Rectangle { left: x - 0.6, top: y, width: 1.2, height: 5.0 }, 0.0, 1.0, |_| TEXT_COLOR);
        canvas.draw_text(&label, Baseline { x, y: y + 19.0, is_centered: true }, LABEL_FONT_SIZE);
    }
    Ok(())
}

/// A rectangle in layout units.
struct Rectangle {
    left: f32,
    top: f32,
    width: f32,
    height: f32,
}

/// Anchor of a line of text in layout units: its left end, or its center if `is_centered`.
struct Baseline {
    x: f32,
    y: f32,
    is_centered: bool,
}

/// The part of an image that the legend covers. Nothing is drawn outside of this box.
struct Canvas<'a> {
    /// The image: RGBA8, `width` pixels per row.
    rgba: &'a mut [u8],
    width: usize,
    /// Top left corner and size of the box in pixels.
    box_origin: [usize; 2],
    box_size: [usize; 2],
    /// Pixels per layout unit.
    pixels_per_unit: f32,
    font: FontRef<'static>,
}

impl Canvas<'_> {
    /// Fills a rectangle with rounded corners, antialiased. `radius` is in layout units, and 0 gives sharp corners.
    /// `color` maps x in layout units to sRGB.
    fn fill_rectangle(&mut self, rectangle: &Rectangle, radius: f32, opacity: f32, color: impl Fn(f32) -> [u8; 3]) {
        let mut rasterizer = Rasterizer::new(self.box_size[0], self.box_size[1]);
        let [left, top] = [rectangle.left * self.pixels_per_unit, rectangle.top * self.pixels_per_unit];
        let [right, bottom] =
            [left + rectangle.width * self.pixels_per_unit, top + rectangle.height * self.pixels_per_unit];
        let radius = radius * self.pixels_per_unit;
        // Each corner, clockwise: its point, and the directions of the incoming and the outgoing edge.
        let corners = [
            (point(right, top), point(1.0, 0.0), point(0.0, 1.0)),
            (point(right, bottom), point(0.0, 1.0), point(-1.0, 0.0)),
            (point(left, bottom), point(-1.0, 0.0), point(0.0, -1.0)),
            (point(left, top), point(0.0, -1.0), point(1.0, 0.0)),
        ];
        let offset_point = |start: Point, direction: Point, length: f32| {
            point(start.x + length * direction.x, start.y + length * direction.y)
        };
        let mut previous_end = offset_point(point(left, top), point(1.0, 0.0), radius);
        for (corner, incoming, outgoing) in corners {
            // The control points of the cubic Bézier curve that approximates a quarter circle are 0.5523 radii from its
            // end points: 4/3 tan(pi/8).
            let control_distance = (1.0 - 0.552_284_8) * radius;
            let start = offset_point(corner, incoming, -radius);
            let end = offset_point(corner, outgoing, radius);
            rasterizer.draw_line(previous_end, start);
            rasterizer.draw_cubic(
                start,
                offset_point(corner, incoming, -control_distance),
                offset_point(corner, outgoing, control_distance),
                end,
            );
            previous_end = end;
        }
        let (box_width, pixels_per_unit) = (self.box_size[0], self.pixels_per_unit);
        rasterizer.for_each_pixel_2d(|x, y, coverage| {
            if coverage > 0.0 && (x as usize) < box_width {
                self.blend([x as usize, y as usize], color((x as f32 + 0.5) / pixels_per_unit), coverage * opacity);
            }
        });
    }

    /// Draws a line of text. `font_size` is the size of the em square in layout units.
    fn draw_text(&mut self, text: &str, baseline: Baseline, font_size: f32) {
        let font = self.font.clone();
        let em = font.units_per_em().unwrap_or(font.height_unscaled());
        // A `PxScale` is the height of the font, which differs from the em square.
        let px_scale = PxScale::from(font_size * self.pixels_per_unit * font.height_unscaled() / em);
        let scaled_font = font.as_scaled(px_scale);
        let mut pen_x = 0.0;
        let mut previous_glyph = None;
        let mut glyphs = Vec::new();
        for id in text.chars().map(|letter| font.glyph_id(letter)) {
            pen_x += previous_glyph.map_or(0.0, |previous_glyph| scaled_font.kern(previous_glyph, id));
            glyphs.push((id, pen_x));
            pen_x += scaled_font.h_advance(id);
            previous_glyph = Some(id);
        }
        let start = baseline.x * self.pixels_per_unit - if baseline.is_centered { pen_x / 2.0 } else { 0.0 };
        for (id, x_offset) in glyphs {
            let glyph = id.with_scale_and_position(
                px_scale,
                ab_glyph::point(start + x_offset, baseline.y * self.pixels_per_unit),
            );
            let Some(outline) = font.outline_glyph(glyph) else { continue };
            let bounds_min = outline.px_bounds().min;
            outline.draw(|x, y, coverage| {
                let pixel = [bounds_min.x + x as f32, bounds_min.y + y as f32];
                if pixel[0] >= 0.0 && pixel[1] >= 0.0 {
                    self.blend([pixel[0] as usize, pixel[1] as usize], TEXT_COLOR, coverage);
                }
            });
        }
    }

    /// Blends a color over a pixel of the box. Pixels outside of the box are ignored.
    fn blend(&mut self, [x, y]: [usize; 2], color: [u8; 3], opacity: f32) {
        if x >= self.box_size[0] || y >= self.box_size[1] {
            return;
        }
        let byte_offset = 4 * ((self.box_origin[1] + y) * self.width + self.box_origin[0] + x);
        let opacity = opacity.clamp(0.0, 1.0);
        for (destination, source) in self.rgba[byte_offset..byte_offset + 3].iter_mut().zip(color) {
            *destination = (f32::from(source) * opacity + f32::from(*destination) * (1.0 - opacity)).round() as u8;
        }
    }
}

/// Rounds up to 1, 2, 2.5 or 5 times a power of ten, so that the axis has readable ticks. Returns 1 unless `value` is
/// finite and positive.
pub fn round_up_scale(value: f64) -> f64 {
    if !(value.is_finite() && value > 0.0) {
        return 1.0;
    }
    let decade = 10f64.powi(value.log10().floor() as i32);
    let candidates = [1.0, 2.0, 2.5, 5.0, 10.0].map(|candidate| candidate * decade);
    // Without the relative tolerance, a rounding error could raise 0.2 to 0.25.
    candidates.into_iter().find(|candidate| *candidate >= value * (1.0 - 1e-9)).unwrap_or(10.0 * decade)
}

/// Tick positions from 0 to 1 and their labels: three to five equal intervals from 0 to `scale_max`. The number
/// of intervals is chosen so that the labels are round.
fn compute_ticks(scale_max: f64) -> Vec<(f64, String)> {
    let significand = scale_max / 10f64.powi(scale_max.log10().floor() as i32);
    let is_close_to = |candidate: f64| (significand - candidate).abs() < 1e-6;
    let interval_count = if [2.0, 4.0, 8.0].into_iter().any(is_close_to) {
        4
    } else if [3.0, 6.0].into_iter().any(is_close_to) {
        3
    } else {
        5
    };
    (0..=interval_count)
        .map(|index| {
            let label = format_tick_label(scale_max * f64::from(index) / f64::from(interval_count));
            (f64::from(index) / f64::from(interval_count), label)
        })
        .collect()
}

/// Formats a number with at most three significant digits, or as an integer of four digits.
fn format_tick_label(value: f64) -> String {
    if value == 0.0 {
        return "0".into();
    }
    let exponent = value.abs().log10().floor() as i32;
    if !(-3..4).contains(&exponent) {
        let significand = (value / 10f64.powi(exponent) * 100.0).round() / 100.0;
        return format!("{significand}e{exponent}");
    }
    let decimal_places = (2 - exponent).max(0);
    let power = 10f64.powi(decimal_places);
    format!("{}", (value * power).round() / power)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rounded_scales_and_tick_labels_are_round_numbers() {
        let rounded = [0.013, 0.2, 0.21, 3.0, 7.0, 1e-9, 1e9, 0.0, f64::NAN].map(round_up_scale);
        for (actual, expected) in rounded.iter().zip([0.02, 0.2, 0.25, 5.0, 10.0, 1e-9, 1e9, 1.0, 1.0]) {
            assert!((actual / expected - 1.0).abs() < 1e-9, "expected {expected}, got {actual}");
        }
        let labels =
            |scale_max| compute_ticks(scale_max).into_iter().map(|(_, label)| label).collect::<Vec<_>>().join(" ");
        assert_eq!(labels(0.02), "0 0.005 0.01 0.015 0.02");
        assert_eq!((labels(2.5), labels(0.8)), ("0 0.5 1 1.5 2 2.5".into(), "0 0.2 0.4 0.6 0.8".into()));
        assert_eq!(labels(1e-7), "0 2e-8 4e-8 6e-8 8e-8 1e-7");
        assert_eq!(labels(1e9), "0 2e8 4e8 6e8 8e8 1e9");
    }

    #[test]
    fn bar_shows_the_colors_of_the_map() {
        let legend = Legend { title: "|u| < 1 & more, m".into(), scale_max: 0.5 };
        for [width, height] in [[1280, 720], [300, 2000], [240, 160], [4000, 200]] {
            let mut rgba = vec![40; 4 * width as usize * height as usize];
            draw(&mut rgba, [width, height], &legend).expect("expected a drawn legend");
            let pixels: Vec<&[u8]> = rgba.chunks_exact(4).collect();
            for position in [0.1, 0.5, 0.9] {
                let color = viridis(position).map(|channel| 255.0 * channel);
                let has_color = |pixel: &&&[u8]| pixel.iter().zip(color).all(|(a, b)| (f32::from(*a) - b).abs() < 4.0);
                let count = pixels.iter().filter(has_color).count();
                assert!(count > 4, "{width} x {height}: expected more than 4 pixels of the color at {position}");
            }
            let top_row = &pixels[..width as usize];
            assert!(top_row.iter().all(|pixel| pixel[..3] == [40; 3]), "expected an unchanged top row");
        }
    }

    #[test]
    fn small_image_remains_unchanged() {
        let legend = Legend { title: String::new(), scale_max: 0.5 };
        let mut rgba = vec![40; 4 * 239 * 160];
        draw(&mut rgba, [239, 160], &legend).expect("expected an unchanged image");
        assert!(rgba.iter().all(|byte| *byte == 40));
    }
}
