//! Tests of the manifest with small models.

use std::path::Path;

use super::*;
use crate::backend_settings::{BackendSettings, BatchPolicy, RasterPolicy};
use crate::domain::{AlphaMode, Transform};
use crate::scene::{
    Antialiasing, Bloom, Culling, DeformationSettings, MomentFormat, NormalMethod, RenderSettings, SceneParts,
    ShadowMethod, ShadowSettings, StorageType, ToneMapping,
};

const TRIANGLE: &str = "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl red\nf 1 2 3\n";

fn description(toml: &str) -> Result<SceneDescription> {
    let folder = tempfile::tempdir().expect("a folder");
    let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).expect("written");
    write("a.obj", TRIANGLE);
    write("b.obj", TRIANGLE);
    write("a.mtl", "newmtl red\nKd 1 0 0\nmap_Kd solid.png\n");
    write("u.txt", "9 2\n1 0 0 0 0 0 0 0 0\n0 1 0 0 0 0 0 0 0\n");
    write("wide.txt", "9 1\n1 1 1 1 1 1 1 1 1 1\n");
    for (name, alpha) in [("solid.png", 255), ("leaf.png", 9)] {
        let image = image::RgbaImage::from_pixel(1, 1, image::Rgba([1, 2, 3, alpha]));
        image.save(folder.path().join(name)).expect("written");
    }
    write(MANIFEST_FILE, toml);
    read(&AssetDir::unrestricted(folder.path()), MANIFEST_FILE, "folder")
}

fn scene(toml: &str) -> Result<SceneParts> {
    description(toml).map(|description| description.parts)
}

#[test]
fn one_model_with_everything_said_about_the_scene() {
    let SceneDescription { parts, backends } = description(
        "name = 'n'\nup = 'z'\nunit = 0.01\norigin = [1.5, 0, 0]\ntransforms = 'rigid'\nshadows = false\n\
         model = 'a.obj'\nmodes = 'u.txt'\nplacement = { translation = [1, 2, 3] }\nlook.sunlight = [2, 2, 2]\n\
         look.antialias = 'fxaa'\nlook.bloom.strength = 0.25\nlook.tone = 'aces'\nlook.exposure = 1.5\n\
         look.dither = true\nlook.culling = 'depth'\nlook.raster = 'fastest'\n\
         deform = { storage = 'int8', normals = 'exact', truncation = 1e-4, displacements = true, batches = 'never' }\n",
    )
    .expect("good");
    assert_eq!((parts.name.as_str(), parts.up, parts.unit), ("n", UpAxis::Z, 0.01));
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
        truncation: Some(1e-4),
        displacements: true,
        ..DeformationSettings::default()
    };
    assert_eq!(parts.deformation, deformation);
    assert_eq!(parts.shapes[0].modes.rank(), 2);
    assert_eq!(parts.domains[0].placement.translation(), nalgebra::Vector3::new(1.0, 2.0, 3.0));
    let shaded = "model = 'a.obj'\nlook.shadow = { method = 'filtered', size = 512, splits = 3, moments = 'f16' }\n";
    let named = ShadowSettings {
        method: ShadowMethod::PercentageCloser,
        size: 512,
        splits: 3,
        moments: MomentFormat::F16,
        ..ShadowSettings::default()
    };
    assert_eq!(scene(shaded).expect("good").look.shadow, Some(named));
    for wrong in ["method = 'ray'", "splits = -1", "blurring = 'tiles'"] {
        let refusal = scene(&format!("model = 'a.obj'\nlook.shadow = {{ {wrong} }}\n")).expect_err(wrong).to_string();
        assert!(refusal.contains("line 2"), "{refusal}");
    }
    let SceneDescription { parts: plain, backends } = description("model = 'a.obj'\n").expect("good");
    assert_eq!((plain.look, backends), (RenderSettings::default(), BackendSettings::default()));
    assert_eq!((plain.name.as_str(), plain.up, plain.rigid_transforms), ("folder", UpAxis::Y, false));
    assert_eq!(plain.deformation, DeformationSettings::default());
    let refusal = scene("model = 'a.obj'\ndeform.storage = 'int3'\n").expect_err("no such type").to_string();
    assert!(refusal.contains("int3"), "{refusal}");
}

#[test]
fn instances_share_mesh_and_modes_but_not_coordinates_or_names() {
    let parts = scene(
        "[[domain]]\nmodel = 'a.obj'\nmodes = 'u.txt'\n[[domain]]\nmodel = './a.obj'\nmodes = 'u.txt'\n\
         placement.scale = 2\n[[domain]]\nmodel = 'b.obj'\nmodes = ''\n",
    )
    .expect("good");
    assert_eq!(parts.shapes.len(), 2);
    assert_eq!(parts.domains.iter().map(|domain| domain.shape).collect::<Vec<_>>(), [0, 0, 1]);
    let names: Vec<_> = parts.domains.iter().map(|domain| domain.name.as_str()).collect();
    assert_eq!(names, ["a", "a 2", "b"]);
    let scene = crate::scene::Scene::new(parts).expect("a scene");
    assert_eq!((scene.layout.coordinates, scene.layout.domains[1].first_q), (4, 2));
}

#[test]
fn a_child_hangs_on_its_parent_by_frame_or_by_placement() {
    let parts = scene(
        "[[domain]]\nname = 'trunk'\nmodel = 'a.obj'\nmodes = 'u.txt'\nplacement = { translation = [10, 0, 0], axis = [0, 0, 1], degrees = 90 }\n\
         [[domain]]\nname = 'by frame'\nmodel = 'b.obj'\nparent = 'trunk'\nframe.translation = [1, 0, 0]\nrows = [1]\n\
         [[domain]]\nname = 'by place'\nmodel = 'b.obj'\nparent = 'trunk'\nplacement.translation = [10, 1, 0]\n",
    )
    .expect("good");
    let [_, by_frame, by_place] = &parts.domains[..] else { panic!("three domains") };
    let at = |transform: Transform| transform.translation().map(|number| (number * 1e4).round() / 1e4);
    assert_eq!(at(by_frame.placement), nalgebra::Vector3::new(10.0, 1.0, 0.0));
    let (first, second) =
        (by_frame.attachment.as_ref().expect("joined"), by_place.attachment.as_ref().expect("joined"));
    assert_eq!(at(first.frame), nalgebra::Vector3::x());
    assert_eq!(at(second.frame), nalgebra::Vector3::x());
    assert_eq!((first.parent, &first.rows[..], &second.rows[..]), (0, &[1][..], &[0, 1, 2][..]));
}

#[test]
fn an_entry_may_follow_what_it_hangs_on_and_says_so_by_how_names_begin() {
    let child = |follows: &str| {
        scene(&format!(
            "[[domain]]\nname = 'trunk'\nmodel = 'a.obj'\nplacement = {{ translation = [10, 0, 0], axis = [0, 0, 1], degrees = 90 }}\n\
             [[domain]]\nname = 'leaf'\nmodel = 'b.obj'\nparent = 'trunk'\nframe.translation = [1, 0, 0]\n{follows}"
        ))
    };
    assert!(child("").expect("good").domains[1].follows.is_none());
    let parts = child("follows = ''\n").expect("good");
    let (follow, attachment) = (parts.domains[1].follows.expect("follows"), parts.domains[1].attachment.clone());
    assert_eq!((follow.parent, Some(follow.frame)), (0, attachment.map(|attachment| attachment.frame)));
    let before = parts.domains[1].placement;
    let scene = crate::scene::Scene::new(parts).expect("a scene");
    assert_eq!(scene.transform_roots.count(), 1);
    let apart = scene.domains[1].placement.0.iter().zip(before.0).map(|(new, old)| (new - old).abs());
    assert!(apart.fold(0.0, f32::max) < 1e-5, "it stays where it was");
    let refusal = child("follows = 'nobody'\n").map(drop).expect_err("no such name").to_string();
    assert!(refusal.contains("follows: expected how the names of domains begin that hang on others"), "{refusal}");
}

#[test]
fn materials_are_changed_by_name_for_all_and_for_one_entry_and_replaced_textures_are_dropped() {
    let parts = scene(
        "[material.red]\ncolour_texture = 'leaf.png'\n[material.'*']\nshininess = 9\n\
         [[domain]]\nmodel = 'a.obj'\n[[domain]]\nmodel = 'a.obj'\nmaterial = { diffuse = [0, 1, 0] }\n",
    )
    .expect("good");
    let [first, second] = &parts.materials[..] else { panic!("two materials") };
    assert_eq!((first.shininess, first.alpha_mode), (9.0, AlphaMode::Mask { cutoff: 0.5 }));
    assert_eq!((first.diffuse, second.diffuse), ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]));
    assert_eq!(parts.domains.iter().map(|domain| domain.material).collect::<Vec<_>>(), [0, 1]);
    assert_eq!(parts.textures.iter().map(|texture| texture.name.as_str()).collect::<Vec<_>>(), ["leaf.png"]);
    assert_eq!((first.color_texture, second.color_texture), (Some(0), Some(0)));
}

#[test]
fn an_entry_that_says_its_up_axis_is_turned_to_the_scenes() {
    let parts = scene("up = 'z'\n[[domain]]\nmodel = 'a.obj'\nup = 'y'\n[[domain]]\nmodel = 'b.obj'\n").expect("good");
    let up = parts.domains[0].placement.linear() * nalgebra::Vector3::y();
    assert!((up - nalgebra::Vector3::z()).norm() < 1e-6, "{up}");
    assert_eq!(parts.domains[1].placement, Transform::IDENTITY);
    assert_eq!(parts.remarks, ["model 'b.obj': Y is up in it and Z in the scene; its entry can say so with `up`"]);
}

#[test]
fn metadata_is_kept() {
    let text = "[[domain]]\nmodel = 'a.obj'\nmodes = 'u.txt'\neigenvalues = [1.5, 2.5]\nnotes = { who = 'me' }\n";
    let parts = scene(text).expect("good");
    assert_eq!(parts.domains[0].metadata.eigenvalues, [1.5, 2.5]);
    assert_eq!(parts.domains[0].metadata.notes["who"], "me");
}

#[test]
fn what_a_manifest_cannot_mean_is_refused_by_line_or_entry() {
    for (text, start) in [
        ("", "model: expected a model, or [[domain]] entries, got neither"),
        ("colour = 1\n", "line 1: expected the keys and values of a scene, got unknown field `colour`"),
        ("model = 'a.obj'\nup = 'w'\n", "line 2: expected the keys and values of a scene, got unknown variant `w`"),
        ("model = \n", "line 1: expected the keys and values of a scene"),
        ("model = 'a.obj'\n[look]\nsky = 1\n", "line 3: expected the keys and values of a scene, got unknown field"),
        ("model = 'a.obj'\n[[domain]]\nmodel = 'b.obj'\n", "model: expected either one model"),
        ("modes = 'u.txt'\n[[domain]]\nmodel = 'b.obj'\n", "modes, placement, follows: expected none beside"),
        ("[[domain]]\nname = 'x'\n", "line 1: expected the keys and values of a scene, got missing field `model`"),
        ("model = 'c.obj'\n", "domain 0 ('c.obj'): file 'c.obj': expected a file that is there"),
        ("model = 'a.mtl'\n", "domain 0 ('a.mtl'): file 'a.mtl': expected a file ending in .glb"),
        ("model = 'a.obj'\nmodes = 'wide.txt'\n", "domain 0 ('a.obj'): file 'wide.txt': values: expected 9 x 1 values"),
        ("model = 'a.obj'\nmodes = 'no.npy'\n", "domain 0 ('a.obj'): file 'no.npy': expected a file that is there"),
        ("model = 'a.obj'\nplacement.scale = inf\n", "domain 0 ('a.obj'): placement: transform[0]"),
        ("model = 'a.obj'\nmaterial.green.alpha = 1\n", "material: expected * or one of red, got green"),
        (
            "model = 'a.obj'\nmaterial.red.colour_texture = 'x.png'\n",
            "domain 0 ('a.obj'): material 'red': colour_texture: file 'x.png'",
        ),
        ("[[domain]]\nmodel = 'a.obj'\nparent = 'x'\n", "domain 0 ('a.obj'): parent: expected the name of a domain"),
        ("[[domain]]\nmodel = 'a.obj'\nrows = [1]\n", "domain 0 ('a.obj'): frame, rows: expected none without"),
        ("[[domain]]\nmodel = 'a.obj'\neigenvalues = [1]\n", "domain 0 ('a.obj'): eigenvalues: expected finite"),
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
            "domain 1 ('b.obj'): frame: expected either",
        ),
    ] {
        let refusal = scene(text).expect_err(text).to_string();
        let expected = format!("file 'scene.toml': {start}");
        assert!(refusal.starts_with(&expected), "{refusal}");
    }
    assert!(scene(&format!("model = {}", "[".repeat(100_000))).is_err(), "deep nesting is no way to end the program");
    let range = "model = 'a.obj'\nmaterial.red.alpha = 7\n";
    let refusal = crate::scene::Scene::new(scene(range).expect("read")).expect_err("7 is no alpha").to_string();
    assert_eq!(refusal, "material 'red': alpha: expected 0 to 1, got 7");
}

#[test]
fn absolute_paths_are_taken_when_nothing_confines_them() {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::write(folder.path().join("x.obj"), "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").expect("written");
    let path = folder.path().join("x.obj");
    let parts = scene(&format!("model = '{}'\n", path.display())).expect("good");
    assert_eq!(parts.domains[0].name, "x");
    assert!(Path::new(&path).is_absolute());
}
