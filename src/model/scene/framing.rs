//! The camera of a picture without a camera of its own: it frames the scene at rest, or the present state if all
//! domains have left that view.

use nalgebra::{Matrix4, Point3};

use super::{BoundingBox, Camera, FrameSize, Scene, SceneState};

/// Where the camera of a picture comes from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum CameraSource {
    /// Set by a client.
    Fixed(Camera),
    /// The camera that frames the rest bounds. It is replaced while no domain is in its view.
    Framing(Camera),
}

/// The camera that draws a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Framing {
    pub camera: Camera,
    /// Whether the camera frames the present state, because no domain is in the view that frames the rest bounds.
    pub is_moved: bool,
}

impl CameraSource {
    /// The camera that frames the rest bounds of a scene.
    pub fn framing(scene: &Scene, size: FrameSize) -> Self {
        Self::Framing(Camera::fit_to_scene(scene, size.width, size.height))
    }

    /// The camera, as if the scene were at rest.
    pub const fn at_rest(&self) -> &Camera {
        match self {
            Self::Fixed(camera) | Self::Framing(camera) => camera,
        }
    }

    /// The camera that draws a state. The search ends at the first domain that is in view.
    pub fn resolve(&self, scene: &Scene, state: &SceneState, size: FrameSize) -> Framing {
        let camera = *self.at_rest();
        let bounds_of = |domain: usize| world_bounds(scene, state, domain);
        let keep = Framing { camera, is_moved: false };
        if matches!(self, Self::Fixed(_)) {
            return keep;
        }
        let clip_from_world =
            camera.clip_from_camera(size.width, size.height, &scene.rest_bounds) * camera.camera_from_world();
        let mut small_count = 0;
        for domain in 0..scene.domains.len() {
            match coverage(&clip_from_world, bounds_of(domain), size) {
                Coverage::None => {}
                Coverage::LessThanPixel => small_count += 1,
                Coverage::Pixels => return keep,
            }
            if small_count == MAX_SMALL_DOMAINS {
                return keep;
            }
        }
        let bounds = (0..scene.domains.len()).map(bounds_of).fold(BoundingBox::EMPTY, BoundingBox::union);
        // Many small domains can cover the image.
        let is_visible = matches!(coverage(&clip_from_world, bounds, size), Coverage::Pixels) && small_count > 0;
        match bounds.is_finite() && !is_visible {
            true => Framing { camera: Camera::fit_to_bounds(scene, bounds, size), is_moved: true },
            false => keep,
        }
    }
}

/// Bounds of the drawn vertices of a domain, relative to the scene's origin.
fn world_bounds(scene: &Scene, state: &SceneState, domain: usize) -> BoundingBox {
    let bounds = scene.drawn_bounds.domain_bounds(scene, state, domain);
    let origin = state.origin_of(scene.transform_roots.root_of(domain));
    let moved = |corner: [f64; 3]| std::array::from_fn(|axis| corner[axis] + origin[axis]);
    BoundingBox { min: moved(bounds.min), max: moved(bounds.max) }
}

/// The most domains of less than a pixel that are examined before the view counts as one that shows them.
const MAX_SMALL_DOMAINS: usize = 4096;

/// How much of an image a box covers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Coverage {
    /// A plane of the view separates the box from the image.
    None,
    /// The box is less than one pixel wide and high.
    LessThanPixel,
    Pixels,
}

fn coverage(clip_from_world: &Matrix4<f64>, bounds: BoundingBox, size: FrameSize) -> Coverage {
    let corners = bounds.corners().map(|corner: Point3<f64>| clip_from_world * corner.to_homogeneous());
    let is_outside = |distance: fn(&nalgebra::Vector4<f64>) -> f64| corners.iter().all(|corner| distance(corner) < 0.0);
    if is_outside(|corner| corner.w)
        || is_outside(|corner| corner.w + corner.x)
        || is_outside(|corner| corner.w - corner.x)
        || is_outside(|corner| corner.w + corner.y)
        || is_outside(|corner| corner.w - corner.y)
    {
        return Coverage::None;
    }
    if corners.iter().any(|corner| corner.w <= 0.0) {
        // The box extends behind the eye.
        return Coverage::Pixels;
    }
    let extent = |ndc: fn(&nalgebra::Vector4<f64>) -> f64| {
        let (min, max) = corners
            .iter()
            .map(ndc)
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(min, max), value| (min.min(value), max.max(value)));
        max - min
    };
    let pixels = [
        extent(|corner| corner.x / corner.w) * f64::from(size.width) / 2.0,
        extent(|corner| corner.y / corner.w) * f64::from(size.height) / 2.0,
    ];
    if pixels.iter().any(|pixels| *pixels >= 1.0) { Coverage::Pixels } else { Coverage::LessThanPixel }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Domain, Material, Mesh, Modes, Shape, Transform};
    use crate::scene::SceneParts;

    const SIZE: FrameSize = FrameSize::new(160, 90);

    /// `count` triangles of about one unit, each with a mode that moves it along x.
    fn triangles(count: usize) -> std::sync::Arc<Scene> {
        let positions = vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.5]];
        let mesh = Mesh::from_indexed(positions, vec![[0.0, 0.0, 1.0]; 3], vec![], vec![[0, 1, 2]]).expect("a mesh");
        let modes = Modes::from_columns(9, 1, [1.0, 0.0, 0.0].repeat(3)).expect("a mode");
        let mut parts = SceneParts::named("triangles");
        parts.shapes.push(Shape::new(mesh, modes).expect("a shape"));
        parts.materials.push(Material::default());
        parts.domains = (0..count).map(|index| Domain::new(format!("{index}"), 0)).collect();
        Scene::new(parts).expect("a scene")
    }

    fn moved(scene: &Scene, translations: &[[f32; 3]]) -> SceneState {
        let mut state = SceneState::rest(scene);
        for (transform, translation) in state.transforms.iter_mut().zip(translations) {
            *transform =
                Transform::from_parts(&nalgebra::Matrix3::identity(), &nalgebra::Vector3::from(*translation).cast());
        }
        state.mark_all_dirty();
        state
    }

    #[test]
    fn rest_view_stays_until_all_domains_have_left_it() {
        let scene = triangles(2);
        let camera = CameraSource::framing(&scene, SIZE);
        let rest = *camera.at_rest();
        let resolve = |translations: [[f32; 3]; 2]| camera.resolve(&scene, &moved(&scene, &translations), SIZE);
        for near in [[0.0; 3], [0.5, 0.0, 0.0], [0.0, -0.5, 0.0]] {
            for far in [[1000.0, 0.0, 0.0], [0.0; 3]] {
                assert_eq!(resolve([near, far]), Framing { camera: rest, is_moved: false }, "{near:?} {far:?}");
            }
        }
        // Beside, above, behind the camera, and so far along the view that a domain covers less than a pixel.
        let forward = (scene.rest_bounds.center().coords - rest.eye()).normalize().cast::<f32>();
        for direction in [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], (-forward).into(), forward.into()] {
            let far = direction.map(|component: f32| 1000.0 * component);
            let framing = resolve([far, far]);
            assert!(framing.is_moved, "{direction:?}");
            let state = moved(&scene, &[far, far]);
            let clip =
                framing.camera.clip_from_camera(160, 90, &scene.rest_bounds) * framing.camera.camera_from_world();
            assert_eq!(coverage(&clip, world_bounds(&scene, &state, 0), SIZE), Coverage::Pixels, "{direction:?}");
            let set = CameraSource::Fixed(rest).resolve(&scene, &state, SIZE);
            assert_eq!(set, Framing { camera: rest, is_moved: false }, "expected the client's camera");
        }
        assert!(!resolve([[0.0; 3], [1000.0, 0.0, 0.0]]).is_moved, "expected one visible domain to keep the view");
    }

    #[test]
    fn coordinates_can_move_a_domain_out_of_the_view_and_back() {
        let scene = triangles(1);
        let camera = CameraSource::framing(&scene, SIZE);
        let mut state = moved(&scene, &[[1000.0, 0.0, 0.0]]);
        assert!(camera.resolve(&scene, &state, SIZE).is_moved);
        // The bounds of a deformed domain extend in both directions of its modes.
        state.q[0] = -1000.0;
        state.mark_all_dirty();
        assert!(!camera.resolve(&scene, &state, SIZE).is_moved);
    }
}
