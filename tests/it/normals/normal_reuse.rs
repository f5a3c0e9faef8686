//! Exact normals of unchanged domains are reused between steps and equal those of a fresh deformer.

use modalcast_compute::cpu::CpuDeformer;
use modalcast_model::deform::{DeformedSurface, Deformer};
use modalcast_model::scene::{Scene, SceneState};

use super::fixtures::{cube, scene, sheet, sphere, state, tube, with_mode};
use super::linear_parts;
use crate::deformers::TestRng;

/// A displacement that bends and shears.
fn wave([x, y, z]: [f32; 3]) -> [f32; 3] {
    [0.3 * y * z, 0.2 * x * x, (2.0 * x + y).sin() + 0.4 * z]
}

fn bits(numbers: &[f32]) -> Vec<u32> {
    numbers.iter().map(|number| number.to_bits()).collect()
}

/// Positions, normals and tangents of a surface as bits.
fn all(surface: &DeformedSurface) -> [Vec<u32>; 3] {
    [&surface.positions, &surface.normals, &surface.tangents].map(|numbers| bits(numbers))
}

/// Normals of one domain as bits.
fn normals_of(scene: &Scene, surface: &DeformedSurface, domain: usize) -> Vec<u32> {
    let slot = scene.layout.slots[domain];
    bits(&surface.normals[3 * slot.first_corner..][..3 * slot.corners])
}

/// Changes q of some domains, their transforms, or both, depending on the step. Returns the changed domains.
fn change(scene: &Scene, state: &mut SceneState, step: usize, noise: &mut TestRng) -> Vec<usize> {
    let domains = match step {
        0 => vec![3],
        1 => vec![1],
        2 => vec![],
        3 => (0..scene.domains.len()).collect(),
        _ => vec![0, 2],
    };
    for domain in &domains {
        let slot = scene.layout.slots[*domain];
        if step != 1 {
            state.q[slot.first_q..][..slot.rank].iter_mut().for_each(|number| *number += noise.next());
        }
        if step % 2 == 1 {
            state.transforms[*domain].0.iter_mut().for_each(|number| *number += 0.3 * noise.next());
        }
    }
    domains
}

/// After each step, all vertices and directions have the bits of a fresh deformer with any number of threads.
#[test]
fn unchanged_domains_keep_their_normals() {
    let meshes = [sheet(33, 30), cube(), tube(40, 20, 0.0), sphere(3), sheet(2, 2)];
    let scene = scene(meshes.map(|mesh| with_mode(mesh, wave)).into());
    let mut state = state(&scene, 0.4, linear_parts()[2], [1.0, 2.0, 3.0]);
    let mut kept = CpuDeformer::new(&scene);
    kept.deform(&state).expect("expected the step to succeed");
    let (mut noise, mut before) = (TestRng(3), kept.surface().expect("one").clone());
    for step in 0..5 {
        let changed = change(&scene, &mut state, step, &mut noise);
        kept.deform(&state).expect("expected the step to succeed");
        let now = kept.surface().expect("one").clone();
        for domain in 0..scene.domains.len() {
            let same = normals_of(&scene, &now, domain) == normals_of(&scene, &before, domain);
            assert_eq!(same, !changed.contains(&domain), "step {step}, domain {domain}");
        }
        for threads in [1, 2, 5] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
            let mut fresh = CpuDeformer::new(&scene);
            pool.install(|| fresh.deform(&state)).expect("expected the step to succeed");
            assert!(all(fresh.surface().expect("one")) == all(&now), "step {step}, {threads} threads");
        }
        before = now;
    }
}
