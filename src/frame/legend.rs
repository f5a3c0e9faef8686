//! The legend of a color map: a color bar with ticks, labels and a title, composited over a picture.

use ab_glyph::{Font as _, FontRef, PxScale, ScaleFont as _};
use ab_glyph_rasterizer::{Point, Rasterizer, point};

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
/// Width and height of the legend's box in layout units. A unit is a pixel of a picture with 720 rows and is scaled for
/// other sizes.
const WIDTH: f32 = 330.0;
const HEIGHT: f32 = 84.0;
/// The color bar inside the box.
const BAR: Rectangle = Rectangle { left: 26.0, top: 34.0, width: 278.0, height: 16.0 };
/// sRGB of text and ticks.
const INK: [u8; 3] = [0x1a; 3];

/// Draws the legend into the lower left corner of RGBA8 pixels, top row first. A picture smaller than 240 x 160 remains
/// unchanged.
///
/// # Errors
/// `Fault` when the embedded font cannot be read.
pub fn draw(rgba: &mut [u8], [width, height]: [u32; 2], legend: &Legend) -> Result<()> {
    if width < MIN_SIZE[0] || height < MIN_SIZE[1] {
        return Ok(());
    }
    let font = FontRef::try_from_slice(dejavu::sans::regular()).map_err(fault_in("legend"))?;
    let scale = (height as f32 / 720.0).max(0.62).min(width as f32 / (1.15 * WIDTH));
    let size = [(WIDTH * scale).ceil() as usize, (HEIGHT * scale).ceil() as usize];
    let margin = (12.0 * scale) as usize;
    let corner = [margin, (height as usize).saturating_sub(size[1] + margin)];
    let mut canvas = Canvas { rgba, width: width as usize, corner, size, scale, font };

    let background = Rectangle { left: 0.0, top: 0.0, width: WIDTH, height: HEIGHT };
    canvas.fill(&background, 6.0, 0.86, |_| [255; 3]);
    canvas.text(&legend.title, Baseline { x: BAR.left, y: 23.0, centered: false }, 15.0);
    canvas.fill(&BAR, 0.0, 1.0, |x| viridis((x - BAR.left) / BAR.width).map(|channel| (255.0 * channel).round() as u8));
    for (share, label) in ticks(legend.largest) {
        let (x, y) = (BAR.left + share as f32 * BAR.width, BAR.top + BAR.height);
        canvas.fill(&Rectangle { left: x - 0.6, top: y, width: 1.2, height: 5.0 }, 0.0, 1.0, |_| INK);
        canvas.text(&label, Baseline { x, y: y + 19.0, centered: true }, 13.0);
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

/// Where a line of text starts, or its middle if it is centered, in layout units.
struct Baseline {
    x: f32,
    y: f32,
    centered: bool,
}

/// The part of a picture that the legend covers. Nothing is drawn outside of it.
struct Canvas<'a> {
    /// The picture: RGBA8, `width` pixels per row.
    rgba: &'a mut [u8],
    width: usize,
    /// Top left corner and size of the legend's box in pixels.
    corner: [usize; 2],
    size: [usize; 2],
    /// Pixels per layout unit.
    scale: f32,
    font: FontRef<'static>,
}

impl Canvas<'_> {
    /// Fills a rectangle with rounded corners, antialiased. `color` maps x in layout units to sRGB.
    fn fill(&mut self, rectangle: &Rectangle, radius: f32, opacity: f32, color: impl Fn(f32) -> [u8; 3]) {
        let mut coverage = Rasterizer::new(self.size[0], self.size[1]);
        let [left, top] = [rectangle.left * self.scale, rectangle.top * self.scale];
        let [right, bottom] = [left + rectangle.width * self.scale, top + rectangle.height * self.scale];
        let radius = radius * self.scale;
        // Each corner: its point, and the directions of the incoming and the outgoing edge.
        let corners = [
            (point(right, top), point(1.0, 0.0), point(0.0, 1.0)),
            (point(right, bottom), point(0.0, 1.0), point(-1.0, 0.0)),
            (point(left, bottom), point(-1.0, 0.0), point(0.0, -1.0)),
            (point(left, top), point(0.0, -1.0), point(1.0, 0.0)),
        ];
        let along = |start: Point, direction: Point, length: f32| {
            point(start.x + length * direction.x, start.y + length * direction.y)
        };
        let mut last = along(point(left, top), point(1.0, 0.0), radius);
        for (corner, incoming, outgoing) in corners {
            // A cubic whose control points are this fraction of the radius from the corner approximates a circular arc.
            let control = (1.0 - 0.552_284_8) * radius;
            let start = along(corner, incoming, -radius);
            let end = along(corner, outgoing, radius);
            coverage.draw_line(last, start);
            coverage.draw_cubic(start, along(corner, incoming, -control), along(corner, outgoing, control), end);
            last = end;
        }
        let (width, scale) = (self.size[0], self.scale);
        coverage.for_each_pixel_2d(|x, y, share| {
            if share > 0.0 && (x as usize) < width {
                self.blend([x as usize, y as usize], color((x as f32 + 0.5) / scale), share * opacity);
            }
        });
    }

    /// Draws a line of text. `font_size` is the size of the em square in layout units.
    fn text(&mut self, text: &str, baseline: Baseline, font_size: f32) {
        let font = self.font.clone();
        let em = font.units_per_em().unwrap_or(font.height_unscaled());
        let scale = PxScale::from(font_size * self.scale * font.height_unscaled() / em);
        let scaled = font.as_scaled(scale);
        let mut end = 0.0;
        let mut last = None;
        let mut glyphs = Vec::new();
        for id in text.chars().map(|letter| font.glyph_id(letter)) {
            end += last.map_or(0.0, |last| scaled.kern(last, id));
            glyphs.push((id, end));
            end += scaled.h_advance(id);
            last = Some(id);
        }
        let start = baseline.x * self.scale - if baseline.centered { end / 2.0 } else { 0.0 };
        for (id, offset) in glyphs {
            let glyph = id.with_scale_and_position(scale, ab_glyph::point(start + offset, baseline.y * self.scale));
            let Some(outline) = font.outline_glyph(glyph) else { continue };
            let corner = outline.px_bounds().min;
            outline.draw(|x, y, share| {
                let at = [corner.x + x as f32, corner.y + y as f32];
                if at[0] >= 0.0 && at[1] >= 0.0 {
                    self.blend([at[0] as usize, at[1] as usize], INK, share);
                }
            });
        }
    }

    /// Blends a color over a pixel of the box. Pixels outside of the box are ignored.
    fn blend(&mut self, [x, y]: [usize; 2], color: [u8; 3], opacity: f32) {
        if x >= self.size[0] || y >= self.size[1] {
            return;
        }
        let first = 4 * ((self.corner[1] + y) * self.width + self.corner[0] + x);
        let opacity = opacity.clamp(0.0, 1.0);
        for (under, over) in self.rgba[first..first + 3].iter_mut().zip(color) {
            *under = (f32::from(over) * opacity + f32::from(*under) * (1.0 - opacity)).round() as u8;
        }
    }
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
