//! Trilinear filtering of images.

use modalcast_model::views::ViewImage;

/// The levels of an image with linear texels.
#[derive(Debug)]
pub(super) struct LinearImage {
    levels: Vec<Level>,
}

#[derive(Debug)]
struct Level {
    size: [usize; 2],
    texels: Vec<[f32; 4]>,
}

impl LinearImage {
    pub(super) fn new(image: &ViewImage) -> Self {
        let decode: Vec<f32> = (0..=255)
            .map(|byte| match byte as f32 / 255.0 {
                encoded if !image.is_srgb => encoded,
                encoded if encoded <= 0.040_45 => encoded / 12.92,
                encoded => ((encoded + 0.055) / 1.055).powf(2.4),
            })
            .collect();
        let texel = |rgba: &[u8]| {
            let [r, g, b] = [0, 1, 2].map(|channel| decode[usize::from(rgba[channel])]);
            [r, g, b, f32::from(rgba[3]) / 255.0]
        };
        let level = |(level, bytes): (usize, &Vec<u8>)| Level {
            size: image.level_size(level),
            texels: bytes.chunks_exact(4).map(texel).collect(),
        };
        Self { levels: image.levels.iter().enumerate().map(level).collect() }
    }

    /// The texel at `uv`, between the two levels whose texels are about as long as the longer side of the footprint.
    /// `ddx` and `ddy`: derivatives of `uv` per pixel.
    pub(super) fn sample(&self, uv: [f32; 2], ddx: [f32; 2], ddy: [f32; 2]) -> [f32; 4] {
        let size = self.levels[0].size.map(|side| side as f32);
        let length = |derivative: [f32; 2]| (derivative[0] * size[0]).hypot(derivative[1] * size[1]);
        let last_level = (self.levels.len() - 1) as f32;
        let level = length(ddx).max(length(ddy)).log2().clamp(0.0, last_level);
        let [finer, coarser] = [level.floor(), level.ceil()].map(|level| self.levels[level as usize].bilinear(uv));
        mix(finer, coarser, level.fract())
    }
}

impl Level {
    /// Bilinear filtering; repeats in both directions.
    fn bilinear(&self, uv: [f32; 2]) -> [f32; 4] {
        let position = [0, 1].map(|axis| (uv[axis] - uv[axis].floor()) * self.size[axis] as f32 - 0.5);
        let texel = |x: f32, y: f32| {
            let wrap = |coordinate: f32, side: usize| (coordinate as i64).rem_euclid(side as i64) as usize;
            self.texels[wrap(y, self.size[1]) * self.size[0] + wrap(x, self.size[0])]
        };
        let [x, y] = position.map(f32::floor);
        let row = |y: f32| mix(texel(x, y), texel(x + 1.0, y), position[0] - x);
        mix(row(y), row(y + 1.0), position[1] - y)
    }
}

fn mix(a: [f32; 4], b: [f32; 4], weight: f32) -> [f32; 4] {
    std::array::from_fn(|channel| a[channel] + weight * (b[channel] - a[channel]))
}
