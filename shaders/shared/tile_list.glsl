// List of pixel tiles, in any order, and the arguments of an indirect dispatch over them: one workgroup per tile, in
// rows of TILES_PER_ROW workgroups.
layout(std430, binding = 1) buffer TileList {
    uint workgroup_counts[3];  // x, y, z of the dispatch
    uint count;
    uint tiles[];              // column in the lower 16 bits, row in the upper
} tile_list;

uint listed_tile_index() { return gl_WorkGroupID.y * TILES_PER_ROW + gl_WorkGroupID.x; }

// Whether the list has a tile of this index. The last row of workgroups may be incomplete.
bool has_listed_tile(uint index) { return index < tile_list.count; }

// Pixel of this lane in the tile of this index. If the list has no such tile, a pixel of the last listed tile.
ivec2 listed_pixel(uint index) {
    uint tile = tile_list.tiles[min(index, tile_list.count - 1u)];
    return TILE * ivec2(tile & 0xFFFFu, tile >> 16) + ivec2(gl_LocalInvocationID.xy);
}
