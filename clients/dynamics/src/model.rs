//! Model of a scene for the dynamics, built from the server's description: per part rank, joint, sampled vertices with
//! their rows of U, and area.
//!
//! Points and rows are in the frame of their part, lengths in scene units. Parents precede their children.

use std::collections::{BTreeMap, BTreeSet};

use modalcast_client::{Array, Client, Domain, ModeRows, SceneDescription};
use nalgebra::Vector3;

use crate::affine::Affine;
use crate::error::{Result, invalid};

/// The most numbers of U that are read, over all parts.
const MAX_MODE_ENTRIES: usize = 8 << 20;

/// A vertex at which the dynamics measures displacements or applies loads.
#[derive(Debug, Clone, PartialEq)]
pub struct Sample {
    pub rest: Vector3<f64>,
    /// Three rows of r entries, row-major.
    pub rows: Vec<f64>,
}

/// The attachment of a part to its parent.
#[derive(Debug, Clone, PartialEq)]
pub struct Joint {
    pub parent: usize,
    /// `parent_from_child` at rest.
    pub frame: Affine,
    /// Indices of the parent's samples that carry the frame; empty for a rigid parent.
    pub ring: Vec<usize>,
}

/// One domain.
#[derive(Debug, Clone, PartialEq)]
pub struct DomainModel {
    pub name: String,
    pub rank: usize,
    /// Index of its first coordinate in the vector of all coordinates. Parts that share coordinates have the same
    /// index.
    pub first: usize,
    /// Whether steps carry the coordinates of this part. False if the part shares those of an earlier part.
    pub owns_q: bool,
    /// `world_from_domain` at rest.
    pub placement: Affine,
    pub joint: Option<Joint>,
    /// (rad/s)^2; empty when unknown.
    pub eigenvalues: Vec<f64>,
    pub notes: BTreeMap<String, String>,
    /// Surface area, and diagonal of the bounds; 0 if the mesh was not requested.
    pub area: f64,
    pub extent: f64,
    /// The first `surface_samples` samples are spread evenly over the vertices; the other vertices of joint rings follow.
    pub samples: Vec<Sample>,
    pub surface_samples: usize,
    /// Index of the sample nearest to the part's origin, where the part is attached to its parent.
    pub base: Option<usize>,
}

/// A scene.
#[derive(Debug, Clone, PartialEq)]
pub struct Model {
    pub scene: String,
    pub parts: Vec<DomainModel>,
    /// Number of coordinates of all parts.
    pub coordinates: usize,
    pub up: Vector3<f64>,
    pub low: Vector3<f64>,
    pub high: Vector3<f64>,
}

impl Sample {
    /// U q at this vertex.
    pub fn displacement(&self, q: &[f64]) -> Vector3<f64> {
        Vector3::from_fn(|row, _| self.row(row, q.len()).iter().zip(q).map(|(entry, q)| entry * q).sum())
    }

    /// One row of U.
    pub fn row(&self, component: usize, rank: usize) -> &[f64] {
        &self.rows[component * rank..][..rank]
    }

    /// One column of the three rows.
    pub fn column(&self, mode: usize, rank: usize) -> Vector3<f64> {
        Vector3::from_fn(|component, _| self.rows[component * rank + mode])
    }

    /// Displaced position of the vertex, in the frame of its part.
    pub fn deformed_position(&self, q: &[f64]) -> Vector3<f64> {
        self.rest + self.displacement(q)
    }
}

impl DomainModel {
    /// The coordinates of this part, from the vector of all coordinates.
    pub fn q<'a>(&self, all: &'a [f64]) -> &'a [f64] {
        &all[self.first..][..self.rank]
    }

    /// The value of a note, if it is a finite number.
    pub fn note(&self, name: &str) -> Option<f64> {
        self.notes.get(name).and_then(|text| text.trim().parse().ok()).filter(|number: &f64| number.is_finite())
    }
}

impl Model {
    /// Reads a scene from its server. `watched` is the most evenly spread samples per part; it is reduced, to no less
    /// than 8, so that these samples of all parts together have at most 8 Mi numbers of U.
    ///
    /// # Errors
    /// `Client` as for the calls; `Invalid` if the description contradicts itself.
    pub async fn fetch(client: &Client, scene: &str, watched: usize) -> Result<Self> {
        let bare = client.describe(scene, &[]).await?;
        let bends = bare.domains.iter().any(|domain| domain.rank > 0);
        let swings = bare.domains.iter().any(|domain| !domain.eigenvalues.is_empty());
        let description = match (bends, swings) {
            (false, _) => bare,
            (true, false) => client.describe(scene, &[Array::RestPositions]).await?,
            (true, true) => {
                client.describe(scene, &[Array::RestPositions, Array::Indices, Array::CornerVertices]).await?
            }
        };
        let numbers: usize = description.domains.iter().map(|domain| 3 * domain.rank).sum();
        let watched = watched.min(MAX_MODE_ENTRIES / numbers.max(1)).max(8);
        let choices = choose(&description, watched)?;
        let mut modes = BTreeMap::new();
        for (domain, choice) in description.domains.iter().zip(&choices) {
            let key = (domain.shape, choice.vertices.clone());
            if domain.rank > 0 && !modes.contains_key(&key) {
                let rows = client.modes(scene, domain.index, &choice.vertices).await?;
                if rows.rank != domain.rank {
                    return Err(invalid(format!("rank of '{}'", domain.name), domain.rank, rows.rank));
                }
                modes.insert(key, rows);
            }
        }
        Self::assemble(&description, choices, |domain, vertices| modes.get(&(domain.shape, vertices.to_vec())))
    }

    fn assemble<'a>(
        description: &SceneDescription,
        choices: Vec<Choice>,
        rows: impl Fn(&Domain, &[u32]) -> Option<&'a ModeRows>,
    ) -> Result<Self> {
        let (mut parts, mut coordinates): (Vec<DomainModel>, _) = (vec![], 0);
        for (domain, choice) in description.domains.iter().zip(&choices) {
            let twin = domain.shares_q_with.map(|twin| parts.get(twin).map(|part| (part.first, part.rank)));
            let first = match twin {
                None => coordinates,
                Some(Some((first, rank))) if rank == domain.rank => first,
                Some(_) => return Err(invalid(format!("'{}' shares q", domain.name), "an earlier twin", "another")),
            };
            coordinates += if twin.is_none() { domain.rank } else { 0 };
            let read = rows(domain, &choice.vertices);
            let mut part = part(domain, choice, read);
            (part.first, part.owns_q) = (first, twin.is_none());
            part.joint = joint(domain, &choices)?;
            parts.push(part);
        }
        let info = &description.info;
        let bounds = <[f64; 6]>::try_from(info.bounds.as_slice());
        let bounds = bounds.map_err(|_| invalid("scene.bounds", "6 numbers", info.bounds.len()))?;
        let up = match info.up.as_str() {
            "x" => Vector3::x(),
            "z" => Vector3::z(),
            _ => Vector3::y(),
        };
        let (low, high) = (Vector3::from_column_slice(&bounds[..3]), Vector3::from_column_slice(&bounds[3..]));
        Ok(Self { scene: info.scene.clone(), parts, coordinates, up, low, high })
    }

    /// Diagonal of the bounds at rest, in scene units.
    pub fn diagonal(&self) -> f64 {
        (self.high - self.low).norm().max(f64::MIN_POSITIVE)
    }

    /// Extent along the up axis at rest, in scene units.
    pub fn height(&self) -> f64 {
        (self.high - self.low).dot(&self.up).max(f64::MIN_POSITIVE)
    }

    /// The horizontal direction at an angle about the up axis, in radians, from the first horizontal axis (x, or y if x
    /// is up).
    pub fn horizontal_direction(&self, angle: f64) -> Vector3<f64> {
        let first = if self.up.x > 0.5 { Vector3::y() } else { Vector3::x() };
        first * angle.cos() + self.up.cross(&first) * angle.sin()
    }

    /// The longer horizontal axis and the other one. The two and the up axis form a right-handed system.
    pub fn ground_axes(&self) -> (Vector3<f64>, Vector3<f64>) {
        let (first, second) = (self.horizontal_direction(0.0), self.horizontal_direction(std::f64::consts::FRAC_PI_2));
        let size = |axis: &Vector3<f64>| (self.high - self.low).dot(&axis.abs());
        if size(&second) > size(&first) { (second, -first) } else { (first, second) }
    }

    /// The largest displacement of a part's origin or of a sample from rest, in scene units. Considers evenly spread
    /// samples only.
    pub fn peak(&self, q: &[f64], world: &[Affine]) -> f64 {
        let parts = self.parts.iter().zip(world);
        let of = |(part, pose): (&DomainModel, &Affine)| {
            let moved = |sample: &Sample| {
                (pose.apply(&sample.deformed_position(part.q(q))) - part.placement.apply(&sample.rest)).norm()
            };
            let origin = (pose.translation - part.placement.translation).norm();
            part.samples[..part.surface_samples].iter().map(moved).fold(origin, f64::max)
        };
        parts.map(of).fold(0.0, f64::max)
    }
}

/// The vertices of a domain to read: first `surface_samples` evenly spread ones, then the others that joints need.
struct Choice {
    vertices: Vec<u32>,
    surface_samples: usize,
}

fn choose(description: &SceneDescription, watched: usize) -> Result<Vec<Choice>> {
    let domains = &description.domains;
    let mut rings: Vec<BTreeSet<u32>> = vec![BTreeSet::new(); domains.len()];
    for (index, domain) in domains.iter().enumerate() {
        let Some(attachment) = &domain.attachment else { continue };
        if attachment.parent >= index {
            let field = format!("parent of '{}'", domain.name);
            return Err(invalid(field, format!("an index below {index}"), attachment.parent));
        }
        let limit = domains[attachment.parent].vertices;
        if let Some(row) = attachment.rows.iter().find(|row| **row as usize >= limit) {
            return Err(invalid(format!("ring of '{}'", domain.name), format!("vertices below {limit}"), row));
        }
        rings[attachment.parent].extend(&attachment.rows);
    }
    let choice = |(domain, ring): (&Domain, BTreeSet<u32>)| {
        if domain.rest_positions.is_empty() {
            return Choice { vertices: vec![], surface_samples: 0 };
        }
        let surface_samples = domain.vertices.min(watched);
        let mut vertices: Vec<u32> =
            (0..surface_samples).map(|at| (at * domain.vertices / surface_samples) as u32).collect();
        let spread: BTreeSet<u32> = vertices.iter().copied().collect();
        let others = ring.into_iter().chain([base(domain)]).collect::<BTreeSet<_>>();
        vertices.extend(others.difference(&spread));
        Choice { vertices, surface_samples }
    };
    Ok(domains.iter().zip(rings).map(choice).collect())
}

/// Index of the vertex nearest to the domain's origin.
fn base(domain: &Domain) -> u32 {
    let size = |at: u32| domain.rest_positions[3 * at as usize..][..3].iter().map(|x| x * x).sum::<f32>();
    (0..domain.vertices as u32).min_by(|a, b| size(*a).total_cmp(&size(*b))).unwrap_or(0)
}

fn point(domain: &Domain, vertex: u32) -> Vector3<f64> {
    Vector3::from_fn(|row, _| f64::from(domain.rest_positions[3 * vertex as usize + row]))
}

fn part(domain: &Domain, choice: &Choice, read: Option<&ModeRows>) -> DomainModel {
    let sample = |(place, vertex): (usize, &u32)| {
        let rows = read.map_or(&[][..], |rows| rows.rows_of(place));
        Sample { rest: point(domain, *vertex), rows: rows.iter().map(|entry| f64::from(*entry)).collect() }
    };
    let samples: Vec<Sample> = choice.vertices.iter().enumerate().map(sample).collect();
    let base = if samples.is_empty() { None } else { Some(base(domain)) };
    DomainModel {
        name: domain.name.clone(),
        rank: domain.rank,
        first: 0,
        owns_q: true,
        placement: Affine::from_entries(&domain.placement),
        joint: None,
        eigenvalues: domain.eigenvalues.clone(),
        notes: domain.notes.clone(),
        area: area(domain),
        extent: extent(domain),
        base: base.and_then(|base| choice.vertices.iter().position(|vertex| *vertex == base)),
        samples,
        surface_samples: choice.surface_samples,
    }
}

fn joint(domain: &Domain, choices: &[Choice]) -> Result<Option<Joint>> {
    let Some(attachment) = &domain.attachment else { return Ok(None) };
    let places: BTreeMap<u32, usize> =
        choices[attachment.parent].vertices.iter().enumerate().map(|(place, vertex)| (*vertex, place)).collect();
    let ring = attachment.rows.iter().filter_map(|row| places.get(row).copied()).collect();
    let frame = Affine::from_entries(&attachment.frame);
    Ok(Some(Joint { parent: attachment.parent, frame, ring }))
}

/// The surface area of a domain's mesh.
fn area(domain: &Domain) -> f64 {
    if domain.corner_vertices.is_empty() {
        return 0.0;
    }
    let corner = |index: &u32| point(domain, domain.corner_vertices[*index as usize]);
    let triangle = |three: &[u32]| {
        let [a, b, c] = [corner(&three[0]), corner(&three[1]), corner(&three[2])];
        0.5 * (b - a).cross(&(c - a)).norm()
    };
    domain.indices.chunks_exact(3).map(triangle).sum()
}

/// The diagonal of a domain's bounds.
fn extent(domain: &Domain) -> f64 {
    let points = (0..(domain.rest_positions.len() / 3) as u32).map(|vertex| point(domain, vertex));
    let bounds = points.fold(None, |bounds: Option<(Vector3<f64>, Vector3<f64>)>, point| {
        Some(bounds.map_or((point, point), |(low, high)| (low.inf(&point), high.sup(&point))))
    });
    bounds.map_or(0.0, |(low, high)| (high - low).norm())
}
