#version 450
#extension GL_GOOGLE_include_directive : require
// Downsweep of one radix pass: every key and its payload go to the place the scanned table gives them.
// In:  keys_in, payload_in, table (exclusive sums). Out: keys_out, payload_out, stably ordered by digit.
//
// Rank without subgroup operations: 32 keys a round set their bit in the word of their digit, so one
// word holds all peers of a round, and a population count of the lower lanes is the stable rank.
// Setting bits commutes: deterministic. A wide digit (11 bits: 16 KiB) sorts tile keys in one pass.
#include "split.glsl"

layout(local_size_x = 32) in;
layout(constant_id = 0) const uint DIGITS_MAX = 2048;

layout(set = 0, binding = 0, std430) readonly buffer KeysIn { uint keys_in[]; };
layout(set = 0, binding = 1, std430) readonly buffer PayloadIn { uint payload_in[]; };
layout(set = 0, binding = 2, std430) readonly buffer Count { uint count[]; };
layout(set = 0, binding = 3, std430) readonly buffer Table { uint table[]; };
layout(set = 0, binding = 4, std430) writeonly buffer KeysOut { uint keys_out[]; };
layout(set = 0, binding = 5, std430) writeonly buffer PayloadOut { uint payload_out[]; };

layout(push_constant) uniform Push {
    uint capacity;
    uint groups_max;
    uint shift;
    uint digits;
};

shared uint peers_of[DIGITS_MAX];
shared uint next[DIGITS_MAX];

void main() {
    uint lane = gl_LocalInvocationID.x;
    uint group = gl_WorkGroupID.x;
    uint n = min(count[0], capacity);
    uint groups = groups_of(n, groups_max);
    if (group >= groups) return;
    for (uint d = lane; d < digits; d += ROUND) {
        peers_of[d] = 0u;
        next[d] = table[d * groups + group];
    }
    barrier();
    uint below = (1u << lane) - 1u;
    uvec2 range = range_of(n, groups, group);
    for (uint first = range.x; first < range.y; first += ROUND) {
        uint i = first + lane;
        bool live = i < range.y;
        uint key = 0u, digit = 0u, peers = 0u, place = 0u;
        if (live) {
            key = keys_in[i];
            digit = (key >> shift) & (digits - 1u);
            atomicOr(peers_of[digit], 1u << lane);
        }
        barrier();
        if (live) {
            peers = peers_of[digit];
            place = next[digit] + bitCount(peers & below);
        }
        barrier();
        if (live) {
            if ((peers & below) == 0u) { // the first of its digit opens the next round for it
                next[digit] = place + bitCount(peers);
                peers_of[digit] = 0u;
            }
            keys_out[place] = key;
            payload_out[place] = payload_in[i];
        }
        barrier();
    }
}
