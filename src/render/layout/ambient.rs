//! Sampling of the ambient occlusion: the constants of its shaders.

use modalcast_model::scene::RendererKind;

/// How the ambient occlusion is sampled. `modalcast report render` measures its error and its time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct AmbientSampling {
    /// Side in pixels of the square that one texel represents.
    pub(crate) scale: u32,
    /// Slices per texel: planes through its view ray.
    pub(crate) slices: u32,
    /// Surface points that a slice samples on each side of the view ray.
    pub(crate) steps: u32,
    /// Side in texels of the noise pattern, in which all slice directions differ: a power of two.
    pub(crate) noise: u32,
    /// Factor from texel to slice direction in the pattern. It is odd, so that all directions occur.
    pub(crate) rotation_stride: u32,
}

impl AmbientSampling {
    /// The sampling of a kind of renderer: one texel per pixel on a GPU, one for 2 x 2 pixels on a CPU.
    pub(crate) const fn of(renderer: RendererKind) -> Self {
        match renderer {
            RendererKind::Hardware => Self { scale: 1, slices: 2, steps: 4, noise: 4, rotation_stride: 7 },
            RendererKind::Software => Self { scale: 2, slices: 1, steps: 4, noise: 4, rotation_stride: 7 },
        }
    }

    /// Width and height of the images of a frame in texels.
    pub(crate) fn image_size(self, frame: [u32; 2]) -> [u32; 2] {
        frame.map(|side| side.div_ceil(self.scale))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn strides_visit_every_texel_of_the_noise() {
        for renderer in [RendererKind::Hardware, RendererKind::Software] {
            let AmbientSampling { noise, rotation_stride, .. } = AmbientSampling::of(renderer);
            let cells = noise * noise;
            let visited: std::collections::HashSet<u32> =
                (0..cells).map(|cell| cell * rotation_stride % cells).collect();
            assert!(noise.is_power_of_two() && visited.len() == cells as usize, "{renderer:?}");
        }
    }

    #[test]
    fn images_cover_frames_of_odd_size() {
        let [hardware, software] =
            [RendererKind::Hardware, RendererKind::Software].map(|kind| AmbientSampling::of(kind).image_size([7, 4]));
        assert_eq!((hardware, software), ([7, 4], [4, 2]));
    }
}
