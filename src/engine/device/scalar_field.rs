//! Per-vertex values for color maps: the displacement in a step, or the shape of one mode.

use nalgebra::Vector3;
use rayon::prelude::*;

use crate::engine::output::output_spec::FrameOutput;
use crate::frame::{Legend, round_up_scale};
use modalcast_model::deform::DeformedSurface;
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::{Scene, SceneState};

/// Lower bound of the value at the end of a fitted color scale of displacements, as a fraction of the scene's diagonal.
/// Smaller displacements may be rounding errors.
const MIN_SCALE_FRACTION: f64 = 1e-5;

/// Limits of the value at the end of a scale. The values that clients may request have the same limits.
const MIN_SCALE: f64 = 1e-30;
const MAX_SCALE: f64 = 1e30;

/// Returns `mode` if at least one domain of the scene has a mode with this index.
///
/// # Errors
/// `Invalid` when every domain has fewer modes.
pub fn validate_mode(scene: &Scene, mode: u32) -> Result<u32> {
    let max_rank = scene.layout.domains.iter().map(|domain| domain.rank).max().unwrap_or(0);
    if (mode as usize) < max_rank { Ok(mode) } else { Err(invalid("mode", format!("an index below {max_rank}"), mode)) }
}

/// The displacement of every vertex in meters, after T: the distance of its deformed position T (x0 + U q) from T x0,
/// the position that it has if the domain is rigid.
///
/// T x0 and the difference are computed in f64, so the error is the error of the deformer's positions. These positions
/// are f32 relative to the domain's floating origin, an f64 point near the domain: one kilometer from this origin the
/// error is up to 0.1 mm.
pub(in crate::engine) fn displacement_magnitudes(
    scene: &Scene,
    state: &SceneState,
    surface: &DeformedSurface,
) -> Vec<f32> {
    let domains = scene.domains.par_iter().zip(&scene.layout.domains).enumerate();
    let magnitudes = domains.flat_map_iter(|(index, (domain, domain_layout))| {
        let world_from_domain = state.composed_transform(scene, index);
        let (linear, entries) = (world_from_domain.linear(), world_from_domain.to_f64());
        // The fourth column of the row-major 3x4 matrix.
        let translation = Vector3::new(entries[3], entries[7], entries[11]);
        let deformed_positions =
            surface.positions[3 * domain_layout.first_vertex..][..3 * domain_layout.vertices].chunks_exact(3);
        scene.shapes[domain.shape].mesh.rest_positions().iter().zip(deformed_positions).map(
            move |(x0, deformed_position)| {
                let x = Vector3::from_fn(|axis, _| f64::from(deformed_position[axis]));
                let displacement = x - linear * Vector3::from(*x0).cast::<f64>() - translation;
                (scene.unit * displacement.norm()) as f32
            },
        )
    });
    magnitudes.collect()
}

/// The displacement of every vertex in meters per unit of the coordinate, before T: the norm of the vertex's three
/// entries in one column of U, times the scene's unit. Zero in domains without the mode.
pub(in crate::engine) fn mode_shape_magnitudes(scene: &Scene, mode: usize) -> Vec<f32> {
    let magnitudes = scene.domains.par_iter().zip(&scene.layout.domains).flat_map_iter(|(domain, domain_layout)| {
        let modes = &scene.shapes[domain.shape].modes;
        let column = if mode < modes.rank() { modes.column(mode) } else { &[] };
        let norm = |mode_vector: &[f32]| Vector3::from_column_slice(mode_vector).cast::<f64>().norm();
        let norms = column.chunks_exact(3).map(move |mode_vector| (scene.unit * norm(mode_vector)) as f32);
        norms.chain(std::iter::repeat(0.0)).take(domain_layout.vertices)
    });
    magnitudes.collect()
}

/// The legend of a color map of these values. The scale ends at the value in `frame_output`. If that is 0, the scale is
/// fitted to the largest value.
pub(in crate::engine) fn fit_legend(scene: &Scene, frame_output: FrameOutput, values: &[f32]) -> Legend {
    let max_value = f64::from(values.iter().copied().fold(0.0, f32::max));
    let (title, requested_max, min_scale_max) = match frame_output {
        FrameOutput::ModeShape { mode, scale_max } => {
            (format!("shape of mode {}, m per unit of q", mode + 1), scale_max, MIN_SCALE)
        }
        FrameOutput::Displacement { scale_max } => (
            "displacement |u|, m".to_owned(),
            scale_max,
            MIN_SCALE_FRACTION * scene.unit * scene.rest_bounds.diagonal(),
        ),
        _ => (String::new(), 0.0, MIN_SCALE),
    };
    let scale_max = if requested_max > 0.0 { requested_max } else { round_up_scale(max_value.max(min_scale_max)) };
    Legend { title, scale_max: scale_max.clamp(MIN_SCALE, MAX_SCALE) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::testing;
    use modalcast_compute::reference;

    /// The second strip is rotated, scaled by 2 and deformed by its first mode. The first strip is at rest.
    #[test]
    fn displacements_and_mode_shapes_match_the_entries_of_u() {
        let scene = testing::two_strips();
        let mut state = SceneState::rest(&scene);
        let rotation = nalgebra::Rotation3::from_euler_angles(0.4, 1.0, -0.3).into_inner();
        state.transforms[1] =
            modalcast_model::domain::Transform::from_parts(&(2.0 * rotation), &Vector3::new(5.0, -3.0, 1.0));
        state.q[scene.layout.domains[1].first_q] = 0.75;
        let positions = reference::deform(&scene, &state).into_flattened();
        let surface =
            DeformedSurface { positions: positions.iter().map(|x| *x as f32).collect(), ..DeformedSurface::default() };
        let displacements = displacement_magnitudes(&scene, &state, &surface);
        let mode_shape = mode_shape_magnitudes(&scene, 0);
        let modes = &scene.shapes[0].modes;
        let mut max_displacement = 0.0_f32;
        for vertex in 0..4 {
            let mode_vector = Vector3::from_fn(|axis, _| modes.entry(vertex, axis, 0));
            let second_strip_vertex = 4 + vertex;
            assert!((mode_shape[vertex] - mode_vector.norm()).abs() < 1e-6);
            assert_eq!(mode_shape[second_strip_vertex], mode_shape[vertex]);
            assert!(displacements[vertex] < 1e-6, "expected the first strip at rest, got {displacements:?}");
            // The scale of the transform times the coordinate.
            let expected = 2.0 * 0.75 * mode_vector.norm();
            let displacement = displacements[second_strip_vertex];
            assert!((displacement - expected).abs() < 2e-6, "expected {expected}, got {displacement}");
            max_displacement = max_displacement.max(displacement);
        }
        assert!(max_displacement > 0.5, "control: expected a displacement, got {max_displacement}");
        let legend_max = |scale_max: f64, displacements: &[f32]| {
            fit_legend(&scene, FrameOutput::Displacement { scale_max }, displacements).scale_max
        };
        let fitted_max = legend_max(0.0, &displacements);
        // The scale ends at 1, 2, 2.5 or 5 times a power of ten. These ends differ by at most a factor of 2, so the end
        // is at most 2 times the largest value. The limit of 2.5 times leaves a margin.
        assert!(fitted_max >= f64::from(max_displacement) && fitted_max <= 2.5 * f64::from(max_displacement));
        assert_eq!(legend_max(3.0, &displacements), 3.0);
        let max_of_rounding_errors = legend_max(0.0, &[1e-9]);
        assert!(max_of_rounding_errors > 1e-6, "expected the lower bound, got {max_of_rounding_errors}");
        assert!(mode_shape_magnitudes(&scene, 7).iter().all(|norm| *norm == 0.0));
    }

    #[test]
    fn mode_beyond_the_largest_rank_is_rejected() {
        let scene = testing::two_strips();
        validate_mode(&scene, 1).expect("expected the second of two modes to be valid");
        validate_mode(&scene, 2).expect_err("expected an error for a third mode");
    }
}
