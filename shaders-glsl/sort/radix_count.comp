#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Upsweep of a radix pass: how many keys of each digit every group holds. Every second pass needs none, as the one before it
// counts for it.
// In:  keys[0..count]. Out: table[group * digits + digit]; next_table: zero, for radix_scatter.
// Shared atomics count in any order, the sums are the same: deterministic.
#include "split.glsl"

layout(local_size_x = 256) in;

layout(set = 0, binding = 0, std430) readonly buffer Keys { uint keys[]; };
layout(set = 0, binding = 1, std430) readonly buffer Count { uint count[]; };
layout(set = 0, binding = 2, std430) writeonly buffer Table { uint table[]; };
layout(set = 0, binding = 3, std430) writeonly buffer NextTable { uint next_table[]; };

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
    // Several reads under way at once.
    for (uint base = range.x + lane; base < range.y; base += 4u * 256u) {
        uint batch[4];
        [[unroll]] for (uint k = 0u; k < 4u; ++k) batch[k] = keys[min(base + k * 256u, range.y - 1u)];
        [[unroll]] for (uint k = 0u; k < 4u; ++k) {
            if (base + k * 256u < range.y && sorted(batch[k])) atomicAdd(seen[(batch[k] >> shift) & (digits - 1u)], 1u);
        }
    }
    for (uint d = lane; d < next_digits; d += 256u) next_table[group * next_digits + d] = 0u;
    barrier();
    for (uint d = lane; d < digits; d += 256u) table[group * digits + d] = seen[d];
}
