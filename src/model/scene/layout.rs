//! The layout of a scene's packed buffers: the ranges of the vertices, corners, triangles and coordinates of each
//! domain.

use std::collections::BTreeMap;

use crate::domain::{Domain, Shape};
use crate::error::{Result, invalid};

/// The packed ranges of one domain.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DomainLayout {
    /// First vertex in the packed positions, and the number n of vertices.
    pub first_vertex: usize,
    pub vertices: usize,
    /// First corner (a vertex with a normal and texture coordinates) in the packed normals, and the number of corners.
    pub first_corner: usize,
    pub corners: usize,
    /// First triangle in the packed index buffer, and the number of triangles.
    pub first_triangle: usize,
    pub triangles: usize,
    /// First coordinate in the packed q, and the rank r. Domains that share coordinates have the same `first_q`.
    pub first_q: usize,
    pub rank: usize,
}

/// The packed ranges of all domains, and the total numbers of vertices, corners, triangles and coordinates.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Layout {
    pub domains: Vec<DomainLayout>,
    pub vertices: usize,
    pub corners: usize,
    pub triangles: usize,
    /// Length of the packed q.
    pub coordinates: usize,
    /// For each `first_q` that several domains of rank above 0 share, these domains, ascending.
    pub domains_sharing_q: BTreeMap<usize, Vec<u32>>,
}

impl Layout {
    /// The domain that owns the coordinates of a domain: the domain itself, unless it shares those of another one.
    pub fn q_owner(&self, domain: u32) -> u32 {
        let DomainLayout { first_q, rank, .. } = self.domains[domain as usize];
        let sharing_domains = self.domains_sharing_q.get(&first_q).filter(|_| rank > 0);
        sharing_domains.and_then(|domains| domains.first()).map_or(domain, |owner| *owner)
    }

    pub(super) fn new(shapes: &[Shape], domains: &[Domain]) -> Result<Self> {
        let mut layout = Self {
            domains: Vec::with_capacity(domains.len()),
            vertices: 0,
            corners: 0,
            triangles: 0,
            coordinates: 0,
            domains_sharing_q: BTreeMap::new(),
        };
        for (index, domain) in domains.iter().enumerate() {
            let shape = &shapes[domain.shape];
            let rank = shape.modes.rank();
            let shared_first_q = domain.shares_q_with.map(|other_domain| layout.domains[other_domain].first_q);
            let domain_layout = DomainLayout {
                first_vertex: layout.vertices,
                vertices: shape.mesh.rest_positions().len(),
                first_corner: layout.corners,
                corners: shape.mesh.corners().vertices.len(),
                first_triangle: layout.triangles,
                triangles: shape.mesh.triangles().len(),
                first_q: shared_first_q.unwrap_or(layout.coordinates),
                rank,
            };
            layout.vertices += domain_layout.vertices;
            layout.corners += domain_layout.corners;
            layout.triangles += domain_layout.triangles;
            layout.coordinates += if shared_first_q.is_some() { 0 } else { rank };
            if let Some(other_domain) = domain.shares_q_with.filter(|_| rank > 0) {
                // The list begins with the domain that owns the coordinates. If `other_domain` itself shares them, the
                // list already exists.
                layout
                    .domains_sharing_q
                    .entry(domain_layout.first_q)
                    .or_insert_with(|| vec![other_domain as u32])
                    .push(index as u32);
            }
            layout.domains.push(domain_layout);
        }
        // Device code uses 32-bit indices for arrays of up to four numbers per vertex, corner or triangle.
        let largest_count = layout.vertices.max(layout.corners).max(layout.triangles);
        if largest_count > (u32::MAX / 4) as usize {
            return Err(invalid(
                "scene.size",
                format!("at most {} vertices, corners and triangles", u32::MAX / 4),
                largest_count,
            ));
        }
        Ok(layout)
    }
}
