//! Resolves a SCENE argument: a built-in name, a folder with `scene.toml`, a model file, or a folder with one model.

use super::asset_dir::{AssetDir, EntryKind, file_name_of, parent_of};
use super::obj::ModesSource;
use super::{SceneDescription, gltf, manifest, obj, plant};
use crate::error::{Error, Result, invalid};
use crate::scene::SceneParts;

/// Names of procedural scenes. A folder with such a name can be opened as `./NAME`.
pub(super) const BUILT_IN: [&str; 1] = ["tree"];

/// A model in a folder: the name of its file or, for a plant, the common stem of its files.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum ModelFile {
    Gltf(String),
    Obj(String),
    /// `STEM.obj`, `STEM.structure.json` and `STEM_object_id.dat`.
    Plant(String),
}

/// The largest number of names in an error message.
const MAX_LISTED_NAMES: usize = 16;

/// Reads a scene of any kind. Only `scene.toml` contains backend settings; other scenes have the defaults.
///
/// # Errors
/// `NotFound` if nothing has this name; otherwise `Invalid` with the file, the field, and the expected and given value.
pub(super) fn read(files: &AssetDir, source: &str) -> Result<SceneDescription> {
    if BUILT_IN.contains(&source) {
        return crate::tree::generate(&crate::tree::TreeParameters::default()).map(SceneDescription::from);
    }
    match files.kind(source)? {
        None => Err(Error::NotFound { what: "scene", given: source.into() }),
        Some(EntryKind::File) if source.ends_with(".toml") => {
            let folder = parent_of(source);
            manifest::read(&files.within(folder)?, file_name_of(source), &files.resolved_name(folder))
        }
        Some(EntryKind::Directory) => {
            let folder = files.within(source)?;
            match folder.kind(manifest::MANIFEST_FILE)? {
                Some(EntryKind::File) => manifest::read(&folder, manifest::MANIFEST_FILE, &files.resolved_name(source)),
                _ => read_model(files, source, ModesSource::Sidecar).map(SceneDescription::from),
            }
        }
        Some(EntryKind::File) => read_model(files, source, ModesSource::Sidecar).map(SceneDescription::from),
    }
}

/// Reads one model: a file, or a folder with exactly one recognized model.
///
/// # Errors
/// `Invalid` with the file, the field, and the expected and given value.
pub(super) fn read_model(files: &AssetDir, path: &str, modes: ModesSource) -> Result<SceneParts> {
    match files.kind(path)? {
        Some(EntryKind::Directory) => {
            let folder = files.within(path)?;
            let mut parts = read_model_file(&folder, &choose_single_model(&folder, path)?, modes)?;
            parts.name = files.resolved_name(path);
            Ok(parts)
        }
        Some(EntryKind::File) => {
            let folder = files.within(parent_of(path))?;
            let file_name = file_name_of(path);
            let model = recognize_model(file_name)
                .ok_or_else(|| invalid(format!("file '{path}'"), "a file ending in .glb, .gltf or .obj", file_name))?;
            let model = detect_plant(model, &file_names(&folder));
            read_model_file(&folder, &model, modes)
        }
        None => Err(invalid(format!("file '{path}'"), "an existing model", "no file of this name")),
    }
}

fn read_model_file(folder: &AssetDir, model: &ModelFile, modes: ModesSource) -> Result<SceneParts> {
    match model {
        ModelFile::Gltf(name) => gltf::read(folder, name),
        ModelFile::Obj(name) => obj::read(folder, name, modes),
        ModelFile::Plant(stem) => plant::read(folder, stem),
    }
}

/// Recognizes a model by the extension of its main file `name`.
pub(super) fn recognize_model(name: &str) -> Option<ModelFile> {
    match name.rsplit_once('.')?.1.to_ascii_lowercase().as_str() {
        "glb" | "gltf" => Some(ModelFile::Gltf(name.into())),
        "obj" => Some(ModelFile::Obj(name.into())),
        _ => None,
    }
}

/// All models in a folder.
pub(super) fn find_models(folder: &AssetDir) -> Vec<ModelFile> {
    let names = file_names(folder);
    names.iter().filter_map(|name| recognize_model(name)).map(|model| detect_plant(model, &names)).collect()
}

/// Changes an OBJ file to a plant if both files of the plant's structure are among the `names` of its folder.
fn detect_plant(model: ModelFile, names: &[String]) -> ModelFile {
    let stem = match &model {
        ModelFile::Obj(name) => name.strip_suffix(".obj"),
        _ => None,
    };
    let is_plant = |stem: &&str| {
        let structure_files = [format!("{stem}.structure.json"), format!("{stem}_object_id.dat")];
        structure_files.iter().all(|name| names.contains(name))
    };
    stem.filter(is_plant).map(|stem| ModelFile::Plant(stem.into())).unwrap_or(model)
}

/// Names of the files in a folder.
fn file_names(folder: &AssetDir) -> Vec<String> {
    folder.entries().into_iter().filter(|(_, kind)| *kind == EntryKind::File).map(|(name, _)| name).collect()
}

fn choose_single_model(folder: &AssetDir, path: &str) -> Result<ModelFile> {
    let mut models = find_models(folder);
    let join_names = |names: Vec<String>| names.into_iter().take(MAX_LISTED_NAMES).collect::<Vec<_>>().join(", ");
    let field = format!("folder '{path}'");
    let expected = "scene.toml or one .glb, .gltf or .obj file";
    match models.len() {
        1 => Ok(models.remove(0)),
        0 => {
            let given = join_names(folder.entries().into_iter().map(|(name, _)| name).collect());
            Err(invalid(field, expected, format!("no model among: {given}")))
        }
        model_count => {
            let name = |model| match model {
                ModelFile::Gltf(name) | ModelFile::Obj(name) => name,
                ModelFile::Plant(stem) => format!("{stem} (a plant)"),
            };
            let given = join_names(models.into_iter().map(name).collect());
            Err(invalid(field, expected, format!("{model_count}: {given}")))
        }
    }
}
