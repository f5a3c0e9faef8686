//! Cameras and bounding boxes. All computations are in f64. Only the users of a matrix round it to f32.

use nalgebra::{Matrix3x4, Matrix4, Point3, Vector3};

use super::{FrameSize, PixelRect, Scene};
use crate::error::{Result, invalid};

/// An axis-aligned bounding box in scene units. Empty if `min > max`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoundingBox {
    pub min: [f64; 3],
    pub max: [f64; 3],
}

impl BoundingBox {
    pub const EMPTY: Self = Self { min: [f64::INFINITY; 3], max: [f64::NEG_INFINITY; 3] };

    /// The bounding box of packed positions, three numbers each.
    pub fn from_positions(positions: &[f32]) -> Self {
        let mut bounds = Self::EMPTY;
        let points = positions.chunks_exact(3);
        points.for_each(|point| bounds.include([0, 1, 2].map(|axis| f64::from(point[axis]))));
        bounds
    }

    /// Extends the box to contain a point. NaN coordinates propagate, so that [`Self::is_finite`] detects them.
    pub fn include(&mut self, point: [f64; 3]) {
        *self = self.union(Self { min: point, max: point });
    }

    /// The smallest box that contains both. NaN in either propagates.
    pub fn union(self, other: Self) -> Self {
        let select = |a: f64, b: f64, is_min: bool| match (a.is_nan() || b.is_nan(), is_min) {
            (true, _) => f64::NAN,
            (false, true) => a.min(b),
            (false, false) => a.max(b),
        };
        Self {
            min: std::array::from_fn(|axis| select(self.min[axis], other.min[axis], true)),
            max: std::array::from_fn(|axis| select(self.max[axis], other.max[axis], false)),
        }
    }

    pub fn is_finite(&self) -> bool {
        self.min.iter().chain(&self.max).all(|number| number.is_finite())
    }

    pub fn center(&self) -> Point3<f64> {
        nalgebra::center(&Point3::from(self.min), &Point3::from(self.max))
    }

    /// Length of the diagonal, the reference length of relative errors in this project.
    pub fn diagonal(&self) -> f64 {
        (Point3::from(self.max) - Point3::from(self.min)).norm()
    }

    /// The eight corners. Bit `axis` of a corner's index selects the maximum along that axis.
    pub fn corners(&self) -> [Point3<f64>; 8] {
        std::array::from_fn(|corner| {
            Point3::from(std::array::from_fn(
                |axis| {
                    if corner >> axis & 1 == 0 { self.min[axis] } else { self.max[axis] }
                },
            ))
        })
    }
}

/// The camera's pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum View {
    LookAt {
        eye: [f64; 3],
        target: [f64; 3],
        up: [f64; 3],
    },
    /// `world_from_camera`, 3x4 row-major, with OpenGL's camera axes: x right, y up, looking along -z.
    Pose([f64; 12]),
}

/// The camera's projection.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Lens {
    /// Vertical field of view in degrees.
    FieldOfView(f64),
    /// Pinhole intrinsics in pixels; (0, 0) is the top left corner of the image.
    Intrinsics { fx: f64, fy: f64, cx: f64, cy: f64 },
}

/// The fraction of the image that the scene fills in [`Camera::fit_to_scene`], in the tighter of both directions.
const IMAGE_FILL: f64 = 0.94;

/// The fitted near plane, relative to the distance of the farthest point of the scene along the view axis.
///
/// The only purpose of this value is that depth stays in the range of f32. Depth is near / w, where w is the distance
/// along the view axis: at most 1, and a normal number (at least 2^-126) up to 2^62 times the farthest distance. The
/// value does not limit how close the camera may come, because the positions are f32, and their rounding errors of
/// 2^-24 of their magnitude are larger. It costs no precision: see [`Camera::clip_from_camera`].
const FITTED_NEAR: f64 = 1.0 / (1_u64 << 63) as f64 / 2.0;

/// A camera. `near` and `far` are distances in scene units along the view axis, and geometry outside of them is
/// clipped. If both are 0, nothing in front of the camera is clipped, at any distance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    pub view: View,
    pub lens: Lens,
    pub near: f64,
    pub far: f64,
}

impl Camera {
    /// A camera that views the scene's rest bounds from the front, slightly from above and from the side. The bounds
    /// fill an image of `width` x `height` pixels up to a margin.
    pub fn fit_to_scene(scene: &Scene, width: u32, height: u32) -> Self {
        Self::fit_to_bounds(scene, scene.rest_bounds, FrameSize::new(width, height))
    }

    /// As [`Self::fit_to_scene`], for other bounds.
    pub(super) fn fit_to_bounds(scene: &Scene, bounds: BoundingBox, FrameSize { width, height }: FrameSize) -> Self {
        let up = scene.up.vector();
        let to_camera = scene.up.rotation_from_y_up() * Vector3::from(scene.look.lighting.to_camera()).normalize();
        let vertical_degrees = 28.0_f64;
        let slope = IMAGE_FILL * (vertical_degrees / 2.0).to_radians().tan();
        let aspect = f64::from(width.max(1)) / f64::from(height.max(1));
        let right = up.cross(&to_camera).normalize();
        let camera_up = to_camera.cross(&right);
        // A corner is inside the view frustum if its depth is at least its vertical offset / slope and its horizontal
        // offset / (slope * aspect).
        let required_distance = |corner: &Point3<f64>| {
            let offset = corner - bounds.center();
            let depth_for_width = offset.dot(&right).abs() / (slope * aspect);
            offset.dot(&to_camera) + depth_for_width.max(offset.dot(&camera_up).abs() / slope)
        };
        let max_distance = bounds.corners().iter().map(required_distance).fold(0.0, f64::max);
        let camera_distance = if max_distance > 0.0 { max_distance } else { 1.0 };
        let eye = bounds.center() + to_camera * camera_distance;
        let view = View::LookAt { eye: eye.coords.into(), target: bounds.center().coords.into(), up: up.into() };
        // Nothing in front of the camera is clipped, because near and far are 0.
        Self { view, lens: Lens::FieldOfView(vertical_degrees), near: 0.0, far: 0.0 }
    }

    /// Validates all fields.
    ///
    /// # Errors
    /// `Invalid` with the field.
    pub fn validated(self) -> Result<Self> {
        if let View::LookAt { eye, target, up } = self.view {
            let forward = Vector3::from(target) - Vector3::from(eye);
            let cross_norm = forward.cross(&Vector3::from(up)).norm();
            let look_at_text = || format!("eye {eye:?}, target {target:?}, up {up:?}");
            // Below 1e-12, the sine of the angle between `forward` and `up` is rounding error.
            if !(cross_norm.is_finite() && cross_norm > 1e-12 * forward.norm() * Vector3::from(up).norm()) {
                return Err(invalid(
                    "camera.look_at",
                    "finite eye and target at different points, and up not parallel to the view",
                    look_at_text(),
                ));
            }
        }
        if let View::Pose(pose) = self.view
            && !(pose.iter().all(|number| number.is_finite()) && invert_pose(pose).is_some())
        {
            return Err(invalid(
                "camera.pose.world_from_camera",
                "a finite, invertible transform",
                format!("{pose:?}"),
            ));
        }
        match self.lens {
            Lens::FieldOfView(degrees) if !(degrees > 0.1 && degrees < 179.0) => {
                return Err(invalid("camera.field_of_view", "0.1 to 179 degrees", degrees));
            }
            Lens::Intrinsics { fx, fy, cx, cy }
                if !(fx > 0.0 && fy > 0.0 && [fx, fy, cx, cy].iter().all(|number| number.is_finite())) =>
            {
                return Err(invalid(
                    "camera.intrinsics",
                    "finite numbers, fx and fy above 0",
                    format!("{:?}", self.lens),
                ));
            }
            _ => {}
        }
        let is_fitted = self.near == 0.0 && self.far == 0.0;
        let is_ordered = self.near > 0.0 && self.far > self.near && self.far.is_finite();
        if !(is_fitted || is_ordered) {
            return Err(invalid(
                "camera.near",
                "0 < near < far, or both 0",
                format!("near {}, far {}", self.near, self.far),
            ));
        }
        Ok(self)
    }

    /// `camera_from_world` with OpenGL's camera axes.
    pub fn camera_from_world(&self) -> Matrix4<f64> {
        match self.view {
            View::LookAt { eye, target, up } => {
                Matrix4::look_at_rh(&Point3::from(eye), &Point3::from(target), &Vector3::from(up))
            }
            View::Pose(pose) => invert_pose(pose).unwrap_or_else(Matrix4::identity),
        }
    }

    /// Position of the camera in the world.
    pub fn eye(&self) -> Vector3<f64> {
        match self.view {
            View::LookAt { eye, .. } => eye.into(),
            View::Pose(pose) => Vector3::new(pose[3], pose[7], pose[11]),
        }
    }

    /// The same camera relative to the point `origin`. Computed in f64, so that a camera near a distant `origin` can be
    /// rounded to f32 afterwards.
    #[must_use]
    pub fn relative_to(self, origin: [f64; 3]) -> Self {
        let shifted = |point: [f64; 3]| std::array::from_fn(|axis| point[axis] - origin[axis]);
        let view = match self.view {
            View::LookAt { eye, target, up } => View::LookAt { eye: shifted(eye), target: shifted(target), up },
            View::Pose(mut pose) => {
                (0..3).for_each(|axis| pose[4 * axis + 3] -= origin[axis]);
                View::Pose(pose)
            }
        };
        Self { view, ..self }
    }

    /// fx, fy, cx and cy in pixels for an image of this width and height. (0, 0) is its top left corner.
    pub fn intrinsics(&self, [width, height]: [u32; 2]) -> [f64; 4] {
        match self.lens {
            Lens::FieldOfView(degrees) => {
                let focal_length = 0.5 * f64::from(height) / (degrees.to_radians() / 2.0).tan();
                [focal_length, focal_length, 0.5 * f64::from(width), 0.5 * f64::from(height)]
            }
            Lens::Intrinsics { fx, fy, cx, cy } => [fx, fy, cx, cy],
        }
    }

    /// The camera whose image equals the rectangle `pixel_rect` of this camera's image. `image` is (width, height).
    #[must_use]
    pub fn cropped_to(self, image: [u32; 2], pixel_rect: PixelRect) -> Self {
        let [fx, fy, cx, cy] = self.intrinsics(image);
        let (cx, cy) = (cx - f64::from(pixel_rect.x()), cy - f64::from(pixel_rect.y()));
        Self { lens: Lens::Intrinsics { fx, fy, cx, cy }, ..self }
    }

    /// `clip_from_camera` for an image of `width` x `height` pixels, with reversed depth: z / w is 1 at the near plane
    /// and 0 at the far plane. Without `near` and `far`, the far plane is at infinity, and the near plane is fitted to
    /// `bounds`, which are those of the scene.
    ///
    /// z / w is then near / w, where w is the distance along the view axis. The spacing of f32 is at most 2^-23 of the
    /// number, so depth resolves 2^-23 of the distance, at every distance and for every near plane. (Depth that
    /// increases from 0 to 1 has the relative resolution 2^-24 distance / near.) Interpolation across a triangle adds
    /// rounding errors of 2^-24 of the largest depth of its corners. Consider a flat surface at the distance h from the
    /// eye, and a rasterizer whose guard band is G times as large as the image. The corners of the clipped triangle have
    /// w of at least about h / G. At the distance d, the relative error of depth is then 2^-24 G d / h: the point moves
    /// by d times this error along the view ray, and by h / d of that along the normal, which is 2^-24 G d.
    /// (Reed, "Depth Precision Visualized", 2015; Upchurch and Desbrun, "Tightening the Precision of Perspective
    /// Rendering", 2012.)
    pub fn clip_from_camera(&self, width: u32, height: u32, bounds: &BoundingBox) -> Matrix4<f64> {
        let [fx, fy, cx, cy] = self.intrinsics([width, height]);
        let (width, height) = (f64::from(width), f64::from(height));
        let mut matrix = Matrix4::zeros();
        matrix[(0, 0)] = 2.0 * fx / width;
        matrix[(0, 2)] = 1.0 - 2.0 * cx / width;
        matrix[(1, 1)] = 2.0 * fy / height;
        matrix[(1, 2)] = 2.0 * cy / height - 1.0;
        if self.far > 0.0 {
            let scale = self.near / (self.far - self.near);
            (matrix[(2, 2)], matrix[(2, 3)]) = (scale, scale * self.far);
        } else {
            matrix[(2, 3)] = self.fitted_near(bounds);
        }
        matrix[(3, 2)] = -1.0;
        matrix
    }

    /// Distance of the fitted near plane: a power of two, so that a change of the bounds changes only the exponents of
    /// depths, not their order.
    fn fitted_near(&self, bounds: &BoundingBox) -> f64 {
        let camera_from_world = self.camera_from_world();
        let distances = bounds.corners().map(|corner| camera_from_world.transform_point(&corner).z.abs());
        let farthest = distances.into_iter().filter(|distance| distance.is_finite()).fold(f64::MIN_POSITIVE, f64::max);
        // The f32 matrix needs a normal number.
        (FITTED_NEAR * farthest.log2().ceil().exp2()).max(f64::from(f32::MIN_POSITIVE))
    }
}

/// The inverse of a 3x4 row-major transform, if it exists and is finite.
fn invert_pose(pose: [f64; 12]) -> Option<Matrix4<f64>> {
    let mut matrix = Matrix4::identity();
    matrix.fixed_view_mut::<3, 4>(0, 0).copy_from(&Matrix3x4::from_row_slice(&pose));
    matrix.try_inverse().filter(|inverse| inverse.iter().all(|number| number.is_finite()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bounds_with_a_nan_are_never_finite() {
        let mut bounds = BoundingBox::EMPTY;
        bounds.include([0.0; 3]);
        assert!(bounds.is_finite());
        bounds.include([0.0, f64::NAN, 0.0]);
        bounds.include([1.0; 3]);
        assert!(!bounds.is_finite());
        let finite_bounds = BoundingBox { min: [0.0; 3], max: [1.0; 3] };
        assert!(!finite_bounds.union(bounds).is_finite() && !bounds.union(finite_bounds).is_finite());
    }

    #[test]
    fn fitted_camera_fills_the_image_up_to_the_margin() {
        for (size, width, height) in [([1.0, 8.0, 1.0], 1280, 720), ([9.0, 1.0, 2.0], 1280, 720), ([1.0; 3], 200, 900)]
        {
            let scene = block(size);
            let camera = Camera::fit_to_scene(&scene, width, height);
            let clip = camera.clip_from_camera(width, height, &scene.rest_bounds) * camera.camera_from_world();
            let extents = scene.rest_bounds.corners().map(|corner| {
                let point = clip.transform_point(&corner);
                point.x.abs().max(point.y.abs())
            });
            let max_extent = extents.into_iter().fold(0.0, f64::max);
            assert!((max_extent - IMAGE_FILL).abs() < 1e-6, "{size:?}: expected {IMAGE_FILL}, got {max_extent}");
        }
    }

    /// Depth in f32, as the shaders compute it, decreases with the distance, from far below to far above the size of
    /// the scene.
    #[test]
    fn fitted_depth_resolves_two_millionths_of_every_distance() {
        for size in [1e-11, 1.0, 1e9_f32] {
            let scene = block([size; 3]);
            let camera = Camera::fit_to_scene(&scene, 64, 64);
            let clip_from_camera = camera.clip_from_camera(64, 64, &scene.rest_bounds).cast::<f32>();
            let depth = |distance: f32| {
                let clip = clip_from_camera * nalgebra::Vector4::new(0.0, 0.0, -distance, 1.0);
                clip.z / clip.w
            };
            for exponent in -50..50 {
                let distance = size * 2.0_f32.powi(exponent);
                let (near_depth, far_depth) = (depth(distance), depth(distance * (1.0 + 2e-6)));
                assert!(
                    near_depth > far_depth && far_depth > f32::MIN_POSITIVE && near_depth <= 1.0,
                    "size {size}, distance {distance}: expected 1 >= {near_depth:e} > {far_depth:e} > 0"
                );
            }
        }
    }

    #[test]
    fn explicit_planes_have_the_depths_1_and_0() {
        let camera = Camera { near: 0.5, far: 80.0, ..Camera::fit_to_scene(&block([1.0; 3]), 64, 64) };
        let clip_from_camera = camera.clip_from_camera(64, 64, &BoundingBox::EMPTY);
        let depth = |distance: f64| clip_from_camera.transform_point(&Point3::new(0.0, 0.0, -distance)).z;
        assert!((depth(0.5) - 1.0).abs() < 1e-12 && depth(80.0).abs() < 1e-12, "{} {}", depth(0.5), depth(80.0));
        // near (far - w) / (w (far - near)) at w = 2
        assert!((depth(2.0) - 0.5 * 78.0 / (2.0 * 79.5)).abs() < 1e-12, "{}", depth(2.0));
    }

    #[test]
    fn relative_camera_keeps_its_precision_far_from_the_origin() {
        let (eye, target, up) = ([1e7 + 0.125, 2.0, -1e7 + 3.0], [1e7, 2.25, -1e7], [0.0, 1.0, 0.0]);
        let lens = Lens::FieldOfView(30.0);
        let camera = Camera { view: View::LookAt { eye, target, up }, lens, near: 0.0, far: 0.0 };
        let world_from_camera = camera.camera_from_world().try_inverse().expect("an invertible transform");
        let pose = std::array::from_fn(|entry| world_from_camera[(entry / 4, entry % 4)]);
        let origin = [1e7, 0.0, -1e7];
        let relative_view = View::LookAt { eye: [0.125, 2.0, 3.0], target: [0.0, 2.25, 0.0], up };
        let expected = Camera { view: relative_view, ..camera }.camera_from_world();
        let error = |candidate: Camera| {
            (candidate.validated().expect("a valid camera").camera_from_world() - expected).abs().max()
        };
        assert!(error(camera.relative_to(origin)) < 1e-12);
        // The pose was computed at 1e7, where f64 has a spacing of 2e-9.
        assert!(error(Camera { view: View::Pose(pose), ..camera }.relative_to(origin)) < 1e-7);
        // Control: near 1e7, f32 has a spacing of 1. A pose that is rounded before the subtraction loses its fraction.
        let rounded_pose = View::Pose(pose.map(|number| f64::from(number as f32)));
        assert!(error(Camera { view: rounded_pose, ..camera }.relative_to(origin)) > 0.05);
        for entry in [f64::NAN, f64::INFINITY] {
            let mut pose = pose;
            pose[7] = entry;
            assert!(Camera { view: View::Pose(pose), ..camera }.validated().is_err());
        }
    }

    /// A scene of one triangle whose bounding box has the given size.
    fn block(size: [f32; 3]) -> std::sync::Arc<Scene> {
        use crate::domain::{Domain, Material, Mesh, Modes, Shape};
        let rest_positions = vec![[0.0; 3], size, [size[0], 0.0, 0.0]];
        let mesh =
            Mesh::from_indexed(rest_positions, vec![[0.0, 0.0, 1.0]; 3], vec![], vec![[0, 1, 2]]).expect("a mesh");
        let mut parts = crate::scene::SceneParts::named("block");
        parts.shapes = vec![Shape::new(mesh, Modes::rigid()).expect("a shape")];
        parts.materials = vec![Material::default()];
        parts.domains = vec![Domain::new("block", 0)];
        Scene::new(parts).expect("a scene")
    }
}
