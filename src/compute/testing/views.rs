//! Random batches of views.

use nalgebra::{Matrix3, Matrix4, Point3, Vector3};

use super::TestRng;
use modalcast_model::raster::{AlphaImage, AlphaMaterial, CutOuts};
use modalcast_model::scene::{CullMode, DrawRange};
use modalcast_model::views::{View, ViewCamera, ViewImage, ViewLight, ViewMaterial, ViewScene, ViewVertices};

/// Triangles of each domain of a [`ViewFixture`]: an opaque one-sided, an opaque double-sided and a third domain.
const DOMAIN_TRIANGLES: usize = 40;

/// A scene of random triangles, the vertices of its worlds, and cameras.
#[derive(Debug)]
pub struct ViewFixture {
    pub scene: ViewScene,
    pub positions: Vec<f32>,
    pub normals: Vec<f32>,
    pub tangents: Vec<f32>,
    /// The first ones look at the triangles from outside, the last one from between them.
    pub cameras: Vec<ViewCamera>,
}

impl ViewFixture {
    /// A fixture with this number of worlds. `has_images`: the triangles of the third domain have a color image, a
    /// normal map and holes.
    pub fn new(world_count: usize, has_images: bool, rng: &mut TestRng) -> Self {
        let scene = random_scene(has_images, rng);
        let unit = |rng: &mut TestRng| {
            let vector = Vector3::new(rng.next(), rng.next(), rng.next());
            vector.try_normalize(1e-3).unwrap_or_else(Vector3::y)
        };
        let (mut positions, mut normals, mut tangents) = (Vec::new(), Vec::new(), Vec::new());
        for _ in 0..world_count * scene.vertices / 3 {
            let center = Vector3::new(rng.next(), rng.next(), rng.next());
            for _ in 0..3 {
                positions.extend((center + 0.35 * unit(rng)).iter());
                normals.extend(unit(rng).iter());
                tangents.extend(unit(rng).iter().copied().chain([1.0_f32.copysign(rng.next())]));
            }
        }
        let eyes = [[2.5, 1.0, 2.0], [-2.0, 0.3, 2.5], [0.1, -0.2, 0.05]];
        let cameras = eyes.map(|eye| camera(eye, [0.0; 3], 1.0)).to_vec();
        Self { scene, positions, normals, tangents, cameras }
    }

    /// The vertices of all worlds.
    pub fn vertices(&self) -> ViewVertices<'_> {
        ViewVertices { positions: &self.positions, normals: &self.normals, tangents: &self.tangents }
    }

    /// A view of each world by each camera, in a random order.
    pub fn views(&self, rng: &mut TestRng) -> Vec<View> {
        let world_count = (self.positions.len() / (3 * self.scene.vertices)) as u32;
        let cameras = 0..self.cameras.len() as u32;
        let mut views: Vec<View> =
            cameras.flat_map(|camera| (0..world_count).map(move |world| View { camera, world })).collect();
        views.sort_by_cached_key(|_| rng.next().to_bits());
        views
    }
}

/// A camera with a square picture and a field of view of 60 degrees, 2 units above the ground at its eye's x and z.
pub fn camera(eye: [f32; 3], target: [f32; 3], aspect: f64) -> ViewCamera {
    let to_f64 = |point: [f32; 3]| Point3::from(point).cast::<f64>();
    let camera_from_world = Matrix4::look_at_rh(&to_f64(eye), &to_f64(target), &Vector3::y());
    let focal_length = 1.0 / 30.0_f64.to_radians().tan();
    let mut clip_from_camera = Matrix4::zeros();
    clip_from_camera[(0, 0)] = focal_length / aspect;
    clip_from_camera[(1, 1)] = focal_length;
    clip_from_camera[(2, 3)] = 1e-3;
    clip_from_camera[(3, 2)] = -1.0;
    let clip_from_world = clip_from_camera * camera_from_world;
    let rotation = camera_from_world.fixed_view::<3, 3>(0, 0).transpose();
    let camera_from_ndc = Matrix3::from_diagonal(&Vector3::new(aspect / focal_length, 1.0 / focal_length, -1.0));
    let world_from_ndc = rotation * camera_from_ndc;
    ViewCamera {
        clip_from_world: std::array::from_fn(|entry| clip_from_world[(entry / 4, entry % 4)] as f32),
        world_from_ndc: std::array::from_fn(|entry| world_from_ndc[(entry / 3, entry % 3)] as f32),
        eye,
        ground_center: [eye[0], eye[1] - 2.0, eye[2]],
        ground_half_side: 60.0,
        ground_fade: 10.0,
        sees_ground: 1,
    }
}

/// Light of a studio from +y.
pub fn light() -> ViewLight {
    ViewLight {
        to_sun: [0.0, 1.0, 0.0],
        sunlight: [0.8, 0.7, 0.6],
        ambient_cube: [0.1, 0.15, 0.2, 0.05, 0.3, 0.25].map(|gray| [gray, gray, 0.9 * gray]),
        fill: [0.1; 3],
        zenith: [0.1, 0.2, 0.6],
        horizon: [0.4, 0.5, 0.8],
        up: [0.0, 1.0, 0.0],
        ground: [0.4, 0.4, 0.3],
        exposure: 1.0,
        tone: 0,
        dithers: 0,
    }
}

/// A matte material without images.
pub const MATTE: ViewMaterial = ViewMaterial {
    ambient: [0.8, 0.5, 0.2],
    diffuse: [0.8, 0.5, 0.2],
    specular: [0.0; 3],
    exponent: 1.0,
    color_image: None,
    normal_image: None,
};

fn random_scene(has_images: bool, rng: &mut TestRng) -> ViewScene {
    let count = DOMAIN_TRIANGLES as u32;
    let corners: Vec<[u32; 3]> = (0..3 * count).map(|triangle| [0, 1, 2].map(|corner| 3 * triangle + corner)).collect();
    let shiny = ViewMaterial { specular: [0.4; 3], exponent: 12.0, ..MATTE };
    let textured = ViewMaterial { color_image: Some(0), normal_image: Some(1), ..shiny };
    let uvs: Vec<[f32; 2]> = corners.iter().flatten().map(|_| [0; 2].map(|_| rng.next())).collect();
    let cut_outs = CutOuts {
        first: 2 * count,
        uvs: corners[2 * DOMAIN_TRIANGLES..]
            .iter()
            .map(|triangle| triangle.map(|corner| uvs[corner as usize]))
            .collect(),
        material_indices: vec![0; DOMAIN_TRIANGLES],
        materials: vec![AlphaMaterial { alpha: 1.0, cutoff: 0.5, image: Some(0) }],
        images: vec![alpha_image()],
        anisotropy: 1.0,
    };
    let group = |first_triangle, cull_mode| DrawRange { first_triangle, triangle_count: count, cull_mode };
    ViewScene {
        vertices: 9 * DOMAIN_TRIANGLES,
        corners: 9 * DOMAIN_TRIANGLES,
        domains: 3,
        triangle_vertices: corners.clone(),
        triangle_corners: corners,
        triangle_materials: (0..3 * count).map(|triangle| triangle / count).collect(),
        triangle_domains: (0..3 * count).map(|triangle| triangle / count).collect(),
        groups: vec![group(0, CullMode::Back), group(count, CullMode::None), group(2 * count, CullMode::None)],
        materials: vec![MATTE, shiny, if has_images { textured } else { shiny }],
        images: if has_images { vec![color_image(true), color_image(false)] } else { Vec::new() },
        uvs,
        cut_outs: has_images.then_some(cut_outs),
        anisotropy: 1.0,
        light: light(),
    }
}

/// Smooth colors of 4 x 4 texels.
fn color_image(is_srgb: bool) -> ViewImage {
    let level = |side: u8| {
        let texel = move |index: u8| [100 + 30 * (index % side), 128, 250 - 20 * (index / side), 255];
        (0..side * side).flat_map(texel).collect()
    };
    ViewImage { width: 4, height: 4, is_srgb, levels: [4, 2, 1].map(level).to_vec() }
}

/// A hole in the middle of 4 x 4 texels.
fn alpha_image() -> AlphaImage {
    let mut texels = vec![255; 16];
    [5, 6, 9, 10].into_iter().for_each(|texel| texels[texel] = 0);
    AlphaImage { width: 4, height: 4, levels: vec![texels, vec![191; 4], vec![191]] }
}
