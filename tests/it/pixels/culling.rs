//! Culled frames are bit-identical to frames without culling and do not depend on earlier frames. The numbers of culled
//! triangles equal the expected ones.
//!
//! `Culling::Triangles` culls triangles outside the view, back faces, and triangles that cover no sample.
//! `Culling::Occlusion` also culls triangles behind those that were visible in the previous frame. So the first frame
//! of a scene has no occlusion culling.

use std::sync::{Arc, OnceLock};

use modalcast_model::deform::DeformedSurface;
use modalcast_model::domain::{AlphaMode, Material, Mesh};
use modalcast_model::scene::{
    BoundingBox, Camera, Culling, Ground, Lens, PixelRect, Scene, ShadowMethod, ShadowSettings, Transparency, View,
};
use modalcast_render::{
    Aov, FrameCullStats, FrameParams, FrameStats, Pass, PickHit, Renderer, SceneBuffers, VisibilityId,
};

use super::harness::{SceneBuilder, facing_rectangle, front_camera, open_renderer};

const CULLING_MODES: [Culling; 3] = [Culling::None, Culling::Triangles, Culling::Occlusion];
/// Default side of a frame in pixels.
const SIZE: u32 = 96;
/// Values of [`Material::double_sided`].
const SINGLE_SIDED: bool = false;
const DOUBLE_SIDED: bool = true;

/// One frame: its pixels, the id of the first sample of each pixel, and its statistics.
struct Frame {
    rgba: Vec<u8>,
    ids: Vec<VisibilityId>,
    stats: FrameStats,
}

impl Frame {
    fn culled(&self) -> FrameCullStats {
        self.stats.culled.expect("expected culling statistics")
    }
}

/// A scene with one culling mode, and its renderer.
struct CullHarness {
    renderer: Renderer,
    buffers: SceneBuffers,
    scene: Arc<Scene>,
    /// Bounds that the renderer receives with each frame, in scene units.
    bounds: BoundingBox,
}

impl CullHarness {
    /// Loads the scene with its vertices at rest.
    fn new(mut builder: SceneBuilder, culling: Culling) -> Self {
        builder.parts.look.culling = culling;
        let (scene, mut renderer) = (builder.build(), open_renderer());
        let buffers = renderer.load(&scene).expect("expected the scene to load");
        let bounds = scene.rest_bounds;
        let mut harness = Self { renderer, buffers, scene, bounds };
        harness.move_vertices(|point| point);
        harness
    }

    /// Moves every vertex to `position(rest_position)`. `bounds` do not change.
    fn move_vertices(&mut self, position: impl Fn([f32; 3]) -> [f32; 3]) {
        let mut surface = DeformedSurface::default();
        for domain in &self.scene.domains {
            let mesh = &self.scene.shapes[domain.shape].mesh;
            surface.positions.extend(mesh.rest_positions().iter().flat_map(|point| position(*point)));
            surface.normals.extend(mesh.corners().normals.as_flattened());
        }
        self.renderer.upload(&self.buffers, &surface).expect("expected the upload to succeed");
    }

    fn draw(&mut self, camera: Camera, [width, height]: [u32; 2]) -> Frame {
        let params =
            FrameParams { camera, width, height, bounds: self.bounds, light_bounds: None, edges: None, samples: None };
        let rgba = self.renderer.draw(&self.buffers, &params).expect("expected a frame").rgba;
        let stats = self.renderer.stats().clone();
        Frame { rgba, ids: self.renderer.read_visibility().expect("expected visibility ids"), stats }
    }
}

/// A camera that shows `target` at the center of a square image with side [`SIZE`]. Its clip planes are fitted to the
/// bounds.
fn camera_at(eye: [f64; 3], target: [f64; 3]) -> Camera {
    let view = View::LookAt { eye, target, up: [0.0, 1.0, 0.0] };
    let center = f64::from(SIZE / 2);
    Camera { view, lens: Lens::Intrinsics { fx: 60.0, fy: 60.0, cx: center, cy: center }, near: 0.0, far: 0.0 }
}

/// A mesh of separate triangles that share no vertices.
fn separate_triangles(triangles: &[[[f32; 3]; 3]]) -> Mesh {
    let positions = triangles.as_flattened().to_vec();
    let corner_count = positions.len() as u32;
    let uvs = (0..corner_count).map(|corner| [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]][corner as usize % 3]).collect();
    let indices = (0..corner_count / 3).map(|triangle| [3 * triangle, 3 * triangle + 1, 3 * triangle + 2]).collect();
    Mesh::from_indexed(positions, vec![[0.0, 0.0, 1.0]; corner_count as usize], uvs, indices)
        .expect("expected a valid mesh")
}

/// Triangles of sizes from 0.003 to 3 in a cube with half side `extent` around the origin. About one in 40 has no area.
fn random_triangles(seed: u64, count: usize, extent: f32) -> Mesh {
    let mut random = fastrand::Rng::with_seed(seed);
    let mut triangles = Vec::new();
    for _ in 0..count {
        // A random number from -limit to limit.
        let mut random_within = |limit: f32| limit * (2.0 * random.f32() - 1.0);
        let triangle_size = 10.0_f32.powf(random_within(1.5) - 1.0);
        let center: [f32; 3] = [random_within(extent), random_within(extent), random_within(extent)];
        let mut corner = || [0, 1, 2].map(|axis| center[axis] + random_within(triangle_size));
        let [a, b, c] = [corner(), corner(), corner()];
        triangles.push(if random_within(1.0) > 0.95 { [a, b, b] } else { [a, b, c] });
    }
    separate_triangles(&triangles)
}

/// A material with equal ambient and diffuse color.
fn material(alpha_mode: AlphaMode, double_sided: bool, color: [f32; 3]) -> Material {
    Material { alpha_mode, double_sided, diffuse: color, ambient: color, ..Material::default() }
}

/// Whether the OpenGL driver is a software renderer.
fn is_software() -> bool {
    static SOFTWARE: OnceLock<bool> = OnceLock::new();
    *SOFTWARE.get_or_init(|| open_renderer().info().software)
}

/// Number of triangles of [`mixed_builder`]: single-sided and double-sided, each of them in four domains.
const MIXED_TRIANGLES: u32 = 2 * (700 + 400 + 60 + 700);

/// Every kind of material, single-sided and double-sided. Each opaque triangle exists twice, so that depths tie.
fn mixed_builder(samples: u32, transparency: Transparency) -> SceneBuilder {
    let mut builder = SceneBuilder::new();
    (builder.parts.look.samples, builder.parts.look.transparency) = (samples, transparency);
    builder.parts.look.ground = Some(Ground::default());
    builder.parts.look.shadow = Some(ShadowSettings { size: 256, ..ShadowSettings::default() });
    let leaf_image = builder.add_texture(8, 8, |x, y| [90, 200, 60, if (x / 2 + y / 2) % 2 == 0 { 255 } else { 10 }]);
    let mask = AlphaMode::Mask { cutoff: 0.5 };
    for (seed, double_sided) in [(1, false), (2, true)] {
        // With several samples per pixel, a software renderer samples cut-out textures at centroids that depend on
        // hidden triangles; see `Culling::Occlusion`. So the leaves have no texture in this case.
        let leaf_texture = (samples == 1 || !is_software()).then_some(leaf_image);
        let leaves = Material { color_texture: leaf_texture, alpha: 0.75, ..material(mask, double_sided, [1.0; 3]) };
        let glass = Material { alpha: 0.5, ..material(AlphaMode::Blend, double_sided, [0.2, 0.4, 0.9]) };
        builder = builder
            .add_domain(random_triangles(seed, 700, 3.0), material(AlphaMode::Opaque, double_sided, [0.8, 0.3, 0.2]))
            .add_domain(random_triangles(seed + 2, 400, 3.0), leaves)
            .add_domain(random_triangles(seed + 4, 60, 3.0), glass)
            // The opaque triangles again in another color.
            .add_domain(random_triangles(seed, 700, 3.0), material(AlphaMode::Opaque, double_sided, [0.2, 0.9, 0.3]));
    }
    builder
}

/// Draws frames with every culling mode and asserts that they are identical. Returns the frames with
/// [`Culling::Occlusion`].
fn assert_same_frames(
    create_builder: &dyn Fn() -> SceneBuilder,
    draw_frames: &dyn Fn(&mut CullHarness) -> Vec<Frame>,
) -> Vec<Frame> {
    let [unculled, with_triangle_culling, with_occlusion] =
        CULLING_MODES.map(|culling| draw_frames(&mut CullHarness::new(create_builder(), culling)));
    for (index, expected) in unculled.iter().enumerate() {
        assert!(expected.stats.culled.is_none(), "negative control: expected a frame without culling");
        for culled in [&with_triangle_culling[index], &with_occlusion[index]] {
            assert!(culled.ids == expected.ids, "frame {index}: expected the same visible triangles");
            assert!(culled.rgba == expected.rgba, "frame {index}: expected the same colors");
            assert!(culled.stats.oit == expected.stats.oit, "frame {index}: expected the same fragment counts");
        }
    }
    with_occlusion
}

/// Positions (eye, target) of cameras.
const CAMERAS: [([f64; 3], [f64; 3]); 5] = [
    ([0.0, 1.0, 9.0], [0.0; 3]),
    // Almost the view of the first camera.
    ([0.0, 1.2, 9.0], [0.1, 0.0, 0.0]),
    // From the opposite side.
    ([-1.0, 2.0, -9.0], [0.0; 3]),
    // From the center of the scene.
    ([0.1, 0.0, 0.2], [1.0, 0.2, -3.0]),
    // From a point near the border of the scene.
    ([2.0, 2.0, 2.0], [2.4, 2.0, 1.0]),
];

/// Every triangle is counted once: as visible, or as culled for one reason.
#[test]
fn culled_frames_are_bit_identical_after_camera_moves() {
    for (samples, transparency) in
        [(1, Transparency::OrderIndependent), (4, Transparency::OrderIndependent), (4, Transparency::TwoPass)]
    {
        let frames = assert_same_frames(&|| mixed_builder(samples, transparency), &|harness| {
            // Frame 5 shows the first camera again.
            let cameras = CAMERAS.into_iter().chain([CAMERAS[0]]);
            cameras.map(|(eye, target)| harness.draw(camera_at(eye, target), [SIZE, SIZE])).collect()
        });
        let camera_stats: Vec<_> = frames.iter().map(|frame| frame.culled().camera).collect();
        assert_eq!(camera_stats[0].occluded, 0, "expected no occlusion culling in the first frame");
        // The minimum numbers show that each reason for culling occurs.
        assert!(camera_stats[1].occluded > 100, "{camera_stats:?}");
        assert!(camera_stats.iter().all(|stats| stats.visible > 0 && stats.no_sample > 50), "{camera_stats:?}");
        let from_scene_center = camera_stats[3];
        assert!(camera_stats[0].back_facing > 100 && from_scene_center.outside_view > 500, "{camera_stats:?}");
        assert!(frames[0].rgba == frames[5].rgba, "expected the same frame of the same camera");
        assert!(
            camera_stats.iter().all(|stats| stats.visible + stats.culled() == MIXED_TRIANGLES),
            "expected each triangle to be counted once, got {camera_stats:?}"
        );
    }
}

/// Visible triangles are compacted to lists with a prefix sum over blocks and superblocks of triangles. The lists of
/// this test span several superblocks.
#[test]
fn long_triangle_lists_keep_their_order() {
    let builder = || {
        let mut builder = SceneBuilder::new();
        builder.parts.look.samples = 1;
        let mask = AlphaMode::Mask { cutoff: 0.5 };
        builder
            .add_domain(random_triangles(7, 45_000, 4.0), material(AlphaMode::Opaque, SINGLE_SIDED, [0.8, 0.3, 0.2]))
            .add_domain(random_triangles(7, 20_000, 4.0), material(AlphaMode::Opaque, DOUBLE_SIDED, [0.2, 0.3, 0.9]))
            .add_domain(random_triangles(8, 17_000, 4.0), material(mask, DOUBLE_SIDED, [0.3, 0.8, 0.2]))
    };
    let frames = assert_same_frames(&builder, &|harness| {
        [0.0, 0.1, 0.2].map(|x| harness.draw(camera_at([x, 1.0, 14.0], [x, 0.0, 0.0]), [SIZE, SIZE])).into()
    });
    let camera_stats = frames[2].culled().camera;
    assert_eq!(camera_stats.visible + camera_stats.culled(), 45_000 + 20_000 + 17_000);
    assert!(camera_stats.occluded > 10_000 && camera_stats.visible < 40_000, "{camera_stats:?}");
}

#[test]
fn culled_frames_of_moving_scenes_are_bit_identical() {
    // Rotates the scene about y and bends it along y.
    let position_at = |step: usize| {
        move |[x, y, z]: [f32; 3]| {
            let (sin, cos) = (0.2 * step as f32).sin_cos();
            [x * cos - z * sin, y + 0.3 * (x + step as f32).sin(), x * sin + z * cos]
        }
    };
    assert_same_frames(&|| mixed_builder(4, Transparency::OrderIndependent), &|harness| {
        let mut frames = Vec::new();
        for step in 0..5 {
            harness.move_vertices(position_at(step));
            // An odd height: the image does not consist of whole blocks of pixels.
            frames.push(harness.draw(camera_at([0.0, 1.0, 9.0], [0.0; 3]), [SIZE, SIZE - 7]));
        }
        frames
    });
}

#[test]
fn culling_handles_non_finite_and_huge_positions() {
    // Replaces y of about one in `interval` vertices. The bits of x select them like a random number.
    let replace_y = |value: f32, interval: u32| {
        move |[x, y, z]: [f32; 3]| if (x.to_bits() / 8).is_multiple_of(interval) { [x, value, z] } else { [x, y, z] }
    };
    assert_same_frames(&|| mixed_builder(4, Transparency::OrderIndependent), &|harness| {
        let mut frames = Vec::new();
        for value in [f32::NAN, f32::INFINITY, 3e38, -1e30, 1e19, 1e6] {
            for interval in [1, 3] {
                harness.move_vertices(replace_y(value, interval));
                frames.push(harness.draw(camera_at([0.0, 1.0, 9.0], [0.0; 3]), [SIZE, SIZE]));
            }
        }
        frames
    });
}

#[test]
fn culling_handles_far_scenes_and_extreme_clip_planes() {
    // Clip planes of 0 are fitted to the bounds. The last planes lie on both sides of the scene's center at distance 9.
    // From 1e6 on, neighboring f32 numbers are 0.06 or more apart, so that triangles may lose their area.
    for (shift, near, far) in [(1e4, 0.0, 0.0), (1e6, 0.0, 0.0), (1e7, 0.0, 0.0), (0.0, 1e-6, 1e9), (0.0, 8.9, 9.1)] {
        let frames = assert_same_frames(&|| mixed_builder(4, Transparency::OrderIndependent), &|harness| {
            harness.move_vertices(|[x, y, z]| [x + shift as f32, y, z]);
            harness.bounds.min[0] += shift;
            harness.bounds.max[0] += shift;
            let camera = Camera { near, far, ..camera_at([shift, 1.0, 9.0], [shift, 0.0, 0.0]) };
            (0..3).map(|_| harness.draw(camera, [SIZE, SIZE])).collect()
        });
        let triangle_pixels = frames[2].ids.iter().filter(|id| matches!(id, VisibilityId::Triangle(_))).count();
        assert!(
            triangle_pixels > 0 || shift >= 1e6,
            "expected triangles at a shift of {shift}, near {near}, far {far}"
        );
    }
}

#[test]
fn huge_triangles_and_a_lone_triangle_are_not_culled() {
    let huge_builder = || {
        let wall = |z: f32| [[-1e5, -1e5, z], [1e5, -1e5, z], [0.0, 1e5, z]];
        // A triangle that extends from behind the walls at z = -20 to behind the eye at z = 20.
        let crossing_triangle = [[-3.0, -1.0, 20.0], [3.0, -1.0, 20.0], [0.0, -1.0, -20.0]];
        let mesh = separate_triangles(&[
            wall(-2.0),
            wall(-2.5),
            crossing_triangle,
            [[0.0, 0.0, 0.0], [1e9, 0.0, 0.0], [0.0, 1e9, 0.0]],
        ]);
        SceneBuilder::new().add_domain(mesh, material(AlphaMode::Opaque, DOUBLE_SIDED, [0.7; 3]))
    };
    let single_builder = || {
        SceneBuilder::new().add_domain(
            separate_triangles(&[[[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 1.0, 0.0]]]),
            Material::default(),
        )
    };
    for builder in [&huge_builder as &dyn Fn() -> SceneBuilder, &single_builder] {
        let frames = assert_same_frames(builder, &|harness| {
            let camera = Camera { near: 0.01, far: 1e3, ..front_camera(64) };
            (0..3).map(|_| harness.draw(camera, [64, 64])).collect()
        });
        assert!(frames[2].ids.iter().any(|id| matches!(id, VisibilityId::Triangle(_))));
    }
}

/// Number of triangles of [`half_hidden_builder`].
const HALF_HIDDEN_TRIANGLES: u32 = 32 * 32 + 2;

/// A grid of 32 x 32 small triangles, and a square of two triangles in front of it that hides half of the grid.
fn half_hidden_builder() -> SceneBuilder {
    let small_triangle = |index: usize| {
        let (x, y) = ((index % 32) as f32 * 0.25 - 4.0, (index / 32) as f32 * 0.25 - 4.0);
        [[x + 0.02, y + 0.02, -1.0], [x + 0.22, y + 0.02, -1.0], [x + 0.02, y + 0.22, -1.0]]
    };
    let grid: Vec<_> = (0..32 * 32).map(small_triangle).collect();
    let mut builder = SceneBuilder::new()
        .add_domain(separate_triangles(&grid), material(AlphaMode::Opaque, DOUBLE_SIDED, [0.9, 0.2, 0.1]))
        .add_domain(
            facing_rectangle(-4.5, -4.5, 0.0, 4.5, 0.0),
            material(AlphaMode::Opaque, SINGLE_SIDED, [0.1, 0.2, 0.9]),
        );
    builder.parts.look.samples = 1;
    builder
}

#[test]
fn hidden_count_equals_triangles_behind_the_square() {
    let mut harness = CullHarness::new(half_hidden_builder(), Culling::Occlusion);
    let first_stats = harness.draw(front_camera(128), [128, 128]).culled().camera;
    assert_eq!((first_stats.occluded, first_stats.visible), (0, HALF_HIDDEN_TRIANGLES));
    let second_stats = harness.draw(front_camera(128), [128, 128]).culled().camera;
    // The square hides the 16 columns of the grid left of x = 0. The column at the edge of the square shares pixels
    // with visible triangles, so it may count as visible.
    assert_eq!((second_stats.outside_view, second_stats.back_facing, second_stats.no_sample), (0, 0, 0));
    assert!((15 * 32..=16 * 32).contains(&second_stats.occluded), "{second_stats:?}");
    assert_eq!(second_stats.visible + second_stats.occluded, HALF_HIDDEN_TRIANGLES);
    // From behind, nothing is hidden, and the two triangles of the square face away.
    let stats_from_behind = harness.draw(camera_at([0.0, 0.0, -12.0], [0.0; 3]), [SIZE, SIZE]).culled().camera;
    assert_eq!((stats_from_behind.back_facing, stats_from_behind.occluded), (2, 0));
    // For a camera that looks away, all triangles are outside the view frustum.
    let stats_looking_away = harness.draw(camera_at([0.0, 0.0, 12.0], [0.0, 0.0, 30.0]), [SIZE, SIZE]).culled().camera;
    assert_eq!((stats_looking_away.outside_view, stats_looking_away.visible), (HALF_HIDDEN_TRIANGLES, 0));
}

/// A triangle between the samples is culled; a triangle of the same size that contains a sample is drawn.
#[test]
fn triangles_without_a_sample_are_culled() {
    let small_triangle = |x: f32, y: f32| [[x, y, 0.0], [x + 0.002, y, 0.0], [x, y + 0.002, 0.0]];
    // Ten pixels per unit: pixel centers lie at 0.05 + 0.1 i for integers i. The first triangle contains no pixel
    // center, the second triangle contains (0.05, 0.05).
    let mesh = separate_triangles(&[small_triangle(0.0, 0.0), small_triangle(0.0492, 0.0492)]);
    let mut builder = SceneBuilder::new().add_domain(mesh, Material::default());
    builder.parts.look.samples = 1;
    let frame = CullHarness::new(builder, Culling::Triangles).draw(front_camera(64), [64, 64]);
    let camera_stats = frame.culled().camera;
    assert_eq!((camera_stats.no_sample, camera_stats.visible), (1, 1), "{camera_stats:?}");
    assert_eq!(
        frame.ids.iter().filter(|id| **id == VisibilityId::Triangle(1)).count(),
        1,
        "negative control: expected one visible sample"
    );
}

#[test]
fn shadows_of_culled_casters_are_bit_identical() {
    for (method, cascades) in [(ShadowMethod::Standard, 1), (ShadowMethod::Variance, 1), (ShadowMethod::Standard, 3)] {
        let builder = || {
            let mut builder = mixed_builder(1, Transparency::OrderIndependent);
            builder.parts.look.sun = [0.3, 0.8, 0.4];
            builder.parts.look.shadow =
                Some(ShadowSettings { size: 128, method, cascades, ..ShadowSettings::default() });
            builder
        };
        let frames = assert_same_frames(&builder, &|harness| {
            (0..2).map(|_| harness.draw(camera_at([0.0, 4.0, 12.0], [0.0; 3]), [SIZE, SIZE])).collect()
        });
        let shadow_stats = frames[0].culled().shadow;
        assert!(
            shadow_stats.no_sample > 100 * cascades && shadow_stats.back_facing == 0 && shadow_stats.occluded == 0,
            "{shadow_stats:?}"
        );
        assert_eq!(shadow_stats.visible + shadow_stats.culled(), cascades * MIXED_TRIANGLES);
    }
}

/// On software renderers, hidden triangles move the centroids at which multisampled cut-outs sample their textures. So
/// these renderers draw hidden triangles of scenes with such cut-outs.
#[test]
fn software_renderers_draw_hidden_multisampled_cut_outs() {
    for (samples, alpha_mode, disables_occlusion_culling) in [
        (4, AlphaMode::Mask { cutoff: 0.5 }, true),
        (1, AlphaMode::Mask { cutoff: 0.5 }, false),
        (4, AlphaMode::Opaque, false),
    ] {
        let mut builder = SceneBuilder::new();
        builder.parts.look.samples = samples;
        let white_image = Some(builder.add_texture(1, 1, |_, _| [255; 4]));
        let material_with_image =
            Material { color_texture: white_image, ..material(alpha_mode, DOUBLE_SIDED, [1.0; 3]) };
        let mut harness = CullHarness::new(
            builder.add_domain(facing_rectangle(-1.0, -1.0, 1.0, 1.0, 0.0), material_with_image),
            Culling::Occlusion,
        );
        let uses_occlusion_culling = harness.draw(front_camera(64), [64, 64]).stats.passes.contains(&Pass::Occluders);
        assert_eq!(uses_occlusion_culling, !(disables_occlusion_culling && harness.renderer.info().software));
    }
}

#[test]
fn picks_aovs_and_rebased_frames_do_not_depend_on_culling() {
    #[derive(PartialEq)]
    struct Results {
        hits: Vec<PickHit>,
        depth: Vec<u8>,
        rebased_images: [Vec<u8>; 2],
    }
    let [unculled, with_triangle_culling, with_occlusion] = CULLING_MODES.map(|culling| {
        let mut harness = CullHarness::new(mixed_builder(4, Transparency::OrderIndependent), culling);
        let camera = camera_at([0.0, 1.0, 9.0], [0.0; 3]);
        let params = FrameParams {
            camera,
            width: SIZE,
            height: SIZE,
            bounds: harness.scene.rest_bounds,
            light_bounds: None,
            edges: None,
            samples: None,
        };
        harness.draw(camera, [SIZE, SIZE]);
        let rectangle = PixelRect::within([SIZE; 2], [40; 2], [8; 2]).expect("expected a valid rectangle");
        let pick = harness.renderer.begin_pick(&harness.buffers, &params, rectangle).expect("expected a pick to start");
        let hits = harness.renderer.finish_pick(pick).expect("expected hits");
        let depth = harness.renderer.render_aov(&harness.buffers, &params, Aov::Depth).expect("expected AOVs").bytes;
        // `upload_rebased` takes positions relative to an origin of their own. The shift by 0.75 and the origin at 0.25
        // together move the scene by 1 along x.
        let rest_positions = harness.scene.shapes.iter().flat_map(|shape| shape.mesh.rest_positions());
        let shifted_positions: Vec<f32> = rest_positions.flat_map(|[x, y, z]| [x + 0.75, *y, *z]).collect();
        harness
            .renderer
            .upload_rebased(&mut harness.buffers, &shifted_positions, [0.25, 0.0, 0.0])
            .expect("expected the upload to succeed");
        let rebased_images =
            [harness.draw(camera, [SIZE, SIZE]), harness.draw(camera, [SIZE, SIZE])].map(|frame| frame.rgba);
        Results { hits, depth, rebased_images }
    });
    assert!(!unculled.hits.is_empty() && unculled.rebased_images[0] == unculled.rebased_images[1]);
    assert!(with_triangle_culling == unculled && with_occlusion == unculled);
}

#[test]
fn small_scene_with_default_culling_has_no_culling_buffers() {
    let default_harness = CullHarness::new(half_hidden_builder(), Culling::Auto);
    assert!(
        default_harness
            .buffers
            .allocations()
            .iter()
            .all(|allocation| !allocation.name.contains("cull") && !allocation.name.contains("visible"))
    );
}

#[test]
fn culled_draw_calls_do_not_grow_with_domains() {
    let draw_calls = |domains: usize| {
        let mut builder = SceneBuilder::new();
        for index in 0..domains {
            builder = builder.add_domain(
                facing_rectangle(-1.0, -1.0, 1.0, 1.0, -(index as f32)),
                material(AlphaMode::Opaque, DOUBLE_SIDED, [0.5; 3]),
            );
        }
        let mut harness = CullHarness::new(builder, Culling::Occlusion);
        let frame = harness.draw(front_camera(64), [64, 64]);
        assert_eq!(frame.stats.passes, harness.buffers.plan().passes);
        assert_eq!(frame.stats.draw_calls, harness.buffers.plan().draw_calls);
        frame.stats.draw_calls
    };
    // The occluder pass and the visibility pass have one draw call each.
    assert_eq!((draw_calls(1), draw_calls(40)), (2, 2));
}
