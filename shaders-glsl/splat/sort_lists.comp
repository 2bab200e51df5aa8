// Sorts the list of each tile front to back, by depth and then by slot: one workgroup a tile; with LONG a long tile.
// 1. A run of up to RUN elements is cut into blocks. The place of an element in its block is the number of those before it.
// 2. Its place in the run is that in its block, and for each other block, by binary search, the number of those before it.
// 3. Neighbouring runs of a longer list are merged in the same way, in spare, until one is left.
// in   ranges, unsorted (elements, by tile); long_tiles, counts.long_lists
// out  lists (intersections, by tile); spare (twice as many elements), for lists longer than RUN
// No two elements are equal, so that the result does not depend on the order before: deterministic.
#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// variants: cpu
#ifdef CPU
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require
#endif
layout(local_size_x = 128, local_size_x_id = 0) in;

#include "../common/types.glsl"
#include "../common/index.glsl"
#include "../common/tile_depth.glsl"
#include "../common/texels.glsl"

layout(constant_id = 0) const uint LANES = 128;
layout(constant_id = 1) const bool LONG = false;
layout(constant_id = 2) const uint SUBGROUP_LANES = 8;  // on a CPU

layout(push_constant) uniform Push {
    uint capacity;  // of the lists
    uint up_to;     // longer ones are left to LONG
} push;

layout(set = 0, binding = 0, std430) readonly buffer CountsIn { Counts counts[]; };
READ_UVEC2S(1, Ranges, range_of)
READ_UINTS(2, LongTiles, long_tile)
READ_UVEC2S(3, Unsorted, unsorted)
layout(set = 0, binding = 4, std430) coherent buffer Spare { uvec2 spare[]; };
layout(set = 0, binding = 5, std430) writeonly buffer Lists { uint lists[]; };

const uint RUN = 256;
#ifdef CPU
#define WIDTH SUBGROUP_LANES  // lanes that share a block: a subgroup is full, and its invocations follow one another
const uint OWN = 4;            // elements of a lane that are compared at a time
const uint BLOCK = 128;
#else
#define WIDTH LANES
const uint OWN = 1;
const uint BLOCK = 64;
#endif

// As they come, then in sorted blocks.
shared uvec2 elements[2 * RUN];

/// Element i of the run from `begin` on.
uvec2 element(uint begin, uint i) {
#ifdef CPU
    return unsorted(begin + i);  // a texel: Mesa's CPU driver reads shared memory lane by lane
#else
    return elements[i];
#endif
}

/// Adds to `place` of each of OWN elements how many from `first` to `end` of a run come before it.
void count_before(uint begin, uint first, uint end, uvec2 own[OWN], inout uint place[OWN]) {
#ifdef CPU
    // One element of each lane, passed round by shuffle.
    for (uint k = first; k < end; k += WIDTH) {
        const uint at = k + gl_SubgroupInvocationID;
        const uvec2 held = at < end ? element(begin, at) : uvec2(NOWHERE);
        for (uint j = 0; j < WIDTH; ++j) {
            const uvec2 other = uvec2(subgroupShuffle(held.x, j), subgroupShuffle(held.y, j));
#else
    for (uint k = first; k < end; ++k) {
        {
            const uvec2 other = element(begin, k);
#endif
            [[unroll]] for (uint q = 0; q < OWN; ++q) {
                place[q] += before(other, own[q]) ? 1 : 0;
            }
        }
    }
}

// How many of the sorted elements from first to end of an array come before one.
#define COUNT_SORTED(array, first, end, own, count)       \
    {                                                     \
        uint low = first, high = end;                     \
        while (low < high) {                              \
            const uint middle = (low + high) / 2;         \
            if (before(array[middle], own)) {             \
                low = middle + 1;                         \
            } else {                                      \
                high = middle;                            \
            }                                             \
        }                                                 \
        count += low - (first);                           \
    }

void sort_list(uvec2 range) {
    const uint lane = gl_LocalInvocationID.x, length = range.y - range.x;
    for (uint begin = range.x; begin < range.y; begin += RUN) {
        const uint n = min(RUN, range.y - begin);
#ifndef CPU
        for (uint i = lane; i < n; i += LANES) {
            elements[i] = unsorted(begin + i);
        }
        barrier();
#endif
        for (uint base = lane / WIDTH * WIDTH * OWN; base < n; base += LANES * OWN) {
            const uint i = base + lane % WIDTH, first = min(i, n - 1) / BLOCK * BLOCK;
            uvec2 own[OWN];
            uint place[OWN];
            [[unroll]] for (uint q = 0; q < OWN; ++q) {
                own[q] = element(begin, min(i + q * WIDTH, n - 1));
                place[q] = first;
            }
            count_before(begin, first, min(first + BLOCK, n), own, place);
            [[unroll]] for (uint q = 0; q < OWN; ++q) {
                if (i + q * WIDTH >= n) {
                    continue;
                }
                if (length <= BLOCK) {
                    lists[begin + place[q]] = intersection_of(own[q]);
                } else {
                    elements[RUN + place[q]] = own[q];
                }
            }
        }
        if (length <= BLOCK) {
            return;
        }
        barrier();
        for (uint i = lane; i < n; i += LANES) {
            const uvec2 own = elements[RUN + i];
            const uint mine = i / BLOCK * BLOCK;
            uint place = i - mine;
            for (uint first = 0; first < n; first += BLOCK) {
                if (first != mine) {
                    COUNT_SORTED(elements, RUN + first, RUN + min(first + BLOCK, n), own, place)
                }
            }
            if (length <= RUN) {
                lists[begin + place] = intersection_of(own);
            } else {
                spare[begin + place] = own;
            }
        }
        barrier();
    }
    uint from = range.x, to = push.capacity + range.x;
    for (uint width = RUN; width < length; width *= 2) {
        memoryBarrierBuffer();
        barrier();
        for (uint i = lane; i < length; i += LANES) {
            const uvec2 own = spare[from + i];
            const uint other = from + min(i / width * width ^ width, length);
            uint place = i % width + i / (2 * width) * (2 * width);
            COUNT_SORTED(spare, other, min(other + width, from + length), own, place)
            if (2 * width < length) {
                spare[to + place] = own;
            } else {
                lists[range.x + place] = intersection_of(own);
            }
        }
        const uint swapped = from;
        from = to;
        to = swapped;
    }
}

void main() {
    const uint group = group_index();
    if (LONG && group >= counts[0].long_lists) {
        return;
    }
    const uvec2 range = range_of(LONG ? long_tile(group) : group);
    if (LONG || range.y - range.x <= push.up_to) {
        sort_list(range);
    }
}
