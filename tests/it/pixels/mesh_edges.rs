//! Lines along the edges of faces: width, visibility, and frames without them.

use std::sync::Arc;

use modalcast_model::domain::{Material, Mesh};
use modalcast_model::scene::{Antialiasing, Camera, Lens, MeshEdges, Scene};
use modalcast_render::{FrameImage, FrameParams, Renderer, SceneBuffers};

use super::harness::{SceneBuilder, colored_material, decode_srgb, facing_rectangle, front_camera, open_renderer};

const SIZE: u32 = 96;

/// Red lines. The surfaces of these tests are green, so the red channel is the coverage by lines.
fn red_edges(width: f32) -> Option<MeshEdges> {
    Some(MeshEdges { width, color: [1.0, 0.0, 0.0] })
}

/// A scene on the device.
struct Harness {
    scene: Arc<Scene>,
    renderer: Renderer,
    buffers: SceneBuffers,
}

impl Harness {
    fn new(builder: SceneBuilder) -> Self {
        let scene = builder.build();
        let mut renderer = open_renderer();
        let buffers = renderer.load(&scene).expect("expected the scene to load");
        let mut surface = modalcast_model::deform::DeformedSurface::default();
        for domain in &scene.domains {
            let mesh = &scene.shapes[domain.shape].mesh;
            surface.positions.extend(mesh.rest_positions().as_flattened());
            surface.normals.extend(mesh.corners().normals.as_flattened());
        }
        renderer.upload(&buffers, &surface).expect("expected the upload to succeed");
        Self { scene, renderer, buffers }
    }

    /// A frame with a focal length of `focal_length` pixels. [`front_camera`] has 100 pixels.
    fn frame(&mut self, focal_length: f64, edges: Option<MeshEdges>) -> FrameImage {
        let center = f64::from(SIZE) / 2.0;
        let lens = Lens::Intrinsics { fx: focal_length, fy: focal_length, cx: center, cy: center };
        let camera = Camera { lens, ..front_camera(SIZE) };
        let bounds = self.scene.rest_bounds;
        let params =
            FrameParams { camera, width: SIZE, height: SIZE, bounds, light_bounds: None, edges, samples: None };
        self.renderer.draw(&self.buffers, &params).expect("expected a frame")
    }
}

/// Coverage of a pixel by red lines, 0 to 1.
fn coverage(image: &FrameImage, x: u32, y: u32) -> f64 {
    decode_srgb(image.rgba[4 * (y * image.width + x) as usize])
}

/// Sum of the coverage over a row, in pixels.
fn row_coverage(image: &FrameImage, row: u32, columns: std::ops::Range<u32>) -> f64 {
    columns.map(|column| coverage(image, column, row)).sum()
}

/// A material without red light.
fn green_material() -> Material {
    Material { ambient: [0.0, 0.5, 0.0], ..colored_material([0.0, 0.5, 0.0]) }
}

fn green_rectangle(mesh: Mesh) -> SceneBuilder {
    SceneBuilder::new().add_domain(mesh, green_material())
}

/// A square of 60 x 60 pixels at the center of the image, whose diagonal goes from the lower left to the upper right.
fn square() -> Mesh {
    facing_rectangle(-3.0, -3.0, 3.0, 3.0, 0.0)
}

/// The diagonal of the square is crossed by a row at 45 degrees, so its coverage of the row is its width times the root
/// of 2. Each border has the half of a line that is inside of the square.
#[test]
fn lines_have_a_constant_width_in_pixels() {
    for (samples, antialias) in [(4, Antialiasing::Msaa), (1, Antialiasing::None)] {
        let mut builder = green_rectangle(square());
        (builder.parts.look.samples, builder.parts.look.antialias) = (samples, antialias);
        let mut harness = Harness::new(builder);
        for (width, focal_length) in [(1.0, 100.0), (1.25, 100.0), (3.0, 100.0), (3.0, 70.0), (1.25, 130.0)] {
            let image = harness.frame(focal_length, red_edges(width));
            // Row 38 crosses the diagonal 9 pixels to the right of the center.
            let half_side = (3.0 * focal_length / 10.0) as u32;
            let expected = f64::from(width) * std::f64::consts::SQRT_2;
            let diagonal = row_coverage(&image, 38, 48..48 + half_side - 8);
            let name = format!("{samples} samples, width {width}, focal length {focal_length}");
            assert!((diagonal - expected).abs() < 0.12 * expected, "{name}: expected {expected}, got {diagonal}");
            let border = row_coverage(&image, 38, 48 - half_side - 4..48 - half_side + 8);
            let expected = 0.5 * f64::from(width);
            assert!((border - expected).abs() < 0.2, "{name}: expected {expected} at the border, got {border}");
            assert_eq!(coverage(&image, 30, 38), 0.0, "{name}: expected no line inside of a triangle");
        }
    }
}

#[test]
fn edges_inside_of_polygons_have_no_line() {
    let quadrilateral = square().with_inner_edges(vec![2, 4]).expect("expected one entry per triangle");
    let mut harness = Harness::new(green_rectangle(quadrilateral));
    let image = harness.frame(100.0, red_edges(2.0));
    assert_eq!(row_coverage(&image, 38, 26..70), 0.0, "expected no diagonal");
    assert!(row_coverage(&image, 38, 10..26) > 0.7, "expected the left border");
    let mut harness = Harness::new(green_rectangle(square()));
    assert!(row_coverage(&harness.frame(100.0, red_edges(2.0)), 38, 26..70) > 2.0, "negative control: expected a line");
}

/// The diagonal of the rear square is behind the front square, whose own diagonal is an inner edge.
#[test]
fn hidden_edges_have_no_line() {
    let front = facing_rectangle(-1.0, -1.0, 1.0, 1.0, 1.0).with_inner_edges(vec![2, 4]).expect("one per triangle");
    let mut harness = Harness::new(green_rectangle(square()).add_domain(front, green_material()));
    let image = harness.frame(100.0, red_edges(1.0));
    // The front square covers the columns and rows 37 to 58.
    assert_eq!((42..54).map(|row| row_coverage(&image, row, 42..54)).sum::<f64>(), 0.0);
    assert!(row_coverage(&image, 28, 62..74) > 1.0, "negative control: expected a line beside it");
}

/// Compares a grid with cells of 10 pixels and a grid with cells of a quarter pixel.
#[test]
fn lines_of_tiny_triangles_fade_out() {
    let grid = |cells: u32| {
        let positions: Vec<[f32; 3]> = (0..(cells + 1) * (cells + 1))
            .map(|index| [index % (cells + 1), index / (cells + 1)].map(|step| 6.0 * step as f32 / cells as f32 - 3.0))
            .map(|[x, y]| [x, y, 0.0])
            .collect();
        let cell = |cell: u32| {
            let corner = cell / cells * (cells + 1) + cell % cells;
            [[corner, corner + 1, corner + cells + 2], [corner, corner + cells + 2, corner + cells + 1]]
        };
        let triangles = (0..cells * cells).flat_map(cell).collect();
        let normals = vec![[0.0, 0.0, 1.0]; positions.len()];
        Mesh::from_indexed(positions, normals, vec![], triangles).expect("expected a valid mesh")
    };
    let mean_coverage = |cells: u32| {
        let image = Harness::new(green_rectangle(grid(cells))).frame(100.0, red_edges(1.25));
        (30..66).map(|row| row_coverage(&image, row, 30..66)).sum::<f64>() / (36.0 * 36.0)
    };
    let (coarse, fine) = (mean_coverage(6), mean_coverage(240));
    assert!(coarse > 0.2, "expected lines of triangles of 10 pixels, got {coarse}");
    assert!(fine < 0.1, "expected almost no lines of triangles of a quarter pixel, got {fine}");
}

#[test]
fn frames_without_edges_are_unchanged_by_frames_with_edges() {
    let quadrilateral = square().with_inner_edges(vec![2, 4]).expect("expected one entry per triangle");
    let mut harness = Harness::new(green_rectangle(quadrilateral));
    let plain = harness.frame(100.0, None);
    let allocations = harness.buffers.allocations();
    assert!(!allocations.iter().any(|allocation| allocation.name == "inner edges"));
    let with_edges = harness.frame(100.0, red_edges(1.25));
    assert!(with_edges.rgba != plain.rgba, "negative control: expected lines");
    assert!(harness.buffers.allocations().iter().any(|allocation| allocation.name == "inner edges"));
    assert!(harness.frame(100.0, None).rgba == plain.rgba);
    assert!(harness.frame(100.0, red_edges(1.25)).rgba == with_edges.rgba);
    // A frame in bands.
    harness.renderer.set_max_band_samples(4 * 8 * u64::from(SIZE));
    assert!(harness.frame(100.0, red_edges(1.25)).rgba == with_edges.rgba, "expected the same pixels in bands");
}

/// Triangles behind the camera, without area, or of extreme size.
#[test]
fn extreme_triangles_have_finite_lines() {
    for scale in [1e-20_f32, 1e-6, 1e6, 1e15] {
        let positions = vec![
            [-scale, -scale, -scale],
            [scale, -scale, 20.0],
            [scale, scale, scale],
            [0.0, 0.0, 0.0],
            [0.1, 0.2, 0.0],
        ];
        let triangles = vec![[0, 1, 2], [3, 4, 3], [0, 1, 4], [2, 1, 3]];
        let mesh = Mesh::from_indexed(positions, vec![[0.0, 0.0, 1.0]; 5], vec![], triangles);
        let mut harness = Harness::new(green_rectangle(mesh.expect("expected a valid mesh")));
        let image = harness.frame(100.0, red_edges(32.0));
        assert!(image.rgba.chunks_exact(4).all(|pixel| pixel[3] == 255), "scale {scale}");
    }
}
