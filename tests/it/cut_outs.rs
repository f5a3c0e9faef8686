//! Alpha tests of cut-outs in the reference rasterizer. A soup is a list of triangles that need not form a surface. Its
//! viewport has one sample per pixel, at the center. The footprint of a sample consists of the texture coordinates
//! there and of their derivatives by pixel column (x) and row (y).

use modalcast_compute::reference::raster::cut_out::{Footprint, alpha, footprint};
use modalcast_compute::reference::raster::{VisibilityBuffer, corners};
use modalcast_model::raster::{AlphaImage, AlphaMaterial, CutOuts};
use modalcast_model::scene::Viewport;
use nalgebra::{Matrix3, Vector3};

use crate::common::cut_outs::{alpha_image, constant_alpha_soups, floor_soup, sheet_soup};
use crate::common::soups::{clip_space_viewport, perspective_viewport};

/// Texture coordinates where the ray through a point of the viewport meets the plane of a triangle, in f64. `x` and `y`
/// are in pixels from the upper left corner. The camera is the one of [`perspective_viewport`]: at the origin, with a
/// vertical field of view of 60 degrees.
fn ray_cast_uv(viewport: &Viewport, triangle: [[f64; 3]; 3], uvs: [[f64; 2]; 3], [x, y]: [f64; 2]) -> [f64; 2] {
    let [width, height] = viewport.size().map(f64::from);
    let focal = 1.0 / 30.0_f64.to_radians().tan();
    let ray = Vector3::new((2.0 * x / width - 1.0) * width / height / focal, (1.0 - 2.0 * y / height) / focal, -1.0);
    let [a, b, c] = triangle.map(Vector3::from);
    // Solve a + s (b - a) + t (c - a) = r ray for (s, t, r).
    let solution =
        Matrix3::from_columns(&[b - a, c - a, -ray]).lu().solve(&-a).expect("expected a triangle with an area");
    [0, 1].map(|axis| {
        uvs[0][axis] + solution[0] * (uvs[1][axis] - uvs[0][axis]) + solution[1] * (uvs[2][axis] - uvs[0][axis])
    })
}

/// A sample of a triangle whose footprint is tested.
struct FootprintCase {
    triangle: [[f64; 3]; 3],
    uvs: [[f64; 2]; 3],
    pixel: [i32; 2],
    viewport: Viewport,
}

impl FootprintCase {
    /// Largest error of the footprint's texture coordinates, and largest difference between its derivatives and central
    /// differences.
    fn max_errors(&self) -> (f64, f64) {
        let positions: Vec<f32> = self.triangle.as_flattened().iter().map(|number| *number as f32).collect();
        let corners = corners(&self.viewport, &positions, [0, 1, 2]);
        let result =
            footprint(&self.viewport, &corners, &self.uvs.map(|uv| uv.map(|number| number as f32)), self.pixel);
        let center = self.pixel.map(|index| f64::from(index) + 0.5);
        let uv_at =
            |dx: f64, dy: f64| ray_cast_uv(&self.viewport, self.triangle, self.uvs, [center[0] + dx, center[1] + dy]);
        let max_error = |actual: [f32; 2], expected: [f64; 2]| {
            (0..2).map(|axis| (f64::from(actual[axis]) - expected[axis]).abs()).fold(0.0, f64::max)
        };
        // Texture coordinates at 1e-3 pixels after and before the center.
        let central_difference =
            |after: [f64; 2], before: [f64; 2]| [0, 1].map(|axis| (after[axis] - before[axis]) / 2e-3);
        let dx_error = max_error(result.duv_dx, central_difference(uv_at(1e-3, 0.0), uv_at(-1e-3, 0.0)));
        let dy_error = max_error(result.duv_dy, central_difference(uv_at(0.0, 1e-3), uv_at(0.0, -1e-3)));
        (max_error(result.uv, uv_at(0.0, 0.0)), dx_error.max(dy_error))
    }
}

/// The two triangles are a tilted one and one with two corners behind the eye.
#[test]
fn footprints_match_ray_cast_texture_coordinates() {
    let viewport = perspective_viewport(192, 128, 0.1, 100.0);
    let uvs = [[0.0, 0.0], [3.0, 0.0], [3.0, 5.0]];
    let tilted_triangle = [[-2.0, -2.0, -3.0], [2.5, -1.0, -5.0], [0.3, 3.0, -9.0]];
    let triangle_behind_eye = [[-9.0, -1.0, 9.0], [9.0, -1.0, 9.0], [2.0, -1.0, -20.0]];
    let (mut max_uv_error, mut max_derivative_error) = (0.0_f64, 0.0_f64);
    for (triangle, pixels) in
        [(tilted_triangle, [[90, 60], [101, 70], [80, 66]]), (triangle_behind_eye, [[96, 80], [96, 120], [99, 100]])]
    {
        for pixel in pixels {
            let (uv_error, derivative_error) = FootprintCase { triangle, uvs, pixel, viewport }.max_errors();
            max_uv_error = max_uv_error.max(uv_error);
            max_derivative_error = max_derivative_error.max(derivative_error);
        }
    }
    // Texture coordinates are up to 5, where numbers in f32 are 5e-7 apart. The limits allow for several roundings.
    assert!(
        max_uv_error < 1e-5 && max_derivative_error < 1e-4,
        "error of texture coordinates {max_uv_error}, of derivatives {max_derivative_error}"
    );
    // Negative control: a triangle whose corners are projected to the plane z = -1 covers the same pixels, but its
    // texture coordinates are interpolated without perspective.
    let affine_uv = ray_cast_uv(&viewport, tilted_triangle.map(|[x, y, z]| [-x / z, -y / z, -1.0]), uvs, [90.5, 60.5]);
    let perspective_uv = ray_cast_uv(&viewport, tilted_triangle, uvs, [90.5, 60.5]);
    assert!(
        (affine_uv[0] - perspective_uv[0]).abs() > 0.05,
        "expected a difference, got {affine_uv:?} without perspective and {perspective_uv:?} with perspective"
    );
}

#[test]
fn small_triangles_at_viewport_border_keep_precision() {
    // The triangle lies in the last column, around the center of the pixel. Its width and height are 1/50 pixel.
    let viewport = clip_space_viewport(16384, 64);
    let pixel = [16383, 1];
    // Clip space is 2 units wide and high, so a pixel is 1/8192 units wide and 1/32 units high.
    let center = [1.0 - 0.5 / 8192.0, 1.0 - 1.5 / 32.0];
    let half_size = [0.01 / 8192.0, 0.01 / 32.0];
    let position = |x: f64, y: f64| [center[0] + half_size[0] * x, center[1] + half_size[1] * y, 0.0];
    let positions: Vec<f32> = [position(-1.0, -1.0), position(1.0, -1.0), position(0.0, 1.0)]
        .as_flattened()
        .iter()
        .map(|number| *number as f32)
        .collect();
    let result =
        footprint(&viewport, &corners(&viewport, &positions, [0, 1, 2]), &[[0.0, 0.0], [1.0, 0.0], [0.5, 1.0]], pixel);
    // Below 1, numbers in f32 are 2^-24 apart, which is 1/2048 pixel. Rounding to f32 thus moves each corner by up to
    // 1/4096 pixel, 1.2 % of the triangle's width. The texture coordinate u changes by 1 over this width of 1/50 pixel.
    // The limits of 6 % and 10 % allow for such errors at several corners.
    assert!((result.uv[0] - 0.5).abs() < 0.06 && (result.uv[1] - 0.5).abs() < 0.06, "{result:?}");
    assert!((result.duv_dx[0] / 50.0 - 1.0).abs() < 0.1, "{result:?}");
    // The shifted triangle lies less than 1/100 pixel to the right of the sample. Rasterizers may draw the sample
    // because of rounding. The sample gets the texture coordinates of the nearest point of the triangle, not
    // extrapolated ones.
    let shifted_positions = [position(0.2, -1.0), position(2.0, -1.0), position(1.2, 1.0)]
        .as_flattened()
        .iter()
        .map(|number| *number as f32)
        .collect::<Vec<_>>();
    let result = footprint(
        &viewport,
        &corners(&viewport, &shifted_positions, [0, 1, 2]),
        &[[0.0, 0.0], [1.0, 0.0], [0.5, 1.0]],
        pixel,
    );
    assert!((0.0..=1.0).contains(&result.uv[0]) && (0.0..=1.0).contains(&result.uv[1]), "{result:?}");
}

/// The footprint is zero for a triangle without area, for corners whose products overflow or underflow, and for texture
/// coordinates that are not finite or whose difference overflows.
#[test]
fn degenerate_footprints_are_zero() {
    let viewport = clip_space_viewport(8, 8);
    let uvs = [[0.5, 0.25], [1.0, 0.0], [0.0, 1.0]];
    let footprint_of = |corners: [[f32; 4]; 3], uvs: [[f32; 2]; 3]| footprint(&viewport, &corners, &uvs, [3, 3]);
    let valid_corners = [[-1.0, -1.0, 0.0, 1.0], [1.0, -1.0, 0.0, 1.0], [0.0, 1.0, 0.0, 1.0]];
    assert!(footprint_of(valid_corners, uvs) != Footprint::default());
    assert_eq!(footprint_of([valid_corners[0]; 3], uvs), Footprint::default());
    assert_eq!(footprint_of(valid_corners.map(|corner| corner.map(|number| number * 1e30)), uvs), Footprint::default());
    assert_eq!(
        footprint_of(valid_corners.map(|corner| corner.map(|number| number * 1e-30)), uvs),
        Footprint::default()
    );
    assert_eq!(footprint_of(valid_corners, [[f32::NAN; 2], uvs[1], uvs[2]]), Footprint::default());
    assert_eq!(footprint_of(valid_corners, [[3e38, 0.0], [-3e38, 0.0], uvs[2]]), Footprint::default());
}

/// Cut-outs whose only alpha-tested triangle has index 4.
fn cut_outs_of_image(image: AlphaImage) -> CutOuts {
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
    let cut_outs = cut_outs_of_image(alpha_image(4, 1, |level, column, _| [51 * column as u8, 255, 0][level as usize]));
    let alpha_at = |u: f32, du_dx: f32| {
        let footprint = Footprint { uv: [u, 0.3], duv_dx: [du_dx, 0.0], duv_dy: [0.0; 2] };
        alpha(&cut_outs, 4, &footprint)
    };
    let assert_close =
        |actual: f32, expected: f32| assert!((actual - expected).abs() < 1e-6, "expected {expected}, got {actual}");
    // Texel centers of level 0 are at u = 1/8, 3/8, 5/8 and 7/8. A texel of level 0 is 1/4 wide, so level 0 is used up
    // to du_dx = 1/4, level 1 at 1/2, and level 2 from 1 on. Between these values, the two levels are blended.
    assert_close(alpha_at(0.125, 0.0), 0.0);
    assert_close(alpha_at(0.375, 0.25), 0.2);
    assert_close(alpha_at(0.5, 0.1), 0.3);
    // u = 0 is halfway between the last texel of a repetition and the first texel of the next one.
    assert_close(alpha_at(0.0, 0.0), 0.3);
    for repeat in [-2.0, 1.0, 5.0] {
        assert_close(alpha_at(0.375 + repeat, 0.0), 0.2);
    }
    // Level 1.
    assert_close(alpha_at(0.375, 0.5), 1.0);
    // Halfway between levels 0 and 1.
    assert_close(alpha_at(0.375, 0.25 * 2.0_f32.sqrt()), 0.6);
    // Level 2.
    assert_close(alpha_at(0.375, 1.0), 0.0);
    assert_close(alpha_at(0.375, 1e30), 0.0);
    // Level 0.
    assert_close(alpha_at(0.375, f32::MIN_POSITIVE), 0.2);
}

/// A sheet that is drawn with one sample per texel covers the samples of its opaque texels. At half the size, it covers
/// the samples of the opaque texels of mip level 1.
#[test]
fn sheet_reproduces_its_image_at_levels_0_and_1() {
    let mut random = crate::scenes::Random(3);
    let image = alpha_image(64, 64, |_, _, _| if random.next_number() < 0.0 { 0 } else { 255 });
    for level in [0, 1] {
        let visibility = sheet_soup(64 >> level, image.clone()).rasterize();
        let is_covered: Vec<bool> = visibility.ids().iter().map(Option::is_some).collect();
        let is_opaque: Vec<bool> = image.levels[level].iter().map(|texel| *texel == 255).collect();
        assert!(is_covered == is_opaque, "level {level}");
    }
    let reversed = image.levels[0].iter().rev().map(|texel| *texel == 255).collect::<Vec<_>>();
    assert!(
        sheet_soup(64, image).rasterize().ids().iter().map(Option::is_some).ne(reversed),
        "negative control: the reversed image differs"
    );
}

/// An image is uniform if all of its texels have the same alpha.
#[test]
fn uniform_images_keep_all_or_nothing_of_a_triangle() {
    let mut different_samples = 0;
    for cut_out_soup in constant_alpha_soups() {
        let (soup, cut_outs) = (&cut_out_soup.soup, &cut_out_soup.cut_outs);
        // For each of the seven materials, whether the alpha test keeps all samples; otherwise it discards all. It
        // keeps a sample if the alpha (material times image) is at least the cutoff. The alphas and cutoffs are (0,
        // 0.5), (1, 0.5), (0.25, 0.5), (0, 0), (0.75, 0.75), (0.5, 0.75) and (1, NaN).
        let is_material_opaque = [false, true, false, true, true, false, false];
        let mut expected = VisibilityBuffer::new(soup.viewport);
        for group in &soup.groups {
            for triangle in group.first_triangle..group.first_triangle + group.triangle_count {
                let cut_out_index = triangle.checked_sub(cut_outs.first);
                let material = cut_out_index.map(|index| cut_outs.material_indices[index as usize]);
                if material.is_none_or(|material| is_material_opaque[material as usize]) {
                    let range = modalcast_model::scene::DrawRange {
                        first_triangle: triangle,
                        triangle_count: 1,
                        cull_mode: group.cull_mode,
                    };
                    expected.draw(&soup.positions, &soup.triangles, range);
                }
            }
        }
        let rasterized = cut_out_soup.rasterize();
        assert!(rasterized.keys == expected.keys, "{}", soup.name);
        // A key holds the depth and the triangle of a sample.
        different_samples +=
            rasterized.keys.iter().zip(&soup.rasterize().keys).filter(|(key, plain_key)| key != plain_key).count();
    }
    assert!(different_samples > 10_000, "negative control: {different_samples} samples differ without cut-outs");
}

/// The wall is visible through the holes of the floor, which are its transparent texels. Few samples are ambiguous
/// (their alpha is near the cutoff). Splitting the floor into 40 x 40 rectangles changes few samples.
#[test]
fn wall_shows_through_holes_of_the_floor() {
    let cut_out_soup = floor_soup(1);
    // Triangles 0 and 1 are the wall.
    let is_floor = |id: &Option<u32>| id.is_some_and(|id| id >= 2);
    let is_wall = |id: &Option<u32>| id.is_some_and(|id| id < 2);
    let ids = cut_out_soup.rasterize().ids();
    let wall_samples = ids.iter().filter(|id| is_wall(id)).count();
    let floor_samples = ids.iter().filter(|id| is_floor(id)).count();
    // Samples of the floor without its alpha test.
    let opaque_samples = cut_out_soup.soup.rasterize().ids().iter().filter(|id| is_floor(id)).count();
    assert!(
        floor_samples > opaque_samples / 5 && floor_samples < opaque_samples * 4 / 5 && wall_samples > 1000,
        "{floor_samples} of {opaque_samples} floor samples remain, {wall_samples} samples of the wall are visible"
    );
    let ambiguous_samples =
        cut_out_soup.ambiguous_samples(1.0 / 16.0).iter().filter(|is_ambiguous| **is_ambiguous).count();
    assert!(
        (100..opaque_samples / 4).contains(&ambiguous_samples),
        "{ambiguous_samples} of {opaque_samples} samples are ambiguous"
    );
    let split_ids = floor_soup(40).rasterize().ids();
    let different_samples =
        ids.iter().zip(&split_ids).filter(|(id, split_id)| is_floor(id) != is_floor(split_id)).count();
    assert!(
        different_samples < opaque_samples / 50,
        "split floor: {different_samples} of {opaque_samples} samples differ"
    );
}
