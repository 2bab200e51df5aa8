// What the two kernels of a radix pass must agree on: who has which keys, and which keys are sorted.

const uint LANES = 256u;   // of a workgroup, and the keys it ranks at a time
const uint DIGITS_MAX = 256u;

layout(push_constant) uniform Push {
    uint capacity;
    uint groups_max;
    uint keys_min;   // fewer keys to a workgroup cost more in table rows than they gain in parallelism
    uint shift;
    uint digits;     // 1 << bits of this pass
    uint first;      // 1: keys that are NONE are left out, and a key's payload is its index
    uint next_shift;  // of the pass after this one,
    uint next_digits; // which this one counts for, or zero
};

const uint NONE = 0xffffffffu;

uint groups_of(uint n) {
    return clamp((n + keys_min - 1u) / keys_min, 1u, groups_max);
}

// Keys of a group: whole rounds, so only the last group has a ragged end.
uint keys_of(uint n, uint groups) {
    uint rounds = (n + LANES - 1u) / LANES;
    return max(1u, (rounds + groups - 1u) / groups) * LANES;
}

// First key of a group and one past its last.
uvec2 range_of(uint n, uint groups, uint group) {
    uint keys = keys_of(n, groups);
    uint begin = min(group * keys, n);
    return uvec2(begin, min(begin + keys, n));
}

bool sorted(uint key) {
    return first == 0u || key != NONE;
}
