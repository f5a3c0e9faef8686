//! Tests of the loaders with real input files from other tools.

use std::path::PathBuf;
use std::sync::Arc;

use crate::domain::AlphaMode;
use crate::scene::{Scene, UpAxis};

fn data(path: &str) -> String {
    let root = std::env::var_os("MODALCAST_DATA").map_or_else(|| PathBuf::from("../../../shared/data"), PathBuf::from);
    root.join(path).to_str().expect("UTF-8").to_owned()
}

fn open(path: &str) -> Arc<Scene> {
    super::open(&data(path)).unwrap_or_else(|error| panic!("{path}: {error}")).scene
}

/// Opens a folder that contains this scene.toml.
fn manifest(text: &str) -> crate::error::Result<Arc<Scene>> {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::write(folder.path().join("scene.toml"), text).expect("written");
    super::open(folder.path().to_str().expect("UTF-8")).map(|opened| opened.scene)
}

fn fixed_rows(scene: &Scene) -> usize {
    let modes = &scene.shapes[0].modes;
    let is_zero = |vertex: &usize| (0..3 * modes.rank()).all(|at| modes.entry(*vertex, at % 3, at / 3) == 0.0);
    (0..modes.vertices()).filter(is_zero).count()
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
fn real_simple_bridge_keeps_the_numbering_of_its_file() {
    let scene = open("vega/simpleBridge");
    let slot = scene.layout.domains[0];
    assert_eq!((slot.vertices, slot.corners, slot.triangles, slot.rank), (16085, 61612, 32014, 20));
    assert_eq!(fixed_rows(&scene), 59);
    assert_eq!(scene.domains.len(), 1);
    // Numbering by first use, which would be wrong, would differ in nearly every row.
    let mut seen = vec![false; slot.vertices];
    let corners = &scene.shapes[0].mesh.corners().vertices;
    let by_first_use: Vec<u32> =
        corners.iter().copied().filter(|vertex| !std::mem::replace(&mut seen[*vertex as usize], true)).collect();
    let moved = by_first_use.iter().zip(0..).filter(|(vertex, index)| *vertex != index).count();
    assert!(moved > 15_000, "{moved}");
    let text = std::fs::read_to_string(data("vega/simpleBridge/simpleBridge.obj")).expect("read");
    let lines = text.lines().filter_map(|line| line.strip_prefix("v "));
    for (line, rest) in lines.zip(scene.shapes[0].mesh.rest_positions()) {
        let numbers: Vec<f32> = line.split_whitespace().map(|word| word.parse().expect("a number")).collect();
        assert_eq!(numbers, rest);
    }
    let notes = &scene.domains[0].metadata.notes;
    assert_eq!((notes["vega.baseFrequency"].as_str(), notes["vega.cubic"].as_str()), ("0.25", "simpleBridge.cub"));
    assert_eq!(open("vega/simpleBridge/simpleBridge.obj").rank_of(0), 20, "the file alone takes its modes too");
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
fn real_a_has_vertices_that_no_face_uses() {
    let scene = open("vega/A");
    let slot = scene.layout.domains[0];
    assert_eq!((slot.vertices, slot.triangles, slot.rank), (575, 834, 20));
    let mut used: Vec<u32> = scene.shapes[0].mesh.corners().vertices.clone();
    used.sort_unstable();
    used.dedup();
    assert_eq!(used.len(), 417);
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
fn real_sofa_models_open_with_their_binary_modes_which_the_text_confirms() {
    for (name, vertices, triangles, rank) in
        [("hexaBeam", 320, 492, 8), ("finger", 158, 306, 3), ("diamond", 1628, 3268, 32)]
    {
        let scene = open(&format!("sofa/{name}"));
        let slot = scene.layout.domains[0];
        assert_eq!((slot.vertices, slot.triangles, slot.rank), (vertices, triangles, rank), "{name}");
        let (model, modes) =
            (data(&format!("sofa/{name}/{name}.derived.obj")), data(&format!("sofa/{name}/modes.txt")));
        let text = manifest(&format!("model = '{model}'\nmodes = '{modes}'\n")).expect("opens");
        let pairs = scene.shapes[0].modes.columns().iter().zip(text.shapes[0].modes.columns());
        let apart = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(apart <= 1e-5, "{name}: {apart}");
    }
    assert_eq!(fixed_rows(&open("sofa/hexaBeam")), 16);
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
fn real_ball_is_refused_with_what_is_declared_and_what_is_delivered() {
    let folder = super::open(&data("sofa/ball")).expect_err("no mesh that is read").to_string();
    assert!(
        folder.contains("expected scene.toml or one .glb, .gltf or .obj file, got none among: modes.txt"),
        "{folder}"
    );
    let (model, modes) = (data("sofa/finger/finger.derived.obj"), data("sofa/ball/modes.txt"));
    let refusal = manifest(&format!("model = '{model}'\nmodes = '{modes}'\n")).expect_err("malformed").to_string();
    assert!(refusal.ends_with("values: expected 684 x 32 values as the header declares, got 684 x 35"), "{refusal}");
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
fn real_almond_is_1447_domains_upright_and_no_face_is_lost() {
    let start = std::time::Instant::now();
    let scene = open("plants/almond");
    let seconds = start.elapsed().as_secs_f64();
    assert!(seconds < 5.0, "{seconds} s");
    assert_eq!((scene.domains.len(), scene.layout.triangles), (1447, 37560));
    assert_eq!(scene.domains.iter().filter(|domain| domain.name.starts_with("shoot ")).count(), 139);
    assert_eq!(scene.domains.iter().filter(|domain| domain.attachment.is_none()).count(), 1);
    assert_eq!(scene.up, UpAxis::Z);
    let height = scene.rest_bounds.max[2] - scene.rest_bounds.min[2];
    assert!((height - 2.6745).abs() < 1e-3, "{height}");
    assert!(scene.features.mask && !scene.features.modes && !scene.features.normal_maps);
    assert_eq!(open("plants/almond/almond.obj").domains.len(), 1447, "the file alone is the same plant");
    let leaf = scene.domains.iter().find(|domain| domain.name.starts_with("leaf ")).expect("a leaf");
    let materials: Vec<_> = leaf.materials().map(|material| &scene.materials[material]).collect();
    assert_eq!(materials.len(), 2, "leaf and petiole");
    assert!(materials.iter().any(|material| matches!(material.alpha_mode, AlphaMode::Mask { .. })));
    for (name, color) in [("material0", [1.0; 3]), ("material2", [0.0; 3])] {
        let material = scene.materials.iter().find(|material| material.name == name).expect(name);
        assert_eq!(material.diffuse, color, "{name}");
    }
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
fn real_plants_lie_where_their_file_says_and_petioles_reach_their_leaves() {
    for (name, domains, triangles) in [("almond", 1447, 37560), ("bean", 237, 42824)] {
        let scene = open(&format!("plants/{name}"));
        assert_eq!((scene.domains.len(), scene.layout.triangles), (domains, triangles), "{name}");
        let text = std::fs::read_to_string(data(&format!("plants/{name}/{name}.obj"))).expect("read");
        let mut bounds = crate::scene::BoundingBox::EMPTY;
        for line in text.lines().filter_map(|line| line.strip_prefix("v ")) {
            let numbers: Vec<f64> = line.split_whitespace().map(|word| word.parse().expect("a number")).collect();
            bounds.include([numbers[0], numbers[1], numbers[2]]);
        }
        for axis in 0..3 {
            assert!((bounds.min[axis] - scene.rest_bounds.min[axis]).abs() < 1e-6, "{name}");
            assert!((bounds.max[axis] - scene.rest_bounds.max[axis]).abs() < 1e-6, "{name}");
        }
        // A petiole that was assigned to another leaf would lie far from the frame of its domain.
        let reach = if name == "almond" { 0.2 } else { 0.4 };
        for (index, domain) in scene.domains.iter().enumerate().filter(|(_, domain)| domain.name.starts_with("leaf ")) {
            let far = |rest: &[f32; 3]| nalgebra::Vector3::from(*rest).norm();
            let farthest = scene.shape_of(index).mesh.rest_positions().iter().map(far).fold(0.0, f32::max);
            assert!(farthest < reach, "{name}: {}: {farthest}", domain.name);
        }
    }
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
fn real_inputs_are_listed_and_those_outside_the_repository_are_not_reached() {
    let repository = super::SceneRepository::new(Some(data("").as_ref())).expect("there");
    let names = repository.list();
    for name in ["tree", "plants/almond", "vega/simpleBridge", "sofa/hexaBeam", "gltf/fern/fern_02.glb"] {
        assert!(names.iter().any(|listed| listed == name), "{name} is not among {names:?}");
    }
    assert!(!names.iter().any(|name| name == "sofa/ball" || name == "vega/volumetric/beam3"));
    assert_eq!(repository.open("vega/A").expect("opens").scene.rank_of(0), 20);
    let refusal = super::open(&data("vega/volumetric/beam3")).expect_err("two models").to_string();
    assert!(refusal.ends_with("got 2: beam3.obj, beam3_tet.obj"), "{refusal}");
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
fn real_fern_takes_its_leaves_from_a_derived_texture() {
    let (model, texture) = (data("gltf/fern/fern_02.glb"), data("gltf/fern/fern_02_basecolor_alpha_1k.derived.png"));
    let scene = manifest(&format!("model = '{model}'\nmaterial.'*'.colour_texture = '{texture}'\n")).expect("opens");
    assert_eq!(scene.domains.len(), 4);
    let color = scene.materials[0].color_texture.expect("a colour texture");
    assert!(scene.textures[color].has_alpha() && scene.textures[color].width() == 1024);
    assert!(matches!(scene.materials[0].alpha_mode, AlphaMode::Mask { .. }));
    assert_eq!(scene.textures.len(), 2, "the replaced texture is dropped");
}
