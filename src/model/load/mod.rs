//! Loaders: from files to scenes.
//!
//! # Scene names
//! A scene is a built-in name (`tree`), a folder with `scene.toml`, a `.glb`, `.gltf`, `.obj`, `.ply`, `.stl`, `.npz`
//! or `.structure.json` file, or a folder with one such file. A folder with several is rejected with an error that
//! lists them.
//!
//! `manifest/README.md` is the reference: keys of `scene.toml`, models, and the names of mode files beside a model. An
//! OBJ file is loaded as a plant if its folder also contains the two files with the structure of the plant (module
//! `plant`). The structure alone is a plant with generated meshes.
//!
//! # Conventions
//! - Rows of U follow the `v` lines of an OBJ file, including unreferenced and coincident vertices.
//! - Texture coordinates have (0, 0) at the top left of the image; OBJ's v is flipped.
//! - Colors in files are linear factors. Color images are sRGB; normal maps are linear with +Y up.
//! - OBJ and glTF have Y up; plants, PLY, STL and NumPy archives have Z up; units are meters. `scene.toml` can override
//!   these defaults, and [`LoadOptions`] override both. A remark names the size of a scene that is implausible in meters,
//!   if neither the format nor the user gives the unit.
//! - Normals of a file are kept. Missing normals are smooth except along creases, which split the corners of a vertex
//!   but not the vertex itself (module `domain::creases`).
//! - Positions are read as f64. A mesh that is far from the origin of its file, in terms of its own size, is centered
//!   before its positions are rounded to f32 ([`crate::domain::Shape::origin`]). Creases and normals are computed after
//!   that.
//! - Vertices that no face uses are kept, because the rows of U include them, but bounds, ground and cameras
//!   ignore them.
//! - Values out of range: module `values` has the table that all formats share.
//! - An image or material library that does not exist or is outside of the folder of the scene, and an image that is no
//!   PNG, JPEG or WebP image, are replaced by a default with a remark. In strict mode, they are errors. The folder of the
//!   scene is that of `scene.toml` or, without one or for a model elsewhere, that of the model
//!   (`find_referenced` of the module `asset_dir`).

mod asset_dir;
mod conversion;
#[cfg(test)]
mod dataset_tests;
#[cfg(test)]
mod far_tests;
mod file_hashes;
mod folder_listing;
mod gltf;
#[cfg(test)]
mod image_path_tests;
mod manifest;
mod modes;
mod npz_model;
mod obj;
mod plant;
mod plant_materials;
mod ply;
mod polygons;
mod repository;
mod size;
mod source;
mod stl;
mod surface;
mod text;
mod texture_cache;
mod values;
mod vega_config;

pub use conversion::is_volume_mesh;
pub use file_hashes::FileHashes;
pub use modes::{NpyArray, parse_numpy};
pub use repository::SceneRepository;
pub use source::is_built_in;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use asset_dir::{AssetDir, ReferencedFile};

use crate::backend_settings::BackendSettings;
use crate::error::Result;
use crate::scene::{LengthUnit, Lighting, LookPreset, PresetRequest, RenderSettings, Scene, SceneParts, UpAxis};

/// How the files of a scene are read.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct LoadOptions {
    /// Whether missing files and definitions, images of other formats, and values out of range, not finite or not understood are
    /// errors instead of remarks.
    pub is_strict: bool,
    /// Replaces the unit of the file format or of `scene.toml`.
    pub unit: Option<LengthUnit>,
    /// Replaces the up axis of the file format or of `scene.toml`.
    pub up: Option<UpAxis>,
    /// Replaces the lighting of the model or of `scene.toml`.
    pub lighting: Option<Lighting>,
}

impl LoadOptions {
    /// The folder from which the loaders read.
    fn apply_to_folder(&self, files: &AssetDir) -> AssetDir {
        if self.is_strict { files.strict() } else { files.clone() }
    }

    /// Sets the unit, the up axis and the lighting of a model that is opened without `scene.toml`.
    fn apply_to_model(&self, parts: &mut SceneParts) {
        parts.unit = self.unit.map(LengthUnit::meters).or(parts.unit);
        parts.up = self.up.unwrap_or(parts.up);
        if let Some(lighting) = self.lighting.filter(|lighting| *lighting != parts.look.lighting) {
            parts.look = lighting.settings();
        }
    }
}

/// A scene that was opened by name or path, with its backend settings.
#[derive(Debug, Clone)]
pub struct OpenedScene {
    pub scene: Arc<Scene>,
    /// Read from `scene.toml`; the defaults for scenes without one.
    pub backends: BackendSettings,
}

impl OpenedScene {
    /// # Errors
    /// Those of [`Scene::new`].
    fn new(SceneDescription { parts, backends }: SceneDescription) -> Result<Self> {
        let is_unit_known = parts.unit.is_some();
        let mut scene = Scene::new(parts)?;
        // A new scene is not shared.
        if let Some(scene) = Arc::get_mut(&mut scene).filter(|_| !is_unit_known) {
            let remark = size::implausible_size(scene);
            scene.remarks.extend(remark);
        }
        Ok(Self { scene, backends })
    }
}

impl From<Arc<Scene>> for OpenedScene {
    /// A scene with the default settings of the backends.
    fn from(scene: Arc<Scene>) -> Self {
        Self { scene, backends: BackendSettings::default() }
    }
}

/// The content of a scene's files, not yet validated.
#[derive(Debug)]
struct SceneDescription {
    parts: SceneParts,
    backends: BackendSettings,
}

impl From<SceneParts> for SceneDescription {
    /// A scene with the default settings of the backends, whose antialiasing and shadow map are left to the renderer.
    fn from(mut parts: SceneParts) -> Self {
        parts.look = parts.look.with_preset(PresetRequest::default());
        Self { parts, backends: BackendSettings::default() }
    }
}

/// Opens `SCENE` of the command line: a built-in name, a folder with `scene.toml`, a model file, or a folder with one
/// model. Paths are not confined to a root.
///
/// # Errors
/// `NotFound` if nothing has this name; otherwise `Invalid` with the file, the field, and the expected and given value.
pub fn open(source: &str) -> Result<OpenedScene> {
    open_with(source, &LoadOptions::default())
}

/// As [`open`], with options.
///
/// # Errors
/// As for [`open`]; in strict mode, also for content that otherwise causes a remark.
pub fn open_with(source: &str, options: &LoadOptions) -> Result<OpenedScene> {
    OpenedScene::new(source::read(&working_folder(), source, options)?)
}

/// The folder to which paths on the command line are relative.
fn working_folder() -> AssetDir {
    AssetDir::unrestricted(Path::new("."))
}

/// As [`open_with`], for a still picture: `preset` replaces the scene's own preset. A scene without a preset is drawn as by
/// a GPU on every machine, because the time of a single picture does not matter. Settings of antialiasing and shadow
/// map in `scene.toml` win over both.
///
/// # Errors
/// As for [`open_with`].
pub fn open_for_still(source: &str, preset: Option<LookPreset>, options: &LoadOptions) -> Result<OpenedScene> {
    let mut description = source::read(&working_folder(), source, options)?;
    let look = &mut description.parts.look;
    let request = look.preset.unwrap_or_default();
    let preset = preset.or(request.preset);
    let resolved = look.with_preset(PresetRequest { preset, ..request });
    // Without a request, the settings for a GPU are final.
    *look = RenderSettings { preset: preset.and(resolved.preset), ..resolved };
    OpenedScene::new(description)
}

/// As [`open_with`] for a model file, but without modes: neither those of the file nor those of a file beside it are
/// read. There is no remark on the size.
///
/// # Errors
/// As for [`open_with`].
pub fn open_without_modes(source: &str, options: &LoadOptions) -> Result<Arc<Scene>> {
    let model_options = surface::ModelOptions { modes: surface::ModesSource::None, ..Default::default() };
    let mut parts = source::read_model(&options.apply_to_folder(&working_folder()), source, model_options)?;
    options.apply_to_model(&mut parts);
    Scene::new(parts)
}

/// The file that the loaders read for a reference of a model file in `folder` to an image or a material library
/// (`find_referenced` of the module `asset_dir`); `None` if there is none.
pub fn find_referenced_file(folder: &Path, reference: &str) -> Option<PathBuf> {
    match AssetDir::unrestricted(folder).locate(reference) {
        ReferencedFile::Exact(path) | ReferencedFile::Similar { path, .. } => Some(folder.join(path)),
        ReferencedFile::Missing { .. } => None,
    }
}

/// The files with the modes of a scene, each with its number of columns: `FILE (r = 20)`, without repetitions, in the
/// order of the domains. Modes that are not in a file of their own, such as morph targets, are not listed.
pub fn modes_files(scene: &Scene) -> Vec<String> {
    let mut files = Vec::new();
    for domain in &scene.domains {
        let rank = scene.shapes[domain.shape].modes.rank();
        let file = domain.metadata.notes.get(modes::FILE_NOTE);
        if let Some(line) = file.map(|file| format!("{file} (r = {rank})"))
            && !files.contains(&line)
        {
            files.push(line);
        }
    }
    files
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::RendererKind;

    #[test]
    fn still_pictures_are_drawn_as_by_a_gpu_unless_a_preset_is_set() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        std::fs::write(folder.path().join("a.obj"), "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").expect("a writable file");
        let look_of = |manifest: &str, preset: Option<LookPreset>| {
            let path = folder.path().join("scene.toml");
            std::fs::write(&path, format!("model = 'a.obj'\n{manifest}")).expect("a writable file");
            open_for_still(&path.to_string_lossy(), preset, &LoadOptions::default()).expect("a scene").scene.look
        };
        let preset_of = |manifest: &str, preset| look_of(manifest, preset).preset.and_then(|request| request.preset);
        assert_eq!(preset_of("look = 'preview'\n", None), Some(LookPreset::Preview));
        assert_eq!(preset_of("look = 'preview'\n", Some(LookPreset::Best)), Some(LookPreset::Best));
        assert_eq!(preset_of("", Some(LookPreset::Standard)), Some(LookPreset::Standard));
        let by_rule = open(&folder.path().join("a.obj").to_string_lossy()).expect("a scene").scene.look;
        let (software, hardware) = (RendererKind::Software, RendererKind::Hardware);
        for (manifest, samples) in [("", 4), ("look.samples = 1\n", 1)] {
            let still = look_of(manifest, None);
            assert_eq!(still.frame_antialiasing(software, 1 << 20, 1 << 20, None).samples, samples, "{manifest}");
            let shadow = still.with_shadow_map_for(software).shadow;
            assert_eq!(shadow, by_rule.with_shadow_map_for(hardware).shadow, "{manifest}");
            assert_ne!(shadow, by_rule.with_shadow_map_for(software).shadow, "control: the rule differs on a CPU");
        }
    }

    /// Negative control: a file with materials of its own.
    #[test]
    fn models_without_materials_are_in_a_studio() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).expect("a writable file");
        write("red.mtl", "newmtl red\nKd 1 0 0\n");
        let triangle = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n";
        write("plain.obj", triangle);
        write("undefined.obj", &format!("usemtl red\n{triangle}"));
        let red = |x: u32, y: u32| format!("v {x} {y} 0 1 0 0\n");
        write("uniform.obj", &format!("{}{}{}f 1 2 3\n", red(0, 0), red(1, 0), red(0, 1)));
        write("tinted.obj", "v 0 0 0 1 0 0\nv 1 0 0 0 1 0\nv 0 1 0 0 0 1\nf 1 2 3\n");
        write("red.obj", &format!("mtllib red.mtl\nusemtl red\n{triangle}"));
        write("part.stl", "solid\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendsolid\n");
        let header = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n";
        let colors = "property uchar red\nproperty uchar green\nproperty uchar blue\n";
        let faces = "element face 1\nproperty list uchar int vertex_indices\nend_header\n";
        write("scan.ply", &format!("{header}{colors}{faces}0 0 0 9 9 9\n1 0 0 9 9 9\n0 1 0 9 9 9\n3 0 1 2\n"));
        let manifest = |entries: &[&str], rest: &str| {
            let entries = entries.iter().map(|entry| format!("[[domain]]\nmodel = '{entry}'\n"));
            write("scene.toml", &format!("{rest}{}", entries.collect::<String>()));
            "scene.toml"
        };
        let lighting_of = |name: &str, lighting: Option<Lighting>| {
            let path = if is_built_in(name) { name.into() } else { folder.path().join(name) };
            let path = path.to_string_lossy();
            let options = LoadOptions { lighting, ..LoadOptions::default() };
            open_with(&path, &options).unwrap_or_else(|error| panic!("{name}: {error}")).scene.look.lighting
        };
        for name in ["plain.obj", "undefined.obj", "uniform.obj", "tinted.obj", "part.stl", "scan.ply"] {
            assert_eq!(lighting_of(name, None), Lighting::Studio, "{name}");
            assert_eq!(lighting_of(name, Some(Lighting::Outdoor)), Lighting::Outdoor, "{name} with an option");
        }
        assert_eq!(lighting_of("red.obj", None), Lighting::Outdoor, "control");
        assert_eq!(lighting_of("red.obj", Some(Lighting::Studio)), Lighting::Studio);
        assert_eq!(lighting_of("tree", None), Lighting::Outdoor);
        for (entries, rest, expected) in [
            (&["part.stl", "plain.obj"][..], "", Lighting::Studio),
            (&["part.stl", "red.obj"], "", Lighting::Outdoor),
            (&["red.obj", "part.stl"], "", Lighting::Outdoor),
            (&["part.stl", "tree"], "", Lighting::Outdoor),
            (&["part.stl"], "look.lighting = 'outdoor'\n", Lighting::Outdoor),
            (&["red.obj"], "look = { lighting = 'studio', exposure = 2 }\n", Lighting::Studio),
        ] {
            assert_eq!(lighting_of(manifest(entries, rest), None), expected, "{entries:?} {rest}");
            assert_eq!(lighting_of("scene.toml", Some(Lighting::Studio)), Lighting::Studio, "{entries:?} {rest}");
        }
    }
}
