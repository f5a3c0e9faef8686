//! Inputs of a rasterizer besides the mesh: the viewport and ranges of triangles.

use nalgebra::Matrix4;

use crate::error::{Result, invalid};

/// The largest width and height of a viewport in pixels.
pub const MAX_VIEWPORT_SIDE: u32 = 16384;

/// An image size and the projection of positions into it. Rows are counted from the top.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Viewport {
    clip_from_positions: [f32; 16],
    width: u32,
    height: u32,
}

impl Viewport {
    /// A viewport of `width` x `height` pixels. `clip_from_positions` maps positions to clip space, in which visible
    /// points have |x| <= w, |y| <= w and 0 <= z <= w, with z / w = 1 nearest. It is rounded to f32. Rasterizers drop
    /// triangles with a vertex that is not finite in clip space.
    ///
    /// # Errors
    /// `Invalid` if a side is not 1 to [`MAX_VIEWPORT_SIDE`] pixels.
    pub fn new(clip_from_positions: &Matrix4<f64>, width: u32, height: u32) -> Result<Self> {
        for (name, side) in [("width", width), ("height", height)] {
            if !(1..=MAX_VIEWPORT_SIDE).contains(&side) {
                return Err(invalid(name, format!("1 to {MAX_VIEWPORT_SIDE} pixels"), side));
            }
        }
        let clip_from_positions = std::array::from_fn(|entry| clip_from_positions[(entry / 4, entry % 4)] as f32);
        Ok(Self { clip_from_positions, width, height })
    }

    /// `clip_from_positions`, row-major.
    pub const fn clip_from_positions(&self) -> &[f32; 16] {
        &self.clip_from_positions
    }

    /// Width and height in pixels.
    pub const fn size(&self) -> [u32; 2] {
        [self.width, self.height]
    }

    /// Number of pixels.
    pub const fn pixel_count(&self) -> usize {
        self.width as usize * self.height as usize
    }

    /// Half the width and height in pixels.
    pub fn half_size(&self) -> [f32; 2] {
        self.size().map(|side| 0.5 * side as f32)
    }

    /// The guard band: |x| and |y| in normalized device coordinates beyond which triangles are clipped. It ends
    /// [`MAX_VIEWPORT_SIDE`] pixels from the center, where f32 still resolves 1/256 pixel.
    pub fn guard_band(&self) -> [f32; 2] {
        self.half_size().map(|half| MAX_VIEWPORT_SIDE as f32 / half)
    }
}

/// Which faces of triangles are culled.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum CullMode {
    #[default]
    None,
    /// Back faces are culled: only triangles whose corners appear counterclockwise are drawn.
    Back,
}

/// A contiguous range of triangles with one cull mode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DrawRange {
    /// Index of the first triangle.
    pub first_triangle: u32,
    /// Number of triangles.
    pub triangle_count: u32,
    pub cull_mode: CullMode,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn viewport_side_is_limited() {
        let viewport = |width, height| Viewport::new(&Matrix4::identity(), width, height);
        assert!(viewport(0, 1).is_err() && viewport(1, 0).is_err() && viewport(MAX_VIEWPORT_SIDE + 1, 1).is_err());
        // The half size is (8192, 0.5) pixels, and the guard band ends at 16384 / 8192 = 2.
        let largest_viewport = viewport(MAX_VIEWPORT_SIDE, 1).expect("a valid viewport");
        assert_eq!((largest_viewport.guard_band()[0], largest_viewport.half_size()), (2.0, [8192.0, 0.5]));
    }
}
