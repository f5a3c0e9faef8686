//! Normals and tangents in extreme cases.

use std::sync::Arc;

use modalcast_compute::reference::{rigid_normals, rigid_tangents};
use modalcast_model::deform::Deformer;
use modalcast_model::domain::{Corners, Mesh, Shape, Transform};
use modalcast_model::scene::{DeformationSettings, NormalMethod, Scene, SceneState};

use super::{run, scene_of, within};
use crate::scenes::{self, Random};

/// Largest accepted error of a component of a unit vector.
const DIRECTION: f64 = 2e-5;

/// Largest error; infinite for a NaN or for another length.
pub(crate) fn largest_error(got: &[f32], want: &[f64]) -> f64 {
    let error = |(got, want): (&f32, &f64)| {
        let error = (f64::from(*got) - want).abs();
        if error.is_nan() { f64::INFINITY } else { error }
    };
    if got.len() == want.len() { got.iter().zip(want).map(error).fold(0.0, f64::max) } else { f64::INFINITY }
}

/// A mirror, a shear, both, and strongly anisotropic scales.
pub(crate) fn shears_and_mirrors<D: Deformer>(make: impl Fn(&Arc<Scene>) -> D) {
    let scene = scenes::scene(&[(40, 3), (200, 2)], 2, true, false);
    let mut state = scenes::state(&scene, 6);
    let linear: [[f32; 9]; 4] = [
        [-1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        [1.0, 0.7, -0.2, 0.0, 0.5, 0.4, 0.1, 0.0, 1.5],
        [1.0, 3.0, 0.0, 0.0, 1.0, 0.0, 0.0, 2.0, -1.0],
        [30.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -0.1],
    ];
    for (transform, [a, b, c, d, e, f, g, h, i]) in state.transforms.iter_mut().zip(linear) {
        *transform = Transform([a, b, c, 1.0, d, e, f, -2.0, g, h, i, 0.5]);
    }
    let shown = run(&mut make(&scene), &state);
    within("shears and mirrors", (&scene, &state), &shown.surface.positions, 0.0);
    let errors = |state: &SceneState| {
        let normals = largest_error(&shown.surface.normals, rigid_normals(&scene, state).as_flattened());
        (normals, largest_error(&shown.surface.tangents, rigid_tangents(&scene, state).as_flattened()))
    };
    let (normal, tangent) = errors(&state);
    eprintln!("shears and mirrors: normals off by {normal:.2e}, tangents by {tangent:.2e}");
    assert!(normal <= DIRECTION && tangent <= DIRECTION);
    // Control: without its mirror, the first domain has tangents of the other sign and mirrored normals.
    state.transforms[0] = Transform::IDENTITY;
    let (normal, tangent) = errors(&state);
    assert!(normal > 0.1 && tangent > 0.1);
}

/// Position of a vertex, vertices of a triangle, and texture coordinates for a number of corners.
type Place = fn(usize) -> [f32; 3];
type Fan = fn(u32) -> [u32; 3];
type Uvs = fn(usize) -> Vec<[f32; 2]>;

/// Meshes whose triangles have no area, with and without texture coordinates.
fn flat_meshes() -> Vec<Mesh> {
    let places: [Place; 3] =
        [|_| [0.5, -0.25, 1.0], |at| [at as f32, 0.0, 0.0], |at| [at as f32, (at * at) as f32, 1.0]];
    let fans: [Fan; 3] = [|at| [at, at + 1, at + 2], |at| [at, at + 1, at + 2], |at| [at, at, at + at % 2]];
    let uvs: [Uvs; 3] =
        [|_| vec![], |count| vec![[0.5, 0.5]; count], |count| (0..count).map(|at| [at as f32, 0.0]).collect()];
    let mut meshes = Vec::new();
    for (place, fan) in places.into_iter().zip(fans) {
        for uvs in uvs {
            let rest: Vec<[f32; 3]> = (0..9).map(place).collect();
            let normals = (0..9).map(|at| if at % 4 == 0 { [0.0; 3] } else { [0.0, at as f32, 1.0] }).collect();
            let corners = Corners { vertices: (0..9).collect(), normals, uvs: uvs(9) };
            meshes.push(Mesh::new(rest, corners, (0..7).map(fan).collect()).expect("a mesh"));
        }
    }
    meshes
}

/// Whether the first three of every `width` numbers are a unit vector.
fn are_unit(numbers: &[f32], width: usize) -> bool {
    let length = |part: &[f32]| part[..3].iter().map(|number| number * number).sum::<f32>().sqrt();
    numbers.chunks_exact(width).all(|part| (length(part) - 1.0).abs() < 1e-5)
}

/// Triangles or texture coordinates without area, and missing texture coordinates, still give unit directions.
pub(crate) fn no_area_and_no_uvs<D: Deformer>(make: impl Fn(&Arc<Scene>) -> D) {
    assert!(are_unit(&[0.6, 0.8, 0.0], 3) && !are_unit(&[0.0; 3], 3) && !are_unit(&[f32::NAN; 3], 3));
    let modes = scenes::shape(&mut Random(35), 9, 2).modes;
    let shapes: Vec<Shape> =
        flat_meshes().into_iter().map(|mesh| Shape::new(mesh, modes.clone()).expect("a shape")).collect();
    for normals in [NormalMethod::Rigid, NormalMethod::Exact] {
        let scene =
            scene_of(shapes.clone(), 1, DeformationSettings { normals, ..DeformationSettings::default() }, true);
        let mut deformer = make(&scene);
        for amount in [0.0, 1e-30, 1.0, 1e15] {
            let mut state = scenes::state(&scene, 8);
            state.q.iter_mut().for_each(|number| *number *= amount);
            let shown = run(&mut deformer, &state);
            assert!(shown.bounds.is_finite());
            assert!(are_unit(&shown.surface.normals, 3), "{normals:?}, q of {amount:e}");
            for (domain, slot) in scene.layout.slots.iter().enumerate() {
                let tangents = &shown.surface.tangents[4 * slot.first_corner..][..4 * slot.corners];
                let good = if scene.shape_of(domain).tangents().is_empty() {
                    tangents.iter().all(|number| *number == 0.0)
                } else {
                    are_unit(tangents, 4) && tangents.iter().skip(3).step_by(4).all(|sign| sign.abs() == 1.0)
                };
                assert!(good, "{normals:?}, q of {amount:e}, domain {domain}: {tangents:?}");
            }
        }
    }
}
