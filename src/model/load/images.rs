//! Image files to the textures of a scene, each file once.

use std::collections::HashMap;

use super::files::{Files, IMAGE_BYTES};
use crate::domain::Texture;
use crate::error::Result;

/// Textures by the name of their file.
#[derive(Debug, Default)]
pub(super) struct Images {
    list: Vec<Texture>,
    by_name: HashMap<String, usize>,
}

impl Images {
    /// Index of the texture in `path`, read at the first call.
    ///
    /// # Errors
    /// `Invalid` when the file is not there or no PNG or JPEG image.
    pub(super) fn load(&mut self, files: &Files, path: &str) -> Result<usize> {
        self.made(path, || decode(files, path))
    }

    /// Index of the texture called `name`, made at the first call.
    ///
    /// # Errors
    /// As `make`.
    pub(super) fn made(&mut self, name: &str, make: impl FnOnce() -> Result<Texture>) -> Result<usize> {
        if let Some(index) = self.by_name.get(name) {
            return Ok(*index);
        }
        self.list.push(make()?);
        self.by_name.insert(name.to_owned(), self.list.len() - 1);
        Ok(self.list.len() - 1)
    }

    /// The textures so far.
    pub(super) fn list(&self) -> &[Texture] {
        &self.list
    }

    /// All textures.
    pub(super) fn into_list(self) -> Vec<Texture> {
        self.list
    }
}

/// The image in `path`.
///
/// # Errors
/// As [`Images::load`].
pub(super) fn decode(files: &Files, path: &str) -> Result<Texture> {
    Texture::decode(path, &files.read(path, IMAGE_BYTES)?)
}
