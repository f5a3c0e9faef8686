//! Frames whose triangles CUDA turns into samples, drawn as a server draws them: OpenGL's pictures, whatever is deformed
//! meanwhile, and the same bits again.

use std::sync::Arc;

use modalcast::config::{BackendChoice, Config};
use modalcast::cpu::CpuDeformer;
use modalcast::deform::Deformer as _;
use modalcast::engine::Workbench;
use modalcast::gpu::{Device, GlRaster};
use modalcast::raster::{Mesh, Rasteriser};
use modalcast::render::{Image, Path, Paths, Pixels, Prefer, Renderer, Seen, Shot};
use modalcast::scene::{Antialias, Camera, Look, Parts, Rastering, Scene, Shadow, State};

use crate::scenes;

const SIZE: [u32; 2] = [960, 540];
const BY_CUDA: Paths = Paths { shadow: Some(Path::Cuda), visibility: Some(Path::Cuda) };
const BY_OPENGL: Paths = Paths { shadow: Some(Path::OpenGl), visibility: Some(Path::OpenGl) };

fn open() -> Workbench {
    Workbench::open(&Config { backend: BackendChoice::Cuda, ..Config::default() }).expect("a CUDA device")
}

/// The same scene with one sample a pixel, drawn so.
fn drawn_by(scene: &Scene, raster: Rastering) -> Arc<Scene> {
    let look = Look { raster, antialias: Antialias::Fxaa, ..scene.look };
    Scene::new(Parts { look, ..scene.parts() }).expect("a good scene")
}

/// Frames of some states, each drawn before the next is deformed.
fn frames(scene: &Scene, raster: Rastering, states: &[State]) -> Vec<Image> {
    let (mut bench, scene) = (open(), drawn_by(scene, raster));
    let camera = Camera::framing(&scene, SIZE[0], SIZE[1]);
    let mut staged = bench.stage(&scene).expect("staged");
    let draw = |state: &State| {
        staged.deform(state).expect("deforms");
        bench.draw(&mut staged, &camera, SIZE[0], SIZE[1]).expect("draws")
    };
    let images = states.iter().map(draw).collect();
    bench.unstage(staged);
    images
}

/// A still picture by one way, and what each pixel sees.
fn still(scene: &Arc<Scene>, state: &State, by_cuda: bool) -> (Image, Vec<Seen>) {
    let device = Device::open(0).expect("a CUDA device");
    let (mut renderer, mut deformer) = (Renderer::open(Prefer::Cuda(0)).expect("OpenGL"), CpuDeformer::new(scene));
    let deformed = deformer.deform(state).expect("deforms");
    let mut buffers = renderer.load(scene).expect("loads");
    renderer.upload(&buffers, deformer.surface().expect("there")).expect("uploads");
    if by_cuda {
        let make = |mesh: Mesh| Ok(Box::new(GlRaster::new(&device, mesh)?) as Box<dyn Rasteriser>);
        renderer.draw_beside(&mut buffers, make).expect("given");
    }
    // A near plane far enough off that depths tell surfaces apart: those that tie may be drawn in any order.
    let camera = Camera { near: 1.0, far: 40.0, ..Camera::framing(scene, SIZE[0], SIZE[1]) };
    let shot = Shot { camera, width: SIZE[0], height: SIZE[1], bounds: deformed.bounds, light: deformed.light };
    let image = renderer.draw(&buffers, &shot).expect("draws");
    (image, renderer.seen().expect("reads"))
}

/// The share of pixels of which `claim` holds.
fn share(claims: impl Iterator<Item = bool>) -> f64 {
    let (mut yes, mut all) = (0_usize, 0_usize);
    claims.for_each(|claim| (yes, all) = (yes + usize::from(claim), all + 1));
    yes as f64 / all as f64
}

/// Shares of pixels: that see something else; and that do not and still look different, by more than a few levels.
fn differences(scene: &Scene, state: &State, shadow: Option<Shadow>) -> [f64; 2] {
    let look = Look { shadow, antialias: Antialias::None, ..scene.look };
    let scene = Scene::new(Parts { look, ..scene.parts() }).expect("a good scene");
    let [want, got] = [false, true].map(|by_cuda| still(&scene, state, by_cuda));
    let other = || got.1.iter().zip(&want.1).map(|(got, want)| got != want);
    let pixels = got.0.rgba.chunks_exact(4).zip(want.0.rgba.chunks_exact(4));
    let far = pixels.map(|(got, want)| got.iter().zip(want).any(|(got, want)| got.abs_diff(*want) > 6));
    [share(other()), share(far.zip(other()).map(|(far, other)| far && !other))]
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_what_pixels_see_and_their_light_are_opengls() {
    let made = scenes::scene(&[(3000, 12), (50, 0), (700, 3)], 5, true, false);
    let tree = modalcast::load::open("tree").expect("built in");
    let (moved, rest) = (scenes::state(&made, 1), State::rest(&tree));
    // A soup of triangles that pierce each other, many smaller than a texel of the map; and a tree with cut-out leaves.
    for (name, scene, state, most) in [("soup", &made, &moved, [0.01, 0.001, 0.05]), ("tree", &tree, &rest, [0.01; 3])]
    {
        let [ids, light] = differences(scene, state, None);
        let [_, shaded] = differences(scene, state, Some(Shadow::default()));
        eprintln!("{name}: {ids:.6} see another triangle, {light:.6} differ elsewhere, {shaded:.6} with shadows");
        assert!(ids <= most[0] && light <= most[1] && shaded <= most[2], "{name}");
    }
    let [ids, _] = differences(&made, &scenes::state(&made, 2), None);
    let other = [still(&made, &moved, true).1, still(&made, &scenes::state(&made, 2), true).1];
    let control = share(other[0].iter().zip(&other[1]).map(|(one, other)| one != other));
    assert!(ids < 0.01 && control > 0.05, "control: another step is seen otherwise: {control}");
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_frames_by_cuda_say_so_and_have_the_same_bits_again() {
    let scene = scenes::scene(&[(3000, 12), (50, 0), (700, 3)], 5, true, false);
    let states = [scenes::state(&scene, 1), scenes::state(&scene, 2)];
    let [want, got, again] =
        [Rastering::OpenGl, Rastering::Cuda, Rastering::Cuda].map(|raster| frames(&scene, raster, &states));
    for at in 0..states.len() {
        assert_eq!((got[at].paths, want[at].paths), (BY_CUDA, BY_OPENGL), "{at}");
        assert!(got[at].rgba == again[at].rgba, "{at}: other bits the second time");
    }
    assert!(got[0].rgba != got[1].rgba, "control: another step is another picture");
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_frames_by_cuda_under_way_keep_their_step_while_the_next_is_deformed() {
    let scene = scenes::scene(&[(3000, 12), (700, 3)], 5, false, false);
    let states: Vec<State> = (0..6).map(|seed| scenes::state(&scene, seed)).collect();
    let want = frames(&scene, Rastering::Cuda, &states);
    let (mut bench, drawn) = (open(), drawn_by(&scene, Rastering::Cuda));
    let camera = Camera::framing(&drawn, SIZE[0], SIZE[1]);
    let mut staged = bench.stage(&drawn).expect("staged");
    let mut images = Vec::new();
    let mut under_way = std::collections::VecDeque::new();
    for state in &states {
        staged.deform(state).expect("deforms");
        if under_way.len() == 3 {
            images.extend(under_way.pop_front().map(|oldest| bench.finish_draw(oldest).map(Pixels::into_image)));
        }
        under_way.push_back(bench.begin_draw(&mut staged, &camera, SIZE[0], SIZE[1]).expect("begins"));
    }
    images.extend(under_way.into_iter().map(|drawing| bench.finish_draw(drawing).map(Pixels::into_image)));
    for (at, (got, want)) in images.into_iter().zip(&want).enumerate() {
        assert!(got.expect("drawn").rgba == want.rgba, "frame {at}");
    }
    bench.unstage(staged);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_the_faster_way_is_chosen_by_measurement_and_frames_of_another_size_follow() {
    let scene = drawn_by(&scenes::scene(&[(3000, 12), (700, 3)], 3, false, false), Rastering::Fastest);
    let mut bench = open();
    let mut staged = bench.stage(&scene).expect("staged");
    for [width, height] in [[64, 48], [1920, 1080], [1, 1], [333, 77]] {
        let camera = Camera::framing(&scene, width, height);
        let image = bench.draw(&mut staged, &camera, width, height).expect("draws");
        eprintln!("{width} x {height}: {:?}", image.paths);
        assert!(image.paths.visibility.is_some());
        assert_eq!(image.rgba.len(), 4 * (width * height) as usize);
        staged.deform(&scenes::state(&scene, u64::from(width))).expect("deforms");
    }
    bench.unstage(staged);
}
