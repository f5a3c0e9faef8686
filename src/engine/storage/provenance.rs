//! Where scenes come from, and their names.

use modalcast_model::error::{Result, invalid};

/// Where a scene comes from.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(tag = "kind", rename_all = "lowercase")]
pub enum SceneProvenance {
    /// A built-in scene or a path inside the repository.
    Repository { source: String },
    /// Files that a client uploaded. `entry` is the path to open. An empty `entry` means the folder.
    Upload { entry: String },
}

impl SceneProvenance {
    /// Readable description for lists and errors.
    pub fn label(&self) -> String {
        match self {
            Self::Repository { source } => source.clone(),
            Self::Upload { entry } if entry.is_empty() => "uploaded".into(),
            Self::Upload { entry } => format!("uploaded: {entry}"),
        }
    }
}

/// Returns `name` if it is valid as the name of a scene. The name is also used as a file name.
///
/// # Errors
/// `Invalid` unless the name has 1 to 64 ASCII letters, digits, dots, dashes and underscores and does not start with a
/// dot.
pub fn validate_scene_name(name: &str) -> Result<&str> {
    let is_allowed = |letter: char| letter.is_ascii_alphanumeric() || "._-".contains(letter);
    if name.is_empty() || name.len() > 64 || name.starts_with('.') || !name.chars().all(is_allowed) {
        let expected = "1 to 64 of A-Z, a-z, 0-9, '.', '_' and '-', no dot first";
        return Err(invalid("scene", expected, format!("{name:?}")));
    }
    Ok(name)
}

/// The default name of a scene: the last path component of its source without extension, with `-` in place of
/// characters that are not allowed.
///
/// # Errors
/// `Invalid` when the source yields no valid name.
pub(in crate::engine) fn default_scene_name(source: &str) -> Result<String> {
    let file_name = source.trim_end_matches('/').rsplit('/').next().unwrap_or_default();
    let stem = file_name.rsplit_once('.').map_or(file_name, |(stem, _)| if stem.is_empty() { file_name } else { stem });
    let replace_invalid =
        |letter: char| if letter.is_ascii_alphanumeric() || "._-".contains(letter) { letter } else { '-' };
    let stem = if source.trim_end_matches('/') == "." { "scene" } else { stem };
    let name: String = stem.trim_start_matches('.').chars().map(replace_invalid).take(64).collect();
    validate_scene_name(&name).map_err(|_| invalid("source", "a built-in name or a path in the repository", source))?;
    Ok(name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_that_are_unsafe_as_file_names_are_rejected() {
        for name in ["", ".", "..", ".hidden", "a/b", "a\\b", "a\0", "ü", &"x".repeat(65)] {
            assert!(validate_scene_name(name).is_err(), "expected an error for {name:?}");
        }
        assert_eq!(validate_scene_name("tree_2.v-1"), Ok("tree_2.v-1"));
    }

    #[test]
    fn default_name_is_the_last_path_component() {
        for (source, name) in [
            ("tree", "tree"),
            ("vega/simpleBridge/", "simpleBridge"),
            ("a b/c d.glb", "c-d"),
            ("x.y.obj", "x.y"),
            (".", "scene"),
            ("./tree", "tree"),
        ] {
            assert_eq!(default_scene_name(source).as_deref(), Ok(name));
        }
        for source in ["", "/", "..", "a/.."] {
            assert!(default_scene_name(source).is_err(), "expected an error for {source:?}");
        }
    }
}
