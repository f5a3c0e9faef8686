//! Exact normals and tangents of the CUDA deformer equal those of the f64 twin for the same positions.

use std::sync::Arc;

use modalcast_compute::gpu::{BufferRole, CudaDeformer};
use modalcast_compute::reference::{exact_normals, exact_tangents, rigid_normals, rigid_tangents};
use modalcast_model::deform::Deformer;
use modalcast_model::domain::{Corners, Mesh, Modes, Shape, Transform};
use modalcast_model::scene::{NormalMethod, Scene, SceneState};
use nalgebra::Vector3;

use crate::accuracy::{DIRECTION, largest_error, same_bits};
use crate::scenes::{self, NORMAL_MAPPED, Random, domain};
use crate::twins::deformer;

/// A tube of `around` x `rows` vertices with a seam, a hard ring every fifth row, and `rank` smooth modes.
fn tube(random: &mut Random, around: u32, rows: u32, rank: usize) -> Shape {
    let angle = |column: u32| column as f32 / around as f32 * std::f32::consts::TAU;
    let place = |row: u32, column: u32| {
        let radius = 1.0 + 0.2 * (row as f32).sin();
        [radius * angle(column).cos(), 6.0 * row as f32 / rows as f32 - 3.0, -radius * angle(column).sin()]
    };
    let rest: Vec<_> = (0..rows).flat_map(|row| (0..around).map(move |column| place(row, column))).collect();
    let mut corners = Corners::default();
    for (row, lower) in (0..rows).flat_map(|row| [(row, true), (row, false)]) {
        let tilt = if row % 5 == 0 && !lower { 0.4 } else { 0.0 };
        for column in 0..=around {
            let turn = angle(column % around);
            corners.vertices.push(row * around + column % around);
            corners.normals.push([turn.cos(), tilt, -turn.sin()]);
            corners.uvs.push([column as f32 / around as f32, row as f32 / rows as f32]);
        }
    }
    let triangle = |row: u32, column: u32| {
        let (low, high) = ((2 * row + 1) * (around + 1) + column, (2 * row + 2) * (around + 1) + column);
        [[low, low + 1, high + 1], [low, high + 1, high]]
    };
    let triangles = (0..rows - 1).flat_map(|row| (0..around).flat_map(move |column| triangle(row, column))).collect();
    let mut column = Vec::with_capacity(3 * rest.len() * rank);
    for _ in 0..rank {
        let (waves, amounts) = (random.triple(), random.triple());
        let phase = |place: &[f32; 3]| (0..3).map(|axis| 2.0 * waves[axis] * place[axis]).sum::<f32>();
        let size = 0.3 / (rank as f32).sqrt();
        column.extend(rest.iter().flat_map(|place| amounts.map(|amount| size * amount * phase(place).sin())));
    }
    let modes = Modes::from_columns(3 * rest.len(), rank, column).expect("modes");
    Shape::new(Mesh::new(rest, corners, triangles).expect("a tube"), modes).expect("a shape")
}

/// A scene of shapes with exact normals, `instances` domains per shape, and optional normal maps.
fn scene_of(shapes: Vec<Shape>, instances: usize, normal_maps: bool, rigid: bool) -> Arc<Scene> {
    let count = shapes.len();
    let mut parts = scenes::parts(shapes);
    parts.deformation.normals = NormalMethod::Exact;
    parts.rigid_transforms = rigid;
    let material = if normal_maps { NORMAL_MAPPED } else { 0 };
    parts.domains = (0..instances * count).map(|index| domain(index % count, material)).collect();
    Scene::new(parts).expect("a scene")
}

/// Normals and tangents of the device, and those of the twin for the device's positions.
struct Both {
    normals: Vec<f32>,
    tangents: Vec<f32>,
    want_normals: Vec<[f64; 3]>,
    want_tangents: Vec<[f64; 4]>,
}

fn both(scene: &Scene, state: &SceneState, deformer: &mut CudaDeformer) -> Both {
    deformer.deform(state).expect("deforms");
    let surface = deformer.surface().expect("copies");
    let positions: Vec<[f64; 3]> =
        surface.positions.chunks_exact(3).map(|place| [0, 1, 2].map(|axis| f64::from(place[axis]))).collect();
    Both {
        normals: surface.normals.clone(),
        tangents: surface.tangents.clone(),
        want_normals: exact_normals(scene, state, &positions),
        want_tangents: exact_tangents(scene, state, &positions),
    }
}

/// Largest angle between unit vectors of the device and of the twin, in degrees.
fn largest_angle(got: &[f32], want: &[[f64; 3]]) -> f64 {
    let angle = |(got, want): (&[f32], &[f64; 3])| {
        let (got, want) = (Vector3::new(got[0], got[1], got[2]).cast::<f64>(), Vector3::from(*want));
        let angle = got.cross(&want).norm().atan2(got.dot(&want)).to_degrees();
        if angle.is_nan() { f64::INFINITY } else { angle }
    };
    got.chunks_exact(3).zip(want).map(angle).fold(0.0, f64::max)
}

/// Compares the device with the twin, and with rigid normals as a control.
fn check(name: &str, scene: &Scene, state: &SceneState, deformer: &mut CudaDeformer) {
    let both = both(scene, state, deformer);
    let normal = largest_error(&both.normals, &both.want_normals, DIRECTION);
    let normal = normal.unwrap_or_else(|error| panic!("{name}: normal {error}"));
    let tangent = largest_error(&both.tangents, &both.want_tangents, DIRECTION);
    let tangent = tangent.unwrap_or_else(|error| panic!("{name}: tangent {error}"));
    let rigid = largest_angle(&both.normals, &rigid_normals(scene, state));
    assert!(rigid > 5.0, "{name}: rigid normals are only {rigid} degrees off");
    let off = largest_angle(&both.normals, &both.want_normals);
    eprintln!("{name}: normal {normal:.2e} ({off:.1e} degrees), tangent {tangent:.2e}; rigid ones {rigid:.1} degrees");
}

/// Runs on the CPU deformer, so that the assumption is checked without a device: the scenes are far from rest, and far
/// from half a turn, where f32 cannot determine the axis of a rotation.
#[test]
fn test_scenes_bend_but_do_not_fold() {
    for (seed, around, rows, rank) in [(1, 16, 9, 3), (4, 24, 12, 3), (5, 16, 6, 2), (6, 70, 72, 8)] {
        let scene = scene_of(vec![tube(&mut Random(seed), around, rows, rank)], 3, true, false);
        for seed in 5..11 {
            let state = scenes::state(&scene, seed);
            let mut cpu = modalcast_compute::cpu::CpuDeformer::new(&scene);
            cpu.deform(&state).expect("deforms");
            let surface = cpu.surface().expect("a surface");
            let positions = modalcast_compute::reference::deform(&scene, &state);
            let want = exact_normals(&scene, &state, &positions);
            let turned = largest_angle(&surface.normals, &rigid_normals(&scene, &state));
            assert!((5.0..150.0).contains(&turned), "{turned} degrees");
            assert!(largest_angle(&surface.normals, &want) < 0.01);
        }
    }
}

/// With and without normal maps and shear.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_exact_normals_equal_their_twin() {
    let mut random = Random(1);
    let shapes = [(16, 9, 3), (5, 2, 1), (40, 31, 12)];
    let shapes: Vec<_> = shapes.map(|(around, rows, rank)| tube(&mut random, around, rows, rank)).into();
    for (normal_maps, rigid) in [(false, false), (false, true), (true, false), (true, true)] {
        let scene = scene_of(shapes.clone(), 4, normal_maps, rigid);
        let mut deformer = deformer(&scene);
        assert!(deformer.plan().kernels.iter().any(|kernel| kernel.name == "normals"));
        assert!(deformer.plan().bytes(BufferRole::RingTables) > 0);
        let name = format!("normal maps {normal_maps}, rigid {rigid}");
        check(&name, &scene, &scenes::state(&scene, 5), &mut deformer);
        assert_eq!(deformer.surface().expect("copies").tangents.is_empty(), !normal_maps);
    }
}

/// At q = 0, and for shapes without modes.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_exact_normals_equal_rigid_ones_without_deformation() {
    let mut random = Random(2);
    let (bends, stiff) = (tube(&mut random, 20, 11, 2), tube(&mut random, 9, 7, 0));
    let scene = scene_of(vec![bends, stiff], 3, true, false);
    let mut deformer = deformer(&scene);
    let mut state = scenes::state(&scene, 6);
    state.q.fill(0.0);
    let both = both(&scene, &state, &mut deformer);
    // Rounded positions turn a normal by about the rounding error divided by the size of a triangle.
    let still = |at: usize, got: &[f32], want: &[f64], width: usize, limit: f64| {
        let slot = scene.layout.slots[at];
        let (first, count) = (width * slot.first_corner, width * slot.corners);
        let want: Vec<[f64; 1]> = want[first..][..count].iter().map(|number| [*number]).collect();
        largest_error(&got[first..][..count], &want, limit).unwrap_or_else(|error| panic!("domain {at}: {error}"));
    };
    let (normals, tangents) = (rigid_normals(&scene, &state).into_flattened(), rigid_tangents(&scene, &state));
    let tangents = tangents.into_flattened();
    for at in 0..scene.domains.len() {
        let limit = if at % 2 == 0 { 1e-3 } else { DIRECTION };
        still(at, &both.normals, &normals, 3, limit);
        still(at, &both.tangents, &tangents, 4, limit);
    }
    state.q.fill(1.0);
    deformer.deform(&state).expect("deforms");
    let bent = &deformer.surface().expect("copies").normals;
    assert!(largest_angle(bent, &rigid_normals(&scene, &state)) > 5.0, "the judge can fail");
}

/// Bits do not depend on earlier steps or on the place of an instance in the packing.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_exact_normals_are_unit_and_deterministic() {
    let mut random = Random(3);
    let scene = scene_of(vec![scenes::shape(&mut random, 700, 9), tube(&mut random, 33, 8, 5)], 3, true, false);
    let (mut state, other) = (scenes::state(&scene, 7), scenes::state(&scene, 8));
    let q = state.q_of(&scene, 1).to_vec();
    for at in [3, 5] {
        state.transforms[at] = state.transforms[1];
        state.q[scene.layout.slots[at].first_q..][..5].copy_from_slice(&q);
    }
    let mut deformer = deformer(&scene);
    let mut run = |state: &SceneState| {
        deformer.deform(state).expect("deforms");
        deformer.surface().expect("copies").clone()
    };
    let (first, between, again) = (run(&state), run(&other), run(&state));
    assert!(!same_bits(&first.normals, &between.normals), "the judge can fail");
    assert!(same_bits(&first.normals, &again.normals) && same_bits(&first.tangents, &again.tangents));
    for surface in [&first, &between] {
        for normal in surface.normals.chunks_exact(3).chain(surface.tangents.chunks_exact(4).map(|all| &all[..3])) {
            let length = normal.iter().map(|number| number * number).sum::<f32>().sqrt();
            assert!((length - 1.0).abs() < 1e-5, "{normal:?}");
        }
    }
    let of = |at: usize| {
        let slot = scene.layout.slots[at];
        &first.normals[3 * slot.first_corner..][..3 * slot.corners]
    };
    assert!(same_bits(of(1), of(3)) && same_bits(of(1), of(5)), "instances");
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_seams_share_a_normal_and_hard_edges_stay_hard() {
    let mut random = Random(4);
    let scene = scene_of(vec![tube(&mut random, 24, 12, 3)], 1, false, false);
    let mut deformer = deformer(&scene);
    deformer.deform(&scenes::state(&scene, 9)).expect("deforms");
    let normals = &deformer.surface().expect("copies").normals;
    let at = |line: usize, column: usize| &normals[3 * (25 * line + column)..][..3];
    for line in 1..23 {
        assert!(same_bits(at(line, 0), at(line, 24)), "line {line}");
    }
    let apart = |line: usize| (0..3).map(|axis| (at(line, 5)[axis] - at(line + 1, 5)[axis]).powi(2)).sum::<f32>();
    assert!(apart(10) > 1e-3, "rows 5 and 10 are hard");
    assert!(same_bits(at(12, 5), at(13, 5)), "row 6 is smooth");
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_exact_normals_survive_collapse_overflow_and_scale() {
    let mut random = Random(5);
    let scene = scene_of(vec![tube(&mut random, 16, 6, 2)], 1, true, false);
    let mut deformer = deformer(&scene);
    for scale in [1e-40, 1e-30, 1e-20, 1.0, 1e18, 1e30, 1e37_f32] {
        for far in [0.0, 1e7] {
            for q in [0.0, 0.7, 1e30, -3e38] {
                let mut state = SceneState::rest(&scene);
                state.q.fill(q);
                state.transforms[0] =
                    Transform([scale, 0.0, 0.0, far, 0.0, -scale, 0.5 * scale, -far, 0.2 * scale, 0.0, scale, far]);
                let both = both(&scene, &state, &mut deformer);
                let name = format!("scale {scale:e} far {far:e} q {q:e}");
                let unit = |part: &[f32]| {
                    let length = part.iter().map(|number| number * number).sum::<f32>().sqrt();
                    assert!((length - 1.0).abs() < 1e-5, "{name}: {part:?}");
                };
                both.normals.chunks_exact(3).for_each(unit);
                both.tangents.chunks_exact(4).for_each(|tangent| unit(&tangent[..3]));
                if q.abs() < 1.0 {
                    largest_error(&both.normals, &both.want_normals, DIRECTION)
                        .unwrap_or_else(|error| panic!("{name}: {error}"));
                }
            }
        }
    }
}

/// Also prints the times of steps with rigid and with exact normals.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_exact_normals_of_a_million_corners_equal_the_twin() {
    let mut random = Random(6);
    let shape = tube(&mut random, 700, 720, 8);
    let mut times = [NormalMethod::Rigid, NormalMethod::Exact].map(|normals| {
        let mut parts = scenes::parts(vec![shape.clone()]);
        parts.deformation.normals = normals;
        parts.domains = vec![domain(0, 0)];
        let scene = Scene::new(parts).expect("a scene");
        let state = scenes::state(&scene, 10);
        let mut deformer = deformer(&scene);
        if normals == NormalMethod::Exact {
            check("a million corners", &scene, &state, &mut deformer);
        }
        let mut times: Vec<f64> = (0..50).map(|_| deformer.deform(&state).expect("deforms").ms).collect();
        times.sort_by(f64::total_cmp);
        times[25]
    });
    times.iter_mut().for_each(|time| *time *= 1e3);
    let corners = shape.mesh.corners().vertices.len();
    let [rigid, exact] = times;
    eprintln!("{corners} corners: {rigid:.0} microseconds a step with rigid normals, {exact:.0} with exact ones");
}
