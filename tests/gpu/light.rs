//! What vertices take up in light space, by `bounds`: against its twin tile by tile, and what it costs.

use modalcast_compute::gpu::{Cache, Device, Extent, Ours, Trial, time};
use modalcast_model::deform::Deformer;
use modalcast_model::scene::{Deformation, Scene, State};

use crate::both::light::{self, TILE, along, beyond, coil, reach};
use crate::both::scene_of;
use crate::scenes::{self, Random};
use crate::twins::deformer;

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_what_vertices_take_up_in_light_space_holds_every_one_of_them() {
    light::every_vertex_is_held(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_a_thin_scene_is_fitted_closely_in_light_space() {
    light::a_thin_scene_is_fitted_closely(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_light_space_is_not_measured_without_a_shadow_and_overflow_there_is_told() {
    light::nothing_is_measured_without_a_shadow_and_overflow_is_told(deformer);
}

/// One domain's tiles are its vertices in their order, 128 each.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_light_bounds_are_those_of_the_boxes_of_tiles_at_every_size() {
    for vertices in [2, 31, 32, 33, 127, 128, 129, 257, 5000, 16085, 200_000] {
        let scene = scene_of(vec![coil(vertices, 3)], 1, Deformation::default(), false);
        let mut deformer = deformer(&scene);
        for seed in 0..3 {
            let deformed = deformer.deform(&scenes::state(&scene, seed)).expect("deforms");
            let (light, positions) =
                (deformed.light.expect("measured"), &deformer.surface().expect("copies").positions);
            let (want, allowed) = (along(&scene, positions, TILE), 4e-7 * reach(&deformed.bounds));
            let (inside, outside) = (beyond(&light, &want), beyond(&want, &light));
            assert!(inside <= 0.0 && outside <= allowed, "n {vertices}: {light:?}, expected {want:?}");
        }
        let other = deformer.deform(&State::rest(&scene)).expect("deforms").light.expect("measured");
        let moved = deformer.deform(&scenes::state(&scene, 0)).expect("deforms").light.expect("measured");
        assert!(beyond(&other, &moved).max(beyond(&moved, &other)) > 1e-3, "control");
    }
}

/// Microseconds of a whole step of a scene with a shadow and without.
fn costs(name: &str, (vertices, rank): (usize, usize), instances: usize) -> [f64; 2] {
    let device = Device::open(0).expect("a CUDA device");
    let with = [true, false].map(|is_lit| {
        let mut parts = scenes::parts(vec![scenes::shape(&mut Random(9), vertices, rank)]);
        parts.domains = vec![scenes::domain(0, 0); instances];
        parts.look.shadow = parts.look.shadow.filter(|_| is_lit);
        let scene = Scene::new(parts).expect("a scene");
        let trial = Ours::new(&device, &scene, &[scenes::state(&scene, 1)], Extent::Whole).expect("a trial");
        trial.kernels().iter().for_each(|facts| eprintln!("{name}, shadow {is_lit}: {facts:?}"));
        time(&device, &trial, Cache::Warm, 300).expect("times").median_us
    });
    eprintln!("{name}: {:.2} us a step with light space, {:.2} us without", with[0], with[1]);
    with
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_light_space_costs_little_of_a_step() {
    // Shapes are of so many vertices and modes.
    for (name, shape, instances) in [
        ("one domain of 16,085", (16_085, 20), 1),
        ("a million vertices", (1_000_000, 32), 1),
        ("20,000 domains of 7", (7, 3), 20_000),
        ("200,000 domains of 60", (60, 0), 200_000),
    ] {
        let [with, without] = costs(name, shape, instances);
        assert!(with > 0.0 && with < 1.1 * without + 5.0, "{name}: {with} and {without} us");
    }
}
