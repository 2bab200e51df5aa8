#version 450
#extension GL_GOOGLE_include_directive : require
// variants: cpu
// First half of an exclusive scan: the sum of each block. In: data(0..n). Out: sums[block].
#include "tile_scan.glsl"
#include "../common/texels.glsl"

layout(local_size_x = 256) in;

READ_UINTS(0, Data, data)
layout(set = 0, binding = 1, std430) writeonly buffer Sums { uint sums[]; };

layout(push_constant) uniform Push {
    uint n;
    uint blocks; // at most 256
};

void main() {
    uint lane = gl_LocalInvocationID.x;
    uint block = gl_WorkGroupID.x;
    if (block >= blocks) return;
    uvec2 range = block_range(n, blocks, block);
    uint sum = 0u;
    for (uint i = range.x + lane; i < range.y; i += LANES) sum += data(i);
    uint total;
    lanes_exclusive(lane, sum, total);
    if (lane == 0u) sums[block] = total;
}
