//! Overlapping blended triangles: order-independent with exact transparency, and in scene order with two passes.

use std::sync::Arc;

use modalcast_model::domain::{AlphaMode, Material, Mesh};
use modalcast_model::scene::{Scene, Transparency};
use modalcast_render::{OitStats, Pass};

use super::harness::{
    RenderedFrame, SceneBuilder, facing_rectangle, front_camera, is_close, open_renderer, render, render_square,
};

/// A material lit by ambient light alone, so that colors appear unchanged.
fn painted(ambient: [f32; 3]) -> Material {
    Material { ambient, diffuse: [0.0; 3], ..Material::default() }
}

fn glass(ambient: [f32; 3], alpha: f32) -> Material {
    Material { alpha, alpha_mode: AlphaMode::Blend, double_sided: true, ..painted(ambient) }
}

fn create_builder(transparency: Transparency, samples: u32) -> SceneBuilder {
    let mut builder = SceneBuilder::new();
    builder.parts.look.skylight = [1.0; 3];
    (builder.parts.look.transparency, builder.parts.look.samples) = (transparency, samples);
    builder
}

/// A pane of 40 x 40 pixels at depth z.
fn pane(z: f32) -> Mesh {
    // Farther panes are larger, so that all cover the same pixels.
    let half = 2.0 * (10.0 - z) / 10.0;
    facing_rectangle(-half, -half, half, half, z)
}

/// Blends layers from the farthest to the nearest over black.
fn over(layers: &[([f32; 3], f32)]) -> [f64; 3] {
    layers.iter().fold([0.0; 3], |under, (color, alpha)| {
        let mix =
            |channel: usize| f64::from(*alpha) * f64::from(color[channel]) + (1.0 - f64::from(*alpha)) * under[channel];
        [mix(0), mix(1), mix(2)]
    })
}

fn lists(shown: &RenderedFrame) -> OitStats {
    shown.stats.oit.expect("exact, with glass")
}

const RED: [f32; 3] = [1.0, 0.1, 0.0];
const GREEN: [f32; 3] = [0.0, 0.8, 0.2];
const BLUE: [f32; 3] = [0.1, 0.3, 1.0];

/// Control: two passes are correct only for layers in back-to-front order.
#[test]
fn two_layers_blend_exactly_in_either_order() {
    let expected = over(&[(GREEN, 0.5), (RED, 0.25)]);
    for samples in [1, 4] {
        let shown = |transparency, near_first: bool| {
            let mut panes = vec![(pane(-1.0), glass(GREEN, 0.5)), (pane(0.0), glass(RED, 0.25))];
            if near_first {
                panes.reverse();
            }
            let add = |builder: SceneBuilder, (mesh, material)| builder.add_domain(mesh, material);
            render(&panes.into_iter().fold(create_builder(transparency, samples), add).build()).pixel(30, 30)
        };
        for near_first in [false, true] {
            let pixel = shown(Transparency::OrderIndependent, near_first);
            assert!(is_close(pixel, expected, 1.0), "{samples}, {near_first}: {pixel:?}");
        }
        assert!(is_close(shown(Transparency::TwoPass, false), expected, 1.0), "two passes, farther first");
        assert!(!is_close(shown(Transparency::TwoPass, true), expected, 8.0), "control: two passes hang on the order");
    }
}

/// Three planes that intersect each other, added in the given order.
fn crossing(transparency: Transparency, order: [usize; 3]) -> Vec<u8> {
    let tilted = |x: f32, y: f32| {
        let corner = |[u, v]: [f32; 2]| [2.0 * u, 2.0 * v, x * u + y * v + 0.013 * x];
        let rest = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]].map(corner).to_vec();
        Mesh::from_indexed(rest, vec![[0.0, 0.0, 1.0]; 4], vec![], vec![[0, 1, 2], [0, 2, 3]])
            .expect("expected a valid mesh")
    };
    let planes = [(tilted(0.9, 0.1), RED), (tilted(-0.7, 0.3), GREEN), (tilted(0.07, -0.8), BLUE)];
    let add =
        |builder: SceneBuilder, index: usize| builder.add_domain(planes[index].0.clone(), glass(planes[index].1, 0.6));
    render(&order.into_iter().fold(create_builder(transparency, 4), add).build()).image.rgba
}

/// Control: with two passes the picture depends on the order.
#[test]
fn crossing_layers_do_not_depend_on_the_order() {
    let orders = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];
    let first = crossing(Transparency::OrderIndependent, orders[0]);
    for order in &orders[1..] {
        assert!(crossing(Transparency::OrderIndependent, *order) == first, "{order:?}");
    }
    let unsorted = crossing(Transparency::TwoPass, orders[0]);
    assert!(unsorted != crossing(Transparency::TwoPass, orders[5]), "control: two passes hang on the order");
    assert!(unsorted != first, "control: and are wrong somewhere");
}

#[test]
fn later_of_coplanar_layers_is_in_front() {
    for (first, second) in [(RED, BLUE), (BLUE, RED)] {
        let scene = create_builder(Transparency::OrderIndependent, 4)
            .add_domain(pane(0.0), glass(first, 0.5))
            .add_domain(pane(0.0), glass(second, 0.5));
        let pixel = render(&scene.build()).pixel(30, 25);
        assert!(is_close(pixel, over(&[(first, 0.5), (second, 0.5)]), 1.0), "{pixel:?}");
    }
}

#[test]
fn opaque_hides_glass_behind_and_shows_through_in_front() {
    let shown = |z: f32| {
        render(
            &create_builder(Transparency::OrderIndependent, 4)
                .add_domain(pane(0.0), painted(BLUE))
                .add_domain(pane(z), glass(RED, 0.5))
                .build(),
        )
    };
    let (behind, before) = (shown(-1.0), shown(1.0));
    assert_eq!((lists(&behind).fragments, lists(&behind).max_per_pixel), (0, 0), "nothing is left to blend");
    assert!(is_close(behind.pixel(30, 30), BLUE.map(f64::from), 1.0), "{:?}", behind.pixel(30, 30));
    assert!(lists(&before).fragments >= 1600 && lists(&before).dropped() == 0);
    assert!(is_close(before.pixel(30, 30), over(&[(BLUE, 1.0), (RED, 0.5)]), 1.0), "{:?}", before.pixel(30, 30));
}

#[test]
fn cut_outs_and_glass_keep_their_depth_order() {
    for transparency in [Transparency::OrderIndependent, Transparency::TwoPass] {
        // The leaf is cut away on the left and solid on the right, with glass in front of it and behind it.
        let mut builder = create_builder(transparency, 4);
        let image = builder.add_texture(2, 1, |x, _| if x == 0 { [255, 255, 255, 0] } else { [255; 4] });
        let mask = AlphaMode::Mask { cutoff: 0.5 };
        let leaf = Material { alpha_mode: mask, color_texture: Some(image), ..painted(GREEN) };
        let scene = builder
            .add_domain(pane(-1.0), glass(BLUE, 0.5))
            .add_domain(pane(0.0), leaf)
            .add_domain(pane(1.0), glass(RED, 0.25));
        let shown = render(&scene.build());
        let (hole, solid) = (over(&[(BLUE, 0.5), (RED, 0.25)]), over(&[(GREEN, 1.0), (RED, 0.25)]));
        assert!(is_close(shown.pixel(18, 30), hole, 1.0), "{transparency:?}: {:?}", shown.pixel(18, 30));
        assert!(is_close(shown.pixel(46, 30), solid, 1.0), "{transparency:?}: {:?}", shown.pixel(46, 30));
    }
}

#[test]
fn edges_of_glass_and_opaque_surfaces_are_multisampled() {
    for (edge, share) in [(0.25_f32, 0.25), (0.5, 0.5), (0.75, 0.75)] {
        let strip = || facing_rectangle(-1.0, -1.0, 0.1 * edge, 1.0, 0.0);
        let shown = |builder: SceneBuilder| render(&builder.build()).pixel(32, 30);
        let alone = shown(create_builder(Transparency::OrderIndependent, 4).add_domain(strip(), glass([1.0; 3], 0.5)));
        assert!(is_close(alone, [0.5 * share; 3], 1.0), "{edge}: {alone:?}");
        let hidden = shown(
            create_builder(Transparency::OrderIndependent, 4)
                .add_domain(strip(), painted([1.0; 3]))
                .add_domain(pane(-1.0), glass(RED, 0.5)),
        );
        let expected = RED.map(|channel| share + (1.0 - share) * 0.5 * f64::from(channel));
        assert!(is_close(hidden, expected, 1.0), "{edge}: {hidden:?} instead of {expected:?}");
    }
    let one = create_builder(Transparency::OrderIndependent, 1)
        .add_domain(facing_rectangle(-1.0, -1.0, 0.025, 1.0, 0.0), glass([1.0; 3], 0.5));
    assert_eq!(render(&one.build()).pixel(32, 30), [0; 3], "control: one sample sees no quarter");
}

#[test]
fn triangles_of_one_pane_show_no_seam() {
    let shown =
        render(&create_builder(Transparency::OrderIndependent, 4).add_domain(pane(0.0), glass([1.0; 3], 0.5)).build());
    assert_eq!(shown.count_pixels(|pixel| is_close(pixel, [0.5; 3], 1.0)), 1600);
    assert_eq!(shown.count_pixels(|pixel| pixel == [0; 3]), 64 * 64 - 1600);
    assert_eq!(lists(&shown).max_per_pixel, 2, "pixels on the diagonal see both triangles");
}

/// A stack of layers with different colors and opacities. `order` maps the position of a layer in the scene to its
/// place in depth, counted from the farthest.
fn stack(count: u32, order: impl Fn(u32) -> u32, set: impl Fn(&mut SceneBuilder)) -> Arc<Scene> {
    let mut builder = create_builder(Transparency::OrderIndependent, 1);
    set(&mut builder);
    (0..count).fold(builder, |builder, index| layered(builder, order(index), count, 1.0)).build()
}

fn layered(builder: SceneBuilder, place: u32, count: u32, share: f32) -> SceneBuilder {
    let (color, alpha) = layer(place, count);
    builder.add_domain(pane(-3.0 + 0.05 * place as f32), glass(color, share * alpha))
}

fn layer(place: u32, count: u32) -> ([f32; 3], f32) {
    let shade = place as f32 / count as f32;
    ([shade, 1.0 - shade, 0.5], 0.1 + 0.2 * shade)
}

/// The same stack, with all but the `kept` nearest layers fully transparent.
fn nearest(count: u32, kept: u32) -> Arc<Scene> {
    let share = |place: u32| if place >= count - kept { 1.0 } else { 0.0 };
    (0..count)
        .fold(create_builder(Transparency::OrderIndependent, 1), |builder, place| {
            layered(builder, place, count, share(place))
        })
        .build()
}

#[test]
fn long_fragment_lists_are_sorted() {
    for count in [31, 32, 33, 34, 61, 97] {
        let sorted = render(&stack(count, |index| index, |_| ()));
        let mixed = render(&stack(count, |index| index * 7 % count, |_| ()));
        let backward = render(&stack(count, |index| count - 1 - index, |_| ()));
        let fragments = 1600 * u64::from(count);
        assert_eq!(
            lists(&sorted),
            OitStats { fragments, stored: fragments, max_per_pixel: count, per_pixel_limit: None }
        );
        assert!(mixed.image.rgba == sorted.image.rgba && backward.image.rgba == sorted.image.rgba, "{count}");
        let layers: Vec<_> = (0..count).map(|place| layer(place, count)).collect();
        assert!(is_close(sorted.pixel(20, 40), over(&layers), 1.0), "{count}: {:?}", sorted.pixel(20, 40));
    }
}

/// Each pixel keeps its nearest fragments, and the statistics count the dropped ones.
#[test]
fn fragments_over_budget_keep_the_nearest() {
    let limited = |budget: Option<u32>, order: fn(u32) -> u32| {
        render(&stack(10, order, |builder| builder.parts.look.fragments = budget))
    };
    let whole = limited(None, |index| index);
    for (budget, per_pixel_limit) in [(8000, 5), (9599, 5), (9600, 6), (1600, 1), (1599, 0), (1, 0)] {
        let shown = limited(Some(budget), |index| index);
        let kept = 1600 * u64::from(per_pixel_limit);
        assert_eq!(
            lists(&shown),
            OitStats { fragments: 16000, stored: kept, max_per_pixel: 10, per_pixel_limit: Some(per_pixel_limit) },
            "{budget}"
        );
        let nearest = render(&nearest(10, per_pixel_limit));
        assert!(shown.image.rgba == nearest.image.rgba, "{budget}");
        for order in [(|index| 9 - index) as fn(u32) -> u32, |index| index * 3 % 10] {
            let other = limited(Some(budget), order);
            assert!(other.image.rgba == shown.image.rgba && other.stats == shown.stats, "{budget}");
        }
        assert!(shown.image.rgba != whole.image.rgba, "control: the picture lacks something");
    }
    assert_eq!(lists(&limited(Some(16000), |index| index)).per_pixel_limit, None, "a budget that is just enough");
}

#[test]
fn latest_of_coplanar_layers_are_kept_over_budget() {
    let colors = [RED, GREEN, BLUE, RED, GREEN];
    let mut builder = create_builder(Transparency::OrderIndependent, 1);
    builder.parts.look.fragments = Some(3200);
    let add = |builder: SceneBuilder, color: [f32; 3]| builder.add_domain(pane(0.0), glass(color, 0.5));
    let shown = render(&colors.into_iter().fold(builder, add).build());
    assert_eq!((lists(&shown).stored, lists(&shown).per_pixel_limit), (3200, Some(2)));
    assert!(is_close(shown.pixel(30, 40), over(&[(RED, 0.5), (GREEN, 0.5)]), 1.0), "{:?}", shown.pixel(30, 40));
}

#[test]
fn scene_over_budget_is_deterministic() {
    let scene = stack(
        40,
        |index| index * 7 % 40,
        |builder| {
            (builder.parts.look.fragments, builder.parts.look.samples) = (Some(20_000), 4);
        },
    );
    let mut renderer = open_renderer();
    let first = render_square(&mut renderer, &scene, front_camera(64), 64);
    assert!(lists(&first).dropped() > 0);
    for _ in 0..5 {
        let again = render_square(&mut renderer, &scene, front_camera(64), 64);
        assert!(again.image.rgba == first.image.rgba && again.stats == first.stats);
    }
}

#[test]
fn two_passes_draw_alpha_above_threshold_as_opaque() {
    let shown = |opaque_alpha: f32| {
        let mut builder = create_builder(Transparency::TwoPass, 4);
        builder.parts.look.opaque_alpha = opaque_alpha;
        let image = builder.add_texture(2, 1, |x, _| if x == 0 { [255, 255, 255, 128] } else { [255; 4] });
        let leaf = Material { color_texture: Some(image), ..glass(GREEN, 1.0) };
        // The farther pane comes later in the scene, so only the depth test keeps it behind.
        render(&builder.add_domain(pane(0.0), leaf).add_domain(pane(-1.0), glass(RED, 0.5)).build())
    };
    let (parts, none) = (shown(0.95), shown(1.5));
    assert!(is_close(parts.pixel(42, 30), GREEN.map(f64::from), 1.0), "{:?}", parts.pixel(42, 30));
    assert!(is_close(none.pixel(42, 30), over(&[(GREEN, 1.0), (RED, 0.5)]), 2.0), "control: {:?}", none.pixel(42, 30));
    let wrong = over(&[(GREEN, 128.0 / 255.0), (RED, 0.5)]);
    // Near the center of the half-transparent texel; the other texel is opaque around its center.
    assert!(is_close(parts.pixel(22, 30), wrong, 2.0), "blended in the order of the scene: {:?}", parts.pixel(22, 30));
    assert_eq!((parts.stats.draw_calls, none.stats.draw_calls), (2, 1));
    assert_eq!(none.stats.passes, [Pass::Blended, Pass::Background, Pass::Encode]);
    assert_eq!(parts.stats.passes, [Pass::Visibility, Pass::Blended, Pass::Background, Pass::Shade, Pass::Encode]);
}
