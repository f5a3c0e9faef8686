//! Compares the reference page of `scene.toml` with the parser.

use std::collections::{BTreeMap, BTreeSet};

use super::*;

const PAGE: &str = include_str!("README.md");
const TRIANGLES: &str = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 3 4\n";

/// A key that no table has, and a value that no setting has.
const UNKNOWN: &str = "unknown_key";

/// The error of the parser for a value of `key`, which is a dotted path.
fn parser_error(key: &str, value: &str) -> String {
    let text = format!("{}{key} = {value}\n", if key.starts_with("domain") { "" } else { "model = 'a.obj'\n" });
    parse(text.as_bytes()).map(drop).err().map_or_else(String::new, |error| error.to_string())
}

/// The names in backquotes after `expected` in an error about an unknown name.
fn names_in(error: &str) -> BTreeSet<String> {
    let list = error.rsplit_once("expected ").map_or("", |(_, list)| list);
    list.split('`').skip(1).step_by(2).map(str::to_owned).collect()
}

/// The keys of a table of the parser.
fn parser_keys(table: &str) -> BTreeSet<String> {
    let key = if table.is_empty() { UNKNOWN.to_owned() } else { format!("{table}.{UNKNOWN}") };
    let text = match table {
        "domain" => format!("[[domain]]\nmodel = 'a.obj'\n{UNKNOWN} = 1\n"),
        _ => format!("model = 'a.obj'\n{key} = 1\n"),
    };
    let error = parse(text.as_bytes()).map(drop).expect_err("an unknown key").to_string();
    assert!(error.contains("unknown field"), "{table}: {error}");
    names_in(&error)
}

/// The rows of the tables under each heading of the second level: key, type and default.
fn page_tables() -> BTreeMap<String, Vec<[String; 3]>> {
    let mut tables: BTreeMap<String, Vec<[String; 3]>> = BTreeMap::new();
    let mut heading = String::new();
    for line in PAGE.lines() {
        if let Some(title) = line.strip_prefix("## ") {
            heading = title.trim_matches('`').to_owned();
        }
        let cells: Vec<&str> = line.trim_matches('|').split('|').map(str::trim).collect();
        if let [key, kind, _, default, ..] = cells[..]
            && line.starts_with("| `")
        {
            tables.entry(heading.clone()).or_default().push([
                key.replace('`', ""),
                kind.to_owned(),
                default.to_owned(),
            ]);
        }
    }
    tables
}

/// The path of the TOML table that a heading of the page describes.
fn table_path(heading: &str) -> &str {
    match heading {
        "Scene" => "",
        "material" => "material.red",
        heading => heading,
    }
}

#[test]
fn page_has_exactly_the_keys_of_the_parser() {
    let tables = page_tables();
    let headings = [
        "Scene",
        "domain",
        "placement",
        "material",
        "look",
        "look.shadow",
        "look.ground",
        "look.ambient_occlusion",
        "look.edges",
        "look.bloom",
        "deform",
        "plant",
    ];
    for heading in headings {
        let rows = tables.get(heading).unwrap_or_else(|| panic!("expected a table of {heading}"));
        let documented: BTreeSet<String> = rows.iter().map(|[key, ..]| key.clone()).collect();
        assert_eq!(documented.len(), rows.len(), "{heading}: expected each key once");
        assert_eq!(documented, parser_keys(table_path(heading)), "keys of {heading}: the page, then the parser");
    }
    // The comparison above covers only the tables in `headings`, so no other table may exist.
    for heading in headings {
        for key in parser_keys(table_path(heading)) {
            let path = if heading == "Scene" { key.clone() } else { format!("{}.{key}", table_path(heading)) };
            let is_table =
                heading != "domain" && parser_error(&format!("{path}.{UNKNOWN}"), "1").contains("unknown field");
            let is_listed = headings.contains(&path.as_str()) || path == "placement" || heading == "material";
            assert!(!is_table || is_listed, "expected a table of {path} on the page");
        }
    }
}

#[test]
fn page_has_the_names_that_the_parser_accepts() {
    let mut compared = 0;
    for (heading, rows) in page_tables() {
        for [key, kind, _] in rows.iter().filter(|_| heading != "domain") {
            let path = if heading == "Scene" { key.clone() } else { format!("{}.{key}", table_path(&heading)) };
            let error = parser_error(&path, &format!("'{UNKNOWN}'"));
            if error.contains("unknown variant") {
                let documented: BTreeSet<String> = kind.split('"').skip(1).step_by(2).map(str::to_owned).collect();
                assert_eq!(documented, names_in(&error), "values of {path}: the page, then the parser");
                compared += 1;
            }
        }
    }
    assert!(compared >= 12, "expected at least 12 keys with names, got {compared}");
}

/// Writes the models and modes of the examples, and `text` as the manifest. Returns the scene.
fn read_scene(text: &str) -> Result<SceneDescription> {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let write = |name: &str, bytes: &[u8]| std::fs::write(folder.path().join(name), bytes).expect("a writable file");
    for name in ["a.obj", "beam.obj"] {
        write(name, format!("usemtl red\n{TRIANGLES}").as_bytes());
    }
    write("trunk.obj", format!("usemtl bark\n{TRIANGLES}").as_bytes());
    write("branch.stl", b"solid\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\n");
    for name in ["beam.U.npy", "trunk.U.npy"] {
        let modes = ndarray::Array3::<f32>::ones((4, 3, 2));
        let mut bytes = Vec::new();
        ndarray_npy::WriteNpyExt::write_npy(&modes, &mut bytes).expect("an encoded array");
        write(name, &bytes);
    }
    write(MANIFEST_FILE, text.as_bytes());
    read(&AssetDir::unrestricted(folder.path()), MANIFEST_FILE, "folder", &LoadOptions::default())
}

#[test]
fn documented_defaults_are_those_of_the_parser() {
    let describe = |text: &str| {
        let SceneDescription { parts, backends } = read_scene(text).unwrap_or_else(|error| panic!("{text}: {error}"));
        // Numbers such as -0 and 0 would differ in the text.
        format!("{parts:?} {backends:?}").replace("-0.0", "0.0")
    };
    let start = "model = 'a.obj'\nlook.lighting = 'outdoor'\n";
    let without_key = describe(start);
    let mut compared = 0;
    for (heading, rows) in page_tables() {
        for [key, _, default] in rows.iter().filter(|[.., default]| default.starts_with('`') && default.ends_with('`'))
        {
            let (value, path) = (default.trim_matches('`'), table_path(&heading));
            // Other cells name a key or a rule instead of a value.
            let is_literal =
                key != value && !value.starts_with(char::is_alphabetic) || ["true", "false"].contains(&value);
            if !is_literal {
                continue;
            }
            let path = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
            let text = format!("{start}{path} = {value}\n");
            // These tables are absent by default, so their defaults are those of a table without keys.
            let expected = match heading.as_str() {
                "look.bloom" | "look.edges" | "look.ambient_occlusion" => {
                    describe(&format!("{start}{heading} = {{}}\n"))
                }
                _ => without_key.clone(),
            };
            assert_eq!(describe(&text), expected, "{path} = {value}");
            compared += 1;
        }
    }
    assert!(compared >= 30, "expected at least 30 defaults, got {compared}");
    assert_ne!(describe(&format!("{start}look.exposure = 2\n")), without_key, "control: expected a difference");
}

#[test]
fn examples_of_the_page_are_valid_scenes() {
    let examples: Vec<&str> = PAGE.split("```toml\n").skip(1).filter_map(|text| text.split("```").next()).collect();
    assert_eq!(examples.len(), 3);
    let beam = read_scene(examples[0]).expect("a valid example").parts;
    assert_eq!((beam.shapes[0].modes.rank(), &beam.domains[0].metadata.eigenvalues[..]), (2, &[39.5, 157.9][..]));
    assert_eq!(beam.domains[0].metadata.notes["modes.file"], "beam.U.npy");
    assert!(read_scene(examples[1]).expect("a valid example").parts.domains.len() > 1);
    let tree = read_scene(examples[2]).expect("a valid example").parts;
    let attachment = tree.domains[1].attachment.as_ref().expect("an attachment");
    assert_eq!((attachment.parent, &attachment.vertices[..]), (0, &[0, 1, 2][..]));
    assert_eq!(tree.materials[tree.domains[1].material].diffuse, [1.0, 0.0, 0.0]);
    assert!(tree.domains[2].follows.is_some(), "expected a follower");
    crate::scene::Scene::new(tree).expect("a valid scene");
}
