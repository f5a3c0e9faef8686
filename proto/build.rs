//! Compiles the contract with protox, so that no protoc is needed.

use prost::Message as _;
use std::{env, fs, path::PathBuf};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let files = ["scenes", "steps", "frames", "vertices", "server"].map(|name| format!("modalcast/v1/{name}.proto"));
    println!("cargo:rerun-if-changed=modalcast/v1");
    let descriptors = protox::compile(&files, ["."])?;
    let out = PathBuf::from(env::var("OUT_DIR")?);
    fs::write(out.join("descriptors.bin"), descriptors.encode_to_vec())?;
    tonic_prost_build::configure().bytes(".modalcast.v1").compile_fds(descriptors)?;
    Ok(())
}
