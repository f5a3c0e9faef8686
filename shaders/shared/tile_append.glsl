// Appends the tile of this workgroup to the tile list. Only one lane may call it. The first row of a band is a multiple
// of TILE.
void append_tile() {
    uint index = atomicAdd(tile_list.count, 1u);
    if (index % TILES_PER_ROW == 0u) atomicAdd(tile_list.workgroup_counts[1], 1u);
    tile_list.tiles[index] = gl_WorkGroupID.x | (gl_WorkGroupID.y + uint(first_row) / TILE) << 16;
}
