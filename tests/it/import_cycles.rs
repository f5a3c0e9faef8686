//! Files import each other without cycles. A module and its submodules may use each other: the parent's documentation
//! describes them together. Everything else that forms a cycle fails the test.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use syn::visit::Visit;

/// The crates whose files are checked, by their root files.
const CRATE_ROOTS: [&str; 9] = [
    "src/lib.rs",
    "src/model/lib.rs",
    "src/compute/lib.rs",
    "src/render/lib.rs",
    "clients/rust/src/lib.rs",
    "clients/rust/src/bin/modalcast-fetch/main.rs",
    "clients/dynamics/src/lib.rs",
    "clients/dynamics/src/main.rs",
    "tests/bench/src/lib.rs",
];

/// A path of module names below the crate root; empty for the root itself.
type ModulePath = Vec<String>;

/// The imports of one file, each as a path from the crate root.
#[derive(Debug, Default)]
struct Module {
    imports: BTreeSet<ModulePath>,
    /// Names that the module re-exports, and the paths of their definitions.
    reexports: BTreeMap<String, ModulePath>,
}

/// All modules of a crate.
type CrateModules = BTreeMap<ModulePath, Module>;

/// Collects the paths that the items of one module name.
struct ImportCollector<'a> {
    module: &'a ModulePath,
    found: Module,
}

impl ImportCollector<'_> {
    /// The path from the crate root of a path that begins with `crate`, `self` or `super`.
    fn absolute_path(&self, segments: &[String]) -> Option<ModulePath> {
        let mut base = match segments.first()?.as_str() {
            "crate" => Vec::new(),
            "self" | "super" => self.module.clone(),
            _ => return None,
        };
        let supers = segments.iter().take_while(|segment| *segment == "super").count();
        base.truncate(base.len().checked_sub(supers)?);
        let names = segments.iter().filter(|name| !["crate", "self", "super"].contains(&name.as_str()));
        Some(base.into_iter().chain(names.cloned()).collect())
    }

    fn add_use_tree(&mut self, tree: &syn::UseTree, prefix: &[String], is_public: bool) {
        let extended = |name: &syn::Ident| [prefix, &[name.to_string()]].concat();
        let (path, name) = match tree {
            syn::UseTree::Path(path) => return self.add_use_tree(&path.tree, &extended(&path.ident), is_public),
            syn::UseTree::Group(group) => {
                return group.items.iter().for_each(|tree| self.add_use_tree(tree, prefix, is_public));
            }
            syn::UseTree::Name(name) => (extended(&name.ident), name.ident.to_string()),
            syn::UseTree::Rename(rename) => (extended(&rename.ident), rename.rename.to_string()),
            syn::UseTree::Glob(_) => (prefix.to_vec(), "*".to_owned()),
        };
        let Some(path) = self.absolute_path(&path) else { return };
        if is_public {
            self.found.reexports.insert(name, path.clone());
        }
        self.found.imports.insert(path);
    }
}

/// Whether the item is compiled for tests only.
fn is_test_only(attributes: &[syn::Attribute]) -> bool {
    attributes.iter().any(|attribute| {
        attribute.path().is_ident("cfg")
            && attribute.parse_args::<syn::Path>().is_ok_and(|condition| condition.is_ident("test"))
    })
}

impl<'ast> Visit<'ast> for ImportCollector<'_> {
    fn visit_item_use(&mut self, item: &'ast syn::ItemUse) {
        if !is_test_only(&item.attrs) {
            let is_public = !matches!(item.vis, syn::Visibility::Inherited);
            self.add_use_tree(&item.tree, &[], is_public);
        }
    }

    fn visit_path(&mut self, path: &'ast syn::Path) {
        let segments: Vec<String> = path.segments.iter().map(|segment| segment.ident.to_string()).collect();
        self.found.imports.extend(self.absolute_path(&segments).filter(|_| segments.len() > 1));
        syn::visit::visit_path(self, path);
    }

    fn visit_item_fn(&mut self, item: &'ast syn::ItemFn) {
        if !is_test_only(&item.attrs) {
            syn::visit::visit_item_fn(self, item);
        }
    }

    fn visit_item_impl(&mut self, item: &'ast syn::ItemImpl) {
        if !is_test_only(&item.attrs) {
            syn::visit::visit_item_impl(self, item);
        }
    }

    /// Submodules are separate modules.
    fn visit_item_mod(&mut self, _: &'ast syn::ItemMod) {}
}

/// The file of the submodule `name` of the module in `file`.
fn file_of_submodule(file: &Path, item: &syn::ItemMod) -> Option<PathBuf> {
    let folder = file.parent()?;
    let explicit = item.attrs.iter().find_map(|attribute| match &attribute.meta {
        syn::Meta::NameValue(pair) if pair.path.is_ident("path") => match &pair.value {
            syn::Expr::Lit(syn::ExprLit { lit: syn::Lit::Str(path), .. }) => Some(path.value()),
            _ => None,
        },
        _ => None,
    });
    if let Some(path) = explicit {
        return Some(folder.join(path));
    }
    let stem = file.file_stem()?.to_str()?;
    let folder = if ["lib", "main", "mod"].contains(&stem) { folder.to_owned() } else { folder.join(stem) };
    let candidates = [folder.join(format!("{}.rs", item.ident)), folder.join(item.ident.to_string()).join("mod.rs")];
    candidates.into_iter().find(|path| path.exists())
}

/// Adds the modules in the items of one module, except those for tests.
fn add_modules(modules: &mut CrateModules, module: ModulePath, (file, items): (&Path, &[syn::Item])) {
    let mut collector = ImportCollector { module: &module, found: Module::default() };
    items.iter().for_each(|item| collector.visit_item(item));
    let found = collector.found;
    for item in items {
        let syn::Item::Mod(item) = item else { continue };
        if is_test_only(&item.attrs) {
            continue;
        }
        let path = [module.as_slice(), &[item.ident.to_string()]].concat();
        match &item.content {
            Some((_, items)) => add_modules(modules, path, (file, items)),
            None => {
                let file = file_of_submodule(file, item).unwrap_or_else(|| panic!("{path:?} has no file"));
                add_modules(modules, path, (&file, &parse(&file)));
            }
        }
    }
    modules.insert(module, found);
}

fn parse(file: &Path) -> Vec<syn::Item> {
    let text = fs::read_to_string(file).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
    syn::parse_file(&text).unwrap_or_else(|error| panic!("{}: {error}", file.display())).items
}

/// The module that defines what `path` names: the longest prefix that is a module, after following re-exports.
fn defining_module(modules: &CrateModules, path: &[String]) -> ModulePath {
    let mut path = path.to_vec();
    // A chain of re-exports is never longer than the depth of the module tree.
    for _ in 0..8 {
        let length = (0..=path.len()).rev().find(|length| modules.contains_key(&path[..*length])).unwrap_or_default();
        let (module, rest) = path.split_at(length);
        let target = rest.first().and_then(|name| modules[module].reexports.get(name));
        match target {
            Some(target) => path = [target.as_slice(), &rest[1..]].concat(),
            None => return module.to_vec(),
        }
    }
    panic!("a cycle of re-exports at {path:?}");
}

/// Imports between modules of which neither contains the other.
fn imports_between_branches(modules: &CrateModules) -> BTreeMap<&ModulePath, BTreeSet<ModulePath>> {
    let edges = |module: &ModulePath, found: &Module| -> BTreeSet<ModulePath> {
        let targets = found.imports.iter().map(|path| defining_module(modules, path));
        targets.filter(|target| !target.starts_with(module) && !module.starts_with(target)).collect()
    };
    modules.iter().map(|(module, found)| (module, edges(module, found))).collect()
}

/// All modules from which imports lead to `start`'s targets, transitively.
fn reachable<'a>(
    edges: &'a BTreeMap<&ModulePath, BTreeSet<ModulePath>>,
    start: &'a ModulePath,
) -> BTreeSet<&'a ModulePath> {
    let (mut seen, mut open) = (BTreeSet::new(), vec![start]);
    while let Some(module) = open.pop() {
        for target in &edges[module] {
            if seen.insert(target) {
                open.push(target);
            }
        }
    }
    seen
}

/// The sets of modules that import each other in a cycle.
fn cycles(modules: &CrateModules) -> BTreeSet<BTreeSet<String>> {
    let edges = imports_between_branches(modules);
    let reachable: BTreeMap<_, _> = edges.keys().map(|module| (*module, reachable(&edges, module))).collect();
    let component = |module: &ModulePath| -> BTreeSet<String> {
        let both = reachable[module].iter().filter(|other| reachable[**other].contains(module));
        both.map(|other| other.join("::")).collect()
    };
    edges.keys().map(|module| component(module)).filter(|component| component.len() > 1).collect()
}

#[test]
fn files_of_each_crate_form_no_import_cycle() {
    let cycles_of = |root: &str| {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join(root);
        let mut modules = CrateModules::new();
        add_modules(&mut modules, Vec::new(), (&file, &parse(&file)));
        assert!(modules.len() > 1, "{root} has submodules");
        cycles(&modules)
    };
    let found: Vec<_> =
        CRATE_ROOTS.iter().map(|root| (root, cycles_of(root))).filter(|(_, found)| !found.is_empty()).collect();
    assert!(found.is_empty(), "{found:#?}");
}

/// A crate whose modules have the given texts.
fn crate_of(texts: &[(&str, &str)]) -> CrateModules {
    let module = |(path, text): &(&str, &str)| {
        let path: ModulePath = path.split("::").filter(|name| !name.is_empty()).map(str::to_owned).collect();
        let items = syn::parse_file(text).expect("Rust").items;
        let mut collector = ImportCollector { module: &path, found: Module::default() };
        items.iter().for_each(|item| collector.visit_item(item));
        let found = collector.found;
        (path, found)
    };
    texts.iter().map(module).collect()
}

#[test]
fn import_cycles_are_detected() {
    let cycle =
        crate_of(&[("", ""), ("a", "use super::b::B;"), ("b", "fn f() { crate::c::f(); }"), ("c", "use crate::a;")]);
    assert_eq!(cycles(&cycle), [["a", "b", "c"].map(str::to_owned).into()].into());
    let hidden = crate_of(&[("", "pub use self::b::B;"), ("a", "use crate::B;"), ("b", "use super::a::A;")]);
    assert_eq!(cycles(&hidden), [["a", "b"].map(str::to_owned).into()].into(), "behind a re-export");
}

#[test]
fn parents_children_and_tests_form_no_cycle() {
    let parent = crate_of(&[("", ""), ("a", "pub use self::b::B;"), ("a::b", "use super::A;")]);
    assert_eq!(cycles(&parent), BTreeSet::new());
    let tests = crate_of(&[("", ""), ("a", "#[cfg(test)] use crate::b::B;"), ("b", "use crate::a::A;")]);
    assert_eq!(cycles(&tests), BTreeSet::new());
}
