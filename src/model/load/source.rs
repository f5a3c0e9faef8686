//! Resolves a SCENE argument: a built-in name, a folder with `scene.toml`, a model file, or a folder with one model.

use super::files::{Files, Kind, name_of, parent_of};
use super::obj::Source;
use super::{gltf, manifest, obj, plant};
use crate::error::{Error, Result, invalid};
use crate::scene::Parts;

/// Names of procedural scenes. A folder with such a name can be opened as `./NAME`.
pub(super) const BUILT_IN: [&str; 1] = ["tree"];

/// A model in a folder, by the name of its main file or, for a plant, its stem.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Model {
    Gltf(String),
    Obj(String),
    /// `STEM.obj`, `STEM.structure.json` and `STEM_object_id.dat`.
    Plant(String),
}

/// The parts of any scene.
///
/// # Errors
/// `NotFound` if nothing has this name; otherwise `Invalid` with the file, the field, and the expected and given value.
pub(super) fn read(files: &Files, source: &str) -> Result<Parts> {
    if BUILT_IN.contains(&source) {
        return crate::tree::grow(&crate::tree::Recipe::default());
    }
    match files.kind(source)? {
        None => Err(Error::NotFound { what: "scene", given: source.into() }),
        Some(Kind::File) if source.ends_with(".toml") => {
            let folder = parent_of(source);
            manifest::read(&files.within(folder)?, name_of(source), &files.own_name(folder))
        }
        Some(Kind::Folder) => {
            let folder = files.within(source)?;
            match folder.kind(manifest::FILE)? {
                Some(Kind::File) => manifest::read(&folder, manifest::FILE, &files.own_name(source)),
                _ => model(files, source, Source::Beside),
            }
        }
        Some(Kind::File) => model(files, source, Source::Beside),
    }
}

/// The parts of one model: a file, or a folder with exactly one recognized model.
///
/// # Errors
/// `Invalid` with the file, the field, and the expected and given value.
pub(super) fn model(files: &Files, path: &str, modes: Source) -> Result<Parts> {
    match files.kind(path)? {
        Some(Kind::Folder) => {
            let folder = files.within(path)?;
            let mut parts = read_model(&folder, &the_one_model(&folder, path)?, modes)?;
            parts.name = files.own_name(path);
            Ok(parts)
        }
        Some(Kind::File) => {
            let folder = files.within(parent_of(path))?;
            let found = recognised(name_of(path))
                .ok_or_else(|| invalid(format!("file '{path}'"), "a file ending in .glb, .gltf or .obj", "another"))?;
            let found = in_company(found, &names_of(&folder));
            read_model(&folder, &found, modes)
        }
        None => Err(invalid(format!("file '{path}'"), "a model that is there", "nothing of that name")),
    }
}

fn read_model(folder: &Files, model: &Model, modes: Source) -> Result<Parts> {
    match model {
        Model::Gltf(name) => gltf::read(folder, name),
        Model::Obj(name) => obj::read(folder, name, modes),
        Model::Plant(stem) => plant::read(folder, stem),
    }
}

/// The model whose main file has this name, by its extension.
pub(super) fn recognised(name: &str) -> Option<Model> {
    match name.rsplit_once('.')?.1.to_ascii_lowercase().as_str() {
        "glb" | "gltf" => Some(Model::Gltf(name.into())),
        "obj" => Some(Model::Obj(name.into())),
        _ => None,
    }
}

/// All models in a folder.
pub(super) fn models(folder: &Files) -> Vec<Model> {
    let names = names_of(folder);
    names.iter().filter_map(|name| recognised(name)).map(|model| in_company(model, &names)).collect()
}

/// Turns an OBJ file into a plant if the files of a plant's structure are next to it.
fn in_company(model: Model, names: &[String]) -> Model {
    let stem = match &model {
        Model::Obj(name) => name.strip_suffix(".obj"),
        _ => None,
    };
    let is_plant = |stem: &&str| {
        let company = [format!("{stem}.structure.json"), format!("{stem}_object_id.dat")];
        company.iter().all(|name| names.contains(name))
    };
    stem.filter(is_plant).map(|stem| Model::Plant(stem.into())).unwrap_or(model)
}

/// Names of the files in a folder.
fn names_of(folder: &Files) -> Vec<String> {
    folder.entries().into_iter().filter(|(_, kind)| *kind == Kind::File).map(|(name, _)| name).collect()
}

fn the_one_model(folder: &Files, path: &str) -> Result<Model> {
    let mut found = models(folder);
    let shown = |names: Vec<String>| names.into_iter().take(16).collect::<Vec<_>>().join(", ");
    let field = format!("folder '{path}'");
    match found.len() {
        1 => Ok(found.remove(0)),
        0 => {
            let given = shown(folder.entries().into_iter().map(|(name, _)| name).collect());
            Err(invalid(field, "scene.toml or one .glb, .gltf or .obj file", format!("none among: {given}")))
        }
        count => {
            let name = |model| match model {
                Model::Gltf(name) | Model::Obj(name) => name,
                Model::Plant(stem) => format!("{stem} (a plant)"),
            };
            let given = shown(found.into_iter().map(name).collect());
            Err(invalid(field, "scene.toml, or one model to choose", format!("{count}: {given}")))
        }
    }
}
