//! Files to scenes.
//!
//! # What a scene is called
//! A built-in name (`tree`); a folder with `scene.toml` (its keys stand in `manifest`); a `.glb`, `.gltf` or `.obj` file;
//! or a folder with one such file. Several are refused, with their names. Beside an OBJ file its modes are found by their
//! names (`modes::beside`), and a plant's structure makes a plant of it.
//!
//! # Conventions
//! - Rows of U follow the `v` lines of an OBJ file, unreferenced and coincident ones included.
//! - Texture coordinates have (0, 0) at the top left of the image; OBJ's v is turned over.
//! - Colours in files are linear factors; images of colour are sRGB, normal maps are linear with +Y up.
//! - OBJ and glTF have Y up unless `scene.toml` says otherwise; plants have Z up. Units are metres unless it says otherwise.

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
