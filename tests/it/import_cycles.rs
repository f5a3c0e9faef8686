//! The modules of each crate import each other without cycles. Only a module and its submodules may use each other,
//! because the documentation of the module describes them together.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use syn::visit::Visit;

/// Root files of the checked crates.
const CRATE_ROOTS: [&str; 14] = [
    "src/lib.rs",
    "src/beam/lib.rs",
    "src/model/lib.rs",
    "src/compute/lib.rs",
    "src/render/lib.rs",
    "clients/rust/src/lib.rs",
    "clients/rust/src/bin/modalcast-fetch/main.rs",
    "clients/dynamics/src/lib.rs",
    "clients/dynamics/src/main.rs",
    "clients/recording/src/lib.rs",
    "clients/recording/src/bin/modalcast-record/main.rs",
    "clients/modes/src/lib.rs",
    "clients/modes/src/bin/modalcast-modes/main.rs",
    "tests/bench/src/lib.rs",
];

/// A path of module names below the crate root; empty for the root itself.
type ModulePath = Vec<String>;

/// The imports of one module.
#[derive(Debug, Default)]
struct Module {
    /// Paths of the imported items from the crate root.
    imports: BTreeSet<ModulePath>,
    /// Maps each name that the module re-exports to the path that the `pub use` names.
    reexports: BTreeMap<String, ModulePath>,
}

/// All modules of a crate.
type CrateModules = BTreeMap<ModulePath, Module>;

/// Collects the paths that the items of one module name.
struct ImportCollector<'a> {
    module: &'a ModulePath,
    result: Module,
}

impl ImportCollector<'_> {
    /// Resolves a path that begins with `crate`, `self` or `super` to a path from the crate root.
    fn absolute_path(&self, segments: &[String]) -> Option<ModulePath> {
        let mut base = match segments.first()?.as_str() {
            "crate" => Vec::new(),
            "self" | "super" => self.module.clone(),
            _ => return None,
        };
        // Each `super` removes one name.
        let super_count = segments.iter().take_while(|segment| *segment == "super").count();
        base.truncate(base.len().checked_sub(super_count)?);
        let names = segments.iter().filter(|name| !["crate", "self", "super"].contains(&name.as_str()));
        Some(base.into_iter().chain(names.cloned()).collect())
    }

    /// Adds the imports of a `use` tree. `prefix` is the path before the tree, and `is_public` tells whether the `use`
    /// is a re-export.
    fn add_use_tree(&mut self, tree: &syn::UseTree, prefix: &[String], is_public: bool) {
        let extended_path = |name: &syn::Ident| [prefix, &[name.to_string()]].concat();
        let (path, name) = match tree {
            syn::UseTree::Path(path) => return self.add_use_tree(&path.tree, &extended_path(&path.ident), is_public),
            syn::UseTree::Group(group) => {
                return group.items.iter().for_each(|tree| self.add_use_tree(tree, prefix, is_public));
            }
            syn::UseTree::Name(name) => (extended_path(&name.ident), name.ident.to_string()),
            syn::UseTree::Rename(rename) => (extended_path(&rename.ident), rename.rename.to_string()),
            syn::UseTree::Glob(_) => (prefix.to_vec(), "*".to_owned()),
        };
        let Some(path) = self.absolute_path(&path) else { return };
        if is_public {
            self.result.reexports.insert(name, path.clone());
        }
        self.result.imports.insert(path);
    }
}

/// Whether an item has the attribute `#[cfg(test)]`.
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
        // A path of one segment, such as `self`, names no other module.
        if segments.len() > 1 {
            self.result.imports.extend(self.absolute_path(&segments));
        }
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

    /// [`add_modules`] visits the items of submodules.
    fn visit_item_mod(&mut self, _: &'ast syn::ItemMod) {}
}

/// The file of a submodule of the module in `file`.
fn file_of_submodule(file: &Path, item: &syn::ItemMod) -> Option<PathBuf> {
    let folder = file.parent()?;
    let explicit_path = item.attrs.iter().find_map(|attribute| match &attribute.meta {
        syn::Meta::NameValue(pair) if pair.path.is_ident("path") => match &pair.value {
            syn::Expr::Lit(syn::ExprLit { lit: syn::Lit::Str(path), .. }) => Some(path.value()),
            _ => None,
        },
        _ => None,
    });
    if let Some(path) = explicit_path {
        return Some(folder.join(path));
    }
    let stem = file.file_stem()?.to_str()?;
    let folder = if ["lib", "main", "mod"].contains(&stem) { folder.to_owned() } else { folder.join(stem) };
    let candidates = [folder.join(format!("{}.rs", item.ident)), folder.join(item.ident.to_string()).join("mod.rs")];
    candidates.into_iter().find(|path| path.exists())
}

/// Adds a module and its submodules to `modules`, except submodules for tests. `items` are the items of the module, and
/// `file` is the file that contains them.
fn add_modules(modules: &mut CrateModules, module: ModulePath, (file, items): (&Path, &[syn::Item])) {
    let mut collector = ImportCollector { module: &module, result: Module::default() };
    items.iter().for_each(|item| collector.visit_item(item));
    let result = collector.result;
    for item in items {
        let syn::Item::Mod(item) = item else { continue };
        if is_test_only(&item.attrs) {
            continue;
        }
        let path = [module.as_slice(), &[item.ident.to_string()]].concat();
        match &item.content {
            // An inline module is in the same file.
            Some((_, items)) => add_modules(modules, path, (file, items)),
            None => {
                let file = file_of_submodule(file, item).unwrap_or_else(|| panic!("{path:?} has no file"));
                add_modules(modules, path, (&file, &parse(&file)));
            }
        }
    }
    modules.insert(module, result);
}

fn parse(file: &Path) -> Vec<syn::Item> {
    let text = fs::read_to_string(file).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
    syn::parse_file(&text).unwrap_or_else(|error| panic!("{}: {error}", file.display())).items
}

/// The module that defines the item at `path`. It is the longest prefix of `path` that is a module, unless that module
/// re-exports the next name of `path`; then the search continues at the definition of that name.
fn defining_module(modules: &CrateModules, path: &[String]) -> ModulePath {
    let mut path = path.to_vec();
    // Each round resolves one re-export. No item has more than 8.
    for _ in 0..8 {
        let length = (0..=path.len()).rev().find(|length| modules.contains_key(&path[..*length])).unwrap_or_default();
        let (module, remaining_names) = path.split_at(length);
        let definition = remaining_names.first().and_then(|name| modules[module].reexports.get(name));
        match definition {
            Some(definition) => path = [definition.as_slice(), &remaining_names[1..]].concat(),
            None => return module.to_vec(),
        }
    }
    panic!("expected at most 8 re-exports of an item, got more at {path:?}");
}

/// The modules that each module imports, except its ancestors and descendants.
fn imports_of_unrelated_modules(modules: &CrateModules) -> BTreeMap<&ModulePath, BTreeSet<ModulePath>> {
    let targets_of = |path: &ModulePath, module: &Module| -> BTreeSet<ModulePath> {
        let targets = module.imports.iter().map(|import| defining_module(modules, import));
        targets.filter(|target| !target.starts_with(path) && !path.starts_with(target)).collect()
    };
    modules.iter().map(|(path, module)| (path, targets_of(path, module))).collect()
}

/// All modules that `start` imports, directly or indirectly.
fn reachable_modules<'a>(
    edges: &'a BTreeMap<&ModulePath, BTreeSet<ModulePath>>,
    start: &'a ModulePath,
) -> BTreeSet<&'a ModulePath> {
    let (mut reached, mut pending) = (BTreeSet::new(), vec![start]);
    while let Some(module) = pending.pop() {
        for target in &edges[module] {
            if reached.insert(target) {
                pending.push(target);
            }
        }
    }
    reached
}

/// The sets of modules that import each other in a cycle.
fn find_cycles(modules: &CrateModules) -> BTreeSet<BTreeSet<String>> {
    let edges = imports_of_unrelated_modules(modules);
    let reachable: BTreeMap<_, _> = edges.keys().map(|module| (*module, reachable_modules(&edges, module))).collect();
    // The strongly connected component of a module: the modules that it reaches and that reach it.
    let component = |module: &ModulePath| -> BTreeSet<String> {
        let members = reachable[module].iter().filter(|other| reachable[**other].contains(module));
        members.map(|other| other.join("::")).collect()
    };
    edges.keys().map(|module| component(module)).filter(|component| component.len() > 1).collect()
}

#[test]
fn modules_of_each_crate_form_no_import_cycle() {
    let cycles_of = |root: &str| {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join(root);
        let mut modules = CrateModules::new();
        add_modules(&mut modules, Vec::new(), (&file, &parse(&file)));
        assert!(modules.len() > 1, "expected submodules of {root}");
        find_cycles(&modules)
    };
    let cycles_by_crate: Vec<_> =
        CRATE_ROOTS.iter().map(|root| (root, cycles_of(root))).filter(|(_, cycles)| !cycles.is_empty()).collect();
    assert!(cycles_by_crate.is_empty(), "{cycles_by_crate:#?}");
}

/// The modules of a crate. Each pair is a module path and the source text of the module.
fn parse_crate_modules(texts: &[(&str, &str)]) -> CrateModules {
    let module = |(path, text): &(&str, &str)| {
        let path: ModulePath = path.split("::").filter(|name| !name.is_empty()).map(str::to_owned).collect();
        let items = syn::parse_file(text).expect("expected valid Rust").items;
        let mut collector = ImportCollector { module: &path, result: Module::default() };
        items.iter().for_each(|item| collector.visit_item(item));
        let result = collector.result;
        (path, result)
    };
    texts.iter().map(module).collect()
}

#[test]
fn import_cycles_are_detected() {
    let cycle = parse_crate_modules(&[
        ("", ""),
        ("a", "use super::b::B;"),
        ("b", "fn f() { crate::c::f(); }"),
        ("c", "use crate::a;"),
    ]);
    assert_eq!(find_cycles(&cycle), [["a", "b", "c"].map(str::to_owned).into()].into());
    let cycle_with_reexport =
        parse_crate_modules(&[("", "pub use self::b::B;"), ("a", "use crate::B;"), ("b", "use super::a::A;")]);
    assert_eq!(
        find_cycles(&cycle_with_reexport),
        [["a", "b"].map(str::to_owned).into()].into(),
        "expected to find the cycle through a re-export"
    );
}

#[test]
fn submodules_and_test_imports_form_no_cycle() {
    let parent_and_child = parse_crate_modules(&[("", ""), ("a", "pub use self::b::B;"), ("a::b", "use super::A;")]);
    assert_eq!(find_cycles(&parent_and_child), BTreeSet::new());
    let test_import =
        parse_crate_modules(&[("", ""), ("a", "#[cfg(test)] use crate::b::B;"), ("b", "use crate::a::A;")]);
    assert_eq!(find_cycles(&test_import), BTreeSet::new());
}
