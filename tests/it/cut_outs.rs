//! Alpha tests of cut-outs in the compute rasterizer, compared with geometry.

use modalcast_compute::reference::raster::cut_out::{Footprint, alpha, footprint};
use modalcast_compute::reference::raster::{VisibilityBuffer, corners};
use modalcast_model::raster::{AlphaImage, AlphaMaterial, CutOuts};
use modalcast_model::scene::Viewport;
use nalgebra::{Matrix3, Vector3};

use crate::common::cut_outs::{alpha_image, floor_soup, sheet_soup, uniform_cut_out_soups};
use crate::common::soups::{clip_space_viewport, perspective_viewport};

/// Texture coordinates at the point where the ray through a sample meets the plane of a triangle, in f64. The eye is
/// that of [`perspective_viewport`], with a vertical field of view of 60 degrees.
fn by_ray(viewport: &Viewport, triangle: [[f64; 3]; 3], uvs: [[f64; 2]; 3], [x, y]: [f64; 2]) -> [f64; 2] {
    let [width, height] = viewport.size().map(f64::from);
    let focal = 1.0 / 30.0_f64.to_radians().tan();
    let ray = Vector3::new((2.0 * x / width - 1.0) * width / height / focal, (1.0 - 2.0 * y / height) / focal, -1.0);
    let [a, b, c] = triangle.map(Vector3::from);
    // Solve a + s (b - a) + t (c - a) = r ray.
    let solved = Matrix3::from_columns(&[b - a, c - a, -ray]).lu().solve(&-a).expect("expected a valid mesh");
    [0, 1].map(|axis| {
        uvs[0][axis] + solved[0] * (uvs[1][axis] - uvs[0][axis]) + solved[1] * (uvs[2][axis] - uvs[0][axis])
    })
}

struct Case {
    triangle: [[f64; 3]; 3],
    uvs: [[f64; 2]; 3],
    pixel: [i32; 2],
    viewport: Viewport,
}

impl Case {
    /// Largest error of the texture coordinates of the footprint, and largest error of their derivatives. The
    /// derivatives are compared with central differences.
    fn errors(&self) -> (f64, f64) {
        let positions: Vec<f32> = self.triangle.as_flattened().iter().map(|number| *number as f32).collect();
        let corners = corners(&self.viewport, &positions, [0, 1, 2]);
        let got = footprint(&self.viewport, &corners, &self.uvs.map(|uv| uv.map(|number| number as f32)), self.pixel);
        let middle = self.pixel.map(|at| f64::from(at) + 0.5);
        let at = |x: f64, y: f64| by_ray(&self.viewport, self.triangle, self.uvs, [middle[0] + x, middle[1] + y]);
        let worst = |got: [f32; 2], want: [f64; 2]| {
            (0..2).map(|axis| (f64::from(got[axis]) - want[axis]).abs()).fold(0.0, f64::max)
        };
        let slope = |high: [f64; 2], low: [f64; 2]| [0, 1].map(|axis| (high[axis] - low[axis]) / 2e-3);
        let across = worst(got.across, slope(at(1e-3, 0.0), at(-1e-3, 0.0)));
        let down = worst(got.down, slope(at(0.0, 1e-3), at(0.0, -1e-3)));
        (worst(got.uv, at(0.0, 0.0)), across.max(down))
    }
}

/// Footprints equal the ray-cast texture coordinates and derivatives, also for triangles with corners behind the eye.
#[test]
fn texture_coordinates_match_ray_cast_behind_the_eye() {
    let viewport = perspective_viewport(192, 128, 0.1, 100.0);
    let uvs = [[0.0, 0.0], [3.0, 0.0], [3.0, 5.0]];
    let tilted = [[-2.0, -2.0, -3.0], [2.5, -1.0, -5.0], [0.3, 3.0, -9.0]];
    let through = [[-9.0, -1.0, 9.0], [9.0, -1.0, 9.0], [2.0, -1.0, -20.0]];
    let mut worst = (0.0_f64, 0.0_f64);
    for (triangle, pixels) in [(tilted, [[90, 60], [101, 70], [80, 66]]), (through, [[96, 80], [96, 120], [99, 100]])] {
        for pixel in pixels {
            let (of_uv, of_change) = Case { triangle, uvs, pixel, viewport }.errors();
            worst = (worst.0.max(of_uv), worst.1.max(of_change));
        }
    }
    assert!(worst.0 < 1e-5 && worst.1 < 1e-4, "{worst:?}");
    let affine = by_ray(&viewport, tilted.map(|[x, y, z]| [-x / z, -y / z, -1.0]), uvs, [90.5, 60.5]);
    let right = by_ray(&viewport, tilted, uvs, [90.5, 60.5]);
    assert!((affine[0] - right[0]).abs() > 0.05, "negative control: without perspective {affine:?} for {right:?}");
}

#[test]
fn small_triangles_at_window_border_keep_precision() {
    // The window is 16384 pixels wide. The triangle lies in the last column and is 1/50 pixel in size.
    let viewport = clip_space_viewport(16384, 64);
    let pixel = [16383, 1];
    let middle = [1.0 - 0.5 / 8192.0, 1.0 - 1.5 / 32.0];
    let size = [0.01 / 8192.0, 0.01 / 32.0];
    let at = |x: f64, y: f64| [middle[0] + size[0] * x, middle[1] + size[1] * y, 0.0];
    let positions: Vec<f32> =
        [at(-1.0, -1.0), at(1.0, -1.0), at(0.0, 1.0)].as_flattened().iter().map(|number| *number as f32).collect();
    let got =
        footprint(&viewport, &corners(&viewport, &positions, [0, 1, 2]), &[[0.0, 0.0], [1.0, 0.0], [0.5, 1.0]], pixel);
    // f32 resolves 1/16384^2 of the window here, which is a twentieth of this triangle.
    assert!((got.uv[0] - 0.5).abs() < 0.06 && (got.uv[1] - 0.5).abs() < 0.06, "{got:?}");
    assert!((got.across[0] / 50.0 - 1.0).abs() < 0.1, "{got:?}");
    // The sample lies outside of the triangle by a rounding step. Its coordinates are those of the nearest point of the
    // triangle, not extrapolated ones.
    let beside =
        [at(0.2, -1.0), at(2.0, -1.0), at(1.2, 1.0)].as_flattened().iter().map(|n| *n as f32).collect::<Vec<_>>();
    let got =
        footprint(&viewport, &corners(&viewport, &beside, [0, 1, 2]), &[[0.0, 0.0], [1.0, 0.0], [0.5, 1.0]], pixel);
    assert!((0.0..=1.0).contains(&got.uv[0]) && (0.0..=1.0).contains(&got.uv[1]), "{got:?}");
}

/// Triangles without area, overflowing corners and texture coordinates that are not finite give a zero footprint.
#[test]
fn degenerate_footprints_are_zero() {
    let viewport = clip_space_viewport(8, 8);
    let uvs = [[0.5, 0.25], [1.0, 0.0], [0.0, 1.0]];
    let of = |corners: [[f32; 4]; 3], uvs: [[f32; 2]; 3]| footprint(&viewport, &corners, &uvs, [3, 3]);
    let good = [[-1.0, -1.0, 0.0, 1.0], [1.0, -1.0, 0.0, 1.0], [0.0, 1.0, 0.0, 1.0]];
    assert!(of(good, uvs) != Footprint::default());
    assert_eq!(of([good[0]; 3], uvs), Footprint::default());
    assert_eq!(of(good.map(|corner| corner.map(|number| number * 1e30)), uvs), Footprint::default());
    assert_eq!(of(good.map(|corner| corner.map(|number| number * 1e-30)), uvs), Footprint::default());
    assert_eq!(of(good, [[f32::NAN; 2], uvs[1], uvs[2]]), Footprint::default());
    assert_eq!(of(good, [[3e38, 0.0], [-3e38, 0.0], uvs[2]]), Footprint::default());
}

fn of_image(image: AlphaImage) -> CutOuts {
    let materials = vec![AlphaMaterial { alpha: 1.0, cutoff: 0.5, image: Some(0) }];
    CutOuts {
        first: 4,
        uvs: vec![[[0.0; 2]; 3]],
        material_indices: vec![0],
        materials,
        images: vec![image],
        anisotropy: 1.0,
    }
}

#[test]
fn alpha_images_repeat_and_filter_trilinearly() {
    // Level 0 is a row of 4 texels with values 0, 51, 102 and 153. Level 1 is two texels of 255, and level 2 is one
    // texel of 0.
    let cut_outs = of_image(alpha_image(4, 1, |level, column, _| [51 * column as u8, 255, 0][level as usize]));
    let at = |u: f32, change: f32| {
        let footprint = Footprint { uv: [u, 0.3], across: [change, 0.0], down: [0.0; 2] };
        alpha(&cut_outs, 4, &footprint)
    };
    let is = |got: f32, want: f32| assert!((got - want).abs() < 1e-6, "{got} for {want}");
    is(at(0.125, 0.0), 0.0);
    is(at(0.375, 0.25), 0.2);
    is(at(0.5, 0.1), 0.3);
    // Halfway between the last texel and the first.
    is(at(0.0, 0.0), 0.3);
    for repeat in [-2.0, 1.0, 5.0] {
        is(at(0.375 + repeat, 0.0), 0.2);
    }
    is(at(0.375, 0.5), 1.0);
    is(at(0.375, 0.25 * 2.0_f32.sqrt()), 0.6);
    is(at(0.375, 1.0), 0.0);
    is(at(0.375, 1e30), 0.0);
    is(at(0.375, f32::MIN_POSITIVE), 0.2);
}

/// A sheet with one sample per texel reproduces its image row by row; at half the size it reproduces level 1.
#[test]
fn sheet_reproduces_its_image_at_levels_0_and_1() {
    let mut random = crate::scenes::Random(3);
    let own = alpha_image(64, 64, |_, _, _| if random.next_number() < 0.0 { 0 } else { 255 });
    for level in [0, 1] {
        let keys = sheet_soup(64 >> level, own.clone()).rasterize();
        let seen: Vec<bool> = keys.ids().iter().map(Option::is_some).collect();
        let want: Vec<bool> = own.levels[level].iter().map(|texel| *texel == 255).collect();
        assert!(seen == want, "level {level}");
    }
    let turned = own.levels[0].iter().rev().map(|texel| *texel == 255).collect::<Vec<_>>();
    assert!(sheet_soup(64, own).rasterize().ids().iter().map(Option::is_some).ne(turned), "negative control");
}

#[test]
fn uniform_images_keep_all_or_nothing_of_a_triangle() {
    let mut differing = 0;
    for holes in uniform_cut_out_soups() {
        let (soup, cut_outs) = (&holes.soup, &holes.cut_outs);
        // Whether each surface of the table keeps any sample.
        let keeps = [false, true, false, true, true, false, false];
        let mut kept = VisibilityBuffer::new(soup.viewport);
        for group in &soup.groups {
            for triangle in group.first..group.first + group.triangles {
                let own = triangle.checked_sub(cut_outs.first);
                if own.is_none_or(|own| keeps[cut_outs.material_indices[own as usize] as usize]) {
                    let one = modalcast_model::scene::DrawRange { first: triangle, triangles: 1, faces: group.faces };
                    kept.draw(&soup.positions, &soup.triangles, one);
                }
            }
        }
        let drawn = holes.rasterize();
        assert!(drawn.keys == kept.keys, "{}", soup.name);
        differing += drawn.keys.iter().zip(&soup.rasterize().keys).filter(|(cut, whole)| cut != whole).count();
    }
    assert!(differing > 10_000, "negative control: {differing} samples see something else than without holes");
}

/// The floor is cut by its image, few of its samples are doubtful, and splitting it into smaller triangles changes few
/// samples.
#[test]
fn wall_shows_through_holes_of_the_floor() {
    let holes = floor_soup(1);
    let ids = holes.rasterize().ids();
    let of = |wanted: fn(u32) -> bool| ids.iter().flatten().filter(|id| wanted(**id)).count();
    let (wall, seen) = (of(|id| id < 2), of(|id| id >= 2));
    let whole = holes.soup.rasterize().ids().iter().flatten().filter(|id| **id >= 2).count();
    assert!(seen > whole / 5 && seen < whole * 4 / 5 && wall > 1000, "{seen} of {whole}, {wall}");
    let doubtful = holes.ambiguous_samples(1.0 / 16.0).iter().filter(|doubt| **doubt).count();
    assert!((100..whole / 4).contains(&doubtful), "{doubtful} of {whole}");
    let pieces = floor_soup(40).rasterize().ids();
    let same = |(a, b): (&Option<u32>, &Option<u32>)| a.is_some_and(|id| id >= 2) == b.is_some_and(|id| id >= 2);
    let unlike = ids.iter().zip(&pieces).filter(|pair| !same(*pair)).count();
    assert!(unlike < whole / 50, "in pieces {unlike} of {whole} samples differ");
}
