//! Checks that every deformer must pass: the limits of f32, partial steps, followers and readers. Each check takes a
//! function that creates the deformer of a scene, and prints its figures; `tests/it` and `tests/gpu` run all of them.

mod bound_checks;
pub(crate) mod changes;
#[allow(dead_code, reason = "each test binary uses a part")]
pub(crate) mod cut_outs;
pub(crate) mod exact;
pub(crate) mod extremes;
pub(crate) mod following;
pub(crate) mod light;
pub(crate) mod neighbors;
pub(crate) mod readers;
pub(crate) mod refusal;
pub(crate) mod soups;
pub(crate) mod surfaces;
pub(crate) mod truncation;

use std::sync::Arc;

use modalcast_model::deform::{DeformSummary, DeformedSurface, Deformer};
use modalcast_model::domain::{Domain, Mesh, Shape};
use modalcast_model::scene::{Bounds, DeformationSettings, LightSpaceBox, Scene, SceneState};

use crate::scenes::{self, NORMAL_MAPPED, Random};
pub(crate) use bound_checks::{beyond, displacements_beyond, displacements_within, within};

/// All results of a step.
#[derive(Debug, Clone)]
pub(crate) struct StepResult {
    pub(crate) bounds: Bounds,
    pub(crate) light: Option<LightSpaceBox>,
    pub(crate) surface: DeformedSurface,
}

pub(crate) fn run(deformer: &mut dyn Deformer, state: &SceneState) -> StepResult {
    let DeformSummary { bounds, light, .. } = deformer.deform(state).expect("deforms");
    StepResult { bounds, light, surface: deformer.surface().expect("a surface").clone() }
}

impl StepResult {
    /// Describes the first number whose bits differ.
    pub(crate) fn difference(&self, other: &Self) -> Option<String> {
        let lists = |shown: &Self| {
            let DeformedSurface { positions, normals, tangents, displacements, .. } = shown.surface.clone();
            [("position", positions), ("normal", normals), ("tangent", tangents), ("displacement", displacements)]
        };
        for ((name, own), (_, other)) in lists(self).into_iter().zip(lists(other)) {
            if own.len() != other.len() {
                return Some(format!("{} and {} numbers of {name}s", own.len(), other.len()));
            }
            if let Some(at) = (0..own.len()).find(|at| own[*at].to_bits() != other[*at].to_bits()) {
                return Some(format!("number {at} of {name}s is {} and {}", own[at], other[at]));
            }
        }
        if self.surface.boxes != other.surface.boxes {
            return Some("boxes".into());
        }
        (self.bounds != other.bounds).then(|| format!("bounds {:?} and {:?}", self.bounds, other.bounds))
    }
}

/// A shape in the unit cube whose corner i is its vertex i.
pub(crate) fn strip(random: &mut Random, vertices: usize, rank: usize) -> Shape {
    let other = scenes::shape(random, vertices, rank);
    let normals = (0..vertices).map(|_| random.triple()).collect();
    let last = vertices as u32 - 1;
    let triangles = (0..=last).map(|at| [at, (at + 1).min(last), (at + 2).min(last)]).collect();
    let uvs = other.mesh.corners().uvs[..vertices].to_vec();
    let mesh = Mesh::from_indexed(other.mesh.rest().to_vec(), normals, uvs, triangles).expect("a strip");
    Shape::new(mesh, other.modes).expect("a shape")
}

/// A scene of domains named by their index, with `instances` domains per shape.
pub(crate) fn scene_of(
    shapes: Vec<Shape>,
    instances: usize,
    deformation: DeformationSettings,
    normal_maps: bool,
) -> Arc<Scene> {
    let count = shapes.len();
    let mut parts = scenes::parts(shapes);
    parts.deformation = deformation;
    let material = if normal_maps { NORMAL_MAPPED } else { 0 };
    let domain = |at: usize| Domain { name: format!("domain {at}"), ..scenes::domain(at % count, material) };
    parts.domains = (0..instances * count).map(domain).collect();
    Scene::new(parts).expect("a scene")
}

#[test]
fn difference_detects_bits_lengths_and_bounds() {
    let surface = DeformedSurface { positions: vec![0.0; 3], normals: vec![1.0; 3], ..DeformedSurface::default() };
    let shown = StepResult { bounds: Bounds { min: [0.0; 3], max: [0.0; 3] }, light: None, surface };
    assert_eq!(shown.difference(&shown), None);
    let spoilt = |spoil: &dyn Fn(&mut StepResult)| {
        let mut other = shown.clone();
        spoil(&mut other);
        shown.difference(&other)
    };
    assert!(spoilt(&|other| other.surface.positions[1] = -0.0).is_some());
    assert!(spoilt(&|other| other.surface.normals[2] = 1.000_000_1).is_some());
    assert!(spoilt(&|other| other.surface.tangents.push(0.0)).is_some());
    assert!(spoilt(&|other| other.surface.displacements.push(0.0)).is_some());
    assert!(spoilt(&|other| other.surface.boxes.push(Bounds::EMPTY)).is_some());
    assert!(spoilt(&|other| other.bounds.max[0] = f64::NAN).is_some());
}
