//! `scene.toml` to the parts of a scene: which models, where, on what, and what is changed about them.
//!
//! ```toml
//! name = "fern"              # else the folder's name
//! up = "y"                   # x, y or z; else the first model's
//! unit = 1.0                 # metres per unit of length; else the first model's
//! origin = [0.0, 0.0, 0.0]   # world position of the frame of all transforms, metres
//! transforms = "rigid"       # a promise that no step shears or scales; else "affine"
//! shadows = true             # false: no shadow map
//! ground = true              # false: no ground plane
//! look.sunlight = [1.0, 0.9, 0.8]       # and sun (direction), skylight, zenith, horizon
//! look.samples = 4           # or 1: samples a pixel
//! look.antialias = "samples" # or "fxaa", "none": one sample a pixel
//! look.transparency = "exact" # or "two-pass", with opaque_alpha; exact keeps as many fragments as look.fragments says
//! look.culling = "depth"     # or "none", "triangles": what is left out before it is drawn; the picture stays the same
//! look.raster = "opengl"      # or "cuda", "fastest": what turns triangles into samples
//! look.bloom = { threshold = 1.0, strength = 0.5, levels = 5 }   # light above the threshold glows
//! look.tone = "aces"         # or "reinhard", "none"; look.exposure = 1.2 multiplies all light before it
//! look.dither = true         # slow gradients show no bands
//! look.shadow = { method = "variance", size = 2048, blur = 2.0, splits = 1 }   # variance, standard, filtered; maps, 1 to 4
//!                            # and bleeding, least_variance, alpha_threshold, moments (f32, f16), fit (vertices,
//!                            # corners)
//! deform = { storage = "f16", normals = "exact", truncation = 1e-4 }   # f32, f16, bf16, int8; rigid, exact; metres
//! deform.batches = "never"   # or "always": whether domains that share a U are deformed together; else where it pays
//! deform.boxes = true        # keep a box of each domain for readers, and with displacements u = U q of each vertex
//!
//! model = "fern_02.glb"      # a scene of one model, or a [[domain]] for each of several
//! modes = "fern.npy"         # U of a model of one domain; "" for none
//! follows = "leaf"           # domains of the model called so, or "leaf ...", keep their place on what they hang on: no
//!                            # step names a transform of theirs; "" for all that hang on something
//! placement = { translation = [0, 0, 0], axis = [0, 1, 0], degrees = 90, scale = 2.0 }
//!
//! [material."*"]             # a material's name, or * for all; what is missing stays as the model has it
//! diffuse = [0.8, 0.1, 0.1]  # linear, 0 to 1; ambient follows unless it is given
//! specular = [0.2, 0.2, 0.2] # and shininess, alpha
//! colour_texture = "leaf.png"   # "" takes it away; normal_texture likewise
//! alpha_mode = "mask"        # opaque, mask or blend
//! cutoff = 0.5
//! double_sided = true
//!
//! [[domain]]                 # models that are named twice are instances: they share mesh and U
//! name = "branch"
//! model = "../branch.obj"
//! parent = "trunk"           # a domain of an earlier entry
//! frame = { translation = [0, 1, 0] }   # parent_from_model, instead of a placement
//! rows = [3, 4, 5]           # vertices of the parent that carry it; else the nearest eight of a deformable parent
//! material = { diffuse = [1, 0, 0] }    # for this entry only
//! ```

mod assemble;
mod patch;
mod placement;

use std::collections::BTreeMap;

use patch::Patch;
use placement::Placement;

use super::files::Files;
use crate::error::{Result, invalid};
use crate::scene::{Deformation, Look, Parts, UpAxis};

/// The name that makes a folder a scene.
pub(super) const FILE: &str = "scene.toml";
/// The most bytes of a `scene.toml`.
const MOST_BYTES: u64 = 1 << 20;

#[derive(Debug, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct Manifest {
    name: Option<String>,
    up: Option<UpAxis>,
    unit: Option<f64>,
    #[serde(default)]
    origin: [f64; 3],
    #[serde(default)]
    transforms: Transforms,
    look: Option<Look>,
    shadows: Option<bool>,
    ground: Option<bool>,
    #[serde(default)]
    deform: Deformation,
    #[serde(default)]
    material: BTreeMap<String, Patch>,
    model: Option<String>,
    modes: Option<String>,
    follows: Option<String>,
    placement: Option<Placement>,
    #[serde(default)]
    domain: Vec<Entry>,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
enum Transforms {
    Rigid,
    #[default]
    Affine,
}

/// One model in its place.
#[derive(Debug, Default, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    model: String,
    name: Option<String>,
    modes: Option<String>,
    /// The model's up axis, turned to the scene's.
    up: Option<UpAxis>,
    placement: Option<Placement>,
    parent: Option<String>,
    frame: Option<Placement>,
    rows: Option<Vec<u32>>,
    /// How the names begin of those domains that keep their place on what they hang on.
    follows: Option<String>,
    material: Option<Patch>,
    /// (rad/s)^2, one per mode; kept for clients.
    eigenvalues: Option<Vec<f64>>,
    /// Kept for clients.
    #[serde(default)]
    notes: BTreeMap<String, String>,
}

/// Reads the manifest `file` of the folder `files`; `own_name` is the scene's name unless it says another.
///
/// # Errors
/// `Invalid` naming the manifest and the line, or the entry, what was expected and what was given.
pub(super) fn read(files: &Files, file: &str, own_name: &str) -> Result<Parts> {
    let place = format!("file '{file}'");
    let bytes = files.read(file, MOST_BYTES)?;
    let mut manifest = parse(&bytes).map_err(|error| error.within(&place))?;
    let entries = entries(&mut manifest).map_err(|error| error.within(&place))?;
    assemble::assemble(files, &manifest, &entries, own_name).map_err(|error| error.within(&place))
}

fn parse(bytes: &[u8]) -> Result<Manifest> {
    let text = std::str::from_utf8(bytes).map_err(|error| invalid("text", "UTF-8", error))?;
    toml::from_str(text).map_err(|error: toml::de::Error| {
        let line = error.span().map_or(1, |span| 1 + text[..span.start].matches('\n').count());
        invalid(format!("line {line}"), "the keys and values of a scene", error.message())
    })
}

/// The entries; a `model` at the top is the only one.
fn entries(manifest: &mut Manifest) -> Result<Vec<Entry>> {
    let entries = std::mem::take(&mut manifest.domain);
    match (manifest.model.take(), entries.is_empty()) {
        (Some(model), true) => {
            let (modes, placement) = (manifest.modes.take(), manifest.placement.take());
            let follows = manifest.follows.take();
            Ok(vec![Entry { model, modes, placement, follows, ..Entry::default() }])
        }
        (Some(_), false) => Err(invalid("model", "either one model or [[domain]] entries", "both")),
        (None, true) => Err(invalid("model", "a model, or [[domain]] entries", "neither")),
        (None, false) if manifest.modes.is_some() || manifest.placement.is_some() || manifest.follows.is_some() => {
            Err(invalid("modes, placement, follows", "none beside [[domain]] entries, which have their own", "some"))
        }
        (None, false) => Ok(entries),
    }
}

#[cfg(test)]
mod tests;
