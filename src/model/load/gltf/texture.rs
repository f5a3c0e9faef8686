//! Decodes the images of glTF textures. An image that several textures or materials use becomes one texture.

use std::collections::HashMap;

use super::buffers::GltfBuffers;
use super::document::{Document, REPEAT, TextureInfo};
use super::warnings::{ImportWarnings, sanitize};
use super::{buffers, get_element};
use crate::domain::Texture;
use crate::error::{Result, invalid};

/// Decodes images when materials first use them.
#[derive(Debug)]
pub(super) struct TextureLoader<'a> {
    document: &'a Document,
    bytes: &'a buffers::GltfBuffers<'a>,
    /// The decoded textures.
    pub(super) textures: Vec<Texture>,
    by_image: HashMap<usize, usize>,
    means: HashMap<usize, [f32; 4]>,
}

impl<'a> TextureLoader<'a> {
    pub(super) fn new(document: &'a Document, bytes: &'a GltfBuffers<'a>) -> Self {
        Self { document, bytes, textures: Vec::new(), by_image: HashMap::new(), means: HashMap::new() }
    }

    /// The index of a decoded texture.
    ///
    /// # Errors
    /// `Invalid` if the texture does not exist or is not a PNG or JPEG image.
    pub(super) fn texture_index(&mut self, wanted: &TextureInfo, remarks: &mut ImportWarnings) -> Result<usize> {
        let image = self.image_of(wanted, remarks)?;
        if let Some(known) = self.by_image.get(&image) {
            return Ok(*known);
        }
        let texture = self.decode(image)?;
        self.textures.push(texture);
        self.by_image.insert(image, self.textures.len() - 1);
        Ok(self.textures.len() - 1)
    }

    /// The mean of each of the four channels, 0 to 1. The texture itself is not kept.
    ///
    /// # Errors
    /// As for [`Self::texture_index`].
    pub(super) fn channel_means(&mut self, wanted: &TextureInfo, remarks: &mut ImportWarnings) -> Result<[f32; 4]> {
        let image = self.image_of(wanted, remarks)?;
        if let Some(known) = self.means.get(&image) {
            return Ok(*known);
        }
        let texture = self.decode(image)?;
        let mut sums = [0_u64; 4];
        for pixel in texture.rgba().as_chunks::<4>().0 {
            sums.iter_mut().zip(pixel).for_each(|(sum, channel)| *sum += u64::from(*channel));
        }
        let pixels = f64::from(texture.width()) * f64::from(texture.height());
        let means = sums.map(|sum| (sum as f64 / (255.0 * pixels)) as f32);
        self.means.insert(image, means);
        Ok(means)
    }

    /// The image of a texture. Unsupported sampler settings are recorded as remarks.
    fn image_of(&self, wanted: &TextureInfo, remarks: &mut ImportWarnings) -> Result<usize> {
        let texture = get_element(&self.document.textures, wanted.index, "index")?;
        let place = format!("textures[{}]", wanted.index);
        if let Some(sampler) = texture.sampler {
            let sampler = get_element(&self.document.samplers, sampler, &format!("{place}.sampler"))?;
            if (sampler.wrap_s, sampler.wrap_t) != (REPEAT, REPEAT) {
                remarks.add("samplers that clamp or mirror are ignored: textures repeat".into());
            }
        }
        if wanted.extensions.transform.is_some() {
            remarks.add("KHR_texture_transform is not supported: texture coordinates stay as they are".into());
        }
        let source = texture.source.ok_or_else(|| invalid(format!("{place}.source"), "an image", "none"))?;
        get_element(&self.document.images, source, &format!("{place}.source"))?;
        Ok(source)
    }

    fn decode(&self, image: usize) -> Result<Texture> {
        let within = |error: crate::error::Error| error.prefix_field(&format!("images[{image}]"));
        let encoded = self.bytes.image(image).map_err(within)?;
        let texture = Texture::decode(self.name(image), &encoded).map_err(within)?;
        self.bytes.charge_budget(texture.rgba().len() as u64).map_err(within)?;
        Ok(texture)
    }

    fn name(&self, index: usize) -> String {
        let image = &self.document.images[index];
        let uri = image.uri.as_deref().filter(|uri| !uri.starts_with("data:"));
        let name = image.name.as_deref().filter(|name| !name.is_empty()).or(uri);
        name.map_or_else(|| format!("image {index}"), |name| sanitize(name, 120))
    }
}
