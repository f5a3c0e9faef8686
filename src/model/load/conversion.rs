//! Commands that convert files of other formats, for errors about such files. `clients/python/tests/test_conversions.py`
//! runs each command.

use super::asset_dir::{extension_of, stem_of};

/// How files of other formats become files that the loaders read.
struct Conversion {
    /// In lower case, without the dot.
    extensions: &'static [&'static str],
    /// A command of a POSIX shell. The words INPUT and OUTPUT stand for the names of the files.
    command: &'static str,
    /// Extension of the converted file.
    output: &'static str,
    /// What makes the command available.
    setup: &'static str,
}

/// Conversions of models.
const MODELS: &[Conversion] = &[
    Conversion {
        // Formats that meshio 5.3 reads with all vertices. Its own command `meshio convert` writes no surface of a volume.
        extensions: &[
            "vtk", "vtu", "msh", "inp", "bdf", "nas", "fem", "e", "ex2", "exo", "xdmf", "xmf", "med", "mesh", "meshb",
            "off", "su2", "h5m", "avs", "mdpa", "f3grid", "tec",
        ],
        command: "python3 -m modalcast.surface INPUT OUTPUT",
        output: "ply",
        setup: "`pip install './clients/python[surface]'`",
    },
    Conversion {
        extensions: &["vtp"],
        command: "python3 -m modalcast.surface INPUT OUTPUT",
        output: "ply",
        setup: "`pip install './clients/python[surface]' pyvista`",
    },
    Conversion {
        extensions: &["step", "stp", "iges", "igs"],
        command: "gmsh INPUT -2 -o OUTPUT",
        output: "stl",
        setup: "`pip install gmsh`",
    },
    Conversion {
        extensions: &["fbx", "dae", "3ds", "3mf", "x3d"],
        command: "assimp export INPUT OUTPUT",
        output: "glb",
        setup: "`pip install cmeel-assimp`",
    },
    Conversion {
        extensions: &["blend"],
        command: "blender INPUT --background --python-exit-code 1 --python-expr \
                  'import bpy, sys; bpy.ops.export_scene.gltf(filepath=sys.argv[-1])' -- OUTPUT",
        output: "glb",
        setup: "installing Blender",
    },
    Conversion {
        extensions: &["usd", "usda", "usdc", "usdz"],
        command: "blender --background --python-exit-code 1 --python-expr 'import bpy, sys; \
                  bpy.ops.wm.read_factory_settings(use_empty=True); bpy.ops.wm.usd_import(filepath=sys.argv[-2]); \
                  bpy.ops.export_scene.gltf(filepath=sys.argv[-1])' -- INPUT OUTPUT",
        output: "glb",
        setup: "installing Blender",
    },
    Conversion {
        extensions: &["abc"],
        command: "blender --background --python-exit-code 1 --python-expr 'import bpy, sys; \
                  bpy.ops.wm.read_factory_settings(use_empty=True); bpy.ops.wm.alembic_import(filepath=sys.argv[-2]); \
                  bpy.ops.export_scene.gltf(filepath=sys.argv[-1])' -- INPUT OUTPUT",
        output: "glb",
        setup: "installing Blender",
    },
];

/// Conversions of files with modes, in which U is the name of the array.
const MODES: &[Conversion] = &[
    Conversion {
        extensions: &["mat"],
        command: "python3 -c 'import numpy, scipy.io, sys; \
                  numpy.save(sys.argv[2], scipy.io.loadmat(sys.argv[1])[\"U\"])' INPUT OUTPUT",
        output: "npy",
        setup: "`pip install scipy`",
    },
    Conversion {
        extensions: &["h5", "hdf5"],
        command: "python3 -c 'import h5py, numpy, sys; numpy.save(sys.argv[2], h5py.File(sys.argv[1])[\"U\"])' INPUT OUTPUT",
        output: "npy",
        setup: "`pip install h5py`",
    },
    Conversion {
        extensions: &["csv"],
        command: "python3 -c 'import numpy, sys; \
                  numpy.save(sys.argv[2], numpy.loadtxt(sys.argv[1], delimiter=\",\", ndmin=2))' INPUT OUTPUT",
        output: "npy",
        setup: "`pip install numpy`",
    },
];

/// Decompresses a glTF file.
const COMPRESSED: Conversion = Conversion {
    extensions: &["glb", "gltf"],
    command: "gltf-transform copy INPUT OUTPUT",
    output: "uncompressed.glb",
    setup: "`npm install --global @gltf-transform/cli`",
};

impl Conversion {
    /// The command for the file `name`.
    fn command_for(&self, name: &str) -> String {
        let words = self.command.split(' ').map(|word| match word {
            "INPUT" => shell_word(name),
            "OUTPUT" => shell_word(&format!("{}.{}", stem_of(name), self.output)),
            word => word.to_owned(),
        });
        words.collect::<Vec<_>>().join(" ")
    }

    /// The command for the file `name` in parentheses after a space.
    fn hint(&self, name: &str) -> String {
        format!(" (convert it in its folder with `{}` after {})", self.command_for(name), self.setup)
    }
}

/// A file name as one word of a shell, which is no option.
fn shell_word(name: &str) -> String {
    let name = if name.starts_with('-') { format!("./{name}") } else { name.to_owned() };
    // A name has no NUL, which is the only character that cannot be quoted.
    shlex::try_quote(&name).map_or_else(|_| name.clone(), Into::into)
}

/// Extensions of files with volume meshes, from which `modalcast model` computes modes. `.vtk`, `.vtu` and `.msh` files can
/// also contain surfaces.
const VOLUME_MESHES: [&str; 4] = ["msh", "vtk", "vtu", "veg"];

/// Whether a file has the extension of a volume mesh, from which `modalcast model` computes modes.
pub fn is_volume_mesh(name: &str) -> bool {
    VOLUME_MESHES.contains(&extension_of(name).as_str())
}

/// How a model of another format is used, in parentheses after a space. Empty for an unknown format.
pub(super) fn model_hint(name: &str) -> String {
    let model = match is_volume_mesh(name) {
        true => format!(" (`modalcast model {}` computes the modes of a volume mesh)", shell_word(name)),
        false => String::new(),
    };
    model + &hint(MODELS, name)
}

/// How a compressed glTF file becomes one that is read, as for [`model_hint`].
pub(super) fn compression_hint(name: &str) -> String {
    COMPRESSED.hint(name)
}

/// As [`model_hint`], for a file of modes.
pub(super) fn modes_hint(name: &str) -> String {
    hint(MODES, name)
}

fn hint(conversions: &[Conversion], name: &str) -> String {
    let extension = extension_of(name);
    let conversion = conversions.iter().find(|conversion| conversion.extensions.contains(&extension.as_str()));
    conversion.map_or_else(String::new, |conversion| conversion.hint(name))
}

#[cfg(test)]
mod tests {
    use super::*;

    const PAGE: &str = include_str!("manifest/README.md");

    /// The tests of the commands read the extensions from the page.
    #[test]
    fn page_has_the_commands_of_all_extensions() {
        for conversion in MODELS.iter().chain(MODES) {
            let extensions: Vec<String> = conversion.extensions.iter().map(|name| format!("`.{name}`")).collect();
            let output = format!("OUTPUT.{}", conversion.output);
            let command = conversion.command.replace("OUTPUT", &output);
            let row = format!("| {} | `{command}` | {} |\n", extensions.join(", "), conversion.setup);
            assert!(PAGE.contains(&row), "expected the row {row}");
        }
    }

    #[test]
    fn names_are_words_of_a_shell() {
        let hint = model_hint("an OUTPUT's.STEP");
        assert!(hint.contains("`gmsh \"an OUTPUT's.STEP\" -2 -o \"an OUTPUT's.stl\"`"), "{hint}");
        let hint = model_hint("-a.dae");
        assert_eq!(
            hint,
            " (convert it in its folder with `assimp export ./-a.dae ./-a.glb` after `pip install cmeel-assimp`)"
        );
        assert_eq!([model_hint("a.obj"), modes_hint("a.vtk"), model_hint("vtk")], [""; 3]);
        assert_eq!(model_hint("a.veg"), " (`modalcast model a.veg` computes the modes of a volume mesh)");
        let hint = model_hint("a b.VTU");
        assert!(
            hint.starts_with(" (`modalcast model 'a b.VTU'` computes the modes of a volume mesh) (convert"),
            "{hint}"
        );
    }
}
