//! The stored form of U: its tiles, as the deformers for CPU and GPU read them, and error bounds of each storage type.
//!
//! # Layout
//! Four consecutive vertices form a quad. Up to [`TILE_QUADS`] consecutive quads of a shape form a tile. A few
//! consecutive modes ([`modes_per_chunk`]) form a chunk. For every storage type, the entries of a quad and a chunk take
//! 48 bytes: three packed words of 16 bytes, one for each of three planes. A tile is the array `[chunk][plane][quad]`
//! of packed words. A warp of the GPU thus makes coalesced reads of 16 bytes per lane, and a core of the CPU reads a
//! shape sequentially.
//!
//! Entry e of the 48 bytes belongs to mode e / 12 of the chunk, axis e / 4 % 3, and vertex e % 4 of the quad. Padding
//! vertices and modes are zero. Numbers have the machine's byte order.

pub mod bound;
mod quantize;
mod split_coordinates;
mod tiles;

pub use split_coordinates::{SplitCoordinates, TensorCoreError};
pub use tiles::{PackedWord, TileLayout, TiledModes};

use modalcast_model::scene::StorageType;

/// Vertices per quad.
pub const QUAD: usize = 4;

/// Maximum number of quads of a tile.
pub const TILE_QUADS: usize = 32;

/// Number of modes of a chunk: those whose entries for a quad take 48 bytes.
pub const fn modes_per_chunk(storage: StorageType) -> usize {
    match storage {
        StorageType::F32 => 1,
        StorageType::F16 | StorageType::Bf16 => 2,
        StorageType::Int8 => 4,
    }
}
