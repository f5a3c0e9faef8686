//! Cache of a scene's image files, each decoded once.

use std::collections::HashMap;
use std::path::PathBuf;

use super::asset_dir::{AssetDir, MAX_IMAGE_BYTES};
use crate::domain::Texture;
use crate::error::Result;

/// The textures of a scene and their indices by folder and name.
#[derive(Debug, Default)]
pub(super) struct TextureCache {
    textures: Vec<Texture>,
    index_by_name: HashMap<(PathBuf, String), usize>,
}

impl TextureCache {
    /// Returns the index of the texture in the file `path`. The first call for a file decodes it.
    ///
    /// # Errors
    /// `Invalid` if the file does not exist or is not a PNG, JPEG or WebP image.
    pub(super) fn load(&mut self, files: &AssetDir, path: &str) -> Result<usize> {
        self.get_or_insert_with(files, path, || decode(files, path))
    }

    /// Returns the index of the texture called `name` in the folder `files`. The first call for a name creates the texture
    /// with `create`.
    ///
    /// # Errors
    /// Those of `create`.
    pub(super) fn get_or_insert_with(
        &mut self,
        files: &AssetDir,
        name: &str,
        create: impl FnOnce() -> Result<Texture>,
    ) -> Result<usize> {
        let key = (files.folder().to_owned(), name.to_owned());
        if let Some(index) = self.index_by_name.get(&key) {
            return Ok(*index);
        }
        self.textures.push(create()?);
        self.index_by_name.insert(key, self.textures.len() - 1);
        Ok(self.textures.len() - 1)
    }

    /// All textures so far.
    pub(super) fn textures(&self) -> &[Texture] {
        &self.textures
    }

    /// Converts to the list of all textures.
    pub(super) fn into_textures(self) -> Vec<Texture> {
        self.textures
    }
}

/// Decodes the image in `path`.
///
/// # Errors
/// As for [`TextureCache::load`].
pub(super) fn decode(files: &AssetDir, path: &str) -> Result<Texture> {
    Texture::decode(path, &files.read(path, MAX_IMAGE_BYTES)?, files.memory())
}
