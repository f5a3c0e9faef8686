//! Twins of GLSL declarations: uniform and storage blocks, texture units, bindings and workgroup sizes.

pub(crate) mod ambient;
pub(crate) mod cull;
pub(crate) mod material;
pub(crate) mod oit;

use crate::scene_data::textures::MAX_ARRAYS;

/// Texture units, as the shaders declare them. Color and normal textures take one unit per texture array, from the
/// given unit on.
pub(crate) const SHADOW_UNIT: u32 = 0;
pub(crate) const COLOR_UNIT: u32 = 1;
pub(crate) const NORMAL_UNIT: u32 = COLOR_UNIT + MAX_ARRAYS as u32;
pub(crate) const POSITION_UNIT: u32 = 13;
pub(crate) const MATERIAL_UNIT: u32 = 14;
pub(crate) const TRIANGLE_MATERIAL_UNIT: u32 = 15;
pub(crate) const CORNER_NORMAL_UNIT: u32 = 16;
pub(crate) const TRIANGLE_CORNER_UNIT: u32 = 17;
pub(crate) const TRIANGLE_VERTEX_UNIT: u32 = 18;
pub(crate) const UV_UNIT: u32 = 19;
pub(crate) const TANGENT_UNIT: u32 = 20;
pub(crate) const ID_UNIT: u32 = 21;
/// Blend layers: light and transmittance of the blended triangles.
pub(crate) const BLEND_LAYER_UNIT: u32 = 22;
/// Number of blended fragments of each pixel.
pub(crate) const FRAGMENT_COUNT_UNIT: u32 = 23;
/// Vertex values of AOV readbacks.
pub(crate) const VALUE_UNIT: u32 = 24;
/// Ids of the triangles in the lists of visible triangles.
pub(crate) const TRIANGLE_ID_UNIT: u32 = 25;
/// Depth of the samples whose ids are at [`ID_UNIT`].
pub(crate) const DEPTH_UNIT: u32 = 26;
/// Depth of a variance shadow map, whose moments are at [`SHADOW_UNIT`].
pub(crate) const SHADOW_DEPTH_UNIT: u32 = 27;
/// Ambient visibility.
pub(crate) const AMBIENT_UNIT: u32 = 28;
/// Texture unit of the image that a program of the blur, the bloom or the sRGB encoding reads.
pub(crate) const SOURCE_UNIT: u32 = 0;
/// Texture unit of the ambient visibility that the filter of the ambient occlusion reads.
pub(crate) const NOISY_VISIBILITY_UNIT: u32 = 1;
/// Maximum number of textures that the shading reads in addition to the scene's images: one for each of the 29 units
/// from [`SHADOW_UNIT`] to [`AMBIENT_UNIT`], except the 12 color and normal units, [`VALUE_UNIT`] and
/// [`TRIANGLE_ID_UNIT`].
pub(crate) const FIXED_TEXTURE_READS: usize = 15;
const _: () = assert!(NORMAL_UNIT + MAX_ARRAYS as u32 <= POSITION_UNIT, "texture units overlap");

/// Uniform block bindings.
pub(crate) const FRAME_BLOCK: u32 = 0;
pub(crate) const CASCADE_BLOCK: u32 = 2;
pub(crate) const CULL_BLOCK: u32 = 3;

/// Storage binding of a buffer of words that a conversion reads or writes: pixels, ids, AOV fields, or the output of
/// the compute rasterizer.
pub(crate) const WORDS_BINDING: u32 = 0;
/// Storage binding of tile lists.
pub(crate) const TILES_BINDING: u32 = 1;

/// Storage binding of the marks of inner edges in the shading.
pub(crate) const INNER_EDGES_BINDING: u32 = 2;

/// Invocations of a compute workgroup, along x.
pub(crate) const WORKGROUP_SIZE: u32 = 64;
/// Side of the square of pixels that a workgroup shades.
pub(crate) const TILE: u32 = 8;
/// Number of workgroups in a row of the dispatch over listed tiles.
pub(crate) const TILES_PER_ROW: u32 = 64;
/// Header of an empty tile list: the workgroup counts of the indirect dispatch (TILES_PER_ROW, 0 rows, 1), and the tile
/// count.
pub(crate) const EMPTY_TILE_LIST: [u32; 4] = [TILES_PER_ROW, 0, 1, 0];

/// Bytes of the tile list of an image: [`EMPTY_TILE_LIST`], then one word per tile.
pub(crate) fn tile_list_bytes([width, height]: [u32; 2]) -> u64 {
    size_of_val(&EMPTY_TILE_LIST) as u64 + 4 * u64::from(width.div_ceil(TILE)) * u64::from(height.div_ceil(TILE))
}

/// Packs width (lower 16 bits) and height into one word, as the shaders expect them.
pub(crate) const fn pack_size([width, height]: [u32; 2]) -> u32 {
    width | height << 16
}
