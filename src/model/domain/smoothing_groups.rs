//! Smoothing groups of a mesh and the triangles around each group, from which normals of a deformed surface are
//! computed.
//!
//! Corners of one vertex whose rest normals agree within 0.1 degrees form a group: a texture seam splits corners but
//! not groups, a hard edge splits both. The triangles adjacent to a group are stored as a ring: the group's own vertex
//! first, then the vertices around it. Two consecutive vertices of a ring are, in this order, the other two vertices of
//! one triangle, unless the second has the flag [`RING_START`]. A closed fan of k triangles takes k + 2 entries instead
//! of the 2 k of a list of pairs, and each vertex is read once instead of twice.
//!
//! Memory: 4 bytes per corner; 20 bytes per group (start of its ring, own vertex and geometric normal); and 4 (k + 1)
//! bytes per group of k triangles that form one fan, or at most 24 bytes per triangle, if no two triangles of a group
//! share an edge.

use nalgebra::Vector3;

use super::Mesh;

/// Flag of the first vertex of each fan of a ring.
pub const RING_START: u32 = 1 << 31;

/// The largest number of triangles, over all shapes, whose rings a 32-bit index can address.
pub const MAX_RING_TRIANGLES: usize = 1 << 28;

/// The largest distance between rest normals of a group: the chord of 0.1 degrees.
const SAME_NORMAL_CHORD: f64 = 1.745_329e-3;

/// A group whose area vectors cancel to less than this fraction of their total length has no geometric normal, for
/// example a leaf whose two sides share corners.
const CANCELLATION_RATIO: f64 = 1.0 / 1024.0;

/// The smoothing groups of one mesh.
#[derive(Debug, Clone, PartialEq)]
pub struct SmoothingGroups {
    members: Vec<u32>,
    ring_offsets: Vec<u32>,
    rings: Vec<u32>,
    normals: Vec<[f32; 3]>,
}

/// The two other vertices of a triangle at some vertex, in winding order.
type OppositeEdge = (u32, u32);

impl SmoothingGroups {
    /// Computes the groups of a mesh with at most [`MAX_RING_TRIANGLES`] triangles, in O(c log c) for c corners.
    pub(super) fn of(mesh: &Mesh) -> Self {
        let members = number_groups(&representatives(mesh));
        let groups = members.iter().max().map_or(0, |last| *last as usize + 1);
        let mut own = vec![0; groups];
        for (group, vertex) in members.iter().zip(&mesh.corners().vertices) {
            own[*group as usize] = *vertex;
        }
        let (firsts, mut pairs) = pairs_of_groups(mesh, &members, groups);
        let mut smoothing =
            Self { members, ring_offsets: vec![0], rings: Vec::new(), normals: Vec::with_capacity(groups) };
        let mut chain = FanBuilder::default();
        for (group, own) in own.into_iter().enumerate() {
            let around = &mut pairs[firsts[group]..firsts[group + 1]];
            smoothing.normals.push(geometric_normal(mesh, own, around));
            smoothing.rings.push(own);
            chain.add(around, &mut smoothing.rings);
            smoothing.ring_offsets.push(smoothing.rings.len() as u32);
        }
        smoothing
    }

    /// The number of groups.
    pub fn groups(&self) -> usize {
        self.normals.len()
    }

    /// The group of each corner. Groups are numbered in the order of their first corners.
    pub fn corner_groups(&self) -> &[u32] {
        &self.members
    }

    /// Start of each group's ring in [`Self::rings`], and the end of the last one.
    pub fn ring_offsets(&self) -> &[u32] {
        &self.ring_offsets
    }

    /// All rings, concatenated.
    pub fn rings(&self) -> &[u32] {
        &self.rings
    }

    /// The ring of one group: its vertex, then the fans of vertices around it.
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
        (4 * (self.members.len() + self.ring_offsets.len() + self.rings.len()) + 12 * self.normals.len()) as u64
    }
}

/// For each corner, the corner that represents its group.
fn representatives(mesh: &Mesh) -> Vec<u32> {
    let corners = mesh.corners();
    let vertex = |corner: u32| corners.vertices[corner as usize];
    let normal = |corner: u32| corners.normals[corner as usize];
    let by_normal = |a: u32, b: u32| {
        let axes = normal(a).into_iter().zip(normal(b)).map(|(a, b)| a.total_cmp(&b));
        axes.fold(std::cmp::Ordering::Equal, std::cmp::Ordering::then)
    };
    let mut order: Vec<u32> = (0..corners.vertices.len() as u32).collect();
    // This order makes the groups independent of the order of corners in a file.
    order.sort_unstable_by(|a, b| vertex(*a).cmp(&vertex(*b)).then(by_normal(*a, *b)).then(a.cmp(b)));
    let mut leader_of = vec![0; order.len()];
    let mut representatives: Vec<u32> = Vec::new();
    for corner in order {
        if representatives.last().is_some_and(|leader| vertex(*leader) != vertex(corner)) {
            representatives.clear();
        }
        // Leaders ascend in x, so only a narrow band must be searched, however many corners a vertex has.
        let mut band = representatives
            .iter()
            .rev()
            .take_while(|leader| chord_distance(normal(corner), normal(**leader), 1) <= SAME_NORMAL_CHORD);
        let found =
            band.find(|leader| chord_distance(normal(corner), normal(**leader), 3) <= SAME_NORMAL_CHORD).copied();
        leader_of[corner as usize] = found.unwrap_or_else(|| {
            representatives.push(corner);
            corner
        });
    }
    leader_of
}

/// The distance of two points within their first `axes` coordinates.
fn chord_distance(a: [f32; 3], b: [f32; 3], axes: usize) -> f64 {
    (0..axes).map(|axis| (f64::from(a[axis]) - f64::from(b[axis])).powi(2)).sum::<f64>().sqrt()
}

/// Maps leaders to group numbers, in the order of the groups' first corners.
fn number_groups(leader_of: &[u32]) -> Vec<u32> {
    const NEW: u32 = u32::MAX;
    let mut numbers = vec![NEW; leader_of.len()];
    let mut count = 0;
    let group = |leader: &u32| {
        let number_groups = &mut numbers[*leader as usize];
        if *number_groups == NEW {
            *number_groups = count;
            count += 1;
        }
        *number_groups
    };
    leader_of.iter().map(group).collect()
}

/// The pairs around each group, and the start of each group's pairs. A triangle that contains a vertex twice never has
/// any area and is omitted.
fn pairs_of_groups(mesh: &Mesh, members: &[u32], groups: usize) -> (Vec<usize>, Vec<OppositeEdge>) {
    let spokes = || {
        mesh.triangles().iter().flat_map(|triangle| {
            let [a, b, c] = triangle.map(|corner| mesh.corners().vertices[corner as usize]);
            let whole = a != b && b != c && c != a;
            let around = triangle.map(|corner| members[corner as usize] as usize).into_iter();
            around.zip([(b, c), (c, a), (a, b)]).filter(move |_| whole)
        })
    };
    let mut firsts = vec![0; groups + 1];
    spokes().for_each(|(group, _)| firsts[group + 1] += 1);
    for group in 0..groups {
        firsts[group + 1] += firsts[group];
    }
    let mut next = firsts.clone();
    let mut pairs = vec![(0, 0); firsts[groups]];
    for (group, pair) in spokes() {
        pairs[next[group]] = pair;
        next[group] += 1;
    }
    (firsts, pairs)
}

fn geometric_normal(mesh: &Mesh, own: u32, pairs: &[OppositeEdge]) -> [f32; 3] {
    let at = |vertex: u32| Vector3::from(mesh.rest_positions()[vertex as usize]).cast::<f64>();
    let (mut sum, mut lengths) = (Vector3::zeros(), 0.0);
    for (from, to) in pairs {
        let area = (at(*from) - at(own)).cross(&(at(*to) - at(own)));
        sum += area;
        lengths += area.norm();
    }
    let resolved = sum.norm() > CANCELLATION_RATIO * lengths;
    sum.try_normalize(0.0).filter(|_| resolved).map_or([0.0; 3], |unit| unit.cast::<f32>().into())
}

/// Chains pairs where the end of one is the beginning of the next. Reuses its buffers for all groups.
#[derive(Default)]
struct FanBuilder {
    /// At the first pair of each beginning vertex: the number of pairs with this beginning that are in a ring already.
    taken: Vec<usize>,
    ends: Vec<u32>,
}

impl FanBuilder {
    /// Appends the fans of a group: first open fans, starting at their border, then closed ones, each in the order of
    /// vertex indices. O(k log k) for k pairs.
    fn add(&mut self, pairs: &mut [OppositeEdge], ring: &mut Vec<u32>) {
        pairs.sort_unstable();
        self.taken.clear();
        self.taken.resize(pairs.len(), 0);
        self.ends.clear();
        self.ends.extend(pairs.iter().map(|(_, to)| *to));
        self.ends.sort_unstable();
        for bordered in [true, false] {
            for (from, _) in pairs.iter() {
                if self.ends.binary_search(from).is_err() == bordered {
                    self.follow(pairs, *from, ring);
                }
            }
        }
    }

    fn follow(&mut self, pairs: &[OppositeEdge], from: u32, ring: &mut Vec<u32>) {
        let Some(mut at) = self.take(pairs, from) else { return };
        ring.extend([from | RING_START, at]);
        while let Some(next) = self.take(pairs, at) {
            ring.push(next);
            at = next;
        }
    }

    /// Takes an unused pair that begins at `from` and returns its end.
    fn take(&mut self, pairs: &[OppositeEdge], from: u32) -> Option<u32> {
        let first = pairs.partition_point(|pair| pair.0 < from);
        let taken = self.taken.get_mut(first)?;
        let (_, to) = pairs.get(first + *taken).filter(|pair| pair.0 == from)?;
        *taken += 1;
        Some(*to)
    }
}

#[cfg(test)]
mod tests {
    use super::super::Corners;
    use super::*;

    /// The pairs that a ring encodes, sorted.
    fn unrolled(ring: &[u32]) -> Vec<OppositeEdge> {
        let steps = ring[1..].windows(2).filter(|step| step[1] & RING_START == 0);
        let mut pairs: Vec<OppositeEdge> = steps.map(|step| (step[0] & !RING_START, step[1])).collect();
        pairs.sort_unstable();
        pairs
    }

    /// A mesh with the given corners (vertex, normal) and triangles over scattered positions.
    fn mesh(corners: &[(u32, [f32; 3])], triangles: Vec<[u32; 3]>) -> Mesh {
        let rest = (0..60_u32).map(|at| [at as f32, (at * at % 17) as f32, (at * 5 % 7) as f32]).collect();
        let (vertices, normals) = corners.iter().copied().unzip();
        Mesh::new(rest, Corners { vertices, normals, uvs: vec![] }, triangles).expect("a mesh")
    }

    const UP: [f32; 3] = [0.0, 0.0, 1.0];
    const SIDE: [f32; 3] = [1.0, 0.0, 0.0];

    #[test]
    fn corners_group_by_vertex_and_rest_normal_whatever_their_order() {
        let degrees = |angle: f32| [angle.to_radians().sin(), 0.0, angle.to_radians().cos()];
        let corners = [(3, SIDE), (5, UP), (3, degrees(0.09)), (3, UP), (3, degrees(0.3)), (5, UP), (4, UP)];
        let groups = SmoothingGroups::of(&mesh(&corners, vec![[0, 1, 6]]));
        assert_eq!(groups.corner_groups(), [0, 1, 2, 2, 3, 1, 4]);
        let mut turned = corners;
        turned.reverse();
        assert_eq!(SmoothingGroups::of(&mesh(&turned, vec![[0, 1, 6]])).corner_groups(), [0, 1, 2, 3, 3, 1, 4]);
    }

    #[test]
    fn rings_hold_each_triangle_of_each_group_once_in_its_winding() {
        let mut number_groups = 1_u32;
        let mut random = |below: u32| {
            number_groups = number_groups.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (number_groups >> 8) % below
        };
        for _ in 0..50 {
            let corners: Vec<_> = (0..20).map(|_| (random(9), [UP, SIDE][random(2) as usize])).collect();
            let triangles: Vec<[u32; 3]> = (0..40).map(|_| [0; 3].map(|_| random(20))).collect();
            let mesh = mesh(&corners, triangles.clone());
            let smoothing = SmoothingGroups::of(&mesh);
            let vertex = |corner: u32| corners[corner as usize].0;
            for group in 0..smoothing.groups() {
                let mut want = Vec::new();
                for (at, triangle) in triangles.iter().flat_map(|triangle| (0..3).map(move |at| (at, triangle))) {
                    let [a, b, c] = [0, 1, 2].map(|step| vertex(triangle[(at + step) % 3]));
                    if smoothing.corner_groups()[triangle[at] as usize] as usize == group && a != b && b != c && c != a
                    {
                        assert_eq!(a, smoothing.ring(group)[0]);
                        want.push((b, c));
                    }
                }
                want.sort_unstable();
                assert_eq!(unrolled(smoothing.ring(group)), want);
            }
        }
    }

    #[test]
    fn a_closed_fan_of_six_takes_eight_entries_an_open_one_of_four_six_and_no_triangle_one() {
        let corners: Vec<_> = (0..8).map(|vertex| (vertex, UP)).collect();
        let closed = (1..=6).map(|at| [0, at, at % 6 + 1]).collect();
        let smoothing = SmoothingGroups::of(&mesh(&corners, closed));
        assert_eq!(smoothing.ring(0), [0, 1 | RING_START, 2, 3, 4, 5, 6, 1]);
        assert_eq!(smoothing.ring(7), [7]);
        assert_eq!(smoothing.normals()[7], [0.0; 3]);
        let open = [3, 2, 5, 4].map(|at| [0, at, at + 1]).into();
        let smoothing = SmoothingGroups::of(&mesh(&corners, open));
        assert_eq!(smoothing.ring(0), [0, 2 | RING_START, 3, 4, 5, 6]);
    }

    #[test]
    fn the_geometric_normal_is_that_of_the_winding_and_none_where_two_sides_cancel() {
        let rest = vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [2.0, 0.0, 0.0]];
        let of = |triangles: Vec<[u32; 3]>| {
            let mesh = Mesh::from_indexed(rest.clone(), vec![UP; 4], vec![], triangles).expect("a mesh");
            SmoothingGroups::of(&mesh).normals()[0]
        };
        assert_eq!(of(vec![[0, 1, 2]]), UP);
        assert_eq!(of(vec![[0, 2, 1]]), [0.0, 0.0, -1.0], "against the rest normal");
        assert_eq!(of(vec![[0, 1, 2], [2, 1, 0]]), [0.0; 3], "both sides");
        assert_eq!(of(vec![[0, 1, 3]]), [0.0; 3], "no area");
        assert_eq!(of(vec![[0, 1, 1]]), [0.0; 3], "a vertex twice");
    }

    #[test]
    fn memory_is_what_the_lists_have_and_a_crowd_at_one_vertex_is_quick() {
        let turn = |at: u32| {
            let (height, angle) = (at as f32 / 50_000.0 - 1.0, at as f32);
            let radius = (1.0 - height * height).sqrt();
            [radius * angle.cos(), radius * angle.sin(), height]
        };
        let corners: Vec<_> = (0..100_000).map(|at| (0, turn(at))).collect();
        let smoothing = SmoothingGroups::of(&mesh(&corners, vec![[0, 1, 2]; 100_000]));
        assert!(smoothing.groups() > 50_000, "{} groups", smoothing.groups());
        let groups = smoothing.groups() as u64;
        assert_eq!(smoothing.bytes(), 4 * 100_000 + 20 * groups + 4, "a triangle that names a vertex thrice adds none");
    }
}
