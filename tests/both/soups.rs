//! Triangle soups that are hard to rasterize, and their windows.

use modalcast_compute::reference::raster::VisibilityBuffer;
use modalcast_model::scene::{CullMode, DrawRange, Viewport};
use nalgebra::{Matrix4, Point3, Vector3};

use crate::scenes::Random;

/// A mesh and the window that it is drawn in.
pub(crate) struct Soup {
    pub(crate) name: &'static str,
    pub(crate) positions: Vec<f32>,
    pub(crate) triangles: Vec<[u32; 3]>,
    pub(crate) groups: Vec<DrawRange>,
    pub(crate) window: Viewport,
}

impl Soup {
    fn new(name: &'static str, positions: Vec<f32>, triangles: Vec<[u32; 3]>, window: Viewport) -> Self {
        let half = triangles.len() as u32 / 2;
        let rest = triangles.len() as u32 - half;
        let groups = vec![
            DrawRange { first: 0, triangles: half, faces: CullMode::None },
            DrawRange { first: half, triangles: rest, faces: CullMode::Back },
        ];
        Self { name, positions, triangles, groups, window }
    }

    /// Triangles without shared vertices.
    fn apart(name: &'static str, positions: Vec<f32>, window: Viewport) -> Self {
        let count = positions.len() as u32 / 9;
        Self::new(name, positions, (0..count).map(|at| [3 * at, 3 * at + 1, 3 * at + 2]).collect(), window)
    }

    /// The result of the definition.
    pub(crate) fn drawn(&self) -> VisibilityBuffer {
        let mut raster = VisibilityBuffer::new(self.window);
        self.groups.iter().for_each(|group| raster.draw(&self.positions, &self.triangles, *group));
        raster
    }
}

/// A camera at the origin that looks along -z with a vertical field of view of 60 degrees.
pub(crate) fn perspective(width: u32, height: u32, near: f64, far: f64) -> Viewport {
    let aspect = f64::from(width) / f64::from(height);
    let clip = nalgebra::Perspective3::new(aspect, 60.0_f64.to_radians(), near, far);
    Viewport::new(&clip.to_homogeneous(), width, height).expect("a window")
}

/// A window whose scene coordinates are clip space.
pub(crate) fn flat(width: u32, height: u32) -> Viewport {
    Viewport::new(&Matrix4::identity(), width, height).expect("a window")
}

/// Triangles with random corners around random centers.
fn scattered(random: &mut Random, count: usize, reach: f32, size: [f32; 3]) -> Vec<f32> {
    let mut positions = Vec::with_capacity(9 * count);
    for _ in 0..count {
        let middle = random.triple().map(|number| reach * number);
        for _ in 0..3 {
            let aside = random.triple();
            positions.extend((0..3).map(|axis| middle[axis] + size[axis] * aside[axis]));
        }
    }
    positions
}

/// A fan around a center; its rim lies beyond the border of [`flat`].
pub(crate) fn fan(window: Viewport) -> Soup {
    let mut random = Random(11);
    let mut positions = vec![0.05, -0.03, 0.0];
    let spokes = 40_u32;
    for spoke in 0..spokes {
        let angle = std::f32::consts::TAU * spoke as f32 / spokes as f32;
        positions.extend([1.9 * angle.cos(), 1.9 * angle.sin(), 0.5 * random.number()]);
    }
    let triangles = (0..spokes).map(|spoke| [0, 1 + spoke, 1 + (spoke + 1) % spokes]).collect();
    let mut soup = Soup::new("a fan", positions, triangles, window);
    soup.groups = vec![DrawRange { first: 0, triangles: spokes, faces: CullMode::None }];
    soup
}

/// Triangles without area, with repeated vertices or collinear corners, and between them one with area.
fn degenerate() -> Soup {
    let mut positions = scattered(&mut Random(9), 8, 0.8, [0.6; 3]);
    positions.extend([[-0.9, -0.9, 0.0], [0.0, 0.0, 0.1], [0.9, 0.9, 0.2]].concat());
    let triangles = (0..24).flat_map(|at: u32| {
        let (a, b) = (at, (at + 7) % 24);
        [[a, a, a], [a, a, b], [a, b, a], [b, a, a], [24, 25, 26], [26, 25, 24], [a, b, 25]]
    });
    Soup::new("degenerate", positions, triangles.collect(), flat(160, 90))
}

/// All soups.
pub(crate) fn soups() -> Vec<Soup> {
    let mut random = Random(5);
    let random = &mut random;
    let mut holes = scattered(random, 600, 1.0, [0.3; 3]);
    for (at, poison) in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX].into_iter().enumerate() {
        (at..holes.len()).step_by(61 + at).for_each(|place| holes[place] = poison);
    }
    let tied = scattered(random, 40, 0.7, [0.4; 3]).repeat(3);
    let far_clip = {
        let eye = Point3::new(1e7, 1e7, 1e7 + 8.0);
        let view = Matrix4::look_at_rh(&eye, &Point3::new(1e7, 1e7, 1e7), &Vector3::y());
        nalgebra::Perspective3::new(1.5, 0.9, 0.1, 100.0).to_homogeneous() * view
    };
    let far: Vec<f32> = scattered(random, 300, 3.0, [2.0; 3]).into_iter().map(|number| number + 1e7).collect();
    let behind: Vec<f32> = scattered(random, 100, 1.0, [0.5; 3]);
    let behind = behind.chunks_exact(3).flat_map(|p| [p[0], p[1], p[2] + 5.0]).collect();
    vec![
        Soup::apart("below a pixel", scattered(random, 6000, 1.1, [0.004; 3]), flat(200, 120)),
        Soup::apart("a few pixels", scattered(random, 2000, 1.1, [0.04; 3]), flat(301, 177)),
        Soup::apart("slivers", scattered(random, 400, 1.0, [0.9, 0.001, 0.3]), flat(311, 97)),
        Soup::apart("slivers upright", scattered(random, 400, 1.0, [0.0005, 1.9, 0.3]), flat(311, 97)),
        Soup::apart("large", scattered(random, 60, 1.0, [3.0, 3.0, 0.9]), flat(257, 255)),
        Soup::apart("huge", scattered(random, 60, 1.0, [1e4, 1e4, 0.9]), flat(129, 65)),
        Soup::apart("through the near plane", scattered(random, 300, 1.0, [2.0; 3]), perspective(160, 120, 0.1, 10.0)),
        Soup::apart("near 1e-6, far 1e9", scattered(random, 100, 1.0, [9.0; 3]), perspective(160, 120, 1e-6, 1e9)),
        Soup::apart("behind the eye", behind, perspective(64, 64, 0.1, 10.0)),
        Soup::apart("beyond the far plane", scattered(random, 200, 6.0, [4.0; 3]), perspective(90, 90, 0.1, 4.0)),
        Soup::apart("no numbers", holes, flat(97, 101)),
        Soup::apart("tied", tied, flat(64, 64)),
        Soup::apart("1e7 away", far, Viewport::new(&far_clip, 150, 100).expect("a window")),
        Soup::apart("one pixel", scattered(random, 200, 1.0, [2.0; 3]), flat(1, 1)),
        Soup::apart("a long window", scattered(random, 40, 1.0, [1.0; 3]), flat(16384, 2)),
        Soup::apart("a tall window", scattered(random, 40, 1.0, [1.0; 3]), flat(2, 16384)),
        Soup::apart("a window without numbers", scattered(random, 9, 1.0, [1.0; 3]), {
            Viewport::new(&Matrix4::from_element(f64::NAN), 8, 8).expect("a window")
        }),
        Soup::apart("nothing", Vec::new(), flat(8, 8)),
        degenerate(),
        fan(flat(128, 128)),
    ]
}
