//! Workloads of batches of small views: many worlds of a small body, each with its own coordinates, transform and
//! camera, and one world that many cameras see.

use std::f64::consts::TAU;
use std::sync::Arc;

use nalgebra::{Rotation3, Vector3};

use super::harness::Size;
use super::measure::STILL_STEP;
use super::workloads::RenderWorkload;
use modalcast_model::domain::{Domain, Material, Mesh, Modes, Shape, Transform};
use modalcast_model::error::Result;
use modalcast_model::scene::{Antialiasing, Camera, Lens, RenderSettings, Scene, SceneParts, SceneState};
use modalcast_model::views::{View, ViewOutputs};

/// Number of modes of a body.
const MODES: usize = 8;
/// States that a workload rotates through.
const STATE_COUNT: usize = 4;
/// Vertical field of view of the cameras in degrees.
const FIELD_OF_VIEW: f64 = 34.0;

/// A scene, its worlds, and the views of one step.
pub(super) struct ViewWorkload {
    pub(super) name: String,
    /// One world.
    pub(super) scene: Arc<Scene>,
    /// All worlds as one scene; that of one world if there is only one.
    pub(super) worlds: Arc<Scene>,
    pub(super) world_count: usize,
    /// States of `worlds`.
    pub(super) states: Vec<SceneState>,
    pub(super) cameras: Vec<Camera>,
    pub(super) views: Vec<View>,
    pub(super) size: Size,
    pub(super) outputs: ViewOutputs,
}

impl ViewWorkload {
    /// One world of a state.
    pub(super) fn state_of(&self, state: usize, world: usize) -> SceneState {
        let (mut world_state, state) = (SceneState::rest(&self.scene), &self.states[state]);
        let (coordinates, transforms) = (world_state.q.len(), world_state.transforms.len());
        world_state.q.copy_from_slice(&state.q[world * coordinates..][..coordinates]);
        world_state.transforms.copy_from_slice(&state.transforms[world * transforms..][..transforms]);
        world_state
    }
}

/// All workloads. `world_count`: number of worlds of a body; the tree has a quarter as many cameras.
///
/// # Errors
/// Errors of the scenes.
pub(super) fn all(world_count: usize) -> Result<Vec<ViewWorkload>> {
    let color = ViewOutputs { color: true, ..ViewOutputs::default() };
    let depth_and_domains = ViewOutputs { depth: true, domains: true, ..ViewOutputs::default() };
    let size = |side| Size { width: side, height: side };
    Ok(vec![
        bodies("152 triangles, color", beam(6, 13)?, world_count, (size(64), color))?,
        bodies("152 triangles, depth and domains", beam(6, 13)?, world_count, (size(128), depth_and_domains))?,
        bodies("2,072 triangles, color", ellipsoid(28, 38)?, world_count, (size(64), color))?,
        tree(world_count.div_ceil(4), (size(64), color))?,
    ])
}

/// The look of the views: without shadows and ambient occlusion, one sample per pixel.
fn view_look(look: RenderSettings) -> RenderSettings {
    RenderSettings {
        preset: None,
        shadow: None,
        ambient_occlusion: None,
        samples: 1,
        antialias: Antialiasing::Msaa,
        ..look
    }
}

/// Worlds with one body each. Each view shows another world by another camera.
fn bodies(name: &str, shape: Shape, world_count: usize, (size, outputs): (Size, ViewOutputs)) -> Result<ViewWorkload> {
    let scene_of = |domain_count: usize| {
        let mut parts = SceneParts::named("views");
        parts.rigid_transforms = true;
        parts.look = view_look(RenderSettings::default());
        parts.materials = vec![Material {
            ambient: [0.8, 0.45, 0.2],
            diffuse: [0.8, 0.45, 0.2],
            specular: [0.3; 3],
            shininess: 24.0,
            ..Material::default()
        }];
        parts.shapes = vec![shape.clone()];
        parts.domains = (0..domain_count).map(|world| Domain::new(format!("body {world}"), 0)).collect();
        Scene::new(parts)
    };
    let (scene, worlds) = (scene_of(1)?, scene_of(world_count)?);
    let mut rng = fastrand::Rng::with_seed(7);
    let states = (0..STATE_COUNT).map(|_| random_state(&worlds, &mut rng)).collect();
    let orbit = orbit(&scene, world_count, 4.0);
    let views = (0..world_count as u32).map(|world| View { camera: world, world }).collect();
    Ok(ViewWorkload { name: name.into(), scene, worlds, world_count, states, cameras: orbit, views, size, outputs })
}

/// The built-in tree, seen by many cameras.
fn tree(camera_count: usize, (size, outputs): (Size, ViewOutputs)) -> Result<ViewWorkload> {
    let animation = RenderWorkload::Tree.build()?;
    let look = view_look(animation.scene.look);
    let scene = Scene::new(SceneParts { look, ..animation.scene.parts() })?;
    Ok(ViewWorkload {
        name: "tree, color".into(),
        worlds: Arc::clone(&scene),
        world_count: 1,
        states: (0..STATE_COUNT).map(|step| animation.state(STILL_STEP + step)).collect(),
        cameras: orbit(&scene, camera_count, 2.6),
        views: (0..camera_count as u32).map(|camera| View { camera, world: 0 }).collect(),
        scene,
        size,
        outputs,
    })
}

/// Random coordinates, and rotations about the vertical axis with a tilt.
fn random_state(scene: &Scene, rng: &mut fastrand::Rng) -> SceneState {
    let mut state = SceneState::rest(scene);
    for coordinates in state.q.chunks_exact_mut(MODES) {
        for (mode, coordinate) in coordinates.iter_mut().enumerate() {
            *coordinate = (rng.f32() - 0.5) * if mode < 4 { 0.8 } else { 0.25 };
        }
    }
    for transform in &mut state.transforms {
        let rotation =
            Rotation3::new(Vector3::z() * (rng.f64() - 0.5)) * Rotation3::new(Vector3::y() * TAU * rng.f64());
        let offset: [f64; 3] = [0; 3].map(|_| 0.2 * (rng.f64() - 0.5));
        let matrix = rotation.matrix();
        let entry = |entry: usize| match entry % 4 {
            3 => offset[entry / 4] as f32,
            column => matrix[(entry / 4, column)] as f32,
        };
        *transform = Transform(std::array::from_fn(entry));
    }
    state
}

/// Cameras around the scene at a distance of `distance` times half of its diagonal, a little above its center.
fn orbit(scene: &Scene, count: usize, distance: f64) -> Vec<Camera> {
    let center = scene.rest_bounds.center();
    let radius = 0.5 * scene.rest_bounds.diagonal();
    let camera = |index: usize| {
        let angle = TAU * index as f64 / count as f64;
        let offset = Vector3::new(distance * angle.sin(), 0.5, distance * angle.cos()) * radius;
        let eye = center + offset;
        let view = modalcast_model::scene::View::LookAt {
            eye: eye.coords.into(),
            target: center.coords.into(),
            up: [0.0, 1.0, 0.0],
        };
        Camera { view, lens: Lens::FieldOfView(FIELD_OF_VIEW), near: 0.0, far: 0.0 }
    };
    (0..count).map(camera).collect()
}

/// A vertical tube of `rings` rings of `sides` vertices: 2 (sides rings - 2) triangles.
fn beam(sides: usize, rings: usize) -> Result<Shape> {
    let (mut positions, mut normals, mut triangles) = (Vec::new(), Vec::new(), Vec::new());
    for vertex in 0..sides * rings {
        let angle = TAU * (vertex % sides) as f64 / sides as f64;
        let [x, z] = [angle.cos() as f32, angle.sin() as f32];
        positions.push([0.12 * x, 2.0 * (vertex / sides) as f32 / (rings - 1) as f32, 0.12 * z]);
        normals.push([x, 0.0, z]);
    }
    let last_ring = (rings - 1) * sides;
    for vertex in 0..last_ring {
        let next = vertex / sides * sides + (vertex + 1) % sides;
        triangles.extend([[vertex, vertex + sides, next], [next, vertex + sides, next + sides]]);
    }
    for side in 1..sides - 1 {
        triangles.extend([[0, side, side + 1], [last_ring, last_ring + side + 1, last_ring + side]]);
    }
    bending_shape(positions, normals, &triangles)
}

/// An ellipsoid of `stacks` stacks of `slices` slices: 2 slices (stacks - 1) triangles.
fn ellipsoid(slices: usize, stacks: usize) -> Result<Shape> {
    const RADII: [f64; 3] = [0.5, 1.0, 0.4];
    let (mut positions, mut normals, mut triangles) = (Vec::new(), Vec::new(), Vec::new());
    let mut push = |direction: [f64; 3]| {
        let normal = Vector3::from([0, 1, 2].map(|axis| direction[axis] / RADII[axis])).normalize();
        positions.push([0, 1, 2].map(|axis| (RADII[axis] * direction[axis]) as f32));
        normals.push([normal.x as f32, normal.y as f32, normal.z as f32]);
    };
    push([0.0, -1.0, 0.0]);
    for vertex in 0..slices * (stacks - 1) {
        let elevation = 0.5 * TAU * (1 + vertex / slices) as f64 / stacks as f64 - 0.25 * TAU;
        let angle = TAU * (vertex % slices) as f64 / slices as f64;
        push([elevation.cos() * angle.cos(), elevation.sin(), elevation.cos() * angle.sin()]);
    }
    push([0.0, 1.0, 0.0]);
    let vertex_at = |stack: usize, slice: usize| 1 + (stack - 1) * slices + slice % slices;
    let top = 1 + slices * (stacks - 1);
    for slice in 0..slices {
        triangles.push([0, vertex_at(1, slice), vertex_at(1, slice + 1)]);
        triangles.push([top, vertex_at(stacks - 1, slice + 1), vertex_at(stacks - 1, slice)]);
        for stack in 1..stacks - 1 {
            let [a, b] = [vertex_at(stack, slice), vertex_at(stack, slice + 1)];
            let [c, d] = [vertex_at(stack + 1, slice), vertex_at(stack + 1, slice + 1)];
            triangles.extend([[a, c, b], [b, c, d]]);
        }
    }
    bending_shape(positions, normals, &triangles)
}

/// A shape with modes that bend it in x and z with growing wave numbers.
fn bending_shape(positions: Vec<[f32; 3]>, normals: Vec<[f32; 3]>, triangles: &[[usize; 3]]) -> Result<Shape> {
    let heights = || positions.iter().map(|position| position[1]);
    let (low, high) = (heights().fold(f32::MAX, f32::min), heights().fold(f32::MIN, f32::max));
    let mut columns = Vec::with_capacity(3 * positions.len() * MODES);
    for mode in 0..MODES {
        for position in &positions {
            let wave_number = (mode / 2 + 1) as f32;
            let height = (position[1] - low) / (high - low);
            let bending = (0.75 * wave_number * std::f32::consts::PI * height).sin() / wave_number;
            columns.extend(if mode % 2 == 0 { [bending, 0.0, 0.0] } else { [0.0, 0.0, bending] });
        }
    }
    let modes = Modes::from_columns(3 * positions.len(), MODES, columns)?;
    let triangles = triangles.iter().map(|triangle| triangle.map(|vertex| vertex as u32)).collect();
    Shape::new(Mesh::from_indexed(positions, normals, vec![], triangles)?, modes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bodies_have_the_triangles_of_their_names() {
        let triangles = |shape: Result<Shape>| shape.expect("a shape").mesh.triangles().len();
        assert_eq!((triangles(beam(6, 13)), triangles(ellipsoid(28, 38))), (152, 2072));
    }

    #[test]
    fn every_view_of_bodies_shows_another_world() {
        let workload = &all(8).expect("workloads")[0];
        assert_eq!((workload.world_count, workload.cameras.len(), workload.states.len()), (8, 8, STATE_COUNT));
        assert_eq!(workload.worlds.layout.vertices, 8 * workload.scene.layout.vertices);
        let worlds: std::collections::BTreeSet<u32> = workload.views.iter().map(|view| view.world).collect();
        assert_eq!(worlds.len(), 8);
    }
}
