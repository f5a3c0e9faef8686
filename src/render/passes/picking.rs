//! Picking: finds the triangles and surface points that the pixels of a small rectangle see on the deformed surface.
//! Only the rectangle is rendered, as an image of its own with one sample at the center of each pixel, and only the
//! visible triangles are read back. The host computes the intersections in f64.
//!
//! Beginning and finishing a pick are separate calls, so that the device gets other work in between. Holes of cut-out
//! materials are holes. Blended triangles cannot be picked; the surface behind them is. The ground is not drawn: it is
//! never hit and hides nothing.

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
use crate::region::Region;
use crate::resources::programs::ProgramCache;
use crate::resources::scene_buffers::SceneBuffers;
use crate::resources::target_desc::TargetDesc;
use crate::scene_data::geometry::{TriangleSpan, locate_triangle};
use crate::shaders;
use crate::types::{FrameParams, FrameStats, VisibilityId};
use crate::uniforms::frame::FrameUniforms;
use modalcast_model::error::Result;
use modalcast_model::scene::{Camera, PixelRect, Scene};

/// 32-bit words per pixel that `shaders/pick.comp` writes.
const WORDS_PER_PIXEL: usize = 22;
const MAX_SIDE: u32 = PixelRect::MAX_SIDE;
const MAX_BYTES: u64 = 4 * WORDS_PER_PIXEL as u64 * MAX_SIDE as u64 * MAX_SIDE as u64;

/// The surface point at the center of a pixel.
#[derive(Debug, Clone, PartialEq)]
pub struct PickHit {
    /// Column and row in the full picture; (0, 0) is the top left.
    pub pixel: [u32; 2],
    pub domain: usize,
    /// Index of the triangle in the domain's mesh.
    pub triangle: usize,
    /// Vertices of the triangle in the domain's mesh (row of U divided by three).
    pub vertices: [u32; 3],
    /// Barycentric coordinates of the point, in the order of `vertices`: 0 to 1, with sum 1.
    pub barycentrics: [f64; 3],
    /// The point, in scene units from the scene's origin.
    pub position: [f64; 3],
    /// Interpolated unit normal on the visible side; zero when the corner normals cancel.
    pub normal: [f64; 3],
    /// Distance along the view axis, in scene units.
    pub depth: f64,
}

/// Begins and finishes picks. The render target is created by the first pick.
#[derive(Debug)]
pub(crate) struct Picker {
    gl: Rc<Gl>,
    target: Option<IdTarget>,
    /// Staging buffers of finished picks, for reuse.
    free: Vec<Buffer>,
}

/// A pick in flight.
#[derive(Debug)]
pub struct PendingPick {
    staging: Buffer,
    fence: Fence,
    scene: Arc<Scene>,
    spans: Rc<[TriangleSpan]>,
    rectangle: PixelRect,
    /// Camera of the rectangle, relative to `origin`.
    camera: Camera,
    origin: [f64; 3],
}

impl Picker {
    pub(crate) fn new(gl: &Rc<Gl>) -> Self {
        Self { gl: Rc::clone(gl), target: None, free: Vec::new() }
    }

    /// Begins a pick in a rectangle of the picture that `shot` describes, without waiting for the device.
    ///
    /// # Errors
    /// `Invalid` for a camera whose matrices overflow, `Fault` when OpenGL reports an error.
    pub(crate) fn begin(
        &mut self,
        programs: &mut ProgramCache,
        buffers: &SceneBuffers,
        shot: &FrameParams,
        rectangle: PixelRect,
    ) -> Result<PendingPick> {
        let size @ [width, height] = rectangle.size();
        let camera = shot.camera.cropped_to([shot.width, shot.height], rectangle);
        let shot = FrameParams { camera, width, height, ..*shot };
        let uniforms = FrameUniforms::new(&buffers.scene, &shot, buffers.origin)?;
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
        let staging = match self.free.pop() {
            Some(staging) => staging,
            None => self.gl.buffer(MAX_BYTES, gl::STREAM_READ, None)?,
        };
        let mut recorder = PassRecorder { gl: &self.gl, stats: &mut FrameStats::default() };
        upload_frame(buffers, &uniforms);
        let ids = IdDraw {
            framebuffer: &target.framebuffer,
            clear: ClearOp::DepthAndIds(None),
            region: Region::whole(size),
            set: TriangleSet::All,
            mask: mask.as_deref(),
            opaque_parts: None,
        };
        recorder.begin(Pass::Pick);
        draw_ids(&mut recorder, buffers, &ids)?;
        let words = WordPass {
            pass: Pass::Pick,
            program: &program,
            number: Some(pack_size(size)),
            size,
            staging: &staging,
            bytes: 4 * (WORDS_PER_PIXEL * width as usize * height as usize) as u64,
        };
        target.read(&recorder, &words)?;
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

    /// Waits for a pick, at most `limit`, and returns its hits row by row. Pixels without a triangle have no entry.
    ///
    /// # Errors
    /// `Fault` when the device does not finish in time.
    pub(crate) fn finish(&mut self, pick: PendingPick, limit: Duration) -> Result<Vec<PickHit>> {
        pick.fence.wait(Pass::Pick.name(), limit)?;
        let [width, height] = pick.rectangle.size();
        let words = WORDS_PER_PIXEL * width as usize * height as usize;
        let words: Vec<u32> = bytemuck::pod_collect_to_vec(&pick.staging.read(4 * words)?);
        let rays = PixelRays::of(&pick);
        let pixels = words.chunks_exact(WORDS_PER_PIXEL).zip(0..);
        let hits = pixels.filter_map(|(words, at)| hit(&pick, &rays, words, [at % width, at / width])).collect();
        self.free.push(pick.staging);
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
    /// fx, fy, cx and cy.
    lens: [f64; 4],
}

impl PixelRays {
    fn of(pick: &PendingPick) -> Self {
        let lens = pick.camera.intrinsics(pick.rectangle.size());
        Self { camera_from_world: pick.camera.camera_from_world(), lens }
    }

    /// Ray from the eye through the center of a pixel, in camera space, one unit of depth long.
    fn through(&self, [x, y]: [u32; 2]) -> Vector3<f64> {
        let [fx, fy, cx, cy] = self.lens;
        Vector3::new((f64::from(x) + 0.5 - cx) / fx, (cy - f64::from(y) - 0.5) / fy, -1.0)
    }
}

/// Hit of one pixel of the rectangle, from the words that the device wrote.
fn hit(pick: &PendingPick, rays: &PixelRays, words: &[u32], at: [u32; 2]) -> Option<PickHit> {
    let VisibilityId::Triangle(place) = VisibilityId::from_id(words[0]) else { return None };
    let (domain, triangle) = locate_triangle(&pick.spans, place)?;
    let mesh = &pick.scene.shapes[pick.scene.domains[domain].shape].mesh;
    let corners = *mesh.triangles().get(triangle)?;
    let first = pick.scene.layout.domains[domain].first_corner as u32;
    // The renderer reverses the winding of some triangles; the result uses the order of the mesh.
    let drawn: [u32; 3] = [words[1], words[2], words[3]];
    let order = corners.map(|corner| drawn.iter().position(|own| *own == corner + first).unwrap_or(0));
    let point = |from: usize, index: usize| {
        Vector3::from_fn(|axis, _| f64::from(f32::from_bits(words[from + 3 * index + axis])))
    };
    let ray = rays.through(at);
    let in_camera = [0, 1, 2].map(|index| rays.camera_from_world.transform_point(&point(4, index).into()).coords);
    let (barycentrics, front) = intersect_triangle(&in_camera, &ray);
    let barycentrics = Vector3::from(barycentrics);
    let mix = |from: usize| Matrix3::from_columns(&[point(from, 0), point(from, 1), point(from, 2)]) * barycentrics;
    let normal = mix(13).try_normalize(1e-30).filter(|unit| unit.iter().all(|number| number.is_finite()));
    let normal = normal.unwrap_or_default();
    Some(PickHit {
        pixel: [pick.rectangle.x() + at[0], pick.rectangle.y() + at[1]],
        domain,
        triangle,
        vertices: corners.map(|corner| mesh.corners().vertices[corner as usize]),
        barycentrics: order.map(|index| barycentrics[index]),
        position: (mix(4) + Vector3::from(pick.origin)).into(),
        normal: if front { normal } else { -normal }.into(),
        depth: -(Matrix3::from_columns(&in_camera) * barycentrics).z,
    })
}

/// Barycentric coordinates of the intersection of a ray from the origin with a triangle, and whether its front side is
/// visible. Corner i has the share d . (v_j x v_k) of their sum. The ray may miss the triangle by the rounding of the
/// rasterizer (1/256 pixel); negative shares are then clamped to 0. A triangle without screen area gets equal shares.
fn intersect_triangle([a, b, c]: &[Vector3<f64>; 3], ray: &Vector3<f64>) -> ([f64; 3], bool) {
    let volumes = [b.cross(c), c.cross(a), a.cross(b)].map(|normal| ray.dot(&normal));
    let sum: f64 = volumes.iter().sum();
    let inside = volumes.map(|volume| (volume / sum).max(0.0));
    let whole: f64 = inside.iter().sum();
    // NaN fails the comparison.
    let barycentrics =
        if whole > 0.5 && whole.is_finite() { inside.map(|share| share / whole) } else { [1.0 / 3.0; 3] };
    // Rays point away from the eye, so the front side is visible when the sum is negative.
    (barycentrics, sum < 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ray_meets_a_triangle_where_its_point_is_and_a_degenerate_one_gives_finite_shares() {
        let corners = [Vector3::new(-1.0, -1.0, -4.0), Vector3::new(3.0, -1.0, -9.0), Vector3::new(0.5, 2.0, -2.0)];
        let want = [0.2, 0.5, 0.3];
        let point: Vector3<f64> = corners.iter().zip(want).map(|(corner, share)| corner * share).sum();
        let (barycentrics, front) = intersect_triangle(&corners, &(point / -point.z));
        assert!(barycentrics.iter().zip(want).all(|(got, want)| (got - want).abs() < 1e-14), "{barycentrics:?}");
        assert!(front, "counter-clockwise");
        let turned = [corners[0], corners[2], corners[1]];
        assert!(!intersect_triangle(&turned, &(point / -point.z)).1);
        for flat in [[corners[0]; 3], [Vector3::zeros(); 3], [corners[0] * f64::NAN; 3]] {
            let (barycentrics, _) = intersect_triangle(&flat, &Vector3::new(0.1, 0.2, -1.0));
            assert!((barycentrics.iter().sum::<f64>() - 1.0).abs() < 1e-12, "{barycentrics:?}");
        }
    }

    #[test]
    fn a_ray_that_passes_by_is_moved_onto_the_rim() {
        let corners = [Vector3::new(0.0, 0.0, -1.0), Vector3::new(1.0, 0.0, -1.0), Vector3::new(0.0, 1.0, -1.0)];
        let (barycentrics, _) = intersect_triangle(&corners, &Vector3::new(0.5, -0.01, -1.0));
        assert!(barycentrics[2] == 0.0 && (barycentrics[0] + barycentrics[1] - 1.0).abs() < 1e-15, "{barycentrics:?}");
    }
}
