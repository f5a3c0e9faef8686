//! Checks that every deformer must pass, such as those of extreme values, partial steps, followers and optional
//! attributes. Each check takes a function that creates the deformer of a scene, and prints the measured errors.
//! `tests/it` runs all checks on the CPU, `tests/gpu` on the GPU. The modules `cut_outs`, `exact_triangle` and `soups`
//! are for tests of rasterizers.

pub(crate) mod attributes;
#[allow(dead_code, reason = "each test binary uses a part")]
pub(crate) mod cut_outs;
pub(crate) mod distant_steps;
mod error_bounds;
pub(crate) mod exact_triangle;
pub(crate) mod extreme_values;
pub(crate) mod followers;
#[allow(dead_code, reason = "each test binary uses a part")]
pub(crate) mod hang_guard;
pub(crate) mod light_bounds;
pub(crate) mod neighbors;
pub(crate) mod overflow;
pub(crate) mod partial_steps;
pub(crate) mod soups;
pub(crate) mod surfaces;

use std::sync::Arc;

use modalcast_model::deform::{DeformSummary, DeformedSurface, Deformer};
use modalcast_model::domain::{Domain, Mesh, Shape};
use modalcast_model::scene::{BoundingBox, DeformationSettings, OrientedBounds, Scene, SceneState};

use crate::scenes::{self, NORMAL_MAPPED_MATERIAL, Random};
pub(crate) use error_bounds::{
    assert_displacements_within_bound, assert_within_bound, domains_beyond_bound, domains_beyond_displacement_bound,
};

/// The results of a step.
#[derive(Debug, Clone)]
pub(crate) struct StepResult {
    /// Axis-aligned bounds of all vertices.
    pub(crate) bounds: BoundingBox,
    /// Light-space bounds; `None` for a scene without a shadow.
    pub(crate) light_bounds: Option<OrientedBounds>,
    pub(crate) surface: DeformedSurface,
}

/// Deforms a state and reads back all attributes.
pub(crate) fn run_step(deformer: &mut dyn Deformer, state: &SceneState) -> StepResult {
    let DeformSummary { bounds, oriented_bounds: light_bounds, .. } =
        deformer.deform(state).expect("expected the step to succeed");
    StepResult { bounds, light_bounds, surface: deformer.surface().expect("expected a surface").clone() }
}

impl StepResult {
    /// Describes the first difference in the bits of a vertex attribute, in the boxes or in the bounds; `None` if there
    /// is none. Light-space bounds are not compared.
    pub(crate) fn difference(&self, other: &Self) -> Option<String> {
        let attribute_lists = |result: &Self| {
            let DeformedSurface { positions, normals, tangents, displacements, .. } = result.surface.clone();
            [("position", positions), ("normal", normals), ("tangent", tangents), ("displacement", displacements)]
        };
        for ((name, numbers), (_, other_numbers)) in attribute_lists(self).into_iter().zip(attribute_lists(other)) {
            if numbers.len() != other_numbers.len() {
                return Some(format!("{name}s have {} and {} numbers", numbers.len(), other_numbers.len()));
            }
            if let Some(index) =
                (0..numbers.len()).find(|index| numbers[*index].to_bits() != other_numbers[*index].to_bits())
            {
                return Some(format!(
                    "{name}s differ at index {index}: {} and {}",
                    numbers[index], other_numbers[index]
                ));
            }
        }
        if self.surface.boxes != other.surface.boxes {
            return Some("boxes differ".into());
        }
        (self.bounds != other.bounds).then(|| format!("bounds differ: {:?} and {:?}", self.bounds, other.bounds))
    }
}

/// A strip of triangles between random vertices with coordinates in -1 to 1. Corner i of the mesh is at vertex i.
pub(crate) fn strip_shape(random: &mut Random, vertices: usize, rank: usize) -> Shape {
    let shape = scenes::random_shape(random, vertices, rank);
    let normals = (0..vertices).map(|_| random.next_triple()).collect();
    let last_vertex = vertices as u32 - 1;
    let triangles =
        (0..=last_vertex).map(|index| [index, (index + 1).min(last_vertex), (index + 2).min(last_vertex)]).collect();
    let uvs = shape.mesh.corners().uvs[..vertices].to_vec();
    let mesh = Mesh::from_indexed(shape.mesh.rest_positions().to_vec(), normals, uvs, triangles).expect("a valid mesh");
    Shape::new(mesh, shape.modes).expect("a valid shape")
}

/// A scene with `instances` domains per shape. Domain i is named "domain i" and has shape i % (number of shapes). With
/// `normal_maps`, all domains have a normal map.
pub(crate) fn scene_of_shapes(
    shapes: Vec<Shape>,
    instances: usize,
    deformation: DeformationSettings,
    normal_maps: bool,
) -> Arc<Scene> {
    let shape_count = shapes.len();
    let mut parts = scenes::parts_of_shapes(shapes);
    parts.deformation = deformation;
    let material = if normal_maps { NORMAL_MAPPED_MATERIAL } else { scenes::PLAIN_MATERIAL };
    let create_domain =
        |index: usize| Domain { name: format!("domain {index}"), ..scenes::new_domain(index % shape_count, material) };
    parts.domains = (0..instances * shape_count).map(create_domain).collect();
    Scene::new(parts).expect("a valid scene")
}

#[test]
fn difference_detects_bits_lengths_and_bounds() {
    let surface = DeformedSurface { positions: vec![0.0; 3], normals: vec![1.0; 3], ..DeformedSurface::default() };
    let result = StepResult { bounds: BoundingBox { min: [0.0; 3], max: [0.0; 3] }, light_bounds: None, surface };
    assert_eq!(result.difference(&result), None);
    let difference_after = |modify: &dyn Fn(&mut StepResult)| {
        let mut other = result.clone();
        modify(&mut other);
        result.difference(&other)
    };
    assert!(difference_after(&|other| other.surface.positions[1] = -0.0).is_some());
    assert!(difference_after(&|other| other.surface.normals[2] = 1.000_000_1).is_some());
    assert!(difference_after(&|other| other.surface.tangents.push(0.0)).is_some());
    assert!(difference_after(&|other| other.surface.displacements.push(0.0)).is_some());
    assert!(difference_after(&|other| other.surface.boxes.push(BoundingBox::EMPTY)).is_some());
    assert!(difference_after(&|other| other.bounds.max[0] = f64::NAN).is_some());
}
