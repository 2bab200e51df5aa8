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
};

const uint NONE = 0xffffffffu;

uint groups_of(uint n) {
    return clamp((n + keys_min - 1u) / keys_min, 1u, groups_max);
}

// First key of a group and one past its last. Whole rounds, so only the last group has a ragged end.
uvec2 range_of(uint n, uint groups, uint group) {
    uint rounds = (n + LANES - 1u) / LANES;
    uint keys = (rounds + groups - 1u) / groups * LANES;
    uint begin = min(group * keys, n);
    return uvec2(begin, min(begin + keys, n));
}

bool sorted(uint key) {
    return first == 0u || key != NONE;
}
