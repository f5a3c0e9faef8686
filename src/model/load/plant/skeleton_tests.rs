//! Tests of plants without an OBJ file.

use super::*;
use crate::domain::AlphaMode;
use crate::load::open;

/// A trunk of 1 m, a twig of 0.4 m at its middle, and four leaves: one with a tip and a width, two leaflets of one
/// petiole, and one on the trunk without a petiole.
const PLANT: &str = r#"{
    "shoots": [
        {"id": 0, "parent": -1, "vertices": [[0,0,0],[0,0,0.25],[0.02,0,0.5],[0,0,0.75],[0,0,1]],
         "radii": [0.02,0.018,0.015,0.012,0.01]},
        {"id": 1, "parent": 0, "vertices": [[0.02,0,0.5],[0.12,0,0.6],[0.3,0,0.7]], "radii": [0.005,0.004,0.003]}
    ],
    "leaves": [
        {"object_id": 5, "shoot": 1, "node": 0, "petiole": 0, "base": [0.3,0,0.75],
         "petiole_vertices": [[0.3,0,0.7],[0.3,0,0.75]], "tip": [0.4,0,0.75], "width": 0.03},
        {"object_id": 6, "shoot": 1, "node": 1, "petiole": 0, "base": [0.12,0.05,0.6],
         "petiole_vertices": [[0.12,0,0.6],[0.12,0.05,0.6]]},
        {"object_id": 7, "shoot": 1, "node": 1, "petiole": 0, "base": [0.12,0.05,0.6]},
        {"object_id": 0, "shoot": 0, "node": 3, "petiole": 0, "base": [0,0,0.75]}
    ]
}"#;

fn read_text(text: &str) -> Result<SceneParts> {
    let folder = tempfile::tempdir().expect("a temporary folder");
    std::fs::write(folder.path().join("p.structure.json"), text).expect("a writable file");
    read_skeleton(&AssetDir::unrestricted(folder.path()), "p.structure.json", ModelOptions::default())
}

fn ranks(parts: &SceneParts) -> Vec<usize> {
    parts.domains.iter().map(|domain| parts.shapes[domain.shape].modes.rank()).collect()
}

/// The position in the scene and the normal of each corner of a domain, with the material of its triangle.
fn corners(parts: &SceneParts, domain: usize) -> Vec<(Vector3<f64>, Vector3<f64>, usize)> {
    let domain = &parts.domains[domain];
    let mesh = &parts.shapes[domain.shape].mesh;
    let (mut corners, mut material) = (Vec::new(), domain.material);
    for (index, triangle) in mesh.triangles().iter().enumerate() {
        let range = domain.material_ranges.iter().find(|range| range.first_triangle == index);
        material = range.map_or(material, |range| range.material);
        for corner in triangle.map(|corner| corner as usize) {
            let position = mesh.rest_positions()[mesh.corners().vertices[corner] as usize];
            let place = domain.placement.translation() + Vector3::from(position).cast::<f64>();
            corners.push((place, Vector3::from(mesh.corners().normals[corner]).cast(), material));
        }
    }
    corners
}

#[test]
fn structure_alone_is_a_plant_with_modes() {
    let parts = read_text(PLANT).expect("a valid plant");
    let names: Vec<&str> = parts.domains.iter().map(|domain| domain.name.as_str()).collect();
    assert_eq!(names, ["shoot 0", "shoot 1", "leaf 5", "leaf 6", "leaf 7", "leaf 0"]);
    let parents = parts.domains.iter().map(|domain| domain.attachment.as_ref().map(|attachment| attachment.parent));
    assert_eq!(parents.collect::<Vec<_>>(), [None, Some(0), Some(1), Some(1), Some(3), Some(0)]);
    // The shoots are slender, and leaf 6 carries a leaflet at its petiole.
    assert_eq!(ranks(&parts), [12, 12, 3, 6, 3, 3], "{:?}", parts.remarks);
    assert!(parts.remarks.is_empty(), "{:?}", parts.remarks);
    for domain in &parts.domains {
        let attachment = domain.attachment.as_ref();
        assert!(attachment.is_none_or(|attachment| attachment.vertices.len() >= 3), "{}", domain.name);
    }
    assert_eq!((parts.name.as_str(), parts.up, parts.unit), ("p", UpAxis::Z, Some(1.0)));
    assert!(
        matches!(parts.materials[1].alpha_mode, AlphaMode::Mask { .. }) && parts.materials[0].normal_texture.is_some()
    );
    crate::scene::Scene::new(parts).expect("a valid scene");
}

#[test]
fn tube_surrounds_its_polyline_with_outward_normals() {
    let parts = read_text(PLANT).expect("a valid plant");
    let polyline = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.25], [0.02, 0.0, 0.5], [0.0, 0.0, 0.75], [0.0, 0.0, 1.0]];
    let trunk = corners(&parts, 0);
    for (place, normal, material) in &trunk {
        let offset = place - organs::nearest_point_on_polyline(&polyline, place);
        assert!((0.0099..0.0201).contains(&offset.norm()), "{place} is {} from the polyline", offset.norm());
        assert!(offset.normalize().dot(normal) > 0.97 && *material == 0, "{place}: {normal}");
    }
    // The volume of the cones by the divergence theorem, with the open base at z = 0.
    let volume: f64 = trunk.chunks(3).map(|corner| corner[0].0.dot(&corner[1].0.cross(&corner[2].0)) / 6.0).sum();
    let cone = |a: f64, b: f64, length: f64| std::f64::consts::PI * length * (a * a + a * b + b * b) / 3.0;
    let exact = cone(0.02, 0.018, 0.25) + cone(0.018, 0.015, 0.25) + cone(0.015, 0.012, 0.25) + cone(0.012, 0.01, 0.25);
    assert!((volume / exact - 1.0).abs() < 0.06, "expected about {exact}, got {volume}");
}

#[test]
fn blades_are_where_the_file_says_or_beside_their_petiole() {
    let parts = read_text(PLANT).expect("a valid plant");
    let blade = |domain: usize| -> Vec<Vector3<f64>> {
        // Blades are folded and curled, and petioles are in the strip of stems.
        let domain_parts = &parts.shapes[parts.domains[domain].shape].mesh;
        let uvs = &domain_parts.corners().uvs;
        let is_blade = |corner: &&u32| uvs[**corner as usize][0] < 0.92;
        let place = |corner: &u32| {
            let position = domain_parts.rest_positions()[domain_parts.corners().vertices[*corner as usize] as usize];
            parts.domains[domain].placement.translation() + Vector3::from(position).cast::<f64>()
        };
        domain_parts.triangles().as_flattened().iter().filter(is_blade).map(place).collect()
    };
    let extent = |points: &[Vector3<f64>], direction: Vector3<f64>| {
        let heights = points.iter().map(|point| point.dot(&direction));
        (heights.clone().fold(f64::INFINITY, f64::min), heights.fold(f64::NEG_INFINITY, f64::max))
    };
    // Leaf 5 reaches from its base to its tip along x, and is 0.03 wide along y.
    let (start, end) = extent(&blade(2), Vector3::x());
    assert!((start - 0.3).abs() < 0.005 && (end - 0.4).abs() < 0.005, "{start} to {end}");
    let (left, right) = extent(&blade(2), Vector3::y());
    assert!((right - left - 0.03 * 0.25_f64.cos()).abs() < 1e-4, "{left} to {right}");
    // The leaflets 6 and 7 begin at the end of the petiole along y and spread to both sides.
    let [right, left] = [3, 4].map(|domain| extent(&blade(domain), Vector3::x()));
    assert!(right.0 > 0.09 && right.1 > 0.15 && left.0 < 0.09 && left.1 < 0.15, "{left:?} {right:?}");
    // Leaf 0 points away from the trunk. Its length is 1.5 times that of the petioles.
    let (_, reach) = extent(
        &blade(5).iter().map(|point| Vector3::new(point.xy().norm(), 0.0, 0.0)).collect::<Vec<_>>(),
        Vector3::x(),
    );
    assert!((0.05..0.08).contains(&reach), "{reach}");
}

#[test]
fn mode_counts_of_the_file_replace_the_defaults() {
    let text = PLANT
        .replace(r#""tip": [0.4,0,0.75]"#, r#""modes": 0, "tip": [0.4,0,0.75]"#)
        .replace(r#""id": 0, "parent": -1"#, r#""id": 0, "modes": 17, "parent": -1"#)
        .replace(r#""id": 1, "parent": 0"#, r#""id": 1, "modes": 0, "parent": 0"#);
    let (parts, default) = (read_text(&text).expect("a valid plant"), read_text(PLANT).expect("a valid plant"));
    assert_eq!(ranks(&parts), [17, 0, 0, 6, 3, 3], "{:?}", parts.remarks);
    // Domains without modes keep their mass.
    let masses = |parts: &SceneParts| -> Vec<f64> {
        let masses = parts.domains.iter().map(|domain| domain.metadata.inertia.as_ref().expect("an inertia").mass());
        masses.collect()
    };
    assert_eq!(masses(&parts), masses(&default));
    crate::scene::Scene::new(parts).expect("a valid scene");
}

#[test]
fn many_leaves_have_flat_blades() {
    let leaves = |count: usize| {
        let leaf = |id: usize| {
            let height = 0.1 + 0.9 * id as f64 / count as f64;
            format!(
                r#"{{"object_id": {id}, "shoot": 0, "node": {id}, "petiole": 0, "base": [0,0,{height}], "modes": 0}}"#
            )
        };
        let leaves: Vec<String> = (0..count).map(leaf).collect();
        let shoot = r#"{"id": 0, "parent": -1, "vertices": [[0,0,0],[0,0,1]], "radii": [0.02,0.02]}"#;
        let parts =
            read_text(&format!(r#"{{"shoots": [{shoot}], "leaves": [{}]}}"#, leaves.join(","))).expect("a plant");
        parts.shapes[parts.domains[1].shape].mesh.triangles().len()
    };
    assert_eq!((leaves(10), leaves(5001)), (16, 4));
}

#[test]
fn structure_is_a_scene_unless_an_obj_file_is_beside_it() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
    std::fs::write(path("my.Structure.json"), PLANT).expect("a writable file");
    for source in [path(""), path("my.Structure.json")] {
        let scene = open(&source).expect("a valid scene").scene;
        assert_eq!(scene.domains.len(), 6, "{source}");
    }
    let repository = crate::load::SceneRepository::new(Some(folder.path())).expect("a folder");
    assert!(repository.list().contains(&"my.Structure.json".to_owned()), "{:?}", repository.list());
    std::fs::write(path("my.obj"), "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").expect("a writable file");
    assert_eq!(open(&path("")).expect("a valid scene").scene.domains.len(), 1, "expected the OBJ file");
    assert_eq!(open(&path("my.Structure.json")).expect("a valid scene").scene.domains.len(), 6);
    std::fs::write(path("other.json"), PLANT).expect("a writable file");
    let message = open(&path("other.json")).expect_err("another name").to_string();
    assert!(message.contains("or .structure.json, got other.json"), "{message}");
}

#[test]
fn wrong_structures_are_rejected_by_name() {
    for (text, expected) in [
        ("", "file 'p.structure.json': json: expected shoots and leaves, got EOF"),
        ("{}", "file 'p.structure.json': json: expected shoots and leaves, got missing field `shoots`"),
        (r#"{"shoots": [], "leaves": []}"#, "file 'p.structure.json': shoots: expected at least one shoot, got 0"),
        (&PLANT.replace("0.015,", ""), "file 'p.structure.json': shoot 0: radii: expected 5 (one per vertex), got 4"),
        (
            &PLANT.replace("0.003]", "3e38]").replace("[0.3,0,0.7]]", "[0.3,0,3e38]]"),
            "file 'p.structure.json': shoot 1",
        ),
    ] {
        let message = read_text(text).expect_err(expected).to_string();
        assert!(message.starts_with(expected), "expected {expected}, got {message}");
    }
}

/// Changes of single bytes and numbers give a scene or an error.
#[test]
fn changed_structures_do_not_panic() {
    let mut random = fastrand::Rng::with_seed(4);
    let (mut accepted, mut rejected) = (0, 0);
    let numbers = ["0", "-1", "1e-300", "3.4e38", "-1e30", "9223372036854775807", "18446744073709551615", "null", "[]"];
    for _ in 0..400 {
        let mut text = PLANT.to_owned();
        for _ in 0..random.usize(1..4) {
            let digits: Vec<usize> =
                text.char_indices().filter(|(_, c)| c.is_ascii_digit()).map(|(at, _)| at).collect();
            let at = digits[random.usize(0..digits.len())];
            let length = text[at..].find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(1);
            text.replace_range(at..at + length, numbers[random.usize(0..numbers.len())]);
        }
        match read_text(&text).and_then(crate::scene::Scene::new) {
            Ok(_) => accepted += 1,
            Err(_) => rejected += 1,
        }
    }
    assert!(accepted > 20 && rejected > 20, "expected both outcomes, got {accepted} scenes and {rejected} errors");
}
