//! A cube of 0.4 units at coordinates of a map, in every format: its vertices and its creases are those of the same
//! cube at the origin.

use std::path::Path;

use base64::Engine as _;
use nalgebra::Vector3;
use ndarray::Array2;
use zip::CompressionMethod;

use super::LoadOptions;
use super::asset_dir::AssetDir;
use super::modes::test_archives::{archive, npy};
use super::source;
use crate::scene::{Scene, SceneState};

/// Easting, northing and height in meters. f32 rounds the northing by up to 0.25.
const CENTER: [f64; 3] = [500_000.3, 4_649_776.2, 12.1];
const SIDE: f64 = 0.4;

/// Largest accepted error of a vertex in diagonals of the cube.
const MAX_ERROR: f64 = 1e-6;

const QUADS: [[usize; 4]; 6] = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];

/// Bit `axis` of the index of a corner selects the upper side.
fn cube(center: [f64; 3]) -> Vec<[f64; 3]> {
    let coordinate = |corner: usize, axis: usize| center[axis] + SIDE * ((corner >> axis & 1) as f64 - 0.5);
    (0..8).map(|corner| std::array::from_fn(|axis| coordinate(corner, axis))).collect()
}

fn triangles() -> Vec<[usize; 3]> {
    QUADS.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]).collect()
}

fn obj(center: [f64; 3], line_end: &str) -> Vec<u8> {
    obj_of_vertices(&cube(center), 0, line_end)
}

/// A cube whose corners begin at the vertex `first`, counted from 0.
fn obj_of_vertices(vertices: &[[f64; 3]], first: usize, line_end: &str) -> Vec<u8> {
    let vertices = vertices.iter().map(|[x, y, z]| format!("v {x:?} {y:?} {z:?}{line_end}"));
    let faces = QUADS.iter().map(|quad| {
        let [a, b, c, d] = quad.map(|corner| corner + first + 1);
        format!("f {a} {b} {c} {d}{line_end}")
    });
    vertices.chain(faces).collect::<String>().into()
}

fn ply(center: [f64; 3], format: &str) -> Vec<u8> {
    let mut bytes = format!(
        "ply\nformat {format} 1.0\nelement vertex 8\nproperty double x\nproperty double y\nproperty double z\n\
         element face 6\nproperty list uchar int vertex_indices\nend_header\n"
    )
    .into_bytes();
    match format {
        "ascii" => {
            cube(center).iter().for_each(|[x, y, z]| bytes.extend(format!("{x:?} {y:?} {z:?}\n").bytes()));
            QUADS.iter().for_each(|[a, b, c, d]| bytes.extend(format!("4 {a} {b} {c} {d}\n").bytes()));
        }
        _ => {
            bytes.extend(cube(center).as_flattened().iter().flat_map(|number| number.to_le_bytes()));
            for quad in QUADS {
                bytes.push(4);
                bytes.extend(quad.iter().flat_map(|corner| (*corner as i32).to_le_bytes()));
            }
        }
    }
    bytes
}

fn stl(center: [f64; 3]) -> Vec<u8> {
    let corners = cube(center);
    let facet = |triangle: [usize; 3]| {
        let vertex = |corner: usize| {
            format!("vertex {:?} {:?} {:?}\n", corners[corner][0], corners[corner][1], corners[corner][2])
        };
        format!("facet normal 0 0 0\nouter loop\n{}endloop\nendfacet\n", triangle.map(vertex).concat())
    };
    format!("solid cube\n{}endsolid cube\n", triangles().into_iter().map(facet).collect::<String>()).into()
}

fn npz(center: [f64; 3]) -> Vec<u8> {
    let corners = cube(center);
    let vertices = Array2::from_shape_fn((8, 3), |(corner, axis)| corners[corner][axis]);
    let faces = Array2::from_shape_fn((6, 4), |(face, corner)| QUADS[face][corner] as i64);
    archive(&[("vertices", npy(&vertices)), ("faces", npy(&faces))], CompressionMethod::Stored)
}

/// A cube at the origin, whose node has a translation, below a parent with a rotation about z by 90 degrees.
fn gltf(center: [f64; 3]) -> Vec<u8> {
    let positions = cube([0.0; 3]);
    let floats = positions.as_flattened().iter().flat_map(|number| (*number as f32).to_le_bytes());
    let indices = triangles().into_iter().flatten().flat_map(|corner| (corner as u16).to_le_bytes());
    let buffer: Vec<u8> = floats.chain(indices).collect();
    let data = base64::engine::general_purpose::STANDARD.encode(&buffer);
    // The rotation maps (x, y, z) to (-y, x, z).
    let [x, y, z] = [center[1], -center[0], center[2]];
    let sine = std::f64::consts::FRAC_1_SQRT_2;
    let document = serde_json::json!({
        "asset": { "version": "2.0" },
        "nodes": [{ "children": [1], "rotation": [0.0, 0.0, sine, sine] }, { "mesh": 0, "translation": [x, y, z] }],
        "scenes": [{ "nodes": [0] }],
        "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0 }, "indices": 1 }] }],
        "buffers": [{ "byteLength": buffer.len(), "uri": format!("data:application/octet-stream;base64,{data}") }],
        "bufferViews": [
            { "buffer": 0, "byteLength": 96 },
            { "buffer": 0, "byteOffset": 96, "byteLength": 72 },
        ],
        "accessors": [
            { "bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3",
              "min": [-0.2, -0.2, -0.2], "max": [0.2, 0.2, 0.2] },
            { "bufferView": 1, "componentType": 5123, "count": 36, "type": "SCALAR" },
        ],
    });
    document.to_string().into_bytes()
}

/// Loads a file of a folder.
fn load(folder: &Path, name: &str) -> std::sync::Arc<Scene> {
    let description = source::read(&AssetDir::unrestricted(folder), name, &LoadOptions::default()).expect(name);
    Scene::new(description.parts).expect(name)
}

/// Loads a file with this content.
fn load_content(name: &str, content: &[u8]) -> std::sync::Arc<Scene> {
    let folder = tempfile::tempdir().expect("a temporary folder");
    std::fs::write(folder.path().join(name), content).expect("a writable file");
    load(folder.path(), name)
}

/// World positions at rest, as deformers compute them from f32.
fn world_positions(scene: &Scene) -> Vec<Vector3<f64>> {
    let state = SceneState::rest(scene);
    let (t, origin) = (state.transform_of(scene, 0).0, Vector3::from(state.origin_of(0)));
    let position = |v: &[f32; 3]| {
        let x = |row: usize| {
            t[4 * row].mul_add(v[0], t[4 * row + 1].mul_add(v[1], t[4 * row + 2].mul_add(v[2], t[4 * row + 3])))
        };
        origin + Vector3::new(x(0), x(1), x(2)).cast::<f64>()
    };
    scene.shape_of(0).mesh.rest_positions().iter().map(position).collect()
}

/// Largest distance of the corners of a cube from the nearest vertex, in diagonals of the cube.
fn error_of(positions: &[Vector3<f64>], center: [f64; 3]) -> f64 {
    let nearest = |corner: [f64; 3]| {
        let distances = positions.iter().map(|position| (position - Vector3::from(corner)).norm());
        distances.fold(f64::INFINITY, f64::min)
    };
    cube(center).into_iter().map(nearest).fold(0.0, f64::max) / (SIDE * 3.0_f64.sqrt())
}

fn check(name: &str, scene: &Scene, center: [f64; 3]) {
    let positions = world_positions(scene);
    assert_eq!(positions.len(), 8, "{name}");
    let error = error_of(&positions, center);
    assert!(error <= MAX_ERROR, "{name} at {center:?}: {error:e} diagonals");
    let corners = scene.shape_of(0).mesh.corners();
    assert_eq!(corners.vertices.len(), 24, "{name}: expected three corners of each vertex");
    let is_axis = |normal: &[f32; 3]| normal.iter().filter(|component| component.abs() > 1e-3).count() == 1;
    assert!(corners.normals.iter().all(is_axis), "{name}: {:?}", corners.normals);
}

#[test]
fn every_format_keeps_the_vertices_and_creases_of_a_far_cube() {
    let siblings = [
        CENTER,
        [0.1, -4_649_776.2, 0.2],
        [0.1, 0.2, 7_000_000.7],
        [1e4 + 0.3, 0.2, 0.1],
        [1e7 + 0.3, -1e7 - 0.4, 1e7 + 0.1],
        [0.0; 3],
    ];
    for center in siblings {
        for (name, content) in [
            ("a.obj", obj(center, "\n")),
            ("b.obj", obj(center, "\r\n")),
            ("a.ply", ply(center, "ascii")),
            ("b.ply", ply(center, "binary_little_endian")),
            ("a.stl", stl(center)),
            ("a.npz", npz(center)),
            ("a.gltf", gltf(center)),
        ] {
            check(name, &load_content(name, &content), center);
        }
    }
    // Control: positions that are rounded to f32 first are wrong.
    let rounded = CENTER.map(|coordinate| f64::from(coordinate as f32));
    let error = error_of(&cube(rounded).into_iter().map(Vector3::from).collect::<Vec<_>>(), CENTER);
    assert!(error > 0.1, "control: {error}");
}

#[test]
fn placements_of_manifests_keep_their_precision() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    std::fs::write(folder.path().join("cube.obj"), obj([0.0; 3], "\n")).expect("a writable file");
    let [x, y, z] = CENTER;
    let placements = [
        format!("translation = [{x:?}, {y:?}, {z:?}]"),
        format!("matrix = [1, 0, 0, {x:?}, 0, 1, 0, {y:?}, 0, 0, 1, {z:?}]"),
        // A cube is the same after a quarter turn.
        format!("translation = [{x:?}, {y:?}, {z:?}]\naxis = [0, 0, 1]\ndegrees = 90"),
    ];
    for placement in placements {
        for transforms in ["affine", "rigid"] {
            let manifest = format!("model = 'cube.obj'\ntransforms = '{transforms}'\n[placement]\n{placement}\n");
            std::fs::write(folder.path().join("scene.toml"), &manifest).expect("a writable file");
            check(&manifest, &load(folder.path(), "scene.toml"), CENTER);
        }
    }
}

/// A cube far in its own file that a placement brings near, and one that two entries place.
#[test]
fn placements_of_far_models_are_exact() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    std::fs::write(folder.path().join("cube.obj"), obj(CENTER, "\n")).expect("a writable file");
    let [x, y, z] = CENTER.map(|coordinate| -coordinate);
    let manifest = format!("model = 'cube.obj'\n[placement]\ntranslation = [{x:?}, {y:?}, {z:?}]\n");
    std::fs::write(folder.path().join("scene.toml"), &manifest).expect("a writable file");
    check("back", &load(folder.path(), "scene.toml"), [0.0; 3]);
    // The up axis of the model is turned to that of the scene: (x, y, z) becomes (x, z, -y).
    let manifest = "up = 'y'\n[[domain]]\nmodel = 'cube.obj'\nup = 'z'\n";
    std::fs::write(folder.path().join("scene.toml"), manifest).expect("a writable file");
    check("turned", &load(folder.path(), "scene.toml"), [CENTER[0], CENTER[2], -CENTER[1]]);
}

/// A vertex that no face uses changes neither bounds nor camera, wherever it is.
#[test]
fn unused_vertices_do_not_change_bounds() {
    let alone = load_content("a.obj", &obj([0.0; 3], "\n"));
    for stray in [[1000.0, 0.0, 0.0], [0.0, -1e6, 0.0], [-3.0, 4.0, 1e9]] {
        let (last, first) = ([cube([0.0; 3]), vec![stray]].concat(), [vec![stray], cube([0.0; 3])].concat());
        for content in [obj_of_vertices(&last, 0, "\n"), obj_of_vertices(&first, 1, "\n")] {
            let scene = load_content("a.obj", &content);
            assert_eq!(scene.rest_bounds, alone.rest_bounds, "{stray:?}");
            assert!(!scene.is_far && scene.origin_grids == alone.origin_grids, "{stray:?}");
            assert_eq!(scene.layout.vertices, 9, "expected the vertex to be kept");
        }
    }
    // Some exporters write a vertex at zero.
    let vertices = [vec![[0.0; 3]], cube(CENTER)].concat();
    let scene = load_content("a.obj", &obj_of_vertices(&vertices, 1, "\n"));
    assert!(scene.is_far && (scene.rest_bounds.diagonal() - SIDE * 3.0_f64.sqrt()).abs() < 1e-6);
    let all = crate::scene::BoundingBox::from_positions(scene.shape_of(0).mesh.rest_positions().as_flattened());
    assert!(all.diagonal() > 4e6, "control: expected the vertex at zero");
}
