//! Sets `MODALCAST_BUILD` to a hash of all sources.

mod build_hash;

fn main() {
    build_hash::set_build_hash(std::path::Path::new(""));
}
