//! Frames whose triangles CUDA turns into samples, drawn as a server draws them: OpenGL's pictures, whatever is deformed
//! meanwhile, and the same bits again.

use std::sync::Arc;

use modalcast::config::{BackendChoice, Config};
use modalcast::engine::Workbench;
use modalcast::render::{Image, Path, Paths, Pixels};
use modalcast::scene::{Antialias, Camera, Look, Parts, Rastering, Scene, State};

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

/// The share of bytes that differ by more than a few levels.
fn far_off(one: &Image, other: &Image) -> f64 {
    let far = one.rgba.iter().zip(&other.rgba).filter(|(one, other)| one.abs_diff(**other) > 6).count();
    far as f64 / one.rgba.len() as f64
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_frames_by_cuda_are_opengls_and_have_the_same_bits_again() {
    let made = scenes::scene(&[(3000, 12), (50, 0), (700, 3)], 5, true, false);
    let tree = modalcast::load::open("tree").expect("built in");
    let states = |scene: &Scene| vec![scenes::state(scene, 1), scenes::state(scene, 2), State::rest(scene)];
    for (name, scene, states) in [("made", &made, states(&made)), ("tree", &tree, vec![State::rest(&tree)])] {
        let want = frames(scene, Rastering::OpenGl, &states);
        let got = frames(scene, Rastering::Cuda, &states);
        let again = frames(scene, Rastering::Cuda, &states);
        for (at, ((got, want), again)) in got.iter().zip(&want).zip(&again).enumerate() {
            assert_eq!((got.paths, want.paths), (BY_CUDA, BY_OPENGL), "{name} {at}");
            assert!(got.rgba == again.rgba, "{name} {at}: other bits the second time");
            let off = far_off(got, want);
            eprintln!("{name} {at}: {:.4} % of the bytes differ by more than 6 levels", 100.0 * off);
            assert!(off < 0.003, "{name} {at}: {off}");
        }
        if let [first, second, ..] = &got[..] {
            assert!(far_off(first, second) > 0.01, "control: {name}: another step is another picture");
        }
    }
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
