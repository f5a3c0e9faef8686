//! Tests of order-independent transparency: images with and without post-depth coverage, and compiled programs.

use std::rc::Rc;

use super::Renderer;
use crate::device;
use crate::scene_data::geometry::tests::squares;
use crate::{DevicePreference, FrameParams};
use modalcast_model::deform::DeformedSurface;
use modalcast_model::domain::{AlphaMode, Material};
use modalcast_model::scene::{BoundingBox, Camera, Scene, Transparency};

/// Draws a red square between two squares of `alpha_mode` into 64 x 64 pixels; returns the pixels and the renderer.
/// `post_depth_coverage`: if the device supports it, list one fragment of a triangle per pixel instead of one per
/// sample.
fn draw_glass(transparency: Transparency, alpha_mode: AlphaMode, post_depth_coverage: bool) -> (Vec<u8>, Renderer) {
    let glass = Material { alpha: 0.5, alpha_mode, double_sided: true, ..Material::default() };
    let mut parts = squares(vec![Material { diffuse: [0.9, 0.2, 0.1], ..Material::default() }, glass.clone(), glass]);
    // No shadow: light must not vary within a pixel, because fragments per pixel and fragments per sample are shaded at
    // different points of it.
    (parts.look.transparency, parts.look.shadow) = (transparency, None);
    // The squares are rotated, so that their edges cross pixels. The angles are in radians.
    let corner = |z: f32, angle: f32, [x, y]: [f32; 2]| {
        let (sine, cosine) = angle.sin_cos();
        [cosine * x - sine * y, sine * x + cosine * y, z]
    };
    let square = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
    let positions: Vec<[f32; 3]> = [(0.0, 0.3), (0.3, 0.5), (-0.3, 0.7)]
        .into_iter()
        .flat_map(|(z, angle)| square.map(|point| corner(z, angle, point)))
        .collect();
    let mut bounds = BoundingBox::EMPTY;
    positions.iter().for_each(|position| bounds.include(position.map(f64::from)));
    let surface = DeformedSurface {
        positions: positions.as_flattened().to_vec(),
        normals: [0.0, 0.0, 1.0].repeat(positions.len()),
        ..DeformedSurface::default()
    };
    let scene = Scene::new(parts).expect("a valid scene");
    let (mut gl, cuda_device) = device::open(DevicePreference::Any).expect("EGL");
    Rc::get_mut(&mut gl).expect("the only reference").limits.post_depth_coverage &= post_depth_coverage;
    let mut renderer = Renderer::new(gl, cuda_device).expect("a renderer");
    let buffers = renderer.load(&scene).expect("loads");
    renderer.upload(&buffers, &surface).expect("uploads");
    let camera = Camera::fit_to_scene(&scene, 64, 64);
    let image = renderer
        .draw(
            &buffers,
            &FrameParams { camera, width: 64, height: 64, bounds, light_bounds: None, edges: None, samples: None },
        )
        .expect("draws");
    (image.rgba, renderer)
}

#[test]
fn per_pixel_and_per_sample_fragments_give_the_same_image() {
    let (pixel_shaded, pixel_renderer) = draw_glass(Transparency::OrderIndependent, AlphaMode::Blend, true);
    let (sample_shaded, sample_renderer) = draw_glass(Transparency::OrderIndependent, AlphaMode::Blend, false);
    let max_difference = pixel_shaded.iter().zip(&sample_shaded).map(|(a, b)| a.abs_diff(*b)).max();
    assert!(max_difference <= Some(2), "expected a difference of at most 2 levels of 255, got {max_difference:?}");
    // Each pixel has four samples. The factor is less than four, because edges cover only some samples of a pixel.
    let [pixel_fragments, sample_fragments] =
        [&pixel_renderer, &sample_renderer].map(|renderer| renderer.stats().oit.expect("list statistics").fragments);
    assert!(
        !pixel_renderer.gl.limits.post_depth_coverage || sample_fragments > 3 * pixel_fragments,
        "expected over 3 times as many fragments per sample as per pixel, got {sample_fragments} and {pixel_fragments}"
    );
}

#[test]
fn only_programs_of_the_used_transparency_are_compiled() {
    let compiled = |transparency, alpha_mode| {
        let (_, renderer) = draw_glass(transparency, alpha_mode, true);
        let has_program = |prefix: &str| renderer.programs.labels().any(|label| label.starts_with(prefix));
        (["oit gather", "oit histogram", "oit allocate", "oit resolve"].map(has_program), has_program("blended"))
    };
    assert_eq!(compiled(Transparency::OrderIndependent, AlphaMode::Opaque), ([false; 4], false));
    assert_eq!(compiled(Transparency::TwoPass, AlphaMode::Opaque), ([false; 4], false));
    assert_eq!(compiled(Transparency::OrderIndependent, AlphaMode::Blend), ([true; 4], false));
    assert_eq!(compiled(Transparency::TwoPass, AlphaMode::Blend), ([false; 4], true));
}
