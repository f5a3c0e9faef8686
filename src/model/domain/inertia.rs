//! The mass properties of a domain's own material, for clients that couple domains.

use nalgebra::DMatrix;

use crate::error::{Result, invalid};

/// Rounding errors of the masses, as a fraction of the masses on the diagonal.
const MASS_ROUNDING: f64 = 1e-6;

/// The kinetic energy of a domain that moves by R X + U q: 1/2 [X', q']^T [[R^T M R, R^T M U], [U^T M R, U^T M U]] [X', q'].
/// X is the small motion of the domain's frame (translation of the origin, then rotation vector, in its own axes), R the
/// six rigid motions about the origin, and M the mass of the domain without the domains that are attached to it.
#[derive(Debug, Clone, PartialEq)]
pub struct Inertia {
    mass: f64,
    center: [f64; 3],
    moments: [f64; 6],
    modal_momenta: Vec<f64>,
    modal_masses: Vec<f64>,
}

impl Inertia {
    /// Checks and stores the properties. `mass` is in kg; `center` is the center of mass at rest; `moments` are the
    /// entries xx, yy, zz, xy, xz, yz of the inertia tensor about the frame's origin (kg scene units^2);
    /// `modal_momenta` is R^T M U, 6 x r row-major; `modal_masses` is U^T M U, r x r row-major.
    ///
    /// # Errors
    /// `Invalid` unless all numbers are finite, the lengths belong to one number of modes r, and the matrix of all masses
    /// is symmetric and positive semidefinite up to rounding errors.
    pub fn new(
        mass: f64,
        center: [f64; 3],
        moments: [f64; 6],
        modal_momenta: Vec<f64>,
        modal_masses: Vec<f64>,
    ) -> Result<Self> {
        let rank = modal_momenta.len() / 6;
        if modal_momenta.len() != 6 * rank || modal_masses.len() != rank * rank {
            let given = format!("{} and {} numbers", modal_momenta.len(), modal_masses.len());
            return Err(invalid("modal_momenta, modal_masses", "6 r and r^2 numbers", given));
        }
        let numbers = [mass].into_iter().chain(center).chain(moments);
        let mut numbers = numbers.chain(modal_momenta.iter().copied()).chain(modal_masses.iter().copied());
        if let Some(number) = numbers.find(|number| !number.is_finite()) {
            return Err(invalid("inertia", "finite numbers", number));
        }
        let inertia = Self { mass, center, moments, modal_momenta, modal_masses };
        inertia.check_masses()?;
        Ok(inertia)
    }

    /// r, the number of modes.
    pub const fn rank(&self) -> usize {
        self.modal_momenta.len() / 6
    }

    /// Mass in kg.
    pub const fn mass(&self) -> f64 {
        self.mass
    }

    /// Center of mass at rest, in the domain's frame and scene units.
    pub const fn center(&self) -> [f64; 3] {
        self.center
    }

    /// Entries xx, yy, zz, xy, xz, yz of the inertia tensor about the frame's origin, in kg scene units^2.
    pub const fn moments(&self) -> [f64; 6] {
        self.moments
    }

    /// R^T M U, 6 x r row-major: momentum, and angular momentum about the origin, per unit rate of each coordinate.
    pub fn modal_momenta(&self) -> &[f64] {
        &self.modal_momenta
    }

    /// U^T M U, r x r row-major.
    pub fn modal_masses(&self) -> &[f64] {
        &self.modal_masses
    }

    /// R^T M R, R^T M U and U^T M U as one matrix with 6 + r rows.
    pub fn mass_matrix(&self) -> DMatrix<f64> {
        let rank = self.rank();
        let [xx, yy, zz, xy, xz, yz] = self.moments;
        let tensor = nalgebra::Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz);
        let moment = (nalgebra::Vector3::from(self.center) * self.mass).cross_matrix();
        let mut matrix = DMatrix::zeros(6 + rank, 6 + rank);
        matrix.fixed_view_mut::<3, 3>(0, 0).fill_diagonal(self.mass);
        matrix.fixed_view_mut::<3, 3>(0, 3).copy_from(&-moment);
        matrix.fixed_view_mut::<3, 3>(3, 0).copy_from(&moment);
        matrix.fixed_view_mut::<3, 3>(3, 3).copy_from(&tensor);
        let momenta = DMatrix::from_row_slice(6, rank, &self.modal_momenta);
        matrix.view_mut((6, 0), (rank, 6)).copy_from(&momenta.transpose());
        matrix.view_mut((0, 6), (6, rank)).copy_from(&momenta);
        matrix.view_mut((6, 6), (rank, rank)).copy_from(&DMatrix::from_row_slice(rank, rank, &self.modal_masses));
        matrix
    }

    /// Checks that the matrix of all masses, scaled to a unit diagonal, is symmetric and positive semidefinite.
    fn check_masses(&self) -> Result<()> {
        let matrix = self.mass_matrix();
        if let Some(mass) = matrix.diagonal().iter().find(|mass| **mass < 0.0) {
            return Err(invalid("inertia", "masses and moments of at least 0", mass));
        }
        let scale = matrix.diagonal().map(|mass| if mass > 0.0 { mass.sqrt().recip() } else { 0.0 });
        let is_massless = |index: usize| scale[index] == 0.0;
        let has_momentum = |index: usize| matrix.row(index).iter().any(|entry| *entry != 0.0);
        if (0..matrix.nrows()).any(|index| is_massless(index) && has_momentum(index)) {
            return Err(invalid("inertia", "no momentum of a motion without mass", "a momentum"));
        }
        let scaled = DMatrix::from_fn(matrix.nrows(), matrix.nrows(), |row, column| {
            matrix[(row, column)] * scale[row] * scale[column]
        });
        let asymmetry = (&scaled - scaled.transpose()).amax();
        if asymmetry > MASS_ROUNDING {
            return Err(invalid(
                "modal_masses",
                "a symmetric matrix",
                format!("relative differences of {asymmetry:.1e}"),
            ));
        }
        let lowest = scaled.symmetric_eigenvalues().min();
        if lowest < -MASS_ROUNDING * matrix.nrows() as f64 {
            return Err(invalid("inertia", "a positive semidefinite mass", format!("the relative mass {lowest:.1e}")));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The arguments of [`Inertia::new`].
    type Parts = (f64, [f64; 3], [f64; 6], Vec<f64>, Vec<f64>);

    /// Two modes of a body of 2 kg, whose masses are those of three points.
    fn parts() -> Parts {
        let points = [([0.0, 0.0, 0.0], 0.5), ([1.0, 0.0, 0.2], 1.0), ([0.0, 2.0, -1.0], 0.5)];
        let mut motions = DMatrix::zeros(9, 8);
        for (index, (x, _)) in points.iter().enumerate() {
            motions.view_mut((3 * index, 0), (3, 3)).fill_with_identity();
            let x = nalgebra::Vector3::from(*x);
            motions.view_mut((3 * index, 3), (3, 3)).copy_from(&-x.cross_matrix());
            for (axis, mode) in (0..3).flat_map(|axis| (0..2).map(move |mode| (axis, mode))) {
                motions[(3 * index + axis, 6 + mode)] = (1.3 * (3 * index + axis + 7 * mode) as f64).sin();
            }
        }
        let masses = DMatrix::from_diagonal(&nalgebra::DVector::from_fn(9, |row, _| points[row / 3].1));
        let matrix = motions.transpose() * masses * motions;
        let entry = |row: usize, column: usize| matrix[(row, column)];
        (
            entry(0, 0),
            [entry(5, 1), entry(3, 2), entry(4, 0)].map(|moment| moment / entry(0, 0)),
            [entry(3, 3), entry(4, 4), entry(5, 5), entry(3, 4), entry(3, 5), entry(4, 5)],
            (0..12).map(|index| entry(index / 2, 6 + index % 2)).collect(),
            (0..4).map(|index| entry(6 + index / 2, 6 + index % 2)).collect(),
        )
    }

    #[test]
    fn mass_matrix_has_all_parts_at_their_places() {
        let (mass, center, moments, momenta, masses) = parts();
        let matrix = Inertia::new(mass, center, moments, momenta.clone(), masses.clone()).expect("valid").mass_matrix();
        assert!((matrix.clone() - matrix.transpose()).amax() < 1e-12);
        assert_eq!(
            (matrix[(0, 0)], matrix[(2, 2)], matrix[(6, 7)], matrix[(5, 6)]),
            (mass, mass, masses[1], momenta[10])
        );
        // A rotation about z moves the center of mass by z x c.
        assert!((matrix[(0, 5)] + mass * center[1]).abs() < 1e-12 && (matrix[(1, 5)] - mass * center[0]).abs() < 1e-12);
        assert!(matrix.symmetric_eigenvalues().min() > -1e-9);
    }

    #[test]
    fn inconsistent_masses_are_rejected() {
        let message = |change: &dyn Fn(&mut Parts)| {
            let mut parts = parts();
            change(&mut parts);
            let (mass, center, moments, momenta, masses) = parts;
            Inertia::new(mass, center, moments, momenta, masses)
                .map_or_else(|error| error.to_string(), |_| String::new())
        };
        assert_eq!(message(&|_| ()), "");
        for (actual, start) in [
            (message(&|parts| parts.0 = -1.0), "inertia: expected masses and moments of at least 0"),
            (message(&|parts| parts.0 = 0.0), "inertia: expected no momentum of a motion without mass"),
            (message(&|parts| parts.1[2] = f64::NAN), "inertia: expected finite numbers"),
            (message(&|parts| parts.1[2] = 50.0), "inertia: expected a positive semidefinite mass"),
            (message(&|parts| parts.3.truncate(11)), "modal_momenta, modal_masses: expected 6 r and r^2 numbers"),
            (message(&|parts| parts.4.truncate(3)), "modal_momenta, modal_masses: expected 6 r and r^2 numbers"),
            (message(&|parts| parts.3[0] += 9.0), "inertia: expected a positive semidefinite mass"),
            (message(&|parts| parts.4[1] += 0.1), "modal_masses: expected a symmetric matrix"),
        ] {
            assert!(actual.starts_with(start), "expected {start}, got {actual:?}");
        }
    }
}
