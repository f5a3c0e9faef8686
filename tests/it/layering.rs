//! Checks of the tables in `src/lib.rs` and of the layout of the repository: modules use only the modules of their row,
//! and every kernel has a launcher and a CPU twin.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

/// Maps each module to the modules that it may use, parsed from the page's table.
fn table(page: &str) -> BTreeMap<String, BTreeSet<String>> {
    let names = |cell: &str| -> BTreeSet<String> { cell.split('`').skip(1).step_by(2).map(str::to_owned).collect() };
    let row = |line: &str| {
        let cells: Vec<&str> = line.strip_prefix("//! | `")?.split('|').collect();
        let module = cells.first()?.trim().trim_end_matches('`').to_owned();
        Some((module, names(cells.get(2)?)))
    };
    page.lines().filter_map(row).collect()
}

fn files(folder: &Path, endings: &[&str]) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let Ok(entries) = fs::read_dir(folder) else { return found };
    for entry in entries {
        let path = entry.expect("an entry").path();
        if path.is_dir() {
            found.extend(files(&path, endings));
        } else if endings.iter().any(|ending| path.extension().is_some_and(|own| own == *ending)) {
            found.push(path);
        }
    }
    found.sort();
    found
}

/// Folders of `src` that are separate crates.
const TIERS: [&str; 3] = ["compute", "model", "render"];

/// Crate and top-level module of a file of `src`, named as in the table. `None` for the root file of a crate and for
/// test support.
fn module_of(path: &Path) -> Option<(String, String)> {
    let inside = path.strip_prefix(root().join("src")).expect("inside src");
    let mut names = inside.iter().map(|name| name.to_string_lossy().into_owned()).peekable();
    let tier = names.next_if(|name| TIERS.contains(&name.as_str()));
    let package = tier.map_or("modalcast".to_owned(), |tier| format!("modalcast-{tier}"));
    let module = names.next().expect("a name").trim_end_matches(".rs").to_owned();
    let is_root = module == "lib" || module == "main";
    // Test support is compiled for tests only and may use every module.
    (!is_root && module != "testing").then_some((package, module))
}

/// Every module that a source text names as `crate::name` or in `crate::{...}`, except in comment lines.
fn uses(text: &str) -> BTreeSet<String> {
    uses_after(text, "crate::")
}

/// Every name that follows `prefix` in a source text, alone or in a group, except in comment lines.
fn uses_after(text: &str, prefix: &str) -> BTreeSet<String> {
    let code: Vec<&str> = text.lines().filter(|line| !line.trim_start().starts_with("//")).collect();
    let name = |rest: &str| -> String {
        rest.trim_start().chars().take_while(|letter| letter.is_alphanumeric() || *letter == '_').collect()
    };
    let code = code.join("\n");
    let names = code.split(prefix).skip(1).flat_map(|rest| match rest.strip_prefix('{') {
        Some(group) => first_names(group).into_iter().map(name).collect::<Vec<_>>(),
        None => vec![name(rest)],
    });
    names.filter(|name| !name.is_empty()).collect()
}

/// The entries of a group import up to its closing brace; nested groups stay within their entry.
fn first_names(group: &str) -> Vec<&str> {
    let (mut depth, mut begin, mut entries) = (0, 0, Vec::new());
    for (at, letter) in group.char_indices() {
        match letter {
            '{' => depth += 1,
            '}' if depth == 0 => {
                entries.push(&group[begin..at]);
                break;
            }
            '}' => depth -= 1,
            ',' if depth == 0 => {
                entries.push(&group[begin..at]);
                begin = at + 1;
            }
            _ => {}
        }
    }
    entries
}

/// Uses that are not allowed: modules of the same crate that the row does not name, and `modalcast_proto` outside of
/// `service`.
fn illegal((package, module): (&str, &str), text: &str, table: &BTreeMap<String, BTreeSet<String>>) -> Vec<String> {
    let row = |module: &str| table.get(&format!("{package}::{module}"));
    let Some(allowed) = row(module) else { return vec![format!("{package}::{module} is not in the table")] };
    let mut wrong: Vec<String> = uses(text)
        .into_iter()
        .filter(|name| name != module && row(name).is_some() && !allowed.contains(name))
        .map(|name| format!("{module} uses {name}"))
        .collect();
    if text.contains("modalcast_proto") && module != "service" {
        wrong.push(format!("{module} names proto"));
    }
    wrong
}

/// The text that the table governs. Tests of the renderer draw with all of it: files of tests, and the test modules at
/// the end of a file, may use every module.
fn governed<'a>(package: &str, path: &Path, text: &'a str) -> &'a str {
    let is_of_tests = path.file_stem().is_some_and(|stem| stem.to_string_lossy().ends_with("tests"));
    match package {
        "modalcast-render" if is_of_tests => "",
        "modalcast-render" => text.split("#[cfg(test)]\nmod tests {").next().unwrap_or(text),
        _ => text,
    }
}

#[test]
fn modules_use_only_what_their_row_names() {
    let table = table(&fs::read_to_string(root().join("src/lib.rs")).expect("the page"));
    assert!(table.len() >= 10, "the table was read: {table:?}");
    for path in files(&root().join("src"), &["rs"]) {
        let Some((package, module)) = module_of(&path) else { continue };
        let text = fs::read_to_string(&path).expect("a file");
        let wrong = illegal((&package, &module), governed(&package, &path, &text), &table);
        assert_eq!(wrong, Vec::<String>::new(), "{}", path.display());
    }
}

/// Tiers of a module that a source text of one of them uses without permission, as `crate::module::tier` or through
/// `super`.
fn illegal_tiers(row: &str, text: &str, table: &BTreeMap<String, BTreeSet<String>>) -> Vec<String> {
    let (parent, tier) = row.rsplit_once("::").expect("a tier of a module");
    let module = parent.rsplit("::").next().unwrap_or_default();
    let is_tier = |name: &String| name != tier && table.contains_key(&format!("{parent}::{name}"));
    let used = [uses_after(text, &format!("crate::{module}::")), uses_after(text, "super::")];
    let used: BTreeSet<String> = used.into_iter().flatten().filter(is_tier).collect();
    used.difference(&table[row]).map(|name| format!("{tier} uses {name}")).collect()
}

#[test]
fn tiers_of_a_module_use_only_what_their_row_names() {
    let table = table(&fs::read_to_string(root().join("src/lib.rs")).expect("the page"));
    let tiers: Vec<&String> = table.keys().filter(|row| row.starts_with("modalcast-compute::gpu::")).collect();
    assert_eq!(tiers.len(), 3, "{tiers:?}");
    for row in tiers {
        let folder = root().join("src").join(row.trim_start_matches("modalcast-").replace("::", "/"));
        let found = files(&folder, &["rs"]);
        assert!(!found.is_empty(), "{}", folder.display());
        for path in found {
            let wrong = illegal_tiers(row, &fs::read_to_string(&path).expect("a file"), &table);
            assert_eq!(wrong, Vec::<String>::new(), "{}", path.display());
        }
    }
}

#[test]
fn forbidden_uses_of_tiers_are_detected() {
    let table = table("//! | `a::m::low` | x | |\n//! | `a::m::high` | x | `low` |\n");
    let none = Vec::<String>::new();
    assert_eq!(illegal_tiers("a::m::high", "use crate::m::low::Thing;", &table), none);
    assert_eq!(illegal_tiers("a::m::low", "use crate::m::high::Thing;", &table), ["low uses high"]);
    assert_eq!(illegal_tiers("a::m::low", "use super::super::{other, high};", &table), ["low uses high"]);
    assert_eq!(illegal_tiers("a::m::low", "use super::own; use crate::other::high;", &table), none);
}

#[test]
fn module_dependencies_have_no_cycle() {
    let table = table(&fs::read_to_string(root().join("src/lib.rs")).expect("the page"));
    // Module names are unique across the crates. Repeatedly remove a module that uses none of the remaining ones; this
    // empties the table unless there is a cycle.
    let name = |row: &String| row.rsplit("::").next().unwrap_or_default().to_owned();
    let mut left: BTreeMap<String, BTreeSet<String>> =
        table.iter().filter(|(row, _)| row.contains("::")).map(|(row, uses)| (name(row), uses.clone())).collect();
    assert!(left.len() >= 15, "{left:?}");
    while !left.is_empty() {
        let leaf = left.iter().find(|(_, uses)| uses.iter().all(|name| !left.contains_key(name)));
        let leaf = leaf.map(|(name, _)| name.clone()).unwrap_or_else(|| panic!("a cycle among {:?}", left.keys()));
        left.remove(&leaf);
    }
}

/// Cargo enforces the order of the tiers as long as no manifest names a higher tier.
#[test]
fn manifests_depend_on_lower_tiers_only() {
    let page = fs::read_to_string(root().join("src/lib.rs")).expect("the page");
    let table = table(&page);
    for (folder, package) in
        [("src/compute", "modalcast-compute"), ("src/render", "modalcast-render"), ("src/model", "modalcast-model")]
    {
        let manifest = fs::read_to_string(root().join(folder).join("Cargo.toml")).expect("a manifest");
        let named: BTreeSet<String> = manifest
            .lines()
            .filter_map(|line| line.split(['.', ' ', '=']).next().filter(|name| name.starts_with("modalcast")))
            .map(str::to_owned)
            .collect();
        let row = table.iter().find(|(row, _)| row.starts_with(&format!("{package}` (")) || *row == package);
        assert_eq!(Some(&named), row.map(|(_, uses)| uses), "{package}");
    }
}

#[test]
fn forbidden_uses_are_detected() {
    let table = table("//! | `a::low` | x | |\n//! | `a::high` | x | `low` |\n//! | `b::other` | x | |\n");
    let none = Vec::<String>::new();
    assert_eq!(illegal(("a", "high"), "use crate::low::Thing;", &table), none);
    assert_eq!(illegal(("a", "low"), "use crate::high::Thing;", &table), ["low uses high"]);
    assert_eq!(illegal(("a", "low"), "use crate::{\n    own::{A, B},\n    high,\n};", &table), ["low uses high"]);
    assert_eq!(illegal(("a", "low"), "use crate::{own::{high}, error};", &table), none);
    assert_eq!(illegal(("a", "low"), "use crate::other;", &table), none, "of another crate");
    assert_eq!(illegal(("a", "stray"), "", &table), ["a::stray is not in the table"]);
    assert_eq!(illegal(("a", "low"), "use modalcast_proto::v1;", &table), ["low names proto"]);
}

/// Whether the twin of a kernel is a `twin_of_` function in the tests of its launcher, instead of a file of its own.
/// This holds for kernels that only the benchmarks launch and for kernels that compute the result of another kernel in
/// a different way.
fn is_walked_in_tests(name: &str) -> bool {
    name.starts_with("thesis_") || ["bandwidth", "plain_update", "batch", "batch_mma"].contains(&name)
}

/// Kernels whose CPU twin is a method of a model or reference type, instead of a file with the name of the kernel.
const TWINS_ELSEWHERE: [(&str, Twin); 3] = [
    ("apply", Twin { file: "src/model/scene/state.rs", of: "SceneState", method: "apply" }),
    ("bounds", Twin { file: "src/model/scene/camera.rs", of: "BoundingBox", method: "union" }),
    ("raster", Twin { file: "src/compute/reference/raster.rs", of: "VisibilityBuffer", method: "draw" }),
];

#[derive(Clone, Copy)]
struct Twin {
    file: &'static str,
    of: &'static str,
    method: &'static str,
}

impl Twin {
    /// Whether the text of the file defines the method in an `impl` block of the type, and the kernel's `CPU twin:`
    /// comment names it.
    fn is_in(&self, file: &str, kernel: &str) -> bool {
        let block = file.split(&format!("\nimpl {} {{", self.of)).nth(1).and_then(|rest| rest.split("\n}\n").next());
        let has = block.is_some_and(|block| block.contains(&format!("\n    pub fn {}(", self.method)));
        let named = format!("{}::{}.", self.of, self.method);
        has && kernel.lines().any(|line| line.contains("CPU twin: ") && line.ends_with(&named))
    }
}

#[test]
fn missing_or_unnamed_twin_method_is_detected() {
    let twin = Twin { file: "", of: "Sum", method: "add" };
    let (kernel, file) = ("// CPU twin: Sum::add.\n", "\nimpl Sum {\n    /// Adds.\n    pub fn add(self) {}\n}\n");
    assert!(twin.is_in(file, kernel));
    assert!(!twin.is_in(file, "// CPU twin: Sum::take.\n"));
    assert!(!twin.is_in(&file.replace("add", "take"), kernel));
    assert!(!twin.is_in(&file.replace("Sum", "Total"), kernel));
    assert!(!twin.is_in("\nimpl Sum {\n}\n\nimpl Total {\n    pub fn add(self) {}\n}\n", kernel));
}

#[test]
fn every_kernel_has_a_launcher_and_a_twin() {
    // Kernels of the server, then kernels of the benchmarks.
    let mut pairs = Vec::new();
    for (kernels, launchers) in [("kernels", "src/compute/gpu"), ("tests/bench/kernels", "tests/bench/src/kernels")] {
        let found = files(&root().join(kernels), &["cu"]);
        assert!(!found.is_empty(), "{kernels}");
        pairs.extend(found.into_iter().map(|kernel| (kernel, launchers)));
    }
    for (kernel, folder) in pairs {
        let name = kernel.file_stem().expect("a name").to_string_lossy().into_owned();
        let launchers = files(&root().join(folder), &["rs"]);
        let launcher = launchers.iter().find(|path| path.file_stem().is_some_and(|stem| *stem == *name));
        let launcher = launcher.unwrap_or_else(|| panic!("{name} has no launcher below {folder}"));
        if is_walked_in_tests(&name) {
            let text = fs::read_to_string(launcher).expect("a file");
            assert!(text.contains("    fn twin_of_"), "{} has no twin of {name}", launcher.display());
            continue;
        }
        if let Some((_, twin)) = TWINS_ELSEWHERE.iter().find(|(kernel, _)| *kernel == name) {
            let [file, text] = [&root().join(twin.file), &kernel].map(|path| fs::read_to_string(path).expect("a file"));
            assert!(twin.is_in(&file, &text), "{name} and {}::{} do not know each other", twin.of, twin.method);
            continue;
        }
        for folder in ["src/compute/reference", "src/compute/cpu"] {
            let twin = root().join(folder).join(format!("{name}.rs"));
            assert!(twin.exists(), "{} is missing", twin.display());
        }
    }
}

#[test]
fn unsafe_code_stays_in_gpu_and_render() {
    for path in files(&root().join("src"), &["rs"]) {
        let inside = path.strip_prefix(root()).expect("inside").to_string_lossy().into_owned();
        let text = fs::read_to_string(&path).expect("a file");
        let code = text.lines().filter(|line| !line.trim_start().starts_with("//"));
        let has = code.into_iter().any(|line| line.contains("unsafe {") || line.contains("unsafe fn"));
        let may = inside.starts_with("src/compute/gpu/") || inside.starts_with("src/render/");
        assert!(!has || may, "{inside} has unsafe code");
    }
}

/// Each floor is the lowest version without a known fault of the dependency.
#[test]
fn locked_versions_have_no_known_faults() {
    let lock = fs::read_to_string(root().join("Cargo.lock")).expect("the lock file");
    let floors = [
        ("h2", "0.4.16"),
        ("tonic", "0.14.6"),
        ("bytes", "1.11.1"),
        ("tokio", "1.44.2"),
        ("slab", "0.4.11"),
        ("tracing-subscriber", "0.3.20"),
        ("prost", "0.6.1"),
    ];
    let number =
        |version: &str| -> Vec<u64> { version.split(['.', '-', '+']).map_while(|part| part.parse().ok()).collect() };
    for (name, floor) in floors {
        let versions: Vec<&str> = lock
            .split("[[package]]")
            .filter(|entry| entry.contains(&format!("name = \"{name}\"\n")))
            .filter_map(|entry| entry.split("version = \"").nth(1)?.split('"').next())
            .collect();
        assert!(!versions.is_empty(), "{name} is not locked");
        for version in versions {
            assert!(number(version) >= number(floor), "{name} {version} is below {floor}");
        }
    }
}
