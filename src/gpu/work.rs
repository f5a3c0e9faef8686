//! A scene to the work list of `deform`: one tile per warp, whatever domains it holds. Pure.
//!
//! A shape of more than [`SMALL`] quads, or one with modes that several domains share, is cut into tiles of its own, and
//! its U lies on the device once. The quads of smaller domains with the same number of chunks fill tiles together, so
//! that 200,000 leaves keep all lanes busy. Tiles with the most chunks come first: a long tile that began last would be
//! waited for.

use super::layout::{Lane, Tile};
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
    /// Of each shape, its first quad of x0, and the quads of all.
    pub first_rest: Vec<u32>,
    pub rest: u64,
    /// Of each shape, its first scale, and the scales of all.
    pub first_scale: Vec<u32>,
    pub scales: u64,
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

/// One tile before it has its place: of one domain, or of the whole of several.
enum Item {
    Own { domain: usize, tile: usize },
    Mixed(Vec<usize>),
}

impl Work {
    pub(super) fn new(scene: &Scene, coordinates: &Coordinates) -> Self {
        let mut items = items(scene);
        items.sort_by_key(|(chunks, _)| std::cmp::Reverse(*chunks));
        let storage = scene.deformation.storage;
        let mut work = Self::empty(scene);
        let mut first_words: Vec<Option<u64>> = vec![None; scene.shapes.len()];
        for (chunks, item) in items {
            match item {
                Item::Own { domain, tile } => {
                    let shape = scene.domains[domain].shape;
                    let first_word = *first_words[shape].get_or_insert_with(|| {
                        if chunks > 0 {
                            work.sources.push(Source::Shape(shape));
                        }
                        let first = work.words;
                        work.words += (3 * chunks * quads_of(&scene.shapes[shape])) as u64;
                        first
                    });
                    let own = work.own_tile(scene, coordinates, (domain, tile));
                    let before = (3 * chunks * TILE_QUADS * tile) as u64;
                    work.tiles.push(Tile { first_word: first_word + before, ..own });
                }
                Item::Mixed(domains) => work.push_mixed(scene, coordinates, &domains, chunks),
            }
        }
        if storage != Storage::Int8 {
            work.lane_scales.clear();
        }
        work
    }

    /// Room for x0 and scales of every shape, and no tiles yet.
    fn empty(scene: &Scene) -> Self {
        let storage = scene.deformation.storage;
        let (mut rest, mut scales) = (0_u64, 0_u64);
        let (mut first_rest, mut first_scale) = (Vec::new(), Vec::new());
        for shape in &scene.shapes {
            first_rest.push(rest as u32);
            first_scale.push(scales as u32);
            rest += quads_of(shape) as u64;
            if storage == Storage::Int8 {
                let per_tile = shape.modes.rank().next_multiple_of(modes_per_chunk(storage));
                scales += (per_tile * quads_of(shape).div_ceil(TILE_QUADS)) as u64;
            }
        }
        let (tiles, lanes, lane_scales, sources) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        Self { tiles, lanes, lane_scales, sources, words: 0, first_rest, rest, first_scale, scales }
    }

    fn own_tile(&self, scene: &Scene, coordinates: &Coordinates, (domain, tile): (usize, usize)) -> Tile {
        let shape = scene.domains[domain].shape;
        let vertices = scene.shapes[shape].mesh.rest().len() - QUAD * TILE_QUADS * tile;
        let width = vertices.div_ceil(QUAD).min(TILE_QUADS);
        let rank = scene.shapes[shape].modes.rank();
        let per_chunk = modes_per_chunk(scene.deformation.storage);
        Tile {
            first_word: 0,
            first: (scene.layout.slots[domain].first_vertex + QUAD * TILE_QUADS * tile) as u32,
            rest: self.first_rest[shape] + (TILE_QUADS * tile) as u32,
            domain: domain as u32,
            first_q: coordinates.first[domain],
            first_scale: self.first_scale[shape] + (tile * rank.next_multiple_of(per_chunk)) as u32,
            chunks: rank.div_ceil(per_chunk) as u16,
            width: width as u8,
            kind: (vertices.min(QUAD * TILE_QUADS) - QUAD * (width - 1)) as u8,
        }
    }

    fn push_mixed(&mut self, scene: &Scene, coordinates: &Coordinates, domains: &[usize], chunks: usize) {
        let first = self.lanes.len() as u32;
        for domain in domains {
            let shape = scene.domains[*domain].shape;
            let vertices = scene.shapes[shape].mesh.rest().len();
            for quad in 0..vertices.div_ceil(QUAD) {
                let count = (vertices - QUAD * quad).min(QUAD);
                self.lanes.push(Lane {
                    vertex: (scene.layout.slots[*domain].first_vertex + QUAD * quad) as u32,
                    rest: self.first_rest[shape] + quad as u32,
                    domain: (QUAD * domain + count - 1) as u32,
                    first_q: coordinates.first[*domain],
                });
                self.lane_scales.push(self.first_scale[shape]);
            }
        }
        let width = self.lanes.len() as u32 - first;
        let (chunks16, first_word) = (chunks as u16, self.words);
        let (rest, domain, first_q, first_scale) = (0, 0, 0, 0);
        let width8 = width as u8;
        self.tiles.push(Tile {
            first_word,
            first,
            rest,
            domain,
            first_q,
            first_scale,
            chunks: chunks16,
            width: width8,
            kind: 0,
        });
        if chunks > 0 {
            self.sources.push(Source::Mixed(domains.iter().map(|domain| scene.domains[*domain].shape).collect()));
            self.words += (3 * chunks) as u64 * u64::from(width);
        }
    }
}

/// Every tile with its chunks, in the order of the domains.
fn items(scene: &Scene) -> Vec<(usize, Item)> {
    let mut users = vec![0_usize; scene.shapes.len()];
    scene.domains.iter().for_each(|domain| users[domain.shape] += 1);
    let mut items = Vec::new();
    // Per number of chunks, the domains that wait for their tile to fill up, and its quads.
    let mut open: std::collections::BTreeMap<usize, (Vec<usize>, usize)> = std::collections::BTreeMap::new();
    for (index, domain) in scene.domains.iter().enumerate() {
        let shape = &scene.shapes[domain.shape];
        let (quads, chunks) = (quads_of(shape), chunks_of(scene, shape));
        if quads > SMALL || (chunks > 0 && users[domain.shape] > 1) {
            items.extend((0..quads.div_ceil(TILE_QUADS)).map(|tile| (chunks, Item::Own { domain: index, tile })));
            continue;
        }
        let (waiting, filled) = open.entry(chunks).or_default();
        if *filled + quads > TILE_QUADS {
            items.push((chunks, Item::Mixed(std::mem::take(waiting))));
            *filled = 0;
        }
        waiting.push(index);
        *filled += quads;
    }
    items.extend(open.into_iter().map(|(chunks, (waiting, _))| (chunks, Item::Mixed(waiting))));
    items
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
            rest: vec![[0.0; 12]; work.rest as usize],
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
            loaded.rest[work.first_rest[shape] as usize..][..own.rest().len()].copy_from_slice(own.rest());
            loaded.factors.push(own.factors().to_vec());
        }
        loaded
    }

    /// A lane as the kernel sees it: domain, first vertex, vertices, first quad of x0, first q, first scale.
    fn lane(work: &Work, tile: &Tile, quad: usize) -> (usize, u32, usize, u32, u32, u32) {
        if tile.kind > 0 {
            let last = quad + 1 == usize::from(tile.width);
            let count = if last { usize::from(tile.kind) } else { 4 };
            let step = quad as u32;
            let vertex = tile.first + 4 * step;
            (tile.domain as usize, vertex, count, tile.rest + step, tile.first_q, tile.first_scale)
        } else {
            let at = tile.first as usize + quad;
            let lane = work.lanes[at];
            let scale = work.lane_scales.get(at).copied().unwrap_or(0);
            let (domain, count) = ((lane.domain / 4) as usize, 1 + lane.domain as usize % 4);
            (domain, lane.vertex, count, lane.rest, lane.first_q, scale)
        }
    }

    /// Walks the work list as the kernel does and checks that every vertex finds its x0, its entries and its q.
    fn check(scene: &Arc<Scene>) -> Work {
        let coordinates = Coordinates::new(scene);
        let work = Work::new(scene, &coordinates);
        let loaded = load(scene, &work);
        assert_eq!(loaded.words.len() as u64, work.words);
        let per_chunk = modes_per_chunk(scene.deformation.storage);
        let mut seen = vec![0; scene.layout.vertices];
        for tile in &work.tiles {
            assert!((1..=TILE_QUADS).contains(&usize::from(tile.width)));
            for quad in 0..usize::from(tile.width) {
                let (domain, first, count, rest, first_q, first_scale) = lane(&work, tile, quad);
                let shape = &scene.shapes[scene.domains[domain].shape];
                assert_eq!(first_q, coordinates.first[domain]);
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
        // Two instances of each: those with modes share U and stay apart.
        let work = check(&scene(&[(7, 0); 40], false, false));
        assert_eq!(work.tiles.len(), 80 * 2 / 32);
        assert!(work.tiles.iter().all(|tile| (tile.kind, tile.width) == (0, 32)));
        let work = check(&scene(&[(7, 3); 40], false, false));
        assert_eq!((work.tiles.len(), work.words), (80, 40 * 2 * 3 * 3));
        let alone = single(&[(7, 3); 80]);
        let work = check(&alone);
        assert_eq!((work.tiles.len(), work.words), (80 * 2 / 32, 80 * 2 * 3 * 3));
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
