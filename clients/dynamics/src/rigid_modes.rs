//! Finds the modes of a domain that are rigid motions. They have no stiffness and would drift without bound, so they
//! are held still.
//!
//! Solvers return the eigenvalues of rigid motions as rounding errors. A soft mode of a stiff domain may have an
//! eigenvalue of the same size, so the eigenvalues alone do not distinguish them. The note `rigid_modes` of the domain
//! decides. Without it, the column of U of a rigid mode must also move each connected part of the mesh like a rigid
//! body.

use nalgebra::{Matrix3, Vector3};

use crate::error::{Result, invalid_input};
use crate::model::{DomainModel, Sample};

/// Name of the note with the number of rigid modes of a domain: those with the smallest eigenvalues.
const NOTE: &str = "rigid_modes";

/// Largest magnitude of the eigenvalue of a rigid mode, as a fraction of the largest eigenvalue of its domain. Smaller
/// negative eigenvalues are rounding errors.
const ZERO_TOLERANCE: f64 = 1e-9;

/// Smallest ratio of the next larger eigenvalue to that of a rigid mode.
const MIN_GAP: f64 = 1e3;

/// Largest number of rigid modes of a connected part: three translations and three rotations.
const RIGID_MODES_PER_PART: usize = 6;

/// Largest difference of a rigid mode from the motion of rigid bodies, as a fraction of its norm. An elastic mode of a
/// free body is orthogonal to all rigid motions; the tolerance allows for solvers that stop early.
const RIGIDITY_TOLERANCE: f64 = 1e-2;

/// Per mode: whether it is held still, because it has no stiffness. Without eigenvalues, all modes are.
///
/// # Errors
/// `Invalid` if an eigenvalue is not finite or negative; if the note `rigid_modes` is not a number of modes; or if a
/// mode has an eigenvalue of 0 or below, but is none of the rigid modes that the note counts.
pub(crate) fn find_held_modes(domain: &DomainModel) -> Result<Vec<bool>> {
    let eigenvalues = &domain.eigenvalues;
    if eigenvalues.is_empty() {
        return Ok(vec![true; domain.rank]);
    }
    if eigenvalues.len() != domain.rank {
        let field = format!("eigenvalues of '{}'", domain.name);
        let expected = format!("{} numbers, one per mode", domain.rank);
        return Err(invalid_input(field, expected, format!("{} numbers", eigenvalues.len())));
    }
    let tolerance = ZERO_TOLERANCE * eigenvalues.iter().fold(0.0, |largest: f64, value| largest.max(value.abs()));
    let invalid_eigenvalue = |mode: usize, expected: String| {
        invalid_input(format!("eigenvalues[{mode}] of '{}'", domain.name), expected, eigenvalues[mode])
    };
    if let Some(mode) = eigenvalues.iter().position(|value| !value.is_finite() || *value < -tolerance) {
        return Err(invalid_eigenvalue(mode, "a finite number >= 0 in (rad/s)^2: a stiffness".into()));
    }
    let mut modes_by_stiffness: Vec<usize> = (0..domain.rank).collect();
    modes_by_stiffness.sort_by(|a, b| eigenvalues[*a].abs().total_cmp(&eigenvalues[*b].abs()));
    let noted_count = read_note(domain)?;
    let rigid_modes = match noted_count {
        Some(count) => modes_by_stiffness[..count].to_vec(),
        None => select_rigid_modes(domain, &modes_by_stiffness, tolerance),
    };
    let mut is_held = vec![false; domain.rank];
    rigid_modes.into_iter().for_each(|mode| is_held[mode] = true);
    for (mode, is_held) in is_held.iter_mut().enumerate().filter(|(mode, _)| eigenvalues[*mode] <= 0.0) {
        if let (Some(count), false) = (noted_count, *is_held) {
            return Err(invalid_eigenvalue(mode, format!("a number > 0, because the note {NOTE} is {count}")));
        }
        *is_held = true;
    }
    Ok(is_held)
}

/// The number in the note; `None` without the note.
fn read_note(domain: &DomainModel) -> Result<Option<usize>> {
    let Some(text) = domain.notes.get(NOTE) else { return Ok(None) };
    let count = text.trim().parse().ok().filter(|count| *count <= domain.rank);
    let expected = || format!("a number of modes, 0 to {}", domain.rank);
    count
        .map(Some)
        .ok_or_else(|| invalid_input(format!("{NOTE} of '{}'", domain.name), expected(), format!("'{text}'")))
}

/// The rigid modes of a domain without the note: at most six per connected part, with eigenvalues up to `tolerance` and
/// below a gap.
fn select_rigid_modes(domain: &DomainModel, modes_by_stiffness: &[usize], tolerance: f64) -> Vec<usize> {
    let stiffness = |mode: &usize| domain.eigenvalues[*mode].abs();
    let is_below_gap = |ordinal: usize| match modes_by_stiffness.get(ordinal + 1) {
        Some(next_mode) => stiffness(next_mode) >= MIN_GAP * stiffness(&modes_by_stiffness[ordinal]),
        None => true,
    };
    let candidates = modes_by_stiffness.iter().enumerate();
    let mut candidates: Vec<(usize, usize)> = candidates
        .take_while(|(_, mode)| stiffness(mode) <= tolerance)
        .filter(|(_, mode)| is_rigid_motion(domain, **mode))
        .map(|(ordinal, mode)| (ordinal, *mode))
        .take(RIGID_MODES_PER_PART * domain.part_count)
        .collect();
    while candidates.pop_if(|(ordinal, _)| !is_below_gap(*ordinal)).is_some() {}
    candidates.into_iter().map(|(_, mode)| mode).collect()
}

/// Whether a mode moves the samples of each connected part like a rigid body.
fn is_rigid_motion(domain: &DomainModel, mode: usize) -> bool {
    let mut samples_by_part: Vec<Vec<&Sample>> = vec![];
    for sample in &domain.samples {
        samples_by_part.resize_with(samples_by_part.len().max(sample.part + 1), Vec::new);
        samples_by_part[sample.part].push(sample);
    }
    let displacement = |sample: &Sample| sample.column(mode, domain.rank);
    let norm_squared: f64 = domain.samples.iter().map(|sample| displacement(sample).norm_squared()).sum();
    let residual: f64 = samples_by_part.iter().map(|samples| rigid_residual(samples, displacement)).sum();
    residual <= RIGIDITY_TOLERANCE * RIGIDITY_TOLERANCE * norm_squared
}

/// The sum of the squared differences between displacements and the closest linearized rigid motion a + w x r, where r
/// is the position relative to the centroid. The translation a is the mean displacement, and the rotation w solves
/// sum(|r|^2 I - r r^T) w = sum(r x u).
fn rigid_residual(samples: &[&Sample], displacement: impl Fn(&Sample) -> Vector3<f64>) -> f64 {
    let count = samples.len().max(1) as f64;
    let centroid = samples.iter().map(|sample| sample.rest_position).sum::<Vector3<f64>>() / count;
    let translation = samples.iter().map(|sample| displacement(sample)).sum::<Vector3<f64>>() / count;
    let (mut inertia, mut moment) = (Matrix3::zeros(), Vector3::zeros());
    for sample in samples {
        let radius = sample.rest_position - centroid;
        inertia += Matrix3::from_diagonal_element(radius.norm_squared()) - radius * radius.transpose();
        moment += radius.cross(&(displacement(sample) - translation));
    }
    // Collinear samples do not define the rotation about their line. Rest positions are f32.
    let rotation =
        inertia.pseudo_inverse(1e-12 * inertia.trace()).map_or_else(|_| Vector3::zeros(), |inverse| inverse * moment);
    let difference = |sample: &&Sample| {
        let motion = translation + rotation.cross(&(sample.rest_position - centroid));
        (displacement(sample) - motion).norm_squared()
    };
    samples.iter().map(difference).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hierarchy::tests::four_domain_model;

    /// A column of U: the displacement at a rest position.
    type Column = fn(&Vector3<f64>) -> Vector3<f64>;

    const RIGID_COLUMNS: [Column; 6] = [
        |_| Vector3::x(),
        |_| Vector3::y(),
        |_| Vector3::z(),
        |x| Vector3::x().cross(x),
        |x| Vector3::y().cross(x),
        |x| Vector3::z().cross(x) + Vector3::new(0.1, 0.2, 0.0),
    ];

    const ELASTIC_COLUMNS: [Column; 6] = [
        |x| Vector3::new(x.y * x.y, -2.0 * x.x * x.y, 0.0),
        |x| Vector3::new(0.0, -2.0 * x.z * x.y, x.y * x.y),
        |x| Vector3::new(x.x, 0.0, 0.0),
        |x| Vector3::new(0.0, x.y, 0.0),
        |x| Vector3::new(x.z * x.y, 0.0, -x.x * x.y),
        |x| Vector3::new(x.y.powi(3), 0.0, 0.0),
    ];

    /// A domain of these modes at 27 points in `part_count` parts, which are 10 apart.
    fn domain(columns: &[Column], eigenvalues: &[f64], part_count: usize) -> DomainModel {
        let points = (0..27 * part_count).map(|index| {
            let [x, y, z] = [index % 3, index / 3 % 3, index / 9 % 3].map(|coordinate| coordinate as f64);
            (index / 27, Vector3::new(x + 10.0 * (index / 27) as f64, y, z))
        });
        let sample = |(part, rest_position): (usize, Vector3<f64>)| {
            let displacements: Vec<_> = columns.iter().map(|column| column(&rest_position)).collect();
            let row =
                |axis: usize| displacements.iter().map(move |displacement| displacement[axis]).collect::<Vec<_>>();
            Sample { rest_position, mode_rows: (0..3).flat_map(row).collect(), part }
        };
        DomainModel {
            rank: columns.len(),
            eigenvalues: eigenvalues.to_vec(),
            samples: points.map(sample).collect(),
            part_count,
            ..four_domain_model().domains.swap_remove(0)
        }
    }

    fn held(domain: &DomainModel) -> Vec<usize> {
        let is_held = find_held_modes(domain).expect("valid eigenvalues");
        (0..domain.rank).filter(|mode| is_held[*mode]).collect()
    }

    fn eigenvalue(hertz: f64) -> f64 {
        (std::f64::consts::TAU * hertz).powi(2)
    }

    /// Rounding errors of a solver, of either sign and size, before and after an elastic mode.
    #[test]
    fn rigid_motions_of_a_free_body_are_held() {
        let columns =
            [&RIGID_COLUMNS[..3], &ELASTIC_COLUMNS[..1], &RIGID_COLUMNS[3..], &ELASTIC_COLUMNS[1..2]].concat();
        let eigenvalues = [-3e-7, 1e-12, 2e-8, 1e6, 5e-8, 0.0, 4e-7, 1e9];
        assert_eq!(held(&domain(&columns, &eigenvalues, 1)), [0, 1, 2, 4, 5, 6]);
    }

    /// Eigenvalues of 1e-22 to 1e-12 of the largest one: smaller than rounding errors.
    #[test]
    fn soft_elastic_modes_move() {
        let eigenvalues = [1e-3, 0.5, 100.0, 1e4, 1e6, 1e8].map(eigenvalue);
        assert_eq!(held(&domain(&ELASTIC_COLUMNS, &eigenvalues, 1)), [0; 0]);
        // Control: rigid motions with the same eigenvalues are held, up to the largest that counts as 0.
        assert_eq!(held(&domain(&RIGID_COLUMNS, &eigenvalues, 1)), [0, 1, 2]);
    }

    #[test]
    fn modes_without_positive_eigenvalue_are_always_held() {
        assert_eq!(held(&domain(&ELASTIC_COLUMNS[..3], &[0.0, 30.0, -1e-12], 1)), [0, 2]);
        assert_eq!(held(&domain(&ELASTIC_COLUMNS[..3], &[], 1)), [0, 1, 2]);
    }

    /// A rigid motion on a soft spring: the next mode is not much stiffer.
    #[test]
    fn rigid_motion_without_gap_moves() {
        let columns = [RIGID_COLUMNS[0], ELASTIC_COLUMNS[0], ELASTIC_COLUMNS[1]];
        assert_eq!(held(&domain(&columns, &[1.0, 500.0, 1e12], 1)), [0; 0]);
        assert_eq!(held(&domain(&columns, &[1.0, 1000.0, 1e12], 1)), [0]);
    }

    /// A body has six rigid motions; the seventh is one on a soft spring.
    #[test]
    fn at_most_six_modes_of_a_part_are_rigid() {
        let columns = [&RIGID_COLUMNS[..], &RIGID_COLUMNS[..1], &ELASTIC_COLUMNS[..1]].concat();
        let eigenvalues = [1e-9, 2e-9, 3e-9, 4e-9, 5e-9, 6e-9, 1e-3, 1e9];
        assert_eq!(held(&domain(&columns, &eigenvalues, 1)), [0, 1, 2, 3, 4, 5]);
        assert_eq!(held(&domain(&columns, &eigenvalues, 2)), [0, 1, 2, 3, 4, 5, 6]);
    }

    /// The mode moves one of two parts only: a rigid motion of parts, but not of one body.
    #[test]
    fn rigid_motions_of_each_part_are_held() {
        let columns: [Column; 2] =
            [|x| if x.x > 5.0 { Vector3::z().cross(x) } else { Vector3::zeros() }, ELASTIC_COLUMNS[0]];
        let two_parts = domain(&columns, &[1e-9, 1e6], 2);
        assert_eq!(held(&two_parts), [0]);
        let mut one_part = two_parts;
        one_part.samples.iter_mut().for_each(|sample| sample.part = 0);
        assert_eq!(held(&one_part), [0; 0]);
    }

    #[test]
    fn note_decides_which_modes_are_rigid() {
        let read = |columns: &[Column], eigenvalues: &[f64], note: &str| {
            let mut domain = domain(columns, eigenvalues, 1);
            domain.notes.insert(NOTE.into(), note.into());
            find_held_modes(&domain).map_err(|error| error.to_string())
        };
        assert_eq!(read(&RIGID_COLUMNS[..2], &[1e-9, 1e6], "0"), Ok(vec![false, false]));
        assert_eq!(read(&ELASTIC_COLUMNS[..3], &[5.0, 1.0, 2.0], " 2 "), Ok(vec![false, true, true]));
        for note in ["4", "-1", "six", "", "1.5"] {
            let error = read(&ELASTIC_COLUMNS[..3], &[1.0, 2.0, 3.0], note).expect_err("an invalid note");
            assert!(error.contains("rigid_modes of 'beam'") && error.contains("0 to 3"), "{error}");
        }
        let error = read(&ELASTIC_COLUMNS[..2], &[1e6, -1e-9], "0").expect_err("a mode without stiffness");
        assert!(error.contains("eigenvalues[1] of 'beam'") && error.contains("rigid_modes is 0"), "{error}");
    }
}
