//! Negative controls of culling: if the culling shader is modified so that it removes too many triangles, the image
//! must change. Another test checks when culling is omitted.

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

/// Two single-sided sheets of 24 x 24 squares each. The sheet of side 2 at z = 0.5 hides a part of the sheet of side 4
/// at z = 0.
fn sheets() -> Arc<Scene> {
    let mut rest_positions = Vec::new();
    let mut indices = Vec::new();
    for (half_side, z) in [(2.0, 0.0), (1.0, 0.5)] {
        for square in 0..24_u32 * 24 {
            let [x, y] = [square % 24, square / 24].map(|step| half_side * (step as f32 / 12.0 - 1.0));
            let (first_vertex, square_side) = (rest_positions.len() as u32, half_side / 12.0);
            rest_positions.extend([
                [x, y, z],
                [x + square_side, y, z],
                [x + square_side, y + square_side, z],
                [x, y + square_side, z],
            ]);
            indices.extend([
                [first_vertex, first_vertex + 1, first_vertex + 2],
                [first_vertex, first_vertex + 2, first_vertex + 3],
            ]);
        }
    }
    let normals = vec![[0.0, 0.0, 1.0]; rest_positions.len()];
    let mesh = Mesh::from_indexed(rest_positions, normals, vec![], indices).expect("sheets");
    let mut parts = squares(vec![Material::default()]);
    parts.shapes[0] = Shape::new(mesh, Modes::rigid()).expect("rigid");
    parts.look.culling = Culling::Occlusion;
    (parts.look.shadow, parts.look.ground) = (None, None);
    Scene::new(parts).expect("a valid scene")
}

/// Draws two frames of a scene, with `original` replaced by `replacement` in the culling shader, and returns the
/// second. The first frame has no occluders, because these are the triangles that were visible in the last frame.
fn draw_second_frame(scene: &Arc<Scene>, (original, replacement): (&str, &str)) -> Vec<u8> {
    let mut renderer = Renderer::open(DevicePreference::Any).expect("EGL and OpenGL 4.3");
    let (gl, sample_positions) = (Rc::clone(&renderer.gl), renderer.sample_positions.clone());
    let mut has_original = false;
    let compile = &mut |mut source: ProgramSource| {
        for (_, text) in &mut source.stages {
            // The program that culls for the camera with four samples per pixel.
            has_original |= source.label.starts_with("cull triangles, 4") && text.contains(original);
            *text = text.replace(original, replacement);
        }
        renderer.programs.program(source)
    };
    let buffers = SceneBuffers::new(&gl, scene, &sample_positions, BlurMethod::Auto, [Vec::new(), Vec::new()], compile)
        .expect("loads");
    assert!(has_original, "expected '{original}' in the shader");
    let corners = scene.shapes[0].mesh.corners();
    let (positions, normals) = (scene.shapes[0].mesh.rest_positions().as_flattened(), corners.normals.as_flattened());
    let surface =
        DeformedSurface { positions: positions.to_vec(), normals: normals.to_vec(), ..DeformedSurface::default() };
    renderer.upload(&buffers, &surface).expect("uploads");
    let view = View::LookAt { eye: [0.3, 0.2, 4.0], target: [0.1, 0.0, 0.0], up: [0.0, 1.0, 0.0] };
    let lens = Lens::Intrinsics { fx: 90.0, fy: 90.0, cx: 32.0, cy: 32.0 };
    // Near and far 0: the planes are fitted to the bounds.
    let camera = Camera { view, lens, near: 0.0, far: 0.0 };
    let params = FrameParams {
        camera,
        width: 64,
        height: 64,
        bounds: scene.rest_bounds,
        light_bounds: None,
        edges: None,
        samples: None,
    };
    renderer.draw(&buffers, &params).expect("draws");
    let image = renderer.draw(&buffers, &params).expect("draws").rgba;
    assert!(renderer.stats().culled.is_some_and(|culled| culled.camera.culled() > 0));
    image
}

#[test]
fn culling_is_omitted_if_lists_exceed_the_buffer_limit() {
    let mut parts = squares(vec![Material::default()]);
    for culling in [Culling::Triangles, Culling::Occlusion] {
        parts.look.culling = culling;
        let scene = Scene::new(parts.clone()).expect("a valid scene");
        let sizes = cull_buffer_sizes(&scene, culling).expect("culling buffers");
        let max_buffer_bytes = sizes.named().map(|(_, bytes)| *bytes).max().expect("buffers");
        assert_eq!(sizes.indices, 12 * scene.layout.triangles as u64, "expected three u32 per triangle");
        let select_for =
            |max_storage_bytes: u64| select_culling(&scene, &Limits { max_storage_bytes, ..Limits::default() });
        assert_eq!((select_for(max_buffer_bytes), select_for(max_buffer_bytes - 1)), (culling, Culling::None));
        let limits = Limits { max_storage_bytes: max_buffer_bytes - 1, ..Limits::default() };
        let plan = ScenePlan::new(&scene, &limits, BlurMethod::Auto).report;
        assert!(!plan.has_define("CULLED") && !plan.passes.contains(&Pass::Cull));
        assert!(plan.omitted.iter().any(|feature| feature.feature == "culling"));
    }
}

#[test]
fn each_culling_test_that_removes_too_much_changes_the_image() {
    let scene = sheets();
    // Replacing a word by itself gives the image of the original shader.
    let expected_image = draw_second_frame(&scene, ("shared", "shared"));
    // Each replacement makes one culling test remove visible triangles.
    for replacement in [
        // Planes of the view volume.
        (
            "is_below[axis] && lower_distance[axis] < -lower_margin[axis]",
            "is_below[axis] && lower_distance[axis] < 2.0",
        ),
        ("is_above[axis] && upper_distance[axis] < -margin[axis]", "is_above[axis] && upper_distance[axis] < 2.0"),
        // Back faces.
        ("area < -area_error", "area < area_error + 20.0"),
        // Triangles without a sample.
        ("ceil(min_position - sample_position)", "ceil(min_position - sample_position + 8.0)"),
        // Occlusion: the margin of the depth, and the comparison with the depth pyramid.
        ("nearest + margin))", "nearest * 0.5))"),
        (
            "if (!(depths[level_offset + y * size.x + x] > depth)) return false;",
            "if (depths[level_offset + y * size.x + x] > depth) return true;",
        ),
    ] {
        let image = draw_second_frame(&scene, replacement);
        assert!(image != expected_image, "expected another image with {replacement:?}");
    }
}
