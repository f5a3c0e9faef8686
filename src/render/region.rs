//! Screen region that a scene can cover. Pixels outside it are neither drawn nor cleared for the next frame. Clearing a
//! 32-bit sample costs a device as much time as drawing one (an H200 clears 14 samples per nanosecond, measured).

use std::cell::Cell;

use nalgebra::{Matrix4, Vector4};

use modalcast_model::scene::BoundingBox;

/// A rectangle of a frame's pixels; (0, 0) is the bottom left pixel. It may be empty.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Region {
    frame: [u32; 2],
    corner: [u32; 2],
    size: [u32; 2],
}

/// Dirty region of an image: the pixels that may differ from the clear value. Initially all of them.
#[derive(Debug, Default)]
pub(crate) struct DirtyRegion(Cell<Option<Region>>);

/// Bound on the f32 rounding error of a clip coordinate, relative to the sum of the magnitudes of its products: each
/// matrix element, each product and three sums are rounded.
const CLIP_RELATIVE_ERROR: f64 = 8.0 * 0.5 * f32::EPSILON as f64;

/// Margin in pixels: a rasterizer moves vertices by up to 1/256 pixel, and a sample may lie anywhere in its pixel.
const MARGIN: f64 = 1.0;

/// Pixels outside the scissor that a draw may still touch: llvmpipe draws one with multisampling.
const SLACK: u32 = 2;

impl Region {
    pub(crate) const fn whole(frame: [u32; 2]) -> Self {
        Self { frame, corner: [0; 2], size: frame }
    }

    /// Region of the frame that can show points in `bounds` when `clip` transforms positions in f32. The whole frame if
    /// the bounds reach behind the eye or overflow.
    pub(crate) fn project(clip: &Matrix4<f64>, bounds: &BoundingBox, frame: [u32; 2]) -> Self {
        let corners = bounds.corners().map(|corner| corner.to_homogeneous());
        let magnitudes = corners.iter().map(|corner| clip.abs() * corner.abs());
        let rounded = magnitudes.fold(Vector4::zeros(), |most: Vector4<f64>, one| most.sup(&one)) * CLIP_RELATIVE_ERROR;
        let shown = corners.map(|corner| clip * corner);
        let nearest = shown.iter().fold(f64::INFINITY, |least, at| least.min(at.w)) - rounded.w;
        let numbers = shown.iter().chain([&rounded]).flat_map(|four| four.iter());
        if !(nearest > 0.0 && numbers.clone().all(|number| number.is_finite())) {
            return Self::whole(frame);
        }
        let spans = [0, 1].map(|axis| {
            let at = shown.map(|at| at[axis] / at.w);
            let (least, most) = at.iter().fold((f64::MAX, f64::MIN), |(a, b), &one| (a.min(one), b.max(one)));
            let off = (rounded[axis] + least.abs().max(most.abs()) * rounded.w) / nearest;
            let side = f64::from(frame[axis]);
            let pixel = |image: f64, margin: f64| ((0.5 * image + 0.5) * side + margin).clamp(0.0, side);
            // No NaN: all numbers are finite, and w is positive.
            [pixel(least - off, -MARGIN).floor() as u32, pixel(most + off, MARGIN).ceil() as u32]
        });
        Self { frame, corner: spans.map(|[low, _]| low), size: spans.map(|[low, high]| high - low) }
    }

    /// Grows the region by this many pixels on each side, clamped to the frame.
    fn expanded(self, by: u32) -> Self {
        let low = self.corner.map(|at| at.saturating_sub(by));
        let high = [0, 1].map(|axis| (self.corner[axis] + self.size[axis] + by).min(self.frame[axis]));
        Self { corner: low, size: [high[0] - low[0], high[1] - low[1]], ..self }
    }

    /// Width and height of the frame.
    pub(crate) const fn frame(&self) -> [u32; 2] {
        self.frame
    }

    /// Column and row of the bottom left pixel, width and height.
    pub(crate) const fn rect(&self) -> [u32; 4] {
        let ([x, y], [width, height]) = (self.corner, self.size);
        [x, y, width, height]
    }
}

impl DirtyRegion {
    /// Returns the dirty region, none for all pixels, and replaces it by `by`.
    pub(crate) fn replace(&self, by: Region) -> Option<Region> {
        self.0.replace(Some(by.expanded(SLACK)))
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

    fn clip(eye: [f64; 3], target: [f64; 3], bounds: &BoundingBox) -> Matrix4<f64> {
        let view = View::LookAt { eye, target, up: [0.0, 1.0, 0.0] };
        let camera = Camera { view, lens: Lens::FieldOfView(40.0), near: 0.0, far: 0.0 };
        camera.clip_from_camera(FRAME[0], FRAME[1], bounds) * camera.camera_from_world()
    }

    /// Position of a point in pixels, transformed in f32 as in a vertex shader.
    fn pixel(clip: &Matrix4<f64>, point: [f32; 3]) -> [f32; 2] {
        let clip: Matrix4<f32> = clip.cast();
        let at = clip * Vector4::new(point[0], point[1], point[2], 1.0);
        [0, 1].map(|axis| (0.5 * at[axis] / at.w + 0.5) * FRAME[axis] as f32)
    }

    /// A cube with this half side, and points in steps of a fifth of it from the center to its corners.
    fn filled(center: [f64; 3], half: f64) -> (BoundingBox, Vec<[f32; 3]>) {
        let (mut bounds, mut points) = (BoundingBox::EMPTY, Vec::new());
        for index in 0..216 {
            let step = [index % 6, index / 6 % 6, index / 36].map(|step| f64::from(step) / 2.5 - 1.0);
            let point: [f32; 3] = std::array::from_fn(|axis| (center[axis] + half * step[axis]) as f32);
            bounds.include(point.map(f64::from));
            points.push(point);
        }
        (bounds, points)
    }

    #[test]
    fn what_lies_in_the_bounds_is_drawn_inside_the_region_however_far_from_the_origin() {
        // Near the origin, and where f32 rounding moves points by pixels.
        for (center, away) in [([0.3, -0.2, 0.1], 5.0), ([2e5, -3e4, 1e5], 5.0), ([-9e6, 0.0, 9e6], 900.0)] {
            let (bounds, points) = filled(center, 0.1 * away);
            for turn in 0..16 {
                let angle = 0.4 * f64::from(turn);
                let aside = 0.02 * away * f64::from(turn);
                let eye = [center[0] + away * angle.cos(), center[1] + aside, center[2] + away * angle.sin()];
                let target = [center[0] + aside, center[1], center[2] - aside];
                let clip = clip(eye, target, &bounds);
                let region = Region::project(&clip, &bounds, FRAME);
                let [x, y, width, height] = region.rect().map(|number| number as f32);
                for point in &points {
                    let at = pixel(&clip, *point);
                    let outside = |at: f32, low: f32, size: f32, side: f32| {
                        at.clamp(0.0, side) < low || at.clamp(0.0, side) > low + size
                    };
                    let out = outside(at[0], x, width, 640.0) || outside(at[1], y, height, 400.0);
                    assert!(!out, "{at:?} lies outside of {region:?}");
                }
            }
        }
    }

    #[test]
    fn the_region_reaches_little_farther_than_the_bounds_and_is_empty_where_they_are_not_seen() {
        let (bounds, points) = filled([0.0; 3], 0.5);
        let clip_from = |target: [f64; 3]| clip([0.3, 0.4, 6.0], target, &bounds);
        let seen = clip_from([0.0; 3]);
        let [x, y, width, height] = Region::project(&seen, &bounds, FRAME).rect().map(|number| number as f32);
        let far = |pick: fn(f32, f32) -> f32, axis: usize| {
            points.iter().map(|point| pixel(&seen, *point)[axis]).reduce(pick).expect("points")
        };
        for (own, tight) in [
            (x, far(f32::min, 0)),
            (y, far(f32::min, 1)),
            (x + width, far(f32::max, 0)),
            (y + height, far(f32::max, 1)),
        ] {
            assert!((own - tight).abs() <= 2.01, "{own} for {tight}");
        }
        for aside in [[9.0, 0.0, 0.0], [-9.0, 0.0, 0.0], [0.0, 9.0, 0.0], [0.0, -9.0, 0.0]] {
            let [_, _, width, height] = Region::project(&clip_from(aside), &bounds, FRAME).rect();
            assert_eq!(width * height, 0, "{aside:?}");
        }
    }

    #[test]
    fn bounds_around_the_eye_behind_it_or_overflowed_may_be_anywhere() {
        let (bounds, _) = filled([0.0; 3], 0.5);
        let whole = Region::whole(FRAME);
        let inside = clip([0.1, 0.2, 0.3], [0.0; 3], &bounds);
        assert_eq!(Region::project(&inside, &bounds, FRAME), whole);
        let away = clip([0.0, 0.0, 6.0], [0.0, 0.0, 12.0], &bounds);
        assert_eq!(Region::project(&away, &bounds, FRAME), whole);
        let seen = clip([0.0, 0.0, 6.0], [0.0; 3], &bounds);
        assert_ne!(Region::project(&seen, &bounds, FRAME), whole, "control");
        for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            for axis in 0..3 {
                let mut lost = bounds;
                lost.max[axis] = bad;
                assert_eq!(Region::project(&seen, &lost, FRAME), whole);
            }
            assert_eq!(Region::project(&(seen * bad), &bounds, FRAME), whole);
        }
        assert_eq!(Region::project(&seen, &BoundingBox::EMPTY, FRAME), whole);
        // So far along x that f32 rounding may place it at any column.
        let (bounds, _) = filled([1e9, 0.0, 0.0], 0.5);
        let [_, y, width, height] =
            Region::project(&clip([1e9, 0.0, 6.0], [1e9, 0.0, 0.0], &bounds), &bounds, FRAME).rect();
        assert!(width == FRAME[0] && y > 100 && height < 200, "{y}, {width} x {height}");
    }

    #[test]
    fn an_image_is_touched_everywhere_at_first_and_again_when_somebody_says_so() {
        let (dirty, part) = (DirtyRegion::default(), Region { frame: FRAME, corner: [3, 1], size: [5, 6] });
        assert_eq!(dirty.replace(part), None);
        let around = Region { frame: FRAME, corner: [1, 0], size: [9, 9] };
        assert_eq!(dirty.replace(Region::whole(FRAME)), Some(around));
        assert_eq!(dirty.replace(part), Some(Region::whole(FRAME)));
        dirty.mark_all();
        assert_eq!(dirty.replace(part), None);
    }
}
