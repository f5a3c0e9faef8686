//! Builder for small scenes, and helpers that render them.

use std::sync::Arc;

use modalcast_compute::reference::ReferenceDeformer;
use modalcast_model::deform::{DeformSummary, DeformedSurface, Deformer as _};
use modalcast_model::domain::{AlphaMode, Domain, Material, Mesh, Modes, Shape, Texture};
use modalcast_model::scene::{Camera, Lens, Scene, SceneParts, SceneState, View};
use modalcast_render::{Allocation, DevicePreference, FrameImage, FrameParams, FrameStats, Renderer};

/// Builder for a scene without shadow and ground, with a black sky, and with the sun in the direction +Z, behind
/// [`front_camera`]. A white surface that faces +Z has the linear color 0.25 (skylight) + 0.5 (sunlight) = 0.75.
pub(super) struct SceneBuilder {
    pub(super) parts: SceneParts,
}

/// An image, the statistics of its frame and the allocations of its scene.
pub(super) struct RenderedFrame {
    pub(super) image: FrameImage,
    pub(super) stats: FrameStats,
    pub(super) allocations: Vec<Allocation>,
}

/// A double-sided opaque material without texture.
pub(super) fn colored_material(diffuse: [f32; 3]) -> Material {
    Material { diffuse, double_sided: true, ..Material::default() }
}

/// A green blended material with alpha 0.4.
pub(super) fn glass_material() -> Material {
    Material { alpha_mode: AlphaMode::Blend, alpha: 0.4, ..colored_material([0.2, 0.9, 0.3]) }
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
        Self { parts }
    }

    /// Adds a texture with the pixels `pixel(x, y)` and returns its index.
    pub(super) fn add_texture(&mut self, width: u32, height: u32, pixel: impl Fn(u32, u32) -> [u8; 4]) -> usize {
        let rgba = (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).flat_map(|(x, y)| pixel(x, y)).collect();
        self.parts.textures.push(Texture::new("test", width, height, rgba).expect("expected a valid texture"));
        self.parts.textures.len() - 1
    }

    /// Adds a texture of 8 x 8 pixels whose alpha is a checkerboard. Returns a cut-out material with this texture.
    pub(super) fn create_leaf_material(&mut self) -> Material {
        let image = self.add_texture(8, 8, |x, y| [200, 220, 90, if (x + y) % 2 == 0 { 255 } else { 0 }]);
        let alpha_mode = AlphaMode::Mask { cutoff: 0.5 };
        Material { alpha_mode, color_texture: Some(image), ..colored_material([1.0; 3]) }
    }

    /// Adds a rigid domain with a new shape and a new material.
    pub(super) fn add_domain(mut self, mesh: Mesh, material: Material) -> Self {
        self.parts.shapes.push(Shape::new(mesh, Modes::rigid()).expect("expected a valid shape"));
        self.parts.materials.push(material);
        self.parts.domains.push(Domain {
            material: self.parts.materials.len() - 1,
            ..Domain::new(format!("domain {}", self.parts.domains.len()), self.parts.shapes.len() - 1)
        });
        self
    }

    pub(super) fn build(self) -> Arc<Scene> {
        Scene::new(self.parts).expect("expected a valid scene")
    }
}

/// A rectangle that faces +Z, from (left, bottom) to (right, top) at depth z.
pub(super) fn facing_rectangle(left: f32, bottom: f32, right: f32, top: f32, z: f32) -> Mesh {
    let positions = vec![[left, bottom, z], [right, bottom, z], [right, top, z], [left, top, z]];
    rectangle(positions, [0.0, 0.0, 1.0])
}

/// A square that faces +Y at height y and extends by `half_side` from the y axis along x and z.
pub(super) fn floor_mesh(half_side: f32, y: f32) -> Mesh {
    let positions = vec![
        [-half_side, y, half_side],
        [half_side, y, half_side],
        [half_side, y, -half_side],
        [-half_side, y, -half_side],
    ];
    rectangle(positions, [0.0, 1.0, 0.0])
}

fn rectangle(positions: Vec<[f32; 3]>, normal: [f32; 3]) -> Mesh {
    let uvs = vec![[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]];
    Mesh::from_indexed(positions, vec![normal; 4], uvs, vec![[0, 1, 2], [0, 2, 3]]).expect("expected a valid mesh")
}

/// A camera at z = 10 with the origin at the center of the image. `size` is the side of the image in pixels. The focal
/// length is 100 pixels, so a unit in the plane z = 0, at distance 10, is ten pixels long.
pub(super) fn front_camera(size: u32) -> Camera {
    let center = f64::from(size) / 2.0;
    Camera {
        view: View::LookAt { eye: [0.0, 0.0, 10.0], target: [0.0; 3], up: [0.0, 1.0, 0.0] },
        lens: Lens::Intrinsics { fx: 100.0, fy: 100.0, cx: center, cy: center },
        // Clip planes of 0 are fitted to the bounds of the frame.
        near: 0.0,
        far: 0.0,
    }
}

pub(super) fn open_renderer() -> Renderer {
    Renderer::open(DevicePreference::Any)
        .expect("expected EGL with OpenGL 4.3 (libegl1, libegl-mesa0, libgl1-mesa-dri)")
}

/// Renders the scene at rest to a square image.
pub(super) fn render_square(renderer: &mut Renderer, scene: &Arc<Scene>, camera: Camera, size: u32) -> RenderedFrame {
    render_sized(renderer, scene, camera, [size, size])
}

/// Renders the scene at rest to an image of width x height pixels.
pub(super) fn render_sized(
    renderer: &mut Renderer,
    scene: &Arc<Scene>,
    camera: Camera,
    size: [u32; 2],
) -> RenderedFrame {
    render_surface(renderer, scene, camera, size, |_| ())
}

/// As [`render_sized`], with this normal at every corner.
pub(super) fn render_with_normals(
    renderer: &mut Renderer,
    scene: &Arc<Scene>,
    camera: Camera,
    size: [u32; 2],
    normal: [f32; 3],
) -> RenderedFrame {
    render_surface(renderer, scene, camera, size, |surface| surface.normals.as_chunks_mut().0.fill(normal))
}

/// Renders the scene at rest with a changed surface.
fn render_surface(
    renderer: &mut Renderer,
    scene: &Arc<Scene>,
    camera: Camera,
    [width, height]: [u32; 2],
    change: impl FnOnce(&mut DeformedSurface),
) -> RenderedFrame {
    // The bounds along the axes of the light are the bounds in light space, to which the shadow map is fitted.
    let mut deformer = ReferenceDeformer::new(scene).with_bounding_axes(scene.light_axes());
    let DeformSummary { bounds, oriented_bounds: light_bounds, .. } =
        deformer.deform(&SceneState::rest(scene)).expect("expected the step to succeed");
    let buffers = renderer.load(scene).expect("expected the scene to load");
    let mut surface = deformer.surface().expect("expected a surface").clone();
    change(&mut surface);
    renderer.upload(&buffers, &surface).expect("expected the upload to succeed");
    let params = FrameParams { camera, width, height, bounds, light_bounds, edges: None, samples: None };
    let image = renderer.draw(&buffers, &params).expect("expected a frame");
    let (stats, allocations) = (renderer.stats().clone(), buffers.allocations());
    renderer.unload(buffers);
    RenderedFrame { image, stats, allocations }
}

/// Renders the scene at rest to 64 x 64 pixels of [`front_camera`].
pub(super) fn render(scene: &Arc<Scene>) -> RenderedFrame {
    render_square(&mut open_renderer(), scene, front_camera(64), 64)
}

impl RenderedFrame {
    /// Red, green and blue of a pixel; (0, 0) is the top left.
    pub(super) fn pixel(&self, x: u32, y: u32) -> [u8; 3] {
        let offset = 4 * (y * self.image.width + x) as usize;
        let [r, g, b, a] = [0, 1, 2, 3].map(|channel| self.image.rgba[offset + channel]);
        assert_eq!(a, 255, "expected an opaque pixel");
        [r, g, b]
    }

    /// Number of pixels that satisfy a predicate.
    pub(super) fn count_pixels(&self, predicate: impl Fn([u8; 3]) -> bool) -> usize {
        (0..self.image.height)
            .flat_map(|y| (0..self.image.width).map(move |x| (x, y)))
            .filter(|(x, y)| predicate(self.pixel(*x, *y)))
            .count()
    }
}

/// The sRGB level of a linear value (IEC 61966-2-1), from 0 to 255 and not rounded.
pub(super) fn encode_srgb(linear: f64) -> f64 {
    let linear = linear.clamp(0.0, 1.0);
    255.0 * if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

/// The linear value of an sRGB level, from 0 to 1.
pub(super) fn decode_srgb(level: u8) -> f64 {
    let encoded = f64::from(level) / 255.0;
    if encoded <= 0.040_45 { encoded / 12.92 } else { ((encoded + 0.055) / 1.055).powf(2.4) }
}

/// Whether each channel of a pixel is within `tolerance` sRGB levels of a linear color.
pub(super) fn is_close(pixel: [u8; 3], linear: [f64; 3], tolerance: f64) -> bool {
    pixel.iter().zip(linear).all(|(byte, value)| (f64::from(*byte) - encode_srgb(value)).abs() <= tolerance)
}
