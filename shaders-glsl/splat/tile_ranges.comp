// First and last + 1 of each tile's run in the sorted list; tiles without one keep the zeros they were filled with.
// in   isect_count, keys (sorted)
// out  ranges[tile]
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "../common/index.glsl"

layout(push_constant) uniform Push {
    uint tiles;  // with the one of emit_tiles' padding
} push;

layout(set = 0, binding = 0, std430) readonly buffer IsectCount { uint isect_count[]; };
layout(set = 0, binding = 1, std430) readonly buffer Keys { uint keys[]; };
layout(set = 0, binding = 2, std430) writeonly buffer Ranges { uvec2 ranges[]; };

void main() {
    const uint i = thread_index();
    const uint n = isect_count[0];
    if (i >= n) {
        return;
    }
    const uint tile = keys[i];
    if (tile >= push.tiles) {
        return;
    }
    if (i == 0 || keys[i - 1] != tile) {
        ranges[tile].x = i;
    }
    if (i + 1 == n || keys[i + 1] != tile) {
        ranges[tile].y = i + 1;
    }
}
