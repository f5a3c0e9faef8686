//! What a shadow map gains by being fitted to the vertices in light space, not to the corners of their bounds.

use modalcast_compute::cpu::CpuDeformer;
use modalcast_compute::reference::ReferenceDeformer;
use modalcast_model::deform::{Deformed, Deformer};
use modalcast_model::load;
use modalcast_model::scene::{Camera, Scene, State};
use modalcast_render::{Shot, shadow_texel};

/// Sides of a texel in scene units, by a deformation.
fn texel(scene: &Scene, deformed: &Deformed, is_lit: bool) -> [f64; 2] {
    let light = deformed.light.filter(|_| is_lit);
    let shot = Shot { camera: Camera::framing(scene, 64, 64), width: 64, height: 64, bounds: deformed.bounds, light };
    shadow_texel(scene, &shot).expect("the look has a shadow").map(|side| side.norm())
}

#[test]
fn texels_of_the_built_in_tree_have_less_than_half_the_area_that_the_corners_of_its_bounds_give_them() {
    let scene = load::open("tree").expect("built in");
    let state = State::rest(&scene);
    let exact = ReferenceDeformer::new(&scene).deform(&state).expect("deforms");
    let tiled = CpuDeformer::new(&scene).deform(&state).expect("deforms");
    let [corners, tiled, exact] =
        [texel(&scene, &exact, false), texel(&scene, &tiled, true), texel(&scene, &exact, true)];
    eprintln!("texel of the tree: {corners:?} by corners, {tiled:?} by boxes of tiles, {exact:?} by vertices");
    let area = |[x, y]: [f64; 2]| x * y;
    assert!(area(tiled) < 0.5 * area(corners), "{tiled:?}, {corners:?}");
    assert!(area(exact) <= area(tiled) && area(tiled) < 1.2 * area(exact), "{tiled:?}, {exact:?}");
}
