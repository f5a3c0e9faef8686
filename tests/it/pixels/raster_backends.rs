//! Frames drawn by a compute rasterizer instead of OpenGL. The compute rasterizer of these tests is the reference
//! rasterizer; the renderer reports every compute rasterizer as [`RasterBackend::Cuda`]. Images equal those of OpenGL
//! up to a few samples on edges, and each frame reports the rasterizer that drew it.

use std::cell::Cell;
use std::ops::Range;
use std::rc::Rc;
use std::sync::Arc;

use glow::HasContext as _;
use modalcast_compute::reference::ReferenceDeformer;
use modalcast_compute::reference::raster::VisibilityBuffer;
use modalcast_model::deform::Deformer as _;
use modalcast_model::domain::{AlphaMode, Material};
use modalcast_model::error::{Error, Result, invalid};
use modalcast_model::memory::{MemoryBudget, MemoryKind};
use modalcast_model::raster::{DrawTarget, GlBuffer, RasterGeometry, Rasterizer};
use modalcast_model::scene::{Camera, CullMode, DrawRange, Lens, Scene, SceneState, ShadowSettings, View, Viewport};
use modalcast_render::{
    BlurMethod, FrameImage, FrameParams, FrameStats, Pass, RasterBackend, RasterBackends, Renderer, SceneBuffers,
    VisibilityId,
};
use nalgebra::{Matrix4, Vector3};

use super::harness::{SceneBuilder, facing_rectangle, floor_mesh, open_renderer};
use super::shadow_layers::LayerScene;

/// The reference rasterizer. It reads and writes buffers of the current OpenGL context.
struct ReferenceRasterizer {
    mesh: RasterGeometry,
    gl: glow::Context,
    /// Shift of all geometry along x in normalized device coordinates, for negative controls.
    x_offset: f64,
}

impl std::fmt::Debug for ReferenceRasterizer {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        out.write_str("ReferenceRasterizer")
    }
}

impl ReferenceRasterizer {
    fn new(mesh: RasterGeometry, x_offset: f64) -> Self {
        // SAFETY: loading runs the initializers of libEGL. They have run already, because the renderer of this test has
        // loaded the library.
        let egl =
            unsafe { khronos_egl::DynamicInstance::<khronos_egl::EGL1_4>::load_required() }.expect("expected libEGL");
        let address = |name: &str| egl.get_proc_address(name).map_or(std::ptr::null(), |function| function as *const _);
        // SAFETY: a context is current on this thread while its scene is loaded, and `address` returns the functions of
        // that context.
        let gl = unsafe { glow::Context::from_loader_function(address) };
        Self { mesh, gl, x_offset }
    }

    /// Reads the deformed positions from their OpenGL buffer.
    fn positions(&self) -> Vec<f32> {
        let GlBuffer { name, bytes, .. } = self.mesh.positions;
        let mut positions = vec![0_f32; bytes as usize / 4];
        // SAFETY: the buffer belongs to the current context, and `positions` has the size of the buffer.
        unsafe {
            self.gl.bind_buffer(glow::COPY_READ_BUFFER, Some(native_buffer(name)));
            self.gl.get_buffer_sub_data(glow::COPY_READ_BUFFER, 0, bytemuck::cast_slice_mut(&mut positions));
        }
        positions
    }

    fn rasterize(&self, viewport: &Viewport, groups: &[DrawRange]) -> VisibilityBuffer {
        let [width, height] = viewport.size();
        let clip = Matrix4::from_row_slice(&viewport.clip_from_positions().map(f64::from));
        let clip = Matrix4::new_translation(&Vector3::new(self.x_offset, 0.0, 0.0)) * clip;
        let mut buffer = VisibilityBuffer::new(Viewport::new(&clip, width, height).expect("expected a valid viewport"));
        groups.iter().for_each(|group| buffer.draw(&self.positions(), &self.mesh.triangles, *group));
        buffer
    }

    fn write(&self, target: &GlBuffer, bytes: &[u8]) -> Result<()> {
        if (bytes.len() as u64) > target.bytes {
            return Err(invalid("raster.buffer", format!("{} bytes", bytes.len()), target.bytes));
        }
        // SAFETY: the buffer belongs to the current context and has at least `bytes.len()` bytes, as checked above.
        unsafe {
            self.gl.bind_buffer(glow::COPY_WRITE_BUFFER, Some(native_buffer(target.name)));
            self.gl.buffer_sub_data_u8_slice(glow::COPY_WRITE_BUFFER, 0, bytes);
        }
        Ok(())
    }
}

impl Rasterizer for ReferenceRasterizer {
    fn precompile(&mut self, _depth: bool, _ids: bool) -> Result<()> {
        Ok(())
    }

    /// Draws all triangles up to the end of the range, so that it need not read the samples of earlier ranges.
    fn draw(&mut self, depth: Option<DrawTarget<'_>>, ids: Option<DrawTarget<'_>>, range: Range<u32>) -> Result<()> {
        if let Some((viewport, target)) = depth {
            let triangle_count = (self.mesh.triangles.len() as u32).min(range.end);
            let triangles = DrawRange { first_triangle: 0, triangle_count, cull_mode: CullMode::None };
            self.write(target, bytemuck::cast_slice(&self.rasterize(viewport, &[triangles]).depths()))?;
        }
        let Some((viewport, target)) = ids else { return Ok(()) };
        let cut_group = |group: &DrawRange| DrawRange {
            triangle_count: group.triangle_count.min(range.end.saturating_sub(group.first_triangle)),
            ..*group
        };
        let groups: Vec<DrawRange> = self.mesh.groups.iter().map(cut_group).collect();
        // A sample has a 64-bit key: the inverted bits of its depth above its triangle id.
        self.write(target, bytemuck::cast_slice(&self.rasterize(viewport, &groups).keys))
    }
}

fn native_buffer(name: u32) -> glow::Buffer {
    glow::NativeBuffer(std::num::NonZeroU32::new(name).expect("expected a nonzero buffer name"))
}

/// The rasterizer that a scene uses.
#[derive(Clone, Copy, PartialEq)]
enum Backend {
    OpenGl,
    /// The compute rasterizer, with all geometry shifted along x by this amount in normalized device coordinates.
    Compute(f64),
}

struct DrawnFrame {
    image: FrameImage,
    /// Id of the first sample of each pixel.
    ids: Vec<VisibilityId>,
    stats: FrameStats,
    /// Names of the scene's buffers.
    allocations: Vec<String>,
}

/// Width and height of a frame in pixels.
const SIZE: [u32; 2] = [192, 128];

fn draw_frame(scene: &Arc<Scene>, camera: Camera, backend: Backend) -> DrawnFrame {
    draw_frame_with(&mut open_renderer(), scene, camera, backend)
}

fn draw_frame_with(renderer: &mut Renderer, scene: &Arc<Scene>, camera: Camera, backend: Backend) -> DrawnFrame {
    let mut deformer = ReferenceDeformer::new(scene);
    let bounds = deformer.deform(&SceneState::rest(scene)).expect("expected the step to succeed").bounds;
    let mut buffers = renderer.load(scene).expect("expected the scene to load");
    renderer.upload(&buffers, deformer.surface().expect("expected a surface")).expect("expected the upload to succeed");
    attach_backend(renderer, &mut buffers, backend);
    let [width, height] = SIZE;
    let image = renderer
        .draw(&buffers, &FrameParams { camera, width, height, bounds, light_bounds: None, edges: None, samples: None })
        .expect("expected a frame");
    let (ids, stats) = (renderer.read_visibility().expect("expected visibility ids"), renderer.stats().clone());
    let allocations = buffers.allocations().into_iter().map(|allocation| allocation.name).collect();
    DrawnFrame { image, ids, stats, allocations }
}

/// Makes the scene of `buffers` use `backend`.
fn attach_backend(renderer: &mut Renderer, buffers: &mut SceneBuffers, backend: Backend) {
    if let Backend::Compute(x_offset) = backend {
        let create_rasterizer =
            |mesh: RasterGeometry| Ok(Box::new(ReferenceRasterizer::new(mesh, x_offset)) as Box<dyn Rasterizer>);
        renderer.attach_rasterizer(buffers, create_rasterizer).expect("expected a rasterizer");
    }
}

/// Domain 0 is a wall, domain 1 a floating horizontal square, and domain 2 a square in the plane of the ground.
fn yard_builder(shadow: Option<ShadowSettings>, samples: u32) -> SceneBuilder {
    let mut builder = SceneBuilder::new();
    let defaults = modalcast_model::scene::RenderSettings::default();
    (builder.parts.look.ground, builder.parts.look.horizon) = (defaults.ground, defaults.horizon);
    (builder.parts.look.sun, builder.parts.look.shadow, builder.parts.look.samples) =
        ([1.0, 3.0, 2.0], shadow, samples);
    let double_sided = || Material { double_sided: true, ..Material::default() };
    let wall = facing_rectangle(-1.0, 0.0, 0.2, 1.1, -0.4);
    builder
        .add_domain(wall, double_sided())
        .add_domain(floor_mesh(0.45, 0.7), Material::default())
        .add_domain(floor_mesh(0.3, 0.0), double_sided())
}

fn default_camera() -> Camera {
    let view = View::LookAt { eye: [1.4, 1.9, 4.0], target: [0.0, 0.2, 0.0], up: [0.0, 1.0, 0.0] };
    Camera { view, lens: Lens::FieldOfView(38.0), near: 0.1, far: 60.0 }
}

/// Number of positions at which two slices of equal length differ.
fn count_differences<T: PartialEq>(left: &[T], right: &[T]) -> usize {
    left.iter().zip(right).filter(|(left, right)| left != right).count()
}

/// Number of bytes that differ by more than four levels.
fn count_different_bytes(left: &FrameImage, right: &FrameImage) -> usize {
    left.rgba.iter().zip(&right.rgba).filter(|(left, right)| left.abs_diff(**right) > 4).count()
}

/// Compares frames with ground and shadow, for every blur method.
#[test]
fn compute_rasterized_frame_equals_opengl() {
    for blur_method in [BlurMethod::Tiles, BlurMethod::Rows, BlurMethod::Fragments] {
        let shadow = ShadowSettings { size: 256, ..ShadowSettings::default() };
        let scene = yard_builder(Some(shadow), 1).build();
        let draw_frame = |backend| {
            let mut renderer = open_renderer();
            renderer.set_blur_method(blur_method);
            draw_frame_with(&mut renderer, &scene, default_camera(), backend)
        };
        let opengl_frame = draw_frame(Backend::OpenGl);
        let compute_frame = draw_frame(Backend::Compute(0.0));
        let cuda = Some(RasterBackend::Cuda);
        assert_eq!(compute_frame.stats.raster_backends, RasterBackends { shadow: cuda, visibility: cuda });
        assert_eq!(
            opengl_frame.stats.raster_backends,
            RasterBackends { shadow: Some(RasterBackend::OpenGl), visibility: Some(RasterBackend::OpenGl) }
        );
        // `RasterShadow` draws the shadow depths and the visibility keys. `Unpack` converts the keys to visibility ids.
        assert_eq!(compute_frame.stats.passes[..3], [Pass::RasterShadow, Pass::Blur, Pass::Unpack]);
        assert!(compute_frame.allocations.iter().any(|name| name == "raster shadow depths"));
        assert!(
            !opengl_frame
                .allocations
                .iter()
                .any(|name| name == "raster visibility keys" || name == "raster shadow depths"),
            "expected no allocations for the compute rasterizer"
        );
        let count_ids =
            |predicate: fn(&VisibilityId) -> bool| opengl_frame.ids.iter().filter(|id| predicate(id)).count();
        assert!(
            count_ids(|id| *id == VisibilityId::Ground) > 5000
                && count_ids(|id| matches!(id, VisibilityId::Triangle(_))) > 2000
        );
        // Only samples on edges may differ: a few of 192 x 128 pixels with one sample each.
        let (different_ids, different_bytes) = (
            count_differences(&compute_frame.ids, &opengl_frame.ids),
            count_different_bytes(&compute_frame.image, &opengl_frame.image),
        );
        assert!(
            different_ids <= 12 && different_bytes <= 60,
            "{blur_method:?}: {different_ids} ids, {different_bytes} bytes differ"
        );
        // The image is 2 wide in normalized device coordinates, so that a shift by 0.02 is 0.02 / 2 * 192 = 1.92
        // pixels.
        let shifted_frame = draw_frame(Backend::Compute(0.02));
        let (different_ids, different_bytes) = (
            count_differences(&shifted_frame.ids, &opengl_frame.ids),
            count_different_bytes(&shifted_frame.image, &opengl_frame.image),
        );
        assert!(
            different_ids > 100 && different_bytes > 300,
            "negative control: shifted by two pixels, {different_ids} ids and {different_bytes} bytes differ"
        );
    }
}

/// Pixels that the moments do not decide filter the compute rasterizer's depth, which the blur copies.
#[test]
fn overlapping_layers_equal_opengl_for_every_blur_method() {
    for blur_method in [BlurMethod::Tiles, BlurMethod::Rows, BlurMethod::Fragments] {
        let draw_frame = |backend, pcf_fallback| {
            let mut renderer = open_renderer();
            renderer.set_blur_method(blur_method);
            let layers = LayerScene::roof_and_slab().with_shadow(|shadow| ShadowSettings { pcf_fallback, ..shadow });
            draw_frame_with(&mut renderer, &layers.build(), layers.camera(SIZE[1]), backend)
        };
        let compute_frame = draw_frame(Backend::Compute(0.0), true);
        assert!(compute_frame.allocations.iter().any(|name| name == "shadow depth, copied"));
        let moments_only = draw_frame(Backend::Compute(0.0), false);
        assert!(!moments_only.allocations.iter().any(|name| name == "shadow depth, copied"));
        for (compute, pcf_fallback) in [(&compute_frame, true), (&moments_only, false)] {
            let opengl = draw_frame(Backend::OpenGl, pcf_fallback);
            let different_bytes = count_different_bytes(&compute.image, &opengl.image);
            assert!(different_bytes <= 60, "{blur_method:?}, fallback {pcf_fallback}: {different_bytes} bytes differ");
        }
        let different_bytes = count_different_bytes(&compute_frame.image, &moments_only.image);
        assert!(different_bytes > 300, "negative control: expected leaked light, {different_bytes} bytes differ");
    }
}

/// The depths of the shadow map and the keys of the frame count against the budget of render targets.
#[test]
fn compute_rasterizer_without_memory_leaves_its_passes_to_opengl() {
    let shadow = ShadowSettings { size: 256, ..ShadowSettings::default() };
    let scene = yard_builder(Some(shadow), 1).build();
    // Depths, their copy, and keys.
    let output_bytes = 2 * 4 * 256 * 256 + 8 * u64::from(SIZE[0] * SIZE[1]);
    // The frame, and the bytes that are reserved after its scene is unloaded, which are those of the target.
    let draw = |backend, bytes: u64| {
        let budget = MemoryBudget::new(MemoryKind::RenderTargets, bytes, bytes);
        let mut renderer = open_renderer();
        renderer.set_target_budget(Arc::clone(&budget));
        let frame = draw_frame_with(&mut renderer, &scene, default_camera(), backend);
        (frame, budget.reserved())
    };
    let (opengl_frame, target_bytes) = draw(Backend::OpenGl, u64::MAX);
    let (exact_frame, reserved_bytes) = draw(Backend::Compute(0.0), target_bytes + output_bytes);
    assert_eq!(exact_frame.stats.raster_backends.visibility, Some(RasterBackend::Cuda));
    assert_eq!(reserved_bytes, target_bytes);
    let (frame, _) = draw(Backend::Compute(0.0), target_bytes + output_bytes - 1);
    assert_eq!(frame.stats.raster_backends, opengl_frame.stats.raster_backends);
    assert!(frame.image.rgba == opengl_frame.image.rgba);
}

/// Frames of both rasterizers alternate on one render target. Each equals the frame of a new renderer.
#[test]
fn opengl_and_compute_frames_share_a_target() {
    let mut builder = yard_builder(None, 1);
    builder.parts.look.ground = None;
    let scene = builder.build();
    let camera_at = |x: f64| {
        let view = View::LookAt { eye: [x, 6.0, 12.0], target: [x, 0.0, 0.0], up: [0.0, 1.0, 0.0] };
        Camera { view, ..default_camera() }
    };
    let mut deformer = ReferenceDeformer::new(&scene);
    let bounds = deformer.deform(&SceneState::rest(&scene)).expect("expected the step to succeed").bounds;
    let mut renderer = open_renderer();
    let scene_buffers = [Backend::OpenGl, Backend::Compute(0.0)].map(|backend| {
        let mut buffers = renderer.load(&scene).expect("expected the scene to load");
        renderer
            .upload(&buffers, deformer.surface().expect("expected a surface"))
            .expect("expected the upload to succeed");
        attach_backend(&mut renderer, &mut buffers, backend);
        buffers
    });
    let [width, height] = SIZE;
    for (frame_index, x) in [-2.5, 2.5, 0.0, 1.0, -1.0].into_iter().enumerate() {
        let params =
            FrameParams { camera: camera_at(x), width, height, bounds, light_bounds: None, edges: None, samples: None };
        let image = renderer.draw(&scene_buffers[frame_index % 2], &params).expect("expected a frame");
        let expected = draw_frame(
            &scene,
            camera_at(x),
            if frame_index % 2 == 0 { Backend::OpenGl } else { Backend::Compute(0.0) },
        );
        assert_eq!(image.info.raster_backends, expected.stats.raster_backends);
        assert!(image.rgba == expected.image.rgba, "frame {frame_index}");
        let triangle_pixels = expected.ids.iter().filter(|id| matches!(id, VisibilityId::Triangle(_))).count();
        assert!(
            (200..12_000).contains(&triangle_pixels),
            "expected 200 to 12000 pixels of triangles, got {triangle_pixels}"
        );
    }
}

#[test]
fn ground_hides_no_geometry_with_any_rasterizer() {
    let scene = yard_builder(None, 1).build();
    // Domain of each pixel, with the wall and the floating square lowered by `lowering`.
    let visible_domains = |backend: Backend, lowering: f32| {
        let (mut renderer, mut deformer) = (open_renderer(), ReferenceDeformer::new(&scene));
        let mut state = SceneState::rest(&scene);
        for domain in 0..2 {
            state.transforms[domain].0[7] -= lowering; // y of the translation
        }
        let bounds = deformer.deform(&state).expect("expected the step to succeed").bounds;
        let mut buffers = renderer.load(&scene).expect("expected the scene to load");
        renderer
            .upload(&buffers, deformer.surface().expect("expected a surface"))
            .expect("expected the upload to succeed");
        attach_backend(&mut renderer, &mut buffers, backend);
        let [width, height] = SIZE;
        renderer
            .draw(
                &buffers,
                &FrameParams {
                    camera: default_camera(),
                    width,
                    height,
                    bounds,
                    light_bounds: None,
                    edges: None,
                    samples: None,
                },
            )
            .expect("expected a frame");
        let domain = |id: &VisibilityId| match id {
            VisibilityId::Triangle(index) => buffers.source_triangle(*index).map(|(domain, _)| domain),
            _ => None,
        };
        let ids = renderer.read_visibility().expect("expected visibility ids");
        ids.iter().map(domain).collect::<Vec<Option<usize>>>()
    };
    let count =
        |domains: &[Option<usize>], domain: usize| domains.iter().filter(|visible| **visible == Some(domain)).count();
    // A lowering of 0.8 puts the floating square, at height 0.7, below the ground.
    let (above_ground, opengl_domains, compute_domains) = (
        visible_domains(Backend::OpenGl, 0.0),
        visible_domains(Backend::OpenGl, 0.8),
        visible_domains(Backend::Compute(0.0), 0.8),
    );
    assert!(
        count_differences(&compute_domains, &opengl_domains) <= 8,
        "expected at most 8 different samples on edges, got {}",
        count_differences(&compute_domains, &opengl_domains)
    );
    // A pixel below the ground plane still shows the wall or the floating square.
    let counts = |domain: usize| [&above_ground, &opengl_domains, &compute_domains].map(|ids| count(ids, domain));
    for domain in 0..2 {
        let [above, opengl, compute] = counts(domain);
        assert!(above > 100 && 2 * opengl.min(compute) > above, "domain {domain}: {:?} pixels", counts(domain));
    }
    assert!(count_differences(&above_ground, &opengl_domains) > 100, "control: expected the geometry to move");
    let in_plane_counts = [count(&above_ground, 2), count(&opengl_domains, 2), count(&compute_domains, 2)];
    assert!(
        in_plane_counts[0] > 100 && in_plane_counts == [in_plane_counts[0]; 3],
        "expected a visible square in the plane of the ground, got {in_plane_counts:?}"
    );
}

#[test]
fn opengl_draws_frames_that_compute_does_not_support() {
    // The rasterizers of a scene with a compute rasterizer attached.
    let raster_backends = |builder: SceneBuilder| {
        draw_frame(&builder.build(), default_camera(), Backend::Compute(0.0)).stats.raster_backends
    };
    let (opengl, cuda) = (Some(RasterBackend::OpenGl), Some(RasterBackend::Cuda));
    let base = ShadowSettings { size: 128, ..ShadowSettings::default() };
    assert_eq!(
        raster_backends(yard_builder(Some(base), 4)),
        RasterBackends { shadow: cuda, visibility: opengl },
        "four samples per pixel"
    );
    let cascades = ShadowSettings { cascades: 2, ..base };
    assert_eq!(raster_backends(yard_builder(Some(cascades), 1)), RasterBackends { shadow: opengl, visibility: cuda });
    let standard = ShadowSettings { method: modalcast_model::scene::ShadowMethod::Standard, ..base };
    assert_eq!(raster_backends(yard_builder(Some(standard), 1)), RasterBackends { shadow: opengl, visibility: cuda });
    assert_eq!(raster_backends(yard_builder(None, 1)), RasterBackends { shadow: None, visibility: cuda });
    let glass = Material { alpha_mode: AlphaMode::Blend, alpha: 0.4, ..Material::default() };
    let blended = yard_builder(None, 1).add_domain(facing_rectangle(0.0, 0.0, 0.5, 0.5, 0.5), glass);
    assert_eq!(raster_backends(blended), RasterBackends { shadow: None, visibility: opengl });
    assert_eq!(
        raster_backends(yard_builder(None, 4)),
        RasterBackends { shadow: None, visibility: opengl },
        "four samples per pixel and no shadow"
    );
}

/// Frames of one step share its shadow. Rebased positions are relative to an origin of their own. `upload_rebased`
/// gives them to OpenGL only, so OpenGL draws the scene until `set_shared_origin`. Then both rasterizers use the
/// positions that they share.
#[test]
fn cameras_share_the_shadow_and_rebased_scenes_use_opengl() {
    let scene = yard_builder(Some(ShadowSettings { size: 256, ..ShadowSettings::default() }), 1).build();
    let (mut renderer, mut deformer) =
        (open_renderer(), ReferenceDeformer::new(&scene).with_bounding_axes(scene.light_axes()));
    let summary = deformer.deform(&SceneState::rest(&scene)).expect("expected the step to succeed");
    let mut buffers = renderer.load(&scene).expect("expected the scene to load");
    renderer.upload(&buffers, deformer.surface().expect("expected a surface")).expect("expected the upload to succeed");
    attach_backend(&mut renderer, &mut buffers, Backend::Compute(0.0));
    let create_params = |eye: [f64; 3]| {
        let view = View::LookAt { eye, target: [0.0, 0.2, 0.0], up: [0.0, 1.0, 0.0] };
        let camera = Camera { view, ..default_camera() };
        FrameParams {
            camera,
            width: SIZE[0],
            height: SIZE[1],
            bounds: summary.bounds,
            light_bounds: summary.oriented_bounds,
            edges: None,
            samples: None,
        }
    };
    let (first_params, second_params) = (create_params([1.4, 1.9, 4.0]), create_params([-2.0, 1.2, 3.0]));
    let unshared_image = renderer.draw(&buffers, &second_params).expect("expected a frame");
    // From here on, all frames are of step 7.
    buffers.set_step(7);
    let draw = |renderer: &mut Renderer, buffers: &SceneBuffers, params: &FrameParams| {
        let image = renderer.draw(buffers, params).expect("expected a frame");
        let first_passes = renderer.stats().passes[..2].to_vec();
        (image, first_passes)
    };
    assert_eq!(draw(&mut renderer, &buffers, &first_params).1, [Pass::RasterShadow, Pass::Blur]);
    let (shared_image, passes) = draw(&mut renderer, &buffers, &second_params);
    assert_eq!(passes, [Pass::RasterVisibility, Pass::Unpack], "expected no second shadow pass");
    assert_eq!(
        shared_image.info.raster_backends,
        RasterBackends { shadow: None, visibility: Some(RasterBackend::Cuda) }
    );
    assert!(shared_image.rgba == unshared_image.rgba, "expected the same image with a shared shadow");
    let positions = deformer.surface().expect("expected a surface").positions.clone();
    renderer.upload_rebased(&mut buffers, &positions, [0.0; 3]).expect("expected the upload to succeed");
    let (rebased_image, passes) = draw(&mut renderer, &buffers, &second_params);
    assert_eq!(
        (passes[0], rebased_image.info.raster_backends.visibility),
        (Pass::Shadow, Some(RasterBackend::OpenGl)),
        "expected OpenGL for rebased positions"
    );
    assert!(
        count_different_bytes(&rebased_image, &unshared_image) <= 60,
        "{}",
        count_different_bytes(&rebased_image, &unshared_image)
    );
    buffers.set_shared_origin([0.0; 3]);
    let (restored_image, _) = draw(&mut renderer, &buffers, &second_params);
    assert_eq!(restored_image.info.raster_backends.visibility, Some(RasterBackend::Cuda));
    assert!(restored_image.rgba == unshared_image.rgba, "expected the same image as before `upload_rebased`");
}

/// The compute rasterizer draws one sample per pixel, so OpenGL draws the visibility of a frame that asks for four.
#[test]
fn opengl_draws_frames_that_ask_for_more_samples_than_their_scene() {
    let scene = yard_builder(Some(ShadowSettings { size: 128, ..ShadowSettings::default() }), 1).build();
    let draw = |backend: Backend, samples: Option<u32>| {
        let (mut renderer, mut deformer) = (open_renderer(), ReferenceDeformer::new(&scene));
        let bounds = deformer.deform(&SceneState::rest(&scene)).expect("expected the step to succeed").bounds;
        let mut buffers = renderer.load(&scene).expect("expected the scene to load");
        let surface = deformer.surface().expect("expected a surface");
        renderer.upload(&buffers, surface).expect("expected the upload to succeed");
        attach_backend(&mut renderer, &mut buffers, backend);
        let [width, height] = SIZE;
        let camera = default_camera();
        let params = FrameParams { camera, width, height, bounds, light_bounds: None, edges: None, samples };
        renderer.draw(&buffers, &params).expect("expected a frame")
    };
    let [one, four] = [None, Some(4)].map(|samples| draw(Backend::Compute(0.0), samples));
    assert_eq!(one.info.raster_backends.visibility, Some(RasterBackend::Cuda));
    let (cuda, opengl) = (Some(RasterBackend::Cuda), Some(RasterBackend::OpenGl));
    assert_eq!(four.info.raster_backends, RasterBackends { shadow: cuda, visibility: opengl });
    let want = draw(Backend::OpenGl, Some(4));
    assert!(count_different_bytes(&four, &want) <= 60, "{}", count_different_bytes(&four, &want));
    assert!(count_different_bytes(&one, &want) > 60, "control: expected another image with one sample");
}

/// A rasterizer whose draw calls return the result of `failure`.
#[derive(Debug)]
struct FailingRasterizer {
    failure: fn() -> Result<()>,
    draw_calls: Rc<Cell<u32>>,
}

impl Rasterizer for FailingRasterizer {
    fn precompile(&mut self, _depth: bool, _ids: bool) -> Result<()> {
        Ok(())
    }

    fn draw(&mut self, _depth: Option<DrawTarget<'_>>, _ids: Option<DrawTarget<'_>>, _range: Range<u32>) -> Result<()> {
        self.draw_calls.set(self.draw_calls.get() + 1);
        (self.failure)()
    }
}

/// Draws `frame_count` frames of a scene with a [`FailingRasterizer`]. Returns the frames and the number of the
/// rasterizer's draw calls.
fn draw_with_failing_rasterizer(
    scene: &Arc<Scene>,
    failure: fn() -> Result<()>,
    frame_count: usize,
) -> (Vec<Result<FrameImage>>, u32) {
    let (mut renderer, mut deformer) = (open_renderer(), ReferenceDeformer::new(scene));
    let summary = deformer.deform(&SceneState::rest(scene)).expect("expected the step to succeed");
    let mut buffers = renderer.load(scene).expect("expected the scene to load");
    renderer.upload(&buffers, deformer.surface().expect("expected a surface")).expect("expected the upload to succeed");
    let draw_calls = Rc::new(Cell::new(0));
    let rasterizer = FailingRasterizer { failure, draw_calls: Rc::clone(&draw_calls) };
    renderer
        .attach_rasterizer(&mut buffers, |_| Ok(Box::new(rasterizer) as Box<dyn Rasterizer>))
        .expect("expected a rasterizer");
    let [width, height] = SIZE;
    let params = FrameParams {
        camera: default_camera(),
        width,
        height,
        bounds: summary.bounds,
        light_bounds: None,
        edges: None,
        samples: None,
    };
    let frames = (0..frame_count).map(|_| renderer.draw(&buffers, &params)).collect();
    (frames, draw_calls.get())
}

/// OpenGL draws the frame in which the rasterizer fails or panics, and all later frames.
#[test]
fn failing_rasterizer_falls_back_to_opengl() {
    let scene = yard_builder(Some(ShadowSettings { size: 128, ..ShadowSettings::default() }), 1).build();
    let opengl_frame = draw_frame(&scene, default_camera(), Backend::OpenGl);
    let failures: [fn() -> Result<()>; 2] = [|| Err(invalid("raster", "a device", "none")), || panic!("injected")];
    for failure in failures {
        let (frames, draw_calls) = draw_with_failing_rasterizer(&scene, failure, 2);
        assert_eq!(draw_calls, 1, "expected a disabled rasterizer after the first draw call");
        for frame in frames {
            let image = frame.expect("expected a frame");
            assert_eq!(image.info.raster_backends, opengl_frame.stats.raster_backends);
            assert!(image.rgba == opengl_frame.image.rgba);
        }
    }
}

/// The loss of a device is reported as an error, so that the server closes the scenes of the device. OpenGL does not
/// draw the frame instead.
#[test]
fn rasterizer_on_a_lost_device_fails_the_frame() {
    let scene = yard_builder(None, 1).build();
    let loss = || Err(Error::DeviceLost { stage: "rasterize", reason: "injected".into() });
    let (frames, _) = draw_with_failing_rasterizer(&scene, loss, 1);
    assert!(
        matches!(frames[0], Err(Error::DeviceLost { .. })),
        "expected the loss, got {:?}",
        frames[0].as_ref().err()
    );
}

/// A rasterizer whose compilation fails.
#[derive(Debug)]
struct UncompiledRasterizer {
    /// Whether the renderer requested the pipelines for shadow depths and for ids.
    requested_pipelines: Rc<Cell<[bool; 2]>>,
}

impl Rasterizer for UncompiledRasterizer {
    fn precompile(&mut self, depth: bool, ids: bool) -> Result<()> {
        self.requested_pipelines.set([depth, ids]);
        Err(invalid("raster", "a compiler", "none"))
    }

    fn draw(&mut self, _depth: Option<DrawTarget<'_>>, _ids: Option<DrawTarget<'_>>, _range: Range<u32>) -> Result<()> {
        panic!("expected no draw call after a failed compilation");
    }
}

/// Only the pipelines that the scene can use are compiled. OpenGL draws the scene if compilation fails.
#[test]
fn rasterizer_is_compiled_when_the_scene_is_loaded() {
    let shadow = Some(ShadowSettings { size: 128, ..ShadowSettings::default() });
    // Pipelines for shadow depths and for ids. Ids need one sample per pixel.
    for (shadow, samples, expected_pipelines) in
        [(shadow, 1, [true; 2]), (shadow, 4, [true, false]), (None, 1, [false, true])]
    {
        let scene = yard_builder(shadow, samples).build();
        let (mut renderer, mut deformer) = (open_renderer(), ReferenceDeformer::new(&scene));
        let summary = deformer.deform(&SceneState::rest(&scene)).expect("expected the step to succeed");
        let mut buffers = renderer.load(&scene).expect("expected the scene to load");
        renderer
            .upload(&buffers, deformer.surface().expect("expected a surface"))
            .expect("expected the upload to succeed");
        let requested_pipelines = Rc::default();
        let rasterizer = UncompiledRasterizer { requested_pipelines: Rc::clone(&requested_pipelines) };
        let result = renderer.attach_rasterizer(&mut buffers, |_| Ok(Box::new(rasterizer) as Box<dyn Rasterizer>));
        assert!(
            result.is_err() && requested_pipelines.get() == expected_pipelines,
            "expected {expected_pipelines:?}, got {:?}",
            requested_pipelines.get()
        );
        let [width, height] = SIZE;
        let params = FrameParams {
            camera: default_camera(),
            width,
            height,
            bounds: summary.bounds,
            light_bounds: None,
            edges: None,
            samples: None,
        };
        let raster_backends = renderer.draw(&buffers, &params).expect("expected a frame").info.raster_backends;
        assert_eq!(raster_backends.visibility, Some(RasterBackend::OpenGl));
    }
}
