//! The entries of a folder, and what the search for modes derives from their names. A load lists a folder once, so that
//! its time does not grow with the square of the number of models in the folder.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

/// The largest number of listings that a load keeps.
const MAX_LISTINGS: usize = 64;

/// The kind of an existing path.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum EntryKind {
    File,
    Directory,
}

/// Names and kinds of a folder's direct entries.
#[derive(Debug)]
pub(super) struct FolderListing {
    /// Sorted by name.
    entries: Vec<(String, EntryKind)>,
    /// Indices of entries by the lower-case form of their names, sorted.
    by_lower_case: OnceLock<HashMap<String, Vec<usize>>>,
    modes_names: OnceLock<ModesNames>,
}

/// The file names of a folder that the search for modes reads.
#[derive(Debug, Default)]
pub(super) struct ModesNames {
    /// Names of the models.
    pub(super) models: Vec<String>,
    /// Names that look like modes and begin with the name of no model, sorted.
    pub(super) unclaimed: Vec<String>,
    /// By model, the names that look like modes and begin with the name of this model only, sorted.
    pub(super) claimed: HashMap<String, Vec<String>>,
}

impl FolderListing {
    pub(super) fn new(mut entries: Vec<(String, EntryKind)>) -> Self {
        entries.sort_by(|a, b| a.0.cmp(&b.0));
        Self { entries, by_lower_case: OnceLock::new(), modes_names: OnceLock::new() }
    }

    /// Names and kinds, sorted by name.
    pub(super) fn entries(&self) -> &[(String, EntryKind)] {
        &self.entries
    }

    /// Names of the files, sorted.
    pub(super) fn file_names(&self) -> impl Iterator<Item = &str> {
        self.entries.iter().filter(|(_, kind)| *kind == EntryKind::File).map(|(name, _)| name.as_str())
    }

    /// The names of this kind that equal `name` in any letter case, sorted.
    pub(super) fn names_ignoring_case(&self, name: &str, kind: EntryKind) -> impl Iterator<Item = &str> {
        let by_lower_case = self.by_lower_case.get_or_init(|| {
            let mut indices: HashMap<String, Vec<usize>> = HashMap::new();
            for (index, (name, _)) in self.entries.iter().enumerate() {
                indices.entry(name.to_lowercase()).or_default().push(index);
            }
            indices
        });
        let entries = by_lower_case.get(&name.to_lowercase()).into_iter().flatten().map(|index| &self.entries[*index]);
        entries.filter(move |(_, entry_kind)| *entry_kind == kind).map(|(name, _)| name.as_str())
    }

    /// The names for the search for modes. The first call derives them with `derive`.
    pub(super) fn modes_names(&self, derive: impl FnOnce() -> ModesNames) -> &ModesNames {
        self.modes_names.get_or_init(derive)
    }
}

/// The listings of one load.
#[derive(Debug, Default)]
pub(super) struct ListingCache {
    /// By the paths of their folders.
    listings: Mutex<HashMap<PathBuf, Arc<FolderListing>>>,
    #[cfg(test)]
    count: std::sync::atomic::AtomicUsize,
}

impl ListingCache {
    /// The listing of a folder. Creates it with `list` unless it is in the cache.
    pub(super) fn get_or_list(&self, folder: &Path, list: impl FnOnce() -> FolderListing) -> Arc<FolderListing> {
        let mut listings = self.listings.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(listing) = listings.get(folder) {
            return Arc::clone(listing);
        }
        // A search through many folders reads each of them once.
        if listings.len() >= MAX_LISTINGS {
            listings.clear();
        }
        #[cfg(test)]
        self.count.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
        let listing = Arc::new(list());
        listings.insert(folder.to_owned(), Arc::clone(&listing));
        listing
    }

    /// How many listings were created.
    #[cfg(test)]
    pub(super) fn count(&self) -> usize {
        self.count.load(std::sync::atomic::Ordering::Relaxed)
    }
}
