//! The quadratic tetrahedron with ten nodes: shape functions, quadrature, stiffness and consistent mass. Its edges may be
//! curved (isoparametric element; Zienkiewicz, Taylor, Zhu: "The Finite Element Method: Its Basis and Fundamentals",
//! chapters 4 and 6). A linear tetrahedron is never used: it locks in bending.

use nalgebra::{Matrix3, Vector3};

use crate::materials::Material;

/// Nodes of an element: four corners, then the middles of [`EDGES`].
pub const NODES: usize = 10;
/// Rows of the stiffness matrix of an element.
pub const FREEDOMS: usize = 3 * NODES;
/// The corners of each edge. Node `4 + edge` is in its middle. This is the order of VTK.
pub const EDGES: [[usize; 2]; 6] = [[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]];
/// The corners of each face, counterclockwise when seen from outside of an element with a positive volume.
pub const FACES: [[usize; 3]; 4] = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]];

/// Positions of the nodes of an element, meters.
pub type Nodes = [Vector3<f64>; NODES];

/// A point of a quadrature rule.
#[derive(Debug, Clone, Copy)]
pub struct QuadraturePoint {
    /// Barycentric coordinates: the shares of the four corners.
    pub barycentric: [f64; 4],
    /// The weights of all points sum to 1/6, the volume of the reference element.
    pub weight: f64,
}

/// A rule with 14 points that is exact up to degree 5 (Walkington 2000: "Quadrature on simplices of arbitrary dimension").
/// For straight edges it is exact for stiffness (degree 2), mass (4) and the energy of a St. Venant-Kirchhoff material (4).
/// All weights are positive, so that the mass of a curved element is positive definite.
pub const RULE: [QuadraturePoint; 14] = {
    const A: f64 = 0.310_885_919_263_300_6;
    const A_WEIGHT: f64 = 0.018_781_320_953_002_643;
    const B: f64 = 0.092_735_250_310_891_22;
    const B_WEIGHT: f64 = 0.012_248_840_519_393_659;
    const C: f64 = 0.045_503_704_125_649_65;
    const D: f64 = 0.5 - C;
    const C_WEIGHT: f64 = 0.007_091_003_462_846_911;
    const fn point(barycentric: [f64; 4], weight: f64) -> QuadraturePoint {
        QuadraturePoint { barycentric, weight }
    }
    const E: f64 = 1.0 - 3.0 * A;
    const F: f64 = 1.0 - 3.0 * B;
    [
        point([E, A, A, A], A_WEIGHT),
        point([A, E, A, A], A_WEIGHT),
        point([A, A, E, A], A_WEIGHT),
        point([A, A, A, E], A_WEIGHT),
        point([F, B, B, B], B_WEIGHT),
        point([B, F, B, B], B_WEIGHT),
        point([B, B, F, B], B_WEIGHT),
        point([B, B, B, F], B_WEIGHT),
        point([C, C, D, D], C_WEIGHT),
        point([C, D, C, D], C_WEIGHT),
        point([C, D, D, C], C_WEIGHT),
        point([D, C, C, D], C_WEIGHT),
        point([D, C, D, C], C_WEIGHT),
        point([D, D, C, C], C_WEIGHT),
    ]
};

/// The shape functions of a straight or curved element at a quadrature point.
#[derive(Debug, Clone, Copy)]
pub struct ShapePoint {
    /// Value of each shape function.
    pub values: [f64; NODES],
    /// Gradient of each shape function at rest, 1/m: the gradient of a displacement u is `sum_i u_i gradients[i]^T`.
    pub gradients: [Vector3<f64>; NODES],
    /// The volume that the point represents: its weight times the Jacobian determinant, cubic meters. Those of all points
    /// sum to the volume of the element.
    pub volume: f64,
}

/// The matrices of an element.
#[derive(Debug, Clone)]
pub struct Tet10Matrices {
    /// Row-major, [`FREEDOMS`] squared; freedom `3 node + axis`. Newtons per meter.
    pub stiffness: Vec<f64>,
    /// Row-major, [`NODES`] squared; the same for all three axes. Kilograms.
    pub mass: Vec<f64>,
}

/// Values of the shape functions: L (2 L - 1) at corners, 4 L_a L_b in the middle of an edge.
pub fn shape_values(barycentric: [f64; 4]) -> [f64; NODES] {
    std::array::from_fn(|node| match node {
        0..4 => barycentric[node] * (2.0 * barycentric[node] - 1.0),
        _ => 4.0 * EDGES[node - 4].iter().map(|corner| barycentric[*corner]).product::<f64>(),
    })
}

/// Derivatives of the shape functions by the reference coordinates, which are the last three barycentric ones.
fn reference_gradients(barycentric: [f64; 4]) -> [Vector3<f64>; NODES] {
    let derivative = |node: usize, by: usize| match node {
        0..4 if node == by => 4.0 * barycentric[by] - 1.0,
        0..4 => 0.0,
        _ => match EDGES[node - 4] {
            [a, b] if a == by => 4.0 * barycentric[b],
            [a, b] if b == by => 4.0 * barycentric[a],
            _ => 0.0,
        },
    };
    // The first coordinate is 1 minus the others.
    std::array::from_fn(|node| Vector3::from_fn(|axis, _| derivative(node, axis + 1) - derivative(node, 0)))
}

/// The Jacobian matrix of the map from reference coordinates to positions: column k is the derivative by coordinate k,
/// meters.
pub fn jacobian(nodes: &Nodes, barycentric: [f64; 4]) -> Matrix3<f64> {
    let pairs = nodes.iter().zip(reference_gradients(barycentric));
    pairs.map(|(position, gradient)| position * gradient.transpose()).sum()
}

/// The shape functions at all points of [`RULE`]. `None` if the element is degenerate or inverted at one of them.
pub fn shape_points(nodes: &Nodes) -> Option<[ShapePoint; RULE.len()]> {
    let mut points =
        [ShapePoint { values: [0.0; NODES], gradients: [Vector3::zeros(); NODES], volume: 0.0 }; RULE.len()];
    for (point, QuadraturePoint { barycentric, weight }) in points.iter_mut().zip(RULE) {
        let jacobian = jacobian(nodes, barycentric);
        let determinant = jacobian.determinant();
        let inverse = jacobian.try_inverse().filter(|_| determinant > 0.0)?.transpose();
        *point = ShapePoint {
            values: shape_values(barycentric),
            gradients: reference_gradients(barycentric).map(|gradient| inverse * gradient),
            volume: weight * determinant,
        };
    }
    Some(points)
}

/// Stiffness and consistent mass. `None` if the element is degenerate or inverted.
///
/// Isotropic linear elasticity: K_ia,jb = lambda G_ab + mu G_ba + delta_ab mu sum_c G_cc, where G_ab is the integral of
/// dN_i/da dN_j/db.
pub fn matrices(nodes: &Nodes, material: &Material) -> Option<Tet10Matrices> {
    let points = shape_points(nodes)?;
    let (lambda, mu) = material.lame_parameters();
    let mut matrices = Tet10Matrices { stiffness: vec![0.0; FREEDOMS * FREEDOMS], mass: vec![0.0; NODES * NODES] };
    for i in 0..NODES {
        for j in i..NODES {
            let mut products = Matrix3::zeros();
            let mut mass = 0.0;
            for ShapePoint { values, gradients, volume } in &points {
                products += gradients[i] * gradients[j].transpose() * *volume;
                mass += material.density * volume * values[i] * values[j];
            }
            let block =
                products * lambda + products.transpose() * mu + Matrix3::from_diagonal_element(mu * products.trace());
            (matrices.mass[i * NODES + j], matrices.mass[j * NODES + i]) = (mass, mass);
            for a in 0..3 {
                for b in 0..3 {
                    matrices.stiffness[(3 * i + a) * FREEDOMS + 3 * j + b] = block[(a, b)];
                    matrices.stiffness[(3 * j + b) * FREEDOMS + 3 * i + a] = block[(a, b)];
                }
            }
        }
    }
    Some(matrices)
}

/// The nodes of an element with straight edges.
pub fn straight_nodes(corners: [Vector3<f64>; 4]) -> Nodes {
    std::array::from_fn(|node| match node {
        0..4 => corners[node],
        _ => EDGES[node - 4].map(|corner| corners[corner] / 2.0).iter().sum(),
    })
}

/// The signed volume of the tetrahedron with these corners, cubic meters. Positive if the last corner sees the first three
/// counterclockwise from inside.
pub fn signed_volume([a, b, c, d]: [Vector3<f64>; 4]) -> f64 {
    (b - a).cross(&(c - a)).dot(&(d - a)) / 6.0
}

#[cfg(test)]
mod tests {
    use super::*;

    fn corners() -> [Vector3<f64>; 4] {
        [[0.1, 0.0, 0.0], [1.2, 0.1, -0.1], [0.3, 0.9, 0.2], [0.2, 0.1, 1.1]].map(Vector3::from)
    }

    fn material() -> Material {
        Material::new(1e6, 0.3, 1000.0).expect("a material")
    }

    /// u^T K u of a displacement that is given at the nodes.
    fn energy(nodes: &Nodes, displacement: impl Fn(Vector3<f64>) -> Vector3<f64>) -> f64 {
        let matrices = matrices(nodes, &material()).expect("an element");
        let u: Vec<f64> = nodes.iter().flat_map(|node| <[f64; 3]>::from(displacement(*node))).collect();
        let row = |i: usize| (0..FREEDOMS).map(|j| matrices.stiffness[i * FREEDOMS + j] * u[j]).sum::<f64>();
        (0..FREEDOMS).map(|i| u[i] * row(i)).sum()
    }

    /// The integral of a product of powers of barycentric coordinates is 6 V a! b! c! d! / (a + b + c + d + 3)!.
    #[test]
    fn rule_is_exact_up_to_degree_five() {
        let factorial = |n: u32| (1..=n).map(f64::from).product::<f64>();
        let error = |powers: [u32; 4]| {
            let value = |point: &QuadraturePoint| {
                (0..4).map(|corner| point.barycentric[corner].powi(powers[corner] as i32)).product::<f64>()
            };
            let sum: f64 = RULE.iter().map(|point| point.weight * value(point)).sum();
            let exact = powers.map(factorial).iter().product::<f64>() / factorial(powers.iter().sum::<u32>() + 3);
            (sum / exact - 1.0).abs()
        };
        for powers in [[0, 0, 0, 0], [1, 0, 0, 0], [2, 1, 0, 0], [1, 1, 1, 1], [2, 2, 0, 0], [3, 1, 1, 0], [5, 0, 0, 0]]
        {
            assert!(error(powers) < 1e-13, "{powers:?}: {}", error(powers));
        }
        assert!(error([6, 0, 0, 0]) > 1e-4, "control: degree 6 is not exact");
    }

    #[test]
    fn shape_functions_are_one_at_their_node_and_reproduce_positions() {
        let nodes = straight_nodes(corners());
        for node in 0..NODES {
            let barycentric = std::array::from_fn(|corner| match node {
                0..4 => f64::from(u8::from(node == corner)),
                _ => f64::from(u8::from(EDGES[node - 4].contains(&corner))) / 2.0,
            });
            let values = shape_values(barycentric);
            for (other, value) in values.iter().enumerate() {
                assert!((value - f64::from(u8::from(node == other))).abs() < 1e-15, "{values:?}");
            }
        }
        let barycentric = [0.1, 0.2, 0.3, 0.4];
        let weighted = |positions: &[Vector3<f64>], weights: &[f64]| -> Vector3<f64> {
            positions.iter().zip(weights).map(|(position, weight)| position * *weight).sum()
        };
        let difference = weighted(&nodes, &shape_values(barycentric)) - weighted(&corners(), &barycentric);
        assert!(difference.norm() < 1e-15);
    }

    #[test]
    fn element_has_its_mass_and_the_energy_of_homogeneous_strain() {
        let nodes = straight_nodes(corners());
        let volume = signed_volume(corners());
        let mass = matrices(&nodes, &material()).expect("an element").mass;
        assert!((mass.iter().sum::<f64>() / (1000.0 * volume) - 1.0).abs() < 1e-13);
        // The consistent mass of corners: V rho / 70 on the diagonal, from the formula for barycentric powers.
        assert!((mass[0] / (1000.0 * volume / 70.0) - 1.0).abs() < 1e-12, "{}", mass[0]);
        let (lambda, mu) = material().lame_parameters();
        let stretch = energy(&nodes, |x| Vector3::new(1e-3 * x.x, 0.0, 0.0));
        assert!((stretch / ((lambda + 2.0 * mu) * 1e-6 * volume) - 1.0).abs() < 1e-12, "{stretch}");
        let shear = energy(&nodes, |x| Vector3::new(0.0, 0.0, 1e-3 * x.y));
        assert!((shear / (mu * 1e-6 * volume) - 1.0).abs() < 1e-12, "{shear}");
        let rotation = energy(&nodes, |x| Vector3::new(1e-3, -1e-3 * x.z, 1e-3 * x.y));
        assert!(rotation.abs() < 1e-12 * stretch, "{rotation}");
    }

    /// Pure bending: the strain is linear, which a linear element cannot show. The energy is that of a beam without
    /// Poisson's effect, int (x / R)^2 E dV.
    #[test]
    fn bending_has_its_energy() {
        let radius = 50.0;
        let nu = 0.3;
        // Saint-Venant's solution for a moment about y with the stress E x / R along z.
        let bend = |p: Vector3<f64>| {
            let [x, y, z]: [f64; 3] = p.into();
            Vector3::new(-(z * z + nu * (x * x - y * y)) / 2.0, -nu * x * y, x * z) / radius
        };
        let nodes = straight_nodes(corners());
        let points = shape_points(&nodes).expect("an element");
        let x_at = |point: &ShapePoint| nodes.iter().zip(point.values).map(|(node, value)| node.x * value).sum::<f64>();
        let exact: f64 = points.iter().map(|point| 1e6 * (x_at(point) / radius).powi(2) * point.volume).sum();
        let bending = energy(&nodes, bend);
        assert!((bending / exact - 1.0).abs() < 1e-12, "{bending} instead of {exact}");
        // Control: the linear element takes the displacements of the middles from the corners.
        let linear = straight_nodes(corners().map(bend));
        let flattened = |x: Vector3<f64>| {
            let node = nodes.iter().position(|node| (node - x).norm() < 1e-12).expect("a node");
            linear[node]
        };
        assert!((energy(&nodes, flattened) / exact - 1.0).abs() > 0.1, "control: a linear element");
    }

    /// Middles on the unit sphere: an octant, whose volume is nearer to pi / 6 than that of the straight element.
    #[test]
    fn curved_element_has_its_volume_and_no_energy_of_rotation() {
        let octant = [[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(Vector3::from);
        let mut nodes = straight_nodes(octant);
        for node in [5, 8, 9] {
            nodes[node] = nodes[node].normalize();
        }
        let points = shape_points(&nodes).expect("an element");
        let volume: f64 = points.iter().map(|point| point.volume).sum();
        let (straight, exact) = (1.0 / 6.0, std::f64::consts::PI / 6.0);
        assert!(volume / exact > 0.8 && volume < exact && straight / exact < 0.4, "{volume} instead of {exact}");
        let turn = Vector3::new(1e-3, 2e-3, -1e-3);
        let stretch = energy(&nodes, |x| x * 1e-3);
        assert!(energy(&nodes, |x| turn.cross(&x)).abs() < 1e-12 * stretch);
    }

    #[test]
    fn inverted_and_flat_elements_have_no_matrices() {
        let [a, b, c, d] = corners();
        assert!(matrices(&straight_nodes([a, c, b, d]), &material()).is_none());
        assert!(matrices(&straight_nodes([a, b, c, (a + b + c) / 3.0]), &material()).is_none());
        let mut folded = straight_nodes(corners());
        folded[4] += (folded[0] - folded[4]) * 1.5 + Vector3::new(0.0, 1.0, 0.0);
        assert!(matrices(&folded, &material()).is_none(), "a middle beyond its corner");
    }

    #[test]
    fn faces_point_outward() {
        let corners = corners();
        let center = corners.iter().sum::<Vector3<f64>>() / 4.0;
        assert!(signed_volume(corners) > 0.0);
        for [a, b, c] in FACES.map(|face| face.map(|corner| corners[corner])) {
            assert!((b - a).cross(&(c - a)).dot(&(a - center)) > 0.0);
        }
    }
}
