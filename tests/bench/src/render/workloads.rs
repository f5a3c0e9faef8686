//! The scenes of the rendering benchmark: small scenes with known results, the built-in tree, and a field with any
//! number of triangles.
//!
//! | name | contents |
//! |---|---|
//! | `square` | a square that floats above the ground; its umbra and penumbra are known |
//! | `shelf` | the narrow shadow of a square just above the ground, at one end of the shadow map's depth range |
//! | `layers` | three sheets above each other whose edges cross, and a floor below them that is mostly in full shadow |
//! | `panes` | three translucent panes in front of an opaque wall, listed from nearest to farthest |
//! | `images` | panels with images of many sizes, each repeated |
//! | `bracket` | a bracket with ribs and a boss, with studio lighting and ambient occlusion |
//! | `tree` | the built-in tree |
//! | `grove` | four built-in trees |
//! | `triangles-N` | a rolling field of about N triangles with poles on it |

use std::f64::consts::TAU;
use std::sync::Arc;

use nalgebra::{Matrix4, Rotation3, Vector3};

use super::bracket;
use super::harness::Size;
use super::light_meter::with_settings;
use super::rigid_domain::add_rigid_domain;
use super::texture_panels;
use crate::motion::WorkloadMotion;
use crate::workloads::Workload;
use modalcast_model::domain::{AlphaMode, Material, Mesh, Transform, smooth_normals};
use modalcast_model::error::{Result, invalid};
use modalcast_model::load;
use modalcast_model::scene::{Antialiasing, Camera, Lens, RenderSettings, Scene, SceneParts, SceneState, View};

/// Identifies a scene of the benchmark.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RenderWorkload {
    Square,
    Shelf,
    Layers,
    Panes,
    Images,
    Bracket,
    Tree,
    Grove,
    /// Approximate number of triangles.
    Triangles(usize),
}

/// Default triangle counts of the field.
const FULL_FIELD_TRIANGLES: usize = 1_000_000;
const QUICK_FIELD_TRIANGLES: usize = 50_000;
/// Largest triangle count that a name may request.
const MAX_TRIANGLES: usize = 8_000_000;

/// A scene and its motion.
pub(super) struct AnimatedScene {
    pub(super) name: String,
    pub(super) workload: RenderWorkload,
    pub(super) scene: Arc<Scene>,
    motion: WorkloadMotion,
    /// The domain that moves on a circle; `None` if only modes are animated.
    sliding_domain: Option<usize>,
}

/// Seconds between steps.
const STEP_SECONDS: f64 = 1.0 / 60.0;
/// Radius of the sliding domain's circle as a fraction of the scene's diagonal.
const SLIDE_RADIUS: f64 = 0.02;
/// Factor of the modal amplitudes.
const SWAY_AMPLITUDE: f64 = 0.2;

impl RenderWorkload {
    /// Every workload, in the order of the report.
    pub fn all(quick: bool) -> Vec<Self> {
        let field = Self::Triangles(if quick { QUICK_FIELD_TRIANGLES } else { FULL_FIELD_TRIANGLES });
        vec![
            Self::Square,
            Self::Shelf,
            Self::Layers,
            Self::Panes,
            Self::Images,
            Self::Bracket,
            Self::Tree,
            Self::Grove,
            field,
        ]
    }

    /// The workload with this name.
    ///
    /// # Errors
    /// `Invalid` when there is none.
    pub fn from_name(name: &str) -> Result<Self> {
        let workload = match name {
            "square" => Some(Self::Square),
            "shelf" => Some(Self::Shelf),
            "layers" => Some(Self::Layers),
            "panes" => Some(Self::Panes),
            "images" => Some(Self::Images),
            "bracket" => Some(Self::Bracket),
            "tree" => Some(Self::Tree),
            "grove" => Some(Self::Grove),
            _ => {
                let triangle_count = name.strip_prefix("triangles-").and_then(|count| count.parse().ok());
                triangle_count.filter(|count| (2..=MAX_TRIANGLES).contains(count)).map(Self::Triangles)
            }
        };
        let expected = format!(
            "square, shelf, layers, panes, images, bracket, tree, grove, or triangles-N (2 to {MAX_TRIANGLES})"
        );
        workload.ok_or_else(|| invalid("load", expected, name))
    }

    /// The name that [`Self::from_name`] takes.
    pub fn name(self) -> String {
        match self {
            Self::Square => "square".into(),
            Self::Shelf => "shelf".into(),
            Self::Layers => "layers".into(),
            Self::Panes => "panes".into(),
            Self::Images => "images".into(),
            Self::Bracket => "bracket".into(),
            Self::Tree => "tree".into(),
            Self::Grove => "grove".into(),
            Self::Triangles(count) => format!("triangles-{count}"),
        }
    }

    /// Builds the scene.
    ///
    /// # Errors
    /// Errors of [`Scene::new`] and of generating the tree.
    pub(super) fn build(self) -> Result<AnimatedScene> {
        // Sliding domains: the square, the red pane, the first panel, the bracket, the poles of the field.
        let (scene, sliding_domain) = match self {
            Self::Square => (Scene::new(build_square()?)?, Some(1)),
            Self::Shelf => (Scene::new(build_shelf()?)?, None),
            Self::Layers => (Scene::new(build_layers()?)?, None),
            Self::Panes => (Scene::new(build_panes()?)?, Some(1)),
            Self::Images => (Scene::new(texture_panels::build_panels()?)?, Some(0)),
            Self::Bracket => (Scene::new(bracket::build_bracket()?)?, Some(0)),
            Self::Tree => (open_tree()?, None),
            Self::Grove => (Scene::new(build_grove(open_tree()?.as_ref()))?, None),
            Self::Triangles(count) => (Scene::new(build_field(count)?)?, Some(1)),
        };
        Ok(AnimatedScene::new(self, scene, sliding_domain))
    }
}

impl AnimatedScene {
    fn new(workload: RenderWorkload, scene: Arc<Scene>, sliding_domain: Option<usize>) -> Self {
        let deform_workload = Workload::new(workload.name(), scene);
        let motion = WorkloadMotion::new(&deform_workload, None);
        Self { name: deform_workload.name, workload, scene: deform_workload.scene, motion, sliding_domain }
    }

    /// The camera of the workload's images. It frames the whole scene, except for `shelf`, `layers` and `images`. A
    /// `near` and `far` of 0 are fitted to the scene.
    pub(super) fn camera(&self, size: Size) -> Camera {
        match self.workload {
            // The shadow fills half of the image.
            RenderWorkload::Shelf => {
                let point = |height: f64| [f64::from(SHELF_EDGE) - 0.06, height, 0.0];
                let view = View::LookAt { eye: point(2.0), target: point(0.0), up: [0.0, 0.0, -1.0] };
                Camera { view, lens: Lens::FieldOfView(2.9), near: 0.0, far: 0.0 }
            }
            // From between the floor and the lowest sheet down to where the edges cross. The image is 0.24 units high.
            RenderWorkload::Layers => {
                let view = View::LookAt { eye: [0.0, 0.28, 0.0], target: [0.0; 3], up: [0.0, 0.0, -1.0] };
                Camera { view, lens: Lens::FieldOfView(46.4), near: 0.0, far: 0.0 }
            }
            // The panels fill the image; the floor extends beyond it.
            RenderWorkload::Images => {
                let view = View::LookAt { eye: [0.5, 1.5, 4.6], target: [0.0, 1.05, 0.0], up: [0.0, 1.0, 0.0] };
                Camera { view, lens: Lens::FieldOfView(34.0), near: 0.0, far: 0.0 }
            }
            _ => Camera::fit_to_scene(&self.scene, size.width, size.height),
        }
    }

    /// The state at a step of the motion. Modes oscillate, and the sliding domain moves on a small circle. All other
    /// domains keep their placements.
    pub(super) fn state(&self, step: usize) -> SceneState {
        let mut state = SceneState::rest(&self.scene);
        add_sway(&mut state, &self.motion, step);
        if let Some(domain) = self.sliding_domain {
            let radius = SLIDE_RADIUS * self.scene.rest_bounds.diagonal();
            // Half a turn per second.
            let angle = TAU * 0.5 * step as f64 * STEP_SECONDS;
            let from_y_up = self.scene.up.rotation_from_y_up();
            let offset = from_y_up * Vector3::new(radius * angle.sin(), 0.0, radius * (1.0 - angle.cos()));
            let placement = self.scene.domains[domain].placement.to_matrix();
            state.transforms[domain] = Transform::from_matrix(&(Matrix4::new_translation(&offset) * placement));
        }
        state.mark_all_dirty();
        state
    }
}

/// Adds the modal coordinates of a motion's step with reduced amplitudes.
fn add_sway(state: &mut SceneState, motion: &WorkloadMotion, step: usize) {
    for (q, coordinate) in state.q.iter_mut().zip(motion.trajectory_state(step).q) {
        *q += (SWAY_AMPLITUDE * coordinate) as f32;
    }
}

/// State of a scene in a light wind, at a step at which the modes are displaced.
pub(super) fn swaying_state(scene: &Arc<Scene>) -> SceneState {
    let workload = Workload::new(scene.name.clone(), Arc::clone(scene));
    let mut state = SceneState::rest(scene);
    add_sway(&mut state, &WorkloadMotion::new(&workload, None), 10);
    state.mark_all_dirty();
    state
}

/// States of a scene in a light wind.
pub(super) fn moving_states(scene: &Arc<Scene>, count: usize) -> Vec<SceneState> {
    let workload = Workload::new(scene.name.clone(), Arc::clone(scene));
    let motion = WorkloadMotion::new(&workload, None);
    let state_at = |step: usize| {
        let mut state = SceneState::rest(scene);
        add_sway(&mut state, &motion, step);
        state.mark_all_dirty();
        state
    };
    (0..count).map(state_at).collect()
}

/// Four corners, counter-clockwise, as two triangles.
pub(super) fn quad(corners: [[f32; 3]; 4], normal: [f32; 3]) -> Result<Mesh> {
    Mesh::from_indexed(corners.to_vec(), vec![normal; 4], Vec::new(), vec![[0, 1, 2], [0, 2, 3]])
}

/// A square of side `2 * half_side` that faces up at this height.
pub(super) fn horizontal_square(half_side: f32, height: f32) -> Result<Mesh> {
    let point = |x: f32, z: f32| [x * half_side, height, z * half_side];
    quad([point(-1.0, 1.0), point(1.0, 1.0), point(1.0, -1.0), point(-1.0, -1.0)], [0.0, 1.0, 0.0])
}

/// A room of about 10,000 triangles seen from inside. It fills the frame and is used by the rasterizer benchmarks only.
pub(super) fn room_mesh() -> Result<(Mesh, Camera)> {
    // Cells per side of a wall: 6 walls of 29 x 29 cells with 2 triangles each have 10,092 triangles.
    const CELLS: u32 = 29;
    let (mut positions, mut normals, mut triangles) = (Vec::new(), Vec::new(), Vec::new());
    for (axis, side) in (0..3).flat_map(|axis| [(axis, -1.0_f32), (axis, 1.0)]) {
        let first_vertex = positions.len() as u32;
        for (row, column) in (0..=CELLS).flat_map(|row| (0..=CELLS).map(move |column| (row, column))) {
            let coordinate = |cell: u32| 2.0 * cell as f32 / CELLS as f32 - 1.0;
            let mut point = [0.0; 3];
            (point[axis], point[(axis + 1) % 3], point[(axis + 2) % 3]) = (side, coordinate(column), coordinate(row));
            positions.push([3.0 * point[0], 1.5 * point[1], 3.0 * point[2]]);
            normals.push(std::array::from_fn(|component| if component == axis { -side } else { 0.0 }));
        }
        for (row, column) in (0..CELLS).flat_map(|row| (0..CELLS).map(move |column| (row, column))) {
            let a = first_vertex + row * (CELLS + 1) + column;
            let (b, c, d) = (a + 1, a + CELLS + 2, a + CELLS + 1);
            triangles.extend(if side < 0.0 { [[a, b, c], [a, c, d]] } else { [[a, c, b], [a, d, c]] });
        }
    }
    let view = View::LookAt { eye: [2.1, 0.4, 2.3], target: [-1.0, -0.3, -1.2], up: [0.0, 1.0, 0.0] };
    let camera = Camera { view, lens: Lens::FieldOfView(60.0), near: 0.05, far: 20.0 };
    Ok((Mesh::from_indexed(positions, normals, Vec::new(), triangles)?, camera))
}

/// Two triangles that fill the frame.
pub(super) fn screen_mesh() -> Result<(Mesh, Camera)> {
    let mesh = quad([[-3.0, -3.0, 0.0], [3.0, -3.0, 0.0], [3.0, 3.0, 0.0], [-3.0, 3.0, 0.0]], [0.0, 0.0, 1.0])?;
    let view = View::LookAt { eye: [0.1, 0.0, 1.2], target: [0.0; 3], up: [0.0, 1.0, 0.0] };
    Ok((mesh, Camera { view, lens: Lens::FieldOfView(50.0), near: 0.1, far: 10.0 }))
}

fn two_sided_material(diffuse: [f32; 3]) -> Material {
    Material {
        ambient: diffuse,
        diffuse,
        specular: [0.15; 3],
        shininess: 24.0,
        double_sided: true,
        ..Material::default()
    }
}

/// Builds a square of 1.4 units at height 1. The ground is at the lowest vertex, so a slab sets its height to 0.
fn build_square() -> Result<SceneParts> {
    let mut parts = SceneParts::named("square");
    add_rigid_domain(&mut parts, "slab", horizontal_square(1.6, 0.0)?, two_sided_material([0.75, 0.72, 0.68]))?;
    add_rigid_domain(&mut parts, "square", horizontal_square(0.7, 1.0)?, two_sided_material([0.80, 0.35, 0.25]))?;
    parts.look = RenderSettings { sun: [0.45, 0.8, 0.3], ..RenderSettings::default() };
    Ok(parts)
}

/// x of the shelf's edge, where the visible part of its shadow begins.
const SHELF_EDGE: f32 = -3.5;

/// Builds a square of two units, 0.03 above the ground. The sun is at [3, 1, 0], so the shadow extends 3 x 0.03 beyond
/// the square's edge. Two slabs set the ground to height 0 and widen the scene, so that the shadow is near one end of
/// the shadow map's depth range.
fn build_shelf() -> Result<SceneParts> {
    let mut parts = SceneParts::named("shelf");
    let square_at = |half_side: f32, height: f32, x: f32, z: f32| {
        let point = |dx: f32, dz: f32| [x + dx * half_side, height, z + dz * half_side];
        quad([point(-1.0, 1.0), point(1.0, 1.0), point(1.0, -1.0), point(-1.0, -1.0)], [0.0, 1.0, 0.0])
    };
    add_rigid_domain(&mut parts, "near slab", square_at(0.1, 0.0, 5.0, 5.0)?, two_sided_material([0.75, 0.72, 0.68]))?;
    add_rigid_domain(&mut parts, "far slab", square_at(0.1, 0.0, -5.0, -5.0)?, two_sided_material([0.75, 0.72, 0.68]))?;
    add_rigid_domain(
        &mut parts,
        "shelf",
        square_at(1.0, 0.03, SHELF_EDGE + 1.0, 0.0)?,
        two_sided_material([0.80, 0.35, 0.25]),
    )?;
    parts.look = RenderSettings { sun: [3.0, 1.0, 0.0], ..RenderSettings::default() };
    Ok(parts)
}

/// Builds a floor of four units and three horizontal sheets above it, whose shadows have edges that cross near the
/// center of the floor. The highest sheet is ten times as high as the lowest one, which covers most of the image: along the
/// shadow edges of the higher sheets, moments alone leak light into its shadow. Between the edges, a wedge is lit.
fn build_layers() -> Result<SceneParts> {
    const SUN: [f32; 3] = [0.1, 1.0, 0.05];
    const HALF_SIDE: f32 = 0.9;
    let mut parts = SceneParts::named("layers");
    add_rigid_domain(&mut parts, "floor", horizontal_square(2.0, 0.0)?, two_sided_material([0.75, 0.72, 0.68]))?;
    // The shadow of a sheet covers the points p of the floor with p . (cos angle, sin angle) <= offset in x and z.
    for (name, height, angle, offset) in
        [("low", 0.3, 0.0, 0.06), ("middle", 1.0, -1.2, -0.05), ("high", 3.0, 1.4_f32, 0.0_f32)]
    {
        let (sin, cos) = angle.sin_cos();
        let point = |u: f32, v: f32| {
            let (across, along) = (offset + HALF_SIDE * (u - 1.0), HALF_SIDE * v);
            [across * cos - along * sin + height * SUN[0], height, across * sin + along * cos + height * SUN[2]]
        };
        let sheet = quad([point(-1.0, 1.0), point(1.0, 1.0), point(1.0, -1.0), point(-1.0, -1.0)], [0.0, 1.0, 0.0])?;
        add_rigid_domain(&mut parts, name, sheet, two_sided_material([0.80, 0.35, 0.25]))?;
    }
    parts.look = RenderSettings { sun: SUN, ..RenderSettings::default() };
    Ok(parts)
}

/// Builds three panes of red, green and blue glass, listed from nearest to farthest, in front of a pale wall.
fn build_panes() -> Result<SceneParts> {
    let mut parts = SceneParts::named("panes");
    let upright_rectangle = |[left, bottom, right, top]: [f32; 4], z: f32| {
        quad([[left, bottom, z], [right, bottom, z], [right, top, z], [left, top, z]], [0.0, 0.0, 1.0])
    };
    add_rigid_domain(
        &mut parts,
        "wall",
        upright_rectangle([-1.4, 0.0, 1.4, 1.9], -0.8)?,
        two_sided_material([0.85, 0.84, 0.80]),
    )?;
    let glass =
        |color: [f32; 3], alpha: f32| Material { alpha, alpha_mode: AlphaMode::Blend, ..two_sided_material(color) };
    add_rigid_domain(
        &mut parts,
        "red",
        upright_rectangle([-1.1, 0.3, 0.3, 1.3], 0.6)?,
        glass([0.85, 0.12, 0.10], 0.6),
    )?;
    add_rigid_domain(
        &mut parts,
        "green",
        upright_rectangle([-0.6, 0.5, 0.8, 1.6], 0.2)?,
        glass([0.10, 0.70, 0.20], 0.45),
    )?;
    add_rigid_domain(
        &mut parts,
        "blue",
        upright_rectangle([-0.2, 0.2, 1.2, 1.2], -0.2)?,
        glass([0.12, 0.25, 0.85], 0.7),
    )?;
    parts.look = RenderSettings { sun: [0.35, 0.6, 0.7], ..RenderSettings::default() };
    Ok(parts)
}

/// Opens the built-in tree. All variants draw it with four samples per pixel, on every renderer.
fn open_tree() -> Result<Arc<Scene>> {
    let tree = load::open("tree")?.scene;
    with_settings(&tree, RenderSettings { samples: 4, antialias: Antialiasing::Msaa, ..tree.look })
}

/// Builds four copies of one tree, each rotated and translated. The copies share shapes, materials and textures.
fn build_grove(tree: &Scene) -> SceneParts {
    let mut parts = SceneParts::named("grove");
    parts.shapes.clone_from(&tree.shapes);
    parts.materials.clone_from(&tree.materials);
    parts.textures.clone_from(&tree.textures);
    (parts.look, parts.up) = (tree.look, tree.up);
    (parts.unit, parts.rigid_transforms) = (Some(tree.unit), tree.rigid_transforms);
    let spacing = 0.42 * tree.rest_bounds.diagonal();
    for (index, [column, row]) in [[-1.5, 0.1], [-0.5, -0.5], [0.5, 0.3], [1.5, -0.3]].into_iter().enumerate() {
        let from_y_up = tree.up.rotation_from_y_up();
        let offset = from_y_up * Vector3::new(column * spacing, 0.0, row * spacing);
        let rotation = Rotation3::new(tree.up.vector() * (1.3 * index as f64));
        let placement = Matrix4::new_translation(&offset) * rotation.to_homogeneous();
        let first_domain = parts.domains.len();
        for domain in &tree.domains {
            let mut copy = domain.clone();
            copy.name = format!("{} of tree {index}", domain.name);
            copy.placement = Transform::from_matrix(&(placement * domain.placement.to_matrix()));
            if let Some(attachment) = &mut copy.attachment {
                attachment.parent += first_domain;
            }
            copy.shares_q_with = copy.shares_q_with.map(|source| source + first_domain);
            parts.domains.push(copy);
        }
    }
    parts
}

/// Builds rolling hills of about `triangle_count` triangles on a square of four units, and four poles that cast shadows
/// on them.
fn build_field(triangle_count: usize) -> Result<SceneParts> {
    let mut parts = SceneParts::named("field");
    let cells_per_side = ((triangle_count as f64 / 2.0).sqrt().round() as usize).max(1);
    let point = |column: usize, row: usize| {
        let [x, z] = [column, row].map(|index| 4.0 * (index as f64 / cells_per_side as f64 - 0.5));
        // A wave with frequencies along x and z in radians per unit.
        let wave = |fx: f64, fz: f64, phase: f64| (fx * x + fz * z + phase).sin();
        let height = 0.16 * wave(2.1, 1.3, 0.4) + 0.11 * wave(-1.7, 3.1, 1.9) + 0.03 * wave(9.0, 7.0, 0.7);
        [x as f32, (0.4 + height) as f32, z as f32]
    };
    let positions: Vec<[f32; 3]> =
        (0..=cells_per_side).flat_map(|row| (0..=cells_per_side).map(move |column| point(column, row))).collect();
    let corner = |column: usize, row: usize| (row * (cells_per_side + 1) + column) as u32;
    let cell_triangles = |cell: usize| {
        let (column, row) = (cell % cells_per_side, cell / cells_per_side);
        let [a, b] = [corner(column, row), corner(column + 1, row)];
        let [c, d] = [corner(column + 1, row + 1), corner(column, row + 1)];
        [[a, d, c], [a, c, b]]
    };
    let triangles: Vec<[u32; 3]> = (0..cells_per_side * cells_per_side).flat_map(cell_triangles).collect();
    let corners: Vec<u32> = (0..positions.len() as u32).collect();
    let normals = smooth_normals(&positions, &corners, &triangles);
    let mesh = Mesh::from_indexed(positions, normals, Vec::new(), triangles)?;
    add_rigid_domain(
        &mut parts,
        "field",
        mesh,
        Material { double_sided: false, ..two_sided_material([0.52, 0.60, 0.34]) },
    )?;
    let pole_corners =
        |x: f32, z: f32| [[x - 0.05, 0.2, z], [x + 0.05, 0.2, z], [x + 0.05, 1.5, z], [x - 0.05, 1.5, z]];
    let pole_positions = [[-0.9, 0.0], [0.9, 0.2], [0.0, -0.9], [0.1, 0.8]];
    let positions: Vec<[f32; 3]> = pole_positions.iter().flat_map(|[x, z]| pole_corners(*x, *z)).collect();
    let triangles =
        (0..4).flat_map(|pole| [[0, 1, 2], [0, 2, 3]].map(|corners: [u32; 3]| corners.map(|corner| corner + 4 * pole)));
    let mesh = Mesh::from_indexed(positions, vec![[0.0, 0.0, 1.0]; 16], Vec::new(), triangles.collect())?;
    add_rigid_domain(&mut parts, "poles", mesh, two_sided_material([0.70, 0.30, 0.22]))?;
    parts.look = RenderSettings { sun: [0.55, 0.5, 0.45], ..RenderSettings::default() };
    Ok(parts)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finds_every_workload_by_name_and_rejects_others() {
        for workload in RenderWorkload::all(false).into_iter().chain(RenderWorkload::all(true)) {
            assert_eq!(RenderWorkload::from_name(&workload.name()), Ok(workload));
        }
        for name in ["", "triangles", "triangles-", "triangles-1", "triangles-9000000", "Tree", "a"] {
            assert!(RenderWorkload::from_name(name).is_err(), "{name}");
        }
    }

    #[test]
    fn field_has_about_the_requested_triangles_facing_up() {
        let animation = RenderWorkload::Triangles(5_000).build().expect("a workload");
        let mesh = &animation.scene.shapes[0].mesh;
        assert!((4_900..=5_100).contains(&mesh.triangles().len()), "{}", mesh.triangles().len());
        assert!(mesh.corners().normals.iter().all(|normal| normal[1] > 0.5));
    }

    #[test]
    fn only_the_sliding_domain_moves() {
        let animation = RenderWorkload::Square.build().expect("a workload");
        let (rest_state, moved_state) = (SceneState::rest(&animation.scene), animation.state(30));
        assert_eq!(animation.state(0).transforms, rest_state.transforms);
        assert_eq!(moved_state.transforms[0], rest_state.transforms[0]);
        let shift = (moved_state.transforms[1].translation() - rest_state.transforms[1].translation()).norm();
        let radius = SLIDE_RADIUS * animation.scene.rest_bounds.diagonal();
        // Step 30, after half a second, is a quarter of the circle from step 0.
        assert!((shift - radius * 2f64.sqrt()).abs() < 1e-6, "expected a shift of sqrt(2) x {radius}, got {shift}");
    }
}
