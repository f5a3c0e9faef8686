//! Checks of the tables in `src/lib.rs` and of the layout of the repository: a module uses only the modules that its
//! row of the table names, and every CUDA kernel has a launcher and a CPU twin (a CPU function with the same result).

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

fn repository_root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

/// Maps each module to the modules that it may use.
type UsageTable = BTreeMap<String, BTreeSet<String>>;

/// Reads the tables of `src/lib.rs`.
fn read_usage_table() -> UsageTable {
    parse_usage_table(&fs::read_to_string(repository_root().join("src/lib.rs")).expect("expected src/lib.rs"))
}

/// Parses the tables in the documentation of `src/lib.rs`. The columns of a table are the name, the contents and the
/// names that may be used.
fn parse_usage_table(page: &str) -> UsageTable {
    // The names of a cell are between backquotes.
    let names = |cell: &str| -> BTreeSet<String> { cell.split('`').skip(1).step_by(2).map(str::to_owned).collect() };
    let row = |line: &str| {
        let cells: Vec<&str> = line.strip_prefix("//! | `")?.split('|').collect();
        let module = cells.first()?.trim().trim_end_matches('`').to_owned();
        Some((module, names(cells.get(2)?)))
    };
    page.lines().filter_map(row).collect()
}

/// All files below a folder with one of these extensions, sorted by path.
fn list_files(folder: &Path, extensions: &[&str]) -> Vec<PathBuf> {
    let mut paths = Vec::new();
    let Ok(entries) = fs::read_dir(folder) else { return paths };
    for entry in entries {
        let path = entry.expect("expected a folder entry").path();
        if path.is_dir() {
            paths.extend(list_files(&path, extensions));
        } else if extensions.iter().any(|expected| path.extension().is_some_and(|extension| extension == *expected)) {
            paths.push(path);
        }
    }
    paths.sort();
    paths
}

/// Folders of `src` that are crates of their own.
const CRATE_FOLDERS: [&str; 4] = ["beam", "compute", "model", "render"];

/// Crate and top-level module of a file of `src`, named as in the table. `None` for the root file of a crate and for
/// test support.
fn module_of(path: &Path) -> Option<(String, String)> {
    let path_in_src = path.strip_prefix(repository_root().join("src")).expect("expected a path in src");
    let mut names = path_in_src.iter().map(|name| name.to_string_lossy().into_owned()).peekable();
    let crate_folder = names.next_if(|name| CRATE_FOLDERS.contains(&name.as_str()));
    let package = crate_folder.map_or("modalcast".to_owned(), |crate_folder| format!("modalcast-{crate_folder}"));
    let module = names.next().expect("expected a file name").trim_end_matches(".rs").to_owned();
    let is_root = module == "lib" || module == "main";
    // Test support is compiled for tests only and may use every module.
    (!is_root && module != "testing").then_some((package, module))
}

/// Every module that a source text names as `crate::name` or in `crate::{...}`, except in comment lines.
fn used_modules(text: &str) -> BTreeSet<String> {
    names_after(text, "crate::")
}

/// Every name that follows `prefix` in a source text, alone or in a group, except in comment lines.
fn names_after(text: &str, prefix: &str) -> BTreeSet<String> {
    let code: Vec<&str> = text.lines().filter(|line| !line.trim_start().starts_with("//")).collect();
    let name = |rest: &str| -> String {
        rest.trim_start().chars().take_while(|letter| letter.is_alphanumeric() || *letter == '_').collect()
    };
    let code = code.join("\n");
    let names = code.split(prefix).skip(1).flat_map(|rest| match rest.strip_prefix('{') {
        Some(group) => split_group(group).into_iter().map(name).collect::<Vec<_>>(),
        None => vec![name(rest)],
    });
    names.filter(|name| !name.is_empty()).collect()
}

/// The entries of a group import up to its closing brace; nested groups stay within their entry.
fn split_group(group: &str) -> Vec<&str> {
    let (mut depth, mut start, mut entries) = (0, 0, Vec::new());
    for (offset, letter) in group.char_indices() {
        match letter {
            '{' => depth += 1,
            '}' if depth == 0 => {
                entries.push(&group[start..offset]);
                break;
            }
            '}' => depth -= 1,
            ',' if depth == 0 => {
                entries.push(&group[start..offset]);
                start = offset + 1;
            }
            _ => {}
        }
    }
    entries
}

/// Lists the forbidden uses in the text of a module: modules of the same crate that the row of the module does not
/// name, and `modalcast_proto` outside of `service`.
fn find_forbidden_uses((package, module): (&str, &str), text: &str, usage_table: &UsageTable) -> Vec<String> {
    let row = |module: &str| usage_table.get(&format!("{package}::{module}"));
    let Some(allowed_modules) = row(module) else { return vec![format!("{package}::{module} is not in the table")] };
    let mut messages: Vec<String> = used_modules(text)
        .into_iter()
        .filter(|name| name != module && row(name).is_some() && !allowed_modules.contains(name))
        .map(|name| format!("{module} uses {name}"))
        .collect();
    if text.contains("modalcast_proto") && module != "service" {
        messages.push(format!("{module} names proto"));
    }
    messages
}

/// The part of a file to which the table applies. Tests of the renderer may use all of its modules, so their files and
/// the test module at the end of a file are excluded.
fn governed_text<'a>(package: &str, path: &Path, text: &'a str) -> &'a str {
    let is_test_file = path.file_stem().is_some_and(|stem| stem.to_string_lossy().ends_with("tests"));
    match package {
        "modalcast-render" if is_test_file => "",
        "modalcast-render" => text.split("#[cfg(test)]\nmod tests {").next().unwrap_or(text),
        _ => text,
    }
}

#[test]
fn modules_use_only_what_their_row_names() {
    let usage_table = read_usage_table();
    assert!(usage_table.len() >= 10, "expected at least 10 rows, got {usage_table:?}");
    for path in list_files(&repository_root().join("src"), &["rs"]) {
        let Some((package, module)) = module_of(&path) else { continue };
        let text = fs::read_to_string(&path).expect("expected a readable file");
        let messages = find_forbidden_uses((&package, &module), governed_text(&package, &path, &text), &usage_table);
        assert_eq!(messages, Vec::<String>::new(), "{}", path.display());
    }
}

/// Lists the uses of a forbidden tier (a submodule with its own row) in a source text. `row` is the tier of the text,
/// such as `modalcast-compute::gpu::tables`. A use of another tier has the form `crate::gpu::launch` or
/// `super::launch`.
fn find_forbidden_tier_uses(row: &str, text: &str, usage_table: &UsageTable) -> Vec<String> {
    let (parent, tier) = row.rsplit_once("::").expect("expected a row of a tier");
    let module = parent.rsplit("::").next().unwrap_or_default();
    let is_tier = |name: &String| name != tier && usage_table.contains_key(&format!("{parent}::{name}"));
    let used_names = [names_after(text, &format!("crate::{module}::")), names_after(text, "super::")];
    let used_names: BTreeSet<String> = used_names.into_iter().flatten().filter(is_tier).collect();
    used_names.difference(&usage_table[row]).map(|name| format!("{tier} uses {name}")).collect()
}

#[test]
fn tiers_of_the_gpu_module_use_only_what_their_row_names() {
    let usage_table = read_usage_table();
    let tiers: Vec<&String> = usage_table.keys().filter(|row| row.starts_with("modalcast-compute::gpu::")).collect();
    assert_eq!(tiers.len(), 3, "{tiers:?}");
    for row in tiers {
        let folder = repository_root().join("src").join(row.trim_start_matches("modalcast-").replace("::", "/"));
        let paths = list_files(&folder, &["rs"]);
        assert!(!paths.is_empty(), "{}", folder.display());
        for path in paths {
            let messages = find_forbidden_tier_uses(
                row,
                &fs::read_to_string(&path).expect("expected a readable file"),
                &usage_table,
            );
            assert_eq!(messages, Vec::<String>::new(), "{}", path.display());
        }
    }
}

#[test]
fn forbidden_uses_of_tiers_are_detected() {
    let usage_table = parse_usage_table("//! | `a::m::low` | x | |\n//! | `a::m::high` | x | `low` |\n");
    let no_messages = Vec::<String>::new();
    assert_eq!(find_forbidden_tier_uses("a::m::high", "use crate::m::low::Thing;", &usage_table), no_messages);
    assert_eq!(find_forbidden_tier_uses("a::m::low", "use crate::m::high::Thing;", &usage_table), ["low uses high"]);
    assert_eq!(
        find_forbidden_tier_uses("a::m::low", "use super::super::{other, high};", &usage_table),
        ["low uses high"]
    );
    assert_eq!(
        find_forbidden_tier_uses("a::m::low", "use super::own; use crate::other::high;", &usage_table),
        no_messages
    );
}

#[test]
fn module_dependencies_have_no_cycle() {
    let usage_table = read_usage_table();
    // Module names are unique across the crates. Repeatedly remove a module that uses none of the remaining modules. No
    // such module exists in a cycle.
    let name = |row: &String| row.rsplit("::").next().unwrap_or_default().to_owned();
    let mut remaining: BTreeMap<String, BTreeSet<String>> = usage_table
        .iter()
        .filter(|(row, _)| row.contains("::"))
        .map(|(row, used_modules)| (name(row), used_modules.clone()))
        .collect();
    assert!(remaining.len() >= 15, "{remaining:?}");
    while !remaining.is_empty() {
        let module =
            remaining.iter().find(|(_, used_modules)| used_modules.iter().all(|name| !remaining.contains_key(name)));
        let module =
            module.map(|(name, _)| name.clone()).unwrap_or_else(|| panic!("a cycle among {:?}", remaining.keys()));
        remaining.remove(&module);
    }
}

/// The dependencies in the manifest of a crate are those of its row. Cargo permits no others.
#[test]
fn manifests_have_the_dependencies_of_the_table() {
    let usage_table = read_usage_table();
    for (folder, package) in ["src/beam", "src/compute", "src/render", "src/model"]
        .map(|folder| (folder, folder.replace("src/", "modalcast-")))
    {
        let manifest =
            fs::read_to_string(repository_root().join(folder).join("Cargo.toml")).expect("expected a manifest");
        let dependencies: BTreeSet<String> = manifest
            .lines()
            .filter_map(|line| line.split(['.', ' ', '=']).next().filter(|name| name.starts_with("modalcast")))
            .map(str::to_owned)
            .collect();
        // The name in a row of the crate table is followed by the folder, as in "`modalcast-render` (`src/render`)".
        let row = usage_table.iter().find(|(row, _)| row.starts_with(&format!("{package}` (")) || **row == package);
        assert_eq!(Some(&dependencies), row.map(|(_, used_modules)| used_modules), "{package}");
    }
}

#[test]
fn forbidden_uses_are_detected() {
    let usage_table =
        parse_usage_table("//! | `a::low` | x | |\n//! | `a::high` | x | `low` |\n//! | `b::other` | x | |\n");
    let no_messages = Vec::<String>::new();
    assert_eq!(find_forbidden_uses(("a", "high"), "use crate::low::Thing;", &usage_table), no_messages);
    assert_eq!(find_forbidden_uses(("a", "low"), "use crate::high::Thing;", &usage_table), ["low uses high"]);
    assert_eq!(
        find_forbidden_uses(("a", "low"), "use crate::{\n    own::{A, B},\n    high,\n};", &usage_table),
        ["low uses high"]
    );
    assert_eq!(find_forbidden_uses(("a", "low"), "use crate::{own::{high}, error};", &usage_table), no_messages);
    assert_eq!(
        find_forbidden_uses(("a", "low"), "use crate::other;", &usage_table),
        no_messages,
        "expected no message for a module of another crate"
    );
    assert_eq!(find_forbidden_uses(("a", "stray"), "", &usage_table), ["a::stray is not in the table"]);
    assert_eq!(find_forbidden_uses(("a", "low"), "use modalcast_proto::v1;", &usage_table), ["low names proto"]);
}

/// Whether the CPU twin of a kernel is a `twin_of_` function in the tests of its launcher, instead of a separate file.
/// These kernels are launched only by the benchmarks, or have the same result as another kernel.
fn has_twin_in_launcher_tests(name: &str) -> bool {
    name.starts_with("thesis_") || ["bandwidth", "plain_update", "batch", "batch_mma"].contains(&name)
}

/// Kernels whose CPU twin is a method of a model or reference type, instead of a file with the name of the kernel.
const METHOD_TWINS: [(&str, Twin); 5] = [
    ("apply", Twin { file: "src/model/scene/state.rs", type_name: "SceneState", method: "apply" }),
    ("bounds", Twin { file: "src/model/scene/camera.rs", type_name: "BoundingBox", method: "union" }),
    ("png", Twin { file: "src/frame/png/mod.rs", type_name: "PngLayout", method: "encode_strip" }),
    ("raster", Twin { file: "src/compute/reference/raster.rs", type_name: "VisibilityBuffer", method: "draw" }),
    ("views", Twin { file: "src/compute/reference/views.rs", type_name: "ReferenceViewRenderer", method: "draw" }),
];

/// A method that computes the same result as a kernel on the CPU.
#[derive(Clone, Copy)]
struct Twin {
    file: &'static str,
    type_name: &'static str,
    method: &'static str,
}

impl Twin {
    /// Whether the text of a source file defines the method in an `impl` block of the type, and the text of a kernel
    /// names the method in its comment `CPU twin:`.
    fn is_defined_and_named(&self, source: &str, kernel: &str) -> bool {
        let impl_block =
            source.split(&format!("\nimpl {} {{", self.type_name)).nth(1).and_then(|rest| rest.split("\n}\n").next());
        let has_method =
            impl_block.is_some_and(|impl_block| impl_block.contains(&format!("\n    pub fn {}(", self.method)));
        let qualified_name = format!("{}::{}.", self.type_name, self.method);
        has_method && kernel.lines().any(|line| line.contains("CPU twin: ") && line.ends_with(&qualified_name))
    }
}

#[test]
fn missing_or_unnamed_twin_method_is_detected() {
    let twin = Twin { file: "", type_name: "Sum", method: "add" };
    let (kernel, file) = ("// CPU twin: Sum::add.\n", "\nimpl Sum {\n    /// Adds.\n    pub fn add(self) {}\n}\n");
    assert!(twin.is_defined_and_named(file, kernel));
    assert!(!twin.is_defined_and_named(file, "// CPU twin: Sum::take.\n"));
    assert!(!twin.is_defined_and_named(&file.replace("add", "take"), kernel));
    assert!(!twin.is_defined_and_named(&file.replace("Sum", "Total"), kernel));
    assert!(!twin.is_defined_and_named("\nimpl Sum {\n}\n\nimpl Total {\n    pub fn add(self) {}\n}\n", kernel));
}

#[test]
fn every_kernel_has_a_launcher_and_a_twin() {
    // Paths of the kernels of the server and of the benchmarks, each with the folder of its launcher.
    let mut kernel_folders = Vec::new();
    for (kernels, launchers) in [("kernels", "src/compute/gpu"), ("tests/bench/kernels", "tests/bench/src/kernels")] {
        let paths = list_files(&repository_root().join(kernels), &["cu"]);
        assert!(!paths.is_empty(), "{kernels}");
        kernel_folders.extend(paths.into_iter().map(|kernel| (kernel, launchers)));
    }
    for (kernel, folder) in kernel_folders {
        let name = kernel.file_stem().expect("expected a file name").to_string_lossy().into_owned();
        let launchers = list_files(&repository_root().join(folder), &["rs"]);
        let launcher = launchers.iter().find(|path| path.file_stem().is_some_and(|stem| *stem == *name));
        let launcher = launcher.unwrap_or_else(|| panic!("{name} has no launcher below {folder}"));
        if has_twin_in_launcher_tests(&name) {
            let text = fs::read_to_string(launcher).expect("expected a readable file");
            assert!(text.contains("    fn twin_of_"), "{} has no twin of {name}", launcher.display());
            continue;
        }
        if let Some((_, twin)) = METHOD_TWINS.iter().find(|(kernel, _)| *kernel == name) {
            let [twin_source, kernel_source] = [&repository_root().join(twin.file), &kernel]
                .map(|path| fs::read_to_string(path).expect("expected a readable file"));
            assert!(
                twin.is_defined_and_named(&twin_source, &kernel_source),
                "expected {name} to have the CPU twin {}::{} and to name it",
                twin.type_name,
                twin.method
            );
            continue;
        }
        // Other kernels have a twin in f64 (the reference) and a twin in f32 (the CPU deformer).
        for folder in ["src/compute/reference", "src/compute/cpu"] {
            let twin = repository_root().join(folder).join(format!("{name}.rs"));
            assert!(twin.exists(), "{} is missing", twin.display());
        }
    }
}

/// Devices, memory that processes share, and a setting of the C library.
#[test]
fn only_modules_near_devices_shared_memory_and_the_c_library_have_unsafe_code() {
    let allowed = [
        "src/compute/gpu/",
        "src/render/",
        "src/service/shared_memory/",
        "src/cli/allocator.rs",
        "src/engine/crash_signals.rs",
    ];
    for path in list_files(&repository_root().join("src"), &["rs"]) {
        let relative_path = path
            .strip_prefix(repository_root())
            .expect("expected a path in the repository")
            .to_string_lossy()
            .into_owned();
        let text = fs::read_to_string(&path).expect("expected a readable file");
        let code = text.lines().filter(|line| !line.trim_start().starts_with("//"));
        let has_unsafe_code = code.into_iter().any(|line| line.contains("unsafe {") || line.contains("unsafe fn"));
        let is_allowed = allowed.iter().any(|folder| relative_path.starts_with(folder));
        assert!(!has_unsafe_code || is_allowed, "{relative_path} has unsafe code");
    }
}

/// The minimum versions are the lowest versions without known security faults.
#[test]
fn locked_versions_have_no_known_security_faults() {
    let lock_file = fs::read_to_string(repository_root().join("Cargo.lock")).expect("expected a lock file");
    let minimum_versions = [
        ("h2", "0.4.16"),
        ("tonic", "0.14.6"),
        ("bytes", "1.11.1"),
        ("tokio", "1.44.2"),
        ("slab", "0.4.11"),
        ("tracing-subscriber", "0.3.20"),
        ("prost", "0.6.1"),
    ];
    let version_numbers =
        |version: &str| -> Vec<u64> { version.split(['.', '-', '+']).map_while(|part| part.parse().ok()).collect() };
    for (name, minimum_version) in minimum_versions {
        let versions: Vec<&str> = lock_file
            .split("[[package]]")
            .filter(|entry| entry.contains(&format!("name = \"{name}\"\n")))
            .filter_map(|entry| entry.split("version = \"").nth(1)?.split('"').next())
            .collect();
        assert!(!versions.is_empty(), "{name} is not locked");
        for version in versions {
            assert!(
                version_numbers(version) >= version_numbers(minimum_version),
                "{name} {version} is below {minimum_version}"
            );
        }
    }
}
