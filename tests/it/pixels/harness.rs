//! Builder for small scenes, and helpers that render them.

use std::sync::Arc;

use modalcast_compute::reference::ReferenceDeformer;
use modalcast_model::deform::{DeformSummary, Deformer as _};
use modalcast_model::domain::{Domain, Material, Mesh, Metadata, Modes, Shape, Texture, Transform};
use modalcast_model::scene::{Camera, Lens, Scene, SceneParts, SceneState, View};
use modalcast_render::{Allocation, DevicePreference, FrameImage, FrameParams, FrameStats, Pass, Renderer, plan};

/// A scene under construction: no shadow, no ground, a black sky, and the sun behind the camera.
pub(super) struct SceneBuilder(pub(super) SceneParts);

/// A picture, the statistics of its frame and the allocations of its scene.
pub(super) struct Picture {
    pub(super) image: FrameImage,
    pub(super) stats: FrameStats,
    pub(super) allocations: Vec<Allocation>,
}

impl SceneBuilder {
    pub(super) fn new() -> Self {
        let mut parts = SceneParts::named("test");
        parts.look.shadow = None;
        parts.look.ground = None;
        parts.look.zenith = [0.0; 3];
        parts.look.horizon = [0.0; 3];
        parts.look.sun = [0.0, 0.0, 1.0];
        parts.look.sunlight = [0.5; 3];
        parts.look.skylight = [0.25; 3];
        Self(parts)
    }

    pub(super) fn texture(&mut self, width: u32, height: u32, pixel: impl Fn(u32, u32) -> [u8; 4]) -> usize {
        let rgba = (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).flat_map(|(x, y)| pixel(x, y)).collect();
        self.0.textures.push(Texture::new("made", width, height, rgba).expect("fits"));
        self.0.textures.len() - 1
    }

    pub(super) fn add(mut self, mesh: Mesh, material: Material) -> Self {
        self.0.shapes.push(Shape::new(mesh, Modes::rigid()).expect("rigid"));
        self.0.materials.push(material);
        self.0.domains.push(Domain {
            name: format!("domain {}", self.0.domains.len()),
            shape: self.0.shapes.len() - 1,
            material: self.0.materials.len() - 1,
            material_ranges: vec![],
            placement: Transform::IDENTITY,
            attachment: None,
            follows: None,
            rest_q: vec![],
            shares_q_with: None,
            metadata: Metadata::default(),
        });
        self
    }

    pub(super) fn scene(self) -> Arc<Scene> {
        Scene::new(self.0).expect("a good scene")
    }
}

/// A rectangle that faces +Z, from (left, bottom) to (right, top) at depth z.
pub(super) fn facing(left: f32, bottom: f32, right: f32, top: f32, z: f32) -> Mesh {
    let rest = vec![[left, bottom, z], [right, bottom, z], [right, top, z], [left, top, z]];
    rectangle(rest, [0.0, 0.0, 1.0])
}

/// A square that faces +Y at height y and extends `half` to each side of the origin.
pub(super) fn floor_mesh(half: f32, y: f32) -> Mesh {
    let rest = vec![[-half, y, half], [half, y, half], [half, y, -half], [-half, y, -half]];
    rectangle(rest, [0.0, 1.0, 0.0])
}

fn rectangle(rest: Vec<[f32; 3]>, normal: [f32; 3]) -> Mesh {
    let uvs = vec![[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]];
    Mesh::from_indexed(rest, vec![normal; 4], uvs, vec![[0, 1, 2], [0, 2, 3]]).expect("a rectangle")
}

/// A camera with ten pixels per unit in the plane z = 0 and the origin at the center of the picture.
pub(super) fn camera(size: u32) -> Camera {
    let middle = f64::from(size) / 2.0;
    Camera {
        view: View::LookAt { eye: [0.0, 0.0, 10.0], target: [0.0; 3], up: [0.0, 1.0, 0.0] },
        lens: Lens::Intrinsics { fx: 100.0, fy: 100.0, cx: middle, cy: middle },
        near: 0.0,
        far: 0.0,
    }
}

pub(super) fn open() -> Renderer {
    Renderer::open(DevicePreference::Any).expect("EGL and OpenGL 4.3 (libegl1, libegl-mesa0, libgl1-mesa-dri)")
}

/// Renders the scene at rest in a square picture.
pub(super) fn draw(renderer: &mut Renderer, scene: &Arc<Scene>, camera: Camera, size: u32) -> Picture {
    draw_sized(renderer, scene, camera, [size, size])
}

/// Renders the scene at rest.
pub(super) fn draw_sized(
    renderer: &mut Renderer,
    scene: &Arc<Scene>,
    camera: Camera,
    [width, height]: [u32; 2],
) -> Picture {
    let mut deformer = ReferenceDeformer::new(scene).with_bounding_axes(scene.light_axes());
    let DeformSummary { bounds, oriented_bounds: light, .. } =
        deformer.deform(&SceneState::rest(scene)).expect("deforms");
    let buffers = renderer.load(scene).expect("loads");
    renderer.upload(&buffers, deformer.surface().expect("there")).expect("uploads");
    let shot = FrameParams { camera, width, height, bounds, light };
    let image = renderer.draw(&buffers, &shot).expect("draws");
    let (stats, allocations) = (renderer.stats().clone(), buffers.allocations());
    renderer.unload(buffers);
    Picture { image, stats, allocations }
}

/// Renders the scene at rest in a 64 x 64 picture of [`camera`].
pub(super) fn picture(scene: &Arc<Scene>) -> Picture {
    draw(&mut open(), scene, camera(64), 64)
}

impl Picture {
    /// Red, green and blue of a pixel; (0, 0) is the top left.
    pub(super) fn at(&self, x: u32, y: u32) -> [u8; 3] {
        let first = 4 * (y * self.image.width + x) as usize;
        let [r, g, b, a] = [0, 1, 2, 3].map(|channel| self.image.rgba[first + channel]);
        assert_eq!(a, 255, "every pixel is opaque");
        [r, g, b]
    }

    /// Number of pixels that satisfy a predicate.
    pub(super) fn count(&self, claim: impl Fn([u8; 3]) -> bool) -> usize {
        (0..self.image.height)
            .flat_map(|y| (0..self.image.width).map(move |x| (x, y)))
            .filter(|(x, y)| claim(self.at(*x, *y)))
            .count()
    }
}

/// Planned passes of a scene with no geometry below its ground; the ground pass is skipped in this case.
pub(super) fn planned_above(scene: &Scene) -> Vec<Pass> {
    plan(scene).passes.into_iter().filter(|pass| *pass != Pass::Ground).collect()
}

/// sRGB value in 0 to 255 of a linear value.
pub(super) fn srgb(linear: f64) -> f64 {
    let linear = linear.clamp(0.0, 1.0);
    255.0 * if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

/// Whether a pixel is within `slack` levels of linear colors.
pub(super) fn close(pixel: [u8; 3], linear: [f64; 3], slack: f64) -> bool {
    pixel.iter().zip(linear).all(|(byte, value)| (f64::from(*byte) - srgb(value)).abs() <= slack)
}
