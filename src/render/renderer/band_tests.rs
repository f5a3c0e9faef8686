//! Tests of frames and AOVs that are drawn in bands and pieces: the pixels are those of a frame without them, also if
//! other scenes are drawn in between.

use std::cell::RefCell;
use std::ops::Range;
use std::rc::Rc;
use std::sync::Arc;
use std::time::Duration;

use super::Renderer;
use crate::hang_guard::HANG_GUARD;
use crate::pass::Pass;
use crate::pieces::PieceLimits;
use crate::scene_data::geometry::tests::squares;
use crate::{Aov, DevicePreference, FrameImage, FrameParams, FrameStats, SceneBuffers};
use modalcast_model::deform::DeformedSurface;
use modalcast_model::domain::{AlphaMode, Material};
use modalcast_model::error::Result;
use modalcast_model::raster::{DrawTarget, Rasterizer};
use modalcast_model::scene::{
    Antialiasing, Bloom, BoundingBox, Camera, Culling, Ground, Lens, Lighting, PixelRect, RenderSettings, Scene,
    ShadowSettings, Transparency, View,
};

/// Frame with several bands of 64 rows; the last band has 8 rows.
const SIZE: [u32; 2] = [230, 200];

/// A scene of random triangles of every kind of material, and its buffers.
struct RandomScene {
    scene: Arc<Scene>,
    buffers: SceneBuffers,
    bounds: BoundingBox,
}

impl RandomScene {
    fn load(renderer: &mut Renderer, seed: u64, look: RenderSettings) -> Self {
        let mut random = fastrand::Rng::with_seed(seed);
        let alpha_modes = [AlphaMode::Opaque, AlphaMode::Mask { cutoff: 0.5 }, AlphaMode::Blend];
        let materials: Vec<Material> = (0..120)
            .map(|index| Material {
                diffuse: [random.f32(), random.f32(), random.f32()],
                alpha: 0.6,
                alpha_mode: alpha_modes[index % 3],
                double_sided: index % 2 == 0,
                ..Material::default()
            })
            .collect();
        let mut parts = squares(materials);
        parts.look = look;
        let scene = Scene::new(parts).expect("a valid scene");
        let vertex_count = scene.layout.vertices;
        let mut bounds = BoundingBox::EMPTY;
        let mut positions = Vec::new();
        for vertex in 0..vertex_count {
            // Squares become pairs of triangles of different sizes.
            let size = if vertex % 16 < 4 { 4.0 } else { 1.0 };
            let center = [0.37, 0.73, 0.11].map(|step: f32| (step * (vertex / 4) as f32).fract() * 4.0 - 2.0);
            let position = center.map(|coordinate| coordinate + size * (random.f32() - 0.5));
            bounds.include(position.map(f64::from));
            positions.extend(position);
        }
        let normals = [0.0, 0.6, 0.8].repeat(vertex_count);
        let buffers = renderer.load(&scene).expect("loads");
        let surface = DeformedSurface { positions, normals, ..DeformedSurface::default() };
        renderer.upload(&buffers, &surface).expect("uploads");
        Self { scene, buffers, bounds }
    }

    fn params(&self, [width, height]: [u32; 2]) -> FrameParams {
        let view = View::LookAt { eye: [1.5, 2.0, 8.0], target: [0.0; 3], up: [0.0, 1.0, 0.0] };
        // Near and far 0: the planes are fitted to the bounds.
        let camera = Camera { view, lens: Lens::FieldOfView(45.0), near: 0.0, far: 0.0 };
        FrameParams { camera, width, height, bounds: self.bounds, light_bounds: None, edges: None, samples: None }
    }
}

fn open_renderer() -> Renderer {
    Renderer::open(DevicePreference::Any).expect("EGL and OpenGL 4.3")
}

fn look(samples: u32) -> RenderSettings {
    let shadow = ShadowSettings { size: 256, ..ShadowSettings::default() };
    let ground = Some(Ground::default());
    RenderSettings { samples, shadow: Some(shadow), ground, ..RenderSettings::default() }
}

/// Looks that use every pass.
fn looks() -> Vec<(&'static str, RenderSettings)> {
    let cascades = Some(ShadowSettings { size: 256, cascades: 3, ..ShadowSettings::default() });
    let exact = RenderSettings { transparency: Transparency::OrderIndependent, ..look(4) };
    let fxaa = RenderSettings { antialias: Antialiasing::Fxaa, dither: true, ..look(1) };
    vec![
        ("four samples, blended in draw order", RenderSettings { transparency: Transparency::TwoPass, ..look(4) }),
        ("one sample, blended in draw order", RenderSettings { transparency: Transparency::TwoPass, ..look(1) }),
        ("exact transparency", exact),
        ("exact transparency over its budget", RenderSettings { fragments: Some(40_000), ..exact }),
        ("exact transparency, one sample", RenderSettings { samples: 1, ..exact }),
        ("bloom", RenderSettings { bloom: Some(Bloom { threshold: 0.2, levels: 4, ..Bloom::default() }), ..look(4) }),
        ("FXAA, bloom, cascades", RenderSettings { bloom: Some(Bloom::default()), shadow: cascades, ..fxaa }),
        ("triangle culling", RenderSettings { culling: Culling::Triangles, ..exact }),
        ("occlusion culling", RenderSettings { culling: Culling::Occlusion, ..look(4) }),
        ("studio with ambient occlusion", RenderSettings { shadow: look(4).shadow, ..Lighting::Studio.settings() }),
    ]
}

/// Draws a frame step by step. Between the steps draws, picks and reads another scene. Returns the image, its
/// statistics and the number of steps.
fn draw_in_steps(
    renderer: &mut Renderer,
    random_scene: &RandomScene,
    other_scene: &RandomScene,
) -> (FrameImage, FrameStats, usize) {
    let params = random_scene.params(SIZE);
    let mut partial_frame = renderer.begin_frame(&random_scene.buffers, &params, true).expect("begins");
    assert!(partial_frame.is_divided());
    let mut step_count = 0;
    while !partial_frame.is_submitted() {
        assert!(partial_frame.is_ready_within(HANG_GUARD));
        renderer.submit_step(&random_scene.buffers, &mut partial_frame).expect("submits");
        step_count += 1;
        // The same size as the frame, and another one.
        let other_size = if step_count % 2 == 0 { SIZE } else { [70, 90] };
        let other_params = other_scene.params(other_size);
        renderer.draw(&other_scene.buffers, &other_params).expect("draws");
        renderer.render_aov(&other_scene.buffers, &other_params, Aov::Normals).expect("reads");
        let rectangle = PixelRect::within(SIZE, [20, 30], [5, 5]).expect("a rectangle");
        let pick = renderer.begin_pick(&other_scene.buffers, &other_scene.params(SIZE), rectangle).expect("picks");
        renderer.finish_pick(pick).expect("picks");
    }
    let pending_frame = renderer.finish_frame(partial_frame).expect("finishes");
    let image = renderer.read_image(pending_frame).expect("draws");
    (image, renderer.stats().clone(), step_count)
}

/// Limits of pieces with about 30 triangles of a band of 64 rows.
fn small_pieces(samples_per_pixel: u32) -> PieceLimits {
    let samples = 30 * u64::from(samples_per_pixel * SIZE[0] * 64);
    PieceLimits { first_samples: samples, max_samples: samples, ..PieceLimits::SOFTWARE }
}

#[test]
fn frame_in_bands_has_the_pixels_of_the_whole_frame() {
    for (name, look) in looks() {
        let mut renderer = open_renderer();
        let random_scene = RandomScene::load(&mut renderer, 1, look);
        let other_scene = RandomScene::load(&mut renderer, 2, look);
        let params = random_scene.params(SIZE);
        // The second frame has occluders.
        renderer.draw(&random_scene.buffers, &params).expect("draws");
        let whole = renderer.draw(&random_scene.buffers, &params).expect("draws");
        let whole_stats = renderer.stats().clone();
        let whole_ids = renderer.read_visibility().expect("ids");
        let colors: std::collections::HashSet<&[u8]> = whole.rgba.chunks(4).collect();
        assert!(colors.len() > 500, "{name}: expected a detailed image, got {} colors", colors.len());
        renderer.set_max_band_samples(u64::from(look.samples * SIZE[0] * 64));
        // Bands, and pieces of the triangles of each band.
        let mut step_counts = Vec::new();
        for pieces in [PieceLimits::SOFTWARE, small_pieces(look.samples)] {
            random_scene.buffers.shadow_cache.invalidate();
            renderer.output_limits.pieces = pieces;
            let (image, stats, step_count) = draw_in_steps(&mut renderer, &random_scene, &other_scene);
            let count = image.rgba.chunks(4).zip(whole.rgba.chunks(4)).filter(|(band, whole)| band != whole).count();
            assert_eq!(count, 0, "{name}: pixels differ, {step_count} steps");
            assert!(renderer.read_visibility().expect("ids") == whole_ids, "{name}: ids differ");
            let results = |stats: &FrameStats| (stats.passes.clone(), stats.oit, stats.culled);
            assert_eq!(results(&stats), results(&whole_stats), "{name}");
            step_counts.push(step_count);
        }
        assert!(step_counts[0] > 15 && step_counts[1] > step_counts[0] + 20, "{name}: {step_counts:?} steps");
    }
}

/// Records the ranges that it draws.
#[derive(Debug)]
struct RangeRecorder(Rc<RefCell<Vec<Range<u32>>>>);

impl Rasterizer for RangeRecorder {
    fn draw(&mut self, _: Option<DrawTarget<'_>>, _: Option<DrawTarget<'_>>, range: Range<u32>) -> Result<()> {
        self.0.borrow_mut().push(range);
        Ok(())
    }

    fn precompile(&mut self, _: bool, _: bool) -> Result<()> {
        Ok(())
    }
}

#[test]
fn compute_rasterizer_draws_consecutive_ranges() {
    let mut renderer = open_renderer();
    let mut random_scene = RandomScene::load(&mut renderer, 1, look(1));
    let ranges = Rc::new(RefCell::new(Vec::new()));
    let recorder = RangeRecorder(Rc::clone(&ranges));
    renderer.attach_shadow_rasterizer(&mut random_scene.buffers, |_| Ok(Box::new(recorder))).expect("attaches");
    renderer.output_limits.pieces = small_pieces(1);
    let params = random_scene.params(SIZE);
    let mut partial_frame = renderer.begin_frame(&random_scene.buffers, &params, true).expect("begins");
    while !partial_frame.is_submitted() {
        renderer.submit_step(&random_scene.buffers, &mut partial_frame).expect("submits");
    }
    let ranges = ranges.take();
    let triangles = random_scene.scene.layout.triangles as u32;
    assert!(ranges.len() > 20, "{ranges:?}");
    let ends = std::iter::once(0).chain(ranges.iter().map(|range| range.end));
    assert!(ranges.iter().map(|range| range.start).zip(ends).all(|(start, end)| start == end), "{ranges:?}");
    assert_eq!(ranges.last().map(|range| range.end), Some(triangles));
}

/// The first frame of a size has breaks; later ones are drawn whole, because they take less time than a piece.
#[test]
fn frame_that_is_known_to_be_short_has_no_breaks() {
    let mut renderer = open_renderer();
    let random_scene = RandomScene::load(&mut renderer, 1, look(4));
    let has_breaks = |renderer: &mut Renderer, size: [u32; 2]| {
        let params = random_scene.params(size);
        let has_breaks = renderer.begin_frame(&random_scene.buffers, &params, true).expect("begins").has_breaks();
        renderer.draw(&random_scene.buffers, &params).expect("draws");
        has_breaks
    };
    // Far longer than a frame takes on a busy machine.
    renderer.output_limits.pieces.target_ms = 1e9;
    assert_eq!(
        [SIZE, SIZE, [32, 32], [32, 32], SIZE].map(|size| has_breaks(&mut renderer, size)),
        [true, false, true, false, false]
    );
    renderer.output_limits.pieces.target_ms = 1e-9;
    assert!(has_breaks(&mut renderer, SIZE), "expected breaks in a frame that took longer than a piece");
}

/// Negative control: a step that is missing changes the pixels, so the comparison sees every band.
#[test]
fn missing_band_changes_the_pixels() {
    let mut renderer = open_renderer();
    let look = RenderSettings { transparency: Transparency::TwoPass, ..look(4) };
    let random_scene = RandomScene::load(&mut renderer, 1, look);
    let other_scene = RandomScene::load(&mut renderer, 2, look);
    let params = random_scene.params(SIZE);
    renderer.set_max_band_samples(u64::from(4 * SIZE[0] * 64));
    let expected = renderer.draw(&random_scene.buffers, &params).expect("draws").rgba;
    let step_count = renderer.begin_frame(&random_scene.buffers, &params, true).expect("begins").remaining_step_count();
    let mut changed_count = 0;
    for missing_step in 0..step_count {
        // Fills the shared target with another image.
        renderer.draw(&other_scene.buffers, &params).expect("draws");
        let mut partial_frame = renderer.begin_frame(&random_scene.buffers, &params, true).expect("begins");
        partial_frame.remove_step(missing_step);
        while !partial_frame.is_submitted() {
            renderer.submit_step(&random_scene.buffers, &mut partial_frame).expect("submits");
        }
        let pending_frame = renderer.finish_frame(partial_frame).expect("finishes");
        // A missing band of the readback is an error.
        let image = renderer.read_image(pending_frame);
        changed_count += usize::from(image.map_or(true, |image| image.rgba != expected));
    }
    // At least three of the four bands of the visibility, the shading and the encoding, and the readback. Only the sky
    // may be visible in the fourth.
    assert!(changed_count >= 10, "{changed_count} of {step_count}");
}

/// A frame in bands allocates one staging buffer of a fixed size, which later frames use again. Frames that are begun before
/// the pixels of earlier ones are read have buffers of their own.
#[test]
fn frames_in_bands_share_staging_buffers_of_one_band() {
    let mut renderer = open_renderer();
    let random_scene = RandomScene::load(&mut renderer, 1, look(4));
    let params = random_scene.params(SIZE);
    let expected = renderer.draw(&random_scene.buffers, &params).expect("draws").rgba;
    let slot_counts = |renderer: &Renderer| {
        (renderer.targets.last().expect("a target").readback_ring.count(), renderer.band_ring.count())
    };
    assert_eq!(slot_counts(&renderer), (1, 0), "control: a frame without bands");
    renderer.targets.clear();
    renderer.set_max_band_samples(1);
    for _ in 0..3 {
        assert!(renderer.draw(&random_scene.buffers, &params).expect("draws").rgba == expected);
        assert_eq!(slot_counts(&renderer), (0, 1));
    }
    let pending: Vec<_> = (0..2).map(|_| renderer.submit(&random_scene.buffers, &params).expect("submits")).collect();
    for pending_frame in pending {
        assert!(renderer.read_image(pending_frame).expect("draws").rgba == expected);
    }
    assert_eq!(slot_counts(&renderer), (0, 2));
}

#[test]
fn shadow_map_is_drawn_once_for_all_bands() {
    let mut renderer = open_renderer();
    let random_scene = RandomScene::load(&mut renderer, 1, look(4));
    renderer.set_max_band_samples(1);
    let mut partial_frame =
        renderer.begin_frame(&random_scene.buffers, &random_scene.params(SIZE), true).expect("begins");
    while !partial_frame.is_submitted() {
        renderer.submit_step(&random_scene.buffers, &mut partial_frame).expect("submits");
    }
    let pending_frame = renderer.finish_frame(partial_frame).expect("finishes");
    let timed = |pass: Pass| pending_frame.passes.iter().filter(|(timed_pass, _)| *timed_pass == pass).count();
    // The smallest bands of the map, each of which is blurred once.
    let map = random_scene.buffers.shadow.as_ref().expect("a shadow map");
    let blur_bands = crate::passes::shadow::blur_bands(map, 0).len();
    assert!(blur_bands > 1);
    assert_eq!([Pass::Shadow, Pass::Blur, Pass::Shade, Pass::Encode].map(timed), [1, blur_bands, 4, 4]);
    let image = renderer.read_image(pending_frame).expect("draws");
    assert_eq!(image.times.iter().filter(|(key, _)| key.name() == "shade").count(), 1, "{:?}", image.times);
}

#[test]
fn aov_in_bands_has_the_words_of_the_whole_aov() {
    let mut renderer = open_renderer();
    let mut random_scene = RandomScene::load(&mut renderer, 1, look(4));
    let other_scene = RandomScene::load(&mut renderer, 2, look(4));
    let values: Vec<f32> = (0..random_scene.scene.layout.vertices).map(|vertex| vertex as f32).collect();
    renderer.upload_vertex_values(&mut random_scene.buffers, &values).expect("uploads");
    let params = random_scene.params(SIZE);
    for field in [Aov::Depth, Aov::Domains, Aov::Normals, Aov::Values { scale_max: 480.0 }] {
        renderer.set_max_band_samples(u64::MAX);
        let whole = renderer.render_aov(&random_scene.buffers, &params, field).expect("reads");
        renderer.set_max_band_samples(u64::from(whole.samples * SIZE[0] * 64));
        let triangle_pieces = random_scene.scene.layout.triangles.div_ceil(30);
        for (pieces, piece_count) in [(PieceLimits::SOFTWARE, 4), (small_pieces(whole.samples), 4 * triangle_pieces)] {
            renderer.output_limits.pieces = pieces;
            let mut partial_aov = renderer.begin_aov(&random_scene.buffers, &params, field).expect("begins");
            let mut submitted_count = 0;
            while !partial_aov.is_submitted() {
                renderer.submit_aov_piece(&random_scene.buffers, &mut partial_aov).expect("submits");
                submitted_count += 1;
                renderer.draw(&other_scene.buffers, &other_scene.params([70, 90])).expect("draws");
                renderer.render_aov(&other_scene.buffers, &params, Aov::Normals).expect("reads");
            }
            let aov = renderer.finish_aov(&random_scene.buffers, partial_aov).expect("reads");
            assert_eq!(aov.samples, whole.samples, "{field:?}");
            // The last band has fewer rows, so its pieces have more triangles.
            assert!((piece_count * 3 / 4..=piece_count).contains(&submitted_count), "{field:?}: {submitted_count}");
            assert!(aov.bytes == whole.bytes, "{field:?}: words differ");
        }
    }
}

/// The targets of abandoned frames are freed, and later frames are not affected.
#[test]
fn dropped_frame_does_not_affect_later_frames() {
    let mut renderer = open_renderer();
    let random_scene = RandomScene::load(&mut renderer, 1, look(4));
    let params = random_scene.params(SIZE);
    let expected = renderer.draw(&random_scene.buffers, &params).expect("draws").rgba;
    renderer.set_max_band_samples(1);
    for submitted_steps in 1..8 {
        let mut partial_frame = renderer.begin_frame(&random_scene.buffers, &params, true).expect("begins");
        for _ in 0..submitted_steps {
            renderer.submit_step(&random_scene.buffers, &mut partial_frame).expect("submits");
        }
        assert!(renderer.targets.is_empty());
        let error = renderer.read_visibility().expect_err("no frame is drawn").to_string();
        assert!(error.contains("no frame was drawn"), "{error}");
        drop(partial_frame);
        assert!(renderer.draw(&random_scene.buffers, &params).expect("draws").rgba == expected);
    }
}

/// A target that is not in use is freed. The next frame creates it again and has the same pixels.
#[test]
fn unused_target_is_freed_and_created_again() {
    let mut renderer = open_renderer();
    let random_scene = RandomScene::load(&mut renderer, 1, look(4));
    let params = random_scene.params(SIZE);
    let expected = renderer.draw(&random_scene.buffers, &params).expect("draws").rgba;
    renderer.free_unused_targets(Duration::from_secs(1000)).expect("frees");
    assert!(renderer.has_targets());
    renderer.read_visibility().expect("ids of the last frame");
    renderer.free_unused_targets(Duration::ZERO).expect("frees");
    assert!(!renderer.has_targets());
    renderer.read_visibility().expect_err("the images of the last frame were freed");
    // A frame that has begun keeps its target.
    let mut partial_frame = renderer.begin_frame(&random_scene.buffers, &params, true).expect("begins");
    renderer.free_unused_targets(Duration::ZERO).expect("frees");
    while !partial_frame.is_submitted() {
        renderer.submit_step(&random_scene.buffers, &mut partial_frame).expect("submits");
    }
    let pending_frame = renderer.finish_frame(partial_frame).expect("finishes");
    renderer.free_unused_targets(Duration::ZERO).expect("frees");
    assert!(renderer.read_image(pending_frame).expect("draws").rgba == expected);
}
