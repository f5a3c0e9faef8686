//! Shadows where several layers of occluders overlap: a variance map leaks at most two levels more light than a
//! filtered map. Without the fallback to filtered depths, it leaks far more.

use std::sync::Arc;

use modalcast_model::domain::Mesh;
use modalcast_model::scene::{Camera, Ground, Lens, MomentFormat, Scene, ShadowMethod, ShadowSettings, View};
use modalcast_render::FrameImage;
use nalgebra::{Rotation3, Vector3};

use super::harness::{SceneBuilder, colored_material, open_renderer, render_square};

/// Side of the images.
const SIZE: u32 = 64;

/// A horizontal sheet that covers the points p with p . (cos angle, sin angle) <= offset in x and z.
#[derive(Debug, Clone, Copy)]
struct Layer {
    height: f32,
    angle: f32,
    offset: f32,
}

/// Layers above a floor at height 0, with the sun straight above, seen from a point on the y axis that looks down.
#[derive(Debug, Clone)]
pub(super) struct LayerScene {
    layers: Vec<Layer>,
    eye_height: f64,
    /// Half the extent of the floor in the image.
    half_view: f64,
    /// Rotation of everything: layers, sun and camera.
    rotation: Rotation3<f64>,
    /// Whether the ground replaces the floor.
    has_ground: bool,
    shadow: ShadowSettings,
}

impl LayerScene {
    /// The case of a report: a roof that covers one half, and a slab close to the floor.
    pub(super) fn roof_and_slab() -> Self {
        let roof = Layer { height: 10.0, angle: 0.0, offset: 0.0 };
        let slab = Layer { height: 1.0, angle: 2.6, offset: 0.05 };
        Self {
            layers: vec![roof, slab],
            eye_height: 0.8,
            half_view: 0.4,
            rotation: Rotation3::identity(),
            has_ground: false,
            shadow: ShadowSettings { size: 512, ..ShadowSettings::default() },
        }
    }

    pub(super) fn with_shadow(self, change: impl FnOnce(ShadowSettings) -> ShadowSettings) -> Self {
        Self { shadow: change(self.shadow), ..self }
    }

    pub(super) fn build(&self) -> Arc<Scene> {
        let mut builder = SceneBuilder::new();
        let look = &mut builder.parts.look;
        (look.sun, look.shadow) = (self.rotate([0.0, 1.0, 0.0]).map(|value| value as f32), Some(self.shadow));
        // Little skylight: a level in the shadow is a small fraction of the sunlight.
        (look.sunlight, look.skylight) = ([0.95; 3], [0.05; 3]);
        look.ground = self.has_ground.then_some(Ground { color: Some([0.8; 3]) });
        // With a ground, a small floor outside the image sets the height of the ground.
        let floor = Layer { height: 0.0, angle: 0.0, offset: if self.has_ground { -5.8 } else { 6.0 } };
        for layer in std::iter::once(&floor).chain(&self.layers) {
            builder = builder.add_domain(self.sheet(layer), colored_material([0.8; 3]));
        }
        builder.build()
    }

    fn rotate(&self, vector: [f64; 3]) -> [f64; 3] {
        (self.rotation * Vector3::from(vector)).into()
    }

    fn sheet(&self, layer: &Layer) -> Mesh {
        let (sin, cos) = f64::from(layer.angle).sin_cos();
        let corner = |across: f64, along: f64| {
            let point = [across * cos - along * sin, f64::from(layer.height), across * sin + along * cos];
            self.rotate(point).map(|value| value as f32)
        };
        let offset = f64::from(layer.offset);
        let positions = vec![corner(-6.0, 6.0), corner(offset, 6.0), corner(offset, -6.0), corner(-6.0, -6.0)];
        let normal = self.rotate([0.0, 1.0, 0.0]).map(|value| value as f32);
        Mesh::from_indexed(positions, vec![normal; 4], vec![], vec![[0, 1, 2], [0, 2, 3]]).expect("a valid mesh")
    }

    /// The camera for square images of `size` pixels.
    pub(super) fn camera(&self, size: u32) -> Camera {
        let eye = self.rotate([0.0, self.eye_height, 0.0]);
        let view = View::LookAt { eye, target: [0.0; 3], up: self.rotate([0.0, 0.0, -1.0]) };
        let center = 0.5 * f64::from(size);
        let focal_length = center * self.eye_height / self.half_view;
        let lens = Lens::Intrinsics { fx: focal_length, fy: focal_length, cx: center, cy: center };
        Camera { view, lens, near: 0.0, far: 0.0 }
    }

    fn render(&self, shadow: ShadowSettings) -> FrameImage {
        let scene = self.clone().with_shadow(|_| shadow).build();
        render_square(&mut open_renderer(), &scene, self.camera(SIZE), SIZE).image
    }

    /// Renders with the settings of `shadow` and with a filtered map, and without the fallback as the negative control.
    /// The largest number of levels by which the variance map is brighter than the filtered map, with the fallback and
    /// without.
    fn leaked_levels(&self) -> [i32; 2] {
        let filtered = self.render(ShadowSettings { method: ShadowMethod::PercentageCloser, ..self.shadow });
        let levels = |image: &FrameImage| image.rgba.iter().step_by(4).copied().collect::<Vec<u8>>();
        let filtered = levels(&filtered);
        let (min, max) = (filtered.iter().min(), filtered.iter().max());
        assert!(
            min.zip(max).is_some_and(|(min, max)| max - min > 60),
            "{self:?}: expected light and shadow: {min:?}, {max:?}"
        );
        [true, false].map(|pcf_fallback| {
            let variance = levels(&self.render(ShadowSettings { pcf_fallback, ..self.shadow }));
            let leak = |(variance, filtered): (&u8, &u8)| i32::from(*variance) - i32::from(*filtered);
            variance.iter().zip(&filtered).map(leak).max().unwrap_or(0)
        })
    }

    /// Asserts at most two leaked levels with the fallback, and at least `control` levels without.
    fn check(&self, name: &str, control: i32) {
        let [leaked, control_levels] = self.leaked_levels();
        println!("{name}: {leaked} levels, {control_levels} without the fallback");
        assert!(leaked <= 2, "{name}: expected at most 2 levels above the filtered map, got {leaked}");
        assert!(control_levels >= control, "{name}: negative control: expected {control} levels, got {control_levels}");
    }
}

#[test]
fn overlapping_layers_leak_at_most_two_levels() {
    let base = LayerScene::roof_and_slab();
    base.check("roof and slab", 20);
    LayerScene { has_ground: true, ..base.clone() }.check("on the ground", 20);
    let mut three_layers = base.clone();
    three_layers.layers.push(Layer { height: 4.0, angle: 1.3, offset: -0.03 });
    three_layers.check("three layers", 20);
    // The camera also sees the edge of the slab, which receives the shadow of the third layer.
    let view_from_above = LayerScene { eye_height: 3.0, half_view: 0.6, ..three_layers };
    view_from_above.check("edge of a layer as receiver", 20);
}

#[test]
fn layers_in_other_directions_leak_at_most_two_levels() {
    let base = LayerScene::roof_and_slab();
    for (roll, pitch, yaw) in [(0.4, 0.0, 0.3), (-0.9, 0.5, 1.0), (0.2, -1.1, 2.5)] {
        let rotation = Rotation3::from_euler_angles(roll, pitch, yaw);
        LayerScene { rotation, ..base.clone() }.check(&format!("rotated by {roll}, {pitch}, {yaw}"), 20);
    }
}

#[test]
fn thin_gaps_and_deep_ranges_leak_at_most_two_levels() {
    let base = LayerScene::roof_and_slab();
    // A gap of two and a half texels.
    let mut thin_gap = base.clone();
    thin_gap.layers[1].height = 0.06;
    LayerScene { eye_height: 0.05, half_view: 0.3, ..thin_gap }.check("thin gap", 20);
    // The sides of the map are at least 1/32 of the diagonal, so that a texel is 1e4 / 32 / 2048 = 0.15 units.
    let mut deep_range = base.with_shadow(|shadow| ShadowSettings { size: 2048, ..shadow });
    deep_range.layers[0].height = 1e4;
    LayerScene { half_view: 1.8, ..deep_range }.check("depth range of 1e4", 20);
}

#[test]
fn layers_with_other_maps_leak_at_most_two_levels() {
    let base = LayerScene::roof_and_slab();
    let shadow = base.shadow;
    let cases = [
        ("three cascades", ShadowSettings { cascades: 3, ..shadow }),
        ("f16 moments", ShadowSettings { moments: MomentFormat::F16, ..shadow }),
        ("blur of 0", ShadowSettings { blur: 0.0, ..shadow }),
        ("blur of 4", ShadowSettings { blur: 4.0, ..shadow }),
        ("blur of 16", ShadowSettings { blur: 16.0, ..shadow }),
        ("no bleeding reduction", ShadowSettings { bleeding: 0.0, ..shadow }),
    ];
    for (name, shadow) in cases {
        let scene = base.clone().with_shadow(|_| shadow);
        // The image shows eight standard deviations of the blur; a texel is about 12 / 512 units.
        let half_view = scene.half_view.max(8.0 * f64::from(shadow.blur) * 12.0 / 512.0);
        LayerScene { half_view, ..scene }.check(name, 20);
    }
}
