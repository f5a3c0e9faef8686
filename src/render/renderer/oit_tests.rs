//! Order-independent transparency: pictures of both ways to find the coverage of a fragment, and compiled programs.

use std::rc::Rc;

use super::Renderer;
use crate::device;
use crate::scene_data::geometry::tests::squares;
use crate::{DevicePreference, FrameParams};
use modalcast_model::deform::DeformedSurface;
use modalcast_model::domain::{AlphaMode, Material};
use modalcast_model::scene::{BoundingBox, Camera, Scene, Transparency};

/// Draws a glass square in front of an opaque square and another behind it, 64 pixels wide; returns the pixels and
/// the renderer.
fn drawn(transparency: Transparency, alpha_mode: AlphaMode, post_depth_coverage: bool) -> (Vec<u8>, Renderer) {
    let glass = Material { alpha: 0.5, alpha_mode, double_sided: true, ..Material::default() };
    let mut parts = squares(vec![Material { diffuse: [0.9, 0.2, 0.1], ..Material::default() }, glass.clone(), glass]);
    // No shadow: light that varies within a pixel would reveal where in the pixel a fragment is shaded.
    (parts.look.transparency, parts.look.shadow) = (transparency, None);
    // Slightly rotated, so that edges cross pixels.
    let corner = |z: f32, angle: f32, [x, y]: [f32; 2]| {
        let (sine, cosine) = angle.sin_cos();
        [cosine * x - sine * y, sine * x + cosine * y, z]
    };
    let square = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
    let positions: Vec<[f32; 3]> = [(0.0, 0.3), (0.3, 0.5), (-0.3, 0.7)]
        .into_iter()
        .flat_map(|(z, angle)| square.map(|at| corner(z, angle, at)))
        .collect();
    let mut bounds = BoundingBox::EMPTY;
    positions.iter().for_each(|position| bounds.include(position.map(f64::from)));
    let surface = DeformedSurface {
        positions: positions.as_flattened().to_vec(),
        normals: [0.0, 0.0, 1.0].repeat(positions.len()),
        ..DeformedSurface::default()
    };
    let scene = Scene::new(parts).expect("good");
    let (mut gl, cuda_device) = device::open(DevicePreference::Any).expect("EGL");
    Rc::get_mut(&mut gl).expect("not shared yet").limits.post_depth_coverage &= post_depth_coverage;
    let mut renderer = Renderer::new(gl, cuda_device).expect("images");
    let buffers = renderer.load(&scene).expect("loads");
    renderer.upload(&buffers, &surface).expect("uploads");
    let camera = Camera::fit_to_scene(&scene, 64, 64);
    let image =
        renderer.draw(&buffers, &FrameParams { camera, width: 64, height: 64, bounds, light: None }).expect("draws");
    (image.rgba, renderer)
}

#[test]
fn a_fragment_a_pixel_with_its_samples_and_a_fragment_a_sample_give_the_same_picture() {
    let (known, renderer) = drawn(Transparency::OrderIndependent, AlphaMode::Blend, true);
    let (apart, other) = drawn(Transparency::OrderIndependent, AlphaMode::Blend, false);
    let worst = known.iter().zip(&apart).map(|(a, b)| a.abs_diff(*b)).max();
    assert!(worst <= Some(2), "{worst:?} levels");
    let [few, many] = [&renderer, &other].map(|renderer| renderer.stats().oit.expect("exact").fragments);
    assert!(!renderer.gl.limits.post_depth_coverage || many > 3 * few, "control: {few} and {many} fragments");
}

#[test]
fn only_the_method_that_the_look_names_is_compiled_and_neither_without_blended_triangles() {
    let compiled = |transparency, alpha_mode| {
        let (_, renderer) = drawn(transparency, alpha_mode, true);
        let any = |name: &str| renderer.programs.labels().any(|label| label.starts_with(name));
        (["oit gather", "oit histogram", "oit allocate", "oit resolve"].map(any), any("blended"))
    };
    assert_eq!(compiled(Transparency::OrderIndependent, AlphaMode::Opaque), ([false; 4], false));
    assert_eq!(compiled(Transparency::TwoPass, AlphaMode::Opaque), ([false; 4], false));
    assert_eq!(compiled(Transparency::OrderIndependent, AlphaMode::Blend), ([true; 4], false));
    assert_eq!(compiled(Transparency::TwoPass, AlphaMode::Blend), ([false; 4], true));
}
