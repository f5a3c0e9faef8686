//! Smoothing groups of a mesh and the triangles around each group, for the normals of a deformed surface.
//!
//! Corners of one vertex whose rest normals agree within 0.1 degrees form a group: a texture seam splits corners but
//! not groups, a hard edge splits both. The triangles adjacent to a group are stored as a ring: the group's vertex,
//! then zero or more fans. A fan is a sequence of neighbors of the group's vertex. Two consecutive neighbors form a
//! triangle with the group's vertex, in winding order. The first neighbor of each fan has the flag [`RING_START`]. A
//! closed fan of k triangles repeats its first neighbor at the end, so the ring takes k + 2 entries instead of the 2 k
//! of a list of edges, and each neighbor is read once instead of twice.
//!
//! Memory: 4 bytes per corner, 20 bytes per group (ring offset, vertex and geometric normal), and 4 (k + 1) bytes per
//! fan of k triangles. The worst case of the fans is 24 bytes per triangle of the mesh (3 groups x 2 neighbors x 4
//! bytes), if no two triangles of a group share an edge.

use nalgebra::Vector3;

use super::Mesh;

/// Flag of the first vertex of each fan of a ring.
pub const RING_START: u32 = 1 << 31;

/// The largest number of triangles of all shapes together. A triangle adds at most two neighbors to the fans of each of
/// its three groups. 2^28 triangles x 3 groups x 2 neighbors are 1.6e9 entries, which 32-bit offsets can address.
pub const MAX_RING_TRIANGLES: usize = 1 << 28;

/// The largest distance between a rest normal and the rest normal of its group's representative: the chord of 0.1
/// degrees on the unit sphere.
const SAME_NORMAL_CHORD: f64 = 1.745_329e-3;

/// A group whose area vectors cancel to less than this fraction of their total length has no geometric normal, because
/// a small deformation would turn it arbitrarily. An example is a leaf whose two sides share corners.
const CANCELLATION_RATIO: f64 = 1.0 / 1024.0;

/// The smoothing groups of one mesh.
#[derive(Debug, Clone, PartialEq)]
pub struct SmoothingGroups {
    corner_groups: Vec<u32>,
    ring_offsets: Vec<u32>,
    rings: Vec<u32>,
    normals: Vec<[f32; 3]>,
}

/// The edge of a triangle opposite to one of its vertices: begin and end in winding order.
type OppositeEdge = (u32, u32);

impl SmoothingGroups {
    /// Computes the groups of a mesh with at most [`MAX_RING_TRIANGLES`] triangles, in O(c log c) for c corners.
    pub(super) fn from_mesh(mesh: &Mesh) -> Self {
        let corner_groups = number_groups(&group_representatives(mesh));
        let group_count = corner_groups.iter().max().map_or(0, |max_group| *max_group as usize + 1);
        let mut group_vertices = vec![0; group_count];
        for (group, vertex) in corner_groups.iter().zip(&mesh.corners().vertices) {
            group_vertices[*group as usize] = *vertex;
        }
        let (edge_offsets, mut edges) = opposite_edges_of_groups(mesh, &corner_groups, group_count);
        let mut groups =
            Self { corner_groups, ring_offsets: vec![0], rings: Vec::new(), normals: Vec::with_capacity(group_count) };
        let mut fan_builder = FanBuilder::default();
        for (group, vertex) in group_vertices.into_iter().enumerate() {
            let group_edges = &mut edges[edge_offsets[group]..edge_offsets[group + 1]];
            groups.normals.push(geometric_normal(mesh, vertex, group_edges));
            groups.rings.push(vertex);
            fan_builder.append_fans(group_edges, &mut groups.rings);
            groups.ring_offsets.push(groups.rings.len() as u32);
        }
        groups
    }

    /// The number of groups.
    pub fn group_count(&self) -> usize {
        self.normals.len()
    }

    /// The group of each corner. Groups are numbered in the order of their first corners.
    pub fn corner_groups(&self) -> &[u32] {
        &self.corner_groups
    }

    /// Start of each group's ring in [`Self::rings`], followed by the end of the last ring.
    pub fn ring_offsets(&self) -> &[u32] {
        &self.ring_offsets
    }

    /// All rings, concatenated.
    pub fn rings(&self) -> &[u32] {
        &self.rings
    }

    /// The ring of one group: its vertex, then its fans.
    pub fn ring(&self, group: usize) -> &[u32] {
        &self.rings[self.ring_offsets[group] as usize..self.ring_offsets[group + 1] as usize]
    }

    /// Per group, the area-weighted unit normal of its triangles at rest, oriented by their winding. Zero if it is
    /// undefined: no triangles, no area, or areas that cancel.
    pub fn normals(&self) -> &[[f32; 3]] {
        &self.normals
    }

    /// Host memory of all lists in bytes.
    pub fn bytes(&self) -> u64 {
        (4 * (self.corner_groups.len() + self.ring_offsets.len() + self.rings.len()) + 12 * self.normals.len()) as u64
    }
}

/// For each corner, the corner that represents its group.
fn group_representatives(mesh: &Mesh) -> Vec<u32> {
    let corners = mesh.corners();
    let vertex = |corner: u32| corners.vertices[corner as usize];
    let normal = |corner: u32| corners.normals[corner as usize];
    let compare_normals = |a: u32, b: u32| {
        let orderings = normal(a).into_iter().zip(normal(b)).map(|(a, b)| a.total_cmp(&b));
        orderings.fold(std::cmp::Ordering::Equal, std::cmp::Ordering::then)
    };
    let mut sorted_corners: Vec<u32> = (0..corners.vertices.len() as u32).collect();
    // Sorting makes the groups independent of the order of corners in a file.
    sorted_corners.sort_unstable_by(|a, b| vertex(*a).cmp(&vertex(*b)).then(compare_normals(*a, *b)).then(a.cmp(b)));
    let mut representative_of_corner = vec![0; sorted_corners.len()];
    let mut vertex_representatives: Vec<u32> = Vec::new();
    for corner in sorted_corners {
        if vertex_representatives.last().is_some_and(|representative| vertex(*representative) != vertex(corner)) {
            vertex_representatives.clear();
        }
        // Representatives are sorted by normal.x, so that only those within the chord in x are candidates.
        let mut candidates = vertex_representatives.iter().rev().take_while(|representative| {
            chord_distance(normal(corner), normal(**representative), 1) <= SAME_NORMAL_CHORD
        });
        let group_representative = candidates
            .find(|representative| chord_distance(normal(corner), normal(**representative), 3) <= SAME_NORMAL_CHORD)
            .copied();
        representative_of_corner[corner as usize] = group_representative.unwrap_or_else(|| {
            vertex_representatives.push(corner);
            corner
        });
    }
    representative_of_corner
}

/// The distance of two normals in their first `axis_count` coordinates.
fn chord_distance(a: [f32; 3], b: [f32; 3], axis_count: usize) -> f64 {
    (0..axis_count).map(|axis| (f64::from(a[axis]) - f64::from(b[axis])).powi(2)).sum::<f64>().sqrt()
}

/// Numbers the groups in the order of their first corners. Returns the group of each corner.
fn number_groups(representative_of_corner: &[u32]) -> Vec<u32> {
    const UNASSIGNED: u32 = u32::MAX;
    let mut group_of_representative = vec![UNASSIGNED; representative_of_corner.len()];
    let mut group_count = 0;
    let group_of = |representative: &u32| {
        let group = &mut group_of_representative[*representative as usize];
        if *group == UNASSIGNED {
            *group = group_count;
            group_count += 1;
        }
        *group
    };
    representative_of_corner.iter().map(group_of).collect()
}

/// Returns the offset of each group's edges, and the opposite edges of all groups, sorted by group. A triangle that
/// contains a vertex twice has no area in any state and is omitted.
fn opposite_edges_of_groups(mesh: &Mesh, corner_groups: &[u32], group_count: usize) -> (Vec<usize>, Vec<OppositeEdge>) {
    // For each corner of each triangle: its group, and the edge opposite to it.
    let group_edges = || {
        mesh.triangles().iter().flat_map(|triangle| {
            let [a, b, c] = triangle.map(|corner| mesh.corners().vertices[corner as usize]);
            let has_distinct_vertices = a != b && b != c && c != a;
            let groups = triangle.map(|corner| corner_groups[corner as usize] as usize).into_iter();
            groups.zip([(b, c), (c, a), (a, b)]).filter(move |_| has_distinct_vertices)
        })
    };
    let mut offsets = vec![0; group_count + 1];
    group_edges().for_each(|(group, _)| offsets[group + 1] += 1);
    for group in 0..group_count {
        offsets[group + 1] += offsets[group];
    }
    let mut next_offsets = offsets.clone();
    let mut edges = vec![(0, 0); offsets[group_count]];
    for (group, edge) in group_edges() {
        edges[next_offsets[group]] = edge;
        next_offsets[group] += 1;
    }
    (offsets, edges)
}

fn geometric_normal(mesh: &Mesh, vertex: u32, edges: &[OppositeEdge]) -> [f32; 3] {
    let position = |other: u32| Vector3::from(mesh.rest_positions()[other as usize]).cast::<f64>();
    let (mut sum, mut length_sum) = (Vector3::zeros(), 0.0);
    for (from, to) in edges {
        let area_vector = (position(*from) - position(vertex)).cross(&(position(*to) - position(vertex)));
        sum += area_vector;
        length_sum += area_vector.norm();
    }
    let is_defined = sum.norm() > CANCELLATION_RATIO * length_sum;
    sum.try_normalize(0.0).filter(|_| is_defined).map_or([0.0; 3], |normal| normal.cast::<f32>().into())
}

/// Chains the opposite edges of a group to fans. Reuses its buffers for all groups.
#[derive(Default)]
struct FanBuilder {
    /// For each begin vertex, at the index of its first edge: the number of its edges that are already in a fan.
    used_edge_counts: Vec<usize>,
    /// The end vertices of all edges, sorted.
    ends: Vec<u32>,
}

impl FanBuilder {
    /// Appends the fans of a group in O(k log k) for k edges: first the open fans, each from its border, then the
    /// closed ones. Both are in the order of their begin vertices.
    fn append_fans(&mut self, edges: &mut [OppositeEdge], ring: &mut Vec<u32>) {
        edges.sort_unstable();
        self.used_edge_counts.clear();
        self.used_edge_counts.resize(edges.len(), 0);
        self.ends.clear();
        self.ends.extend(edges.iter().map(|(_, to)| *to));
        self.ends.sort_unstable();
        // An open fan begins at a vertex where no edge ends.
        for is_open in [true, false] {
            for (begin, _) in edges.iter() {
                if self.ends.binary_search(begin).is_err() == is_open {
                    self.append_fan(edges, *begin, ring);
                }
            }
        }
    }

    /// Appends the fan that starts with an unused edge from `begin`. Appends nothing if there is none.
    fn append_fan(&mut self, edges: &[OppositeEdge], begin: u32, ring: &mut Vec<u32>) {
        let Some(mut end) = self.take_edge(edges, begin) else { return };
        ring.extend([begin | RING_START, end]);
        while let Some(next) = self.take_edge(edges, end) {
            ring.push(next);
            end = next;
        }
    }

    /// Takes an unused edge that begins at `begin`, and returns its end.
    fn take_edge(&mut self, edges: &[OppositeEdge], begin: u32) -> Option<u32> {
        let first_edge = edges.partition_point(|edge| edge.0 < begin);
        let used_edge_count = self.used_edge_counts.get_mut(first_edge)?;
        let (_, to) = edges.get(first_edge + *used_edge_count).filter(|edge| edge.0 == begin)?;
        *used_edge_count += 1;
        Some(*to)
    }
}

#[cfg(test)]
mod tests {
    use super::super::Corners;
    use super::*;

    /// The opposite edges that a ring encodes, sorted.
    fn decode_ring(ring: &[u32]) -> Vec<OppositeEdge> {
        let vertex_pairs = ring[1..].windows(2).filter(|pair| pair[1] & RING_START == 0);
        let mut edges: Vec<OppositeEdge> = vertex_pairs.map(|pair| (pair[0] & !RING_START, pair[1])).collect();
        edges.sort_unstable();
        edges
    }

    /// A mesh with the given corners (vertex, normal) and triangles. The positions of its 60 vertices are arbitrary.
    fn mesh(corners: &[(u32, [f32; 3])], triangles: Vec<[u32; 3]>) -> Mesh {
        let rest_positions =
            (0..60_u32).map(|index| [index as f32, (index * index % 17) as f32, (index * 5 % 7) as f32]).collect();
        let (vertices, normals) = corners.iter().copied().unzip();
        Mesh::new(rest_positions, Corners { vertices, normals, uvs: vec![] }, triangles).expect("a valid mesh")
    }

    const UP: [f32; 3] = [0.0, 0.0, 1.0];
    const SIDE: [f32; 3] = [1.0, 0.0, 0.0];

    #[test]
    fn groups_are_independent_of_the_order_of_corners() {
        let tilted_normal = |angle: f32| [angle.to_radians().sin(), 0.0, angle.to_radians().cos()];
        // At vertex 3, the normals at 0 and 0.09 degrees form a group. The normal at 0.3 degrees is in another one.
        let corners =
            [(3, SIDE), (5, UP), (3, tilted_normal(0.09)), (3, UP), (3, tilted_normal(0.3)), (5, UP), (4, UP)];
        let groups = SmoothingGroups::from_mesh(&mesh(&corners, vec![[0, 1, 6]]));
        assert_eq!(groups.corner_groups(), [0, 1, 2, 2, 3, 1, 4]);
        let mut reversed_corners = corners;
        reversed_corners.reverse();
        // The same groups, numbered in the order of their first corners.
        assert_eq!(
            SmoothingGroups::from_mesh(&mesh(&reversed_corners, vec![[0, 1, 6]])).corner_groups(),
            [0, 1, 2, 3, 3, 1, 4]
        );
    }

    #[test]
    fn rings_contain_each_triangle_of_a_group_once() {
        let mut random_state = 1_u32;
        let mut random = |limit: u32| {
            random_state = random_state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (random_state >> 8) % limit
        };
        for _ in 0..50 {
            let corners: Vec<_> = (0..20).map(|_| (random(9), [UP, SIDE][random(2) as usize])).collect();
            let triangles: Vec<[u32; 3]> = (0..40).map(|_| [0; 3].map(|_| random(20))).collect();
            let mesh = mesh(&corners, triangles.clone());
            let groups = SmoothingGroups::from_mesh(&mesh);
            let vertex = |corner: u32| corners[corner as usize].0;
            for group in 0..groups.group_count() {
                let mut expected_edges = Vec::new();
                for (i, triangle) in triangles.iter().flat_map(|triangle| (0..3).map(move |i| (i, triangle))) {
                    // The triangle, beginning with its corner i.
                    let [a, b, c] = [0, 1, 2].map(|offset| vertex(triangle[(i + offset) % 3]));
                    let is_in_group = groups.corner_groups()[triangle[i] as usize] as usize == group;
                    if is_in_group && a != b && b != c && c != a {
                        assert_eq!(a, groups.ring(group)[0]);
                        expected_edges.push((b, c));
                    }
                }
                expected_edges.sort_unstable();
                assert_eq!(decode_ring(groups.ring(group)), expected_edges);
            }
        }
    }

    #[test]
    fn ring_of_k_triangles_has_k_plus_two_entries() {
        // One corner, and so one group, per vertex. Group 0 is the center of six triangles; vertex 7 has no triangle.
        let corners: Vec<_> = (0..8).map(|vertex| (vertex, UP)).collect();
        let closed_fan = (1..=6).map(|vertex| [0, vertex, vertex % 6 + 1]).collect();
        let groups = SmoothingGroups::from_mesh(&mesh(&corners, closed_fan));
        assert_eq!(groups.ring(0), [0, 1 | RING_START, 2, 3, 4, 5, 6, 1]);
        assert_eq!(groups.ring(7), [7]);
        assert_eq!(groups.normals()[7], [0.0; 3]);
        let open_fan = [3, 2, 5, 4].map(|vertex| [0, vertex, vertex + 1]).into();
        let groups = SmoothingGroups::from_mesh(&mesh(&corners, open_fan));
        assert_eq!(groups.ring(0), [0, 2 | RING_START, 3, 4, 5, 6]);
    }

    #[test]
    fn geometric_normal_follows_winding_or_is_zero() {
        let rest_positions = vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [2.0, 0.0, 0.0]];
        let geometric_normal = |triangles: Vec<[u32; 3]>| {
            let mesh =
                Mesh::from_indexed(rest_positions.clone(), vec![UP; 4], vec![], triangles).expect("a valid mesh");
            SmoothingGroups::from_mesh(&mesh).normals()[0]
        };
        assert_eq!(geometric_normal(vec![[0, 1, 2]]), UP);
        assert_eq!(geometric_normal(vec![[0, 2, 1]]), [0.0, 0.0, -1.0], "winding opposite to the rest normal");
        assert_eq!(geometric_normal(vec![[0, 1, 2], [2, 1, 0]]), [0.0; 3], "two opposite triangles");
        assert_eq!(geometric_normal(vec![[0, 1, 3]]), [0.0; 3], "no area");
        assert_eq!(geometric_normal(vec![[0, 1, 1]]), [0.0; 3], "a repeated vertex");
    }

    /// 100,000 corners at one vertex: a quadratic search for groups would take too long. Their normals form a spiral
    /// around the unit sphere.
    #[test]
    fn many_groups_at_one_vertex_need_linear_memory() {
        let spiral_normal = |index: u32| {
            let (height, angle) = (index as f32 / 50_000.0 - 1.0, index as f32);
            let radius = (1.0 - height * height).sqrt();
            [radius * angle.cos(), radius * angle.sin(), height]
        };
        let corners: Vec<_> = (0..100_000).map(|index| (0, spiral_normal(index))).collect();
        let smoothing = SmoothingGroups::from_mesh(&mesh(&corners, vec![[0, 1, 2]; 100_000]));
        assert!(smoothing.group_count() > 50_000, "{} groups", smoothing.group_count());
        let group_count = smoothing.group_count() as u64;
        // The last 4 bytes are the end of the last ring in `ring_offsets`.
        assert_eq!(
            smoothing.bytes(),
            4 * 100_000 + 20 * group_count + 4,
            "expected no memory for degenerate triangles"
        );
    }
}
