//! Packs a scene's images into a bounded number of texture arrays, one layer per distinct use.
//!
//! Images of one size share an array. When there are more sizes than [`MAX_ARRAYS`], the smallest array is merged into
//! the one where that wastes the fewest texels, and its images are enlarged to that size. Texture coordinates run from
//! 0 to 1 either way, so nothing else changes. Colors are stored as sRGB, normal maps as linear values. If alpha only
//! cuts out, the mipmap levels preserve the covered share of the image (`coverage`).

mod coverage;

use std::sync::OnceLock;

use modalcast_model::domain::{AlphaMode, Texture};
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::Scene;

use super::geometry::used_materials;

/// Maximum number of arrays per use. The color arrays, the normal arrays and the shadow map together stay below the
/// sixteen texture units that OpenGL guarantees to a fragment shader.
pub(crate) const MAX_ARRAYS: usize = 6;

/// Maximum bytes of all arrays with their mipmap levels. 512 images of 4096 x 4096 would take 46 GB.
const MAX_TEXTURE_BYTES: u64 = 8 << 30;

/// What an image contains.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum TextureRole {
    Color,
    Normal,
}

/// One texture array: its size, and the scene's texture in each layer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct TextureArray {
    pub(crate) width: u32,
    pub(crate) height: u32,
    pub(crate) layers: Vec<usize>,
}

/// Location of a material's image: array and layer.
pub(crate) type ArrayLayer = (usize, usize);

impl TextureArray {
    /// Levels of a full mipmap chain.
    pub(crate) fn levels(&self) -> u32 {
        self.width.max(self.height).ilog2() + 1
    }

    /// Bytes of all levels and layers.
    pub(crate) fn bytes(&self) -> u64 {
        let texels = |level: u32| u64::from((self.width >> level).max(1)) * u64::from((self.height >> level).max(1));
        4 * self.layers.len() as u64 * (0..self.levels()).map(texels).sum::<u64>()
    }
}

/// The arrays that a scene needs for one use; empty when no used material has such an image.
pub(crate) fn arrays(scene: &Scene, purpose: TextureRole) -> Vec<TextureArray> {
    let wanted = match purpose {
        TextureRole::Color => scene.features.textures,
        TextureRole::Normal => scene.features.normal_maps,
    };
    if !wanted {
        return Vec::new();
    }
    let image = |material: usize| match purpose {
        TextureRole::Color => scene.materials[material].color_texture,
        TextureRole::Normal => scene.materials[material].normal_texture,
    };
    let used: std::collections::BTreeSet<usize> = used_materials(scene).into_iter().filter_map(image).collect();
    let sizes =
        used.into_iter().map(|texture| (texture, scene.textures[texture].width(), scene.textures[texture].height()));
    merge(by_size(sizes), MAX_ARRAYS)
}

/// Checks that the arrays stay within the device memory budget for images.
///
/// # Errors
/// `Invalid` with the number of bytes and a list of the arrays, largest first.
pub(crate) fn check_texture_budget(images: &[Vec<TextureArray>; 2]) -> Result<()> {
    let mut arrays: Vec<&TextureArray> = images.iter().flatten().collect();
    let bytes: u64 = arrays.iter().map(|array| array.bytes()).sum();
    if bytes <= MAX_TEXTURE_BYTES {
        return Ok(());
    }
    arrays.sort_by_key(|array| std::cmp::Reverse(array.bytes()));
    let words = |array: &&TextureArray| format!("{} of {} x {}", array.layers.len(), array.width, array.height);
    let list = arrays.iter().map(words).collect::<Vec<_>>().join(", ");
    Err(invalid(
        "scene.textures",
        format!("at most {MAX_TEXTURE_BYTES} bytes with all levels"),
        format!("{bytes} bytes: {list}"),
    ))
}

/// Location of a texture in its arrays.
pub(crate) fn find_layer(arrays: &[TextureArray], texture: usize) -> Option<ArrayLayer> {
    arrays
        .iter()
        .enumerate()
        .find_map(|(index, array)| array.layers.iter().position(|layer| *layer == texture).map(|layer| (index, layer)))
}

fn by_size(images: impl Iterator<Item = (usize, u32, u32)>) -> Vec<TextureArray> {
    let mut arrays: Vec<TextureArray> = Vec::new();
    for (texture, width, height) in images {
        match arrays.iter_mut().find(|array| (array.width, array.height) == (width, height)) {
            Some(array) => array.layers.push(texture),
            None => arrays.push(TextureArray { width, height, layers: vec![texture] }),
        }
    }
    arrays
}

fn merge(mut arrays: Vec<TextureArray>, limit: usize) -> Vec<TextureArray> {
    let area = |width: u32, height: u32| u64::from(width) * u64::from(height);
    while arrays.len() > limit {
        arrays.sort_by_key(|array| std::cmp::Reverse(area(array.width, array.height)));
        let Some(small) = arrays.pop() else { break };
        let joined = |array: &TextureArray| (array.width.max(small.width), array.height.max(small.height));
        let waste = |array: &TextureArray| {
            let (width, height) = joined(array);
            let grown = area(width, height) - area(array.width, array.height);
            grown * array.layers.len() as u64 + (area(width, height) - area(small.width, small.height))
        };
        if let Some(host) = arrays.iter_mut().min_by_key(|array| waste(array)) {
            (host.width, host.height) = joined(host);
            host.layers.extend(small.layers);
        }
    }
    arrays
}

/// Alpha threshold of a texture's texels, if only cut-outs with one cutoff use the texture.
pub(crate) fn cutoff(scene: &Scene, texture: usize) -> Option<f32> {
    let materials = used_materials(scene).into_iter().map(|material| &scene.materials[material]);
    let of_material = |material: &modalcast_model::domain::Material| match material.alpha_mode {
        AlphaMode::Mask { cutoff } => Some(cutoff / material.alpha),
        _ => None,
    };
    let mut cutoffs = materials.filter(|material| material.color_texture == Some(texture)).map(of_material);
    let first = cutoffs.next()??;
    (first > 0.0 && first < 1.0 && cutoffs.all(|cutoff| cutoff == Some(first))).then_some(first)
}

/// All mipmap levels of an image at the size of its array, level 0 first, RGBA8. With a cutoff, all levels cover the
/// same share.
pub(crate) fn mip_levels(
    texture: &Texture,
    array: &TextureArray,
    purpose: TextureRole,
    cutoff: Option<f32>,
) -> Vec<Vec<u8>> {
    let mut image = LinearImage::new(texture, purpose);
    if (texture.width(), texture.height()) != (array.width, array.height) {
        image = image.resized(array.width, array.height);
    }
    let mut chain = vec![image];
    while let Some(last) = chain.last().filter(|last| last.width > 1 || last.height > 1) {
        let half = last.downsampled();
        chain.push(half);
    }
    if purpose == TextureRole::Color {
        bleed_colors(&mut chain);
    }
    if let Some(cutoff) = cutoff {
        coverage::preserve_coverage(&mut chain, cutoff);
    }
    chain.iter().map(|level| level.bytes(purpose)).collect()
}

/// RGBA as floats: linear color (or a normal), and alpha.
struct LinearImage {
    width: u32,
    height: u32,
    texels: Vec<[f32; 4]>,
}

impl LinearImage {
    fn new(texture: &Texture, purpose: TextureRole) -> Self {
        let decode: [f32; 256] = std::array::from_fn(|byte| match purpose {
            TextureRole::Color => linear_from_srgb(byte as f32 / 255.0),
            TextureRole::Normal => byte as f32 / 255.0,
        });
        let texel = |rgba: &[u8]| {
            let [r, g, b] = [rgba[0], rgba[1], rgba[2]].map(|byte| decode[usize::from(byte)]);
            [r, g, b, f32::from(rgba[3]) / 255.0]
        };
        let texels = texture.rgba().chunks_exact(4).map(texel).collect();
        Self { width: texture.width(), height: texture.height(), texels }
    }

    fn at(&self, x: u32, y: u32) -> [f32; 4] {
        self.texels[(y.min(self.height - 1) * self.width + x.min(self.width - 1)) as usize]
    }

    /// The next mipmap level. Each texel averages the texels below it: four, or parts of up to nine for odd sides.
    /// Colors are weighted by alpha, so that transparent texels do not tint the result.
    fn downsampled(&self) -> Self {
        let (width, height) = ((self.width / 2).max(1), (self.height / 2).max(1));
        let (across, down) = (downsample_weights(self.width), downsample_weights(self.height));
        let mut texels = Vec::with_capacity((width * height) as usize);
        for (y, own) in down.iter().enumerate() {
            for (x, beside) in across.iter().enumerate() {
                let nine = std::array::from_fn::<_, 9, _>(|at| {
                    let (dx, dy) = (at % 3, at / 3);
                    (self.at((2 * x + dx) as u32, (2 * y + dy) as u32), beside[dx] * own[dy])
                });
                texels.push(alpha_weighted_mean(&nine));
            }
        }
        Self { width, height, texels }
    }

    /// Bilinear enlargement (arrays never shrink an image), with repeat wrapping like the sampler.
    fn resized(&self, width: u32, height: u32) -> Self {
        let along = |to: u32, count: u32, from: u32| {
            let position = (to as f32 + 0.5) * from as f32 / count as f32 - 0.5;
            let low = position.floor();
            (
                (low as i64).rem_euclid(i64::from(from)) as u32,
                (low as i64 + 1).rem_euclid(i64::from(from)) as u32,
                position - low,
            )
        };
        let mut texels = Vec::with_capacity((width * height) as usize);
        for y in 0..height {
            let (top, bottom, v) = along(y, height, self.height);
            for x in 0..width {
                let (left, right, u) = along(x, width, self.width);
                texels.push(alpha_weighted_mean(&[
                    (self.at(left, top), (1.0 - u) * (1.0 - v)),
                    (self.at(right, top), u * (1.0 - v)),
                    (self.at(left, bottom), (1.0 - u) * v),
                    (self.at(right, bottom), u * v),
                ]));
            }
        }
        Self { width, height, texels }
    }

    fn bytes(&self, purpose: TextureRole) -> Vec<u8> {
        static SRGB: OnceLock<Vec<u8>> = OnceLock::new();
        // Fine enough that the steepest step of the curve, at black, is a twentieth of a byte.
        let table =
            SRGB.get_or_init(|| (0..=65535).map(|step| byte(srgb_from_linear(step as f32 / 65535.0))).collect());
        let encode = |value: f32| match purpose {
            TextureRole::Color => table[(value * 65535.0 + 0.5) as u16 as usize],
            TextureRole::Normal => byte(value),
        };
        self.texels.iter().flat_map(|[r, g, b, a]| [encode(*r), encode(*g), encode(*b), byte(*a)]).collect()
    }
}

/// Weights of the texels 2x, 2x + 1 and 2x + 2 in texel x of the halved side. Texels of a halved odd side are wider
/// than two: averaging pairs would drop the last column and shift the rest.
fn downsample_weights(side: u32) -> Vec<[f32; 3]> {
    let half = (side / 2).max(1);
    let share = |x: u32| match side {
        1 => [1.0, 0.0, 0.0],
        side if side % 2 == 0 => [0.5, 0.5, 0.0],
        side => [half - x, half, x + 1].map(|part| part as f32 / side as f32),
    };
    (0..half).map(share).collect()
}

fn byte(value: f32) -> u8 {
    (value * 255.0 + 0.5) as u8
}

fn alpha_weighted_mean(parts: &[([f32; 4], f32)]) -> [f32; 4] {
    let alpha: f32 = parts.iter().map(|(texel, weight)| texel[3] * weight).sum();
    let mut mean = [0.0, 0.0, 0.0, alpha];
    for (channel, sum) in mean[..3].iter_mut().enumerate() {
        let opaque = |(texel, weight): &([f32; 4], f32)| weight * if alpha > 0.0 { texel[3] / alpha } else { 1.0 };
        *sum = parts.iter().map(|part| part.0[channel] * opaque(part)).sum();
    }
    mean
}

/// Gives each fully transparent texel the color of the next coarser level, from the coarsest level down: filtering at
/// the edge of a cut-out then finds the color of the leaf instead of a dark rim.
fn bleed_colors(chain: &mut [LinearImage]) {
    for level in (0..chain.len().saturating_sub(1)).rev() {
        let (fine, coarse) = chain.split_at_mut(level + 1);
        let (fine, coarse) = (&mut fine[level], &coarse[0]);
        for y in 0..fine.height {
            for x in 0..fine.width {
                let texel = &mut fine.texels[(y * fine.width + x) as usize];
                if texel[3] == 0.0 {
                    let [r, g, b, _] = coarse.at(x / 2, y / 2);
                    *texel = [r, g, b, 0.0];
                }
            }
        }
    }
}

/// sRGB transfer function, IEC 61966-2-1.
pub(crate) fn linear_from_srgb(encoded: f32) -> f32 {
    if encoded <= 0.040_45 { encoded / 12.92 } else { ((encoded + 0.055) / 1.055).powf(2.4) }
}

fn srgb_from_linear(linear: f32) -> f32 {
    if linear <= 0.003_130_8 { linear * 12.92 } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(width: u32, height: u32, pixel: impl Fn(u32, u32) -> [u8; 4]) -> Texture {
        let rgba = (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).flat_map(|(x, y)| pixel(x, y)).collect();
        Texture::new("test", width, height, rgba).expect("fits")
    }

    #[test]
    fn many_sizes_end_in_few_arrays_and_no_image_is_lost_or_shrunk() {
        let sizes: Vec<(usize, u32, u32)> = (0..40).map(|index| (index, 1 + index as u32 * 3, 50)).collect();
        let merged = merge(by_size(sizes.iter().copied()), MAX_ARRAYS);
        assert_eq!(merged.len(), MAX_ARRAYS);
        for (texture, width, height) in sizes {
            let (array, _) = find_layer(&merged, texture).expect("kept");
            assert!(merged[array].width >= width && merged[array].height >= height);
        }
        let few = by_size([(0, 4, 4), (1, 8, 8), (2, 4, 4)].into_iter());
        assert_eq!(merge(few.clone(), MAX_ARRAYS), few, "few sizes are left alone");
    }

    #[test]
    fn images_over_the_budget_are_refused_with_the_numbers_and_five_hundred_of_usual_size_are_not() {
        let array = |side, count| TextureArray { width: side, height: side, layers: (0..count).collect() };
        let refusal =
            check_texture_budget(&[vec![array(16, 1), array(4096, 512)], vec![]]).expect_err("46 GB").to_string();
        assert!(refusal.contains("8589934592") && refusal.contains("45812985172 bytes"), "{refusal}");
        assert!(refusal.contains("512 of 4096 x 4096, 1 of 16 x 16"), "{refusal}");
        check_texture_budget(&[vec![array(1024, 512)], vec![array(1024, 512)]]).expect("5.7 GB");
    }

    #[test]
    fn level_zero_keeps_every_byte_of_opaque_and_translucent_texels() {
        let picture = image(16, 16, |x, y| [(16 * y + x) as u8, (255 - 16 * y) as u8, x as u8, 1 + 15 * y as u8]);
        let array = TextureArray { width: 16, height: 16, layers: vec![0] };
        for purpose in [TextureRole::Color, TextureRole::Normal] {
            let chain = mip_levels(&picture, &array, purpose, None);
            assert_eq!(chain[0], picture.rgba());
            assert_eq!(chain.iter().map(Vec::len).collect::<Vec<_>>(), [1024, 256, 64, 16, 4]);
            assert_eq!(chain.iter().map(Vec::len).sum::<usize>() as u64, array.bytes());
        }
    }

    #[test]
    fn transparent_texels_take_the_colour_of_the_leaf_and_darken_no_level() {
        let leaf = image(4, 4, |x, _| if x == 0 { [0, 200, 0, 255] } else { [255, 0, 255, 0] });
        let chain = mip_levels(&leaf, &TextureArray { width: 4, height: 4, layers: vec![0] }, TextureRole::Color, None);
        for (level, rgba) in chain.iter().enumerate() {
            assert!(rgba.chunks_exact(4).all(|texel| texel[..3] == [0, 200, 0]), "level {level}: {rgba:?}");
        }
        assert_eq!(chain[2], [0, 200, 0, 64]);
    }

    #[test]
    fn every_level_of_an_odd_side_keeps_the_mean_of_the_image_and_its_centre() {
        for (width, height) in [(25, 15), (3, 1), (1, 7), (24, 24), (75, 50), (2, 3)] {
            // A ramp with a distinct last column and row, which halving by pairs would drop.
            let level = |at: u32, side: u32| 100 * u32::from(at + 1 == side) + 3 * at % 100;
            let texel = |at: u32| [level(at % width, width) as f32, level(at / width, height) as f32, 1.0, 1.0];
            let texels: Vec<[f32; 4]> = (0..width * height).map(texel).collect();
            let mean = |image: &LinearImage| {
                let sum = |channel: usize| image.texels.iter().map(|texel| f64::from(texel[channel])).sum::<f64>();
                [0, 1, 2, 3].map(|channel| sum(channel) / image.texels.len() as f64)
            };
            let mut image = LinearImage { width, height, texels };
            let wanted = mean(&image);
            while image.width > 1 || image.height > 1 {
                image = image.downsampled();
                let found = mean(&image);
                let off = found.iter().zip(wanted).map(|(found, wanted)| (found - wanted).abs()).fold(0.0, f64::max);
                assert!(off < 1e-3, "{width} x {height}: {found:?} is not {wanted:?}");
            }
            assert_eq!(image.texels.len(), 1);
        }
        assert_eq!(downsample_weights(5), [[0.4, 0.4, 0.2], [0.2, 0.4, 0.4]]);
        assert!(
            downsample_weights(6).iter().all(|share| *share == [0.5, 0.5, 0.0]),
            "even sides stay averages of pairs"
        );
    }

    #[test]
    fn an_enlarged_image_keeps_its_corners_and_odd_sizes_reach_one_texel() {
        let picture = image(2, 2, |x, y| [255 * x as u8, 255 * y as u8, 0, 255]);
        let array = TextureArray { width: 7, height: 3, layers: vec![0] };
        let chain = mip_levels(&picture, &array, TextureRole::Normal, None);
        assert_eq!((chain[0].len(), chain.len(), chain[2].len()), (84, 3, 4));
        assert_eq!(array.bytes(), 4 * (21 + 3 + 1));
        let constant = image(1, 1, |_, _| [9, 99, 199, 255]);
        let chain = mip_levels(&constant, &array, TextureRole::Color, None);
        assert!(chain[0].chunks_exact(4).all(|texel| texel == [9, 99, 199, 255]));
    }
}
