//! Files to scenes.

mod files;
mod gltf;
mod images;
mod manifest;
mod modes;
mod obj;
mod plant;
#[cfg(test)]
mod real;
mod repository;
mod source;
mod vega;

pub use modes::{Array, parse_numpy};
pub use repository::Repository;

use std::path::Path;
use std::sync::Arc;

use crate::error::Result;
use crate::scene::Scene;

/// Opens `SCENE` of the command line: a built-in name, a folder with `scene.toml`, a `.glb`, `.gltf` or `.obj` file, or
/// a folder with one recognisable model. Paths are taken as they are.
///
/// # Errors
/// `NotFound` when nothing of that name is there; `Invalid` naming file, field, expected and given otherwise.
pub fn open(source: &str) -> Result<Arc<Scene>> {
    Scene::new(source::read(&files::Files::anywhere(Path::new(".")), source)?)
}
