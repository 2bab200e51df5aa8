#version 450
#extension GL_GOOGLE_include_directive : require
// variants: cpu
// Upsweep of one radix pass on a CPU: how many keys of each digit every share holds.
// In:  keys[0..count]. Out: table[share * digits + digit].
// A share is the consecutive keys that one invocation counts, in counters of its own: no atomics, no barriers.
#include "shares.glsl"
#include "../common/texels.glsl"

layout(local_size_x = 8) in;

READ_UINTS(0, Keys, key_at)
READ_UINTS(1, Count, count)
layout(set = 0, binding = 2, std430) buffer Table { uint table[]; };

void main() {
    uint share = gl_GlobalInvocationID.x;
    for (uint d = 0u; d < digits; ++d) table[share * digits + d] = 0u;
    uvec2 range = range_of(min(count(0u), capacity), share);
    for (uint i = range.x; i < range.y; ++i) {
        uint key = key_at(i);
        if (sorted(key)) ++table[share * digits + ((key >> shift) & (digits - 1u))];
    }
}
