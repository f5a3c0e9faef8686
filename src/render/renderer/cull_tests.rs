//! Negative controls: culling tests that remove too much change the picture. Also tests which scenes are culled at all.

use std::rc::Rc;
use std::sync::Arc;

use super::Renderer;
use crate::device::gl::Limits;
use crate::pass::Pass;
use crate::plan::ScenePlan;
use crate::plan::culling::{cull_buffer_sizes, select_culling};
use crate::scene_data::geometry::tests::squares;
use crate::shaders::ProgramSource;
use crate::{BlurMethod, DevicePreference, FrameParams, SceneBuffers};
use modalcast_model::deform::DeformedSurface;
use modalcast_model::domain::{Material, Mesh, Modes, Shape};
use modalcast_model::scene::{Camera, Culling, Lens, Scene, View};

/// A sheet of 24 x 24 squares behind a smaller sheet; both are single-sided.
fn sheets() -> Arc<Scene> {
    let mut rest = Vec::new();
    let mut indices = Vec::new();
    for (half, z) in [(2.0, 0.0), (1.0, 0.5)] {
        for index in 0..24_u32 * 24 {
            let [x, y] = [index % 24, index / 24].map(|step| half * (step as f32 / 12.0 - 1.0));
            let (first, side) = (rest.len() as u32, half / 12.0);
            rest.extend([[x, y, z], [x + side, y, z], [x + side, y + side, z], [x, y + side, z]]);
            indices.extend([[first, first + 1, first + 2], [first, first + 2, first + 3]]);
        }
    }
    let normals = vec![[0.0, 0.0, 1.0]; rest.len()];
    let mesh = Mesh::from_indexed(rest, normals, vec![], indices).expect("sheets");
    let mut parts = squares(vec![Material::default()]);
    parts.shapes[0] = Shape::new(mesh, Modes::rigid()).expect("rigid");
    parts.look.culling = Culling::Occlusion;
    (parts.look.shadow, parts.look.ground) = (None, None);
    Scene::new(parts).expect("good")
}

/// The second frame of a scene whose culling shader has `greedy` in place of `just`.
fn picture(scene: &Arc<Scene>, (just, greedy): (&str, &str)) -> Vec<u8> {
    let mut renderer = Renderer::open(DevicePreference::Any).expect("EGL and OpenGL 4.3");
    let (gl, places) = (Rc::clone(&renderer.gl), renderer.sample_positions.clone());
    let mut found = false;
    let compile = &mut |mut source: ProgramSource| {
        for (_, text) in &mut source.stages {
            found |= source.label.starts_with("cull triangles, 4") && text.contains(just);
            *text = text.replace(just, greedy);
        }
        renderer.programs.program(source)
    };
    let buffers = SceneBuffers::new(&gl, scene, &places, BlurMethod::Auto, compile).expect("loads");
    assert!(found, "the shader says no '{just}'");
    let corners = scene.shapes[0].mesh.corners();
    let (positions, normals) = (scene.shapes[0].mesh.rest_positions().as_flattened(), corners.normals.as_flattened());
    let surface =
        DeformedSurface { positions: positions.to_vec(), normals: normals.to_vec(), ..DeformedSurface::default() };
    renderer.upload(&buffers, &surface).expect("uploads");
    let view = View::LookAt { eye: [0.3, 0.2, 4.0], target: [0.1, 0.0, 0.0], up: [0.0, 1.0, 0.0] };
    let lens = Lens::Intrinsics { fx: 90.0, fy: 90.0, cx: 32.0, cy: 32.0 };
    let camera = Camera { view, lens, near: 0.0, far: 0.0 };
    let shot = FrameParams { camera, width: 64, height: 64, bounds: scene.rest_bounds, light: None };
    renderer.draw(&buffers, &shot).expect("draws");
    let second = renderer.draw(&buffers, &shot).expect("draws").rgba;
    assert!(renderer.stats().culled.is_some_and(|culled| culled.camera.culled() > 0));
    second
}

#[test]
fn a_scene_whose_lists_are_larger_than_a_buffer_may_be_is_not_culled_and_says_so() {
    let mut parts = squares(vec![Material::default()]);
    for culling in [Culling::Triangles, Culling::Occlusion] {
        parts.look.culling = culling;
        let scene = Scene::new(parts.clone()).expect("good");
        let sizes = cull_buffer_sizes(&scene, culling).expect("culled");
        let largest = sizes.named().map(|(_, bytes)| *bytes).max().expect("lists");
        assert_eq!(sizes.indices, 12 * scene.layout.triangles as u64);
        let on = |max_storage_bytes: u64| select_culling(&scene, &Limits { max_storage_bytes, ..Limits::default() });
        assert_eq!((on(largest), on(largest - 1)), (culling, Culling::None));
        let limits = Limits { max_storage_bytes: largest - 1, ..Limits::default() };
        let plan = ScenePlan::new(&scene, &limits, BlurMethod::Auto).report;
        assert!(!plan.defines("CULLED") && !plan.passes.contains(&Pass::Cull));
        assert!(plan.omitted.iter().any(|saving| saving.feature == "culling"));
    }
}

#[test]
fn each_test_that_is_too_greedy_is_seen_in_the_picture() {
    let scene = sheets();
    let just = picture(&scene, ("shared", "shared"));
    for greedy in [
        ("below[axis] && low[axis] < -margin[axis]", "below[axis] && low[axis] < 2.0"),
        ("above[axis] && high[axis] < -margin[axis]", "above[axis] && high[axis] < 2.0"),
        ("area < -unsure", "area < unsure + 20.0"),
        ("ceil(low - place)", "ceil(low - place + 8.0)"),
        ("nearest - margin))", "nearest + 0.5))"),
        (
            "if (!(depths[base + y * size.x + x] < depth)) return false;",
            "if (depths[base + y * size.x + x] < depth) return true;",
        ),
    ] {
        assert!(picture(&scene, greedy) != just, "{greedy:?} changes nothing");
    }
}
