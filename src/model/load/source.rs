//! Resolves a SCENE argument: a built-in name, a folder with `scene.toml`, a model file, or a folder with one model.

use super::asset_dir::{AssetDir, EntryKind, extension_of, file_name_of, parent_of, stem_of};
use super::conversion::model_hint;
use super::modes::computed_modes_remark;
use super::surface::{ModelOptions, ModesSource};
use super::{LoadOptions, SceneDescription, gltf, manifest, npz_model, obj, plant, ply, stl};
use crate::error::{Error, Result, invalid};
use crate::scene::SceneParts;

/// Names of procedural scenes. A folder with such a name can be opened as `./NAME`.
pub(super) const BUILT_IN: [&str; 1] = ["tree"];

/// Whether a scene name denotes a built-in scene, even if a folder has the same name.
pub fn is_built_in(source: &str) -> bool {
    BUILT_IN.contains(&source)
}

/// A model in a folder: the name of its main file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum ModelFile {
    Gltf(String),
    Obj(String),
    /// `STEM.obj`, to which `STEM.structure.json` and `STEM_object_id.dat` belong.
    Plant(String),
    Ply(String),
    Stl(String),
    /// A NumPy archive with the arrays `vertices` and `faces`.
    Npz(String),
    /// `STEM.structure.json`: the structure of a plant without an OBJ file.
    Skeleton(String),
}

impl ModelFile {
    /// The name of the main file.
    pub(super) fn name(&self) -> &str {
        match self {
            Self::Gltf(name)
            | Self::Obj(name)
            | Self::Plant(name)
            | Self::Ply(name)
            | Self::Stl(name)
            | Self::Npz(name)
            | Self::Skeleton(name) => name,
        }
    }

    /// Only the models of the smallest rank in a folder are used, because exporters write meshes of the other formats
    /// beside a model with materials.
    const fn format_rank(&self) -> usize {
        match self {
            Self::Gltf(_) | Self::Obj(_) | Self::Plant(_) => 0,
            Self::Ply(_) => 1,
            Self::Stl(_) => 2,
            Self::Npz(_) => 3,
            Self::Skeleton(_) => 4,
        }
    }
}

/// The formats in error messages.
const FORMATS: &str = ".glb, .gltf, .obj, .ply, .stl, .npz or .structure.json";

/// The largest number of names in an error message.
const MAX_LISTED_NAMES: usize = 16;

/// Reads a scene of any kind. Only `scene.toml` contains backend settings; other scenes have the defaults. Without
/// `scene.toml` and an option, the unit and the up axis are those of the model.
///
/// # Errors
/// `NotFound` if nothing has this name; otherwise `Invalid` with the file, the field, and the expected and given value.
pub(super) fn read(files: &AssetDir, source: &str, options: &LoadOptions) -> Result<SceneDescription> {
    let files = &options.apply_to_folder(files);
    let read_single_model = || -> Result<SceneDescription> {
        let mut parts = read_model(files, source, ModelOptions::default())?;
        options.apply_to_model(&mut parts);
        Ok(parts.into())
    };
    if is_built_in(source) {
        return read_single_model();
    }
    match files.kind(source)? {
        None => Err(Error::NotFound { what: "scene", given: source.into() }),
        Some(EntryKind::File) if source.ends_with(".toml") => {
            let folder = parent_of(source);
            let name = files.resolved_name(folder);
            manifest::read(&files.within_scene(folder)?, file_name_of(source), &name, options)
        }
        Some(EntryKind::Directory) => {
            let folder = files.within_scene(source)?;
            match folder.kind(manifest::MANIFEST_FILE)? {
                Some(EntryKind::File) => {
                    manifest::read(&folder, manifest::MANIFEST_FILE, &files.resolved_name(source), options)
                }
                _ => read_single_model(),
            }
        }
        Some(EntryKind::File) => read_single_model(),
    }
}

/// Generates the only scene in [`BUILT_IN`].
fn built_in() -> Result<SceneParts> {
    crate::tree::generate(&crate::tree::TreeParameters::default())
}

/// Reads one model: a file, a folder with exactly one recognized model, or a built-in name, which ignores the options.
///
/// # Errors
/// `Invalid` with the file, the field, and the expected and given value.
pub(super) fn read_model(files: &AssetDir, path: &str, options: ModelOptions) -> Result<SceneParts> {
    if is_built_in(path) {
        return built_in();
    }
    match files.kind(path)? {
        Some(EntryKind::Directory) => {
            let folder = files.within_scene(path)?;
            let model = choose_single_model(&folder, path)?;
            let mut parts = read_model_file(&folder, &model, options)?;
            parts.name = files.resolved_name(path);
            Ok(parts)
        }
        Some(EntryKind::File) => {
            let folder = files.within_scene(parent_of(path))?;
            let file_name = file_name_of(path);
            let given = || format!("{file_name}{}", model_hint(file_name));
            let model = recognize_model(file_name)
                .ok_or_else(|| invalid(format!("file '{path}'"), format!("a file ending in {FORMATS}"), given()))?;
            read_model_file(&folder, &detect_plant(&folder, model), options)
        }
        None => Err(invalid(format!("file '{path}'"), "an existing model", "no file of this name")),
    }
}

fn read_model_file(folder: &AssetDir, model: &ModelFile, options: ModelOptions) -> Result<SceneParts> {
    let mut parts = match model {
        ModelFile::Gltf(name) => gltf::read(folder, name, options.crease_angle),
        ModelFile::Obj(name) => obj::read(folder, name, options),
        ModelFile::Plant(name) => plant::read(folder, name, options),
        ModelFile::Ply(name) => ply::read(folder, name, options),
        ModelFile::Stl(name) => stl::read(folder, name, options),
        ModelFile::Npz(name) => npz_model::read(folder, name, options),
        ModelFile::Skeleton(name) => plant::read_skeleton(folder, name, options),
    }?;
    let is_rigid = parts.shapes.iter().all(|shape| shape.modes.rank() == 0);
    if is_rigid && options.modes == ModesSource::Sidecar {
        parts.remarks.extend(computed_modes_remark(folder, model.name()));
    }
    Ok(parts)
}

/// Recognizes a model by the extension of its main file `name`.
pub(super) fn recognize_model(name: &str) -> Option<ModelFile> {
    match extension_of(name).as_str() {
        "glb" | "gltf" => Some(ModelFile::Gltf(name.into())),
        "obj" => Some(ModelFile::Obj(name.into())),
        "ply" => Some(ModelFile::Ply(name.into())),
        "stl" => Some(ModelFile::Stl(name.into())),
        "npz" => Some(ModelFile::Npz(name.into())),
        "json" if is_structure(name) => Some(ModelFile::Skeleton(name.into())),
        _ => None,
    }
}

/// Whether a file name is `STEM.structure.json`, in any letter case.
fn is_structure(name: &str) -> bool {
    let start = name.len().checked_sub(plant::STRUCTURE_SUFFIX.len());
    let suffix = start.filter(|start| *start > 0).and_then(|start| name.get(start..));
    suffix.is_some_and(|suffix| suffix.eq_ignore_ascii_case(plant::STRUCTURE_SUFFIX))
}

/// As [`recognize_model`], but only for a NumPy archive that contains a mesh, because most archives contain other
/// arrays, and only for a structure without an OBJ file beside it.
pub(super) fn find_model(folder: &AssetDir, name: &str) -> Option<ModelFile> {
    recognize_model(name).filter(|model| match model {
        ModelFile::Npz(_) => npz_model::is_model(folder, name),
        ModelFile::Skeleton(_) => {
            let stem = &name[..name.len() - plant::STRUCTURE_SUFFIX.len()];
            !folder.has_file(&format!("{stem}.obj"))
        }
        _ => true,
    })
}

/// The models of a folder: its glTF and OBJ files; if there is none, its PLY files, else its STL files, else its NumPy
/// archives with a mesh, else its structures of plants.
pub(super) fn find_models(folder: &AssetDir) -> Vec<ModelFile> {
    let mut models: Vec<ModelFile> = folder.listing().file_names().filter_map(recognize_model).collect();
    let rank = models.iter().map(ModelFile::format_rank).min();
    models.retain(|model| Some(model.format_rank()) == rank && find_model(folder, model.name()).is_some());
    models.into_iter().map(|model| detect_plant(folder, model)).collect()
}

/// Changes an OBJ file to a plant if both files of the plant's structure are in its folder.
fn detect_plant(folder: &AssetDir, model: ModelFile) -> ModelFile {
    let ModelFile::Obj(name) = &model else { return model };
    let stem = stem_of(name);
    let structure_files = [format!("{stem}.structure.json"), format!("{stem}_object_id.dat")];
    match structure_files.iter().all(|name| folder.has_file(name)) {
        true => ModelFile::Plant(name.clone()),
        false => model,
    }
}

fn choose_single_model(folder: &AssetDir, path: &str) -> Result<ModelFile> {
    let mut models = find_models(folder);
    let join_names = |names: Vec<String>| names.into_iter().take(MAX_LISTED_NAMES).collect::<Vec<_>>().join(", ");
    let field = format!("folder '{path}'");
    let expected = format!("scene.toml or one {FORMATS} file");
    match models.len() {
        1 => Ok(models.remove(0)),
        0 => {
            // The record of an upload is a hidden file.
            let listing = folder.listing();
            let entries = listing.entries().iter().filter(|(name, _)| !name.starts_with('.'));
            let names: Vec<String> = entries.map(|(name, _)| name.clone()).collect();
            let hint = names.iter().map(|name| model_hint(name)).find(|hint| !hint.is_empty()).unwrap_or_default();
            Err(invalid(field, expected, format!("no model among: {}{hint}", join_names(names))))
        }
        model_count => {
            let name = |model: ModelFile| match model {
                ModelFile::Plant(name) => format!("{name} (a plant)"),
                other => other.name().to_owned(),
            };
            let given = join_names(models.into_iter().map(name).collect());
            Err(invalid(field, expected, format!("{model_count}: {given}")))
        }
    }
}
