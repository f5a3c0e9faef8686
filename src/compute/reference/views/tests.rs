use modalcast_model::scene::{CullMode, DrawRange};
use modalcast_model::views::{View, ViewBatch, ViewFormat, ViewOutputs, ViewScene, ViewVertices};

use super::ReferenceViewRenderer;
use crate::testing::TestRng;
use crate::testing::views::{MATTE, ViewFixture, camera, light};

const ALL_OUTPUTS: ViewOutputs = ViewOutputs { color: true, depth: true, domains: true, normals: true };

fn format(width: u32, height: u32) -> ViewFormat {
    ViewFormat { width, height, outputs: ALL_OUTPUTS, depth_scale: 1.0, depth_includes_ground: false }
}

/// A square of side 2 in the plane z = 0, which faces +z.
fn square() -> (ViewScene, Vec<f32>, Vec<f32>) {
    let scene = ViewScene {
        vertices: 4,
        corners: 4,
        domains: 1,
        triangle_vertices: vec![[0, 1, 2], [0, 2, 3]],
        triangle_corners: vec![[0, 1, 2], [0, 2, 3]],
        triangle_materials: vec![0; 2],
        triangle_domains: vec![0; 2],
        groups: vec![DrawRange { first_triangle: 0, triangle_count: 2, cull_mode: CullMode::Back }],
        materials: vec![MATTE],
        images: Vec::new(),
        uvs: Vec::new(),
        cut_outs: None,
        anisotropy: 1.0,
        light: light(),
    };
    let positions = [[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]];
    (scene, positions.concat(), [[0.0, 0.0, 1.0]; 4].concat())
}

fn srgb(linear: f32) -> u8 {
    (255.0 * (1.055 * linear.powf(1.0 / 2.4) - 0.055)).round() as u8
}

#[test]
fn square_has_its_pixels_depth_normal_and_light() {
    let (scene, positions, normals) = square();
    let renderer = ReferenceViewRenderer::new(scene).expect("a valid scene");
    let vertices = ViewVertices { positions: &positions, normals: &normals, tangents: &[] };
    // At distance 2 sqrt(3) and a field of view of 60 degrees, the picture shows 4 x 4 units.
    let distance = 2.0 * 3.0_f32.sqrt();
    let cameras = [camera([0.0, 0.0, distance], [0.0; 3], 1.0), camera([0.0, 0.0, -distance], [0.0; 3], 1.0)];
    let views = [View { camera: 0, world: 0 }, View { camera: 1, world: 0 }];
    let batch = ViewBatch { cameras: &cameras, views: &views, format: format(16, 16) };
    let pictures = renderer.draw(&vertices, &batch).expect("pictures");
    for pixel in 0..256 {
        let is_covered = [pixel % 16, pixel / 16].into_iter().all(|side| (4..12).contains(&side));
        assert_eq!(pictures.domains[pixel], if is_covered { 0 } else { -1 }, "pixel {pixel}");
        let depth = pictures.depth[pixel];
        assert!(if is_covered { (depth - distance).abs() < 1e-5 } else { depth.is_infinite() }, "{depth}");
        let normal = if is_covered { [0.0, 0.0, 1.0] } else { [0.0; 3] };
        assert_eq!(&pictures.normals[3 * pixel..][..3], &normal);
    }
    // Ambient light from +z and the fill light; the sun is in the plane of the square. The cosine to the eye is 1 in
    // the center up to the offset of half a pixel.
    let channel = |channel: usize| MATTE.ambient[channel] * (light().ambient_cube[4][channel] + light().fill[channel]);
    let center = 3 * (8 * 16 + 8);
    assert_eq!(&pictures.color[center..][..3], &[0, 1, 2].map(|index| srgb(channel(index))));
    assert!(pictures.domains[256..].iter().all(|domain| *domain == -1), "expected no back face");
}

#[test]
fn background_has_ground_below_the_horizon_and_sky_above() {
    let (mut scene, positions, normals) = square();
    scene.groups[0].cull_mode = CullMode::Back;
    let renderer = ReferenceViewRenderer::new(scene).expect("a valid scene");
    let vertices = ViewVertices { positions: &positions, normals: &normals, tangents: &[] };
    // Looks along -z away from the square, 2 units above the ground.
    let cameras = [camera([0.0, 0.0, -1.0], [0.0, 0.0, -2.0], 1.0)];
    let views = [View { camera: 0, world: 0 }];
    let format = ViewFormat { depth_includes_ground: true, depth_scale: 0.5, ..format(16, 16) };
    let pictures =
        renderer.draw(&vertices, &ViewBatch { cameras: &cameras, views: &views, format }).expect("a picture");
    for pixel in 0..256 {
        // Slope of the view ray: tan(30 degrees) at the edge of the picture.
        let slope = (pixel / 16) as f32 + 0.5 - 8.0;
        let slope = slope / 8.0 * 30.0_f32.to_radians().tan();
        let depth = pictures.depth[pixel];
        if slope < 0.0 {
            assert!(depth.is_infinite(), "expected the sky, got {depth}");
        } else {
            assert!((depth - 0.5 * 2.0 / slope).abs() < 1e-3 * depth, "expected {}, got {depth}", 1.0 / slope);
        }
    }
    let [top, bottom] = [0, 255].map(|pixel| &pictures.color[3 * pixel..][..3]);
    assert!(top[2] > top[0] && bottom[0] > bottom[2], "expected sky {top:?} and ground {bottom:?}");
}

/// Every view equals the picture of its world alone, whatever else is in the batch. A batch that shows another world,
/// or the vertices of another step, is detected.
#[test]
fn views_of_a_batch_equal_single_pictures_of_their_worlds() {
    let mut rng = TestRng(3);
    let fixture = ViewFixture::new(3, true, &mut rng);
    let renderer = ReferenceViewRenderer::new(fixture.scene.clone()).expect("a valid scene");
    let views = fixture.views(&mut rng);
    let batch = ViewBatch { cameras: &fixture.cameras, views: &views, format: format(24, 16) };
    let pictures = renderer.draw(&fixture.vertices(), &batch).expect("pictures");
    let differing_views = |views: &[View], vertices: &ViewVertices<'_>| {
        let single = |view: &View| {
            let (vertices_per_world, corners) = (3 * fixture.scene.vertices, 3 * fixture.scene.corners);
            let world = view.world as usize;
            let vertices = ViewVertices {
                positions: &vertices.positions[world * vertices_per_world..][..vertices_per_world],
                normals: &vertices.normals[world * corners..][..corners],
                tangents: &vertices.tangents[world * corners / 3 * 4..][..corners / 3 * 4],
            };
            let view = [View { camera: view.camera, world: 0 }];
            renderer.draw(&vertices, &ViewBatch { views: &view, ..batch }).expect("a picture")
        };
        let pixels = batch.format.pixel_count();
        let differs = |(index, view): (usize, &View)| {
            let single = single(view);
            single.color != pictures.color[3 * pixels * index..][..3 * pixels]
                || single.depth != pictures.depth[pixels * index..][..pixels]
                || single.domains != pictures.domains[pixels * index..][..pixels]
                || single.normals != pictures.normals[3 * pixels * index..][..3 * pixels]
        };
        views.iter().enumerate().filter(|view| differs(*view)).count()
    };
    assert_eq!(differing_views(&views, &fixture.vertices()), 0);
    let other_worlds: Vec<View> = views.iter().map(|view| View { world: (view.world + 1) % 3, ..*view }).collect();
    assert_eq!(differing_views(&other_worlds, &fixture.vertices()), views.len(), "expected other worlds to differ");
    let other_step = ViewFixture::new(3, true, &mut rng);
    assert_eq!(differing_views(&views, &other_step.vertices()), views.len(), "expected another step to differ");
}

#[test]
fn too_few_vertices_are_rejected() {
    let (scene, positions, normals) = square();
    let renderer = ReferenceViewRenderer::new(scene).expect("a valid scene");
    let vertices = ViewVertices { positions: &positions, normals: &normals, tangents: &[] };
    let cameras = [camera([0.0, 0.0, 3.0], [0.0; 3], 1.0)];
    let draw = |world| {
        let views = [View { camera: 0, world }];
        renderer.draw(&vertices, &ViewBatch { cameras: &cameras, views: &views, format: format(8, 8) }).map(|_| ())
    };
    assert_eq!(draw(0), Ok(()));
    let error = draw(1).expect_err("a world without vertices").to_string();
    assert!(error.starts_with("views.positions: expected 24 numbers for 2 worlds, got 12"), "{error}");
}
