// Lists (tile, intersection) pairs front to back, so that a full list loses the farthest: one thread a rank, or a
// workgroup where it has many.
// in   visible_count, slots (by depth), projected, tile_offsets (prefix sum of tile_counts)
// out  keys (tile), owners (slot of each);
//      isect_count[0] those listed, [1] those there are, [2..5] workgroups of 64 over those listed
// The walk repeats count_tiles'. Should two compilations round differently, what it counted too much is
// padded with a tile past the last, where nothing is drawn, and what it counted too little is dropped.
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "../common/types.glsl"
#include "../common/tiles.glsl"
#include "../common/index.glsl"

layout(push_constant) uniform Push {
    uvec2 size;
    uint splats;
    uint capacity;
    float coarseness;
} push;

layout(set = 0, binding = 0, std430) readonly buffer VisibleCount { uint visible_count[]; };
layout(set = 0, binding = 1, std430) readonly buffer Slots { uint slots[]; };
layout(set = 0, binding = 2, std430) readonly buffer ProjectedIn { Projected projected[]; };
layout(set = 0, binding = 3, std430) readonly buffer TileOffsets { uint tile_offsets[]; };
layout(set = 0, binding = 4, std430) writeonly buffer Keys { uint keys[]; };
layout(set = 0, binding = 5, std430) writeonly buffer Owners { uint owners[]; };
layout(set = 0, binding = 6, std430) writeonly buffer IsectCount { uint isect_count[]; };

// One before the camera covers the picture. A thread that lists so many tiles alone is what all others wait for, so past this
// many the workgroup does it, a row a thread.
const uint ALONE_MAX = 64;

shared uint large_count;
shared uint large[gl_WorkGroupSize.x];
shared uint row_counts[gl_WorkGroupSize.x];

/// Lists the tiles of a row from `at` on; where it ended.
uint emit_row(Ellipse e, int row, uint slot, uint at, uint end) {
    const uint across = tile_grid(push.size).x;
    const ivec2 columns = columns_of(e, row, push.size);
    for (int column = columns.x; column <= columns.y && at < end; ++column) {
        keys[at] = uint(row) * across + uint(column);
        owners[at] = slot;
        ++at;
    }
    return at;
}

void pad(uint slot, uint at, uint end, uint stride) {
    const uvec2 grid = tile_grid(push.size);
    for (; at < end; at += stride) {
        keys[at] = grid.x * grid.y;
        owners[at] = slot;
    }
}

void emit_alone(uint rank, uint at, uint end) {
    const uint slot = slots[rank];
    const Ellipse e = ellipse_of(projected[slot], push.size, push.coarseness);
    for (int row = e.rows.x; row <= e.rows.y && at < end; ++row) {
        at = emit_row(e, row, slot, at, end);
    }
    pad(slot, at, end, 1);
}

/// By all threads of the workgroup.
void emit_together(uint rank) {
    const uint i = gl_LocalInvocationID.x, slot = slots[rank];
    const uint end = min(tile_offsets[rank + 1], push.capacity);
    const Ellipse e = ellipse_of(projected[slot], push.size, push.coarseness);
    uint next = tile_offsets[rank];
    for (int first = e.rows.x; first <= e.rows.y; first += int(gl_WorkGroupSize.x)) {
        const int row = first + int(i);
        const ivec2 columns = row <= e.rows.y ? columns_of(e, row, push.size) : ivec2(0, -1);
        row_counts[i] = uint(max(0, columns.y - columns.x + 1));
        barrier();
        uint at = next;
        for (uint k = 0; k < gl_WorkGroupSize.x; ++k) {
            at += k < i ? row_counts[k] : 0;
            next += row_counts[k];
        }
        barrier();
        if (row <= e.rows.y) {
            emit_row(e, row, slot, at, end);
        }
    }
    pad(slot, next + i, end, gl_WorkGroupSize.x);
}

void main() {
    const uint rank = thread_index(), i = gl_LocalInvocationID.x;
    if (rank == 0) {
        const uint needed = tile_offsets[push.splats];
        const uint listed = min(needed, push.capacity);
        const uint groups = (listed + 63) / 64;
        const uint high = max(1, (groups + 65534) / 65535);
        isect_count[0] = listed;
        isect_count[1] = needed;
        isect_count[2] = (groups + high - 1) / high;
        isect_count[3] = high;
        isect_count[4] = 1;
    }
    if (i == 0) {
        large_count = 0;
    }
    barrier();
    if (rank < visible_count[0]) {
        const uint begin = tile_offsets[rank], end = min(tile_offsets[rank + 1], push.capacity);
        if (end > begin + ALONE_MAX) {
            large[atomicAdd(large_count, 1)] = rank;
        } else {
            emit_alone(rank, begin, end);
        }
    }
    barrier();
    for (uint k = 0; k < large_count; ++k) {
        emit_together(large[k]);
    }
}
