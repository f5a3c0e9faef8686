//! U in tiles, as the deformers of the CPU and the GPU read it; how far each storage type may be off; which modes may be
//! left out. Pure functions of a scene's values.
//!
//! # Layout
//! Four consecutive vertices are a quad, up to [`TILE_QUADS`] consecutive quads of a shape a tile. [`modes_per_chunk`]
//! modes are a chunk, which takes 48 bytes of a quad whatever the storage: three planes of 16 bytes. A tile of W quads
//! is `[chunk][plane][quad]` of those 16 bytes, so that a warp reads 16 bytes a lane without gaps, and so does a core
//! from the first byte of a shape to its last.
//!
//! Element e of the 48 bytes is that of mode e / 12 of the chunk, axis e / 4 % 3, vertex e % 4 of the quad. Vertices
//! and modes that fill up a quad or a chunk are zeros. Numbers have the machine's byte order.

pub mod bound;
mod halves;
mod pack;
mod tiles;
mod truncation;

pub use halves::{Halves, Products};
pub use tiles::{Plane, Tile, Tiles};
pub use truncation::{Amounts, Truncation, reaches};

use modalcast_model::scene::Storage;

/// Vertices of a quad.
pub const QUAD: usize = 4;

/// The most quads of a tile.
pub const TILE_QUADS: usize = 32;

/// Modes whose entries of a quad take 48 bytes together.
pub const fn modes_per_chunk(storage: Storage) -> usize {
    match storage {
        Storage::F32 => 1,
        Storage::F16 | Storage::Bf16 => 2,
        Storage::Int8 => 4,
    }
}
