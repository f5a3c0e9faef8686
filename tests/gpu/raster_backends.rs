//! Frames rasterized by CUDA in the way that the server draws them. They equal OpenGL frames up to edges and depth
//! ties, do not depend on steps computed meanwhile, and are deterministic.

use std::sync::Arc;

use modalcast::config::{BackendChoice, Config};
use modalcast::engine::DeviceContext;
use modalcast_compute::cpu::CpuDeformer;
use modalcast_compute::gpu::{CudaRasterizer, Device};
use modalcast_model::backend_settings::{BackendSettings, RasterPolicy};
use modalcast_model::deform::Deformer as _;
use modalcast_model::raster::{RasterGeometry, Rasterizer};
use modalcast_model::scene::{
    Antialiasing, Camera, FrameSize, RenderSettings, Scene, SceneParts, SceneState, ShadowSettings,
};
use modalcast_render::{
    DevicePreference, FrameImage, FrameParams, MappedPixels, RasterBackend, RasterBackends, Renderer, VisibilityId,
};

use crate::both::exact::{Exact, compare};
use crate::scenes;

const SIZE: [u32; 2] = [960, 540];
/// Depth tie threshold. Hardware interpolates the depth of triangles that are hundreds of pixels wide to 3e-7 of the
/// depth range.
const TIE: f64 = 4e-7;
const BY_CUDA: RasterBackends =
    RasterBackends { shadow: Some(RasterBackend::Cuda), visibility: Some(RasterBackend::Cuda) };
const BY_OPENGL: RasterBackends =
    RasterBackends { shadow: Some(RasterBackend::OpenGl), visibility: Some(RasterBackend::OpenGl) };

fn open() -> DeviceContext {
    DeviceContext::open(&Config { backend: BackendChoice::Cuda, ..Config::default() }).expect("a CUDA device")
}

/// The same scene with one sample per pixel, which the CUDA rasterizer requires.
fn with_one_sample(scene: &Scene) -> Arc<Scene> {
    let look = RenderSettings { antialias: Antialiasing::Fxaa, ..scene.look };
    Scene::new(SceneParts { look, ..scene.parts() }).expect("a good scene")
}

/// Frames of some states, each drawn before the next is deformed.
fn frames(scene: &Scene, raster: RasterPolicy, states: &[SceneState]) -> Vec<FrameImage> {
    let (mut bench, scene) = (open(), with_one_sample(scene));
    let camera = Camera::fit_to_scene(&scene, SIZE[0], SIZE[1]);
    let mut staged = bench.load_scene(&scene, BackendSettings { raster }).expect("staged");
    let draw = |state: &SceneState| {
        staged.deform(state).expect("deforms");
        bench.draw(&mut staged, &camera, FrameSize::new(SIZE[0], SIZE[1])).expect("draws")
    };
    let images = states.iter().map(draw).collect();
    bench.unload_scene(staged);
    images
}

/// A picture of a static scene, the index of the triangle that each pixel sees, and each triangle in f64.
struct Still {
    image: FrameImage,
    seen: Vec<Option<u32>>,
    exact: Vec<Exact>,
}

fn still(scene: &Arc<Scene>, state: &SceneState, by_cuda: bool) -> Still {
    let device = Device::open(0).expect("a CUDA device");
    let (mut renderer, mut deformer) =
        (Renderer::open(DevicePreference::Cuda(0)).expect("OpenGL"), CpuDeformer::new(scene));
    let deformed = deformer.deform(state).expect("deforms");
    let mut buffers = renderer.load(scene).expect("loads");
    renderer.upload(&buffers, deformer.surface().expect("there")).expect("uploads");
    if by_cuda {
        let make = |mesh: RasterGeometry| Ok(Box::new(CudaRasterizer::new(&device, mesh)?) as Box<dyn Rasterizer>);
        renderer.attach_rasterizer(&mut buffers, make).expect("given");
    }
    // The near plane is far enough away that depth precision separates the surfaces.
    let camera = Camera { near: 1.0, far: 40.0, ..Camera::fit_to_scene(scene, SIZE[0], SIZE[1]) };
    let shot = FrameParams { camera, width: SIZE[0], height: SIZE[1], bounds: deformed.bounds, light: deformed.light };
    let image = renderer.draw(&buffers, &shot).expect("draws");
    let place = |seen: &VisibilityId| if let VisibilityId::Triangle(place) = seen { Some(*place as u32) } else { None };
    let seen = renderer.read_visibility().expect("reads").iter().map(place).collect();
    let clip = camera.clip_from_camera(SIZE[0], SIZE[1], &deformed.bounds) * camera.camera_from_world();
    let positions = &deformer.surface().expect("there").positions;
    let list = scene.triangle_vertices();
    let exact = |place: usize| {
        let (domain, triangle) = buffers.source_triangle(place).expect("there");
        let corners = list[scene.layout.slots[domain].first_triangle + triangle]
            .map(|vertex| std::array::from_fn(|axis| positions[3 * vertex as usize + axis]));
        Exact::new(&clip, SIZE, corners)
    };
    let exact = (0..scene.layout.triangles).map(exact).collect();
    Still { image, seen, exact }
}

/// A soup of intersecting triangles, moved and mirrored, and a tree with cut-out leaves.
fn scenes_and_states() -> [(&'static str, Arc<Scene>, SceneState); 2] {
    let soup = scenes::scene(&[(3000, 12), (50, 0), (700, 3)], 5, true, false);
    let tree = modalcast_model::load::open("tree").expect("built in").scene;
    let (moved, rest) = (scenes::state(&soup, 1), SceneState::rest(&tree));
    [("soup", soup, moved), ("tree", tree, rest)]
}

fn under(scene: &Scene, shadow: Option<ShadowSettings>) -> Arc<Scene> {
    let look = RenderSettings { shadow, ground: None, antialias: Antialiasing::None, ..scene.look };
    Scene::new(SceneParts { look, ..scene.parts() }).expect("a good scene")
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_ids_equal_opengl_except_on_edges_and_depth_ties() {
    for (name, scene, state) in scenes_and_states() {
        let scene = under(&scene, None);
        let [want, got] = [false, true].map(|by_cuda| still(&scene, &state, by_cuda));
        let found = compare(&got.seen, &want.seen, &want.exact, (SIZE, TIE));
        eprintln!("{name}: {found:?} of {} pixels", got.seen.len());
        // At the rim of a hole the filtered alpha crosses its threshold, and hardware has 8-bit filter weights.
        let rims = if name == "tree" { SIZE[0] * SIZE[1] / 500 } else { 0 };
        assert!(found.wrong <= rims as usize, "{name}: {found:?}");
        let other = still(&scene, &SceneState { q: state.q.iter().map(|q| q + 0.3).collect(), ..state.clone() }, true);
        let control = compare(&other.seen, &want.seen, &want.exact, (SIZE, TIE));
        assert!(control.wrong > rims as usize + 500, "control: {name}: {control:?}");
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_shading_of_equal_ids_equals_opengl() {
    for (name, scene, state) in scenes_and_states() {
        for shadow in [None, Some(ShadowSettings::default())] {
            let scene = under(&scene, shadow);
            let [want, got] = [false, true].map(|by_cuda| still(&scene, &state, by_cuda));
            let pixels = got.image.rgba.chunks_exact(4).zip(want.image.rgba.chunks_exact(4));
            let far = pixels.map(|(got, want)| got.iter().zip(want).any(|(got, want)| got.abs_diff(*want) > 6));
            let alike = got.seen.iter().zip(&want.seen).map(|(got, want)| got == want);
            let off = far.zip(alike).filter(|(far, alike)| *far && *alike).count();
            eprintln!("{name}, {:?}: {off} pixels differ in light alone", shadow.map(|shadow| shadow.size));
            assert!(off <= got.seen.len() / 500, "{name}: {off}");
        }
    }
    let [(_, soup, state), _] = scenes_and_states();
    let [dark, lit] =
        [Some(ShadowSettings::default()), None].map(|shadow| still(&under(&soup, shadow), &state, true).image);
    let off = dark.rgba.iter().zip(&lit.rgba).filter(|(dark, lit)| dark.abs_diff(**lit) > 6).count();
    assert!(off > dark.rgba.len() / 50, "control: shadows are seen: {off}");
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_cuda_frames_report_their_path_and_repeat_bits() {
    let scene = scenes::scene(&[(3000, 12), (50, 0), (700, 3)], 5, true, false);
    let states = [scenes::state(&scene, 1), scenes::state(&scene, 2)];
    let [want, got, again] =
        [RasterPolicy::OpenGl, RasterPolicy::Cuda, RasterPolicy::Cuda].map(|raster| frames(&scene, raster, &states));
    for at in 0..states.len() {
        assert_eq!((got[at].raster_backends, want[at].raster_backends), (BY_CUDA, BY_OPENGL), "{at}");
        assert!(got[at].rgba == again[at].rgba, "{at}: other bits the second time");
    }
    assert!(got[0].rgba != got[1].rgba, "control: another step is another picture");
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_cuda_frames_in_flight_keep_their_step() {
    let scene = scenes::scene(&[(3000, 12), (700, 3)], 5, false, false);
    let states: Vec<SceneState> = (0..6).map(|seed| scenes::state(&scene, seed)).collect();
    let want = frames(&scene, RasterPolicy::Cuda, &states);
    let (mut bench, drawn) = (open(), with_one_sample(&scene));
    let camera = Camera::fit_to_scene(&drawn, SIZE[0], SIZE[1]);
    let mut staged = bench.load_scene(&drawn, BackendSettings { raster: RasterPolicy::Cuda }).expect("staged");
    let mut images = Vec::new();
    let mut under_way = std::collections::VecDeque::new();
    for state in &states {
        staged.deform(state).expect("deforms");
        if under_way.len() == 3 {
            images.extend(under_way.pop_front().map(|oldest| bench.finish_draw(oldest).map(MappedPixels::into_image)));
        }
        under_way.push_back(bench.begin_draw(&mut staged, &camera, FrameSize::new(SIZE[0], SIZE[1])).expect("begins"));
    }
    images.extend(under_way.into_iter().map(|drawing| bench.finish_draw(drawing).map(MappedPixels::into_image)));
    for (at, (got, want)) in images.into_iter().zip(&want).enumerate() {
        assert!(got.expect("drawn").rgba == want.rgba, "frame {at}");
    }
    bench.unload_scene(staged);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_ground_hides_geometry_below_on_both_paths() {
    let [(_, scene, state), _] = scenes_and_states();
    let look = RenderSettings { shadow: None, antialias: Antialiasing::None, ..scene.look };
    let scene = Scene::new(SceneParts { look, ..scene.parts() }).expect("a good scene");
    let [want, got] = [false, true].map(|by_cuda| still(&scene, &state, by_cuda));
    let hidden = |still: &Still| still.seen.iter().filter(|seen| seen.is_none()).count();
    let differing = got.seen.iter().zip(&want.seen).filter(|(got, want)| got != want).count();
    eprintln!("{differing} differ, {} and {} see ground or sky", hidden(&got), hidden(&want));
    assert!(hidden(&want) > 20_000 && differing < got.seen.len() / 2000, "{differing}");
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_resized_cuda_frames_equal_a_fresh_renderer() {
    let scene = with_one_sample(&scenes::scene(&[(3000, 12), (700, 3)], 3, false, false));
    let draw = |bench: &mut DeviceContext, staged: &mut modalcast::engine::LoadedScene, [width, height]: [u32; 2]| {
        let image = bench
            .draw(staged, &Camera::fit_to_scene(&scene, width, height), FrameSize::new(width, height))
            .expect("draws");
        assert_eq!(image.raster_backends.visibility, Some(RasterBackend::Cuda));
        image.rgba
    };
    let mut bench = open();
    let mut staged = bench.load_scene(&scene, BackendSettings { raster: RasterPolicy::Cuda }).expect("staged");
    for size in [[64, 48], [1920, 1080], [1, 1], [333, 77], [64, 48]] {
        let got = draw(&mut bench, &mut staged, size);
        let mut fresh = open();
        let mut alone = fresh.load_scene(&scene, BackendSettings { raster: RasterPolicy::Cuda }).expect("staged");
        assert!(got == draw(&mut fresh, &mut alone, size), "{size:?}");
        fresh.unload_scene(alone);
    }
    bench.unload_scene(staged);
}

/// The path is selected by measurement.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_fastest_path_draws_frames_of_every_size() {
    let scene = with_one_sample(&scenes::scene(&[(3000, 12), (700, 3)], 3, false, false));
    let mut bench = open();
    let mut staged = bench.load_scene(&scene, BackendSettings { raster: RasterPolicy::Fastest }).expect("staged");
    for [width, height] in [[64, 48], [1920, 1080], [1, 1], [333, 77]] {
        let camera = Camera::fit_to_scene(&scene, width, height);
        let image = bench.draw(&mut staged, &camera, FrameSize::new(width, height)).expect("draws");
        eprintln!("{width} x {height}: {:?}", image.raster_backends);
        assert!(image.raster_backends.visibility.is_some());
        assert_eq!(image.rgba.len(), 4 * (width * height) as usize);
        staged.deform(&scenes::state(&scene, u64::from(width))).expect("deforms");
    }
    bench.unload_scene(staged);
}
