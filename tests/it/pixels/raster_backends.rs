//! Frames drawn by the compute rasterizer instead of OpenGL, with the reference rasterizer in its place. Their pictures
//! equal those of OpenGL up to a few samples on edges, and each frame reports the path that drew it.

use std::sync::Arc;

use glow::HasContext as _;
use modalcast_compute::reference::ReferenceDeformer;
use modalcast_compute::reference::raster::VisibilityBuffer;
use modalcast_model::deform::Deformer as _;
use modalcast_model::domain::{AlphaMode, Material};
use modalcast_model::error::{Result, invalid};
use modalcast_model::raster::{DrawTarget, GlBuffer, RasterGeometry, Rasterizer};
use modalcast_model::scene::{Camera, CullMode, DrawRange, Lens, Scene, SceneState, ShadowSettings, View, Viewport};
use modalcast_render::{
    BlurMethod, FrameImage, FrameParams, FrameStats, RasterBackend, RasterBackends, Renderer, SceneBuffers,
    VisibilityId,
};
use nalgebra::{Matrix4, Vector3};

use super::harness::{SceneBuilder, facing_rectangle, floor_mesh, open_renderer};

/// The reference rasterizer, reading and writing buffers of the current OpenGL context.
struct ReferenceRasterizer {
    mesh: RasterGeometry,
    gl: glow::Context,
    /// Shift of everything drawn along x, in normalized device coordinates; not zero in controls.
    aside: f64,
}

impl std::fmt::Debug for ReferenceRasterizer {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        out.write_str("Plain")
    }
}

impl ReferenceRasterizer {
    fn new(mesh: RasterGeometry, aside: f64) -> Self {
        // SAFETY: loading runs the initializers of libEGL. They have run already, because the renderer of this test has
        // loaded the library.
        let egl =
            unsafe { khronos_egl::DynamicInstance::<khronos_egl::EGL1_4>::load_required() }.expect("expected libEGL");
        let address = |name: &str| egl.get_proc_address(name).map_or(std::ptr::null(), |place| place as *const _);
        // SAFETY: a context is current on this thread while its scene is loaded, and `address` returns the functions of
        // that context.
        let gl = unsafe { glow::Context::from_loader_function(address) };
        Self { mesh, gl, aside }
    }

    fn positions(&self) -> Vec<f32> {
        let GlBuffer { name, bytes, .. } = self.mesh.positions;
        let mut positions = vec![0_f32; bytes as usize / 4];
        // SAFETY: the buffer belongs to the current context, and `positions` has the size of the buffer.
        unsafe {
            self.gl.bind_buffer(glow::COPY_READ_BUFFER, Some(named(name)));
            self.gl.get_buffer_sub_data(glow::COPY_READ_BUFFER, 0, bytemuck::cast_slice_mut(&mut positions));
        }
        positions
    }

    fn drawn(&self, window: &Viewport, groups: &[DrawRange]) -> VisibilityBuffer {
        let [width, height] = window.size();
        let clip = Matrix4::from_row_slice(&window.clip().map(f64::from));
        let clip = Matrix4::new_translation(&Vector3::new(self.aside, 0.0, 0.0)) * clip;
        let mut raster = VisibilityBuffer::new(Viewport::new(&clip, width, height).expect("expected a valid viewport"));
        groups.iter().for_each(|group| raster.draw(&self.positions(), &self.mesh.triangles, *group));
        raster
    }

    fn write(&self, into: &GlBuffer, bytes: &[u8]) -> Result<()> {
        if (bytes.len() as u64) > into.bytes {
            return Err(invalid("raster.buffer", format!("{} bytes", bytes.len()), into.bytes));
        }
        // SAFETY: the buffer belongs to the current context and has at least `bytes.len()` bytes, as checked above.
        unsafe {
            self.gl.bind_buffer(glow::COPY_WRITE_BUFFER, Some(named(into.name)));
            self.gl.buffer_sub_data_u8_slice(glow::COPY_WRITE_BUFFER, 0, bytes);
        }
        Ok(())
    }
}

impl Rasterizer for ReferenceRasterizer {
    fn precompile(&mut self, _: bool, _: bool) -> Result<()> {
        Ok(())
    }

    fn draw(&mut self, depth: Option<DrawTarget<'_>>, ids: Option<DrawTarget<'_>>) -> Result<()> {
        if let Some((window, into)) = depth {
            let all = DrawRange { first: 0, triangles: self.mesh.triangles.len() as u32, faces: CullMode::None };
            self.write(into, bytemuck::cast_slice(&self.drawn(window, &[all]).depths()))?;
        }
        let Some((window, into)) = ids else { return Ok(()) };
        self.write(into, bytemuck::cast_slice(&self.drawn(window, &self.mesh.groups).keys))
    }
}

fn named(name: u32) -> glow::Buffer {
    glow::NativeBuffer(std::num::NonZeroU32::new(name).expect("expected a name"))
}

/// Rasterizer that draws a scene.
#[derive(Clone, Copy, PartialEq)]
enum Backend {
    OpenGl,
    /// The compute rasterizer, with everything shifted along x by this amount of normalized device coordinates.
    Compute(f64),
}

struct DrawnFrame {
    image: FrameImage,
    seen: Vec<VisibilityId>,
    stats: FrameStats,
    allocations: Vec<String>,
}

const SIZE: [u32; 2] = [192, 128];

fn show(scene: &Arc<Scene>, camera: Camera, by: Backend) -> DrawnFrame {
    show_with(&mut open_renderer(), scene, camera, by)
}

fn show_with(renderer: &mut Renderer, scene: &Arc<Scene>, camera: Camera, by: Backend) -> DrawnFrame {
    let mut deformer = ReferenceDeformer::new(scene);
    let bounds = deformer.deform(&SceneState::rest(scene)).expect("expected the step to succeed").bounds;
    let mut buffers = renderer.load(scene).expect("expected the scene to load");
    renderer.upload(&buffers, deformer.surface().expect("there")).expect("expected the upload to succeed");
    attach(renderer, &mut buffers, by);
    let [width, height] = SIZE;
    let image =
        renderer.draw(&buffers, &FrameParams { camera, width, height, bounds, light: None }).expect("expected a frame");
    let (seen, stats) = (renderer.read_visibility().expect("reads"), renderer.stats().clone());
    let allocations = buffers.allocations().into_iter().map(|part| part.name).collect();
    DrawnFrame { image, seen, stats, allocations }
}

fn attach(renderer: &mut Renderer, buffers: &mut SceneBuffers, by: Backend) {
    if let Backend::Compute(aside) = by {
        let make = |mesh: RasterGeometry| Ok(Box::new(ReferenceRasterizer::new(mesh, aside)) as Box<dyn Rasterizer>);
        renderer.attach_rasterizer(buffers, make).expect("given");
    }
}

/// A wall, a lid above the ground and a square in the plane of the ground, lit by a slanting sun.
fn yard(shadow: Option<ShadowSettings>, samples: u32) -> SceneBuilder {
    let mut builder = SceneBuilder::new();
    let defaults = modalcast_model::scene::RenderSettings::default();
    (builder.parts.look.ground, builder.parts.look.horizon) = (defaults.ground, defaults.horizon);
    (builder.parts.look.sun, builder.parts.look.shadow, builder.parts.look.samples) =
        ([1.0, 3.0, 2.0], shadow, samples);
    let plain = || Material { double_sided: true, ..Material::default() };
    let wall = facing_rectangle(-1.0, 0.0, 0.2, 1.1, -0.4);
    builder
        .add_domain(wall, plain())
        .add_domain(floor_mesh(0.45, 0.7), Material::default())
        .add_domain(floor_mesh(0.3, 0.0), plain())
}

fn from_above() -> Camera {
    let view = View::LookAt { eye: [1.4, 1.9, 4.0], target: [0.0, 0.2, 0.0], up: [0.0, 1.0, 0.0] };
    Camera { view, lens: Lens::FieldOfView(38.0), near: 0.1, far: 60.0 }
}

fn differing<T: PartialEq>(one: &[T], other: &[T]) -> usize {
    one.iter().zip(other).filter(|(one, other)| one != other).count()
}

/// Number of bytes that differ by more than four levels.
fn far_off(one: &FrameImage, other: &FrameImage) -> usize {
    one.rgba.iter().zip(&other.rgba).filter(|(one, other)| one.abs_diff(**other) > 4).count()
}

/// Ground and shadow included, for every way of blurring.
#[test]
fn compute_rasterized_frame_equals_opengl() {
    for blur_method in [BlurMethod::Tiles, BlurMethod::Rows, BlurMethod::Fragments] {
        let shadow = ShadowSettings { size: 256, ..ShadowSettings::default() };
        let scene = yard(Some(shadow), 1).build();
        let show = |by| {
            let mut renderer = open_renderer();
            renderer.set_blur_method(blur_method);
            show_with(&mut renderer, &scene, from_above(), by)
        };
        let want = show(Backend::OpenGl);
        let got = show(Backend::Compute(0.0));
        let cuda = Some(RasterBackend::Cuda);
        assert_eq!(got.stats.raster_backends, RasterBackends { shadow: cuda, visibility: cuda });
        assert_eq!(
            want.stats.raster_backends,
            RasterBackends { shadow: Some(RasterBackend::OpenGl), visibility: Some(RasterBackend::OpenGl) }
        );
        assert_eq!(got.stats.passes[..3], ["raster shadow", "blur", "unpack"]);
        assert!(
            !got.stats.passes.contains(&"ground") && got.allocations.iter().any(|name| name == "raster shadow depths")
        );
        assert!(
            !want.allocations.iter().any(|name| name == "raster visibility keys" || name == "raster shadow depths"),
            "costs OpenGL nothing"
        );
        let kinds = |kind: fn(&VisibilityId) -> bool| want.seen.iter().filter(|seen| kind(seen)).count();
        assert!(
            kinds(|seen| *seen == VisibilityId::Ground) > 5000
                && kinds(|seen| matches!(seen, VisibilityId::Triangle(_))) > 2000
        );
        let (ids, pixels) = (differing(&got.seen, &want.seen), far_off(&got.image, &want.image));
        assert!(ids <= 12 && pixels <= 60, "{blur_method:?}: {ids} ids, {pixels} bytes differ");
        let aside = show(Backend::Compute(0.02));
        let (ids, pixels) = (differing(&aside.seen, &want.seen), far_off(&aside.image, &want.image));
        assert!(ids > 100 && pixels > 300, "control: two pixels aside: {ids} ids, {pixels} bytes");
    }
}

/// Frames of both paths alternate on one render target, and each equals the frame of a fresh renderer.
#[test]
fn opengl_and_compute_frames_share_a_target() {
    let mut builder = yard(None, 1);
    builder.parts.look.ground = None;
    let scene = builder.build();
    let aside = |x: f64| {
        let view = View::LookAt { eye: [x, 6.0, 12.0], target: [x, 0.0, 0.0], up: [0.0, 1.0, 0.0] };
        Camera { view, ..from_above() }
    };
    let mut deformer = ReferenceDeformer::new(&scene);
    let bounds = deformer.deform(&SceneState::rest(&scene)).expect("expected the step to succeed").bounds;
    let mut renderer = open_renderer();
    let both = [Backend::OpenGl, Backend::Compute(0.0)].map(|by| {
        let mut buffers = renderer.load(&scene).expect("expected the scene to load");
        renderer.upload(&buffers, deformer.surface().expect("there")).expect("expected the upload to succeed");
        attach(&mut renderer, &mut buffers, by);
        buffers
    });
    let [width, height] = SIZE;
    for (turn, x) in [-2.5, 2.5, 0.0, 1.0, -1.0].into_iter().enumerate() {
        let shot = FrameParams { camera: aside(x), width, height, bounds, light: None };
        let image = renderer.draw(&both[turn % 2], &shot).expect("expected a frame");
        let alone = show(&scene, aside(x), if turn % 2 == 0 { Backend::OpenGl } else { Backend::Compute(0.0) });
        assert_eq!(image.raster_backends, alone.stats.raster_backends);
        assert!(image.rgba == alone.image.rgba, "turn {turn}");
        let triangles = alone.seen.iter().filter(|seen| matches!(seen, VisibilityId::Triangle(_))).count();
        assert!((200..12_000).contains(&triangles), "{triangles} pixels");
    }
}

#[test]
fn ground_hides_geometry_below_but_not_in_its_plane() {
    let scene = yard(None, 1).build();
    let seen = |by: Backend, down: f32| {
        let (mut renderer, mut deformer) = (open_renderer(), ReferenceDeformer::new(&scene));
        let mut state = SceneState::rest(&scene);
        for domain in 0..2 {
            state.transforms[domain].0[7] -= down;
        }
        let bounds = deformer.deform(&state).expect("expected the step to succeed").bounds;
        let mut buffers = renderer.load(&scene).expect("expected the scene to load");
        renderer.upload(&buffers, deformer.surface().expect("there")).expect("expected the upload to succeed");
        attach(&mut renderer, &mut buffers, by);
        let [width, height] = SIZE;
        renderer
            .draw(&buffers, &FrameParams { camera: from_above(), width, height, bounds, light: None })
            .expect("expected a frame");
        let domain = |seen: &VisibilityId| match seen {
            VisibilityId::Triangle(place) => buffers.source_triangle(*place).map(|(domain, _)| domain),
            _ => None,
        };
        let seen: Vec<Option<usize>> = renderer.read_visibility().expect("reads").iter().map(domain).collect();
        seen
    };
    let count = |seen: &[Option<usize>], domain: usize| seen.iter().filter(|own| **own == Some(domain)).count();
    let (up, want, got) = (seen(Backend::OpenGl, 0.0), seen(Backend::OpenGl, 0.8), seen(Backend::Compute(0.0), 0.8));
    assert!(differing(&got, &want) <= 8, "{} samples differ", differing(&got, &want));
    assert!(count(&want, 0) > 100 && 2 * count(&got, 0) < count(&up, 0), "most of the wall is below the ground");
    assert!(count(&up, 1) > 100 && count(&got, 1) == 0, "the lid is");
    let flat = [count(&up, 2), count(&want, 2), count(&got, 2)];
    assert!(flat[0] > 100 && flat == [flat[0]; 3], "what lies in the plane of the ground is seen: {flat:?}");
}

#[test]
fn opengl_draws_what_the_compute_rasterizer_cannot() {
    let raster_backends =
        |builder: SceneBuilder| show(&builder.build(), from_above(), Backend::Compute(0.0)).stats.raster_backends;
    let (opengl, cuda) = (Some(RasterBackend::OpenGl), Some(RasterBackend::Cuda));
    let base = ShadowSettings { size: 128, ..ShadowSettings::default() };
    assert_eq!(
        raster_backends(yard(Some(base), 4)),
        RasterBackends { shadow: cuda, visibility: opengl },
        "four samples a pixel"
    );
    let split = ShadowSettings { splits: 2, ..base };
    assert_eq!(raster_backends(yard(Some(split), 1)), RasterBackends { shadow: opengl, visibility: cuda });
    let standard = ShadowSettings { method: modalcast_model::scene::ShadowMethod::Standard, ..base };
    assert_eq!(raster_backends(yard(Some(standard), 1)), RasterBackends { shadow: opengl, visibility: cuda });
    assert_eq!(raster_backends(yard(None, 1)), RasterBackends { shadow: None, visibility: cuda });
    let glass = Material { alpha_mode: AlphaMode::Blend, alpha: 0.4, ..Material::default() };
    let blended = yard(None, 1).add_domain(facing_rectangle(0.0, 0.0, 0.5, 0.5, 0.5), glass);
    assert_eq!(raster_backends(blended), RasterBackends { shadow: None, visibility: opengl });
    assert_eq!(
        raster_backends(yard(None, 4)),
        RasterBackends { shadow: None, visibility: opengl },
        "and nothing is made for it"
    );
}

/// Cameras of one step share its shadow. OpenGL draws a rebased scene until the scene returns to the shared positions.
#[test]
fn cameras_share_the_shadow_and_rebased_scenes_use_opengl() {
    let scene = yard(Some(ShadowSettings { size: 256, ..ShadowSettings::default() }), 1).build();
    let (mut renderer, mut deformer) = (open_renderer(), ReferenceDeformer::new(&scene));
    let deformed = deformer.deform(&SceneState::rest(&scene)).expect("expected the step to succeed");
    let mut buffers = renderer.load(&scene).expect("expected the scene to load");
    renderer.upload(&buffers, deformer.surface().expect("there")).expect("expected the upload to succeed");
    attach(&mut renderer, &mut buffers, Backend::Compute(0.0));
    let shot = |eye: [f64; 3]| {
        let view = View::LookAt { eye, target: [0.0, 0.2, 0.0], up: [0.0, 1.0, 0.0] };
        let camera = Camera { view, ..from_above() };
        FrameParams { camera, width: SIZE[0], height: SIZE[1], bounds: deformed.bounds, light: deformed.light }
    };
    let (one, other) = (shot([1.4, 1.9, 4.0]), shot([-2.0, 1.2, 3.0]));
    let alone = renderer.draw(&buffers, &other).expect("expected a frame");
    buffers.set_step(7);
    let draw = |renderer: &mut Renderer, buffers: &SceneBuffers, shot: &FrameParams| {
        let image = renderer.draw(buffers, shot).expect("expected a frame");
        (image, renderer.stats().passes[..2].to_vec())
    };
    assert_eq!(draw(&mut renderer, &buffers, &one).1, ["raster shadow", "blur"]);
    let (shared, passes) = draw(&mut renderer, &buffers, &other);
    assert_eq!(passes, ["raster visibility", "unpack"], "the shadow is there");
    assert_eq!(shared.raster_backends, RasterBackends { shadow: None, visibility: Some(RasterBackend::Cuda) });
    assert!(shared.rgba == alone.rgba, "the same picture");
    let positions = deformer.surface().expect("there").positions.clone();
    renderer.upload_rebased(&mut buffers, &positions, [0.0; 3]).expect("expected the upload to succeed");
    let (apart, passes) = draw(&mut renderer, &buffers, &other);
    assert_eq!(
        (passes[0], apart.raster_backends.visibility),
        ("shadow", Some(RasterBackend::OpenGl)),
        "it knows the shared ones alone"
    );
    assert!(far_off(&apart, &alone) <= 60, "{}", far_off(&apart, &alone));
    buffers.set_origin([0.0; 3]);
    let (together, _) = draw(&mut renderer, &buffers, &other);
    assert_eq!(together.raster_backends.visibility, Some(RasterBackend::Cuda));
    assert!(together.rgba == alone.rgba, "the same picture again");
}

/// A rasterizer whose draw calls always fail.
#[derive(Debug)]
struct FailingRasterizer;

impl Rasterizer for FailingRasterizer {
    fn precompile(&mut self, _: bool, _: bool) -> Result<()> {
        Ok(())
    }

    fn draw(&mut self, _: Option<DrawTarget<'_>>, _: Option<DrawTarget<'_>>) -> Result<()> {
        Err(invalid("raster", "a device", "none"))
    }
}

/// The frame of the failure and all later frames are drawn by OpenGL.
#[test]
fn failing_rasterizer_falls_back_to_opengl() {
    let scene = yard(Some(ShadowSettings { size: 128, ..ShadowSettings::default() }), 1).build();
    let want = show(&scene, from_above(), Backend::OpenGl);
    let (mut renderer, mut deformer) = (open_renderer(), ReferenceDeformer::new(&scene));
    let deformed = deformer.deform(&SceneState::rest(&scene)).expect("expected the step to succeed");
    let mut buffers = renderer.load(&scene).expect("expected the scene to load");
    renderer.upload(&buffers, deformer.surface().expect("there")).expect("expected the upload to succeed");
    renderer
        .attach_rasterizer(&mut buffers, |_| Ok(Box::new(FailingRasterizer) as Box<dyn Rasterizer>))
        .expect("given");
    let [width, height] = SIZE;
    let shot = FrameParams { camera: from_above(), width, height, bounds: deformed.bounds, light: None };
    for _ in 0..2 {
        let image = renderer.draw(&buffers, &shot).expect("expected a frame");
        assert_eq!(image.raster_backends, want.stats.raster_backends);
        assert!(image.rgba == want.image.rgba);
    }
}

/// A rasterizer without a compiler. It records the pipelines that it was asked to compile.
#[derive(Debug)]
struct UncompiledRasterizer(std::rc::Rc<std::cell::Cell<[bool; 2]>>);

impl Rasterizer for UncompiledRasterizer {
    fn precompile(&mut self, depth: bool, ids: bool) -> Result<()> {
        self.0.set([depth, ids]);
        Err(invalid("raster", "a compiler", "none"))
    }

    fn draw(&mut self, _: Option<DrawTarget<'_>>, _: Option<DrawTarget<'_>>) -> Result<()> {
        panic!("nothing was compiled");
    }
}

/// Only the pipelines that the scene can use are compiled. OpenGL draws the scene if compilation fails.
#[test]
fn rasterizer_is_compiled_when_the_scene_is_loaded() {
    let shadow = Some(ShadowSettings { size: 128, ..ShadowSettings::default() });
    for (shadow, samples, want) in [(shadow, 1, [true; 2]), (shadow, 4, [true, false]), (None, 1, [false, true])] {
        let scene = yard(shadow, samples).build();
        let (mut renderer, mut deformer) = (open_renderer(), ReferenceDeformer::new(&scene));
        let deformed = deformer.deform(&SceneState::rest(&scene)).expect("expected the step to succeed");
        let mut buffers = renderer.load(&scene).expect("expected the scene to load");
        renderer.upload(&buffers, deformer.surface().expect("there")).expect("expected the upload to succeed");
        let asked = std::rc::Rc::default();
        let unready = UncompiledRasterizer(std::rc::Rc::clone(&asked));
        let refused = renderer.attach_rasterizer(&mut buffers, |_| Ok(Box::new(unready) as Box<dyn Rasterizer>));
        assert!(refused.is_err() && asked.get() == want, "{:?}", asked.get());
        let [width, height] = SIZE;
        let shot = FrameParams { camera: from_above(), width, height, bounds: deformed.bounds, light: None };
        let raster_backends = renderer.draw(&buffers, &shot).expect("expected a frame").raster_backends;
        assert_eq!(raster_backends.visibility, Some(RasterBackend::OpenGl));
    }
}
