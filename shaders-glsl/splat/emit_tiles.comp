// Lists (tile, intersection) pairs front to back, so that a full list loses the farthest: one thread a rank.
// in   visible_count, slots (by depth), projected, tile_offsets (prefix sum of tile_counts)
// out  keys (tile), owners (slot of each);
//      isect_count[0] those listed, [1] those there are
// The walk repeats count_tiles'. Should two compilations round differently, what it counted too much is
// padded with a tile past the last, where nothing is drawn, and what it counted too little is dropped.
#version 450
#extension GL_GOOGLE_include_directive : require
// variants: cpu
layout(local_size_x = 64) in;

#include "../common/types.glsl"
#include "../common/tiles.glsl"
#include "../common/index.glsl"
#include "../common/texels.glsl"

layout(push_constant) uniform Push {
    uvec2 size;
    uint splats;
    uint capacity;
    float coarseness;
} push;

READ_UINTS(0, VisibleCount, visible_count)
READ_UINTS(1, Slots, slot_of)
READ_PROJECTED(2, ProjectedIn, projected)
READ_UINTS(3, TileOffsets, tile_offset)
layout(set = 0, binding = 4, std430) writeonly buffer Keys { uint keys[]; };
layout(set = 0, binding = 5, std430) writeonly buffer Owners { uint owners[]; };
layout(set = 0, binding = 6, std430) writeonly buffer IsectCount { uint isect_count[]; };

void main() {
    const uint rank = thread_index();
    if (rank == 0) {
        const uint needed = tile_offset(push.splats);
        const uint listed = min(needed, push.capacity);
        isect_count[0] = listed;
        isect_count[1] = needed;
    }
    if (rank >= visible_count(0)) {
        return;
    }
    const uint slot = slot_of(rank);
    const uvec2 grid = tile_grid(push.size);
    const uint end = min(tile_offset(rank + 1), push.capacity);
    uint at = tile_offset(rank);
    const Ellipse e = ellipse_of(projected(slot), push.size, push.coarseness);
    for (int row = e.rows.x; row <= e.rows.y && at < end; ++row) {
        const ivec2 columns = columns_of(e, row, push.size);
        for (int column = columns.x; column <= columns.y && at < end; ++column) {
            keys[at] = uint(row) * grid.x + uint(column);
            owners[at] = slot;
            ++at;
        }
    }
    for (; at < end; ++at) {
        keys[at] = grid.x * grid.y;
        owners[at] = slot;
    }
}
