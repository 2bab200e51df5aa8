// How `n` keys are split over the workgroups of a radix pass. Both kernels of a pass must agree on it.
// Groups below KEYS_MIN keys cost more in table rows than they gain in parallelism.

const uint ROUND = 32u;      // keys one scatter workgroup ranks at a time
const uint KEYS_MIN = 1024u;

uint groups_of(uint n, uint groups_max) {
    return clamp((n + KEYS_MIN - 1u) / KEYS_MIN, 1u, groups_max);
}

// First key of a group and one past its last. Whole rounds, so only the last group has a ragged end.
uvec2 range_of(uint n, uint groups, uint group) {
    uint rounds = (n + ROUND - 1u) / ROUND;
    uint keys = (rounds + groups - 1u) / groups * ROUND;
    uint begin = min(group * keys, n);
    return uvec2(begin, min(begin + keys, n));
}
