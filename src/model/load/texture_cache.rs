//! Cache of a scene's image files, each decoded once.

use std::collections::HashMap;

use super::asset_dir::{AssetDir, MAX_IMAGE_BYTES};
use crate::domain::Texture;
use crate::error::Result;

/// Textures by the name of their file.
#[derive(Debug, Default)]
pub(super) struct TextureCache {
    list: Vec<Texture>,
    by_name: HashMap<String, usize>,
}

impl TextureCache {
    /// The index of the texture in `path`, which is decoded on the first call.
    ///
    /// # Errors
    /// `Invalid` if the file does not exist or is not a PNG or JPEG image.
    pub(super) fn load(&mut self, files: &AssetDir, path: &str) -> Result<usize> {
        self.get_or_insert_with(path, || decode(files, path))
    }

    /// The index of the texture called `name`, which `make` creates on the first call.
    ///
    /// # Errors
    /// Those of `make`.
    pub(super) fn get_or_insert_with(&mut self, name: &str, make: impl FnOnce() -> Result<Texture>) -> Result<usize> {
        if let Some(index) = self.by_name.get(name) {
            return Ok(*index);
        }
        self.list.push(make()?);
        self.by_name.insert(name.to_owned(), self.list.len() - 1);
        Ok(self.list.len() - 1)
    }

    /// The textures loaded so far.
    pub(super) fn list(&self) -> &[Texture] {
        &self.list
    }

    /// Converts to the list of all textures.
    pub(super) fn into_textures(self) -> Vec<Texture> {
        self.list
    }
}

/// Decodes the image in `path`.
///
/// # Errors
/// As for [`TextureCache::load`].
pub(super) fn decode(files: &AssetDir, path: &str) -> Result<Texture> {
    Texture::decode(path, &files.read(path, MAX_IMAGE_BYTES)?)
}
