//! The CPU deformer reuses the exact normals of domains that a step does not change. The normals equal those of a new
//! deformer.

use modalcast_compute::cpu::CpuDeformer;
use modalcast_model::deform::{DeformedSurface, Deformer};
use modalcast_model::scene::{Scene, SceneState};

use super::fixtures::{create_scene, create_state, cube, shape_with_mode, sheet, sphere, tube};
use super::linear_parts;
use crate::deformers::TestRng;

/// A nonlinear mode.
fn wave([x, y, z]: [f32; 3]) -> [f32; 3] {
    [0.3 * y * z, 0.2 * x * x, (2.0 * x + y).sin() + 0.4 * z]
}

fn f32_bits(numbers: &[f32]) -> Vec<u32> {
    numbers.iter().map(|number| number.to_bits()).collect()
}

/// Positions, normals and tangents of a surface as bits.
fn surface_bits(surface: &DeformedSurface) -> [Vec<u32>; 3] {
    [&surface.positions, &surface.normals, &surface.tangents].map(|numbers| f32_bits(numbers))
}

/// Normals of one domain as bits.
fn normal_bits(scene: &Scene, surface: &DeformedSurface, domain: usize) -> Vec<u32> {
    let layout = scene.layout.domains[domain];
    f32_bits(&surface.normals[3 * layout.first_corner..][..3 * layout.corners])
}

/// Changes some domains and returns their indices. Step 0 changes q of domain 3, step 1 the transform of domain 1, step
/// 2 nothing, step 3 q and the transforms of all domains, and step 4 q of domains 0 and 2.
fn change_domains(scene: &Scene, state: &mut SceneState, step: usize, random: &mut TestRng) -> Vec<usize> {
    let domains = match step {
        0 => vec![3],
        1 => vec![1],
        2 => vec![],
        3 => (0..scene.domains.len()).collect(),
        _ => vec![0, 2],
    };
    for domain in &domains {
        let layout = scene.layout.domains[*domain];
        if step != 1 {
            state.q[layout.first_q..][..layout.rank].iter_mut().for_each(|number| *number += random.next());
        }
        if step % 2 == 1 {
            state.transforms[*domain].0.iter_mut().for_each(|number| *number += 0.3 * random.next());
        }
    }
    domains
}

/// After each step, positions, normals and tangents are bit-identical to those of new deformers with 1, 2 and 5
/// threads.
#[test]
fn unchanged_domains_keep_their_normals() {
    let meshes = [sheet(33, 30), cube(), tube(40, 20, 0.0), sphere(3), sheet(2, 2)];
    let scene = create_scene(meshes.map(|mesh| shape_with_mode(mesh, wave)).into());
    let mut state = create_state(&scene, 0.4, linear_parts()[2], [1.0, 2.0, 3.0]);
    let mut deformer = CpuDeformer::new(&scene);
    deformer.deform(&state).expect("expected the step to succeed");
    let (mut random, mut previous_surface) = (TestRng(3), deformer.surface().expect("expected a surface").clone());
    for step in 0..5 {
        let changed_domains = change_domains(&scene, &mut state, step, &mut random);
        deformer.deform(&state).expect("expected the step to succeed");
        let surface = deformer.surface().expect("expected a surface").clone();
        for domain in 0..scene.domains.len() {
            let is_unchanged = normal_bits(&scene, &surface, domain) == normal_bits(&scene, &previous_surface, domain);
            assert_eq!(is_unchanged, !changed_domains.contains(&domain), "step {step}, domain {domain}");
        }
        for threads in [1, 2, 5] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("expected a thread pool");
            let mut new_deformer = CpuDeformer::new(&scene);
            pool.install(|| new_deformer.deform(&state)).expect("expected the step to succeed");
            assert!(
                surface_bits(new_deformer.surface().expect("expected a surface")) == surface_bits(&surface),
                "step {step}, {threads} threads"
            );
        }
        previous_surface = surface;
    }
}
