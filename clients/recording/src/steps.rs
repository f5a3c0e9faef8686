//! Converts recorded states to steps that a server accepts.

use glam::{DMat3, DQuat, DVec3};
use modalcast_client::{DomainTransform, SceneDescription, SceneState, Step};

use crate::error::{Error, Result};
use crate::states::RecordedState;

/// Largest difference of R^T R from the identity with which a server accepts R as a rotation.
const ROTATION_TOLERANCE: f64 = 1e-3;

/// The scene that the steps are for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StepTarget {
    /// The recorded scene: domains may follow others and share coordinates.
    RecordedScene,
    /// Domains of the recorded scene that were uploaded as arrays: each has coordinates and a transform of its own, and
    /// the scene's origin is that of the world.
    UploadedArrays,
}

/// Converts the states of a recording, in order.
pub struct StepConverter {
    target: StepTarget,
    /// The domains of a step with all values.
    all_q_domains: Vec<u32>,
    all_transform_domains: Vec<u32>,
    /// World position in meters of the origin of the recorded scene.
    scene_origin: [f64; 3],
    /// Meters per scene unit.
    unit: f64,
    /// Whether transforms are relative to another origin than that of the scene.
    has_moved_origin: bool,
    /// Per domain, the origin of its shape ([`modalcast_client::Shape::origin`]).
    shape_origins: Vec<[f64; 3]>,
}

impl StepConverter {
    pub fn new(description: &SceneDescription, target: StepTarget) -> Self {
        let is_recorded = target == StepTarget::RecordedScene;
        let domains = || description.domains.iter();
        let with_q = domains().filter(|domain| domain.rank > 0 && !(is_recorded && domain.shares_q_with.is_some()));
        let with_transform = domains().filter(|domain| !(is_recorded && domain.follow.is_some()));
        let origin = &description.info.origin;
        Self {
            target,
            all_q_domains: with_q.map(|domain| domain.index as u32).collect(),
            all_transform_domains: with_transform.map(|domain| domain.index as u32).collect(),
            scene_origin: std::array::from_fn(|axis| origin.get(axis).copied().unwrap_or(0.0)),
            unit: description.info.unit,
            has_moved_origin: false,
            shape_origins: domains().map(|domain| description.shapes[domain.shape].origin).collect(),
        }
    }

    /// A step with the values that the state has on the wire, or with all values.
    ///
    /// # Errors
    /// `Invalid` if a transform whose origin is not that of the scene is not a rotation and a translation: no format of
    /// a step can express it exactly.
    pub fn convert(&mut self, recorded: &RecordedState, number: u64, with_all_values: bool) -> Result<Step> {
        let sent = &recorded.sent_values;
        let state = &recorded.state;
        if sent.origins {
            let domains = self.all_transform_domains.iter();
            let mut origins = domains.filter_map(|domain| state.origin(*domain as usize));
            self.has_moved_origin = origins.any(|origin| origin != self.scene_origin);
        }
        let mut step = Step::new(number, state.step.time);
        let is_whole = with_all_values || sent.is_complete || self.target == StepTarget::UploadedArrays;
        let q_domains = if is_whole { &self.all_q_domains } else { &sent.q_domains };
        for domain in q_domains {
            step.set_q(*domain, state.q(*domain as usize).unwrap_or_default());
        }
        let transform_domains =
            if is_whole || sent.origins { &self.all_transform_domains } else { &sent.transform_domains };
        for domain in transform_domains {
            step.set_domain_transform(*domain, &self.transform(state, *domain, number)?);
        }
        Ok(step)
    }

    fn transform(&self, state: &SceneState, domain: u32, number: u64) -> Result<DomainTransform> {
        let transform = state.transform(domain as usize).unwrap_or_default();
        if !self.has_moved_origin {
            return Ok(DomainTransform::Affine(transform));
        }
        let entry = |row: usize, column: usize| f64::from(transform[4 * row + column]);
        let column = |column| DVec3::new(entry(0, column), entry(1, column), entry(2, column));
        let linear = DMat3::from_cols(column(0), column(1), column(2));
        let difference = (linear.transpose() * linear - DMat3::IDENTITY).to_cols_array();
        let is_rotation =
            difference.iter().all(|entry| entry.abs() <= ROTATION_TOLERANCE) && linear.determinant() > 0.0;
        if !is_rotation {
            let field = format!("step {number}: transform of domain {domain}");
            let expected = "a rotation and a translation, because its origin is not that of the scene";
            return Err(Error::invalid(field, expected, format!("{transform:?}")));
        }
        let origin = state.origin(domain as usize).unwrap_or_default();
        let rotation = DQuat::from_mat3(&linear).normalize().as_quat().to_array();
        // The rounded rotation moves a shape that is far from the origin of its frame. The translation compensates it.
        let shape_origin = DVec3::from_array(self.shape_origins.get(domain as usize).copied().unwrap_or_default());
        let rounded = DMat3::from_quat(DQuat::from_array(rotation.map(f64::from)).normalize());
        let correction = (linear - rounded) * shape_origin;
        let translation = std::array::from_fn(|axis| {
            let origin = match self.target {
                StepTarget::RecordedScene => origin[axis],
                StepTarget::UploadedArrays => origin[axis] - self.scene_origin[axis],
            };
            origin / self.unit + entry(axis, 3) + correction[axis]
        });
        Ok(DomainTransform::QuaternionXyzwF64 { rotation, translation })
    }
}
