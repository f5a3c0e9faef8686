use super::*;
use crate::domain::smooth_normals;

/// The 8 vertices of a cube.
const CUBE: [[f32; 3]; 8] = [
    [0.0, 0.0, 0.0],
    [1.0, 0.0, 0.0],
    [1.0, 1.0, 0.0],
    [0.0, 1.0, 0.0],
    [0.0, 0.0, 1.0],
    [1.0, 0.0, 1.0],
    [1.0, 1.0, 1.0],
    [0.0, 1.0, 1.0],
];
/// Two triangles per side of the cube.
const CUBE_TRIANGLES: [[u32; 3]; 12] = [
    [0, 2, 1],
    [0, 3, 2],
    [4, 5, 6],
    [4, 6, 7],
    [0, 1, 5],
    [0, 5, 4],
    [2, 3, 7],
    [2, 7, 6],
    [0, 4, 7],
    [0, 7, 3],
    [1, 2, 6],
    [1, 6, 5],
];

/// Splits a mesh with one corner per vertex and without normals.
fn split(rest_positions: &[[f32; 3]], triangles: &[[u32; 3]], degrees: f64) -> CreasedCorners {
    let vertices: Vec<u32> = (0..rest_positions.len() as u32).collect();
    let crease_angle = CreaseAngle::from_degrees(degrees).expect("a valid angle");
    split_at_creases(rest_positions, &vertices, triangles, &[], crease_angle)
}

/// The normals of the corners of a triangle.
fn normals_of(creased: &CreasedCorners, triangle: usize) -> [[f32; 3]; 3] {
    creased.triangles[triangle].map(|corner| creased.normals[corner as usize])
}

/// Two unit squares of two triangles each that share the edge from (0, 0, 0) to (0, 1, 0). The second one is bent
/// upwards by `degrees`.
fn hinge(degrees: f64) -> ([[f32; 3]; 6], [[u32; 3]; 4]) {
    let (sine, cosine) = degrees.to_radians().sin_cos();
    let (x, z) = (cosine as f32, sine as f32);
    let positions = [[-1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 1.0, 0.0], [x, 0.0, z], [x, 1.0, z]];
    (positions, [[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]])
}

/// The side of a prism with `sides` sides and no caps.
fn prism(sides: u32) -> (Vec<[f32; 3]>, Vec<[u32; 3]>) {
    let angle = |side: u32| (f64::from(side) / f64::from(sides) * std::f64::consts::TAU).sin_cos();
    let positions = (0..2 * sides).map(|index| {
        let (sine, cosine) = angle(index / 2);
        [cosine as f32, sine as f32, (index % 2) as f32]
    });
    let triangles = (0..sides).flat_map(|side| {
        let (a, b) = (2 * side, 2 * ((side + 1) % sides));
        [[a, b, b + 1], [a, b + 1, a + 1]]
    });
    (positions.collect(), triangles.collect())
}

/// Deterministic numbers below a limit.
fn random_numbers() -> impl FnMut(u32) -> u32 {
    let mut state = 1_u32;
    move |limit| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) % limit
    }
}

#[test]
fn cube_has_hard_edges_by_default() {
    let creased = split(&CUBE, &CUBE_TRIANGLES, CreaseAngle::default().degrees());
    assert_eq!(creased.source_corners.len(), 24);
    for (index, vertices) in CUBE_TRIANGLES.iter().enumerate() {
        let [a, b, c] = vertices.map(|vertex| Vector3::from(CUBE[vertex as usize]));
        let normal: [f32; 3] = (b - a).cross(&(c - a)).into();
        assert_eq!(normals_of(&creased, index), [normal; 3], "triangle {index}");
        let sources = creased.triangles[index].map(|corner| creased.source_corners[corner as usize]);
        assert_eq!(sources, *vertices, "expected corners of the same vertices");
    }
    // A vertex has one or two triangles on each of its three sides, so the sides have different weights.
    let smooth = split(&CUBE, &CUBE_TRIANGLES, 180.0);
    assert_eq!((smooth.source_corners.len(), &smooth.triangles[..]), (8, &CUBE_TRIANGLES[..]));
}

#[test]
fn edge_is_hard_only_above_the_crease_angle() {
    for (bend, crease_angle, is_hard) in [
        (39.9, 40.0, false),
        (40.1, 40.0, true),
        (90.0, 90.0, false),
        (90.1, 90.0, true),
        (0.0, 0.0, false),
        (0.2, 0.0, true),
        (179.0, 180.0, false),
        (179.0, 178.0, true),
    ] {
        let (positions, triangles) = hinge(bend);
        let creased = split(&positions, &triangles, crease_angle);
        assert_eq!(creased.source_corners.len(), if is_hard { 8 } else { 6 }, "{bend} degrees at {crease_angle}");
        let [a, b] = [normals_of(&creased, 1)[1], normals_of(&creased, 3)[2]];
        assert_eq!(a != b, is_hard, "{bend} degrees at {crease_angle}: {a:?} and {b:?}");
    }
}

#[test]
fn prisms_are_round_from_nine_sides_on() {
    for (sides, corners_per_vertex) in [(6, 2), (8, 2), (9, 1), (12, 1), (64, 1)] {
        let (positions, triangles) = prism(sides);
        let creased = split(&positions, &triangles, 40.0);
        assert_eq!(creased.source_corners.len(), corners_per_vertex * positions.len(), "{sides} sides");
    }
}

#[test]
fn normals_weight_triangles_by_area() {
    // The bent square is stretched to three times the area of the other one.
    let (mut positions, triangles) = hinge(30.0);
    for position in &mut positions[4..] {
        (position[0], position[2]) = (3.0 * position[0], 3.0 * position[2]);
    }
    let creased = split(&positions, &triangles, 40.0);
    // Vertex 2 has two triangles of the flat square and one of the bent one.
    let (sine, cosine) = 30_f64.to_radians().sin_cos();
    let expected = Vector3::new(-3.0 * sine, 0.0, 2.0 + 3.0 * cosine).normalize().cast::<f32>();
    let normal = Vector3::from(creased.normals[creased.triangles[3][2] as usize]);
    assert!((normal - expected).norm() < 1e-6, "expected {expected}, got {normal}");
}

#[test]
fn angle_180_equals_smooth_normals_bit_for_bit() {
    let mut random = random_numbers();
    for _ in 0..100 {
        let positions: Vec<[f32; 3]> = (0..12).map(|_| [0; 3].map(|_| random(7) as f32 - 3.0)).collect();
        let triangles: Vec<[u32; 3]> = (0..30).map(|_| [0; 3].map(|_| random(12))).collect();
        let vertices: Vec<u32> = (0..12).collect();
        let creased = split(&positions, &triangles, 180.0);
        assert_eq!(creased.triangles, triangles);
        assert_eq!(creased.source_corners, vertices);
        assert_eq!(creased.normals, smooth_normals(&positions, &vertices, &triangles));
    }
}

/// The normal of each corner of each triangle is independent of the order of the triangles, and corners keep their
/// vertices. The triangles have common, repeated and opposite edges, and some have no area: those are not drawn, and
/// their normals are not compared.
#[test]
fn random_triangles_are_independent_of_their_order() {
    let mut random = random_numbers();
    for _ in 0..200 {
        let positions: Vec<[f32; 3]> = (0..8).map(|_| [0; 3].map(|_| random(4) as f32)).collect();
        let mut triangles: Vec<[u32; 3]> = (0..24).map(|_| [0; 3].map(|_| random(8))).collect();
        let creased = split(&positions, &triangles, 40.0);
        for (triangle, corners) in triangles.iter().zip(&creased.triangles) {
            assert_eq!(corners.map(|corner| creased.source_corners[corner as usize]), *triangle);
        }
        triangles.reverse();
        let reversed = split(&positions, &triangles, 40.0);
        let count = triangles.len();
        let has_area = |vertices: &[u32; 3]| TriangleArea::new(&positions, *vertices).direction.is_some();
        for index in (0..count).filter(|index| has_area(&triangles[count - 1 - index])) {
            for (a, b) in normals_of(&creased, index).iter().zip(normals_of(&reversed, count - 1 - index)) {
                let difference = (Vector3::from(*a) - Vector3::from(b)).norm();
                assert!(difference < 1e-6, "triangle {:?}: {a:?} and {b:?}", triangles[count - 1 - index]);
            }
        }
    }
}

#[test]
fn web_of_a_t_joint_does_not_split_its_flange() {
    // The flange is in the plane z = 0, the web stands on its middle.
    let (mut positions, mut triangles) = (hinge(0.0).0.to_vec(), hinge(0.0).1.to_vec());
    positions.extend([[0.0, 0.0, 1.0], [0.0, 1.0, 1.0]]);
    triangles.extend([[1, 2, 7], [1, 7, 6]]);
    let creased = split(&positions, &triangles, 40.0);
    assert_eq!(creased.source_corners.len(), 8 + 2, "expected two corners at the two vertices of the joint");
    assert_eq!(normals_of(&creased, 0), [[0.0, 0.0, 1.0]; 3]);
    assert_eq!(normals_of(&creased, 3), [[0.0, 0.0, 1.0]; 3]);
    assert_eq!(normals_of(&creased, 4), [[1.0, 0.0, 0.0]; 3]);
}

#[test]
fn edge_of_many_triangles_is_a_crease() {
    let positions_of = |count: u32| {
        let blade = |index: u32| [(f64::from(index) * 0.01).cos() as f32, 0.0, (f64::from(index) * 0.01).sin() as f32];
        [[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]].into_iter().chain((0..count).map(blade)).collect::<Vec<_>>()
    };
    let triangles_of = |count: u32| (0..count).map(|index| [0, 2 + index, 1]).collect::<Vec<_>>();
    let limit = MAX_EDGE_TRIANGLES as u32;
    for (count, corners) in [(limit, limit + 2), (limit + 1, 3 * (limit + 1))] {
        let creased = split(&positions_of(count), &triangles_of(count), 40.0);
        assert_eq!(creased.source_corners.len() as u32, corners, "{count} triangles");
    }
}

#[test]
fn opposite_windings_have_opposite_normals() {
    let (positions, mut triangles) = hinge(0.0);
    triangles[2].swap(0, 1);
    triangles[3].swap(0, 1);
    let creased = split(&positions, &triangles, 40.0);
    assert_eq!(normals_of(&creased, 0), [[0.0, 0.0, 1.0]; 3]);
    assert_eq!(normals_of(&creased, 3), [[0.0, 0.0, -1.0]; 3]);
    // The two sides of a leaf with common vertices.
    let leaf = split(&positions, &[[0, 1, 2], [2, 1, 0]], 40.0);
    assert_eq!(normals_of(&leaf, 0), [[0.0, 0.0, 1.0]; 3]);
    assert_eq!(normals_of(&leaf, 1), [[0.0, 0.0, -1.0]; 3]);
}

#[test]
fn triangles_without_area_connect_their_neighbors() {
    // A triangle without area replaces the edge of the hinge: vertex 6 is at the position of vertex 2 or on the edge.
    for (position, bend, corners_at_vertex_1) in [
        ([0.0, 1.0, 0.0], 30.0, 1),
        ([0.0, 1.0, 0.0], 60.0, 2),
        ([0.0, 0.5, 0.0], 30.0, 1),
        ([1e-9, 1.0, 0.0], 30.0, 1),
    ] {
        let (positions, mut triangles) = hinge(bend);
        let positions = [&positions[..], &[position]].concat();
        triangles[3] = [1, 5, 6];
        let with_sliver = [&triangles[..], &[[1, 6, 2]]].concat();
        let creased = split(&positions, &with_sliver, 40.0);
        let count = creased.source_corners.iter().filter(|source| **source == 1).count();
        assert_eq!(count, corners_at_vertex_1, "{position:?} at {bend} degrees");
        // Without this triangle, vertices 2 and 6 are not connected.
        let disconnected = split(&positions, &triangles, 40.0);
        assert_eq!(disconnected.source_corners.iter().filter(|source| **source == 1).count(), 2);
    }
}

#[test]
fn meshes_without_area_have_z_as_normal() {
    let positions = [[0.0; 3], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0; 3]];
    for degrees in [0.0, 40.0, 180.0] {
        let creased = split(&positions, &[[0, 1, 2], [0, 0, 1], [1, 1, 1], [0, 3, 2]], degrees);
        assert_eq!(creased.normals, [[0.0, 0.0, 1.0]; 4], "{degrees} degrees");
        assert_eq!(creased.triangles[1], [0, 0, 1]);
    }
}

#[test]
fn extreme_coordinates_have_the_same_creases() {
    for scale in [1e-18_f32, 1e-6, 1e6, 1e18] {
        let positions = CUBE.map(|position| position.map(|coordinate| coordinate * scale));
        let creased = split(&positions, &CUBE_TRIANGLES, 40.0);
        assert_eq!(creased.source_corners.len(), 24, "scale {scale}");
        assert_eq!(normals_of(&creased, 2), [[0.0, 0.0, 1.0]; 3], "scale {scale}");
    }
    // Far from the origin, the normals of small triangles consist of rounding errors, so their edges are not creases.
    let (positions, triangles) = hinge(90.0);
    let far = positions.map(|position| position.map(|coordinate| coordinate * 1e-3 + 4096.0));
    assert_eq!(split(&far, &triangles, 40.0).source_corners.len(), 6);
    for value in [f32::NAN, f32::INFINITY, f32::MAX] {
        let mut invalid = positions;
        invalid[1][0] = value;
        split(&invalid, &triangles, 40.0);
    }
}

#[test]
fn vertices_of_equal_coordinates_stay_separate() {
    let (positions, mut triangles) = hinge(20.0);
    let positions = [&positions[..], &[positions[1], positions[2]]].concat();
    for vertex in triangles[2..].as_flattened_mut() {
        *vertex = match *vertex {
            1 => 6,
            2 => 7,
            other => other,
        };
    }
    let creased = split(&positions, &triangles, 40.0);
    assert_eq!(creased.source_corners, [0, 1, 2, 3, 4, 5, 6, 7]);
    assert_eq!(normals_of(&creased, 0), [[0.0, 0.0, 1.0]; 3], "expected no smoothing across the duplicates");
}

#[test]
fn corners_with_normals_and_without_triangles_are_kept() {
    let own_normal = [0.6, 0.0, 0.8];
    let mut own_normals = vec![None; 9];
    own_normals[0] = Some(own_normal);
    let positions = [&CUBE[..], &[[5.0; 3]]].concat();
    let vertices: Vec<u32> = (0..9).collect();
    let creased = split_at_creases(&positions, &vertices, &CUBE_TRIANGLES, &own_normals, CreaseAngle::default());
    // Three corners at each of seven vertices, one at vertex 0, and one at the unused vertex.
    assert_eq!(creased.source_corners.len(), 21 + 1 + 1);
    assert_eq!((creased.source_corners[0], creased.normals[0]), (0, own_normal));
    assert_eq!((creased.source_corners[22], creased.normals[22]), (8, [0.0, 0.0, 1.0]));
}

/// 200,000 triangles at one vertex: a quadratic search for fans would take minutes.
#[test]
fn vertex_of_many_triangles_needs_no_quadratic_time() {
    let sides = 200_000_u32;
    let angle = |side: u32| (f64::from(side) / f64::from(sides) * std::f64::consts::TAU).sin_cos();
    let rim = (0..sides).map(|side| [angle(side).1 as f32 * 1e3, angle(side).0 as f32 * 1e3, 0.0]);
    let positions: Vec<[f32; 3]> = [[0.0, 0.0, 1e3]].into_iter().chain(rim).collect();
    let cone: Vec<[u32; 3]> = (0..sides).map(|side| [0, 1 + side, 1 + (side + 1) % sides]).collect();
    let creased = split(&positions, &cone, 40.0);
    assert_eq!(creased.source_corners.len(), positions.len(), "expected one normal at the tip");
    assert!(creased.normals[0][2] > 0.999_99, "{:?}", creased.normals[0]);
    // All triangles at one edge.
    let blades: Vec<[u32; 3]> = (2..sides).map(|vertex| [0, 1, vertex]).collect();
    assert_eq!(split(&positions, &blades, 40.0).triangles.len(), blades.len());
}

#[test]
fn angles_out_of_range_are_rejected() {
    for degrees in [-0.1, 180.1, f64::NAN, f64::INFINITY] {
        let message = CreaseAngle::from_degrees(degrees).expect_err("an angle out of range").to_string();
        assert_eq!(message, format!("crease_angle: expected 0 to 180 degrees, got {degrees}"));
    }
    assert_eq!(CreaseAngle::from_degrees(40.0).expect("a valid angle"), CreaseAngle::default());
}
