//! Triangle soups that are hard to rasterize, and their viewports. A soup is a list of triangles that need not form a
//! surface.

use modalcast_compute::reference::raster::VisibilityBuffer;
use modalcast_model::scene::{CullMode, DrawRange, Viewport};
use nalgebra::{Matrix4, Point3, Vector3, Vector4};

use crate::scenes::Random;

/// Triangles and the viewport that they are drawn in.
pub(crate) struct Soup {
    pub(crate) name: &'static str,
    /// Three numbers per vertex.
    pub(crate) positions: Vec<f32>,
    pub(crate) triangles: Vec<[u32; 3]>,
    /// Ranges of triangles with the same cull mode.
    pub(crate) groups: Vec<DrawRange>,
    pub(crate) viewport: Viewport,
}

impl Soup {
    /// The first half of the triangles is drawn without culling, the second half with culling of back faces.
    fn new(name: &'static str, positions: Vec<f32>, triangles: Vec<[u32; 3]>, viewport: Viewport) -> Self {
        let first_half = triangles.len() as u32 / 2;
        let second_half = triangles.len() as u32 - first_half;
        let groups = vec![
            DrawRange { first_triangle: 0, triangle_count: first_half, cull_mode: CullMode::None },
            DrawRange { first_triangle: first_half, triangle_count: second_half, cull_mode: CullMode::Back },
        ];
        Self { name, positions, triangles, groups, viewport }
    }

    /// Triangles without shared vertices.
    fn with_separate_triangles(name: &'static str, positions: Vec<f32>, viewport: Viewport) -> Self {
        let count = positions.len() as u32 / 9;
        Self::new(
            name,
            positions,
            (0..count).map(|triangle| [3 * triangle, 3 * triangle + 1, 3 * triangle + 2]).collect(),
            viewport,
        )
    }

    /// Draws the soup with the reference rasterizer.
    pub(crate) fn rasterize(&self) -> VisibilityBuffer {
        let mut raster = VisibilityBuffer::new(self.viewport);
        self.groups.iter().for_each(|group| raster.draw(&self.positions, &self.triangles, *group));
        raster
    }
}

/// A camera at the origin that looks along -z with a vertical field of view of 60 degrees.
pub(crate) fn perspective_viewport(width: u32, height: u32, near: f64, far: f64) -> Viewport {
    let aspect = f64::from(width) / f64::from(height);
    Viewport::new(&reversed_perspective(aspect, 60.0_f64.to_radians(), near, far), width, height)
        .expect("expected a valid viewport")
}

/// A perspective projection with the clip volume of [`Viewport`]: z / w is 1 at the near plane and 0 at the far plane.
/// `far` may be infinite.
fn reversed_perspective(aspect: f64, field_of_view: f64, near: f64, far: f64) -> Matrix4<f64> {
    let focal = 1.0 / (0.5 * field_of_view).tan();
    let mut clip = Matrix4::from_diagonal(&Vector4::new(focal / aspect, focal, 0.0, 0.0));
    // near (far - w) / (far - near), for w = -z.
    (clip[(2, 2)], clip[(2, 3)]) = (near / (far - near), near / (1.0 - near / far));
    clip[(3, 2)] = -1.0;
    clip
}

/// A viewport that uses x and y of positions as clip-space coordinates. z is from -1 (near) to 1 (far), and depth is
/// 0.5 - 0.5 z.
pub(crate) fn clip_space_viewport(width: u32, height: u32) -> Viewport {
    let mut clip = Matrix4::identity();
    (clip[(2, 2)], clip[(2, 3)]) = (-0.5, 0.5);
    Viewport::new(&clip, width, height).expect("expected a valid viewport")
}

/// Positions of triangles with random corners around random centers. Per axis, centers are within `extent` of the
/// origin, and corners within `size` of their center.
fn scattered_triangles(random: &mut Random, count: usize, extent: f32, size: [f32; 3]) -> Vec<f32> {
    let mut positions = Vec::with_capacity(9 * count);
    for _ in 0..count {
        let center = random.next_triple().map(|number| extent * number);
        for _ in 0..3 {
            let offset = random.next_triple();
            positions.extend((0..3).map(|axis| center[axis] + size[axis] * offset[axis]));
        }
    }
    positions
}

/// A fan around a center. Its outer vertices lie outside of [`clip_space_viewport`].
pub(crate) fn fan_soup(viewport: Viewport) -> Soup {
    let mut random = Random(11);
    let mut positions = vec![0.05, -0.03, 0.0];
    let spokes = 40_u32;
    for spoke in 0..spokes {
        let angle = std::f32::consts::TAU * spoke as f32 / spokes as f32;
        positions.extend([1.9 * angle.cos(), 1.9 * angle.sin(), 0.5 * random.next_number()]);
    }
    let triangles = (0..spokes).map(|spoke| [0, 1 + spoke, 1 + (spoke + 1) % spokes]).collect();
    let mut soup = Soup::new("fan", positions, triangles, viewport);
    soup.groups = vec![DrawRange { first_triangle: 0, triangle_count: spokes, cull_mode: CullMode::None }];
    soup
}

/// Triangles without area, because a vertex repeats or the corners are collinear, and a few triangles with an area.
fn degenerate_soup() -> Soup {
    let mut positions = scattered_triangles(&mut Random(9), 8, 0.8, [0.6; 3]);
    positions.extend([[-0.9, -0.9, 0.0], [0.0, 0.0, 0.1], [0.9, 0.9, 0.2]].concat());
    let triangles = (0..24).flat_map(|vertex: u32| {
        let (a, b) = (vertex, (vertex + 7) % 24);
        [[a, a, a], [a, a, b], [a, b, a], [b, a, a], [24, 25, 26], [26, 25, 24], [a, b, 25]]
    });
    Soup::new("degenerate", positions, triangles.collect(), clip_space_viewport(160, 90))
}

/// All soups, each with one difficulty that its name states.
pub(crate) fn all_soups() -> Vec<Soup> {
    let random = &mut Random(5);
    let mut non_finite = scattered_triangles(random, 600, 1.0, [0.3; 3]);
    // The four values replace every 61st, 62nd, 63rd and 64th coordinate. `f32::MAX` is finite, but the clip-space
    // position of its vertex may overflow.
    for (index, value) in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX].into_iter().enumerate() {
        (index..non_finite.len()).step_by(61 + index).for_each(|coordinate| non_finite[coordinate] = value);
    }
    let coincident = scattered_triangles(random, 40, 0.7, [0.4; 3]).repeat(3);
    let far_projection = {
        let eye = Point3::new(1e7, 1e7, 1e7 + 8.0);
        let view = Matrix4::look_at_rh(&eye, &Point3::new(1e7, 1e7, 1e7), &Vector3::y());
        reversed_perspective(1.5, 0.9, 0.1, 100.0) * view
    };
    let far_positions: Vec<f32> =
        scattered_triangles(random, 300, 3.0, [2.0; 3]).into_iter().map(|coordinate| coordinate + 1e7).collect();
    let positions_behind = scattered_triangles(random, 100, 1.0, [0.5; 3]);
    let positions_behind = positions_behind.chunks_exact(3).flat_map(|p| [p[0], p[1], p[2] + 5.0]).collect();
    // `extent` and `size` are those of `scattered_triangles`.
    let mut scattered_soup = |name, count, extent, size, viewport| {
        Soup::with_separate_triangles(name, scattered_triangles(random, count, extent, size), viewport)
    };
    let nan_viewport = Viewport::new(&Matrix4::from_element(f64::NAN), 8, 8).expect("expected a valid viewport");
    vec![
        scattered_soup("smaller than a pixel", 6000, 1.1, [0.004; 3], clip_space_viewport(200, 120)),
        scattered_soup("a few pixels", 2000, 1.1, [0.04; 3], clip_space_viewport(301, 177)),
        scattered_soup("slivers", 400, 1.0, [0.9, 0.001, 0.3], clip_space_viewport(311, 97)),
        scattered_soup("vertical slivers", 400, 1.0, [0.0005, 1.9, 0.3], clip_space_viewport(311, 97)),
        scattered_soup("large", 60, 1.0, [3.0, 3.0, 0.9], clip_space_viewport(257, 255)),
        scattered_soup("huge", 60, 1.0, [1e4, 1e4, 0.9], clip_space_viewport(129, 65)),
        scattered_soup("through the near plane", 300, 1.0, [2.0; 3], perspective_viewport(160, 120, 0.1, 10.0)),
        scattered_soup("near 1e-6, far 1e9", 100, 1.0, [9.0; 3], perspective_viewport(160, 120, 1e-6, 1e9)),
        scattered_soup(
            "near 2^-64, no far plane",
            300,
            1.0,
            [9.0; 3],
            perspective_viewport(160, 120, 5e-20, f64::INFINITY),
        ),
        Soup::with_separate_triangles("behind the eye", positions_behind, perspective_viewport(64, 64, 0.1, 10.0)),
        scattered_soup("beyond the far plane", 200, 6.0, [4.0; 3], perspective_viewport(90, 90, 0.1, 4.0)),
        Soup::with_separate_triangles("non-finite positions", non_finite, clip_space_viewport(97, 101)),
        Soup::with_separate_triangles("coincident", coincident, clip_space_viewport(64, 64)),
        Soup::with_separate_triangles(
            "1e7 from the origin",
            far_positions,
            Viewport::new(&far_projection, 150, 100).expect("expected a valid viewport"),
        ),
        scattered_soup("one-pixel viewport", 200, 1.0, [2.0; 3], clip_space_viewport(1, 1)),
        scattered_soup("wide viewport", 40, 1.0, [1.0; 3], clip_space_viewport(16384, 2)),
        scattered_soup("tall viewport", 40, 1.0, [1.0; 3], clip_space_viewport(2, 16384)),
        scattered_soup("NaN viewport", 9, 1.0, [1.0; 3], nan_viewport),
        Soup::with_separate_triangles("no triangles", Vec::new(), clip_space_viewport(8, 8)),
        degenerate_soup(),
        fan_soup(clip_space_viewport(128, 128)),
    ]
}
