//! The ground and the shadow map: the ground receives shadows but never casts. Tests cover the border of the map and
//! the contact line of a wall.

use modalcast_model::domain::{AlphaMode, Material};
use modalcast_model::scene::{Camera, Lens, ShadowMethod, ShadowSettings, View};
use modalcast_render::{BlurMethod, Renderer};

use super::harness::{RenderedFrame, facing_rectangle, is_close, open_renderer, render_square};
use super::shadow::{create_builder, with_square};

/// The part of the ground that the map covers, seen from above, with the given shadow map or none.
fn from_high_above(renderer: &mut Renderer, shadow: Option<ShadowSettings>, caster: bool) -> RenderedFrame {
    let mut builder = create_builder();
    builder.parts.look.sun = [3.0, 4.0, 0.0];
    builder.parts.look.shadow = shadow;
    let builder = if caster { with_square(builder, AlphaMode::Opaque, 1.0) } else { builder };
    let view = View::LookAt { eye: [0.0, 20.0, 0.0], target: [0.0; 3], up: [0.0, 0.0, -1.0] };
    let lens = Lens::Intrinsics { fx: 120.0, fy: 120.0, cx: 80.0, cy: 80.0 };
    render_square(renderer, &builder.build(), Camera { view, lens, near: 0.0, far: 0.0 }, 160)
}

#[test]
fn ground_is_lit_at_the_border_of_the_map() {
    let base = ShadowSettings { size: 64, blur: 4.0, bleeding: 0.2, ..ShadowSettings::default() };
    let kinds = [
        (BlurMethod::Rows, base),
        (BlurMethod::Tiles, base),
        (BlurMethod::Fragments, base),
        (BlurMethod::Auto, ShadowSettings { method: ShadowMethod::PercentageCloser, ..base }),
        (BlurMethod::Auto, ShadowSettings { splits: 2, ..base }),
    ];
    let bright = from_high_above(&mut open_renderer(), None, false);
    let darker = |shown: &RenderedFrame| {
        let pairs = shown.image.rgba.iter().zip(&bright.image.rgba);
        pairs.filter(|(own, bright)| bright.abs_diff(**own) > 2).count()
    };
    for (method, shadow) in kinds {
        let mut renderer = open_renderer();
        renderer.set_blur_method(method);
        assert_eq!(darker(&from_high_above(&mut renderer, Some(shadow), false)), 0, "{method:?}, {shadow:?}");
    }
    assert!(darker(&from_high_above(&mut open_renderer(), Some(base), true)) > 300, "control: a caster is seen");
}

/// Number of pixels of a wall on the ground that are not fully lit, and number that are not fully dark.
fn on_the_wall(shadow: ShadowSettings, shaded: bool) -> [usize; 2] {
    let mut builder = create_builder();
    builder.parts.look.sun = [0.0, 3.0, 4.0];
    builder.parts.look.shadow = Some(shadow);
    let mut builder = builder.add_domain(facing_rectangle(-1.0, -1.0, 1.0, 1.0, 0.0), Material::default());
    if shaded {
        // Above the view of the camera. Its shadow on the wall extends from the ground to half a unit above the top of
        // the wall.
        builder = builder.add_domain(facing_rectangle(-3.0, 1.8, 3.0, 4.5, 4.0), Material::default());
    }
    let lens = Lens::Intrinsics { fx: 100.0, fy: 100.0, cx: 32.0, cy: 32.0 };
    let view = View::LookAt { eye: [0.0, 0.0, 10.0], target: [0.0; 3], up: [0.0, 1.0, 0.0] };
    let shown = render_square(&mut open_renderer(), &builder.build(), Camera { view, lens, near: 0.0, far: 0.0 }, 64);
    // The wall covers 20 x 20 pixels at the center; its rim is excluded.
    let wall = || (23..41).flat_map(|y| (23..41).map(move |x| (x, y)));
    let differing = |light: f64| wall().filter(|(x, y)| !is_close(shown.pixel(*x, *y), [light; 3], 2.0)).count();
    [differing(0.25 + 0.5 * 0.8), differing(0.25)]
}

/// Control: a wall in the shadow is dark.
#[test]
fn lit_wall_is_fully_lit_down_to_the_ground() {
    for blur in [0.0, 2.0, 4.0] {
        for size in [128, 512] {
            let base = ShadowSettings { size, blur, bleeding: 0.2, ..ShadowSettings::default() };
            for shadow in [
                base,
                ShadowSettings { splits: 3, ..base },
                ShadowSettings { method: ShadowMethod::PercentageCloser, ..base },
            ] {
                let [unlit, _] = on_the_wall(shadow, false);
                assert_eq!(unlit, 0, "{shadow:?}");
            }
            let [unlit, light] = on_the_wall(base, true);
            assert!(unlit == 18 * 18 && light < 50, "control, {base:?}: {unlit} not lit, {light} not dark");
        }
    }
}
