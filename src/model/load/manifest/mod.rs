//! Loader of `scene.toml`: which models a scene consists of, where they are placed and attached, and how their
//! materials and the scene's settings are overridden.
//!
//! ```toml
//! name = "fern"              # default: the name of the folder
//! up = "y"                   # x, y or z; default: up axis of the first model
//! unit = 1.0                 # meters per scene unit; default: unit of the first model
//! origin = [0.0, 0.0, 0.0]   # world position of the scene's origin, to which all transforms are relative; meters
//! transforms = "rigid"       # declares that no step shears or scales non-uniformly; default: "affine"
//! shadows = true             # false: no shadow map
//! ground = true              # false: no ground plane; look.ground.colour is its color
//! look.sunlight = [1.0, 0.9, 0.8]   # also sun (direction), skylight, zenith, horizon; linear colors
//! look.samples = 4           # samples per pixel, 1 or 4
//! look.antialias = "samples" # or "fxaa", "none", both with one sample per pixel
//! look.transparency = "exact"   # order-independent, with up to look.fragments blended fragments per frame;
//!                            # or "two-pass", with look.opaque_alpha
//! look.culling = "depth"     # or "none", "triangles", "fitting" (default); does not change the image
//! look.raster = "opengl"     # the rasterizer; or "cuda", "fastest"
//! look.bloom = { threshold = 1.0, strength = 0.5, levels = 5 }
//! look.tone = "aces"         # tone mapping; or "reinhard", "none"
//! look.exposure = 1.2        # multiplies all light before bloom and tone mapping
//! look.dither = true         # avoids banding in slow gradients
//! look.shadow = { method = "variance", size = 2048, blur = 2.0, splits = 1 }
//!                            # method: variance, standard, filtered; splits: number of cascades, 1 to 4;
//!                            # also bleeding, least_variance, alpha_threshold, moments (f32, f16),
//!                            # fit (vertices, corners)
//! deform.storage = "f16"     # type of the entries of U: f32 (default), f16, bf16, int8
//! deform.normals = "exact"   # or "rigid" (default)
//! deform.truncation = 1e-4   # skip modes that together move no vertex by more than this many meters
//! deform.compensated = true  # compensated summation of modes
//! deform.batches = "never"   # or "always", "auto" (default): whether domains that share U are deformed together
//! deform.boxes = true        # store a bounding box per domain for clients
//! deform.displacements = true   # store u = U q of every vertex for clients
//!
//! model = "fern_02.glb"      # a scene of one model; or several [[domain]] entries
//! modes = "fern.npy"         # U of a model with one shape; "" for none
//! follows = "leaf"           # name prefix of domains that move rigidly with their parents, so that steps cannot set
//!                            # their transforms; "" for all domains with a parent
//! placement = { translation = [0, 0, 0], axis = [0, 1, 0], degrees = 90, scale = 2.0 }
//!
//! [material."*"]             # overrides by material name, or * for all; missing keys keep the model's values
//! diffuse = [0.8, 0.1, 0.1]  # linear, 0 to 1; also sets ambient, unless ambient is given
//! specular = [0.2, 0.2, 0.2] # also shininess, alpha
//! colour_texture = "leaf.png"   # "" removes it; also normal_texture
//! alpha_mode = "mask"        # opaque, mask or blend
//! cutoff = 0.5
//! double_sided = true
//!
//! [[domain]]                 # entries with the same model are instances: they share mesh and U
//! name = "branch"
//! model = "../branch.obj"    # also modes, follows and placement, as above
//! up = "z"                   # up axis of the model; the model is rotated to the up axis of the scene
//! parent = "trunk"           # a domain of an earlier entry
//! frame = { translation = [0, 1, 0] }   # parent_from_model, instead of a placement
//! parent_vertices = [3, 4, 5]   # the vertices that carry it; default: the nearest eight of a deformable parent
//! material = { diffuse = [1, 0, 0] }    # overrides for this entry only
//! eigenvalues = [39.5]       # (rad/s)^2, one per mode of a single domain; stored for clients
//! notes = { source = "scan" }   # strings, stored for clients
//! ```

mod assemble;
mod patch;
mod placement;
mod settings;

use std::collections::BTreeMap;

use patch::MaterialPatch;
use placement::Placement;
use settings::{DeformKeys, LookKeys};

use super::SceneDescription;
use super::asset_dir::AssetDir;
use crate::error::{Result, invalid};
use crate::scene::UpAxis;

/// The file name of a manifest. A folder that contains it is a scene.
pub(super) const MANIFEST_FILE: &str = "scene.toml";
/// The largest size of a `scene.toml` in bytes.
const MAX_MANIFEST_BYTES: u64 = 64 << 20;

/// A parsed `scene.toml`. The documentation of this module describes its keys.
#[derive(Debug, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct Manifest {
    name: Option<String>,
    up: Option<UpAxis>,
    unit: Option<f64>,
    #[serde(default)]
    origin: [f64; 3],
    #[serde(default)]
    transforms: TransformKind,
    look: Option<LookKeys>,
    shadows: Option<bool>,
    ground: Option<bool>,
    #[serde(default)]
    deform: DeformKeys,
    #[serde(default)]
    material: BTreeMap<String, MaterialPatch>,
    model: Option<String>,
    modes: Option<String>,
    follows: Option<String>,
    placement: Option<Placement>,
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
    /// Up axis of the model. The model is rotated to the up axis of the scene.
    up: Option<UpAxis>,
    placement: Option<Placement>,
    parent: Option<String>,
    /// `parent_from_model`.
    frame: Option<Placement>,
    /// Vertices of the parent that carry the model.
    parent_vertices: Option<Vec<u32>>,
    /// Name prefix of the domains that move rigidly with their parent.
    follows: Option<String>,
    material: Option<MaterialPatch>,
    /// Eigenvalues in (rad/s)^2, one per mode; stored for clients.
    eigenvalues: Option<Vec<f64>>,
    /// Stored for clients.
    #[serde(default)]
    notes: BTreeMap<String, String>,
}

/// Reads the manifest `file` in the folder `files`. `default_name` is the name of a scene whose manifest has none.
///
/// # Errors
/// `Invalid` with the manifest, the line or entry, and the expected and given value.
pub(super) fn read(files: &AssetDir, file: &str, default_name: &str) -> Result<SceneDescription> {
    let location = format!("file '{file}'");
    let bytes = files.read(file, MAX_MANIFEST_BYTES)?;
    let mut manifest = parse(&bytes).map_err(|error| error.prefix_field(&location))?;
    let entries = take_entries(&mut manifest).map_err(|error| error.prefix_field(&location))?;
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
    match (manifest.model.take(), entries.is_empty()) {
        (Some(model), true) => {
            let (modes, placement) = (manifest.modes.take(), manifest.placement.take());
            let follows = manifest.follows.take();
            Ok(vec![DomainEntry { model, modes, placement, follows, ..DomainEntry::default() }])
        }
        (Some(_), false) => Err(invalid("model", "either one model or [[domain]] entries", "both of them")),
        (None, true) => Err(invalid("model", "one model or [[domain]] entries", "neither")),
        (None, false) if manifest.modes.is_some() || manifest.placement.is_some() || manifest.follows.is_some() => {
            Err(invalid("modes, placement, follows", "these keys in the [[domain]] entries", "a top-level key"))
        }
        (None, false) => Ok(entries),
    }
}

#[cfg(test)]
mod tests;
