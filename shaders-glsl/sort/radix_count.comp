#version 450
#extension GL_GOOGLE_include_directive : require
// Upsweep of one radix pass: how many keys of each digit every group holds.
// In:  keys[0..count]. Out: table[group * digits + digit].
// Shared atomics count in any order, the sums are the same: deterministic.
#include "split.glsl"

layout(local_size_x = 256) in;

layout(set = 0, binding = 0, std430) readonly buffer Keys { uint keys[]; };
layout(set = 0, binding = 1, std430) readonly buffer Count { uint count[]; };
layout(set = 0, binding = 2, std430) writeonly buffer Table { uint table[]; };

shared uint seen[DIGITS_MAX];

void main() {
    uint lane = gl_LocalInvocationID.x;
    uint group = gl_WorkGroupID.x;
    uint n = min(count[0], capacity);
    uint groups = groups_of(n);
    if (group >= groups) return;
    for (uint d = lane; d < digits; d += 256u) seen[d] = 0u;
    barrier();
    uvec2 range = range_of(n, groups, group);
    for (uint i = range.x + lane; i < range.y; i += 256u) {
        uint key = keys[i];
        if (sorted(key)) atomicAdd(seen[(key >> shift) & (digits - 1u)], 1u);
    }
    barrier();
    for (uint d = lane; d < digits; d += 256u) table[group * digits + d] = seen[d];
}
