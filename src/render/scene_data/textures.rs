//! Packs the images of a scene into a bounded number of texture arrays, one layer per image and role (color or normal).
//!
//! Images of the same size share an array. If there are more sizes than [`MAX_ARRAYS`], the smallest array is merged
//! into the array for which this wastes the fewest texels. Images are never resampled: each level of an image is at the
//! first texels of the same level of its layer, and shaders wrap and filter within the image
//! (`shaders/shared/mixed_image.glsl`). Colors are stored as sRGB, normal maps as linear values.
//! For cut-outs, the mipmap levels preserve the covered fraction of the image (`coverage`).

mod coverage;

use std::sync::OnceLock;

use modalcast_model::domain::{AlphaMode, Texture};
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::Scene;

use super::geometry::used_materials;

/// Maximum number of arrays per role. The arrays of both roles and the shadow map together need 6 + 6 + 1 texture
/// units; OpenGL guarantees sixteen to a fragment shader.
pub(crate) const MAX_ARRAYS: usize = 6;

/// Maximum bytes of all arrays with their mipmap levels. For comparison, 512 images of 4096 x 4096 take 46 GB.
const MAX_TEXTURE_BYTES: u64 = 8 << 30;

/// What an image contains.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum TextureRole {
    Color,
    Normal,
}

/// A texture array.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct TextureArray {
    /// Size of the layers.
    pub(crate) width: u32,
    pub(crate) height: u32,
    /// Whether the images of some layers are smaller than the layers.
    pub(crate) is_mixed: bool,
    /// Index of the scene's texture in each layer.
    pub(crate) layers: Vec<usize>,
}

/// Location of an image: index of the array, index of the layer.
pub(crate) type ArrayLayer = (usize, usize);

/// A texture array of a role, as shaders use it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct ArrayUse {
    pub(crate) index: usize,
    /// As [`TextureArray::is_mixed`].
    pub(crate) is_mixed: bool,
}

impl TextureArray {
    /// Number of levels of a full mipmap chain.
    pub(crate) fn levels(&self) -> u32 {
        self.width.max(self.height).ilog2() + 1
    }

    /// Bytes of all levels and layers.
    pub(crate) fn bytes(&self) -> u64 {
        let texels = |level: u32| u64::from((self.width >> level).max(1)) * u64::from((self.height >> level).max(1));
        4 * self.layers.len() as u64 * (0..self.levels()).map(texels).sum::<u64>()
    }
}

/// Texture arrays of a scene for one role; empty if no used material has such an image.
pub(crate) fn arrays(scene: &Scene, role: TextureRole) -> Vec<TextureArray> {
    let is_used = match role {
        TextureRole::Color => scene.features.textures,
        TextureRole::Normal => scene.features.normal_maps,
    };
    if !is_used {
        return Vec::new();
    }
    let texture_of = |material: usize| match role {
        TextureRole::Color => scene.materials[material].color_texture,
        TextureRole::Normal => scene.materials[material].normal_texture,
    };
    let textures: std::collections::BTreeSet<usize> =
        used_materials(scene).into_iter().filter_map(texture_of).collect();
    let sizes = textures
        .into_iter()
        .map(|texture| (texture, scene.textures[texture].width(), scene.textures[texture].height()));
    merge_arrays(group_by_size(sizes), MAX_ARRAYS)
}

/// Checks that the arrays do not exceed the device memory budget for images.
///
/// # Errors
/// `Invalid` with the number of bytes and a list of the arrays, largest first.
pub(crate) fn check_texture_budget(texture_arrays: &[Vec<TextureArray>; 2]) -> Result<()> {
    let mut arrays: Vec<&TextureArray> = texture_arrays.iter().flatten().collect();
    let bytes: u64 = arrays.iter().map(|array| array.bytes()).sum();
    if bytes <= MAX_TEXTURE_BYTES {
        return Ok(());
    }
    arrays.sort_by_key(|array| std::cmp::Reverse(array.bytes()));
    let describe = |array: &&TextureArray| format!("{} of {} x {}", array.layers.len(), array.width, array.height);
    let array_list = arrays.iter().map(describe).collect::<Vec<_>>().join(", ");
    Err(invalid(
        "scene.textures",
        format!("at most {MAX_TEXTURE_BYTES} bytes with all levels"),
        format!("{bytes} bytes: {array_list}"),
    ))
}

/// Location of a texture; none if no array contains it.
pub(crate) fn find_layer(arrays: &[TextureArray], texture: usize) -> Option<ArrayLayer> {
    arrays
        .iter()
        .enumerate()
        .find_map(|(index, array)| array.layers.iter().position(|layer| *layer == texture).map(|layer| (index, layer)))
}

/// One array per image size. Each texture is given by index, width and height.
fn group_by_size(texture_sizes: impl Iterator<Item = (usize, u32, u32)>) -> Vec<TextureArray> {
    let mut arrays: Vec<TextureArray> = Vec::new();
    for (texture, width, height) in texture_sizes {
        match arrays.iter_mut().find(|array| (array.width, array.height) == (width, height)) {
            Some(array) => array.layers.push(texture),
            None => arrays.push(TextureArray { width, height, is_mixed: false, layers: vec![texture] }),
        }
    }
    arrays
}

/// Merges arrays until there are at most `limit`.
fn merge_arrays(mut arrays: Vec<TextureArray>, limit: usize) -> Vec<TextureArray> {
    let area = |width: u32, height: u32| u64::from(width) * u64::from(height);
    while arrays.len() > limit {
        arrays.sort_by_key(|array| std::cmp::Reverse(area(array.width, array.height)));
        let Some(smallest) = arrays.pop() else { break };
        let merged_size = |array: &TextureArray| (array.width.max(smallest.width), array.height.max(smallest.height));
        // Texels that are added to all layers of `array`, and to one layer of the smallest array.
        let wasted_texels = |array: &TextureArray| {
            let (width, height) = merged_size(array);
            let enlargement = area(width, height) - area(array.width, array.height);
            enlargement * array.layers.len() as u64 + (area(width, height) - area(smallest.width, smallest.height))
        };
        if let Some(target) = arrays.iter_mut().min_by_key(|array| wasted_texels(array)) {
            (target.width, target.height) = merged_size(target);
            target.is_mixed = true;
            target.layers.extend(smallest.layers);
        }
    }
    arrays
}

/// Cutoff for the alpha of a texture's texels, if only cut-outs with the same cutoff use the texture.
pub(crate) fn cutoff(scene: &Scene, texture: usize) -> Option<f32> {
    let materials = used_materials(scene).into_iter().map(|material| &scene.materials[material]);
    // The shader multiplies the alpha of a texel by that of the material before the comparison.
    let cutoff_of = |material: &modalcast_model::domain::Material| match material.alpha_mode {
        AlphaMode::Mask { cutoff } => Some(cutoff / material.alpha),
        _ => None,
    };
    let mut cutoffs = materials.filter(|material| material.color_texture == Some(texture)).map(cutoff_of);
    let common_cutoff = cutoffs.next()??;
    (common_cutoff > 0.0 && common_cutoff < 1.0 && cutoffs.all(|cutoff| cutoff == Some(common_cutoff)))
        .then_some(common_cutoff)
}

/// All mipmap levels of an image, RGBA8, level 0 first. With a cutoff, all levels have the same coverage.
pub(crate) fn mip_levels(texture: &Texture, role: TextureRole, cutoff: Option<f32>) -> Vec<Vec<u8>> {
    let mut chain = vec![LinearImage::new(texture, role)];
    while let Some(coarsest) = chain.last().filter(|coarsest| coarsest.width > 1 || coarsest.height > 1) {
        let next_level = coarsest.downsampled();
        chain.push(next_level);
    }
    if role == TextureRole::Color {
        bleed_colors(&mut chain);
    }
    if let Some(cutoff) = cutoff {
        coverage::preserve_coverage(&mut chain, cutoff);
    }
    chain.iter().map(|level| level.bytes(role)).collect()
}

/// RGBA as floats: linear color (or a normal), and alpha.
struct LinearImage {
    width: u32,
    height: u32,
    texels: Vec<[f32; 4]>,
}

impl LinearImage {
    fn new(texture: &Texture, role: TextureRole) -> Self {
        let decode: [f32; 256] = std::array::from_fn(|byte| match role {
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

    /// The texel at (x, y), or the nearest texel for coordinates above the maximum.
    fn texel_at(&self, x: u32, y: u32) -> [f32; 4] {
        self.texels[(y.min(self.height - 1) * self.width + x.min(self.width - 1)) as usize]
    }

    /// The next mipmap level. Each texel is the mean of four texels, or of parts of up to nine texels for odd sides.
    /// Colors are weighted by alpha, so that transparent texels do not tint the result.
    fn downsampled(&self) -> Self {
        let (width, height) = ((self.width / 2).max(1), (self.height / 2).max(1));
        let (weights_by_column, weights_by_row) = (downsample_weights(self.width), downsample_weights(self.height));
        let mut texels = Vec::with_capacity((width * height) as usize);
        for (y, row_weights) in weights_by_row.iter().enumerate() {
            for (x, column_weights) in weights_by_column.iter().enumerate() {
                let weighted_texels = std::array::from_fn::<_, 9, _>(|index| {
                    let (dx, dy) = (index % 3, index / 3);
                    (self.texel_at((2 * x + dx) as u32, (2 * y + dy) as u32), column_weights[dx] * row_weights[dy])
                });
                texels.push(alpha_weighted_mean(&weighted_texels));
            }
        }
        Self { width, height, texels }
    }

    /// Texels as RGBA8.
    fn bytes(&self, role: TextureRole) -> Vec<u8> {
        static SRGB: OnceLock<Vec<u8>> = OnceLock::new();
        // With 65536 entries, the largest step between entries, at black, is a twentieth of a byte level.
        let table =
            SRGB.get_or_init(|| (0..=65535).map(|step| byte(srgb_from_linear(step as f32 / 65535.0))).collect());
        let encode = |value: f32| match role {
            TextureRole::Color => table[(value * 65535.0 + 0.5) as u16 as usize],
            TextureRole::Normal => byte(value),
        };
        self.texels.iter().flat_map(|[r, g, b, a]| [encode(*r), encode(*g), encode(*b), byte(*a)]).collect()
    }
}

/// Weights of the texels 2x, 2x + 1 and 2x + 2 in texel x of the halved side. If `side` is odd, a texel of the halved
/// side covers more than two texels; a mean of pairs would drop the last texel and shift the others.
fn downsample_weights(side: u32) -> Vec<[f32; 3]> {
    let half_side = (side / 2).max(1);
    let weights_of = |x: u32| match side {
        1 => [1.0, 0.0, 0.0],
        side if side % 2 == 0 => [0.5, 0.5, 0.0],
        // Texel x covers the interval from x side / half_side to (x + 1) side / half_side.
        side => [half_side - x, half_side, x + 1].map(|weight| weight as f32 / side as f32),
    };
    (0..half_side).map(weights_of).collect()
}

/// Converts a value from 0 to 1 to a byte, rounded.
fn byte(value: f32) -> u8 {
    (value * 255.0 + 0.5) as u8
}

/// Mean of texels with weights. The weights of colors are multiplied by alpha, unless all texels are transparent.
fn alpha_weighted_mean(weighted_texels: &[([f32; 4], f32)]) -> [f32; 4] {
    let alpha: f32 = weighted_texels.iter().map(|(texel, weight)| texel[3] * weight).sum();
    let mut mean = [0.0, 0.0, 0.0, alpha];
    for (channel, sum) in mean[..3].iter_mut().enumerate() {
        let color_weight =
            |(texel, weight): &([f32; 4], f32)| weight * if alpha > 0.0 { texel[3] / alpha } else { 1.0 };
        *sum =
            weighted_texels.iter().map(|weighted_texel| weighted_texel.0[channel] * color_weight(weighted_texel)).sum();
    }
    mean
}

/// Gives each fully transparent texel the color of the next coarser level, beginning with the coarsest. So filtering at
/// the edge of a cut-out does not mix in the color of transparent texels.
fn bleed_colors(chain: &mut [LinearImage]) {
    for level in (0..chain.len().saturating_sub(1)).rev() {
        let (finer_images, coarser_images) = chain.split_at_mut(level + 1);
        let (level_image, coarser_image) = (&mut finer_images[level], &coarser_images[0]);
        for y in 0..level_image.height {
            for x in 0..level_image.width {
                let texel = &mut level_image.texels[(y * level_image.width + x) as usize];
                if texel[3] == 0.0 {
                    let [r, g, b, _] = coarser_image.texel_at(x / 2, y / 2);
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
        Texture::new("test", width, height, rgba).expect("a valid texture")
    }

    #[test]
    fn merged_arrays_contain_all_images_and_are_mixed() {
        let sizes: Vec<(usize, u32, u32)> = (0..40).map(|index| (index, 1 + index as u32 * 3, 50)).collect();
        let merged = merge_arrays(group_by_size(sizes.iter().copied()), MAX_ARRAYS);
        assert_eq!(merged.len(), MAX_ARRAYS);
        for (texture, width, height) in sizes {
            let (array, _) = find_layer(&merged, texture).expect("a layer");
            assert!(merged[array].width >= width && merged[array].height >= height);
            assert!(merged[array].is_mixed || (merged[array].width, merged[array].height) == (width, height));
        }
        let arrays = group_by_size([(0, 4, 4), (1, 8, 8), (2, 4, 4)].into_iter());
        assert_eq!(merge_arrays(arrays.clone(), MAX_ARRAYS), arrays, "expected no merging of two arrays");
    }

    #[test]
    fn images_above_the_budget_are_rejected_with_their_sizes() {
        // A full mipmap chain has about 4/3 times the texels of level 0, with 4 bytes each.
        let array =
            |side, count| TextureArray { width: side, height: side, is_mixed: false, layers: (0..count).collect() };
        let error = check_texture_budget(&[vec![array(16, 1), array(4096, 512)], vec![]])
            .expect_err("46 GB exceed the budget")
            .to_string();
        assert!(error.contains("8589934592") && error.contains("45812985172 bytes"), "{error}");
        assert!(error.contains("512 of 4096 x 4096, 1 of 16 x 16"), "{error}");
        check_texture_budget(&[vec![array(1024, 512)], vec![array(1024, 512)]]).expect("5.7 GB are within the budget");
    }

    #[test]
    fn level_zero_is_byte_identical_to_the_image() {
        let texture = image(16, 16, |x, y| [(16 * y + x) as u8, (255 - 16 * y) as u8, x as u8, 1 + 15 * y as u8]);
        let array = TextureArray { width: 16, height: 16, is_mixed: false, layers: vec![0] };
        for role in [TextureRole::Color, TextureRole::Normal] {
            let chain = mip_levels(&texture, role, None);
            assert_eq!(chain[0], texture.rgba());
            assert_eq!(chain.iter().map(Vec::len).collect::<Vec<_>>(), [1024, 256, 64, 16, 4]);
            assert_eq!(chain.iter().map(Vec::len).sum::<usize>() as u64, array.bytes());
        }
    }

    #[test]
    fn transparent_texels_get_the_color_of_the_leaf() {
        let texture = image(4, 4, |x, _| if x == 0 { [0, 200, 0, 255] } else { [255, 0, 255, 0] });
        let chain = mip_levels(&texture, TextureRole::Color, None);
        for (level, rgba) in chain.iter().enumerate() {
            assert!(rgba.chunks_exact(4).all(|texel| texel[..3] == [0, 200, 0]), "level {level}: {rgba:?}");
        }
        // A quarter of the texels has an alpha of 255.
        assert_eq!(chain[2], [0, 200, 0, 64]);
    }

    #[test]
    fn levels_of_odd_sides_preserve_the_mean() {
        for (width, height) in [(25, 15), (3, 1), (1, 7), (24, 24), (75, 50), (2, 3)] {
            // A ramp with a distinct last column and row, which halving by pairs would drop.
            let level = |index: u32, side: u32| 100 * u32::from(index + 1 == side) + 3 * index % 100;
            let texel =
                |index: u32| [level(index % width, width) as f32, level(index / width, height) as f32, 1.0, 1.0];
            let texels: Vec<[f32; 4]> = (0..width * height).map(texel).collect();
            let mean = |image: &LinearImage| {
                let sum = |channel: usize| image.texels.iter().map(|texel| f64::from(texel[channel])).sum::<f64>();
                [0, 1, 2, 3].map(|channel| sum(channel) / image.texels.len() as f64)
            };
            let mut image = LinearImage { width, height, texels };
            let expected_mean = mean(&image);
            while image.width > 1 || image.height > 1 {
                image = image.downsampled();
                let mean_color = mean(&image);
                let max_error = mean_color
                    .iter()
                    .zip(expected_mean)
                    .map(|(mean, expected)| (mean - expected).abs())
                    .fold(0.0, f64::max);
                assert!(max_error < 1e-3, "{width} x {height}: expected {expected_mean:?}, got {mean_color:?}");
            }
            assert_eq!(image.texels.len(), 1);
        }
        assert_eq!(downsample_weights(5), [[0.4, 0.4, 0.2], [0.2, 0.4, 0.4]]);
        assert!(
            downsample_weights(6).iter().all(|weights| *weights == [0.5, 0.5, 0.0]),
            "expected means of pairs for even sides"
        );
    }

    #[test]
    fn levels_of_an_image_fit_into_those_of_a_larger_layer() {
        for (width, height) in [(25, 15), (16, 16), (1, 3), (127, 2)] {
            let texture = image(width, height, |x, y| [x as u8, y as u8, 0, 255]);
            let layer = TextureArray { width: 127, height: 17, is_mixed: true, layers: vec![0] };
            let chain = mip_levels(&texture, TextureRole::Normal, None);
            assert_eq!(chain[0], texture.rgba(), "expected no resampling");
            assert!(chain.len() <= layer.levels() as usize);
            for (level, rgba) in chain.iter().enumerate() {
                let side = |side: u32| (side >> level).max(1);
                assert_eq!(rgba.len() as u32, 4 * side(width) * side(height));
                assert!(side(width) <= side(layer.width) && side(height) <= side(layer.height));
            }
        }
    }
}
