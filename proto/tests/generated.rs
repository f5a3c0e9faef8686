//! Generates the Rust code of the contract and compares it with the code in `generated`.
//!
//! The generated code is part of the repository, so that users build neither a compiler for protobuf nor a code
//! generator. After a change of a `.proto` file, `cargo test -p modalcast-proto` writes the new code.

use prost::Message as _;
use std::fs;
use std::path::Path;

#[test]
fn generated_code_matches_the_proto_files() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let files = ["scenes", "steps", "frames", "vertices", "server"].map(|name| format!("modalcast/v1/{name}.proto"));
    // protox is a compiler in Rust, so that no protoc is needed.
    let descriptors = protox::compile(files, [root]).expect("valid .proto files");
    let out = tempfile::tempdir().expect("a folder");
    fs::write(out.path().join("descriptors.bin"), descriptors.encode_to_vec()).expect("written");
    tonic_prost_build::configure()
        .bytes(".modalcast.v1")
        .out_dir(out.path())
        .emit_rerun_if_changed(false)
        .compile_fds(descriptors)
        .expect("generated code");

    let mut stale = Vec::new();
    for name in ["modalcast.v1.rs", "descriptors.bin"] {
        let generated = fs::read(out.path().join(name)).expect("a generated file");
        let path = root.join("generated").join(name);
        if fs::read(&path).ok().as_ref() != Some(&generated) {
            fs::write(&path, generated).expect("written");
            stale.push(name);
        }
    }
    assert!(stale.is_empty(), "stale files in proto/generated, now rewritten: {stale:?}");
}
