//! Per-vertex values for color maps: the displacement in a step, or the shape of one mode.

use nalgebra::Vector3;
use rayon::prelude::*;

use crate::engine::output::step_output::FrameOutput;
use crate::frame::{Legend, nice_ceiling};
use modalcast_model::deform::DeformedSurface;
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::{Scene, SceneState};

/// Lower bound of a fitted displacement scale, as a fraction of the scene's diagonal. Smaller displacements may be
/// rounding errors.
const MIN_DISPLACEMENT_SCALE: f64 = 1e-5;

/// Returns `mode` if at least one domain of the scene has a mode with this index.
///
/// # Errors
/// `Invalid` when every domain has fewer modes.
pub fn validate_mode(scene: &Scene, mode: u32) -> Result<u32> {
    let most = scene.layout.domains.iter().map(|slot| slot.rank).max().unwrap_or(0);
    match (mode as usize) < most {
        true => Ok(mode),
        false => Err(invalid("picture.mode", format!("an index below {most}"), mode)),
    }
}

/// |u| of every vertex in meters: the distance of its deformed position from T x0, its position in the rigid domain.
///
/// The error is that of the deformer's positions, because T x0 and the difference are computed in f64. The positions
/// are f32 relative to the domain's floating origin, so a vertex one kilometer from it has an error of up to 0.1
/// mm.
pub(in crate::engine) fn displacement_magnitudes(
    scene: &Scene,
    state: &SceneState,
    surface: &DeformedSurface,
) -> Vec<f32> {
    let domains = scene.domains.par_iter().zip(&scene.layout.domains).enumerate();
    let of_domain = domains.flat_map_iter(|(index, (domain, slot))| {
        let placed = state.composed_transform(scene, index);
        let (linear, entries) = (placed.linear(), placed.to_f64());
        let translation = Vector3::new(entries[3], entries[7], entries[11]);
        let deformed = surface.positions[3 * slot.first_vertex..][..3 * slot.vertices].chunks_exact(3);
        scene.shapes[domain.shape].mesh.rest_positions().iter().zip(deformed).map(move |(rest, deformed)| {
            let deformed = Vector3::from_fn(|axis, _| f64::from(deformed[axis]));
            let moved = deformed - linear * Vector3::from(*rest).cast::<f64>() - translation;
            (scene.unit * moved.norm()) as f32
        })
    });
    of_domain.collect()
}

/// The norm of every vertex's three entries of one column of U, times the scene's unit: the displacement in meters per
/// unit of the coordinate, before T. Zero in domains without the mode.
pub(in crate::engine) fn mode_shape_magnitudes(scene: &Scene, mode: usize) -> Vec<f32> {
    let of_domain = scene.domains.par_iter().zip(&scene.layout.domains).flat_map_iter(|(domain, slot)| {
        let modes = &scene.shapes[domain.shape].modes;
        let column = if mode < modes.rank() { modes.column(mode) } else { &[] };
        let length = |row: &[f32]| Vector3::from_column_slice(row).cast::<f64>().norm();
        let lengths = column.chunks_exact(3).map(move |row| (scene.unit * length(row)) as f32);
        lengths.chain(std::iter::repeat(0.0)).take(slot.vertices)
    });
    of_domain.collect()
}

/// The legend of a color map of these values. The end of the scale is that of `frame_output`, or is fitted to the largest
/// value if that is 0.
pub(in crate::engine) fn fit_legend(scene: &Scene, frame_output: FrameOutput, values: &[f32]) -> Legend {
    let most = f64::from(values.iter().copied().fold(0.0, f32::max));
    let (title, asked, least) = match frame_output {
        FrameOutput::ModeShape { mode, largest } => (format!("shape of mode {mode}, m per unit of q"), largest, 1e-30),
        FrameOutput::Displacement { largest } => (
            "displacement |u|, m".to_owned(),
            largest,
            MIN_DISPLACEMENT_SCALE * scene.unit * scene.rest_bounds.diagonal(),
        ),
        _ => (String::new(), 0.0, 1e-30),
    };
    let largest = if asked > 0.0 { asked } else { nice_ceiling(most.max(least)) };
    Legend { title, scale_max: largest.clamp(1e-30, 1e30) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::testing;
    use modalcast_compute::reference;

    #[test]
    fn displacements_are_those_of_u_whatever_the_placement_and_shapes_are_lengths_of_rows() {
        let scene = testing::two_strips();
        let mut state = SceneState::rest(&scene);
        let turn = nalgebra::Rotation3::from_euler_angles(0.4, 1.0, -0.3).into_inner();
        state.transforms[1] =
            modalcast_model::domain::Transform::from_parts(&(2.0 * turn), &Vector3::new(5.0, -3.0, 1.0));
        state.q[scene.layout.domains[1].first_q] = 0.75;
        let positions = reference::deform(&scene, &state).into_flattened();
        let surface =
            DeformedSurface { positions: positions.iter().map(|x| *x as f32).collect(), ..DeformedSurface::default() };
        let (moved, shape) = (displacement_magnitudes(&scene, &state, &surface), mode_shape_magnitudes(&scene, 0));
        let modes = &scene.shapes[0].modes;
        let mut largest = 0.0_f32;
        for vertex in 0..4 {
            let row = Vector3::from_fn(|axis, _| modes.entry(vertex, axis, 0));
            assert!((shape[vertex] - row.norm()).abs() < 1e-6 && shape[4 + vertex] == shape[vertex]);
            assert!(moved[vertex] < 1e-6, "the first strip rests: {moved:?}");
            assert!((moved[4 + vertex] - 2.0 * 0.75 * row.norm()).abs() < 2e-6, "{moved:?}");
            largest = largest.max(moved[4 + vertex]);
        }
        assert!(largest > 0.5, "control: something moves");
        let fitted = fit_legend(&scene, FrameOutput::Displacement { largest: 0.0 }, &moved).scale_max;
        assert!(fitted >= f64::from(largest) && fitted <= 2.5 * f64::from(largest));
        assert_eq!(fit_legend(&scene, FrameOutput::Displacement { largest: 3.0 }, &moved).scale_max, 3.0);
        assert!(
            fit_legend(&scene, FrameOutput::Displacement { largest: 0.0 }, &[1e-9]).scale_max > 1e-6,
            "rounding is no motion"
        );
        validate_mode(&scene, 1).expect("two modes");
        validate_mode(&scene, 2).expect_err("no third");
        assert!(mode_shape_magnitudes(&scene, 7).iter().all(|length| *length == 0.0));
    }
}
