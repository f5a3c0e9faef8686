//! Generates the Rust code of the contract and compares it with the code in `generated`.
//!
//! The generated code is part of the repository, so that users build neither a protobuf compiler nor a code generator.
//! After a change of a `.proto` file, `cargo test -p modalcast-proto` writes the new code and fails once.

use prost::Message as _;
use std::fs;
use std::path::Path;

#[test]
fn generated_code_matches_the_proto_files() {
    let proto_folder = Path::new(env!("CARGO_MANIFEST_DIR"));
    let proto_files =
        ["common", "errors", "scenes", "steps", "frames", "vertices", "states", "forces", "views", "server"]
            .map(|name| format!("modalcast/v1/{name}.proto"));
    // protox is a compiler in Rust, so that no protoc is needed.
    let descriptors = protox::compile(proto_files, [proto_folder]).expect("expected valid .proto files");
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    fs::write(folder.path().join("descriptors.bin"), descriptors.encode_to_vec()).expect("expected a written file");
    tonic_prost_build::configure()
        .bytes(".modalcast.v1")
        .out_dir(folder.path())
        .emit_rerun_if_changed(false)
        .compile_fds(descriptors)
        .expect("expected generated code");

    let mut stale_files = Vec::new();
    for name in ["modalcast.v1.rs", "descriptors.bin"] {
        let generated_bytes = fs::read(folder.path().join(name)).expect("expected a generated file");
        let path = proto_folder.join("generated").join(name);
        if fs::read(&path).ok().as_ref() != Some(&generated_bytes) {
            fs::write(&path, generated_bytes).expect("expected a written file");
            stale_files.push(name);
        }
    }
    assert!(stale_files.is_empty(), "stale files in proto/generated, now rewritten: {stale_files:?}");
}
