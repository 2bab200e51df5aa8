// First and last + 1 of each tile's run in the sorted list, which the workgroups walk; tiles without one keep the zeros
// they were filled with.
// in   isect_count, keys (sorted)
// out  ranges[tile]
#version 450
#extension GL_GOOGLE_include_directive : require
// variants: cpu
layout(local_size_x = 64) in;

#include "../common/index.glsl"
#include "../common/texels.glsl"

layout(push_constant) uniform Push {
    uint tiles;  // with the one of emit_tiles' padding
} push;

READ_UINTS(0, IsectCount, isect_count)
READ_UINTS(1, Keys, key_at)
layout(set = 0, binding = 2, std430) writeonly buffer Ranges { uvec2 ranges[]; };

void main() {
    const uint n = isect_count(0);
    for (uint i = thread_index(); i < n; i += gl_NumWorkGroups.x * gl_WorkGroupSize.x) {
        const uint tile = key_at(i);
        if (tile >= push.tiles) {
            continue;
        }
        if (i == 0 || key_at(i - 1) != tile) {
            ranges[tile].x = i;
        }
        if (i + 1 == n || key_at(i + 1) != tile) {
            ranges[tile].y = i + 1;
        }
    }
}
