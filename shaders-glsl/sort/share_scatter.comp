#version 450
#extension GL_GOOGLE_include_directive : require
// variants: cpu
// Downsweep of one radix pass on a CPU: every key and its payload go to their place, stably ordered by digit.
// In:  keys_in, payload_in, count, table (of share_count). Out: keys_out, payload_out; sorted_count[0] (first pass); places, which
// is scratch: places[share * digits + digit], where the share's next key of that digit goes.
// Every workgroup finds the places of its shares itself, from the whole table. An invocation moves the keys of its share one
// after another, so order is kept without ranks.
#include "shares.glsl"
#include "../common/texels.glsl"

layout(local_size_x = 8) in;

READ_UINTS(0, KeysIn, key_in)
READ_UINTS(1, PayloadIn, payload_in)
READ_UINTS(2, Count, count)
READ_UINTS(3, Table, table)
layout(set = 0, binding = 4, std430) coherent buffer Places { uint places[]; };
layout(set = 0, binding = 5, std430) writeonly buffer KeysOut { uint keys_out[]; };
layout(set = 0, binding = 6, std430) writeonly buffer PayloadOut { uint payload_out[]; };
layout(set = 0, binding = 7, std430) writeonly buffer SortedCount { uint sorted_count[]; };

shared uint sums[LANES];

// Each lane takes consecutive digits.
void find_places(uint lane, uint group) {
    uint each = max(1u, digits / LANES), begin = min(lane * each, digits), end = min(begin + each, digits);
    uint sum = 0u;
    for (uint d = begin; d < end; ++d) {
        for (uint s = 0u; s < shares; ++s) sum += table(s * digits + d);
    }
    sums[lane] = sum;
    barrier();
    uint running = 0u, total = 0u;
    for (uint l = 0u; l < LANES; ++l) {
        running += l < lane ? sums[l] : 0u;
        total += sums[l];
    }
    if (group == 0u && lane == 0u && first != 0u) sorted_count[0] = total;
    for (uint d = begin; d < end; ++d) {
        for (uint s = 0u; s < shares; ++s) {
            if (s / LANES == group) places[s * digits + d] = running;
            running += table(s * digits + d);
        }
    }
    memoryBarrierBuffer();
    barrier();
}

void main() {
    uint share = gl_GlobalInvocationID.x;
    find_places(gl_LocalInvocationID.x, gl_WorkGroupID.x);
    uvec2 range = range_of(min(count(0u), capacity), share);
    for (uint i = range.x; i < range.y; ++i) {
        uint key = key_in(i);
        if (sorted(key)) {
            uint at = share * digits + ((key >> shift) & (digits - 1u));
            uint place = places[at];
            places[at] = place + 1u;
            keys_out[place] = key;
            payload_out[place] = first != 0u ? i : payload_in(i);
        }
    }
}
