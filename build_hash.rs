//! Computes the hash of all sources. The build scripts of `modalcast` and of the programs that it starts store this
//! hash in their programs, and `modalcast` starts only programs with its own hash.

use std::fs;
use std::path::{Path, PathBuf};

const SOURCES: [&str; 7] = ["Cargo.lock", "Cargo.toml", "clients/web/dist", "kernels", "proto", "shaders", "src"];

/// Sets `MODALCAST_BUILD` to the hash of the sources in the folder of the repository.
pub(crate) fn set_build_hash(repository: &Path) {
    let mut paths = Vec::new();
    for source in SOURCES {
        let path = repository.join(source);
        println!("cargo::rerun-if-changed={}", path.display());
        collect_files(&path, &mut paths);
    }
    paths.sort();
    // The 64-bit FNV-1a hash. The first constant is its offset basis, the second its prime.
    let hash = paths
        .iter()
        .flat_map(|path| fs::read(path).unwrap_or_default())
        .fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3));
    println!("cargo::rustc-env=MODALCAST_BUILD={hash:016x}");
}

fn collect_files(path: &Path, paths: &mut Vec<PathBuf>) {
    match fs::read_dir(path) {
        Ok(entries) => entries.flatten().for_each(|entry| collect_files(&entry.path(), paths)),
        Err(_) => paths.push(path.to_owned()),
    }
}
