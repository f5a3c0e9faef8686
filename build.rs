//! Sets `MODALCAST_BUILD` to a hash of all sources, so that `modalcast` can check that `modalcast-report` was built
//! from the same sources.

use std::fs;
use std::path::{Path, PathBuf};

const SOURCES: [&str; 7] = ["Cargo.lock", "Cargo.toml", "clients/web/dist", "kernels", "proto", "shaders", "src"];

fn main() {
    let mut paths = Vec::new();
    for source in SOURCES {
        println!("cargo::rerun-if-changed={source}");
        collect_files(Path::new(source), &mut paths);
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
