//! The crown of a tree: the highest surface samples of the domains that reach into the top quarter of the scene.

use nalgebra::Vector3;

use crate::affine::AffineTransform;
use crate::model::{DomainModel, Model};

/// A sample of a domain.
#[derive(Clone, Copy)]
struct SampleIndex {
    domain: usize,
    sample: usize,
}

/// Samples by which the sway of a tree is measured.
pub(super) struct Crown(Vec<SampleIndex>);

impl Crown {
    /// Selects the highest surface sample of each domain, if this sample is in the top quarter of the scene.
    pub(super) fn select(model: &Model) -> Self {
        let top = model.bounds_min.dot(&model.up).max(model.bounds_max.dot(&model.up));
        let min_height = top - 0.25 * model.height();
        let highest_sample = |(index, domain): (usize, &DomainModel)| {
            let height = |sample: &usize| domain.placement.apply(&domain.samples[*sample].rest_position).dot(&model.up);
            let sample = (0..domain.surface_sample_count).max_by(|a, b| height(a).total_cmp(&height(b)))?;
            (height(&sample) >= min_height).then_some(SampleIndex { domain: index, sample })
        };
        Self(model.domains.iter().enumerate().filter_map(highest_sample).collect())
    }

    /// The length of the mean displacement of the samples, as a fraction of the scene's height.
    pub(super) fn sway(&self, model: &Model, q: &[f64], world_from_domain: &[AffineTransform]) -> f64 {
        let displacement = |index: &SampleIndex| {
            let domain = &model.domains[index.domain];
            let sample = &domain.samples[index.sample];
            let current = world_from_domain[index.domain].apply(&sample.deformed_position(domain.q(q)));
            current - domain.placement.apply(&sample.rest_position)
        };
        let displacement_sum: Vector3<f64> = self.0.iter().map(displacement).sum();
        displacement_sum.norm() / (self.0.len().max(1) as f64 * model.height())
    }
}
