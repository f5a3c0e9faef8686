//! The work list of `deform`, derived from a scene: a list of tiles, each of which is the work of one warp.
//!
//! A quad is four consecutive items, which are vertices or corners. A tile is up to `TILE_QUADS` quads. Where corner i
//! of a shape is its vertex i, one tile computes both. A chunk is a few modes that are stored together.
//!
//! A domain has tiles of its own if its shape has more than `MAX_SHARED_QUADS` quads, or if the shape has modes and
//! several domains use it. The U of the shape is then stored once. The quads of all other domains with the same number
//! of chunks fill tiles together (mixed tiles), so that 200,000 small domains keep all lanes busy.
//!
//! Tiles with the most chunks come first, because a long tile that begins last would delay the end of the step. Tiles
//! with vertices of batched domains come after all other tiles: in a full step, `batch` computes their vertices instead
//! of `deform`. In a partial step, `deform` computes them, because only the tiles of changed domains
//! are computed, and the list of these tiles (`tile_list`) is an input of `deform`.

pub(crate) mod batches;
mod coordinates;
mod quads;
#[cfg(test)]
pub(crate) mod tests;

use std::collections::BTreeMap;

use batches::BatchTables;
pub(crate) use coordinates::CoordinateLayout;
pub(crate) use quads::{QuadLayout, rest_directions, rest_positions};

use super::layout::{MixedQuad, TILE_CORNERS, TILE_VERTICES, WarpTile};
use crate::storage::{PackedWord, TILE_QUADS, TiledModes, modes_per_chunk};
use modalcast_model::backend_settings::BatchPolicy;
use modalcast_model::domain::Shape;
use modalcast_model::scene::{DomainLayout, Scene, StorageType};

/// Maximum number of quads of a domain that shares a tile with other domains.
const MAX_SHARED_QUADS: usize = TILE_QUADS / 2;

/// Vertices per quad.
const QUAD: usize = crate::storage::QUAD;

/// A section of the stored U. The sections are stored one after the other.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum WordSource {
    /// All tiles of a shape.
    Shape(usize),
    /// A mixed tile of these shapes.
    Mixed(Vec<usize>),
}

/// Consecutive tiles of the work list.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct TileSpan {
    pub first: u32,
    pub count: u32,
}

/// The tiles of a domain, or the mixed tile that contains the domain.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct DomainTiles {
    /// Tiles with vertices.
    pub vertices: TileSpan,
    /// Tiles without vertices.
    pub corners: TileSpan,
}

/// The work list, and the offsets of all data that it refers to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct WorkList {
    pub tiles: Vec<WarpTile>,
    /// Per shape, whether one tile computes vertices and corners. False for batched shapes, whose vertices and corners
    /// are computed by different kernels.
    pub corners_match: Vec<bool>,
    /// Number of leading tiles that `deform` computes in a full step. `batch` computes the other tiles.
    pub full_step_tiles: usize,
    /// Number of tiles with vertices among the first `full_step_tiles` tiles, where they precede the tiles with only
    /// corners.
    pub vertex_tiles: usize,
    pub batched: BatchTables,
    pub mixed_quads: Vec<MixedQuad>,
    /// Per mixed quad, its first scale; empty unless the storage is `Int8`.
    pub mixed_quad_scales: Vec<u32>,
    /// The sections of U, in the order of storage.
    pub sources: Vec<WordSource>,
    /// Number of 16-byte words of U.
    pub word_count: u64,
    pub quads: QuadLayout,
    /// Per shape, its first scale.
    pub first_scales: Vec<u32>,
    pub scale_count: u64,
    /// The tiles of each domain.
    pub domain_tiles: Vec<DomainTiles>,
    /// Per domain, the offset from its first vertex to its first corner, modulo 2^32 because it may be negative; empty
    /// when all offsets are zero.
    pub corner_offsets: Vec<u32>,
}

/// Whether corner i of a shape is its vertex i, so that one lane can compute both.
fn corners_match_vertices(shape: &Shape) -> bool {
    let corners = &shape.mesh.corners().vertices;
    corners.len() == shape.mesh.rest_positions().len()
        && corners.iter().enumerate().all(|(corner, vertex)| corner as u32 == *vertex)
}

/// Whether `deform` rotates the rest normals. Otherwise `normals` computes them from the deformed surface.
pub(crate) fn has_rigid_normals(scene: &Scene) -> bool {
    !scene.features.exact_normals
}

/// The number of chunks and the flags of a tile. In a mixed tile, they are the same for all domains.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct TileClass {
    chunks: usize,
    /// `TILE_VERTICES`, `TILE_CORNERS` or both, as in [`WarpTile::kind`].
    flags: u8,
}

/// A tile before its offsets are assigned.
enum PendingTile {
    /// Tile number `tile` of a domain that has tiles of its own; the number counts from 0.
    Owned { domain: usize, tile: usize },
    /// A mixed tile of all items of these domains.
    Mixed(Vec<usize>),
}

impl WorkList {
    pub(crate) fn new(scene: &Scene, coordinates: &CoordinateLayout, policy: BatchPolicy) -> Self {
        let shape_is_batched = batches::batched_shapes(scene, policy);
        let corners_match = scene
            .shapes
            .iter()
            .zip(&shape_is_batched)
            .map(|(shape, is_batched)| !is_batched && corners_match_vertices(shape))
            .collect();
        let mut work = Self::empty(scene, corners_match);
        let mut pending_tiles = pending_tiles(scene, &work.corners_match);
        let has_vertices = |class: &TileClass| class.flags & TILE_VERTICES > 0;
        let is_batched = |class: &TileClass, tile: &PendingTile| match tile {
            PendingTile::Owned { domain, .. } => has_vertices(class) && shape_is_batched[scene.domains[*domain].shape],
            PendingTile::Mixed(_) => false,
        };
        pending_tiles.sort_by_key(|(class, tile)| {
            (is_batched(class, tile), std::cmp::Reverse(class.chunks), !has_vertices(class))
        });
        work.full_step_tiles = pending_tiles.partition_point(|(class, tile)| !is_batched(class, tile));
        work.vertex_tiles = pending_tiles[..work.full_step_tiles].partition_point(|(class, _)| has_vertices(class));
        let mut first_words: Vec<Option<u64>> = vec![None; scene.shapes.len()];
        for (class, pending_tile) in pending_tiles {
            let index = work.tiles.len() as u32;
            match pending_tile {
                PendingTile::Owned { domain, tile } => {
                    let shape_word =
                        work.allocate_words(scene, scene.domains[domain].shape, class.chunks, &mut first_words);
                    let first_word = shape_word + (3 * class.chunks * TILE_QUADS * tile) as u64;
                    let warp_tile = work.tile_of_domain(scene, coordinates, class, domain, tile);
                    work.tiles.push(WarpTile { first_word, ..warp_tile });
                    work.record_tile(domain, class, index);
                }
                PendingTile::Mixed(domains) => {
                    work.push_mixed_tile(scene, coordinates, class, &domains);
                    domains.iter().for_each(|domain| work.record_tile(*domain, class, index));
                }
            }
        }
        if scene.deformation.storage != StorageType::Int8 {
            work.mixed_quad_scales.clear();
        }
        work.batched = BatchTables::new(scene, &work, coordinates, &shape_is_batched, &first_words);
        work
    }

    /// An empty work list, with offsets for the scales of every shape.
    fn empty(scene: &Scene, corners_match: Vec<bool>) -> Self {
        let storage = scene.deformation.storage;
        let (mut scale_count, mut first_scales) = (0_u64, Vec::new());
        for shape in &scene.shapes {
            first_scales.push(scale_count as u32);
            if storage == StorageType::Int8 {
                let scales_per_tile = shape.modes.rank().next_multiple_of(modes_per_chunk(storage));
                scale_count += (scales_per_tile * quad_count(shape).div_ceil(TILE_QUADS)) as u64;
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
            word_count: 0,
            quads: QuadLayout::new(scene, &corners_match),
            corners_match,
            first_scales,
            scale_count,
            domain_tiles: vec![DomainTiles::default(); scene.domains.len()],
            corner_offsets: corner_offsets(scene),
        }
    }

    /// The first word of U of a shape whose domains have tiles of their own. The first call for a shape allocates its
    /// words.
    fn allocate_words(&mut self, scene: &Scene, shape: usize, chunks: usize, first_words: &mut [Option<u64>]) -> u64 {
        if chunks == 0 {
            return 0;
        }
        *first_words[shape].get_or_insert_with(|| {
            self.sources.push(WordSource::Shape(shape));
            let first_word = self.word_count;
            self.word_count += (3 * chunks * quad_count(&scene.shapes[shape])) as u64;
            first_word
        })
    }

    /// Device bytes of the bounding boxes of all tiles: four boxes per tile (boxes.cuh). A box has six u32 keys, which
    /// compare like its floats.
    pub(crate) const fn box_bytes(&self) -> u64 {
        96 * self.tiles.len() as u64
    }

    /// Records a tile of a domain. The tiles of one domain and class are consecutive.
    fn record_tile(&mut self, domain: usize, class: TileClass, index: u32) {
        let tiles = &mut self.domain_tiles[domain];
        let span = if class.flags & TILE_VERTICES > 0 { &mut tiles.vertices } else { &mut tiles.corners };
        if span.count == 0 {
            span.first = index;
        }
        span.count += 1;
    }

    /// Tile number `tile` of a domain, with `first_word` 0.
    fn tile_of_domain(
        &self,
        scene: &Scene,
        coordinates: &CoordinateLayout,
        class: TileClass,
        domain: usize,
        tile: usize,
    ) -> WarpTile {
        let range = self.item_range(scene, class, domain);
        let remaining_items = range.item_count - QUAD * TILE_QUADS * tile;
        let quad_count = remaining_items.div_ceil(QUAD).min(TILE_QUADS);
        let last_quad_items = remaining_items.min(QUAD * TILE_QUADS) - QUAD * (quad_count - 1);
        let shape = scene.domains[domain].shape;
        let preceding_scales = tile * class.chunks * modes_per_chunk(scene.deformation.storage);
        WarpTile {
            first_word: 0,
            first_item: range.first_item + (QUAD * TILE_QUADS * tile) as u32,
            rest_quad: range.rest_quad + (TILE_QUADS * tile) as u32,
            domain: domain as u32,
            first_q: coordinates.first_q[domain],
            first_scale: self.first_scales[shape] + preceding_scales as u32,
            chunk_count: class.chunks as u16,
            quad_count: quad_count as u8,
            kind: class.flags | last_quad_items as u8,
        }
    }

    fn push_mixed_tile(&mut self, scene: &Scene, coordinates: &CoordinateLayout, class: TileClass, domains: &[usize]) {
        let first_quad = self.mixed_quads.len() as u32;
        for domain in domains {
            let range = self.item_range(scene, class, *domain);
            for quad in 0..range.item_count.div_ceil(QUAD) {
                let quad_items = (range.item_count - QUAD * quad).min(QUAD);
                self.mixed_quads.push(MixedQuad {
                    first_item: range.first_item + (QUAD * quad) as u32,
                    rest_quad: range.rest_quad + quad as u32,
                    // The domain, and in the two lowest bits the number of items minus 1.
                    packed_domain: (QUAD * domain + quad_items - 1) as u32,
                    first_q: coordinates.first_q[*domain],
                });
                self.mixed_quad_scales.push(self.first_scales[scene.domains[*domain].shape]);
            }
        }
        let quad_count = self.mixed_quads.len() as u32 - first_quad;
        self.tiles.push(WarpTile {
            first_word: self.word_count,
            first_item: first_quad,
            rest_quad: 0,
            domain: 0,
            first_q: 0,
            first_scale: 0,
            chunk_count: class.chunks as u16,
            quad_count: quad_count as u8,
            kind: class.flags,
        });
        if class.chunks > 0 {
            self.sources.push(WordSource::Mixed(domains.iter().map(|domain| scene.domains[*domain].shape).collect()));
            self.word_count += (3 * class.chunks) as u64 * u64::from(quad_count);
        }
    }

    /// Items of a domain: its vertices, or its corners in a tile without vertices.
    fn item_range(&self, scene: &Scene, class: TileClass, domain: usize) -> ItemRange {
        let (layout, shape) = (scene.layout.domains[domain], scene.domains[domain].shape);
        if class.flags & TILE_VERTICES > 0 {
            let (first_item, rest_quad) = (layout.first_vertex as u32, self.quads.vertex_quads[shape]);
            ItemRange { item_count: layout.vertices, first_item, rest_quad }
        } else {
            let (first_item, rest_quad) = (layout.first_corner as u32, self.quads.corner_quads[shape]);
            ItemRange { item_count: layout.corners, first_item, rest_quad }
        }
    }
}

/// The items of a domain: its vertices or its corners.
struct ItemRange {
    item_count: usize,
    /// Index of the first item among the vertices or corners of all domains.
    first_item: u32,
    /// Index of the first quad in the tables of x0, normals and tangents.
    rest_quad: u32,
}

/// Whether a domain has tiles of its own because of its number of items.
const fn has_own_tiles(item_count: usize) -> bool {
    item_count.div_ceil(QUAD) > MAX_SHARED_QUADS
}

/// Per shape, the number of domains that use it.
fn count_users(scene: &Scene) -> Vec<usize> {
    let mut user_counts = vec![0_usize; scene.shapes.len()];
    scene.domains.iter().for_each(|domain| user_counts[domain.shape] += 1);
    user_counts
}

/// Per shape, whether the vertices of its domains have tiles of their own.
fn shapes_with_own_tiles(scene: &Scene) -> Vec<bool> {
    let has_tiles = |(shape, user_count): (&Shape, usize)| {
        has_own_tiles(shape.mesh.rest_positions().len()) || (shape.modes.rank() > 0 && user_count > 1)
    };
    scene.shapes.iter().zip(count_users(scene)).map(has_tiles).collect()
}

/// A mixed tile that may take more domains.
#[derive(Default)]
struct OpenTile {
    domains: Vec<usize>,
    quad_count: usize,
}

/// Every tile with its class. Mixed tiles are collected over all domains.
fn pending_tiles(scene: &Scene, corners_match: &[bool]) -> Vec<(TileClass, PendingTile)> {
    let shape_has_tiles = shapes_with_own_tiles(scene);
    let mut tiles = Vec::new();
    let mut open_tiles: BTreeMap<TileClass, OpenTile> = BTreeMap::new();
    let mut add_items = |domain: usize, class: TileClass, item_count: usize, has_own_tiles: bool| {
        let quads = item_count.div_ceil(QUAD);
        if has_own_tiles {
            tiles.extend((0..quads.div_ceil(TILE_QUADS)).map(|tile| (class, PendingTile::Owned { domain, tile })));
            return;
        }
        let open_tile = open_tiles.entry(class).or_default();
        if open_tile.quad_count + quads > TILE_QUADS {
            tiles.push((class, PendingTile::Mixed(std::mem::take(open_tile).domains)));
        }
        open_tile.domains.push(domain);
        open_tile.quad_count += quads;
    };
    for (index, domain) in scene.domains.iter().enumerate() {
        let (shape, layout) = (&scene.shapes[domain.shape], scene.layout.domains[index]);
        let chunks = chunk_count(scene, shape);
        let computes_both = has_rigid_normals(scene) && corners_match[domain.shape];
        let flags = TILE_VERTICES | if computes_both { TILE_CORNERS } else { 0 };
        add_items(index, TileClass { chunks, flags }, layout.vertices, shape_has_tiles[domain.shape]);
        if has_rigid_normals(scene) && !computes_both {
            add_items(
                index,
                TileClass { chunks: 0, flags: TILE_CORNERS },
                layout.corners,
                has_own_tiles(layout.corners),
            );
        }
    }
    tiles.extend(open_tiles.into_iter().map(|(class, tile)| (class, PendingTile::Mixed(tile.domains))));
    tiles
}

/// As [`WorkList::corner_offsets`].
fn corner_offsets(scene: &Scene) -> Vec<u32> {
    let offset = |layout: &DomainLayout| (layout.first_corner as u32).wrapping_sub(layout.first_vertex as u32);
    let offsets: Vec<u32> = scene.layout.domains.iter().map(offset).collect();
    if has_rigid_normals(scene) && offsets.iter().any(|offset| *offset != 0) { offsets } else { Vec::new() }
}

fn quad_count(shape: &Shape) -> usize {
    shape.mesh.rest_positions().len().div_ceil(QUAD)
}

fn chunk_count(scene: &Scene, shape: &Shape) -> usize {
    shape.modes.rank().div_ceil(modes_per_chunk(scene.deformation.storage))
}

/// U of a mixed tile: packed words `[chunk][plane][quad]` with the quads of all of `shapes`. A plane has the rows of U
/// for one of x, y and z. Each shape has one tile
/// `[chunk][plane][quad]` of three planes, and all shapes have the same number of chunks.
pub(crate) fn mix_tiles(shapes: &[TiledModes]) -> Vec<PackedWord> {
    let row_count = 3 * shapes.first().map_or(0, TiledModes::chunks);
    let mut words = Vec::with_capacity(shapes.iter().map(|tiles| tiles.packed_words().len()).sum());
    for row in 0..row_count {
        for tiles in shapes {
            let quads = tiles.quads();
            words.extend_from_slice(&tiles.packed_words()[row * quads..][..quads]);
        }
    }
    words
}
