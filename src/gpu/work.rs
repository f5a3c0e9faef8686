//! A scene to the work list of `deform`: one tile per warp, whatever domains it holds. Pure.
//!
//! A tile computes vertices, or corners, or both where corner i of a shape is its vertex i.
//! A shape of more than [`SMALL`] quads, or one with modes that several domains share, is cut into tiles of its own, and
//! its U lies on the device once. The quads of smaller domains with the same number of chunks fill tiles together, so
//! that 200,000 leaves keep all lanes busy. Tiles with the most chunks come first: a long tile that began last would be
//! waited for.

use super::layout::{Lane, TILE_CORNERS, TILE_VERTICES, Tile};
use crate::domain::Shape;
use crate::scene::{Scene, Storage};
use crate::storage::{Plane, TILE_QUADS, Tiles, modes_per_chunk};

/// The most quads of a domain that shares a tile with others.
const SMALL: usize = TILE_QUADS / 2;

/// Vertices of a quad.
const QUAD: usize = crate::storage::QUAD;

/// What lies in the words, in order.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Source {
    /// All tiles of a shape.
    Shape(usize),
    /// The quads of these shapes side by side.
    Mixed(Vec<usize>),
}

/// The work list, and where everything it names lies.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Work {
    pub tiles: Vec<Tile>,
    pub lanes: Vec<Lane>,
    /// The first scale of each lane; only with `Int8`.
    pub lane_scales: Vec<u32>,
    pub sources: Vec<Source>,
    /// Words of 16 bytes.
    pub words: u64,
    pub quads: Quads,
    /// Of each shape, its first scale, and the scales of all.
    pub first_scale: Vec<u32>,
    pub scales: u64,
    /// Of each domain, the first and the count of its tiles of vertices, and of those of corners alone.
    pub spans: Vec<[(u32, u32); 2]>,
}

/// Where quads of x0, normals and tangents lie: first x0 of shapes whose corners are others than their vertices, then
/// x0, normals and tangents of those whose corner i is vertex i, then normals and tangents of the others.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Quads {
    /// Of each shape, its first quad of x0.
    pub vertices: Vec<u32>,
    /// Of each shape, its first quad of normals and tangents.
    pub corners: Vec<u32>,
    /// Quads of x0, and the first that has normals.
    pub rest: u64,
    pub directed: u64,
    /// The end of all quads.
    pub end: u64,
}

impl Quads {
    fn new(scene: &Scene) -> Self {
        let orients = orients(scene);
        let places = |own: &dyn Fn(&Shape) -> Option<usize>, next: &mut u64| -> Vec<u32> {
            let place = |shape| {
                let first = *next;
                *next += own(shape).map_or(0, |items| items.div_ceil(QUAD)) as u64;
                first as u32
            };
            scene.shapes.iter().map(place).collect()
        };
        let (mut next, unlike) = (0, |shape: &Shape| !is_alike(shape));
        let vertices = |shape: &Shape| shape.mesh.rest().len();
        let before = places(&|shape| unlike(shape).then(|| vertices(shape)), &mut next);
        let directed = next;
        let alike = places(&|shape| is_alike(shape).then(|| vertices(shape)), &mut next);
        let rest = next;
        let corners = |shape: &Shape| shape.mesh.corners().vertices.len();
        let behind = places(&|shape| (orients && unlike(shape)).then(|| corners(shape)), &mut next);
        let choose = |others: &[u32]| {
            let each = scene.shapes.iter().zip(&alike).zip(others);
            each.map(|((shape, alike), other)| if is_alike(shape) { *alike } else { *other }).collect()
        };
        Self { vertices: choose(&before), corners: choose(&behind), rest, directed, end: next }
    }
}

/// Whether corner i of a shape is its vertex i, so that one lane has both.
pub(super) fn is_alike(shape: &Shape) -> bool {
    let corners = &shape.mesh.corners().vertices;
    corners.len() == shape.mesh.rest().len() && corners.iter().enumerate().all(|(at, vertex)| at as u32 == *vertex)
}

/// Whether `deform` turns normals; those that follow the surface come after it.
pub(super) fn orients(scene: &Scene) -> bool {
    !scene.needs.exact_normals
}

/// Where a domain's coordinates lie on the device: whole chunks of them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Coordinates {
    /// Of each domain.
    pub first: Vec<u32>,
    /// Numbers of all, a multiple of four.
    pub total: usize,
    /// Whether they lie as in the scene's own packing.
    pub as_packed: bool,
}

impl Coordinates {
    pub(super) fn new(scene: &Scene) -> Self {
        let storage = scene.deformation.storage;
        // Factors belong to a shape and lists of modes to a domain, so those who share coordinates cannot share these.
        if storage == Storage::F32 && !scene.needs.truncation {
            let first = scene.layout.slots.iter().map(|slot| slot.first_q as u32).collect();
            return Self { first, total: scene.layout.coordinates.next_multiple_of(4), as_packed: true };
        }
        let mut total = 0;
        let place = |slot: &crate::scene::Slot| {
            let first = total;
            total += slot.rank.next_multiple_of(modes_per_chunk(storage));
            first as u32
        };
        let first = scene.layout.slots.iter().map(place).collect();
        Self { first, total: total.next_multiple_of(4), as_packed: false }
    }
}

/// What a domain's tile computes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Role {
    chunks: usize,
    /// Parts of [`Tile`]'s kind.
    flags: u8,
}

/// One tile before it has its place: of one domain, or of the whole of several.
enum Item {
    Own { domain: usize, tile: usize },
    Mixed(Vec<usize>),
}

impl Work {
    pub(super) fn new(scene: &Scene, coordinates: &Coordinates) -> Self {
        let mut items = items(scene);
        items.sort_by_key(|(role, _)| std::cmp::Reverse(role.chunks));
        let mut work = Self::empty(scene);
        let mut first_words: Vec<Option<u64>> = vec![None; scene.shapes.len()];
        for (role, item) in items {
            let index = work.tiles.len() as u32;
            match item {
                Item::Own { domain, tile } => {
                    let first_word =
                        work.place_words(scene, scene.domains[domain].shape, role.chunks, &mut first_words);
                    let own = work.own_tile(scene, coordinates, role, (domain, tile));
                    let before = (3 * role.chunks * TILE_QUADS * tile) as u64;
                    work.tiles.push(Tile { first_word: first_word + before, ..own });
                    work.note_span(domain, role, index);
                }
                Item::Mixed(domains) => {
                    work.push_mixed(scene, coordinates, role, &domains);
                    domains.iter().for_each(|domain| work.note_span(*domain, role, index));
                }
            }
        }
        if scene.deformation.storage != Storage::Int8 {
            work.lane_scales.clear();
        }
        work
    }

    /// Room for scales of every shape, and no tiles yet.
    fn empty(scene: &Scene) -> Self {
        let storage = scene.deformation.storage;
        let (mut scales, mut first_scale) = (0_u64, Vec::new());
        for shape in &scene.shapes {
            first_scale.push(scales as u32);
            if storage == Storage::Int8 {
                let per_tile = shape.modes.rank().next_multiple_of(modes_per_chunk(storage));
                scales += (per_tile * quads_of(shape).div_ceil(TILE_QUADS)) as u64;
            }
        }
        Self {
            tiles: Vec::new(),
            lanes: Vec::new(),
            lane_scales: Vec::new(),
            sources: Vec::new(),
            words: 0,
            quads: Quads::new(scene),
            first_scale,
            scales,
            spans: vec![[(0, 0); 2]; scene.domains.len()],
        }
    }

    /// The first word of a shape that is stored by itself; its place is taken at the first call.
    fn place_words(&mut self, scene: &Scene, shape: usize, chunks: usize, places: &mut [Option<u64>]) -> u64 {
        if chunks == 0 {
            return 0;
        }
        *places[shape].get_or_insert_with(|| {
            self.sources.push(Source::Shape(shape));
            let first = self.words;
            self.words += (3 * chunks * quads_of(&scene.shapes[shape])) as u64;
            first
        })
    }

    /// The tiles of a domain's role follow each other.
    fn note_span(&mut self, domain: usize, role: Role, index: u32) {
        let (first, count) = &mut self.spans[domain][usize::from(role.flags & TILE_VERTICES == 0)];
        if *count == 0 {
            *first = index;
        }
        *count += 1;
    }

    fn own_tile(&self, scene: &Scene, coordinates: &Coordinates, role: Role, (domain, tile): (usize, usize)) -> Tile {
        let place = self.place(scene, role, domain);
        let items = place.items - QUAD * TILE_QUADS * tile;
        let width = items.div_ceil(QUAD).min(TILE_QUADS);
        let shape = scene.domains[domain].shape;
        let scales = if role.chunks == 0 { 0 } else { tile * role.chunks * modes_per_chunk(scene.deformation.storage) };
        Tile {
            first_word: 0,
            first: place.first + (QUAD * TILE_QUADS * tile) as u32,
            rest: place.rest + (TILE_QUADS * tile) as u32,
            domain: domain as u32,
            first_q: coordinates.first[domain],
            first_scale: self.first_scale[shape] + scales as u32,
            chunks: role.chunks as u16,
            width: width as u8,
            kind: role.flags | (items.min(QUAD * TILE_QUADS) - QUAD * (width - 1)) as u8,
        }
    }

    fn push_mixed(&mut self, scene: &Scene, coordinates: &Coordinates, role: Role, domains: &[usize]) {
        let first = self.lanes.len() as u32;
        for domain in domains {
            let place = self.place(scene, role, *domain);
            for quad in 0..place.items.div_ceil(QUAD) {
                let count = (place.items - QUAD * quad).min(QUAD);
                self.lanes.push(Lane {
                    item: place.first + (QUAD * quad) as u32,
                    rest: place.rest + quad as u32,
                    domain: (QUAD * domain + count - 1) as u32,
                    first_q: coordinates.first[*domain],
                });
                self.lane_scales.push(self.first_scale[scene.domains[*domain].shape]);
            }
        }
        let width = self.lanes.len() as u32 - first;
        self.tiles.push(Tile {
            first_word: self.words,
            first,
            rest: 0,
            domain: 0,
            first_q: 0,
            first_scale: 0,
            chunks: role.chunks as u16,
            width: width as u8,
            kind: role.flags,
        });
        if role.chunks > 0 {
            self.sources.push(Source::Mixed(domains.iter().map(|domain| scene.domains[*domain].shape).collect()));
            self.words += (3 * role.chunks) as u64 * u64::from(width);
        }
    }

    /// The vertices of a domain, or its corners in a tile of corners alone.
    fn place(&self, scene: &Scene, role: Role, domain: usize) -> Place {
        let (slot, shape) = (scene.layout.slots[domain], scene.domains[domain].shape);
        if role.flags & TILE_VERTICES > 0 {
            Place { items: slot.vertices, first: slot.first_vertex as u32, rest: self.quads.vertices[shape] }
        } else {
            Place { items: slot.corners, first: slot.first_corner as u32, rest: self.quads.corners[shape] }
        }
    }
}

/// Items of a domain, the first packed one, and the first quad of what they are at rest.
struct Place {
    items: usize,
    first: u32,
    rest: u32,
}

/// Every tile with its role, in the order of the domains.
fn items(scene: &Scene) -> Vec<(Role, Item)> {
    let mut users = vec![0_usize; scene.shapes.len()];
    scene.domains.iter().for_each(|domain| users[domain.shape] += 1);
    let alike: Vec<bool> = scene.shapes.iter().map(is_alike).collect();
    let mut items = Vec::new();
    // Per role, the domains that wait for their tile to fill up, and its quads.
    let mut open: std::collections::BTreeMap<Role, (Vec<usize>, usize)> = std::collections::BTreeMap::new();
    let mut add = |domain: usize, role: Role, count: usize, alone: bool| {
        let quads = count.div_ceil(QUAD);
        if quads > SMALL || alone {
            items.extend((0..quads.div_ceil(TILE_QUADS)).map(|tile| (role, Item::Own { domain, tile })));
            return;
        }
        let (waiting, filled) = open.entry(role).or_default();
        if *filled + quads > TILE_QUADS {
            items.push((role, Item::Mixed(std::mem::take(waiting))));
            *filled = 0;
        }
        waiting.push(domain);
        *filled += quads;
    };
    for (index, domain) in scene.domains.iter().enumerate() {
        let (shape, slot) = (&scene.shapes[domain.shape], scene.layout.slots[index]);
        let chunks = chunks_of(scene, shape);
        let both = orients(scene) && alike[domain.shape];
        let flags = TILE_VERTICES | if both { TILE_CORNERS } else { 0 };
        add(index, Role { chunks, flags }, slot.vertices, chunks > 0 && users[domain.shape] > 1);
        if orients(scene) && !both {
            add(index, Role { chunks: 0, flags: TILE_CORNERS }, slot.corners, false);
        }
    }
    let rest: Vec<_> = open.into_iter().map(|(role, (waiting, _))| (role, Item::Mixed(waiting))).collect();
    items.extend(rest);
    items
}

/// From a domain's first vertex to its first corner, wrapping; empty when all are at the same place.
pub(super) fn corner_shifts(scene: &Scene) -> Vec<u32> {
    let shift = |slot: &crate::scene::Slot| (slot.first_corner as u32).wrapping_sub(slot.first_vertex as u32);
    let shifts: Vec<u32> = scene.layout.slots.iter().map(shift).collect();
    if orients(scene) && shifts.iter().any(|shift| *shift != 0) { shifts } else { Vec::new() }
}

fn quads_of(shape: &Shape) -> usize {
    shape.mesh.rest().len().div_ceil(QUAD)
}

fn chunks_of(scene: &Scene, shape: &Shape) -> usize {
    shape.modes.rank().div_ceil(modes_per_chunk(scene.deformation.storage))
}

/// The quads of whole small shapes side by side: [chunk][3][width], from [chunk][3][own width] of each.
pub(super) fn side_by_side(shapes: &[Tiles]) -> Vec<Plane> {
    let rows = 3 * shapes.first().map_or(0, Tiles::chunks);
    let mut words = Vec::with_capacity(shapes.iter().map(|tiles| tiles.planes().len()).sum());
    for row in 0..rows {
        for tiles in shapes {
            let width = tiles.quads();
            words.extend_from_slice(&tiles.planes()[row * width..][..width]);
        }
    }
    words
}

#[cfg(test)]
mod tests {
    use super::super::layout::TILE_LAST;
    use super::super::pack::tests::{scene, stored};
    use super::*;
    use std::sync::Arc;

    /// What lies in the words, scales and x0 of a scene, as `deform` loads them.
    struct Loaded {
        words: Vec<Plane>,
        scales: Vec<f32>,
        rest: Vec<[f32; 12]>,
        factors: Vec<Vec<f32>>,
    }

    fn load(scene: &Scene, work: &Work) -> Loaded {
        let tiles = |shape: usize| Tiles::new(&scene.shapes[shape], scene.deformation.storage);
        let mut loaded = Loaded {
            words: Vec::new(),
            scales: vec![0.0; work.scales as usize],
            rest: vec![[0.0; 12]; work.quads.rest as usize],
            factors: Vec::new(),
        };
        for source in &work.sources {
            match source {
                Source::Shape(shape) => loaded.words.extend_from_slice(tiles(*shape).planes()),
                Source::Mixed(shapes) => {
                    loaded.words.extend(side_by_side(&shapes.iter().map(|shape| tiles(*shape)).collect::<Vec<_>>()));
                }
            }
        }
        for shape in 0..scene.shapes.len() {
            let own = tiles(shape);
            loaded.scales[work.first_scale[shape] as usize..][..own.scales().len()].copy_from_slice(own.scales());
            loaded.rest[work.quads.vertices[shape] as usize..][..own.rest().len()].copy_from_slice(own.rest());
            loaded.factors.push(own.factors().to_vec());
        }
        loaded
    }

    /// A lane as the kernel sees it: domain, first item, items, first quad of x0, first q, first scale.
    fn lane(work: &Work, tile: &Tile, quad: usize) -> (usize, u32, usize, u32, u32, u32) {
        let last = usize::from(tile.kind & TILE_LAST);
        if last > 0 {
            let count = if quad + 1 == usize::from(tile.width) { last } else { 4 };
            let step = quad as u32;
            let item = tile.first + 4 * step;
            (tile.domain as usize, item, count, tile.rest + step, tile.first_q, tile.first_scale)
        } else {
            let at = tile.first as usize + quad;
            let lane = work.lanes[at];
            let scale = work.lane_scales.get(at).copied().unwrap_or(0);
            let (domain, count) = ((lane.domain / 4) as usize, 1 + lane.domain as usize % 4);
            (domain, lane.item, count, lane.rest, lane.first_q, scale)
        }
    }

    /// Counts the tiles that compute each packed corner, and checks where they look for its rest normal.
    fn check_corners(scene: &Scene, work: &Work) {
        let mut seen = vec![0; scene.layout.corners];
        let shifts = corner_shifts(scene);
        for tile in work.tiles.iter().filter(|tile| tile.kind & TILE_CORNERS > 0) {
            for quad in 0..usize::from(tile.width) {
                let (domain, item, count, rest, ..) = lane(work, tile, quad);
                let both = tile.kind & TILE_VERTICES > 0;
                let shift = if both { shifts.get(domain).copied().unwrap_or(0) } else { 0 };
                let slot = scene.layout.slots[domain];
                for within in 0..count {
                    let corner = item.wrapping_add(shift) as usize + within;
                    seen[corner] += 1;
                    let quad = work.quads.corners[scene.domains[domain].shape] as usize;
                    assert_eq!(rest as usize, quad + (corner - slot.first_corner) / 4);
                    assert!(rest as u64 >= work.quads.directed && (rest as u64) < work.quads.end);
                }
            }
        }
        assert!(seen.iter().all(|times| *times == 1), "every corner is computed once");
    }

    /// Walks the work list as the kernel does and checks that every vertex finds its x0, its entries and its q.
    fn check(scene: &Arc<Scene>) -> Work {
        let coordinates = Coordinates::new(scene);
        let work = Work::new(scene, &coordinates);
        let loaded = load(scene, &work);
        assert_eq!(loaded.words.len() as u64, work.words);
        let per_chunk = modes_per_chunk(scene.deformation.storage);
        let mut seen = vec![0; scene.layout.vertices];
        check_corners(scene, &work);
        for (index, tile) in work.tiles.iter().enumerate().filter(|(_, tile)| tile.kind & TILE_VERTICES > 0) {
            assert!((1..=TILE_QUADS).contains(&usize::from(tile.width)));
            for quad in 0..usize::from(tile.width) {
                let (domain, first, count, rest, first_q, first_scale) = lane(&work, tile, quad);
                let shape = &scene.shapes[scene.domains[domain].shape];
                assert_eq!(first_q, coordinates.first[domain]);
                let (begin, tiles) = work.spans[domain][0];
                assert!((begin..begin + tiles).contains(&(index as u32)), "the domain knows its tiles");
                assert_eq!(usize::from(tile.chunks), shape.modes.rank().div_ceil(per_chunk));
                for within in 0..count {
                    let packed = first as usize + within;
                    seen[packed] += 1;
                    let vertex = packed - scene.layout.slots[domain].first_vertex;
                    for axis in 0..3 {
                        assert_eq!(loaded.rest[rest as usize][4 * axis + within], shape.mesh.rest()[vertex][axis]);
                        for mode in 0..shape.modes.rank() {
                            let size = 4 / per_chunk;
                            let byte = ((mode % per_chunk * 3 + axis) * 4 + within) * size;
                            let row = mode / per_chunk * 3 + byte / 16;
                            let at = tile.first_word as usize + row * usize::from(tile.width) + quad;
                            let bytes = &loaded.words[at].0[byte % 16..][..size];
                            let factor = loaded.factors[scene.domains[domain].shape].get(mode).copied();
                            let got = match scene.deformation.storage {
                                Storage::F32 => bytemuck::pod_read_unaligned::<f32>(bytes),
                                Storage::F16 => half::f16::from_le_bytes([bytes[0], bytes[1]]).to_f32(),
                                Storage::Bf16 => half::bf16::from_le_bytes([bytes[0], bytes[1]]).to_f32(),
                                Storage::Int8 => {
                                    (f32::from(bytes[0]) - 128.0) * loaded.scales[first_scale as usize + mode]
                                }
                            };
                            let (got, want) = (got * factor.unwrap_or(1.0), shape.modes.at(vertex, axis, mode));
                            assert!((got - want).abs() <= want.abs() / 100.0 + 1.0, "{got} is not {want}");
                        }
                    }
                }
            }
        }
        assert!(seen.iter().all(|times| *times == 1), "every vertex is computed once");
        work
    }

    const SHAPES: [(usize, usize); 7] = [(7, 2), (300, 0), (1, 5), (513, 1), (130, 33), (64, 2), (65, 2)];

    #[test]
    fn every_vertex_finds_its_entries_whatever_the_storage_and_the_tile() {
        for storage in Storage::ALL {
            check(&stored(&SHAPES, storage));
        }
    }

    #[test]
    fn small_rigid_domains_fill_tiles_together_and_those_with_modes_do_unless_they_share_them() {
        let vertices = |work: &Work| -> Vec<Tile> {
            work.tiles.iter().filter(|tile| tile.kind & TILE_VERTICES > 0).copied().collect()
        };
        // Two instances of each: those with modes share U and stay apart.
        let work = check(&scene(&[(7, 0); 40], false, false));
        assert_eq!(vertices(&work).len(), 80 * 2 / 32);
        assert!(vertices(&work).iter().all(|tile| (tile.kind & TILE_LAST, tile.width) == (0, 32)));
        let work = check(&scene(&[(7, 3); 40], false, false));
        assert_eq!((vertices(&work).len(), work.words), (80, 40 * 2 * 3 * 3));
        let work = check(&single(&[(7, 3); 80]));
        assert_eq!((vertices(&work).len(), work.words), (80 * 2 / 32, 80 * 2 * 3 * 3));
    }

    #[test]
    fn corners_that_are_the_vertices_share_their_tiles_and_have_no_room_of_their_own() {
        let work = check(&super::super::pack::tests::alike(&[(7, 2), (300, 0), (9, 0)]));
        assert!(work.tiles.iter().all(|tile| tile.kind & !TILE_LAST == TILE_VERTICES | TILE_CORNERS));
        assert_eq!((work.quads.directed, work.quads.end), (0, work.quads.rest));
        let work = check(&single(&[(7, 2), (300, 0)]));
        assert!(work.tiles.iter().all(|tile| [TILE_VERTICES, TILE_CORNERS].contains(&(tile.kind & !TILE_LAST))));
    }

    /// Every shape used by one domain.
    fn single(shapes: &[(usize, usize)]) -> Arc<Scene> {
        super::super::pack::tests::used_once(shapes)
    }

    #[test]
    fn tiles_with_the_most_modes_come_first() {
        let work = check(&single(&[(7, 1), (700, 9), (9, 0), (200, 40), (8, 9)]));
        let chunks: Vec<u16> = work.tiles.iter().map(|tile| tile.chunks).collect();
        assert!(chunks.windows(2).all(|pair| pair[0] >= pair[1]), "{chunks:?}");
        assert_eq!((chunks[0], chunks[chunks.len() - 1]), (40, 0));
    }

    #[test]
    fn coordinates_fill_whole_chunks_unless_chunks_are_single_modes() {
        let shapes = [(7, 3), (9, 5)];
        let packed = Coordinates::new(&stored(&shapes, Storage::F32));
        assert_eq!((packed.first.as_slice(), packed.total, packed.as_packed), ([0, 3, 6, 11].as_slice(), 16, true));
        let chunked = Coordinates::new(&stored(&shapes, Storage::Int8));
        assert_eq!((chunked.first.as_slice(), chunked.total), ([0, 4, 8, 16].as_slice(), 24));
    }
}
