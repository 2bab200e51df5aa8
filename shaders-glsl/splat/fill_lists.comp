// Puts each intersection into the list of its tile, in any order: workgroups walk the intersections.
// in   counts.listed, tile_depths, owners
// out  ranges[tile]: first place, and one past the last; unsorted (elements, by tile)
#version 450
#extension GL_GOOGLE_include_directive : require
// variants: cpu
layout(local_size_x = 64) in;

#include "../common/types.glsl"
#include "../common/index.glsl"
#include "../common/tile_depth.glsl"
#include "../common/texels.glsl"

layout(set = 0, binding = 0, std430) readonly buffer CountsIn { Counts counts[]; };
READ_UINTS(1, TileDepths, tile_depth)
READ_UINTS(2, Owners, owner)
layout(set = 0, binding = 3, std430) buffer Ranges { uvec2 ranges[]; };
layout(set = 0, binding = 4, std430) writeonly buffer Unsorted { uvec2 unsorted[]; };

void main() {
    const uint n = counts[0].listed;
    for (uint i = thread_index(); i < n; i += gl_NumWorkGroups.x * gl_WorkGroupSize.x) {
        const uint word = tile_depth(i);
        if (word != NOWHERE) {
            unsorted[atomicAdd(ranges[tile_of(word)].y, 1)] = element_of(word, owner(i), i);
        }
    }
}
