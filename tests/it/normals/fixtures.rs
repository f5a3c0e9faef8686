//! Meshes whose deformed normals are known analytically, and scenes of these meshes.

use std::sync::Arc;

use modalcast_compute::cpu::CpuDeformer;
use modalcast_model::deform::{DeformedSurface, Deformer};
use modalcast_model::domain::{Corners, Domain, Material, Mesh, Modes, Shape, Texture, Transform, smooth_normals};
use modalcast_model::scene::{NormalMethod, Scene, SceneParts, SceneState};
use nalgebra::{Matrix3, Vector3};

/// Rest normal of a sheet.
pub(crate) const UP: [f32; 3] = [0.0, 0.0, 1.0];

/// A shape with one mode. `displacement` returns the displacement of the mode at a rest position.
pub(crate) fn shape_with_mode(mesh: Mesh, displacement: impl Fn([f32; 3]) -> [f32; 3]) -> Shape {
    let column: Vec<f32> = mesh.rest_positions().iter().flat_map(|position| displacement(*position)).collect();
    let modes = Modes::from_columns(column.len(), 1, column).expect("expected valid modes");
    Shape::new(mesh, modes).expect("expected a valid shape")
}

/// A flat grid over -1..1 x -1..1 at z = 0 that faces +Z; u runs along x.
pub(crate) fn sheet(columns: u32, rows: u32) -> Mesh {
    let coordinate = |index: u32, count: u32| 2.0 * index as f32 / (count - 1) as f32 - 1.0;
    let grid =
        (0..rows).flat_map(|row| (0..columns).map(move |column| (coordinate(column, columns), coordinate(row, rows))));
    let rest_positions: Vec<_> = grid.clone().map(|(x, y)| [x, y, 0.0]).collect();
    let uvs = grid.map(|(x, y)| [0.5 * x + 0.5, 0.5 - 0.5 * y]).collect();
    let normals = vec![UP; rest_positions.len()];
    Mesh::from_indexed(rest_positions, normals, uvs, grid_triangles(columns, rows)).expect("expected a valid mesh")
}

/// Two triangles per cell of a grid, all split along the same diagonal.
pub(crate) fn grid_triangles(columns: u32, rows: u32) -> Vec<[u32; 3]> {
    let cells = (0..rows - 1).flat_map(|row| (0..columns - 1).map(move |column| row * columns + column));
    cells
        .flat_map(|corner| {
            [[corner, corner + 1, corner + columns + 1], [corner, corner + columns + 1, corner + columns]]
        })
        .collect()
}

/// A tube about y with `columns` sides and `rows` rows of vertices. A row has one corner more than vertices: its first
/// and its last corner share a vertex, as at a seam of texture coordinates. The normal of the last corner of each row
/// is rotated by `tilt` degrees.
pub(crate) fn tube(columns: u32, rows: u32, tilt: f32) -> Mesh {
    let column_angle = |column: u32| column as f32 / columns as f32 * std::f32::consts::TAU;
    let rest_positions = (0..rows).flat_map(|row| {
        (0..columns).map(move |column| [column_angle(column).cos(), row as f32, -column_angle(column).sin()])
    });
    let mut corners = Corners::default();
    for (row, column) in (0..rows).flat_map(|row| (0..=columns).map(move |column| (row, column))) {
        let angle = column_angle(column % columns) + if column == columns { tilt.to_radians() } else { 0.0 };
        corners.vertices.push(row * columns + column % columns);
        corners.normals.push([angle.cos(), 0.0, -angle.sin()]);
        corners.uvs.push([column as f32 / columns as f32, 1.0 - row as f32]);
    }
    Mesh::new(rest_positions.collect(), corners, grid_triangles(columns + 1, rows)).expect("expected a valid mesh")
}

/// A unit cube of 8 vertices and 24 corners, four for each face. Every edge is hard.
pub(crate) fn cube() -> Mesh {
    // Bit `axis` of the index of a vertex is its coordinate on that axis.
    let rest_positions = (0..8_u8).map(|vertex| [0, 1, 2].map(|axis| f32::from(vertex >> axis & 1))).collect();
    let (mut corners, mut triangles) = (Corners::default(), Vec::new());
    // Each face has the coordinate `side`, 0 or 1, on `axis`.
    for (axis, side) in (0..3_usize).flat_map(|axis| [(axis, 0_u32), (axis, 1)]) {
        let (second_bit, third_bit) = (1_u32 << ((axis + 1) % 3), 1_u32 << ((axis + 2) % 3));
        let first_corner = corners.vertices.len() as u32;
        corners.vertices.extend([0, second_bit, second_bit | third_bit, third_bit].map(|vertex| vertex | side << axis));
        let mut normal = [0.0; 3];
        normal[axis] = if side == 1 { 1.0 } else { -1.0 };
        corners.normals.extend([normal; 4]);
        let face_triangles = if side == 1 { [[0, 1, 2], [0, 2, 3]] } else { [[0, 2, 1], [0, 3, 2]] };
        triangles.extend(face_triangles.map(|triangle| triangle.map(|corner| first_corner + corner)));
    }
    Mesh::new(rest_positions, corners, triangles).expect("expected a valid mesh")
}

/// A bar of 2 x 1 x 1, loaded from an OBJ file without normals with this crease angle. Its sides are grids of squares,
/// and its mode bends and twists it. Normals are exact.
pub(crate) fn creased_box(crease_angle: f64) -> Arc<Scene> {
    // Vertices of a 5 x 3 x 3 lattice; those in the interior belong to no face.
    let vertex = |[x, y, z]: [usize; 3]| 1 + x + 5 * (y + 3 * z);
    let mut text = String::new();
    for index in 0..45 {
        let [x, y, z] = [index % 5, index / 5 % 3, index / 15].map(|coordinate| 0.5 * coordinate as f32);
        text += &format!("v {x} {y} {z}\n");
    }
    let last = [4, 2, 2];
    for (axis, is_far) in (0..3).flat_map(|axis| [(axis, false), (axis, true)]) {
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        for (i, j) in (0..last[u]).flat_map(|i| (0..last[v]).map(move |j| (i, j))) {
            let corner = |i: usize, j: usize| {
                let mut lattice = [0; 3];
                (lattice[axis], lattice[u], lattice[v]) = (if is_far { last[axis] } else { 0 }, i, j);
                vertex(lattice)
            };
            let mut face = [corner(i, j), corner(i + 1, j), corner(i + 1, j + 1), corner(i, j + 1)];
            if !is_far {
                face.reverse();
            }
            text += &format!("f {} {} {} {}\n", face[0], face[1], face[2], face[3]);
        }
    }
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    std::fs::write(folder.path().join("box.obj"), text).expect("expected a written file");
    let manifest =
        format!("model = 'box.obj'\nmodes = ''\ncrease_angle = {crease_angle:?}\ndeform.normals = 'exact'\n");
    std::fs::write(folder.path().join("scene.toml"), manifest).expect("expected a written file");
    let path = folder.path().to_str().expect("expected a UTF-8 path");
    let scene = modalcast_model::load::open(path).expect("expected a valid scene").scene;
    assert_eq!(scene.shapes[0].mesh.rest_positions().len(), 45, "expected the vertices of the file");
    let bend = |[x, y, z]: [f32; 3]| [-0.4 * x * y, 0.5 * x * x + 0.3 * x * z, -0.3 * x * y];
    create_scene(vec![shape_with_mode(scene.shapes[0].mesh.clone(), bend)])
}

/// A unit sphere of 8 x 4^level triangles with area-weighted normals: an octahedron whose triangles are split `level`
/// times.
pub(crate) fn sphere(level: u32) -> Mesh {
    let mut triangles: Vec<[Vector3<f64>; 3]> = octahedron_faces();
    for _ in 0..level {
        let split_triangle = |[a, b, c]: [Vector3<f64>; 3]| {
            let [ab, bc, ca] = [a + b, b + c, c + a].map(|middle| middle.normalize());
            [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
        };
        triangles = triangles.into_iter().flat_map(split_triangle).collect();
    }
    let mut rest_positions: Vec<[f32; 3]> = Vec::new();
    // Index of the vertex at a position. Adds a vertex if there is none.
    let mut vertex_index = |position: Vector3<f64>| {
        let position: [f32; 3] = position.cast::<f32>().into();
        let is_near = |other: &[f32; 3]| (0..3).all(|axis| (other[axis] - position[axis]).abs() < 1e-5);
        rest_positions.iter().position(is_near).unwrap_or_else(|| {
            rest_positions.push(position);
            rest_positions.len() - 1
        }) as u32
    };
    let triangles: Vec<_> = triangles.into_iter().map(|triangle| triangle.map(&mut vertex_index)).collect();
    let vertices: Vec<u32> = (0..rest_positions.len() as u32).collect();
    let normals = smooth_normals(&rest_positions, &vertices, &triangles);
    Mesh::from_indexed(rest_positions, normals, vec![], triangles).expect("expected a valid mesh")
}

/// The faces of an octahedron, one per octant, with counterclockwise corners.
fn octahedron_faces() -> Vec<[Vector3<f64>; 3]> {
    let signs = (0..8).map(|bits| [0, 1, 2].map(|axis| if bits >> axis & 1 == 1 { -1.0 } else { 1.0 }));
    let triangle = |[x, y, z]: [f64; 3]| {
        let [a, b, c] = [Vector3::x() * x, Vector3::y() * y, Vector3::z() * z];
        if x * y * z > 0.0 { [a, b, c] } else { [a, c, b] }
    };
    signs.map(triangle).collect()
}

/// A scene of shapes with exact normals. Shapes with texture coordinates have a normal map.
pub(crate) fn create_scene(shapes: Vec<Shape>) -> Arc<Scene> {
    scene_with_normals(shapes, NormalMethod::Exact)
}

/// A scene of shapes with rigid or exact normals. Shapes with texture coordinates have a normal map.
pub(crate) fn scene_with_normals(shapes: Vec<Shape>, normals: NormalMethod) -> Arc<Scene> {
    let mut parts = SceneParts::named("bent");
    parts.deformation.normals = normals;
    parts.textures = vec![Texture::new("flat", 1, 1, vec![128, 128, 255, 255]).expect("expected a valid texture")];
    parts.materials = vec![Material { normal_texture: Some(0), ..Material::default() }];
    parts.domains = (0..shapes.len()).map(|shape| Domain::new(format!("shape {shape}"), shape)).collect();
    parts.shapes = shapes;
    Scene::new(parts).expect("expected a valid scene")
}

/// A state in which every reduced coordinate is q and every transform has the given linear part and translation.
pub(crate) fn create_state(scene: &Scene, q: f32, linear: Matrix3<f64>, translation: [f64; 3]) -> SceneState {
    let mut state = SceneState::rest(scene);
    state.q.fill(q);
    state.transforms.fill(Transform::from_parts(&linear, &translation.into()));
    state
}

/// The rest state with every reduced coordinate set to q.
pub(crate) fn uniform_q_state(scene: &Scene, q: f32) -> SceneState {
    create_state(scene, q, Matrix3::identity(), [0.0; 3])
}

/// The surface that the CPU deformer computes for a state.
pub(crate) fn deform_on_cpu(scene: &Arc<Scene>, state: &SceneState) -> DeformedSurface {
    let mut deformer = CpuDeformer::new(scene);
    deformer.deform(state).expect("expected the step to succeed");
    deformer.surface().expect("expected a surface").clone()
}

/// Exact normals and tangents of the reference.
pub(crate) fn reference_normals_and_tangents(scene: &Scene, state: &SceneState) -> (Vec<[f64; 3]>, Vec<[f64; 4]>) {
    let positions = modalcast_compute::reference::deform(scene, state);
    let tangents = modalcast_compute::reference::exact_tangents(scene, state, &positions);
    (modalcast_compute::reference::exact_normals(scene, state, &positions), tangents)
}

/// Angle between two directions in degrees; NaN if a component is NaN.
pub(crate) fn angle_degrees(a: [f64; 3], b: [f64; 3]) -> f64 {
    let (a, b) = (Vector3::from(a), Vector3::from(b));
    a.cross(&b).norm().atan2(a.dot(&b)).to_degrees()
}

/// Largest angle in degrees between normals and expected normals. It is infinite if a normal is NaN or not of unit
/// length.
pub(crate) fn max_angle_degrees(normals: &[f32], expected_normals: &[[f64; 3]]) -> f64 {
    assert_eq!(normals.len(), 3 * expected_normals.len(), "expected three numbers per direction");
    let angle = |(normal, expected): (&[f32], &[f64; 3])| {
        let normal: [f64; 3] = [0, 1, 2].map(|axis| f64::from(normal[axis]));
        let is_unit = (Vector3::from(normal).norm() - 1.0).abs() < 1e-6;
        let angle = angle_degrees(normal, *expected);
        if is_unit && !angle.is_nan() { angle } else { f64::INFINITY }
    };
    normals.chunks_exact(3).zip(expected_normals).map(angle).fold(0.0, f64::max)
}
