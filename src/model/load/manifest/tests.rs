//! Tests of the manifest with small models.

use super::*;
use crate::backend_settings::{BackendSettings, BatchPolicy, RasterPolicy};
use crate::domain::{AlphaMode, Transform};
use crate::scene::{
    AmbientOcclusion, Antialiasing, Bloom, Culling, DeformationSettings, LookOverrides, LookPreset, MomentFormat,
    NormalMethod, PresetRequest, RenderSettings, SceneParts, ShadowMethod, ShadowSettings, StorageType, ToneMapping,
};

const TRIANGLE: &str = "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl red\nf 1 2 3\n";

/// Vertices of two triangles at a right angle.
const ROOF: &str = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n";

/// Reads a manifest from a folder that also contains two equal models of one triangle with the material `red`, modes
/// for them (`u.txt`, two modes), modes with a wrong number of entries (`wide.txt`), two triangles at a right
/// angle without and with normals, and an opaque and a transparent image.
fn read_manifest(toml: &str) -> Result<SceneDescription> {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).expect("a writable file");
    write("a.obj", TRIANGLE);
    write("b.obj", TRIANGLE);
    write("roof.obj", &format!("{ROOF}f 1 2 3\nf 2 1 4\n"));
    write("smooth.obj", &format!("{ROOF}vn 0 1 1\nf 1//1 2//1 3//1\nf 2//1 1//1 4//1\n"));
    write("a.mtl", "newmtl red\nKd 1 0 0\nmap_Kd solid.png\n");
    write("u.txt", "9 2\n1 0 0 0 0 0 0 0 0\n0 1 0 0 0 0 0 0 0\n");
    write("wide.txt", "9 1\n1 1 1 1 1 1 1 1 1 1\n");
    for (name, alpha) in [("solid.png", 255), ("leaf.png", 9)] {
        let image = image::RgbaImage::from_pixel(1, 1, image::Rgba([1, 2, 3, alpha]));
        image.save(folder.path().join(name)).expect("a writable file");
    }
    write(MANIFEST_FILE, toml);
    read(&AssetDir::unrestricted(folder.path()), MANIFEST_FILE, "folder", &LoadOptions::default())
}

fn read_parts(toml: &str) -> Result<SceneParts> {
    read_manifest(toml).map(|description| description.parts)
}

#[test]
fn ambient_occlusion_is_removed_or_set_by_a_key() {
    let radius = |keys: &str| {
        let parts = read_parts(&format!("model = 'a.obj'\n{keys}\n")).unwrap_or_else(|error| panic!("{keys}: {error}"));
        parts.look.ambient_occlusion.map(|occlusion| occlusion.radius)
    };
    let default = AmbientOcclusion::default().radius;
    for (keys, expected) in [
        ("look.lighting = 'studio'", Some(default)),
        ("look.lighting = 'outdoor'", None),
        ("ambient_occlusion = false\nlook.lighting = 'studio'", None),
        ("ambient_occlusion = true\nlook.lighting = 'outdoor'", Some(default)),
        ("look = { lighting = 'studio', ambient_occlusion = { radius = 0.5 } }", Some(0.5)),
    ] {
        assert_eq!(radius(keys), expected, "{keys}");
    }
}

/// Some keys and values differ from the names in Rust: `splits` is the number of cascades, the method "filtered" is
/// [`ShadowMethod::PercentageCloser`], and the culling "depth" is [`Culling::Occlusion`].
#[test]
fn scene_keys_override_the_defaults() {
    let SceneDescription { parts, backends } = read_manifest(
        "name = 'n'\nup = 'z'\nunit = 0.01\norigin = [1.5, 0, 0]\ntransforms = 'rigid'\nshadows = false\n\
         model = 'a.obj'\nmodes = 'u.txt'\nplacement = { translation = [1, 2, 3] }\nlook.sunlight = [2, 2, 2]\n\
         look.antialias = 'fxaa'\nlook.bloom.strength = 0.25\nlook.tone = 'aces'\nlook.exposure = 1.5\n\
         look.dither = true\nlook.culling = 'depth'\nlook.raster = 'fastest'\n\
         deform = { storage = 'int8', normals = 'exact', displacements = true, batches = 'never' }\n",
    )
    .expect("a valid manifest");
    assert_eq!((parts.name.as_str(), parts.up, parts.unit), ("n", UpAxis::Z, Some(0.01)));
    assert_eq!((parts.origin, parts.rigid_transforms), ([1.5, 0.0, 0.0], true));
    assert!(parts.look.shadow.is_none() && parts.look.ground.is_some());
    assert_eq!(backends, BackendSettings { raster: RasterPolicy::Fastest, batches: BatchPolicy::Never });
    assert_eq!(parts.look.sunlight, [2.0; 3]);
    assert_eq!(parts.look.bloom, Some(Bloom { strength: 0.25, ..Bloom::default() }));
    assert_eq!((parts.look.antialias, parts.look.tone), (Antialiasing::Fxaa, ToneMapping::Aces));
    assert_eq!((parts.look.exposure, parts.look.dither, parts.look.culling), (1.5, true, Culling::Occlusion));
    let deformation = DeformationSettings {
        storage: StorageType::Int8,
        normals: NormalMethod::Exact,
        displacements: true,
        ..DeformationSettings::default()
    };
    assert_eq!(parts.deformation, deformation);
    assert_eq!(parts.shapes[0].modes.rank(), 2);
    assert_eq!(parts.domains[0].placement.translation(), nalgebra::Vector3::new(1.0, 2.0, 3.0));
    let shadow_toml =
        "model = 'a.obj'\nlook.shadow = { method = 'filtered', size = 512, splits = 3, moments = 'f16' }\n";
    let shadow = ShadowSettings {
        method: ShadowMethod::PercentageCloser,
        size: 512,
        cascades: 3,
        moments: MomentFormat::F16,
        ..ShadowSettings::default()
    };
    assert_eq!(read_parts(shadow_toml).expect("a valid manifest").look.shadow, Some(shadow));
    for invalid_key in ["method = 'ray'", "splits = -1", "blurring = 'tiles'"] {
        let toml = format!("model = 'a.obj'\nlook.shadow = {{ {invalid_key} }}\n");
        let message = read_parts(&toml).expect_err(invalid_key).to_string();
        assert!(message.contains("line 2"), "{message}");
    }
    let SceneDescription { parts, backends } = read_manifest("model = 'a.obj'\n").expect("a valid manifest");
    let default_look = RenderSettings::default().with_preset(PresetRequest::default());
    assert_eq!((parts.look, backends), (default_look, BackendSettings::default()));
    assert_eq!((parts.name.as_str(), parts.up, parts.rigid_transforms), ("folder", UpAxis::Y, false));
    assert_eq!(parts.deformation, DeformationSettings::default());
    let message =
        read_parts("model = 'a.obj'\ndeform.storage = 'int3'\n").expect_err("an unknown storage type").to_string();
    assert!(message.contains("int3"), "{message}");
}

#[test]
fn instances_share_mesh_and_modes_but_not_coordinates_or_names() {
    let parts = read_parts(
        "[[domain]]\nmodel = 'a.obj'\nmodes = 'u.txt'\n[[domain]]\nmodel = './a.obj'\nmodes = 'u.txt'\n\
         placement.scale = 2\n[[domain]]\nmodel = 'b.obj'\nmodes = ''\n",
    )
    .expect("a valid manifest");
    assert_eq!(parts.shapes.len(), 2);
    assert_eq!(parts.domains.iter().map(|domain| domain.shape).collect::<Vec<_>>(), [0, 0, 1]);
    let names: Vec<_> = parts.domains.iter().map(|domain| domain.name.as_str()).collect();
    assert_eq!(names, ["a", "a 2", "b"]);
    // Each of the two instances has two coordinates of its own.
    let scene = crate::scene::Scene::new(parts).expect("a valid scene");
    assert_eq!((scene.layout.coordinates, scene.layout.domains[1].first_q), (4, 2));
}

#[test]
fn numbers_of_unnamed_instances_skip_names_in_use() {
    let names = |toml: &str| {
        let parts = read_parts(toml).expect("a valid manifest");
        parts.domains.into_iter().map(|domain| domain.name).collect::<Vec<_>>()
    };
    let entry = "[[domain]]\nmodel = 'a.obj'\n";
    let toml = format!("{}{entry}name = 'a 3'\n{}", entry.repeat(2), entry.repeat(2));
    assert_eq!(names(&toml), ["a", "a 2", "a 3", "a 4", "a 5"]);
}

/// The time of a load must not grow with the square of the number of models.
#[test]
fn folder_is_listed_once_for_all_of_its_models() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let mut toml = String::new();
    for index in 0..20 {
        std::fs::write(folder.path().join(format!("{index}.obj")), TRIANGLE).expect("a writable file");
        toml += &format!("[[domain]]\nmodel = '{index}.obj'\n");
    }
    std::fs::write(folder.path().join(MANIFEST_FILE), toml).expect("a writable file");
    let files = AssetDir::unrestricted(folder.path());
    read(&files, MANIFEST_FILE, "folder", &LoadOptions::default()).expect("a valid scene");
    assert_eq!(files.listing_count(), 1);
}

#[test]
fn crease_angle_of_an_entry_overrides_that_of_the_scene() {
    // Two triangles at a right angle: `roof.obj` has no normals, `smooth.obj` has the same normal at all vertices.
    let corners = |toml: &str| {
        let parts = read_parts(toml).unwrap_or_else(|error| panic!("{toml}: {error}"));
        let corners = |domain: &crate::domain::Domain| parts.shapes[domain.shape].mesh.corners().vertices.len();
        (parts.shapes.len(), parts.domains.iter().map(corners).collect::<Vec<_>>())
    };
    assert_eq!(corners("model = 'roof.obj'\n"), (1, vec![6]), "expected a hard edge by default");
    assert_eq!(corners("model = 'roof.obj'\ncrease_angle = 91\n"), (1, vec![4]));
    assert_eq!(corners("model = 'smooth.obj'\ncrease_angle = 0\n"), (1, vec![4]), "expected the normals of the file");
    let entries = "crease_angle = 180\n[[domain]]\nmodel = 'roof.obj'\n[[domain]]\nmodel = 'roof.obj'\n\
                   crease_angle = 89.5\n[[domain]]\nmodel = 'roof.obj'\n";
    assert_eq!(corners(entries), (2, vec![4, 6, 4]), "expected two shapes for three entries");
    for (angle, given) in [("-1", "-1"), ("181", "181"), ("nan", "NaN")] {
        let message =
            read_parts(&format!("model = 'roof.obj'\ncrease_angle = {angle}\n")).expect_err(angle).to_string();
        let expected = format!("crease_angle: expected 0 to 180 degrees, got {given}");
        assert!(message.ends_with(&expected), "{message}");
    }
}

#[test]
fn child_attaches_by_frame_or_by_placement() {
    let parts = read_parts(
        "[[domain]]\nname = 'trunk'\nmodel = 'a.obj'\nmodes = 'u.txt'\nplacement = { translation = [10, 0, 0], axis = [0, 0, 1], degrees = 90 }\n\
         [[domain]]\nname = 'by frame'\nmodel = 'b.obj'\nparent = 'trunk'\nframe.translation = [1, 0, 0]\nparent_vertices = [1]\n\
         [[domain]]\nname = 'by place'\nmodel = 'b.obj'\nparent = 'trunk'\nplacement.translation = [10, 1, 0]\n",
    )
    .expect("a valid manifest");
    let [_, by_frame, by_placement] = &parts.domains[..] else { panic!("three domains") };
    let translation = |transform: Transform| transform.translation().map(|x| (x * 1e4).round() / 1e4);
    // The trunk at (10, 0, 0) is rotated by 90 degrees about z, which maps (1, 0, 0) to (0, 1, 0).
    assert_eq!(translation(by_frame.placement), nalgebra::Vector3::new(10.0, 1.0, 0.0));
    // Without `parent_vertices`, the nearest eight vertices of the parent are used. The trunk has only three.
    for (child, vertices) in [(by_frame, &[1][..]), (by_placement, &[0, 1, 2])] {
        let attachment = child.attachment.as_ref().expect("an attachment");
        assert_eq!(translation(attachment.frame), nalgebra::Vector3::x(), "{}", child.name);
        assert_eq!((attachment.parent, &attachment.vertices[..]), (0, vertices), "{}", child.name);
    }
}

/// The value of `follows` is a prefix of domain names. The empty prefix matches all domains of the entry.
#[test]
fn follows_constrains_the_domains_whose_names_have_its_prefix() {
    let read_child = |follows_line: &str| {
        read_parts(&format!(
            "[[domain]]\nname = 'trunk'\nmodel = 'a.obj'\nplacement = {{ translation = [10, 0, 0], axis = [0, 0, 1], degrees = 90 }}\n\
             [[domain]]\nname = 'leaf'\nmodel = 'b.obj'\nparent = 'trunk'\nframe.translation = [1, 0, 0]\n{follows_line}"
        ))
    };
    assert!(read_child("").expect("a valid manifest").domains[1].follows.is_none());
    let parts = read_child("follows = ''\n").expect("a valid manifest");
    let constraint = parts.domains[1].follows.expect("a follow constraint");
    let attachment = parts.domains[1].attachment.clone();
    assert_eq!((constraint.parent, Some(constraint.frame)), (0, attachment.map(|attachment| attachment.frame)));
    let placement = parts.domains[1].placement;
    let scene = crate::scene::Scene::new(parts).expect("a valid scene");
    assert_eq!(scene.transform_roots.count(), 1);
    let differences = scene.domains[1].placement.0.iter().zip(placement.0).map(|(a, b)| (a - b).abs());
    assert!(differences.fold(0.0, f32::max) < 1e-5, "expected an unchanged placement");
    let message = read_child("follows = 'nobody'\n").map(drop).expect_err("an unknown prefix").to_string();
    assert!(message.contains("follows: expected a prefix of the name of a domain that has a parent"), "{message}");
}

#[test]
fn overrides_apply_per_material_and_per_entry() {
    let parts = read_parts(
        "[material.red]\ncolor_texture = 'leaf.png'\n[material.'*']\nshininess = 9\n\
         [[domain]]\nmodel = 'a.obj'\n[[domain]]\nmodel = 'a.obj'\nmaterial = { diffuse = [0, 1, 0] }\n",
    )
    .expect("a valid manifest");
    let [model_material, entry_material] = &parts.materials[..] else { panic!("two materials") };
    assert_eq!((model_material.shininess, model_material.alpha_mode), (9.0, AlphaMode::Mask { cutoff: 0.5 }));
    assert_eq!((model_material.diffuse, entry_material.diffuse), ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]));
    assert_eq!(parts.domains.iter().map(|domain| domain.material).collect::<Vec<_>>(), [0, 1]);
    let texture_names: Vec<_> = parts.textures.iter().map(|texture| texture.name.as_str()).collect();
    assert_eq!(texture_names, ["leaf.png"], "expected the replaced texture to be removed");
    assert_eq!((model_material.color_texture, entry_material.color_texture), (Some(0), Some(0)));
}

#[test]
fn up_axis_of_an_entry_is_rotated_to_that_of_the_scene() {
    let toml = "up = 'z'\n[[domain]]\nmodel = 'a.obj'\nup = 'y'\n[[domain]]\nmodel = 'b.obj'\n";
    let parts = read_parts(toml).expect("a valid manifest");
    let up = parts.domains[0].placement.linear() * nalgebra::Vector3::y();
    assert!((up - nalgebra::Vector3::z()).norm() < 1e-6, "{up}");
    assert_eq!(parts.domains[1].placement, Transform::IDENTITY);
    let remark = "model 'b.obj': not rotated: Y is up by default in its format, and Z in this scene. Set `up` in its \
                  entry to the model's up axis";
    assert_eq!(parts.remarks.last().map(String::as_str), Some(remark));
}

#[test]
fn eigenvalues_and_notes_become_metadata() {
    let keys = "model = 'a.obj'\nmodes = 'u.txt'\neigenvalues = [1.5, 2.5]\nnotes = { who = 'me' }\n";
    for text in [keys.to_owned(), format!("[[domain]]\n{keys}")] {
        let parts = read_parts(&text).expect("a valid manifest");
        assert_eq!(parts.domains[0].metadata.eigenvalues, [1.5, 2.5]);
        assert_eq!(parts.domains[0].metadata.notes["who"], "me");
        assert_eq!(parts.domains[0].metadata.notes["modes.file"], "u.txt");
    }
}

#[test]
fn invalid_manifest_is_rejected_with_line_or_entry() {
    for (text, start) in [
        ("", "model: expected one model or [[domain]] entries, got neither"),
        ("color = 1\n", "line 1: expected the keys and values of a scene, got unknown field `color`"),
        ("model = 'a.obj'\nup = 'w'\n", "line 2: expected the keys and values of a scene, got unknown variant `w`"),
        ("model = \n", "line 1: expected the keys and values of a scene"),
        ("model = 'a.obj'\n[look]\nsky = 1\n", "line 3: expected the keys and values of a scene, got unknown field"),
        (
            "deform.truncation = 1e-4\n",
            "line 1: expected the keys and values of a scene, got unknown field `truncation`",
        ),
        ("model = 'a.obj'\n[[domain]]\nmodel = 'b.obj'\n", "model: expected either one model"),
        ("modes = 'u.txt'\n[[domain]]\nmodel = 'b.obj'\n", "modes: expected this key in the [[domain]] entries"),
        ("[[domain]]\nname = 'x'\n", "line 1: expected the keys and values of a scene, got missing field `model`"),
        ("model = 'c.obj'\n", "domain 0 ('c.obj'): file 'c.obj': expected an existing file"),
        ("model = 'a.mtl'\n", "domain 0 ('a.mtl'): file 'a.mtl': expected a file ending in .glb"),
        ("model = 'a.obj'\nmodes = 'wide.txt'\n", "domain 0 ('a.obj'): file 'wide.txt': values: expected 9 x 1 values"),
        ("model = 'a.obj'\nmodes = 'no.npy'\n", "domain 0 ('a.obj'): file 'no.npy': expected an existing file"),
        ("model = 'a.obj'\nplacement.scale = inf\n", "domain 0 ('a.obj'): placement: transform[0]"),
        ("model = 'a.obj'\nmaterial.green.alpha = 1\n", "material: expected * or one of: red, got green"),
        (
            "model = 'a.obj'\nmaterial.red.color_texture = 'x.png'\n",
            "domain 0 ('a.obj'): material 'red': color_texture: file 'x.png'",
        ),
        ("[[domain]]\nmodel = 'a.obj'\nparent = 'x'\n", "domain 0 ('a.obj'): parent: expected the name of a domain"),
        (
            "[[domain]]\nmodel = 'a.obj'\nparent_vertices = [1]\n",
            "domain 0 ('a.obj'): parent: expected a parent for the keys",
        ),
        (
            "[[domain]]\nmodel = 'a.obj'\neigenvalues = [1]\n",
            "domain 0 ('a.obj'): eigenvalues: expected one domain, and one finite",
        ),
        (
            "[[domain]]\nname = 'x'\nmodel = 'a.obj'\n[[domain]]\nname = 'x'\nmodel = 'b.obj'\n",
            "domain 1 ('b.obj'): name: expected a name that no earlier domain has, got x",
        ),
        (
            "[[domain]]\nname = 'x'\nmodel = 'a.obj'\nplacement.scale = 0\n[[domain]]\nmodel = 'b.obj'\nparent = 'x'\n",
            "domain 1 ('b.obj'): parent: expected a parent whose placement has an inverse",
        ),
        (
            "[[domain]]\nname = 'x'\nmodel = 'a.obj'\n[[domain]]\nmodel = 'b.obj'\nparent = 'x'\nframe = {}\nplacement = {}\n",
            "domain 1 ('b.obj'): frame, placement: expected only one",
        ),
    ] {
        let message = read_parts(text).expect_err(text).to_string();
        let expected = format!("file 'scene.toml': {start}");
        assert!(message.starts_with(&expected), "{message}");
    }
    let nested_arrays = format!("model = {}", "[".repeat(100_000));
    assert!(read_parts(&nested_arrays).is_err(), "expected an error instead of a stack overflow");
    let parts = read_parts("model = 'a.obj'\nmaterial.red.alpha = 7\n").expect("a valid manifest");
    let message = crate::scene::Scene::new(parts).expect_err("an invalid alpha").to_string();
    assert_eq!(message, "material 'red': alpha: expected 0 to 1, got 7");
}

#[test]
fn unrestricted_manifest_accepts_absolute_paths() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    std::fs::write(folder.path().join("x.obj"), "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").expect("a writable file");
    let path = folder.path().join("x.obj");
    let parts = read_parts(&format!("model = '{}'\n", path.display())).expect("a valid manifest");
    assert_eq!(parts.domains[0].name, "x");
    assert!(path.is_absolute());
}

/// A preset by name, by key, and with overrides. Keys that are set win over the preset.
#[test]
fn look_is_a_preset_or_a_table_with_overrides() {
    let request = |look: &str| {
        let parts = read_parts(&format!("model = 'a.obj'\n{look}\n")).unwrap_or_else(|error| panic!("{look}: {error}"));
        crate::scene::Scene::new(parts).expect("a valid scene").look.preset.expect("a preset request")
    };
    let preview = PresetRequest { preset: Some(LookPreset::Preview), ..PresetRequest::default() };
    assert_eq!(request(""), PresetRequest::default());
    assert_eq!((request("look = 'preview'"), request("look.preset = 'preview'")), (preview, preview));
    let overrides = LookOverrides { samples: Some(4), shadow_size: Some(256), ..LookOverrides::default() };
    let table = "look = { preset = 'preview', samples = 4, shadow = { size = 256 }, sunlight = [1, 2, 3] }";
    assert_eq!(request(table), PresetRequest { overrides, ..preview });
    assert_eq!(request("look.samples = 1").overrides.samples, Some(1));
    // The compute rasterizer implies a variance map.
    let method = |look| request(look).overrides.shadow_method;
    let named = "look = { raster = 'cuda', shadow.method = 'filtered' }";
    let methods = [method("look.raster = 'cuda'"), method(named), method("look.raster = 'opengl'")];
    assert_eq!(methods, [Some(ShadowMethod::Variance), Some(ShadowMethod::PercentageCloser), None]);
    assert_eq!([method(""), method("look.raster = 'auto'")], [None, None]);
    for (look, expected) in [
        ("look = 'fast'", "unknown variant `fast`, expected one of `preview`, `standard`, `best`"),
        ("look = 3", "the name of a preset, or a table"),
        ("look.preset = 'fast'", "unknown variant `fast`"),
    ] {
        let message = read_parts(&format!("model = 'a.obj'\n{look}\n")).expect_err(look).to_string();
        assert!(message.contains("line 2") && message.contains(expected), "{look}: {message}");
    }
    for (look, expected) in [("samples = 3", "look.samples: expected 1 or 4"), ("shadow.size = 8", "look.shadow.size")]
    {
        let parts = read_parts(&format!("model = 'a.obj'\nlook.preset = 'preview'\nlook.{look}\n")).expect(look);
        let message = crate::scene::Scene::new(parts).expect_err(look).to_string();
        assert!(message.contains(expected), "{look}: {message}");
    }
}

#[test]
fn built_in_tree_is_a_model_with_other_settings_and_places() {
    let tree = crate::load::open("tree").expect("the tree").scene;
    let count = tree.parts().domains.len();
    let one = read_parts("model = 'tree'\ntransforms = 'rigid'\nlook = { raster = 'cuda' }\n").expect("a tree");
    assert_eq!((one.domains.len(), one.shapes.len()), (count, tree.parts().shapes.len()));
    assert_eq!(one.domains[count - 1].attachment, tree.parts().domains[count - 1].attachment);
    assert!(one.rigid_transforms && one.remarks.is_empty());

    let grove = "[material.bark]\nshininess = 3\n[[domain]]\nmodel = 'tree'\n[[domain]]\nmodel = 'tree'\n\
                 name = 'second'\nplacement = { translation = [5, 0, 0] }\n";
    let grove = read_parts(grove).expect("two trees");
    assert_eq!((grove.domains.len(), grove.shapes.len()), (2 * count, one.shapes.len()));
    let parent_of = |index: usize| grove.domains[index].attachment.as_ref().map(|attachment| attachment.parent);
    assert_eq!(parent_of(2 * count - 1), parent_of(count - 1).map(|parent| parent + count));
    assert!(grove.materials.iter().any(|material| material.name == "bark" && material.shininess == 3.0));

    let error = read_manifest("model = './tree'\n").map(drop).expect_err("there is no folder 'tree'");
    assert!(error.to_string().contains("tree"), "{error}");
}
