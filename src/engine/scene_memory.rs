//! The memory that an open scene takes, and its reservation.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

use crate::engine::lock::lock;
use crate::engine::memory_limits::MemoryLimits;
use modalcast_model::domain::{Shape, Transform};
use modalcast_model::error::Result;
use modalcast_model::memory::{MemoryBudget, MemoryGroup, MemoryReservation};
use modalcast_model::scene::Scene;

/// Bytes of a domain on host and device, without its mesh: names, notes, transforms of several steps, tables.
const DOMAIN_BYTES: u64 = 2048;

/// The scenes of one principal leave this part of the memory for others: 1 / `RESERVE_DIVISOR`.
const RESERVE_DIVISOR: u64 = 8;

/// Output sets of a deformer: one is written while another is copied.
const OUTPUT_SETS: u64 = 2;

/// Pieces of a batch of views that exist at a time: one is drawn, two are sent.
const PIECES_IN_MEMORY: u64 = 3;

/// Copies of the state of worlds: the one that is shown, the next one, its step, and that of the deformer.
const STATE_COPIES: u64 = 4;

/// The budgets that all scenes share.
#[derive(Debug)]
pub(super) struct MemoryBudgets {
    host: Arc<MemoryBudget>,
    device: Arc<MemoryBudget>,
    /// By the principals to whom the scenes belong.
    groups: Mutex<BTreeMap<String, PrincipalMemory>>,
    has_device: bool,
    has_renderer: bool,
}

/// The memory of the scenes of one principal.
#[derive(Debug, Clone)]
struct PrincipalMemory {
    host: Arc<MemoryGroup>,
    device: Arc<MemoryGroup>,
}

/// Memory of all scenes in bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MemoryUse {
    pub reserved: u64,
    pub limit: u64,
}

/// The reserved memory of one scene, until this is dropped.
#[derive(Debug)]
pub(super) struct SceneMemory {
    pub(super) host: Arc<MemoryReservation>,
    device: Arc<MemoryReservation>,
    has_device: bool,
    has_renderer: bool,
}

impl MemoryBudgets {
    /// Without a renderer, scenes need no memory to be drawn.
    pub(super) fn new(limits: MemoryLimits, has_renderer: bool) -> Self {
        let has_device = limits.has_device;
        let groups = Mutex::default();
        Self { host: limits.host_budget(), device: limits.device_budget(), groups, has_device, has_renderer }
    }

    /// The memory of all scenes, by its kind. Without a device, what scenes have there counts as host memory.
    pub(super) fn in_use(&self) -> impl Iterator<Item = (&'static str, MemoryUse)> {
        let budgets = [("host", &self.host)].into_iter().chain(self.has_device.then_some(("device", &self.device)));
        budgets.map(|(kind, budget)| (kind, MemoryUse { reserved: budget.reserved(), limit: budget.total() }))
    }

    /// The memory of a scene of a principal that is to be loaded.
    pub(super) fn new_scene(&self, principal: &str) -> SceneMemory {
        let PrincipalMemory { host, device } = self.memory_of(principal);
        SceneMemory {
            host: MemoryReservation::in_group(&host),
            device: MemoryReservation::in_group(&device),
            has_device: self.has_device,
            has_renderer: self.has_renderer,
        }
    }

    fn memory_of(&self, principal: &str) -> PrincipalMemory {
        let new_group = |budget: &Arc<MemoryBudget>| {
            let total = budget.total();
            MemoryGroup::new(budget, total - total / RESERVE_DIVISOR)
        };
        let mut groups = lock(&self.groups);
        // Principals without scenes.
        groups.retain(|_, memory| Arc::strong_count(&memory.host) > 1 || Arc::strong_count(&memory.device) > 1);
        let memory = groups.entry(principal.to_owned());
        memory
            .or_insert_with(|| PrincipalMemory { host: new_group(&self.host), device: new_group(&self.device) })
            .clone()
    }
}

impl SceneMemory {
    /// Reserves the memory of worlds of a scene, whose pictures have at most `picture_bytes` at a time.
    ///
    /// # Errors
    /// `OutOfMemory`.
    pub(super) fn reserve_worlds(&self, name: &str, scene: &Scene, count: usize, picture_bytes: usize) -> Result<()> {
        let object = format!("{count} worlds of scene '{name}'");
        let pictures = PIECES_IN_MEMORY * picture_bytes as u64;
        // The CPU has the levels of images in f32.
        let images = if self.has_device { 4 * pixel_bytes(scene) / 3 } else { 16 * pixel_bytes(scene) / 3 };
        let shared = array_bytes(scene) + view_table_bytes(scene) + images;
        let worlds = shared.saturating_add(world_bytes(scene, count));
        if self.has_device {
            self.host.resize(&object, worlds.saturating_add(pictures))?;
            self.device.resize(&object, worlds.saturating_add(pictures))
        } else {
            self.host.resize(&object, worlds.saturating_mul(2).saturating_add(pictures))
        }
    }

    /// Reserves device memory for pictures, in addition to the rest.
    ///
    /// # Errors
    /// `OutOfMemory`.
    pub(super) fn reserve_pictures(&self, object: &str, bytes: u64) -> Result<()> {
        self.device.reserve(object, bytes)
    }

    /// Replaces what the loaders have reserved by the memory of the loaded scene on host and device.
    ///
    /// # Errors
    /// `OutOfMemory`.
    pub(super) fn reserve_loaded(&self, name: &str, scene: &Scene) -> Result<()> {
        let object = format!("scene '{name}'");
        let (mut host, mut device) = (host_bytes(scene), device_bytes(scene));
        if self.has_renderer {
            // The levels of textures are computed on the host before they are uploaded.
            host += 4 * pixel_bytes(scene) / 3;
            device += render_bytes(scene);
        }
        if self.has_device {
            self.host.resize(&object, host)?;
            self.device.resize(&object, device)
        } else {
            self.host.resize(&object, host.saturating_add(device))
        }
    }
}

/// Bytes that `count` worlds of a scene take on the host and on the device, apart from the arrays that they share: as
/// [`output_bytes`] and [`domain_bytes`] of all worlds, and several copies of their state.
fn world_bytes(scene: &Scene, count: usize) -> u64 {
    let (coordinates, transforms) = (scene.layout.coordinates as u64, scene.transform_roots.count() as u64);
    let state = size_of::<f32>() as u64 * coordinates + size_of::<Transform>() as u64 * transforms;
    (count as u64).saturating_mul(output_bytes(scene) + domain_bytes(scene) + STATE_COPIES * state)
}

/// Bytes of the tables of a view renderer: per triangle its vertices, corners, material and domain, and per corner its
/// texture coordinates.
fn view_table_bytes(scene: &Scene) -> u64 {
    32 * scene.layout.triangles as u64 + 8 * scene.layout.corners as u64
}

/// Host memory of a scene: its arrays and pixels, and copies of the outputs of a deformer.
fn host_bytes(scene: &Scene) -> u64 {
    array_bytes(scene) + pixel_bytes(scene) + output_bytes(scene) + domain_bytes(scene)
}

/// Device memory of a deformer: U, the mesh, and the outputs.
fn device_bytes(scene: &Scene) -> u64 {
    array_bytes(scene) + output_bytes(scene) + domain_bytes(scene)
}

/// Device memory of a renderer: buffers, textures with their levels, and shadow maps.
fn render_bytes(scene: &Scene) -> u64 {
    // Rebased positions and the values of a color map are created by the first frame that needs them.
    let on_demand = 16 * scene.layout.vertices as u64;
    modalcast_render::plan(scene).bytes() + on_demand
}

fn array_bytes(scene: &Scene) -> u64 {
    scene.shapes.iter().map(shape_bytes).sum()
}

fn pixel_bytes(scene: &Scene) -> u64 {
    scene.textures.iter().map(|texture| texture.rgba().len() as u64).sum()
}

fn domain_bytes(scene: &Scene) -> u64 {
    DOMAIN_BYTES * scene.domains.len() as u64
}

/// Bytes of the arrays of a shape: 3 f32 per vertex, its rank times 3 f32 of U, and per corner its vertex, its normal,
/// its texture coordinates and its tangent.
fn shape_bytes(shape: &Shape) -> u64 {
    let mesh = &shape.mesh;
    let corners = mesh.corners();
    let lists = [
        size_of_val(mesh.rest_positions()),
        size_of_val(mesh.triangles()),
        mesh.inner_edges().len(),
        size_of_val(&corners.vertices[..]),
        size_of_val(&corners.normals[..]),
        size_of_val(&corners.uvs[..]),
        size_of_val(shape.tangents()),
        size_of_val(shape.modes.columns()),
    ];
    lists.iter().sum::<usize>() as u64
}

/// Bytes of the outputs of a deformer: positions and displacements per vertex, normals and tangents per corner.
fn output_bytes(scene: &Scene) -> u64 {
    let (vertices, corners) = (scene.layout.vertices as u64, scene.layout.corners as u64);
    let tangent = if scene.features.normal_maps { 16 } else { 0 };
    OUTPUT_SETS * (24 * vertices + (12 + tangent) * corners)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use crate::engine::testing;
    use modalcast_model::error::Error;

    fn budgets(bytes: u64, has_device: bool) -> MemoryBudgets {
        let config = Config {
            scenes_host_bytes: Some(2 * bytes),
            scene_host_bytes: Some(bytes),
            scenes_device_bytes: Some(2 * bytes),
            scene_device_bytes: Some(bytes),
            ..Config::default()
        };
        MemoryBudgets::new(MemoryLimits::new(&config, has_device.then_some(1 << 30)), false)
    }

    #[test]
    fn loaded_scene_replaces_the_reservation_of_its_files() {
        let scene = testing::two_strips();
        let budgets = budgets(1 << 30, true);
        let memory = budgets.new_scene("anna");
        memory.host.reserve("file", 1 << 20).expect("expected enough memory");
        memory.reserve_loaded("strips", &scene).expect("expected enough memory");
        let expected = (host_bytes(&scene), device_bytes(&scene));
        assert_eq!((budgets.host.reserved(), budgets.device.reserved()), expected);
        drop(memory);
        assert_eq!((budgets.host.reserved(), budgets.device.reserved()), (0, 0));
    }

    /// A principal that opens scenes as long as it can leaves memory for others.
    #[test]
    fn principals_share_the_memory() {
        let scene = testing::two_strips();
        let budgets = budgets(8 * (host_bytes(&scene) + device_bytes(&scene)), false);
        let open = |principal: &str| {
            let memory = budgets.new_scene(principal);
            memory.reserve_loaded("strips", &scene).map(|()| memory)
        };
        let mut of_anna: Vec<_> = std::iter::repeat_with(|| open("anna")).map_while(Result::ok).collect();
        assert_eq!(of_anna.len(), 14, "expected 2 of 16 to be left");
        let of_ben = [open("ben").expect("expected the rest"), open("ben").expect("expected the rest")];
        assert!(open("carla").is_err());
        of_anna.pop();
        open("carla").expect("expected the memory of the closed scene");
        drop((of_anna, of_ben));
        open("ben").expect("expected the memory of the closed scenes");
        assert_eq!(lock(&budgets.groups).len(), 1, "expected no group without a scene");
    }

    #[test]
    fn scene_without_gpu_counts_its_device_memory_as_host_memory() {
        let scene = testing::two_strips();
        let bytes = host_bytes(&scene) + device_bytes(&scene);
        let memory = budgets(bytes, false).new_scene("anna");
        memory.reserve_loaded("strips", &scene).expect("expected exactly enough memory");
        let error = budgets(bytes - 1, false).new_scene("anna").reserve_loaded("strips", &scene);
        assert!(matches!(error, Err(Error::OutOfMemory { asked, .. }) if asked == bytes), "{error:?}");
    }
}
