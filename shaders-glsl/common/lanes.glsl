// One tile is shaded by LANES invocations in step. Each fetches one Gaussian; then all take them in
// turn. The subgroup variant keeps the batch in registers and passes it by shuffle, with several
// tiles to a workgroup where subgroups are narrower than it; the baseline keeps it in shared memory,
// with one tile of 32 lanes to a workgroup.

struct Batch {
    vec4 a;     // centre x, y; conic a, b
    vec4 b;     // conic c; log2 opacity; grey or red; depth
    vec2 chroma;  // green, blue
    uint slot;  // gradient slot
};

/// One that no pixel sees, in place of those past the end of a list.
const float LOG2_UNSEEN = -1e5;

#ifdef SUBGROUP

uint lane() {
    return gl_SubgroupInvocationID;
}

uint tile_index() {
    return group_index() * (gl_WorkGroupSize.x / LANES) + gl_SubgroupID;
}

Batch held;

void batch_put(Batch b) {
    held = b;
}

Batch batch_get(uint i) {
    const vec2 chroma = CHANNELS == 3 ? subgroupShuffle(held.chroma, i) : vec2(0.0);
    return Batch(subgroupShuffle(held.a, i), subgroupShuffle(held.b, i), chroma, subgroupShuffle(held.slot, i));
}

bool all_lanes(bool done) {
    return subgroupAll(done);
}

/// Gaussians whose gradients are summed over the lanes at once: eight values each, one for every lane. A sum is a chain of
/// dependent shuffles; those of several Gaussians overlap.
const uint TOGETHER = LANES / 8;

// One step of `sums`: halves the values and doubles the lanes that each is summed over.
#define HALVE(v, half_width)                                                                          \
    if (half_width < LANES) {                                                                         \
        const bool up = (lane() & half_width) != 0;                                                   \
        [[unroll]] for (uint i = 0; i < half_width; ++i) {                                            \
            const float mine = up ? v[i + half_width] : v[i], other = up ? v[i] : v[i + half_width];  \
            v[i] = mine + subgroupShuffleXor(other, half_width);                                      \
        }                                                                                             \
    }

/// Sums LANES values over the lanes: lane l gets the sum of value l.
float sums(float v[32]) {
    HALVE(v, 16u)
    HALVE(v, 8u)
    HALVE(v, 4u)
    HALVE(v, 2u)
    HALVE(v, 1u)
    return v[0];
}

/// Slot of the Gaussian whose value lane l has after `sums`, of those from i on.
uint slot_of_lane(uint i) {
    return subgroupShuffle(held.slot, i + lane() / 8);
}

/// Sums 2 values: lane l gets the sum of value l & 1.
float sum_of_two(float a, float b) {
    const bool up = (lane() & 1u) != 0;
    float s = (up ? b : a) + subgroupShuffleXor(up ? a : b, 1);
    [[unroll]] for (uint step = 2; step < LANES; step *= 2) {
        s += subgroupShuffleXor(s, step);
    }
    return s;
}

#else

uint lane() {
    return gl_LocalInvocationID.x;
}

uint tile_index() {
    return group_index();
}

shared vec4 batch_a[32];
shared vec4 batch_b[32];
shared vec2 batch_chroma[32];
shared uint batch_slot[32];
shared uint pending;
shared float terms[8 * 33];

void batch_put(Batch b) {
    barrier();
    batch_a[lane()] = b.a;
    batch_b[lane()] = b.b;
    if (CHANNELS == 3) {
        batch_chroma[lane()] = b.chroma;
    }
    batch_slot[lane()] = b.slot;
    barrier();
}

Batch batch_get(uint i) {
    return Batch(batch_a[i], batch_b[i], CHANNELS == 3 ? batch_chroma[i] : vec2(0.0), batch_slot[i]);
}

bool all_lanes(bool done) {
    barrier();
    if (lane() == 0) {
        pending = 0;
    }
    barrier();
    if (!done) {
        atomicOr(pending, 1u);
    }
    barrier();
    return pending == 0;
}

const uint TOGETHER = 1;

/// Sums 8 values over the lanes: lane l gets the sum of value l & 7.
float sums(float v[32]) {
    const uint l = lane();
    barrier();
    [[unroll]] for (uint i = 0; i < 8; ++i) {
        terms[i * 33 + l] = v[i];
    }
    barrier();
    float s = 0.0;
    [[unroll]] for (uint i = 0; i < 8; ++i) {
        s += terms[(l & 7u) * 33 + (l >> 3) * 8 + i];
    }
    barrier();
    terms[(l & 7u) * 33 + (l >> 3)] = s;
    barrier();
    const uint row = (l & 7u) * 33;
    return (terms[row] + terms[row + 1]) + (terms[row + 2] + terms[row + 3]);
}

/// Slot of the Gaussian whose values `sums` has just summed.
uint slot_of_lane(uint i) {
    return batch_slot[i];
}

float sum_of_two(float a, float b) {
    float v[32];
    [[unroll]] for (uint i = 0; i < 8; ++i) {
        v[i] = i == 0 ? a : i == 1 ? b : 0.0;
    }
    return sums(v);
}

#endif
