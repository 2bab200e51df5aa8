#version 450
#extension GL_GOOGLE_include_directive : require
// Second half of an exclusive scan. In: data[0..n], sums[block]. Out: data scanned in place.
// Two dispatches for any length: a block walks its tiles, so the block sums always fit one workgroup.
#include "tile_scan.glsl"

layout(local_size_x = 256) in;

layout(set = 0, binding = 0, std430) buffer Data { uint data[]; };
layout(set = 0, binding = 1, std430) readonly buffer Sums { uint sums[]; };

layout(push_constant) uniform Push {
    uint n;
    uint blocks;
};

void main() {
    uint lane = gl_LocalInvocationID.x;
    uint block = gl_WorkGroupID.x;
    if (block >= blocks) return;
    uvec2 range = block_range(n, blocks, block);
    uint carry;
    lanes_exclusive(lane, lane < block ? sums[lane] : 0u, carry);
    for (uint first = range.x; first < range.y; first += TILE) {
        uint begin = min(first + lane * ITEMS, range.y);
        uint end = min(begin + ITEMS, range.y);
        uint sum = 0u;
        for (uint i = begin; i < end; i++) sum += data[i];
        uint tile;
        uint running = carry + lanes_exclusive(lane, sum, tile);
        for (uint i = begin; i < end; i++) {
            uint value = data[i];
            data[i] = running;
            running += value;
        }
        carry += tile;
    }
}
