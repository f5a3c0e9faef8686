//! Steps that overflow are reported, are refused with the name of the domain, and do not affect later steps.

use std::sync::Arc;

use modalcast::config::{BackendChoice, Config, RendererChoice};
use modalcast::engine::DeviceContext;
use modalcast_model::backend_settings::BackendSettings;
use modalcast_model::deform::Deformer;
use modalcast_model::domain::Transform;
use modalcast_model::scene::{DeformationSettings, Scene, SceneState, StorageType};

use super::{changes, run, scene_of, strip};
use crate::scenes::{self, Random};

/// Enough domains that a list of changes may name two of them.
fn scene(storage: StorageType) -> Arc<Scene> {
    let mut random = Random(71);
    let shapes = vec![
        strip(&mut random, 7, 2),
        scenes::shape(&mut random, 300, 2),
        strip(&mut random, 9, 3),
        scenes::shape(&mut random, 30, 0),
    ];
    scene_of(shapes, 2, DeformationSettings { storage, ..DeformationSettings::default() }, true)
}

/// Large enough that f32 overflows in the transform if it does not in the sum.
const FAR: Transform = Transform([1e3, -2e3, 1e3, 0.0, 1e3, 1e3, -3e3, 0.0, -1e3, 1e3, 1e3, 0.0]);

/// A step that overflows gives bounds that are not finite. The next valid step equals that of a fresh deformer.
pub(crate) fn overflow_is_told_and_forgotten<D: Deformer>(make: impl Fn(&Arc<Scene>) -> D) {
    for storage in StorageType::ALL {
        let scene = scene(storage);
        let (mut deformer, mut random) = (make(&scene), Random(72));
        let mut good = scenes::state(&scene, 73);
        let before = run(&mut deformer, &good);
        assert!(before.bounds.is_finite());
        for amount in [f32::MAX, -f32::MAX] {
            let mut bad = good.clone();
            changes::apply(&scene, &mut bad, &mut random, (&[1], &[1]));
            let first = scene.layout.slots[1].first_q;
            bad.q[first..first + 2].fill(amount);
            bad.transforms[1] = FAR;
            assert!(!deformer.deform(&bad).expect("deforms").bounds.is_finite(), "{}: {amount:e}", storage.name());
            // Another domain changes in the step after the refused one; the history of that state contains no overflow.
            changes::apply(&scene, &mut good, &mut random, (&[2], &[]));
            let after = run(&mut deformer, &good);
            assert!(after.bounds.is_finite() && after.difference(&before).is_some());
            assert_eq!(after.difference(&run(&mut make(&scene), &good)), None, "{}: {amount:e}", storage.name());
        }
    }
}

/// The step is refused with the name of its domain, and the vertices stay those of the last valid step.
pub(crate) fn overflow_is_refused_by_name(backend: BackendChoice) {
    let config = Config { backend, renderer: RendererChoice::Off, ..Config::default() };
    let mut bench = DeviceContext::open(&config).expect("a workbench");
    let scene = scene(StorageType::F32);
    let (mut staged, mut random) = (bench.load_scene(&scene, BackendSettings::default()).expect("stages"), Random(74));
    let mut good = SceneState::rest(&scene);
    changes::apply(&scene, &mut good, &mut random, (&[0, 5], &[5]));
    staged.deform(&good).expect("a good step");
    let before = staged.surface().expect("vertices").clone();
    for (domain, amount) in [(5, f32::MAX), (2, -f32::MAX), (5, 1e30)] {
        let mut bad = good.clone();
        changes::apply(&scene, &mut bad, &mut random, (&[domain], &[]));
        bad.q[scene.layout.slots[domain as usize].first_q] = amount;
        let refusal = staged.deform(&bad).expect_err("overflows").to_string();
        eprintln!("{refusal}");
        assert!(refusal.starts_with(&format!("step.q of domain 'domain {domain}'")), "{refusal}");
        assert_eq!(staged.surface().expect("vertices"), &before);
        assert!(staged.bounds().is_finite());
    }
    // The next step applies to the last valid step.
    changes::apply(&scene, &mut good, &mut random, (&[6], &[]));
    staged.deform(&good).expect("a good step");
    let after = staged.surface().expect("vertices").clone();
    assert_ne!(after, before, "the judge can fail");
    let mut fresh = bench.load_scene(&scene, BackendSettings::default()).expect("stages");
    fresh.deform(&good).expect("a good step");
    assert_eq!(fresh.surface().expect("vertices"), &after);
    bench.unload_scene(staged);
    bench.unload_scene(fresh);
}
