//! A shadow map fitted to the vertices in light space has smaller texels than one fitted to the corners of the scene
//! bounds.

use modalcast_compute::cpu::CpuDeformer;
use modalcast_compute::reference::ReferenceDeformer;
use modalcast_model::deform::Deformer;
use modalcast_model::load;
use modalcast_model::scene::{BoundingBox, Camera, OrientedBounds, Scene, SceneState};
use modalcast_render::{FrameParams, shadow_texel_axes};

/// Side lengths of a shadow map texel in scene units. The map is fitted to `light_bounds` (the bounds in light space),
/// or without these to the corners of `bounds`.
fn texel_size(scene: &Scene, bounds: BoundingBox, light_bounds: Option<OrientedBounds>) -> [f64; 2] {
    let params = FrameParams {
        camera: Camera::fit_to_scene(scene, 64, 64),
        width: 64,
        height: 64,
        bounds,
        light_bounds,
        edges: None,
        samples: None,
    };
    shadow_texel_axes(scene, &params).expect("expected a scene with a shadow").map(|side| side.norm())
}

/// The deformer gives the light-space boxes of tiles (groups of up to 128 vertices). Texels of a map fitted to these
/// boxes have less than half the area of texels of a map fitted to the corners of the scene bounds, and less than 1.2
/// times the area of texels of a map fitted to the vertices.
#[test]
fn light_space_fit_halves_the_shadow_texels_of_the_tree() {
    let scene = load::open("tree").expect("expected the built-in scene").scene;
    let state = SceneState::rest(&scene);
    let reference_summary = ReferenceDeformer::new(&scene)
        .with_bounding_axes(scene.light_axes())
        .deform(&state)
        .expect("expected the step to succeed");
    let cpu_summary = CpuDeformer::new(&scene)
        .with_bounding_axes(scene.light_axes())
        .deform(&state)
        .expect("expected the step to succeed");
    // The reference has the exact bounds of the vertices in light space. The CPU deformer has the bounds of the boxes
    // of its tiles.
    let [corner_fit, tile_fit, vertex_fit] = [
        texel_size(&scene, reference_summary.bounds, None),
        texel_size(&scene, cpu_summary.bounds, cpu_summary.oriented_bounds),
        texel_size(&scene, reference_summary.bounds, reference_summary.oriented_bounds),
    ];
    eprintln!(
        "texel size of the tree, fitted to corners: {corner_fit:?}, to tiles: {tile_fit:?}, to vertices: {vertex_fit:?}"
    );
    let area = |[x, y]: [f64; 2]| x * y;
    assert!(area(tile_fit) < 0.5 * area(corner_fit), "{tile_fit:?}, {corner_fit:?}");
    assert!(
        area(vertex_fit) <= area(tile_fit) && area(tile_fit) < 1.2 * area(vertex_fit),
        "{tile_fit:?}, {vertex_fit:?}"
    );
}
