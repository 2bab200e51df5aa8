// Exclusive sum over the 256 lanes of a workgroup, and the sum of all. Every lane must call it.

const uint LANES = 256u;
shared uint ladder[2u * LANES];

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
    uint inclusive = ladder[at + lane];
    barrier(); // the caller may call again
    return inclusive - value;
}

// Elements of `n` that a block sums: whole tiles, so blocks differ by one tile at most.
layout(constant_id = 0) const uint ITEMS = 4; // of a lane
const uint TILE = LANES * ITEMS;

uvec2 block_range(uint n, uint blocks, uint block) {
    uint tiles = (n + TILE - 1u) / TILE;
    uint span = (tiles + blocks - 1u) / blocks * TILE;
    uint begin = min(block * span, n);
    return uvec2(begin, min(begin + span, n));
}
