//! The cases of the report: a scene, the exact motion of its first domain, and how a client sends this motion.

use std::sync::Arc;

use fastrand::Rng;
use nalgebra::{Isometry3, Matrix3, UnitQuaternion, Vector3};

use super::sent_transform::{SentTransform, exact_rotation};
use modalcast_model::domain::{Domain, FollowConstraint, Material, Mesh, Modes, Shape, Transform};
use modalcast_model::error::Result;
use modalcast_model::scene::{RawStepUpdate, Scene, SceneParts};

/// Vertices of each domain, on a sphere with a radius of 1 m.
const VERTICES: usize = 16;
/// Modes of each domain.
const RANK: usize = 2;
/// Largest coordinate q. Entries of U are at most 1.
const Q_AMPLITUDE: f64 = 0.05;
/// Followers of the chain.
const FOLLOWERS: usize = 64;
/// Meters per step of a domain that travels.
const TRAVEL_PER_STEP: f64 = 2.0;
/// Distance of the domains that do not move from the start of the one that travels, in meters. It is larger than the
/// reach of the shared origin, so that the domain has an origin of its own from the first step.
const STATIONARY_DISTANCE: f32 = 1000.0;

/// A scene and its motion. Domain 0 moves, the followers form a chain that starts at domain 0, and all other domains
/// stay where they are.
#[derive(Debug, Clone)]
pub(super) struct Case {
    pub(super) name: &'static str,
    /// Whether the errors must grow: a negative control.
    pub(super) is_control: bool,
    followers: usize,
    stationary: usize,
    /// Translation of domain 0 in meters, by step and number of steps.
    translation: fn(u64, u64) -> Vector3<f64>,
    sent_transform: SentTransform,
}

/// All cases.
pub(super) fn all() -> Vec<Case> {
    // A client that rotates a domain without translating it.
    let client = |name, is_control, sent_transform| {
        let translation = |_, _| Vector3::zeros();
        Case { name, is_control, followers: 0, stationary: 0, translation, sent_transform }
    };
    let traveler = |name| Case { translation: travel, ..client(name, false, SentTransform::QuaternionF64) };
    let chain = client("follower-chain", false, SentTransform::MatrixF64);
    vec![
        Case { followers: FOLLOWERS, translation: circle, ..chain },
        traveler("shared-origin"),
        // The shared origin stays with the majority.
        Case { stationary: 2, ..traveler("own-origin") },
        client("f32-product", true, SentTransform::ProductF32(Matrix3::identity())),
        client("f32-orthonormal", true, SentTransform::OrthonormalF32(Matrix3::identity())),
        client("f64-product", false, SentTransform::ProductF64(Matrix3::identity())),
        client("f64-from-time", false, SentTransform::MatrixF64),
    ]
}

/// A closed curve with a radius of 3 m.
fn circle(step: u64, _steps: u64) -> Vector3<f64> {
    let angle = 0.07 * step as f64;
    Vector3::new(3.0 * angle.cos(), 3.0 * angle.sin(), 1.5 * (2.0 * angle).cos())
}

/// Travels along x and back, so that the last step is at x = 0 again.
fn travel(step: u64, steps: u64) -> Vector3<f64> {
    circle(step, steps) + TRAVEL_PER_STEP * step.min(steps - step) as f64 * Vector3::x()
}

impl Case {
    /// The exact pose of domain 0.
    pub(super) fn pose(&self, step: u64, steps: u64) -> Isometry3<f64> {
        Isometry3::from_parts((self.translation)(step, steps).into(), exact_rotation(step))
    }

    /// The step that a client sends for the exact pose of domain 0. Must be called for each step in order.
    pub(super) fn next_step(&mut self, step: u64, pose: &Isometry3<f64>) -> RawStepUpdate {
        let coordinate_count = RANK * (1 + self.followers + self.stationary);
        let coordinate = |index: usize| (Q_AMPLITUDE * (0.3 * step as f64 + index as f64).cos()) as f32;
        RawStepUpdate {
            number: step,
            time: step as f64,
            q: (0..coordinate_count).flat_map(|index| coordinate(index).to_le_bytes()).collect(),
            transform_domains: vec![0],
            transform_format: self.sent_transform.format(),
            transforms: self.sent_transform.advance(pose).into(),
            ..RawStepUpdate::default()
        }
    }

    /// Builds the scene at rest.
    pub(super) fn scene(&self) -> Result<Arc<Scene>> {
        let link_rotation = UnitQuaternion::from_scaled_axis(Vector3::new(0.3, 0.2, -0.1));
        let link = Isometry3::from_parts(Vector3::new(0.1, 0.2, -0.05).into(), link_rotation);
        let frame = Transform::from_matrix(&link.to_homogeneous());
        let mut placement = Transform::IDENTITY;
        placement.0[7] = -STATIONARY_DISTANCE;
        let domain = |index: usize| {
            let domain = Domain::new(index.to_string(), 0);
            match index {
                0 => domain,
                _ if index <= self.followers => {
                    Domain { follows: Some(FollowConstraint { parent: index - 1, frame }), ..domain }
                }
                _ => Domain { placement, ..domain },
            }
        };
        Scene::new(SceneParts {
            shapes: vec![sphere_shape()?],
            materials: vec![Material::default()],
            domains: (0..1 + self.followers + self.stationary).map(domain).collect(),
            ..SceneParts::named(self.name)
        })
    }
}

/// Points on a sphere in random directions, with random modes.
fn sphere_shape() -> Result<Shape> {
    let mut rng = Rng::with_seed(0xD21F7);
    let mut random_entry = || 2.0 * rng.f32() - 1.0;
    let directions: Vec<[f32; 3]> =
        (0..VERTICES).map(|_| Vector3::from_fn(|_, _| random_entry()).normalize().into()).collect();
    let mesh = Mesh::from_indexed(directions.clone(), directions, vec![], vec![[0, 1, 2]])?;
    let entries = (0..3 * VERTICES * RANK).map(|_| random_entry()).collect();
    Shape::new(mesh, Modes::from_columns(3 * VERTICES, RANK, entries)?)
}
