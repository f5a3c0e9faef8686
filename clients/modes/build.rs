//! Sets `MODALCAST_BUILD` to a hash of all sources.

#[path = "../../build_hash.rs"]
mod build_hash;

fn main() {
    build_hash::set_build_hash(std::path::Path::new("../.."));
}
