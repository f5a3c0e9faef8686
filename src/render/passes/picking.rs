//! Picking: finds the triangles and surface points of the deformed surface that are visible in a small rectangle of
//! pixels. Only the rectangle is rendered, with one sample at the center of each pixel. The visible triangles are read
//! back, and the host computes the intersections in f64.
//!
//! Beginning and finishing a pick are separate calls, so that the device can do other work in between. Fragments below
//! the cutoff of a cut-out material are not hit. Blended triangles and the ground are ignored.

use std::rc::Rc;
use std::sync::Arc;
use std::time::Duration;

use nalgebra::{Matrix3, Matrix4, Vector3};

use super::draw::TriangleSet;
use super::readback::{IdTarget, WordPass};
use super::recorder::PassRecorder;
use super::uniforms::upload_frame;
use super::visibility::{IdDraw, draw_ids};
use crate::device::gl::{self, Buffer, ClearOp, Fence, Gl};
use crate::layout::pack_size;
use crate::pass::Pass;
use crate::pieces::PieceRange;
use crate::region::{Band, Region};
use crate::resources::programs::ProgramCache;
use crate::resources::scene_buffers::SceneBuffers;
use crate::resources::target_desc::TargetDesc;
use crate::scene_data::geometry::{TriangleSpan, locate_triangle};
use crate::shaders;
use crate::types::{FrameParams, FrameStats, VisibilityId};
use crate::uniforms::frame::FrameUniforms;
use modalcast_model::error::Result;
use modalcast_model::scene::{Camera, PixelRect, Scene};

/// 32-bit words per pixel that `shaders/pick.comp` writes: the id (1 word), three corners (3), their positions (9) and
/// their normals (9).
const WORDS_PER_PIXEL: usize = 22;
/// First word of the positions of the three corners, three words each.
const POSITIONS_WORD: usize = 4;
/// First word of the normals of the three corners, three words each.
const NORMALS_WORD: usize = 13;
/// Maximum width and height of the rectangle, in pixels.
const MAX_SIDE: u32 = PixelRect::MAX_SIDE;
/// Bytes of the words of the largest rectangle.
const MAX_BYTES: u64 = 4 * WORDS_PER_PIXEL as u64 * MAX_SIDE as u64 * MAX_SIDE as u64;

/// The surface point at the center of a pixel.
#[derive(Debug, Clone, PartialEq)]
pub struct PickHit {
    /// Column and row in the full frame; (0, 0) is the top left.
    pub pixel: [u32; 2],
    pub domain: usize,
    /// Index of the triangle in the domain's mesh.
    pub triangle: usize,
    /// Vertices of the triangle in the domain's mesh. Vertex i has the rows 3 i to 3 i + 2 of U.
    pub vertices: [u32; 3],
    /// Barycentric coordinates of the point, in the order of `vertices`: 0 to 1, with sum 1.
    pub barycentrics: [f64; 3],
    /// The point, in scene units from the scene's origin.
    pub position: [f64; 3],
    /// Interpolated unit normal on the visible side; zero if the interpolated normal is zero.
    pub normal: [f64; 3],
    /// Distance along the view axis, in scene units.
    pub depth: f64,
}

/// Begins and finishes picks. The first pick creates the render target.
#[derive(Debug)]
pub(crate) struct Picker {
    gl: Rc<Gl>,
    target: Option<IdTarget>,
    /// Staging buffers of finished picks, for reuse.
    free_staging: Vec<Buffer>,
}

/// A pick in flight.
#[derive(Debug)]
pub struct PendingPick {
    staging: Buffer,
    fence: Fence,
    scene: Arc<Scene>,
    spans: Rc<[TriangleSpan]>,
    rectangle: PixelRect,
    /// Camera whose image is the rectangle, relative to `origin`.
    camera: Camera,
    /// Origin of the drawn positions, in scene units from the scene's origin.
    origin: [f64; 3],
}

impl Picker {
    pub(crate) fn new(gl: &Rc<Gl>) -> Self {
        Self { gl: Rc::clone(gl), target: None, free_staging: Vec::new() }
    }

    /// Begins a pick in a rectangle of the frame that `params` describes, without waiting for the device.
    ///
    /// # Errors
    /// `Invalid` for a camera whose matrices overflow, `Fault` when OpenGL reports an error.
    pub(crate) fn begin(
        &mut self,
        programs: &mut ProgramCache,
        buffers: &SceneBuffers,
        params: &FrameParams,
        rectangle: PixelRect,
    ) -> Result<PendingPick> {
        let size @ [width, height] = rectangle.size();
        let camera = params.camera.cropped_to([params.width, params.height], rectangle);
        let params = FrameParams { camera, width, height, ..*params };
        let uniforms = FrameUniforms::new(&buffers.scene, &buffers.look, &params, buffers.origin)?;
        let mask = buffers.mask_program(1, &mut |source| programs.program(source))?;
        let program = programs.program(shaders::readback::pick())?;
        let target = match self.target.take() {
            Some(target) => target,
            None => {
                let desc = TargetDesc { width: MAX_SIDE, height: MAX_SIDE, samples: 1, ..TargetDesc::EMPTY };
                IdTarget::new(&self.gl, desc, MAX_BYTES)?
            }
        };
        let target = self.target.insert(target);
        let staging = match self.free_staging.pop() {
            Some(staging) => staging,
            None => self.gl.buffer(MAX_BYTES, gl::STREAM_READ, None)?,
        };
        let mut recorder = PassRecorder { gl: &self.gl, stats: &mut FrameStats::default() };
        upload_frame(buffers, &uniforms);
        let ids = IdDraw {
            framebuffer: &target.framebuffer,
            clear: ClearOp::DepthAndIds(None),
            region: Region::whole(size),
            band: Band::whole(height),
            triangles: TriangleSet::All,
            range: PieceRange::ALL,
            mask: mask.as_deref(),
            opaque_parts: None,
        };
        recorder.begin(Pass::Pick);
        draw_ids(&mut recorder, buffers, &ids)?;
        let word_pass = WordPass {
            pass: Pass::Pick,
            program: &program,
            uniform: Some(pack_size(size)),
            size,
            band: None,
            staging: &staging,
            bytes: 4 * (WORDS_PER_PIXEL * width as usize * height as usize) as u64,
        };
        target.read(&recorder, &word_pass)?;
        Ok(PendingPick {
            staging,
            fence: self.gl.fence(Pass::Pick.name())?,
            scene: Arc::clone(&buffers.scene),
            spans: Rc::clone(&buffers.spans),
            rectangle,
            camera: camera.relative_to(buffers.origin),
            origin: buffers.origin,
        })
    }

    /// Waits for a pick, at most `timeout`, and returns its hits row by row. Pixels without a triangle have no entry.
    ///
    /// # Errors
    /// `Fault` when the device does not finish in time.
    pub(crate) fn finish(&mut self, pick: PendingPick, timeout: Duration) -> Result<Vec<PickHit>> {
        pick.fence.wait(Pass::Pick.name(), timeout)?;
        let [width, height] = pick.rectangle.size();
        let word_count = WORDS_PER_PIXEL * width as usize * height as usize;
        let words: Vec<u32> = bytemuck::pod_collect_to_vec(&pick.staging.read(4 * word_count)?);
        let rays = PixelRays::new(&pick);
        let pixels = words.chunks_exact(WORDS_PER_PIXEL).zip(0..);
        let hits =
            pixels.filter_map(|(words, index)| find_hit(&pick, &rays, words, [index % width, index / width])).collect();
        self.free_staging.push(pick.staging);
        self.gl.check(Pass::Pick.name()).map(|()| hits)
    }
}

impl PendingPick {
    /// Whether [`crate::Renderer::finish_pick`] would return without waiting.
    pub fn is_ready(&self) -> bool {
        self.fence.is_done()
    }
}

/// View rays through the pixels of the rectangle.
struct PixelRays {
    camera_from_world: Matrix4<f64>,
    /// fx, fy, cx and cy in pixels.
    intrinsics: [f64; 4],
}

impl PixelRays {
    fn new(pick: &PendingPick) -> Self {
        let intrinsics = pick.camera.intrinsics(pick.rectangle.size());
        Self { camera_from_world: pick.camera.camera_from_world(), intrinsics }
    }

    /// Ray from the eye through the center of a pixel of the rectangle, in camera space. Its length along the view axis
    /// is 1.
    fn through_pixel(&self, [x, y]: [u32; 2]) -> Vector3<f64> {
        let [fx, fy, cx, cy] = self.intrinsics;
        Vector3::new((f64::from(x) + 0.5 - cx) / fx, (cy - f64::from(y) - 0.5) / fy, -1.0)
    }
}

/// Finds the hit of a pixel of the rectangle, from the words that `shaders/pick.comp` wrote.
fn find_hit(pick: &PendingPick, rays: &PixelRays, words: &[u32], pixel: [u32; 2]) -> Option<PickHit> {
    let VisibilityId::Triangle(triangle_index) = VisibilityId::from_id(words[0]) else { return None };
    let (domain, triangle) = locate_triangle(&pick.spans, triangle_index)?;
    let mesh = &pick.scene.shapes[pick.scene.domains[domain].shape].mesh;
    let corners = *mesh.triangles().get(triangle)?;
    let first_corner = pick.scene.layout.domains[domain].first_corner as u32;
    // The renderer reverses the winding of some triangles, but the result has the corner order of the mesh.
    // `drawn_order` gives the position of each corner of the mesh's triangle among the drawn corners.
    let drawn_corners: [u32; 3] = [words[1], words[2], words[3]];
    let drawn_order = corners.map(|corner| {
        drawn_corners.iter().position(|drawn_corner| *drawn_corner == corner + first_corner).unwrap_or(0)
    });
    let corner_vector = |first_word: usize, index: usize| {
        Vector3::from_fn(|axis, _| f64::from(f32::from_bits(words[first_word + 3 * index + axis])))
    };
    let ray = rays.through_pixel(pixel);
    let camera_positions = [0, 1, 2]
        .map(|index| rays.camera_from_world.transform_point(&corner_vector(POSITIONS_WORD, index).into()).coords);
    let (barycentrics, is_front_facing) = intersect_triangle(&camera_positions, &ray);
    let barycentrics = Vector3::from(barycentrics);
    let interpolate = |first_word: usize| {
        Matrix3::from_columns(&[0, 1, 2].map(|index| corner_vector(first_word, index))) * barycentrics
    };
    // Shorter normals count as zero: their direction is lost in rounding.
    let min_length = 1e-30;
    let normal = interpolate(NORMALS_WORD)
        .try_normalize(min_length)
        .filter(|normal| normal.iter().all(|number| number.is_finite()));
    let normal = normal.unwrap_or_default();
    Some(PickHit {
        pixel: [pick.rectangle.x() + pixel[0], pick.rectangle.y() + pixel[1]],
        domain,
        triangle,
        vertices: corners.map(|corner| mesh.corners().vertices[corner as usize]),
        barycentrics: drawn_order.map(|index| barycentrics[index]),
        position: (interpolate(POSITIONS_WORD) + Vector3::from(pick.origin)).into(),
        normal: if is_front_facing { normal } else { -normal }.into(),
        depth: -(Matrix3::from_columns(&camera_positions) * barycentrics).z,
    })
}

/// Barycentric coordinates of the intersection of a ray d from the origin with a triangle, and whether the front side
/// of the triangle is visible. The coordinate of corner i is proportional to d . (v_j x v_k), where j and k are the
/// next corners in cyclic order. The ray may miss the triangle by the rounding of the rasterizer (1/256 pixel);
/// negative coordinates are then clamped to 0. A triangle without screen area has three equal coordinates.
fn intersect_triangle([a, b, c]: &[Vector3<f64>; 3], ray: &Vector3<f64>) -> ([f64; 3], bool) {
    let volumes = [b.cross(c), c.cross(a), a.cross(b)].map(|normal| ray.dot(&normal));
    let sum: f64 = volumes.iter().sum();
    let clamped = volumes.map(|volume| (volume / sum).max(0.0));
    let clamped_sum: f64 = clamped.iter().sum();
    // The coordinates have the sum 1, and clamping only increases it. The sum is 0 if they are NaN, which `max`
    // replaces by 0.
    let barycentrics = if clamped_sum > 0.5 && clamped_sum.is_finite() {
        clamped.map(|volume| volume / clamped_sum)
    } else {
        [1.0 / 3.0; 3]
    };
    // Rays point away from the eye, so the front side is visible when the sum is negative.
    (barycentrics, sum < 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ray_hits_triangle_at_the_expected_coordinates() {
        let corners = [Vector3::new(-1.0, -1.0, -4.0), Vector3::new(3.0, -1.0, -9.0), Vector3::new(0.5, 2.0, -2.0)];
        let expected = [0.2, 0.5, 0.3];
        let point: Vector3<f64> = corners.iter().zip(expected).map(|(corner, weight)| corner * weight).sum();
        let (barycentrics, is_front_facing) = intersect_triangle(&corners, &(point / -point.z));
        assert!(
            barycentrics.iter().zip(expected).all(|(got, expected)| (got - expected).abs() < 1e-14),
            "{barycentrics:?}"
        );
        assert!(is_front_facing, "expected the front side of a counterclockwise triangle");
        let reversed = [corners[0], corners[2], corners[1]];
        assert!(!intersect_triangle(&reversed, &(point / -point.z)).1);
    }

    #[test]
    fn degenerate_triangle_gives_finite_coordinates() {
        let corner = Vector3::new(-1.0, -1.0, -4.0);
        for degenerate in [[corner; 3], [Vector3::zeros(); 3], [corner * f64::NAN; 3]] {
            let (barycentrics, _) = intersect_triangle(&degenerate, &Vector3::new(0.1, 0.2, -1.0));
            assert!((barycentrics.iter().sum::<f64>() - 1.0).abs() < 1e-12, "{barycentrics:?}");
        }
    }

    #[test]
    fn ray_beside_the_triangle_is_clamped_to_its_edge() {
        let corners = [Vector3::new(0.0, 0.0, -1.0), Vector3::new(1.0, 0.0, -1.0), Vector3::new(0.0, 1.0, -1.0)];
        let (barycentrics, _) = intersect_triangle(&corners, &Vector3::new(0.5, -0.01, -1.0));
        assert!(barycentrics[2] == 0.0 && (barycentrics[0] + barycentrics[1] - 1.0).abs() < 1e-15, "{barycentrics:?}");
    }
}
