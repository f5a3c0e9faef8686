//! Loader of `scene.toml`: which models a scene consists of, where they are placed and attached, and how their
//! materials and the scene's settings are overridden.
//!
#![doc = include_str!("README.md")]

mod assemble;
mod patch;
mod placement;
mod settings;

use std::collections::BTreeMap;

use patch::MaterialPatch;
use placement::Placement;
use settings::{DeformKeys, LookKeys};

use super::asset_dir::AssetDir;
use super::plant_materials::PlantMaterials;
use super::{LoadOptions, SceneDescription};
use crate::error::{Result, invalid};
use crate::scene::{LengthUnit, UpAxis};

/// The file name of a manifest. A folder that contains it is a scene.
pub(super) const MANIFEST_FILE: &str = "scene.toml";
/// The largest size of a `scene.toml` in bytes.
const MAX_MANIFEST_BYTES: u64 = 64 << 20;

/// A parsed `scene.toml`. `README.md` in the folder of this module describes its keys.
#[derive(Debug, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct Manifest {
    name: Option<String>,
    up: Option<UpAxis>,
    unit: Option<LengthUnit>,
    #[serde(default)]
    origin: [f64; 3],
    #[serde(default)]
    transforms: TransformKind,
    #[serde(default, deserialize_with = "settings::deserialize_look")]
    look: Option<LookKeys>,
    shadows: Option<bool>,
    ground: Option<bool>,
    ambient_occlusion: Option<bool>,
    #[serde(default)]
    deform: DeformKeys,
    #[serde(default)]
    material: BTreeMap<String, MaterialPatch>,
    /// In degrees, of all entries without a crease angle.
    crease_angle: Option<f64>,
    /// Elastic constants of all plants.
    #[serde(default)]
    plant: PlantMaterials,
    model: Option<String>,
    modes: Option<String>,
    follows: Option<String>,
    placement: Option<Placement>,
    eigenvalues: Option<Vec<f64>>,
    notes: Option<BTreeMap<String, String>>,
    /// As [`LoadOptions::is_strict`].
    #[serde(default)]
    strict: bool,
    #[serde(default)]
    domain: Vec<DomainEntry>,
}

/// The transforms that steps may contain.
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
enum TransformKind {
    Rigid,
    #[default]
    Affine,
}

/// A model and its placement: a `[[domain]]` table, or the top-level keys of a scene of one model.
#[derive(Debug, Default, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct DomainEntry {
    model: String,
    name: Option<String>,
    modes: Option<String>,
    /// In degrees.
    crease_angle: Option<f64>,
    /// Up axis of the model. The model is rotated to the up axis of the scene.
    up: Option<UpAxis>,
    placement: Option<Placement>,
    parent: Option<String>,
    /// `parent_from_model`.
    frame: Option<Placement>,
    /// Vertices of the parent that carry the model.
    parent_vertices: Option<Vec<u32>>,
    /// Prefix of names. The domains whose names start with it move rigidly with their parents.
    follows: Option<String>,
    material: Option<MaterialPatch>,
    /// Eigenvalues in (rad/s)^2, one per mode; stored for clients.
    eigenvalues: Option<Vec<f64>>,
    /// Stored for clients.
    #[serde(default)]
    notes: BTreeMap<String, String>,
}

/// Reads the manifest `file` in the folder `files`. `default_name` is the name of a scene whose manifest has none. The
/// unit, the up axis and the lighting of `options` replace those of the manifest.
///
/// # Errors
/// `Invalid` with the manifest, the line or entry, and the expected and given value.
pub(super) fn read(
    files: &AssetDir,
    file: &str,
    default_name: &str,
    options: &LoadOptions,
) -> Result<SceneDescription> {
    let location = format!("file '{file}'");
    let bytes = files.read(file, MAX_MANIFEST_BYTES)?;
    let mut manifest = parse(&bytes).map_err(|error| error.prefix_field(&location))?;
    (manifest.unit, manifest.up) = (options.unit.or(manifest.unit), options.up.or(manifest.up));
    if let Some(lighting) = options.lighting {
        manifest.look.get_or_insert_default().lighting = Some(lighting);
    }
    manifest.plant.check().map_err(|error| error.prefix_field(&location))?;
    let entries = take_entries(&mut manifest).map_err(|error| error.prefix_field(&location))?;
    let files = if manifest.strict { &files.strict() } else { files };
    assemble::assemble(files, &manifest, &entries, default_name).map_err(|error| error.prefix_field(&location))
}

fn parse(bytes: &[u8]) -> Result<Manifest> {
    let text = std::str::from_utf8(bytes).map_err(|error| invalid("text", "UTF-8", error))?;
    toml::from_str(text).map_err(|error: toml::de::Error| {
        let line = error.span().map_or(1, |span| 1 + text[..span.start].matches('\n').count());
        invalid(format!("line {line}"), "the keys and values of a scene", error.message())
    })
}

/// Takes the entries out of the manifest. A manifest with a top-level `model` has one entry.
fn take_entries(manifest: &mut Manifest) -> Result<Vec<DomainEntry>> {
    let entries = std::mem::take(&mut manifest.domain);
    let entry_keys = [
        ("modes", manifest.modes.is_some()),
        ("follows", manifest.follows.is_some()),
        ("placement", manifest.placement.is_some()),
        ("eigenvalues", manifest.eigenvalues.is_some()),
        ("notes", manifest.notes.is_some()),
    ];
    match (manifest.model.take(), entries.is_empty()) {
        (Some(model), true) => Ok(vec![DomainEntry {
            model,
            modes: manifest.modes.take(),
            placement: manifest.placement.take(),
            follows: manifest.follows.take(),
            eigenvalues: manifest.eigenvalues.take(),
            notes: manifest.notes.take().unwrap_or_default(),
            ..DomainEntry::default()
        }]),
        (Some(_), false) => Err(invalid("model", "either one model or [[domain]] entries", "both of them")),
        (None, true) => Err(invalid("model", "one model or [[domain]] entries", "neither")),
        (None, false) => match entry_keys.into_iter().find(|(_, is_given)| *is_given) {
            Some((key, _)) => Err(invalid(key, "this key in the [[domain]] entries", "a top-level key")),
            None => Ok(entries),
        },
    }
}

#[cfg(test)]
mod reference_tests;
#[cfg(test)]
mod tests;
