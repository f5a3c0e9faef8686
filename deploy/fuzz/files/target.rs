//! The targets of model files. Each opens a small scene with one file that has the content of the input. The fuzzer and
//! `replay.rs` run them.

#[path = "../temporary_folder.rs"]
mod temporary_folder;

use std::fs;
use std::path::PathBuf;

use modalcast_model::load::SceneRepository;
use modalcast_model::memory::{MemoryBudget, MemoryKind, MemoryReservation};
use temporary_folder::temporary_folder;

/// The memory in bytes that a scene may take.
const MAX_MEMORY: u64 = 256 << 20;

/// The names of all targets.
pub(crate) const TARGETS: [&str; 16] = [
    "glb",
    "gltf",
    "image",
    "manifest",
    "mtl",
    "npy",
    "npz",
    "obj",
    "plant",
    "ply",
    "safetensors",
    "skeleton",
    "sofa",
    "stl",
    "vega",
    "vega_config",
];

/// A square of two triangles with the materials `a` and `b`.
const SQUARE: &str = "mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nusemtl a\n\
                      f 1/1 2/2 3/3\nusemtl b\nf 1/1 3/2 4/3\n";

/// A PNG image of one pixel.
pub(crate) const PIXEL: [u8; 70] = [
    0x89, 0x50, 0x4e, 0x47, 0x0d, 0x0a, 0x1a, 0x0a, 0x00, 0x00, 0x00, 0x0d, 0x49, 0x48, 0x44, 0x52, 0x00, 0x00, 0x00,
    0x01, 0x00, 0x00, 0x00, 0x01, 0x08, 0x06, 0x00, 0x00, 0x00, 0x1f, 0x15, 0xc4, 0x89, 0x00, 0x00, 0x00, 0x0d, 0x49,
    0x44, 0x41, 0x54, 0x78, 0xda, 0x63, 0xf8, 0xcf, 0xc0, 0xf0, 0x1f, 0x00, 0x05, 0x00, 0x01, 0xff, 0x56, 0xc7, 0x2f,
    0x0d, 0x00, 0x00, 0x00, 0x00, 0x49, 0x45, 0x4e, 0x44, 0xae, 0x42, 0x60, 0x82,
];

/// Where the input of a target is written.
enum Input {
    /// A file of this name.
    File(&'static str),
    /// The structure and the object ids of a plant, separated by a NUL byte.
    Plant,
}

/// A target with the other files of its scene, in a temporary folder.
pub(crate) struct FileTarget {
    folder: tempfile::TempDir,
    repository: SceneRepository,
    input: Input,
    /// The scene that is opened: a file, or `.` for the folder.
    scene: &'static str,
}

impl FileTarget {
    /// # Panics
    /// If there is no target of this name, or the temporary folder is not writable.
    pub(crate) fn new(name: &str) -> Self {
        let texture: &[(&str, &[u8])] =
            &[("m.obj", SQUARE.as_bytes()), ("m.mtl", b"newmtl a\nmap_Kd t.png\nnewmtl b\nKd 1 0 0\n")];
        let square: &[(&str, &[u8])] = &[("m.obj", SQUARE.as_bytes())];
        let square_with_image = [square, &[("t.png", &PIXEL)]].concat();
        let (scene, input, others) = match name {
            "glb" => ("m.glb", Input::File("m.glb"), &[][..]),
            "gltf" => ("m.gltf", Input::File("m.gltf"), &[("t.png", &PIXEL[..])][..]),
            "image" => ("m.obj", Input::File("t.png"), texture),
            "manifest" => (".", Input::File("scene.toml"), &square_with_image[..]),
            "mtl" => ("m.obj", Input::File("m.mtl"), &square_with_image[..]),
            "npy" => ("m.obj", Input::File("m.npy"), square),
            "npz" => ("m.npz", Input::File("m.npz"), &[][..]),
            "obj" => ("m.obj", Input::File("m.obj"), &[][..]),
            "plant" => ("m.obj", Input::Plant, square),
            "ply" => ("m.ply", Input::File("m.ply"), &[][..]),
            "safetensors" => ("m.obj", Input::File("m.safetensors"), square),
            "skeleton" => ("m.structure.json", Input::File("m.structure.json"), &[][..]),
            "sofa" => ("m.obj", Input::File("modes.txt"), square),
            "stl" => ("m.stl", Input::File("m.stl"), &[][..]),
            "vega" => ("m.obj", Input::File("m.URendering.float"), square),
            "vega_config" => ("m.obj", Input::File("m.config"), square),
            _ => panic!("MODALCAST_FUZZ_TARGET: expected one of {TARGETS:?}, got {name:?}"),
        };
        let folder = temporary_folder();
        for (file, content) in others {
            fs::write(folder.path().join(file), content).expect("expected a writable folder");
        }
        let repository = SceneRepository::new(Some(folder.path())).expect("expected a readable folder");
        Self { folder, repository, input, scene }
    }

    /// Opens the scene. Returns false if the loader rejects the input.
    ///
    /// # Panics
    /// If the temporary folder is not writable, or the loader panics.
    pub(crate) fn run(&self, input: &[u8]) -> bool {
        let write = |name: &str, content: &[u8]| {
            fs::write(self.path(name), content).expect("expected a writable folder");
        };
        match self.input {
            Input::File(name) => write(name, input),
            Input::Plant => {
                let end = input.iter().position(|byte| *byte == 0).unwrap_or(input.len());
                write("m.structure.json", &input[..end]);
                write("m_object_id.dat", input.get(end + 1..).unwrap_or_default());
            }
        }
        let budget = MemoryBudget::new(MemoryKind::Host, MAX_MEMORY, MAX_MEMORY);
        self.repository.open(self.scene, &MemoryReservation::new(&budget)).is_ok()
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }
}
