//! Tests of the loaders with datasets from other tools. They are ignored by default, because the datasets are not part
//! of the repository. Expected counts and sizes are properties of the datasets.

use std::path::PathBuf;
use std::sync::Arc;

use nalgebra::{Matrix3, Vector3};

use crate::domain::AlphaMode;
use crate::scene::{Scene, UpAxis};

fn dataset_path(path: &str) -> String {
    let root = std::env::var_os("MODALCAST_DATA").map_or_else(|| PathBuf::from("../../../shared/data"), PathBuf::from);
    root.join(path).to_str().expect("a UTF-8 path").to_owned()
}

fn open_scene(path: &str) -> Arc<Scene> {
    super::open(&dataset_path(path)).unwrap_or_else(|error| panic!("{path}: {error}")).scene
}

/// Opens a scene whose `scene.toml` has this text.
fn open_manifest(text: &str) -> crate::error::Result<Arc<Scene>> {
    let folder = tempfile::tempdir().expect("a temporary folder");
    std::fs::write(folder.path().join("scene.toml"), text).expect("a writable file");
    super::open(folder.path().to_str().expect("a UTF-8 path")).map(|opened| opened.scene)
}

/// The number of vertices that no mode moves.
fn count_fixed_vertices(scene: &Scene) -> usize {
    let modes = &scene.shapes[0].modes;
    let is_fixed = |vertex: &usize| {
        (0..modes.rank()).all(|mode| (0..3).all(|component| modes.entry(*vertex, component, mode) == 0.0))
    };
    (0..modes.vertices()).filter(is_fixed).count()
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../../../shared/data (from this crate)"]
fn real_simple_bridge_keeps_the_numbering_of_its_file() {
    let scene = open_scene("vega/simpleBridge");
    let layout = scene.layout.domains[0];
    assert_eq!((layout.vertices, layout.corners, layout.triangles, layout.rank), (16085, 61612, 32014, 20));
    assert_eq!(count_fixed_vertices(&scene), 59);
    assert_eq!(scene.domains.len(), 1);
    // Control: a loader that numbers vertices by first use would change most rows.
    let mut is_seen = vec![false; layout.vertices];
    let corners = &scene.shapes[0].mesh.corners().vertices;
    let first_use_order: Vec<u32> =
        corners.iter().copied().filter(|vertex| !std::mem::replace(&mut is_seen[*vertex as usize], true)).collect();
    let renumbered_count = first_use_order.iter().zip(0..).filter(|(vertex, index)| *vertex != index).count();
    assert!(renumbered_count > 15_000, "expected the control to renumber most vertices, got {renumbered_count}");
    let text = std::fs::read_to_string(dataset_path("vega/simpleBridge/simpleBridge.obj")).expect("a readable file");
    let lines = text.lines().filter_map(|line| line.strip_prefix("v "));
    for (line, rest_position) in lines.zip(scene.shapes[0].mesh.rest_positions()) {
        let coordinates: Vec<f32> = line.split_whitespace().map(|word| word.parse().expect("a number")).collect();
        assert_eq!(coordinates, rest_position);
    }
    let notes = &scene.domains[0].metadata.notes;
    assert_eq!((notes["vega.baseFrequency"].as_str(), notes["vega.cubic"].as_str()), ("0.25", "simpleBridge.cub"));
    assert_eq!(
        open_scene("vega/simpleBridge/simpleBridge.obj").rank_of(0),
        20,
        "expected the path of the file to load the modes, too"
    );
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../../../shared/data (from this crate)"]
fn real_model_a_has_vertices_that_no_face_uses() {
    let scene = open_scene("vega/A");
    let layout = scene.layout.domains[0];
    assert_eq!((layout.vertices, layout.triangles, layout.rank), (575, 834, 20));
    let mut used_vertices: Vec<u32> = scene.shapes[0].mesh.corners().vertices.clone();
    used_vertices.sort_unstable();
    used_vertices.dedup();
    assert_eq!(used_vertices.len(), 417);
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../../../shared/data (from this crate)"]
fn real_sofa_binary_modes_equal_the_text_modes() {
    for (name, vertices, triangles, rank) in
        [("hexaBeam", 320, 492, 8), ("finger", 158, 306, 3), ("diamond", 1628, 3268, 32)]
    {
        let scene = open_scene(&format!("sofa/{name}"));
        let layout = scene.layout.domains[0];
        assert_eq!((layout.vertices, layout.triangles, layout.rank), (vertices, triangles, rank), "{name}");
        let (model, modes) =
            (dataset_path(&format!("sofa/{name}/{name}.derived.obj")), dataset_path(&format!("sofa/{name}/modes.txt")));
        let text_scene = open_manifest(&format!("model = '{model}'\nmodes = '{modes}'\n")).expect("a valid scene");
        let pairs = scene.shapes[0].modes.columns().iter().zip(text_scene.shapes[0].modes.columns());
        let max_difference = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        // The text has fewer digits.
        assert!(max_difference <= 1e-5, "{name}: {max_difference}");
    }
    assert_eq!(count_fixed_vertices(&open_scene("sofa/hexaBeam")), 16);
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../../../shared/data (from this crate)"]
fn real_ball_is_rejected_with_declared_and_actual_size() {
    // The only mesh of the folder is an STL file. The modes of such a folder are read from `modes.txt`.
    let folder_error = super::open(&dataset_path("sofa/ball")).expect_err("mismatching modes").to_string();
    assert!(folder_error.starts_with("file 'modes.txt': values: expected 684 x 32 values"), "{folder_error}");
    let (model, modes) = (dataset_path("sofa/finger/finger.derived.obj"), dataset_path("sofa/ball/modes.txt"));
    let message =
        open_manifest(&format!("model = '{model}'\nmodes = '{modes}'\n")).expect_err("mismatching modes").to_string();
    assert!(message.ends_with("values: expected 684 x 32 values as the header declares, got 684 x 35"), "{message}");
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../../../shared/data (from this crate)"]
fn real_almond_has_1447_domains_and_all_faces() {
    let scene = open_scene("plants/almond");
    assert_eq!((scene.domains.len(), scene.layout.triangles), (1447, 37560));
    assert_eq!(scene.domains.iter().filter(|domain| domain.name.starts_with("shoot ")).count(), 139);
    assert_eq!(scene.domains.iter().filter(|domain| domain.attachment.is_none()).count(), 1);
    assert_eq!(scene.up, UpAxis::Z);
    let height = scene.rest_bounds.max[2] - scene.rest_bounds.min[2];
    assert!((height - 2.6745).abs() < 1e-3, "{height}");
    assert!(scene.features.mask && scene.features.modes && !scene.features.normal_maps);
    assert_eq!(
        open_scene("plants/almond/almond.obj").domains.len(),
        1447,
        "expected the path of the file to load the plant, too"
    );
    let leaf = scene.domains.iter().find(|domain| domain.name.starts_with("leaf ")).expect("a leaf");
    let materials: Vec<_> = leaf.materials().map(|material| &scene.materials[material]).collect();
    assert_eq!(materials.len(), 2, "expected the materials of leaf and petiole");
    assert!(materials.iter().any(|material| matches!(material.alpha_mode, AlphaMode::Mask { .. })));
    for (name, color) in [("material0", [1.0; 3]), ("material2", [0.0; 3])] {
        let material = scene.materials.iter().find(|material| material.name == name).expect(name);
        assert_eq!(material.diffuse, color, "{name}");
    }
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../../../shared/data (from this crate)"]
fn real_plants_have_the_bounds_of_their_file_and_compact_leaves() {
    for (name, domains, triangles) in [("almond", 1447, 37560), ("bean", 237, 42824)] {
        let scene = open_scene(&format!("plants/{name}"));
        assert_eq!((scene.domains.len(), scene.layout.triangles), (domains, triangles), "{name}");
        let text =
            std::fs::read_to_string(dataset_path(&format!("plants/{name}/{name}.obj"))).expect("a readable file");
        let mut bounds = crate::scene::BoundingBox::EMPTY;
        for line in text.lines().filter_map(|line| line.strip_prefix("v ")) {
            let position: Vec<f64> = line.split_whitespace().map(|word| word.parse().expect("a number")).collect();
            bounds.include([position[0], position[1], position[2]]);
        }
        for axis in 0..3 {
            assert!((bounds.min[axis] - scene.rest_bounds.min[axis]).abs() < 1e-6, "{name}");
            assert!((bounds.max[axis] - scene.rest_bounds.max[axis]).abs() < 1e-6, "{name}");
        }
        // A petiole that is assigned to the wrong leaf is far from the origin of its domain. Correctly assigned organs
        // are within this distance in meters.
        let max_distance = if name == "almond" { 0.2 } else { 0.4 };
        for (index, domain) in scene.domains.iter().enumerate().filter(|(_, domain)| domain.name.starts_with("leaf ")) {
            let distance = |rest_position: &[f32; 3]| nalgebra::Vector3::from(*rest_position).norm();
            let largest_distance = scene.shape_of(index).mesh.rest_positions().iter().map(distance).fold(0.0, f32::max);
            assert!(
                largest_distance < max_distance,
                "{name}: {}: expected below {max_distance}, got {largest_distance}",
                domain.name
            );
        }
    }
}

/// The motion of a joint per unit of a mode, fitted to the attachment vertices: displacement at `point`, and rotation.
fn fitted_joint_motion(
    shape: &crate::domain::Shape,
    vertices: &[u32],
    point: &Vector3<f64>,
    mode: usize,
) -> [Vector3<f64>; 2] {
    let place = |vertex: &u32| Vector3::from(shape.mesh.rest_positions()[*vertex as usize]).cast::<f64>();
    let displacement =
        |vertex: &u32| Vector3::from_fn(|axis, _| f64::from(shape.modes.entry(*vertex as usize, axis, mode)));
    let count = vertices.len() as f64;
    let center = vertices.iter().map(place).sum::<Vector3<f64>>() / count;
    let mean = vertices.iter().map(displacement).sum::<Vector3<f64>>() / count;
    let arms = || vertices.iter().map(|vertex| (place(vertex) - center, displacement(vertex)));
    let spread: Matrix3<f64> =
        arms().map(|(arm, _)| Matrix3::identity() * arm.norm_squared() - arm * arm.transpose()).sum();
    let moment: Vector3<f64> = arms().map(|(arm, displacement)| arm.cross(&displacement)).sum();
    let rotation = spread.try_inverse().expect("vertices that are not collinear") * moment;
    [mean + rotation.cross(&(point - center)), rotation]
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../../../shared/data (from this crate)"]
fn real_plants_are_flexible_and_their_joints_move_rigidly() {
    for (name, min_coordinates) in [("almond", 4500), ("bean", 690)] {
        let start = std::time::Instant::now();
        let scene = open_scene(&format!("plants/{name}"));
        let coordinates: usize = (0..scene.domains.len()).map(|domain| scene.rank_of(domain)).sum();
        println!("{name}: {coordinates} coordinates, {:.2} s, {:?}", start.elapsed().as_secs_f64(), scene.remarks);
        assert!(coordinates >= min_coordinates, "{name}: {coordinates}");
        let mut largest_residual = 0.0_f64;
        let mut lowest: std::collections::BTreeMap<(usize, String), f64> = std::collections::BTreeMap::new();
        let mut levels = vec![0; scene.domains.len()];
        for (index, domain) in scene.domains.iter().enumerate() {
            let shape = scene.shape_of(index);
            let eigenvalues = &domain.metadata.eigenvalues;
            assert!(shape.modes.columns().iter().all(|entry| entry.is_finite()));
            assert!(scene.rank_of(index) >= 3 && eigenvalues.len() == scene.rank_of(index), "{}", domain.name);
            assert!(eigenvalues.iter().all(|eigenvalue| eigenvalue.is_finite() && *eigenvalue > 0.0));
            if let Some(attachment) = &domain.attachment {
                levels[index] = levels[attachment.parent] + 1;
                let parent = scene.shape_of(attachment.parent);
                let vertices = &attachment.vertices;
                assert!(vertices.len() >= 3, "{}", domain.name);
                for mode in 0..parent.modes.rank() {
                    let point = attachment.frame.translation();
                    let [translation, rotation] = fitted_joint_motion(parent, vertices, &point, mode);
                    let scale = (0..parent.modes.vertices())
                        .map(|vertex| Vector3::from_fn(|axis, _| parent.modes.entry(vertex, axis, mode)).norm())
                        .fold(0.0, f32::max);
                    for vertex in vertices {
                        let place = Vector3::from(parent.mesh.rest_positions()[*vertex as usize]).cast::<f64>();
                        let expected = translation + rotation.cross(&(place - point));
                        let actual =
                            Vector3::from_fn(|axis, _| f64::from(parent.modes.entry(*vertex as usize, axis, mode)));
                        largest_residual = largest_residual.max((actual - expected).norm() / f64::from(scale));
                    }
                }
            }
            let kind = domain.metadata.notes["plant.kind"].clone();
            let hertz = eigenvalues[0].sqrt() / std::f64::consts::TAU;
            let entry = lowest.entry((levels[index], kind)).or_insert(f64::INFINITY);
            *entry = entry.min(hertz);
        }
        println!("{name}: residual of the attachment vertices {largest_residual:.1e}, lowest frequencies {lowest:.2?}");
        assert!(largest_residual < 1e-5, "{name}: {largest_residual}");
    }
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../../../shared/data (from this crate)"]
fn real_datasets_are_listed_if_their_folder_has_one_model() {
    let repository = super::SceneRepository::new(Some(dataset_path("").as_ref())).expect("an existing folder");
    let names = repository.list();
    for name in ["tree", "plants/almond", "vega/simpleBridge", "sofa/hexaBeam", "gltf/fern/fern_02.glb"] {
        assert!(names.iter().any(|listed| listed == name), "{name} is not among {names:?}");
    }
    assert!(!names.iter().any(|name| name == "vega/volumetric/beam3"));
    assert_eq!(
        repository
            .open("vega/A", &crate::memory::MemoryReservation::unlimited())
            .expect("a valid scene")
            .scene
            .rank_of(0),
        20
    );
    let message = super::open(&dataset_path("vega/volumetric/beam3")).expect_err("two models").to_string();
    assert!(message.ends_with("got 2: beam3.obj, beam3_tet.obj"), "{message}");
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../../../shared/data (from this crate)"]
fn real_fern_is_masked_by_an_override_of_its_texture() {
    let (model, texture) =
        (dataset_path("gltf/fern/fern_02.glb"), dataset_path("gltf/fern/fern_02_basecolor_alpha_1k.derived.png"));
    let scene = open_manifest(&format!("model = '{model}'\nmaterial.'*'.color_texture = '{texture}'\n"))
        .expect("a valid scene");
    assert_eq!(scene.domains.len(), 4);
    let color_texture = scene.materials[0].color_texture.expect("a color texture");
    assert!(scene.textures[color_texture].has_alpha() && scene.textures[color_texture].width() == 1024);
    assert!(matches!(scene.materials[0].alpha_mode, AlphaMode::Mask { .. }));
    assert_eq!(scene.textures.len(), 2, "expected the replaced texture to be removed");
}
