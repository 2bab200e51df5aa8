#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Downsweep of one radix pass: every key and its payload go to their place, stably ordered by digit.
// In:  keys_in, payload_in, count, table (of radix_count, or of the pass before). Out: keys_out, payload_out;
//      sorted_count[0] (first pass); next_table, which was zero: the table of the next pass, where this one counts for it.
//
// A group finds its places itself, from the whole table: a few hundred reads a lane, in place of a scan of the table
// in two more dispatches, each of which costs a GPU as much as this kernel.
//
// Rank without subgroup operations: each row of 32 lanes sets its bits in the word of their digit, so one word holds
// all peers of the row, and population counts of the rows above and of the lower lanes are the stable rank. Setting
// bits and adding commute: deterministic.
#include "split.glsl"

layout(local_size_x = 256) in;
const uint ROWS = LANES / 32;
const uint READS = 16; // of the table, under way at once

layout(set = 0, binding = 0, std430) readonly buffer KeysIn { uint keys_in[]; };
layout(set = 0, binding = 1, std430) readonly buffer PayloadIn { uint payload_in[]; };
layout(set = 0, binding = 2, std430) readonly buffer Count { uint count[]; };
layout(set = 0, binding = 3, std430) readonly buffer Table { uint table[]; };
layout(set = 0, binding = 4, std430) writeonly buffer KeysOut { uint keys_out[]; };
layout(set = 0, binding = 5, std430) writeonly buffer PayloadOut { uint payload_out[]; };
layout(set = 0, binding = 6, std430) writeonly buffer SortedCount { uint sorted_count[]; };
layout(set = 0, binding = 7, std430) buffer NextTable { uint next_table[]; };

shared uint peers_of[ROWS * DIGITS_MAX];
shared uint next[DIGITS_MAX];
shared uint ladder[2 * LANES];

// Exclusive sum over the lanes of the group, and the sum of all.
uint lanes_exclusive(uint lane, uint value, out uint total) {
    uint at = 0u;
    ladder[lane] = value;
    barrier();
    for (uint step = 1u; step < LANES; step <<= 1u) {
        uint sum = ladder[at + lane];
        if (lane >= step) sum += ladder[at + lane - step];
        at ^= LANES;
        ladder[at + lane] = sum;
        barrier();
    }
    total = ladder[at + LANES - 1u];
    return ladder[at + lane] - value;
}

// next[digit]: where this group's first key of the digit goes. Leaves peers_of zero. Answers how many keys are sorted.
uint find_places(uint lane, uint group, uint groups) {
    for (uint d = lane; d < digits; d += LANES) {
        next[d] = 0u;
        peers_of[d] = 0u;
    }
    barrier();
    // All of a digit's keys are counted in peers_of, those in groups before this one in next. Lanes that digits leave
    // over share the groups.
    uint shares = max(1u, LANES / digits);
    for (uint i = lane; i < digits * shares; i += LANES) {
        uint digit = i & (digits - 1u), before = 0u, all = 0u;
        // Several reads under way at once: one after another they would take longer than the rest.
        for (uint g0 = i / digits; g0 < groups; g0 += READS * shares) {
            [[unroll]] for (uint k = 0u; k < READS; ++k) {
                uint g = g0 + k * shares;
                uint n = g < groups ? table[g * digits + digit] : 0u;
                all += n;
                before += g < group ? n : 0u;
            }
        }
        atomicAdd(next[digit], before);
        atomicAdd(peers_of[digit], all);
    }
    barrier();
    uint each = max(1u, digits / LANES), own = lane * each;
    uint sum = 0u, total;
    if (own < digits) {
        for (uint d = own; d < own + each; ++d) sum += peers_of[d];
    }
    uint running = lanes_exclusive(lane, sum, total);
    if (own < digits) {
        for (uint d = own; d < own + each; ++d) {
            next[d] += running;
            running += peers_of[d];
        }
    }
    if (group == 0u && lane == 0u && first != 0u) sorted_count[0] = total;
    barrier();
    for (uint i = lane; i < ROWS * digits; i += LANES) peers_of[i] = 0u;
    barrier();
    return total;
}

struct Pair {
    uint key;
    uint payload;
};

Pair read(uint i, uint end) {
    if (i >= end) return Pair(NONE, 0u);
    return Pair(keys_in[i], first != 0u ? i : payload_in[i]);
}

void main() {
    uint lane = gl_LocalInvocationID.x;
    uint group = gl_WorkGroupID.x;
    uint n = min(count[0], capacity);
    uint groups = groups_of(n);
    if (group >= groups) return;
    uint row = lane / 32u, bit = 1u << (lane & 31u);
    uvec2 range = range_of(n, groups, group);
    Pair coming = read(range.x + lane, range.y);
    uint total = find_places(lane, group, groups);
    uint next_groups = groups_of(total), next_keys = keys_of(total, next_groups);
    for (uint base = range.x; base < range.y; base += LANES) {
        uint i = base + lane;
        Pair pair = coming;
        coming = read(i + LANES, range.y);
        bool live = i < range.y && sorted(pair.key);
        uint digit = (pair.key >> shift) & (digits - 1u);
        uint mine = row * digits + digit;
        if (live) atomicOr(peers_of[mine], bit);
        barrier();
        uint peers = 0u, place = 0u;
        if (live) {
            peers = peers_of[mine];
            place = next[digit] + bitCount(peers & (bit - 1u));
            for (uint r = 0u; r < row; ++r) place += bitCount(peers_of[r * digits + digit]);
        }
        barrier();
        if (live) {
            if ((peers & (bit - 1u)) == 0u) { // the first of its digit and row opens the next round for them
                atomicAdd(next[digit], bitCount(peers));
                peers_of[mine] = 0u;
            }
            keys_out[place] = pair.key;
            payload_out[place] = pair.payload;
            if (next_digits != 0u) {
                uint next_digit = (pair.key >> next_shift) & (next_digits - 1u);
                atomicAdd(next_table[place / next_keys * next_digits + next_digit], 1u);
            }
        }
        barrier();
    }
}
