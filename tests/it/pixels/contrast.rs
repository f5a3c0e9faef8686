//! Contrast of a surface with the default backdrop at its silhouette.

use modalcast_model::domain::{Material, Mesh};
use modalcast_model::scene::{Camera, Lighting, RenderSettings, View};

use super::harness::{SceneBuilder, decode_srgb, open_renderer, render_square};

/// Side of the images in pixels.
const SIZE: u32 = 160;
/// Distance of the compared pixels from the silhouette.
const MARGIN: f64 = 3.0;

/// A unit sphere of 64 x 32 facets with smooth normals.
fn sphere() -> Mesh {
    const COLUMNS: u32 = 64;
    const ROWS: u32 = 32;
    let point = |index: u32| {
        let (azimuth, polar) = (
            f64::from(index % COLUMNS) / f64::from(COLUMNS) * std::f64::consts::TAU,
            f64::from(index / COLUMNS) / f64::from(ROWS) * std::f64::consts::PI,
        );
        [polar.sin() * azimuth.sin(), polar.cos(), polar.sin() * azimuth.cos()].map(|coordinate| coordinate as f32)
    };
    let points: Vec<[f32; 3]> = (0..COLUMNS * (ROWS + 1)).map(point).collect();
    let cell = |index: u32| {
        let next = index - index % COLUMNS + (index + 1) % COLUMNS;
        [[index, index + COLUMNS, next + COLUMNS], [index, next + COLUMNS, next]]
    };
    let triangles = (0..COLUMNS * ROWS).flat_map(cell).collect();
    Mesh::from_indexed(points.clone(), points, vec![], triangles).expect("expected a valid mesh")
}

/// CIELAB (D65) of an 8-bit sRGB color.
pub(super) fn lab(pixel: [u8; 3]) -> [f64; 3] {
    let [r, g, b] = pixel.map(decode_srgb);
    let xyz = [
        (0.4124 * r + 0.3576 * g + 0.1805 * b) / 0.9505,
        0.2126 * r + 0.7152 * g + 0.0722 * b,
        (0.0193 * r + 0.1192 * g + 0.9505 * b) / 1.089,
    ];
    let [x, y, z] = xyz.map(|t| if t > 0.008_856 { t.cbrt() } else { 7.787 * t + 16.0 / 116.0 });
    [116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)]
}

/// The color difference (CIE 1976) that nine tenths of the silhouette of a sphere exceed, between the surface and the
/// backdrop. The camera is the default one, whose view of the sphere is centered.
fn silhouette_contrast(material: Material, look: RenderSettings) -> f64 {
    let mut builder = SceneBuilder::new().add_domain(sphere(), material);
    builder.parts.look = look;
    let scene = builder.build();
    let camera = Camera::fit_to_scene(&scene, SIZE, SIZE);
    let View::LookAt { eye, .. } = camera.view else { panic!("expected a view by eye and target") };
    let distance = eye.iter().map(|coordinate| coordinate * coordinate).sum::<f64>().sqrt();
    // The vertical field of view of the default camera is 28 degrees.
    let focal_length = f64::from(SIZE) / 2.0 / 14_f64.to_radians().tan();
    let radius = focal_length * (1.0 / distance).asin().tan();
    let frame = render_square(&mut open_renderer(), &scene, camera, SIZE);
    let color_at = |degrees: u32, radius: f64| {
        let (sine, cosine) = f64::from(degrees).to_radians().sin_cos();
        let [x, y] = [cosine, -sine].map(|offset| (f64::from(SIZE) / 2.0 + radius * offset) as u32);
        lab(frame.pixel(x, y))
    };
    let mut differences: Vec<f64> = (0..360)
        .map(|degrees| {
            let (surface, backdrop) = (color_at(degrees, radius - MARGIN), color_at(degrees, radius + MARGIN));
            surface.iter().zip(backdrop).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
        })
        .collect();
    differences.sort_by(f64::total_cmp);
    // A tenth of the 360 differences are smaller.
    differences[36]
}

/// Negative control: the contrast of white with a pale sky.
#[test]
fn default_backdrop_contrasts_with_common_materials() {
    let colored = |color: [f32; 3]| Material { ambient: color, diffuse: color, ..Material::default() };
    let default = RenderSettings::default();
    let without_ground = RenderSettings { ground: None, ..default };
    for (name, material, least, least_without_ground) in [
        ("default", Material::unspecified(""), 14.0, 14.0),
        ("white", colored([1.0; 3]), 9.0, 17.0),
        ("light gray", colored([0.6; 3]), 7.0, 20.0),
        ("dark gray", colored([0.1; 3]), 18.0, 40.0),
        ("leaf", colored([0.1, 0.22, 0.05]), 25.0, 55.0),
        ("bark", colored([0.2, 0.15, 0.1]), 15.0, 42.0),
    ] {
        let contrast = silhouette_contrast(material.clone(), default);
        let contrast_without_ground = silhouette_contrast(material, without_ground);
        eprintln!("{name}: {contrast:.0} with ground, {contrast_without_ground:.0} without");
        assert!(contrast > least, "{name}: expected more than {least}, got {contrast}");
        assert!(
            contrast_without_ground > least_without_ground,
            "{name} without ground: expected more than {least_without_ground}, got {contrast_without_ground}"
        );
    }
    let studio = silhouette_contrast(Material::unspecified(""), Lighting::Studio.settings());
    eprintln!("default in a studio: {studio:.0}");
    assert!(studio > 20.0, "default in a studio: expected more than 20, got {studio}");
    let pale_sky = RenderSettings { horizon: [0.72, 0.82, 0.9], zenith: [0.16, 0.36, 0.72], ..without_ground };
    let white_on_pale_sky = silhouette_contrast(colored([1.0; 3]), pale_sky);
    eprintln!("white on a pale sky: {white_on_pale_sky:.0}");
    assert!(white_on_pale_sky < 9.0, "negative control: {white_on_pale_sky}");
}
