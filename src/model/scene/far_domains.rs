//! Domains that are far from the origin of their own frame, or from the scene's origin, so that f32 alone would round
//! their rest state too coarsely.
//!
//! Such a scene differs from others in two ways. Rest positions are relative to an origin of their shape
//! ([`Shape::origin`]), which is a part of the transforms of the state ([`super::TransformRoots::pivot_of`]). And the
//! rest state has [`super::FloatingOrigins`], as after a step with f64 translations. All other scenes have neither.

use nalgebra::{Matrix4, Point3};

use super::{BoundingBox, SceneParts};
use crate::domain::{Domain, MAX_DIAGONALS, Mesh, Shape, origin_of_bounds};
use crate::error::Result;
use crate::rounding::to_significant_digits;

/// Limit on the distance of a domain from the scene's origin, in diagonals of its own bounds. The limit is large for two
/// reasons: floating origins cost a pass over all vertices on the host per frame, and up to it, f32 only shifts a domain,
/// by at most 2^-24 x 2^16 = 0.4 % of its diagonal, and does not deform it.
const MAX_OWN_DIAGONALS: f64 = 65_536.0;

/// The largest error on an axis of a step with f32 transforms, in terms of the largest coordinate d of a domain.
///
/// A client that rounds T = (A, t) to f32 changes each entry of A by at most 2^-25, and t, which is at most 2 d, by at
/// most 2^-23 d. On each axis, T x0 then changes by at most 3 x 2^-25 d + 2^-23 d, which is less than 2^-22 d.
const F32_TRANSFORM_ERROR: f64 = 1.0 / 4_194_304.0;

/// The error that needs no remark, in diagonals of the scene: the accuracy that the project promises.
const PROMISED_ERROR: f64 = 1e-5;

/// The bounds that decide whether a domain is far.
struct Extents {
    /// Per shape, the bounds of x0 of the drawn vertices.
    shapes: Vec<BoundingBox>,
    /// Per domain, the bounds at rest.
    domains: Vec<BoundingBox>,
    /// Diagonal of the bounds of all domains.
    diagonal: f64,
}

impl Extents {
    fn new(shapes: &[Shape], domains: &[Domain]) -> Self {
        let shapes: Vec<BoundingBox> = shapes.iter().map(|shape| drawn_bounds(&shape.mesh, shape.origin())).collect();
        let world_bounds = |domain: &Domain| transform_bounds(&domain.placement_matrix(), shapes[domain.shape]);
        let domains: Vec<BoundingBox> = domains.iter().map(world_bounds).collect();
        let bounds = domains.iter().fold(BoundingBox::EMPTY, |all, bounds| all.union(*bounds));
        Self { shapes, domains, diagonal: bounds.diagonal() }
    }

    /// The error of the place of a domain that needs no remark, in scene units.
    fn tolerated_error(&self, domain: usize) -> f64 {
        let own_limit = F32_TRANSFORM_ERROR * MAX_OWN_DIAGONALS * self.domains[domain].diagonal();
        (PROMISED_ERROR * self.diagonal).min(own_limit)
    }

    /// The largest coordinate that f32 represents well enough for a domain, in scene units.
    fn largest_coordinate(&self, domain: usize) -> f64 {
        let limit = MAX_DIAGONALS * self.diagonal;
        match self.domains[domain].diagonal() {
            own_diagonal if own_diagonal.is_normal() => limit.min(MAX_OWN_DIAGONALS * own_diagonal),
            _ => limit,
        }
    }
}

/// The domains of a scene that are far.
pub(super) struct FarDomains {
    /// Per domain.
    is_far: Vec<bool>,
    /// A remark, if steps with f32 transforms would misplace a domain by more than the promised accuracy.
    pub(super) remark: Option<String>,
}

impl FarDomains {
    /// Whether any domain is far.
    pub(super) fn exist(&self) -> bool {
        self.is_far.contains(&true)
    }

    /// Rounds the placements of the other domains to f32.
    pub(super) fn round_near_placements(&self, domains: &mut [Domain]) {
        for (domain, is_far) in domains.iter_mut().zip(&self.is_far) {
            if !is_far {
                domain.placement_remainder = [0.0; 12];
            }
        }
    }
}

/// Decides which domains are far, and removes the origins of the shapes that do not matter. Centers shapes that are far
/// without having an origin.
///
/// # Errors
/// `Invalid` if a position exceeds the range of f32.
pub(super) fn separate_far_domains(parts: &mut SceneParts) -> Result<FarDomains> {
    let SceneParts { shapes, domains, .. } = parts;
    let extents = Extents::new(shapes, domains);
    let mut is_far_shape = vec![false; shapes.len()];
    let mut is_far_domain = vec![false; domains.len()];
    // Domains that steps with f32 transforms misplace: the index and the largest coordinate of each.
    let mut misplaced: Vec<(usize, f64)> = Vec::new();
    for (index, domain) in domains.iter().enumerate() {
        let limit = extents.largest_coordinate(index);
        // A scene of a single point has no size to compare with.
        let is_far = |reach: f64| limit.is_normal() && reach.is_finite() && reach > limit;
        // A uniform scale, or a mean of the scales of the axes.
        let scale = domain.placement.linear().norm() / 3.0_f64.sqrt();
        let shape_reach = scale * largest_coordinate(extents.shapes[domain.shape]);
        let reach = shape_reach.max(largest_coordinate(extents.domains[index]));
        is_far_shape[domain.shape] |= is_far(shape_reach);
        is_far_domain[index] = is_far(reach);
        if is_far(reach) && F32_TRANSFORM_ERROR * reach > extents.tolerated_error(index) {
            misplaced.push((index, reach));
        }
    }
    for (index, shape) in shapes.iter_mut().enumerate() {
        let origin = match is_far_shape[index] {
            false => [0.0; 3],
            true if shape.is_centered() => shape.origin(),
            true => origin_of_bounds([extents.shapes[index].min, extents.shapes[index].max]),
        };
        if origin != shape.origin() {
            shape.set_origin(origin)?;
        }
    }
    Ok(FarDomains { is_far: is_far_domain, remark: far_remark(parts, &misplaced) })
}

/// A remark on the error of steps with f32 transforms, in a scene where it matters.
fn far_remark(parts: &SceneParts, misplaced: &[(usize, f64)]) -> Option<String> {
    let (index, reach) = misplaced.iter().max_by(|a, b| a.1.total_cmp(&b.1))?;
    let others = match misplaced.len() - 1 {
        0 => String::new(),
        1 => ", another domain is far from it, too".to_owned(),
        count => format!(", {count} other domains are far from it, too"),
    };
    let [distance, error] =
        [*reach, *reach * F32_TRANSFORM_ERROR].map(|length| to_significant_digits(length * parts.meters_per_unit(), 2));
    Some(format!(
        "'{}' is {distance} m from the origin{others}: steps with f32 transforms misplace it by up to {error} m on each \
         axis; send poses in f64",
        parts.domains[*index].name
    ))
}

/// The bounds of the vertices that triangles use, in f64.
pub(super) fn drawn_bounds(mesh: &Mesh, origin: [f64; 3]) -> BoundingBox {
    let mut bounds = BoundingBox::EMPTY;
    for position in mesh.drawn_positions() {
        bounds.include(std::array::from_fn(|axis| f64::from(position[axis]) + origin[axis]));
    }
    bounds
}

/// The bounds of a transformed box.
pub(super) fn transform_bounds(matrix: &Matrix4<f64>, bounds: BoundingBox) -> BoundingBox {
    let mut transformed = BoundingBox::EMPTY;
    for corner in bounds.corners() {
        transformed.include(transform_point(matrix, corner.coords.into()));
    }
    transformed
}

/// An affine transform of a point.
pub(super) fn transform_point(matrix: &Matrix4<f64>, point: [f64; 3]) -> [f64; 3] {
    matrix.transform_point(&Point3::from(point)).coords.into()
}

/// The largest magnitude of a coordinate in a box.
fn largest_coordinate(bounds: BoundingBox) -> f64 {
    bounds.min.iter().chain(&bounds.max).fold(0.0, |largest: f64, coordinate| largest.max(coordinate.abs()))
}

#[cfg(test)]
mod tests;
