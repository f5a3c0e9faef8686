//! Model of a scene for the dynamics, built from the server's description. It has one `DomainModel` per domain: rank
//! (number of modes), joint, surface area, and sampled vertices with their rows of U.
//!
//! Points and rows of U are in the frame of their domain, lengths in scene units. Parents precede their children.

use std::collections::{BTreeMap, BTreeSet};

use modalcast_client::{Client, Domain, Inertia, ModeRows, SceneDescription, Shape, ShapeArray};
use nalgebra::{DMatrix, DVector, Matrix3, Matrix6, Vector3, Vector6};
use rayon::prelude::*;

use crate::affine::AffineTransform;
use crate::connected_parts::ConnectedParts;
use crate::error::{Result, invalid_input};
use crate::wrench::{split, stack};

/// Maximum number of entries of U in the surface samples of all domains together: 64 MiB of f64.
const MAX_MODE_ENTRIES: usize = 8 << 20;

/// Minimum number of surface samples per domain, even if `MAX_MODE_ENTRIES` is exceeded. A domain with fewer vertices
/// has all of them as samples.
const MIN_SURFACE_SAMPLES: usize = 8;

/// Minimum number of domains that one thread processes.
pub const MIN_DOMAINS_PER_THREAD: usize = 64;

/// A vertex at which the dynamics measures displacements or applies loads.
#[derive(Debug, Clone, PartialEq)]
pub struct Sample {
    pub rest_position: Vector3<f64>,
    /// Rows of U at this vertex: 3 x r, row-major.
    pub mode_rows: Vec<f64>,
    /// The connected part of the mesh that has this vertex; 0 if the mesh was not requested.
    pub part: usize,
}

/// The attachment of a domain to its parent.
#[derive(Debug, Clone, PartialEq)]
pub struct Joint {
    /// Index of the parent.
    pub parent: usize,
    /// `parent_from_child` at rest.
    pub parent_from_child: AffineTransform,
    /// Indices of the parent's samples whose displacement moves the joint. Empty for a rigid parent.
    pub attachment_samples: Vec<usize>,
}

/// The domain whose transform a domain follows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FollowedDomain {
    /// Index of the followed domain.
    pub leader: usize,
    pub leader_from_follower: AffineTransform,
}

/// The mass properties of a domain's own material, about the domain's origin and along its axes at rest. Lengths are in
/// scene units.
#[derive(Debug, Clone, PartialEq)]
pub struct DomainInertia {
    /// R^T M R, where R are the six rigid motions: translations along the axes, then rotations about them.
    pub rigid: Matrix6<f64>,
    /// R^T M U: per mode, the momentum and the angular momentum per unit rate of the coordinate.
    pub coupling: Vec<Vector6<f64>>,
    /// U^T M U, r x r.
    pub modal: DMatrix<f64>,
}

/// One domain of the scene.
#[derive(Debug, Clone, PartialEq)]
pub struct DomainModel {
    pub name: String,
    /// r, the number of modes.
    pub rank: usize,
    /// Index of the domain's first coordinate in the vector of all coordinates. Domains that share coordinates have the
    /// same index.
    pub first_coordinate: usize,
    /// Whether the domain has coordinates of its own, which steps contain. False if it shares the coordinates of an
    /// earlier domain.
    pub owns_q: bool,
    /// `world_from_domain` at rest.
    pub placement: AffineTransform,
    pub joint: Option<Joint>,
    /// Present if the domain follows another one. Steps must not contain its transform.
    pub follow: Option<FollowedDomain>,
    /// (rad/s)^2 per mode; empty when unknown.
    pub eigenvalues: Vec<f64>,
    /// `None` if unknown.
    pub inertia: Option<DomainInertia>,
    /// Free-form metadata of the scene's author, by name.
    pub notes: BTreeMap<String, String>,
    /// Surface area; 0 if the mesh was not requested.
    pub area: f64,
    /// Number of connected parts of the mesh; 0 if it was not requested.
    pub part_count: usize,
    /// Diagonal of the bounds at rest; 0 if the positions were not requested.
    pub diagonal: f64,
    /// The first `surface_sample_count` samples are spread evenly over the vertices. The remaining samples are further
    /// vertices that joints need.
    pub samples: Vec<Sample>,
    pub surface_sample_count: usize,
    /// Index of the sample nearest to the domain's origin, where the domain is attached to its parent.
    pub base_sample: Option<usize>,
}

/// A scene.
#[derive(Debug, Clone, PartialEq)]
pub struct Model {
    pub scene: String,
    pub domains: Vec<DomainModel>,
    /// Number of coordinates of all domains.
    pub coordinate_count: usize,
    /// Meters per scene unit.
    pub unit: f64,
    /// Unit vector of the up axis.
    pub up: Vector3<f64>,
    /// Corners of the bounds at rest.
    pub bounds_min: Vector3<f64>,
    pub bounds_max: Vector3<f64>,
}

/// The horizontal axes of a scene. `long_axis`, `short_axis` and the up axis form a right-handed system.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GroundAxes {
    /// The axis along which the bounds are longer.
    pub long_axis: Vector3<f64>,
    pub short_axis: Vector3<f64>,
}

impl DomainInertia {
    /// The mass properties of a domain of r modes. `inertia` has 6 r momenta and r^2 masses.
    pub(crate) fn new(rank: usize, inertia: &Inertia) -> Self {
        let Inertia { mass, center, moments: [xx, yy, zz, xy, xz, yz], modal_momenta, modal_masses } = inertia;
        // A motion has the momentum m (v + w x c), and the angular momentum m c x v + J w.
        let moment = (Vector3::from(*center) * *mass).cross_matrix();
        let mut rigid = Matrix6::zeros();
        rigid.fixed_view_mut::<3, 3>(0, 0).fill_diagonal(*mass);
        rigid.fixed_view_mut::<3, 3>(0, 3).copy_from(&-moment);
        rigid.fixed_view_mut::<3, 3>(3, 0).copy_from(&moment);
        let tensor = Matrix3::new(*xx, *xy, *xz, *xy, *yy, *yz, *xz, *yz, *zz);
        rigid.fixed_view_mut::<3, 3>(3, 3).copy_from(&tensor);
        let momentum = |mode: usize| Vector6::from_fn(|row, _| modal_momenta[row * rank + mode]);
        Self {
            rigid,
            coupling: (0..rank).map(momentum).collect(),
            modal: DMatrix::from_row_slice(rank, rank, modal_masses),
        }
    }
}

impl Sample {
    /// U q at this vertex.
    pub fn displacement(&self, q: &[f64]) -> Vector3<f64> {
        Vector3::from_fn(|component, _| self.row(component, q.len()).iter().zip(q).map(|(entry, q)| entry * q).sum())
    }

    /// The row of U of one component (0, 1, 2 for x, y, z) of this vertex.
    pub fn row(&self, component: usize, rank: usize) -> &[f64] {
        &self.mode_rows[component * rank..][..rank]
    }

    /// The displacement of this vertex per unit of the coordinate of `mode`: one column of the vertex's rows of U.
    pub fn column(&self, mode: usize, rank: usize) -> Vector3<f64> {
        Vector3::from_fn(|component, _| self.mode_rows[component * rank + mode])
    }

    /// Displaced position of the vertex, in the frame of its domain.
    pub fn deformed_position(&self, q: &[f64]) -> Vector3<f64> {
        self.rest_position + self.displacement(q)
    }
}

impl DomainModel {
    /// The coordinates of this domain, from the coordinates of the whole scene.
    pub fn q<'a>(&self, scene_q: &'a [f64]) -> &'a [f64] {
        &scene_q[self.first_coordinate..][..self.rank]
    }

    /// The domain that this one follows or is attached to. `None` for a root.
    pub fn carrier(&self) -> Option<usize> {
        let followed = self.follow.as_ref().map(|follow| follow.leader);
        followed.or_else(|| self.joint.as_ref().map(|joint| joint.parent))
    }

    /// The kinetic energy of a motion of the frame in world axes at rest (translation of the origin, then rotation
    /// vector) and of the coordinates, per second. Without mass properties, that of modes of unit mass.
    pub fn kinetic_energy(&self, frame: &Vector6<f64>, velocities: &[f64]) -> f64 {
        let v = DVector::from_column_slice(velocities);
        let Some(inertia) = &self.inertia else {
            return if self.owns_q { 0.5 * v.norm_squared() } else { 0.0 };
        };
        let local_from_world = self.placement.linear.transpose();
        let (translation, rotation) = split(frame);
        let frame = stack(&(local_from_world * translation), &(local_from_world * rotation));
        let momentum: Vector6<f64> = inertia.coupling.iter().zip(&v).map(|(column, v)| column * *v).sum();
        0.5 * frame.dot(&(inertia.rigid * frame)) + frame.dot(&momentum) + 0.5 * v.dot(&(&inertia.modal * &v))
    }

    /// The samples that are spread evenly over the vertices.
    pub fn surface_samples(&self) -> &[Sample] {
        &self.samples[..self.surface_sample_count]
    }

    /// The largest displacement of a sample per unit of the coordinate of `mode`, at the rest placement, in scene
    /// units.
    pub fn displacement_per_unit(&self, mode: usize) -> f64 {
        let world_displacement = |sample: &Sample| (self.placement.linear * sample.column(mode, self.rank)).norm();
        self.samples.iter().map(world_displacement).fold(0.0, f64::max)
    }
}

impl Model {
    /// Per coordinate: the largest displacement of a sample per unit of the coordinate, in diagonals of the scene's rest
    /// bounds. Domains may share coordinates.
    pub fn displacements_per_unit(&self) -> Vec<f64> {
        let mut displacements_per_unit = vec![0.0_f64; self.coordinate_count];
        for domain in &self.domains {
            for mode in 0..domain.rank {
                let displacement = &mut displacements_per_unit[domain.first_coordinate + mode];
                *displacement = displacement.max(domain.displacement_per_unit(mode) / self.diagonal());
            }
        }
        displacements_per_unit
    }

    /// Reads a scene from its server. `max_surface_samples` limits the surface samples per domain. The limit is
    /// reduced, but not below 8, if the samples of all domains would have more than 8 Mi entries of U.
    ///
    /// # Errors
    /// `Client` if a request to the server fails; `Invalid` if the description contradicts itself, or if the scene's
    /// bounds have no extent or are not finite.
    pub async fn fetch(client: &Client, scene: &str, max_surface_samples: usize) -> Result<Self> {
        let description_without_arrays = client.describe(scene, &[]).await?;
        let has_modes = description_without_arrays.domains.iter().any(|domain| domain.rank > 0);
        let has_eigenvalues = description_without_arrays.domains.iter().any(|domain| !domain.eigenvalues.is_empty());
        // Sampling needs rest positions. The tree scenario also needs triangles, for surface areas; only scenes with
        // eigenvalues use it.
        let mut arrays = vec![ShapeArray::RestPositions];
        if has_eigenvalues {
            arrays.extend([ShapeArray::Indices, ShapeArray::CornerVertices]);
        }
        if description_without_arrays.shapes.iter().any(Shape::has_origin) {
            arrays.push(ShapeArray::CenteredPositions);
        }
        let description = match has_modes {
            false => description_without_arrays,
            true => client.describe(scene, &arrays).await?,
        };
        let entries_per_sample: usize = description.domains.iter().map(|domain| 3 * domain.rank).sum();
        let max_surface_samples =
            max_surface_samples.min(MAX_MODE_ENTRIES / entries_per_sample.max(1)).max(MIN_SURFACE_SAMPLES);
        let selections = select_vertices(&description, max_surface_samples)?;
        let mut mode_rows_by_vertices = BTreeMap::new();
        for (domain, selection) in description.domains.iter().zip(&selections) {
            // Domains of the same shape have the same U. Equal rows are fetched once.
            let key = (domain.shape, selection.vertices.clone());
            if domain.rank > 0 && !mode_rows_by_vertices.contains_key(&key) {
                let mode_rows = client.read_modes(scene, domain.index, &selection.vertices).await?;
                if mode_rows.rank != domain.rank {
                    return Err(invalid_input(format!("rank of '{}'", domain.name), domain.rank, mode_rows.rank));
                }
                mode_rows_by_vertices.insert(key, mode_rows);
            }
        }
        Self::assemble(&description, selections, |domain, vertices| {
            mode_rows_by_vertices.get(&(domain.shape, vertices.to_vec()))
        })
    }

    fn assemble<'a>(
        description: &SceneDescription,
        selections: Vec<SelectedVertices>,
        mode_rows: impl Fn(&Domain, &[u32]) -> Option<&'a ModeRows>,
    ) -> Result<Self> {
        let parts_of_shapes: Vec<_> = description.shapes.par_iter().map(ConnectedParts::of_shape).collect();
        let mut domains: Vec<DomainModel> = vec![];
        let mut coordinate_count = 0;
        for (domain, selection) in description.domains.iter().zip(&selections) {
            let first_coordinate = match domain.shares_q_with {
                None => coordinate_count,
                Some(owner) => {
                    let owner_model = domains.get(owner).filter(|owner_model| owner_model.rank == domain.rank);
                    owner_model.map(|owner_model| owner_model.first_coordinate).ok_or_else(|| {
                        let field = format!("domain whose q '{}' shares", domain.name);
                        invalid_input(field, "an earlier domain of the same rank", format!("domain {owner}"))
                    })?
                }
            };
            let owns_q = domain.shares_q_with.is_none();
            coordinate_count += if owns_q { domain.rank } else { 0 };
            let shape = description.shape_of(domain);
            let parts = &parts_of_shapes[domain.shape];
            let mut samples = create_samples(domain, shape, selection, mode_rows(domain, &selection.vertices))?;
            for (sample, vertex) in samples.iter_mut().zip(&selection.vertices) {
                sample.part = parts.part_of(*vertex);
            }
            let mut domain_model = create_domain_model(domain, shape, selection, samples);
            domain_model.part_count = parts.count;
            (domain_model.first_coordinate, domain_model.owns_q) = (first_coordinate, owns_q);
            domain_model.joint = create_joint(domain, &selections);
            domain_model.follow = create_follow(domain, domains.len())?;
            domains.push(domain_model);
        }
        let info = &description.info;
        let bounds = <[f64; 6]>::try_from(info.bounds.as_slice());
        let bounds = bounds.map_err(|_| invalid_input("scene.bounds", "6 numbers", info.bounds.len()))?;
        let up = match info.up.as_str() {
            "x" => Vector3::x(),
            "z" => Vector3::z(),
            _ => Vector3::y(),
        };
        let bounds_min = Vector3::from_column_slice(&bounds[..3]);
        let bounds_max = Vector3::from_column_slice(&bounds[3..]);
        let diagonal = (bounds_max - bounds_min).norm();
        if !(diagonal.is_finite() && diagonal > 0.0) {
            return Err(invalid_input("scene.bounds", "finite bounds with a positive diagonal", diagonal));
        }
        let (scene, unit) = (info.scene.clone(), info.unit);
        if !(unit.is_finite() && unit > 0.0) {
            return Err(invalid_input("scene.unit", "a positive number of meters", unit));
        }
        Ok(Self { scene, domains, coordinate_count, unit, up, bounds_min, bounds_max })
    }

    /// Diagonal of the bounds at rest, in scene units.
    pub fn diagonal(&self) -> f64 {
        (self.bounds_max - self.bounds_min).norm()
    }

    /// Extent along the up axis at rest, in scene units. For a flat scene, which has no height, the diagonal.
    pub fn height(&self) -> f64 {
        let extent = (self.bounds_max - self.bounds_min).dot(&self.up);
        if extent > 1e-6 * self.diagonal() { extent } else { self.diagonal() }
    }

    /// The horizontal direction at an angle about the up axis, in radians, from the first horizontal axis (x, or y if x
    /// is up).
    pub fn horizontal_direction(&self, angle: f64) -> Vector3<f64> {
        let first_axis = if self.up.x > 0.5 { Vector3::y() } else { Vector3::x() };
        first_axis * angle.cos() + self.up.cross(&first_axis) * angle.sin()
    }

    /// The horizontal axes, ordered by the size of the bounds at rest.
    pub fn ground_axes(&self) -> GroundAxes {
        let (first_axis, second_axis) =
            (self.horizontal_direction(0.0), self.horizontal_direction(std::f64::consts::FRAC_PI_2));
        let extent = |axis: &Vector3<f64>| (self.bounds_max - self.bounds_min).dot(&axis.abs());
        if extent(&second_axis) > extent(&first_axis) {
            GroundAxes { long_axis: second_axis, short_axis: -first_axis }
        } else {
            GroundAxes { long_axis: first_axis, short_axis: second_axis }
        }
    }

    /// The largest displacement from rest of a domain's origin or of a surface sample, in scene units.
    /// `world_from_domain` has one transform per domain.
    pub fn max_displacement(&self, q: &[f64], world_from_domain: &[AffineTransform]) -> f64 {
        let domain_displacement = |(domain, transform): (&DomainModel, &AffineTransform)| {
            let sample_displacement = |sample: &Sample| {
                let current = transform.apply(&sample.deformed_position(domain.q(q)));
                (current - domain.placement.apply(&sample.rest_position)).norm()
            };
            let origin_displacement = (transform.translation - domain.placement.translation).norm();
            domain.surface_samples().iter().map(sample_displacement).fold(origin_displacement, f64::max)
        };
        let domains = self.domains.par_iter().with_min_len(MIN_DOMAINS_PER_THREAD);
        domains.zip(world_from_domain).map(domain_displacement).reduce(|| 0.0, f64::max)
    }
}

/// The vertices of a domain to read: first `surface_sample_count` evenly spread vertices, then further vertices that
/// joints need.
struct SelectedVertices {
    vertices: Vec<u32>,
    surface_sample_count: usize,
}

/// Selects the vertices of every domain. Domains without rest positions have none.
fn select_vertices(description: &SceneDescription, max_surface_samples: usize) -> Result<Vec<SelectedVertices>> {
    let domains = &description.domains;
    let mut attachment_vertices: Vec<BTreeSet<u32>> = vec![BTreeSet::new(); domains.len()];
    for (index, domain) in domains.iter().enumerate() {
        let Some(attachment) = &domain.attachment else { continue };
        if attachment.parent >= index {
            let field = format!("parent of '{}'", domain.name);
            return Err(invalid_input(field, format!("an index below {index}"), attachment.parent));
        }
        let limit = description.shape_of(&domains[attachment.parent]).vertex_count;
        if let Some(vertex) = attachment.parent_vertices.iter().find(|vertex| **vertex as usize >= limit) {
            let field = format!("attachment vertices of '{}'", domain.name);
            return Err(invalid_input(field, format!("vertices below {limit}"), vertex));
        }
        attachment_vertices[attachment.parent].extend(&attachment.parent_vertices);
    }
    let select_for_domain = |(domain, attachment_vertices): (&Domain, BTreeSet<u32>)| {
        let shape = description.shape_of(domain);
        if shape.rest_positions.is_empty() {
            return SelectedVertices { vertices: vec![], surface_sample_count: 0 };
        }
        let surface_sample_count = shape.vertex_count.min(max_surface_samples);
        let spread_vertex = |ordinal: usize| (ordinal * shape.vertex_count / surface_sample_count) as u32;
        let mut vertices: Vec<u32> = (0..surface_sample_count).map(spread_vertex).collect();
        let surface_vertices: BTreeSet<u32> = vertices.iter().copied().collect();
        let joint_vertices = attachment_vertices.into_iter().chain([base_vertex(shape)]).collect::<BTreeSet<_>>();
        vertices.extend(joint_vertices.difference(&surface_vertices));
        SelectedVertices { vertices, surface_sample_count }
    };
    Ok(domains.iter().zip(attachment_vertices).map(select_for_domain).collect())
}

/// Index of the vertex nearest to the domain's origin.
fn base_vertex(shape: &Shape) -> u32 {
    let norm_squared = |vertex: u32| rest_position(shape, vertex).norm_squared();
    (0..shape.vertex_count as u32).min_by(|a, b| norm_squared(*a).total_cmp(&norm_squared(*b))).unwrap_or(0)
}

pub(crate) fn rest_position(shape: &Shape, vertex: u32) -> Vector3<f64> {
    let local_position = &shape.local_positions()[3 * vertex as usize..];
    Vector3::from_fn(|component, _| shape.origin[component] + f64::from(local_position[component]))
}

/// The samples of a domain's selected vertices. They have no rows of U if `mode_rows` is `None`. The caller sets their
/// parts.
fn create_samples(
    domain: &Domain,
    shape: &Shape,
    selection: &SelectedVertices,
    mode_rows: Option<&ModeRows>,
) -> Result<Vec<Sample>> {
    let sample = |(ordinal, vertex): (usize, &u32)| {
        let rows = match mode_rows {
            Some(mode_rows) => mode_rows.rows_of(ordinal).ok_or_else(|| {
                let field = format!("rows of U of '{}'", domain.name);
                let expected = format!("rows of {} vertices", selection.vertices.len());
                invalid_input(field, expected, format!("rows of {ordinal} vertices"))
            })?,
            None => &[],
        };
        let mode_rows = rows.iter().map(|entry| f64::from(*entry)).collect();
        Ok(Sample { rest_position: rest_position(shape, *vertex), mode_rows, part: 0 })
    };
    selection.vertices.iter().enumerate().map(sample).collect()
}

/// Creates the model of a domain. The caller sets `joint`, `follow`, `first_coordinate`, `owns_q` and `part_count`.
fn create_domain_model(
    domain: &Domain,
    shape: &Shape,
    selection: &SelectedVertices,
    samples: Vec<Sample>,
) -> DomainModel {
    let base_vertex = (!samples.is_empty()).then(|| base_vertex(shape));
    DomainModel {
        name: domain.name.clone(),
        rank: domain.rank,
        first_coordinate: 0,
        owns_q: true,
        placement: AffineTransform::from_row_major(&domain.placement),
        joint: None,
        follow: None,
        eigenvalues: domain.eigenvalues.clone(),
        inertia: domain.inertia.as_ref().map(|inertia| DomainInertia::new(domain.rank, inertia)),
        notes: domain.notes.clone(),
        area: surface_area(shape),
        part_count: 0,
        diagonal: bounds_diagonal(shape),
        base_sample: base_vertex
            .and_then(|base_vertex| selection.vertices.iter().position(|vertex| *vertex == base_vertex)),
        samples,
        surface_sample_count: selection.surface_sample_count,
    }
}

fn create_joint(domain: &Domain, selections: &[SelectedVertices]) -> Option<Joint> {
    let attachment = domain.attachment.as_ref()?;
    let parent_vertices = &selections[attachment.parent].vertices;
    let sample_of_vertex: BTreeMap<u32, usize> =
        parent_vertices.iter().enumerate().map(|(sample, vertex)| (*vertex, sample)).collect();
    let attachment_samples =
        attachment.parent_vertices.iter().filter_map(|vertex| sample_of_vertex.get(vertex).copied()).collect();
    let parent_from_child = AffineTransform::from_row_major(&attachment.parent_from_child);
    Some(Joint { parent: attachment.parent, parent_from_child, attachment_samples })
}

/// The domain that the domain with index `index` follows. Leaders precede their followers.
fn create_follow(domain: &Domain, index: usize) -> Result<Option<FollowedDomain>> {
    let Some(follow) = &domain.follow else { return Ok(None) };
    if follow.leader >= index {
        let field = format!("domain that '{}' follows", domain.name);
        return Err(invalid_input(field, format!("an index below {index}"), follow.leader));
    }
    let leader_from_follower = AffineTransform::from_row_major(&follow.leader_from_follower);
    Ok(Some(FollowedDomain { leader: follow.leader, leader_from_follower }))
}

/// The surface area of a mesh; 0 without a mesh.
fn surface_area(shape: &Shape) -> f64 {
    if shape.corner_vertices.is_empty() {
        return 0.0;
    }
    let position = |corner: &u32| rest_position(shape, shape.corner_vertices[*corner as usize]);
    let triangle_area = |corners: &[u32]| {
        let [a, b, c] = [position(&corners[0]), position(&corners[1]), position(&corners[2])];
        0.5 * (b - a).cross(&(c - a)).norm()
    };
    shape.indices.chunks_exact(3).map(triangle_area).sum()
}

/// The diagonal of a shape's bounds at rest; 0 without rest positions.
fn bounds_diagonal(shape: &Shape) -> f64 {
    let points = (0..(shape.rest_positions.len() / 3) as u32).map(|vertex| rest_position(shape, vertex));
    let bounds = points.fold(None, |bounds: Option<(Vector3<f64>, Vector3<f64>)>, point| {
        // `inf` and `sup` are the minimum and the maximum per component.
        Some(bounds.map_or((point, point), |(min, max)| (min.inf(&point), max.sup(&point))))
    });
    bounds.map_or(0.0, |(min, max)| (max - min).norm())
}
