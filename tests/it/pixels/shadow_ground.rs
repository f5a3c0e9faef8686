//! The ground and the shadow map. The ground receives shadows and casts none. The tests cover the border of the map and
//! the line where a wall meets the ground.

use modalcast_model::domain::{AlphaMode, Material};
use modalcast_model::scene::{Camera, Lens, ShadowMethod, ShadowSettings, View};
use modalcast_render::{BlurMethod, Renderer};

use super::harness::{RenderedFrame, facing_rectangle, is_close, open_renderer, render_square};
use super::shadow::{create_builder, with_square};

/// Values of the parameter `has_caster`.
const WITH_CASTER: bool = true;
const WITHOUT_CASTER: bool = false;

/// Renders from above the part of the ground that the shadow map covers. With `has_caster`, a square above the ground
/// casts a shadow.
fn render_ground(renderer: &mut Renderer, shadow: Option<ShadowSettings>, has_caster: bool) -> RenderedFrame {
    let mut builder = create_builder();
    builder.parts.look.sun = [3.0, 4.0, 0.0];
    builder.parts.look.shadow = shadow;
    let builder = if has_caster { with_square(builder, AlphaMode::Opaque, 1.0) } else { builder };
    let view = View::LookAt { eye: [0.0, 20.0, 0.0], target: [0.0; 3], up: [0.0, 0.0, -1.0] };
    // Clip planes of 0 are fitted to the bounds.
    let lens = Lens::Intrinsics { fx: 120.0, fy: 120.0, cx: 80.0, cy: 80.0 };
    render_square(renderer, &builder.build(), Camera { view, lens, near: 0.0, far: 0.0 }, 160)
}

#[test]
fn ground_is_lit_at_the_border_of_the_map() {
    let base = ShadowSettings { size: 64, blur: 4.0, bleeding: 0.2, ..ShadowSettings::default() };
    let cases = [
        (BlurMethod::Rows, base),
        (BlurMethod::Tiles, base),
        (BlurMethod::Fragments, base),
        (BlurMethod::Auto, ShadowSettings { method: ShadowMethod::PercentageCloser, ..base }),
        (BlurMethod::Auto, ShadowSettings { cascades: 2, ..base }),
    ];
    let unshadowed = render_ground(&mut open_renderer(), None, WITHOUT_CASTER);
    // Number of bytes that differ by more than two levels.
    let count_differences = |frame: &RenderedFrame| {
        let pairs = frame.image.rgba.iter().zip(&unshadowed.image.rgba);
        pairs.filter(|(shadowed, unshadowed)| unshadowed.abs_diff(**shadowed) > 2).count()
    };
    for (method, shadow) in cases {
        let mut renderer = open_renderer();
        renderer.set_blur_method(method);
        assert_eq!(
            count_differences(&render_ground(&mut renderer, Some(shadow), WITHOUT_CASTER)),
            0,
            "{method:?}, {shadow:?}"
        );
    }
    assert!(
        count_differences(&render_ground(&mut open_renderer(), Some(base), WITH_CASTER)) > 300,
        "negative control: expected the shadow of a caster"
    );
}

/// Renders a wall that stands on the ground. The ground is at y = -1, the lowest point of the scene. Returns the number
/// of pixels of the wall that are not fully lit, and the number that are not fully dark. With `has_caster`, a shadow
/// covers the wall.
fn count_wall_pixels(shadow: ShadowSettings, has_caster: bool) -> [usize; 2] {
    let mut builder = create_builder();
    builder.parts.look.sun = [0.0, 3.0, 4.0];
    builder.parts.look.shadow = Some(shadow);
    let mut builder = builder.add_domain(facing_rectangle(-1.0, -1.0, 1.0, 1.0, 0.0), Material::default());
    if has_caster {
        // A caster outside the view of the camera. Its shadow covers the whole wall.
        builder = builder.add_domain(facing_rectangle(-3.0, 1.8, 3.0, 4.5, 4.0), Material::default());
    }
    let lens = Lens::Intrinsics { fx: 100.0, fy: 100.0, cx: 32.0, cy: 32.0 };
    let view = View::LookAt { eye: [0.0, 0.0, 10.0], target: [0.0; 3], up: [0.0, 1.0, 0.0] };
    let frame = render_square(&mut open_renderer(), &builder.build(), Camera { view, lens, near: 0.0, far: 0.0 }, 64);
    // The wall covers 20 x 20 pixels at the center. Its border pixels are excluded.
    let wall_pixels = || (23..41).flat_map(|y| (23..41).map(move |x| (x, y)));
    // Number of pixels whose color is not that of a white surface with this linear light.
    let count_other =
        |light: f64| wall_pixels().filter(|(x, y)| !is_close(frame.pixel(*x, *y), [light; 3], 2.0)).count();
    // Skylight is 0.25 and sunlight 0.5. The cosine between the sun and the normal of the wall is 4/5.
    [count_other(0.25 + 0.5 * 0.8), count_other(0.25)]
}

/// Negative control: a wall in the shadow is dark.
#[test]
fn lit_wall_is_fully_lit_down_to_the_ground() {
    for blur in [0.0, 2.0, 4.0] {
        for size in [128, 512] {
            let base = ShadowSettings { size, blur, bleeding: 0.2, ..ShadowSettings::default() };
            for shadow in [
                base,
                ShadowSettings { cascades: 3, ..base },
                ShadowSettings { method: ShadowMethod::PercentageCloser, ..base },
            ] {
                let [not_lit, _] = count_wall_pixels(shadow, WITHOUT_CASTER);
                assert_eq!(not_lit, 0, "{shadow:?}");
            }
            let [not_lit, not_dark] = count_wall_pixels(base, WITH_CASTER);
            assert!(
                not_lit == 18 * 18 && not_dark < 50,
                "negative control, {base:?}: {not_lit} of 324 pixels not lit, {not_dark} not dark"
            );
        }
    }
}
