//! The work list of `deform`, derived from a scene: one tile per warp, of one or of several domains. Pure.
//!
//! A tile computes vertices, or corners, or both where corner i of a shape is its vertex i.
//!
//! A shape of more than `MAX_SHARED_QUADS` quads, or one with modes that several domains share, is cut into tiles of its own,
//! and its U is stored once. The quads of smaller domains with the same number of chunks fill tiles together (mixed
//! tiles), so that 200,000 leaves keep all lanes busy. Tiles with the most chunks come first, because a long tile that
//! begins last would delay the end of the step. Vertices of domains that `batches` puts into groups have tiles too,
//! after all others: a full step leaves them to `batch`, and the tile list of a partial step refers to them.

pub(crate) mod batches;
mod coordinates;
mod quads;
#[cfg(test)]
pub(crate) mod tests;

use batches::BatchTables;
pub(crate) use coordinates::CoordinateLayout;
pub(crate) use quads::{Quads, rest_directions, rest_positions};

use super::layout::{MixedQuad, TILE_CORNERS, TILE_VERTICES, WarpTile};
use crate::storage::{PackedWord, TILE_QUADS, TiledModes, modes_per_chunk};
use modalcast_model::backend_settings::BatchPolicy;
use modalcast_model::domain::Shape;
use modalcast_model::scene::{Scene, StorageType};

/// Maximum number of quads of a domain that shares a tile with other domains.
const MAX_SHARED_QUADS: usize = TILE_QUADS / 2;

/// Vertices per quad.
const QUAD: usize = crate::storage::QUAD;

/// A section of the words; the sections follow each other in order.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum WordSource {
    /// All tiles of a shape.
    Shape(usize),
    /// The quads of these shapes side by side.
    Mixed(Vec<usize>),
}

/// The work list, and the offsets of all data that it refers to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct WorkList {
    pub tiles: Vec<WarpTile>,
    /// Per shape, whether one lane computes a vertex and the corner of the same index. False for batched shapes, whose
    /// vertices and corners are computed by different kernels.
    pub corners_match: Vec<bool>,
    /// Number of tiles before those that a full step leaves to `batch`.
    pub full_step_tiles: usize,
    /// Among these, the number of tiles that have vertices; tiles of corners alone follow.
    pub vertex_tiles: usize,
    pub batched: BatchTables,
    pub mixed_quads: Vec<MixedQuad>,
    /// The first scale of each lane; only with `Int8`.
    pub mixed_quad_scales: Vec<u32>,
    pub sources: Vec<WordSource>,
    /// Number of words of 16 bytes.
    pub words: u64,
    pub quads: Quads,
    /// Per shape, its first scale; and the number of all scales.
    pub first_scale: Vec<u32>,
    pub scales: u64,
    /// Per domain, first tile and tile count: of tiles with vertices, and of tiles with corners alone.
    pub spans: Vec<[(u32, u32); 2]>,
    /// Per domain, the wrapping offset from its first vertex to its first corner; empty when all offsets are zero.
    pub corner_offsets: Vec<u32>,
}

/// Whether corner i of a shape is its vertex i, so that one lane can compute both.
fn corners_match_vertices(shape: &Shape) -> bool {
    let corners = &shape.mesh.corners().vertices;
    corners.len() == shape.mesh.rest_positions().len()
        && corners.iter().enumerate().all(|(at, vertex)| at as u32 == *vertex)
}

/// Whether `deform` rotates the rest normals. Otherwise `normals` computes them from the deformed surface.
pub(crate) fn has_rigid_normals(scene: &Scene) -> bool {
    !scene.features.exact_normals
}

/// What a domain's tile computes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct TileClass {
    chunks: usize,
    /// Flags of [`WarpTile::kind`].
    flags: u8,
}

/// A tile before its offsets are assigned: a part of one domain, or several whole domains.
enum PendingTile {
    Owned { domain: usize, tile: usize },
    Mixed(Vec<usize>),
}

impl WorkList {
    pub(crate) fn new(scene: &Scene, coordinates: &CoordinateLayout, policy: BatchPolicy) -> Self {
        let batched = batches::shapes(scene, policy);
        let corners_match = scene
            .shapes
            .iter()
            .zip(&batched)
            .map(|(shape, batched)| !batched && corners_match_vertices(shape))
            .collect();
        let mut work = Self::empty(scene, corners_match);
        let mut items = items(scene, &work.corners_match);
        let is_batched = |class: TileClass, item: &PendingTile| match item {
            PendingTile::Owned { domain, .. } => {
                class.flags & TILE_VERTICES > 0 && batched[scene.domains[*domain].shape]
            }
            PendingTile::Mixed(_) => false,
        };
        let has_vertices = |class: &TileClass| class.flags & TILE_VERTICES > 0;
        items.sort_by_key(|(class, item)| {
            (is_batched(*class, item), std::cmp::Reverse(class.chunks), !has_vertices(class))
        });
        work.full_step_tiles = items.partition_point(|(class, item)| !is_batched(*class, item));
        work.vertex_tiles = items[..work.full_step_tiles].partition_point(|(class, _)| has_vertices(class));
        let mut first_words: Vec<Option<u64>> = vec![None; scene.shapes.len()];
        for (class, item) in items {
            let index = work.tiles.len() as u32;
            match item {
                PendingTile::Owned { domain, tile } => {
                    let first_word =
                        work.allocate_words(scene, scene.domains[domain].shape, class.chunks, &mut first_words);
                    let own = work.own_tile(scene, coordinates, class, (domain, tile));
                    let before = (3 * class.chunks * TILE_QUADS * tile) as u64;
                    work.tiles.push(WarpTile { first_word: first_word + before, ..own });
                    work.record_span(domain, class, index);
                }
                PendingTile::Mixed(domains) => {
                    work.push_mixed(scene, coordinates, class, &domains);
                    domains.iter().for_each(|domain| work.record_span(*domain, class, index));
                }
            }
        }
        if scene.deformation.storage != StorageType::Int8 {
            work.mixed_quad_scales.clear();
        }
        work.batched = BatchTables::new(scene, (&work, coordinates), (&batched, &first_words));
        work
    }

    /// An empty work list, with offsets for the scales of every shape.
    fn empty(scene: &Scene, corners_match: Vec<bool>) -> Self {
        let storage = scene.deformation.storage;
        let (mut scales, mut first_scale) = (0_u64, Vec::new());
        for shape in &scene.shapes {
            first_scale.push(scales as u32);
            if storage == StorageType::Int8 {
                let per_tile = shape.modes.rank().next_multiple_of(modes_per_chunk(storage));
                scales += (per_tile * quads_of(shape).div_ceil(TILE_QUADS)) as u64;
            }
        }
        Self {
            tiles: Vec::new(),
            full_step_tiles: 0,
            vertex_tiles: 0,
            batched: BatchTables::default(),
            mixed_quads: Vec::new(),
            mixed_quad_scales: Vec::new(),
            sources: Vec::new(),
            words: 0,
            quads: Quads::new(scene, &corners_match),
            corners_match,
            first_scale,
            scales,
            spans: vec![[(0, 0); 2]; scene.domains.len()],
            corner_offsets: corner_offsets(scene),
        }
    }

    /// The first word of a shape that has tiles of its own; allocated at the first call.
    fn allocate_words(&mut self, scene: &Scene, shape: usize, chunks: usize, places: &mut [Option<u64>]) -> u64 {
        if chunks == 0 {
            return 0;
        }
        *places[shape].get_or_insert_with(|| {
            self.sources.push(WordSource::Shape(shape));
            let first = self.words;
            self.words += (3 * chunks * quads_of(&scene.shapes[shape])) as u64;
            first
        })
    }

    /// Device bytes of the boxes of all warps: four per tile, six keys each.
    pub(crate) const fn box_bytes(&self) -> u64 {
        96 * self.tiles.len() as u64
    }

    /// Records a tile of a domain. The tiles of one domain and role are contiguous.
    fn record_span(&mut self, domain: usize, class: TileClass, index: u32) {
        let (first, count) = &mut self.spans[domain][usize::from(class.flags & TILE_VERTICES == 0)];
        if *count == 0 {
            *first = index;
        }
        *count += 1;
    }

    fn own_tile(
        &self,
        scene: &Scene,
        coordinates: &CoordinateLayout,
        class: TileClass,
        (domain, tile): (usize, usize),
    ) -> WarpTile {
        let place = self.place(scene, class, domain);
        let items = place.items - QUAD * TILE_QUADS * tile;
        let width = items.div_ceil(QUAD).min(TILE_QUADS);
        let shape = scene.domains[domain].shape;
        let scales =
            if class.chunks == 0 { 0 } else { tile * class.chunks * modes_per_chunk(scene.deformation.storage) };
        WarpTile {
            first_word: 0,
            first: place.first + (QUAD * TILE_QUADS * tile) as u32,
            rest: place.rest + (TILE_QUADS * tile) as u32,
            domain: domain as u32,
            first_q: coordinates.first[domain],
            first_scale: self.first_scale[shape] + scales as u32,
            chunks: class.chunks as u16,
            width: width as u8,
            kind: class.flags | (items.min(QUAD * TILE_QUADS) - QUAD * (width - 1)) as u8,
        }
    }

    fn push_mixed(&mut self, scene: &Scene, coordinates: &CoordinateLayout, class: TileClass, domains: &[usize]) {
        let first = self.mixed_quads.len() as u32;
        for domain in domains {
            let place = self.place(scene, class, *domain);
            for quad in 0..place.items.div_ceil(QUAD) {
                let count = (place.items - QUAD * quad).min(QUAD);
                self.mixed_quads.push(MixedQuad {
                    item: place.first + (QUAD * quad) as u32,
                    rest: place.rest + quad as u32,
                    domain: (QUAD * domain + count - 1) as u32,
                    first_q: coordinates.first[*domain],
                });
                self.mixed_quad_scales.push(self.first_scale[scene.domains[*domain].shape]);
            }
        }
        let width = self.mixed_quads.len() as u32 - first;
        self.tiles.push(WarpTile {
            first_word: self.words,
            first,
            rest: 0,
            domain: 0,
            first_q: 0,
            first_scale: 0,
            chunks: class.chunks as u16,
            width: width as u8,
            kind: class.flags,
        });
        if class.chunks > 0 {
            self.sources.push(WordSource::Mixed(domains.iter().map(|domain| scene.domains[*domain].shape).collect()));
            self.words += (3 * class.chunks) as u64 * u64::from(width);
        }
    }

    /// Items of a domain: its vertices, or its corners in a tile of corners alone.
    fn place(&self, scene: &Scene, class: TileClass, domain: usize) -> ItemRange {
        let (slot, shape) = (scene.layout.domains[domain], scene.domains[domain].shape);
        if class.flags & TILE_VERTICES > 0 {
            ItemRange { items: slot.vertices, first: slot.first_vertex as u32, rest: self.quads.vertices[shape] }
        } else {
            ItemRange { items: slot.corners, first: slot.first_corner as u32, rest: self.quads.corners[shape] }
        }
    }
}

/// Number of items of a domain, its first packed item, and its first quad at rest.
struct ItemRange {
    items: usize,
    first: u32,
    rest: u32,
}

/// Whether a domain with so many items has tiles of its own.
const fn has_own_tiles(items: usize) -> bool {
    items.div_ceil(QUAD) > MAX_SHARED_QUADS
}

/// Per shape, whether its vertices have tiles of their own.
fn shapes_with_own_tiles(scene: &Scene) -> Vec<bool> {
    let mut users = vec![0_usize; scene.shapes.len()];
    scene.domains.iter().for_each(|domain| users[domain.shape] += 1);
    let own = |(shape, users): (&Shape, usize)| {
        has_own_tiles(shape.mesh.rest_positions().len()) || (shape.modes.rank() > 0 && users > 1)
    };
    scene.shapes.iter().zip(users).map(own).collect()
}

/// Every tile with its role, in the order of the domains.
fn items(scene: &Scene, corners_match: &[bool]) -> Vec<(TileClass, PendingTile)> {
    let own = shapes_with_own_tiles(scene);
    let mut items = Vec::new();
    // Per role, the domains of the mixed tile that is being filled, and the number of its quads.
    let mut open: std::collections::BTreeMap<TileClass, (Vec<usize>, usize)> = std::collections::BTreeMap::new();
    let mut add = |domain: usize, class: TileClass, count: usize, own: bool| {
        let quads = count.div_ceil(QUAD);
        if own {
            items.extend((0..quads.div_ceil(TILE_QUADS)).map(|tile| (class, PendingTile::Owned { domain, tile })));
            return;
        }
        let (waiting, filled) = open.entry(class).or_default();
        if *filled + quads > TILE_QUADS {
            items.push((class, PendingTile::Mixed(std::mem::take(waiting))));
            *filled = 0;
        }
        waiting.push(domain);
        *filled += quads;
    };
    for (index, domain) in scene.domains.iter().enumerate() {
        let (shape, slot) = (&scene.shapes[domain.shape], scene.layout.domains[index]);
        let chunks = chunks_of(scene, shape);
        let both = has_rigid_normals(scene) && corners_match[domain.shape];
        let flags = TILE_VERTICES | if both { TILE_CORNERS } else { 0 };
        add(index, TileClass { chunks, flags }, slot.vertices, own[domain.shape]);
        if has_rigid_normals(scene) && !both {
            add(index, TileClass { chunks: 0, flags: TILE_CORNERS }, slot.corners, has_own_tiles(slot.corners));
        }
    }
    let rest: Vec<_> = open.into_iter().map(|(class, (waiting, _))| (class, PendingTile::Mixed(waiting))).collect();
    items.extend(rest);
    items
}

fn corner_offsets(scene: &Scene) -> Vec<u32> {
    let shift =
        |slot: &modalcast_model::scene::DomainLayout| (slot.first_corner as u32).wrapping_sub(slot.first_vertex as u32);
    let shifts: Vec<u32> = scene.layout.domains.iter().map(shift).collect();
    if has_rigid_normals(scene) && shifts.iter().any(|shift| *shift != 0) { shifts } else { Vec::new() }
}

fn quads_of(shape: &Shape) -> usize {
    shape.mesh.rest_positions().len().div_ceil(QUAD)
}

fn chunks_of(scene: &Scene, shape: &Shape) -> usize {
    shape.modes.rank().div_ceil(modes_per_chunk(scene.deformation.storage))
}

/// The quads of small shapes side by side: [chunk][3][width], from [chunk][3][own width] of each.
pub(crate) fn side_by_side(shapes: &[TiledModes]) -> Vec<PackedWord> {
    let rows = 3 * shapes.first().map_or(0, TiledModes::chunks);
    let mut words = Vec::with_capacity(shapes.iter().map(|tiles| tiles.packed_words().len()).sum());
    for row in 0..rows {
        for tiles in shapes {
            let width = tiles.quads();
            words.extend_from_slice(&tiles.packed_words()[row * width..][..width]);
        }
    }
    words
}
