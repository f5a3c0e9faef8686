//! Scenes of coupled domains for tests, with the mass properties of point masses.

use std::collections::BTreeMap;

use nalgebra::{DMatrix, Matrix6, Vector3, Vector6};

use crate::affine::AffineTransform;
use crate::model::{DomainInertia, DomainModel, Joint, Model, Sample};
use crate::wind::hash_to_unit;

/// Vertices of a section of a branch, and sections.
const RING: usize = 6;
const SECTIONS: usize = 5;

/// Pseudorandom numbers.
pub(crate) struct Random {
    seed: u64,
    counter: u64,
}

impl Random {
    pub(crate) const fn new(seed: u64) -> Self {
        Self { seed, counter: 0 }
    }

    /// A number from -1 to 1.
    pub(crate) fn next(&mut self) -> f64 {
        self.counter += 1;
        2.0 * hash_to_unit(self.seed, self.counter) - 1.0
    }

    pub(crate) fn vector(&mut self) -> Vector3<f64> {
        Vector3::from_fn(|_, _| self.next())
    }

    /// An index below `count`.
    pub(crate) fn index(&mut self, count: usize) -> usize {
        ((0.5 * (self.next() + 1.0) * count as f64) as usize).min(count - 1)
    }
}

/// Parameters of a branch: a beam along y from the origin.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Branch {
    pub(crate) rank: usize,
    pub(crate) length: f64,
    pub(crate) mass: f64,
    /// Frequency of the first mode in hertz; those of the others are multiples.
    pub(crate) hertz: f64,
}

/// The mass of a sample of a branch. The last sample is the base.
fn sample_mass(domain: &DomainModel) -> f64 {
    domain.inertia.as_ref().map_or(0.0, |inertia| inertia.rigid[(0, 0)]) / (RING * SECTIONS) as f64
}

/// The samples with mass of a branch, and the mass of each.
pub(crate) fn point_masses(domain: &DomainModel) -> (&[Sample], f64) {
    (domain.surface_samples(), sample_mass(domain))
}

/// The mass properties of point masses at the surface samples of a domain.
pub(crate) fn inertia_of_samples(domain: &DomainModel, mass: f64) -> DomainInertia {
    let rank = domain.rank;
    let mass = mass / domain.surface_sample_count as f64;
    let mut rigid = Matrix6::zeros();
    let mut coupling = vec![Vector6::zeros(); rank];
    let mut modal = DMatrix::zeros(rank, rank);
    for sample in domain.surface_samples() {
        // R at the sample: 3 x 6.
        let mut rigid_motions = nalgebra::Matrix3x6::zeros();
        rigid_motions.fixed_view_mut::<3, 3>(0, 0).fill_with_identity();
        rigid_motions.fixed_view_mut::<3, 3>(0, 3).copy_from(&-sample.rest_position.cross_matrix());
        rigid += rigid_motions.transpose() * rigid_motions * mass;
        for mode in 0..rank {
            let column = sample.column(mode, rank);
            coupling[mode] += rigid_motions.transpose() * column * mass;
            for other in 0..rank {
                modal[(mode, other)] += mass * column.dot(&sample.column(other, rank));
            }
        }
    }
    DomainInertia { rigid, coupling, modal }
}

impl Branch {
    /// A branch with random modes whose sections move as rigid bodies, and whose root does not move.
    pub(crate) fn create(&self, random: &mut Random) -> DomainModel {
        let Self { rank, length, mass, hertz } = *self;
        let amplitude = (mass.max(1e-30)).sqrt().recip();
        let motions: Vec<(Vector3<f64>, Vector3<f64>, f64)> = (0..rank)
            .map(|_| (random.vector() * amplitude, random.vector() * (amplitude / length), 1.5 + 0.5 * random.next()))
            .collect();
        let mut samples = vec![];
        for section in 0..SECTIONS {
            let height = section as f64 / (SECTIONS - 1) as f64;
            for vertex in 0..RING {
                let angle = std::f64::consts::TAU * vertex as f64 / RING as f64;
                let arm = Vector3::new(angle.cos(), 0.0, angle.sin()) * (0.05 * length);
                let displacement = |(translation, rotation, power): &(Vector3<f64>, Vector3<f64>, f64)| {
                    (translation + rotation.cross(&arm)) * height.powf(*power)
                };
                let columns: Vec<Vector3<f64>> = motions.iter().map(displacement).collect();
                let mode_rows = (0..3).flat_map(|axis| columns.iter().map(move |column| column[axis])).collect();
                samples.push(Sample { rest_position: Vector3::y() * (height * length) + arm, mode_rows, part: 0 });
            }
        }
        let surface_sample_count = samples.len();
        samples.push(Sample { rest_position: Vector3::zeros(), mode_rows: vec![0.0; 3 * rank], part: 0 });
        let eigenvalue = |mode: usize| (std::f64::consts::TAU * hertz * (mode + 1) as f64).powi(2);
        let mut domain = DomainModel {
            name: "branch".into(),
            rank,
            first_coordinate: 0,
            owns_q: true,
            placement: AffineTransform::identity(),
            joint: None,
            follow: None,
            eigenvalues: (0..rank).map(eigenvalue).collect(),
            inertia: None,
            notes: BTreeMap::new(),
            area: 0.3 * length * length,
            part_count: 1,
            diagonal: length,
            samples,
            surface_sample_count,
            base_sample: Some(surface_sample_count),
        };
        domain.inertia = Some(inertia_of_samples(&domain, mass));
        domain
    }
}

/// A scene of branches. `parents` has the index of the parent per branch; each is attached to the last section of its
/// parent. Roots stand at the origin.
pub(crate) fn create_scene(branches: &[Branch], parents: &[Option<usize>], seed: u64) -> Model {
    let mut random = Random::new(seed);
    let mut domains: Vec<DomainModel> = vec![];
    let mut coordinate_count = 0;
    for (branch, parent) in branches.iter().zip(parents) {
        let mut domain = branch.create(&mut random);
        domain.name = format!("branch {}", domains.len());
        domain.first_coordinate = coordinate_count;
        coordinate_count += domain.rank;
        if let Some(parent) = *parent {
            let tilt = AffineTransform::rotation_about(&random.vector(), 0.8 * random.next(), &Vector3::zeros());
            let length = domains[parent].diagonal;
            let parent_from_child = AffineTransform { translation: Vector3::y() * length, ..tilt };
            let attachment_samples =
                if domains[parent].rank > 0 { (RING * (SECTIONS - 1)..RING * SECTIONS).collect() } else { vec![] };
            domain.placement = domains[parent].placement.compose(&parent_from_child);
            domain.joint = Some(Joint { parent, parent_from_child, attachment_samples });
        }
        domains.push(domain);
    }
    let mut model = Model {
        scene: "coupled".into(),
        domains,
        coordinate_count,
        unit: 1.0,
        up: Vector3::y(),
        bounds_min: Vector3::repeat(f64::MAX),
        bounds_max: Vector3::repeat(f64::MIN),
    };
    for domain in &model.domains {
        for sample in &domain.samples {
            let position = domain.placement.apply(&sample.rest_position);
            (model.bounds_min, model.bounds_max) = (model.bounds_min.inf(&position), model.bounds_max.sup(&position));
        }
    }
    model
}

/// A plant of `count` branches: every branch is attached to a random earlier one, and becomes smaller, lighter and faster
/// with its depth. Some leaves are rigid.
pub(crate) fn random_plant(count: usize, seed: u64) -> Model {
    let mut random = Random::new(seed);
    let parents: Vec<Option<usize>> =
        (0..count).map(|index| (index > 0).then(|| random.index(index).max(index / 4))).collect();
    let mut depths = vec![];
    for parent in &parents {
        depths.push(parent.map_or(0, |parent: usize| depths[parent] + 1));
    }
    let is_leaf = |index: usize| !parents.contains(&Some(index));
    let branch = |(index, depth): (usize, &i32)| Branch {
        rank: if is_leaf(index) && index % 3 == 0 { 0 } else { 3 + index % 7 },
        length: 2.0 * 0.8_f64.powi(*depth),
        mass: 20.0 * 0.4_f64.powi(*depth),
        hertz: 0.8 * 1.2_f64.powi(*depth),
    };
    let branches: Vec<Branch> = depths.iter().enumerate().map(branch).collect();
    create_scene(&branches, &parents, seed)
}

/// The same scene with lengths in units of `unit` meters instead of meters. Its coordinates are larger by 1 / `unit`.
pub(crate) fn in_units(model: &Model, unit: f64) -> Model {
    let mut model = model.clone();
    let scale = unit.recip();
    // Mass properties have a factor for each of their rows and columns that is a rotation.
    let factors = Vector6::new(1.0, 1.0, 1.0, scale, scale, scale);
    for domain in &mut model.domains {
        domain.placement.translation *= scale;
        domain.joint.iter_mut().for_each(|joint| joint.parent_from_child.translation *= scale);
        domain.follow.iter_mut().for_each(|follow| follow.leader_from_follower.translation *= scale);
        domain.samples.iter_mut().for_each(|sample| sample.rest_position *= scale);
        (domain.area, domain.diagonal) = (domain.area * scale * scale, domain.diagonal * scale);
        if let Some(DomainInertia { rigid, coupling, .. }) = &mut domain.inertia {
            rigid.component_mul_assign(&(factors * factors.transpose()));
            coupling.iter_mut().for_each(|momentum| momentum.component_mul_assign(&factors));
        }
    }
    model.bounds_min *= scale;
    model.bounds_max *= scale;
    Model { unit, ..model }
}
