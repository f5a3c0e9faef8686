//! Screen region that a scene can cover. Pixels outside the region are neither drawn nor cleared for the next frame.
//! This saves time, because clearing a 32-bit sample takes as long as drawing it: an H200 clears 14 samples per
//! nanosecond.

use std::cell::Cell;

use nalgebra::{Matrix4, Vector4};

use modalcast_model::scene::BoundingBox;

/// A rectangle of a frame's pixels; (0, 0) is the bottom left pixel. It may be empty.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Region {
    /// Width and height of the frame.
    frame_size: [u32; 2],
    /// Column and row of the bottom left pixel.
    corner: [u32; 2],
    /// Width and height of the region.
    size: [u32; 2],
}

/// Consecutive rows of an image that are drawn or computed without a break; row 0 is the bottom row. A large frame is
/// drawn band by band, so that the device can execute other commands in between.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Band {
    pub(crate) first_row: u32,
    pub(crate) rows: u32,
    /// Rows of the image.
    image_rows: u32,
}

/// Maximum size of a band.
#[derive(Debug, Clone, Copy)]
pub(crate) struct BandLimit {
    pub(crate) max_pixels: u64,
    /// Pixels times samples per pixel.
    pub(crate) max_samples: u64,
}

impl BandLimit {
    /// Maximum number of pixels of a band with this number of samples per pixel.
    pub(crate) fn max_pixels(self, samples: u32) -> u64 {
        self.max_pixels.min(self.max_samples / u64::from(samples))
    }
}

/// Dirty region of an image: the pixels that may differ from the clear value. `None` stands for all pixels, which are
/// dirty initially.
#[derive(Debug, Default)]
pub(crate) struct DirtyRegion(Cell<Option<Region>>);

/// Bound on the f32 rounding error of a clip coordinate, which is a sum of four products. The error is relative to the
/// sum of the magnitudes of the products. A product is affected by at most five roundings of half an epsilon each: of
/// its matrix element, of the product and of three sums. The bound allows eight.
const CLIP_RELATIVE_ERROR: f64 = 8.0 * 0.5 * f32::EPSILON as f64;

/// Margin of the projected bounds in pixels, because a rasterizer rounds positions to 1/256 pixel, and a sample may lie
/// anywhere in its pixel.
const PROJECTION_MARGIN: f64 = 1.0;

/// Margin of the dirty region in pixels, because draws may exceed the scissor: llvmpipe exceeds it by one pixel with
/// multisampling.
const DIRTY_MARGIN: u32 = 2;

/// The first row of a band is a multiple of this number of rows. llvmpipe rasterizes squares of 64 x 64 pixels, so a
/// draw that exceeds the scissor (see [`DIRTY_MARGIN`]) does not reach into another band. This number is also a
/// multiple of the workgroup sizes of all passes that work on bands.
const BAND_ALIGNMENT: u32 = 64;

impl Band {
    /// All rows of an image.
    pub(crate) const fn whole(image_rows: u32) -> Self {
        Self { first_row: 0, rows: image_rows, image_rows }
    }

    /// Divides an image into bands of at most `max_pixels` pixels, but at least [`BAND_ALIGNMENT`] rows, from the
    /// bottom to the top.
    pub(crate) fn divide(size: [u32; 2], max_pixels: u64) -> Vec<Self> {
        Self::divide_aligned(size, max_pixels, BAND_ALIGNMENT)
    }

    /// [`Self::divide`], but the first row of each band is a multiple of `alignment`.
    pub(crate) fn divide_aligned([width, height]: [u32; 2], max_pixels: u64, alignment: u32) -> Vec<Self> {
        let max_rows = u32::try_from(max_pixels / u64::from(width.max(1))).unwrap_or(u32::MAX);
        if height <= max_rows {
            return vec![Self::whole(height)];
        }
        let band_rows = (max_rows / alignment).max(1) * alignment;
        let first_rows = (0..height).step_by(band_rows as usize);
        first_rows
            .map(|first_row| Self { first_row, rows: band_rows.min(height - first_row), image_rows: height })
            .collect()
    }

    /// Whether this band ends with the top row.
    pub(crate) const fn is_last(&self) -> bool {
        self.first_row + self.rows == self.image_rows
    }
}

impl Region {
    /// All pixels of a frame.
    pub(crate) const fn whole(frame_size: [u32; 2]) -> Self {
        Self { frame_size, corner: [0; 2], size: frame_size }
    }

    /// Region of the frame that can show points in `bounds` if a shader computes clip coordinates in f32. The whole
    /// frame if the bounds reach behind the eye or overflow.
    pub(crate) fn project(clip_from_world: &Matrix4<f64>, bounds: &BoundingBox, frame_size: [u32; 2]) -> Self {
        let corners = bounds.corners().map(|corner| corner.to_homogeneous());
        let magnitudes = corners.iter().map(|corner| clip_from_world.abs() * corner.abs());
        let max_magnitude = magnitudes.fold(Vector4::zeros(), |max: Vector4<f64>, magnitude| max.sup(&magnitude));
        let clip_error = max_magnitude * CLIP_RELATIVE_ERROR;
        let clip_corners = corners.map(|corner| clip_from_world * corner);
        let min_w = clip_corners.iter().fold(f64::INFINITY, |min, corner| min.min(corner.w)) - clip_error.w;
        let mut coordinates = clip_corners.iter().chain([&clip_error]).flat_map(|corner| corner.iter());
        if !(min_w > 0.0 && coordinates.all(|coordinate| coordinate.is_finite())) {
            return Self::whole(frame_size);
        }
        let pixel_ranges = [0, 1].map(|axis| {
            let ndc = clip_corners.map(|corner| corner[axis] / corner.w);
            let (min_ndc, max_ndc) = ndc.iter().fold((f64::MAX, f64::MIN), |(min, max), &x| (min.min(x), max.max(x)));
            // Error of a quotient x / w: (error of x + |x / w| times the error of w) / w.
            let ndc_error = (clip_error[axis] + min_ndc.abs().max(max_ndc.abs()) * clip_error.w) / min_w;
            let side = f64::from(frame_size[axis]);
            let to_pixel = |ndc: f64, margin: f64| ((0.5 * ndc + 0.5) * side + margin).clamp(0.0, side);
            // No NaN: all coordinates are finite, and w is positive.
            let low = to_pixel(min_ndc - ndc_error, -PROJECTION_MARGIN).floor() as u32;
            [low, to_pixel(max_ndc + ndc_error, PROJECTION_MARGIN).ceil() as u32]
        });
        Self { frame_size, corner: pixel_ranges.map(|[low, _]| low), size: pixel_ranges.map(|[low, high]| high - low) }
    }

    /// Grows the region by `margin` pixels on each side, clamped to the frame.
    fn expanded(self, margin: u32) -> Self {
        let low = self.corner.map(|coordinate| coordinate.saturating_sub(margin));
        let high = [0, 1].map(|axis| (self.corner[axis] + self.size[axis] + margin).min(self.frame_size[axis]));
        Self { corner: low, size: [high[0] - low[0], high[1] - low[1]], ..self }
    }

    /// The part of the region in a band.
    pub(crate) fn within(self, band: Band) -> Self {
        let low = self.corner[1].max(band.first_row);
        let high = (self.corner[1] + self.size[1]).min(band.first_row + band.rows).max(low);
        Self { corner: [self.corner[0], low], size: [self.size[0], high - low], ..self }
    }

    /// Width and height of the frame.
    pub(crate) const fn frame_size(&self) -> [u32; 2] {
        self.frame_size
    }

    /// Column and row of the bottom left pixel, width and height.
    pub(crate) const fn rect(&self) -> [u32; 4] {
        let ([x, y], [width, height]) = (self.corner, self.size);
        [x, y, width, height]
    }
}

impl DirtyRegion {
    /// Returns the dirty region, or none if all pixels are dirty. With the last band of a frame, replaces it by
    /// `region`, the region of all bands, with a margin.
    pub(crate) fn replace(&self, region: Region, band: Band) -> Option<Region> {
        let dirty_region = self.0.get();
        if band.is_last() {
            self.0.set(Some(region.expanded(DIRTY_MARGIN)));
        }
        dirty_region
    }

    /// Marks all pixels as dirty.
    pub(crate) fn mark_all(&self) {
        self.0.set(None);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use modalcast_model::scene::{Camera, Lens, View};

    const FRAME: [u32; 2] = [640, 400];

    fn clip_from_world(eye: [f64; 3], target: [f64; 3], bounds: &BoundingBox) -> Matrix4<f64> {
        let view = View::LookAt { eye, target, up: [0.0, 1.0, 0.0] };
        // Near and far 0: the planes are fitted to the bounds.
        let camera = Camera { view, lens: Lens::FieldOfView(40.0), near: 0.0, far: 0.0 };
        camera.clip_from_camera(FRAME[0], FRAME[1], bounds) * camera.camera_from_world()
    }

    /// Position of a point in pixels, transformed in f32 as in a vertex shader.
    fn project_to_pixels(clip: &Matrix4<f64>, point: [f32; 3]) -> [f32; 2] {
        let clip: Matrix4<f32> = clip.cast();
        let clip_position = clip * Vector4::new(point[0], point[1], point[2], 1.0);
        [0, 1].map(|axis| (0.5 * clip_position[axis] / clip_position.w + 0.5) * FRAME[axis] as f32)
    }

    /// Bounds of a cube, and 6 x 6 x 6 points in it, from face to face.
    fn sample_cube(center: [f64; 3], half_side: f64) -> (BoundingBox, Vec<[f32; 3]>) {
        let (mut bounds, mut points) = (BoundingBox::EMPTY, Vec::new());
        for index in 0..216 {
            // Six values from -1 to 1 along each axis.
            let step = [index % 6, index / 6 % 6, index / 36].map(|step| f64::from(step) / 2.5 - 1.0);
            let point: [f32; 3] = std::array::from_fn(|axis| (center[axis] + half_side * step[axis]) as f32);
            bounds.include(point.map(f64::from));
            points.push(point);
        }
        (bounds, points)
    }

    #[test]
    fn region_contains_all_points_of_the_bounds() {
        // Near the origin, and where f32 rounding moves points by pixels.
        for (center, distance) in [([0.3, -0.2, 0.1], 5.0), ([2e5, -3e4, 1e5], 5.0), ([-9e6, 0.0, 9e6], 900.0)] {
            let (bounds, points) = sample_cube(center, 0.1 * distance);
            for view in 0..16 {
                let angle = 0.4 * f64::from(view);
                let offset = 0.02 * distance * f64::from(view);
                let eye = [center[0] + distance * angle.cos(), center[1] + offset, center[2] + distance * angle.sin()];
                let target = [center[0] + offset, center[1], center[2] - offset];
                let clip = clip_from_world(eye, target, &bounds);
                let region = Region::project(&clip, &bounds, FRAME);
                let [x, y, width, height] = region.rect().map(|number| number as f32);
                for point in &points {
                    let pixel = project_to_pixels(&clip, *point);
                    let is_inside = |axis: usize, low: f32, size: f32| {
                        (low..=low + size).contains(&pixel[axis].clamp(0.0, FRAME[axis] as f32))
                    };
                    assert!(is_inside(0, x, width) && is_inside(1, y, height), "expected {pixel:?} in {region:?}");
                }
            }
        }
    }

    #[test]
    fn region_is_tight_and_empty_for_invisible_bounds() {
        let (bounds, points) = sample_cube([0.0; 3], 0.5);
        let look_at = |target: [f64; 3]| clip_from_world([0.3, 0.4, 6.0], target, &bounds);
        let clip = look_at([0.0; 3]);
        let [x, y, width, height] = Region::project(&clip, &bounds, FRAME).rect().map(|number| number as f32);
        let extreme = |min_or_max: fn(f32, f32) -> f32, axis: usize| {
            points.iter().map(|point| project_to_pixels(&clip, *point)[axis]).reduce(min_or_max).expect("points")
        };
        // PROJECTION_MARGIN, and up to one pixel because the edges are rounded to whole pixels.
        let max_distance = 2.01;
        for (edge, tight_edge) in [
            (x, extreme(f32::min, 0)),
            (y, extreme(f32::min, 1)),
            (x + width, extreme(f32::max, 0)),
            (y + height, extreme(f32::max, 1)),
        ] {
            assert!((edge - tight_edge).abs() <= max_distance, "expected an edge near {tight_edge}, got {edge}");
        }
        for target in [[9.0, 0.0, 0.0], [-9.0, 0.0, 0.0], [0.0, 9.0, 0.0], [0.0, -9.0, 0.0]] {
            let [_, _, width, height] = Region::project(&look_at(target), &bounds, FRAME).rect();
            assert_eq!(width * height, 0, "{target:?}");
        }
    }

    #[test]
    fn bounds_behind_the_eye_or_overflow_give_the_whole_frame() {
        let (bounds, _) = sample_cube([0.0; 3], 0.5);
        let whole = Region::whole(FRAME);
        let eye_inside = clip_from_world([0.1, 0.2, 0.3], [0.0; 3], &bounds);
        assert_eq!(Region::project(&eye_inside, &bounds, FRAME), whole);
        let bounds_behind = clip_from_world([0.0, 0.0, 6.0], [0.0, 0.0, 12.0], &bounds);
        assert_eq!(Region::project(&bounds_behind, &bounds, FRAME), whole);
        let bounds_in_front = clip_from_world([0.0, 0.0, 6.0], [0.0; 3], &bounds);
        assert_ne!(Region::project(&bounds_in_front, &bounds, FRAME), whole, "expected a smaller region");
        for overflow in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            for axis in 0..3 {
                let mut overflowed_bounds = bounds;
                overflowed_bounds.max[axis] = overflow;
                assert_eq!(Region::project(&bounds_in_front, &overflowed_bounds, FRAME), whole);
            }
            assert_eq!(Region::project(&(bounds_in_front * overflow), &bounds, FRAME), whole);
        }
        assert_eq!(Region::project(&bounds_in_front, &BoundingBox::EMPTY, FRAME), whole);
        // At this x, f32 rounding may move the points to any column. The cube covers about 100 of the 400 rows.
        let (bounds, _) = sample_cube([1e9, 0.0, 0.0], 0.5);
        let [_, y, width, height] =
            Region::project(&clip_from_world([1e9, 0.0, 6.0], [1e9, 0.0, 0.0], &bounds), &bounds, FRAME).rect();
        assert!(width == FRAME[0] && y > 100 && height < 200, "{y}, {width} x {height}");
    }

    #[test]
    fn image_is_dirty_at_first_and_after_mark_all() {
        let (dirty_region, region) =
            (DirtyRegion::default(), Region { frame_size: FRAME, corner: [3, 1], size: [5, 6] });
        let whole = Band::whole(FRAME[1]);
        assert_eq!(dirty_region.replace(region, whole), None);
        // Two pixels more on each side, except at the bottom, where the frame has only one.
        let region_with_margin = Region { frame_size: FRAME, corner: [1, 0], size: [9, 9] };
        assert_eq!(dirty_region.replace(Region::whole(FRAME), whole), Some(region_with_margin));
        assert_eq!(dirty_region.replace(region, whole), Some(Region::whole(FRAME)));
        dirty_region.mark_all();
        assert_eq!(dirty_region.replace(region, whole), None);
    }

    #[test]
    fn dirty_region_changes_with_the_last_band() {
        let (dirty_region, region) = (DirtyRegion::default(), Region::whole(FRAME));
        let bands = Band::divide(FRAME, 640 * 150);
        for band in &bands {
            assert_eq!(dirty_region.replace(region, *band), None, "{band:?}");
        }
        assert_eq!(dirty_region.replace(region, bands[0]), Some(region));
    }

    #[test]
    fn bands_cover_each_row_once() {
        let rows = |max_pixels: u64| -> Vec<[u32; 2]> {
            Band::divide(FRAME, max_pixels).iter().map(|band| [band.first_row, band.rows]).collect()
        };
        assert_eq!(rows(640 * 400), [[0, 400]]);
        assert_eq!(rows(640 * 400 - 1), [[0, 384], [384, 16]]);
        assert_eq!(rows(640 * 150), [[0, 128], [128, 128], [256, 128], [384, 16]]);
        // A band has at least 64 rows.
        assert_eq!(rows(1).len(), 7);
        let region = Region { frame_size: FRAME, corner: [3, 100], size: [5, 60] };
        let parts = Band::divide(FRAME, 640 * 128).into_iter().map(|band| region.within(band).rect());
        assert_eq!(
            parts.map(|[_, y, _, rows]| [y, rows]).collect::<Vec<_>>(),
            [[100, 28], [128, 32], [256, 0], [384, 0]]
        );
    }
}
