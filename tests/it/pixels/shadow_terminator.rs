//! The side of a coarse smooth ball that faces the sun is lit up to the line where the light of its smooth surface ends
//! (the shadow terminator), although triangles beside this line face away from the sun and are in their own shadow.

use std::sync::Arc;

use modalcast_model::domain::{Material, Mesh};
use modalcast_model::scene::{Scene, ShadowMethod, ShadowSettings};

use super::harness::{SceneBuilder, decode_srgb, facing_rectangle, front_camera, open_renderer, render_square};

/// Side of the image in pixels, of which 10 are one unit.
const SIZE: u32 = 96;
const RADIUS: f32 = 4.0;
const SUN: [f32; 3] = [0.8, 0.6, 0.0];
const SUNLIGHT: f64 = 0.5;
const SKYLIGHT: f64 = 0.25;

/// A ball of 12 meridians and 6 rows of quadrilaterals, with the normals of a smooth ball.
fn ball() -> Mesh {
    let (columns, rows) = (12_u16, 6_u16);
    let direction = |column: u16, row: u16| {
        let longitude = f32::from(column) / f32::from(columns) * std::f32::consts::TAU;
        let latitude = (f32::from(row) / f32::from(rows) - 0.5) * std::f32::consts::PI;
        [latitude.cos() * longitude.cos(), latitude.sin(), latitude.cos() * longitude.sin()]
    };
    let directions: Vec<[f32; 3]> =
        (0..=rows).flat_map(|row| (0..columns).map(move |column| direction(column, row))).collect();
    let vertex = |column: u16, row: u16| u32::from(row * columns + column % columns);
    let quads = (0..rows).flat_map(|row| (0..columns).map(move |column| (column, row)));
    let triangles = quads.flat_map(|(column, row)| {
        let [a, b] = [vertex(column, row), vertex(column + 1, row)];
        let [c, d] = [vertex(column + 1, row + 1), vertex(column, row + 1)];
        [[a, d, b], [b, d, c]]
    });
    let scaled = |scale: f32| directions.iter().map(move |direction| direction.map(|x| scale * x)).collect();
    Mesh::from_indexed(scaled(RADIUS), scaled(1.0), vec![[0.0; 2]; directions.len()], triangles.collect())
        .expect("expected a valid mesh")
}

/// A white ball, with a square in front of it if the ball is to be in its shadow.
fn scene(shadow: Option<ShadowSettings>, has_caster: bool) -> Arc<Scene> {
    let mut builder = SceneBuilder::new();
    builder.parts.look.shadow = shadow;
    builder.parts.look.sun = SUN;
    let white = Material { diffuse: [1.0; 3], ambient: [1.0; 3], specular: [0.0; 3], ..Material::default() };
    builder = builder.add_domain(ball(), white);
    if has_caster {
        // Right of the image and between the sun and the ball.
        let mut mesh = facing_rectangle(-9.0, -9.0, 9.0, 9.0, 0.0);
        let positions = mesh.rest_positions().iter().map(|[x, y, _]| [16.0 + 0.6 * x, 12.0 - 0.8 * x, *y]).collect();
        mesh = Mesh::from_indexed(positions, vec![[-0.8, -0.6, 0.0]; 4], vec![[0.0; 2]; 4], vec![[0, 1, 2], [0, 2, 3]])
            .expect("expected a valid mesh");
        builder = builder.add_domain(mesh, Material { double_sided: true, ..Material::default() });
    }
    builder.build()
}

/// Sunlight of each pixel of the image, from 0 to 1.
fn sunlight(scene: &Arc<Scene>) -> Vec<f64> {
    let frame = render_square(&mut open_renderer(), scene, front_camera(SIZE), SIZE);
    let pixels = (0..SIZE).flat_map(|y| (0..SIZE).map(move |x| (x, y)));
    pixels.map(|(x, y)| (decode_srgb(frame.pixel(x, y)[0]) - SKYLIGHT) / SUNLIGHT).collect()
}

/// Mean and largest loss of sunlight by the shadow map over the pixels that have at least a tenth of the light.
fn lost_sunlight(shadow: ShadowSettings) -> [f64; 2] {
    let lit = sunlight(&scene(None, false));
    let shadowed = sunlight(&scene(Some(shadow), false));
    let losses: Vec<f64> =
        lit.iter().zip(shadowed).filter(|(lit, _)| **lit >= 0.1).map(|(lit, shadowed)| lit - shadowed).collect();
    assert!(losses.len() > 1500, "expected a lit half of the ball, got {} pixels", losses.len());
    [losses.iter().sum::<f64>() / losses.len() as f64, losses.iter().copied().fold(0.0, f64::max)]
}

#[test]
fn coarse_smooth_ball_has_no_dark_triangles_at_the_terminator() {
    for method in [ShadowMethod::PercentageCloser, ShadowMethod::Standard, ShadowMethod::Variance] {
        for (size, blur) in [(512, 1.5), (1024, 1.5), (2048, 3.0)] {
            let shadow = ShadowSettings { method, size, blur, ..ShadowSettings::default() };
            let [mean, max] = lost_sunlight(shadow);
            println!("{method:?}, {size}: {mean:.5} of the sunlight is lost on average, at most {max:.4}");
            assert!(mean < 0.002 && max < 0.05, "{method:?}, {size}: lost {mean}, at most {max}");
        }
    }
}

/// Control: a caster in front of the ball darkens all of it.
#[test]
fn shadows_remain_on_a_coarse_smooth_ball() {
    for method in [ShadowMethod::PercentageCloser, ShadowMethod::Standard, ShadowMethod::Variance] {
        let shadow = ShadowSettings { method, size: 1024, ..ShadowSettings::default() };
        let lit = sunlight(&scene(Some(shadow), true));
        let brightest = lit.iter().copied().fold(0.0, f64::max);
        assert!(brightest < 0.02, "{method:?}: expected a ball in the shadow of the square, got {brightest}");
    }
}
