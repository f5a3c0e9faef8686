//! Overlapping blended triangles. With order-independent transparency (OIT), the order in the scene does not affect the
//! image. With two-pass transparency, triangles are blended in scene order.
//!
//! OIT stores the blended fragments of each pixel in a list, sorts the list by depth, and blends it. The fragment
//! budget of a scene is the number of fragments that all lists of a frame can store together.

use std::sync::Arc;

use modalcast_model::domain::{AlphaMode, Material, Mesh};
use modalcast_model::scene::{Scene, Transparency};
use modalcast_render::{OitStats, Pass};

use super::harness::{
    RenderedFrame, SceneBuilder, facing_rectangle, front_camera, is_close, open_renderer, render, render_square,
};

/// A material lit by skylight alone. As the skylight of [`create_builder`] is 1, the material appears in its color.
fn unlit_material(ambient: [f32; 3]) -> Material {
    Material { ambient, diffuse: [0.0; 3], ..Material::default() }
}

fn glass_material(ambient: [f32; 3], alpha: f32) -> Material {
    Material { alpha, alpha_mode: AlphaMode::Blend, double_sided: true, ..unlit_material(ambient) }
}

fn create_builder(transparency: Transparency, samples: u32) -> SceneBuilder {
    let mut builder = SceneBuilder::new();
    builder.parts.look.skylight = [1.0; 3];
    (builder.parts.look.transparency, builder.parts.look.samples) = (transparency, samples);
    builder
}

/// A pane in the plane of the given z. For every z, it covers 40 x 40 = 1600 pixels at the center of a [`front_camera`]
/// image.
fn pane(z: f32) -> Mesh {
    // The camera is at z = 10. At z = 0, four units are 40 pixels.
    let half_side = 2.0 * (10.0 - z) / 10.0;
    facing_rectangle(-half_side, -half_side, half_side, half_side, z)
}

/// Blends layers of a color and an alpha over black. The first layer is the farthest.
fn blend(layers: &[([f32; 3], f32)]) -> [f64; 3] {
    layers.iter().fold([0.0; 3], |below, (color, alpha)| {
        let mix =
            |channel: usize| f64::from(*alpha) * f64::from(color[channel]) + (1.0 - f64::from(*alpha)) * below[channel];
        [mix(0), mix(1), mix(2)]
    })
}

fn oit_stats(frame: &RenderedFrame) -> OitStats {
    frame.stats.oit.expect("expected order-independent transparency")
}

const RED: [f32; 3] = [1.0, 0.1, 0.0];
const GREEN: [f32; 3] = [0.0, 0.8, 0.2];
const BLUE: [f32; 3] = [0.1, 0.3, 1.0];

/// Negative control: two passes are correct only for layers in back-to-front order.
#[test]
fn two_layers_blend_exactly_in_either_order() {
    let expected = blend(&[(GREEN, 0.5), (RED, 0.25)]);
    for samples in [1, 4] {
        let render_with = |transparency, is_near_first: bool| {
            let mut panes = vec![(pane(-1.0), glass_material(GREEN, 0.5)), (pane(0.0), glass_material(RED, 0.25))];
            if is_near_first {
                panes.reverse();
            }
            let add_pane = |builder: SceneBuilder, (mesh, material)| builder.add_domain(mesh, material);
            render(&panes.into_iter().fold(create_builder(transparency, samples), add_pane).build()).pixel(30, 30)
        };
        for is_near_first in [false, true] {
            let pixel = render_with(Transparency::OrderIndependent, is_near_first);
            assert!(
                is_close(pixel, expected, 1.0),
                "{samples} samples, near pane first in the scene {is_near_first}: {pixel:?}"
            );
        }
        assert!(
            is_close(render_with(Transparency::TwoPass, false), expected, 1.0),
            "expected two passes to be correct in back-to-front order"
        );
        assert!(
            !is_close(render_with(Transparency::TwoPass, true), expected, 8.0),
            "negative control: expected two passes to be wrong in front-to-back order"
        );
    }
}

/// Three planes that intersect each other, added in the given order.
fn render_crossing_planes(transparency: Transparency, order: [usize; 3]) -> Vec<u8> {
    // The offset by 0.013 times the slope gives the planes different depths at the image center.
    let tilted_plane = |slope_x: f32, slope_y: f32| {
        let corner = |[u, v]: [f32; 2]| [2.0 * u, 2.0 * v, slope_x * u + slope_y * v + 0.013 * slope_x];
        let positions = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]].map(corner).to_vec();
        Mesh::from_indexed(positions, vec![[0.0, 0.0, 1.0]; 4], vec![], vec![[0, 1, 2], [0, 2, 3]])
            .expect("expected a valid mesh")
    };
    let planes = [(tilted_plane(0.9, 0.1), RED), (tilted_plane(-0.7, 0.3), GREEN), (tilted_plane(0.07, -0.8), BLUE)];
    let add_plane = |builder: SceneBuilder, index: usize| {
        builder.add_domain(planes[index].0.clone(), glass_material(planes[index].1, 0.6))
    };
    render(&order.into_iter().fold(create_builder(transparency, 4), add_plane).build()).image.rgba
}

/// Negative control: with two passes, the image depends on the order.
#[test]
fn crossing_layers_do_not_depend_on_the_order() {
    // The last order is the reverse of the first.
    let orders = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];
    let expected_image = render_crossing_planes(Transparency::OrderIndependent, orders[0]);
    for order in &orders[1..] {
        assert!(render_crossing_planes(Transparency::OrderIndependent, *order) == expected_image, "{order:?}");
    }
    let two_pass_image = render_crossing_planes(Transparency::TwoPass, orders[0]);
    assert!(
        two_pass_image != render_crossing_planes(Transparency::TwoPass, orders[5]),
        "negative control: expected the image of two passes to depend on the order"
    );
    assert!(two_pass_image != expected_image, "negative control: expected another image with two passes");
}

#[test]
fn later_of_coplanar_layers_is_in_front() {
    for (first_color, second_color) in [(RED, BLUE), (BLUE, RED)] {
        let scene = create_builder(Transparency::OrderIndependent, 4)
            .add_domain(pane(0.0), glass_material(first_color, 0.5))
            .add_domain(pane(0.0), glass_material(second_color, 0.5));
        let pixel = render(&scene.build()).pixel(30, 25);
        assert!(is_close(pixel, blend(&[(first_color, 0.5), (second_color, 0.5)]), 1.0), "{pixel:?}");
    }
}

#[test]
fn glass_is_hidden_behind_opaque_and_blended_in_front() {
    let render_with = |z: f32| {
        render(
            &create_builder(Transparency::OrderIndependent, 4)
                .add_domain(pane(0.0), unlit_material(BLUE))
                .add_domain(pane(z), glass_material(RED, 0.5))
                .build(),
        )
    };
    let (glass_behind, glass_in_front) = (render_with(-1.0), render_with(1.0));
    assert_eq!(
        (oit_stats(&glass_behind).fragments, oit_stats(&glass_behind).max_per_pixel),
        (0, 0),
        "expected no fragments behind the opaque pane"
    );
    assert!(is_close(glass_behind.pixel(30, 30), BLUE.map(f64::from), 1.0), "{:?}", glass_behind.pixel(30, 30));
    assert!(oit_stats(&glass_in_front).fragments >= 1600 && oit_stats(&glass_in_front).dropped() == 0);
    assert!(
        is_close(glass_in_front.pixel(30, 30), blend(&[(BLUE, 1.0), (RED, 0.5)]), 1.0),
        "{:?}",
        glass_in_front.pixel(30, 30)
    );
}

#[test]
fn cut_outs_and_glass_keep_their_depth_order() {
    for transparency in [Transparency::OrderIndependent, Transparency::TwoPass] {
        // The leaf is cut away on the left and solid on the right, with glass in front of it and behind it.
        let mut builder = create_builder(transparency, 4);
        let image = builder.add_texture(2, 1, |x, _| if x == 0 { [255, 255, 255, 0] } else { [255; 4] });
        let mask = AlphaMode::Mask { cutoff: 0.5 };
        let leaf = Material { alpha_mode: mask, color_texture: Some(image), ..unlit_material(GREEN) };
        let scene = builder
            .add_domain(pane(-1.0), glass_material(BLUE, 0.5))
            .add_domain(pane(0.0), leaf)
            .add_domain(pane(1.0), glass_material(RED, 0.25));
        let frame = render(&scene.build());
        let (hole_color, leaf_color) = (blend(&[(BLUE, 0.5), (RED, 0.25)]), blend(&[(GREEN, 1.0), (RED, 0.25)]));
        assert!(is_close(frame.pixel(18, 30), hole_color, 1.0), "{transparency:?}: {:?}", frame.pixel(18, 30));
        assert!(is_close(frame.pixel(46, 30), leaf_color, 1.0), "{transparency:?}: {:?}", frame.pixel(46, 30));
    }
}

#[test]
fn edges_of_glass_and_opaque_surfaces_are_multisampled() {
    // A strip ends within pixel column 32, which is 0.1 units wide and begins at x = 0. `coverage` is the fraction of
    // the column that the strip covers.
    for coverage in [0.25, 0.5, 0.75] {
        let strip = || facing_rectangle(-1.0, -1.0, 0.1 * coverage as f32, 1.0, 0.0);
        let render_with = |builder: SceneBuilder| render(&builder.build()).pixel(32, 30);
        let glass_pixel = render_with(
            create_builder(Transparency::OrderIndependent, 4).add_domain(strip(), glass_material([1.0; 3], 0.5)),
        );
        assert!(is_close(glass_pixel, [0.5 * coverage; 3], 1.0), "{coverage}: {glass_pixel:?}");
        let opaque_pixel = render_with(
            create_builder(Transparency::OrderIndependent, 4)
                .add_domain(strip(), unlit_material([1.0; 3]))
                .add_domain(pane(-1.0), glass_material(RED, 0.5)),
        );
        let expected = RED.map(|channel| coverage + (1.0 - coverage) * 0.5 * f64::from(channel));
        assert!(is_close(opaque_pixel, expected, 1.0), "{coverage}: {opaque_pixel:?} instead of {expected:?}");
    }
    // This strip covers a quarter of the pixel, but not its center.
    let builder = create_builder(Transparency::OrderIndependent, 1)
        .add_domain(facing_rectangle(-1.0, -1.0, 0.025, 1.0, 0.0), glass_material([1.0; 3], 0.5));
    assert_eq!(render(&builder.build()).pixel(32, 30), [0; 3], "negative control: one sample at the pixel center");
}

#[test]
fn triangles_of_one_pane_show_no_seam() {
    let frame = render(
        &create_builder(Transparency::OrderIndependent, 4).add_domain(pane(0.0), glass_material([1.0; 3], 0.5)).build(),
    );
    assert_eq!(frame.count_pixels(|pixel| is_close(pixel, [0.5; 3], 1.0)), 1600);
    assert_eq!(frame.count_pixels(|pixel| pixel == [0; 3]), 64 * 64 - 1600);
    assert_eq!(oit_stats(&frame).max_per_pixel, 2, "expected fragments of both triangles on the diagonal");
}

/// A stack of `count` layers with different colors and alphas. `depth_index` of a layer counts from the farthest layer.
/// `order` maps the index of a layer in the scene to its `depth_index`.
fn layer_stack(count: u32, order: impl Fn(u32) -> u32, modify_builder: impl Fn(&mut SceneBuilder)) -> Arc<Scene> {
    let mut builder = create_builder(Transparency::OrderIndependent, 1);
    modify_builder(&mut builder);
    (0..count).fold(builder, |builder, index| add_layer(builder, order(index), count, 1.0)).build()
}

fn add_layer(builder: SceneBuilder, depth_index: u32, count: u32, opacity_scale: f32) -> SceneBuilder {
    let (color, alpha) = layer(depth_index, count);
    builder.add_domain(pane(-3.0 + 0.05 * depth_index as f32), glass_material(color, opacity_scale * alpha))
}

/// Color and alpha of one of `count` layers.
fn layer(depth_index: u32, count: u32) -> ([f32; 3], f32) {
    let shade = depth_index as f32 / count as f32;
    ([shade, 1.0 - shade, 0.5], 0.1 + 0.2 * shade)
}

/// A stack of `count` layers of which only the nearest `visible_count` are not fully transparent.
fn nearest_layers(count: u32, visible_count: u32) -> Arc<Scene> {
    let opacity_scale = |depth_index: u32| if depth_index >= count - visible_count { 1.0 } else { 0.0 };
    (0..count)
        .fold(create_builder(Transparency::OrderIndependent, 1), |builder, depth_index| {
            add_layer(builder, depth_index, count, opacity_scale(depth_index))
        })
        .build()
}

#[test]
fn long_fragment_lists_are_sorted() {
    // Insertion sort is used for lists of up to 32 fragments, and heap sort for longer lists. No count is a multiple of
    // 7, so that `index * 7 % count` is a permutation.
    for count in [31, 32, 33, 34, 61, 97] {
        let sorted_frame = render(&layer_stack(count, |index| index, |_| ()));
        let shuffled_frame = render(&layer_stack(count, |index| index * 7 % count, |_| ()));
        let reversed_frame = render(&layer_stack(count, |index| count - 1 - index, |_| ()));
        let fragments = 1600 * u64::from(count);
        assert_eq!(
            oit_stats(&sorted_frame),
            OitStats { fragments, stored: fragments, max_per_pixel: count, per_pixel_limit: None }
        );
        assert!(
            shuffled_frame.image.rgba == sorted_frame.image.rgba
                && reversed_frame.image.rgba == sorted_frame.image.rgba,
            "{count} layers"
        );
        let layers: Vec<_> = (0..count).map(|depth_index| layer(depth_index, count)).collect();
        let pixel = sorted_frame.pixel(20, 40);
        assert!(is_close(pixel, blend(&layers), 1.0), "{count} layers: {pixel:?}");
    }
}

/// The statistics contain the number of dropped fragments.
#[test]
fn nearest_fragments_are_kept_over_budget() {
    let render_limited = |budget: Option<u32>, order: fn(u32) -> u32| {
        render(&layer_stack(10, order, |builder| builder.parts.look.fragments = budget))
    };
    let complete_frame = render_limited(None, |index| index);
    // Ten layers of 1600 pixels are 16,000 fragments. The limit per pixel is budget / 1600, rounded down.
    for (budget, per_pixel_limit) in [(8000, 5), (9599, 5), (9600, 6), (1600, 1), (1599, 0), (1, 0)] {
        let frame = render_limited(Some(budget), |index| index);
        let stored = 1600 * u64::from(per_pixel_limit);
        assert_eq!(
            oit_stats(&frame),
            OitStats { fragments: 16000, stored, max_per_pixel: 10, per_pixel_limit: Some(per_pixel_limit) },
            "budget {budget}"
        );
        let nearest_frame = render(&nearest_layers(10, per_pixel_limit));
        assert!(frame.image.rgba == nearest_frame.image.rgba, "budget {budget}");
        // The reverse order and a permutation.
        for order in [(|index| 9 - index) as fn(u32) -> u32, |index| index * 3 % 10] {
            let reordered_frame = render_limited(Some(budget), order);
            assert!(
                reordered_frame.image.rgba == frame.image.rgba && reordered_frame.stats == frame.stats,
                "budget {budget}"
            );
        }
        assert!(frame.image.rgba != complete_frame.image.rgba, "negative control: expected missing fragments");
    }
    assert_eq!(
        oit_stats(&render_limited(Some(16000), |index| index)).per_pixel_limit,
        None,
        "expected no limit for a sufficient budget"
    );
}

#[test]
fn latest_of_coplanar_layers_are_kept_over_budget() {
    let colors = [RED, GREEN, BLUE, RED, GREEN];
    let mut builder = create_builder(Transparency::OrderIndependent, 1);
    // Two fragments for each of the 1600 pixels.
    builder.parts.look.fragments = Some(3200);
    let add_pane = |builder: SceneBuilder, color: [f32; 3]| builder.add_domain(pane(0.0), glass_material(color, 0.5));
    let frame = render(&colors.into_iter().fold(builder, add_pane).build());
    assert_eq!((oit_stats(&frame).stored, oit_stats(&frame).per_pixel_limit), (3200, Some(2)));
    assert!(is_close(frame.pixel(30, 40), blend(&[(RED, 0.5), (GREEN, 0.5)]), 1.0), "{:?}", frame.pixel(30, 40));
}

#[test]
fn scene_over_budget_is_deterministic() {
    let scene = layer_stack(
        40,
        // Because 40 is not a multiple of 7, this is a permutation.
        |index| index * 7 % 40,
        |builder| {
            (builder.parts.look.fragments, builder.parts.look.samples) = (Some(20_000), 4);
        },
    );
    let mut renderer = open_renderer();
    let first_frame = render_square(&mut renderer, &scene, front_camera(64), 64);
    assert!(oit_stats(&first_frame).dropped() > 0);
    for _ in 0..5 {
        let repeated_frame = render_square(&mut renderer, &scene, front_camera(64), 64);
        assert!(repeated_frame.image.rgba == first_frame.image.rgba && repeated_frame.stats == first_frame.stats);
    }
}

#[test]
fn two_passes_draw_alpha_above_threshold_as_opaque() {
    // A leaf whose left half has alpha 128 / 255 and whose right half has alpha 1.
    let render_with = |opaque_alpha: f32| {
        let mut builder = create_builder(Transparency::TwoPass, 4);
        builder.parts.look.opaque_alpha = opaque_alpha;
        let image = builder.add_texture(2, 1, |x, _| if x == 0 { [255, 255, 255, 128] } else { [255; 4] });
        let leaf = Material { color_texture: Some(image), ..glass_material(GREEN, 1.0) };
        // The farther pane comes later in the scene, so only the depth test keeps it behind.
        render(&builder.add_domain(pane(0.0), leaf).add_domain(pane(-1.0), glass_material(RED, 0.5)).build())
    };
    // With a threshold of 0.95, the right half of the leaf is drawn as opaque. No alpha reaches the threshold of 1.5,
    // so that all fragments are blended in scene order.
    let (mixed_frame, blended_frame) = (render_with(0.95), render_with(1.5));
    assert!(is_close(mixed_frame.pixel(42, 30), GREEN.map(f64::from), 1.0), "{:?}", mixed_frame.pixel(42, 30));
    assert!(
        is_close(blended_frame.pixel(42, 30), blend(&[(GREEN, 1.0), (RED, 0.5)]), 2.0),
        "negative control: {:?}",
        blended_frame.pixel(42, 30)
    );
    let blended_color = blend(&[(GREEN, 128.0 / 255.0), (RED, 0.5)]);
    // Pixel (22, 30) is near the center of the half-transparent texel.
    assert!(
        is_close(mixed_frame.pixel(22, 30), blended_color, 2.0),
        "expected blending in scene order, got {:?}",
        mixed_frame.pixel(22, 30)
    );
    assert_eq!((mixed_frame.stats.draw_calls, blended_frame.stats.draw_calls), (2, 1));
    assert_eq!(blended_frame.stats.passes, [Pass::Blended, Pass::Background, Pass::Encode]);
    assert_eq!(
        mixed_frame.stats.passes,
        [Pass::Visibility, Pass::Blended, Pass::Background, Pass::Shade, Pass::Encode]
    );
}
