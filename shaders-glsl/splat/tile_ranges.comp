// Gives each tile as many places in a row as it has intersections: one thread a tile. Which tile comes first differs from run to run,
// what its list holds does not.
// in   tile_lengths
// out  ranges[tile]: its first place, twice, as fill_lists moves the second to the end; long_tiles, in any order, and counts.long_lists;
//      counts.listed, .shared_out
#version 450
#extension GL_GOOGLE_include_directive : require
layout(local_size_x = 64) in;

#include "../common/types.glsl"
#include "../common/index.glsl"

layout(push_constant) uniform Push {
    uint tiles;
    uint capacity;  // intersections
    uint up_to;     // longer lists are sorted apart
} push;

layout(set = 0, binding = 0, std430) readonly buffer TileLengths { uint tile_lengths[]; };
layout(set = 0, binding = 1, std430) writeonly buffer Ranges { uvec2 ranges[]; };
layout(set = 0, binding = 2, std430) writeonly buffer LongTiles { uint long_tiles[]; };
layout(set = 0, binding = 3, std430) buffer CountsOut { Counts counts[]; };

shared uint together;  // places of the workgroup's tiles, then the first of them

void main() {
    const uint tile = thread_index();
    const bool leads = gl_LocalInvocationID.x == 0;
    if (leads) {
        together = 0;
    }
    barrier();
    const uint length = tile < push.tiles ? tile_lengths[tile] : 0;
    const uint before = atomicAdd(together, length);
    barrier();
    if (leads) {
        together = atomicAdd(counts[0].shared_out, together);
    }
    barrier();
    if (tile < push.tiles) {
        ranges[tile] = uvec2(together + before);
        if (length > push.up_to) {
            long_tiles[atomicAdd(counts[0].long_lists, 1)] = tile;
        }
    }
    if (tile == 0) {
        counts[0].listed = min(counts[0].needed, push.capacity);
    }
}
