//! An independent model of the parts of the tree, against which their modes are tested: a fine frame of uniform
//! Euler-Bernoulli elements with point masses at nodes, assembled densely. It shares only the geometry and the masses
//! with `beam` and `element`: its matrices are in closed form and use vectors instead of local axes.

use nalgebra::{Cholesky, DMatrix, Matrix3, Matrix3xX, Matrix4, Vector3};

use super::template::PartTemplate;

/// A frame with a node at each ring, at each carried mass, and between them.
pub(super) struct FrameModel {
    stiffness: DMatrix<f64>,
    mass: DMatrix<f64>,
}

/// A position on the centerline: the index of the ring before it, and the fraction of the distance to the next ring.
fn ring_coordinate(station: super::skin_modes::Station) -> f64 {
    station.element as f64 + station.fraction
}

impl FrameModel {
    /// Builds the frame with `subdivisions` elements between two rings.
    pub(super) fn new(template: &PartTemplate, subdivisions: usize) -> Self {
        let last_ring = template.centerline.points.len() - 1;
        let mut coordinates: Vec<f64> =
            (0..=last_ring * subdivisions).map(|index| index as f64 / subdivisions as f64).collect();
        coordinates.extend(template.point_masses.iter().map(|(station, _)| ring_coordinate(*station)));
        coordinates.sort_by(f64::total_cmp);
        coordinates.dedup_by(|a, b| (*a - *b).abs() < 1e-6);
        let before = |coordinate: f64| (coordinate.floor() as usize).min(last_ring - 1);
        let position = |coordinate: f64| {
            let ring = before(coordinate);
            let points = &template.centerline.points;
            points[ring].lerp(&points[ring + 1], coordinate - ring as f64)
        };
        let radius = |coordinate: f64| {
            let ring = before(coordinate);
            let weight = coordinate - ring as f64;
            template.radii[ring] * (1.0 - weight) + template.radii[ring + 1] * weight
        };
        let free_dofs = 6 * (coordinates.len() - 1);
        let (mut stiffness, mut mass) = (DMatrix::zeros(free_dofs, free_dofs), DMatrix::zeros(free_dofs, free_dofs));
        for (element, ends) in coordinates.windows(2).enumerate() {
            let axis = position(ends[1]) - position(ends[0]);
            let (k, m) = uniform_element(template, &axis, radius(0.5 * (ends[0] + ends[1])));
            for (matrix, block) in [(&mut stiffness, k), (&mut mass, m)] {
                add_free_block(matrix, element, &block);
            }
        }
        for (station, carried_mass) in &template.point_masses {
            let distance = |node: &usize| (coordinates[*node] - ring_coordinate(*station)).abs();
            let node = (0..coordinates.len()).min_by(|a, b| distance(a).total_cmp(&distance(b))).expect("a node");
            for axis in 0..3 {
                mass[(6 * node - 6 + axis, 6 * node - 6 + axis)] += carried_mass;
            }
        }
        Self { stiffness, mass }
    }

    /// The lowest frequencies in hertz, ascending.
    pub(super) fn frequencies(self, count: usize) -> Vec<f64> {
        // 1 / omega^2 are the eigenvalues of L^-1 M L^-T with K = L L^T.
        let factor = Cholesky::new(self.stiffness).expect("a positive definite stiffness").unpack();
        let half_transformed = factor.solve_lower_triangular(&self.mass).expect("a regular factor");
        let transformed = factor.solve_lower_triangular(&half_transformed.transpose()).expect("a regular factor");
        let mut inverse_eigenvalues: Vec<f64> = transformed.symmetric_eigenvalues().iter().copied().collect();
        inverse_eigenvalues.sort_by(|a, b| b.total_cmp(a));
        inverse_eigenvalues[..count].iter().map(|mu| mu.sqrt().recip() / std::f64::consts::TAU).collect()
    }
}

/// Adds the 12 x 12 matrix of an element. The node 0 is clamped.
fn add_free_block(matrix: &mut DMatrix<f64>, element: usize, block: &DMatrix<f64>) {
    for (row, column) in (0..12).flat_map(|row| (0..12).map(move |column| (row, column))) {
        if let (Some(free_row), Some(free_column)) =
            ((6 * element + row).checked_sub(6), (6 * element + column).checked_sub(6))
        {
            matrix[(free_row, free_column)] += block[(row, column)];
        }
    }
}

/// Stiffness and consistent mass of a uniform element along `axis`. With the unit tangent t, the transverse
/// displacement is (I - t t^T) u, and its slope is theta x t, so that the textbook matrices of a plane beam apply to
/// vectors (Craig and Kurdila, "Fundamentals of Structural Dynamics", section 14.2).
fn uniform_element(template: &PartTemplate, axis: &Vector3<f64>, radius: f64) -> (DMatrix<f64>, DMatrix<f64>) {
    let (length, tangent) = (axis.norm(), axis.normalize());
    let (area, moment) = (std::f64::consts::PI * radius.powi(2), std::f64::consts::FRAC_PI_4 * radius.powi(4));
    let along = tangent * tangent.transpose();
    let transverse = Matrix3::identity() - along;
    let slope_of_rotation = -tangent.cross_matrix();
    let elastic = &template.elastic;
    let (l, line_mass) = (length, elastic.density * area);
    #[rustfmt::skip]
    let bending = Matrix4::new(
        12.0,    6.0 * l,     -12.0,    6.0 * l,
        6.0 * l, 4.0 * l * l, -6.0 * l, 2.0 * l * l,
        -12.0,   -6.0 * l,    12.0,     -6.0 * l,
        6.0 * l, 2.0 * l * l, -6.0 * l, 4.0 * l * l,
    ) * (elastic.youngs_modulus * moment / l.powi(3));
    #[rustfmt::skip]
    let bending_mass = Matrix4::new(
        156.0,     22.0 * l,     54.0,      -13.0 * l,
        22.0 * l,  4.0 * l * l,  13.0 * l,  -3.0 * l * l,
        54.0,      13.0 * l,     156.0,     -22.0 * l,
        -13.0 * l, -3.0 * l * l, -22.0 * l, 4.0 * l * l,
    ) * (line_mass * l / 420.0);
    let vectors = [transverse, slope_of_rotation, transverse, slope_of_rotation];
    let (mut stiffness, mut mass) = (DMatrix::zeros(12, 12), DMatrix::zeros(12, 12));
    let add = |matrix: &mut DMatrix<f64>, row: usize, column: usize, block: Matrix3<f64>| {
        let mut view = matrix.view_mut((3 * row, 3 * column), (3, 3));
        view += block;
    };
    for (row, column) in (0..4).flat_map(|row| (0..4).map(move |column| (row, column))) {
        let directions = vectors[row].transpose() * vectors[column];
        add(&mut stiffness, row, column, directions * bending[(row, column)]);
        add(&mut mass, row, column, directions * bending_mass[(row, column)]);
    }
    // Vectors 0 and 2 are displacements, which stretch; vectors 1 and 3 are rotations, which twist.
    let twist_stiffness = elastic.shear_modulus * 2.0 * moment / l;
    let stretch_stiffness = elastic.youngs_modulus * area / l;
    for (first, stiffness_factor, mass_factor) in
        [(0, stretch_stiffness, line_mass * l / 6.0), (1, twist_stiffness, elastic.density * 2.0 * moment * l / 6.0)]
    {
        for (row, column, sign, weight) in [(0, 0, 1.0, 2.0), (0, 2, -1.0, 1.0), (2, 0, -1.0, 1.0), (2, 2, 1.0, 2.0)] {
            add(&mut stiffness, first + row, first + column, along * (sign * stiffness_factor));
            add(&mut mass, first + row, first + column, along * (weight * mass_factor));
        }
    }
    (stiffness, mass)
}

mod tests {
    use super::super::random::SplitMix64;
    use super::super::skin_modes::{Station, section_motion};
    use super::super::species::grow_templates;
    use super::*;

    /// The trunk, the longest and the shortest bough, three twigs, and all flexible leaf clusters, each with the number
    /// of fine elements between two rings. Clusters have 4 intervals between rings, twigs 10, boughs 24, the trunk 48.
    fn tested_templates() -> Vec<(PartTemplate, usize)> {
        let templates = grow_templates(&mut SplitMix64::new(7));
        let mut flexible: Vec<_> = templates.into_iter().filter(|template| template.rank > 0).collect();
        flexible.sort_by(|a, b| a.centerline.length().total_cmp(&b.centerline.length()));
        let of_level = |level: Option<usize>| {
            flexible.iter().filter(|template| template.level == level).cloned().collect::<Vec<_>>()
        };
        let (clusters, twigs, boughs, trunk) =
            (of_level(None), of_level(Some(2)), of_level(Some(1)), of_level(Some(0)));
        let mut tested: Vec<_> = clusters.into_iter().map(|cluster| (cluster, 10)).collect();
        tested.extend([0, 5, twigs.len() - 1].map(|index| (twigs[index].clone(), 8)));
        tested.extend([0, boughs.len() - 1].map(|index| (boughs[index].clone(), 2)));
        tested.extend(trunk.into_iter().map(|trunk| (trunk, 2)));
        tested
    }

    #[test]
    fn frequencies_agree_with_a_fine_frame() {
        for (template, subdivisions) in tested_templates() {
            let modes = template.beam().solve_modes(template.rank).expect("a converged solution");
            let expected = FrameModel::new(&template, subdivisions).frequencies(template.rank);
            let errors: Vec<f64> = modes
                .eigenvalues
                .iter()
                .zip(&expected)
                .map(|(eigenvalue, hertz)| eigenvalue.sqrt() / std::f64::consts::TAU / hertz - 1.0)
                .collect();
            let case = format!("level {:?}, {:.2} m: {errors:.4?}", template.level, template.centerline.length());
            println!("{case} {expected:.2?}");
            assert!(errors.iter().all(|error| error.abs() <= 5e-3), "{case}");
        }
    }

    /// U^T M U: the integral of the products of velocities over all sections by the midpoint rule with many points per
    /// element, and the carried masses.
    fn gram_matrix(template: &PartTemplate, mode_shapes: &DMatrix<f64>) -> DMatrix<f64> {
        // A multiple of every number of elements between two rings in the tested templates.
        const POINTS: usize = 168;
        let (beam, parts) = (template.beam(), template.elements_per_ring());
        let points = &template.centerline.points;
        let columns: Vec<Vec<f64>> = mode_shapes.column_iter().map(|column| column.iter().copied().collect()).collect();
        // Translations and rotations of all modes as 3 x r.
        let motions = |station: Station| {
            let motions: Vec<_> =
                columns.iter().map(|dofs| section_motion(&beam.nodes, dofs, station.subdivide(parts))).collect();
            let translations: Vec<_> = motions.iter().map(|motion| motion.translation).collect();
            let rotations: Vec<_> = motions.iter().map(|motion| motion.rotation).collect();
            (Matrix3xX::from_columns(&translations), Matrix3xX::from_columns(&rotations))
        };
        let mut gram = DMatrix::zeros(columns.len(), columns.len());
        for element in 0..points.len() - 1 {
            let axis = points[element + 1] - points[element];
            for index in 0..POINTS {
                let fraction = (index as f64 + 0.5) / POINTS as f64;
                let radius = template.radii[element] * (1.0 - fraction) + template.radii[element + 1] * fraction;
                let (area, moment) =
                    (std::f64::consts::PI * radius.powi(2), std::f64::consts::FRAC_PI_4 * radius.powi(4));
                let (translations, rotations) = motions(Station { element, fraction });
                let twists = axis.normalize().transpose() * rotations;
                let factor = template.elastic.density * axis.norm() / POINTS as f64;
                gram += (translations.tr_mul(&translations) * area + twists.tr_mul(&twists) * (2.0 * moment)) * factor;
            }
        }
        for (station, mass) in &template.point_masses {
            let translations = motions(*station).0;
            gram += translations.tr_mul(&translations) * *mass;
        }
        gram
    }

    #[test]
    fn modes_are_mass_orthonormal() {
        for (template, _) in tested_templates() {
            let mode_shapes = template.beam().solve_modes(template.rank).expect("a converged solution").mode_shapes;
            let identity = DMatrix::identity(template.rank, template.rank);
            let error = (gram_matrix(&template, &mode_shapes) - &identity).abs().max();
            println!("level {:?}: U^T M U - I {error:.2e}", template.level);
            assert!(error <= 1e-6, "level {:?}: {error}", template.level);
            // Counterexample: a carried mass that the modes do not account for.
            let mut heavier = template.clone();
            heavier.point_masses.iter_mut().for_each(|(_, mass)| *mass *= 1.01);
            assert!((gram_matrix(&heavier, &mode_shapes) - &identity).abs().max() > 1e-4);
        }
    }
}
