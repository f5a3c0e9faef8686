//! Decodes the images of glTF textures. An image that several textures or materials use becomes one texture.

use std::collections::HashMap;

use super::buffers::GltfBuffers;
use super::document::{Document, NEAREST, TextureInfo};
use super::get_element;
use super::remarks::{ImportRemarks, sanitize};
use crate::domain::Texture;
use crate::error::{Result, invalid};

/// Decodes images when materials first use them.
#[derive(Debug)]
pub(super) struct TextureLoader<'a> {
    document: &'a Document,
    buffers: &'a GltfBuffers<'a>,
    /// The decoded textures.
    pub(super) textures: Vec<Texture>,
    /// Indices in `textures` by the index of the image.
    texture_indices: HashMap<usize, usize>,
    /// Channel means by the index of the image.
    channel_means: HashMap<usize, [f32; 4]>,
}

impl<'a> TextureLoader<'a> {
    pub(super) fn new(document: &'a Document, buffers: &'a GltfBuffers<'a>) -> Self {
        Self { document, buffers, textures: Vec::new(), texture_indices: HashMap::new(), channel_means: HashMap::new() }
    }

    /// Returns the index of a texture. The first call for an image decodes it.
    ///
    /// # Errors
    /// `Invalid` if the texture does not exist or is not a PNG, JPEG or WebP image.
    pub(super) fn texture_index(&mut self, texture_info: &TextureInfo, remarks: &mut ImportRemarks) -> Result<usize> {
        let image_index = self.image_index_of(texture_info, remarks)?;
        if let Some(index) = self.texture_indices.get(&image_index) {
            return Ok(*index);
        }
        let texture = self.decode(image_index)?;
        self.textures.push(texture);
        self.texture_indices.insert(image_index, self.textures.len() - 1);
        Ok(self.textures.len() - 1)
    }

    /// Adds a texture that no image of the document has, and returns its index.
    pub(super) fn add(&mut self, texture: Texture) -> usize {
        self.textures.push(texture);
        self.textures.len() - 1
    }

    /// Reserves the memory of an image with a patch of `side` x `side` texels per triangle.
    ///
    /// # Errors
    /// As for [`GltfBuffers::charge_budget`].
    pub(super) fn charge_patches(&self, side: usize, triangle_count: usize) -> Result<()> {
        // The last row of patches can be incomplete.
        let patches = triangle_count as u64 + (triangle_count as f64).sqrt().ceil() as u64;
        self.buffers.charge_budget(4 * (side as u64).pow(2) * patches)
    }

    /// Whether a texture has no PNG, JPEG or WebP image: its image is a file that is not found, has another format, or is
    /// defined by an extension. Adds a remark that ends with `stand_in`.
    ///
    /// # Errors
    /// `Invalid` if the texture does not exist and, in strict mode, if it has no PNG, JPEG or WebP image.
    pub(super) fn is_unusable(
        &self,
        texture_info: &TextureInfo,
        stand_in: &str,
        remarks: &mut ImportRemarks,
    ) -> Result<bool> {
        let texture = get_element(&self.document.textures, texture_info.index, "index")?;
        if texture.image().is_none() && !self.buffers.is_strict() {
            remarks.add(format!("texture {} has no PNG, JPEG or WebP image: {stand_in}", texture_info.index));
            return Ok(true);
        }
        let image = self.image_index_of(texture_info, remarks)?;
        let subject = match self.uri(image) {
            Some(uri) => format!("image '{}'", sanitize(uri, 120)),
            None => format!("image '{}'", self.name(image)),
        };
        let mut image_remarks = Vec::new();
        let is_usable = self.buffers.is_usable_image(image, &subject, stand_in, &mut image_remarks);
        let is_usable = is_usable.map_err(|error| error.prefix_field(&format!("images[{image}]")))?;
        image_remarks.into_iter().for_each(|remark| remarks.add(remark));
        Ok(!is_usable)
    }

    /// The mean of each of the four channels, 0 to 1. The texture is not added to `textures`.
    ///
    /// # Errors
    /// As for [`Self::texture_index`].
    pub(super) fn channel_means(
        &mut self,
        texture_info: &TextureInfo,
        remarks: &mut ImportRemarks,
    ) -> Result<[f32; 4]> {
        let image_index = self.image_index_of(texture_info, remarks)?;
        if let Some(means) = self.channel_means.get(&image_index) {
            return Ok(*means);
        }
        let texture = self.decode(image_index)?;
        let mut sums = [0_u64; 4];
        for pixel in texture.rgba().as_chunks::<4>().0 {
            sums.iter_mut().zip(pixel).for_each(|(sum, channel)| *sum += u64::from(*channel));
        }
        let pixel_count = f64::from(texture.width()) * f64::from(texture.height());
        let means = sums.map(|sum| (sum as f64 / (255.0 * pixel_count)) as f32);
        self.channel_means.insert(image_index, means);
        Ok(means)
    }

    /// The index of a texture's image. Unsupported sampler settings are recorded as remarks.
    fn image_index_of(&self, texture_info: &TextureInfo, remarks: &mut ImportRemarks) -> Result<usize> {
        let texture = get_element(&self.document.textures, texture_info.index, "index")?;
        let texture_field = format!("textures[{}]", texture_info.index);
        if let Some(sampler) = texture.sampler {
            let sampler = get_element(&self.document.samplers, sampler, &format!("{texture_field}.sampler"))?;
            if sampler.mag_filter == Some(NEAREST) {
                remarks.add("samplers with the filter NEAREST are ignored: textures are interpolated".into());
            }
        }
        let image_index =
            texture.image().ok_or_else(|| invalid(format!("{texture_field}.source"), "an image", "none"))?;
        get_element(&self.document.images, image_index, &format!("{texture_field}.source"))?;
        Ok(image_index)
    }

    fn decode(&self, image: usize) -> Result<Texture> {
        let add_image_location = |error: crate::error::Error| error.prefix_field(&format!("images[{image}]"));
        let encoded = self.buffers.image(image).map_err(add_image_location)?;
        let texture = Texture::decode(self.name(image), &encoded, self.buffers.memory()).map_err(add_image_location)?;
        self.buffers.count_budget(texture.rgba().len() as u64).map_err(add_image_location)?;
        Ok(texture)
    }

    fn name(&self, index: usize) -> String {
        let image = &self.document.images[index];
        let name = image.name.as_deref().filter(|name| !name.is_empty()).or(self.uri(index));
        name.map_or_else(|| format!("image {index}"), |name| sanitize(name, 120))
    }

    /// The URI of an image that is a file.
    fn uri(&self, index: usize) -> Option<&str> {
        self.document.images[index].uri.as_deref().filter(|uri| !uri.starts_with("data:"))
    }
}
